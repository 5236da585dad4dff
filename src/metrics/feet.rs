//! Foot skate: how fast feet slide that should stand still.

use std::collections::BTreeMap;

use nalgebra::Vector3;
use serde::Serialize;

use crate::core::body::{FEET, Posture};

/// Contact: the joint is less than this above its floor, millimetres, and ...
const CONTACT_HEIGHT: i64 = 40;
/// ... its speed is below this, m/s.
const CONTACT_SPEED: f64 = 0.2;
/// This share of a joint's heights is below its floor: the lowest values are noise.
const BELOW_FLOOR: f64 = 0.05;

/// Speed of feet that should stand still, over the ankles and feet of both sides.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct FootSkate {
    /// Mean horizontal speed of the joints in contact, mm/s.
    pub mm_s: f64,
    /// The same for the true joints: speed in the motion itself. `None` without a truth.
    pub truth_mm_s: Option<f64>,
    /// Number of contacts: frames, counted for each joint.
    pub contacts: usize,
    /// Share of the contacts in all frames, percent.
    pub contact_percent: f64,
}

/// Foot skate of two runs of the same times, without gaps, at `fps`; see [`FootSkateSums`].
pub fn foot_skate(estimate: &[Posture], truth: &[Posture], fps: f64) -> Option<FootSkate> {
    let mut sums = FootSkateSums::new(fps);
    estimate.iter().zip(truth).for_each(|(estimate, truth)| sums.add(estimate, Some(truth)));
    sums.finish()
}

/// Positions of [`FEET`].
type Feet = [Vector3<f64>; FEET.len()];

/// Sums [`FootSkate`] over frames, in memory that does not grow with their number.
///
/// Speeds are |P(t+1) - P(t-1)| fps / 2. A joint is in contact in a frame if its true height is less
/// than 4 cm above its floor and its true speed below 0.2 m/s. The floor is the 5th percentile of the
/// joint's true heights; heights are rounded to millimetres. Without a truth, the estimate decides.
/// Contact by height and speed of ankles and toes follows \[Rempe 2021\], with thresholds of our own.
#[derive(Clone, Debug)]
pub struct FootSkateSums {
    fps: f64,
    has_truth: bool,
    /// The last frames of the run, at most two: estimate and truth.
    run: Vec<[Feet; 2]>,
    /// By joint and height, millimetres.
    heights: [BTreeMap<i64, Slow>; FEET.len()],
}

/// The frames with a joint at one height: all, those in which it is slow, and the sums of the
/// horizontal speeds of estimate and truth in these, m/s.
#[derive(Clone, Debug, Default)]
struct Slow {
    all: usize,
    slow: usize,
    sums: [f64; 2],
}

impl FootSkateSums {
    /// For postures at `fps` frames a second.
    pub fn new(fps: f64) -> Self {
        Self { fps, has_truth: false, run: Vec::new(), heights: Default::default() }
    }

    /// The next frame does not follow the one before.
    pub fn gap(&mut self) {
        self.run.clear();
    }

    /// Adds the next frame.
    pub fn add(&mut self, estimate: &Posture, truth: Option<&Posture>) {
        let feet = |posture: &Posture| FEET.map(|joint| posture.positions[joint.index()]);
        self.has_truth = truth.is_some();
        let new = [feet(estimate), feet(truth.unwrap_or(estimate))];
        if let [before, at] = &self.run[..] {
            for (j, heights) in self.heights.iter_mut().enumerate() {
                let bin = heights.entry((1e3 * at[1][j].y).round() as i64).or_default();
                bin.all += 1;
                let velocities = [0, 1].map(|run| (new[run][j] - before[run][j]) * 0.5 * self.fps);
                if velocities[1].norm() < CONTACT_SPEED {
                    bin.slow += 1;
                    (0..2).for_each(|run| bin.sums[run] += velocities[run].xz().norm());
                }
            }
            self.run.remove(0);
        }
        self.run.push(new);
    }

    /// The skate so far; `None` without a contact.
    pub fn finish(&self) -> Option<FootSkate> {
        let (mut all, mut contacts, mut sums) = (0, 0, [0.0; 2]);
        for heights in &self.heights {
            let frames: usize = heights.values().map(|bin| bin.all).sum();
            let mut below = 0;
            let floor = heights.iter().find(|(_, bin)| {
                below += bin.all;
                below as f64 >= BELOW_FLOOR * frames as f64
            });
            let Some((&floor, _)) = floor else { continue };
            for (_, bin) in heights.range(..floor.saturating_add(CONTACT_HEIGHT)) {
                contacts += bin.slow;
                (0..2).for_each(|run| sums[run] += bin.sums[run]);
            }
            all += frames;
        }
        let [mm_s, truth_mm_s] = sums.map(|sum| 1e3 * sum / contacts as f64);
        (contacts > 0).then(|| FootSkate {
            mm_s,
            truth_mm_s: self.has_truth.then_some(truth_mm_s),
            contacts,
            contact_percent: 100.0 * contacts as f64 / all as f64,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::core::body::Joint;
    use crate::metrics::made_up::{FPS, close, run};

    #[test]
    fn feet_slide_when_they_should_stand() {
        let still = run(&[0.0; 5]);
        let sliding = run(&[0.0, 0.002, 0.004, 0.006, 0.008]);
        let skate = foot_skate(&sliding, &still, FPS).unwrap();
        close(skate.mm_s, 2.0 * FPS);
        close(skate.truth_mm_s.unwrap(), 0.0);
        assert_eq!((skate.contacts, skate.contact_percent), (12, 100.0));
        assert_eq!(foot_skate(&still, &run(&[0.0, 0.1, 0.2, 0.3, 0.4]), FPS), None, "all move");
    }

    #[test]
    fn without_a_truth_the_estimate_decides() {
        let mut sums = FootSkateSums::new(FPS);
        // 0.1 m/s, a gap, then 5 m/s.
        for (frame, posture) in run(&[0.0, 0.002, 0.004, 0.1, 0.2, 0.3]).iter().enumerate() {
            if frame == 3 {
                sums.gap();
            }
            sums.add(posture, None);
        }
        let skate = sums.finish().unwrap();
        close(skate.mm_s, 100.0);
        assert_eq!((skate.truth_mm_s, skate.contacts, skate.contact_percent), (None, 4, 50.0));
    }

    #[test]
    fn a_lifted_foot_is_no_contact() {
        let still = run(&[0.0; 40]);
        let mut lifted = still.clone();
        for posture in &mut lifted[10..30] {
            posture.positions[Joint::LFoot.index()].y += 0.05;
        }
        let skate = foot_skate(&still, &lifted, FPS).unwrap();
        // The others in 38 frames; the left foot in 18, without the two beside each change, in which
        // it moves.
        assert_eq!(skate.contacts, 3 * 38 + 18 - 2);
    }
}

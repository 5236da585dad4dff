//! Errors of motion: velocity jumps where windows meet, and feet that slide.

use nalgebra::Vector3;
use serde::Serialize;

use super::statistics::{mean, percentile};
use crate::core::body::{JOINTS, Joint, Posture};

/// Contact: the foot is less than this above its floor, metres, and ...
const CONTACT_HEIGHT: f64 = 0.04;
/// ... its true speed is below this, m/s.
const CONTACT_SPEED: f64 = 0.2;
/// The floor is this percentile of the foot's true heights: the lowest values are noise.
const FLOOR_PERCENTILE: f64 = 5.0;
/// The joints that touch the ground.
const FEET: [Joint; 2] = [Joint::LFoot, Joint::RFoot];

/// Velocity jumps from frame to frame at window borders and elsewhere: mean over joints and frames
/// of |v(t+) - v(t-)|, m/s, with v(t+) - v(t-) = (P(t+1) - 2 P(t) + P(t-1)) fps.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct VelocityJump {
    /// At window borders.
    pub border_m_s: f64,
    /// At all other frames.
    pub inside_m_s: f64,
    /// At window borders, less the true motion's jump in these frames.
    pub excess_m_s: f64,
}

/// Measures runs of the same times, without gaps, at `fps`; `borders` are indices into them. `None`
/// if the inner frames have no border, or only borders.
pub fn velocity_jump(
    estimate: &[Posture],
    truth: &[Posture],
    borders: &[usize],
    fps: f64,
) -> Option<VelocityJump> {
    let is_border = |(frame, _): &(usize, f64)| borders.contains(frame);
    let (at, inside): (Vec<_>, Vec<_>) = velocity_jumps(estimate, fps).partition(is_border);
    let true_at: Vec<_> = velocity_jumps(truth, fps).filter(is_border).collect();
    let mean = |jumps: &[(usize, f64)]| mean(&jumps.iter().map(|jump| jump.1).collect::<Vec<_>>());
    let border_m_s = mean(&at)?;
    let excess_m_s = border_m_s - mean(&true_at)?;
    Some(VelocityJump { border_m_s, inside_m_s: mean(&inside)?, excess_m_s })
}

/// Mean over joints of |v(t+) - v(t-)|, m/s, at every inner frame of a run without gaps.
pub fn velocity_jumps(run: &[Posture], fps: f64) -> impl Iterator<Item = (usize, f64)> + '_ {
    run.windows(3).enumerate().map(move |(before, triple)| {
        let at = |frame: usize, joint: usize| triple[frame].positions[joint];
        let jump = |j: usize| (at(2, j) - at(1, j) * 2.0 + at(0, j)).norm() * fps;
        (before + 1, (0..JOINTS).map(jump).sum::<f64>() / JOINTS as f64)
    })
}

/// Speed of feet that should stand still.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct FootSkate {
    /// Mean horizontal speed of the estimated foot joints in contact, mm/s.
    pub mm_s: f64,
    /// The same for the true joints: speed in the motion itself.
    pub truth_mm_s: f64,
    /// Number of contacts: frames, counted for each foot.
    pub contacts: usize,
}

/// Foot skate of two runs of the same times, without gaps, at `fps`. Speeds are
/// |P(t+1) - P(t-1)| fps / 2. A foot is in contact in a frame if its true joint (l_foot, r_foot) is
/// less than 4 cm above its floor, the 5th percentile of its true heights, and its true speed is
/// below 0.2 m/s. `None` without a contact.
pub fn foot_skate(estimate: &[Posture], truth: &[Posture], fps: f64) -> Option<FootSkate> {
    let (mut sums, mut contacts) = ([0.0; 2], 0usize);
    for foot in FEET.map(Joint::index) {
        let heights: Vec<f64> = truth.iter().map(|posture| posture.positions[foot].y).collect();
        let floor = percentile(&heights, FLOOR_PERCENTILE)?;
        let velocity = |run: &[Posture], frame: usize| {
            (run[frame + 1].positions[foot] - run[frame - 1].positions[foot]) * (0.5 * fps)
        };
        let last = estimate.len().min(truth.len()).saturating_sub(1);
        for (frame, height) in heights.iter().enumerate().take(last).skip(1) {
            let true_velocity = velocity(truth, frame);
            if height - floor < CONTACT_HEIGHT && true_velocity.norm() < CONTACT_SPEED {
                sums[0] += horizontal(&velocity(estimate, frame));
                sums[1] += horizontal(&true_velocity);
                contacts += 1;
            }
        }
    }
    let mean = |sum: f64| 1e3 * sum / contacts as f64;
    (contacts > 0).then(|| FootSkate { mm_s: mean(sums[0]), truth_mm_s: mean(sums[1]), contacts })
}

fn horizontal(velocity: &Vector3<f64>) -> f64 {
    velocity.xz().norm()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::core::body::{Pose, Skeleton};

    const FPS: f64 = 50.0;

    /// The rest pose with the pelvis at these positions along x, metres.
    fn run(x: &[f64]) -> Vec<Posture> {
        let at = |&x: &f64| {
            let mut pose = Pose::rest();
            pose.root_position = Vector3::new(x, 0.0, 0.0);
            pose.posture(&Skeleton::default())
        };
        x.iter().map(at).collect()
    }

    fn close(a: f64, b: f64) {
        assert!((a - b).abs() < 1e-9, "{a} is not {b}");
    }

    #[test]
    fn a_kink_at_a_border_stands_out() {
        // Speeds 1, 1, 2, 2.25, 2.5 cm a frame: jumps of 0, 1, 0.25, 0.25 cm a frame.
        let truth = run(&[0.0, 0.01, 0.02, 0.0325, 0.045, 0.0575]);
        let run = run(&[0.0, 0.01, 0.02, 0.04, 0.0625, 0.0875]);
        let jump = velocity_jump(&run, &truth, &[2], FPS).unwrap();
        close(jump.border_m_s, 0.01 * FPS);
        close(jump.inside_m_s, 0.005 / 3.0 * FPS);
        close(jump.excess_m_s, 0.0075 * FPS);
        assert_eq!(velocity_jump(&run, &run, &[], FPS), None);
        assert_eq!(velocity_jump(&run, &run, &[0, 5], FPS), None, "the ends have no jump");
        assert_eq!(velocity_jump(&run[..2], &run[..2], &[1], FPS), None);
    }

    #[test]
    fn feet_slide_when_they_should_stand() {
        let still = run(&[0.0; 5]);
        let sliding = run(&[0.0, 0.002, 0.004, 0.006, 0.008]);
        let skate = foot_skate(&sliding, &still, FPS).unwrap();
        close(skate.mm_s, 2.0 * FPS);
        close(skate.truth_mm_s, 0.0);
        assert_eq!(skate.contacts, 6);
        assert_eq!(foot_skate(&still, &run(&[0.0, 0.1, 0.2, 0.3, 0.4]), FPS), None, "all move");
    }

    #[test]
    fn a_lifted_foot_is_no_contact() {
        let still = run(&[0.0; 40]);
        let mut lifted = still.clone();
        for posture in &mut lifted[10..30] {
            posture.positions[Joint::LFoot.index()].y += 0.05;
        }
        let skate = foot_skate(&still, &lifted, FPS).unwrap();
        // The right foot in 38 frames; the left in 18, without the two beside each change, in which
        // it moves.
        assert_eq!(skate.contacts, 38 + 18 - 2);
    }
}

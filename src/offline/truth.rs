//! Distance from the truth in a synthetic recording.

use std::collections::{BTreeMap, VecDeque};

use super::compact_pose::CompactPose;
use crate::core::body::Skeleton;
use crate::core::time::Nanos;
use crate::metrics::{FootSkate, FootSkateSums, PoseErrorSums, PoseErrors};

/// Most poses that wait for the other side.
const WAITING: usize = 16_384;

/// One performer's poses compared with the truth of each actor.
#[derive(Default)]
pub(super) struct TruthComparisons(BTreeMap<String, TruthComparison>);

impl TruthComparisons {
    fn of(&mut self, actor: &str) -> &mut TruthComparison {
        self.0.entry(actor.to_owned()).or_default()
    }

    /// Sets an actor's true body; call it before the true poses.
    pub(super) fn set_body(&mut self, actor: &str, body: &Skeleton) {
        self.of(actor).set_body(body.clone());
    }

    pub(super) fn add_truth(&mut self, actor: &str, truth: CompactPose) {
        self.of(actor).add_truth(truth);
    }

    /// Adds a solved pose of a recording with `fps` frames per second.
    pub(super) fn add_pose(&mut self, pose: &CompactPose, skeleton: &Skeleton, fps: f64) {
        self.0.values_mut().for_each(|truth| truth.add_pose(pose, skeleton, fps));
    }

    /// The errors and the foot skate of the actor who is nearest on average, if nearer than `most_mm`; `None` if nothing could
    /// be compared.
    pub(super) fn nearest(
        self,
        skeleton: &Skeleton,
        fps: f64,
        most_mm: f64,
    ) -> Option<(PoseErrors, Option<FootSkate>)> {
        let all = self.0.into_values().filter_map(|truth| truth.finish(skeleton, fps));
        let all = all.filter(|(errors, _)| errors.mpjpe_mm <= most_mm);
        all.min_by(|a, b| a.0.mpjpe_mm.total_cmp(&b.0.mpjpe_mm))
    }
}

/// Compares solved poses with true ones in a stream; both are in order of capture time, either may
/// come first. A pose counts if it is tracked and a true pose lies within a tenth of a frame
/// period. At most 16,384 poses of a side wait; then the oldest are dropped.
#[derive(Default)]
struct TruthComparison {
    body: Skeleton,
    truths: VecDeque<CompactPose>,
    poses: VecDeque<CompactPose>,
    sums: PoseErrorSums,
    feet: Option<FootSkateSums>,
}

impl TruthComparison {
    /// Sets the true body; call it before the true poses.
    fn set_body(&mut self, body: Skeleton) {
        self.body = body;
    }

    fn add_truth(&mut self, truth: CompactPose) {
        let after = |known: &CompactPose| known.capture <= truth.capture;
        let place = self.truths.iter().rposition(after).map_or(0, |before| before + 1);
        self.truths.insert(place, truth);
        if self.truths.len() > WAITING {
            self.truths.pop_front();
        }
    }

    /// Adds a solved pose of a recording with `fps` frames per second.
    fn add_pose(&mut self, pose: &CompactPose, skeleton: &Skeleton, fps: f64) {
        self.poses.push_back(pose.clone());
        let tolerance = tolerance(fps);
        self.feet.get_or_insert_with(|| FootSkateSums::new(fps));
        let is_covered = |pose: &CompactPose, truths: &VecDeque<CompactPose>| {
            truths.back().is_some_and(|truth| truth.capture > pose.capture + tolerance)
        };
        while let Some(pose) = self.poses.front()
            && (is_covered(pose, &self.truths) || self.poses.len() > WAITING)
        {
            self.compare_first(skeleton, tolerance);
        }
    }

    /// The errors and the foot skate; `None` if nothing could be compared.
    fn finish(mut self, skeleton: &Skeleton, fps: f64) -> Option<(PoseErrors, Option<FootSkate>)> {
        while !self.poses.is_empty() {
            self.compare_first(skeleton, tolerance(fps));
        }
        Some((self.sums.errors()?, self.feet.and_then(|feet| feet.finish())))
    }

    fn compare_first(&mut self, skeleton: &Skeleton, tolerance: Nanos) {
        let Some(pose) = self.poses.pop_front() else { return };
        while self.truths.front().is_some_and(|truth| truth.capture + tolerance < pose.capture) {
            self.truths.pop_front();
        }
        let near = self.truths.front().filter(|truth| truth.capture - pose.capture <= tolerance);
        if let (Some(truth), Some(usable)) = (near, pose.usable()) {
            let (solved, truth) = (usable.posture(skeleton), truth.pose().posture(&self.body));
            self.sums.add(&solved, &truth, pose.deviations().as_ref());
            self.feet.iter_mut().for_each(|feet| feet.add(&solved, Some(&truth)));
        } else {
            self.feet.iter_mut().for_each(FootSkateSums::gap);
        }
    }
}

fn tolerance(fps: f64) -> Nanos {
    Nanos::new((0.1e9 / fps) as i64)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::offline::compact_pose::tests::tracked;

    #[test]
    fn either_side_may_come_first() {
        let body = Skeleton::default();
        let (solved, truth) = (
            |ns: i64| tracked(ns * 20_000_000, 0.03),
            |ns: i64| tracked(ns * 20_000_000 + 1_000_000, 0.0),
        );
        let compare = |add: &dyn Fn(&mut TruthComparison)| {
            let mut comparison = TruthComparison::default();
            add(&mut comparison);
            comparison
                .finish(&body, 50.0)
                .map(|(errors, _)| (errors.frames, errors.mpjpe_mm.round()))
        };
        let truths = |c: &mut TruthComparison| (0..100).for_each(|i| c.add_truth(truth(i)));
        let poses = |c: &mut TruthComparison| {
            (5..90).for_each(|i| c.add_pose(&solved(i), &body, 50.0));
        };
        let expected = Some((85, 30.0));
        assert_eq!(compare(&|c| (truths(c), poses(c)).0), expected);
        assert_eq!(compare(&|c| (poses(c), truths(c)).0), expected);
        assert_eq!(compare(&|c| poses(c)), None);
        let mut interleaved = TruthComparison::default();
        for i in 0..100_000 {
            interleaved.add_truth(truth(i));
            interleaved.add_pose(&solved(i), &body, 50.0);
        }
        assert!(interleaved.truths.len() < 4 && interleaved.poses.len() < 4);
        let (errors, feet) = interleaved.finish(&body, 50.0).unwrap();
        assert_eq!((errors.frames, feet.unwrap().contacts), (100_000, 4 * 99_998));
    }
}

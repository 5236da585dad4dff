//! The poses of a solved recording, by performer.

use std::collections::BTreeMap;
use std::path::Path;

use super::compact_pose::CompactPose;
use super::poses::frame_rate;
use crate::core::body::{Skeleton, StampedPose};
use crate::io::recording::{Message, Reader, RecordError, Report};
use crate::io::wire::Topic;

/// The poses of a performer.
#[derive(Clone, Debug)]
pub struct Motion {
    /// The performer's name.
    pub actor: String,
    /// The body.
    pub skeleton: Skeleton,
    /// Frames per second.
    pub fps: f64,
    /// Sorted by capture time, one per time; at least one.
    pub(crate) poses: Vec<CompactPose>,
}

impl Motion {
    /// The poses, sorted by capture time, one per time; at least one.
    pub fn poses(&self) -> impl ExactSizeIterator<Item = StampedPose> + '_ {
        self.poses.iter().map(CompactPose::stamped)
    }
}

/// Reads the final poses of a recording, or the true ones of a synthetic recording; by name of the performer.
///
/// # Errors
/// The file cannot be read. What a damaged file lost is in the report.
pub fn read_motions(file: &Path, truth: bool) -> Result<(Vec<Motion>, Report), RecordError> {
    let mut reader = Reader::open(file)?;
    let mut found = BTreeMap::<String, (Option<Skeleton>, Vec<CompactPose>)>::new();
    while let Some(entry) = reader.next() {
        let entry = entry?;
        let name = Topic::actor(&entry.topic);
        let result = match (entry.message, truth) {
            (Message::Skeleton(wire), false) | (Message::TruthSkeleton(wire), true) => {
                let body = if truth { wire.to_truth() } else { wire.to_core() };
                body.map(|body| found.entry(name).or_default().0 = Some(body))
            }
            // Final poses replace provisional ones.
            (Message::Pose(wire), false) if wire.provisional => Ok(()),
            (Message::Pose(wire), false) | (Message::TruthPose(wire), true) => {
                wire.to_core().map(|pose| found.entry(name).or_default().1.push((&pose).into()))
            }
            _ => Ok(()),
        };
        if let Err(error) = result {
            reader.reject(&entry.topic, &error);
        }
    }
    let whole = |(actor, (skeleton, mut poses)): (String, (Option<_>, Vec<_>))| {
        in_order(&mut poses);
        let fps = frame_rate(&poses);
        (!poses.is_empty()).then_some(Motion { actor, skeleton: skeleton?, fps, poses })
    };
    Ok((found.into_iter().filter_map(whole).collect(), reader.report().clone()))
}

/// Sorts by capture time and keeps the last of several poses of one time.
fn in_order(poses: &mut Vec<CompactPose>) {
    poses.sort_by_key(|pose| pose.capture);
    poses.dedup_by(|later, kept| {
        let anew = later.capture == kept.capture;
        if anew {
            std::mem::swap(later, kept);
        }
        anew
    });
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::offline::compact_pose::tests::tracked;

    #[test]
    fn poses_are_put_in_order_and_the_newest_of_a_time_stays() {
        let mut poses: Vec<CompactPose> = [(30, 1.0), (10, 2.0), (20, 3.0), (10, 4.0), (10, 5.0)]
            .map(|(ns, x)| tracked(ns, x))
            .into();
        in_order(&mut poses);
        let left = poses.iter().map(|pose| (pose.capture.ns(), pose.pose().root_position.x));
        assert_eq!(left.collect::<Vec<_>>(), [(10, 5.0), (20, 3.0), (30, 1.0)]);
    }
}

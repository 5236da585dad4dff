//! Writes a crowd as a recording.

use std::path::Path;

use super::crowd::Crowd;
use super::recording::Recording;
use crate::core::body::Pose;
use crate::io::recording::{Provenance, RecordError, Writer};
use crate::io::wire::{self, Topics};

impl<M: Fn(f64) -> Pose> Crowd<M> {
    /// Writes the detections of everybody and the truth of all but the bystanders: of one person under the
    /// usual name, of several under `actor/p1`, `actor/p2` ... Calls `each_frame` once a frame.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn write(
        &self,
        path: &Path,
        provenance: &Provenance,
        mut each_frame: impl FnMut(),
    ) -> Result<(), RecordError> {
        let people = self.people();
        let performers = &people[..people.len().saturating_sub(self.bystanders).max(1)];
        let (rig, start) = (&people[0].rig, people[0].start);
        let actor = |person: usize| match people.len() {
            1 => Topics::default(),
            _ => Topics { actor: format!("p{}", person + 1), ..Topics::default() },
        };
        let mut writer = Writer::create(path, Topics::default(), provenance)?;
        writer.rig(rig, start)?;
        for (person, one) in performers.iter().enumerate() {
            let body = wire::Skeleton::from_core(&one.skeleton);
            writer.write(&actor(person).truth_skeleton(), start, &body)?;
        }
        let mut truth: Vec<_> = performers.iter().map(Recording::poses).collect();
        for (index, (detections, _)) in self.detections().enumerate() {
            if index % rig.cameras.len() == 0 {
                for (person, truth) in truth.iter_mut().enumerate() {
                    if let Some(pose) = truth.next() {
                        let message = wire::Pose::from_core(&pose, &people[person].skeleton, None);
                        writer.write(&actor(person).truth(), pose.capture, &message)?;
                    }
                }
                each_frame();
            }
            let camera = &rig.cameras[detections.camera];
            writer.keypoints(&detections, &camera.name, [camera.width, camera.height])?;
        }
        writer.finish()
    }
}

//! Cameras that were moved: the calibration follows them, when asked to or by itself.

use super::Core;
use super::port::Output;
use super::publication::Content;
use crate::core::camera::Rig;
use crate::core::time::Timestamp;
use crate::core::tracker::{EventKind, Placed};
use crate::io::wire::{self, encode};

impl Core {
    /// Stores the new pose of a moved camera, or, with `None`, that it fits its calibration again.
    pub(super) fn placed(&mut self, camera: usize, placed: Option<Placed>) {
        let Some(camera) = self.cameras.get_mut(camera) else { return };
        let is_wanted = placed.is_some() && self.settings.node.mend_cameras;
        camera.placed = placed;
        let name = camera.name().to_owned();
        if is_wanted {
            // It is known where it is.
            let _ = self.mend(&name);
        }
    }

    /// Gives a camera that was moved its new pose. Says what was done.
    pub(super) fn mend(&mut self, name: &str) -> Result<String, String> {
        let index = self.cameras.iter().position(|camera| camera.name() == name);
        let index = index.ok_or_else(|| format!("no camera has the name {name:?}"))?;
        let (Some(placed), Some(before)) = (self.cameras[index].placed.take(), &self.calibration)
        else {
            return Err(format!("{name}: no new pose is known"));
        };
        let mut rig = Rig::clone(&before.rig);
        let camera = &mut rig.cameras[index];
        (camera.rotation, camera.translation) = (placed.camera.rotation, placed.camera.translation);
        let (rig, instead_of) = (wire::Rig::from_core(&rig).with_own_version(), rig.version);
        if !self.calibrate(&encode(&rig), "mending") {
            return Err(format!("{name}: its pose is in use already"));
        }
        self.publish(self.topics.rig(), Timestamp::default(), Content::Rig(rig.clone()));
        self.outputs.push_back(Output::Mended { rig, instead_of });
        self.event(EventKind::CameraMoved, Some(name), format!("mended: {placed}; it is used"));
        Ok(format!("{name} is mended: {placed}"))
    }
}

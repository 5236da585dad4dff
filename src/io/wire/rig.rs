//! Converts `Rig` to and from [`camera::Rig`].

use nalgebra::Matrix3;

use super::check::{Field, field};
use super::{CalibratedCamera, DecodeError, LensKind, Rig, encode};
use crate::core::camera::{self, Camera, CameraError, Lens};
use crate::core::fnv::fnv1a;
use crate::core::so3;
use crate::core::time::Nanos;

const fn at(name: &'static str) -> Field {
    field("Rig", name)
}

impl Rig {
    /// The message of a rig, in full precision.
    pub fn from_core(rig: &camera::Rig) -> Self {
        Self {
            version: rig.version,
            cameras: rig.cameras.iter().map(CalibratedCamera::from_core).collect(),
        }
    }

    /// The same with a version of its own: a hash of the cameras, so it depends on them only.
    #[must_use]
    pub fn with_own_version(self) -> Self {
        let rig = Self { version: 0, ..self };
        let hash = fnv1a(&encode(&rig));
        // Every language's numbers can hold 32 bits.
        Self { version: ((hash >> 32) ^ (hash & 0xffff_ffff)).max(1), ..rig }
    }

    /// The cameras.
    ///
    /// # Errors
    /// Wrong lengths, numbers that are not finite, and every [`CameraError`].
    pub fn to_core(&self) -> Result<camera::Rig, DecodeError> {
        let cameras = self.cameras.iter().map(CalibratedCamera::to_core);
        let cameras = cameras.collect::<Result<_, _>>()?;
        camera::Rig::new(self.version, cameras).map_err(refused("cameras"))
    }
}

impl CalibratedCamera {
    fn from_core(camera: &Camera) -> Self {
        let kind = match camera.lens() {
            Lens::BrownConrady(_) => LensKind::BrownConrady,
            Lens::Fisheye(_) => LensKind::Fisheye,
        };
        Self {
            name: camera.name.clone(),
            width: camera.width,
            height: camera.height,
            focal_px: camera.focal.iter().copied().collect(),
            centre_px: camera.centre.iter().copied().collect(),
            lens: kind.into(),
            lens_coefficients: camera.lens().coefficients().to_vec(),
            camera_from_world_rotation: so3::xyzw_from_rotation(&camera.rotation).to_vec(),
            camera_from_world_translation_m: camera.translation.iter().copied().collect(),
            skew_px: camera.skew,
            time_offset_ns: camera.time_offset.ns(),
        }
    }

    fn to_core(&self) -> Result<Camera, DecodeError> {
        let [fx, fy] = at("cameras.focal_px").numbers(&self.focal_px)?;
        let [cx, cy] = at("cameras.centre_px").numbers(&self.centre_px)?;
        let matrix = Matrix3::new(fx, self.skew_px, cx, 0.0, fy, cy, 0.0, 0.0, 1.0);
        let rotation =
            at("cameras.camera_from_world_rotation").rotation(&self.camera_from_world_rotation)?;
        let translation = at("cameras.camera_from_world_translation_m")
            .vector(&self.camera_from_world_translation_m)?;
        let size = [self.width, self.height];
        let lens = self.lens_to_core()?;
        let mut camera = Camera::new(&self.name, size, &matrix, lens, rotation, translation)
            .map_err(refused("cameras"))?;
        camera.time_offset = Nanos::new(self.time_offset_ns);
        Ok(camera)
    }

    fn lens_to_core(&self) -> Result<Lens, DecodeError> {
        let coefficients = &self.lens_coefficients;
        match LensKind::try_from(self.lens) {
            Ok(LensKind::BrownConrady) => Lens::brown_conrady(coefficients),
            Ok(LensKind::Fisheye) => Lens::fisheye(coefficients),
            Ok(LensKind::Unspecified) | Err(_) => {
                let reason = format!("camera {} has the unknown lens {}", self.name, self.lens);
                return Err(at("cameras.lens").invalid(reason));
            }
        }
        .map_err(refused("cameras.lens_coefficients"))
    }
}

/// An error with the name of the field and the message of the camera module.
fn refused(name: &'static str) -> impl Fn(CameraError) -> DecodeError {
    move |error| at(name).invalid(error.to_string())
}

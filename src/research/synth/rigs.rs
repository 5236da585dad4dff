//! Rigs by name.

use std::path::Path;

use nalgebra::{Matrix3, Vector3};

use super::h36m::{H36mError, h36m_rig};
use super::ring::{looking_at, ring_rig};
use crate::core::camera::{Camera, CameraError, Lens, Rig};

/// Why a rig cannot be made.
#[derive(Debug, thiserror::Error)]
pub enum RigError {
    /// Unknown name.
    #[error("no rig is named {0:?}; use h36m, h36m-s11, 3dhp, or ring2 to ring64")]
    Name(String),
    /// The file with the Human3.6M cameras is not given.
    #[error("rig {0} needs the file with the Human3.6M cameras; give its path")]
    NeedsFile(String),
    /// The Human3.6M cameras cannot be used.
    #[error(transparent)]
    H36m(#[from] H36mError),
    /// A camera cannot be made.
    #[error(transparent)]
    Camera(#[from] CameraError),
}

/// Radius of the ring and height of its cameras, metres.
const RING: [f64; 2] = [4.5, 1.6];

/// The rig of that name: `h36m` or `h36m-s9` and `h36m-s11` (the cameras of Human3.6M for a
/// subject, from the file at `h36m`), `3dhp` ([`tdhp_like_rig`]), or `ring2` to `ring64` (that many
/// cameras on a ring with a radius of 4.5 m, 1.6 m high). The origin is the middle of the floor.
///
/// # Errors
/// The name is unknown, or the file is missing or cannot be used.
pub fn rig_named(name: &str, h36m: Option<&Path>) -> Result<Rig, RigError> {
    let of_subject = |subject: &str| {
        let path = h36m.ok_or_else(|| RigError::NeedsFile(name.to_owned()))?;
        Ok(h36m_rig(path, subject)?)
    };
    match name {
        "h36m" | "h36m-s9" => of_subject("S9"),
        "h36m-s11" => of_subject("S11"),
        "3dhp" => Ok(tdhp_like_rig()?),
        _ => {
            let count = name.strip_prefix("ring").and_then(|n| n.parse().ok());
            match count {
                Some(n @ 2..=64) => Ok(ring_rig(n, RING[0], RING[1])?),
                _ => Err(RigError::Name(name.to_owned())),
            }
        }
    }
}

/// Four cameras similar to views 0, 2, 7 and 8 of MPI-INF-3DHP, with our own numbers (not the data
/// set's): images of 2048 x 2048 pixels, focal length about 1500 pixels, three at chest height and
/// one higher, at unequal distances and angles. The origin is the middle of the floor.
///
/// # Errors
/// Never with these numbers.
pub fn tdhp_like_rig() -> Result<Rig, CameraError> {
    // Angle about y from +z in degrees, distance and height in metres.
    const PLACES: [(&str, f64, f64, f64); 4] = [
        ("view0", 0.0, 3.6, 1.3),
        ("view2", 62.0, 3.9, 1.4),
        ("view7", -75.0, 3.7, 1.3),
        ("view8", 158.0, 4.3, 2.6),
    ];
    let cameras = PLACES.into_iter().enumerate().map(|(index, (name, degrees, radius, height))| {
        let angle = f64::to_radians(degrees);
        let eye = Vector3::new(radius * angle.sin(), height, radius * angle.cos());
        let rotation = looking_at(&eye, &Vector3::new(0.0, 0.95, 0.0));
        // Real cameras differ in focal length and principal point.
        let (f, off) = (1500.0 - 4.0 * index as f64, 9.0 - 6.0 * index as f64);
        let matrix = Matrix3::new(f, 0.0, 1023.5 + off, 0.0, f, 1023.5 - off, 0.0, 0.0, 1.0);
        let lens = Lens::brown_conrady(&[-0.02, 0.01, 0.0002, -0.0002, 0.0])?;
        Camera::new(name, [2048, 2048], &matrix, lens, rotation, -(rotation * eye))
    });
    Rig::new(1, cameras.collect::<Result<_, _>>()?)
}

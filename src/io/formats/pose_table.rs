//! Writes poses as CSV.

use std::path::Path;

use crate::core::body::{Joint, Pose, Skeleton, TrackingState};
use crate::core::so3;
use crate::io::formats::ExportError;
use crate::io::new_file;

/// Writes a line for each pose: `time_s`, `state` (tracking, coasting, lost), then for each joint its place in the
/// world (`pelvis_x`, `_y`, `_z`; metres, y up) and its rotation (`pelvis_qx`, `_qy`, `_qz`, `_qw`): of the
/// pelvis in the world, of the others in their parents. All rotations are zero in a T-pose that faces +z.
///
/// # Errors
/// The disk is full.
pub fn write_csv(
    path: &Path,
    skeleton: &Skeleton,
    poses: impl IntoIterator<Item = (f64, TrackingState, Pose)>,
) -> Result<(), ExportError> {
    let mut file = csv::Writer::from_writer(Vec::new());
    let written = || -> csv::Result<()> {
        let of = |joint: Joint| {
            ["x", "y", "z", "qx", "qy", "qz", "qw"].map(|axis| format!("{}_{axis}", joint.name()))
        };
        let begin = ["time_s", "state"].map(str::to_owned);
        file.write_record(begin.into_iter().chain(Joint::ALL.into_iter().flat_map(of)))?;
        for (time, state, pose) in poses {
            let posture = pose.posture(skeleton);
            let turns = std::iter::once(&pose.root_rotation).chain(&pose.local);
            let joints = posture.positions.iter().zip(turns).flat_map(|(at, turn)| {
                let [x, y, z, w] = so3::xyzw_from_rotation(turn);
                [at.x, at.y, at.z, x, y, z, w].map(|value| format!("{value:.7}"))
            });
            let begin = [format!("{time:.6}"), state.name().to_owned()];
            file.write_record(begin.into_iter().chain(joints))?;
        }
        Ok(())
    };
    let written = written().map_err(std::io::Error::other);
    let bytes = written.and_then(|()| file.into_inner().map_err(std::io::Error::other));
    let written = bytes.and_then(|bytes| new_file::write(path, &bytes));
    written.map_err(ExportError::write(path))
}

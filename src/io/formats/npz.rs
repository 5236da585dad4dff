//! Writes numpy's `.npz` with the fields of AMASS: rotation vectors of SMPL's joints, z up.
//!
//! | field | shape | content |
//! |---|---|---|
//! | `poses` | frames x 156 | the pelvis in the world, then 21 joints in their parents; hands are 0 |
//! | `trans` | frames x 3 | the pelvis, metres; SMPL adds its own pelvis at rest (joint 0) to it, so subtract that first |
//! | `betas` | 16 | 0: the body has its own rest pose, `rest_joints` |
//! | `rest_joints` | 22 x 3 | joints of the T-pose from the pelvis, metres; y up and facing +z, as SMPL's template |
//! | `times` | frames | seconds |
//! | `tracked` | frames | 1, or 0 where the pose is coasting or lost |
//! | `joint_sd` | frames x 22 | standard deviation of each joint centre along each axis, metres; NaN where it is not known |
//! | `mocap_frame_rate` | | hertz; `mocap_framerate` too |
//! | `gender` | | `neutral` |

use std::io::{self, Write};
use std::path::Path;

use nalgebra::Vector3;
use npyz::WriterBuilder;
use zip::ZipWriter;
use zip::write::SimpleFileOptions;

use super::pose_table::TimedPose;
use crate::core::body::{JOINTS, Pose, Skeleton, TrackingState};
use crate::core::so3;
use crate::io::formats::ExportError;
use crate::io::new_file;

/// Numbers of a frame in AMASS: 52 joints of SMPL-H.
const NUMBERS: usize = 156;

/// Writes evenly spaced poses.
///
/// # Errors
/// The disk is full, the rate is not above 0, or a pose has a value that is not finite.
pub fn write_npz(
    path: &Path,
    fps: f64,
    skeleton: &Skeleton,
    poses: &[TimedPose],
) -> Result<(), ExportError> {
    ExportError::check_rate(path, fps)?;
    // AMASS's world has z up.
    let (mut all, mut trans) = (Vec::new(), Vec::<f64>::new());
    for (frame, TimedPose { pose, .. }) in poses.iter().enumerate() {
        let first = all.len();
        all.extend_from_slice(so3::log(&(so3::Z_UP * pose.root_rotation)).as_slice());
        pose.local.iter().for_each(|turn| all.extend_from_slice(so3::log(turn).as_slice()));
        all.resize(first + NUMBERS, 0.0);
        trans.extend_from_slice((so3::Z_UP * pose.root_position).as_slice());
        if all[first..].iter().chain(&trans[3 * frame..]).any(|value| !value.is_finite()) {
            return Err(ExportError::NotFinite { path: path.into(), frame });
        }
    }
    let rest = Pose::rest().posture(skeleton).positions;
    let rest: Vec<f64> = rest.iter().flat_map(|at: &Vector3<f64>| [at.x, at.y, at.z]).collect();
    let frames = poses.len();
    let times: Vec<f64> = poses.iter().map(|pose| pose.time).collect();
    let is_tracked = |pose: &TimedPose| pose.state == TrackingState::Tracking;
    let tracked: Vec<f64> =
        poses.iter().map(|pose| f64::from(u8::from(is_tracked(pose)))).collect();
    let deviations: Vec<f64> =
        poses.iter().flat_map(|pose| pose.deviations.unwrap_or([f64::NAN; JOINTS])).collect();
    let written = || -> io::Result<Vec<u8>> {
        let mut file = ZipWriter::new(io::Cursor::new(Vec::new()));
        let fields: [(&str, &[usize], &[f64]); 9] = [
            ("poses", &[frames, NUMBERS], &all),
            ("trans", &[frames, 3], &trans),
            ("betas", &[16], &[0.0; 16]),
            ("rest_joints", &[rest.len() / 3, 3], &rest),
            ("times", &[frames], &times),
            ("tracked", &[frames], &tracked),
            ("joint_sd", &[frames, JOINTS], &deviations),
            ("mocap_frame_rate", &[], &[fps]),
            ("mocap_framerate", &[], &[fps]),
        ];
        for (name, shape, numbers) in fields {
            file.start_file(format!("{name}.npy"), SimpleFileOptions::default())?;
            file.write_all(&array(shape, numbers)?)?;
        }
        file.start_file("gender.npy", SimpleFileOptions::default())?;
        file.write_all(&text(b"neutral")?)?;
        Ok(file.finish()?.into_inner())
    };
    let written = written().and_then(|bytes| new_file::write(path, &bytes));
    written.map_err(ExportError::write(path))
}

/// An array of f8.
fn array(shape: &[usize], numbers: &[f64]) -> io::Result<Vec<u8>> {
    let shape: Vec<u64> = shape.iter().map(|size| *size as u64).collect();
    let mut bytes = Vec::new();
    let options = npyz::WriteOptions::new().default_dtype().shape(&shape);
    let mut writer = options.writer(&mut bytes).begin_nd()?;
    writer.extend(numbers.iter().copied())?;
    writer.finish()?;
    Ok(bytes)
}

/// A text, as numpy has it without a shape.
fn text(text: &[u8]) -> io::Result<Vec<u8>> {
    let kind = format!("|S{}", text.len()).parse().map_err(io::Error::other)?;
    let mut bytes = Vec::new();
    let options = npyz::WriteOptions::<Vec<u8>>::new().dtype(npyz::DType::Plain(kind)).shape(&[]);
    let mut writer = options.writer(&mut bytes).begin_nd()?;
    writer.push(&text.to_vec())?;
    writer.finish()?;
    Ok(bytes)
}

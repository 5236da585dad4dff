//! Writes poses and their standard deviations as CSV.

use std::path::Path;

use crate::core::body::{JOINTS, Joint, JointDeviations, Pose, Skeleton, TrackingState};
use crate::core::so3;
use crate::io::formats::{ExportError, Style};
use crate::io::new_file;

/// A pose of a file.
#[derive(Clone, Debug)]
pub struct TimedPose {
    /// Seconds.
    pub time: f64,
    /// Its quality.
    pub state: TrackingState,
    /// The pose.
    pub pose: Pose,
    /// The standard deviations of its joint centres, if they are known.
    pub deviations: Option<JointDeviations>,
}

/// Writes a line for each pose: `time_s`, `state` (tracking, coasting, lost), then for each joint its place in the
/// world (`pelvis_x`, `_y`, `_z`; metres), its rotation (`pelvis_qx`, `_qy`, `_qz`, `_qw`; without changes of the sign):
/// of the pelvis in the world, of the others in their parents, and the standard deviation of its place along each
/// axis (`pelvis_sd`; metres, empty where it is not known). The axes, the names of the joints and the pose in
/// which all rotations are zero are those of the style.
///
/// # Errors
/// The disk is full.
pub fn write_csv(
    path: &Path,
    skeleton: &Skeleton,
    style: &Style,
    poses: impl IntoIterator<Item = TimedPose>,
) -> Result<(), ExportError> {
    let skeleton = style.skeleton(skeleton);
    let of = |joint: Joint| {
        let columns = ["x", "y", "z", "qx", "qy", "qz", "qw", "sd"];
        columns.map(|column| format!("{}_{column}", style.names.of(joint)))
    };
    let header = ["time_s", "state"].map(str::to_owned);
    let header = header.into_iter().chain(Joint::ALL.into_iter().flat_map(of)).collect();
    let mut last = [[0.0; 4]; JOINTS];
    let row = |TimedPose { time, state, pose, deviations }: TimedPose| {
        let pose = style.pose(&pose);
        let places = pose.posture(&skeleton).positions;
        let turns = std::iter::once(&pose.root_rotation).chain(&pose.local);
        for (last, turn) in last.iter_mut().zip(turns) {
            *last = so3::continued(so3::xyzw_from_rotation(turn), last);
        }
        let joints = places.iter().zip(last).zip(deviation_cells(deviations.as_ref()));
        let joints = joints.flat_map(|((at, [x, y, z, w]), deviation)| {
            let numbers = [at.x, at.y, at.z, x, y, z, w].map(|value| format!("{value:.7}"));
            numbers.into_iter().chain([deviation])
        });
        let begin = [format!("{time:.6}"), state.name().to_owned()];
        begin.into_iter().chain(joints).collect()
    };
    write_table(path, header, poses.into_iter().map(row))
}

/// Writes the standard deviations beside a file of evenly spaced frames: `frame` from 1, `time_s` from 0,
/// then `pelvis_sd` and so on, metres; empty where they are not known.
///
/// # Errors
/// The disk is full.
pub fn write_deviations(
    path: &Path,
    fps: f64,
    frames: impl IntoIterator<Item = Option<JointDeviations>>,
) -> Result<(), ExportError> {
    let header = ["frame", "time_s"].map(str::to_owned);
    let of = |joint: Joint| format!("{}_sd", joint.name());
    let header = header.into_iter().chain(Joint::ALL.map(of)).collect();
    let row = |(frame, deviations): (usize, Option<JointDeviations>)| {
        let begin = [(frame + 1).to_string(), format!("{:.6}", frame as f64 / fps)];
        begin.into_iter().chain(deviation_cells(deviations.as_ref())).collect()
    };
    write_table(path, header, frames.into_iter().enumerate().map(row))
}

fn deviation_cells(deviations: Option<&JointDeviations>) -> [String; JOINTS] {
    let cell =
        |joint: usize| deviations.map_or_else(String::new, |all| format!("{:.5}", all[joint]));
    std::array::from_fn(cell)
}

pub(super) fn write_table(
    path: &Path,
    header: Vec<String>,
    rows: impl Iterator<Item = Vec<String>>,
) -> Result<(), ExportError> {
    let mut file = csv::Writer::from_writer(Vec::new());
    let written = std::iter::once(header).chain(rows).try_for_each(|row| file.write_record(row));
    let written = written.map_err(std::io::Error::other);
    let bytes = written.and_then(|()| file.into_inner().map_err(std::io::Error::other));
    let written = bytes.and_then(|bytes| new_file::write(path, &bytes));
    written.map_err(ExportError::write(path))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quaternions_do_not_change_their_sign() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("turn.csv");
        let pose =
            |k: u32| Pose { root_rotation: so3::about(1, f64::from(k) * 0.5), ..Pose::rest() };
        let (state, deviations) = (TrackingState::Tracking, None);
        let poses = (0..30).map(|k| TimedPose { time: 0.0, state, pose: pose(k), deviations });
        write_csv(&path, &Skeleton::default(), &Style::default(), poses).unwrap();
        let mut file = csv::Reader::from_path(&path).unwrap();
        let at = file.headers().unwrap().iter().position(|name| name == "pelvis_qx").unwrap();
        let turns: Vec<[f64; 4]> = file
            .records()
            .map(|row| {
                let row = row.unwrap();
                std::array::from_fn(|axis| row[at + axis].parse().unwrap())
            })
            .collect();
        for pair in turns.windows(2) {
            let dot: f64 = pair[0].iter().zip(&pair[1]).map(|(a, b)| a * b).sum();
            assert!(dot > 0.9, "{pair:?}");
        }
    }
}

//! Writes BVH: by default centimetres, y up, +z forward, T-pose at zero rotation.
//!
//! The format stores neither unit nor axes; the defaults are what importers assume. The order of rotation
//! channels is Z, X, Y: the local rotation is Rz(a) Rx(b) Ry(c).

use std::fmt::Write as _;
use std::path::Path;

use nalgebra::{Matrix3, Vector3};

use super::motion_file::MotionFile;
use crate::core::body::{JOINTS, Joint, Pose, Skeleton};
use crate::core::so3;
use crate::io::formats::style::end_site;
use crate::io::formats::{ExportError, Style, Unit};

/// Axes of the rotation channels.
const ZXY: [usize; 3] = [2, 0, 1];

/// Writes poses of one skeleton, one by one, at a constant frame rate.
///
/// The file appears at its path when [`BvhWriter::finish`] succeeds, and not before.
#[derive(Debug)]
pub struct BvhWriter {
    file: MotionFile,
    style: Style,
    /// The last written angles by joint, so that the next ones continue without jumps of 360
    /// degrees.
    last: [[f64; 3]; JOINTS],
}

impl BvhWriter {
    /// Begins a file with the hierarchy.
    ///
    /// # Errors
    /// The folder is not writable, or `fps` is not above 0.
    pub fn create(
        path: &Path,
        skeleton: &Skeleton,
        fps: f64,
        style: &Style,
    ) -> Result<Self, ExportError> {
        let file = MotionFile::create(path, &hierarchy(skeleton, style), fps)?;
        Ok(Self { file, style: style.clone(), last: [[0.0; 3]; JOINTS] })
    }

    /// Adds a frame.
    ///
    /// # Errors
    /// The disk is full, or the pose has a value that is not finite.
    pub fn write(&mut self, pose: &Pose) -> Result<(), ExportError> {
        let pose = self.style.pose(pose);
        let position = pose.root_position / unit(&self.style);
        let digits = if unit(&self.style) < 0.1 { 4 } else { 6 };
        let [x, y, z] = position.into();
        let mut line = format!("{x:.digits$} {y:.digits$} {z:.digits$}");
        let mut finite = position.iter().all(|c| c.is_finite());
        for &joint in &hierarchy_order() {
            let angles = &mut self.last[joint.index()];
            *angles = so3::angles(local(&pose, joint), ZXY, *angles);
            finite &= angles.iter().all(|a| a.is_finite());
            for angle in angles {
                // Writing into a string cannot fail.
                let _ = write!(line, " {:.5}", angle.to_degrees());
            }
        }
        self.file.write(&line, finite)
    }

    /// Completes the file and moves it to its path.
    ///
    /// # Errors
    /// The disk is full, or the destination cannot be replaced.
    pub fn finish(self) -> Result<(), ExportError> {
        self.file.finish()
    }
}

/// Writes all poses to `path`, in the default style; see [`BvhWriter`].
///
/// # Errors
/// See [`BvhWriter`].
pub fn write_bvh<'a>(
    path: &Path,
    skeleton: &Skeleton,
    fps: f64,
    poses: impl IntoIterator<Item = &'a Pose>,
) -> Result<(), ExportError> {
    let mut writer = BvhWriter::create(path, skeleton, fps, &Style::default())?;
    for pose in poses {
        writer.write(pose)?;
    }
    writer.finish()
}

fn local(pose: &Pose, joint: Joint) -> &Matrix3<f64> {
    match joint.index().checked_sub(1) {
        Some(j) => &pose.local[j],
        None => &pose.root_rotation,
    }
}

/// The joints depth first, the order of hierarchy and motion.
fn hierarchy_order() -> [Joint; JOINTS] {
    fn visit(joint: Joint, order: &mut [Joint; JOINTS], next: &mut usize) {
        order[*next] = joint;
        *next += 1;
        for child in children(joint) {
            visit(child, order, next);
        }
    }
    let mut order = [Joint::Pelvis; JOINTS];
    visit(Joint::Pelvis, &mut order, &mut 0);
    order
}

fn children(of: Joint) -> impl Iterator<Item = Joint> {
    Joint::ALL.into_iter().filter(move |joint| joint.parent() == Some(of))
}

/// Metres.
fn unit(style: &Style) -> f64 {
    style.unit.unwrap_or(Unit::CM).metres()
}

fn hierarchy(skeleton: &Skeleton, style: &Style) -> String {
    let mut text = String::from("HIERARCHY\n");
    add_joint(&mut text, skeleton, style, Joint::Pelvis, 0);
    text
}

fn add_joint(text: &mut String, skeleton: &Skeleton, style: &Style, joint: Joint, depth: usize) {
    let tabs = "\t".repeat(depth);
    let (kind, channels) = match joint {
        Joint::Pelvis => ("ROOT", "6 Xposition Yposition Zposition"),
        _ => ("JOINT", "3"),
    };
    *text += &format!("{tabs}{kind} {}\n{tabs}{{\n", style.names.of(joint));
    let line = |of: Joint, at: &Vector3<f64>| offset_line(&(style.offset(of, at) / unit(style)));
    let offset = line(joint.parent().unwrap_or(joint), skeleton.offset(joint));
    *text += &format!("{tabs}\t{offset}\n");
    *text += &format!("{tabs}\tCHANNELS {channels} Zrotation Xrotation Yrotation\n");
    for child in children(joint) {
        add_joint(text, skeleton, style, child, depth + 1);
    }
    if let Some(end) = end_site(skeleton, joint) {
        *text += &format!("{tabs}\tEnd Site\n{tabs}\t{{\n");
        *text += &format!("{tabs}\t\t{}\n{tabs}\t}}\n", line(joint, &end));
    }
    *text += &format!("{tabs}}}\n");
}

fn offset_line(at: &Vector3<f64>) -> String {
    format!("OFFSET {:.5} {:.5} {:.5}", at.x, at.y, at.z)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_hierarchy_is_depth_first_and_complete() {
        let mut order = hierarchy_order();
        assert_eq!(
            order[..5].iter().map(|j| j.name()).collect::<Vec<_>>(),
            ["pelvis", "l_hip", "l_knee", "l_ankle", "l_foot"]
        );
        order.sort();
        assert_eq!(order, Joint::ALL);
        let text = hierarchy(&Skeleton::default(), &Style::default());
        assert_eq!((text.matches("JOINT").count(), text.matches("End Site").count()), (21, 5));
    }
}

//! BVH: centimetres, y up, +z forward, T-pose at zero rotation.
//!
//! The format stores neither unit nor axes; these are what importers assume. Rotations are
//! written as Z, X, Y: the local rotation is Rz(a) Rx(b) Ry(c).

use std::fmt::Write as _;
use std::io::{Seek, SeekFrom, Write};
use std::path::Path;

use nalgebra::{Matrix3, Rotation3, Vector3};

use super::ExportError;
use super::new_file::NewFile;
use crate::body::{Attachment, JOINTS, Joint, Pose, Skeleton};
use crate::detect::Keypoint;

const CENTIMETRES: f64 = 100.0;
/// From the wrist to the knuckles, in forearms.
const HAND: f64 = 0.33;
/// Below this cosine of b, a and c turn about the same axis.
const GIMBAL: f64 = 1e-6;
/// Digits kept for the number of frames, which is known at the end.
const COUNT_DIGITS: usize = 12;

/// Writes poses of one skeleton, at a constant frame rate, as they come.
///
/// The file appears at its path when [`BvhWriter::finish`] succeeds; without it, there is none.
#[derive(Debug)]
pub struct BvhWriter {
    file: NewFile,
    frames: usize,
    /// Where the number of frames stands.
    count_at: u64,
    /// The angles written last, by joint, to carry on from.
    last: [[f64; 3]; JOINTS],
}

impl BvhWriter {
    /// Begins a file with the hierarchy.
    ///
    /// # Errors
    /// The folder cannot be written to, or `fps` is not above 0.
    pub fn create(path: &Path, skeleton: &Skeleton, fps: f64) -> Result<Self, ExportError> {
        if !(fps.is_finite() && fps > 0.0) {
            return Err(ExportError::FrameRate { path: path.into(), fps });
        }
        let head = format!("{}MOTION\nFrames: ", hierarchy(skeleton));
        let tail = format!("{:>COUNT_DIGITS$}\nFrame Time: {:.9}\n", 0, 1.0 / fps);
        let mut file = NewFile::create(path)?;
        file.write(|file| file.write_all((head.clone() + &tail).as_bytes()))?;
        Ok(Self { file, frames: 0, count_at: head.len() as u64, last: [[0.0; 3]; JOINTS] })
    }

    /// Adds a frame.
    ///
    /// # Errors
    /// The disk is full, or the pose holds a number that is not finite.
    pub fn write(&mut self, pose: &Pose) -> Result<(), ExportError> {
        let position = pose.root_position * CENTIMETRES;
        let mut line = format!("{:.4} {:.4} {:.4}", position.x, position.y, position.z);
        let mut finite = position.iter().all(|c| c.is_finite());
        for &joint in &hierarchy_order() {
            let angles = &mut self.last[joint.index()];
            *angles = angles_zxy(local(pose, joint), *angles);
            finite &= angles.iter().all(|a| a.is_finite());
            for angle in angles {
                // Writing into a string cannot fail.
                let _ = write!(line, " {:.5}", angle.to_degrees());
            }
        }
        if !finite {
            let path = self.file.path().into();
            return Err(ExportError::NotFinite { path, frame: self.frames });
        }
        self.frames += 1;
        self.file.write(|file| writeln!(file, "{line}"))
    }

    /// Completes the file and puts it in its place.
    ///
    /// # Errors
    /// The disk is full, or the destination cannot be replaced.
    pub fn finish(mut self) -> Result<(), ExportError> {
        let (at, frames) = (self.count_at, self.frames);
        self.file.write(|file| {
            file.seek(SeekFrom::Start(at))?;
            write!(file, "{frames:>COUNT_DIGITS$}")
        })?;
        self.file.finish().map(drop)
    }
}

/// Writes all poses to `path`; see [`BvhWriter`].
///
/// # Errors
/// See [`BvhWriter`].
pub fn write_bvh<'a>(
    path: &Path,
    skeleton: &Skeleton,
    fps: f64,
    poses: impl IntoIterator<Item = &'a Pose>,
) -> Result<(), ExportError> {
    let mut writer = BvhWriter::create(path, skeleton, fps)?;
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

/// The joints depth first, as the hierarchy lists them and the motion follows.
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

fn hierarchy(skeleton: &Skeleton) -> String {
    let mut text = String::from("HIERARCHY\n");
    add_joint(&mut text, skeleton, Joint::Pelvis, 0);
    text
}

fn add_joint(text: &mut String, skeleton: &Skeleton, joint: Joint, depth: usize) {
    let tabs = "\t".repeat(depth);
    let (kind, channels) = match joint {
        Joint::Pelvis => ("ROOT", "6 Xposition Yposition Zposition"),
        _ => ("JOINT", "3"),
    };
    *text += &format!("{tabs}{kind} {}\n{tabs}{{\n", joint.name());
    *text += &format!("{tabs}\t{}\n", offset_line(skeleton.offset(joint)));
    *text += &format!("{tabs}\tCHANNELS {channels} Zrotation Xrotation Yrotation\n");
    for child in children(joint) {
        add_joint(text, skeleton, child, depth + 1);
    }
    if let Some(end) = end_site(skeleton, joint) {
        *text += &format!("{tabs}\tEnd Site\n{tabs}\t{{\n");
        *text += &format!("{tabs}\t\t{}\n{tabs}\t}}\n", offset_line(&end));
    }
    *text += &format!("{tabs}}}\n");
}

fn offset_line(metres: &Vector3<f64>) -> String {
    let at = metres * CENTIMETRES;
    format!("OFFSET {:.5} {:.5} {:.5}", at.x, at.y, at.z)
}

/// Where the bone of a last joint ends, metres from it.
fn end_site(skeleton: &Skeleton, joint: Joint) -> Option<Vector3<f64>> {
    let point = |keypoint| Some(Attachment::of(keypoint).offset(skeleton.shape()));
    match joint {
        Joint::Head => point(Keypoint::HeadTop),
        Joint::LFoot => point(Keypoint::LBigToe),
        Joint::RFoot => point(Keypoint::RBigToe),
        Joint::LWrist | Joint::RWrist => Some(skeleton.offset(joint) * HAND),
        _ => None,
    }
}

/// The angles a, b, c of R = Rz(a) Rx(b) Ry(c), radians, that lie nearest to `last`: of the two
/// solutions, and with whole turns added. Where b is a quarter turn only the sum or difference
/// of a and c is known: c is kept.
fn angles_zxy(r: &Matrix3<f64>, last: [f64; 3]) -> [f64; 3] {
    use std::f64::consts::PI;
    let cosine = r[(2, 0)].hypot(r[(2, 2)]);
    let b = r[(2, 1)].atan2(cosine);
    let first = if cosine < GIMBAL {
        let x = Rotation3::from_axis_angle(&Vector3::x_axis(), b);
        let y = Rotation3::from_axis_angle(&Vector3::y_axis(), last[2]);
        let z = r * (x * y).matrix().transpose();
        [z[(1, 0)].atan2(z[(0, 0)]), b, last[2]]
    } else {
        [(-r[(0, 1)]).atan2(r[(1, 1)]), b, (-r[(2, 0)]).atan2(r[(2, 2)])]
    };
    let second = [first[0] + PI, PI - first[1], first[2] + PI];
    let [first, second] = [first, second].map(|angles| nearest_turns(angles, last));
    if distance(&first, &last) <= distance(&second, &last) { first } else { second }
}

/// Adds whole turns to each angle so that it lies within half a turn of `last`.
fn nearest_turns(angles: [f64; 3], last: [f64; 3]) -> [f64; 3] {
    use std::f64::consts::TAU;
    std::array::from_fn(|i| angles[i] + TAU * ((last[i] - angles[i]) / TAU).round())
}

fn distance(a: &[f64; 3], b: &[f64; 3]) -> f64 {
    a.iter().zip(b).map(|(a, b)| (a - b).abs()).sum()
}

#[cfg(test)]
mod tests {
    use std::f64::consts::FRAC_PI_2;

    use super::*;

    fn compose([a, b, c]: [f64; 3]) -> Matrix3<f64> {
        let about = |axis, angle| Rotation3::from_axis_angle(&axis, angle);
        (about(Vector3::z_axis(), a) * about(Vector3::x_axis(), b) * about(Vector3::y_axis(), c))
            .into_inner()
    }

    #[test]
    fn angles_give_the_rotation_back_and_carry_on() {
        // A knee that bends past a quarter turn, a root that turns for ever, and both at once.
        let paths: [fn(f64) -> [f64; 3]; 3] = [
            |t| [0.02, 2.5 * t.sin().abs(), -0.01],
            |t| [0.1 * t, 0.3, 3.0 * t],
            |t| [t, FRAC_PI_2, 0.4 * t],
        ];
        for path in paths {
            let mut last = path(0.0);
            for frame in 0..2000 {
                let truth = compose(path(f64::from(frame) * 0.01));
                let angles = angles_zxy(&truth, last);
                assert!((compose(angles) - truth).amax() < 1e-6, "frame {frame}");
                assert!(distance(&angles, &last) < 0.15, "frame {frame}: {last:?} {angles:?}");
                last = angles;
            }
        }
    }

    #[test]
    fn the_hierarchy_is_depth_first_and_complete() {
        let mut order = hierarchy_order();
        assert_eq!(
            order[..5].iter().map(|j| j.name()).collect::<Vec<_>>(),
            ["pelvis", "l_hip", "l_knee", "l_ankle", "l_foot"]
        );
        order.sort();
        assert_eq!(order, Joint::ALL);
        let text = hierarchy(&Skeleton::default());
        assert_eq!((text.matches("JOINT").count(), text.matches("End Site").count()), (21, 5));
    }
}

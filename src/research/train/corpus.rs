//! Motion clips: reads folders of BVH files as local rotations of our joints.

use std::path::{Path, PathBuf};

use nalgebra::{Matrix3, Rotation3, UnitVector3, Vector3};

use super::TrainError;
use crate::core::body::{BODY_JOINTS, JOINTS, Joint, Pose, Skeleton};
use crate::core::so3;
use crate::io::formats::bvh::Bvh;

/// Length of a pose vector: two columns of each of the 21 local rotations.
pub const POSE: usize = 6 * BODY_JOINTS;

/// A pose: for joint j (1 to 21) the first and second column of `parent_from_joint` at
/// 6 (j - 1) and 6 (j - 1) + 3.
pub type PoseVector = [f32; POSE];

/// Frame rate of all clips, Hz.
pub const FPS: f64 = 60.0;

/// A motion clip at 60 fps.
#[derive(Clone, Debug, PartialEq)]
pub struct Clip {
    /// File name without extension.
    pub name: String,
    /// Digits before the first `_` of the file name, else `act`.
    pub subject: String,
    /// Poses in order.
    pub poses: Vec<PoseVector>,
    /// Pelvis of each pose: rotation, and position in metres at the scale of our mean body.
    pub roots: Vec<Root>,
    /// The file's own skeleton with our joints: its poses have the file's joint centres, but for the
    /// head of files with a second neck joint.
    pub skeleton: Skeleton,
}

/// Rotation and position of the pelvis in the world.
pub type Root = (Matrix3<f64>, Vector3<f64>);

/// A frame of a clip.
pub(super) type Frame = (Root, [Matrix3<f64>; BODY_JOINTS]);

impl Clip {
    /// The whole pose of a frame.
    pub fn pose(&self, frame: usize) -> Option<Pose> {
        let (&(root_rotation, root_position), numbers) =
            self.roots.get(frame).zip(self.poses.get(frame))?;
        let local = std::array::from_fn(|joint| {
            let at = |k: usize| f64::from(numbers[6 * joint + k]);
            let a = Vector3::new(at(0), at(1), at(2)).normalize();
            let b = Vector3::new(at(3), at(4), at(5));
            let b = (b - a * a.dot(&b)).normalize();
            Matrix3::from_columns(&[a, b, a.cross(&b)])
        });
        Some(Pose { root_rotation, root_position, local })
    }
}

/// The joints of a BVH skeleton that correspond to ours, by our index.
struct Source {
    names: [&'static str; JOINTS],
    /// Metres per unit of the file.
    unit: f64,
    /// Whether the rest pose has splayed legs, which must be straightened.
    splayed: bool,
}

/// Daz-friendly conversion of the CMU database: zero rotation is a T-pose.
const HIP: Source = Source {
    names: [
        "hip", "lThigh", "rThigh", "abdomen", "lShin", "rShin", "abdomen", "lFoot", "rFoot",
        "chest", "lFoot", "rFoot", "neck", "lCollar", "rCollar", "head", "lShldr", "rShldr",
        "lForeArm", "rForeArm", "lHand", "rHand",
    ],
    unit: 0.01,
    splayed: false,
};

/// MotionBuilder-like conversion of the CMU database: legs splayed at zero rotation.
const HIPS: Source = Source {
    names: [
        "Hips",
        "LeftUpLeg",
        "RightUpLeg",
        "LowerBack",
        "LeftLeg",
        "RightLeg",
        "Spine",
        "LeftFoot",
        "RightFoot",
        "Spine1",
        "LeftToeBase",
        "RightToeBase",
        "Neck",
        "LeftShoulder",
        "RightShoulder",
        "Head",
        "LeftArm",
        "RightArm",
        "LeftForeArm",
        "RightForeArm",
        "LeftHand",
        "RightHand",
    ],
    unit: 0.056444,
    splayed: true,
};

/// Reads every clip under `folder`, sorted by path.
///
/// # Errors
/// A file cannot be used, or there is none.
pub fn read_folder(folder: &Path) -> Result<Vec<Clip>, TrainError> {
    let mut files = Vec::new();
    list(folder, &mut files)?;
    files.sort();
    if files.is_empty() {
        return Err(TrainError::NoClips { path: folder.to_owned() });
    }
    files.iter().map(|file| read_clip(file)).collect()
}

fn list(folder: &Path, files: &mut Vec<PathBuf>) -> Result<(), TrainError> {
    let failed = |source| TrainError::Read { path: folder.to_owned(), source };
    for entry in std::fs::read_dir(folder).map_err(failed)? {
        let path = entry.map_err(failed)?.path();
        if path.is_dir() {
            list(&path, files)?;
        } else if path.extension().is_some_and(|end| end.eq_ignore_ascii_case("bvh")) {
            files.push(path);
        }
    }
    Ok(())
}

fn read_clip(path: &Path) -> Result<Clip, TrainError> {
    let read = |source| TrainError::Read { path: path.to_owned(), source };
    let text = std::fs::read_to_string(path).map_err(read)?;
    let bvh =
        Bvh::parse(&text).map_err(|source| TrainError::Bvh { path: path.to_owned(), source })?;
    let name = path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
    let retarget = Retarget::of(&bvh)
        .map_err(|joint| TrainError::Joint { path: path.to_owned(), joint: joint.to_owned() })?;
    let (roots, poses) = retarget.frames(&bvh).into_iter().unzip();
    let skeleton = retarget.skeleton(&bvh);
    Ok(Clip { subject: subject_of(&name), name, poses, roots, skeleton })
}

fn subject_of(name: &str) -> String {
    let head = name.split('_').next().unwrap_or_default();
    let number = !head.is_empty() && head.bytes().all(|byte| byte.is_ascii_digit());
    if number { head.to_owned() } else { "act".to_owned() }
}

/// The subjects of clips, sorted, without duplicates.
pub fn subjects<'a>(clips: impl IntoIterator<Item = &'a Clip>) -> Vec<&'a str> {
    let mut names: Vec<&str> = clips.into_iter().map(|clip| clip.subject.as_str()).collect();
    names.sort_unstable();
    names.dedup();
    names
}

/// The mapping from a file's skeleton to ours.
struct Retarget {
    joints: [usize; JOINTS],
    /// `theirs_from_ours` at rest; identity except for splayed legs.
    rest: [Matrix3<f64>; JOINTS],
    /// Metres of our mean body per unit of the file, from the leg lengths.
    scale: f64,
    /// Metres per unit of the file.
    unit: f64,
}

impl Retarget {
    /// The mapping for a skeleton of the CMU corpus. The error is the name of a missing joint.
    fn of(bvh: &Bvh) -> Result<Self, &'static str> {
        let source = if bvh.joint("Hips").is_some() { &HIPS } else { &HIP };
        let mut joints = [0; JOINTS];
        for (index, name) in joints.iter_mut().zip(source.names) {
            *index = bvh.joint(name).ok_or(name)?;
        }
        let mut rest = [Matrix3::identity(); JOINTS];
        if source.splayed {
            straighten(bvh, &joints, &mut rest);
        }
        let body = Skeleton::default();
        let length = |joint: Joint| bvh.joints()[joints[joint.index()]].offset.norm();
        let theirs = length(Joint::LKnee) + length(Joint::LAnkle);
        let ours = body.offset(Joint::LKnee).norm() + body.offset(Joint::LAnkle).norm();
        Ok(Self { joints, rest, scale: ours / theirs.max(1e-6), unit: source.unit })
    }

    /// The file's skeleton: offsets C_parent^T o of our joints, with the offset o from the file's
    /// joint of our parent to that of our joint.
    fn skeleton(&self, bvh: &Bvh) -> Skeleton {
        Skeleton::with_joint_offsets(Joint::ALL.map(|joint| {
            let Some(parent) = joint.parent() else { return Vector3::zeros() };
            let (mut at, end) = (self.joints[joint.index()], self.joints[parent.index()]);
            let mut offset = Vector3::zeros();
            while let (true, Some(next)) = (at != end, bvh.joints()[at].parent) {
                offset += bvh.joints()[at].offset;
                at = next;
            }
            self.rest[parent.index()].tr_mul(&offset) * self.unit
        }))
    }

    /// Pelvis and our local rotations (G_parent C_parent)^T G_j C_j, with the file's global
    /// rotations G and `theirs_from_ours` C.
    fn frame(&self, bvh: &Bvh, frame: usize) -> Option<Frame> {
        let posture = bvh.posture(frame)?;
        let global =
            |joint: Joint| posture[self.joints[joint.index()]].0 * self.rest[joint.index()];
        let mut locals = [Matrix3::identity(); BODY_JOINTS];
        for (local, joint) in locals.iter_mut().zip(&Joint::ALL[1..]) {
            if let Some(parent) = joint.parent() {
                *local = global(parent).transpose() * global(*joint);
            }
        }
        let position = posture[self.joints[Joint::Pelvis.index()]].1 * self.scale;
        Some(((global(Joint::Pelvis), position), locals))
    }

    fn frames(&self, bvh: &Bvh) -> Vec<(Root, PoseVector)> {
        let frames: Vec<_> = (0..bvh.frames()).filter_map(|f| self.frame(bvh, f)).collect();
        let step = FPS * bvh.frame_time();
        if (step - 1.0).abs() < 0.01 {
            return frames.iter().map(|(root, locals)| (*root, pose_vector(locals))).collect();
        }
        resampled(&frames, step)
    }
}

/// C of the legs: the rotation from straight down to the file's rest direction.
fn straighten(bvh: &Bvh, joints: &[usize; JOINTS], rest: &mut [Matrix3<f64>; JOINTS]) {
    let left = [Joint::LHip, Joint::LKnee, Joint::LAnkle, Joint::LFoot];
    let right = left.map(Joint::mirrored);
    for leg in [left, right] {
        let shank = bvh.joints()[joints[leg[1].index()]].offset;
        let turn = UnitVector3::try_new(shank, 1e-9)
            .and_then(|down| Rotation3::rotation_between(&-Vector3::y(), &down));
        for joint in leg {
            rest[joint.index()] = turn.unwrap_or_default().into_inner();
        }
    }
}

/// Resamples frames to `step` times their rate: slerp of rotations, lerp of the pelvis position.
pub(super) fn resampled(frames: &[Frame], step: f64) -> Vec<(Root, PoseVector)> {
    let last = frames.len().saturating_sub(1);
    let count = (last as f64 * step).floor() as usize + usize::from(!frames.is_empty());
    (0..count)
        .map(|index| {
            let at = index as f64 / step;
            let (before, s) = ((at.floor() as usize).min(last), at.fract());
            let ((root, a), (next, b)) = (&frames[before], &frames[(before + 1).min(last)]);
            let root = (so3::slerp(&root.0, &next.0, s), root.1.lerp(&next.1, s));
            (root, pose_vector(&std::array::from_fn(|j| so3::slerp(&a[j], &b[j], s))))
        })
        .collect()
}

/// The first two columns of each rotation.
pub fn pose_vector(locals: &[Matrix3<f64>; BODY_JOINTS]) -> PoseVector {
    let mut pose = [0.0; POSE];
    for (numbers, local) in pose.chunks_exact_mut(6).zip(locals) {
        for (number, value) in numbers.iter_mut().zip(local.as_slice()) {
            *number = *value as f32;
        }
    }
    pose
}

/// The mirrored pose: R' = M R M with M = diag(-1, 1, 1), left and right swapped.
pub fn mirrored(pose: &PoseVector) -> PoseVector {
    let mut out = [0.0; POSE];
    for joint in &Joint::ALL[1..] {
        let (to, from) = (6 * (joint.index() - 1), 6 * (joint.mirrored().index() - 1));
        for (entry, sign) in [1.0, -1.0, -1.0, -1.0, 1.0, 1.0].into_iter().enumerate() {
            out[to + entry] = sign * pose[from + entry];
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn subjects_come_from_the_name() {
        assert_eq!(subject_of("07_12"), "07");
        assert_eq!(subject_of("act_train_walking_22"), "act");
        assert_eq!(subject_of("7"), "7");
        assert_eq!(subject_of("_1"), "act");
    }

    #[test]
    fn mirroring_is_conjugation_by_the_mirror() {
        let turn = |k: usize| so3::exp(&Vector3::new(0.1 * k as f64, 0.4, -0.07 * k as f64));
        let locals: [Matrix3<f64>; BODY_JOINTS] = std::array::from_fn(turn);
        let mirror = Matrix3::from_diagonal(&Vector3::new(-1.0, 1.0, 1.0));
        let expected = Joint::ALL.map(|joint| {
            let from = joint.mirrored().index().max(1) - 1;
            mirror * locals[from] * mirror
        });
        let expected: [Matrix3<f64>; BODY_JOINTS] = std::array::from_fn(|j| expected[j + 1]);
        assert_eq!(mirrored(&pose_vector(&locals)), pose_vector(&expected));
    }

    #[test]
    fn resampling_keeps_both_ends_and_halves_the_steps() {
        let turn = |angle: f64| [so3::exp(&(Vector3::x() * angle)); BODY_JOINTS];
        let frame = |angle: f64| ((turn(angle)[0], Vector3::z() * angle), turn(angle));
        let frames = resampled(&[frame(0.0), frame(0.4), frame(0.8)], 2.0);
        assert_eq!(frames.len(), 5);
        for ((root, pose), angle) in frames.iter().zip([0.0, 0.2, 0.4, 0.6, 0.8]) {
            assert!((root.0 - turn(angle)[0]).norm() < 1e-9 && (root.1.z - angle).abs() < 1e-9);
            let expected = pose_vector(&turn(angle));
            assert!(pose.iter().zip(&expected).all(|(a, b)| (a - b).abs() < 1e-6));
        }
        assert!(resampled(&[], 2.0).is_empty());
    }
}

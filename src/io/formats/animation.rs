//! The skin and the keys of an animation, for glTF and USD.

use nalgebra::{Matrix3, Vector3};

use super::style::Style;
use crate::core::body::{JOINTS, Joint, Mesh, Pose, Skeleton};
use crate::core::so3;

/// Most joints that move a vertex.
pub(super) const INFLUENCES: usize = 4;
/// A gap is longer than this, periods.
const GAP_PERIODS: f64 = 1.5;
/// A gap is longer than this, seconds: programs interpolate over a few lost frames and over a slower rate.
const GAP_S: f64 = 0.25;

/// What a file says of its content.
#[derive(Clone, Debug)]
pub struct Description<'a> {
    /// The performer.
    pub name: &'a str,
    /// Frame rate, hertz.
    pub fps: f64,
    /// Timecode and its rate at 0 seconds, such as `01:00:00:00 25`.
    pub timecode: Option<String>,
    /// Its rest pose and the names of its joints; its axes and unit are those of the format.
    pub style: &'a Style,
}

/// The skin of a body in the rest pose of a file; it stands on y = 0.
pub(super) struct Skin {
    pub(super) vertices: Vec<Vector3<f64>>,
    pub(super) joints: [Vector3<f64>; JOINTS],
    /// The axes of the joints, as columns.
    pub(super) axes: [Matrix3<f64>; JOINTS],
}

impl Skin {
    pub(super) fn of(skeleton: &Skeleton, style: &Style) -> Self {
        let (mesh, rest) = (Mesh::template(), style.rest());
        let mut vertices = mesh.posed(&mesh.rest(skeleton), skeleton, &rest);
        let lowest = vertices.iter().map(|vertex| vertex.y).fold(0.0, f64::min);
        let up = Vector3::new(0.0, -lowest, 0.0);
        vertices.iter_mut().for_each(|vertex| *vertex += up);
        let joints = rest.posture(skeleton).positions.map(|joint| joint + up);
        Self { vertices, joints, axes: style.joint_axes.of(&rest, skeleton) }
    }

    /// The rotation and the place of a joint in its parent; those of the pelvis are in the world.
    pub(super) fn in_parent(&self, joint: Joint) -> (Matrix3<f64>, Vector3<f64>) {
        let (axes, place) = (self.axes[joint.index()], self.joints[joint.index()]);
        let Some(parent) = joint.parent().map(Joint::index) else { return (axes, place) };
        let back = self.axes[parent].transpose();
        (back * axes, back * (place - self.joints[parent]))
    }

    pub(super) fn normals(&self) -> Vec<Vector3<f64>> {
        let mut normals = vec![Vector3::zeros(); self.vertices.len()];
        for face in Mesh::template().faces() {
            let [a, b, c] = face.map(|corner| self.vertices[corner as usize]);
            let normal = (b - a).cross(&(c - a));
            face.iter().for_each(|&corner| normals[corner as usize] += normal);
        }
        let unit = |sum: Vector3<f64>| sum.try_normalize(0.0).unwrap_or_else(Vector3::y);
        normals.into_iter().map(unit).collect()
    }
}

/// The joints that move a vertex, with their weights: a bone between two joints is divided between them.
pub(super) fn joint_weights(influences: &[(u8, f64); 4]) -> ([u8; INFLUENCES], [f32; INFLUENCES]) {
    let bones = Mesh::bones();
    let mut weights = [0.0; JOINTS];
    for &(bone, weight) in influences {
        let (joint, part) = bones[usize::from(bone)];
        weights[joint.index()] += part * weight;
        weights[joint.parent().unwrap_or(joint).index()] += (1.0 - part) * weight;
    }
    let mut order: [usize; JOINTS] = std::array::from_fn(|joint| joint);
    order.sort_by(|&a, &b| weights[b].total_cmp(&weights[a]));
    let kept = order.first_chunk::<INFLUENCES>().copied().unwrap_or_default();
    let sum: f64 = kept.iter().map(|&joint| weights[joint]).sum();
    // Joints without weight are 0, as the format wants it.
    let named = kept.map(|joint| if weights[joint] > 0.0 { joint as u8 } else { 0 });
    (named, kept.map(|joint| (weights[joint] / sum) as f32))
}

/// The keys of an animation.
#[derive(Default)]
pub(super) struct Keys {
    /// Seconds; they increase, in f32 too.
    pub(super) times: Vec<f64>,
    pub(super) positions: Vec<[f32; 3]>,
    /// By joint: x, y, z, w. Each is the nearer to the last of the two quaternions of its rotation, for programs
    /// interpolate between them.
    pub(super) rotations: [Vec<[f32; 4]>; JOINTS],
}

impl Keys {
    /// Fails with the number of a pose that is not finite.
    pub(super) fn of(
        poses: impl IntoIterator<Item = (f64, Pose)>,
        period: f64,
        style: &Style,
        skin: &Skin,
    ) -> Result<Self, usize> {
        let style = style.clone().with_axes(&skin.axes);
        let mut keys = Self::default();
        for (frame, (seconds, pose)) in poses.into_iter().enumerate() {
            let pose = style.pose(&pose);
            let position: [f32; 3] = pose.root_position.map(|metres| metres as f32).into();
            let turns = std::iter::once(&pose.root_rotation).chain(&pose.local);
            let turns = turns.map(|turn| so3::xyzw_from_rotation(turn).map(|number| number as f32));
            let turns = Vec::from_iter(turns);
            let numbers = turns.as_flattened().iter().chain(&position);
            if !(seconds as f32).is_finite() || !numbers.copied().all(f32::is_finite) {
                return Err(frame);
            }
            let last = keys.times.last().copied().unwrap_or(f64::NEG_INFINITY);
            let held = seconds - period;
            let is_between = (last as f32) < held as f32 && (held as f32) < seconds as f32;
            if last.is_finite() && seconds - last > (GAP_PERIODS * period).max(GAP_S) && is_between
            {
                keys.hold(held);
            }
            if seconds as f32 > last as f32 {
                keys.add(seconds, position, &turns);
            }
        }
        Ok(keys)
    }

    fn add(&mut self, seconds: f64, position: [f32; 3], turns: &[[f32; 4]]) {
        self.times.push(seconds);
        self.positions.push(position);
        for (keys, turn) in self.rotations.iter_mut().zip(turns) {
            keys.push(keys.last().map_or(*turn, |last| so3::continued(*turn, last)));
        }
    }

    /// Repeats the last key.
    fn hold(&mut self, seconds: f64) {
        self.times.push(seconds);
        self.positions.extend_from_within(self.positions.len() - 1..);
        self.rotations.iter_mut().for_each(|keys| keys.extend_from_within(keys.len() - 1..));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn turned(degrees: f64) -> Pose {
        let root_rotation = so3::exp(&Vector3::new(0.0, degrees.to_radians(), 0.0));
        Pose { root_rotation, ..Pose::rest() }
    }

    #[test]
    fn keys_turn_the_short_way_and_hold_before_a_gap() {
        let turns = (0..72).map(|k| (f64::from(k) * 0.1, turned(10.0 * f64::from(k))));
        let style = Style::default();
        let skin = Skin::of(&Skeleton::default(), &style);
        let keys = Keys::of(turns, 0.1, &style, &skin).unwrap();
        assert_eq!(keys.times.len(), 72);
        for pair in keys.rotations[0].windows(2) {
            let dot: f32 = pair[0].iter().zip(&pair[1]).map(|(a, b)| a * b).sum();
            assert!(dot > 0.99, "{pair:?}");
        }
        // A gap, a pose that comes twice, and one that goes back.
        let at = [0.0, 0.1, 0.5, 0.5, 0.3, 0.6];
        let turns = at.map(|seconds| (seconds, turned(100.0 * seconds)));
        let keys = Keys::of(turns, 0.1, &style, &skin).unwrap();
        let times: Vec<f32> = keys.times.iter().map(|time| *time as f32).collect();
        assert_eq!(times, [0.0, 0.1, 0.4, 0.5, 0.6]);
        assert_eq!(keys.rotations[0][1], keys.rotations[0][2]);
        let far = Pose { root_position: Vector3::repeat(1e39), ..Pose::rest() };
        let far = Keys::of([(0.0, Pose::rest()), (0.1, far)], 0.1, &style, &skin);
        assert_eq!(far.err(), Some(1));
    }

    #[test]
    fn weights_of_joints_add_up_and_name_no_joint_without_weight() {
        for influences in Mesh::template().influences() {
            let (joints, weights) = joint_weights(influences);
            assert!((weights.iter().sum::<f32>() - 1.0).abs() < 1e-6, "{weights:?}");
            for (joint, weight) in joints.iter().zip(weights) {
                assert!(weight > 0.0 || *joint == 0, "{joints:?} {weights:?}");
            }
        }
    }
}

//! The skin of the body: (V, F) = B(shape, pose, translation), and the joints j = R V.
//!
//! One template, a closed and symmetric triangle mesh in the rest pose, serves all bodies: its
//! segments follow the skeleton's, in length and girth. The skin is blended linearly between bones, so
//! that any program that skins meshes can show it.

mod polygonise;
mod sdf;
mod skin;

use std::sync::OnceLock;

use nalgebra::{Matrix3, Vector3};
use serde::Serialize;

use super::joints::{JOINTS, Joint};
use super::pose::Pose;
use super::skeleton::Skeleton;
use crate::core::so3;

/// The turn between a joint's parent and the joint is divided into this many equal steps. Each step before
/// the last has its own bone.
const STEPS: usize = 3;

/// Number of bones: the joints, then for each joint but the pelvis those between its parent and it.
const BONES: usize = JOINTS + (JOINTS - 1) * (STEPS - 1);

/// The bone of a step from the parent of `joint`, 0, to `joint`.
const fn bone(joint: Joint, step: usize) -> usize {
    match (step, joint.parent()) {
        (0, Some(parent)) => parent.index(),
        (STEPS, _) | (_, None) => joint.index(),
        _ => JOINTS + (joint.index() - 1) * (STEPS - 1) + step - 1,
    }
}

/// The joint that a bone turns about, and its part of the turn: 0 as the parent, 1 as the joint.
fn joint_of(bone: usize) -> (Joint, f64) {
    match bone.checked_sub(JOINTS) {
        None => (Joint::ALL[bone], 1.0),
        Some(k) => {
            let step = k % (STEPS - 1) + 1;
            (Joint::ALL[k / (STEPS - 1) + 1], step as f64 / STEPS as f64)
        }
    }
}

/// How much the bones between a joint and its parent bulge, so that limbs keep their volume: skin that is
/// blended linearly shrinks where a limb bends. Without unit; set by hand, the test of volumes checks them.
/// For a turn of the joint by the angle a about the unit axis n, in the parent's frame, their scale along an
/// axis is 1 + axis (bent (1 - cos a) + raised n_z sin a).
#[derive(Clone, Copy, Debug, Serialize)]
pub struct Bulge {
    bent: f64,
    raised: f64,
    axes: [f64; 3],
}

impl Bulge {
    /// Of all axes alike.
    const fn round(bent: f64) -> Self {
        Self { bent, raised: 0.0, axes: [1.0; 3] }
    }

    /// The scale along each axis for the joint's local rotation.
    fn scale(&self, local: &Matrix3<f64>) -> Vector3<f64> {
        let (versine, sine) = (0.5 * (3.0 - local.trace()), 0.5 * (local[(1, 0)] - local[(0, 1)]));
        let more = self.bent * versine + self.raised * sine;
        Vector3::from(self.axes).map(|axis| 1.0 + axis * more)
    }
}

/// The skin of all bodies: a closed, symmetric triangle mesh with skinning weights. Vertices are in metres; in
/// the rest pose the pelvis is at the origin, +x to the left, y up, +z forwards. [`Mesh::rest`] fits it to a
/// body, [`Mesh::posed`] poses it by linear blend skinning, [`Mesh::joints`] finds the joint centres.
#[derive(Debug)]
pub struct Mesh {
    vertices: Vec<Vector3<f64>>,
    faces: Vec<[u32; 3]>,
    influences: Vec<skin::Influences>,
    regressor: [Vec<(u32, f64)>; JOINTS],
}

impl Mesh {
    /// The template. The first call computes it, in about 0.2 s.
    pub fn template() -> &'static Self {
        static TEMPLATE: OnceLock<Mesh> = OnceLock::new();
        TEMPLATE.get_or_init(|| {
            let (vertices, faces) = polygonise::polygonise();
            let influences: Vec<_> = vertices.iter().map(skin::influences).collect();
            let rest = joints(&Skeleton::default());
            let regressor = Joint::ALL
                .map(|joint| skin::regressor(joint, &rest[joint.index()], &vertices, &influences));
            Self { vertices, faces, influences, regressor }
        })
    }

    /// The vertices of the template's own body in the rest pose, the pelvis at the origin, metres.
    pub fn vertices(&self) -> &[Vector3<f64>] {
        &self.vertices
    }

    /// Corners of each triangle, counter-clockwise seen from outside.
    pub fn faces(&self) -> &[[u32; 3]] {
        &self.faces
    }

    /// By bone, the joint that it turns about, and its part of the turn from the parent's rotation (0) to the
    /// joint's (1). The first bones are the joints, in order.
    pub fn bones() -> Vec<(Joint, f64)> {
        (0..BONES).map(joint_of).collect()
    }

    /// How much the bones between a joint and its parent bulge.
    pub fn bulge(joint: Joint) -> Bulge {
        match joint {
            Joint::LElbow | Joint::RElbow => Bulge::round(0.035),
            Joint::LKnee | Joint::RKnee => Bulge::round(0.05),
            // The shoulder is not in the middle of the flesh that it moves: the armpit is below. It goes to the
            // front and the back when the arm hangs.
            Joint::LShoulder | Joint::RShoulder => {
                Bulge { bent: 0.11, raised: -0.155 * joint.side(), axes: [0.0, 0.0, 1.0] }
            }
            _ => Bulge::round(0.03),
        }
    }

    /// The bones that move each vertex, with weights that add up to 1, the largest first.
    pub fn influences(&self) -> &[[(u8, f64); 4]] {
        &self.influences
    }

    /// The vertices of a body in the rest pose, the pelvis at the origin, metres.
    pub fn rest(&self, body: &Skeleton) -> Vec<Vector3<f64>> {
        let (from, to) = (joints(&Skeleton::default()), joints(body));
        let scales = Scales::of(body);
        let moved = |(p, influences): (&Vector3<f64>, &skin::Influences)| {
            let mut sum = Vector3::zeros();
            for &(bone, weight) in influences {
                let (joint, part) = joint_of(bone.into());
                let parent = joint.parent().unwrap_or(joint);
                let scale = scales.at(parent, p).lerp(&scales.at(joint, p), part);
                let arm = p - from[joint.index()];
                sum += (to[joint.index()] + scale.component_mul(&arm)) * weight;
            }
            sum
        };
        self.vertices.iter().zip(&self.influences).map(moved).collect()
    }

    /// The vertices of a body in a pose, in the world, metres. `rest`: [`Mesh::rest`] of the same body.
    pub fn posed(&self, rest: &[Vector3<f64>], body: &Skeleton, pose: &Pose) -> Vec<Vector3<f64>> {
        let from = joints(body);
        let posture = pose.posture(body);
        let bones: [(Matrix3<f64>, Vector3<f64>); BONES] = std::array::from_fn(|bone| {
            let (joint, part) = joint_of(bone);
            let j = joint.index();
            let parent = joint.parent().unwrap_or(joint).index();
            let (before, own) = (&posture.rotations[parent], &posture.rotations[j]);
            let matrix = match part < 1.0 {
                true => {
                    let scale = Self::bulge(joint).scale(&pose.local[j - 1]);
                    so3::slerp(before, own, part) * Matrix3::from_diagonal(&scale)
                }
                false => *own,
            };
            (matrix, posture.positions[j] - matrix * from[j])
        });
        let moved = |(p, influences): (&Vector3<f64>, &skin::Influences)| {
            let by = |&(bone, weight): &(u8, f64)| {
                let (matrix, position) = &bones[usize::from(bone)];
                (matrix * p + position) * weight
            };
            influences.iter().map(by).sum()
        };
        rest.iter().zip(&self.influences).map(moved).collect()
    }

    /// The joint centres of a skin in any pose: R V.
    pub fn joints(&self, vertices: &[Vector3<f64>]) -> [Vector3<f64>; JOINTS] {
        let weighted = |&(vertex, weight): &(u32, f64)| vertices[vertex as usize] * weight;
        std::array::from_fn(|j| self.regressor[j].iter().map(weighted).sum())
    }
}

/// The joints of a body in the rest pose, the pelvis at the origin.
fn joints(body: &Skeleton) -> [Vector3<f64>; JOINTS] {
    Pose::rest().posture(body).positions
}

/// The size of each segment of a body, relative to the template's, by axis. A limb that is 10 % longer is 5 %
/// thicker: weight grows with the square of stature. Shoulders and hips give the width of the trunk.
struct Scales {
    offsets: [Vector3<f64>; JOINTS],
}

impl Scales {
    fn of(body: &Skeleton) -> Self {
        let template = Skeleton::default();
        let relative = |joint: Joint| {
            let (own, usual) = (body.offset(joint), template.offset(joint));
            let length = own.norm() / usual.norm().max(f64::MIN_POSITIVE);
            Vector3::from_fn(|axis, _| match usual[axis].abs() > 0.02 {
                true => own[axis] / usual[axis],
                false => length,
            })
        };
        Self { offsets: Joint::ALL.map(relative) }
    }

    /// The scale about `joint` of what it carries at `p`, a point of the template.
    fn at(&self, joint: Joint, p: &Vector3<f64>) -> Vector3<f64> {
        use Joint::*;
        let of = |joint: Joint| self.offsets[joint.index()];
        let girth = |length: f64| 0.5 + 0.5 * length;
        let leg = |next: Joint| Vector3::new(girth(of(next).y), of(next).y, girth(of(next).y));
        let arm = |next: Joint| Vector3::new(of(next).x, girth(of(next).x), girth(of(next).x));
        let trunk = |x: f64, y: f64| Vector3::new(x, y, girth(y));
        let (hip, collar) =
            if p.x < 0.0 { (of(RHip), of(RCollar)) } else { (of(LHip), of(LCollar)) };
        match joint {
            Pelvis => {
                // From the hips to the waist.
                let up = (0.5 + p.y / 0.16).clamp(0.0, 1.0);
                trunk(hip.x, hip.y + (of(Spine1).y - hip.y) * up)
            }
            Spine1 => trunk(0.5 * (hip.x + collar.x), of(Spine2).y),
            Spine2 => trunk(0.5 * (hip.x + collar.x), of(Spine3).y),
            Spine3 => trunk(collar.x, of(Neck).y),
            LCollar => trunk(of(LShoulder).x, of(LShoulder).y),
            RCollar => trunk(of(RShoulder).x, of(RShoulder).y),
            Neck | Head => Vector3::repeat(of(Head).y),
            LHip => leg(LKnee),
            RHip => leg(RKnee),
            LKnee => leg(LAnkle),
            RKnee => leg(RAnkle),
            LAnkle | LFoot => Vector3::repeat(of(LFoot).y),
            RAnkle | RFoot => Vector3::repeat(of(RFoot).y),
            LShoulder => arm(LElbow),
            RShoulder => arm(RElbow),
            LElbow => arm(LWrist),
            RElbow => arm(RWrist),
            LWrist => Vector3::repeat(of(LWrist).x),
            RWrist => Vector3::repeat(of(RWrist).x),
        }
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;
    use std::ops::Range;

    use rand::rngs::StdRng;
    use rand::{RngExt, SeedableRng};

    use super::*;
    use crate::core::body::skeleton::{SHAPE_COEFFICIENTS, Shape};

    /// A pose with one joint turned.
    fn bent(joint: Joint, axis: Vector3<f64>) -> Pose {
        let mut pose = Pose::rest();
        pose.local[joint.index() - 1] = so3::exp(&axis);
        pose
    }

    fn random_pose(seed: u64) -> (Skeleton, Pose) {
        let mut random = StdRng::seed_from_u64(seed);
        let mut turn =
            |size: f64| so3::exp(&Vector3::from_fn(|_, _| random.random_range(-size..size)));
        let mut pose = Pose::rest();
        pose.root_rotation = turn(3.0);
        pose.root_position = Vector3::new(1.0, 2.0, -3.0);
        pose.local = std::array::from_fn(|_| turn(1.2));
        let shape = Shape(std::array::from_fn(|_| random.random_range(-2.0..2.0)));
        (Skeleton::new(shape), pose)
    }

    #[test]
    fn the_template_is_closed_and_symmetric() {
        let mesh = Mesh::template();
        let n = mesh.vertices.len();
        assert!((2000..7000).contains(&n), "{n} vertices");
        let mut edges = BTreeMap::new();
        for &[a, b, c] in &mesh.faces {
            for edge in [(a, b), (b, c), (c, a)] {
                *edges.entry(edge).or_insert(0) += 1;
            }
        }
        for ((a, b), count) in &edges {
            assert_eq!((*count, edges.get(&(*b, *a))), (1, Some(&1)), "edge {a} {b}");
        }
        assert_eq!(n + mesh.faces.len(), edges.len() / 2 + 2, "not a sphere's topology");
        let (left, right) = mesh.vertices.split_at(n / 2);
        for (left, right) in left.iter().zip(right) {
            assert_eq!((left.x, left.y, left.z), (-right.x, right.y, right.z));
        }
    }

    /// Length of the convex hull of a section, as a tape measures it; of the points with `xs` only.
    fn girth(skin: &[Vector3<f64>], axis: usize, at: f64, xs: Range<f64>) -> f64 {
        let mut points = Vec::new();
        for face in &Mesh::template().faces {
            for k in 0..3 {
                let [a, b] = [face[k], face[(k + 1) % 3]].map(|v| skin[v as usize]);
                let (da, db) = (a[axis] - at, b[axis] - at);
                if (da < 0.0) != (db < 0.0) {
                    points.push(a.lerp(&b, da / (da - db)));
                }
            }
        }
        let (u, v) = ((axis + 1) % 3, (axis + 2) % 3);
        let mut points: Vec<[f64; 2]> =
            points.iter().filter(|p| xs.contains(&p.x)).map(|p| [p[u], p[v]]).collect();
        points.sort_by(|a, b| a.partial_cmp(b).unwrap());
        let half = |points: &mut dyn Iterator<Item = &[f64; 2]>| {
            let mut hull: Vec<[f64; 2]> = Vec::new();
            for p in points {
                while let [.., a, b] = hull[..] {
                    let turn = (b[0] - a[0]) * (p[1] - a[1]) - (b[1] - a[1]) * (p[0] - a[0]);
                    if turn > 0.0 {
                        break;
                    }
                    hull.pop();
                }
                hull.push(*p);
            }
            hull.windows(2).map(|w| libm::hypot(w[1][0] - w[0][0], w[1][1] - w[0][1])).sum::<f64>()
        };
        half(&mut points.iter()) + half(&mut points.iter().rev())
    }

    #[test]
    fn girths_are_those_of_the_mean_adult() {
        let skin = &Mesh::template().vertices;
        let (trunk, left) = (-0.2..0.2, 0.0..1.0);
        // [Gordon 2014], women and men to equal parts, centimetres. Flexed arms there, so 1 cm less here.
        let table = [
            ("head", 1, 0.660, &trunk, 56.8),
            ("neck", 1, 0.505, &trunk, 36.4),
            ("chest", 1, 0.275, &trunk, 100.3),
            ("waist", 1, 0.060, &trunk, 90.1),
            ("hips", 1, -0.100, &trunk, 102.0),
            ("thigh", 1, -0.170, &left, 62.0),
            ("lower thigh", 1, -0.430, &left, 40.6),
            ("calf", 1, -0.620, &left, 38.3),
            ("ankle", 1, -0.870, &left, 22.3),
            ("upper arm", 0, 0.300, &left, 32.2),
            ("forearm", 0, 0.510, &left, 27.7),
            ("wrist", 0, 0.705, &left, 16.6),
        ];
        for (name, axis, at, xs, usual) in table {
            let found = 100.0 * girth(skin, axis, at, Range::clone(xs));
            println!("{name}: {found:.1} cm, usually {usual:.1}");
            assert!((found / usual - 1.0).abs() < 0.05, "{name}: {found:.1} cm, usually {usual}");
        }
    }

    #[test]
    fn the_regressor_finds_the_joints_in_any_pose_and_shape() {
        let mesh = Mesh::template();
        for seed in 0..20 {
            let (body, pose) = random_pose(seed);
            let skin = mesh.posed(&mesh.rest(&body), &body, &pose);
            let (found, right) = (mesh.joints(&skin), pose.posture(&body).positions);
            for joint in Joint::ALL {
                let off = 1000.0 * (found[joint.index()] - right[joint.index()]).norm();
                assert!(off < 3.0, "{}: {off:.3} mm, seed {seed}", joint.name());
            }
        }
    }

    #[test]
    fn the_skin_grows_with_the_shape() {
        let mesh = Mesh::template();
        let height = |shape: [f64; SHAPE_COEFFICIENTS]| {
            let skin = mesh.rest(&Skeleton::new(Shape(shape)));
            let ys = || skin.iter().map(|p| p.y);
            ys().fold(f64::MIN, f64::max) - ys().fold(f64::MAX, f64::min)
        };
        let mut tall = [0.0; SHAPE_COEFFICIENTS];
        let usual = height(tall);
        assert!((usual - 1.72).abs() < 0.01, "{usual} m");
        tall[0] = 2.0;
        assert!((height(tall) / usual - 1.104).abs() < 1e-9);
        // Girths of limbs grow half as much; the trunk is also as wide as shoulders and hips are.
        let large = mesh.rest(&Skeleton::new(Shape(tall)));
        for (at, xs) in
            [(0.275, -0.2..0.2), (0.060, -0.2..0.2), (-0.170, 0.0..1.0), (-0.620, 0.0..1.0)]
        {
            let usual = girth(&mesh.vertices, 1, at, Range::clone(&xs));
            let found = girth(&large, 1, 1.104 * at, 1.104 * xs.start..1.104 * xs.end) / usual;
            let most = if xs.start < 0.0 { 1.09 } else { 1.06 };
            assert!((1.04..most).contains(&found), "{found} times at {at} m");
        }
        assert_eq!(mesh.rest(&Skeleton::default()).len(), mesh.vertices.len());
        for (rest, template) in mesh.rest(&Skeleton::default()).iter().zip(&mesh.vertices) {
            assert!((rest - template).norm() < 1e-12);
        }
    }

    #[test]
    fn limbs_keep_their_volume_when_they_bend() {
        let mesh = Mesh::template();
        let body = Skeleton::default();
        let right_angle = std::f64::consts::FRAC_PI_2;
        let mut worst: f64 = 0.0;
        let cases = [
            ("elbow", Joint::LElbow, Vector3::y(), [0.0, -1.6], 0.13),
            ("knee", Joint::LKnee, Vector3::x(), [0.0, 1.6], 0.20),
            ("shoulder", Joint::LShoulder, Vector3::z(), [-1.0, 0.9], 0.20),
            ("shoulder, forwards", Joint::LShoulder, Vector3::y(), [-1.0, 0.3], 0.20),
            ("forearm, twisted", Joint::LWrist, Vector3::x(), [-1.0, 1.0], 0.12),
        ];
        for (name, joint, axis, [from, to], reach) in cases {
            let centre = joints(&body)[joint.index()];
            let near: Vec<_> = mesh
                .faces
                .iter()
                .filter(|f| f.iter().all(|v| (mesh.vertices[*v as usize] - centre).norm() < reach))
                .collect();
            // The skin near the joint, closed by a cone from the joint to its rims, which keep their shape.
            let volume = |skin: &[Vector3<f64>]| -> f64 {
                let arm = |v: u32| skin[v as usize] - centre;
                near.iter().map(|[a, b, c]| arm(*a).dot(&arm(*b).cross(&arm(*c))) / 6.0).sum()
            };
            let usual = volume(&mesh.vertices);
            for step in 0..=8 {
                let angle = right_angle * (from + (to - from) * f64::from(step) / 8.0);
                let skin = mesh.posed(&mesh.vertices, &body, &bent(joint, axis * angle));
                let change = 100.0 * (volume(&skin) / usual - 1.0);
                println!("{name} {:.0} degrees: {change:+.1} %", angle.to_degrees());
                worst = worst.max(change.abs());
            }
        }
        assert!(worst < 3.0, "{worst:.1} %");
    }
}

//! Forward kinematics in global rotations, and its Jacobian by pushing tangents forward.

use nalgebra::{Matrix3, Vector3};

use super::joints::{BODY_JOINTS, JOINTS, Joint};
use super::skeleton::Skeleton;

/// Rotation and position of every joint in the world.
#[derive(Clone, Debug, PartialEq)]
pub struct Posture {
    /// `world_from_joint` rotations.
    pub rotations: [Matrix3<f64>; JOINTS],
    /// Joint centres in the world, metres.
    pub positions: [Vector3<f64>; JOINTS],
}

/// G_j = G_parent R_j and P_j = P_parent + G_parent o_j.
///
/// `root_rotation` is `world_from_pelvis`, `root_position` the pelvis in the world, `local` the
/// 21 rotations `parent_from_joint` in joint order.
pub fn forward(
    skeleton: &Skeleton,
    root_rotation: &Matrix3<f64>,
    root_position: &Vector3<f64>,
    local: &[Matrix3<f64>; BODY_JOINTS],
) -> Posture {
    let mut posture =
        Posture { rotations: [*root_rotation; JOINTS], positions: [*root_position; JOINTS] };
    for joint in &Joint::ALL[1..] {
        if let Some(parent) = joint.parent().map(Joint::index) {
            let (j, parent_rotation) = (joint.index(), posture.rotations[parent]);
            posture.rotations[j] = parent_rotation * local[j - 1];
            posture.positions[j] =
                posture.positions[parent] + parent_rotation * skeleton.offset(*joint);
        }
    }
    posture
}

/// The way from a joint's centre to a keypoint, world frame, metres: one part turns with the joint, the
/// other, if there is one, with its parent.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Arms {
    pub(super) joint: Joint,
    pub(super) own: Vector3<f64>,
    pub(super) of_parent: Option<(Joint, Vector3<f64>)>,
}

impl Arms {
    /// Position of the keypoint.
    pub fn position(&self, posture: &Posture) -> Vector3<f64> {
        let of_parent = self.of_parent.map_or_else(Vector3::zeros, |(_, arm)| arm);
        posture.positions[self.joint.index()] + self.own + of_parent
    }
}

/// Tangents of a posture by `columns` parameters. They are f32, since they only set the direction
/// of a step. Row-major, `3 * JOINTS` rows each.
#[derive(Clone, Debug)]
pub struct Tangents {
    columns: usize,
    /// Left (world-frame) angular tangents, rows 3 j to 3 j + 2 for joint j.
    rotation: Vec<f32>,
    /// Derivatives of the joint centres, same rows.
    position: Vec<f32>,
}

impl Tangents {
    /// Tangents that are all zero.
    pub fn zeros(columns: usize) -> Self {
        let size = 3 * JOINTS * columns;
        Self { columns, rotation: vec![0.0; size], position: vec![0.0; size] }
    }

    /// Number of parameters.
    pub fn columns(&self) -> usize {
        self.columns
    }

    /// Motion along `direction` of a point by each parameter, written to `out`:
    /// d . (dP_j + w_j x a_j + w_p x a_p) = d . dP_j + (a_j x d) . w_j + (a_p x d) . w_p.
    pub fn along(&self, arms: &Arms, direction: &Vector3<f64>, out: &mut [f32]) {
        let rows =
            |joint: Joint| joint.index() * 3 * self.columns..(joint.index() + 1) * 3 * self.columns;
        let (rotation, position) =
            (&self.rotation[rows(arms.joint)], &self.position[rows(arms.joint)]);
        contract(rotation, &arms.own.cross(direction).cast(), position, &direction.cast(), out);
        if let Some((parent, arm)) = arms.of_parent {
            add_turned(&self.rotation[rows(parent)], &arm.cross(direction).cast(), out);
        }
    }

    /// The derivative of the centre of `joint`, 3 x columns, row-major.
    pub fn position(&self, joint: Joint) -> &[f32] {
        &self.position[joint.index() * 3 * self.columns..][..3 * self.columns]
    }
}

crate::core::linalg::wide! {
    /// out = torque^T rotation + force^T position, for 3 x n blocks.
    fn contract(
        rotation: &[f32],
        torque: &Vector3<f32>,
        position: &[f32],
        force: &Vector3<f32>,
        out: &mut [f32],
    ) {
        let n = rotation.len() / 3;
        let (out, (tx, rest)) = (&mut out[..n], rotation.split_at(n));
        let (ty, tz) = rest.split_at(n);
        let (sx, rest) = position.split_at(n);
        let ((sy, sz), tz) = (rest.split_at(n), &tz[..n]);
        let sz = &sz[..n];
        for (c, out) in out.iter_mut().enumerate() {
            let turned = torque.x * tx[c] + torque.y * ty[c] + torque.z * tz[c];
            *out = turned + force.x * sx[c] + force.y * sy[c] + force.z * sz[c];
        }
    }
}

crate::core::linalg::wide! {
    /// out += torque^T rotation, for a 3 x n block.
    fn add_turned(rotation: &[f32], torque: &Vector3<f32>, out: &mut [f32]) {
        let n = rotation.len() / 3;
        let (out, (tx, rest)) = (&mut out[..n], rotation.split_at(n));
        let (ty, tz) = rest.split_at(n);
        let tz = &tz[..n];
        for (c, out) in out.iter_mut().enumerate() {
            *out += torque.x * tx[c] + torque.y * ty[c] + torque.z * tz[c];
        }
    }
}

crate::core::linalg::wide! {
    /// out = position + rotation x arm, for 3 x n blocks.
    fn add_moved(position: &[f32], rotation: &[f32], arm: &Vector3<f32>, n: usize, out: &mut [f32]) {
        let (wx, rest) = rotation.split_at(n);
        let (wy, wz) = rest.split_at(n);
        let (sx, rest) = position.split_at(n);
        let (sy, sz) = rest.split_at(n);
        let (ox, rest) = out.split_at_mut(n);
        let (oy, oz) = rest.split_at_mut(n);
        for c in 0..n {
            ox[c] = sx[c] + wy[c] * arm.z - wz[c] * arm.y;
            oy[c] = sy[c] + wz[c] * arm.x - wx[c] * arm.z;
            oz[c] = sz[c] + wx[c] * arm.y - wy[c] * arm.x;
        }
    }
}

/// Fills `tangents` for joints 1 to 21 from those of the pelvis (see [`Tangents::set_root_rotation`])
/// and from the local tangents.
///
/// `local` is row-major, `3 * BODY_JOINTS` rows of `local_columns`: right tangents of each local
/// rotation by the first `local_columns` parameters. `shape_column`, if given, is the first of the
/// columns of the shape; those without a column are left out.
///
/// w_j = w_parent + G_j d_j and dP_j = dP_parent + w_parent x (G_parent o_j).
pub fn push_forward(
    skeleton: &Skeleton,
    posture: &Posture,
    local: &[f32],
    local_columns: usize,
    shape_column: Option<usize>,
    tangents: &mut Tangents,
) {
    let n = tangents.columns;
    for joint in &Joint::ALL[1..] {
        let Some(parent) = joint.parent().map(Joint::index) else { continue };
        let (j, block) = (joint.index(), 3 * n);
        let (done, here) = tangents.rotation.split_at_mut(j * block);
        let parent_tangents = &done[parent * block..(parent + 1) * block];
        here[..block].copy_from_slice(parent_tangents);
        let rows = &local[(j - 1) * 3 * local_columns..j * 3 * local_columns];
        let m = local_columns;
        add_rotated(&posture.rotations[j].cast(), rows, m, n, &mut here[..block]);

        let parent_rotation = &posture.rotations[parent];
        let arm = parent_rotation * skeleton.offset(*joint);
        let (done, here) = tangents.position.split_at_mut(j * block);
        add_moved(
            &done[parent * block..(parent + 1) * block],
            parent_tangents,
            &arm.cast(),
            n,
            here,
        );
        if let Some(first) = shape_column {
            let by_shape = skeleton.offset_by_shape(*joint);
            for (k, offset) in by_shape.iter().enumerate().take(n - first) {
                let moved = parent_rotation * offset;
                for row in 0..3 {
                    here[row * n + first + k] += moved[row] as f32;
                }
            }
        }
    }
}

crate::core::linalg::wide! {
    /// rotation (3 x n) += G rows (3 x m), in the first m columns.
    fn add_rotated(g: &Matrix3<f32>, rows: &[f32], m: usize, n: usize, rotation: &mut [f32]) {
        let (x, rest) = rows.split_at(m);
        let (y, z) = rest.split_at(m);
        for row in 0..3 {
            let (gx, gy, gz) = (g[(row, 0)], g[(row, 1)], g[(row, 2)]);
            for (c, out) in rotation[row * n..row * n + m].iter_mut().enumerate() {
                *out += gx * x[c] + gy * y[c] + gz * z[c];
            }
        }
    }
}

impl Tangents {
    /// Sets the pelvis' tangents to zero.
    pub fn clear_root(&mut self) {
        let n = self.columns;
        self.rotation[..3 * n].fill(0.0);
        self.position[..3 * n].fill(0.0);
    }

    /// The three parameters from `column` on rotate the pelvis by `rotation` (world frame, 3x3).
    pub fn set_root_rotation(&mut self, column: usize, rotation: &Matrix3<f64>) {
        for row in 0..3 {
            for k in 0..3 {
                self.rotation[row * self.columns + column + k] = rotation[(row, k)] as f32;
            }
        }
    }

    /// The three parameters from `column` on move the pelvis by `scale` times their values.
    pub fn set_root_position(&mut self, column: usize, scale: f32) {
        for row in 0..3 {
            self.position[row * self.columns + column + row] = scale;
        }
    }
}

/// The gradient of a cost by joint positions and rotations, as forces and torques. A joint carries
/// the forces on its descendants.
#[derive(Clone, Debug)]
pub struct Wrenches {
    force: [Vector3<f64>; JOINTS],
    /// About the joint's centre, in the world frame.
    torque: [Vector3<f64>; JOINTS],
}

impl Wrenches {
    /// Forces and torques that are all zero.
    pub fn zeros() -> Self {
        Self { force: [Vector3::zeros(); JOINTS], torque: [Vector3::zeros(); JOINTS] }
    }

    /// Adds the gradient by the position of a point.
    pub fn add(&mut self, arms: &Arms, gradient: &Vector3<f64>) {
        self.force[arms.joint.index()] += gradient;
        self.torque[arms.joint.index()] += arms.own.cross(gradient);
        if let Some((parent, arm)) = arms.of_parent {
            self.torque[parent.index()] += arm.cross(gradient);
        }
    }

    /// Adds to each joint the forces on its children, from the tips to the pelvis.
    pub fn gather(&mut self, posture: &Posture) {
        for joint in Joint::ALL[1..].iter().rev() {
            let Some(parent) = joint.parent().map(Joint::index) else { continue };
            let j = joint.index();
            let arm = posture.positions[j] - posture.positions[parent];
            self.force[parent] += self.force[j];
            self.torque[parent] += self.torque[j] + arm.cross(&self.force[j]);
        }
    }

    /// After gathering: the gradient by a translation of `joint` with its descendants, world frame.
    pub fn force(&self, joint: Joint) -> &Vector3<f64> {
        &self.force[joint.index()]
    }

    /// After gathering: the gradient by the left (world-frame) rotation vector of `joint`. The
    /// rotation of a joint times its local right tangent is such a vector.
    pub fn torque(&self, joint: Joint) -> &Vector3<f64> {
        &self.torque[joint.index()]
    }
}

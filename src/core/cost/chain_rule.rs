//! The chain rule from a frame's coordinates to the unknowns of the keyframes around it.

use std::ops::Range;

use nalgebra::{Matrix3, Vector3};

use super::unknowns::{KEYFRAME, Place, Unknowns};
use crate::core::manifold::{Interpolation, LATENT, LatentTangent};
use crate::core::optimise::BlockBanded;
use crate::core::so3;

/// Derivative of a frame's coordinates (code, rotation, position) by those of a keyframe.
#[derive(Clone, Debug)]
pub(super) struct KeyframeTangent {
    /// Index of the keyframe among the free ones.
    pub(super) keyframe: usize,
    pub(super) code: LatentTangent,
    /// Left (world-frame) tangent of the frame's rotation by the keyframe's rotation vector.
    pub(super) rotation: Matrix3<f64>,
    /// Factor of the position.
    pub(super) position: f64,
}

/// The derivatives by the free keyframes next to a frame, the later one first.
pub(super) fn keyframe_tangents(
    unknowns: &Unknowns,
    interpolation: Interpolation,
    Place { from, to, s }: Place,
) -> [Option<KeyframeTangent>; 2] {
    let free = |k: usize, make: &dyn Fn() -> (LatentTangent, Matrix3<f64>, f64)| {
        unknowns.is_free(k).then(|| {
            let (code, rotation, position) = make();
            let rotation = rotation * so3::left_jacobian(&unknowns.rotation_vectors[k]);
            KeyframeTangent { keyframe: unknowns.number(k), code, rotation, position }
        })
    };
    if from == to {
        let same = || (LatentTangent::straight(1.0), Matrix3::identity(), 1.0);
        return [free(to, &same), None];
    }
    let tangent = |k: usize, other: usize, s: f64| {
        let (near, far) = (&unknowns.keyframes[k], &unknowns.keyframes[other]);
        free(k, &|| {
            let along = so3::slerp_jacobian(&far.root_rotation, &near.root_rotation, s);
            (interpolation.tangent(&far.z, &near.z, s), along, s)
        })
    };
    [tangent(to, from, s), tangent(from, to, 1.0 - s)]
}

impl KeyframeTangent {
    /// out = D^T v: v is a gradient by the frame's coordinates, D this derivative.
    pub(super) fn pull_back<T: Copy + Into<f64>>(&self, v: &[T], out: &mut [f64; KEYFRAME]) {
        let (code, root) = v.split_at(LATENT);
        let across: f64 = code.iter().zip(&self.code.across).map(|(&a, b)| a.into() * b).sum();
        for ((out, &v), along) in out.iter_mut().zip(code).zip(&self.code.along) {
            *out = self.code.scale * v.into() + across * along;
        }
        let turned = self.rotation.tr_mul(&Vector3::from_fn(|k, _| root[k].into()));
        out[LATENT..LATENT + 3].copy_from_slice(turned.as_slice());
        (0..3).for_each(|k| out[LATENT + 3 + k] = self.position * root[3 + k].into());
    }

    /// Adds D^T H D' to the block of this keyframe and of `other`, which is not later. `gram` is H
    /// with `columns` columns; `half` is scratch memory.
    pub(super) fn add_block(
        &self,
        other: &Self,
        gram: &[f32],
        columns: usize,
        half: &mut Vec<f64>,
        hessian: &mut BlockBanded,
    ) {
        // H is symmetric, so the product of its rows with D' is the columns of H D': `half` is D'^T
        // H.
        half.resize(KEYFRAME * KEYFRAME, 0.0);
        let mut pulled = [0.0; KEYFRAME];
        for (i, row) in gram.chunks_exact(columns).take(KEYFRAME).enumerate() {
            other.pull_back(row, &mut pulled);
            (0..KEYFRAME).for_each(|j| half[j * KEYFRAME + i] = pulled[j]);
        }
        for (j, row) in half.chunks_exact(KEYFRAME).enumerate() {
            self.pull_back(row, &mut pulled);
            let column = hessian.column_mut(block(self.keyframe), other.keyframe * KEYFRAME + j);
            column.iter_mut().zip(&pulled).for_each(|(entry, value)| *entry += value);
        }
    }
}

/// The unknowns of a free keyframe, by its index among the free ones.
pub(super) fn block(keyframe: usize) -> Range<usize> {
    keyframe * KEYFRAME..(keyframe + 1) * KEYFRAME
}

/// A lower triangular L with L L^T = A, for A positive semidefinite. A zero pivot gives a zero
/// column, for instance along the ray of a point that only one camera sees.
pub(super) fn semidefinite_cholesky(a: &Matrix3<f64>) -> Matrix3<f64> {
    let floor = 1e-12 * a.trace();
    let mut rest = *a;
    let mut root = Matrix3::zeros();
    for column in 0..3 {
        let pivot = rest[(column, column)];
        if pivot > floor {
            let mut l = rest.column(column) / pivot.sqrt();
            l.rows_mut(0, column).fill(0.0);
            rest -= l * l.transpose();
            root.set_column(column, &l);
        }
    }
    root
}

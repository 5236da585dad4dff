//! From the coordinates of a moment to the unknowns of knots.

use std::ops::Range;

use nalgebra::{Matrix3, Vector3};

use super::unknowns::{KEYFRAME, Place, Unknowns};
use crate::core::manifold::{Interpolation, LATENT, LatentTangent};
use crate::core::optimise::BlockBanded;
use crate::core::so3;

/// How a moment's own coordinates (code, rotation, position) change with a knot's.
#[derive(Clone, Debug)]
pub(super) struct End {
    /// Number of the knot among the free ones.
    pub(super) knot: usize,
    pub(super) code: LatentTangent,
    /// World-frame turn of the moment by the knot's rotation vector.
    pub(super) turn: Matrix3<f64>,
    pub(super) shift: f64,
}

/// How a moment's coordinates change with the free knots about it, the later one first.
pub(super) fn ends(
    unknowns: &Unknowns,
    interpolation: Interpolation,
    Place { from, to, s }: Place,
) -> [Option<End>; 2] {
    let free = |knot: usize, make: &dyn Fn() -> (LatentTangent, Matrix3<f64>, f64)| {
        unknowns.is_free(knot).then(|| {
            let (code, turn, shift) = make();
            let turn = turn * so3::left_jacobian(&unknowns.turns[knot]);
            End { knot: unknowns.number(knot), code, turn, shift }
        })
    };
    if from == to {
        let same = || (LatentTangent::straight(1.0), Matrix3::identity(), 1.0);
        return [free(to, &same), None];
    }
    let end = |knot: usize, other: usize, s: f64| {
        let (near, far) = (&unknowns.keyframes[knot], &unknowns.keyframes[other]);
        free(knot, &|| {
            let along = so3::slerp_jacobian(&far.root_rotation, &near.root_rotation, s);
            (interpolation.tangent(&far.z, &near.z, s), along, s)
        })
    };
    [end(to, from, s), end(from, to, 1.0 - s)]
}

impl End {
    /// out = D^T v, for v a gradient by the moment's coordinates and D this change.
    pub(super) fn pull<T: Copy + Into<f64>>(&self, v: &[T], out: &mut [f64; KEYFRAME]) {
        let (code, root) = v.split_at(LATENT);
        let across: f64 = code.iter().zip(&self.code.across).map(|(&a, b)| a.into() * b).sum();
        for ((out, &v), along) in out.iter_mut().zip(code).zip(&self.code.along) {
            *out = self.code.scale * v.into() + across * along;
        }
        let turn = self.turn.tr_mul(&Vector3::from_fn(|k, _| root[k].into()));
        out[LATENT..LATENT + 3].copy_from_slice(turn.as_slice());
        (0..3).for_each(|k| out[LATENT + 3 + k] = self.shift * root[3 + k].into());
    }

    /// Adds D^T H D' to the block of this knot and another, not later one. `gram` is H, `columns`
    /// wide; `half` is memory.
    pub(super) fn add_block(
        &self,
        other: &Self,
        gram: &[f32],
        columns: usize,
        half: &mut Vec<f64>,
        hessian: &mut BlockBanded,
    ) {
        // H is symmetric: its rows pulled back are the columns of H D', so `half` is D'^T H.
        half.resize(KEYFRAME * KEYFRAME, 0.0);
        let mut pulled = [0.0; KEYFRAME];
        for (i, row) in gram.chunks_exact(columns).take(KEYFRAME).enumerate() {
            other.pull(row, &mut pulled);
            (0..KEYFRAME).for_each(|j| half[j * KEYFRAME + i] = pulled[j]);
        }
        for (j, row) in half.chunks_exact(KEYFRAME).enumerate() {
            self.pull(row, &mut pulled);
            let column = hessian.column_mut(block(self.knot), other.knot * KEYFRAME + j);
            column.iter_mut().zip(&pulled).for_each(|(entry, value)| *entry += value);
        }
    }
}

/// The unknowns of a free knot.
pub(super) fn block(knot: usize) -> Range<usize> {
    knot * KEYFRAME..(knot + 1) * KEYFRAME
}

/// A lower triangular L with L L^T = A, for A positive semidefinite: a pivot that vanishes, as
/// along the ray of a point that one camera sees, gives a zero column.
pub(super) fn root_of(a: &Matrix3<f64>) -> Matrix3<f64> {
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

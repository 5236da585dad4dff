//! Memory of a problem, and what is known of the decoder at its moments.

use nalgebra::Vector3;

use crate::body::{BODY_JOINTS, Tangents};
use crate::manifold::{Decoder, Jacobians, LATENT, Latent};

/// Rows of the derivatives of the local rotations.
pub(super) const LOCAL_ROWS: usize = 3 * BODY_JOINTS;

/// Memory that problems use in turn; grows to the largest and stays.
#[derive(Clone, Debug, Default)]
pub struct Workspace {
    /// What is decoded: the code of each moment.
    codes: Vec<Latent>,
    pub(super) jacobians: Jacobians,
    /// The codes at which the decoder was linearised last.
    linearised_at: Vec<Latent>,
    /// Moments whose Jacobian is to be renewed, and whether it is that of the moment before.
    moved: Vec<(usize, bool)>,
    /// Right tangents of the local rotations by the code there, 63 x 32 for each moment.
    pub(super) by_code: Vec<f64>,
    pub(super) tangents: Option<Tangents>,
    /// The points' offsets in their joints' frames, for the present shape.
    pub(super) offsets: Vec<Vector3<f64>>,
    /// Weighted rows of the moment, (3 per point) x (coordinates of the moment).
    pub(super) rows: Vec<f64>,
    /// Hessian by the coordinates of the moment.
    pub(super) gram: Vec<f64>,
    /// Half of a change of coordinates.
    pub(super) half: Vec<f64>,
    /// Gradient by the local rotations (right tangents), 63 for each moment.
    pub(super) by_rotation: Vec<f64>,
    /// The same by the codes, 32 for each moment.
    pub(super) code_gradients: Vec<f64>,
    /// Gradient by each moment's coordinates. That by the code is filled in last.
    pub(super) gradients: Vec<f64>,
    pub(super) counts: Counts,
}

/// What was done, to count the arithmetic.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Counts {
    /// Codes decoded.
    pub decoded: usize,
    /// Codes at which the decoder was linearised.
    pub linearised: usize,
    /// Gradients carried back through the decoder.
    pub gradients: usize,
    /// Moments of which rows were made for a Hessian.
    pub moments: usize,
}

impl Counts {
    /// What was done after `before`.
    pub fn since(self, before: Self) -> Self {
        Self {
            decoded: self.decoded - before.decoded,
            linearised: self.linearised - before.linearised,
            gradients: self.gradients - before.gradients,
            moments: self.moments - before.moments,
        }
    }
}

impl Workspace {
    /// What was done since it was made.
    pub fn counts(&self) -> Counts {
        self.counts
    }

    /// Another problem begins.
    pub(super) fn forget(&mut self) {
        self.codes.clear();
        self.linearised_at.clear();
    }

    /// Decodes the codes of all moments at once, unless they are those decoded last.
    pub(super) fn decode(
        &mut self,
        decoder: &Decoder,
        codes: impl ExactSizeIterator<Item = Latent>,
    ) {
        let mut is_known = self.codes.len() == codes.len();
        self.codes.resize(codes.len(), [0.0; LATENT]);
        for (known, code) in self.codes.iter_mut().zip(codes) {
            is_known &= *known == code;
            *known = code;
        }
        if !is_known {
            self.counts.decoded += self.codes.len();
            decoder.values(&self.codes, &mut self.jacobians);
        }
    }

    /// Makes sure of a Jacobian of the decoder at the code of each moment: that which it had, or the
    /// one of the moment before, or a new one.
    pub(super) fn linearise(&mut self, decoder: &Decoder) {
        const SIZE: usize = LOCAL_ROWS * LATENT;
        let Self { codes, linearised_at, jacobians, by_code, moved, counts, .. } = self;
        by_code.resize(codes.len() * SIZE, 0.0);
        linearised_at.resize(codes.len(), [f64::INFINITY; LATENT]);
        moved.clear();
        for (m, code) in codes.iter().enumerate() {
            if linearised_at[m] != *code {
                let shared = linearised_at[..m].last().copied().filter(|at| at == code);
                linearised_at[m] = shared.unwrap_or(*code);
                moved.push((m, shared.is_some()));
            }
        }
        let new = moved.iter().filter(|(_, is_shared)| !is_shared).map(|&(m, _)| m);
        decoder.tangents_of(new, jacobians);
        for &(m, is_shared) in &*moved {
            match is_shared {
                true => by_code.copy_within((m - 1) * SIZE..m * SIZE, m * SIZE),
                false => {
                    counts.linearised += 1;
                    jacobians.local_tangents(m, &mut by_code[m * SIZE..(m + 1) * SIZE]);
                }
            }
        }
    }

    /// The gradient by the codes from that by the local rotations.
    pub(super) fn pull_back(&mut self, decoder: &Decoder) {
        self.counts.gradients += self.codes.len();
        decoder.pull_back(&self.by_rotation, &mut self.jacobians, &mut self.code_gradients);
    }
}

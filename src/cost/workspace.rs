//! Memory of a problem, and what is known of the decoder at its moments.

use nalgebra::{Matrix3, Vector3};

use crate::body::{BODY_JOINTS, Tangents};
use crate::manifold::{Decoder, Jacobians, LATENT, Latent};
use crate::so3;

/// Rows of the derivatives of the local rotations.
pub(super) const LOCAL_ROWS: usize = 3 * BODY_JOINTS;

/// Memory that problems use in turn; grows to the largest and stays.
#[derive(Clone, Debug, Default)]
pub struct Workspace {
    /// What is decoded: the code of each moment.
    codes: Vec<Latent>,
    pub(super) jacobians: Jacobians,
    /// Where each moment's Jacobian is taken.
    linearised: Vec<Option<Linearised>>,
    /// Where each will come from, and how far it will have been carried.
    plan: Vec<(Source, f64)>,
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

/// Numbers of a moment's Jacobian of the decoder.
const SIZE: usize = LOCAL_ROWS * LATENT;

/// How often a Jacobian is carried on at its moment: so steps that come to little are soon exact again.
const OLDEST: usize = 2;

/// A step shorter than this leaves a Jacobian as it is: rotations of six digits tell no more of it.
const SHORTEST: f64 = 1e-2;

/// Where a Jacobian of the decoder is taken.
#[derive(Clone, Debug)]
struct Linearised {
    code: Latent,
    rotations: [Matrix3<f64>; BODY_JOINTS],
    /// How far it was carried since the decoder gave it.
    carried: f64,
    /// How often it was carried on at its moment.
    age: usize,
}

/// Where a moment's Jacobian comes from.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Source {
    /// The one that the moment has.
    Own,
    /// That of the moment before.
    Before,
    Decoder,
}

fn distance(a: &Latent, b: &Latent) -> f64 {
    a.iter().zip(b).map(|(a, b)| (a - b) * (a - b)).sum::<f64>().sqrt()
}

/// Carries a Jacobian along a step to other rotations: the least change that has it tell how they
/// turned \[Broyden 1965\].
fn secant(
    step: &Latent,
    from: &[Matrix3<f64>; BODY_JOINTS],
    to: &[Matrix3<f64>; BODY_JOINTS],
    by_code: &mut [f64],
) {
    let square: f64 = step.iter().map(|s| s * s).sum();
    for ((from, to), rows) in from.iter().zip(to).zip(by_code.chunks_exact_mut(3 * LATENT)) {
        let turned = so3::log(&(from.transpose() * to));
        for (turned, row) in turned.iter().zip(rows.chunks_exact_mut(LATENT)) {
            let told: f64 = row.iter().zip(step).map(|(j, s)| j * s).sum();
            let missing = (turned - told) / square;
            row.iter_mut().zip(step).for_each(|(j, s)| *j += missing * s);
        }
    }
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
        self.linearised.clear();
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

    /// Makes sure of the decoder's Jacobian at the code of each moment: the one that the moment has, or
    /// that of the moment before, carried there by a secant, or a new one where both come from codes
    /// further than `reach` along the way, or were carried often.
    pub(super) fn linearise(&mut self, decoder: &Decoder, reach: f64) {
        let Self { codes, linearised, plan, jacobians, by_code, counts, .. } = self;
        by_code.resize(codes.len() * SIZE, 0.0);
        linearised.resize_with(codes.len(), || None);
        plan.clear();
        for (m, code) in codes.iter().enumerate() {
            let own = linearised[m].as_ref().filter(|at| at.age < OLDEST);
            let own = own.map(|at| at.carried + distance(&at.code, code));
            let before = m.checked_sub(1).map(|n| plan[n].1 + distance(&codes[n], code));
            let sources = [(Source::Own, own), (Source::Before, before)];
            let mut near = sources.into_iter().filter_map(|(source, far)| Some((source, far?)));
            plan.push(near.find(|(_, far)| *far <= reach).unwrap_or((Source::Decoder, 0.0)));
        }
        let new = plan.iter().enumerate().filter(|(_, (source, _))| *source == Source::Decoder);
        decoder.tangents_of(new.map(|(m, _)| m), jacobians);
        for (m, &(source, carried)) in plan.iter().enumerate() {
            let rows = m * SIZE..(m + 1) * SIZE;
            let from = match source {
                Source::Own => linearised[m].take().map(|at| Linearised { age: at.age + 1, ..at }),
                Source::Before => {
                    by_code.copy_within((m - 1) * SIZE..m * SIZE, m * SIZE);
                    linearised[m - 1].clone()
                }
                Source::Decoder => {
                    counts.linearised += 1;
                    jacobians.local_tangents(m, &mut by_code[rows.clone()]);
                    None
                }
            };
            let (code, rotations) = (codes[m], jacobians.rotations(m));
            if let Some(from) = &from {
                if distance(&from.code, &code) < SHORTEST {
                    linearised[m] = Some(from.clone());
                    continue;
                }
                let step: Latent = std::array::from_fn(|i| code[i] - from.code[i]);
                secant(&step, &from.rotations, &rotations, &mut by_code[rows]);
            }
            let age = from.map_or(0, |from| from.age);
            linearised[m] = Some(Linearised { code, rotations, carried, age });
        }
    }

    /// The gradient by the codes from that by the local rotations.
    pub(super) fn pull_back(&mut self, decoder: &Decoder) {
        self.counts.gradients += self.codes.len();
        decoder.pull_back(&self.by_rotation, &mut self.jacobians, &mut self.code_gradients);
    }
}

//! Memory for consecutive frames of a path, with the decoder's Jacobians at their codes.

use nalgebra::{Matrix3, Vector3};

use super::counts::Counts;
use crate::core::body::{BODY_JOINTS, Tangents};
use crate::core::linalg;
use crate::core::manifold::{Decoder, Jacobians, LATENT, Latent};
use crate::core::so3;

/// Rows of the derivatives of the local rotations.
pub(super) const LOCAL_ROWS: usize = 3 * BODY_JOINTS;

/// Size of a frame's decoder Jacobian.
const SIZE: usize = LOCAL_ROWS * LATENT;

/// A Jacobian is carried from one iteration to the next at most this often, so that it becomes
/// exact after a few small steps.
const OLDEST: usize = 2;

/// A shorter step leaves a Jacobian as it is: an update cannot improve six digits of rotation.
const SHORTEST: f64 = 1e-2;

/// Consecutive frames. A batch needs nothing from other batches.
#[derive(Clone, Debug, Default)]
pub(super) struct ObservationBatch {
    /// The code of each frame, as decoded.
    codes: Vec<Latent>,
    jacobians: Jacobians,
    /// The code at which each frame's Jacobian is taken.
    linearised: Vec<Option<Linearised>>,
    /// The source of each Jacobian, and the length of its way after this update.
    plan: Vec<(Source, f64)>,
    /// Right tangents of the local rotations by the code there, 63 x 32 for each frame.
    by_code: Vec<f32>,
    pub(super) tangents: Option<Tangents>,
    /// Weighted rows of the present frame, (3 per point) x (coordinates of the frame).
    pub(super) rows: Vec<f32>,
    /// Gradient by the local rotations (right tangents), 63 for each frame.
    pub(super) by_rotation: Vec<f64>,
    /// Gradient by the codes, 32 for each frame.
    code_gradients: Vec<f64>,
    /// The cost of each frame.
    pub(super) costs: Vec<f64>,
    /// Gradient by each frame's coordinates.
    pub(super) gradients: Vec<f64>,
    /// Hessian by each frame's coordinates.
    pub(super) grams: Vec<f32>,
    /// The counts since the batch was made.
    pub(super) counts: Counts,
}

/// A code at which a Jacobian of the decoder is taken.
#[derive(Clone, Debug)]
struct Linearised {
    code: Latent,
    rotations: [Matrix3<f64>; BODY_JOINTS],
    /// Length of its way since the decoder computed it.
    carried: f64,
    /// Number of times it was carried to the next iteration of its frame.
    age: usize,
}

/// The source of a frame's Jacobian.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Source {
    /// The frame's own, from the iteration before.
    Own,
    /// That of the frame before.
    Before,
    Decoder,
}

impl ObservationBatch {
    /// Starts another problem.
    pub(super) fn forget(&mut self) {
        self.codes.clear();
        self.linearised.clear();
    }

    /// Decodes the codes of all frames at once, unless they are the last decoded ones.
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

    /// The local rotations of frame `m`, after decoding.
    pub(super) fn rotations(&self, m: usize) -> [Matrix3<f64>; BODY_JOINTS] {
        self.jacobians.rotations(m)
    }

    /// Provides the decoder's Jacobian at the code of each frame: the frame's own or that of the
    /// frame before, updated by a secant. Computes a new one if both were carried further than
    /// `radius` (length of the way) or too often.
    pub(super) fn linearise(&mut self, decoder: &Decoder, radius: f64) {
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
            plan.push(near.find(|(_, far)| *far <= radius).unwrap_or((Source::Decoder, 0.0)));
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
            let age = from.as_ref().map_or(0, |from| from.age);
            linearised[m] = match from {
                Some(from) if distance(&from.code, &code) < SHORTEST => Some(from),
                from => {
                    if let Some(from) = from {
                        let step: Latent = std::array::from_fn(|i| code[i] - from.code[i]);
                        secant(&step, &from.rotations, &rotations, &mut by_code[rows]);
                    }
                    Some(Linearised { code, rotations, carried, age })
                }
            };
        }
    }

    /// Right tangents of the local rotations of frame `m` by its code, after linearising: 63 x 32.
    pub(super) fn by_code(&self, m: usize) -> &[f32] {
        &self.by_code[m * SIZE..(m + 1) * SIZE]
    }

    /// Completes the gradients, `coordinates` numbers for each frame: computes the part by the code
    /// from the gradient by the local rotations.
    pub(super) fn pull_back(&mut self, decoder: &Decoder, coordinates: usize) {
        self.counts.gradients += self.codes.len();
        decoder.pull_back(&self.by_rotation, &mut self.jacobians, &mut self.code_gradients);
        let gradients = self.gradients.chunks_exact_mut(coordinates);
        for (gradient, by_code) in gradients.zip(self.code_gradients.chunks_exact(LATENT)) {
            gradient[..LATENT].copy_from_slice(by_code);
        }
    }
}

fn distance(a: &Latent, b: &Latent) -> f64 {
    a.iter().zip(b).map(|(a, b)| (a - b) * (a - b)).sum::<f64>().sqrt()
}

/// Broyden's update of a Jacobian: the smallest change that makes it predict the measured rotations
/// of the step \[Broyden 1965\].
fn secant(
    step: &Latent,
    from: &[Matrix3<f64>; BODY_JOINTS],
    to: &[Matrix3<f64>; BODY_JOINTS],
    by_code: &mut [f32],
) {
    let step = step.map(|s| s as f32);
    for ((from, to), rows) in from.iter().zip(to).zip(by_code.chunks_exact_mut(3 * LATENT)) {
        let turned = so3::log(&(from.transpose() * to));
        broyden_update(&step, &turned.cast(), rows);
    }
}

linalg::wide! {
    /// Changes three rows so that row . step is the rotation of a joint.
    fn broyden_update(step: &[f32; LATENT], turned: &Vector3<f32>, rows: &mut [f32]) {
        let square: f32 = step.iter().map(|s| s * s).sum();
        for (turned, row) in turned.iter().zip(rows.chunks_exact_mut(LATENT)) {
            // Eight running sums, so that the additions are independent.
            let mut predicted = [0.0; 8];
            for (row, step) in row.chunks_exact(8).zip(step.chunks_exact(8)) {
                (0..8).for_each(|k| predicted[k] += row[k] * step[k]);
            }
            let missing = (turned - predicted.iter().sum::<f32>()) / square;
            row.iter_mut().zip(step).for_each(|(j, s)| *j += missing * s);
        }
    }
}

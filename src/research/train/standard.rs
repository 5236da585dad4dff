//! Standardises codes after training: z' = T (z - m).
//!
//! The KL divergence brings the codes only near to N(0, I), the solver's prior. In the new
//! coordinates each latent dimension has mean 0 and about unit variance over the clips, and half of
//! the correlations are removed.

use nalgebra::{SMatrix, SVector};

use super::corpus::{Clip, mirrored};
use super::evaluate::encode;
use super::model::Model;
use crate::core::manifold::LATENT;

/// Factor on the correlations before whitening; few clips of few people estimate them poorly.
const CORRELATION: f64 = 0.5;
/// Smallest variance; keeps T finite where clips hardly move.
const LEAST: f64 = 1e-4;

type Vector = SVector<f64, LATENT>;
type Matrix = SMatrix<f64, LATENT, LATENT>;

/// New coordinates z' = T (z - m), with T symmetric.
pub struct Standard {
    /// m, the mean code.
    pub mean: Vector,
    /// T.
    pub to_new: Matrix,
    /// The inverse of T.
    pub to_old: Matrix,
}

impl Standard {
    /// Standardises the codes of all poses of the clips and of their mirror images. Unused latent
    /// dimensions stay.
    pub fn of(model: &Model, clips: &[Clip]) -> Self {
        let (mut count, mut sum, mut squares) = (0.0, Vector::zeros(), Matrix::zeros());
        for clip in clips {
            let others: Vec<_> = clip.poses.iter().map(mirrored).collect();
            for code in [&clip.poses, &others].into_iter().flat_map(|poses| encode(model, poses)) {
                let code = Vector::from_fn(|i, _| code[i].into());
                count += 1.0;
                sum += code;
                squares.syger(1.0, &code, &code, 1.0);
            }
        }
        let (mean, squares) = (sum / f64::max(count, 1.0), squares / f64::max(count, 1.0));
        let used = model.latent();
        let covariance = Matrix::from_fn(|i, j| match (i.max(j), i.min(j)) {
            (i, j) if i >= used => f64::from(u8::from(i == j)),
            (i, j) => {
                let part = if i == j { 1.0 } else { CORRELATION };
                part * (squares[(i, j)] - mean[i] * mean[j])
            }
        });
        let eigen = covariance.symmetric_eigen();
        let power = |exponent: f64| {
            let scales = eigen.eigenvalues.map(|variance| variance.max(LEAST).powf(exponent));
            let scale = Matrix::from_diagonal(&scales);
            let power = eigen.eigenvectors * scale * eigen.eigenvectors.transpose();
            Matrix::from_fn(|i, j| match i.max(j) < used {
                true => power[(i, j)],
                false => f64::from(u8::from(i == j)),
            })
        };
        Self { mean, to_new: power(-0.5), to_old: power(0.5) }
    }
}

impl Model {
    /// Changes the coordinates of codes: folds z' = T (z - m) into the encoder's last layer and its
    /// inverse into the decoder's first layer. Log variances change by the diagonal of T only.
    pub fn recode(&mut self, Standard { mean, to_new, to_old }: &Standard) {
        if let Some(last) = self.encoder.layers().last() {
            for column in 0..last.inputs {
                let at = |row: usize| last.weight.start + row * last.inputs + column;
                let new = to_new * Vector::from_fn(|row, _| self.parameters[at(row)].into());
                (0..LATENT).for_each(|row| self.parameters[at(row)] = new[row] as f32);
            }
            let (means, log_variances) = self.parameters[last.bias.clone()].split_at_mut(LATENT);
            let new = to_new * (Vector::from_fn(|row, _| means[row].into()) - mean);
            for (row, (bias, log_variance)) in means.iter_mut().zip(log_variances).enumerate() {
                *bias = new[row] as f32;
                *log_variance += 2.0 * to_new[(row, row)].ln() as f32;
            }
        }
        if let Some(first) = self.decoder.layers().first() {
            for (row, bias) in first.weight.clone().step_by(LATENT).zip(first.bias.clone()) {
                let row = row..row + LATENT;
                let old = Vector::from_fn(|i, _| self.parameters[row.start + i].into());
                self.parameters[bias] += old.dot(mean) as f32;
                let new = to_old * old;
                let weights = self.parameters[row].iter_mut().zip(&new);
                weights.for_each(|(weight, new)| *weight = *new as f32);
            }
        }
    }
}

//! The decoder G from a latent code to 21 local rotations, with its Jacobian.
//!
//! Linear layers with SiLU between them give 6 numbers a joint, the first two columns a, b of a
//! rotation before orthonormalisation \[Zhou 2019\]:
//! c1 = a / |a|, c2 = (b - (c1 . b) c1) / |...|, c3 = c1 x c2.
//!
//! Values are computed in f64, so that a cost is smooth to its last digits; Jacobians in f32,
//! where six digits are plenty.

use std::sync::Arc;

use nalgebra::{Matrix3, Vector3};

use super::weights::{Layer, OUTPUTS, WeightsError, decoder_layers};
use super::{Keyframe, LATENT, Latent};
use crate::body::{BODY_JOINTS, Pose};
use crate::gemm;

/// Shorter columns than this are no direction: the joint keeps its rest rotation.
const MIN_COLUMN: f64 = 1e-9;

/// The weights file that ships with the program, encoder and decoder.
pub const EMBEDDED: &[u8] = include_bytes!("weights.safetensors");

/// The decoder. Cheap to clone.
#[derive(Clone, Debug)]
pub struct Decoder {
    layers: Arc<[Layer]>,
    /// Each layer's weight transposed, [in, out], f64.
    wide: Arc<[Vec<f64>]>,
    fingerprint: u64,
}

/// Memory for a batch of codes: values, then Jacobians. Grows to the largest batch and stays.
#[derive(Clone, Debug, Default)]
pub struct Jacobians {
    /// Activations after each layer, batch x outputs.
    values: Vec<Vec<f64>>,
    /// SiLU' at each hidden unit, batch x outputs.
    slopes: Vec<Vec<f32>>,
    /// Tangents after the layer just done, outputs x (batch * LATENT).
    tangents: Vec<f32>,
    next_tangents: Vec<f32>,
    batch: usize,
}

impl Decoder {
    /// Reads a weights file.
    pub fn from_bytes(bytes: &[u8]) -> Result<Self, WeightsError> {
        let layers = decoder_layers(bytes)?;
        let wide = layers.iter().map(transposed).collect();
        Ok(Self { layers: layers.into(), wide, fingerprint: fnv1a(bytes) })
    }

    /// The decoder that ships with the program; see `src/manifold/MODEL_CARD.md`.
    pub fn embedded() -> Result<Self, WeightsError> {
        Self::from_bytes(EMBEDDED)
    }

    /// A hash of the weights file, to tell files apart (not cryptographic).
    pub fn fingerprint(&self) -> u64 {
        self.fingerprint
    }

    /// The 21 rotations `parent_from_joint` of one code.
    pub fn decode(&self, z: &Latent) -> [Matrix3<f64>; BODY_JOINTS] {
        let mut work = Jacobians::default();
        self.values(std::slice::from_ref(z), &mut work);
        work.rotations(0)
    }

    /// The pose of a keyframe.
    pub fn pose(&self, keyframe: &Keyframe) -> Pose {
        Pose {
            root_rotation: keyframe.root_rotation,
            root_position: keyframe.root_position,
            local: self.decode(&keyframe.z),
        }
    }

    /// Runs a batch of codes; read the results with [`Jacobians::rotations`].
    pub fn values(&self, codes: &[Latent], work: &mut Jacobians) {
        let batch = codes.len();
        work.reserve(&self.layers, batch);
        for (n, layer) in self.layers.iter().enumerate() {
            let (before, here) = work.values.split_at_mut(n);
            let input = before.last().map_or_else(|| codes.as_flattened(), |v| &v[..]);
            let output = &mut here[0][..batch * layer.outputs];
            for row in output.chunks_exact_mut(layer.outputs) {
                row.iter_mut().zip(&layer.bias).for_each(|(o, &b)| *o = f64::from(b));
            }
            let sizes = [batch, layer.inputs, layer.outputs];
            gemm::product(sizes, input, &self.wide[n], gemm::Accum::Add, output);
            if n + 1 < self.layers.len() {
                silu(output, &mut work.slopes[n][..batch * layer.outputs]);
            }
        }
    }

    /// The derivatives of the codes last given to [`Decoder::values`]; read them with
    /// [`Jacobians::local_tangents`].
    pub fn tangents(&self, work: &mut Jacobians) {
        let columns = work.batch * LATENT;
        if columns == 0 {
            return;
        }
        for (n, layer) in self.layers.iter().enumerate() {
            let out = &mut work.next_tangents[..layer.outputs * columns];
            if n == 0 {
                for (row, weights) in
                    out.chunks_exact_mut(columns).zip(layer.weight.chunks_exact(LATENT))
                {
                    row.chunks_exact_mut(LATENT).for_each(|block| block.copy_from_slice(weights));
                }
            } else {
                let sizes = [layer.outputs, layer.inputs, columns];
                gemm::product(sizes, &layer.weight, &work.tangents, gemm::Accum::Replace, out);
            }
            if n + 1 < self.layers.len() {
                for (unit, row) in out.chunks_exact_mut(columns).enumerate() {
                    for (frame, block) in row.chunks_exact_mut(LATENT).enumerate() {
                        let slope = work.slopes[n][frame * layer.outputs + unit];
                        block.iter_mut().for_each(|v| *v *= slope);
                    }
                }
            }
            std::mem::swap(&mut work.tangents, &mut work.next_tangents);
        }
    }
}

impl Jacobians {
    fn reserve(&mut self, layers: &[Layer], batch: usize) {
        self.batch = batch;
        self.values.resize_with(layers.len(), Vec::new);
        self.slopes.resize_with(layers.len(), Vec::new);
        for (n, layer) in layers.iter().enumerate() {
            self.values[n].resize(batch * layer.outputs, 0.0);
            self.slopes[n].resize(batch * layer.outputs, 0.0);
        }
        let widest = layers.iter().map(|l| l.outputs).max().unwrap_or(0);
        self.tangents.resize(widest * batch * LATENT, 0.0);
        self.next_tangents.resize(widest * batch * LATENT, 0.0);
    }

    fn columns_of(&self, code: usize, joint: usize) -> [Vector3<f64>; 2] {
        let output = self.values.last().map_or(&[][..], |v| v);
        let at = code * OUTPUTS + joint * 6;
        let six = &output[at..at + 6];
        [Vector3::new(six[0], six[1], six[2]), Vector3::new(six[3], six[4], six[5])]
    }

    /// The 21 rotations of the code at that place in the batch.
    pub fn rotations(&self, code: usize) -> [Matrix3<f64>; BODY_JOINTS] {
        std::array::from_fn(|joint| {
            let [a, b] = self.columns_of(code, joint);
            Frame::of(&a, &b).map_or_else(Matrix3::identity, |frame| frame.rotation())
        })
    }

    /// Right tangents of the 21 rotations by the code: writes 63 x 32, row-major.
    ///
    /// With dR = R \[d\]x: d_z = c2 . da / |a|, d_y = -c3 . da / |a|,
    /// d_x = (c3 . db - (c1 . b) (c3 . da) / |a|) / |b - (c1 . b) c1|.
    pub fn local_tangents(&self, code: usize, out: &mut [f64]) {
        let columns = self.batch * LATENT;
        for joint in 0..BODY_JOINTS {
            let rows = &mut out[joint * 3 * LATENT..(joint + 1) * 3 * LATENT];
            let [a, b] = self.columns_of(code, joint);
            let Some(frame) = Frame::of(&a, &b) else {
                rows.fill(0.0);
                continue;
            };
            let map = frame.tangent_map(&b);
            let six: [&[f32]; 6] = std::array::from_fn(|k| {
                let at = (joint * 6 + k) * columns + code * LATENT;
                &self.tangents[at..at + LATENT]
            });
            for (row, factors) in rows.chunks_exact_mut(LATENT).zip(&map) {
                for (c, value) in row.iter_mut().enumerate() {
                    *value = (0..6).map(|k| factors[k] * f64::from(six[k][c])).sum();
                }
            }
        }
    }
}

/// The orthonormal columns, and the lengths they were divided by.
struct Frame {
    columns: [Vector3<f64>; 3],
    length_a: f64,
    length_b: f64,
}

impl Frame {
    fn of(a: &Vector3<f64>, b: &Vector3<f64>) -> Option<Self> {
        let length_a = a.norm();
        let c1 = a / length_a;
        let across = b - c1 * c1.dot(b);
        let length_b = across.norm();
        (length_a > MIN_COLUMN && length_b > MIN_COLUMN).then(|| {
            let c2 = across / length_b;
            Self { columns: [c1, c2, c1.cross(&c2)], length_a, length_b }
        })
    }

    fn rotation(&self) -> Matrix3<f64> {
        Matrix3::from_columns(&self.columns)
    }

    /// The 3x6 map from (da, db) to the right tangent.
    fn tangent_map(&self, b: &Vector3<f64>) -> [[f64; 6]; 3] {
        let [c1, c2, c3] = self.columns;
        let along = -c1.dot(b) / (self.length_a * self.length_b);
        let (x_a, x_b) = (c3 * along, c3 / self.length_b);
        let (y, z) = (c3 / -self.length_a, c2 / self.length_a);
        [
            [x_a.x, x_a.y, x_a.z, x_b.x, x_b.y, x_b.z],
            [y.x, y.y, y.z, 0.0, 0.0, 0.0],
            [z.x, z.y, z.z, 0.0, 0.0, 0.0],
        ]
    }
}

pub(super) fn transposed(layer: &Layer) -> Vec<f64> {
    let column = |input| layer.weight.iter().skip(input).step_by(layer.inputs);
    (0..layer.inputs).flat_map(column).map(|&w| f64::from(w)).collect()
}

/// x -> x / (1 + exp(-x)) in place, with its derivative.
pub(super) fn silu(values: &mut [f64], slopes: &mut [f32]) {
    for (value, slope) in values.iter_mut().zip(slopes) {
        let gate = 1.0 / (1.0 + (-*value).exp());
        *slope = (gate * (1.0 + *value * (1.0 - gate))) as f32;
        *value *= gate;
    }
}

/// 64-bit FNV-1a.
pub(super) fn fnv1a(bytes: &[u8]) -> u64 {
    bytes.iter().fold(0xcbf2_9ce4_8422_2325, |hash, &byte| {
        (hash ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3)
    })
}

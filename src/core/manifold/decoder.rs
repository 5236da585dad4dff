//! The decoder G from a latent code to 21 local rotations, with its Jacobian.
//!
//! Linear layers with SiLU between them give 6 numbers a joint, the first two columns a, b of a
//! rotation before orthonormalisation \[Zhou 2019\]:
//! c1 = a / |a|, c2 = (b - (c1 . b) c1) / |...|, c3 = c1 x c2.
//!
//! The layers are computed in f32: six digits are a micrometre of a body, and take half of the time.

use std::f64::consts::TAU;
use std::sync::{Arc, OnceLock};

use nalgebra::{Matrix3, Vector3};

use super::weights::{Layer, OUTPUTS, WeightsError, decoder_layers};
use super::{Correction, Keyframe, LATENT, Latent, activation};
use crate::core::body::{BODY_JOINTS, Pose};
use crate::core::fnv::fnv1a;
use crate::core::linalg;
use crate::core::random::Draws;

/// Shorter columns than this are no direction: the joint keeps its rest rotation.
const MIN_COLUMN: f64 = 1e-9;

/// Number of samples of the prior.
const SAMPLES: u64 = 512;
/// Poses that are decoded together.
const BATCH: usize = 8;

/// The weights file that ships with the program, encoder and decoder.
pub const EMBEDDED: &[u8] = include_bytes!("weights.safetensors");

/// The decoder. Cheap to clone.
#[derive(Clone, Debug)]
pub struct Decoder {
    layers: Arc<[Layer]>,
    /// Each layer's weight as [in, out].
    transposed: Arc<[Vec<f32>]>,
    fingerprint: u64,
    samples: Arc<OnceLock<Vec<(Latent, Pose)>>>,
}

/// Memory for a batch of codes: values, then Jacobians. Grows to the largest batch and stays.
#[derive(Clone, Debug, Default)]
pub struct Jacobians {
    /// The codes.
    codes: Vec<f32>,
    /// Activations after each layer, batch x outputs.
    values: Vec<Vec<f32>>,
    /// SiLU' at each hidden unit, batch x outputs.
    slopes: Vec<Vec<f32>>,
    /// Tangents after the layer just done, outputs x (codes * LATENT); or a gradient on its way back.
    tangents: Vec<f32>,
    next_tangents: Vec<f32>,
    batch: usize,
    /// Which codes of the batch the tangents are of.
    linearised: Vec<usize>,
}

impl Decoder {
    /// Reads a weights file.
    pub fn from_bytes(bytes: &[u8]) -> Result<Self, WeightsError> {
        let layers = decoder_layers(bytes)?;
        Ok(Self {
            transposed: layers.iter().map(Layer::transposed).collect(),
            layers: layers.into(),
            fingerprint: fnv1a(bytes),
            samples: Arc::default(),
        })
    }

    /// The decoder that ships with the program; see `src/core/manifold/MODEL_CARD.md`.
    pub fn embedded() -> Result<Self, WeightsError> {
        Self::from_bytes(EMBEDDED)
    }

    /// A hash of the weights file, to tell files apart (not cryptographic).
    pub fn fingerprint(&self) -> u64 {
        self.fingerprint
    }

    /// 512 samples of the prior on codes, with their poses. They are always the same. The root is at the
    /// origin and not rotated.
    pub fn samples(&self) -> &[(Latent, Pose)] {
        self.samples.get_or_init(|| {
            let keyframe = |n| Keyframe {
                z: sample(n),
                root_rotation: Matrix3::identity(),
                root_position: Vector3::zeros(),
                correction: Correction::default(),
            };
            let keyframes: Vec<Keyframe> = (0..SAMPLES).map(keyframe).collect();
            let codes = keyframes.iter().map(|keyframe| keyframe.z);
            codes.zip(self.poses(&keyframes)).collect()
        })
    }

    /// The pose of a keyframe.
    pub fn pose(&self, keyframe: &Keyframe) -> Pose {
        self.poses(std::slice::from_ref(keyframe)).swap_remove(0)
    }

    /// The poses of keyframes. They do not depend on what else is decoded with them: there is one size of
    /// batch, the last one filled up.
    pub fn poses(&self, keyframes: &[Keyframe]) -> Vec<Pose> {
        let mut work = Jacobians::default();
        let mut poses = Vec::with_capacity(keyframes.len());
        for keyframes in keyframes.chunks(BATCH) {
            let mut codes = [[0.0; LATENT]; BATCH];
            codes.iter_mut().zip(keyframes).for_each(|(code, keyframe)| *code = keyframe.z);
            self.values(&codes, &mut work);
            poses.extend(keyframes.iter().enumerate().map(|(n, keyframe)| {
                let mut local = work.rotations(n);
                keyframe.correction.apply(&mut local);
                let Keyframe { root_rotation, root_position, .. } = *keyframe;
                Pose { root_rotation, root_position, local }
            }));
        }
        poses
    }

    /// Runs a batch of codes; read the results with [`Jacobians::rotations`].
    pub fn values(&self, codes: &[Latent], work: &mut Jacobians) {
        let batch = codes.len();
        work.reserve(&self.layers, batch);
        work.codes.clear();
        work.codes.extend(codes.as_flattened().iter().map(|&z| z as f32));
        for (n, layer) in self.layers.iter().enumerate() {
            let (before, here) = work.values.split_at_mut(n);
            let input = before.last().unwrap_or(&work.codes);
            let output = &mut here[0][..batch * layer.outputs];
            for row in output.chunks_exact_mut(layer.outputs) {
                row.copy_from_slice(&layer.bias);
            }
            let sizes = [batch, layer.inputs, layer.outputs];
            linalg::product(sizes, input, &self.transposed[n], linalg::Accum::Add, output);
            if n + 1 < self.layers.len() {
                activation::silu(output, &mut work.slopes[n][..batch * layer.outputs]);
            }
        }
    }

    /// The derivatives of all codes last given to [`Decoder::values`]; read them with
    /// [`Jacobians::local_tangents`].
    pub fn tangents(&self, work: &mut Jacobians) {
        self.tangents_of(0..work.batch, work);
    }

    /// The same for some of the codes, by their places in the batch.
    pub fn tangents_of(&self, codes: impl IntoIterator<Item = usize>, work: &mut Jacobians) {
        work.linearised.clear();
        work.linearised.extend(codes);
        let columns = work.linearised.len() * LATENT;
        if columns == 0 {
            return;
        }
        work.reserve_tangents(&self.layers, columns);
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
                linalg::product(sizes, &layer.weight, &work.tangents, linalg::Accum::Replace, out);
            }
            if n + 1 < self.layers.len() {
                scale_blocks(out, &work.linearised, &work.slopes[n], layer.outputs);
            }
            std::mem::swap(&mut work.tangents, &mut work.next_tangents);
        }
    }

    /// The gradient of a cost by the codes last given to [`Decoder::values`], batch x 32, from that
    /// by their local rotations (right tangents), batch x 63: a pass back through the layers.
    pub fn pull_back(&self, by_rotation: &[f64], work: &mut Jacobians, by_code: &mut Vec<f64>) {
        let batch = work.batch;
        by_code.clear();
        if batch == 0 {
            return;
        }
        work.reserve_tangents(&self.layers, batch);
        for (code, by_rotation) in by_rotation.chunks_exact(3 * BODY_JOINTS).enumerate() {
            for (joint, by_rotation) in by_rotation.chunks_exact(3).enumerate() {
                let [a, b] = columns_of(work.outputs(code), joint);
                let map = Frame::of(&a, &b).map(|frame| frame.tangent_map(&b));
                let at = code * OUTPUTS + joint * 6;
                for (k, out) in work.tangents[at..at + 6].iter_mut().enumerate() {
                    let pulled = |map: [[f64; 6]; 3]| {
                        map.iter().zip(by_rotation).map(|(row, g)| row[k] * g).sum::<f64>() as f32
                    };
                    *out = map.map_or(0.0, pulled);
                }
            }
        }
        for (n, layer) in self.layers.iter().enumerate().rev() {
            let sizes = [batch, layer.outputs, layer.inputs];
            let out = &mut work.next_tangents[..batch * layer.inputs];
            linalg::product(sizes, &work.tangents, &layer.weight, linalg::Accum::Replace, out);
            if n > 0 {
                out.iter_mut().zip(&work.slopes[n - 1]).for_each(|(g, slope)| *g *= slope);
            }
            std::mem::swap(&mut work.tangents, &mut work.next_tangents);
        }
        by_code.extend(work.tangents[..batch * LATENT].iter().map(|&g| f64::from(g)));
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
    }

    /// Makes room for a pass of so many columns.
    fn reserve_tangents(&mut self, layers: &[Layer], columns: usize) {
        let widest = layers.iter().map(|l| l.outputs).max().unwrap_or(0);
        let size = (widest * columns).max(self.tangents.len());
        self.tangents.resize(size, 0.0);
        self.next_tangents.resize(size, 0.0);
    }

    /// What the last layer gave for the code at that place in the batch.
    fn outputs(&self, code: usize) -> &[f32] {
        let outputs = self.values.last().map_or(&[][..], |values| values);
        &outputs[code * OUTPUTS..(code + 1) * OUTPUTS]
    }

    /// The 21 rotations of the code at that place in the batch.
    pub fn rotations(&self, code: usize) -> [Matrix3<f64>; BODY_JOINTS] {
        let outputs = self.outputs(code);
        std::array::from_fn(|joint| {
            let [a, b] = columns_of(outputs, joint);
            Frame::of(&a, &b).map_or_else(Matrix3::identity, |frame| frame.rotation())
        })
    }

    /// Right tangents of the 21 rotations by the code at that place in the batch, one of those given
    /// to [`Decoder::tangents_of`]: writes 63 x 32, row-major.
    ///
    /// With dR = R \[d\]x: d_z = c2 . da / |a|, d_y = -c3 . da / |a|,
    /// d_x = (c3 . db - (c1 . b) (c3 . da) / |a|) / |b - (c1 . b) c1|.
    pub fn local_tangents(&self, code: usize, out: &mut [f32]) {
        let columns = self.linearised.len() * LATENT;
        let Some(slot) = self.linearised.iter().position(|&place| place == code) else { return };
        for (joint, rows) in out.chunks_exact_mut(3 * LATENT).enumerate() {
            let [a, b] = columns_of(self.outputs(code), joint);
            let Some(frame) = Frame::of(&a, &b) else {
                rows.fill(0.0);
                continue;
            };
            let six = &self.tangents[joint * 6 * columns..(joint + 1) * 6 * columns];
            let map = frame.tangent_map(&b).map(|row| row.map(|v| v as f32));
            map_six(&map, six, columns, slot * LATENT, rows);
        }
    }
}

/// The two columns that a joint's rotation is made of.
fn columns_of(outputs: &[f32], joint: usize) -> [Vector3<f64>; 2] {
    [6 * joint, 6 * joint + 3].map(|at| Vector3::from_fn(|i, _| outputs[at + i].into()))
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

linalg::wide! {
    /// Tangents through SiLU: a row for each unit, in it 32 for each of `codes`.
    fn scale_blocks(tangents: &mut [f32], codes: &[usize], slopes: &[f32], units: usize) {
        for (unit, row) in tangents.chunks_exact_mut(codes.len() * LATENT).enumerate() {
            for (block, code) in row.chunks_exact_mut(LATENT).zip(codes) {
                let slope = slopes[code * units + unit];
                block.iter_mut().for_each(|v| *v *= slope);
            }
        }
    }
}

linalg::wide! {
    /// out (3 x 32) = map (3 x 6) six (6 x 32), the latter from column `first` of rows of `columns`.
    fn map_six(map: &[[f32; 6]; 3], six: &[f32], columns: usize, first: usize, out: &mut [f32]) {
        out.fill(0.0);
        for (k, row) in six.chunks_exact(columns).enumerate() {
            let row = &row[first..first + LATENT];
            for (out, factors) in out.chunks_exact_mut(LATENT).zip(map) {
                out.iter_mut().zip(row).for_each(|(out, t)| *out += factors[k] * t);
            }
        }
    }
}

/// Sample `n` of the prior on codes, always the same.
fn sample(n: u64) -> Latent {
    let draws = Draws { seed: n, stream: 0 };
    std::array::from_fn(|i| {
        let uniform = |topic| draws.uniform(topic, i as u64);
        let radius = libm::sqrt(-2.0 * libm::log(1.0 - uniform(0)));
        radius * libm::cos(TAU * uniform(1))
    })
}

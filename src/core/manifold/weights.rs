//! The weights file: safetensors with our own metadata.
//!
//! `decoder.N.weight` \[out, in\] and `decoder.N.bias` \[out\], f32, N from 0: linear layers with
//! SiLU between them. Metadata `format` = `bundlemocap-manifold`, `version` = `1`. The encoder's
//! tensors may be there too; they are not read here.

use std::collections::HashMap;

use safetensors::tensor::{Dtype, SafeTensors};
use thiserror::Error;

use super::LATENT;
use crate::core::body::BODY_JOINTS;

/// Outputs of the decoder: two columns of each rotation.
pub(super) const OUTPUTS: usize = 6 * BODY_JOINTS;
const FORMAT: &str = "bundlemocap-manifold";
const VERSION: &str = "1";

/// Why a weights file cannot be used. Its text says what is wrong, with units.
#[derive(Debug, Error)]
#[non_exhaustive]
#[allow(missing_docs)]
pub enum WeightsError {
    #[error("the weights are not a safetensors file: {0}")]
    NotSafetensors(#[from] safetensors::SafeTensorError),
    #[error(
        "the weights' metadata has {key} = {found:?}, expected {expected:?}: train again with this version's `bundlemocap train`"
    )]
    Metadata { key: &'static str, found: Option<String>, expected: &'static str },
    #[error("tensor {name} is {found}, expected {expected}")]
    Shape { name: String, found: String, expected: String },
    #[error("tensor {name} holds a number that is not finite")]
    NotFinite { name: String },
}

/// A linear layer, weight \[out, in\] row-major.
#[derive(Clone, Debug)]
pub(crate) struct Layer {
    pub inputs: usize,
    pub outputs: usize,
    pub weight: Vec<f32>,
    pub bias: Vec<f32>,
}

impl Layer {
    /// The weight as [in, out], the fastest order for products with rows.
    pub fn transposed<T: From<f32>>(&self) -> Vec<T> {
        let column = |input| self.weight.iter().skip(input).step_by(self.inputs);
        (0..self.inputs).flat_map(column).map(|&w| T::from(w)).collect()
    }
}

/// Reads the decoder's layers.
pub(super) fn decoder_layers(bytes: &[u8]) -> Result<Vec<Layer>, WeightsError> {
    checked_metadata(bytes, FORMAT)?;
    layers(&SafeTensors::deserialize(bytes)?, "decoder", LATENT, OUTPUTS)
}

/// The metadata of a file, after a check of its format and version.
pub(crate) fn checked_metadata(
    bytes: &[u8],
    format: &'static str,
) -> Result<HashMap<String, String>, WeightsError> {
    let (_, header) = SafeTensors::read_metadata(bytes)?;
    let metadata = header.metadata().clone().unwrap_or_default();
    for (key, expected) in [("format", format), ("version", VERSION)] {
        let found = metadata.get(key).cloned();
        if found.as_deref() != Some(expected) {
            return Err(WeightsError::Metadata { key, found, expected });
        }
    }
    Ok(metadata)
}

/// The subjects on whose clips the weights were trained. `bytes`: of a weights file. Empty if it does not say so.
pub fn trained_on(bytes: &[u8]) -> Vec<String> {
    let subjects = checked_metadata(bytes, FORMAT).ok().and_then(|mut all| all.remove("subjects"));
    subjects.iter().flat_map(|all| all.split(',')).map(str::to_owned).collect()
}

/// The layers of the network `name`, from its first to its last width.
pub(crate) fn layers(
    tensors: &SafeTensors,
    network: &str,
    first: usize,
    last: usize,
) -> Result<Vec<Layer>, WeightsError> {
    let weight = |n: usize| format!("{network}.{n}.weight");
    let count = (0..).take_while(|&n| tensors.tensor(&weight(n)).is_ok()).count();
    let mut layers = Vec::with_capacity(count);
    let mut inputs = first;
    for n in 0..count {
        let layer = layer(tensors, network, n, inputs)?;
        inputs = layer.outputs;
        layers.push(layer);
    }
    if inputs != last || layers.is_empty() {
        return Err(WeightsError::Shape {
            name: weight(count.saturating_sub(1)),
            found: format!("of {inputs} outputs"),
            expected: format!("of {last} outputs"),
        });
    }
    Ok(layers)
}

fn layer(
    tensors: &SafeTensors,
    network: &str,
    n: usize,
    inputs: usize,
) -> Result<Layer, WeightsError> {
    let name = format!("{network}.{n}.weight");
    let view = tensors.tensor(&name)?;
    let outputs = view.shape().first().copied().unwrap_or(0);
    let weight = numbers(tensors, &name, &[outputs, inputs])?;
    let bias = numbers(tensors, &format!("{network}.{n}.bias"), &[outputs])?;
    Ok(Layer { inputs, outputs, weight, bias })
}

/// The values of a tensor of that shape.
pub(crate) fn numbers(
    tensors: &SafeTensors,
    name: &str,
    shape: &[usize],
) -> Result<Vec<f32>, WeightsError> {
    let view = tensors.tensor(name)?;
    if view.dtype() != Dtype::F32 || view.shape() != shape || shape.contains(&0) {
        return Err(WeightsError::Shape {
            name: name.to_owned(),
            found: format!("{:?} {:?}", view.dtype(), view.shape()),
            expected: format!("F32 {shape:?}"),
        });
    }
    let values: Vec<f32> =
        view.data().chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect();
    if values.iter().any(|v| !v.is_finite()) {
        return Err(WeightsError::NotFinite { name: name.to_owned() });
    }
    Ok(values)
}

//! The weights file: safetensors, f32, `encoder.N.weight` \[out, in\], `encoder.N.bias`, and the
//! same for the decoder. The metadata records how they were trained.

use std::collections::BTreeMap;
use std::ops::Range;
use std::path::Path;

use safetensors::SafeTensors;
use serde_json::{Map, Value, json};

use super::TrainError;
use super::corpus::POSE;
use super::latent::CODE;
use super::mlp::Mlp;
use super::model::Model;
use crate::core::manifold::LATENT;
use crate::core::manifold::weights::{Layer, WeightsError, checked_metadata, layers};
use crate::io::new_file;

/// Name of the format in the metadata.
const FORMAT: &str = "bundlemocap-manifold";
/// The version of the format.
const VERSION: &str = "1";
/// The activation between layers.
const ACTIVATION: &str = "silu";

/// Content of a weights file.
pub struct Content<'a> {
    /// Name of the format in the metadata.
    pub format: &'a str,
    /// Networks by name.
    pub networks: &'a [(&'a str, &'a Mlp)],
    /// Parameters of all networks.
    pub parameters: &'a [f32],
    /// Other vectors by name.
    pub vectors: &'a [(&'a str, &'a [f32])],
    /// How they were trained.
    pub metadata: &'a BTreeMap<&'static str, String>,
}

/// Writes the weights file of a manifold.
pub fn write(
    path: &Path,
    model: &Model,
    metadata: &BTreeMap<&'static str, String>,
) -> Result<(), TrainError> {
    let networks = [("encoder", &model.encoder), ("decoder", &model.decoder)];
    let parameters = &model.parameters;
    let content =
        Content { format: FORMAT, networks: &networks, parameters, vectors: &[], metadata };
    write_bytes(path, &bytes(&content))
}

/// Writes the file under a temporary name, then renames it.
pub fn write_bytes(path: &Path, bytes: &[u8]) -> Result<(), TrainError> {
    let failed = |source| TrainError::Write { path: path.to_owned(), source };
    new_file::write(path, bytes).map_err(failed)
}

/// The bytes of a file: length of the header, header with sorted keys, values. The same content
/// gives the same bytes.
pub fn bytes(content: &Content) -> Vec<u8> {
    let (mut header, mut data) = (Map::new(), Vec::new());
    let mut described: Map<String, Value> =
        content.metadata.iter().map(|(key, value)| ((*key).to_owned(), json!(value))).collect();
    for (key, value) in
        [("format", content.format), ("version", VERSION), ("activation", ACTIVATION)]
    {
        described.insert(key.to_owned(), json!(value));
    }
    header.insert("__metadata__".to_owned(), Value::Object(described));
    let mut add = |name: String, shape: &[usize], numbers: &[f32]| {
        let first = data.len();
        data.extend(numbers.iter().flat_map(|number| number.to_le_bytes()));
        let tensor = json!({"dtype": "F32", "shape": shape, "data_offsets": [first, data.len()]});
        header.insert(name, tensor);
    };
    for (name, network) in content.networks {
        for (index, layer) in network.layers().iter().enumerate() {
            let numbers = |range: &Range<usize>| &content.parameters[range.clone()];
            let shape = [layer.outputs, layer.inputs];
            add(format!("{name}.{index}.weight"), &shape, numbers(&layer.weight));
            add(format!("{name}.{index}.bias"), &shape[..1], numbers(&layer.bias));
        }
    }
    for (name, numbers) in content.vectors {
        add((*name).to_owned(), &[numbers.len()], numbers);
    }
    let mut header = Value::Object(header).to_string().into_bytes();
    header.resize(header.len().next_multiple_of(8), b' ');
    let mut out = (header.len() as u64).to_le_bytes().to_vec();
    out.extend(header);
    out.extend(data);
    out
}

/// Reads a file with encoder and decoder.
pub fn read(path: &Path) -> Result<Model, TrainError> {
    let bytes =
        std::fs::read(path).map_err(|source| TrainError::Read { path: path.to_owned(), source })?;
    parse(&bytes)
        .map_err(|error| TrainError::Weights { path: path.to_owned(), problem: error.to_string() })
}

/// Reads encoder and decoder from bytes.
pub fn parse(bytes: &[u8]) -> Result<Model, WeightsError> {
    checked_metadata(bytes, FORMAT)?;
    let tensors = SafeTensors::deserialize(bytes)?;
    let encoder = layers(&tensors, "encoder", POSE, CODE)?;
    let decoder = layers(&tensors, "decoder", LATENT, POSE)?;
    let hidden =
        |layers: &[Layer]| -> Vec<usize> { layers[1..].iter().map(|layer| layer.inputs).collect() };
    let mut model = Model::new(&hidden(&encoder), &hidden(&decoder));
    let networks = [(&model.encoder, encoder), (&model.decoder, decoder)];
    for (to, from) in networks.iter().flat_map(|(to, from)| to.layers().iter().zip(from)) {
        model.parameters[to.weight.clone()].copy_from_slice(&from.weight);
        model.parameters[to.bias.clone()].copy_from_slice(&from.bias);
    }
    Ok(model)
}

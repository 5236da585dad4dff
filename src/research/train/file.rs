//! The weights file: safetensors, f32, `encoder.N.weight` \[out, in\], `encoder.N.bias`, and the
//! same for the decoder. The metadata records how they were trained.

use std::collections::BTreeMap;
use std::ops::Range;
use std::path::Path;

use safetensors::{Dtype, SafeTensors};
use serde_json::{Map, Value, json};

use super::TrainError;
use super::corpus::POSE;
use super::latent::CODE;
use super::mlp::Mlp;
use super::model::Model;
use crate::core::manifold::LATENT;
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
    parse(&bytes).map_err(|problem| TrainError::Weights { path: path.to_owned(), problem })
}

/// Reads encoder and decoder from bytes. The error says what is wrong with them.
pub fn parse(bytes: &[u8]) -> Result<Model, String> {
    let (_, header) = SafeTensors::read_metadata(bytes).map_err(|error| error.to_string())?;
    let metadata = header.metadata().clone().unwrap_or_default();
    for (key, expected) in [("format", FORMAT), ("version", VERSION), ("activation", ACTIVATION)] {
        let found = metadata.get(key).map_or("nothing", String::as_str);
        if found != expected {
            return Err(format!("its `{key}` is `{found}`, not `{expected}`"));
        }
    }
    let tensors = SafeTensors::deserialize(bytes).map_err(|error| error.to_string())?;
    let encoder = widths(&tensors, "encoder", POSE, CODE)?;
    let decoder = widths(&tensors, "decoder", LATENT, POSE)?;
    let mut model = Model::new(&encoder, &decoder);
    for (name, network) in [("encoder", model.encoder.clone()), ("decoder", model.decoder.clone())]
    {
        load(&tensors, name, &network, &mut model.parameters)?;
    }
    Ok(model)
}

/// Hidden widths of a network. Checks that its widths begin with `first` and end with `last`.
fn widths(
    tensors: &SafeTensors,
    name: &str,
    first: usize,
    last: usize,
) -> Result<Vec<usize>, String> {
    let mut widths = vec![first];
    while let Ok(tensor) = tensors.tensor(&format!("{name}.{}.weight", widths.len() - 1)) {
        match tensor.shape() {
            [out, inputs] if widths.last() == Some(inputs) => widths.push(*out),
            shape => {
                let layer = widths.len() - 1;
                return Err(format!("`{name}.{layer}.weight` has the shape {shape:?}"));
            }
        }
    }
    if widths.len() < 2 || widths.pop() != Some(last) {
        return Err(format!("its {name} does not have {last} outputs"));
    }
    Ok(widths.split_off(1))
}

fn load(
    tensors: &SafeTensors,
    name: &str,
    network: &Mlp,
    parameters: &mut [f32],
) -> Result<(), String> {
    for (index, layer) in network.layers().iter().enumerate() {
        for (part, range) in [("weight", &layer.weight), ("bias", &layer.bias)] {
            let name = format!("{name}.{index}.{part}");
            let tensor = tensors.tensor(&name).map_err(|error| error.to_string())?;
            if tensor.dtype() != Dtype::F32 || tensor.data().len() != 4 * range.len() {
                return Err(format!("`{name}` does not have {} f32 values", range.len()));
            }
            let numbers = tensor.data().as_chunks::<4>().0.iter().copied().map(f32::from_le_bytes);
            for (parameter, number) in parameters[range.clone()].iter_mut().zip(numbers) {
                if !number.is_finite() {
                    return Err(format!("`{name}` has a value that is not finite"));
                }
                *parameter = number;
            }
        }
    }
    Ok(())
}

//! Writes glTF 2.0 binary files (.glb): metres, y up, +z forward; at rest the body stands with its feet on
//! y = 0, in the rest pose and with the axes of the joints of the file's style.
//!
//! Each holds the skin of the body, its skeleton, and one animation with a key for each
//! pose.

use std::io::{Error, Write};
use std::path::Path;

use nalgebra::{Matrix3, Vector3};
use serde_json::{Value, json};

use super::ExportError;
use super::animation::{Description, Keys, Skin, joint_weights};
use super::style::JointNames;
use crate::core::body::{JOINTS, Joint, Mesh, Pose, Skeleton};
use crate::core::so3;
use crate::io::new_file::NewFile;

// The format's numbers for types of components and uses of buffers.
const UNSIGNED_BYTE: u32 = 5121;
const UNSIGNED_SHORT: u32 = 5123;
const FLOAT: u32 = 5126;
const ARRAY_BUFFER: u32 = 34962;
const ELEMENT_ARRAY_BUFFER: u32 = 34963;

/// Writes poses of a performer, each with its time in seconds; returns the number of keys. A pose that is not later
/// than the one before it is left out. Before a gap the last pose is held.
///
/// The skin follows the joints alone, without the bones between them that [`Mesh::posed`] has: programs that
/// retarget find the skeleton that they expect, and a bent limb is a little thinner.
///
/// # Errors
/// The disk is full, the file would be larger than 4 GiB, the rate is not above 0, or a pose has a value that is not
/// finite.
pub fn write_glb(
    path: &Path,
    about: &Description,
    skeleton: &Skeleton,
    poses: impl IntoIterator<Item = (f64, Pose)>,
) -> Result<usize, ExportError> {
    let Description { name, fps, timecode, style } = about;
    ExportError::check_rate(path, *fps)?;
    let skin = Skin::of(skeleton, style);
    let keys = Keys::of(poses, 1.0 / fps, style, &skin)
        .map_err(|frame| ExportError::NotFinite { path: path.into(), frame })?;
    let (count, mut buffer) = (keys.times.len(), Buffer::default());
    let primitive = primitive(&skin, &mut buffer);
    let binds = buffer.floats("MAT4", &inverse_binds(&skin), None);
    let mut nodes = bones(&skin, style.names);
    nodes.push(json!({ "name": name, "mesh": 0, "skin": 0 }));
    let mut json = json!({
        "asset": {
            "version": "2.0",
            "generator": concat!("bundlemocap ", env!("CARGO_PKG_VERSION")),
            "extras": { "frame_rate": fps, "timecode": timecode },
        },
        "scene": 0,
        "scenes": [{ "name": name, "nodes": [0, JOINTS] }],
        "nodes": nodes,
        "meshes": [{ "name": name, "primitives": [primitive] }],
        "materials": [{ "name": "skin", "pbrMetallicRoughness":
            { "baseColorFactor": [0.6, 0.6, 0.62, 1.0], "metallicFactor": 0.0, "roughnessFactor": 0.8 } }],
        "skins": [{ "name": name, "skeleton": 0, "inverseBindMatrices": binds, "joints": Vec::from_iter(0..JOINTS) }],
    });
    if count > 0 {
        json["animations"] = json!([animation(about.name, &keys, &mut buffer)]);
    }
    json["buffers"] = json!([{ "byteLength": buffer.bytes.len() }]);
    (json["bufferViews"], json["accessors"]) = (buffer.views.into(), buffer.accessors.into());
    write(path, &json, &buffer.bytes).map_err(ExportError::write(path))?;
    Ok(count)
}

/// The nodes of the joints.
fn bones(skin: &Skin, names: JointNames) -> Vec<Value> {
    let bone = |joint: Joint| {
        let (turn, place) = skin.in_parent(joint);
        let mut node = json!({ "name": names.of(joint), "translation": place.as_slice() });
        if turn != Matrix3::identity() {
            node["rotation"] = json!(so3::xyzw_from_rotation(&turn));
        }
        let children = Joint::ALL.into_iter().filter(|child| child.parent() == Some(joint));
        let children: Vec<usize> = children.map(Joint::index).collect();
        if !children.is_empty() {
            node["children"] = json!(children);
        }
        node
    };
    Joint::ALL.into_iter().map(bone).collect()
}

/// Writes the file: a header, then JSON and numbers, each with its length and kind.
fn write(path: &Path, json: &Value, bytes: &[u8]) -> std::io::Result<()> {
    let mut text = serde_json::to_vec(json)?;
    text.resize(text.len().next_multiple_of(4), b' ');
    let length = |bytes: usize| {
        u32::try_from(bytes)
            .map(u32::to_le_bytes)
            .map_err(|_| Error::other("more than 4 GiB; export parts, with --start and --end"))
    };
    let whole = length(28 + text.len() + bytes.len())?;
    let mut new = NewFile::create(path)?;
    let file = new.file();
    file.write_all(b"glTF\x02\0\0\0")?;
    file.write_all(&whole)?;
    for (kind, chunk) in [(b"JSON", &*text), (b"BIN\0", bytes)] {
        file.write_all(&length(chunk.len())?)?;
        file.write_all(kind)?;
        file.write_all(chunk)?;
    }
    new.finish().map(drop)
}

/// The numbers of a file, with their descriptions.
#[derive(Default)]
struct Buffer {
    bytes: Vec<u8>,
    views: Vec<Value>,
    accessors: Vec<Value>,
}

impl Buffer {
    /// Adds numbers; returns the index of their accessor.
    fn add(
        &mut self,
        kind: &str,
        component: u32,
        count: usize,
        bytes: Vec<u8>,
        target: Option<u32>,
    ) -> usize {
        let mut view =
            json!({ "buffer": 0, "byteOffset": self.bytes.len(), "byteLength": bytes.len() });
        if let Some(target) = target {
            view["target"] = json!(target);
        }
        self.bytes.extend(bytes);
        self.bytes.resize(self.bytes.len().next_multiple_of(4), 0);
        self.views.push(view);
        self.accessors.push(json!({ "bufferView": self.views.len() - 1, "type": kind,
            "componentType": component, "count": count }));
        self.accessors.len() - 1
    }

    /// Adds numbers, with their smallest and largest values.
    fn floats<const N: usize>(
        &mut self,
        kind: &str,
        rows: &[[f32; N]],
        target: Option<u32>,
    ) -> usize {
        let bytes = rows.as_flattened().iter().flat_map(|number| number.to_le_bytes()).collect();
        let index = self.add(kind, FLOAT, rows.len(), bytes, target);
        let bound = |pick: fn(f32, f32) -> f32| {
            let bound =
                rows.iter().copied().reduce(|a, b| std::array::from_fn(|k| pick(a[k], b[k])));
            bound.map(|numbers| numbers.to_vec())
        };
        self.accessors[index]["min"] = json!(bound(f32::min));
        self.accessors[index]["max"] = json!(bound(f32::max));
        index
    }
}

/// The skin, with normals.
fn primitive(skin: &Skin, buffer: &mut Buffer) -> Value {
    let mesh = Mesh::template();
    let corners = mesh.faces().as_flattened();
    let indices = corners.iter().flat_map(|&corner| (corner as u16).to_le_bytes()).collect();
    let (bones, weights): (Vec<_>, Vec<_>) = mesh.influences().iter().map(joint_weights).unzip();
    let (positions, normals) = (rows(&skin.vertices), rows(&skin.normals()));
    let count = bones.len();
    json!({
        "indices": buffer.add("SCALAR", UNSIGNED_SHORT, corners.len(), indices, Some(ELEMENT_ARRAY_BUFFER)),
        "material": 0,
        "attributes": {
            "POSITION": buffer.floats("VEC3", &positions, Some(ARRAY_BUFFER)),
            "NORMAL": buffer.floats("VEC3", &normals, Some(ARRAY_BUFFER)),
            "JOINTS_0": buffer.add("VEC4", UNSIGNED_BYTE, count, bones.into_flattened(), Some(ARRAY_BUFFER)),
            "WEIGHTS_0": buffer.floats("VEC4", &weights, Some(ARRAY_BUFFER)),
        },
    })
}

/// Column by column, the way back from each joint.
fn inverse_binds(skin: &Skin) -> [[f32; 16]; JOINTS] {
    std::array::from_fn(|joint| {
        let back = skin.axes[joint].transpose();
        let mut bind = back.to_homogeneous();
        bind.fixed_view_mut::<3, 1>(0, 3).copy_from(&(back * -skin.joints[joint]));
        std::array::from_fn(|number| bind[number] as f32)
    })
}

fn rows(vectors: &[Vector3<f64>]) -> Vec<[f32; 3]> {
    vectors.iter().map(|vector| vector.map(|number| number as f32).into()).collect()
}

/// The keys as an animation of the nodes.
fn animation(name: &str, keys: &Keys, buffer: &mut Buffer) -> Value {
    let times: Vec<[f32; 1]> = keys.times.iter().map(|seconds| [*seconds as f32]).collect();
    let times = buffer.floats("SCALAR", &times, None);
    let mut outputs = vec![(0, "translation", buffer.floats("VEC3", &keys.positions, None))];
    for (joint, turns) in keys.rotations.iter().enumerate() {
        outputs.push((joint, "rotation", buffer.floats("VEC4", turns, None)));
    }
    let (mut samplers, mut channels) = (Vec::new(), Vec::new());
    for (node, path, output) in outputs {
        let target = json!({ "node": node, "path": path });
        channels.push(json!({ "sampler": samplers.len(), "target": target }));
        samplers.push(json!({ "input": times, "output": output }));
    }
    json!({ "name": name, "samplers": samplers, "channels": channels })
}

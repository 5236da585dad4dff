//! Writes glTF 2.0 binary files (.glb): metres, y up, +z forward, T-pose at zero rotation with the feet on y = 0.
//!
//! Each holds the skin of the body, its skeleton with the names of our joints, and one animation with a key a
//! frame: frame n is at n / fps.

use std::path::Path;

use nalgebra::Vector3;
use serde_json::{Value, json};

use crate::core::body::{JOINTS, Joint, Mesh, Pose, Skeleton};
use crate::core::so3;
use crate::io::formats::ExportError;
use crate::io::new_file;

/// Most bones that move a vertex.
const INFLUENCES: usize = 4;
/// Component types, and what a buffer view is for, as the format numbers them.
const U8: u32 = 5121;
const U16: u32 = 5123;
const F32: u32 = 5126;
const VERTICES: u32 = 34962;
const CORNERS: u32 = 34963;

/// Writes poses of a performer; returns the number of frames.
///
/// The skin follows the joints alone, without the bones between them that [`Mesh::posed`] has: programs that
/// retarget find the skeleton that they expect, and a bent limb is a little thinner.
///
/// # Errors
/// The disk is full, `fps` is not above 0, or a pose has a value that is not finite.
pub fn write_glb(
    path: &Path,
    name: &str,
    skeleton: &Skeleton,
    fps: f64,
    poses: impl IntoIterator<Item = Pose>,
) -> Result<usize, ExportError> {
    if !(fps.is_finite() && fps > 0.0) {
        return Err(ExportError::FrameRate { path: path.into(), fps });
    }
    let mut buffer = Buffer::default();
    let keys =
        Keys::of(poses).map_err(|frame| ExportError::NotFinite { path: path.into(), frame })?;
    let skin = Skin::of(skeleton);
    let primitive = skin.primitive(&mut buffer);
    let binds = buffer.floats("MAT4", &skin.inverse_binds(), None);
    let animation = keys.animation(&mut buffer, fps);
    let rest = |joint: Joint| match joint {
        Joint::Pelvis => skin.joints[0],
        _ => *skeleton.offset(joint),
    };
    let bone = |joint: Joint| {
        let children = Joint::ALL.into_iter().filter(|child| child.parent() == Some(joint));
        let children: Vec<usize> = children.map(Joint::index).collect();
        let mut node = json!({ "name": joint.name(), "translation": rest(joint).as_slice() });
        if !children.is_empty() {
            node["children"] = json!(children);
        }
        node
    };
    let mut nodes: Vec<Value> = Joint::ALL.into_iter().map(bone).collect();
    nodes.push(json!({ "name": name, "mesh": 0, "skin": 0 }));
    let json = json!({
        "asset": { "version": "2.0", "generator": concat!("bundlemocap ", env!("CARGO_PKG_VERSION")) },
        "scene": 0,
        "scenes": [{ "name": name, "nodes": [0, JOINTS] }],
        "nodes": nodes,
        "meshes": [{ "name": name, "primitives": [primitive] }],
        "materials": [{ "name": "skin", "pbrMetallicRoughness":
            { "baseColorFactor": [0.6, 0.6, 0.62, 1.0], "metallicFactor": 0.0, "roughnessFactor": 0.8 } }],
        "skins": [{ "skeleton": 0, "inverseBindMatrices": binds, "joints": (0..JOINTS).collect::<Vec<_>>() }],
        "animations": [animation],
        "buffers": [{ "byteLength": buffer.bytes.len() }],
        "bufferViews": buffer.views,
        "accessors": buffer.accessors,
    });
    let file = container(&json, &buffer.bytes).map_err(ExportError::write(path))?;
    new_file::write(path, &file).map_err(ExportError::write(path))?;
    Ok(keys.frames)
}

/// The file: a header, then JSON and numbers, each with its length and kind.
fn container(json: &Value, bytes: &[u8]) -> std::io::Result<Vec<u8>> {
    let mut text = serde_json::to_vec(json)?;
    text.resize(text.len().next_multiple_of(4), b' ');
    let length = |bytes: usize| {
        u32::try_from(bytes).map_err(|_| std::io::Error::other("more than 4 GiB; export a part"))
    };
    let mut file = b"glTF".to_vec();
    file.extend(2_u32.to_le_bytes());
    file.extend(length(28 + text.len() + bytes.len())?.to_le_bytes());
    for (kind, chunk) in [(b"JSON", &*text), (b"BIN\0", bytes)] {
        file.extend(length(chunk.len())?.to_le_bytes());
        file.extend(kind);
        file.extend(chunk);
    }
    Ok(file)
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
        let index = self.add(kind, F32, rows.len(), bytes, target);
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

/// The skin of a body that stands on y = 0.
struct Skin {
    vertices: Vec<Vector3<f64>>,
    joints: [Vector3<f64>; JOINTS],
}

impl Skin {
    fn of(skeleton: &Skeleton) -> Self {
        let mut vertices = Mesh::template().rest(skeleton);
        let lowest = vertices.iter().map(|vertex| vertex.y).fold(0.0, f64::min);
        let up = Vector3::new(0.0, -lowest, 0.0);
        vertices.iter_mut().for_each(|vertex| *vertex += up);
        let joints = Pose::rest().posture(skeleton).positions.map(|joint| joint + up);
        Self { vertices, joints }
    }

    fn primitive(&self, buffer: &mut Buffer) -> Value {
        let mesh = Mesh::template();
        let corners = mesh.faces().as_flattened();
        let indices = corners.iter().flat_map(|&corner| (corner as u16).to_le_bytes()).collect();
        let (bones, weights): (Vec<_>, Vec<_>) = mesh.influences().iter().map(of_joints).unzip();
        let (positions, normals) = (rows(&self.vertices), rows(&self.normals()));
        let count = bones.len();
        json!({
            "indices": buffer.add("SCALAR", U16, corners.len(), indices, Some(CORNERS)),
            "material": 0,
            "attributes": {
                "POSITION": buffer.floats("VEC3", &positions, Some(VERTICES)),
                "NORMAL": buffer.floats("VEC3", &normals, Some(VERTICES)),
                "JOINTS_0": buffer.add("VEC4", U8, count, bones.into_flattened(), Some(VERTICES)),
                "WEIGHTS_0": buffer.floats("VEC4", &weights, Some(VERTICES)),
            },
        })
    }

    fn normals(&self) -> Vec<Vector3<f64>> {
        let mut normals = vec![Vector3::zeros(); self.vertices.len()];
        for face in Mesh::template().faces() {
            let [a, b, c] = face.map(|corner| self.vertices[corner as usize]);
            let normal = (b - a).cross(&(c - a));
            face.iter().for_each(|&corner| normals[corner as usize] += normal);
        }
        normals.into_iter().map(|sum| sum.normalize()).collect()
    }

    /// Column by column.
    fn inverse_binds(&self) -> [[f32; 16]; JOINTS] {
        self.joints.map(|joint| {
            let [x, y, z] = joint.map(|metres| -metres as f32).into();
            [1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, x, y, z, 1.0]
        })
    }
}

fn rows(vectors: &[Vector3<f64>]) -> Vec<[f32; 3]> {
    vectors.iter().map(|vector| vector.map(|number| number as f32).into()).collect()
}

/// The joints that move a vertex, with their weights: a bone between two joints is divided between them.
fn of_joints(influences: &[(u8, f64); 4]) -> ([u8; INFLUENCES], [f32; INFLUENCES]) {
    let bones = Mesh::bones();
    let mut weights = [0.0; JOINTS];
    for &(bone, weight) in influences {
        let (joint, part) = bones[usize::from(bone)];
        weights[joint.index()] += part * weight;
        weights[joint.parent().unwrap_or(joint).index()] += (1.0 - part) * weight;
    }
    let mut order: [usize; JOINTS] = std::array::from_fn(|joint| joint);
    order.sort_by(|&a, &b| weights[b].total_cmp(&weights[a]));
    let kept = order.first_chunk::<INFLUENCES>().copied().unwrap_or_default();
    let sum: f64 = kept.iter().map(|&joint| weights[joint]).sum();
    // Joints without weight are 0, as the format wants it.
    let named = kept.map(|joint| if weights[joint] > 0.0 { joint as u8 } else { 0 });
    (named, kept.map(|joint| (weights[joint] / sum) as f32))
}

/// The keys of an animation.
struct Keys {
    frames: usize,
    positions: Vec<[f32; 3]>,
    /// By joint: x, y, z, w.
    rotations: [Vec<[f32; 4]>; JOINTS],
}

impl Keys {
    /// Fails with the number of a pose that is not finite.
    fn of(poses: impl IntoIterator<Item = Pose>) -> Result<Self, usize> {
        let (mut positions, mut rotations) =
            (Vec::new(), [const { Vec::<[f32; 4]>::new() }; JOINTS]);
        for (frame, pose) in poses.into_iter().enumerate() {
            let turns = std::iter::once(&pose.root_rotation).chain(&pose.local);
            if !turns
                .clone()
                .flat_map(|turn| turn.iter())
                .chain(&pose.root_position)
                .all(|n| n.is_finite())
            {
                return Err(frame);
            }
            positions.push(pose.root_position.map(|metres| metres as f32).into());
            for (turn, keys) in turns.zip(&mut rotations) {
                let mut key = so3::xyzw_from_rotation(turn).map(|number| number as f32);
                // The nearer of the two quaternions of a rotation: programs interpolate between keys.
                let dot = |last: &[f32; 4]| last.iter().zip(&key).map(|(a, b)| a * b).sum::<f32>();
                if keys.last().is_some_and(|last| dot(last) < 0.0) {
                    key = key.map(|number| -number);
                }
                keys.push(key);
            }
        }
        Ok(Self { frames: positions.len(), positions, rotations })
    }

    fn animation(&self, buffer: &mut Buffer, fps: f64) -> Value {
        let times: Vec<[f32; 1]> =
            (0..self.frames).map(|frame| [(frame as f64 / fps) as f32]).collect();
        let times = buffer.floats("SCALAR", &times, None);
        let mut outputs = vec![(0, "translation", buffer.floats("VEC3", &self.positions, None))];
        for (joint, keys) in self.rotations.iter().enumerate() {
            outputs.push((joint, "rotation", buffer.floats("VEC4", keys, None)));
        }
        let sampler = |&(_, _, output): &(_, _, usize)| json!({ "input": times, "output": output });
        let samplers: Vec<Value> = outputs.iter().map(sampler).collect();
        let channel = |(sampler, &(node, path, _)): (usize, &(usize, &str, usize))| json!({ "sampler": sampler, "target": { "node": node, "path": path } });
        let channels: Vec<Value> = outputs.iter().enumerate().map(channel).collect();
        json!({ "name": "take", "samplers": samplers, "channels": channels })
    }
}

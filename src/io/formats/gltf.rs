//! Writes glTF 2.0 binary files (.glb): metres, y up, +z forward, T-pose at zero rotation with the feet on y = 0.
//!
//! Each holds the skin of the body, its skeleton with the names of our joints, and one animation with a key for each
//! pose.

use std::io::{Error, Write};
use std::path::Path;

use nalgebra::Vector3;
use serde_json::{Value, json};

use crate::core::body::{JOINTS, Joint, Mesh, Pose, Skeleton};
use crate::core::so3;
use crate::io::formats::ExportError;
use crate::io::new_file::NewFile;

/// Most joints that move a vertex.
const INFLUENCES: usize = 4;
/// A gap is longer than this, periods.
const GAP_PERIODS: f64 = 1.5;
/// A gap is longer than this, seconds: programs interpolate over a few lost frames and over a slower rate.
const GAP_S: f64 = 0.25;
// The format's numbers for types of components and uses of buffers.
const UNSIGNED_BYTE: u32 = 5121;
const UNSIGNED_SHORT: u32 = 5123;
const FLOAT: u32 = 5126;
const ARRAY_BUFFER: u32 = 34962;
const ELEMENT_ARRAY_BUFFER: u32 = 34963;

/// What a file says of its content.
#[derive(Clone, Debug)]
pub struct Description<'a> {
    /// The performer.
    pub name: &'a str,
    /// Frame rate, hertz.
    pub fps: f64,
    /// Timecode and its rate at 0 seconds, such as `01:00:00:00 25`.
    pub timecode: Option<String>,
}

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
    let Description { name, fps, timecode } = about;
    if !(fps.is_finite() && *fps > 0.0) {
        return Err(ExportError::FrameRate { path: path.into(), fps: *fps });
    }
    let keys = Keys::of(poses, 1.0 / fps)
        .map_err(|frame| ExportError::NotFinite { path: path.into(), frame })?;
    let (count, mut buffer, skin) = (keys.times.len(), Buffer::default(), Skin::of(skeleton));
    let primitive = skin.primitive(&mut buffer);
    let binds = buffer.floats("MAT4", &skin.inverse_binds(), None);
    let mut nodes = bones(skeleton, &skin);
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
        "skins": [{ "skeleton": 0, "inverseBindMatrices": binds, "joints": Vec::from_iter(0..JOINTS) }],
    });
    if count > 0 {
        json["animations"] = json!([keys.animation(&mut buffer)]);
    }
    json["buffers"] = json!([{ "byteLength": buffer.bytes.len() }]);
    (json["bufferViews"], json["accessors"]) = (buffer.views.into(), buffer.accessors.into());
    write(path, &json, &buffer.bytes).map_err(ExportError::write(path))?;
    Ok(count)
}

/// The nodes of the joints.
fn bones(skeleton: &Skeleton, skin: &Skin) -> Vec<Value> {
    let bone = |joint: Joint| {
        let place = match joint {
            Joint::Pelvis => &skin.joints[0],
            _ => skeleton.offset(joint),
        };
        let mut node = json!({ "name": joint.name(), "translation": place.as_slice() });
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
        let (bones, weights): (Vec<_>, Vec<_>) =
            mesh.influences().iter().map(joint_weights).unzip();
        let (positions, normals) = (rows(&self.vertices), rows(&self.normals()));
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

    fn normals(&self) -> Vec<Vector3<f64>> {
        let mut normals = vec![Vector3::zeros(); self.vertices.len()];
        for face in Mesh::template().faces() {
            let [a, b, c] = face.map(|corner| self.vertices[corner as usize]);
            let normal = (b - a).cross(&(c - a));
            face.iter().for_each(|&corner| normals[corner as usize] += normal);
        }
        let unit = |sum: Vector3<f64>| sum.try_normalize(0.0).unwrap_or_else(Vector3::y);
        normals.into_iter().map(unit).collect()
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
fn joint_weights(influences: &[(u8, f64); 4]) -> ([u8; INFLUENCES], [f32; INFLUENCES]) {
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
#[derive(Default)]
struct Keys {
    /// Seconds; they increase.
    times: Vec<[f32; 1]>,
    positions: Vec<[f32; 3]>,
    /// By joint: x, y, z, w. Each is the nearer to the last of the two quaternions of its rotation, for programs
    /// interpolate between them.
    rotations: [Vec<[f32; 4]>; JOINTS],
}

impl Keys {
    /// Fails with the number of a pose that is not finite.
    fn of(poses: impl IntoIterator<Item = (f64, Pose)>, period: f64) -> Result<Self, usize> {
        let mut keys = Self::default();
        for (frame, (seconds, pose)) in poses.into_iter().enumerate() {
            let time = seconds as f32;
            let position: [f32; 3] = pose.root_position.map(|metres| metres as f32).into();
            let turns = std::iter::once(&pose.root_rotation).chain(&pose.local);
            let turns = turns.map(|turn| so3::xyzw_from_rotation(turn).map(|number| number as f32));
            let turns = Vec::from_iter(turns);
            let numbers = turns.as_flattened().iter().chain(&position).chain([&time]);
            if !numbers.copied().all(f32::is_finite) {
                return Err(frame);
            }
            let last = keys.times.last().map_or(f64::NEG_INFINITY, |[last]| f64::from(*last));
            if last.is_finite() && seconds - last > (GAP_PERIODS * period).max(GAP_S) {
                keys.hold((seconds - period) as f32);
            }
            if time > last as f32 {
                keys.add(time, position, &turns);
            }
        }
        Ok(keys)
    }

    fn add(&mut self, seconds: f32, position: [f32; 3], turns: &[[f32; 4]]) {
        self.times.push([seconds]);
        self.positions.push(position);
        for (keys, turn) in self.rotations.iter_mut().zip(turns) {
            let dot = |last: &[f32; 4]| last.iter().zip(turn).map(|(a, b)| a * b).sum::<f32>();
            let is_far = keys.last().is_some_and(|last| dot(last) < 0.0);
            keys.push(if is_far { turn.map(|number| -number) } else { *turn });
        }
    }

    /// Repeats the last key.
    fn hold(&mut self, seconds: f32) {
        self.times.push([seconds]);
        self.positions.extend_from_within(self.positions.len() - 1..);
        self.rotations.iter_mut().for_each(|keys| keys.extend_from_within(keys.len() - 1..));
    }

    fn animation(self, buffer: &mut Buffer) -> Value {
        let times = buffer.floats("SCALAR", &self.times, None);
        let mut outputs = vec![(0, "translation", buffer.floats("VEC3", &self.positions, None))];
        for (joint, keys) in self.rotations.iter().enumerate() {
            outputs.push((joint, "rotation", buffer.floats("VEC4", keys, None)));
        }
        let (mut samplers, mut channels) = (Vec::new(), Vec::new());
        for (node, path, output) in outputs {
            let target = json!({ "node": node, "path": path });
            channels.push(json!({ "sampler": samplers.len(), "target": target }));
            samplers.push(json!({ "input": times, "output": output }));
        }
        json!({ "name": "take", "samplers": samplers, "channels": channels })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn turned(degrees: f64) -> Pose {
        let root_rotation = so3::exp(&Vector3::new(0.0, degrees.to_radians(), 0.0));
        Pose { root_rotation, ..Pose::rest() }
    }

    #[test]
    fn keys_turn_the_short_way_and_hold_before_a_gap() {
        let turns = (0..72).map(|k| (f64::from(k) * 0.1, turned(10.0 * f64::from(k))));
        let keys = Keys::of(turns, 0.1).unwrap();
        assert_eq!(keys.times.len(), 72);
        for pair in keys.rotations[0].windows(2) {
            let dot: f32 = pair[0].iter().zip(&pair[1]).map(|(a, b)| a * b).sum();
            assert!(dot > 0.99, "{pair:?}");
        }
        // A gap, a pose that comes twice, and one that goes back.
        let at = [0.0, 0.1, 0.5, 0.5, 0.3, 0.6];
        let keys = Keys::of(at.map(|seconds| (seconds, turned(100.0 * seconds))), 0.1).unwrap();
        let times: Vec<f32> = keys.times.iter().map(|[time]| *time).collect();
        assert_eq!(times, [0.0, 0.1, 0.4, 0.5, 0.6]);
        assert_eq!(keys.rotations[0][1], keys.rotations[0][2]);
        let far = Pose { root_position: Vector3::repeat(1e39), ..Pose::rest() };
        assert_eq!(Keys::of([(0.0, Pose::rest()), (0.1, far)], 0.1).err(), Some(1));
    }

    #[test]
    fn weights_of_joints_add_up_and_name_no_joint_without_weight() {
        for influences in Mesh::template().influences() {
            let (joints, weights) = joint_weights(influences);
            assert!((weights.iter().sum::<f32>() - 1.0).abs() < 1e-6, "{weights:?}");
            for (joint, weight) in joints.iter().zip(weights) {
                assert!(weight > 0.0 || *joint == 0, "{joints:?} {weights:?}");
            }
        }
    }
}

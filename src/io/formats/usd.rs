//! Writes USD as text (.usda): metres, y up, +z forward; at rest the body stands with its feet on y = 0,
//! in the rest pose and with the axes of the joints of the file's style.
//!
//! Each file holds one `SkelRoot` with the skin, the skeleton and the animation of a performer. A time code is a frame.

use std::fmt::{Display, Write as _};
use std::io::Write as _;
use std::path::Path;

use nalgebra::{Matrix3, Vector3};

use super::ExportError;
use super::animation::{Description, INFLUENCES, Keys, Skin, joint_weights};
use super::style::JointNames;
use crate::core::body::{Joint, Mesh, Pose, Skeleton};
use crate::io::new_file::NewFile;

/// Writes poses of a performer, each with its time in seconds; returns the number of keys. A pose that is not later
/// than the one before it is left out. Before a gap the last pose is held. The skin is that of
/// [`write_glb`](super::gltf::write_glb).
///
/// # Errors
/// The disk is full, the rate is not above 0, or a pose has a value that is not finite.
pub fn write_usda(
    path: &Path,
    about: &Description,
    skeleton: &Skeleton,
    poses: impl IntoIterator<Item = (f64, Pose)>,
) -> Result<usize, ExportError> {
    let Description { name, fps, style, .. } = about;
    ExportError::check_rate(path, *fps)?;
    let skin = Skin::of(skeleton, style);
    let keys = Keys::of(poses, 1.0 / fps, style, &skin)
        .map_err(|frame| ExportError::NotFinite { path: path.into(), frame })?;
    let written = || {
        let mut new = NewFile::create(path)?;
        let file = new.file();
        let joints = joints(style.names);
        write!(file, "{}", header(about, &keys))?;
        write!(file, "{}", bones(&skin, &joints))?;
        animation(file, &skin, &joints, &keys, *fps)?;
        writeln!(file, "    }}\n{}}}", surface(&skin, &identifier(name)))?;
        new.finish().map(drop)
    };
    written().map_err(ExportError::write(path))?;
    Ok(keys.times.len())
}

/// The name as USD allows it: letters, digits and underscores, and no digit first.
fn identifier(name: &str) -> String {
    let allowed = |c: char| if c.is_ascii_alphanumeric() { c } else { '_' };
    let name: String = name.chars().map(allowed).collect();
    if name.starts_with(|c: char| !c.is_ascii_digit()) { name } else { format!("_{name}") }
}

/// The path of a joint from the pelvis.
fn path_of(joint: Joint, names: JointNames) -> String {
    let name = identifier(names.of(joint));
    match joint.parent() {
        None => name,
        Some(parent) => format!("{}/{name}", path_of(parent, names)),
    }
}

/// The items with commas between them.
fn joined<T: Display>(items: impl IntoIterator<Item = T>) -> String {
    let mut text = String::new();
    for (index, item) in items.into_iter().enumerate() {
        let _ = write!(text, "{}{item}", if index > 0 { ", " } else { "" });
    }
    text
}

fn list<T: Display>(items: impl IntoIterator<Item = T>) -> String {
    format!("[{}]", joined(items))
}

fn tuple<T: Display>(items: impl IntoIterator<Item = T>) -> String {
    format!("({})", joined(items))
}

fn point(point: &Vector3<f64>) -> String {
    tuple(point.iter().map(|&metres| metres as f32))
}

fn header(Description { name, fps, timecode, .. }: &Description, keys: &Keys) -> String {
    let last = keys.times.last().map_or(0.0, |seconds| seconds * fps);
    let timecode = timecode.as_ref().map_or_else(String::new, |timecode| {
        format!("    customLayerData = {{\n        string timecode = {timecode:?}\n    }}\n")
    });
    let name = identifier(name);
    let version = env!("CARGO_PKG_VERSION");
    format!(
        "#usda 1.0\n(\n{timecode}    defaultPrim = \"{name}\"\n    doc = \"bundlemocap {version}\"\n    \
         endTimeCode = {}\n    framesPerSecond = {fps}\n    metersPerUnit = 1\n    startTimeCode = 0\n    \
         timeCodesPerSecond = {fps}\n    upAxis = \"Y\"\n)\n\n\
         def SkelRoot \"{name}\" (\n    prepend apiSchemas = [\"SkelBindingAPI\"]\n)\n{{\n",
        last.round()
    )
}

/// The skeleton; its animation and its closing brace follow.
fn bones(skin: &Skin, joints: &str) -> String {
    // Rows are multiplied from the left.
    let moved = |(turn, by): (Matrix3<f64>, Vector3<f64>)| {
        let rows = turn.column_iter().map(|column| format!("({}, 0)", joined(column.iter())));
        format!("({}, ({}, 1))", joined(rows), joined(by.iter()))
    };
    format!(
        "    def Skeleton \"Skeleton\" (\n        prepend apiSchemas = [\"SkelBindingAPI\"]\n    )\n    {{\n        \
         uniform matrix4d[] bindTransforms = {}\n        uniform token[] joints = {joints}\n        \
         uniform matrix4d[] restTransforms = {}\n        rel skel:animationSource = <Animation>\n",
        list(skin.axes.into_iter().zip(skin.joints).map(moved)),
        list(Joint::ALL.map(|joint| moved(skin.in_parent(joint))))
    )
}

fn joints(names: JointNames) -> String {
    list(Joint::ALL.map(|joint| format!("\"{}\"", path_of(joint, names))))
}

/// Writes the animation inside the skeleton: for each joint its place in its parent and its rotation.
fn animation(
    file: &mut impl std::io::Write,
    skin: &Skin,
    joints: &str,
    keys: &Keys,
    fps: f64,
) -> std::io::Result<()> {
    let ones = list(Joint::ALL.map(|_| "(1, 1, 1)"));
    writeln!(file, "\n        def SkelAnimation \"Animation\"\n        {{")?;
    writeln!(file, "            uniform token[] joints = {joints}")?;
    writeln!(file, "            half3[] scales = {ones}")?;
    // Only the pelvis moves in its parent.
    let others = joined(Joint::ALL[1..].iter().map(|&joint| point(&skin.in_parent(joint).1)));
    let frame = |seconds: f64| {
        // Capture times are whole nanoseconds; frames are whole where the poses are evenly spaced.
        let frame = seconds * fps;
        if (frame - frame.round()).abs() < 0.05 { frame.round() } else { frame }
    };
    writeln!(file, "            float3[] translations.timeSamples = {{")?;
    for (time, position) in keys.times.iter().zip(&keys.positions) {
        let (at, pelvis) = (frame(*time), tuple(position));
        writeln!(file, "                {at}: [{pelvis}, {others}],")?;
    }
    writeln!(file, "            }}\n            quatf[] rotations.timeSamples = {{")?;
    for (key, time) in keys.times.iter().enumerate() {
        let turns = keys.rotations.iter().map(|turns| {
            let [x, y, z, w] = turns[key];
            tuple([w, x, y, z])
        });
        writeln!(file, "                {}: {},", frame(*time), list(turns))?;
    }
    writeln!(file, "            }}\n        }}")
}

/// The mesh with its weights.
fn surface(skin: &Skin, root: &str) -> String {
    let mesh = Mesh::template();
    let (bones, weights): (Vec<_>, Vec<_>) = mesh.influences().iter().map(joint_weights).unzip();
    let extent = skin
        .vertices
        .iter()
        .fold([skin.vertices[0]; 2], |[low, high], vertex| [low.inf(vertex), high.sup(vertex)]);
    format!(
        "\n    def Mesh \"Skin\" (\n        prepend apiSchemas = [\"SkelBindingAPI\"]\n    )\n    {{\n        \
         float3[] extent = {}\n        int[] faceVertexCounts = {}\n        int[] faceVertexIndices = {}\n        \
         point3f[] points = {}\n        int[] primvars:skel:jointIndices = {} (\n            \
         elementSize = {INFLUENCES}\n            interpolation = \"vertex\"\n        )\n        \
         float[] primvars:skel:jointWeights = {} (\n            elementSize = {INFLUENCES}\n            \
         interpolation = \"vertex\"\n        )\n        rel skel:skeleton = </{root}/Skeleton>\n        \
         uniform token subdivisionScheme = \"none\"\n    }}\n",
        list(extent.iter().map(point)),
        list(mesh.faces().iter().map(|_| 3)),
        list(mesh.faces().as_flattened()),
        list(skin.vertices.iter().map(point)),
        list(bones.as_flattened()),
        list(weights.as_flattened()),
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_made_valid() {
        assert_eq!(
            ["p1", "anna-2", "2nd", "Zoë", ""].map(identifier),
            ["p1", "anna_2", "_2nd", "Zo_", "_"]
        );
    }
}

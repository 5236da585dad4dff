//! The skin of the body, as the scene of the page and of the report draws it.

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD as BASE64;
use serde_json::{Value, json};

use crate::core::body::{Joint, Mesh, Skeleton};
use crate::io::wire;

/// What all bodies share. In base64: the corners of the faces (u16), and of each vertex four bones (u8) and
/// their weights (u8, together 255). For each bone, as in [`Mesh::bones`], joint and part of the turn. For each
/// joint its [`Mesh::bulge`] and its parent; -1: none.
pub(crate) fn template() -> Value {
    let mesh = Mesh::template();
    let corners = mesh.faces().as_flattened().iter();
    let faces: Vec<u8> = corners.flat_map(|corner| (*corner as u16).to_le_bytes()).collect();
    let (bones, weights): (Vec<u8>, Vec<u8>) = mesh.influences().iter().flat_map(whole).unzip();
    let [faces, bones, weights] = [faces, bones, weights].map(|bytes| BASE64.encode(bytes));
    let turns: Vec<_> =
        Mesh::bones().into_iter().map(|(joint, part)| (joint.index(), part)).collect();
    let parents = wire::Skeleton::from_core(&Skeleton::default()).parents;
    json!({ "faces": faces, "bones": bones, "weights": weights, "turns": turns,
            "bulge": Joint::ALL.map(Mesh::bulge), "parents": parents })
}

/// Influences whose weights are whole numbers that add up to 255.
fn whole(influences: &[(u8, f64); 4]) -> [(u8, u8); 4] {
    let mut whole = influences.map(|(bone, weight)| (bone, (255.0 * weight).round() as u8));
    let others: u8 = whole[1..].iter().map(|(_, weight)| weight).sum();
    whole[0].1 = 255 - others;
    whole
}

/// The skin of a body in the rest pose, the pelvis at the origin: x, y and z of each vertex in tenths
/// of millimetres (i16, little-endian).
pub(crate) fn rest(body: &Skeleton) -> Vec<u8> {
    let skin = Mesh::template().rest(body);
    let numbers = skin.iter().flat_map(|p| [p.x, p.y, p.z]);
    numbers.flat_map(|metres| ((1e4 * metres).round() as i16).to_le_bytes()).collect()
}

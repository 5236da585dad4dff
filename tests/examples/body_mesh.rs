//! The skin of three bodies in four poses, as OBJ files (metres), and the poses as JSON: of each joint the rotation
//! from the T-pose, relative to its parent, row by row.
//!
//! ```text
//! cargo run --release --example body_mesh -- out/
//! ```

use std::collections::BTreeMap;
use std::error::Error;
use std::f64::consts::PI;
use std::fmt::Write as _;
use std::path::PathBuf;

use bundlemocap::core::body::{Joint, Mesh, Pose, Shape, Skeleton};
use bundlemocap::core::so3;
use bundlemocap::nalgebra::Vector3;

/// Joints and their rotations in a pose: an axis (x left, y up, z forwards) times an angle, degrees.
type Turns = &'static [(Joint, [f64; 3])];

use Joint as J;
const POSES: [(&str, Turns); 4] = [
    ("t-pose", &[]),
    (
        "walk",
        &[
            (J::LHip, [-28.0, 0.0, 0.0]),
            (J::LKnee, [8.0, 0.0, 0.0]),
            (J::RHip, [18.0, 0.0, 0.0]),
            (J::RKnee, [28.0, 0.0, 0.0]),
            (J::RAnkle, [12.0, 0.0, 0.0]),
            (J::LShoulder, [0.0, 22.0, -78.0]),
            (J::RShoulder, [0.0, 22.0, 78.0]),
            (J::LElbow, [0.0, -20.0, 0.0]),
            (J::RElbow, [0.0, 40.0, 0.0]),
        ],
    ),
    (
        "squat",
        &[
            (J::Spine1, [18.0, 0.0, 0.0]),
            (J::LHip, [-95.0, 0.0, 12.0]),
            (J::RHip, [-95.0, 0.0, -12.0]),
            (J::LKnee, [105.0, 0.0, 0.0]),
            (J::RKnee, [105.0, 0.0, 0.0]),
            (J::LAnkle, [-28.0, 0.0, 0.0]),
            (J::RAnkle, [-28.0, 0.0, 0.0]),
            (J::LShoulder, [0.0, -80.0, -15.0]),
            (J::RShoulder, [0.0, 80.0, 15.0]),
        ],
    ),
    (
        "arms up",
        &[
            (J::LCollar, [0.0, 0.0, 20.0]),
            (J::RCollar, [0.0, 0.0, -20.0]),
            (J::LShoulder, [0.0, 0.0, 62.0]),
            (J::RShoulder, [0.0, 0.0, -62.0]),
        ],
    ),
];
/// Bodies, by their symmetric shape coefficients, in standard deviations.
const BODIES: [(&str, [f64; 10]); 3] = [
    ("mean", [0.0; 10]),
    ("tall", [2.0, 0.5, 0.5, 0.5, 0.0, 1.5, 0.0, 0.0, 0.0, 0.0]),
    ("short", [-2.0, 0.0, 0.0, -0.5, 0.0, -1.0, 1.0, 0.0, 0.0, 0.0]),
];

fn main() -> Result<(), Box<dyn Error>> {
    let folder = PathBuf::from(std::env::args().nth(1).ok_or("give a folder for the files")?);
    std::fs::create_dir_all(&folder)?;
    let mesh = Mesh::template();
    let mut rotations = BTreeMap::new();
    for (name, turns) in POSES {
        let turn = |joint: Joint| {
            let found = turns.iter().find(|(turned, _)| *turned == joint);
            so3::exp(
                &(found.map_or(Vector3::zeros(), |(_, degrees)| Vector3::from(*degrees)) * PI
                    / 180.0),
            )
        };
        let mut pose = Pose::rest();
        for (joint, local) in Joint::ALL[1..].iter().zip(&mut pose.local) {
            *local = turn(*joint);
        }
        let rows = Joint::ALL.map(|joint| turn(joint).transpose().as_slice().to_vec());
        rotations.insert(name, rows.to_vec());
        for (of, shape) in BODIES {
            let body = Skeleton::new(Shape::symmetric(shape));
            let vertices = mesh.posed(&mesh.rest(&body), &body, &pose);
            let mut text = String::new();
            vertices
                .iter()
                .try_for_each(|v| writeln!(text, "v {:.4} {:.4} {:.4}", v.x, v.y, v.z))?;
            let mut faces = mesh.faces().iter().map(|face| face.map(|corner| corner + 1));
            faces.try_for_each(|[a, b, c]| writeln!(text, "f {a} {b} {c}"))?;
            std::fs::write(folder.join(format!("{name}, {of}.obj")), text)?;
        }
    }
    std::fs::write(folder.join("poses.json"), serde_json::to_string(&rotations)?)?;
    println!("{} bodies in {} poses are in {}", BODIES.len(), POSES.len(), folder.display());
    Ok(())
}

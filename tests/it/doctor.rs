//! `doctor`, and what a node says of cameras that it does not hear, or that do not fit.

use std::fs;
use std::path::Path;
use std::process::{Command, Output};

use bundlemocap::core::so3;
use bundlemocap::core::time::Timestamp;
use bundlemocap::io::recording::{Message, Provenance, Reader, Writer};
use bundlemocap::io::wire::Topics;
use nalgebra::Vector3;

use crate::program::{Program, listening_node};

const PROGRAM: &str = env!("CARGO_BIN_EXE_bundlemocap");
const WALK: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/recordings/walk.mcap");

/// A calibration with cameras of that name and width.
fn calibration(cameras: &[(&str, u32)]) -> String {
    let camera = |(name, width): &(&str, u32)| {
        format!(
            "[{name}]\nname = \"{name}\"\nsize = [{width}.0, 1024.0]\n\
             matrix = [[1000.0, 0.0, 640.0], [0.0, 1000.0, 512.0], [0.0, 0.0, 1.0]]\n\
             distortions = [0.0, 0.0, 0.0, 0.0]\nrotation = [0.1, 0.2, 0.3]\n\
             translation = [0.0, 0.0, 4.0]\n"
        )
    };
    cameras.iter().map(camera).collect()
}

fn doctor(folder: &Path, address: &str, stage: &str, rig: &str, seconds: u32) -> Output {
    let settings = format!(
        "[node]\nstage = \"{stage}\"\nrig = \"{rig}\"\n[bus.zenoh]\nlisten = [\"{address}\"]\n"
    );
    fs::write(folder.join("studio.toml"), settings).unwrap();
    let mut command = Command::new(PROGRAM);
    command.args(["doctor", "studio.toml", "--seconds", &seconds.to_string()]);
    command.current_dir(folder).output().unwrap()
}

/// Whether a line begins with `start` and holds `text`.
fn says(said: &str, start: &str, text: &str) -> bool {
    said.lines().any(|line| line.starts_with(start) && line.contains(text))
}

#[test]
fn cameras_that_do_not_fit_the_settings_are_named() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    fs::write(folder.join("node.toml"), "[node]\nstage = \"other\"\n").unwrap();
    let settings = folder.join("node.toml");
    let (mut node, address) = listening_node(&[settings.to_str().unwrap()]);
    let mut player = Command::new(PROGRAM);
    let _player = Program::start(player.args([
        "play",
        WALK,
        "--loop",
        "--connect",
        &address,
        "--speed",
        "2",
    ]));

    // The node hears nothing on its stage, and says where cameras send.
    assert!(node.has_said("no camera sends on stage other, but on stage (cam01, cam02"));

    // Their delays are not those of the stage.
    let mut far = Command::new(PROGRAM);
    far.args(["play", WALK, "--loop", "--connect", &address, "--stage", "zoo"]);
    let _far = Program::start(far.args(["--late", "1", "--late-ms", "2000"]));
    let good = [("cam01", 1280), ("cam02", 1280), ("cam03", 1280), ("cam04", 1280)];
    fs::write(folder.join("good.toml"), calibration(&good)).unwrap();
    let output = doctor(folder, &address, "stage", "good.toml", 3);
    let said = String::from_utf8(output.stdout).unwrap();
    assert_eq!(output.status.code(), Some(0), "{said}");
    assert!(says(&said, "ok     node", "stage other, actor actor"), "{said}");
    assert!(says(&said, "ok     cam01", "1280 x 1024, delay"), "{said}");
    assert!(says(&said, "ok     latency", "ms: window"), "{said}");
    let after = |text: &str| {
        let numbers = said.split(text).skip(1).map(|rest| rest.split([')', '\n']).next().unwrap());
        numbers.map(|number| number.parse().unwrap()).reduce(f64::max)
    };
    let [slowest, counted] = ["(99 %: ", "cameras and network "].map(after);
    assert!((slowest.unwrap() - counted.unwrap()).abs() < 0.6, "{said}");
    assert!(says(&said, "look   stage", "zoo (cam01"), "{said}");

    let bad = [("cam01", 640), ("cam02", 1280), ("cam03", 1280), ("spare", 1280)];
    fs::write(folder.join("bad.toml"), calibration(&bad)).unwrap();
    let output = doctor(folder, &address, "stage", "bad.toml", 1);
    let said = String::from_utf8(output.stdout).unwrap();
    assert_eq!(output.status.code(), Some(17), "{said}");
    assert!(says(&said, "wrong  cam01", "the calibration is for 640 x 1024"), "{said}");
    assert!(says(&said, "ok     cam02", ""), "{said}");
    assert!(says(&said, "wrong  cam04", "is not in the calibration"), "{said}");
    assert!(says(&said, "wrong  spare", "sends nothing"), "{said}");
    assert!(said.lines().last().unwrap().starts_with("3 wrong, "), "{said}");

    let output = doctor(folder, &address, "other", "none.toml", 1);
    let said = String::from_utf8(output.stdout).unwrap();
    assert_eq!(output.status.code(), Some(17), "{said}");
    assert!(says(&said, "wrong  calibration", "none.toml"), "{said}");
    assert!(says(&said, "look   stage", "cameras also send on stage (cam01"), "{said}");
    assert!(says(&said, "wrong  cameras", "mocap/other/camera/CAMERA/keypoints"), "{said}");
}

/// The walk without image sizes, with a calibration in which a camera is turned by 5 degrees.
fn with_a_turned_camera(path: &Path) {
    let mut writer = Writer::create(path, Topics::default(), &Provenance::default()).unwrap();
    let mut rig = None;
    for entry in Reader::open(Path::new(WALK)).unwrap() {
        match entry.unwrap().message {
            Message::Rig(message) => {
                let mut turned = message.to_core().unwrap();
                let camera = &mut turned.cameras[2];
                let turn = so3::exp(&Vector3::new(0.0, 5_f64.to_radians(), 0.0));
                camera.rotation = turn * camera.rotation;
                camera.translation = turn * camera.translation;
                writer.rig(&turned, Timestamp::default()).unwrap();
                rig = Some(turned);
            }
            Message::Keypoints(frame) => {
                let rig = rig.as_ref().unwrap();
                let frame = frame.to_core(|name| rig.index_of(name)).unwrap();
                writer.keypoints(&frame, &rig.cameras[frame.camera].name, [0, 0]).unwrap();
            }
            _ => {}
        }
    }
    writer.finish().unwrap();
}

#[test]
fn a_running_node_names_a_camera_that_does_not_fit() {
    let folder = tempfile::tempdir().unwrap();
    let turned = folder.path().join("turned.mcap");
    with_a_turned_camera(&turned);
    let (mut node, address) = listening_node(&[]);
    let mut player = Command::new(PROGRAM);
    player.args(["play", turned.to_str().unwrap(), "--loop", "--connect", &address]);
    let _player = Program::start(&mut player);
    assert!(node.has_said("camera cam03: "));

    let cameras = [("cam01", 1280), ("cam02", 1280), ("cam03", 1280), ("cam04", 1280)];
    fs::write(folder.path().join("rig.toml"), calibration(&cameras)).unwrap();
    let output = doctor(folder.path(), &address, "stage", "rig.toml", 1);
    let said = String::from_utf8(output.stdout).unwrap();
    assert!(says(&said, "ok     cam01", "unknown image size"), "{said}");
}

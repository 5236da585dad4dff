//! The page's server, as a browser sees it. `tests/view` has the tests in a browser.

use std::io::{Read, Write};
use std::net::TcpStream;
use std::path::Path;
use std::sync::Arc;

use bundlemocap::core::body::{Joint, Mesh, Pose, Shape, Skeleton};
use bundlemocap::core::so3;
use bundlemocap::core::time::{Nanos, Timestamp};
use bundlemocap::io::bus::Memory;
use bundlemocap::io::recording::{Message, Reader, Spans};
use bundlemocap::io::wire::Topics;
use bundlemocap::view::{Live, Recorded, Running, Source, bridge, start};
use expect_test::expect_file;
use nalgebra::Vector3;
use serde_json::json;

/// The body of the answer to a GET request, and the first line of the answer.
fn get(page: &Running, path: &str, header: &str) -> (String, Vec<u8>) {
    let url = page.url();
    let host = url.strip_prefix("http://").unwrap().split('/').next().unwrap();
    let mut stream = TcpStream::connect(host).unwrap();
    write!(stream, "GET {path} HTTP/1.1\r\nHost: {host}\r\n{header}Connection: close\r\n\r\n")
        .unwrap();
    let mut answer = Vec::new();
    stream.read_to_end(&mut answer).unwrap();
    let head = answer.windows(4).position(|four| four == b"\r\n\r\n").unwrap();
    let line = String::from_utf8_lossy(&answer).lines().next().unwrap().to_owned();
    (line, answer.split_off(head + 4))
}

fn walk() -> &'static Path {
    Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/recordings/walk.mcap"))
}

/// Topic and capture time of each frame, see the documentation of the module.
fn frames(mut bytes: &[u8]) -> Vec<(String, i64)> {
    let mut all = Vec::new();
    while !bytes.is_empty() {
        let length = u32::from_le_bytes(bytes[..4].try_into().unwrap()) as usize;
        let (topic, rest) = bytes[4..].split_at(length);
        let capture = i64::from_le_bytes(rest[..8].try_into().unwrap());
        let size = u32::from_le_bytes(rest[16..20].try_into().unwrap()) as usize;
        all.push((String::from_utf8(topic.to_vec()).unwrap(), capture));
        bytes = &rest[20 + size..];
    }
    all
}

#[test]
fn a_part_of_a_recording_is_served() {
    let recorded = Recorded::open(&[walk().to_owned()], || ()).unwrap();
    assert_eq!(recorded.overview().cameras.values().sum::<u64>(), 4 * 240);
    let page = start("127.0.0.1:0", Source::Recorded(Arc::new(recorded))).unwrap();
    let (status, about) = get(&page, "/about.json", "");
    assert!(status.contains("200"), "{status}");
    let about: serde_json::Value = serde_json::from_slice(&about).unwrap();
    assert_eq!(about["about"]["name"], "walk.mcap");
    assert_eq!(about["messages"]["Pose"]["8"][0], "joint_positions_m");
    let (_, part) = get(&page, "/messages?from=1000000000&to=1500000000&kinds=keypoints,state", "");
    let part = frames(&part);
    let (states, keypoints): (Vec<_>, Vec<_>) =
        part.into_iter().partition(|(topic, _)| topic.ends_with("/rig"));
    assert_eq!(states.len(), 1);
    let expected = Reader::open(walk()).unwrap().filter_map(|entry| match entry.unwrap().message {
        Message::Keypoints(frame) => Some(frame.capture_time_ns),
        _ => None,
    });
    let expected = expected.filter(|at| (1_000_000_000..1_500_000_000).contains(at)).count();
    assert!(expected >= 4 * 29 && keypoints.len() == expected, "{} of {expected}", keypoints.len());
    assert!(get(&page, "/", "Origin: http://example.org\r\n").0.contains("403"));
    assert!(get(&page, "/no.js", "").0.contains("404"));
    assert!(get(&page, "/bus", "").0.contains("400"), "not a WebSocket");
    assert!(
        get(&page, "/messages?from=0&to=1&kinds=pose", "Sec-Fetch-Site: cross-site\r\n")
            .0
            .contains("403")
    );
    // A recording without a topic of the wanted kind gives nothing.
    let (_, none) = get(&page, "/messages?from=0&to=2000000000&kinds=status", "");
    assert!(frames(&none).iter().all(|(topic, _)| topic.ends_with("/rig")));
}

#[test]
fn a_recording_without_an_index_gives_the_same_messages() {
    let folder = tempfile::tempdir().unwrap();
    let cut = folder.path().join("cut.mcap");
    let bytes = std::fs::read(walk()).unwrap();
    std::fs::write(&cut, &bytes[..bytes.len() * 9 / 10]).unwrap();
    let span = [1000, 1500].map(|ms| Timestamp::from_ns(0) + Nanos::from_ms(ms));
    let read = |path: &Path| {
        let wanted = |topic: &str| topic.ends_with("/keypoints");
        Spans::open(path).unwrap().read(span, wanted).unwrap()
    };
    let (whole, cut) = (read(walk()), read(&cut));
    assert!(whole.len() >= 4 * 29, "{}", whole.len());
    assert_eq!(whole, cut);
}

#[test]
fn an_address_in_use_is_refused_with_its_remedy() {
    let source =
        || Source::Recorded(Arc::new(Recorded::open(&[walk().to_owned()], || ()).unwrap()));
    let first = start("127.0.0.1:0", source()).unwrap();
    let url = first.url();
    let address = url.strip_prefix("http://").unwrap().trim_end_matches('/');
    let error = start(address, source()).err().unwrap().to_string();
    assert!(error.contains(address) && error.contains("give a free address"), "{error}");
    drop(first);
    start(address, source()).unwrap();
}

/// The rounded numbers of points, x y z x y z ...
fn rounded<'a>(numbers: impl IntoIterator<Item = &'a f64>) -> Vec<f64> {
    numbers.into_iter().map(|x| (x * 1e5).round() / 1e5).collect()
}

/// `tests/view` compares the page's skin with this file.
#[test]
fn a_skin_in_a_pose_is_as_in_the_file() {
    let shape = Shape(std::array::from_fn(|k| 0.3 * (k as f64 - 8.0)));
    let body = Skeleton::new(shape);
    let mut pose = Pose::rest();
    pose.root_rotation = so3::exp(&Vector3::new(0.2, 2.0, -0.3));
    pose.root_position = Vector3::new(0.5, 0.9, -1.0);
    let turn = |k: usize| 1.2 * libm::sin(7.0 * k as f64);
    let turns = |j| so3::exp(&Vector3::new(turn(3 * j), turn(3 * j + 1), turn(3 * j + 2)));
    pose.local = std::array::from_fn(turns);
    let posture = pose.posture(&body);
    let skin = Mesh::template().posed(&Mesh::template().rest(&body), &body, &pose);
    let rotations = std::iter::once(&pose.root_rotation).chain(&pose.local);
    let rotations: Vec<f64> = rotations.flat_map(so3::xyzw_from_rotation).collect();
    let offsets: Vec<f64> =
        Joint::ALL.iter().flat_map(|j| body.offset(*j).iter().copied()).collect();
    let vertices: serde_json::Map<_, _> = (0..skin.len())
        .step_by(101)
        .map(|k| (k.to_string(), json!(rounded(skin[k].iter()))))
        .collect();
    let file = json!({
        "offsets": rounded(&offsets),
        "joints": rounded(posture.positions.iter().flat_map(|p| p.iter())),
        "rotations": rounded(&rotations),
        "vertices": vertices,
    });
    expect_file!["../golden/skin.json"].assert_eq(&format!("{file}\n"));
}

#[test]
fn skins_are_served_and_wrong_bodies_are_refused() {
    let recorded = Recorded::open(&[walk().to_owned()], || ()).unwrap();
    let page = start("127.0.0.1:0", Source::Recorded(Arc::new(recorded))).unwrap();
    let (line, template) = get(&page, "/body.json", "");
    assert!(line.contains("200"), "{line}");
    let template: serde_json::Value = serde_json::from_slice(&template).unwrap();
    assert_eq!(template["parents"].as_array().unwrap().len(), 22);
    let offsets: Vec<String> = Joint::ALL
        .iter()
        .flat_map(|joint| {
            Skeleton::default().offset(*joint).iter().map(f64::to_string).collect::<Vec<_>>()
        })
        .collect();
    let (line, skin) = get(&page, &format!("/rest?offsets={}", offsets.join(",")), "");
    assert!(line.contains("200"), "{line}");
    let mesh = Mesh::template();
    assert_eq!(skin.len(), 6 * mesh.vertices().len());
    let x = i16::from_le_bytes([skin[0], skin[1]]);
    assert_eq!(f64::from(x), (1e4 * mesh.vertices()[0].x).round());
    for wrong in [
        "",
        "?offsets=",
        "?offsets=1,2,3",
        "?offsets=nan",
        &format!("?offsets={},0", offsets.join(",")),
    ] {
        let (line, _) = get(&page, &format!("/rest{wrong}"), "");
        assert!(line.contains("400"), "{wrong}: {line}");
    }
}

#[test]
fn an_address_in_use_is_refused_for_foxglove_too() {
    let taken = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let address = taken.local_addr().unwrap().to_string();
    let live = || Arc::new(Live::new(Topics::default(), || Ok(Box::new(Memory::new()))));
    let error = bridge(&address, live()).err().unwrap().to_string();
    assert!(error.starts_with("cannot serve Foxglove") && error.contains("8766"), "{error}");
    drop(taken);
    let url = bridge(&address, live()).unwrap().url();
    assert_eq!(url, format!("ws://{address}"));
}

//! The page's server, as a browser sees it. `tests/view` has the tests in a browser.

use std::io::{Read, Write};
use std::net::TcpStream;
use std::path::Path;
use std::sync::Arc;

use bundlemocap::core::time::{Nanos, Timestamp};
use bundlemocap::io::recording::{Message, Reader, Spans};
use bundlemocap::view::{Recorded, Running, Source, start};

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

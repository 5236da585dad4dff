//! Recordings: round trip, equal bytes, damage, foreign files, another implementation.

use std::collections::BTreeMap;
use std::path::Path;
use std::process::Command;

use bundlemocap::core::detections::Detections;
use bundlemocap::core::time::Timestamp;
use bundlemocap::io::recording::{
    Entry, METADATA, Message, Provenance, Reader, RecordError, Report, Writer, scan, summary,
};
use bundlemocap::io::wire::{self, Topics};
use expect_test::expect;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::messages::{WEIGHTS, detections, event, keyframe, rig, skeleton, stamped_pose};

const FRAMES: u64 = 400;
/// Chunk records have this opcode.
const CHUNK: u8 = 6;

fn frame(index: u64, camera: usize) -> Detections {
    let mut detections = detections();
    let mut noise = ChaCha8Rng::seed_from_u64(2 * index + camera as u64);
    for point in detections.people[0].points.iter_mut().flatten() {
        point.pixel.x = f64::from(noise.random_range(0.0..1280.0_f32));
        point.pixel.y = f64::from(noise.random_range(0.0..720.0_f32));
    }
    Detections { frame: index, camera, capture: Timestamp::of_frame(index, 60.0), ..detections }
}

/// A recording of two cameras with a message on every topic.
fn write_recording(path: &Path) {
    let provenance = Provenance {
        config: "window_frames = 10\n".into(),
        weights: "sha256:0123".into(),
        more: BTreeMap::from([("source".into(), "a test".into())]),
    };
    let mut writer = Writer::create(path, Topics::default(), &provenance).unwrap();
    let start = Timestamp::default();
    writer.rig(&rig(), start).unwrap();
    writer.skeleton(&skeleton(), start).unwrap();
    let (topics, body) = (Topics::default(), wire::Skeleton::from_core(&skeleton()));
    writer.write(&topics.truth_skeleton(), start, &body).unwrap();
    for index in 0..FRAMES {
        for (camera, name) in ["left", "right"].into_iter().enumerate() {
            writer.keypoints(&frame(index, camera), name, [1280, 720]).unwrap();
        }
    }
    writer.pose(&stamped_pose(1), &skeleton()).unwrap();
    let pose = stamped_pose(1);
    let of_pose = wire::Pose::from_core(&pose, &skeleton(), None);
    writer.write(&topics.truth(), pose.capture, &of_pose).unwrap();
    let at = keyframe().capture;
    writer.write(&topics.keyframe(), at, &wire::Keyframe::from_core(&keyframe(), WEIGHTS)).unwrap();
    let event = event();
    let of_event = topics.events(event.event_kind().unwrap());
    let at = Timestamp::from_ns(event.capture_time_ns);
    writer.write(&of_event, at, &event).unwrap();
    writer.write(&topics.status(), start, &wire::Status::default()).unwrap();
    writer.finish().unwrap();
}

fn recording() -> (tempfile::TempDir, Vec<u8>) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("whole.mcap");
    write_recording(&path);
    let bytes = std::fs::read(path).unwrap();
    (folder, bytes)
}

fn read(path: &Path) -> Result<(Vec<Entry>, Report), RecordError> {
    let mut reader = Reader::open(path)?;
    let entries = reader.by_ref().collect::<Result<_, _>>()?;
    Ok((entries, reader.report().clone()))
}

/// Writes `bytes` beside the recording and reads them.
fn read_bytes(folder: &tempfile::TempDir, bytes: &[u8]) -> (Vec<Entry>, Report) {
    let path = folder.path().join("changed.mcap");
    std::fs::write(&path, bytes).unwrap();
    read(&path).unwrap()
}

/// Offset, opcode and length (of the whole record) of every record outside chunks.
fn records(bytes: &[u8]) -> Vec<(usize, u8, usize)> {
    let (mut at, mut found) = (8, Vec::new());
    while at + 9 <= bytes.len() - 8 {
        let length = u64::from_le_bytes(bytes[at + 1..at + 9].try_into().unwrap());
        let length = 9 + usize::try_from(length).unwrap();
        found.push((at, bytes[at], length));
        at += length;
    }
    assert_eq!(at, bytes.len() - 8);
    found
}

fn chunks(bytes: &[u8]) -> Vec<(usize, usize)> {
    let all = records(bytes).into_iter().filter(|record| record.1 == CHUNK);
    all.map(|(at, _, length)| (at, length)).collect()
}

fn is_prefix(part: &[Entry], whole: &[Entry]) -> bool {
    part.len() <= whole.len() && part == &whole[..part.len()]
}

/// Whether `part` is `whole` without one run of entries.
fn lacks_one_run(part: &[Entry], whole: &[Entry]) -> bool {
    let same = part.iter().zip(whole).take_while(|(a, b)| a == b).count();
    let (rest, lost) = (&part[same..], whole.len() - part.len());
    rest == &whole[same + lost..]
}

#[test]
fn messages_are_read_in_the_order_of_writing() {
    let (folder, _) = recording();
    let (entries, report) = read(&folder.path().join("whole.mcap")).unwrap();
    assert!(report.is_clean(), "{report:?}");
    assert_eq!(entries.len() as u64, 2 * FRAMES + 8);
    let rig_came = matches!(&entries[0].message, Message::Rig(r) if r.to_core().is_ok());
    assert!(rig_came && matches!(&entries[1].message, Message::Skeleton(_)));
    assert!(matches!(&entries[2].message, Message::TruthSkeleton(_)));
    for (index, entry) in entries[3..3 + 2 * FRAMES as usize].iter().enumerate() {
        let expected = frame(index as u64 / 2, index % 2);
        let Message::Keypoints(keypoints) = &entry.message else { panic!("{entry:?}") };
        let found = keypoints.to_core(|name| rig().index_of(name)).unwrap();
        assert_eq!((entry.log_time, &found), (expected.capture, &expected));
    }
    let last: Vec<&Message> = entries.iter().rev().map(|entry| &entry.message).collect();
    assert!(matches!(last[0], Message::Status(_)));
    assert!(matches!(last[1], Message::Event(e) if *e == event()));
    assert!(matches!(last[2], Message::Keyframe(k) if k.to_core().is_ok()));
    assert!(matches!(last[3], Message::TruthPose(_)) && matches!(last[4], Message::Pose(_)));
    assert_eq!(&*entries[3].topic, "mocap/stage/camera/left/keypoints");
}

#[test]
fn the_same_input_gives_the_same_bytes() {
    assert_eq!(recording().1, recording().1);
}

#[test]
fn an_unfinished_recording_leaves_no_file() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("out.mcap");
    std::fs::write(&path, "as it was").unwrap();
    let mut writer = Writer::create(&path, Topics::default(), &Provenance::default()).unwrap();
    writer.rig(&rig(), Timestamp::default()).unwrap();
    drop(writer);
    assert_eq!(std::fs::read(&path).unwrap(), b"as it was");
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1);
}

#[test]
fn detections_that_no_reader_takes_are_not_written() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("out.mcap");
    let mut writer = Writer::create(&path, Topics::default(), &Provenance::default()).unwrap();
    let right = frame(0, 0);
    writer.keypoints(&right, "left", [640, 480]).unwrap();
    let mut wrong = right.clone();
    wrong.people[0].points.iter_mut().flatten().next().unwrap().pixel.y = f64::NAN;
    let error = writer.keypoints(&wrong, "left", [640, 480]).unwrap_err().to_string();
    assert!(error.contains("camera left, frame ") && error.contains("no finite pixel"), "{error}");
    let mut wrong = right;
    wrong.people[0].points.pop();
    let error = writer.keypoints(&wrong, "left", [640, 480]).unwrap_err().to_string();
    assert!(error.contains("a person has 16 points, coco_17 has 17"), "{error}");
}

#[test]
fn a_truncated_file_gives_its_first_messages_and_the_place_of_the_cut() {
    let (folder, bytes) = recording();
    let (whole, _) = read_bytes(&folder, &bytes);
    let records = records(&bytes);
    let mut cuts: Vec<usize> = records.iter().flat_map(|r| [r.0, r.0 + 5, r.0 + r.2 - 1]).collect();
    // A cut in the last eight bytes, which are no record, is reported at the footer.
    cuts.extend((8..bytes.len() - 8).step_by(bytes.len() / 60));
    let mut longest = 0;
    for cut in cuts {
        let (part, report) = read_bytes(&folder, &bytes[..cut]);
        assert!(is_prefix(&part, &whole), "cut at {cut}");
        let damage = report.damage.last().unwrap();
        let at = damage.offset as usize;
        let start = records.iter().rev().map(|r| r.0).find(|&start| start <= cut).unwrap();
        assert!(at == start || at == cut, "cut at {cut}, said {damage}");
        assert!(damage.to_string().starts_with(&format!("damaged at byte {at}: ")), "{damage}");
        let whole_chunks = chunks(&bytes).iter().filter(|(at, length)| at + length <= cut).count();
        assert!(whole_chunks == 0 || !part.is_empty(), "cut at {cut}");
        longest = longest.max(part.len());
    }
    assert_eq!(longest, whole.len());
}

#[test]
fn a_flipped_byte_loses_only_its_chunk() {
    let (folder, bytes) = recording();
    let (whole, _) = read_bytes(&folder, &bytes);
    let chunks = chunks(&bytes);
    assert!(chunks.len() >= 4, "{} chunks", chunks.len());
    let largest = whole.len() / (chunks.len() - 1) + 2;
    for &(at, length) in &chunks {
        let next = chunks.iter().map(|c| c.0).find(|&start| start > at).unwrap_or(bytes.len());
        // Opcode, length, uncompressed size, check sum, compression, compressed size, content.
        for place in [0, 1, 4, 8, 26, 34, 40, 46, 60, length / 2, length - 1] {
            let mut changed = bytes.clone();
            changed[at + place] ^= 0x55;
            let (part, report) = read_bytes(&folder, &changed);
            assert!(lacks_one_run(&part, &whole), "byte {place} of the chunk at {at}");
            let lost = whole.len() - part.len();
            assert!(lost <= largest, "{lost} lost by byte {place} of the chunk at {at}");
            let framing = place < 9;
            assert!(framing || lost > 0, "byte {place} of the chunk at {at}");
            assert_eq!(report.damage.len(), 1, "{report:?}");
            let said = report.damage[0].offset as usize;
            assert!(said == at || framing && (at..next).contains(&said), "{report:?}");
        }
    }
}

#[test]
fn flipped_bytes_never_panic_and_lost_messages_are_reported() {
    let (folder, bytes) = recording();
    let (whole, _) = read_bytes(&folder, &bytes);
    let mut rng = ChaCha8Rng::seed_from_u64(3);
    for _ in 0..300 {
        let mut changed = bytes.clone();
        let at = rng.random_range(8..bytes.len());
        changed[at] ^= rng.random_range(1..=255_u8);
        if rng.random_bool(0.3) {
            changed.truncate(rng.random_range(8..bytes.len()));
        }
        let (part, report) = read_bytes(&folder, &changed);
        assert!(part.len() == whole.len() || !report.is_clean(), "byte {at} unnoticed");
    }
}

#[test]
fn summaries_by_index_and_by_scan_agree() {
    let (folder, bytes) = recording();
    let path = folder.path().join("whole.mcap");
    let (by_index, by_scan) = (summary(&path).unwrap(), scan(&path).unwrap());
    assert!(!by_index.scanned && by_scan.scanned);
    assert_eq!(by_index.bytes as usize, bytes.len());
    assert_eq!((by_index.span, &by_index.metadata), (by_scan.span, &by_scan.metadata));
    assert_eq!((&by_index.rig, &by_index.cameras), (&by_scan.rig, &by_scan.cameras));
    for (topic, info) in &by_index.topics {
        assert_eq!(info.count, by_scan.topics[topic].count, "{topic}");
        assert_eq!(info.schema, by_scan.topics[topic].schema, "{topic}");
    }
    assert_eq!(by_index.topics.len(), by_scan.topics.len());
    assert_eq!(by_index.rig, ["left", "right"]);
    assert_eq!(by_index.cameras["left"].format, "coco_17");
    let left = &by_scan.topics["mocap/stage/camera/left/keypoints"];
    assert_eq!((left.count, left.rate.unwrap().round()), (FRAMES, 60.0));
    let ours = &by_index.metadata[METADATA];
    assert_eq!((ours["weights"].as_str(), ours["source"].as_str()), ("sha256:0123", "a test"));

    let cut = folder.path().join("cut.mcap");
    std::fs::write(&cut, &bytes[..bytes.len() * 2 / 3]).unwrap();
    let by_scan = summary(&cut).unwrap();
    assert!(by_scan.scanned && by_scan.report.damage.len() == 1, "{by_scan:?}");
}

#[test]
fn other_files_give_a_clear_error() {
    let folder = tempfile::tempdir().unwrap();
    let open = |name: &str, content: &[u8]| {
        let path = folder.path().join(name);
        std::fs::write(&path, content).unwrap();
        let error = read(&path).unwrap_err().to_string();
        error.replace(&folder.path().display().to_string(), "…")
    };
    let missing = read(&folder.path().join("missing.mcap")).unwrap_err().to_string();
    assert!(missing.contains("missing.mcap"), "{missing}");

    let messages = [
        open("text.mcap", b"{\"people\": []}"),
        open("empty.mcap", b""),
        open("foreign.mcap", &foreign()),
        open("no-index.mcap", &without_index(&foreign())),
    ];
    expect![[r#"
    …/text.mcap is not an MCAP recording: it begins with "{\"people"; make one with `bundlemocap import`
    …/empty.mcap is not an MCAP recording: it is empty; make one with `bundlemocap import`
    …/foreign.mcap holds no messages of bundlemocap.v1, but /imu (sensor_msgs/Imu), /log (sensor_msgs/Imu); make a recording of keypoints with `bundlemocap import`
    …/no-index.mcap holds no messages of bundlemocap.v1, but /imu (sensor_msgs/Imu), /log (sensor_msgs/Imu); make a recording of keypoints with `bundlemocap import`"#]]
    .assert_eq(&messages.join("\n"));
}

/// A recording of another program.
fn foreign() -> Vec<u8> {
    let mut file = std::io::Cursor::new(Vec::new());
    let mut writer = mcap::Writer::new(&mut file).unwrap();
    let schema = writer.add_schema("sensor_msgs/Imu", "ros1msg", b"").unwrap();
    let imu = writer.add_channel(schema, "/imu", "ros1", &BTreeMap::new()).unwrap();
    let log = writer.add_channel(schema, "/log", "json", &BTreeMap::new()).unwrap();
    for channel_id in [imu, log] {
        let header =
            mcap::records::MessageHeader { channel_id, sequence: 0, log_time: 1, publish_time: 1 };
        writer.write_to_known_channel(&header, b"abc").unwrap();
    }
    writer.finish().unwrap();
    drop(writer);
    file.into_inner()
}

/// The same file with a footer without a summary.
fn without_index(bytes: &[u8]) -> Vec<u8> {
    let (end, _, _) = records(bytes).into_iter().find(|record| record.1 == 0x0f).unwrap();
    let footer = [vec![2], 20_u64.to_le_bytes().to_vec(), vec![0; 20]].concat();
    [&bytes[..end + 13], &footer, mcap::MAGIC].concat()
}

#[test]
fn a_recording_without_an_index_can_be_read() {
    let (folder, bytes) = recording();
    let (whole, _) = read_bytes(&folder, &bytes);
    let (at, length) = chunks(&bytes)[2];
    let mut changed = without_index(&bytes);
    changed[at + length / 2] ^= 0x55;
    let (part, report) = read_bytes(&folder, &changed);
    assert!(part.len() < whole.len() && lacks_one_run(&part, &whole));
    assert_eq!((report.damage.len(), report.damage[0].offset as usize), (1, at));

    let (same, report) = read_bytes(&folder, &without_index(&bytes));
    assert!(report.is_clean() && same == whole, "{report:?}");
}

#[test]
fn unusable_messages_are_counted() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("some.mcap");
    let topics = Topics::default();
    let mut writer = Writer::create(&path, topics.clone(), &Provenance::default()).unwrap();
    let mut bad = wire::KeypointFrame::from_core(&detections(), "left", [1280, 720]);
    let at = Timestamp::from_ns(1);
    writer.write(&topics.keypoints("left"), at, &bad).unwrap();
    bad.format = "body_26".into();
    writer.write(&topics.keypoints("left"), at, &bad).unwrap();
    writer.write(&topics.keypoints("left"), at, &bad).unwrap();
    writer.finish().unwrap();
    let (entries, report) = read(&path).unwrap();
    let undecodable = &report.undecodable["mocap/stage/camera/left/keypoints"];
    assert_eq!((entries.len(), undecodable.count), (1, 2));
    assert!(undecodable.first.contains("body_26") && report.damage.is_empty());
}

/// Reads the file with the `mcap` and `mcap-protobuf-support` packages: topic, count, and a few
/// values of each message.
const READ_WITH_PYTHON: &str = r#"
import sys
try:
    from mcap.reader import make_reader
    from mcap_protobuf.decoder import DecoderFactory
except ImportError as error:
    print("no package:", error)
    sys.exit(0)
counts = {}
with open(sys.argv[1], "rb") as file:
    reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
    for schema, channel, message, decoded in reader.iter_decoded_messages():
        counts[channel.topic] = counts.get(channel.topic, 0) + 1
        if schema.name == "bundlemocap.v1.KeypointFrame" and decoded.frame == 7:
            points = decoded.people[0].points
            print(decoded.camera, decoded.capture_time_ns, decoded.people[0].id, len(points))
        if schema.name == "bundlemocap.v1.Keyframe":
            print("keyframe", decoded.window, list(decoded.z[:3]), decoded.root_position_m[1])
    for metadata in reader.iter_metadata():
        print(metadata.name, metadata.metadata["weights"])
for topic, count in sorted(counts.items()):
    print(topic, count)
"#;

#[test]
fn another_implementation_reads_the_same_messages() {
    let (folder, _) = recording();
    let path = folder.path().join("whole.mcap");
    let Ok(output) = Command::new("python3").args(["-c", READ_WITH_PYTHON]).arg(path).output()
    else {
        crate::support::skipped("python3 is not installed");
        return;
    };
    let said = String::from_utf8_lossy(&output.stdout);
    if said.starts_with("no package") {
        crate::support::skipped(&format!(
            "{} (pip install mcap mcap-protobuf-support)",
            said.trim()
        ));
        return;
    }
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    expect![[r#"
    left 116666667 -3 51
    right 116666667 -3 51
    keyframe 12 [-2.0, -1.875, -1.75] 0.875
    bundlemocap sha256:0123
    mocap/stage/actor/actor/keyframe 1
    mocap/stage/actor/actor/pose 1
    mocap/stage/actor/actor/skeleton 1
    mocap/stage/actor/actor/status 1
    mocap/stage/actor/actor/truth 1
    mocap/stage/actor/actor/truth/skeleton 1
    mocap/stage/camera/left/keypoints 400
    mocap/stage/camera/right/keypoints 400
    mocap/stage/events 1
    mocap/stage/rig 1
    "#]]
    .assert_eq(&said);
}

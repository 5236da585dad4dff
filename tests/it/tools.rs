//! The tools on the bus: the built program, with a router in place of the node.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::time::{Duration, Instant};

use bundlemocap::core::body::Skeleton;
use bundlemocap::core::time::Timestamp;
use bundlemocap::io::bus::{Bus, Sample, Zenoh, ZenohConfig};
use bundlemocap::io::recording::{Provenance, RawEntry, Reader, Writer};
use bundlemocap::io::wire::{self, Schema, Take, TakeAnswer, Topics, encode, media_type};
use bundlemocap::research::synth::{Motion, MotionStyle, Recording, ring_rig};
use serde_json::Value;
use tempfile::TempDir;

use crate::program::{PATIENCE, Program};

const PROGRAM: &str = env!("CARGO_BIN_EXE_bundlemocap");
const CAMERAS: usize = 3;
const FRAMES: u64 = 30;

fn router() -> Zenoh {
    let listen = vec!["tcp/127.0.0.1:0".into()];
    Zenoh::open_node(&ZenohConfig { listen, ..ZenohConfig::default() }).unwrap()
}

/// A folder and the arguments to reach the router.
struct Place {
    folder: TempDir,
    router: Zenoh,
}

impl Place {
    fn new() -> Self {
        Self { folder: tempfile::tempdir().unwrap(), router: router() }
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    fn command(&self, line: &str) -> Command {
        let mut command = Command::new(PROGRAM);
        command.args(line.split_whitespace()).current_dir(self.folder.path());
        command.arg("--connect").arg(&self.router.listens_on()[0]);
        command
    }

    fn done(&self, line: &str) -> String {
        let output = self.command(line).output().unwrap();
        let errors = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(0), "{line}: {errors}");
        String::from_utf8(output.stdout).unwrap()
    }

    /// `record`, when it listens.
    fn recorder(&self, name: &str) -> Program {
        Self::listening(self.command(&format!("record {name}")))
    }

    fn listening(mut command: Command) -> Program {
        let mut recorder = Program::start(&mut command);
        assert!(recorder.has_said("mocap/stage/** to"));
        recorder
    }
}

/// The synthetic walk, one camera after the other, as importers write it.
fn walk(path: &Path) {
    let rig = ring_rig(CAMERAS, 4.0, 1.6).unwrap();
    let skeleton = Skeleton::default();
    let motion = Motion::new(&skeleton, MotionStyle::default());
    let mut recording = Recording::new(rig, skeleton, |seconds| motion.pose(seconds));
    recording.frames = FRAMES;
    recording.start = Timestamp::from_ns(1_000_000_000);
    let mut writer = Writer::create(path, Topics::default(), &Provenance::default()).unwrap();
    writer.rig(&recording.rig, Timestamp::default()).unwrap();
    let mut all: Vec<_> = recording.detections().collect();
    all.sort_by_key(|detections| detections.camera);
    for detections in all {
        let camera = &recording.rig.cameras[detections.camera];
        writer.keypoints(&detections, &camera.name, [camera.width, camera.height]).unwrap();
    }
    for pose in recording.poses().take(3) {
        writer.pose(&pose, &recording.skeleton).unwrap();
    }
    writer.finish().unwrap();
}

fn raw(path: &Path) -> (Vec<RawEntry>, usize) {
    let Ok(mut reader) = Reader::open(path) else { return (Vec::new(), 0) };
    let mut entries = Vec::new();
    while let Some(entry) = reader.next_raw() {
        match entry {
            Ok(entry) => entries.push(entry),
            // While the file is still empty.
            Err(_) => break,
        }
    }
    (entries, reader.report().damage.len())
}

/// Payloads by topic, in order.
fn payloads(path: &Path) -> BTreeMap<String, Vec<Vec<u8>>> {
    let mut topics = BTreeMap::<_, Vec<_>>::new();
    for entry in raw(path).0 {
        topics.entry(entry.topic.to_string()).or_default().push(entry.payload);
    }
    topics
}

/// Waits until an unfinished recording holds a number of messages.
fn wait_for_messages(part: &Path, count: usize) {
    let begin = Instant::now();
    while raw(part).0.len() < count {
        assert!(begin.elapsed() < PATIENCE, "{} of {count} messages", raw(part).0.len());
        std::thread::sleep(Duration::from_millis(50));
    }
}

#[test]
fn played_messages_are_recorded_byte_for_byte() {
    let place = Place::new();
    walk(&place.path("walk.mcap"));
    let recorder = place.recorder("take.mcap");
    let said = place.done("play walk.mcap --keep-times --speed 0.5");
    assert!(said.contains("cam01") && said.contains("30 frames"), "{said}");
    wait_for_messages(&place.path("take.mcap.part"), 1 + CAMERAS * FRAMES as usize);
    let said = recorder.interrupted(0);
    assert!(said.contains("91 messages"), "{said}");
    assert!(!place.path("take.mcap.part").exists());

    let mut expected = payloads(&place.path("walk.mcap"));
    expected.remove(&Topics::default().pose());
    assert_eq!(expected.len(), 1 + CAMERAS);
    assert!(payloads(&place.path("take.mcap")) == expected);
    let (entries, damage) = raw(&place.path("take.mcap"));
    assert_eq!(damage, 0);
    assert!(entries.iter().all(|entry| entry.schema.starts_with("bundlemocap.v1.")));
    let keypoints = entries.iter().filter(|entry| entry.topic.ends_with("keypoints"));
    for entry in keypoints {
        let frame: wire::KeypointFrame = wire::decode(&entry.payload).unwrap();
        assert_eq!(frame.capture_time_ns, entry.publish_time.ns());
        assert!(entry.log_time > entry.publish_time);
    }
    let again = place.command("record take.mcap").output().unwrap();
    fails(&again, 2, "--overwrite");
}

#[test]
fn a_player_that_no_node_hears_is_told() {
    let place = Place::new();
    walk(&place.path("walk.mcap"));
    let publisher = place.router.publisher(&Topics::default().status()).unwrap();
    let cameras = [("cam01", 60.0), ("cam02", 0.0), ("other", 0.0)].map(|(camera, rate_hz)| {
        wire::CameraCounters { camera: camera.into(), rate_hz, ..wire::CameraCounters::default() }
    });
    let status = wire::Status { cameras: cameras.into(), ..wire::Status::default() };
    let encoding = media_type(wire::Status::FULL_NAME);
    publisher.put(Timestamp::default(), &encoding, &encode(&status)).unwrap();
    for (speed, lasted) in [("0.1", true), ("1", false)] {
        let played = place.command(&format!("play walk.mcap --speed {speed}")).output().unwrap();
        let errors = String::from_utf8_lossy(&played.stderr);
        let told = errors.contains("no frame of cam02 has reached the node: may this program");
        assert_eq!((played.status.code(), told), (Some(0), lasted), "{errors}");
    }
    let played = place.command("play walk.mcap --speed 0.1 --stage other").output().unwrap();
    let errors = String::from_utf8_lossy(&played.stderr);
    assert!(errors.contains("note: no node publishes its status on stage other"), "{errors}");
}

#[test]
fn a_take_that_cannot_be_written_does_not_end_the_recorder() {
    let place = Place::new();
    let topics = Topics::default();
    let (sender, answers) = std::sync::mpsc::channel();
    let sink = Box::new(move |sample: Sample| drop(sender.send(sample)));
    let _answers = place.router.subscribe(&topics.take_answers(), sink).unwrap();
    // A file may have at most 100 to 200 kB.
    let mut command = Command::new("sh");
    command.args([
        "-c",
        r#"trap '' XFSZ; ulimit -f 200; exec "$0" "$@""#,
        PROGRAM,
        "record",
        "takes/",
    ]);
    command.args(["--connect", &place.router.listens_on()[0]]).current_dir(place.folder.path());
    let recorder = Place::listening(command);
    let answer = |id: u64| -> TakeAnswer {
        let begin = Instant::now();
        loop {
            let sample = answers.recv_timeout(PATIENCE).expect("an answer");
            let answer: TakeAnswer = wire::decode(&sample.payload).unwrap();
            if answer.id == id && answer.free_bytes == 0 {
                return answer;
            }
            assert!(begin.elapsed() < PATIENCE);
        }
    };
    let takes = place.router.publisher(&topics.take()).unwrap();
    let put = |id: u64, action: &str, name: &str| {
        let take = Take { id, action: action.into(), name: name.into(), ..Take::default() };
        takes.put(Timestamp::default(), &media_type(Take::FULL_NAME), &encode(&take)).unwrap();
    };
    put(1, "start", "large");
    assert!(!answer(1).refused);
    let mut random = 1_u64;
    let mut byte = || {
        random = random.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
        (random >> 56) as u8
    };
    let payload: Vec<u8> = (0..1_000_000).map(|_| byte()).collect();
    let other = place.router.publisher("mocap/stage/mixer/gain").unwrap();
    other.put(Timestamp::default(), "", &payload).unwrap();
    let told = answer(0);
    assert!(
        told.refused && told.text.contains("large.mcap: what follows is not recorded"),
        "{told:?}"
    );
    put(2, "stop", "large");
    let told = answer(2);
    assert!(told.refused && told.text.contains("large.mcap is not complete"), "{told:?}");
    put(3, "start", "small");
    assert!(!answer(3).refused);
    put(4, "stop", "small");
    assert!(!answer(4).refused);
    assert_eq!(raw(&place.path("takes/small.mcap")).1, 0);
    recorder.interrupted(6);
}

#[test]
fn a_recording_survives_a_kill() {
    /// Count of the events that are sent until the first arrives.
    const PROBE: u64 = 1000;
    let place = Place::new();
    let topics = Topics::default();
    let recorder = place.recorder("take.mcap");
    let publisher = place.router.publisher(&topics.stage_events()).unwrap();
    let encoding = media_type("bundlemocap.v1.Event");
    let put = |count| {
        let event = wire::Event { kind: "late".into(), count, ..wire::Event::default() };
        publisher.put(Timestamp::from_ns(5), &encoding, &encode(&event)).unwrap();
    };
    let part = place.path("take.mcap.part");
    // The subscription may reach the publisher a moment after the recorder has started.
    let begin = Instant::now();
    while raw(&part).0.is_empty() {
        assert!(begin.elapsed() < PATIENCE, "no message");
        put(PROBE);
        std::thread::sleep(Duration::from_millis(100));
    }
    (1..=40).for_each(put);
    let count = |entry: &RawEntry| match entry.message().unwrap() {
        bundlemocap::io::recording::Message::Event(event) => event.count,
        other => panic!("{other:?}"),
    };
    while raw(&part).0.last().map(count) != Some(40) {
        assert!(begin.elapsed() < PATIENCE, "not all messages");
        std::thread::sleep(Duration::from_millis(50));
    }
    drop(recorder);

    assert!(!place.path("take.mcap").exists());
    let (entries, damage) = raw(&part);
    assert_eq!(damage, 1);
    let counts = entries.iter().map(count).filter(|count| *count != PROBE);
    assert_eq!(counts.collect::<Vec<_>>(), (1..=40).collect::<Vec<_>>());
    fails(&place.command("record take.mcap").output().unwrap(), 1, "take.mcap.part");
}

#[test]
fn echo_prints_states_to_late_joiners() {
    let place = Place::new();
    let publisher = place.router.publisher(&Topics::default().rig()).unwrap();
    let rig = wire::Rig::from_core(&ring_rig(CAMERAS, 4.0, 1.6).unwrap());
    publisher.put(Timestamp::from_ns(5), &media_type("bundlemocap.v1.Rig"), &encode(&rig)).unwrap();
    let said = place.done("echo rig --count 1");
    assert!(
        said.contains("stage/rig") && said.contains("3 cameras: cam01, cam02, cam03"),
        "{said}"
    );
    let object: Value = serde_json::from_str(&place.done("echo rig --count 1 --json")).unwrap();
    assert_eq!(object["message"]["cameras"][2]["name"], "cam03");
    assert_eq!(object["bytes"], encode(&rig).len());
}

fn fails(output: &Output, code: i32, evidence: &str) {
    let errors = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(code), "{errors}");
    assert_eq!(errors.lines().count(), 1, "{errors}");
    assert!(errors.starts_with("error: ") && errors.contains(evidence), "{errors}");
}

#[test]
fn bad_arguments_and_a_missing_node_give_a_one_line_error() {
    let folder = tempfile::tempdir().unwrap();
    walk(&folder.path().join("walk.mcap"));
    let run = |line: &str| {
        let mut command = Command::new(PROGRAM);
        command.args(line.split_whitespace()).current_dir(folder.path()).output().unwrap()
    };
    for line in ["play walk.mcap", "echo all", "record take.mcap"] {
        fails(&run(&format!("{line} --connect tcp/127.0.0.1:1")), 13, "nothing answers");
    }
    assert!(!folder.path().join("take.mcap.part").exists());
    fails(&run("play walk.mcap --speed 0"), 2, "--speed is 0");
    fails(&run("play walk.mcap --drop 1.5"), 2, "--drop is 1.5");
    fails(&run("play walk.mcap --late-ms -1"), 2, "--late-ms is -1");
    fails(&run("play walk.mcap --start-at 5"), 2, "must be 0 to 86400 s ahead");
    fails(&run("take clock cam01 fast"), 2, "clock needs milliseconds");
    fails(&run("take mend cam01 5"), 2, "one word too many");
    fails(&run("take name p1 -x"), 2, "-x");
    fails(&run("play walk.mcap --camera cam9"), 8, "cam01, cam02, cam03");
    fails(&run("play nothing.mcap"), 3, "nothing.mcap");
    fails(&run("echo all --stage a/b"), 2, "--stage: \"a/b\"");
}

/// Pose messages by capture time.
fn poses(path: &Path) -> BTreeMap<i64, wire::Pose> {
    let entries = raw(path).0.into_iter().filter(|entry| entry.topic.ends_with("/pose"));
    let poses = entries.map(|entry| wire::decode::<wire::Pose>(&entry.payload).unwrap());
    poses.map(|pose| (pose.capture_time_ns, pose)).collect()
}

#[test]
fn keyframes_alone_give_the_solved_poses() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let walk = Path::new(env!("CARGO_MANIFEST_DIR")).join("recordings/walk.mcap");
    let run = |line: &str| {
        let mut command = Command::new(PROGRAM);
        command.args(line.split_whitespace()).current_dir(folder.path()).output().unwrap()
    };
    assert!(run(&format!("solve {} --out out", walk.display())).status.success());
    // Only keyframes are left.
    let mut keyframes =
        Writer::create(at("keyframes.mcap"), Topics::default(), &Provenance::default()).unwrap();
    let (entries, _) = raw(&at("out/poses.mcap"));
    for entry in entries.iter().filter(|entry| entry.topic.ends_with("keyframe")) {
        keyframes.write_raw(entry).unwrap();
    }
    keyframes.finish().unwrap();
    let output = run("decode keyframes.mcap --out again.mcap");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));

    let other = keyframes_of_other_weights(&entries);
    std::fs::write(at("other.mcap"), other).unwrap();
    fails(&run("decode other.mcap --out no.mcap"), 11, "--weights");
    fails(&run("decode again.mcap --out no.mcap"), 12, "no usable keyframes");
    assert!(!at("no.mcap").exists());

    let (solved, again) = (poses(&at("out/poses.mcap")), poses(&at("again.mcap")));
    assert!(solved.len() > 200);
    let mut different = 0;
    for (time, pose) in &solved {
        // Keyframes do not tell how certain they are.
        let pose = wire::Pose { joint_deviations_m: Vec::new(), ..pose.clone() };
        different += usize::from(pose != again[time]);
    }
    assert_eq!(different, 0, "of {}", solved.len());
    assert_eq!(again.len(), solved.len());
}

/// A recording of the first keyframe with the hash of other weights.
fn keyframes_of_other_weights(entries: &[RawEntry]) -> Vec<u8> {
    let first = entries.iter().find(|entry| entry.topic.ends_with("keyframe")).unwrap();
    let mut keyframe: wire::Keyframe = wire::decode(&first.payload).unwrap();
    keyframe.weights = "0123456789abcdef".into();
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("other.mcap");
    let mut writer = Writer::create(&path, Topics::default(), &Provenance::default()).unwrap();
    writer.write_raw(&RawEntry { payload: encode(&keyframe), ..first.clone() }).unwrap();
    writer.finish().unwrap();
    std::fs::read(path).unwrap()
}

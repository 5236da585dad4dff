//! The built program: a round trip; every bad input gives one line of error and its own exit code.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use bundlemocap::core::body::{Joint, Pose, Shape, Skeleton, StampedPose, TrackingState};
use bundlemocap::core::camera::Rig;
use bundlemocap::core::detections::{Detections, Person};
use bundlemocap::core::random::Draws;
use bundlemocap::core::time::{Nanos, Timestamp};
use bundlemocap::io::formats::bvh::Bvh;
use bundlemocap::io::formats::{Up, read_trajectories, write_calibration};
use bundlemocap::io::recording::{Message, Provenance, RawEntry, Reader, TAKE, Writer, last_body};
use bundlemocap::io::wire::{self, Topics};
use bundlemocap::metrics::segment_lengths;
use bundlemocap::research::synth::{Motion, MotionStyle, Noise, Recording, ring_rig};
use nalgebra::{Matrix3, Vector3};
use serde_json::{Value, json};
use tempfile::TempDir;

use crate::program::{Ended, Program};
use crate::support::{data, pinned};

const USAGE: i32 = 2;
const UNREADABLE: i32 = 3;
const MALFORMED: i32 = 4;
const NOBODY_FOUND: i32 = 5;
const IN_PART: i32 = 6;
const NO_DETECTIONS: i32 = 7;
const CAMERA_MISMATCH: i32 = 8;
const BAD_CALIBRATION: i32 = 9;
const KEYPOINT_FORMAT: i32 = 10;
const WEIGHTS: i32 = 11;
const NOT_OURS: i32 = 12;

/// A separate folder in which the program runs.
struct Place(TempDir);

impl Place {
    fn new() -> Self {
        Self(tempfile::tempdir().unwrap())
    }

    fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    fn write(&self, name: &str, text: impl AsRef<[u8]>) -> PathBuf {
        let path = self.path(name);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(&path, text).unwrap();
        path
    }

    fn lines(&self, name: &str) -> Vec<String> {
        fs::read_to_string(self.path(name)).unwrap().lines().map(str::to_owned).collect()
    }

    fn run(&self, command: &str) -> Output {
        self.command(command).output().unwrap()
    }

    fn command(&self, command: &str) -> Command {
        let mut program = Command::new(env!("CARGO_BIN_EXE_bundlemocap"));
        program.args(command.split_whitespace()).current_dir(self.0.path());
        program
    }

    fn start(&self, command: &str) -> Program {
        Program::start(&mut self.command(command))
    }

    /// Runs and expects success; returns the standard output.
    fn done(&self, command: &str) -> String {
        let output = self.run(command);
        let errors = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(0), "{command}: {errors}");
        String::from_utf8(output.stdout).unwrap()
    }

    /// Runs and expects that exit code, one line of error that holds all of `evidence`, and no
    /// output.
    fn fails(&self, code: i32, command: &str, evidence: &[&str]) {
        let output = self.run(command);
        let errors = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(code), "{command}: {errors}");
        assert_eq!(errors.lines().count(), 1, "{command}: {errors}");
        assert!(errors.starts_with("error: "), "{command}: {errors}");
        for part in evidence {
            assert!(errors.contains(part), "{command}: {part:?} is not in: {errors}");
        }
        assert!(!self.path("out").exists(), "{command}: a folder is left behind");
        assert!(!self.path("out.mcap").exists(), "{command}: a recording is left behind");
        let left = files(self.0.path()).into_iter().filter(|path| is_temporary(path)).count();
        assert_eq!(left, 0, "{command}: a temporary file is left behind");
    }
}

fn files(folder: &Path) -> Vec<PathBuf> {
    fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path()).collect()
}

fn is_temporary(path: &Path) -> bool {
    path.file_name().unwrap().to_string_lossy().starts_with('.')
}

/// A calibration of named cameras with a focal length of `width` pixels.
fn calibration(names: &[&str], focal: f64) -> String {
    let camera = |(index, name): (usize, &&str)| {
        format!(
            "[{name}]\nname = \"{name}\"\nsize = [640.0, 480.0]\n\
             matrix = [[{focal:?}, 0.0, 320.0], [0.0, {focal:?}, 240.0], [0.0, 0.0, 1.0]]\n\
             distortions = [0.0, 0.0, 0.0, 0.0]\nrotation = [1.57, 0.0, 0.0]\n\
             translation = [{index}.0, 1.0, 4.0]\nfisheye = false\n\n"
        )
    };
    names.iter().enumerate().map(camera).collect()
}

/// A recording of those frames, one camera after the other.
fn write_sorted(path: &Path, mut frames: Vec<Detections>) {
    let rig = ring_rig(4, 4.0, 1.6).unwrap();
    frames.sort_by_key(|frame| frame.camera);
    let mut writer = Writer::create(path, Topics::default(), &Provenance::default()).unwrap();
    writer.rig(&rig, Timestamp::default()).unwrap();
    for frame in &frames {
        let camera = &rig.cameras[frame.camera];
        writer.keypoints(frame, &camera.name, [camera.width, camera.height]).unwrap();
    }
    writer.finish().unwrap();
}

/// One frame of two cameras; each person has a given count of numbers.
fn detections(place: &Place, cameras: &[&str], numbers: usize) {
    let points = vec!["1.0"; numbers].join(",");
    let people = match numbers {
        0 => String::new(),
        _ => format!("{{\"person_id\":[-1],\"pose_keypoints_2d\":[{points}]}}"),
    };
    for camera in cameras {
        for frame in 0..20 {
            let text = format!("{{\"version\":1.3,\"people\":[{people}]}}");
            place.write(&format!("pose/{camera}_json/{camera}.{frame:04}.json"), text);
        }
    }
}

const IMPORT: &str = "import pose --calibration calib.toml --fps 60 --out out.mcap";

/// A recording of the synthetic walk; `keep` filters the detections.
fn walk(
    path: &Path,
    frames: u64,
    keep: impl FnMut(&mut bundlemocap::core::detections::Detections) -> bool,
) {
    synthetic(path, frames, Noise::jitter_only(), keep);
}

/// The same with other detectors.
fn synthetic(
    path: &Path,
    frames: u64,
    noise: Noise,
    keep: impl FnMut(&mut bundlemocap::core::detections::Detections) -> bool,
) {
    before(ring_rig(4, 4.0, 1.6).unwrap(), path, frames, noise, keep);
}

/// The same before other cameras.
fn before(
    rig: Rig,
    path: &Path,
    frames: u64,
    noise: Noise,
    keep: impl FnMut(&mut bundlemocap::core::detections::Detections) -> bool,
) {
    let skeleton = Skeleton::default();
    let motion = Motion::new(&skeleton, MotionStyle::default());
    let mut recording = Recording::new(rig, skeleton, |seconds| motion.pose(seconds));
    recording.frames = frames;
    recording.noise = noise;
    save(path, &recording, keep);
}

fn save<M: Fn(f64) -> Pose>(
    path: &Path,
    recording: &Recording<M>,
    mut keep: impl FnMut(&mut bundlemocap::core::detections::Detections) -> bool,
) {
    let mut writer = Writer::create(path, Topics::default(), &Provenance::default()).unwrap();
    writer.rig(&recording.rig, Timestamp::default()).unwrap();
    for mut detections in recording.detections() {
        if keep(&mut detections) {
            let camera = &recording.rig.cameras[detections.camera];
            writer.keypoints(&detections, &camera.name, [camera.width, camera.height]).unwrap();
        }
    }
    writer.finish().unwrap();
}

/// Writes a folder of OpenPose's for each camera of the synthetic walk, by the names of [`ring_rig`]'s cameras.
fn walk_in_folders(place: &Place, folders: [&str; 4]) {
    in_folders(place, folders, ring_rig(4, 4.0, 1.6).unwrap());
}

fn in_folders(place: &Place, folders: [&str; 4], rig: Rig) {
    before(rig, &place.path("walk.mcap"), 60, Noise::jitter_only(), |detections| {
        let folder = folders[detections.camera];
        let person = |person: &Person| {
            let points = person.points.iter().map(|point| match point {
                Some(at) => [at.pixel.x, at.pixel.y, at.confidence],
                None => [0.0; 3],
            });
            json!({ "pose_keypoints_2d": points.flatten().collect::<Vec<_>>() })
        };
        let people: Vec<Value> = detections.people.iter().map(person).collect();
        let name = format!("pose/{folder}/{folder}.{:04}.json", detections.frame);
        place.write(&name, json!({ "people": people }).to_string());
        true
    });
    place.done("rig convert walk.mcap --out calib.toml");
}

#[test]
fn files_without_a_cameras_name_are_given_to_the_cameras_that_agree() {
    let said = |place: &Place, command: &str| {
        let output = place.run(command);
        let errors = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(0), "{errors}");
        (String::from_utf8(output.stdout).unwrap(), errors)
    };
    // In order: all is well.
    let place = Place::new();
    walk_in_folders(&place, ["back", "front", "left", "right"]);
    let (found, errors) = said(&place, IMPORT);
    assert!(found.contains("back   -> cam01 (by order)"), "{found}");
    assert!(errors.contains("4 of 4 files have no camera's name"), "{errors}");
    assert!(
        errors.contains("camera's name; the cameras agree") && !errors.contains("warning"),
        "{errors}"
    );
    let messages = |place: &Place| -> Vec<Message> {
        Reader::open(place.path("out.mcap")).unwrap().map(|entry| entry.unwrap().message).collect()
    };
    let right = messages(&place);
    assert!(right.len() == 241, "{}", right.len());
    // In another order; one has a name.
    let place = Place::new();
    walk_in_folders(&place, ["right", "cam02", "left", "back"]);
    let (found, errors) = said(&place, IMPORT);
    for (folder, camera) in [("right ", "cam01"), ("left  ", "cam03"), ("back  ", "cam04")] {
        assert!(found.contains(&format!("{folder} -> {camera} (exchanged)")), "{found}");
    }
    assert!(
        found.contains("cam02  -> cam02 (by name)") && !errors.contains("warning"),
        "{found}{errors}"
    );
    assert_eq!(messages(&place), right);
    // The command that does it again without a try is kept.
    let info = place.done("info out.mcap");
    assert!(info.contains("--camera left=cam03"), "{info}");
    let left = fs::read_dir(place.path(".")).unwrap().map(|entry| entry.unwrap().file_name());
    assert!(left.into_iter().all(|name| !name.to_string_lossy().starts_with('.')));
    // What the user says is not changed, but it is said.
    let given = "--camera right=cam04 --camera back=cam01 --camera left=cam03 --overwrite";
    let (found, errors) = said(&place, &format!("{IMPORT} {given}"));
    assert!(found.contains("right  -> cam04 (as given)"), "{found}");
    assert!(errors.contains("its images are those of camera cam01"), "{errors}");
}

#[test]
fn of_two_files_without_a_cameras_name_the_order_is_found() {
    let place = Place::new();
    walk_in_folders(&place, ["two", "unused", "one", "unused"]);
    fs::remove_dir_all(place.path("pose/unused")).unwrap();
    let all = fs::read_to_string(place.path("calib.toml")).unwrap();
    let cameras =
        all.split("\n\n").filter(|part| !part.contains("cam02") && !part.contains("cam04"));
    place.write("calib.toml", cameras.collect::<Vec<_>>().join("\n\n"));
    let found = place.done(IMPORT);
    assert!(found.contains("one  -> cam03 (exchanged)"), "{found}");
    // In the right order nothing is exchanged, whatever else is wrong.
    fs::rename(place.path("pose/two"), place.path("pose/a")).unwrap();
    let found = place.done(&format!("{IMPORT} --overwrite --unit ft --up y"));
    assert!(found.contains("one  -> cam03 (by order)"), "{found}");
}

#[test]
fn files_without_a_cameras_name_may_be_fewer_than_the_cameras() {
    let place = Place::new();
    let mut rig = ring_rig(4, 4.0, 1.6).unwrap();
    // Turned, a ring of cameras fits as well; so each has a distance of its own.
    for (index, camera) in rig.cameras.iter_mut().enumerate() {
        camera.translation.z += 0.4 * index as f64;
    }
    in_folders(&place, ["c", "a", "unused", "b"], rig);
    fs::remove_dir_all(place.path("pose/unused")).unwrap();
    let output = place.run(IMPORT);
    let [found, said] = [output.stdout, output.stderr].map(|text| String::from_utf8(text).unwrap());
    for (folder, camera) in [("c", "cam01"), ("a", "cam02"), ("b", "cam04")] {
        assert!(found.contains(&format!("{folder}  -> {camera} (exchanged)")), "{found}{said}");
    }
    let told = ["3 of 3 files have no camera's name, and may be", "no detections of camera cam03"];
    assert!(told.iter().all(|text| said.contains(text)), "{said}");
    assert_eq!(said.matches("warning").count(), 1, "{said}");
    assert_eq!(place.run(&format!("{IMPORT} --overwrite --strict")).status.code(), Some(8));
}

#[test]
fn pose2sims_settings_tell_the_frame_rate() {
    let place = Place::new();
    walk_in_folders(&place, ["cam01", "cam02", "cam03", "cam04"]);
    let import = "import pose --calibration calib.toml --out out.mcap";
    place.fails(USAGE, import, &["pose: the frame rate is not known", "--fps 60"]);
    place.write("Config.toml", "[project]\nframe_rate = 'auto'");
    place.fails(USAGE, import, &["pose: the frame rate is not known", "--fps 60"]);
    place.write("Config.toml", "[project]\nframe_rate = 60");
    let output = place.run(import);
    let said = String::from_utf8(output.stderr).unwrap();
    assert!(said.contains("60.000 frames a second, as ") && said.contains("Config.toml"), "{said}");
    let from_settings = fs::read(place.path("out.mcap")).unwrap();
    place.done(&format!("{IMPORT} --overwrite"));
    assert!(from_settings == fs::read(place.path("out.mcap")).unwrap());
}

#[test]
fn the_performers_height_tells_the_unit_of_a_calibration() {
    let place = Place::new();
    walk_in_folders(&place, ["cam01", "cam02", "cam03", "cam04"]);
    place.done(IMPORT);
    let right = place.done("check out.mcap --json");
    let calibration = fs::read_to_string(place.path("calib.toml")).unwrap();
    let (cameras, _) = calibration.split_once("[metadata]").unwrap();
    let in_feet = |line: &str| {
        let Some(numbers) = line.strip_prefix("translation = ") else { return line.to_owned() };
        let metres: Vec<f64> = serde_json::from_str(numbers).unwrap();
        let feet: Vec<f64> = metres.iter().map(|metres| metres / 0.3048).collect();
        format!("translation = {feet:?}")
    };
    let feet: Vec<String> = cameras.lines().map(in_feet).collect();
    place.write("calib.toml", feet.join("\n"));
    let output = place.run(&format!("{IMPORT} --overwrite"));
    let said = String::from_utf8(output.stderr).unwrap();
    assert!(said.contains("units high: the unit is ft, not m (--unit)"), "{said}");
    assert!(said.contains("unit ft, z up") && !said.contains("warning"), "{said}");
    assert!(place.done("info out.mcap").contains("--unit ft"));
    assert_eq!(place.done("check out.mcap --json"), right);
    // What the user says is not changed, but it is said.
    let output = place.run(&format!("{IMPORT} --overwrite --unit m"));
    let said = String::from_utf8(output.stderr).unwrap();
    assert!(said.contains("the calibration is in feet; divide all translations by"), "{said}");
}

#[test]
fn the_detections_tell_the_direction_of_the_poses_where_the_cameras_do_not() {
    let mut rig = ring_rig(4, 4.5, 1.4).unwrap();
    let first = rig.cameras[0].clone();
    // In a row, all looking the same way: in both directions of the poses they are.
    for (index, camera) in rig.cameras.iter_mut().enumerate() {
        camera.rotation = first.rotation;
        camera.translation = first.translation + Vector3::x() * (0.6 * index as f64 - 0.9);
    }
    let place = Place::new();
    in_folders(&place, ["cam01", "cam02", "cam03", "cam04"], rig.clone());
    let up = Up::Z.calibration_from_world();
    for camera in &mut rig.cameras {
        // What the file has is the inverse of what it should have.
        let centre = camera.centre_in_world();
        camera.rotation = up * camera.rotation.transpose() * up;
        camera.translation = up * centre;
    }
    write_calibration(&place.path("calib.toml"), &rig, Up::Z).unwrap();
    let calibration = fs::read_to_string(place.path("calib.toml")).unwrap();
    place.write("calib.toml", calibration.split_once("[metadata]").unwrap().0);
    let output = place.run(&format!("{IMPORT} --up z --unit m"));
    let said = String::from_utf8(output.stderr).unwrap();
    let note = "note: the cameras agree if the poses are world-from-camera (--poses)";
    assert!(said.contains(note) && !said.contains("warning"), "{said}");
    place.done("check out.mcap");
    // What the user says is not changed, but it is said.
    let given =
        place.run(&format!("{IMPORT} --overwrite --up z --unit m --poses camera-from-world"));
    let said = String::from_utf8(given.stderr).unwrap();
    assert!(!said.contains(note) && said.contains("warning"), "{said}");
}

#[test]
fn the_performer_tells_the_up_axis_where_the_images_do_not() {
    let mut rig = ring_rig(4, 4.0, 1.6).unwrap();
    // Every second camera hangs upside down.
    for camera in rig.cameras.iter_mut().step_by(2) {
        let half_turn = Matrix3::from_diagonal(&[-1.0, -1.0, 1.0].into());
        (camera.rotation, camera.translation) =
            (half_turn * camera.rotation, half_turn * camera.translation);
    }
    let place = Place::new();
    in_folders(&place, ["cam01", "cam02", "cam03", "cam04"], rig.clone());
    write_calibration(&place.path("calib.toml"), &rig, Up::Y).unwrap();
    let calibration = fs::read_to_string(place.path("calib.toml")).unwrap();
    place.write("calib.toml", calibration.split_once("[metadata]").unwrap().0);
    let output = place.run(IMPORT);
    let said = String::from_utf8(output.stderr).unwrap();
    assert!(said.contains("warning: y is taken as up: it points from hips"), "{said}");
    assert!(said.contains("unit m, y up") && said.matches("warning").count() == 1, "{said}");
    assert!(place.done("info out.mcap").contains("--up y"));
}

#[test]
fn a_synthetic_walk_is_solved_and_exported() {
    let place = Place::new();
    place.done("synth --out walk.mcap --seconds 2 --noise jitter");
    let info: Value = serde_json::from_str(&place.done("info walk.mcap --json")).unwrap();
    assert_eq!(info["rig"].as_array().unwrap().len(), 4);
    assert_eq!(info["cameras"]["cam02"]["format"], "body_25");

    let figures = place.done("solve walk.mcap --out out --overwrite --json --hold-out cam_3");
    let figures: Value = serde_json::from_str(&figures).unwrap();
    assert_eq!(figures["frames"], 120);
    assert_eq!((&figures["windows"], &figures["lost"]), (&23.into(), &0.into()));
    assert_eq!(figures["reprojection"]["cameras"].as_object().unwrap().len(), 3);
    assert_eq!(figures["hold_out"]["camera"], "cam03");
    pinned("hold-out, px", number(&figures, "/hold_out/median_px"), 3.508);
    pinned("MPJPE, mm", number(&figures, "/truth/mpjpe_mm"), 7.067);
    assert!(figures["solve_ms"]["p50"].as_f64().unwrap() > 0.0);
    for name in ["poses.mcap", "poses.bvh", "report.html"] {
        assert!(fs::metadata(place.path("out").join(name)).unwrap().len() > 1000, "{name}");
    }

    let two =
        place.done("solve walk.mcap --out out --overwrite --json --hold-out cam03,cam01,cam_3");
    let two: Value = serde_json::from_str(&two).unwrap();
    assert_eq!(two["hold_out"]["camera"], "cam03,cam01");
    let each = two["hold_out_cameras"].as_array().unwrap();
    let median = |camera: &Value| camera["median_px"].as_f64().unwrap();
    let mean = (median(&each[0]) + median(&each[1])) / 2.0;
    assert!((median(&two["hold_out"]) - mean).abs() < 1e-9, "{two}");
    assert_eq!(two["reprojection"]["cameras"].as_object().unwrap().len(), 2);

    let table = place.done("solve walk.mcap --out out --overwrite --hold-out cam03");
    for row in ["hold-out cam03, median", "frames without the performer"] {
        assert!(table.contains(row), "{table}");
    }
    // The cameras are judged once a second.
    let mut reader = Reader::open(place.path("out/poses.mcap")).unwrap();
    let status = reader.by_ref().find_map(|entry| match entry.unwrap().message {
        Message::Status(status) => Some(status),
        _ => None,
    });
    let status = status.unwrap();
    let names: Vec<&str> = status.cameras.iter().map(|one| one.camera.as_str()).collect();
    assert_eq!((names, status.windows.unwrap().lost), (vec!["cam01", "cam02", "cam04"], 0));
    for camera in &status.cameras {
        assert_eq!((camera.rate_hz.round(), camera.used >= 60), (60.0, true), "{camera:?}");
        assert!(camera.near > 0.8 && (1.0..8.0).contains(&camera.residual_px), "{camera:?}");
        assert!(camera.usual_px == camera.residual_px && camera.age_s < 0.1, "{camera:?}");
    }

    place.done("export out/poses.mcap --out again.bvh --out strip.svg");
    let again = fs::read_to_string(place.path("again.bvh")).unwrap();
    let bvh = fs::read_to_string(place.path("out/poses.bvh")).unwrap();
    assert_eq!(again.lines().count(), bvh.lines().count());
    assert!(fs::read_to_string(place.path("strip.svg")).unwrap().starts_with("<svg"));
}

#[test]
fn what_is_wrong_with_a_camera_is_in_the_poses() {
    let place = Place::new();
    place.done("synth --seconds 8 --noise clean --bump 0 --out bumped.mcap");
    place.run("solve bumped.mcap --out out");
    let status = Reader::open(place.path("out/poses.mcap")).unwrap().find_map(|entry| {
        let Message::Status(status) = entry.unwrap().message else { return None };
        Some(status)
    });
    let verdicts: Vec<_> =
        status.unwrap().cameras.into_iter().map(|camera| (camera.camera, camera.verdict)).collect();
    let [fine @ .., (name, verdict)] = &verdicts[..] else { panic!("{verdicts:?}") };
    assert!(name == "cam04" && verdict.contains("turned by"), "{verdicts:?}");
    assert!(fine.len() == 3 && fine.iter().all(|(_, verdict)| verdict.is_empty()), "{verdicts:?}");
}

#[test]
fn a_camera_that_was_moved_during_the_recording_is_not_corrected() {
    let place = Place::new();
    place.done("synth --seconds 16 --noise clean --bump 8 --out bumped.mcap");
    let corrected = |output: &Output| -> Vec<String> {
        let json: Value = serde_json::from_slice(&output.stdout).unwrap();
        let all = json["corrections"].as_array().unwrap().iter();
        let all = all.filter(|one| one["significant"] == true);
        all.map(|one| one["camera"].as_str().unwrap().to_owned()).collect()
    };
    let whole = place.run("calibrate bumped.mcap --json");
    let errors = String::from_utf8_lossy(&whole.stderr);
    assert_eq!(whole.status.code(), Some(6), "{errors}");
    assert!(errors.contains("warning: cam04: from about "), "{errors}");
    assert_eq!(corrected(&whole), Vec::<String>::new());
    let late = place.run("calibrate bumped.mcap --start 2 --json");
    for output in [&whole, &late] {
        let json: Value = serde_json::from_slice(&output.stdout).unwrap();
        assert!((7.5..8.5).contains(&number(&json, "/changed/0/at_s")), "{json}");
    }
    let part = place.run("calibrate bumped.mcap --start 8.5 --json");
    assert_eq!((part.status.code(), corrected(&part)), (Some(0), vec!["cam04".to_owned()]));
}

#[test]
fn feet_of_a_walk_stand() {
    let walk = Path::new(env!("CARGO_MANIFEST_DIR")).join("recordings/walk.mcap");
    let place = Place::new();
    fs::write(place.path("slide.toml"), "[tracker.cost]\nfoot_contact = 0.0\n").unwrap();
    let solve = |options: &str| -> Value {
        let figures = format!("solve {} --out out --overwrite --json {options}", walk.display());
        serde_json::from_str(&place.done(&figures)).unwrap()
    };
    let [standing, sliding] = ["", "--config slide.toml"].map(solve);
    pinned("true skate, mm/s", number(&standing, "/foot_skate/truth_mm_s"), 32.0);
    pinned("foot skate, mm/s", number(&standing, "/foot_skate/mm_s"), 46.0);
    pinned("foot skate of feet that may slide, mm/s", number(&sliding, "/foot_skate/mm_s"), 126.0);
    let floor = number(&standing, "/floor_m");
    assert!((-0.05..0.05).contains(&floor), "{floor}");
    let mpjpe = |figures| number(figures, "/truth/mpjpe_mm");
    assert!(mpjpe(&standing) < mpjpe(&sliding), "{standing} {sliding}");
}

/// The summary uses the newest keypoint offsets. The first skeleton has none, as without offsets.
#[test]
fn a_held_out_camera_is_compared_with_the_learnt_offsets() {
    let place = Place::new();
    let biased = Noise { bias_m: 0.03, ..Noise::none() };
    synthetic(&place.path("walk.mcap"), 360, biased, |_| true);
    place.write("plain.toml", "[tracker]\nbody_windows = 0\n");
    let held_out = |options: &str| {
        let solve =
            format!("solve walk.mcap --out out --overwrite --json --hold-out cam03 {options}");
        number(&serde_json::from_str(&place.done(&solve)).unwrap(), "/hold_out/median_px")
    };
    pinned("hold-out with offsets, px", held_out(""), 0.197);
    pinned("hold-out without offsets, px", held_out("--config plain.toml"), 3.724);
}

#[test]
fn a_given_body_is_used_unless_it_is_wrong() {
    let place = Place::new();
    synthetic(&place.path("walk.mcap"), 240, Noise::jitter_only(), |_| true);
    synthetic(&place.path("short.mcap"), 60, Noise::jitter_only(), |_| true);
    let body = Skeleton::new(Shape::symmetric([2.5; 10]));
    let motion = Motion::new(&body, MotionStyle::default());
    let rig = ring_rig(4, 4.0, 1.6).unwrap();
    let mut tall = Recording::new(rig, body, |seconds| motion.pose(seconds));
    tall.frames = 60;
    save(&place.path("tall.mcap"), &tall, |_| true);
    place.done("solve walk.mcap --out right");
    place.done("solve tall.mcap --out wrong");
    let notes = |body: &str| {
        let solve = format!("solve short.mcap --out again --overwrite --json --body {body}");
        let figures: Value = serde_json::from_str(&place.done(&solve)).unwrap();
        assert!(number(&figures, "/reprojection/median_px") < 4.0, "{body}: {figures}");
        String::from_utf8(place.run(&solve).stderr).unwrap()
    };
    assert_eq!(notes("right/poses.mcap"), "");
    let wrong = notes("wrong/poses.mcap");
    assert!(wrong.contains("note: the given body fits worse"), "{wrong}");
    place.fails(3, "solve short.mcap --out out --body nothing.mcap", &["nothing.mcap"]);
    let evidence = ["walk.mcap holds no body", "give the poses.mcap of `bundlemocap solve`"];
    place.fails(12, "solve short.mcap --out out --body walk.mcap", &evidence);
}

/// Eight seconds of a performer, whose detector has its own places for keypoints. Squats and reaches are smaller
/// in the less lively takes.
fn save_lively(path: &Path, body: &Skeleton, liveliness: f64) {
    let style = MotionStyle { liveliness, step_length: 0.5, ..MotionStyle::default() };
    let motion = Motion::new(body, style);
    let rig = ring_rig(4, 4.0, 1.6).unwrap();
    let mut take = Recording::new(rig, body.clone(), |seconds| motion.pose(seconds));
    take.frames = 480;
    take.noise = Noise { bias_m: 0.01, ..Noise::jitter_only() };
    save(path, &take, |_| true);
}

/// Two takes of one tall performer with long legs and short arms.
#[test]
fn the_body_of_a_performer_is_right_and_the_same_in_two_takes() {
    let place = Place::new();
    let body =
        Skeleton::new(Shape::symmetric([1.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0, -1.0, -1.0, 0.0]));
    let found = [1.0, 0.4].map(|liveliness| {
        save_lively(&place.path("take.mcap"), &body, liveliness);
        place.done("solve take.mcap --out out --overwrite");
        let mut reader = Reader::open(place.path("out/poses.mcap")).unwrap();
        let bodies: Vec<Skeleton> = reader
            .by_ref()
            .filter_map(|entry| match entry.unwrap().message {
                Message::Skeleton(skeleton) => Some(skeleton.to_core().unwrap()),
                _ => None,
            })
            .collect();
        assert_eq!(bodies.len(), 1, "one body for the whole take");
        bodies.into_iter().next().unwrap()
    });
    for joint in [Joint::LKnee, Joint::LAnkle, Joint::LElbow, Joint::LWrist] {
        let millimetres = |body: &Skeleton| 1e3 * body.offset(joint).norm();
        let [one, other] = [0, 1].map(|take| millimetres(&found[take]));
        let truth = millimetres(&body);
        println!("{}: {one:.1} and {other:.1}, truth {truth:.1} mm", joint.name());
        assert!((one - other).abs() < 8.0, "{}: {one} and {other} mm", joint.name());
        assert!((one - truth).abs() < 12.0, "{}: {one}, truth {truth} mm", joint.name());
    }
}

#[test]
fn the_body_of_several_takes_is_that_of_each_of_them() {
    let place = Place::new();
    let lead =
        Skeleton::new(Shape::symmetric([1.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0, -1.0, -1.0, 0.0]));
    let tall = Skeleton::new(Shape::symmetric([5.0; 10]));
    let takes = [("one", &lead, 1.0), ("two", &lead, 0.4), ("tall", &tall, 1.0)];
    for (take, body, liveliness) in takes {
        save_lively(&place.path(&format!("{take}.mcap")), body, liveliness);
    }
    let truth = segment_lengths(&lead);

    let said = place.done("body one.mcap two.mcap --out lead.mcap");
    assert!(said.contains("one.mcap") && said.contains("the body  "), "{said}");
    let found = place.done("body one.mcap two.mcap --out again.mcap --json --strict");
    let found: Value = serde_json::from_str(&found).unwrap();
    for (index, truth) in truth.iter().enumerate() {
        let millimetres = number(&found, &format!("/body_mm/{index}"));
        assert!((millimetres - 1e3 * truth).abs() < 10.0, "{found}, truth {truth} m");
    }
    let bones = last_body(&place.path("lead.mcap"), None).unwrap();
    for take in ["one", "two"] {
        let output = place.run(&format!("solve {take}.mcap --out {take} --body lead.mcap"));
        assert!(output.status.success() && output.stderr.is_empty(), "{output:?}");
        let body = last_body(&place.path(&format!("{take}/poses.mcap")), None).unwrap();
        assert_eq!(body.shape(), bones.shape(), "{take}");
        assert_ne!(body, bones, "{take}: its detector's places are its own");
    }

    place.fails(USAGE, "body one.mcap --out lead.mcap", &["lead.mcap", "--overwrite"]);
    let mixed = "body one.mcap two.mcap tall.mcap --out mixed.mcap --strict";
    let output = place.run(mixed);
    let why = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(15), "{why}");
    assert!(why.contains("tall.mcap has limbs of another length"), "{why}");
    assert!(!why.contains("one.mcap") && !why.contains("two.mcap"), "{why}");
    assert!(!place.path("mixed.mcap").exists());
    place.write("bad.mcap", "no recording");
    let output = place.run("body one.mcap bad.mcap two.mcap tall.mcap --out mixed.mcap");
    let why = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(IN_PART), "{why}");
    assert!(why.contains("warning: bad.mcap is not an MCAP recording"), "{why}");
    place.fails(MALFORMED, "body bad.mcap --out none.mcap", &["bad.mcap is not"]);
    assert_eq!(last_body(&place.path("mixed.mcap"), None).unwrap(), bones);
    place.fails(USAGE, "body one.mcap two.mcap --out two.mcap --overwrite", &["one of the takes"]);
}

#[test]
fn a_good_rig_is_written_as_it_is_and_can_be_solved_with() {
    let place = Place::new();
    place.done("synth --out walk.mcap --seconds 4");
    let said = place.done("calibrate walk.mcap --time-only --out synced.toml");
    assert_eq!(said.matches("in sync").count(), 4, "{said}");
    assert!(!said.contains("before"), "{said}");
    let said = place.done("calibrate walk.mcap --out refined.toml");
    assert!(said.contains("px before") && said.contains("nothing to correct"), "{said}");
    let text = |name: &str| fs::read_to_string(place.path(name)).unwrap();
    assert_eq!(text("synced.toml"), text("refined.toml"));

    let again = "calibrate walk.mcap --out synced.toml";
    place.fails(USAGE, again, &["synced.toml", "--overwrite"]);
    place.write("other.toml", text("synced.toml").replace("cam04", "cam05"));
    let output = place.run("solve walk.mcap --out out --rig other.toml");
    let errors = String::from_utf8_lossy(&output.stderr).into_owned();
    let [read, error] = errors.lines().collect::<Vec<_>>()[..] else { panic!("{errors}") };
    assert_eq!(output.status.code(), Some(CAMERA_MISMATCH), "{errors}");
    assert!(read.contains("other.toml: 4 cameras, TOML") && error.contains("cam04"), "{errors}");
    place.done("solve walk.mcap --out out --rig refined.toml");
}

#[test]
fn inputs_and_the_users_files_are_never_replaced() {
    let place = Place::new();
    place.done("synth --out walk.mcap --seconds 2 --noise jitter");
    let span = "solve walk.mcap --out out --start 100";
    place.fails(USAGE, span, &["no keypoints from --start"]);
    let input = "is the input; choose another name";
    place.fails(USAGE, "calibrate walk.mcap --out walk.mcap --overwrite", &[input]);
    place.fails(USAGE, "rig convert walk.mcap --out walk.mcap --format toml --overwrite", &[input]);
    place.fails(USAGE, "take stop --mark good", &["are for note"]);
    place.write("in/poses.mcap", fs::read(place.path("walk.mcap")).unwrap());
    place.fails(USAGE, "solve in/poses.mcap --out in --overwrite", &[input]);

    let map =
        "retarget --skeleton s.bvh --from walk.mcap --map map.toml --out map.toml --overwrite";
    place.write("map.toml", "");
    place.fails(USAGE, map, &[input]);
    place.fails(MALFORMED, "solve walk.mcap --out out --rig walk.mcap", &["a recording; `bundle"]);

    place.done("synth --out crowd.mcap --performers 2 --seconds 2 --noise clean");
    place.write("half/poses.p2.bvh", "of an earlier solve, or the user's");
    let half = "solve crowd.mcap --out half --performers auto";
    place.fails(USAGE, half, &["poses.p2.bvh", "--overwrite"]);
    place.done("solve crowd.mcap --out out --performers auto");
    place.done("export out/poses.mcap --actor p1 --out out/poses_mine.bvh --lost mark");
    place.write("out/poses.mine.bvh", "the user's");
    let body = "solve walk.mcap --out out --body out/poses.mcap --overwrite";
    assert_eq!(place.run(body).status.code(), Some(USAGE));
    place.done("solve walk.mcap --out out --overwrite");
    let is_there = |name: &str| place.path(&format!("out/{name}")).exists();
    for kept in ["poses.bvh", "poses.mine.bvh", "poses_mine.bvh", "poses_mine.states.csv"] {
        assert!(is_there(kept), "{kept}");
    }
    assert!(!is_there("poses.p2.bvh") && !is_there("poses.p2.states.csv"));
}

#[test]
fn the_calibration_of_a_recording_is_read_in_another_unit() {
    let place = Place::new();
    place.done("synth --out walk.mcap --seconds 4 --noise clean");
    assert!(!place.done("check walk.mcap").contains("divide all translations"));
    let told = place.done("check walk.mcap --unit 2");
    assert!(told.contains("the calibration has 2.0"), "{told}");
    let convert = "rig convert walk.mcap --unit 2 --out twice.toml";
    place.done(convert);
    assert_eq!(place.done("check walk.mcap --rig twice.toml"), told);
    place.fails(USAGE, "check walk.mcap --set S9", &["--set"]);
}

#[test]
fn the_real_recording_has_no_time_offset_but_a_turned_camera() {
    let Some(set) = real_set() else { return };
    let place = Place::new();
    import_real(&place, &set, "balancing", "butterworth.trc");
    let found = place.done("calibrate take.mcap --out rig.toml --json");
    let found: Value = serde_json::from_str(&found).unwrap();
    let all = |list: &str| found[list].as_array().unwrap().clone();
    assert!(all("time_offsets").iter().all(|offset| offset["applied"] == false), "{found}");
    let corrected = all("corrections").into_iter().filter(|camera| camera["significant"] == true);
    let corrected: Vec<Value> = corrected.map(|camera| camera["camera"].clone()).collect();
    assert_eq!(corrected, ["cam_01"], "{found}");
    let figures = place.done("solve take.mcap --out out --rig rig.toml --hold-out cam_01 --json");
    let figures: Value = serde_json::from_str(&figures).unwrap();
    pinned("held-out camera 1, px", number(&figures, "/hold_out/median_px"), 12.98);
}

#[test]
fn a_fault_is_named_by_check_and_noted_by_solve() {
    let place = Place::new();
    walk(&place.path("good.mcap"), 240, |_| true);
    walk(&place.path("mirrored.mcap"), 240, |detections| {
        if detections.camera == 1 {
            let points = detections.people.iter_mut().flat_map(|person| &mut person.points);
            points.flatten().for_each(|point| point.pixel.x = 1279.0 - point.pixel.x);
        }
        true
    });
    let good = place.done("check good.mcap --strict");
    assert_eq!(good.matches("  fits").count(), 4, "{good}");
    assert!(place.done("check mirrored.mcap").contains("x coordinates are mirrored"));
    let strict = place.run("check good.mcap mirrored.mcap --strict --json");
    assert_eq!(strict.status.code(), Some(15));
    let found: Value = serde_json::from_slice(&strict.stdout).unwrap();
    let cause = found.pointer("/1/check/cameras/1/findings/0/cause");
    assert_eq!(cause.and_then(Value::as_str), Some("pixels_mirrored"), "{found}");
    assert!(number(&found, "/0/check/performer_height_m") > 1.5);

    let solved = place.run("solve mirrored.mcap --out out --json");
    let notes = String::from_utf8(solved.stderr).unwrap();
    assert!(notes.contains("note: camera cam02: its x coordinates are mirrored"), "{notes}");
    let summary: Value = serde_json::from_slice(&solved.stdout).unwrap();
    assert!(summary.pointer("/check/cameras/1/findings/0/fix").is_some(), "{summary}");
    let report = fs::read_to_string(place.path("out/report.html")).unwrap();
    assert!(report.contains("its x coordinates are mirrored"));
}

#[test]
fn a_calibration_in_millimetres_is_named_where_nobody_is_found() {
    let place = Place::new();
    let skeleton = Skeleton::default();
    let motion = Motion::new(&skeleton, MotionStyle::default());
    let mut rig = ring_rig(4, 4.0, 1.6).unwrap();
    let mut recording = Recording::new(rig.clone(), skeleton, |seconds| motion.pose(seconds));
    recording.frames = 120;
    let frames: Vec<_> = recording.detections().collect();
    rig.cameras.iter_mut().for_each(|camera| camera.translation *= 1000.0);
    recording.rig = rig;
    let mut seen = frames.into_iter();
    save(&place.path("mm.mcap"), &recording, |detections| {
        *detections = seen.next().unwrap();
        true
    });
    let evidence = ["nobody was found", "the calibration is in millimetres"];
    place.fails(NOBODY_FOUND, "solve mm.mcap --out out", &evidence);
}

/// A TRC file of one marker.
fn markers_file(name: &str, rows: &str) -> String {
    let header = "PathFileType\t4\t(X/Y/Z)\tother.trc\nDataRate\tCameraRate\tNumFrames\tNumMarkers\t\
                  Units\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames\n60\t60\t120\t1\tm\t60\t0\t120\n";
    format!("{header}Frame#\tTime\t{name}\t\t\n\t\tX1\tY1\tZ1\n{rows}")
}

#[test]
fn a_reference_of_another_trial_is_noted() {
    let place = Place::new();
    walk(&place.path("walk.mcap"), 120, |_| true);
    let rows: String =
        (1..=120).map(|i| format!("{i}\t{:.4}\t9.0\t9.0\t9.0\n", f64::from(i) / 60.0)).collect();
    place.write("other.trc", markers_file("RHip", &rows));
    let notes = place.run("solve walk.mcap --out out --reference other.trc").stderr;
    let notes = String::from_utf8(notes).unwrap();
    assert!(notes.contains("note: the reference does not fit"), "{notes}");
}

/// The first camera is half as fast as the others, and counts its own frames.
#[test]
fn a_reference_has_the_frames_of_the_fast_cameras() {
    let place = Place::new();
    walk(&place.path("walk.mcap"), 240, |_| true);
    place.done("solve walk.mcap --out whole");
    place.done("export whole/poses.mcap --out walk.trc");
    walk(&place.path("slow.mcap"), 240, |frame| {
        let is_used = frame.camera > 0 || frame.frame % 2 == 0;
        frame.frame /= if frame.camera == 0 { 2 } else { 1 };
        is_used
    });
    let solve = "solve slow.mcap --out slow --reference walk.trc --json";
    let figures: Value = serde_json::from_str(&place.done(solve)).unwrap();
    assert!(number(&figures, "/reference/frames") > 230.0, "{}", figures["reference"]);
    assert!(number(&figures, "/reference/mean_mm") < 10.0, "{}", figures["reference"]);
}

#[test]
fn existing_outputs_are_kept_unless_told_otherwise() {
    let place = Place::new();
    walk(&place.path("walk.mcap"), 30, |_| true);
    place.done("solve walk.mcap --out out");
    let before = fs::read(place.path("out/poses.mcap")).unwrap();
    place.write("out/poses.bvh", "mine");
    let refused = |command: &str, file: &str| {
        let output = place.run(command);
        let message = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(USAGE), "{message}");
        assert!(message.contains(file) && message.contains("--overwrite"), "{message}");
    };
    refused("solve walk.mcap --out out", "out/poses.mcap");
    assert_eq!(fs::read(place.path("out/poses.bvh")).unwrap(), b"mine");
    place.done("solve walk.mcap --out out --overwrite");
    assert_eq!(fs::read(place.path("out/poses.mcap")).unwrap(), before);

    detections(&place, &["cam1", "cam2"], 75);
    place.write("calib.toml", calibration(&["cam1", "cam2"], 600.0));
    let import = format!("{IMPORT} --format body_25");
    place.write("out.mcap", "mine");
    refused(&import, "out.mcap");
    assert_eq!(fs::read(place.path("out.mcap")).unwrap(), b"mine");
}

#[test]
fn a_shelf_of_takes_is_solved_once() {
    let place = Place::new();
    for (name, frames) in [("a", 60), ("b", 90)] {
        walk(&place.path(&format!("{name}.mcap")), frames, |_| true);
    }
    place.write("bad.mcap", "no recording");
    let solve = "solve a.mcap b.mcap bad.mcap --out takes --jobs 2";
    let output = place.run(solve);
    let (said, errors) =
        (String::from_utf8(output.stdout).unwrap(), String::from_utf8(output.stderr).unwrap());
    assert_eq!(output.status.code(), Some(IN_PART), "{errors}");
    assert!(said.contains("2 solved, 0 solved before, 1 failed, of 3"), "{said}");
    assert!(errors.contains("error: bad: bad.mcap"), "{errors}");
    let output = place.run("summary takes");
    let table = String::from_utf8(output.stdout).unwrap();
    assert!(table.contains("bad  not solved: bad.mcap is not an MCAP recording"), "{table}");
    // Of one take the exit code is its own; a wrong name gets no folder.
    assert_eq!(place.run("solve bad.mcap --out takes --jobs 1").status.code(), Some(MALFORMED));
    assert_eq!(place.run("solve c.mcap --out takes --jobs 1").status.code(), Some(3));
    assert!(!place.path("takes/c").exists());
    place.done("solve a.mcap --out alone");
    let poses = |folder: &str| fs::read(place.path(folder).join("poses.mcap")).unwrap();
    assert_eq!(poses("takes/a"), poses("alone"));

    // A second time nothing is done; nor while another process is at it; what was broken off is done again.
    let before = fs::metadata(place.path("takes/a/poses.mcap")).unwrap().modified().unwrap();
    let again = place.done("solve a.mcap b.mcap --out takes");
    assert!(again.contains("0 solved, 2 solved before, 0 failed, of 2"), "{again}");
    let after = fs::metadata(place.path("takes/a/poses.mcap")).unwrap().modified().unwrap();
    assert_eq!(before, after);
    let manifest =
        fs::File::options().write(true).open(place.path("takes/b/manifest.json")).unwrap();
    manifest.set_len(0).unwrap();
    manifest.lock().unwrap();
    let part = place.path("takes/b/.bundlemocap-x.part");
    fs::write(&part, "left by a killed process").unwrap();
    let mut waiting = place.start("solve a.mcap b.mcap --out takes");
    assert!(waiting.has_said("b: another process solves it; this one waits"));
    let output = place.run("summary takes");
    assert_eq!(output.status.code(), Some(IN_PART));
    let table = String::from_utf8(output.stdout).unwrap();
    assert!(table.contains("a    60 frames (") && table.contains("b    not solved: it"), "{table}");
    assert!(part.exists());
    drop(manifest);
    let Ended { code, said, .. } = waiting.ended();
    assert!(said.contains("1 solved, 1 solved before, 0 failed, of 2"), "{said}");
    assert_eq!(code, Some(0), "{said}");
    assert!(!part.exists());

    // Other settings, and files of somebody else. The bus is no setting of a solve.
    place.write("bus.toml", "[bus]\nkind = \"iceoryx2\"\n");
    let again = place.done("solve a.mcap b.mcap --out takes --config bus.toml");
    assert!(again.contains("0 solved, 2 solved before"), "{again}");
    let other = place.run("solve a.mcap b.mcap --out takes --no-sync");
    assert_eq!(other.status.code(), Some(IN_PART));
    let errors = String::from_utf8(other.stderr).unwrap();
    assert!(errors.contains("a: takes/a was solved from other inputs, settings"), "{errors}");
    place.done("solve a.mcap b.mcap --out takes --no-sync --overwrite");
    // A command that fails at once leaves the takes as they are.
    let output =
        place.run("solve a.mcap b.mcap --out takes --no-sync --overwrite --cameras nobody");
    assert_eq!(output.status.code(), Some(IN_PART));
    let again = place.done("solve a.mcap b.mcap --out takes --no-sync");
    assert!(again.contains("0 solved, 2 solved before"), "{again}");
    // Poses that were changed are not those of the manifest.
    let mut poses = poses("takes/b");
    poses.push(0);
    place.write("takes/b/poses.mcap", poses);
    let output = place.run("solve a.mcap b.mcap --out takes --no-sync");
    let errors = String::from_utf8(output.stderr).unwrap();
    assert!(errors.contains("b: takes/b/poses.mcap was changed or removed after"), "{errors}");
    fs::remove_file(place.path("takes/a/poses.bvh")).unwrap();
    let output = place.run("solve a.mcap --out takes --jobs 1 --no-sync");
    assert_eq!(output.status.code(), Some(USAGE));
    let errors = String::from_utf8(output.stderr).unwrap();
    assert!(errors.contains("a: takes/a/poses.bvh was changed or removed after"), "{errors}");
    place.done("solve a.mcap b.mcap --out takes --no-sync --overwrite");
    fs::remove_dir_all(place.path("takes/bad")).unwrap();
    let table = place.done("summary takes");
    assert!(table.contains("b  90 frames (0 flagged), ") && table.contains("0 of"), "{table}");
    let json: Value = serde_json::from_str(&place.done("summary takes --json")).unwrap();
    assert_eq!(json.pointer("/b/frames").and_then(Value::as_u64), Some(90));
    fs::remove_file(place.path("takes/a/manifest.json")).unwrap();
    let output = place.run("solve a.mcap b.mcap --out takes --no-sync");
    let errors = String::from_utf8(output.stderr).unwrap();
    assert!(
        errors.contains("takes/a holds other files; choose another --out, or use --overwrite"),
        "{errors}"
    );
    place.fails(2, "solve a.mcap takes/../a.mcap --out out", &["would be solved into one folder"]);
    place.fails(NOT_OURS, "summary alone", &["alone holds no solved takes"]);
}

#[cfg(unix)]
#[test]
fn a_command_that_is_stopped_leaves_no_half_files() {
    let place = Place::new();
    let mut synth = place.start("synth --out long.mcap --seconds 3600");
    let files = || fs::read_dir(place.path("")).unwrap().count();
    while files() == 0 {
        assert!(!synth.is_over());
        std::thread::sleep(std::time::Duration::from_millis(5));
    }
    assert_eq!(synth.interrupt().code, None, "it ends by the signal");
    assert_eq!(files(), 0);
}

#[cfg(unix)]
#[test]
fn a_solve_that_is_stopped_leaves_no_half_files() {
    let place = Place::new();
    walk(&place.path("a.mcap"), 3000, |_| true);
    walk(&place.path("b.mcap"), 60, |_| true);
    let mut solving = place.start("solve a.mcap b.mcap --out takes");
    while !place.path("takes/a/manifest.json").exists() {
        assert!(!solving.is_over());
        std::thread::sleep(std::time::Duration::from_millis(5));
    }
    std::thread::sleep(std::time::Duration::from_millis(200));
    let Ended { code, said, errors } = solving.interrupt();
    assert_eq!(code, Some(IN_PART), "{errors}");
    assert!(errors.contains("a: a.mcap is not solved: it was stopped"), "{errors}");
    assert!(said.contains("0 solved, 0 solved before, 1 failed, 1 not solved yet, of 2"), "{said}");
    let left: Vec<_> = fs::read_dir(place.path("takes/a")).unwrap().collect();
    assert_eq!(left.len(), 1, "{left:?}");
    let table = String::from_utf8(place.run("summary takes").stdout).unwrap();
    assert!(table.contains("a  not solved: a.mcap is not solved: it was stopped"), "{table}");
}

#[test]
fn frames_that_are_not_used_are_told() {
    let place = Place::new();
    walk(&place.path("late.mcap"), 240, |frame| frame.camera == 0 || frame.frame >= 120);
    let output = place.run("solve late.mcap --out late");
    let notes = String::from_utf8(output.stderr).unwrap();
    assert!(notes.contains(" of 240 frames have no pose: nobody was found there"), "{notes}");
    let mut frames = Vec::new();
    walk(&place.path("walk.mcap"), 120, |frame| {
        frames.push(frame.clone());
        true
    });
    write_sorted(&place.path("sorted.mcap"), frames);
    let notes = String::from_utf8(place.run("solve sorted.mcap --out sorted").stderr).unwrap();
    assert!(notes.contains("is the recording sorted by capture time?"), "{notes}");
}

#[test]
fn people_become_known_in_one_take_after_the_other() {
    let place = Place::new();
    place.done("synth --out a.mcap --seconds 8 --cameras 5 --seed 5 --performers 2 --meet");
    place.done("synth --out b.mcap --seconds 8 --seed 31");
    let solve = "solve a.mcap b.mcap --out takes --jobs 2 --performers auto --names ada,ben,cleo";
    let output = place.run(&format!("{solve} --bodies bodies"));
    let errors = String::from_utf8(output.stderr).unwrap();
    assert!(errors.contains("one take is solved after the other"), "{errors}");
    for file in ["a/poses.ada.bvh", "a/poses.ben.bvh", "b/poses.cleo.bvh"] {
        assert!(place.path("takes").join(file).exists(), "{file}: {errors}");
    }
    let again = place.done(&format!("{solve} --bodies bodies"));
    assert!(again.contains("0 solved, 2 solved before"), "{again}");
}

#[cfg(target_os = "linux")]
#[test]
fn output_that_cannot_be_written_is_an_error() {
    let place = Place::new();
    walk(&place.path("a.mcap"), 60, |_| true);
    let full = fs::File::options().write(true).open("/dev/full").unwrap();
    let output = place.command("info a.mcap --json").stdout(full).output().unwrap();
    let errors = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(1), "{errors}");
    assert!(errors.contains("standard output cannot be written: No space left"), "{errors}");
}

#[test]
fn a_recorder_of_one_performer_is_chosen_by_topic() {
    let evidence = ["all performers are recorded", "--topics 'mocap/stage/actor/p2/**'"];
    Place::new().fails(USAGE, "record all.mcap --actor p2", &evidence);
}

#[test]
fn files_are_not_replaced_without_being_asked() {
    let place = Place::new();
    walk(&place.path("walk.mcap"), 60, |_| true);
    place.done("solve walk.mcap --out out");
    for (command, file) in [
        ("synth --out mine", "mine"),
        ("export out/poses.mcap --format bvh --out mine", "mine"),
        ("export out/poses.mcap --format glb --out mine", "mine"),
        ("retarget --skeleton out/poses.bvh --from out/poses.mcap --out mine", "mine"),
        ("decode out/poses.mcap --out mine", "mine"),
        ("replay walk.mcap --out mine", "mine"),
        ("train motions --out mine", "mine"),
        ("calibrate walk.mcap --out mine", "mine"),
        ("record mine", "mine"),
        ("eval methods --rig ring4 --out .", "table.md"),
    ] {
        place.write(file, "mine");
        let output = place.run(command);
        let message = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(USAGE), "{command}: {message}");
        assert!(message.contains("exists; choose another name, or use --overwrite"), "{message}");
        assert_eq!(fs::read(place.path(file)).unwrap(), b"mine", "{command}");
    }
    place.done("export out/poses.mcap --format bvh --out mine --overwrite");
    // Nothing is written before everything is checked.
    for (command, why) in [
        ("export out/poses.mcap --out new.glb --out mine --format bvh", "mine exists"),
        ("export out/poses.mcap --out new.glb --out new.glb", "new.glb would be written twice"),
        ("export out/poses.mcap --out new.glb --out new", "unknown ending; use .glb, .usda, .bvh"),
        ("export --out new.glb --out ./out/poses.mcap --overwrite out/poses.mcap", "is the input"),
        ("export out/poses.mcap --out new.mcap --actor p1", "leave out --actor"),
        ("export out/poses.mcap --out new.glb --start 900", "no poses from --start to --end"),
    ] {
        let output = place.run(command);
        let message = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(USAGE), "{command}: {message}");
        assert!(message.contains(why), "{command}: {message}");
        assert!(!place.path("new.glb").exists() && !place.path("new.mcap").exists(), "{command}");
    }
    assert!(fs::read(place.path("mine")).unwrap().starts_with(b"HIERARCHY"));
}

/// Two performers, the second a second later: in glTF both have the time of the take.
#[test]
fn gltf_files_of_several_performers_begin_together() {
    let place = Place::new();
    let skeleton = Skeleton::default();
    let provenance = Provenance::default();
    let path = place.path("two.mcap");
    let mut writer = Writer::create(&path, Topics::default(), &provenance).unwrap();
    for (actor, start) in [("p1", 0), ("p2", 60)] {
        let topics = Topics { actor: actor.into(), ..Topics::default() };
        let body = wire::Skeleton::from_core(&skeleton);
        writer.write(&topics.skeleton(), Timestamp::default(), &body).unwrap();
        for frame in start..120 {
            let capture = Timestamp::default() + Nanos::of_frames(frame, 60.0);
            let stamped = StampedPose::new(capture, Pose::rest(), TrackingState::Tracking);
            let pose = wire::Pose::from_core(&stamped, &skeleton, None);
            writer.write(&topics.pose(), capture, &pose).unwrap();
        }
    }
    writer.finish().unwrap();
    place.done("export two.mcap --out two.glb");
    // Each has its own files beside, whatever the names.
    place.done("export two.mcap --format bvh --lost mark --out two");
    for actor in ["p1", "p2"] {
        assert!(place.path(&format!("two.{actor}.states.csv")).exists());
    }
    for outputs in ["--out a.states.csv --out a.bvh", "--out a.bvh --out ./a.bvh"] {
        let export = format!("export two.mcap --lost mark --actor p1 {outputs}");
        place.fails(USAGE, &export, &["would be written twice"]);
    }
    let told = place.done("export two.mcap --out one.glb --start 0 --end 0.5");
    assert!(place.path("one.p1.glb").exists(), "{told}");
    for (actor, start, count) in [("p1", 0.0, 120), ("p2", 1.0, 60)] {
        let bytes = fs::read(place.path(&format!("two.{actor}.glb"))).unwrap();
        let length = u32::from_le_bytes(bytes[12..16].try_into().unwrap()) as usize;
        let json: Value = serde_json::from_slice(&bytes[20..20 + length]).unwrap();
        let times = json["animations"][0]["samplers"][0]["input"].as_u64().unwrap() as usize;
        let times = &json["accessors"][times];
        assert_eq!((times["min"][0].as_f64(), times["count"].as_u64()), (Some(start), Some(count)));
        // Blender names the armature after the skin, and the action after the animation.
        for named in [&json["skins"][0], &json["animations"][0]] {
            assert_eq!(named["name"], actor);
        }
    }
}

/// One camera's files are three frames late. Whenever the take begins, it is solved alike.
#[test]
fn no_time_of_a_take_matters() {
    let place = Place::new();
    let period = Nanos::of_frames(1, 60.0);
    let years = |years: i64| Nanos::SECOND * (years * 365 * 86_400);
    let mut medians = Vec::new();
    for start in [Nanos::from_ms(-1500), Nanos::ZERO, Nanos::SECOND, years(230)] {
        synthetic(&place.path("late.mcap"), 240, Noise::jitter_only(), |frame| {
            let lead = if frame.camera == 1 { 0 } else { 3 };
            frame.capture = frame.capture - period * lead + start;
            frame.frame as i64 >= lead
        });
        let solve = "solve late.mcap --out out --overwrite --json";
        let figures: Value = serde_json::from_str(&place.done(solve)).unwrap();
        let offset = number(&figures, "/time_offsets/1/offset_ms");
        assert!((offset + 50.0).abs() < 5.0, "{offset}");
        medians.push(number(&figures, "/reprojection/median_px"));
        place.done("export out/poses.mcap --out cut.bvh --start 1 --end 1.5 --overwrite");
        let cut = fs::read_to_string(place.path("cut.bvh")).unwrap();
        let frames = cut.lines().find_map(|line| line.strip_prefix("Frames:")).unwrap();
        // The take begins between two poses: the estimated offset is no whole number of frames.
        assert!(["30", "31"].contains(&frames.trim()), "{frames}");
    }
    assert!(medians.iter().all(|median| (median / medians[1] - 1.0).abs() < 0.01), "{medians:?}");
}

#[test]
fn poses_carry_their_provenance() {
    let place = Place::new();
    walk(&place.path("walk.mcap"), 30, |_| true);
    place.run("solve walk.mcap --out out --overwrite");
    let mut reader = Reader::open(place.path("out/poses.mcap")).unwrap();
    let mut kinds = [0; 4];
    for entry in reader.by_ref() {
        match entry.unwrap().message {
            Message::Skeleton(_) => kinds[0] += 1,
            Message::Rig(_) => kinds[1] += 1,
            Message::Pose(_) => kinds[2] += 1,
            Message::Keyframe(_) => kinds[3] += 1,
            _ => {}
        }
    }
    assert!(kinds[0] == 1 && kinds[1] == 1 && kinds[2] >= 30 && kinds[3] >= 3, "{kinds:?}");
    let ours = &reader.metadata()["bundlemocap"];
    assert!(ours["config"].contains("window_frames = 10"));
    assert_eq!((ours["version"].as_str(), ours["weights"].len()), (env!("CARGO_PKG_VERSION"), 16));
}

#[test]
fn the_same_recording_gives_the_same_bytes() {
    let place = Place::new();
    walk(&place.path("walk.mcap"), 40, |_| true);
    let bytes = ["a", "b"].map(|out| {
        place.run(&format!("solve walk.mcap --out {out}"));
        ["poses.mcap", "poses.bvh"].map(|name| fs::read(place.path(out).join(name)).unwrap())
    });
    assert!(bytes[0] == bytes[1]);
}

#[test]
fn a_truncated_recording_is_solved_to_its_end() {
    let place = Place::new();
    walk(&place.path("walk.mcap"), 240, |_| true);
    let whole = fs::read(place.path("walk.mcap")).unwrap();
    place.write("cut.mcap", &whole[..whole.len() / 2]);
    let output = place.run("solve cut.mcap --out out --json");
    assert_eq!(output.status.code(), Some(IN_PART), "{}", String::from_utf8_lossy(&output.stderr));
    let figures: Value = serde_json::from_slice(&output.stdout).unwrap();
    let frames = figures["frames"].as_u64().unwrap();
    assert!((20..240).contains(&frames), "{frames}");
    assert!(figures["damage"][0].as_str().unwrap().contains("damaged at byte"));
    assert!(place.path("out/poses.bvh").exists());

    let body = place.run("body cut.mcap --out lead.mcap");
    let errors = String::from_utf8_lossy(&body.stderr);
    assert_eq!(body.status.code(), Some(IN_PART), "{errors}");
    assert!(errors.contains("damaged at byte") && place.path("lead.mcap").exists(), "{errors}");
    place.run("solve cut.mcap walk.mcap --out takes");
    let table = String::from_utf8(place.run("summary takes").stdout).unwrap();
    let told: Vec<bool> = table.lines().map(|line| line.ends_with("; exit code 6")).collect();
    assert_eq!(told, [true, false], "{table}");
}

#[test]
fn who_enters_late_is_no_failure() {
    let place = Place::new();
    walk(&place.path("walk.mcap"), 240, |detections| {
        if detections.frame < 60 {
            detections.people.clear();
        }
        true
    });
    let output = place.run("solve walk.mcap --out out --json");
    let errors = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(0), "{errors}");
    let figures: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert!(figures["windows_without_performer"].as_u64().unwrap() > 0, "{figures}");
    assert_eq!(figures["lost"], 0, "{figures}");

    // Frame n of a file is frame n of the video.
    let first = 240 - figures["frames"].as_u64().unwrap() as usize;
    assert!((55..=60).contains(&first), "{first}");
    place.done("export out/poses.mcap --out a.trc --out a.csv --out a.bvh");
    let trc = read_trajectories(&place.path("a.trc"), None).unwrap();
    let empty = trc.rows.iter().take_while(|row| row.iter().all(Option::is_none)).count();
    assert_eq!((trc.rows.len(), empty), (240, first));
    assert_eq!(trc.first_frame, 0.0);
    let line = &place.lines("a.csv")[1];
    assert!(line.starts_with(&format!("{:.6},", first as f64 / 60.0)), "{line}");
    let bvh = Bvh::parse(&fs::read_to_string(place.path("a.bvh")).unwrap()).unwrap();
    place.done("retarget --skeleton a.bvh --from out/poses.mcap --out b.bvh");
    let other = Bvh::parse(&fs::read_to_string(place.path("b.bvh")).unwrap()).unwrap();
    assert_eq!((other.frames(), other.posture(0)), (240, other.posture(first)));
    assert_eq!(bvh.frames(), 240);
}

#[test]
fn a_take_is_drawn_tabled_and_plotted() {
    let place = Place::new();
    walk(&place.path("walk.mcap"), 90, |_| true);
    place.done("solve walk.mcap --out out");
    place.done("rig show out/poses.mcap --out rig.svg");
    place.done("rig show walk.mcap --out cameras.svg");
    let [drawn, cameras] =
        ["rig.svg", "cameras.svg"].map(|name| fs::read_to_string(place.path(name)).unwrap());
    for name in ["cam01", "cam02", "cam03", "cam04", "actor"] {
        let named = format!(">{name}</text>");
        // From above and from the side.
        assert_eq!(drawn.matches(&named).count(), 2, "{name}");
        assert_eq!(cameras.matches(&named).count(), if name == "actor" { 0 } else { 2 }, "{name}");
    }

    place.done("export out/poses.mcap --out a.mot --out a.angles.csv");
    let motion = place.lines("a.mot");
    let head = motion.iter().position(|line| line.starts_with("time\t")).unwrap();
    let table = place.lines("a.angles.csv");
    let cells = |line: &String| line.split(',').map(str::to_owned).collect::<Vec<_>>();
    assert_eq!((table.len(), motion.len() - head), (91, 91));
    for (row, line) in table.iter().map(cells).zip(&motion[head..]) {
        let angles: Vec<&str> = line.split('\t').skip(1).collect();
        assert_eq!(row[2..], angles);
    }
    let knee = cells(&table[0]).iter().position(|name| name == "knee_angle_r").unwrap();
    let knees = table[1..].iter().map(|line| cells(line)[knee].parse::<f64>().unwrap());
    let (least, most) = knees.fold((f64::MAX, f64::MIN), |(a, b), x| (a.min(x), b.max(x)));
    assert!(least > 0.0 && most - least > 30.0 && most < 120.0, "{least} to {most} degrees");

    let report = fs::read_to_string(place.path("out/report.html")).unwrap();
    let (_, plot) = report.split_once("How certain the joint centres are").unwrap();
    let (plot, _) = plot.split_once("</svg>").unwrap();
    assert!(plot.contains("mean of the joints") && plot.contains("least certain joint"), "{plot}");
    assert!(plot.matches("<polyline").count() + plot.matches("<path").count() >= 2, "{plot}");
}

#[test]
fn poses_are_exported_at_another_rate_in_place_and_in_part() {
    let place = Place::new();
    walk(&place.path("walk.mcap"), 150, |detections| {
        if (60..90).contains(&detections.frame) {
            detections.people.clear();
        }
        true
    });
    place.done("solve walk.mcap --out solved");
    let export = |options: &str| {
        place.done(&format!("export solved/poses.mcap --overwrite {options}"));
    };
    let rows = || -> Vec<(f64, String, Vec<f64>)> {
        let row = |line: &String| {
            let mut cells = line.split(',');
            let time = cells.next().unwrap().parse().unwrap();
            let state = cells.next().unwrap().to_owned();
            (time, state, cells.take(3).map(|cell| cell.parse().unwrap()).collect())
        };
        place.lines("a.csv")[1..].iter().map(row).collect()
    };
    export("--out a.csv");
    let all = rows();
    let is_lost = |row: &&(f64, String, Vec<f64>)| row.1 == "lost";
    let lost = all.iter().filter(is_lost).count();
    let flagged = all.iter().filter(|row| row.1 != "tracking").count();
    assert!(all.len() == 150 && lost > 5 && flagged > lost, "{lost} and {flagged} of {all:?}");
    export("--out a.csv --start 20f --end 39f --fps 30 --in-place");
    let part = rows();
    assert_eq!(part.len(), 10);
    for (k, (time, _, pelvis)) in part.iter().enumerate() {
        let whole = &all[20 + 2 * k].2;
        assert!((time - k as f64 / 30.0).abs() < 2e-6 && pelvis[..] == [0.0, whole[1], 0.0], "{k}");
    }
    export("--out a.csv --lost skip");
    assert_eq!(rows().len(), all.len() - flagged);
    // Poses have whole nanoseconds: no time is before the first one, and the rate is the cameras'.
    export("--out a.csv --out a.usda --start 100f --fps 60000/1001");
    assert!(!place.lines("a.csv").iter().any(|line| line.starts_with('-')));
    assert!(
        place.lines("a.usda").iter().any(|line| line.contains("framesPerSecond = 59.94005994"))
    );
    for start in (1..150).step_by(7) {
        export(&format!("--out a.csv --out a.usda --start {start}f"));
        assert!(!place.lines("a.csv")[1].starts_with('-'), "{start}");
    }
    assert!(place.lines("a.usda").iter().any(|line| line.trim() == "framesPerSecond = 60"));
    export("--out a.glb --lost mark");
    let states = place.lines("a.states.csv");
    let marked = states.iter().filter_map(|line| line.strip_suffix(",lost"));
    let frames = |run: &str| {
        let (first, last) = run.split_once(',').unwrap();
        last.parse::<usize>().unwrap() - first.parse::<usize>().unwrap() + 1
    };
    assert_eq!(marked.map(frames).sum::<usize>(), lost);
    for (options, reason) in [
        ("--out b.glb --up z", ".glb: --up is for .bvh, .trc, .c3d, .csv"),
        ("--out b.npz --rest a", ".npz: --rest is for .glb, .usda, .bvh, .csv"),
        ("--out b.glb --figures 3", "--figures is for .svg"),
        ("--out b.mcap --in-place", "a .mcap holds the whole recording"),
        (
            "--out b.csv --start 900f",
            "no poses from --start to --end; the take has poses from 0.00 to 2.48",
        ),
        ("--out b.csv --start 1.5f", "frames such as 120f"),
        ("--out b.csv --start -1", "--start -1: give seconds since the first frame"),
    ] {
        place.fails(USAGE, &format!("export solved/poses.mcap {options}"), &[reason]);
    }
    for (command, reason) in [
        (
            "retarget --skeleton solved/poses.bvh --from solved/poses.mcap --out b.glb",
            "b.glb: the ending must be .bvh",
        ),
        ("decode solved/poses.mcap --out b.bvh", "b.bvh: the ending must be .mcap"),
        ("calibrate solved/poses.mcap --out b.yml", "b.yml: the ending must be .toml"),
    ] {
        place.fails(USAGE, command, &[reason]);
    }
    // Names that others give to joints are those that retargeting knows.
    for (names, known) in [("mixamo", "Mixamo"), ("unreal", "Unreal")] {
        export(&format!("--out named.bvh --rest a --names {names}"));
        let told = place
            .run("retarget --skeleton named.bvh --from solved/poses.mcap --out b.bvh --overwrite");
        let told = String::from_utf8_lossy(&told.stdout).into_owned()
            + &String::from_utf8_lossy(&told.stderr);
        assert!(told.contains(&format!("{known} names, 22 joints")), "{told}");
    }
}

#[test]
fn poses_carry_the_timecode_of_the_house() {
    let place = Place::new();
    walk(&place.path("walk.mcap"), 60, |_| true);
    place.write("house.toml", "[timecode]\nrate = \"25\"\noffset = \"01:00:00:00 at 0\"\n");
    let solve = "solve walk.mcap --out out --config house.toml --start 01:00:00:05";
    assert!(place.run(solve).status.success());
    assert!(place.run("decode out/poses.mcap --out decoded.mcap").status.success());
    for file in ["out/poses.mcap", "decoded.mcap"] {
        let mut reader = Reader::open(place.path(file)).unwrap();
        let messages = std::iter::from_fn(|| reader.next()).map(|entry| entry.unwrap().message);
        let poses = messages.filter_map(|message| match message {
            Message::Pose(pose) => Some((pose.capture_time_ns, pose.timecode)),
            _ => None,
        });
        let poses: Vec<(i64, String)> = poses.collect();
        // All three frames with this timecode are there.
        assert_eq!(poses[0], (183_333_333, "01:00:00:05".to_owned()), "{file}");
        for (capture, label) in poses {
            let number = (capture + 20_000_000) / 40_000_000;
            assert_eq!(label, format!("01:00:{:02}:{:02}", number / 25, number % 25), "{file}");
        }
    }
    let start = |file: &str| Reader::open(place.path(file)).unwrap().metadata()[TAKE].clone();
    assert_eq!(start("out/poses.mcap"), start("decoded.mcap"));
    // At the rate of the house, a part that begins with a timecode has the poses of the whole.
    place.done("solve walk.mcap --out whole --config house.toml");
    place.done("export whole/poses.mcap --fps 25 --out whole.csv");
    for frame in [3, 8, 13] {
        let cut = format!("--fps 25 --start 01:00:00:{frame:02} --out cut.csv --overwrite");
        place.done(&format!("export whole/poses.mcap {cut}"));
        let rows = |file: &str| {
            let rest = |line: String| line.split_once(',').unwrap().1.to_owned();
            place.lines(file).into_iter().skip(1).map(rest).collect::<Vec<_>>()
        };
        assert!(rows("cut.csv") == rows("whole.csv")[frame..], "{frame}");
    }
    // At a higher rate, or from a time between two poses on, a file begins at 0, too.
    for start in ["01:00:00:07", "0.308", "0.3"] {
        let cut = format!("--fps 100 --start {start} --end 0.5 --out cut.csv --overwrite");
        place.done(&format!("export whole/poses.mcap {cut}"));
        let lines = place.lines("cut.csv");
        let time = |line: &String| line.split(',').next().unwrap().parse::<f64>().unwrap();
        assert_eq!(time(&lines[1]), 0.0, "{start}");
        assert!((time(lines.last().unwrap()) - 0.2).abs() < 0.025, "{start}: {:?}", lines.last());
    }
    place.done("retarget --skeleton out/poses.bvh --from out/poses.mcap --out mine.bvh");
    for file in ["out/poses.timecode.txt", "mine.timecode.txt"] {
        assert_eq!(fs::read_to_string(place.path(file)).unwrap(), "01:00:00:05 25\n", "{file}");
    }
}

#[test]
fn keyframes_give_the_poses_of_fast_cameras_too() {
    let place = Place::new();
    place.done("synth --out fast.mcap --seconds 2 --fps 120 --noise clean");
    let slow = place.run("solve fast.mcap --out slow --fps 60");
    let errors = String::from_utf8_lossy(&slow.stderr);
    assert!(errors.contains("the cameras have 120.0 frames a second, not 60.0"), "{errors}");
    place.done("solve fast.mcap --out out");
    place.done("decode out/poses.mcap --out decoded.mcap");
    let poses = |file: &str| -> Vec<(i64, Vec<f32>)> {
        let mut reader = Reader::open(place.path(file)).unwrap();
        let messages = std::iter::from_fn(|| reader.next()).map(|entry| entry.unwrap().message);
        let poses = messages.filter_map(|message| match message {
            Message::Pose(pose) => Some((pose.capture_time_ns, pose.joint_positions_m)),
            _ => None,
        });
        poses.collect()
    };
    let (solved, decoded) = (poses("out/poses.mcap"), poses("decoded.mcap"));
    assert!(solved.len() > 230 && solved == decoded, "{} {}", solved.len(), decoded.len());
}

/// Writes odd.mcap: a walk in which other frames, of any camera, take the place of those of one camera.
fn odd_walk(
    place: &Place,
    camera: &str,
    mut others: impl FnMut(wire::KeypointFrame) -> Vec<wire::KeypointFrame>,
) {
    walk(&place.path("walk.mcap"), 120, |_| true);
    let mut reader = Reader::open(place.path("walk.mcap")).unwrap();
    let topics = Topics::default();
    let (path, provenance) = (place.path("odd.mcap"), Provenance::default());
    let mut writer = Writer::create(path, topics.clone(), &provenance).unwrap();
    while let Some(entry) = reader.next_raw().transpose().unwrap() {
        if *entry.topic != *topics.keypoints(camera) {
            writer.write_raw(&entry).unwrap();
            continue;
        }
        for frame in others(wire::decode(&entry.payload).unwrap()) {
            let (topic, payload) = (topics.keypoints(&frame.camera).into(), wire::encode(&frame));
            writer.write_raw(&RawEntry { topic, payload, ..entry.clone() }).unwrap();
        }
    }
    writer.finish().unwrap();
}

#[test]
fn frames_of_unknown_cameras_and_other_images_are_left_out() {
    let place = Place::new();
    odd_walk(&place, "cam04", |frame| {
        let camera = if frame.frame % 2 == 0 { "cam04" } else { "cam05" };
        let other = wire::KeypointFrame {
            camera: camera.into(),
            frame: frame.frame + 500,
            capture_time_ns: frame.capture_time_ns + 1,
            image_width: 640,
            image_height: 512,
            ..frame.clone()
        };
        vec![frame, other]
    });
    for command in [
        "solve odd.mcap --out odd --json",
        "solve odd.mcap --out four --json --cameras cam01,cam02,cam03,cam04",
    ] {
        let output = place.run(command);
        let errors = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(IN_PART), "{errors}");
        assert!(errors.contains("no calibration of camera cam05"), "{errors}");
        let figures: Value = serde_json::from_slice(&output.stdout).unwrap();
        let damage = figures["damage"][1].as_str().unwrap();
        assert!(damage.contains("60 messages") && damage.contains("640 x 512"), "{damage}");
        assert_eq!((&figures["frames"], &figures["frames_lost"]), (&120.into(), &0.into()));
    }
    let checked = place.run("check odd.mcap");
    let errors = String::from_utf8(checked.stderr).unwrap();
    assert_eq!(checked.status.code(), Some(IN_PART), "{errors}");
    assert!(errors.contains("no calibration of camera cam05"), "{errors}");
}

#[test]
fn a_camera_with_another_keypoint_format_is_left_out_and_said() {
    let place = Place::new();
    // Cameras without a calibration have no vote.
    odd_walk(&place, "cam01", |mut frame| {
        frame.format = "coco_17".into();
        frame.people.iter_mut().for_each(|person| person.points.truncate(3 * 17));
        let all = ["cam01", "cam05", "cam06", "cam07", "cam08"];
        all.map(|camera| wire::KeypointFrame { camera: camera.into(), ..frame.clone() }).to_vec()
    });
    let output = place.run("solve odd.mcap --out odd --json");
    let errors = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(IN_PART), "{errors}");
    let figures: Value = serde_json::from_slice(&output.stdout).unwrap();
    let damage = figures["damage"][1].as_str().unwrap();
    let told = ["120 messages of", "cam01", "coco_17, most cameras have body_25"];
    assert!(told.iter().all(|words| damage.contains(words)), "{damage}");
    assert_eq!((&figures["frames"], &figures["frames_lost"]), (&120.into(), &0.into()));
}

#[test]
fn who_is_away_for_a_while_is_no_failure() {
    let place = Place::new();
    walk(&place.path("walk.mcap"), 150, |detections| {
        if (60..90).contains(&detections.frame) {
            detections.people.clear();
        }
        true
    });
    let output = place.run("solve walk.mcap --out out --overwrite --json");
    let errors = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(0), "{errors}");
    assert!(errors.starts_with("note: not seen well enough in ") && errors.lines().count() == 1);
    let figures: Value = serde_json::from_slice(&output.stdout).unwrap();
    let count = |name: &str| figures[name].as_u64().unwrap();
    assert!(count("hidden") >= 2 && count("hidden") == count("lost"), "{figures}");
    let good = count("frames") - count("frames_lost");
    assert!((110..=125).contains(&good), "{good} frames");
    for (command, told) in [
        ("decode out/poses.mcap --out decoded.mcap", "poses have no keyframes, and are left out"),
        ("retarget --skeleton out/poses.bvh --from out/poses.mcap --out r.bvh", "coasting or lost"),
    ] {
        let output = place.run(command);
        let errors = String::from_utf8(output.stderr).unwrap();
        assert!(output.status.success() && errors.contains(told), "{errors}");
    }
}

#[test]
fn windows_that_fit_badly_are_counted_and_the_rest_is_solved() {
    let place = Place::new();
    let mut side = 1.0;
    walk(&place.path("walk.mcap"), 150, |detections| {
        if (60..90).contains(&detections.frame) {
            for point in detections.people.iter_mut().flat_map(|person| &mut person.points) {
                side = -side;
                point.iter_mut().for_each(|point| point.pixel.x += side * 15.0);
            }
        }
        true
    });
    place.write("strict.toml", "[tracker.gate]\nlost_residual = 0.02\n");
    let output = place.run("solve walk.mcap --out out --config strict.toml --json");
    let errors = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(IN_PART), "{errors}");
    assert!(
        errors.contains("warning: walk.mcap: ") && errors.contains("windows fit badly"),
        "{errors}"
    );
    let figures: Value = serde_json::from_slice(&output.stdout).unwrap();
    let count = |name: &str| figures[name].as_u64().unwrap();
    assert!(count("lost") > count("hidden"), "{figures}");
    let good = count("frames") - count("frames_lost");
    assert!((90..=125).contains(&good), "{good} frames");
}

#[test]
fn missing_files_and_wrong_file_types_are_refused() {
    let place = Place::new();
    place.fails(UNREADABLE, "solve no.mcap --out out", &["no.mcap", "check the path"]);
    place.fails(UNREADABLE, "info no.mcap", &["no.mcap"]);
    place.fails(UNREADABLE, "export no.mcap --out out.bvh", &["no.mcap"]);
    place.write("empty.mcap", "");
    place.fails(MALFORMED, "solve empty.mcap --out out", &["empty.mcap", "it is empty"]);
    place.write("text.mcap", "a text file, no recording");
    place.fails(MALFORMED, "solve text.mcap --out out", &["text.mcap", "bundlemocap import"]);
    fs::create_dir(place.path("folder.mcap")).unwrap();
    place.fails(UNREADABLE, "solve folder.mcap --out out", &["folder.mcap"]);
    let usage = place.run("solve");
    assert_eq!(usage.status.code(), Some(2));
}

#[test]
fn recordings_without_our_channels_are_refused() {
    let place = Place::new();
    let mut foreign =
        mcap::Writer::new(fs::File::create(place.path("foreign.mcap")).unwrap()).unwrap();
    let channel = foreign.add_channel(0, "/tf", "json", &Default::default()).unwrap();
    let header = mcap::records::MessageHeader {
        channel_id: channel,
        sequence: 0,
        log_time: 1,
        publish_time: 1,
    };
    foreign.write_to_known_channel(&header, b"{}").unwrap();
    foreign.finish().unwrap();
    place.fails(NOT_OURS, "solve foreign.mcap --out out", &["foreign.mcap", "/tf", "import"]);

    let path = place.path("rigless.mcap");
    walk(&path, 10, |_| true);
    let provenance = Provenance::default();
    let mut rigless = Writer::create(&path, Topics::default(), &provenance).unwrap();
    let frame = bundlemocap::io::wire::KeypointFrame {
        camera: "cam01".into(),
        format: "body_25".into(),
        ..Default::default()
    };
    rigless.write("mocap/stage/camera/cam01/keypoints", Timestamp::default(), &frame).unwrap();
    rigless.finish().unwrap();
    place.fails(NOT_OURS, "solve rigless.mcap --out out", &["rigless.mcap", "--calibration"]);

    walk(&place.path("walk.mcap"), 30, |_| true);
    place.fails(NOT_OURS, "export walk.mcap --out out.bvh", &["walk.mcap", "bundlemocap solve"]);
    place.run("solve walk.mcap --out solved");
    place.fails(NOT_OURS, "solve solved/poses.mcap --out out", &["poses.mcap", "keypoints"]);
}

#[test]
fn invalid_folders_are_not_imported() {
    let place = Place::new();
    place.write("calib.toml", calibration(&["cam1", "cam2"], 600.0));
    let import = format!("{IMPORT} --format body_25");
    place.fails(UNREADABLE, &import, &["pose"]);
    place.fails(UNREADABLE, "import pose --calibration calib.toml --out take.mcap", &["pose"]);
    place.write("own.csv", "");
    let own = "import own.csv --calibration calib.toml --out own.csv --overwrite";
    place.fails(USAGE, own, &["is the input; choose another name"]);
    fs::create_dir(place.path("pose")).unwrap();
    place.fails(NO_DETECTIONS, &import, &["pose", "no detections are found"]);
    detections(&place, &["cam1", "cam2", "cam3"], 75);
    let strict = format!("{import} --strict");
    place.fails(CAMERA_MISMATCH, &strict, &["cam3", "calibrate the camera"]);
    place.write("calib.toml", calibration(&["cam1", "cam2", "cam3", "cam4"], 600.0));
    let strict = format!("{import} --strict");
    place.fails(CAMERA_MISMATCH, &strict, &["cam4", "remove it from the calibration"]);
    place.write("calib.toml", calibration(&["cam1", "cam2", "cam3"], 600.0));
    let text = place.write("pose/cam2_json/cam2.0003.json", "{\"people\": 3}");
    place.fails(MALFORMED, &strict, &["cam2.0003.json", "no list of people"]);
    fs::write(&text, "not json").unwrap();
    place.fails(MALFORMED, &strict, &["cam2.0003.json"]);
    let other = import.replace("--fps", "--camera cam2_json=cam9 --fps");
    place.fails(2, &other, &["there is no cam9; there are cam1, cam2, cam3"]);

    place.write("calib.toml", calibration(&["cam1", "cam2", "cam3", "cam4"], 600.0));
    let said = place.done(&import);
    assert!(said.contains("cam2: 20 frames, numbers 0 to 19, 19 people"), "{said}");
    assert!(said.contains("; 1 broken files"), "{said}");
    let same = import.replace("import pose", "import openpose pose");
    place.done(&same.replace("--fps", "--overwrite --camera cam2_json=cam2 --fps"));
}

#[test]
fn invalid_calibrations_are_refused() {
    let place = Place::new();
    detections(&place, &["cam1", "cam2"], 75);
    let import = format!("{IMPORT} --format body_25");
    place.fails(UNREADABLE, &import, &["calib.toml"]);
    place.write("calib.toml", "[cam1]\nname = 3\n");
    place.fails(MALFORMED, &import, &["calib.toml"]);
    place.write("calib.toml", calibration(&["cam1", "cam2"], 0.0));
    place.fails(BAD_CALIBRATION, &import, &["calib.toml", "cam1", "singular", "positive fx"]);
    place.write("calib.toml", crate::import::qualisys(0.5));
    place.fails(BAD_CALIBRATION, &import, &["calib.toml", "camera b", "no rotation", "check"]);
    place.write("calib.toml", calibration(&["cam1"], 600.0));
    place.fails(BAD_CALIBRATION, &import, &["calib.toml", "at least two cameras"]);
    walk(&place.path("walk.mcap"), 10, |_| true);
    let one = "solve walk.mcap --out out --overwrite --cameras cam01";
    place.fails(USAGE, one, &["walk.mcap", "leave 1 of 4 cameras; two are needed"]);
    place.fails(USAGE, "solve walk.mcap --out walk.mcap", &["walk.mcap is a file", "a folder"]);
    place.fails(
        UNREADABLE,
        "solve . --out out",
        &["is a folder; give recordings, such as ./*.mcap"],
    );
    let another = "solve walk.mcap --out out --overwrite --hold-out cam9";
    place.fails(CAMERA_MISMATCH, another, &["walk.mcap", "cam9", "cam04"]);
}

#[test]
fn cameras_that_do_not_fit_the_rig_are_refused() {
    let place = Place::new();
    walk(&place.path("silent.mcap"), 20, |detections| detections.camera != 2);
    let evidence = ["silent.mcap", "cam03 has no keypoints", "--cameras"];
    place.fails(CAMERA_MISMATCH, "solve silent.mcap --out out --cameras cam1,cam3", &evidence);
    place.fails(CAMERA_MISMATCH, "solve silent.mcap --out out --hold-out cam3", &evidence);
    let solve = |command: &str| {
        let output = place.run(command);
        assert!(output.status.success(), "{output:?}");
        String::from_utf8(output.stderr).unwrap()
    };
    let notes = solve("solve silent.mcap --out all");
    assert!(notes.contains("note: no keypoints of camera cam03; the others are used"), "{notes}");
    let notes = solve("solve silent.mcap --out three --cameras cam1,cam2,cam4");
    assert!(!notes.contains("cam03"), "{notes}");
    let motion = |folder: &str| std::fs::read(place.path(folder).join("poses.bvh")).unwrap();
    assert!(motion("all") == motion("three"));
    place.done("calibrate silent.mcap --out silent.toml --time-only");
    let written = std::fs::read_to_string(place.path("silent.toml")).unwrap();
    assert!(written.contains("cam03"), "{written}");

    let rig = ring_rig(4, 4.0, 1.6).unwrap();
    let write = |name: &str, camera: &str, image_width: u32| {
        let provenance = Provenance::default();
        let mut writer = Writer::create(place.path(name), Topics::default(), &provenance).unwrap();
        writer.rig(&rig, Timestamp::default()).unwrap();
        let frame = bundlemocap::io::wire::KeypointFrame {
            camera: camera.into(),
            image_width,
            image_height: 1024,
            format: "body_25".into(),
            ..Default::default()
        };
        let topic = Topics::default().keypoints(camera);
        writer.write(&topic, Timestamp::default(), &frame).unwrap();
        writer.finish().unwrap();
    };
    write("foreign.mcap", "cam09", 1280);
    place.fails(CAMERA_MISMATCH, "solve foreign.mcap --out out", &["foreign.mcap", "cam09"]);
    write("small.mcap", "cam01", 640);
    let evidence = ["small.mcap", "cam01", "1280 x 1024", "640 x 1024"];
    place.fails(BAD_CALIBRATION, "solve small.mcap --out out", &evidence);
}

/// A recording of one rig message and one keypoint message, valid or not.
fn one_frame(
    path: &Path,
    rig: &bundlemocap::io::wire::Rig,
    keypoints: &bundlemocap::io::wire::KeypointFrame,
) {
    let mut writer = Writer::create(path, Topics::default(), &Provenance::default()).unwrap();
    let (topics, at) = (Topics::default(), Timestamp::default());
    writer.write(&topics.rig(), at, rig).unwrap();
    writer.write(&topics.keypoints("cam01"), at, keypoints).unwrap();
    writer.finish().unwrap();
}

#[test]
fn invalid_rigs_and_keypoints_in_recordings_are_refused() {
    use bundlemocap::io::wire::{DetectedPerson, KeypointFrame, Rig};
    let place = Place::new();
    let rig = || Rig::from_core(&ring_rig(4, 4.0, 1.6).unwrap());
    let keypoints = |format: &str, numbers: usize| KeypointFrame {
        camera: "cam01".into(),
        image_width: 1280,
        image_height: 1024,
        format: format.into(),
        people: vec![DetectedPerson { points: vec![1.0; numbers], ..Default::default() }],
        ..Default::default()
    };
    let refused = |code: i32, rig: Rig, keypoints: KeypointFrame, evidence: &[&str]| {
        one_frame(&place.path("bad.mcap"), &rig, &keypoints);
        place.fails(code, "solve bad.mcap --out out", &[&["bad.mcap"], evidence].concat());
    };
    let mut singular = rig();
    singular.cameras[1].focal_px = vec![0.0, 600.0];
    refused(BAD_CALIBRATION, singular, keypoints("body_25", 75), &["/rig", "cam02", "singular"]);
    let mut no_rotation = rig();
    no_rotation.cameras[2].camera_from_world_rotation = vec![0.0; 4];
    let evidence = ["/rig", "rotation", "length zero", "calibration"];
    refused(BAD_CALIBRATION, no_rotation, keypoints("body_25", 75), &evidence);
    let mut alone = rig();
    alone.cameras.truncate(1);
    refused(BAD_CALIBRATION, alone, keypoints("body_25", 75), &["at least two cameras"]);
    let mut far = rig();
    far.cameras[1].time_offset_ns = i64::MAX;
    refused(
        BAD_CALIBRATION,
        far,
        keypoints("body_25", 75),
        &["cam02", "more than a hundred years"],
    );
    let evidence = ["cam01/keypoints", "body_26", "halpe_26"];
    refused(KEYPOINT_FORMAT, rig(), keypoints("body_26", 75), &evidence);
    let evidence = ["cam01/keypoints", "51 entries, expected 75", "--format"];
    refused(KEYPOINT_FORMAT, rig(), keypoints("body_25", 51), &evidence);
}

#[test]
fn keypoints_of_another_format_are_refused() {
    let place = Place::new();
    place.write("calib.toml", calibration(&["cam1", "cam2"], 600.0));
    detections(&place, &["cam1", "cam2"], 75);
    place.fails(KEYPOINT_FORMAT, &format!("{IMPORT} --format body_26"), &["body_26", "halpe_26"]);
    let coco = format!("{IMPORT} --format coco_17");
    place.fails(KEYPOINT_FORMAT, &coco, &["cam1.0000.json", "25 points", "body_25"]);
    place.fails(KEYPOINT_FORMAT, "synth --out out.mcap --format what", &["what", "body_25"]);
}

#[test]
fn a_recording_that_shows_nobody_is_refused() {
    let place = Place::new();
    place.write("calib.toml", calibration(&["cam1", "cam2"], 600.0));
    detections(&place, &["cam1", "cam2"], 0);
    place.done(&format!("{} --format body_25", IMPORT.replace("out.mcap", "nobody.mcap")));
    let evidence = ["nobody.mcap", "nobody was found", "check the calibration"];
    place.fails(NOBODY_FOUND, "solve nobody.mcap --out out", &evidence);

    walk(&place.path("one.mcap"), 60, |detections| {
        if detections.camera > 0 {
            detections.people.clear();
        }
        true
    });
    place.fails(NOBODY_FOUND, "solve one.mcap --out out", &["one.mcap", "two of the 4 cameras"]);

    walk(&place.path("short.mcap"), 3, |_| true);
    let evidence = ["3 frames of a camera", "too few to tell who is a performer"];
    place.fails(NOBODY_FOUND, "solve short.mcap --performers auto --out out", &evidence);
    place.done("solve short.mcap --out short");
}

#[test]
fn an_unsorted_recording_reports_its_late_frames() {
    let place = Place::new();
    let mut all = Vec::new();
    walk(&place.path("walk.mcap"), 120, |detections| {
        all.push(detections.clone());
        true
    });
    // One camera after the other, the first for longer: the frames of the others arrive after their
    // windows are closed.
    all.retain(|detections| detections.camera == 0 || detections.frame < 60);
    write_sorted(&place.path("unsorted.mcap"), all);
    let evidence = ["unsorted.mcap", "nobody was found", "frames came late", "sorted by capture"];
    place.fails(NOBODY_FOUND, "solve unsorted.mcap --out out", &evidence);
}

/// The number of poses of a solve, and their rate.
fn poses_and_rate(place: &Place, recording: &str) -> (u64, f64) {
    let figures = place.done(&format!("solve {recording} --out out --overwrite --json"));
    let figures: Value = serde_json::from_str(&figures).unwrap();
    (figures["frames"].as_u64().unwrap(), figures["frame_rate_hz"].as_f64().unwrap())
}

#[test]
fn jitter_of_the_timestamps_does_not_change_the_rate() {
    let place = Place::new();
    for (jitter_ms, seed) in [(1.0, 1), (5.0, 2)] {
        let draws = Draws { seed, stream: 0 };
        walk(&place.path("jitter.mcap"), 240, |detections| {
            let item = 16 * detections.frame + detections.camera as u64;
            let jitter = draws.normals(0, item)[0] * jitter_ms * 1e6;
            detections.capture = detections.capture + Nanos::SECOND + Nanos::rounded(jitter);
            true
        });
        let (poses, rate) = poses_and_rate(&place, "jitter.mcap");
        assert!((239..=241).contains(&poses), "{poses} poses at {rate} Hz, jitter {jitter_ms} ms");
        assert!((rate / 60.0 - 1.0).abs() < 1e-3, "{rate} Hz, jitter {jitter_ms} ms");
    }
}

#[test]
fn a_rate_may_be_a_ratio() {
    let place = Place::new();
    place.fails(USAGE, "synth --out a.mcap --fps 60/0", &["--fps is inf"]);
    assert_eq!(place.run("synth --out a.mcap --fps 60/x").status.code(), Some(USAGE));
    place.done("synth --out ntsc.mcap --seconds 2 --noise jitter --fps 60000/1001");
    let (_, rate) = poses_and_rate(&place, "ntsc.mcap");
    assert!((rate / (60e3 / 1001.0) - 1.0).abs() < 1e-6, "{rate}");
}

#[test]
fn capture_times_in_other_units_are_refused() {
    let place = Place::new();
    for (unit, ns) in [("milliseconds", 1_000_000), ("microseconds", 1_000)] {
        walk(&place.path("unit.mcap"), 120, |detections| {
            let in_unit = detections.capture.ns() / ns;
            if detections.camera == 2 {
                detections.capture = Timestamp::from_ns(in_unit);
            }
            true
        });
        let evidence = ["unit.mcap", "camera cam03", unit, "multiply them by"];
        place.fails(MALFORMED, "solve unit.mcap --out out", &evidence);
    }
}

#[test]
fn invalid_weights_and_settings_are_refused() {
    let place = Place::new();
    walk(&place.path("walk.mcap"), 10, |_| true);
    let solve = "solve walk.mcap --out out --overwrite";
    let weights = format!("{solve} --weights w.safetensors");
    place.fails(UNREADABLE, &weights, &["w.safetensors"]);
    place.write("w.safetensors", "these are no weights");
    place.fails(WEIGHTS, &weights, &["w.safetensors", "safetensors file"]);
    let mut header =
        br#"{"__metadata__":{"format":"bundlemocap-manifold","version":"0"}}"#.to_vec();
    header.resize(header.len().next_multiple_of(8), b' ');
    let file = [&(header.len() as u64).to_le_bytes()[..], &header].concat();
    place.write("w.safetensors", file);
    place.fails(WEIGHTS, &weights, &["w.safetensors", "version", "bundlemocap train"]);

    let config = format!("{solve} --config c.toml");
    place.fails(UNREADABLE, &config, &["c.toml"]);
    place.write("c.toml", "[tracker]\nwindow = 3\n");
    place.fails(MALFORMED, &config, &["c.toml, line 2", "window"]);
    let reference = format!("{solve} --reference r.trc");
    place.fails(UNREADABLE, &reference, &["r.trc"]);
    place.write("r.trc", "hello");
    place.fails(MALFORMED, &reference, &["r.trc", "PathFileType"]);
    place.write("r.trc", markers_file("shin", "0\t0.0\t9.0\t9.0\t9.0\n"));
    place.fails(MALFORMED, &reference, &["r.trc", "shin", "--markers"]);
    let mapped = format!("{reference} --markers map.toml");
    place.write("map.toml", "[points]\nleft_knee = ['shin', 'thigh']\n");
    place.fails(MALFORMED, &mapped, &["map.toml", "thigh is not in r.trc, which has shin"]);
    place.write("map.toml", "[points]\nfin = 'shin'\n");
    place.fails(MALFORMED, &mapped, &["map.toml", "fin is no point of ours"]);
    place.write("c.toml", "[tracker]\nwindow_frames = 100000\n");
    place.fails(MALFORMED, &config, &["c.toml", "tracker.window_frames is 100000", "1 to 1000"]);
    place.write("c.toml", "[tracker]\nframe_rate_hz = 1e9\n");
    place.fails(
        MALFORMED,
        &config,
        &["c.toml", "tracker.frame_rate_hz is 1000000000", "1 to 1000"],
    );
    for fps in ["-3", "0", "1001", "NaN", "inf"] {
        let evidence = [&format!("--fps is {fps}"), "1 to 1000"];
        place.fails(2, &format!("{solve} --fps {fps}"), &evidence);
        let import = IMPORT.replace("--fps 60", &format!("--fps {fps}"));
        place.fails(2, &format!("{import} --format body_25"), &evidence);
    }
}

#[test]
fn unwritable_outputs_are_reported() {
    let place = Place::new();
    place.fails(1, "synth --out nowhere/walk.mcap", &["nowhere/walk.mcap", "folder exists"]);
    walk(&place.path("walk.mcap"), 10, |_| true);
    place.write("file", "in the way");
    place.fails(1, "solve walk.mcap --out file/out", &["file/out"]);
}

#[test]
fn invalid_motions_are_not_used_for_training() {
    let place = Place::new();
    place.fails(UNREADABLE, "train motions --out w.safetensors", &["motions"]);
    fs::create_dir(place.path("motions")).unwrap();
    place.fails(NO_DETECTIONS, "train motions --out w.safetensors", &["motions", ".bvh"]);
    place.write("motions/a.bvh", "no BVH");
    place.fails(MALFORMED, "train motions --out w.safetensors", &["a.bvh"]);
}

/// Folder of the real recordings, if the data is available.
fn real_set() -> Option<PathBuf> {
    data("recordings/pose2sim")
}

/// Imports one of the real recordings; returns the reference of the same performer.
fn import_real(place: &Place, set: &Path, take: &str, reference: &str) -> PathBuf {
    let import = format!(
        "import openpose {0}/{take}/pose --calibration {0}/calibration/Calib_qualisys.toml \
         --fps 60 --format body_25b --out take.mcap",
        set.display()
    );
    assert!(place.done(&import).contains("cam01_json  -> cam_01 (by name)"));
    files(&set.join(take).join("pose-3d"))
        .into_iter()
        .find(|path| path.to_string_lossy().ends_with(reference))
        .unwrap()
}

fn number(figures: &Value, pointer: &str) -> f64 {
    figures.pointer(pointer).and_then(Value::as_f64).unwrap()
}

#[test]
fn the_real_recording_is_solved_with_the_documented_accuracy() {
    let Some(set) = real_set() else { return };
    let place = Place::new();
    let reference = import_real(&place, &set, "balancing", "butterworth.trc");
    let solve = format!("solve take.mcap --out out --json --reference {}", reference.display());
    let figures: Value = serde_json::from_str(&place.done(&solve)).unwrap();
    assert_eq!((&figures["frames"], &figures["frames_lost"]), (&100.into(), &0.into()));
    assert_eq!(figures["reference"]["frames"], 100);
    pinned("residual, px", number(&figures, "/reprojection/median_px"), 11.45);
    pinned("reference, mm", number(&figures, "/reference/mean_mm"), 23.0);
    pinned("worst mid hip, mm", number(&figures, "/reference/worst_mid_hip_mm"), 53.91);
    pinned("acceleration", number(&figures, "/mean_acceleration_m_s2"), 5.47);
}

/// Median pixels in each camera: what was measured, and Pose2Sim 0.10.49 on the same detections.
const HELD_OUT_PX: [(&str, f64, f64); 4] = [
    ("cam01", 29.71, 32.9),
    ("cam02", 13.38, 14.2),
    ("cam03", 38.32, 38.8),
    ("cam04", 18.79, 20.3),
];

#[test]
fn three_cameras_predict_the_fourth_better_than_triangulation() {
    let Some(set) = real_set() else { return };
    let place = Place::new();
    import_real(&place, &set, "balancing", "butterworth.trc");
    for (camera, measured, pose2sim) in HELD_OUT_PX {
        let solve = format!("solve take.mcap --out out --overwrite --json --hold-out {camera}");
        let figures: Value = serde_json::from_str(&place.done(&solve)).unwrap();
        let median = number(&figures, "/hold_out/median_px");
        assert!(median < pose2sim, "{camera}: {median} px");
        pinned(camera, median, measured);
    }
}

#[test]
fn the_performer_is_selected_and_not_the_bystander() {
    let Some(set) = real_set() else { return };
    let place = Place::new();
    let reference = import_real(&place, &set, "two_people", "P2_0-100_filt_butterworth.trc");
    let solve = format!("solve take.mcap --out out --json --reference {}", reference.display());
    let figures: Value = serde_json::from_str(&place.done(&solve)).unwrap();
    assert_eq!((&figures["frames"], &figures["frames_lost"]), (&100.into(), &0.into()));
    pinned("worst mid hip, mm", number(&figures, "/reference/worst_mid_hip_mm"), 53.88);
}

#[test]
fn both_people_of_the_real_recording_are_solved() {
    let Some(set) = real_set() else { return };
    let place = Place::new();
    let first = import_real(&place, &set, "two_people", "P1_0-100.trc");
    let second = first.with_file_name(
        first.file_name().unwrap().to_string_lossy().replace("P1_0-100", "P2_0-100"),
    );
    let mut nearest = Vec::new();
    for (reference, measured) in [(first, 11.48), (second, 27.6)] {
        let solve = format!(
            "solve take.mcap --out out --overwrite --json --performers auto --reference {}",
            reference.display()
        );
        let figures: Value = serde_json::from_str(&place.done(&solve)).unwrap();
        let performers = figures["performers"].as_array().unwrap();
        assert_eq!(performers.len(), 2);
        let off = |one: &Value| number(one, "/reference/mean_mm");
        let one = performers.iter().min_by(|a, b| off(a).total_cmp(&off(b))).unwrap();
        assert_eq!((&one["frames"], &one["frames_lost"]), (&100.into(), &0.into()));
        assert_eq!(one["reference"]["frames"], 100);
        pinned("reference, mm", off(one), measured);
        assert!(off(one) < 36.0);
        nearest.push(one["performer"].clone());
    }
    assert_ne!(nearest[0], nearest[1]);
}

#[test]
fn several_performers_are_solved_into_one_recording_and_a_file_each() {
    let place = Place::new();
    place.done("synth --out crowd.mcap --performers 3 --seconds 3 --noise clean");
    let text = place.done("solve crowd.mcap --out out --performers auto");
    assert!(text.contains("p3") && text.contains("from the truth"), "{text}");
    let mut names: Vec<String> = files(&place.path("out"))
        .iter()
        .map(|path| path.file_name().unwrap().to_string_lossy().into_owned())
        .collect();
    names.sort();
    let performers = ["p1", "p2", "p3"];
    let mut expected = vec!["poses.mcap".to_owned(), "report.html".to_owned()];
    expected.extend(performers.map(|name| format!("poses.{name}.bvh")));
    expected.extend(performers.map(|name| format!("poses.{name}.states.csv")));
    expected.sort();
    assert_eq!(names, expected);
    let info: Value = serde_json::from_str(&place.done("info out/poses.mcap --json")).unwrap();
    for name in performers {
        for (channel, least) in [("pose", 175), ("keyframe", 170), ("skeleton", 1), ("events", 2)] {
            let topic = format!("mocap/stage/actor/{name}/{channel}");
            let count = info["topics"][&topic]["count"].as_u64().unwrap();
            assert!(count >= least, "{topic}: {count}");
        }
    }
    place.done("solve crowd.mcap --out alone --performers auto --threads 1");
    let poses = ["out", "alone"].map(|out| fs::read(place.path(out).join("poses.mcap")).unwrap());
    assert!(poses[0] == poses[1], "the threads change the poses");
    let report = fs::read_to_string(place.path("out/report.html")).unwrap();
    assert!(performers.iter().all(|name| report.contains(&format!("<h2>{name}</h2>"))));
    place.done("export out/poses.mcap --out again.bvh --out again.svg");
    place.done("retarget --skeleton out/poses.p1.bvh --from out/poses.mcap --out other.bvh");
    place
        .done("retarget --skeleton out/poses.p2.bvh --from out/poses.mcap --actor p2 --out p2.bvh");
    let parts = |name: &str| {
        let text = fs::read_to_string(place.path(name)).unwrap();
        (text.split_once("MOTION").unwrap().0.to_owned(), text.lines().last().unwrap().to_owned())
    };
    for name in performers {
        assert!(place.path(&format!("again.{name}.svg")).exists());
        assert_eq!(parts(&format!("again.{name}.bvh")), parts(&format!("out/poses.{name}.bvh")));
        assert_eq!(parts(&format!("other.{name}.bvh")).0, parts("other.p1.bvh").0);
    }
    assert_eq!(parts("p2.bvh").0.matches("JOINT").count(), 21);
    let nobody = place.run("export out/poses.mcap --out no.bvh --actor p4");
    assert_eq!(nobody.status.code(), Some(USAGE));
    assert!(String::from_utf8_lossy(&nobody.stderr).contains("may be p1, p2, p3"));
    walk(&place.path("walk.mcap"), 60, |_| true);
    let evidence = ["out/poses.mcap holds the bodies of p1, p2, p3", "--body-actor"];
    for command in ["solve walk.mcap --out one", "run"] {
        let refused = place.run(&format!("{command} --body out/poses.mcap"));
        let errors = String::from_utf8_lossy(&refused.stderr);
        assert_eq!(refused.status.code(), Some(USAGE), "{errors}");
        assert!(evidence.iter().all(|part| errors.contains(part)), "{errors}");
    }
    place.done("solve walk.mcap --out one --body out/poses.mcap --body-actor p2");

    // What was seen for a moment is nobody's body.
    let short = place.run(
        "solve crowd.mcap --out short --performers auto --names lead,double --bodies none --end 1.5",
    );
    let errors = String::from_utf8_lossy(&short.stderr);
    assert!(short.status.success() && errors.contains("no body of lead is written"), "{errors}");
    assert!(!place.path("none/lead.mcap").exists());

    place
        .done("solve crowd.mcap --out named --performers auto --names lead,double --bodies bodies");
    assert!(
        place.path("named/poses.double.bvh").exists() && place.path("named/poses.p3.bvh").exists()
    );
    let known = "solve crowd.mcap --out known --performers auto --bodies bodies --only lead --json";
    let known: Value = serde_json::from_str(&place.done(known)).unwrap();
    let names: Vec<&Value> =
        known["performers"].as_array().unwrap().iter().map(|one| &one["performer"]).collect();
    assert_eq!((names, &known["others"]), (vec![&Value::from("lead")], &2.into()));
    place.write("small.toml", "[stage]\nmin_height_px = 5000\n[node]\nbody = 'a.mcap'\n");
    let alone = place.run("solve crowd.mcap --out no --config small.toml");
    let errors = String::from_utf8_lossy(&alone.stderr);
    assert_eq!(alone.status.code(), Some(MALFORMED), "{errors}");
    assert!(errors.contains("small.toml: [stage] names"), "{errors}");
    place.write("auto.toml", "[stage]\nperformers = \"auto\"\nmin_height_px = 5000\n");
    let one = place.run("solve walk.mcap --out largest --config auto.toml --performers 1");
    let errors = String::from_utf8_lossy(&one.stderr);
    assert!(one.status.success() && errors.contains("have no effect"), "{errors}");
    let nobody = place.run("solve crowd.mcap --out no --config small.toml --performers auto");
    let errors = String::from_utf8_lossy(&nobody.stderr);
    let evidence = "at most 3 at a time, but [stage] only, region or min_height_px excludes all";
    assert!(nobody.status.code() == Some(5) && errors.contains(evidence), "{errors}");
    for (options, evidence) in [
        ("--performers auto --bodies bodies --only ghost", "no body of ghost, but of double, lead"),
        ("--performers auto --only lead", "[stage] only needs [stage] bodies"),
        ("--names lead", "--names, --bodies and --only are for several people"),
        ("--performers auto --names p1", "names must differ"),
    ] {
        let refused = place.run(&format!("solve crowd.mcap --out no {options}"));
        let errors = String::from_utf8_lossy(&refused.stderr);
        assert_eq!(refused.status.code(), Some(USAGE), "{errors}");
        assert!(errors.contains(evidence), "{errors}");
    }

    let again = place.run("solve crowd.mcap --out out --performers auto");
    assert_eq!(again.status.code(), Some(USAGE));
    assert!(String::from_utf8_lossy(&again.stderr).contains("poses.mcap exists"));
    let many = place.run("solve crowd.mcap --out many --performers 33");
    assert_eq!(many.status.code(), Some(USAGE));
    assert!(String::from_utf8_lossy(&many.stderr).contains("1 to 32 or auto"));

    let two = place.run("solve crowd.mcap --out two --performers 2 --json");
    let errors = String::from_utf8_lossy(&two.stderr);
    assert!(errors.contains("1 more person was seen, not solved"), "{errors}");
    let two: Value = serde_json::from_slice(&two.stdout).unwrap();
    assert_eq!((two["performers"].as_array().unwrap().len(), &two["others"]), (2, &1.into()));
    assert_eq!(two["scores"]["id_switches"], 0);
    // One of three people is nobody's.
    let recall = number(&two, "/scores/recall_percent");
    assert!((66.0..66.7).contains(&recall), "{recall}");
}

//! Calibrations and detections of other programs: the real data set, and small ones made here.

use std::collections::HashMap;
use std::fs;
use std::path::{Path, PathBuf};

use bundlemocap::core::body::{Skeleton, StampedPose};
use bundlemocap::core::camera::{Camera, Lens, Rig, View, triangulate_robust};
use bundlemocap::core::detections::{Detections, Keypoint, KeypointFormat, Person};
use bundlemocap::core::so3;
use bundlemocap::core::time::Timestamp;
use bundlemocap::io::formats::read_trajectories;
use bundlemocap::io::formats::{
    Convention, DetectionFolder, DetectionOptions, ImportError, MatchedBy, PointOrder, Up,
    keypoint_format, read_calibration,
};
use bundlemocap::io::recording::{Provenance, Writer};
use bundlemocap::io::wire::Topics;
use bundlemocap::offline::{Observer, Options, Recording, solve};
use nalgebra::{Vector2, Vector3};
use serde_json::{Value, json};
use tempfile::TempDir;

use crate::support::data;

const LIMBS: [(Keypoint, &str); 12] = [
    (Keypoint::LShoulder, "LShoulder"),
    (Keypoint::RShoulder, "RShoulder"),
    (Keypoint::LElbow, "LElbow"),
    (Keypoint::RElbow, "RElbow"),
    (Keypoint::LWrist, "LWrist"),
    (Keypoint::RWrist, "RWrist"),
    (Keypoint::LHip, "LHip"),
    (Keypoint::RHip, "RHip"),
    (Keypoint::LKnee, "LKnee"),
    (Keypoint::RKnee, "RKnee"),
    (Keypoint::LAnkle, "LAnkle"),
    (Keypoint::RAnkle, "RAnkle"),
];

/// Folder of the real recordings, if the data is available.
fn real_set() -> Option<PathBuf> {
    data("recordings/pose2sim")
}

fn toml_rig(set: &Path) -> Rig {
    read_calibration(&set.join("calibration/Calib_qualisys.toml"), &Up::Z.into()).unwrap().rig
}

fn qca_rig(set: &Path) -> Rig {
    read_calibration(&set.join("calibration/Calib.qca.txt"), &Up::Z.into()).unwrap().rig
}

/// Marker positions of a TRC file by name, per frame.
fn read_trc(path: &Path) -> Vec<HashMap<String, Vector3<f64>>> {
    let text = fs::read_to_string(path).unwrap();
    let mut lines = text.lines();
    let names: Vec<String> = lines
        .nth(3)
        .unwrap()
        .split('\t')
        .skip(2)
        .filter(|name| !name.is_empty())
        .map(str::to_owned)
        .collect();
    let frame = |line: &str| {
        let values: Vec<f64> = line.split('\t').skip(2).map(|v| v.parse().unwrap()).collect();
        let points = values.chunks_exact(3).map(Vector3::from_column_slice);
        names.iter().cloned().zip(points).collect()
    };
    lines.skip(1).filter(|l| !l.trim().is_empty()).map(frame).collect()
}

fn butterworth(set: &Path) -> Vec<HashMap<String, Vector3<f64>>> {
    let mut folder = fs::read_dir(set.join("balancing/pose-3d")).unwrap();
    let file = folder.find_map(|e| {
        let path = e.unwrap().path();
        path.to_string_lossy().ends_with("filt_butterworth.trc").then_some(path)
    });
    read_trc(&file.unwrap())
}

fn surest(detections: &Detections) -> Option<&Person> {
    let sum = |p: &Person| p.points.iter().flatten().map(|d| d.confidence).sum::<f64>();
    detections.people.iter().max_by(|a, b| sum(a).total_cmp(&sum(b)))
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

/// Views of one keypoint by frame, of the most confident person of each camera.
fn views_by_frame(folder: &Path, rig: &Rig, keypoint: Keypoint) -> Vec<Vec<View>> {
    let index = KeypointFormat::Body25b.index_of(keypoint).unwrap();
    let mut frames = vec![Vec::new(); 100];
    for item in opened(folder, rig, KeypointFormat::Body25b, 60.0).unwrap() {
        let item = item.unwrap();
        if let Some(point) = surest(&item).and_then(|p| p.points[index]) {
            let view = (item.camera, point.pixel.coords, point.confidence);
            frames[item.frame as usize].push(view);
        }
    }
    frames
}

/// Residuals (px) of the inliers of robust triangulation, and the points by marker and frame.
#[derive(Default)]
struct Fit {
    residuals: Vec<f64>,
    points: Vec<(&'static str, usize, Vector3<f64>)>,
}

fn triangulate_set(folder: &Path, rig: &Rig, threshold_px: f64) -> Fit {
    let mut fit = Fit::default();
    for (keypoint, marker) in LIMBS {
        for (frame, views) in views_by_frame(folder, rig, keypoint).iter().enumerate() {
            let Some(found) = triangulate_robust(rig, views, threshold_px, 1) else { continue };
            fit.points.push((marker, frame, found.point));
            for &i in &found.inliers {
                let (camera, pixel, _) = views[i];
                let projected = rig.cameras[camera].project(&found.point).unwrap();
                fit.residuals.push((projected - pixel).norm());
            }
        }
    }
    fit
}

/// Millimetres from the reference.
fn distances(fit: &Fit, reference: &[HashMap<String, Vector3<f64>>]) -> Vec<f64> {
    fit.points.iter().map(|(m, frame, p)| (p - reference[*frame][*m]).norm() * 1e3).collect()
}

#[test]
fn both_calibrations_of_the_real_set_agree_and_stand_upright() {
    let Some(set) = real_set() else { return };
    let (toml, qca) = (toml_rig(&set), qca_rig(&set));
    assert_eq!(toml.cameras.len(), 4);
    for (a, b) in toml.cameras.iter().zip(&qca.cameras) {
        assert_eq!((&a.name, a.width, a.height), (&b.name, b.width, b.height));
        assert_eq!((a.width, a.height), (1088, 1920));
        assert!((a.centre_in_world() - b.centre_in_world()).norm() < 1e-9);
        assert!(so3::angle_between(&a.rotation, &b.rotation) < 1e-7);
        assert!((a.matrix() - b.matrix()).amax() < 1e-9);
        // 1.6 to 2.1 m above the ground, looking down a little, with the image upright.
        assert!((1.6..2.2).contains(&a.centre_in_world().y), "{}", a.centre_in_world());
        assert!(a.rotation[(1, 1)] < -0.8, "{}", a.rotation);
    }
}

#[test]
fn triangulated_limbs_of_the_real_set_agree_with_the_reference() {
    let Some(set) = real_set() else { return };
    let fit = triangulate_set(&set.join("balancing/pose"), &toml_rig(&set), 60.0);
    let distances = distances(&fit, &butterworth(&set));
    let (residual, distance) = (median(fit.residuals), median(distances.clone()));
    println!(
        "triangulated {} points: residual {residual:.2} px, {distance:.1} mm",
        distances.len()
    );
    assert!(distances.len() > 1000);
    assert!(residual < 15.0, "{residual} px");
    assert!(distance < 25.0, "{distance} mm");
}

/// Why the Qualisys importer uses the distortion unchanged: the detections do not contradict it.
#[test]
fn the_real_set_cannot_tell_whether_qualisys_distortion_is_divided() {
    let Some(set) = real_set() else { return };
    for take in ["balancing", "static"] {
        let folder = set.join(take).join("pose");
        let [divided, whole] = [toml_rig(&set), qca_rig(&set)].map(|rig| {
            let fit = triangulate_set(&folder, &rig, 60.0);
            let mean = fit.residuals.iter().sum::<f64>() / fit.residuals.len() as f64;
            (median(fit.residuals), mean)
        });
        println!("{take} (median, mean px): divided by 64 {divided:.2?}, as it stands {whole:.2?}");
        assert!((divided.0 - whole.0).abs() < 0.3 && (divided.1 - whole.1).abs() < 0.1);
    }
}

#[test]
fn the_real_folder_streams_in_capture_order() {
    let Some(set) = real_set() else { return };
    let rig = toml_rig(&set);
    let format = KeypointFormat::Body25b;
    let mut stream = opened(&set.join("balancing/pose"), &rig, format, 60.0).unwrap();
    assert!(stream.matches().iter().all(|m| m.by == MatchedBy::Name));
    assert_eq!(stream.frame_count(), 400);
    let order: Vec<_> =
        stream.by_ref().map(|d| d.map(|d| (d.capture, d.camera, d.frame)).unwrap()).collect();
    assert_eq!(order.len(), 400);
    assert!(order.is_sorted());
    assert_eq!(order[399].2, 99);
    for report in stream.reports() {
        assert_eq!((report.frames, report.gaps, report.broken_files), (100, 0, 0));
        assert!(report.people >= 80, "{report:?}");
    }
    let statics = opened(&set.join("static/pose"), &rig, format, 60.0).unwrap();
    assert_eq!(statics.filter_map(Result::ok).count(), 48);
}

fn small_rig(names: &[&str]) -> Rig {
    let k = nalgebra::Matrix3::new(1000.0, 0.0, 320.0, 0.0, 1000.0, 240.0, 0.0, 0.0, 1.0);
    let camera = |(i, name): (usize, &&str)| {
        let t = Vector3::new(i as f64, 0.0, 3.0);
        Camera::new(*name, [640, 480], &k, Lens::IDEAL, nalgebra::Matrix3::identity(), t).unwrap()
    };
    Rig::new(1, names.iter().enumerate().map(camera).collect()).unwrap()
}

fn write(root: &Path, name: &str, text: &str) -> PathBuf {
    let path = root.join(name);
    fs::create_dir_all(path.parent().unwrap()).unwrap();
    fs::write(&path, text).unwrap();
    path
}

/// A person of COCO-17 with a given first point and the others far from the origin.
fn person(first: &str) -> String {
    format!("{{\"person_id\":[-1],\"pose_keypoints_2d\":[{first}{}]}}", ",10,20,0.5".repeat(16))
}

fn frame(people: &[String]) -> String {
    format!("{{\"version\":1.3,\"people\":[{}]}}", people.join(","))
}

fn open(root: &Path, rig: &Rig) -> Result<DetectionFolder, ImportError> {
    opened(root, rig, KeypointFormat::Coco17, 50.0)
}

/// Opens a folder, and refuses what can be tolerated.
fn opened(
    root: &Path,
    rig: &Rig,
    format: KeypointFormat,
    fps: f64,
) -> Result<DetectionFolder, ImportError> {
    let order = Some(format.into());
    let strict = DetectionOptions { fps, order, strict: true, ..DetectionOptions::default() };
    DetectionFolder::open(root, rig, strict)
}

fn open_error(root: &Path, rig: &Rig) -> ImportError {
    let error = open(root, rig).err().expect("an error");
    assert_one_line(&error);
    error
}

/// The only error of a stream, which must be its last item.
fn stream_error(root: &Path, rig: &Rig) -> ImportError {
    let mut stream = open(root, rig).unwrap();
    let error = stream.by_ref().find_map(Result::err).expect("an error");
    assert!(stream.next().is_none());
    assert_one_line(&error);
    error
}

fn assert_one_line(error: &ImportError) {
    let text = error.to_string();
    assert!(!text.contains('\n') && text.contains("; "), "{text}");
}

fn two_cameras() -> (TempDir, Rig) {
    let root = TempDir::new().unwrap();
    for camera in ["cam01_json", "cam02_json"] {
        write(root.path(), &format!("{camera}/{camera}.0000.json"), &frame(&[person("1,2,0.5")]));
    }
    (root, small_rig(&["cam_1", "cam_2"]))
}

#[test]
fn uneven_folders_merge_by_capture_time_and_faults_are_counted() {
    let root = TempDir::new().unwrap();
    let whole = frame(&[person("1,2,0.5")]);
    for (name, text) in [
        ("cam2/a_000000000003_keypoints.json", whole.as_str()),
        ("cam2/a_000000000007_keypoints.json", ""),
        ("cam1_json/x.5.json", "{\"people\":[]}"),
        ("cam1_json/x.7.json", &frame(&[r#"{"person_id":[-1]}"#.into(), person("1,2,1.5")])),
        ("cam1_json/x.10.json", &frame(&["0,0,0", "NaN,2,0.5", "1e39,2,0.5"].map(person))),
        ("cam1_json/notes.txt", "not a frame"),
        ("cam1_json/.hidden.json", "not a frame"),
    ] {
        write(root.path(), name, text);
    }
    let options = DetectionOptions { fps: 50.0, ..DetectionOptions::default() };
    let rig = small_rig(&["Cam_01", "Cam_02"]);
    let mut stream = DetectionFolder::open(root.path(), &rig, options).unwrap();
    assert!(stream.frame_counts_differ());
    let all: Vec<Detections> = stream.by_ref().map(Result::unwrap).collect();
    let order: Vec<_> = all.iter().map(|d| (d.frame, d.camera)).collect();
    assert_eq!(order, [(3, 1), (5, 0), (7, 0), (10, 0)]);
    assert_eq!(all[0].capture.ns(), 60_000_000);
    // What reads the recording uses it as 1, and says so if most are so high.
    let high = all[2].people[0].points[0].unwrap();
    assert_eq!((high.pixel.x, high.confidence), (1.0, 1.5));
    assert_eq!(all[2].people.len(), 1);
    assert!(all[3].people.iter().all(|p| p.points[0].is_none() && p.points[1].is_some()));
    let rates = |camera: &str| DetectionOptions {
        fps: 50.0,
        rates: vec![(camera.to_owned(), 10.0)],
        ..DetectionOptions::default()
    };
    let slow = DetectionFolder::open(root.path(), &rig, rates("Cam_02")).unwrap();
    let times: Vec<_> = slow.map(Result::unwrap).map(|d| (d.camera, d.capture.ns())).collect();
    assert_eq!(times.last(), Some(&(1, 300_000_000)), "{times:?}");
    assert!(times.is_sorted_by_key(|(_, capture)| *capture), "{times:?}");
    let unknown = DetectionFolder::open(root.path(), &rig, rates("phone")).err().unwrap();
    assert!(unknown.to_string().contains("there is no phone; there are Cam_01"), "{unknown}");
    let [first, second] = stream.reports() else { panic!("two cameras") };
    assert_eq!((first.frames, first.first_frame, first.last_frame, first.gaps), (3, 5, 10, 3));
    assert_eq!((first.people, first.people_without_points), (4, 1));
    assert_eq!((first.points, first.non_finite_points, first.confidences_above_1), (65, 2, 1));
    assert_eq!((first.frames_without_people, first.broken_files), (1, 0));
    assert_eq!((second.frames, second.gaps, second.broken_files), (2, 3, 1));
    assert_eq!(second.frames_without_people, 0);
}

#[test]
fn a_tracked_person_keeps_its_id() {
    let (root, rig) = two_cameras();
    let text = frame(&[person("1,2,0.5").replace("[-1]", "[7]")]);
    write(root.path(), "cam01_json/cam01_json.0000.json", &text);
    let ids: Vec<_> = open(root.path(), &rig).unwrap().map(|d| d.unwrap().people[0].id).collect();
    assert_eq!(ids, [Some(7), None]);
}

#[test]
fn folders_are_matched_by_name_then_by_order() {
    let root = TempDir::new().unwrap();
    for name in ["left10", "left9", "cam_02"] {
        write(root.path(), &format!("{name}/0.json"), &frame(&[]));
    }
    let rig = small_rig(&["cam1", "cam2", "cam3"]);
    let stream = open(root.path(), &rig).unwrap();
    let found: Vec<_> = stream
        .matches()
        .iter()
        .map(|m| (m.folder.file_name().unwrap().to_str().unwrap(), m.camera, m.by))
        .collect();
    let expected = [
        ("left9", 0, MatchedBy::Order),
        ("cam_02", 1, MatchedBy::Name),
        ("left10", 2, MatchedBy::Order),
    ];
    assert_eq!(found, expected);
}

#[test]
fn folders_are_matched_by_parts_of_names_and_by_numbers() {
    let found = |folders: &[&str], cameras: &[&str]| -> Vec<String> {
        let root = TempDir::new().unwrap();
        folders.iter().for_each(|name| {
            drop(write(root.path(), &format!("{name}/0.json"), &frame(&[person("10,20,0.5")])))
        });
        let options = DetectionOptions { fps: 50.0, ..DetectionOptions::default() };
        let stream = DetectionFolder::open(root.path(), &small_rig(cameras), options).unwrap();
        let names = stream.matches().iter().map(|m| {
            let folder = m.folder.file_name().unwrap().to_str().unwrap();
            format!("{folder} {} {:?}", cameras[m.camera], m.by)
        });
        names.collect()
    };
    let pose2sim = ["int_cam01_img", "int_cam02_img", "int_cam03_img"];
    let expected = ["cam02 int_cam02_img Name", "cam03 int_cam03_img Name"];
    assert_eq!(found(&["cam02", "cam03"], &pose2sim), expected);
    let cameras = ["cam_01", "cam_02", "cam_03"];
    let expected = ["Camera_2 cam_02 Name", "Camera_3 cam_03 Name"];
    assert_eq!(found(&["Camera_2", "Camera_3"], &cameras), expected);
    // One side counts from 0.
    let names = ["camera1", "camera2", "camera3"];
    let expected = ["cam0 camera1 Order", "cam1 camera2 Order", "cam2 camera3 Order"];
    assert_eq!(found(&["cam0", "cam1", "cam2"], &names), expected);
    // The whole name is stronger than a part.
    let expected = ["cam_01 cam_01 Name", "old_cam_01 cam_02 Order"];
    assert_eq!(found(&["cam_01", "old_cam_01"], &cameras), expected);
    // Both have the number of the take.
    assert_eq!(
        found(&["left_2", "right_2"], &cameras),
        ["left_2 cam_01 Order", "right_2 cam_02 Order"]
    );
}

#[test]
fn folders_that_do_not_match_the_rig_are_refused() {
    let (root, rig) = two_cameras();
    let path = root.path();
    let error = open_error(&path.join("nowhere"), &rig);
    assert!(matches!(error, ImportError::Read { .. }), "{error}");
    let error = open_error(&path.join("cam01_json"), &rig);
    assert!(matches!(error, ImportError::NoCameraFolders { .. }), "{error}");
    fs::create_dir(path.join("cam3")).unwrap();

    let error = open_error(path, &small_rig(&["cam1", "cam2", "cam3"]));
    assert!(
        matches!(&error, ImportError::CalibrationWithoutCamera { cameras, .. }
        if cameras == "cam3"),
        "{error}"
    );
    write(path, "cam3/3.json", "{}");
    let error = open_error(path, &rig);
    assert!(
        matches!(&error, ImportError::CameraWithoutCalibration { folders, .. }
        if folders == "cam3"),
        "{error}"
    );
    for fps in [0.0, -1.0, f64::NAN, f64::INFINITY] {
        let error = opened(path, &rig, KeypointFormat::Coco17, fps).err().unwrap();
        assert!(matches!(error, ImportError::FrameRate { .. }), "{error}");
    }
}

#[test]
fn missing_or_duplicate_frame_numbers_in_file_names_are_refused() {
    for (name, text) in [
        ("cam02_json/summary.json", "usable frame number"),
        ("cam02_json/99999999999999999999.json", "usable frame number"),
        ("cam02_json/9999999999999999999.json", "usable frame number"),
        ("cam02_json/other.0.json", "twice (cam02_json.0000.json and other.0.json)"),
    ] {
        let (root, rig) = two_cameras();
        write(root.path(), name, &frame(&[]));
        let error = open_error(root.path(), &rig);
        assert!(error.to_string().contains(text), "{error}");
    }
}

#[test]
fn files_of_other_programs_than_openpose_are_refused() {
    for (text, says) in [
        ("{\"annotations\":[]}", "no list of people"),
        ("{\"people\":3}", "no list of people"),
        ("[1,2]", "no list of people"),
        ("{\"people\":[{\"pose_keypoints_2d\":[\"a\"]}]}", "points are not numbers"),
        ("{\"people\":[{\"pose_keypoints_2d\":[1,2]}]}", "2 numbers, no multiple of 3"),
        ("{\"people\":[", "not valid JSON"),
        ("\u{1}\u{2}", "not valid JSON"),
        ("{\"people\":[{\"pose_keypoints_2d\":[NaN", "not valid JSON"),
    ] {
        let (root, rig) = two_cameras();
        let bad = write(root.path(), "cam02_json/cam02.0001.json", text);
        let error = stream_error(root.path(), &rig);
        assert!(error.to_string().contains(says), "{text}: {error}");
        assert!(error.to_string().starts_with(bad.to_str().unwrap()), "{error}");
    }
}

#[test]
fn a_wrong_length_names_the_matching_format() {
    for (numbers, says) in [
        (75, "has 25 points, coco_17 needs 17; body_25 or body_25b has as many"),
        (78, "halpe_26 has as many"),
        (57, "no known order has as many"),
    ] {
        let (root, rig) = two_cameras();
        let list = vec!["1"; numbers].join(",");
        let person = format!("{{\"pose_keypoints_2d\":[{list}]}}");
        write(root.path(), "cam02_json/cam02.0001.json", &frame(&[person]));
        let error = stream_error(root.path(), &rig);
        assert!(error.to_string().contains(says), "{error}");
    }
    assert_eq!(keypoint_format("halpe_26").unwrap(), KeypointFormat::Halpe26);
    let error = keypoint_format("body_26").unwrap_err();
    assert!(error.to_string().contains("known are body_25, body_25b, coco_17"), "{error}");
    let error = PointOrder::named("body_26").unwrap_err();
    assert!(error.to_string().contains("mediapipe_33"), "{error}");
}

const TOML: &str = r#"
[cam_10]
name = "cam_10"
size = [640.0, 480.0]
matrix = [[900.0, 0.0, 320.0], [0.0, 910.0, 240.0], [0.0, 0.0, 1.0]]
distortions = [0.1, 0.01, 0.002, 0.003, 0.004]
rotation = [1.5707963267948966, 0.0, 0.0]
translation = [0.1, 0.2, 3.0]
fisheye = false

[cam_2]
size = [640, 480]
matrix = [[900.0, 0.0, 320.0], [0.0, 910.0, 240.0], [0.0, 0.0, 1.0]]
distortions = [0.1, 0.01, 0.002, 0.003]
rotation = [1.5707963267948966, 0.0, 0.0]
translation = [0.0, 0.0, 3.0]
fisheye = true

[metadata]
error = 0.0
"#;

fn calibration(text: &str, up: Up) -> Result<Rig, ImportError> {
    let folder = TempDir::new().unwrap();
    let path = write(folder.path(), "calibration", text);
    read_calibration(&path, &up.into()).map(|read| read.rig)
}

#[test]
fn a_toml_calibration_is_read_in_natural_order_and_turned_upright() {
    let rig = calibration(TOML, Up::Z).unwrap();
    let names: Vec<_> = rig.cameras.iter().map(|c| c.name.as_str()).collect();
    assert_eq!(names, ["cam_2", "cam_10"]);
    assert_eq!(*rig.cameras[0].lens(), Lens::Fisheye([0.1, 0.01, 0.002, 0.003]));
    let brown = Lens::BrownConrady([0.1, 0.01, 0.002, 0.003, 0.004, 0.0, 0.0, 0.0]);
    assert_eq!(*rig.cameras[1].lens(), brown);
    assert_eq!(rig.cameras[1].focal, Vector2::new(900.0, 910.0));
    // A quarter turn about x takes the file's z to the camera's -y: up is up in the image.
    let same = calibration(TOML, Up::Y).unwrap();
    let (point, in_file) = (Vector3::new(0.3, 0.5, 0.2), Vector3::new(0.2, 0.3, 0.5));
    assert_eq!(Up::Z.calibration_from_world() * point, in_file);
    for (ours, theirs) in rig.cameras.iter().zip(&same.cameras) {
        let error = ours.project(&point).unwrap() - theirs.project(&in_file).unwrap();
        assert!(error.norm() < 1e-9);
        let (low, high) = (Vector3::zeros(), Vector3::y());
        assert!(ours.project(&high).unwrap().y < ours.project(&low).unwrap().y - 100.0);
    }
}

#[test]
fn odd_image_sizes_are_said() {
    let root = TempDir::new().unwrap();
    let notes = |size: &str, centre: [&str; 2]| {
        let text = TOML.replace("[640.0, 480.0]", size).replace("[640, 480]", size);
        let text = text.replace("320.0]", &format!("{}]", centre[0]));
        let text = text.replace("240.0]", &format!("{}]", centre[1]));
        let path = write(root.path(), "calibration.toml", &text);
        read_calibration(&path, &Convention::default()).unwrap().notes.join("\n")
    };
    for (size, centre) in
        [("[640.0, 480.0]", ["320.0", "240.0"]), ("[480.0, 640.0]", ["236.0", "330.0"])]
    {
        assert!(!notes(size, centre).contains("principal point"), "{}", notes(size, centre));
    }
    let exchanged = notes("[480.0, 640.0]", ["320.0", "240.0"]);
    assert!(exchanged.contains("are width and height exchanged?"), "{exchanged}");
    let half = notes("[320.0, 200.0]", ["322.0", "241.0"]);
    assert!(half.contains("(322, 241) is outside of the image of 320 x 200"), "{half}");
}

#[test]
fn bad_calibrations_give_a_one_line_error() {
    let one = TOML.split("[cam_2]").next().unwrap();
    let camera = "<calibration><camera serial=\"a\">";
    for (text, says) in [
        (String::new(), "no camera: nothing has a matrix"),
        ("[metadata]\nerror = 0.0".into(), "no camera: nothing has a matrix"),
        ("a = 1\n\u{1}".into(), "line 2 is not TOML"),
        ("{\"people\": []}".into(), "no camera: nothing has a matrix"),
        ("{\"people\": ".into(), "not JSON"),
        (TOML.replace("rotation = [1.5707963267948966, 0.0, 0.0]\n", ""), "rotation is missing"),
        (TOML.replace("640, 480", "640"), "camera cam_2: size must be width and height"),
        (TOML.replace("[640, 480]", "[640, 0]"), "camera cam_2: image size 640 x 0"),
        (TOML.replace("0.003, 0.004]", "0.003, 0.004, 0.5]"), "4, 5 or 8 coefficients, not 6"),
        (TOML.replace("910.0", "0.0"), "camera cam_2: the intrinsic matrix is singular"),
        (
            TOML.replace("[0.1, 0.2, 3.0]", "[nan, 0.2, 3.0]"),
            "camera cam_10: translation holds something that is no number",
        ),
        (
            TOML.replace("[cam_2]", "[cam_2]\nname = \"cam_10\""),
            "camera cam_10: distortions is there twice, in cam_10 and in cam_2",
        ),
        (one.into(), "at least two cameras, this one has 1"),
        ("<calibration".into(), "not XML"),
        ("<calibration/>".into(), "without an active <camera>"),
        (format!("{camera}</camera></calibration>"), "camera a: no <fov_video>"),
        (
            format!("{camera}<fov_video left=\"x\"/></camera></calibration>"),
            "camera a: <fov_video> left is not a number",
        ),
    ] {
        let error = calibration(&text, Up::Z).unwrap_err();
        assert_one_line(&error);
        assert!(error.to_string().contains(says), "{says}: {error}");
    }
    let missing = Path::new("/nowhere/calibration.toml");
    let missing = read_calibration(missing, &Up::Z.into()).unwrap_err();
    assert!(matches!(missing, ImportError::Read { .. }), "{missing}");
}

/// A Qualisys calibration of two cameras; `r33` belongs to the second one's rotation.
pub fn qualisys(r33: f64) -> String {
    let camera = |serial: &str, r33: f64| {
        format!(
            "<camera active=\"1\" serial=\"{serial}\" viewrotation=\"0\">\
             <fov_video left=\"10\" top=\"20\" right=\"649\" bottom=\"499\"/>\
             <transform r11=\"1\" r12=\"0\" r13=\"0\" r21=\"0\" r22=\"1\" r23=\"0\" r31=\"0\" \
             r32=\"0\" r33=\"{r33}\" x=\"1000\" y=\"2000\" z=\"3000\"/>\
             <intrinsic focalLengthU=\"64000\" focalLengthV=\"64000\" centerPointU=\"20480\" \
             centerPointV=\"15360\" skew=\"0\" radialDistortion1=\"0.1\" radialDistortion2=\"0.2\" \
             radialDistortion3=\"0.3\" tangentalDistortion1=\"0.4\" tangentalDistortion2=\"0.5\"/>\
             </camera>"
        )
    };
    format!("<c><cameras>{}{}</cameras></c>", camera("a", 1.0), camera("b", r33))
}

#[test]
fn an_invalid_qualisys_rotation_is_refused() {
    let rig = calibration(&qualisys(1.0), Up::Y).unwrap();
    let a = &rig.cameras[0];
    assert_eq!((a.width, a.height), (640, 480));
    assert_eq!((a.focal, a.centre), (Vector2::new(1000.0, 1000.0), Vector2::new(310.0, 220.0)));
    assert!((a.centre_in_world() - Vector3::new(1.0, 2.0, 3.0)).norm() < 1e-12);
    // The camera looks along its own -z.
    assert!((a.ray(&a.centre).unwrap() + Vector3::z()).norm() < 1e-12);
    assert_eq!(*a.lens(), Lens::BrownConrady([0.1, 0.2, 0.4, 0.5, 0.3, 0.0, 0.0, 0.0]));
    for r33 in [0.5, -1.0] {
        let error = calibration(&qualisys(r33), Up::Y).unwrap_err();
        assert!(error.to_string().contains("camera b: the rotation is no rotation"), "{error}");
    }
}

#[test]
fn real_trc_files_are_read() {
    let Some(set) = real_set() else { return };
    let folder = set.join("balancing/pose-3d");
    let read = |end: &str| {
        let name = format!("S00_P00_T01_BalancingTrial_0-100{end}.trc");
        read_trajectories(&folder.join(name), None).unwrap()
    };
    let (raw, augmented) = (read(""), read("_filt_butterworth_LSTM"));
    assert_eq!((raw.rows.len(), raw.first_frame, raw.names.len()), (100, 0.0, 21));
    assert_eq!((augmented.rows.len(), augmented.names.len()), (100, 64));
    for keypoint in [Keypoint::LShoulder, Keypoint::RWrist, Keypoint::LHip, Keypoint::RAnkle] {
        assert!(raw.column_of(keypoint).is_some());
        assert_eq!(raw.column_of(keypoint), augmented.column_of(keypoint));
    }
}

/// What a detector saw: by camera and frame, the people with the points of COCO-17, and 0, 0, 0 for unseen ones.
type Seen = Vec<Vec<Vec<[[f64; 3]; 17]>>>;

/// Two cameras, three frames, one and two people; the second camera's first frame is empty.
fn seen() -> Seen {
    let person = |shift: f64| {
        let mut points = [[0.0; 3]; 17];
        for (i, point) in points.iter_mut().enumerate().skip(1) {
            *point =
                [100.25 + shift + 3.0 * i as f64, 50.5 + 11.0 * i as f64, 0.5 + 0.01 * i as f64];
        }
        points
    };
    let camera = |c: f64| {
        (0..3)
            .map(move |f| (0..1 + f % 2).map(|p| person(c + 9.0 * f64::from(f + 5 * p))).collect())
    };
    let mut all: Seen = vec![camera(0.0).collect(), camera(40.0).collect()];
    all[1][0].clear();
    all
}

/// The people of a form of detections, by time and camera, with the ids.
fn read_back(root: &Path, order: Option<&str>) -> Vec<(i64, usize, Vec<Person>)> {
    let order = order.map(|name| PointOrder::named(name).unwrap());
    let options = DetectionOptions { fps: 50.0, order, ..DetectionOptions::default() };
    let rig = small_rig(&["cam1", "cam2"]);
    let folder = DetectionFolder::open(root, &rig, options).unwrap();
    folder.map(|frame| frame.map(|f| (f.capture.ns(), f.camera, f.people)).unwrap()).collect()
}

#[test]
fn all_forms_of_the_same_detections_are_read_alike() {
    let flat = |points: &[[f64; 3]; 17]| json!(points.as_flattened());
    let pairs = |points: &[[f64; 3]; 17]| json!(points.map(|[x, y, _]| [x, y]));
    let column = |points: &[[f64; 3]; 17], i: usize| json!(points.map(|point| point[i]));
    let mmpose = |points: &[[f64; 3]; 17]| json!({ "keypoints": pairs(points), "keypoint_scores": column(points, 2) });
    let all = seen();
    let each = |one: &dyn Fn(&[[f64; 3]; 17]) -> Value, frame: &[[[f64; 3]; 17]]| -> Value {
        frame.iter().map(one).collect()
    };

    // A file for each frame.
    type Form<'a> = Box<dyn Fn(&[[[f64; 3]; 17]]) -> Value + 'a>;
    let by_frame: Vec<(&str, Form)> = vec![
        (
            "openpose",
            Box::new(
                |frame| json!({ "people": each(&|p| json!({ "person_id": [-1], "pose_keypoints_2d": flat(p) }), frame) }),
            ),
        ),
        ("mmpose list", Box::new(|frame| each(&mmpose, frame))),
        ("mmpose instances", Box::new(|frame| json!({ "instances": each(&mmpose, frame) }))),
        (
            "ultralytics",
            Box::new(|frame| {
                each(
                    &|p| {
                        json!({ "name": "person", "class": 0, "confidence": 0.9, "box": {},
                    "keypoints": { "x": column(p, 0), "y": column(p, 1), "visible": column(p, 2) } })
                    },
                    frame,
                )
            }),
        ),
        ("triples", Box::new(|frame| each(&|p| json!({ "keypoints": p }), frame))),
        (
            "easymocap",
            Box::new(
                |frame| json!({ "filename": "", "annots": each(&|p| json!({ "bbox": [], "keypoints": p }), frame) }),
            ),
        ),
    ];
    let mut forms = Vec::new();
    for (name, form) in by_frame {
        let root = TempDir::new().unwrap();
        for (c, camera) in all.iter().enumerate() {
            for (f, frame) in camera.iter().enumerate() {
                let file = format!("cam{}/{f:06}_keypoints.json", c + 1);
                write(root.path(), &file, &form(frame).to_string());
            }
        }
        forms.push((name, root));
    }

    // A file for each camera.
    type Text<'a> = Box<dyn Fn(&[Vec<[[f64; 3]; 17]>]) -> String + 'a>;
    let of_camera: Vec<(&str, &str, Text)> = vec![
        (
            "mmpose video",
            "results_cam{}.json",
            Box::new(|camera| {
                let frame = |(f, frame): (usize, &Vec<_>)| json!({ "frame_id": f + 1, "instances": each(&mmpose, frame) });
                let frames: Value = camera.iter().enumerate().map(frame).collect();
                json!({ "meta_info": {}, "instance_info": frames }).to_string()
            }),
        ),
        (
            "alphapose",
            "alphapose-cam{}.json",
            Box::new(|camera| {
                let people = camera.iter().enumerate().flat_map(|(f, frame)| {
                    frame.iter().map(move |p| {
                        json!({ "image_id": format!("{f}.jpg"), "category_id": 1,
                    "keypoints": flat(p), "score": 2.5 })
                    })
                });
                people.collect::<Value>().to_string()
            }),
        ),
        (
            "alphapose cmu",
            "cam{}.json",
            Box::new(|camera| {
                let frame = |(f, frame): (usize, &Vec<_>)| {
                    (
                        format!("{f}.jpg"),
                        json!({ "version": "AlphaPose", "bodies": each(&|p| json!({ "joints": flat(p) }), frame) }),
                    )
                };
                camera.iter().enumerate().map(frame).collect::<Value>().to_string()
            }),
        ),
        (
            "list of frames",
            "cam{}.json",
            Box::new(|camera| {
                camera.iter().map(|frame| each(&mmpose, frame)).collect::<Value>().to_string()
            }),
        ),
        (
            "numbered frames",
            "cam{}.json",
            Box::new(|camera| {
                let frame = |(f, frame): (usize, &Vec<_>)| json!({ "people": each(&mmpose, frame), "frame_id": format!("{f}.jpg"), "frame_idx": f, "//": 7 });
                let frames = camera.iter().enumerate().rev().map(frame).collect::<Value>();
                format!("\u{feff}{frames}")
            }),
        ),
    ];
    for (name, file, form) in of_camera {
        let root = TempDir::new().unwrap();
        for (c, camera) in all.iter().enumerate() {
            write(root.path(), &file.replace("{}", &(c + 1).to_string()), &form(camera));
        }
        forms.push((name, root));
    }
    // One file of all, and a trial's folder around it.
    let names = KeypointFormat::Coco17.keypoints().iter().map(|point| format!("{point:?}"));
    let header: String = names.map(|name| format!(",{name}_x,{name}_y,{name}_c")).collect();
    // As pandas writes it, with the index of the rows first.
    let mut text = format!(",frame,camera{header}\n");
    for (c, camera) in all.iter().enumerate() {
        for (f, frame) in camera.iter().enumerate() {
            for points in frame {
                let cells = points.as_flattened().iter().map(|value| format!(",{value}"));
                text += &format!("{},{f},cam{}{}\n", 7 * f + c, c + 1, cells.collect::<String>());
            }
        }
    }
    let root = TempDir::new().unwrap();
    write(root.path(), "pose/all.csv", &text);

    let expected = read_back(forms[0].1.path(), Some("coco_17"));
    assert_eq!(expected.len(), 6);
    assert_eq!(expected[4].0, 40_000_000);
    assert_eq!(expected[3].2.len(), 2);
    assert_eq!(expected[3].2[1].points[5].unwrap().pixel.y, 105.5);
    assert!(expected[1].2.is_empty() && expected[0].2[0].points[0].is_none());
    for (name, root) in &forms[1..] {
        // A list by image or person has no frames without people.
        let is_sparse = *name == "alphapose";
        let expected = expected.iter().filter(|(_, _, people)| !is_sparse || !people.is_empty());
        assert_eq!(read_back(root.path(), None), expected.cloned().collect::<Vec<_>>(), "{name}");
    }
    let in_csv = read_back(&root.path().join("pose/all.csv"), None);
    let expected = expected.iter().filter(|(_, _, people)| !people.is_empty());
    assert_eq!(in_csv, expected.cloned().collect::<Vec<_>>());
}

#[test]
fn rows_of_a_table_are_frames_by_their_number() {
    let root = TempDir::new().unwrap();
    // As SLEAP writes it: two tracks, and nobody in frame 101.
    let rows = "a,100,0.9,1,2,0.5\nb,100,0.9,3,4,0.5\na,102,0.9,1,2,0.5\n";
    let text =
        |field: &str| format!("track,{field},instance.score,nose.x,nose.y,nose.score\n{rows}");
    let rig = small_rig(&["cam1", "cam2"]);
    let open = || {
        let options = DetectionOptions { fps: 50.0, ..DetectionOptions::default() };
        DetectionFolder::open(root.path(), &rig, options)
    };
    for field in ["frame_idx", "Frame#", "frameIndex", "frame number"] {
        write(root.path(), "cam1.csv", &text(field));
        write(root.path(), "cam2.csv", &text(field).replace("100", "99"));
        let mut folder = open().unwrap();
        let read = folder.by_ref().map(Result::unwrap);
        let read: Vec<_> = read.map(|d| (d.frame, d.camera, d.people.len())).collect();
        assert_eq!(read, [(99, 1, 2), (100, 0, 2), (102, 0, 1), (102, 1, 1)], "{field}");
        let said = folder.notes().join("\n");
        assert!(said.contains("the first frame is 99; outputs count from"), "{said}");
    }
    for other in ["time", "index", ""] {
        write(root.path(), "cam2.csv", &text(other));
        let error = open().err().unwrap().to_string();
        assert!(error.contains("cam2.csv") && error.contains("no column frame"), "{error}");
    }
    // Rows are not frames: some may be missing.
    write(root.path(), "cam1.csv", "timestamp,nose_x,nose_y\n0.5,1,2\n0.52,1,2\n");
    let error = open().err().unwrap().to_string();
    assert!(error.contains("a column timestamp but no column frame"), "{error}");
    write(root.path(), "cam1.csv", "frame;nose_x;nose_y\n0;1,5;2,5\n");
    let error = open().err().unwrap().to_string();
    assert!(error.contains("';' is between its columns"), "{error}");
    // Decimal commas; a line of commas alone is none.
    write(root.path(), "cam1.csv", "frame,nose_x,nose_y\n0,1,2\n,,\n1,1,5,2,5\n");
    let error = open().err().unwrap().to_string();
    let evidence = "line 4: 5 cells, the first line has 3: are there decimal commas?";
    assert!(error.contains(evidence), "{error}");
    for camera in ["cam1.csv", "cam2.csv"] {
        write(root.path(), camera, "image,nose_x,nose_y\nimg_00080.png,1,2\nimg_00082.png,1,2\n");
    }
    let read = open().unwrap().map(Result::unwrap);
    assert_eq!(read.map(|d| d.frame).collect::<Vec<_>>(), [80, 80, 82, 82]);
    // A number behind that of the frame, and the name of the video.
    for (image, frames) in [("000080_cam1.png", [80, 80, 82, 82]), ("cam1.mp4", [0, 0, 1, 1])] {
        let rows = [80, 82].map(|k| image.replace("80", &k.to_string()) + ",1,2\n").concat();
        for camera in ["cam1.csv", "cam2.csv"] {
            write(root.path(), camera, &format!("image,nose_x,nose_y\n{rows}"));
        }
        let read = open().unwrap().map(Result::unwrap);
        assert_eq!(read.map(|d| d.frame).collect::<Vec<_>>(), frames, "{image}");
    }
}

#[test]
fn a_number_behind_the_frame_number_is_no_frame_number() {
    let root = TempDir::new().unwrap();
    let rig = small_rig(&["cam1", "cam2"]);
    let points = vec!["10"; 51].join(",");
    for camera in [1, 2] {
        let people = [12, 13, 15].map(|k| {
            format!(
                "{{\"image_id\":\"{k:06}_cam{camera}.jpg\",\"keypoints\":[{points}],\"score\":1}}"
            )
        });
        write(
            root.path(),
            &format!("cam{camera}/alphapose.json"),
            &format!("[{}]", people.join(",")),
        );
    }
    let frames = |root: &Path| -> Vec<u64> {
        let options = DetectionOptions { fps: 50.0, ..DetectionOptions::default() };
        let folder = DetectionFolder::open(root, &rig, options).unwrap();
        folder.map(|frame| frame.unwrap().frame).collect()
    };
    assert_eq!(frames(root.path()), [12, 12, 13, 13, 15, 15]);
    let root = TempDir::new().unwrap();
    for camera in [1, 2] {
        for k in [3, 4] {
            write(
                root.path(),
                &format!("cam{camera}/{k}_take_07.json"),
                &frame(&[person("10,20,0.5")]),
            );
        }
    }
    assert_eq!(frames(root.path()), [3, 3, 4, 4]);
    // Files in a folder of their own, and a folder beside the files.
    let root = TempDir::new().unwrap();
    for place in ["cam1/json", "cam2"] {
        write(root.path(), &format!("{place}/5.json"), &frame(&[person("10,20,0.5")]));
    }
    fs::create_dir(root.path().join("cam2/json")).unwrap();
    assert_eq!(frames(root.path()), [5, 5]);
}

#[test]
fn files_that_are_not_understood_are_not_called_empty() {
    let (root, rig) = two_cameras();
    for camera in ["cam01_json", "cam02_json"] {
        write(root.path(), &format!("{camera}/{camera}.0000.json"), r#"{"poses": []}"#);
    }
    let guessing = DetectionOptions { fps: 50.0, ..DetectionOptions::default() };
    let error = DetectionFolder::open(root.path(), &rig, guessing).err().unwrap().to_string();
    assert!(error.contains("0000.json") && error.contains("no list of people"), "{error}");
    // One camera sees nobody in the whole take, and writes an empty list.
    for (camera, text) in [("cam1", "[]"), ("cam2", r#"[{"image_id":"3.jpg","keypoints":[]}]"#)] {
        write(root.path(), &format!("{camera}/alphapose-results.json"), text);
        drop(fs::remove_dir_all(root.path().join(format!(
            "{}0{}_json",
            &camera[..3],
            &camera[3..]
        ))));
    }
    let order = Some(PointOrder::named("coco_17").unwrap());
    let options = DetectionOptions { fps: 50.0, order, ..DetectionOptions::default() };
    let folder = DetectionFolder::open(root.path(), &rig, options).unwrap();
    let frames: Vec<_> = folder.map(|d| (d.as_ref().unwrap().camera, d.unwrap().frame)).collect();
    assert_eq!(frames, [(1, 3)]);
}

#[test]
fn points_in_shares_of_the_image_and_with_ids_are_read() {
    let root = TempDir::new().unwrap();
    // YOLO's labels: class, box, points, confidence of the box, id. A camera of 640 x 480.
    let points = " 0.5 0.25 0.9".repeat(17);
    for (file, text) in [
        ("cam1/clip_12.txt", format!("0 0.5 0.5 0.1 0.2{points}\n")),
        ("cam1/clip_13.txt", format!("0 0.5 0.5 0.1 0.2{points} 0.8 7\n")),
        // Ids without confidences; then confidences.
        ("cam1/clip_14.txt", format!("0 0.5 0.5 0.1 0.2{points} 7\n0 0.5 0.5 0.1 0.2{points} 3\n")),
        ("cam1/clip_15.txt", format!("0 0.5 0.5 0.1 0.2{points} 1\n0 0.5 0.5 0.1 0.2{points} 1\n")),
        ("cam1/classes.txt", "person".into()),
        ("cam2/clip_12.txt", String::new()),
    ] {
        write(root.path(), file, &text);
    }
    let read = read_back(root.path(), None);
    assert_eq!(read.len(), 5);
    let point = read[0].2[0].points[3].unwrap();
    assert_eq!((point.pixel.x, point.pixel.y, point.confidence), (320.0, 120.0, 0.9));
    let ids = read.iter().map(|(_, _, people)| people.iter().map(|one| one.id).collect::<Vec<_>>());
    let ids: Vec<_> = ids.filter(|ids| !ids.is_empty()).collect();
    assert_eq!(ids, [vec![None], vec![Some(7)], vec![Some(7), Some(3)], vec![None, None]]);

    let root = TempDir::new().unwrap();
    let all = |value: f64| vec![value; 17];
    for (frame, scale) in [(1, 1.0), (2, 100.0)] {
        let points = json!({ "x": all(0.5 * scale), "y": all(0.25 * scale), "visible": all(0.9) });
        let people = json!([{ "name": "person", "class": 0, "keypoints": points }]);
        write(root.path(), &format!("cam1/{frame}.json"), &people.to_string());
        write(root.path(), &format!("cam2/{frame}.json"), &people.to_string());
    }
    let pixel = |(_, _, people): &(_, _, Vec<Person>)| people[0].points[3].unwrap().pixel;
    let pixels: Vec<_> = read_back(root.path(), None).iter().map(pixel).collect();
    assert_eq!([pixels[0], pixels[2]].map(|p| [p.x, p.y]), [[320.0, 120.0], [50.0, 25.0]]);

    let root = TempDir::new().unwrap();
    let landmark =
        |i: usize| json!({ "x": 0.01 * i as f64, "y": 0.5, "z": 0.0, "visibility": 0.75 });
    let landmarks: Value = (0..33).map(landmark).collect();
    write(root.path(), "cam1/cam1.json", &json!([landmarks, null]).to_string());
    write(
        root.path(),
        "cam2.json",
        &json!([{ "landmarks": landmarks }, { "landmarks": [] }]).to_string(),
    );
    let read = read_back(root.path(), None);
    let [(_, 0, first), (_, 1, second), (_, 0, none), (_, 1, _)] = &read[..] else {
        panic!("{read:?}")
    };
    assert_eq!(first, second);
    assert!(none.is_empty());
    let heel = |people: &[Person]| {
        let format = PointOrder::named("mediapipe_33").unwrap().format;
        people[0].points[format.index_of(Keypoint::RHeel).unwrap()].unwrap()
    };
    assert!((heel(first).pixel.x - 0.3 * 640.0).abs() < 1e-9);
    assert_eq!((heel(first).pixel.y, heel(first).confidence), (240.0, 0.75));
}

#[test]
fn frames_of_all_videos_in_one_folder_are_told_apart() {
    let root = TempDir::new().unwrap();
    let points = " 0.5 0.25 0.9".repeat(17);
    for (camera, frame) in ["cam1", "cam2"].into_iter().flat_map(|c| [9, 10].map(|f| (c, f))) {
        let text = format!("0 0.5 0.5 0.1 0.2{points}\n");
        write(root.path(), &format!("predict/labels/{camera}_{frame}.txt"), &text);
    }
    for folder in ["", "predict", "predict/labels"] {
        let read = read_back(&root.path().join(folder), None);
        let read: Vec<(i64, usize)> =
            read.iter().map(|(ns, camera, _)| (ns / 20_000_000, *camera)).collect();
        assert_eq!(read, [(9, 0), (9, 1), (10, 0), (10, 1)], "{folder}");
    }
}

#[test]
fn what_is_synchronised_is_used_and_what_is_of_no_camera_is_said() {
    let root = TempDir::new().unwrap();
    for (folder, number) in [("pose", 3), ("pose-sync", 7)] {
        for camera in ["cam1", "cam2", "cam9"] {
            let name = format!("{folder}/{camera}_json/{camera}.000{number}.json");
            write(root.path(), &name, &frame(&[person("1,2,0.5")]));
        }
    }
    let rig = small_rig(&["cam1", "cam2"]);
    let options = DetectionOptions { fps: 50.0, ..DetectionOptions::default() };
    let mut folder = DetectionFolder::open(root.path(), &rig, options.clone()).unwrap();
    assert!(folder.by_ref().map(Result::unwrap).all(|frame| frame.frame == 7));
    let said = folder.notes().join("\n");
    for note in ["pose-sync is used, not pose", "there is no calibration for cam9_json: not used"] {
        assert!(said.contains(note), "{said}");
    }
    let error = open_error(root.path(), &rig);
    assert!(matches!(error, ImportError::CameraWithoutCalibration { .. }), "{error}");
    // A file that is there and holds something else.
    let root = TempDir::new().unwrap();
    write(root.path(), "cam1.csv", "frame,nose_x,nose_y\n0,1,2\n");
    write(root.path(), "cam2.csv", "frame,nose_x,nose_y\n0,1,2\n");
    write(root.path(), "cam3.json", r#"{"images": [], "annotations": []}"#);
    let rig = small_rig(&["cam1", "cam2", "cam3"]);
    let folder = DetectionFolder::open(root.path(), &rig, options).unwrap();
    let said = folder.notes().join("\n");
    assert!(
        said.contains("of camera cam3; the others are used; not understood: cam3.json"),
        "{said}"
    );
}

#[test]
fn tables_of_deeplabcut_are_read_by_the_names_of_their_points() {
    let root = TempDir::new().unwrap();
    let of_one = "scorer,net,net,net,net,net,net,net,net,net\n\
        bodyparts,shoulder_L,shoulder_L,shoulder_L,RightKnee,RightKnee,RightKnee,tail,tail,tail\n\
        coords,x,y,likelihood,x,y,likelihood,x,y,likelihood\n\
        0,10.5,20.5,0.9,30,40,0.8,1,2,0.3\n1,11.5,21.5,0.9,,,,1,2,0.3\n";
    let of_two = "scorer,net,net,net,net,net,net\n\
        individuals,a,a,a,b,b,b\nbodyparts,lshoulder,lshoulder,lshoulder,lshoulder,lshoulder,lshoulder\n\
        coords,x,y,likelihood,x,y,likelihood\n0,1,2,0.5,3,4,0.5\n";
    write(root.path(), "cam1DLC_resnet50_take.csv", of_one);
    write(root.path(), "cam-2_take.csv", &of_one.replace("0.9", "0.7"));
    let rig = small_rig(&["cam1", "cam2"]);
    let options = |cameras: &[(&str, &str)]| DetectionOptions {
        fps: 50.0,
        cameras: cameras.iter().map(|(a, b)| ((*a).into(), (*b).into())).collect(),
        ..DetectionOptions::default()
    };
    let given = [("cam1DLC_resnet50_take.csv", "cam1"), ("cam-2_take.csv", "cam2")];
    let mut folder = DetectionFolder::open(root.path(), &rig, options(&given)).unwrap();
    let read: Vec<Detections> = folder.by_ref().map(Result::unwrap).collect();
    assert_eq!(read.len(), 4);
    let at = |frame: &Detections, point: Keypoint| {
        frame.people[0].points[frame.format.index_of(point).unwrap()]
    };
    let shoulder = at(&read[0], Keypoint::LShoulder).unwrap();
    assert_eq!((shoulder.pixel.x, shoulder.pixel.y, shoulder.confidence), (10.5, 20.5, 0.9));
    assert!(at(&read[0], Keypoint::RKnee).is_some() && at(&read[2], Keypoint::RKnee).is_none());
    assert!(folder.notes()[0].contains("points left out: tail"), "{:?}", folder.notes());

    // The same tables as pandas writes them to h5.
    let golden = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/golden");
    let again = TempDir::new().unwrap();
    for name in ["cam1DLC_resnet50_take.h5", "cam-2_take.h5"] {
        fs::copy(golden.join("deeplabcut.h5"), again.path().join(name)).unwrap();
    }
    let given_h5 = [("cam1DLC_resnet50_take.h5", "cam1"), ("cam-2_take.h5", "cam2")];
    let of_h5 = DetectionFolder::open(again.path(), &rig, options(&given_h5)).unwrap();
    let of_h5: Vec<Detections> = of_h5.map(Result::unwrap).collect();
    assert_eq!(of_h5.len(), 4);
    let of_camera = |all: &[Detections]| {
        all.iter().filter(|frame| frame.camera == 0).cloned().collect::<Vec<_>>()
    };
    assert_eq!(of_camera(&of_h5), of_camera(&read));
    // Beside its CSV a table is not read twice.
    let cam1 = "cam1DLC_resnet50_take";
    let csv = format!("{cam1}.csv");
    fs::copy(root.path().join(&csv), again.path().join(&csv)).unwrap();
    let folder = DetectionFolder::open(again.path(), &rig, options(&[])).unwrap();
    let both: Vec<Detections> = folder.map(Result::unwrap).collect();
    assert_eq!((both.len(), of_camera(&both)), (4, of_camera(&read)));
    // Two individuals are two people.
    let two = TempDir::new().unwrap();
    for name in ["cam1.h5", "cam2.h5"] {
        fs::copy(golden.join("deeplabcut_two.h5"), two.path().join(name)).unwrap();
    }
    let folder = DetectionFolder::open(two.path(), &rig, options(&[])).unwrap();
    let people: Vec<usize> = folder.map(|frame| frame.unwrap().people.len()).collect();
    assert_eq!(people, [2, 2]);
    // Broken ones are refused with the reason.
    let bytes = fs::read(golden.join("deeplabcut.h5")).unwrap();
    for cut in [0, 7, 100, 5_000, 60_000] {
        fs::write(again.path().join("cam-2_take.h5"), &bytes[..cut]).unwrap();
        let said = match DetectionFolder::open(again.path(), &rig, options(&[])) {
            Ok(folder) => format!("{:?}", folder.filter_map(Result::err).collect::<Vec<_>>()),
            Err(error) => error.to_string(),
        };
        assert!(said.contains("cam-2_take.h5"), "{cut}: {said}");
    }

    // A mapping file by the detector's names.
    let mapping =
        write(root.path(), "points.toml", "[points]\nnose = \"tail\"\nleft_knee = \"RightKnee\"\n");
    let mapped = DetectionOptions { mapping: Some(mapping.clone()), ..options(&given) };
    let folder = DetectionFolder::open(root.path(), &rig, mapped).unwrap();
    let first = folder.map(Result::unwrap).next().unwrap();
    assert_eq!(at(&first, Keypoint::Nose).unwrap().confidence, 0.3);
    assert_eq!(at(&first, Keypoint::LKnee).unwrap().pixel.x, 30.0);
    for (text, says) in [
        ("[points]\ntail = 0\n", "tail is no point of ours"),
        (
            "[points]\nnose = \"beak\"\n",
            "beak is not in the file, which has shoulder_L, RightKnee, tail",
        ),
        ("[points]\nnose = 9\n[other]\n", "unknown field"),
        ("count = 3\n[points]\nnose = 9\n", "there is no index 9"),
    ] {
        fs::write(&mapping, text).unwrap();
        let mapped = DetectionOptions { mapping: Some(mapping.clone()), ..options(&given) };
        let error = DetectionFolder::open(root.path(), &rig, mapped).err().unwrap();
        assert!(error.to_string().contains(says), "{error}");
    }

    let root = TempDir::new().unwrap();
    for camera in ["cam1.csv", "cam2.csv"] {
        write(root.path(), camera, of_two);
    }
    let read = read_back(root.path(), None);
    assert_eq!(read[0].2.len(), 2);
    for (text, says) in [
        ("a,b\n1,2\n", "no columns of points"),
        ("frame,nose_x,nose_y\n1,2\n", "line 2: it is shorter"),
        ("frame,nose_x,nose_y\n1,2,what\n", "line 2: what is not a number"),
    ] {
        write(root.path(), "cam2.csv", text);
        let error = DetectionFolder::open(root.path(), &rig, options(&[])).err().unwrap();
        assert!(error.to_string().contains(says), "{error}");
    }
}

#[test]
fn arrays_of_freemocap_are_read_for_all_cameras() {
    let root = TempDir::new().unwrap();
    // 2 cameras x 1 frame x 33 points x 2, as numpy writes it.
    let header = "{'descr': '<f8', 'fortran_order': False, 'shape': (2, 1, 33, 2), }";
    let header = format!("{header:<117}\n");
    let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
    bytes.extend((header.len() as u16).to_le_bytes());
    bytes.extend(header.as_bytes());
    for value in 0..132 {
        let value = if value == 0 { f64::NAN } else { f64::from(value) };
        bytes.extend(value.to_le_bytes());
    }
    let name =
        "output_data/raw_data/mediapipe_2dData_numCams_numFrames_numTrackedPoints_pixelXY.npy";
    fs::create_dir_all(root.path().join("output_data/raw_data")).unwrap();
    fs::write(root.path().join(name), &bytes).unwrap();
    // What FreeMoCap writes beside it.
    for other in ["mediapipe_body_3d_xyz.csv", "mediapipe_body_3d_xyz.npy", "raw_data/charuco.npy"]
    {
        write(root.path(), &format!("output_data/{other}"), "0");
    }
    fs::create_dir_all(root.path().join("synchronized_videos")).unwrap();
    let read = read_back(root.path(), None);
    assert_eq!(read.len(), 2);
    assert_eq!(read_back(&root.path().join("output_data"), None), read);
    assert!(read[0].2[0].points[0].is_none());
    let knee = KeypointFormat::Body25.index_of(Keypoint::LKnee).unwrap();
    let knee = read[1].2[0].points[knee].unwrap();
    assert_eq!((knee.pixel.x, knee.pixel.y, knee.confidence), (116.0, 117.0, 1.0));
    // With a third number: scores, also those above 1, but no depths.
    for (least, expected) in [(0.25, [0.25, 1.0]), (-0.25, [1.0, 1.0])] {
        let header = header.replace("33, 2", "17, 3");
        let mut bytes = [&b"\x93NUMPY\x01\x00"[..], &(header.len() as u16).to_le_bytes()].concat();
        bytes.extend(header.as_bytes());
        for at in 0..102 {
            let value = if at % 3 < 2 {
                9.0
            } else if at % 2 == 0 {
                least
            } else {
                1.5
            };
            bytes.extend(f64::to_le_bytes(value));
        }
        fs::write(root.path().join(name), &bytes).unwrap();
        let read = read_back(root.path(), None);
        let points = [0, 1].map(|point| read[0].2[0].points[point].unwrap().confidence.min(1.0));
        assert_eq!(points, expected);
    }
    let at = bytes.windows(13).position(|part| part == b"(2, 1, 33, 2)").unwrap();
    let mut wrong = bytes.clone();
    wrong[at..at + 13].copy_from_slice(b"(99999, 9, 2)");
    fs::write(root.path().join(name), &wrong).unwrap();
    let rig = small_rig(&["cam1", "cam2"]);
    let options = DetectionOptions { fps: 50.0, ..DetectionOptions::default() };
    let error = DetectionFolder::open(root.path(), &rig, options).err().unwrap();
    assert!(error.to_string().contains("the file cannot hold"), "{error}");
    bytes.truncate(bytes.len() - 5);
    fs::write(root.path().join(name), &bytes).unwrap();
    let rig = small_rig(&["cam1", "cam2"]);
    let options = DetectionOptions { fps: 50.0, ..DetectionOptions::default() };
    let error = DetectionFolder::open(root.path(), &rig, options).err().unwrap();
    assert!(error.to_string().contains("the array is cut"), "{error}");
}

#[test]
fn given_cameras_come_first_and_arrays_have_no_names() {
    let root = TempDir::new().unwrap();
    for folder in ["cam1", "left"] {
        write(root.path(), &format!("{folder}/0.json"), &frame(&[person("1,2,0.5")]));
    }
    let rig = small_rig(&["cam1", "cam2"]);
    let open = |cameras: &[(&str, &str)]| {
        let cameras = cameras.iter().map(|(a, b)| ((*a).into(), (*b).into())).collect();
        let options = DetectionOptions { fps: 50.0, cameras, ..DetectionOptions::default() };
        DetectionFolder::open(root.path(), &rig, options)
    };
    let folder = open(&[("left", "cam1")]).unwrap();
    let found: Vec<_> =
        folder.matches().iter().map(|m| (m.folder.ends_with("left"), m.by)).collect();
    assert_eq!(found, [(true, MatchedBy::Given), (false, MatchedBy::Order)]);
    let error = open(&[("left", "cam1"), ("cam1", "cam1")]).err().unwrap();
    assert!(error.to_string().contains("cam1=cam1 gives a folder or a camera twice"), "{error}");

    // A name is a part of the file's, also with separators and zeros in it.
    let root = TempDir::new().unwrap();
    let names = ["results_cam_0", "take__side_cam_01", "cam-2DLC_resnet50"];
    let csv = "frame,nose_x,nose_y\n0,1,2\n";
    for name in names {
        write(root.path(), &format!("{name}.csv"), csv);
    }
    let rig = small_rig(&["cam2", "cam1", "cam0"]);
    let options = || DetectionOptions { fps: 50.0, ..DetectionOptions::default() };
    let folder = DetectionFolder::open(root.path(), &rig, options()).unwrap();
    let found: Vec<_> = folder.matches().iter().map(|m| m.folder.file_stem().unwrap()).collect();
    assert_eq!(found, [names[2], names[1], names[0]]);

    let refused = |files: &[(&str, &str)], says: &str| {
        let root = TempDir::new().unwrap();
        files.iter().for_each(|(name, text)| drop(write(root.path(), name, text)));
        let error = DetectionFolder::open(root.path(), &rig, options()).err().unwrap();
        assert!(error.to_string().contains(says), "{error}");
    };
    refused(&[("all.csv", csv)], "it has no column camera, and is the only file");
    let several = "frame,camera,nose_x,nose_y\n0,a,1,2\n0,b,1,2\n";
    refused(
        &[("cam0.csv", several), ("cam1.csv", csv), ("cam2.csv", csv)],
        "holds several cameras",
    );
    let take = r#"[{"image_id":"0.jpg","keypoints":[]}]"#;
    refused(&[("cam0/a.json", take), ("cam0/b.json", take)], "its folder holds several takes");
    let cut = ("cam1.json", &take[..20]);
    refused(&[("cam0.json", take), cut, ("cam2.json", take)], "cam1.json: not valid JSON");
    let individuals = "scorer,n,n\nindividuals,a\nbodyparts,nose,nose\ncoords,x,y\n0,1,2\n";
    refused(
        &[("cam0.csv", individuals), ("cam1.csv", csv), ("cam2.csv", csv)],
        "line individuals is shorter",
    );
    refused(
        &[("cam0.csv", "frame,nose_x,nose_y\n-1,1,2\n"), ("cam1.csv", csv), ("cam2.csv", csv)],
        "no whole number",
    );
}

#[test]
fn what_is_guessed_or_missing_is_said() {
    let root = TempDir::new().unwrap();
    let of = |points: usize| {
        let list = vec!["10"; 3 * points].join(",");
        frame(&[format!("{{\"pose_keypoints_2d\":[{list}],\"hand_left_keypoints_2d\":[1,2,3]}}")])
    };
    write(root.path(), "cam1/0.json", &of(25));
    write(root.path(), "cam2/0.json", &of(25));
    write(root.path(), "cam2/1.json", "{\"people\": [{\"pose_keyp");
    write(root.path(), "cam2/2.json", &of(24));
    let rig = small_rig(&["cam1", "cam2", "cam3"]);
    let options = || DetectionOptions { fps: 50.0, ..DetectionOptions::default() };
    let mut folder = DetectionFolder::open(root.path(), &rig, options()).unwrap();
    assert_eq!(folder.by_ref().map(Result::unwrap).count(), 2);
    let notes = folder.notes().join("\n");
    for says in [
        "no detections of camera cam3",
        "read as body_25; body_25b has as many",
        "1.json",
        "2.json",
    ] {
        assert!(notes.contains(says), "{notes}");
    }
    assert_eq!(folder.reports()[1].broken_files, 2);
    fs::remove_file(root.path().join("cam2/2.json")).unwrap();
    assert!(folder.reports()[0].left_out);
    let refused = |text: &str, says: &str| {
        write(root.path(), "cam1/0.json", text);
        let error = DetectionFolder::open(root.path(), &rig, options()).err().unwrap();
        assert!(error.to_string().contains(says), "{error}");
    };
    refused(&of(24), "people have 24 points, which no known order has");
    write(root.path(), "cam2/0.json", "{\"people\":[]}");
    refused("", "nobody is seen in any frame");
    // Two left folders for one free camera: nothing tells which it is.
    write(root.path(), "left/0.json", &of(25));
    write(root.path(), "right/0.json", &of(25));
    refused("", "no calibration for left, right");
}

/// Collects the poses of a solve.
#[derive(Default)]
struct Poses(Vec<StampedPose>);

impl Observer for Poses {
    fn pose(&mut self, _: &str, pose: &StampedPose, _: &Skeleton) {
        self.0.push(pose.clone());
    }
}

#[test]
fn the_real_take_is_the_same_in_the_form_of_another_detector() {
    let Some(set) = real_set() else { return };
    let rig = toml_rig(&set);
    let take = set.join("balancing/pose");
    let (root, openpose) = (TempDir::new().unwrap(), TempDir::new().unwrap());
    for camera in fs::read_dir(&take).unwrap().map(|entry| entry.unwrap().path()) {
        let mut files: Vec<PathBuf> =
            fs::read_dir(&camera).unwrap().map(|entry| entry.unwrap().path()).collect();
        files.sort();
        // OpenPose's own names of files, and its other fields.
        let name = camera.file_name().unwrap().to_string_lossy().into_owned();
        for (i, file) in files.iter().enumerate() {
            let mut frame: Value = serde_json::from_slice(&fs::read(file).unwrap()).unwrap();
            for person in frame["people"].as_array_mut().unwrap() {
                person["face_keypoints_2d"] = json!([]);
                person["hand_left_keypoints_2d"] = json!([]);
            }
            let file = format!("{name}/{name}_{i:012}_keypoints.json");
            write(openpose.path(), &file, &frame.to_string());
        }
        let frame = |(i, file): (usize, &PathBuf)| {
            let frame: Value = serde_json::from_slice(&fs::read(file).unwrap()).unwrap();
            let person = |person: &Value| {
                let numbers = person["pose_keypoints_2d"].as_array().unwrap();
                let points: Value = numbers.chunks(3).map(|p| json!([p[0], p[1]])).collect();
                let scores: Value = numbers.chunks(3).map(|p| p[2].clone()).collect();
                json!({ "keypoints": points, "keypoint_scores": scores })
            };
            let people: Value = frame["people"].as_array().unwrap().iter().map(person).collect();
            json!({ "frame_id": i + 1, "instances": people })
        };
        let frames: Value = files.iter().enumerate().map(frame).collect();
        let name = camera.file_name().unwrap().to_string_lossy().replace("json", "results.json");
        write(root.path(), &name, &json!({ "instance_info": frames }).to_string());
    }
    let read = |folder: &Path| -> Vec<Detections> {
        let folder = opened(folder, &rig, KeypointFormat::Body25b, 60.0).unwrap();
        folder.map(Result::unwrap).collect()
    };
    let (pose2sim, mmpose) = (read(&take), read(root.path()));
    assert_eq!(pose2sim.len(), 400);
    assert_eq!(pose2sim, mmpose);
    assert_eq!(pose2sim, read(openpose.path()));
    // So the poses are the same to the last bit.
    let solved = |folder: &Path| {
        let place = TempDir::new().unwrap();
        let path = place.path().join("take.mcap");
        let mut writer = Writer::create(&path, Topics::default(), &Provenance::default()).unwrap();
        writer.rig(&rig, Timestamp::default()).unwrap();
        for detections in read(folder) {
            let camera = &rig.cameras[detections.camera];
            writer.keypoints(&detections, &camera.name, [camera.width, camera.height]).unwrap();
        }
        writer.finish().unwrap();
        let mut poses = Poses::default();
        let mut recording = Recording::open(&path).unwrap();
        solve(&mut recording, &Options::default(), &mut poses).unwrap();
        poses.0
    };
    let poses = solved(&take);
    assert!(poses.len() > 90, "{}", poses.len());
    assert_eq!(poses, solved(root.path()));
    assert_eq!(poses, solved(openpose.path()));
}

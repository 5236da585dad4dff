//! Calibrations and OpenPose folders: the real data set, and small ones made here.

use std::collections::HashMap;
use std::fs;
use std::path::{Path, PathBuf};

use bundlemocap::core::camera::{Camera, Lens, Rig, View, triangulate_robust};
use bundlemocap::core::detections::{Detections, Keypoint, KeypointFormat, Person};
use bundlemocap::core::so3;
use bundlemocap::io::formats::trc::Trc;
use bundlemocap::io::formats::{
    ImportError, MatchedBy, OpenposeFolder, Up, keypoint_format, read_calibration,
};
use nalgebra::{Vector2, Vector3};
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
    read_calibration(&set.join("calibration/Calib_qualisys.toml"), Up::Z).unwrap()
}

fn qca_rig(set: &Path) -> Rig {
    read_calibration(&set.join("calibration/Calib.qca.txt"), Up::Z).unwrap()
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
    for item in OpenposeFolder::open(folder, rig, KeypointFormat::Body25b, 60.0).unwrap() {
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
    let mut stream = OpenposeFolder::open(&set.join("balancing/pose"), &rig, format, 60.0).unwrap();
    assert!(stream.matches().iter().all(|m| m.by == MatchedBy::Name));
    assert_eq!(stream.file_count(), 400);
    let order: Vec<_> =
        stream.by_ref().map(|d| d.map(|d| (d.capture, d.camera, d.frame)).unwrap()).collect();
    assert_eq!(order.len(), 400);
    assert!(order.is_sorted());
    assert_eq!(order[399].2, 99);
    for report in stream.reports() {
        assert_eq!((report.files, report.gaps, report.empty_files), (100, 0, 0));
        assert!(report.people >= 80, "{report:?}");
    }
    let statics = OpenposeFolder::open(&set.join("static/pose"), &rig, format, 60.0).unwrap();
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

fn open(root: &Path, rig: &Rig) -> Result<OpenposeFolder, ImportError> {
    OpenposeFolder::open(root, rig, KeypointFormat::Coco17, 50.0)
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
        ("cam1_json/x.10.json", &frame(&[person("0,0,0"), person("NaN,2,0.5")])),
        ("cam1_json/notes.txt", "not a frame"),
        ("cam1_json/.hidden.json", "not a frame"),
    ] {
        write(root.path(), name, text);
    }
    let mut stream = open(root.path(), &small_rig(&["Cam_01", "Cam_02"])).unwrap();
    assert!(stream.frame_counts_differ());
    let all: Vec<Detections> = stream.by_ref().map(Result::unwrap).collect();
    let order: Vec<_> = all.iter().map(|d| (d.frame, d.camera)).collect();
    assert_eq!(order, [(3, 1), (5, 0), (7, 0), (7, 1), (10, 0)]);
    assert_eq!(all[0].capture.ns(), 60_000_000);
    let clamped = all[2].people[0].points[0].unwrap();
    assert_eq!((clamped.pixel.x, clamped.confidence), (1.0, 1.0));
    assert_eq!(all[2].people.len(), 1);
    assert!(all[3].people.is_empty());
    assert!(all[4].people.iter().all(|p| p.points[0].is_none() && p.points[1].is_some()));
    let [first, second] = stream.reports() else { panic!("two cameras") };
    assert_eq!((first.files, first.first_frame, first.last_frame, first.gaps), (3, 5, 10, 3));
    assert_eq!((first.people, first.people_without_points), (3, 1));
    assert_eq!((first.points, first.non_finite_points, first.clamped_confidences), (49, 1, 1));
    assert_eq!((first.frames_without_people, first.empty_files), (1, 0));
    assert_eq!((second.files, second.gaps, second.empty_files), (2, 3, 1));
    assert_eq!(second.frames_without_people, 1);
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
fn folders_that_do_not_match_the_rig_are_refused() {
    let (root, rig) = two_cameras();
    let path = root.path();
    let error = open_error(&path.join("nowhere"), &rig);
    assert!(matches!(error, ImportError::Read { .. }), "{error}");
    let error = open_error(&path.join("cam01_json"), &rig);
    assert!(matches!(error, ImportError::NoCameraFolders { .. }), "{error}");

    let error = open_error(path, &small_rig(&["cam1", "cam2", "cam3"]));
    assert!(
        matches!(&error, ImportError::CalibrationWithoutCamera { cameras, .. }
        if cameras == "cam3"),
        "{error}"
    );
    fs::create_dir(path.join("cam3")).unwrap();
    let error = open_error(path, &small_rig(&["cam1", "cam2", "cam3"]));
    assert!(
        matches!(&error, ImportError::EmptyCameraFolder { camera, .. }
        if camera == "cam3"),
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
        let error = OpenposeFolder::open(path, &rig, KeypointFormat::Coco17, fps).err().unwrap();
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
        ("{\"annotations\":[]}", "no list \"people\""),
        ("{\"people\":3}", "not OpenPose's JSON"),
        ("[1,2]", "not OpenPose's JSON"),
        ("{\"people\":[{\"pose_keypoints_2d\":[\"a\"]}]}", "not OpenPose's JSON"),
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
        (75, "has 75 numbers, coco_17 needs 51; that length fits body_25 or body_25b"),
        (78, "that length fits halpe_26"),
        (52, "no known format has that length"),
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
    read_calibration(&write(folder.path(), "calibration", text), up)
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
    assert_eq!(
        [Up::from_name("y"), Up::from_name("z"), Up::from_name("x")],
        [Some(Up::Y), Some(Up::Z), None]
    );
}

#[test]
fn bad_calibrations_give_a_one_line_error() {
    let one = TOML.split("[cam_2]").next().unwrap();
    let camera = "<calibration><camera serial=\"a\">";
    for (text, says) in [
        (String::new(), "no table describes a camera"),
        ("[metadata]\nerror = 0.0".into(), "no table describes a camera"),
        ("a = 1\n\u{1}".into(), "line 2 is not TOML"),
        ("{\"people\": []}".into(), "line 1 is not TOML"),
        (TOML.replace("size = [640, 480]\n", ""), "camera table cam_2: missing field `size`"),
        (TOML.replace("[640, 480]", "[640, 0]"), "camera cam_2: image size 640 x 0"),
        (TOML.replace("0.003, 0.004]", "0.003, 0.004, 0.5]"), "4, 5 or 8 coefficients, not 6"),
        (TOML.replace("910.0", "0.0"), "camera cam_2: the intrinsic matrix is singular"),
        (TOML.replace("[0.1, 0.2, 3.0]", "[nan, 0.2, 3.0]"), "camera cam_10: the translation"),
        (TOML.replace("[cam_2]", "[cam_2]\nname = \"cam_10\""), "two cameras of the rig are named"),
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
    let missing = read_calibration(Path::new("/nowhere/calibration.toml"), Up::Z).unwrap_err();
    assert!(matches!(missing, ImportError::Read { .. }), "{missing}");
}

#[test]
fn an_invalid_qualisys_rotation_is_refused() {
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
    let file = |r33| format!("<c><cameras>{}{}</cameras></c>", camera("a", 1.0), camera("b", r33));
    let rig = calibration(&file(1.0), Up::Y).unwrap();
    let a = &rig.cameras[0];
    assert_eq!((a.width, a.height), (640, 480));
    assert_eq!((a.focal, a.centre), (Vector2::new(1000.0, 1000.0), Vector2::new(310.0, 220.0)));
    assert!((a.centre_in_world() - Vector3::new(1.0, 2.0, 3.0)).norm() < 1e-12);
    // The camera looks along its own -z.
    assert!((a.ray(&a.centre).unwrap() + Vector3::z()).norm() < 1e-12);
    assert_eq!(*a.lens(), Lens::BrownConrady([0.1, 0.2, 0.4, 0.5, 0.3, 0.0, 0.0, 0.0]));
    for r33 in [0.5, -1.0] {
        let error = calibration(&file(r33), Up::Y).unwrap_err();
        assert!(error.to_string().contains("camera b: the rotation is no rotation"), "{error}");
    }
}

#[test]
fn real_trc_files_are_read() {
    let Some(set) = real_set() else { return };
    let folder = set.join("balancing/pose-3d");
    let read = |end: &str| {
        let name = format!("S00_P00_T01_BalancingTrial_0-100{end}.trc");
        Trc::read(&folder.join(name)).unwrap()
    };
    let (raw, augmented) = (read(""), read("_filt_butterworth_LSTM"));
    assert_eq!((raw.rows.len(), raw.first_frame, raw.names.len()), (100, 0, 21));
    assert_eq!((augmented.rows.len(), augmented.names.len()), (100, 64));
    for keypoint in [Keypoint::LShoulder, Keypoint::RWrist, Keypoint::LHip, Keypoint::RAnkle] {
        assert!(raw.column_of(keypoint).is_some());
        assert_eq!(raw.column_of(keypoint), augmented.column_of(keypoint));
    }
}

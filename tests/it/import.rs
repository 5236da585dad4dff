//! Calibrations and OpenPose folders: the real set, and small ones made here.

use std::collections::HashMap;
use std::fs;
use std::path::{Path, PathBuf};

use bundlemocap::camera::{Camera, Lens, Rig, View, triangulate_robust};
use bundlemocap::detect::{Detections, Keypoint, KeypointFormat, Person};
use bundlemocap::import::{
    ImportError, MatchedBy, OpenposeFolder, Up, keypoint_format, read_calibration,
};
use bundlemocap::so3;
use nalgebra::{Vector2, Vector3};
use tempfile::TempDir;

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

/// The real set, where it is there.
fn real_set() -> Option<PathBuf> {
    let root = std::env::var_os("BUNDLEMOCAP_DATA")
        .map_or_else(|| Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared"), PathBuf::from);
    let set = root.join("recordings/pose2sim");
    if !set.is_dir() {
        println!("skipped: no real recordings (set BUNDLEMOCAP_DATA)");
        return None;
    }
    Some(set)
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

/// Views of one keypoint by frame, of the surest person of each camera.
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

/// Residuals (px) of robust triangulation, and distances (mm) to the reference.
fn triangulate_set(set: &Path, rig: &Rig, threshold_px: f64) -> (Vec<f64>, Vec<f64>, usize) {
    let reference = butterworth(set);
    let (mut residuals, mut distances, mut inliers) = (Vec::new(), Vec::new(), 0);
    for (keypoint, marker) in LIMBS {
        let frames = views_by_frame(&set.join("balancing/pose"), rig, keypoint);
        for (views, markers) in frames.iter().zip(&reference) {
            let Some(found) = triangulate_robust(rig, views, threshold_px, 1) else { continue };
            distances.push((found.point - markers[marker]).norm() * 1e3);
            inliers += found.inliers.len();
            for &i in &found.inliers {
                let (camera, pixel, _) = views[i];
                residuals.push((rig.cameras[camera].project(&found.point).unwrap() - pixel).norm());
            }
        }
    }
    (residuals, distances, inliers)
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
        // 1.6 to 2.1 m above the ground, and looking down a little with the image upright.
        assert!((1.6..2.2).contains(&a.centre_in_world().y), "{}", a.centre_in_world());
        assert!(a.rotation[(1, 1)] < -0.8, "{}", a.rotation);
    }
}

#[test]
fn triangulated_limbs_of_the_real_set_are_where_the_reference_has_them() {
    let Some(set) = real_set() else { return };
    let (residuals, distances, _) = triangulate_set(&set, &toml_rig(&set), 60.0);
    let (residual, distance) = (median(residuals), median(distances.clone()));
    println!(
        "triangulated {} points: residual {residual:.2} px, {distance:.1} mm",
        distances.len()
    );
    assert!(distances.len() > 1000);
    assert!(residual < 14.0, "{residual} px");
    assert!(distance < 30.0, "{distance} mm");
}

#[test]
#[ignore = "a measurement: which distortion of the Qualisys file fits the detections"]
fn distortion_of_the_real_set_compared() {
    let Some(set) = real_set() else { return };
    let ideal = |rig: &Rig| {
        let cameras = rig.cameras.iter().map(|c| {
            let size = [c.width, c.height];
            Camera::new(&c.name, size, &c.matrix(), Lens::IDEAL, c.rotation, c.translation).unwrap()
        });
        Rig::new(1, cameras.collect()).unwrap()
    };
    let (toml, qca) = (toml_rig(&set), qca_rig(&set));
    for threshold in [30.0, 60.0, 120.0] {
        for (name, rig) in [("divided", &toml), ("whole", &qca), ("none", &ideal(&toml))] {
            let (r, d, inliers) = triangulate_set(&set, rig, threshold);
            let mean = r.iter().sum::<f64>() / r.len() as f64;
            let n = d.len();
            let mm = median(d);
            println!(
                "{threshold} px {name}: median {:.3} mean {mean:.3} px, {inliers} of {n} points, {mm:.2} mm",
                median(r)
            );
        }
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

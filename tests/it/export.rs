//! BVH read by a parser of other authors, and the report.

use std::path::Path;
use std::process::Command;

use bundlemocap::core::body::{JOINTS, Joint, Pose, Posture, Shape, Skeleton};
use bundlemocap::io::formats::bvh::{BvhWriter, write_bvh};
use bundlemocap::io::formats::gltf::write_glb;
use bundlemocap::io::formats::{Description, JointNames, RestPose, Style, Unit, Up};
use bundlemocap::io::report::{
    AngleTrack, CameraErrors, Picture, ReportData, StickFigures, Table, WindowRow, flexion_deg,
    stick_figures, write_report,
};
use bundlemocap::research::synth::{Motion, MotionStyle};

/// Reads a BVH file with the PyPI package `bvh` and prints, for each frame, the positions and rotations
/// of all joints by a forward kinematics that multiplies in channel order. Exits with 3 without the
/// package.
const READER: &str = r#"
import math, sys
try:
    from bvh import Bvh
except ImportError:
    sys.exit(3)
mocap = Bvh(open(sys.argv[1]).read())

def multiply(a, b):
    return [[sum(a[i][k] * b[k][j] for k in range(3)) for j in range(3)] for i in range(3)]

def turn(axis, degrees):
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    return {"X": [[1, 0, 0], [0, c, -s], [0, s, c]],
            "Y": [[c, 0, s], [0, 1, 0], [-s, 0, c]],
            "Z": [[c, -s, 0], [s, c, 0], [0, 0, 1]]}[axis]

names = mocap.get_joints_names()
print(mocap.nframes, mocap.frame_time, *names)
for frame in range(mocap.nframes):
    rotations, positions = {}, {}
    for name in names:
        offset = list(mocap.joint_offset(name))
        rotation = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]
        for channel in mocap.joint_channels(name):
            value = mocap.frame_joint_channel(frame, name, channel)
            if channel.endswith("position"):
                offset["XYZ".index(channel[0])] += value
            else:
                rotation = multiply(rotation, turn(channel[0], value))
        parent = mocap.joint_parent(name)
        if parent is None:
            rotations[name], positions[name] = rotation, offset
            continue
        outer, at = rotations[parent.name], positions[parent.name]
        rotations[name] = multiply(outer, rotation)
        positions[name] = [at[i] + sum(outer[i][k] * offset[k] for k in range(3)) for i in range(3)]
    print(*(c for name in names for c in positions[name] + sum(rotations[name], [])))
"#;

fn motion(skeleton: &Skeleton) -> Vec<Pose> {
    let motion = Motion::new(skeleton, MotionStyle::default());
    (0..260).map(|frame| motion.pose(f64::from(frame) / 20.0)).collect()
}

/// The output lines of [`READER`]; empty if it cannot run.
fn read_elsewhere(path: &Path) -> Option<Vec<String>> {
    let output = Command::new("python3").args(["-c", READER]).arg(path).output().ok()?;
    match output.status.code() {
        Some(0) => {}
        Some(3) => return None,
        _ => panic!("{}", String::from_utf8_lossy(&output.stderr)),
    }
    Some(String::from_utf8(output.stdout).unwrap().lines().map(str::to_owned).collect())
}

#[test]
fn another_parser_finds_the_same_joint_positions() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("walk.bvh");
    let skeleton =
        Skeleton::new(Shape::symmetric([0.7, -0.5, 1.0, 0.0, 0.5, -1.0, 1.0, 0.3, 0.0, 1.0]));
    let poses = motion(&skeleton);
    write_bvh(&path, &skeleton, 20.0, &poses).unwrap();
    let Some(lines) = read_elsewhere(&path) else {
        crate::support::skipped("python3 with the package bvh (pip install bvh) is not there");
        return;
    };
    let head: Vec<&str> = lines[0].split(' ').collect();
    assert_eq!((head[0], head[1], head.len() - 2), ("260", "0.05", JOINTS));
    let (mut worst, mut angle) = (0.0f64, 0.0f64);
    for (line, pose) in lines[1..].iter().zip(&poses) {
        let values: Vec<f64> = line.split(' ').map(|v| v.parse().unwrap()).collect();
        let posture = pose.posture(&skeleton);
        for (name, at) in head[2..].iter().zip(values.chunks_exact(12)) {
            let joint = Joint::ALL.into_iter().find(|joint| joint.name() == *name).unwrap();
            let truth = posture.positions[joint.index()] * 100.0;
            worst = worst.max((truth - nalgebra::Vector3::from_row_slice(&at[..3])).norm());
            let turn = nalgebra::Matrix3::from_row_slice(&at[3..]);
            let apart = (turn - posture.rotations[joint.index()]).norm();
            angle = angle.max((2.0 * (apart / 8f64.sqrt()).asin()).to_degrees());
        }
    }
    println!("largest distance {:.5} mm, largest angle {angle:.5} degrees", worst * 10.0);
    assert_eq!(lines.len(), 261);
    assert!(worst * 10.0 < 0.1, "{} mm", worst * 10.0);
    assert!(angle < 0.1, "{angle} degrees");
}

/// An A-pose with z up, in metres, with Unreal's names.
#[test]
fn another_parser_finds_the_same_places_in_another_style() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("styled.bvh");
    let skeleton = Skeleton::default();
    let mut style = Style::new(RestPose::A, Up::Z);
    (style.names, style.unit) = (JointNames::Unreal, Some(Unit::M));
    let poses = [&[RestPose::A.pose()][..], &motion(&skeleton)].concat();
    let mut writer = BvhWriter::create(&path, &skeleton, 20.0, &style).unwrap();
    poses.iter().for_each(|pose| writer.write(pose).unwrap());
    writer.finish().unwrap();
    let Some(lines) = read_elsewhere(&path) else {
        crate::support::skipped("python3 with the package bvh (pip install bvh) is not there");
        return;
    };
    let names: Vec<&str> = lines[0].split(' ').skip(2).collect();
    assert_eq!(lines.len(), 1 + poses.len());
    for (line, pose) in lines[1..].iter().zip(&poses) {
        let values: Vec<f64> = line.split(' ').map(|value| value.parse().unwrap()).collect();
        let places = pose.posture(&skeleton).positions;
        for (name, at) in names.iter().zip(values.chunks_exact(12)) {
            let joint = Joint::ALL.into_iter().find(|joint| style.names.of(*joint) == *name);
            // (x, y, z) of ours is (y, z, x) of the file.
            let truth = places[joint.unwrap().index()];
            let far = nalgebra::Vector3::new(at[1], at[2], at[0]) - truth;
            assert!(far.norm() < 1e-4, "{name}: {far}");
        }
    }
    // All rotations of the first frame are zero.
    let text = std::fs::read_to_string(&path).unwrap();
    let first = text.lines().skip_while(|line| !line.starts_with("Frame Time")).nth(1).unwrap();
    let mut numbers = first.split(' ').skip(3).map(|value| value.parse::<f64>().unwrap());
    assert!(numbers.all(|degrees| degrees.abs() < 1e-4), "{first}");
}

#[test]
fn bvh_angles_have_no_jumps() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("walk.bvh");
    let skeleton = Skeleton::default();
    let motion = Motion::new(&skeleton, MotionStyle::default());
    let poses: Vec<Pose> = (0..3000).map(|f| motion.pose(f64::from(f) / 60.0)).collect();
    write_bvh(&path, &skeleton, 60.0, &poses).unwrap();
    let text = std::fs::read_to_string(&path).unwrap();
    let rows: Vec<Vec<f64>> = (text.lines().skip_while(|line| !line.starts_with("Frame Time")))
        .skip(1)
        .map(|line| line.split(' ').map(|v| v.parse().unwrap()).collect())
        .collect();
    assert_eq!(rows.len(), 3000);
    for (before, after) in rows.iter().zip(&rows[1..]) {
        let jump = before[3..].iter().zip(&after[3..]).map(|(a, b)| (a - b).abs());
        assert!(jump.fold(0.0, f64::max) < 25.0, "degrees between frames");
    }
}

#[test]
fn a_file_is_written_completely_or_not_at_all() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("bad.bvh");
    let mut pose = Pose::rest();
    pose.root_position.x = f64::NAN;
    let poses = [Pose::rest(), pose];
    let error = write_bvh(&path, &Skeleton::default(), 60.0, &poses).unwrap_err().to_string();
    assert!(error.contains("bad.bvh") && error.contains("pose 1"), "{error}");
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);

    let nowhere = folder.path().join("absent").join("a.bvh");
    let error = write_bvh(&nowhere, &Skeleton::default(), 60.0, []).unwrap_err().to_string();
    assert!(error.contains("cannot be written"), "{error}");
    let error = write_bvh(&path, &Skeleton::default(), 0.0, []).unwrap_err().to_string();
    assert!(error.contains("frame rate 0 is not valid"), "{error}");

    let glb = folder.path().join("a \"b\".glb");
    let style = Style::default();
    let mut about = Description { name: "a \"b\"", fps: 60.0, timecode: None, style: &style };
    let timed = poses.map(|pose| (0.0, pose));
    let error = write_glb(&glb, &about, &Skeleton::default(), timed).unwrap_err().to_string();
    assert!(error.contains("pose 1") && !glb.exists(), "{error}");
    assert_eq!(write_glb(&glb, &about, &Skeleton::default(), []).unwrap(), 0);
    let bytes = std::fs::read(&glb).unwrap();
    let length = u32::from_le_bytes(bytes[12..16].try_into().unwrap()) as usize;
    let json: serde_json::Value = serde_json::from_slice(&bytes[20..20 + length]).unwrap();
    assert_eq!(
        (json["scenes"][0]["name"].as_str(), json.get("animations")),
        (Some(about.name), None)
    );
    about.fps = f64::NAN;
    let error = write_glb(&glb, &about, &Skeleton::default(), []).unwrap_err().to_string();
    assert!(error.contains("frame rate NaN is not valid"), "{error}");
}

fn report() -> ReportData {
    let skeleton = Skeleton::default();
    let postures: Vec<Posture> = motion(&skeleton).iter().map(|p| p.posture(&skeleton)).collect();
    let seconds = |frame: usize| frame as f64 / 20.0;
    let cameras = (1..=4).map(|camera| CameraErrors {
        name: format!("cam{camera:02}"),
        frames: (0..postures.len())
            .map(|frame| {
                let wave = (seconds(frame) * f64::from(camera) * 1.7).sin();
                let median = 5.0 + f64::from(camera) + wave;
                (seconds(frame), [median - 2.0, median, median + 3.0])
            })
            .collect(),
    });
    let angles = [Joint::LKnee, Joint::RKnee, Joint::LElbow, Joint::RElbow].map(|joint| {
        let of = |(frame, posture): (usize, &Posture)| {
            (seconds(frame), flexion_deg(&posture.positions, joint).unwrap())
        };
        AngleTrack { joint, degrees: postures.iter().enumerate().map(of).collect() }
    });
    let windows = (0..78).map(|index| WindowRow {
        start_s: f64::from(index) / 6.0,
        end_s: f64::from(index + 1) / 6.0,
        latent_norm: 4.0 + (f64::from(index) * 0.3).sin(),
        iterations: 5 + (index as usize * 7) % 6,
        cost: 2000.0 * (2.0 + (f64::from(index) * 0.5).sin()),
        solve_ms: 7.0 + (f64::from(index) * 1.3).cos(),
        lost_s: (40..43).contains(&index).then(|| [0, 1].map(|end| f64::from(index + end) / 6.0)),
    });
    let times: Vec<(usize, String)> =
        [10, 22, 45, 68, 97, 135, 170, 225].map(|f| (f, format!("{:.1} s", seconds(f)))).into();
    let drawn = times.iter().map(|(frame, caption)| (&postures[*frame], caption.as_str()));
    ReportData {
        title: "walk.mcap".into(),
        subtitle: "4 cameras, 780 frames at 60 fps".into(),
        facts: [("frames", "780"), ("windows", "78"), ("lost", "3"), ("reprojection", "6.9 px")]
            .map(|(a, b)| (a.to_owned(), b.to_owned()))
            .into(),
        tables: vec![Table {
            title: "Cameras".into(),
            header: vec!["camera".into(), "median (px)".into(), "points".into()],
            rows: vec![vec!["cam01".into(), "6.1".into(), "19,204".into()]; 4],
        }],
        pictures: vec![Picture {
            title: "The motion".into(),
            svg: stick_figures(drawn, &StickFigures::default()),
        }],
        cameras: cameras.collect(),
        angles: angles.into(),
        windows: windows.collect(),
        ..ReportData::default()
    }
}

/// Set BUNDLEMOCAP_KEEP_REPORT to a path to keep the page and look at it.
#[test]
fn the_report_is_one_self_contained_file() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("report.html");
    write_report(&path, &report()).unwrap();
    if let Some(keep) = std::env::var_os("BUNDLEMOCAP_KEEP_REPORT") {
        std::fs::copy(&path, keep).unwrap();
    }
    let page = std::fs::read_to_string(&path).unwrap();
    for title in [
        "Reprojection error",
        "Knee angle",
        "Elbow angle",
        "Latent norm",
        "Iterations",
        "Solve time",
    ] {
        assert!(page.contains(&format!("<h3>{title}</h3>")), "{title}");
    }
    assert!(!page.contains("<script") && !page.contains("<link") && !page.contains("NaN"));
    let bodies = page.split("<svg ").skip(1).map(|rest| rest.split_once("</svg>").unwrap().0);
    for body in bodies {
        let xml = format!("<svg {body}</svg>");
        roxmltree::Document::parse(&xml).unwrap();
    }
    assert_eq!(page.matches("<svg ").count(), 8);
    // Three lost windows in a row are one section in each plot.
    assert_eq!(page.matches("<rect x=").count(), 7);
    assert!(page.len() < 400_000, "{}", page.len());
}

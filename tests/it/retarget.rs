//! Retargeting to our own skeleton, CMU's, and synthetic ones of each naming convention.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::time::{Duration, Instant};

use bundlemocap::core::body::{
    JOINTS, Joint, Pose, Posture, Shape, Skeleton, StampedPose, TrackingState,
};
use bundlemocap::core::time::Timestamp;
use bundlemocap::io::bus::{Bus, Sample, Zenoh, ZenohConfig};
use bundlemocap::io::formats::bvh::Bvh;
use bundlemocap::io::formats::bvh::{HierarchyWriter, write_bvh};
use bundlemocap::io::recording::{Provenance, Writer};
use bundlemocap::io::report::{StickFigures, stick_figures};
use bundlemocap::io::vmc::packets;
use bundlemocap::io::wire::{self, Topics, encode};
use bundlemocap::research::synth::{Motion, MotionStyle};
use bundlemocap::research::train::read_folder;
use bundlemocap::retarget::{Channels, Convention, Figure, Map, Retarget, Target};
use expect_test::expect;
use nalgebra::{Matrix3, Vector3};

use crate::program::Program;
use crate::support::data;
use crate::vmc::{bones, read};

const ZYX: &str = "Zrotation Yrotation Xrotation";

/// Bones of the limbs: from, to.
const LIMBS: [(Joint, Joint); 8] = [
    (Joint::LShoulder, Joint::LElbow),
    (Joint::RShoulder, Joint::RElbow),
    (Joint::LElbow, Joint::LWrist),
    (Joint::RElbow, Joint::RWrist),
    (Joint::LHip, Joint::LKnee),
    (Joint::RHip, Joint::RKnee),
    (Joint::LKnee, Joint::LAnkle),
    (Joint::RKnee, Joint::RAnkle),
];

/// One cycle of walking, squatting, reaching and waving.
fn poses(skeleton: &Skeleton) -> Vec<Pose> {
    let motion = Motion::new(skeleton, MotionStyle::default());
    (0..390).map(|frame| motion.pose(f64::from(frame) / 30.0)).collect()
}

fn shaped() -> Skeleton {
    Skeleton::new(Shape::symmetric([0.7, -0.5, 1.0, 0.0, 0.5, -1.0, 1.0, 0.3, 0.0, 1.0]))
}

fn retarget(text: &str, map: &str) -> Retarget {
    try_retarget(text, map).unwrap()
}

fn try_retarget(text: &str, map: &str) -> Result<Retarget, String> {
    let map = Map::parse(map, Path::new("map.toml")).map_err(|error| error.to_string())?;
    let target = Target::new(Bvh::parse(text).unwrap(), Path::new("target.bvh"), &map);
    Retarget::new(target, &map).map_err(|error| error.to_string())
}

/// The text of a BVH file of our skeleton without frames.
fn our_file(skeleton: &Skeleton) -> String {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("ours.bvh");
    write_bvh(&path, skeleton, 60.0, []).unwrap();
    std::fs::read_to_string(path).unwrap()
}

/// A row of a synthetic skeleton: depth, joint name, offset.
type Row = (usize, String, Vector3<f64>);

/// A BVH file without frames. Joints without children get an end site.
fn bvh_text(rows: &[Row], rotations: &str) -> String {
    let mut text = String::from("HIERARCHY\n");
    for (index, (depth, name, offset)) in rows.iter().enumerate() {
        let (kind, channels) = match depth {
            0 => ("ROOT", format!("6 Xposition Yposition Zposition {rotations}")),
            _ => ("JOINT", format!("3 {rotations}")),
        };
        let (x, y, z) = (offset.x, offset.y, offset.z);
        let _ = writeln!(text, "{kind} {name} {{ OFFSET {x} {y} {z} CHANNELS {channels}");
        let next = rows.get(index + 1).map_or(0, |row| row.0);
        if next <= *depth {
            let _ = writeln!(text, "End Site {{ OFFSET 0 0 0 }}");
            text += &"}\n".repeat(depth + 1 - next);
        }
    }
    text + "MOTION\nFrames: 0\nFrame Time: 0.01\n"
}

/// A whole skeleton from its left half and middle; the left half is mirrored to the right.
fn symmetric(rows: &[(usize, &str, [f64; 3])], right: impl Fn(&str) -> Option<String>) -> Vec<Row> {
    let mut all: Vec<Row> = Vec::new();
    let mut at = 0;
    while at < rows.len() {
        let (depth, name, _) = rows[at];
        let branch = 1 + rows[at + 1..].iter().take_while(|row| row.0 > depth).count();
        let take = |mirror: bool| {
            rows[at..at + branch].iter().map(move |&(depth, name, [x, y, z])| {
                let sign = if mirror { -1.0 } else { 1.0 };
                (depth, name.to_owned(), Vector3::new(sign * x, y, z))
            })
        };
        if right(name).is_some() {
            all.extend(take(false));
            all.extend(take(true).map(|(d, name, o)| (d, right(&name).unwrap_or(name), o)));
            at += branch;
        } else {
            all.extend(take(false).take(1));
            at += 1;
        }
    }
    all
}

fn left_to_right(name: &str) -> Option<String> {
    name.contains("Left").then(|| name.replace("Left", "Right"))
}

/// Mixamo names, A-pose with arms 45 degrees down, centimetres, with fingers and toe ends.
fn mixamo() -> Vec<Row> {
    symmetric(
        &[
            (0, "mixamorig:Hips", [0.0, 98.0, 1.0]),
            (1, "mixamorig:Spine", [0.0, 10.0, -1.2]),
            (2, "mixamorig:Spine1", [0.0, 11.7, 0.0]),
            (3, "mixamorig:Spine2", [0.0, 13.5, 0.0]),
            (4, "mixamorig:Neck", [0.0, 15.0, 0.9]),
            (5, "mixamorig:Head", [0.0, 10.3, 3.1]),
            (6, "mixamorig:HeadTop_End", [0.0, 18.5, 6.6]),
            (4, "mixamorig:LeftShoulder", [6.1, 9.1, 0.7]),
            (5, "mixamorig:LeftArm", [12.9, -1.2, -2.0]),
            (6, "mixamorig:LeftForeArm", [19.4, -19.4, -1.1]),
            (7, "mixamorig:LeftHand", [19.5, -19.6, 2.3]),
            (8, "mixamorig:LeftHandIndex1", [9.0, -8.0, 2.8]),
            (1, "mixamorig:LeftUpLeg", [9.1, -6.7, -0.1]),
            (2, "mixamorig:LeftLeg", [2.2, -44.4, 0.3]),
            (3, "mixamorig:LeftFoot", [1.1, -44.6, -2.3]),
            (4, "mixamorig:LeftToeBase", [0.9, -8.6, 13.5]),
            (5, "mixamorig:LeftToe_End", [0.0, 0.0, 8.6]),
        ],
        left_to_right,
    )
}

/// Unity names, T-pose, metres, facing -z.
fn unity() -> Vec<Row> {
    let rows = symmetric(
        &[
            (0, "Hips", [0.0, 0.0, 0.0]),
            (1, "Spine", [0.0, 0.09, -0.01]),
            (2, "Chest", [0.0, 0.14, 0.0]),
            (3, "UpperChest", [0.0, 0.13, -0.01]),
            (4, "Neck", [0.0, 0.18, -0.02]),
            (5, "Head", [0.0, 0.09, 0.02]),
            (4, "LeftShoulder", [0.04, 0.12, -0.01]),
            (5, "LeftUpperArm", [0.12, 0.0, -0.01]),
            (6, "LeftLowerArm", [0.26, 0.0, 0.0]),
            (7, "LeftHand", [0.25, 0.0, 0.0]),
            (1, "LeftUpperLeg", [0.09, -0.05, 0.0]),
            (2, "LeftLowerLeg", [0.0, -0.38, 0.0]),
            (3, "LeftFoot", [0.0, -0.4, -0.03]),
            (4, "LeftToes", [0.02, -0.06, 0.12]),
        ],
        left_to_right,
    );
    let half_turn = |(depth, name, at): Row| (depth, name, Vector3::new(-at.x, at.y, -at.z));
    rows.into_iter().map(half_turn).collect()
}

/// The skeleton without these joints of the trunk.
fn without(rows: Vec<Row>, names: &[&str]) -> Vec<Row> {
    let (mut above, mut all) = (Vec::<(usize, Vector3<f64>)>::new(), Vec::new());
    for (depth, name, at) in rows {
        above.retain(|(gone, _)| *gone < depth);
        if names.contains(&&*name) {
            above.push((depth, at));
            continue;
        }
        let is_child = above.last().is_some_and(|(gone, _)| gone + 1 == depth);
        let moved: Vector3<f64> = above.iter().filter(|_| is_child).map(|(_, at)| at).sum();
        all.push((depth - above.len(), name, at + moved));
    }
    all
}

fn degrees(a: &Vector3<f64>, b: &Vector3<f64>) -> f64 {
    a.angle(b).to_degrees()
}

/// Position of the target's joint that corresponds to ours, if there is one.
fn at(retarget: &Retarget, figure: &Figure, joint: Joint) -> Option<Vector3<f64>> {
    Some(figure.positions[retarget.mapping().joint(joint)?])
}

/// The largest angle between a limb of the target and ours, degrees, and the largest height
/// difference of the lower ball of the foot, metres. Set BUNDLEMOCAP_KEEP_FIGURES to a folder to
/// keep a picture of each target.
struct Worst {
    limbs: f64,
    floor: f64,
}

fn compare(name: &str, retarget: &mut Retarget, skeleton: &Skeleton) -> Worst {
    compare_poses(name, retarget, skeleton, &poses(skeleton))
}

fn compare_poses(
    name: &str,
    retarget: &mut Retarget,
    skeleton: &Skeleton,
    poses: &[Pose],
) -> Worst {
    if let Some(folder) = std::env::var_os("BUNDLEMOCAP_KEEP_FIGURES") {
        let file = Path::new(&folder).join(format!("{name}.svg"));
        std::fs::write(file, picture(name, retarget, skeleton, poses)).unwrap();
    }
    let mut worst = Worst { limbs: 0.0, floor: 0.0 };
    for pose in poses {
        let (figure, ours) = (retarget.apply(pose, skeleton).unwrap(), pose.posture(skeleton));
        for (from, to) in LIMBS {
            let theirs = at(retarget, &figure, to).zip(at(retarget, &figure, from));
            let bone = ours.positions[to.index()] - ours.positions[from.index()];
            let apart = theirs.map_or(0.0, |(to, from)| degrees(&(to - from), &bone));
            worst.limbs = worst.limbs.max(apart);
        }
        let balls = [Joint::LFoot, Joint::RFoot];
        let low = balls.map(|ball| ours.positions[ball.index()].y).into_iter().reduce(f64::min);
        let theirs = balls.iter().filter_map(|&ball| Some(at(retarget, &figure, ball)?.y));
        if let (Some(low), Some(theirs)) = (low, theirs.reduce(f64::min)) {
            worst.floor = worst.floor.max((low - theirs).abs());
        }
    }
    println!(
        "{name}: limbs within {:.4} degrees, balls of the feet within {:.1} mm, scale {:.3}, unit \
         {} m",
        worst.limbs,
        worst.floor * 1e3,
        retarget.scale(skeleton),
        retarget.target().unit()
    );
    worst
}

#[test]
fn retargeting_to_our_own_skeleton_is_the_identity() {
    for (skeleton, tolerance) in [(Skeleton::default(), 1e-9), (shaped(), 1e-6)] {
        let mut retarget = retarget(&our_file(&skeleton), "");
        assert_eq!(retarget.target().convention(), Some(Convention::Ours));
        assert_eq!(retarget.target().unit(), 0.01);
        let (mut turn, mut shift) = (0.0f64, 0.0f64);
        for pose in poses(&skeleton) {
            let figure = retarget.apply(&pose, &skeleton).unwrap();
            let ours = pose.posture(&skeleton);
            for joint in Joint::ALL {
                let theirs = retarget.mapping().joint(joint).unwrap();
                assert_eq!(retarget.target().joints()[theirs].name, joint.name());
                let (ours, at) = ((&ours.rotations, &ours.positions), joint.index());
                turn = turn.max((figure.rotations[theirs] - ours.0[at]).amax());
                shift = shift.max((figure.positions[theirs] - ours.1[at]).amax());
            }
        }
        println!("identity: rotations {turn:.1e}, positions {shift:.1e} m");
        assert!(turn < 1e-9, "{turn:.1e}");
        assert!(shift < tolerance, "{shift:.1e}");
    }
}

#[test]
fn a_file_on_our_own_skeleton_equals_the_exported_one() {
    let folder = tempfile::tempdir().unwrap();
    let (exported, mapped) = (folder.path().join("a.bvh"), folder.path().join("b.bvh"));
    let skeleton = Skeleton::default();
    let poses = poses(&skeleton);
    write_bvh(&exported, &skeleton, 30.0, &poses).unwrap();
    let mut retarget = retarget(&our_file(&skeleton), "");
    write(&mapped, &mut retarget, &skeleton, &poses);
    let [exported, mapped] = [exported, mapped].map(|path| std::fs::read_to_string(path).unwrap());
    let numbers = |text: &str| -> Vec<f64> {
        let frames = text.split_once("Frame Time").unwrap().1.lines().skip(1);
        frames.flat_map(str::split_whitespace).map(|number| number.parse().unwrap()).collect()
    };
    let (a, b) = (numbers(&exported), numbers(&mapped));
    assert_eq!(a.len(), b.len());
    assert!(a.iter().zip(&b).all(|(a, b)| (a - b).abs() < 1e-4));
}

/// Writes poses, retargeted, as BVH.
fn write(path: &Path, retarget: &mut Retarget, skeleton: &Skeleton, poses: &[Pose]) {
    let mut writer = HierarchyWriter::create(path, retarget.target().bvh(), 30.0).unwrap();
    let mut channels = Channels::default();
    for pose in poses {
        let figure = retarget.apply(pose, skeleton).unwrap();
        writer.write(&channels.values(retarget, &figure)).unwrap();
    }
    writer.finish().unwrap();
}

#[test]
fn a_written_file_holds_the_poses_and_the_same_hierarchy() {
    let skeleton = shaped();
    let poses = poses(&skeleton);
    // The same body with z up, facing -y; `up` is found automatically.
    let z_up = |(depth, name, at): Row| (depth, name, Vector3::new(at.x, -at.z, at.y));
    let z_up: Vec<Row> = mixamo().into_iter().map(z_up).collect();
    let (xyz, zxy) = ("Xrotation Yrotation Zrotation", "Zrotation Xrotation Yrotation");
    let world = Matrix3::new(1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, -1.0, 0.0);
    let cases = [
        (bvh_text(&mixamo(), ZYX), Matrix3::identity()),
        (bvh_text(&unity(), xyz), Matrix3::identity()),
        (bvh_text(&z_up, zxy), world),
    ];
    for (text, ours_from_file) in cases {
        let mut retarget = retarget(&text, "");
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("out.bvh");
        write(&path, &mut retarget, &skeleton, &poses);
        let written = std::fs::read_to_string(&path).unwrap();
        let back = Bvh::parse(&written).unwrap();
        assert_eq!(back.joints(), retarget.target().joints());
        assert_eq!((back.frames(), back.frame_time()), (poses.len(), 0.033_333_333));
        let (mut worst, unit) = (0.0f64, retarget.target().unit());
        for (frame, pose) in poses.iter().enumerate() {
            let figure = retarget.apply(pose, &skeleton).unwrap();
            for (at, (_, position)) in figure.positions.iter().zip(back.posture(frame).unwrap()) {
                worst = worst.max((at - ours_from_file * position * unit).norm());
            }
        }
        assert!(worst < 2e-6, "{worst:.1e} m");
        let rows: Vec<Vec<f64>> = (written.split_once("Frame Time").unwrap().1.lines().skip(1))
            .map(|line| line.split(' ').map(|number| number.parse().unwrap()).collect())
            .collect();
        let jumps = rows.windows(2).flat_map(|pair| {
            pair[0][3..].iter().zip(&pair[1][3..]).map(|(a, b)| (a - b).abs()).collect::<Vec<_>>()
        });
        let jump = jumps.fold(0.0, f64::max);
        // Near gimbal lock of an arm's channels angles change fast, but they do not wrap.
        assert!(jump < 170.0, "{jump} degrees between frames");
    }
}

#[test]
fn the_bones_for_avatars_are_where_the_targets_joints_are_and_not_turned_in_the_t_pose() {
    let skeleton = shaped();
    let without_toes = mixamo().into_iter().filter(|row| !row.1.contains("Toe")).collect();
    // Trunks with fewer joints are named from below.
    let with_chest = without(unity(), &["UpperChest"]);
    let with_spine = without(unity(), &["UpperChest", "Chest"]);
    let cases = [
        ("Mixamo", mixamo(), &["Spine", "Chest", "UpperChest"][..]),
        ("Unity", unity(), &["Spine", "Chest", "UpperChest"]),
        ("no toes", without_toes, &["Spine", "Chest", "UpperChest"]),
        ("trunk of two", with_chest, &["Spine", "Chest"]),
        ("trunk of one", with_spine, &["Spine"]),
    ];
    for (name, rows, trunk) in cases {
        let mut retarget = retarget(&bvh_text(&rows, ZYX), "");
        for (_, _, turn) in retarget.apply(&Pose::rest(), &skeleton).unwrap().bones() {
            assert!((turn - Matrix3::identity()).amax() < 1e-9, "{name}: {turn}");
        }
        let joints = [
            (Joint::Pelvis, "Hips"),
            (Joint::Spine3, trunk[trunk.len() - 1]),
            (Joint::Head, "Head"),
            (Joint::LWrist, "LeftHand"),
            (Joint::RElbow, "RightLowerArm"),
            (Joint::LAnkle, "LeftFoot"),
            (Joint::RFoot, "RightToes"),
        ];
        for pose in poses(&skeleton).iter().step_by(30) {
            let figure = retarget.apply(pose, &skeleton).unwrap();
            let packets = packets(&figure.bones(), TrackingState::Tracking, 0.0).unwrap();
            let messages: Vec<_> = packets.iter().flat_map(|packet| read(packet)).collect();
            let bones = bones(&messages);
            for bone in ["Spine", "Chest", "UpperChest"] {
                assert_eq!(bones.contains_key(bone), trunk.contains(&bone), "{name}: {bone}");
            }
            for (joint, bone) in joints {
                let theirs = at(&retarget, &figure, joint);
                assert_eq!(theirs.is_some(), bones.contains_key(bone), "{name}: {bone}");
                let Some(theirs) = theirs else { continue };
                let mirrored = Vector3::new(-theirs.x, theirs.y, theirs.z).cast::<f32>();
                assert!((bones[bone] - mirrored).norm() < 1e-5, "{name}: {bone}");
            }
        }
    }
}

#[test]
fn limbs_have_our_directions_with_a_and_t_poses() {
    let skeleton = Skeleton::default();
    for (name, rows) in [("Mixamo", mixamo()), ("Unity", unity())] {
        let mut retarget = retarget(&bvh_text(&rows, ZYX), "");
        assert_eq!(retarget.target().convention().unwrap().name(), name);
        let worst = compare(name, &mut retarget, &skeleton);
        assert!(worst.limbs < 1.0 && worst.floor < 0.05, "{} {}", worst.limbs, worst.floor);
        // The rest pose faces the same way as ours.
        let figure = retarget.apply(&Pose::rest(), &skeleton).unwrap();
        let across = at(&retarget, &figure, Joint::LHip).unwrap()
            - at(&retarget, &figure, Joint::RHip).unwrap();
        assert!(degrees(&across, &Vector3::x()) < 0.1, "{across}");
        let toes = at(&retarget, &figure, Joint::LFoot).unwrap()
            - at(&retarget, &figure, Joint::LAnkle).unwrap();
        assert!(toes.z > 0.1, "{toes}");
    }
}

#[test]
fn turned_bodies_with_extra_joints_above_the_hips_and_in_the_limbs_are_mapped() {
    let skeleton = Skeleton::default();
    let mut rows: Vec<Row> = vec![(0, "Armature".into(), Vector3::new(3.0, 1.0, 2.0))];
    for (depth, name, at) in mixamo() {
        // Facing +x, with an extra joint halfway along each forearm.
        let at = Vector3::new(at.z, at.y, -at.x);
        if name.ends_with("Hand") {
            rows.push((depth + 1, format!("{name}Twist"), at / 2.0));
            rows.push((depth + 2, name, at / 2.0));
        } else if name.contains("HandIndex") {
            rows.push((depth + 2, name, at));
        } else {
            rows.push((depth + 1, name, at));
        }
    }
    let mut retarget = retarget(&bvh_text(&rows, ZYX), "");
    let worst = compare("turned", &mut retarget, &skeleton);
    assert!(worst.limbs < 1.0 && worst.floor < 0.05, "{} {}", worst.limbs, worst.floor);
    let summary = retarget.mapping().summary(retarget.target());
    assert!(summary.contains("l_wrist -> mixamorig:LeftHand"), "{summary}");
    assert!(summary.contains("not mapped: Armature"), "{summary}");
}

#[test]
fn feet_are_on_the_floor_too_if_the_legs_hang_from_the_spine() {
    let skeleton = Skeleton::default();
    // As in Biped: hips, spine, and the legs from the spine on.
    let spine = mixamo()[1].2;
    let is_of_leg = |name: &str| ["Leg", "Foot", "Toe"].iter().any(|part| name.contains(part));
    let (legs, mut rows): (Vec<Row>, Vec<Row>) =
        mixamo().into_iter().partition(|(_, name, _)| is_of_leg(name));
    let legs = legs.into_iter().map(|(depth, name, at)| match name.ends_with("UpLeg") {
        true => (depth + 1, name, at - spine),
        false => (depth + 1, name, at),
    });
    rows.splice(2..2, legs);
    let mut retarget = retarget(&bvh_text(&rows, ZYX), "");
    let worst = compare("legs from the spine", &mut retarget, &skeleton);
    assert!(worst.limbs < 1.0 && worst.floor < 0.05, "{} {}", worst.limbs, worst.floor);
    let mut bent = Pose::rest();
    for joint in [Joint::Spine1, Joint::Spine2] {
        bent.local[joint.index() - 1] = bundlemocap::core::so3::about(0, 0.4);
    }
    let [still, figure] =
        [Pose::rest(), bent].map(|pose| retarget.apply(&pose, &skeleton).unwrap());
    for ankle in [Joint::LAnkle, Joint::RAnkle] {
        let [still, bent] = [&still, &figure].map(|figure| at(&retarget, figure, ankle).unwrap());
        assert!((still - bent).norm() < 0.01, "{}", still - bent);
    }
    // The hips are those of our pelvis.
    let mut aside = Pose::rest();
    for joint in [Joint::Spine1, Joint::Spine2, Joint::Spine3] {
        aside.local[joint.index() - 1] = bundlemocap::core::so3::about(2, 0.3);
    }
    let aside = retarget.apply(&aside, &skeleton).unwrap();
    let hips = [Joint::LHip, Joint::RHip].map(|hip| at(&retarget, &aside, hip).unwrap());
    assert!(degrees(&(hips[0] - hips[1]), &Vector3::x()) < 0.1, "{hips:?}");
}

#[test]
fn spines_of_any_length_bend_like_ours() {
    let skeleton = Skeleton::default();
    let mut pose = Pose::rest();
    for joint in [Joint::Spine1, Joint::Spine2, Joint::Spine3] {
        let bend = nalgebra::Rotation3::from_axis_angle(&Vector3::x_axis(), 0.3);
        pose.local[joint.index() - 1] = bend.into_inner();
    }
    for count in [1, 2, 3, 5] {
        let mut rows: Vec<Row> = Vec::new();
        for (depth, name, at) in unity() {
            match name.as_str() {
                "Spine" => rows.extend(
                    (0..count).map(|k| (1 + k, format!("S{k}"), Vector3::new(0.0, 0.1, 0.0))),
                ),
                "Chest" | "UpperChest" => {}
                _ if depth >= 4 && !name.contains("Toes") => {
                    rows.push((depth + count - 3, name, at))
                }
                _ => rows.push((depth, name, at)),
            }
        }
        let mut retarget = retarget(&bvh_text(&rows, ZYX), "");
        let figure = retarget.apply(&pose, &skeleton).unwrap();
        let turn = |joint: usize| {
            let facing = Matrix3::from_diagonal(&Vector3::new(-1.0, 1.0, -1.0));
            bundlemocap::core::so3::log(&(figure.rotations[joint] * facing)).x
        };
        for k in 1..=count {
            let expected = 0.9 * k as f64 / count as f64;
            assert!((turn(k) - expected).abs() < 1e-9, "{count}: {k} {} {expected}", turn(k));
        }
        assert_eq!(retarget.mapping().joint(Joint::Spine3), Some(count));
    }
}

#[test]
fn every_naming_convention_is_recognised() {
    let expect = |names: [&str; 15], convention: &str| {
        let [hips, spine, neck, head, arm_parts @ ..] = names;
        let [collar, arm, fore, hand, up, low, foot, toes, left, right, form] = arm_parts;
        let side = |name: &str| form.replace('*', left).replace('@', name);
        let rows: Vec<(usize, String, [f64; 3])> = vec![
            (0, form_middle(form, hips), [0.0, 0.0, 0.0]),
            (1, form_middle(form, spine), [0.0, 20.0, 0.0]),
            (2, form_middle(form, neck), [0.0, 30.0, 0.0]),
            (3, form_middle(form, head), [0.0, 10.0, 0.0]),
            (2, side(collar), [5.0, 20.0, 0.0]),
            (3, side(arm), [12.0, 0.0, 0.0]),
            (4, side(fore), [28.0, 0.0, 0.0]),
            (5, side(hand), [26.0, 0.0, 0.0]),
            (1, side(up), [9.0, -8.0, 0.0]),
            (2, side(low), [0.0, -41.0, 0.0]),
            (3, side(foot), [0.0, -42.0, 0.0]),
            (4, side(toes), [0.0, -6.0, 12.0]),
        ];
        let plain: Vec<(usize, &str, [f64; 3])> =
            rows.iter().map(|(depth, name, at)| (*depth, name.as_str(), *at)).collect();
        let from = form.replace('*', left);
        let from: Vec<&str> = from.split('@').collect();
        let mirrored = |name: &str| {
            let bare = name.strip_prefix(from[0])?.strip_suffix(from[1])?;
            let known = [collar, arm, fore, hand, up, low, foot, toes].contains(&bare);
            known.then(|| form.replace('*', right).replace('@', bare))
        };
        let rows = symmetric(&plain, mirrored);
        let retarget = retarget(&bvh_text(&rows, ZYX), "");
        assert_eq!(retarget.target().convention().map(Convention::name), Some(convention));
        let mapped = Joint::ALL.iter().filter(|&&joint| retarget.mapping().joint(joint).is_some());
        assert_eq!(mapped.count(), JOINTS - 2, "{convention}: all joints except two of the spine");
        for (ours, name) in [(Joint::RElbow, fore), (Joint::RAnkle, foot), (Joint::RCollar, collar)]
        {
            let theirs = retarget.mapping().joint(ours).unwrap();
            let expected = form.replace('*', right).replace('@', name);
            assert_eq!(retarget.target().joints()[theirs].name, expected);
        }
    };
    let (upper, lower) = ("Left", "Right");
    let motion_builder = |form| {
        [
            "Hips", "Spine", "Neck", "Head", "Shoulder", "Arm", "ForeArm", "Hand", "UpLeg", "Leg",
            "Foot", "ToeBase", upper, lower, form,
        ]
    };
    expect(motion_builder("mixamorig:*@"), "Mixamo");
    expect(motion_builder("*@"), "MotionBuilder");
    expect(motion_builder("Character1_*@"), "MotionBuilder");
    let mut cmu = motion_builder("*@");
    cmu[1] = "LowerBack";
    expect(cmu, "CMU");
    let unity = [
        "Hips", "Chest", "Neck", "Head", "Shoulder", "UpperArm", "LowerArm", "Hand", "UpperLeg",
        "LowerLeg", "Foot", "Toes", upper, lower, "*@",
    ];
    expect(unity, "Unity");
    let ours = [
        "pelvis", "spine1", "neck", "head", "collar", "shoulder", "elbow", "wrist", "hip", "knee",
        "ankle", "foot", "l", "r", "*_@",
    ];
    expect(ours, "bundlemocap");
    let daz = [
        "hip", "abdomen", "neck", "head", "Collar", "Shldr", "ForeArm", "Hand", "Thigh", "Shin",
        "Foot", "Toe", "l", "r", "*@",
    ];
    expect(daz, "Daz");
    let anatomical = [
        "Hips", "Chest", "Neck", "Head", "Collar", "Shoulder", "Elbow", "Wrist", "Hip", "Knee",
        "Ankle", "Toe", upper, lower, "*@",
    ];
    expect(anatomical, "anatomical");
    let unreal = [
        "pelvis", "spine_01", "neck_01", "head", "clavicle", "upperarm", "lowerarm", "hand",
        "thigh", "calf", "foot", "ball", "l", "r", "@_*",
    ];
    expect(unreal, "Unreal");
    let biped = [
        "Pelvis",
        "Spine",
        "Neck",
        "Head",
        "Clavicle",
        "UpperArm",
        "Forearm",
        "Hand",
        "Thigh",
        "Calf",
        "Foot",
        "Toe0",
        "L",
        "R",
        "Bip01_*_@",
    ];
    expect(biped, "Biped");
}

/// A joint on the midline, with the prefix of a form.
fn form_middle(form: &str, name: &str) -> String {
    let prefix = form.split(['*', '@']).next().unwrap();
    format!("{prefix}{name}")
}

#[test]
fn a_map_names_joints_scale_and_unit() {
    let strange: Vec<Row> = mixamo()
        .into_iter()
        .map(|(depth, name, at)| (depth, name.replace("LeftLeg", "Kneecap"), at))
        .collect();
    let text = bvh_text(&strange, ZYX);
    let missing = try_retarget(&text, "").unwrap_err();
    assert!(
        missing.starts_with("target.bvh: no joint found for l_knee; name them in a --map file")
            && missing.contains("l_knee = \"...\"")
            && missing.contains("mixamorig:Kneecap"),
        "{missing}"
    );
    let map = "scale = 2.0\nunit = \"inch\"\n[joints]\nleft_knee = \"mixamorig:Kneecap\"\n\
               spine2 = \"mixamorig:Spine2\"\nhead = \"\"\n";
    let mut retarget = retarget(&text, map);
    let skeleton = Skeleton::default();
    assert_eq!((retarget.scale(&skeleton), retarget.target().unit()), (2.0, 0.0254));
    let mapping = retarget.mapping();
    assert_eq!(mapping.joint(Joint::Head), None);
    let name = |joint| retarget.target().joints()[mapping.joint(joint).unwrap()].name.clone();
    assert_eq!(name(Joint::Spine2), "mixamorig:Spine2");
    assert_eq!(name(Joint::Neck), "mixamorig:Neck");
    let mut pose = Pose::rest();
    let before = retarget.apply(&pose, &skeleton).unwrap();
    pose.root_position.x += 1.0;
    let after = retarget.apply(&pose, &skeleton).unwrap();
    let moved = after.positions[0] - before.positions[0];
    assert!((moved - Vector3::new(2.0, 0.0, 0.0)).norm() < 1e-12, "{moved}");
    let worst = compare("scale", &mut retarget, &skeleton);
    assert!(worst.limbs < 1.0 && worst.floor < 0.05, "{} {}", worst.limbs, worst.floor);
}

#[test]
fn errors_in_maps_and_skeletons_name_the_key_and_the_fix() {
    let text = bvh_text(&mixamo(), ZYX);
    let wrong = |map: &str| try_retarget(&text, map).unwrap_err();
    let short = |error: String| match error.split_once("it has mixamorig:Hips, mixamorig:Spine, ") {
        Some((start, _)) => format!("{start}it has mixamorig:Hips, ..."),
        None => error,
    };
    let legless: Vec<Row> =
        mixamo().into_iter().filter(|row| !row.1.contains("Leg") || row.1.contains("Up")).collect();
    let legless: Vec<Row> = (legless.into_iter())
        .map(|(depth, name, at)| {
            let below = name.contains("Foot") || name.contains("Toe");
            (if below { depth - 1 } else { depth }, name, at)
        })
        .collect();
    let legless = try_retarget(&bvh_text(&legless, ZYX), "").unwrap_err();
    let flat: Vec<Row> = mixamo().into_iter().map(|(d, n, _)| (d, n, Vector3::zeros())).collect();
    let messages = [
        wrong("scale = 1.0\nscael = 2.0"),
        wrong("[joints]\nl_knee = 3"),
        wrong("scale = -1.0"),
        wrong("unit = \"parsec\""),
        wrong("unit = 0"),
        wrong("up = \"x\""),
        wrong("[joints]\nkneecap = \"mixamorig:LeftLeg\"\n"),
        short(wrong("[joints]\nl_knee = \"LeftKnee\"")),
        wrong("[joints]\nl_knee = \"mixamorig:RightLeg\""),
        wrong("[joints]\nl_wrist = \"mixamorig:LeftForeArm\""),
        wrong("[joints]\nspine2 = \"mixamorig:Spine2\"\nspine1 = \"mixamorig:Spine2\""),
        wrong("[joints]\nspine3 = \"mixamorig:HeadTop_End\""),
        wrong("[joints]\nspine1 = \"mixamorig:Spine1\"\nspine2 = \"mixamorig:Spine\""),
        wrong("[joints]\nspine1 = \"mixamorig:LeftHandIndex1\""),
        wrong("[joints]\nr_foot = \"mixamorig:LeftToe_End\""),
        legless.split("; the skeleton").next().unwrap().to_owned(),
        try_retarget(&bvh_text(&flat, ZYX), "").unwrap_err(),
    ];
    expect![[r#"
    map.toml, line 2: unknown field `scael`, expected one of `scale`, `unit`, `up`, `joints`; a map has `scale`, `unit`, `up` and a table [joints]
    map.toml, line 2: invalid type: integer `3`, expected a string; a map has `scale`, `unit`, `up` and a table [joints]
    map.toml: scale is -1, but must be a number above 0
    map.toml: unit is "parsec", but must be m, dm, cm, mm, inch, foot, or a number of metres above 0
    map.toml: unit is 0, but must be m, dm, cm, mm, inch, foot, or a number of metres above 0
    map.toml, line 1: unknown variant `x`, expected `y` or `z`; a map has `scale`, `unit`, `up` and a table [joints]
    map.toml: joints.kneecap is not one of our joints; use one of pelvis, l_hip, r_hip, spine1, l_knee, r_knee, spine2, l_ankle, r_ankle, spine3, l_foot, r_foot, neck, l_collar, r_collar, head, l_shoulder, r_shoulder, l_elbow, r_elbow, l_wrist, r_wrist
    map.toml: joints.l_knee = "LeftKnee", but target.bvh has no such joint; it has mixamorig:Hips, ...
    target.bvh: mixamorig:RightLeg is mapped to both l_knee and r_knee; change one with --map
    target.bvh: mixamorig:LeftForeArm is mapped to both l_elbow and l_wrist; change one with --map
    target.bvh: mixamorig:Spine2 is mapped to both spine1 and spine2; change one with --map
    target.bvh: mixamorig:LeftArm (l_shoulder) must be below mixamorig:HeadTop_End (spine3) in the hierarchy; name other joints with --map
    target.bvh: mixamorig:Spine (spine2) must be below mixamorig:Spine1 (spine1) in the hierarchy; name other joints with --map
    target.bvh: mixamorig:LeftHandIndex1 (spine1) must be below mixamorig:Hips (pelvis) in the hierarchy; name other joints with --map
    target.bvh: mixamorig:LeftToe_End (r_foot) must be below mixamorig:RightFoot (r_ankle) in the hierarchy; name other joints with --map
    target.bvh: no joint found for l_knee, r_knee; name them in a --map file, for example [joints] l_knee = "..."
    target.bvh: its legs have no length; the skeleton cannot be used"#]]
    .assert_eq(&messages.join("\n"));
}

#[test]
fn hinge_knees_keep_their_axis_and_the_feet_are_corrected() {
    let skeleton = Skeleton::default();
    let text = bvh_text(&mixamo(), ZYX);
    let joint = text.find("mixamorig:LeftLeg ").unwrap();
    let (start, rest) = text.split_at(joint);
    let text = format!("{start}{}", rest.replacen(&format!("3 {ZYX}"), "1 Xrotation", 1));
    let mut retarget = retarget(&text, "");
    let worst = compare("hinge knee", &mut retarget, &skeleton);
    assert!(worst.limbs < 20.0, "{}", worst.limbs);
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("hinge.bvh");
    let poses = poses(&skeleton);
    write(&path, &mut retarget, &skeleton, &poses);
    let back = Bvh::parse(&std::fs::read_to_string(&path).unwrap()).unwrap();
    let foot = retarget.mapping().joint(Joint::LAnkle).unwrap();
    for (frame, pose) in poses.iter().enumerate() {
        let figure = retarget.apply(pose, &skeleton).unwrap();
        let (rotation, _) = back.posture(frame).unwrap()[foot];
        assert!((rotation - figure.rotations[foot]).amax() < 1e-6);
    }
}

fn run(folder: &Path, line: &str) -> Output {
    let program = Command::new(env!("CARGO_BIN_EXE_bundlemocap"))
        .args(line.split_whitespace())
        .current_dir(folder)
        .output();
    program.unwrap()
}

/// A solved recording of poses at 30 Hz; poses 11 to 13 are missing.
fn recording(path: &Path, skeleton: &Skeleton, poses: &[Pose]) {
    let mut writer = Writer::create(path, Topics::default(), &Provenance::default()).unwrap();
    writer.skeleton(skeleton, Timestamp::default()).unwrap();
    for (index, pose) in poses.iter().enumerate().filter(|(index, _)| !(10..13).contains(index)) {
        writer.pose(&stamped(index, pose), skeleton).unwrap();
    }
    writer.finish().unwrap();
}

fn stamped(index: usize, pose: &Pose) -> StampedPose {
    let capture = Timestamp::from_ns(index as i64 * 33_333_333);
    StampedPose::new(capture, pose.clone(), TrackingState::Tracking)
}

#[test]
fn the_program_retargets_a_recording() {
    let folder = tempfile::tempdir().unwrap();
    let (skeleton, at) = (shaped(), |name: &str| folder.path().join(name));
    let poses = poses(&skeleton);
    recording(&at("poses.mcap"), &skeleton, &poses);
    std::fs::write(at("robot.bvh"), bvh_text(&mixamo(), ZYX)).unwrap();
    let output = run(folder.path(), "retarget --skeleton robot.bvh --from poses.mcap --out a.bvh");
    let errors = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(0), "{errors}");
    assert_eq!(errors.lines().count(), 1, "{errors}");
    let start = "robot.bvh: Mixamo names, 27 joints, unit 0.01 m: pelvis -> mixamorig:Hips, ";
    assert!(errors.starts_with(start), "{errors}");
    let said = String::from_utf8(output.stdout).unwrap();
    assert!(said.starts_with("a.bvh: 390 frames at 30.00 Hz"), "{said}");
    let back = Bvh::parse(&std::fs::read_to_string(at("a.bvh")).unwrap()).unwrap();
    assert_eq!(back.frames(), 390);
    let mut retarget = retarget(&bvh_text(&mixamo(), ZYX), "");
    for (frame, shown) in [(5, 5), (11, 9), (12, 9), (200, 200)] {
        let figure = retarget.apply(&poses[shown], &skeleton).unwrap();
        for (at, (_, position)) in figure.positions.iter().zip(back.posture(frame).unwrap()) {
            assert!((at - position * 0.01).norm() < 1e-5, "frame {frame}");
        }
    }

    let part = "retarget --skeleton robot.bvh --from poses.mcap --out part.bvh --start 60f --end 120f --fps 15 \
                --lost mark";
    let output = run(folder.path(), part);
    assert_eq!(output.status.code(), Some(0), "{}", String::from_utf8_lossy(&output.stderr));
    let part = Bvh::parse(&std::fs::read_to_string(at("part.bvh")).unwrap()).unwrap();
    assert_eq!(part.frames(), 31);
    for frame in [0, 11, 30] {
        let both =
            part.posture(frame).unwrap().into_iter().zip(back.posture(60 + 2 * frame).unwrap());
        for ((_, part), (_, whole)) in both {
            assert!((part - whole).norm() < 1e-3, "frame {frame}: {part} {whole}");
        }
    }
    let states = std::fs::read_to_string(at("part.states.csv")).unwrap();
    assert_eq!(states, "first_frame,last_frame,state\n0,30,tracking\n");
    let live = run(folder.path(), "retarget --skeleton robot.bvh --start 1");
    assert_eq!(live.status.code(), Some(2));
    assert!(String::from_utf8_lossy(&live.stderr).contains("--from poses.mcap"));
}

#[test]
fn unusable_input_gives_a_one_line_error() {
    let folder = tempfile::tempdir().unwrap();
    let write = |name: &str, text: &str| std::fs::write(folder.path().join(name), text).unwrap();
    write("robot.bvh", &bvh_text(&mixamo(), ZYX));
    write("cut.bvh", &bvh_text(&mixamo(), ZYX)[..300]);
    write("bad.toml", "[joints]\nl_knee = \"Knee\"\n");
    recording(&folder.path().join("empty.mcap"), &Skeleton::default(), &[]);
    let fails = |code: i32, line: &str, evidence: &str| {
        let output = run(folder.path(), &format!("retarget --out a.bvh {line}"));
        let errors = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(code), "{line}: {errors}");
        let last = errors.lines().last().unwrap();
        assert!(last.starts_with("error: ") && last.contains(evidence), "{line}: {errors}");
        assert!(!folder.path().join("a.bvh").exists());
    };
    fails(3, "--from empty.mcap --skeleton absent.bvh", "absent.bvh");
    fails(4, "--from empty.mcap --skeleton cut.bvh", "cut.bvh: ");
    fails(4, "--from empty.mcap --skeleton robot.bvh --map bad.toml", "bad.toml: joints.l_knee");
    fails(3, "--from empty.mcap --skeleton robot.bvh --map absent.toml", "absent.toml");
    fails(3, "--from absent.mcap --skeleton robot.bvh", "absent.mcap");
    fails(12, "--from empty.mcap --skeleton robot.bvh", "holds no poses");
    fails(2, "--skeleton robot.bvh --name a/b", "--name");

    let onto_itself = "retarget --from empty.mcap --skeleton robot.bvh --out ./robot.bvh";
    assert_eq!(run(folder.path(), onto_itself).status.code(), Some(2));
    let robot = std::fs::read_to_string(folder.path().join("robot.bvh")).unwrap();
    assert_eq!(robot, bvh_text(&mixamo(), ZYX));
}

#[test]
fn live_poses_are_retargeted_and_written_at_the_end() {
    let listen = vec!["tcp/127.0.0.1:0".into()];
    let bus = Zenoh::open_node(&ZenohConfig { listen, ..ZenohConfig::default() }).unwrap();
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("my robot.bvh"), bvh_text(&unity(), ZYX)).unwrap();
    let (skeleton, topics) = (Skeleton::default(), Topics::default());
    let (sender, came) = crossbeam_channel::unbounded();
    let sink = Box::new(move |sample: Sample| drop(sender.send(sample)));
    let _guard = bus.subscribe(&topics.retargeted("my_robot"), sink).unwrap();
    let put = |topic: &str, capture: Timestamp, payload: &[u8]| {
        bus.publisher(topic).unwrap().put(capture, "", payload).unwrap();
    };
    // Late joiners receive it as long as its publisher lives.
    let body = bus.publisher(&topics.skeleton()).unwrap();
    let wire = encode(&wire::Skeleton::from_core(&skeleton));
    body.put(Timestamp::default(), "", &wire).unwrap();

    let mut command = Command::new(env!("CARGO_BIN_EXE_bundlemocap"));
    command.args(["retarget", "--skeleton", "my robot.bvh", "--out", "take.bvh", "--connect"]);
    command.arg(&bus.listens_on()[0]).current_dir(folder.path());
    let mut live = Program::start(&mut command);
    assert!(live.has_said("retargeted/my_robot; stop with Ctrl-C"));
    // The skeleton may arrive after the first pose: repeat the pose until there is a result.
    let poses = poses(&skeleton);
    let payload = |index: usize| {
        encode(&wire::Pose::from_core(&stamped(index, &poses[index]), &skeleton, None))
    };
    let begin = Instant::now();
    let first = loop {
        put(&topics.pose(), Timestamp::default(), &payload(0));
        if let Ok(sample) = came.recv_timeout(Duration::from_millis(200)) {
            break sample;
        }
        assert!(begin.elapsed() < Duration::from_secs(60), "no pose came back");
    };
    let mut retarget = retarget(&bvh_text(&unity(), ZYX), "");
    let expected = |retarget: &mut Retarget, index: usize| {
        let wire = wire::Pose::from_core(&stamped(index, &poses[index]), &skeleton, None);
        let figure = retarget.apply(&wire.to_core().unwrap().pose, &skeleton).unwrap();
        encode(&figure.message(&wire, retarget.target()))
    };
    assert!(first.payload == expected(&mut retarget, 0));
    for (index, pose) in poses.iter().enumerate().take(30).skip(1) {
        put(&topics.pose(), stamped(index, pose).capture, &payload(index));
    }
    // Streams may lose a sample: repeat the last pose until there is a result.
    let mut last = first;
    while last.capture != stamped(29, &poses[29]).capture {
        assert!(begin.elapsed() < Duration::from_secs(120), "the last pose did not come back");
        match came.recv_timeout(Duration::from_millis(200)) {
            Ok(sample) => last = sample,
            Err(_) => put(&topics.pose(), Timestamp::default(), &payload(29)),
        }
    }
    assert!(last.payload == expected(&mut retarget, 29));
    // The file of an earlier performer is not replaced.
    std::fs::write(folder.path().join("other.p1.bvh"), "").unwrap();
    std::fs::copy(folder.path().join("my robot.bvh"), folder.path().join("my.bvh")).unwrap();
    let output = run(folder.path(), "retarget --skeleton my.bvh --out other.bvh");
    let said = String::from_utf8(output.stderr).unwrap();
    assert!(said.contains("other.p1.bvh exists"), "{said}");
    live.interrupted(0);
    let text = std::fs::read_to_string(folder.path().join("take.bvh")).unwrap();
    let back = Bvh::parse(&text).unwrap();
    assert!(back.frames() == 30 && (back.frame_time() - 1.0 / 30.0).abs() < 1e-6);
}

/// Folder of the motion clips, if the data is available.
fn corpus() -> Option<PathBuf> {
    data("motions/cmu")
}

#[test]
fn limbs_have_our_directions_on_the_skeletons_of_cmu() {
    let Some(folder) = corpus() else { return };
    let files = [("act_train_walking_24.bvh", "CMU"), ("07_01.bvh", "Daz")];
    for (file, convention) in files {
        let map = Map::default();
        let target = Target::read(&folder.join(file), &map).unwrap();
        let mut retarget = Retarget::new(target, &map).unwrap();
        assert_eq!(retarget.target().convention().map(Convention::name), Some(convention));
        for skeleton in [Skeleton::default(), shaped()] {
            let worst = compare(file, &mut retarget, &skeleton);
            assert!(worst.limbs < 1.0 && worst.floor < 0.05, "{} {}", worst.limbs, worst.floor);
        }
    }
}

#[test]
fn a_captured_walk_is_retargeted_to_every_skeleton() {
    let Some(corpus) = corpus() else { return };
    let folder = tempfile::tempdir().unwrap();
    let file = "act_train_walking_24.bvh";
    std::fs::copy(corpus.join(file), folder.path().join(file)).unwrap();
    let clip = read_folder(folder.path()).unwrap().remove(0);
    let poses = clip.poses.iter().map(|numbers| {
        let mut pose = Pose::rest();
        pose.root_position.y = 0.95;
        for (local, six) in pose.local.iter_mut().zip(numbers.chunks_exact(6)) {
            let [a, b] = [0, 3].map(|at| Vector3::from_fn(|row, _| f64::from(six[at + row])));
            *local = Matrix3::from_columns(&[a, b, a.cross(&b)]);
        }
        pose
    });
    let poses: Vec<Pose> = poses.collect();
    let skeleton = Skeleton::default();
    let read = |name: &str| std::fs::read_to_string(corpus.join(name)).unwrap();
    let targets = [
        ("walk on CMU", read(file)),
        ("walk on Daz", read("07_01.bvh")),
        ("walk on Mixamo", bvh_text(&mixamo(), ZYX)),
        ("walk on Unity", bvh_text(&unity(), ZYX)),
    ];
    for (name, text) in targets {
        let worst = compare_poses(name, &mut retarget(&text, ""), &skeleton, &poses);
        assert!(worst.limbs < 1.0 && worst.floor < 0.05, "{} {}", worst.limbs, worst.floor);
    }
}

/// Draws our body and the target side by side.
fn picture(name: &str, retarget: &mut Retarget, skeleton: &Skeleton, poses: &[Pose]) -> String {
    let mut postures: Vec<(Posture, String)> = Vec::new();
    for (index, pose) in poses.iter().enumerate().filter(|(i, _)| i % 50 == 8) {
        let figure = retarget.apply(pose, skeleton).unwrap();
        let mut theirs = pose.posture(skeleton);
        postures.push((theirs.clone(), format!("ours {index}")));
        for joint in Joint::ALL {
            let parent = joint.parent().map_or(0, Joint::index);
            let place = at(retarget, &figure, joint).unwrap_or(theirs.positions[parent]);
            theirs.positions[joint.index()] = place;
        }
        postures.push((theirs, name.to_owned()));
    }
    let drawn = postures.iter().map(|(posture, caption)| (posture, caption.as_str()));
    stick_figures(drawn, &StickFigures::default())
}

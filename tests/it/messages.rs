//! Wire types: round trips, byte goldens, unknown fields, hostile bytes.

use bundlemocap::core::body::{
    self, BODY_JOINTS, Joint, KeypointOffsets, SYMMETRIC_SHAPE, Shape, StampedPose, TrackingState,
};
use bundlemocap::core::camera::{self, Camera, Lens};
use bundlemocap::core::detections::{Detection, Detections, KeypointFormat, Person};
use bundlemocap::core::manifold;
use bundlemocap::core::so3;
use bundlemocap::core::time::{Grid, Nanos, Timestamp};
use bundlemocap::io::wire::journal_entry::Input;
use bundlemocap::io::wire::{
    CameraCounters, DecodeError, Event, HandOver, Journal, JournalDropped, JournalEntry,
    JournalLoss, JournalMessage, JournalPerformer, JournalPlayed, JournalSolved, JournalSolvers,
    JournalStart, Keyframe, KeypointFrame, KeypointSet, LiveStamp, PerformerLabel, Pose,
    RetargetedPose, Rig, Schema, Skeleton, StagePerformer, StageStatus, Status, Take, TakeAnswer,
    WindowCounters, decode, encode,
};
use expect_test::{expect, expect_file};
use nalgebra::{Matrix3, Point2, Vector3};
use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

pub fn detections() -> Detections {
    let point = |i: usize| {
        (i % 5 != 3).then(|| Detection {
            pixel: Point2::new(100.0 + i as f64, 200.5 - i as f64),
            confidence: 0.25 + i as f64 / 64.0,
        })
    };
    let person =
        |id, missing: usize| Person { id, points: (missing..missing + 17).map(point).collect() };
    Detections {
        camera: 1,
        frame: 7,
        capture: Timestamp::from_ns(1_234_567_890),
        format: KeypointFormat::Coco17,
        people: vec![person(Some(-3), 0), person(None, 2)],
    }
}

pub fn rig() -> camera::Rig {
    let matrix = Matrix3::new(900.0, 0.5, 640.0, 0.0, 910.0, 360.0, 0.0, 0.0, 1.0);
    let camera = |name: &str, lens, turn: f64| {
        let rotation = so3::exp(&Vector3::new(0.1, turn, -0.2));
        let translation = Vector3::new(0.5, -1.0, 4.0);
        Camera::new(name, [1280, 720], &matrix, lens, rotation, translation).unwrap()
    };
    let lens = Lens::brown_conrady(&[-0.1, 0.02, 0.001, -0.002, 0.003]).unwrap();
    let fisheye = Lens::fisheye(&[0.01, -0.02, 0.03, -0.04]).unwrap();
    camera::Rig::new(3, vec![camera("left", lens, 0.4), camera("right", fisheye, -2.9)]).unwrap()
}

pub fn skeleton() -> body::Skeleton {
    body::Skeleton::new(Shape::symmetric(std::array::from_fn(|i| 0.5 - 0.1 * i as f64)))
}

pub fn stamped_pose(window: u64) -> StampedPose {
    let turn = |i: usize| so3::exp(&Vector3::new(0.02 * i as f64, -0.5, 0.03 * window as f64));
    StampedPose {
        capture: Timestamp::from_ns(5_000_000_000 + 100_000_000 * window as i64),
        pose: body::Pose {
            root_rotation: turn(40),
            root_position: Vector3::new(0.25, 0.9, -1.5),
            local: std::array::from_fn::<_, BODY_JOINTS, _>(turn),
        },
        state: TrackingState::Coasting,
        window,
        rig_version: 3,
        provisional: true,
        revision: 2,
        // Powers of two are not rounded.
        deviations: Some(std::array::from_fn(|joint| (joint + 1) as f64 / 1024.0)),
    }
}

pub const WEIGHTS: &str = "0123456789abcdef";

pub fn keyframe() -> manifold::StampedKeyframe {
    manifold::StampedKeyframe {
        capture: Timestamp::from_ns(8_000_000_000),
        window: 12,
        keyframe: manifold::Keyframe {
            z: std::array::from_fn(|i| (i as f64 - 16.0) / 8.0),
            root_rotation: so3::exp(&Vector3::new(0.0, 3.0, 0.5)),
            root_position: Vector3::new(1.0, 0.875, -0.5),
            correction: Default::default(),
        },
        shape: *skeleton().shape(),
        start: Timestamp::from_ns(7_833_333_333),
        interpolation: manifold::Interpolation::Slerp,
        grid: Grid { origin: Timestamp::from_ns(3_000_000_000), period_ns: 1e9 / 60.0 },
        state: TrackingState::Tracking,
        rig_version: 3,
    }
}

pub fn event() -> Event {
    Event {
        capture_time_ns: 17,
        kind: "late".into(),
        camera: Some("left".into()),
        window: Some(0),
        count: 2,
        detail: "31 ms after the deadline".into(),
        run_id: 0,
    }
}

fn status() -> Status {
    let camera = CameraCounters {
        camera: "left".into(),
        used: 100,
        late: 1,
        duplicate: 2,
        out_of_order: 3,
        missing: 4,
        ..CameraCounters::default()
    };
    Status {
        capture_time_ns: 9_000_000_000,
        cameras: vec![camera],
        windows: Some(WindowCounters {
            tracked: 10,
            coasted: 1,
            lost: 2,
            incomplete: 3,
            ..WindowCounters::default()
        }),
        ..Status::default()
    }
}

pub fn retargeted() -> RetargetedPose {
    RetargetedPose {
        capture_time_ns: 5_000_000_000,
        due_time_ns: Some(5_250_000_000),
        run_id: 0x0123_4567_89ab_cdef,
        state: published_pose().state,
        hips: 1,
        hips_position_m: vec![0.25, 0.9, -1.5],
        local_rotations: vec![0.0, 0.0, 0.0, 1.0, 0.5, -0.5, 0.5, 0.5],
        joint_names: vec!["Armature".into(), "Hips".into()],
        timecode: "01:00:00:05".into(),
    }
}

fn label() -> PerformerLabel {
    PerformerLabel { display_name: "Lead".into(), colour: "#0072b2".into(), locked: true }
}

fn known() -> JournalPerformer {
    JournalPerformer {
        number: 1,
        body: Some(vec![1, 2, 3]),
        seen_ns: 8_000_000_000,
        points_m: vec![0.5, 1.0, -0.25],
        lengths_m: vec![0.375, 12.0],
        name: "lead".into(),
        dropped: true,
        offsets_are_known: true,
    }
}

fn journal() -> Journal {
    let start = JournalStart {
        version: "0.1.0".into(),
        config: "[node]".into(),
        weights: WEIGHTS.into(),
        platform: "x86_64-linux".into(),
        rig: Some(vec![4, 5]),
        run_id: 0x0123_4567_89ab_cdef,
        body: Some(vec![6]),
        take: "walk".into(),
        latency_ns: 250_000_000,
        time_offsets_ns: vec![0, -3_000_000],
        performers: vec![known()],
        left_out: vec![2],
        labels: vec![label()],
        usual_px: vec![3.5],
        verdicts: vec!["turned by 3 degrees".into()],
        verdict: "in millimetres".into(),
        solvers: vec!["solver1".into()],
        offsets_are_known: true,
        solve_ns: 2_000_000,
    };
    let payload = Some(vec![7, 8]);
    let message = JournalMessage { topic: "mocap/stage/rig".into(), hash: 9, payload };
    let loss = JournalLoss { camera: "left".into(), dropped: 1, too_large: 2, bytes: 3 };
    let inputs = [
        Input::Start(start),
        Input::Message(message),
        Input::Solved(JournalSolved { job: 4, took_ns: 1_500_000, performer: 1 }),
        Input::Tick(true),
        Input::Played(JournalPlayed { deviation_us: vec![-12, 40] }),
        Input::Dropped(JournalDropped { losses: vec![loss] }),
        Input::Solvers(JournalSolvers { names: vec!["solver1".into()] }),
        Input::End(true),
    ];
    let entries = inputs.into_iter().zip(1..);
    let entry = |(input, time_ns)| JournalEntry { time_ns, input: Some(input) };
    Journal { sequence: 3, entries: entries.map(entry).collect(), run_id: 0x0123_4567_89ab_cdef }
}

fn take() -> Take {
    Take {
        id: 5,
        action: "label".into(),
        name: "p3".into(),
        note: "again".into(),
        mark: "good".into(),
        display_name: "Lead".into(),
        colour: "#0072b2".into(),
        new_name: "lead".into(),
        place_m: vec![1.0, -0.5],
        offset_ms: -20.0,
    }
}

fn take_answer() -> TakeAnswer {
    let (role, text) = ("recorder".into(), "recording to walk.mcap".into());
    TakeAnswer { id: 5, role, text, refused: true, free_bytes: 1 << 30 }
}

fn stage_status() -> StageStatus {
    let performer = StagePerformer {
        name: "lead".into(),
        life: "coasting".into(),
        tracker_state: "tracking".into(),
        solver: "solver1".into(),
        place_m: vec![1.0, -0.5],
        unseen_s: 0.25,
        views: 4,
        residual_px: 3.5,
        label: Some(label()),
    };
    StageStatus {
        capture_time_ns: 9_000_000_000,
        node_time_ns: 9_100_000_000,
        run_id: 0x0123_4567_89ab_cdef,
        node: "actor".into(),
        performers: vec![performer],
        tentative: 1,
        others: 2,
        places: 8,
        known: vec![known()],
    }
}

fn keypoint_set() -> KeypointSet {
    KeypointSet {
        performer: 1,
        frames: vec![keypoints()],
        complete_ns: 1_240_000_000,
        returns: true,
        run_id: 0x0123_4567_89ab_cdef,
        enters: true,
        number: 77,
        label: Some(label()),
        rig_hash: 11,
    }
}

fn keypoints() -> KeypointFrame {
    KeypointFrame::from_core(&detections(), "right", [1280, 720])
}

fn published_pose() -> Pose {
    let due = Some(Timestamp::from_ns(-1));
    let live = LiveStamp { due, latency: Nanos::from_ms(250), run_id: 0x0123_4567_89ab_cdef };
    Pose::from_core(&stamped_pose(4), &skeleton(), Some(live))
}

fn through_bytes<T: Schema>(message: &T) -> T {
    decode(&encode(message)).unwrap()
}

#[test]
fn keypoints_round_trip() {
    let frame = through_bytes(&keypoints());
    let index_of = |name: &str| rig().index_of(name);
    assert_eq!(frame.to_core(index_of).unwrap(), detections());
    assert_eq!((frame.image_width, frame.image_height), (1280, 720));
}

#[test]
fn a_rig_round_trips() {
    let (back, rig) = (through_bytes(&Rig::from_core(&rig())).to_core().unwrap(), rig());
    assert_eq!((back.version, back.cameras.len()), (rig.version, 2));
    for (a, b) in back.cameras.iter().zip(&rig.cameras) {
        assert_eq!((&a.name, a.matrix(), a.lens()), (&b.name, b.matrix(), b.lens()));
        assert_eq!((a.width, a.height, a.translation), (b.width, b.height, b.translation));
        assert!((a.rotation - b.rotation).amax() < 1e-14);
    }
}

#[test]
fn a_pose_round_trips_and_carries_its_joints() {
    let (wire, pose) = (through_bytes(&published_pose()), stamped_pose(4));
    let back = wire.to_core().unwrap();
    for (a, b) in back.pose.local.iter().zip(&pose.pose.local) {
        assert!((a - b).amax() < 1e-6);
    }
    assert!((back.pose.root_rotation - pose.pose.root_rotation).amax() < 1e-14);
    let stamps = StampedPose { pose: pose.pose.clone(), ..back.clone() };
    assert_eq!(stamps, pose);
    assert_eq!(back.pose.root_position, pose.pose.root_position);
    let joints = pose.pose.posture(&skeleton()).positions;
    for (a, b) in wire.joint_positions().unwrap().iter().zip(joints) {
        assert!((a - b).norm() < 1e-6);
    }
    assert_eq!((wire.due_time_ns, wire.declared_latency_ns), (Some(-1), 250_000_000));
    assert_eq!(wire.run_id, 0x0123_4567_89ab_cdef);
}

#[test]
fn standard_deviations_are_all_there_or_none() {
    let with = |deviations: Vec<f32>| Pose { joint_deviations_m: deviations, ..published_pose() };
    assert_eq!(with(Vec::new()).to_core().unwrap().deviations, None);
    for (wrong, why) in
        [(vec![0.1; 21], "21"), (vec![-0.1; 22], "negative"), (vec![f32::NAN; 22], "finite")]
    {
        let error = with(wrong).to_core().unwrap_err().to_string();
        assert!(error.contains("joint_deviations_m") && error.contains(why), "{error}");
    }
}

#[test]
fn a_keyframe_and_a_skeleton_round_trip() {
    let back = through_bytes(&Keyframe::from_core(&keyframe(), WEIGHTS)).to_core().unwrap();
    assert_eq!((back.keyframe.z, back.shape), (keyframe().keyframe.z, keyframe().shape));
    assert_eq!((back.capture, back.window), (keyframe().capture, keyframe().window));
    let turned = back.keyframe.root_rotation - keyframe().keyframe.root_rotation;
    assert!(turned.amax() < 1e-12);
    let quantised = back.keyframe.clone().quantised();
    assert_eq!(quantised, back.keyframe);
    assert_eq!(through_bytes(&Skeleton::from_core(&skeleton())).to_core().unwrap(), skeleton());
}

/// Bytes as lines of hexadecimal digits.
fn hex(message: &impl Schema) -> String {
    let digits: Vec<String> = encode(message).iter().map(|b| format!("{b:02x}")).collect();
    digits.chunks(32).map(|line| line.concat() + "\n").collect()
}

#[test]
fn the_encoding_has_not_changed() {
    expect_file!["../golden/keypoint_frame.snap"].assert_eq(&hex(&keypoints()));
    expect_file!["../golden/rig.snap"].assert_eq(&hex(&Rig::from_core(&rig())));
    expect_file!["../golden/pose.snap"].assert_eq(&hex(&published_pose()));
    expect_file!["../golden/keyframe.snap"]
        .assert_eq(&hex(&Keyframe::from_core(&keyframe(), WEIGHTS)));
    expect_file!["../golden/skeleton.snap"].assert_eq(&hex(&Skeleton::from_core(&skeleton())));
    expect_file!["../golden/event.snap"].assert_eq(&hex(&event()));
    expect_file!["../golden/status.snap"].assert_eq(&hex(&status()));
    expect_file!["../golden/retargeted_pose.snap"].assert_eq(&hex(&retargeted()));
    expect_file!["../golden/journal.snap"].assert_eq(&hex(&journal()));
    expect_file!["../golden/take.snap"].assert_eq(&hex(&take()));
    expect_file!["../golden/take_answer.snap"].assert_eq(&hex(&take_answer()));
    expect_file!["../golden/stage_status.snap"].assert_eq(&hex(&stage_status()));
    expect_file!["../golden/keypoint_set.snap"].assert_eq(&hex(&keypoint_set()));
    expect_file!["../golden/hand_over.snap"].assert_eq(&hex(&hand_over()));
}

#[test]
fn a_body_keeps_its_sides_and_its_keypoint_offsets() {
    let offsets = KeypointOffsets(std::array::from_fn(|i| 0.1 * (i as f64).sin()));
    let shape = Shape(std::array::from_fn(|i| 0.3 * (i as f64).cos()));
    let body = body::Skeleton::new(shape).with_keypoint_offsets(offsets);
    let found = through_bytes(&Skeleton::from_core(&body)).to_core().unwrap();
    assert_eq!(found.shape(), body.shape());
    let metres = |body: &body::Skeleton| body.keypoint_offsets().metres();
    let pairs = metres(&found).into_iter().zip(metres(&body));
    assert!(pairs.into_iter().all(|(a, b)| (a - b).abs() < 1e-12));
}

/// Bodies of equal sides, without keypoint offsets.
#[test]
fn bodies_of_earlier_versions_are_read() {
    let wire = Skeleton::from_core(&skeleton());
    let shape = wire.shape[..SYMMETRIC_SHAPE].to_vec();
    let earlier = Skeleton { shape, keypoint_offsets_m: Vec::new(), ..wire };
    assert_eq!(through_bytes(&earlier).to_core().unwrap(), skeleton());
}

#[test]
fn fields_of_a_later_version_are_skipped() {
    fn check<T: Schema + PartialEq + std::fmt::Debug>(message: &T) {
        // Field 1000 as a varint, field 1001 as five bytes, field 1002 as four.
        const LATER: &[u8] = &[
            0xc0, 0x3e, 0x96, 0x01, 0xca, 0x3e, 0x05, b'l', b'a', b't', b'e', b'r', 0xd5, 0x3e, 1,
            2, 3, 4,
        ];
        let bytes = [LATER, &encode(message), LATER].concat();
        assert_eq!(decode::<T>(&bytes).unwrap(), *message, "{}", T::NAME);
    }
    check(&keypoints());
    check(&Rig::from_core(&rig()));
    check(&published_pose());
    check(&Keyframe::from_core(&keyframe(), WEIGHTS));
    check(&Skeleton::from_core(&skeleton()));
    check(&event());
    check(&status());
    check(&retargeted());
    check(&journal());
    check(&take());
    check(&take_answer());
    check(&stage_status());
    check(&keypoint_set());
    check(&hand_over());
}

/// The state of a tracker in the middle of a motion.
fn hand_over() -> HandOver {
    let past = Keyframe::from_core(&keyframe(), WEIGHTS);
    let state = HandOver {
        until_ns: past.capture_time_ns,
        body: body::Skeleton::default().coefficients().collect(),
        past: vec![past],
        noise: vec![49.0, 0.01, 0.6, 20.0, 2.5],
        ..HandOver::default()
    };
    assert!(state.to_core().unwrap().motion.is_some());
    state
}

/// Decodes `bytes` as every message; returns how many conversions succeeded.
fn decode_as_everything(bytes: &[u8]) -> usize {
    let mut sound = 0;
    sound +=
        usize::from(decode(bytes).is_ok_and(|m: KeypointFrame| m.to_core(|_| Some(0)).is_ok()));
    sound += usize::from(decode(bytes).is_ok_and(|m: Rig| m.to_core().is_ok()));
    sound += usize::from(
        decode(bytes).is_ok_and(|m: Pose| m.joint_positions().is_ok() && m.to_core().is_ok()),
    );
    sound += usize::from(decode(bytes).is_ok_and(|m: Keyframe| m.to_core().is_ok()));
    sound += usize::from(decode(bytes).is_ok_and(|m: Skeleton| m.to_core().is_ok()));
    sound += usize::from(decode(bytes).is_ok_and(|m: Event| m.validated().is_ok()));
    sound += usize::from(decode(bytes).is_ok_and(|m: RetargetedPose| m.validated().is_ok()));
    sound += usize::from(decode(bytes).is_ok_and(|m: HandOver| m.to_core().is_ok()));
    sound += usize::from(decode(bytes).is_ok_and(|m: KeypointSet| m.to_core(|_| Some(0)).is_ok()));
    sound += usize::from(decode::<StageStatus>(bytes).is_ok());
    sound + usize::from(decode::<Status>(bytes).is_ok())
}

#[test]
fn no_bytes_panic() {
    let mut rng = ChaCha8Rng::seed_from_u64(7);
    let sound: Vec<Vec<u8>> = vec![
        encode(&keypoints()),
        encode(&Rig::from_core(&rig())),
        encode(&published_pose()),
        encode(&Keyframe::from_core(&keyframe(), WEIGHTS)),
        encode(&Skeleton::from_core(&skeleton())),
        encode(&event()),
        encode(&status()),
        encode(&retargeted()),
        encode(&keypoint_set()),
        encode(&stage_status()),
        encode(&hand_over()),
    ];
    let (mut accepted, mut refused) = (0, 0);
    for round in 0..4000 {
        let mut bytes = if round % 4 == 0 {
            vec![0; rng.random_range(0..200)]
        } else {
            sound[round % sound.len()].clone()
        };
        if round % 4 == 0 {
            rng.fill_bytes(&mut bytes);
        } else {
            for _ in 0..rng.random_range(1..4) {
                let at = rng.random_range(0..bytes.len());
                bytes[at] = rng.random();
            }
            if round % 4 == 3 {
                bytes.truncate(rng.random_range(bytes.len() / 2..=bytes.len()));
            }
        }
        match decode_as_everything(&bytes) {
            0 => refused += 1,
            _ => accepted += 1,
        }
    }
    assert!(accepted > 100 && refused > 100, "{accepted} accepted, {refused} refused");
}

#[test]
fn invalid_values_are_refused_with_message_and_field() {
    let frame = |change: fn(&mut KeypointFrame)| {
        let mut frame = keypoints();
        change(&mut frame);
        frame.to_core(|name| rig().index_of(name)).unwrap_err().to_string()
    };
    let pose = |change: fn(&mut Pose)| {
        let mut pose = published_pose();
        change(&mut pose);
        pose.to_core().unwrap_err().to_string()
    };
    let skeleton = |change: fn(&mut Skeleton)| {
        let mut wire = Skeleton::from_core(&skeleton());
        change(&mut wire);
        wire.to_core().unwrap_err().to_string()
    };
    let rig_without = |change: fn(&mut Rig)| {
        let mut wire = Rig::from_core(&rig());
        change(&mut wire);
        wire.to_core().unwrap_err().to_string()
    };
    let retargeted = |change: fn(&mut RetargetedPose)| {
        let mut wire = retargeted();
        change(&mut wire);
        wire.validated().unwrap_err().to_string()
    };
    let messages = [
        frame(|f| f.camera = "top".into()),
        frame(|f| f.format = "body_26".into()),
        frame(|f| f.people[0].points.truncate(50)),
        frame(|f| f.people[1].points[1] = f32::NAN),
        frame(|f| f.people[0].points[2] = -0.5),
        pose(|p| p.root_rotation = vec![0.0; 4]),
        pose(|p| p.local_rotations[8..12].fill(0.0)),
        pose(|p| p.root_position_m[1] = f64::INFINITY),
        pose(|p| p.state = 0),
        skeleton(|s| s.joint_names[3] = "chest".into()),
        skeleton(|s| s.parents[2] = 9),
        skeleton(|s| s.rest_offsets_m[4] += 0.01),
        rig_without(|r| r.cameras.truncate(1)),
        rig_without(|r| r.cameras[0].lens_coefficients.truncate(3)),
        rig_without(|r| r.cameras[1].lens = 9),
        rig_without(|r| r.cameras[1].focal_px[0] = 0.0),
        Event { kind: String::new(), ..event() }.validated().unwrap_err().to_string(),
        retargeted(|p| p.state = 7),
        retargeted(|p| p.hips = 2),
        retargeted(|p| p.local_rotations.truncate(7)),
        retargeted(|p| p.local_rotations[..4].fill(0.0)),
        decode::<Pose>(&[0x0a]).unwrap_err().to_string(),
    ];
    expect![[r#"
    KeypointFrame.camera: camera "top" is not in the rig, add its calibration
    KeypointFrame.format: unknown keypoint format "body_26", use one of body_25, body_25b, coco_17, halpe_26, coco_wholebody_133
    KeypointFrame.people.points: 50 entries, expected 51
    KeypointFrame.people.points: point 0 is not finite; a missing point has confidence 0
    KeypointFrame.people.points: point 0 has confidence -0.5
    Pose.root_rotation: quaternion 0 has length zero
    Pose.local_rotations: quaternion 2 has length zero
    Pose.root_position_m: entry 1 is not a finite number
    Pose.state: unknown state 0
    Skeleton.joint_names: joint 3 is "chest", not spine1
    Skeleton.parents: r_hip has parent 9
    Skeleton.rest_offsets_m: l_hip is 10.000 mm from the position that the shape gives; it was written for another template
    Rig.cameras: a rig needs at least two cameras, this one has 1; add calibrated cameras
    Rig.cameras.lens_coefficients: a Brown-Conrady lens has 4, 5 or 8 coefficients, not 3
    Rig.cameras.lens: camera right has the unknown lens 9
    Rig.cameras: camera right: the intrinsic matrix is singular or no pinhole matrix (fx 0, fy 910, determinant 0); it must be [fx s cx; 0 fy cy; 0 0 1] with positive fx and fy in pixels
    Event.kind: is empty
    RetargetedPose.state: unknown state 7
    RetargetedPose.hips: 2 is not one of the 2 joints
    RetargetedPose.local_rotations: 7 entries, expected 8
    RetargetedPose.local_rotations: quaternion 0 has length zero
    Pose: not a message of this schema: failed to decode Protobuf message: Pose.capture_time_ns: invalid wire type: LengthDelimited (expected Varint)"#]]
    .assert_eq(&messages.join("\n"));
}

#[test]
fn missing_points_are_ignored_and_scores_above_one_are_clamped() {
    let mut frame = keypoints();
    frame.people[0].points[..6].copy_from_slice(&[f32::NAN, f32::NAN, 0.0, 1.0, 2.0, 7.5]);
    let people = frame.to_core(|_| Some(0)).unwrap().people;
    assert_eq!(people[0].points[0], None);
    assert_eq!(people[0].points[1].unwrap().confidence, 1.0);
    let unknown = frame.to_core(|_| None).unwrap_err();
    assert_eq!(unknown, DecodeError::UnknownCamera { name: "right".into() });
}

#[test]
fn a_true_body_may_be_of_any_build() {
    let mut offsets = Joint::ALL.map(|joint| *body::Skeleton::default().offset(joint));
    offsets[Joint::LKnee.index()] *= 1.3;
    let mut wire = Skeleton::from_core(&body::Skeleton::with_joint_offsets(offsets));
    assert!(wire.to_core().is_err());
    let truth = wire.to_truth().unwrap();
    assert_eq!(Joint::ALL.map(|joint| *truth.offset(joint)), offsets);
    wire.rest_offsets_m[0] = f64::NAN;
    assert!(wire.to_truth().is_err());
}

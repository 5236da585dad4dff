//! Poses in the VMC protocol, read by somebody else's reader.

use std::collections::BTreeMap;
use std::net::UdpSocket;
use std::process::Command;
use std::time::Duration;

use ::vmc::{Message, TrackingState as Quality, rosc::decoder::decode_udp};
use bundlemocap::core::body::{JOINTS, Joint, Pose, Shape, Skeleton, StampedPose, TrackingState};
use bundlemocap::core::time::Timestamp;
use bundlemocap::io::bus::{Bus, Zenoh, ZenohConfig};
use bundlemocap::io::formats::bvh::write_bvh;
use bundlemocap::io::vmc::{bones as bones_of_body, packets};
use bundlemocap::io::wire::{self, Topics, encode};
use bundlemocap::research::synth::{Motion, MotionStyle};
use bundlemocap::retarget::{Map, Retarget, Target};
use nalgebra::{Quaternion, UnitQuaternion, Vector3};

use crate::program::{PATIENCE, Program};

pub(crate) fn read(packet: &[u8]) -> Vec<Message> {
    let (rest, packet) = decode_udp(packet).unwrap();
    assert!(rest.is_empty());
    ::vmc::parse(packet).unwrap()
}

/// Places of the bones as Unity sees them, by name.
pub(crate) fn bones(messages: &[Message]) -> BTreeMap<String, Vector3<f32>> {
    let mut local = BTreeMap::new();
    for message in messages {
        if let Message::BoneTransform(bone) = message {
            let (p, r) = (&bone.position, &bone.rotation);
            let turn = UnitQuaternion::from_quaternion(Quaternion::new(r.w, r.x, r.y, r.z));
            local.insert(bone.bone.clone(), (Vector3::new(p.x, p.y, p.z), turn));
        }
    }
    // A bone whose parent is not there is in the next one above.
    let parents = [
        ("Spine", "Hips"),
        ("Chest", "Spine"),
        ("UpperChest", "Chest"),
        ("Neck", "UpperChest"),
        ("Head", "Neck"),
        ("UpperLeg", "Hips"),
        ("LowerLeg", "UpperLeg"),
        ("Foot", "LowerLeg"),
        ("Toes", "Foot"),
        ("Shoulder", "UpperChest"),
        ("UpperArm", "Shoulder"),
        ("LowerArm", "UpperArm"),
        ("Hand", "LowerArm"),
    ];
    let mut world = BTreeMap::from([("Hips".to_owned(), local["Hips"])]);
    for (child, parent) in parents {
        for side in ["", "Left", "Right"] {
            let (child, own) = (format!("{side}{child}"), format!("{side}{parent}"));
            let Some((position, turn)) = local.get(&child) else { continue };
            let mut above = [own.as_str(), parent, "Chest", "Spine"].into_iter();
            let (at, above) = above.find_map(|name| world.get(name)).copied().unwrap();
            world.insert(child, (at + above * position, above * turn));
        }
    }
    world.into_iter().map(|(name, (position, _))| (name, position)).collect()
}

#[test]
fn bones_are_where_the_joints_are_in_the_axes_of_unity() {
    let skeleton = Skeleton::default();
    let motion = Motion::new(&skeleton, MotionStyle::default());
    for pose in [Pose::rest(), motion.pose(1.3), motion.pose(4.1)] {
        let of_body = bones_of_body(&skeleton, &pose);
        let packets = packets(&of_body, TrackingState::Tracking, 2.5).unwrap();
        assert!(packets.iter().all(|packet| packet.len() < 1400));
        let messages: Vec<Message> = packets.iter().flat_map(|packet| read(packet)).collect();
        let Message::State(state) = &messages[0] else { panic!("{:?}", messages[0]) };
        assert_eq!(state.tracking_state, Some(Quality::Good));
        assert!(matches!(&messages[1], Message::Time(time) if time.0 == 2.5), "{:?}", messages[1]);
        let bones = bones(&messages);
        assert_eq!(bones.len(), JOINTS);
        let joints = pose.posture(&skeleton).positions;
        let names = [
            (Joint::Pelvis, "Hips"),
            (Joint::Head, "Head"),
            (Joint::LWrist, "LeftHand"),
            (Joint::RWrist, "RightHand"),
            (Joint::LElbow, "LeftLowerArm"),
            (Joint::LFoot, "LeftToes"),
            (Joint::RFoot, "RightToes"),
            (Joint::RAnkle, "RightFoot"),
            (Joint::LKnee, "LeftLowerLeg"),
            (Joint::RShoulder, "RightUpperArm"),
        ];
        for (joint, name) in names {
            let ours = joints[joint.index()];
            let mirrored = Vector3::new(-ours.x, ours.y, ours.z).cast::<f32>();
            assert!((bones[name] - mirrored).norm() < 1e-5, "{name}: {} {mirrored}", bones[name]);
        }
    }
    // What is lost has no bones.
    let rest = bones_of_body(&skeleton, &Pose::rest());
    let lost = packets(&rest, TrackingState::Lost, 0.0).unwrap();
    let messages: Vec<Message> = lost.iter().flat_map(|packet| read(packet)).collect();
    assert!(matches!(&messages[0], Message::State(s) if s.tracking_state == Some(Quality::Poor)));
    assert!(bones_of(&messages) == 0 && messages.len() == 3);
}

fn bones_of(messages: &[Message]) -> usize {
    messages.iter().filter(|message| matches!(message, Message::BoneTransform(_))).count()
}

#[test]
fn each_address_gets_its_performer() {
    sends_to_each_address(&[], [-1.0, -2.0]);
}

#[test]
fn an_address_gets_the_poses_on_a_characters_skeleton() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("character.bvh");
    write_bvh(&path, &Skeleton::new(Shape::symmetric([2.0; 10])), 60.0, []).unwrap();
    let map = Map::default();
    let mut retarget = Retarget::new(Target::read(&path, &map).unwrap(), &map).unwrap();
    let hips = [1.0, 2.0].map(|x| {
        let mut pose = Pose::rest();
        pose.root_position.x = x;
        let figure = retarget.apply(&pose, &Skeleton::default()).unwrap();
        -figure.positions[figure.hips].x as f32
    });
    assert!(hips[0] != -1.0, "{hips:?}");
    sends_to_each_address(&["--skeleton", path.to_str().unwrap()], hips);
}

/// `wanted`: x of the hips where they are at 1 and 2 m.
fn sends_to_each_address(options: &[&str], wanted: [f32; 2]) {
    let listen = vec!["tcp/127.0.0.1:0".into()];
    let bus = Zenoh::open_node(&ZenohConfig { listen, ..ZenohConfig::default() }).unwrap();
    let [first, second] = [(); 2].map(|()| {
        let socket = UdpSocket::bind("127.0.0.1:0").unwrap();
        socket.set_read_timeout(Some(Duration::from_millis(20))).unwrap();
        socket
    });
    let mut command = Command::new(env!("CARGO_BIN_EXE_bundlemocap"));
    command.args(["bridge", "vmc", "--connect", &bus.listens_on()[0]]);
    command.args(options);
    command.args(["--to", &first.local_addr().unwrap().to_string()]);
    command.args(["--to", &format!("p2={}", second.local_addr().unwrap())]);
    let mut bridge = Program::start(&mut command);
    assert!(bridge.has_said("sending poses to"));
    let skeleton = Skeleton::default();
    let of = |actor: &str| Topics { actor: actor.into(), ..Topics::default() };
    let body = encode(&wire::Skeleton::from_core(&skeleton));
    let actors = ["p1", "p2", "p3"].map(|actor| {
        let topics = of(actor);
        let publishers =
            [topics.skeleton(), topics.pose()].map(|topic| bus.publisher(&topic).unwrap());
        publishers[0].put(Timestamp::default(), "", &body).unwrap();
        publishers
    });
    let pose = |capture: i64, x: f64| {
        let mut pose = Pose::rest();
        pose.root_position.x = x;
        let stamped = StampedPose::new(Timestamp::from_ns(capture), pose, TrackingState::Tracking);
        encode(&wire::Pose::from_core(&stamped, &skeleton, None))
    };
    let hips = |socket: &UdpSocket| {
        let mut buffer = [0; 2048];
        let mut found = None;
        while let Ok(length) = socket.recv(&mut buffer) {
            for message in read(&buffer[..length]) {
                if let Message::BoneTransform(bone) = message
                    && bone.bone == "Hips"
                {
                    found = Some(bone.position.x);
                }
            }
        }
        found
    };
    // Streams may lose a sample: repeat the poses until both are there. p1 comes first; p3 has no address.
    let begin = std::time::Instant::now();
    let mut found = [None; 2];
    for frame in 0.. {
        assert!(begin.elapsed() < PATIENCE, "{found:?}");
        for (k, [_, poses]) in actors.iter().enumerate().take(1 + usize::from(found[0].is_some())) {
            poses.put(Timestamp::default(), "", &pose(frame * 16_000_000, k as f64 + 1.0)).unwrap();
        }
        found = [hips(&first).or(found[0]), hips(&second).or(found[1])];
        if found.iter().all(Option::is_some) {
            break;
        }
    }
    assert_eq!(found, wanted.map(Some));
    // A receiver that goes away does not stop the others.
    drop(second);
    let gone = std::time::Instant::now();
    while hips(&first).is_none_or(|x| x.abs() < 4.0) {
        assert!(gone.elapsed() < PATIENCE, "the first gets nothing more");
        for (k, x) in [(1, 2.0), (0, 5.0)] {
            actors[k][1].put(Timestamp::default(), "", &pose(20_000_000_000, x)).unwrap();
        }
    }
    for _ in 0..50 {
        actors[0][1].put(Timestamp::default(), "", b"not a pose").unwrap();
        actors[2][1].put(Timestamp::default(), "", &pose(0, 3.0)).unwrap();
        std::thread::sleep(Duration::from_millis(10));
    }
    assert!(bridge.has_said("unusable message"));
    let ended = bridge.interrupt();
    assert_eq!(ended.code, Some(0), "{}", ended.errors);
    assert!(ended.errors.contains("p3 is not sent; give --to p3=HOST:PORT"), "{}", ended.errors);
    for part in ["poses sent", "unusable messages", "of p3 without an address"] {
        assert!(ended.said.contains(part), "{}", ended.said);
    }
}

#[test]
fn a_wrong_address_is_refused() {
    for (to, why) in [
        (&["nowhere"][..], "--to nowhere"),
        (&["a b=127.0.0.1:1"], "--to"),
        (&["127.0.0.1:1", "127.0.0.1:2"], "another address without a name"),
        (&["p1=127.0.0.1:1", "p1=127.0.0.1:2"], "has another address already"),
        (&["p1=127.0.0.1:1", "p2=127.0.0.1:1"], "is given twice"),
        (&["p1=127.0.0.1:1", "--actor", "p2"], "another performer than that of --actor"),
    ] {
        let mut command = Command::new(env!("CARGO_BIN_EXE_bundlemocap"));
        command.args(["bridge", "vmc"]);
        for argument in to {
            command.args((!argument.contains("--") && *argument != "p2").then_some("--to"));
            command.arg(argument);
        }
        let output = command.output().unwrap();
        let errors = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(2), "{errors}");
        assert!(errors.contains(why), "{errors}");
    }
}

//! Poses in the VMC protocol (Virtual Motion Capture): OSC messages in UDP packets, for Unity, Unreal and avatar
//! programs.
//!
//! Axes are Unity's: left-handed, y up, +z forwards, +x to the subject's right; metres. Rotations are local, and zero
//! in the T-pose. The root stays at the origin; the hips move.

use nalgebra::{Matrix3, Vector3};
use rosc::{OscBundle, OscMessage, OscPacket, OscTime, OscType, encoder};

use crate::core::body::{Bone, JOINTS, Joint, Pose, Skeleton, TrackingState};
use crate::core::so3;

/// By joint, the bone of Unity's humanoid.
const BONES: [&str; JOINTS] = [
    "Hips",
    "LeftUpperLeg",
    "RightUpperLeg",
    "Spine",
    "LeftLowerLeg",
    "RightLowerLeg",
    "Chest",
    "LeftFoot",
    "RightFoot",
    "UpperChest",
    "LeftToes",
    "RightToes",
    "Neck",
    "LeftShoulder",
    "RightShoulder",
    "Head",
    "LeftUpperArm",
    "RightUpperArm",
    "LeftLowerArm",
    "RightLowerArm",
    "LeftHand",
    "RightHand",
];

/// Bones in a packet: it stays below 1,400 bytes, so that no network divides it.
const TOGETHER: usize = 11;

/// The bones of our body.
pub fn bones(skeleton: &Skeleton, pose: &Pose) -> Vec<Bone> {
    let bone = |joint: Joint| match joint.index().checked_sub(1) {
        None => (joint, pose.root_position, pose.root_rotation),
        Some(j) => (joint, *skeleton.offset(joint), pose.local[j]),
    };
    Joint::ALL.map(bone).into()
}

/// The packets of a pose: first that a body is loaded and tracked, the time and the root, then the bones. A lost
/// pose has no bones. `seconds`: since any moment.
///
/// # Errors
/// None that a pose can cause.
pub fn packets(
    bones: &[Bone],
    state: TrackingState,
    seconds: f64,
) -> Result<Vec<Vec<u8>>, rosc::OscError> {
    let is_tracked = i32::from(state == TrackingState::Tracking);
    // Loaded; calibrated; the normal mode of calibration; whether the tracking is good.
    let ok = [1, 3, 0, is_tracked].map(OscType::Int).to_vec();
    let mut all = vec![
        message("/VMC/Ext/OK", ok),
        message("/VMC/Ext/T", vec![OscType::Float(seconds as f32)]),
        placed("/VMC/Ext/Root/Pos", "root", &Vector3::zeros(), &Matrix3::identity()),
    ];
    if state != TrackingState::Lost {
        all.extend(bones.iter().map(|(joint, position, turn)| {
            placed("/VMC/Ext/Bone/Pos", BONES[joint.index()], position, turn)
        }));
    }
    let at_once = OscTime { seconds: 0, fractional: 1 };
    let bundle = |content: &[OscPacket]| {
        let bundle = OscBundle { timetag: at_once, content: content.to_vec() };
        encoder::encode(&OscPacket::Bundle(bundle))
    };
    let (first, bones) = all.split_at(3);
    std::iter::once(first).chain(bones.chunks(TOGETHER)).map(bundle).collect()
}

fn message(addr: &str, args: Vec<OscType>) -> OscPacket {
    OscPacket::Message(OscMessage { addr: addr.into(), args })
}

/// A name, a position and a rotation, mirrored into the other handedness.
fn placed(addr: &str, name: &str, position: &Vector3<f64>, turn: &Matrix3<f64>) -> OscPacket {
    let [x, y, z, w] = so3::xyzw_from_rotation(turn);
    let numbers = [-position.x, position.y, position.z, x, -y, -z, w];
    let mut args = vec![OscType::String(name.into())];
    args.extend(numbers.map(|number| OscType::Float(number as f32)));
    message(addr, args)
}

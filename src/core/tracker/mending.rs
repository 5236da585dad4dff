//! What is seen since a camera was moved.

use std::sync::Arc;

use super::job::Placed;
use crate::core::calibration::Seen;
use crate::core::so3;
use crate::core::time::Nanos;

/// The solver is asked each time that as much more was seen.
const STEP: Nanos = Nanos::from_ms(10_000);
/// After this time it begins anew, for the camera may have been moved again.
const LONGEST: Nanos = Nanos::from_ms(40_000);
/// From here on it is another pose than the one that is known: 1 degree, 4 cm.
const ANOTHER: (f64, f64) = (0.0175, 0.04);

/// A camera that was moved and is left out.
#[derive(Clone, Debug)]
pub(super) struct Mending {
    pub(super) camera: usize,
    seen: Option<Arc<Seen>>,
    /// Length of what must be seen for the next job.
    next: Nanos,
    /// The job that is out.
    pub(super) job: Option<u64>,
    pub(super) known: Option<Placed>,
}

impl Mending {
    pub(super) fn new(camera: usize) -> Self {
        Self { camera, seen: None, next: STEP, job: None, known: None }
    }

    /// Adds what a window has seen. Returns all when the solver is to be asked.
    pub(super) fn add(&mut self, window: &Seen) -> Option<Arc<Seen>> {
        if self.job.is_some() {
            return None;
        }
        let is_old = |seen: &Arc<Seen>| !Arc::ptr_eq(&seen.body, &window.body);
        if self.next > LONGEST || self.seen.as_ref().is_some_and(is_old) {
            (self.seen, self.next) = (None, STEP);
        }
        let Some(seen) = &mut self.seen else {
            self.seen = Some(Arc::new(window.clone()));
            return None;
        };
        let all = Arc::make_mut(seen);
        all.frames.extend_from_slice(&window.frames);
        all.poses.extend_from_slice(&window.poses);
        let [first, last] = all.span()?;
        if last - first < self.next {
            return None;
        }
        self.next = self.next + STEP;
        Some(Arc::clone(seen))
    }

    /// Notes the answer of the solver. Returns whether the camera is somewhere else than was known.
    pub(super) fn answer(&mut self, placed: Option<Placed>) -> bool {
        self.job = None;
        let Some(placed) = placed else { return false };
        let is_new = self.known.as_ref().is_none_or(|known| {
            let (to, from) = (&placed.camera, &known.camera);
            so3::angle_between(&to.rotation, &from.rotation) > ANOTHER.0
                || (to.centre_in_world() - from.centre_in_world()).norm() > ANOTHER.1
        });
        let error = |placed: &Placed| placed.by.position[1];
        if is_new || self.known.as_ref().is_none_or(|known| error(&placed) < error(known)) {
            self.known = Some(placed);
        }
        is_new
    }
}

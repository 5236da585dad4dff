//! Finds the first keyframe and the body; the same for every method.

use std::sync::Arc;

use super::Take;
use crate::core::body::Skeleton;
use crate::core::manifold::{Decoder, Keyframe};
use crate::core::time::Timestamp;
use crate::core::tracker::{Config, Input, Job, Outcome, Solver, Tracker};

/// The initial keyframe and body of a take.
#[derive(Clone, Debug)]
pub struct Start {
    /// The time of the first keyframe.
    pub at: Timestamp,
    /// The first keyframe.
    pub keyframe: Keyframe,
    /// The body: the take's, or one solved from the first windows.
    pub skeleton: Arc<Skeleton>,
}

/// Finds the performer as the tracker does, with the take's body if it has one; `None` if nobody is found.
pub fn start(take: &Take, decoder: &Decoder, config: &Config) -> Option<Start> {
    let config = Config { frame_rate_hz: take.fps, ..*config };
    let mut tracker = Tracker::new(config, Arc::clone(&take.rig)).with_body(take.body.clone());
    let mut solver = Solver::new(decoder.clone(), config);
    for input in take.frames.iter().cloned().map(Input::Detections).chain([Input::End]) {
        tracker.handle(input);
        let mut found = None;
        let mut solve = |job: &Job| {
            let solution = solver.solve(job);
            if let Outcome::Acquired { first, skeleton, .. } = &solution.outcome {
                found.get_or_insert_with(|| Start {
                    at: first.capture,
                    keyframe: first.keyframe.clone(),
                    skeleton: Arc::clone(skeleton),
                });
            }
            solution
        };
        while tracker.poll_and_solve(&mut solve).is_some() {}
        if found.is_some() {
            return found;
        }
    }
    None
}

//! Finds the first keyframe and the body; the same for every method.

use std::sync::Arc;

use super::Take;
use crate::core::body::Skeleton;
use crate::core::manifold::{Decoder, Keyframe};
use crate::core::time::Timestamp;
use crate::core::tracker::{Config, Input, Outcome, Output, Solver, Tracker};

/// The initial keyframe and body of a take.
#[derive(Clone, Debug)]
pub struct Start {
    /// The time of the first keyframe.
    pub at: Timestamp,
    /// The first keyframe.
    pub keyframe: Keyframe,
    /// The body, solved from the first windows.
    pub skeleton: Arc<Skeleton>,
}

/// Finds the performer with the [`Tracker`]'s acquisition; `None` if nobody is found.
pub fn start(take: &Take, decoder: &Decoder, config: &Config) -> Option<Start> {
    let config = Config { frame_rate_hz: take.fps, ..*config };
    let mut track = Tracker::new(config, Arc::clone(&take.rig));
    let mut solver = Solver::new(decoder.clone(), config);
    for input in take.frames.iter().cloned().map(Input::Detections).chain([Input::End]) {
        track.handle(input);
        while let Some(output) = track.poll() {
            let Output::Solve(job) = output else { continue };
            let solution = solver.solve(&job);
            if let Outcome::Acquired { at, keyframe, skeleton, .. } = solution.outcome {
                return Some(Start { at, keyframe: *keyframe, skeleton });
            }
            track.handle(Input::Solved(solution));
        }
    }
    None
}

//! Splits a take into nominal frames and finds the performer's observations in each.

use super::{Start, Take};
use crate::core::body::BodyPoint;
use crate::core::cost::FrameObservations;
use crate::core::detections::Detections;
use crate::core::manifold::{Decoder, Keyframe};
use crate::core::time::{Nanos, Timestamp};
use crate::core::tracker::{self, Config};

/// A view counts if it has at least this many points.
const MIN_VIEW: usize = 4;

/// The detections of each nominal frame, starting at the first keyframe.
#[derive(Clone, Debug)]
pub(super) struct Cut<'a> {
    /// The nominal time of each frame.
    pub(super) times: Vec<Timestamp>,
    /// The detections nearest to each of these times, in order of capture time.
    pub(super) frames: Vec<Vec<&'a Detections>>,
}

impl<'a> Cut<'a> {
    /// Assigns every detection to the frame with the nearest nominal time.
    pub(super) fn new(take: &'a Take, at: Timestamp) -> Self {
        let period = 1e9 / take.fps;
        let mut frames: Vec<Vec<&Detections>> = Vec::new();
        for detections in &take.frames {
            let index = ((detections.capture - at).ns() as f64 / period).round();
            if index >= 0.0 {
                let index = index as usize;
                if frames.len() <= index {
                    frames.resize_with(index + 1, Vec::new);
                }
                frames[index].push(detections);
            }
        }
        let time = |frame: usize| at + Nanos::rounded(frame as f64 * period);
        Self { times: (0..frames.len()).map(time).collect(), frames }
    }

    /// What was seen of the performer in a frame, expected where `keyframe` puts the body.
    pub(super) fn observations(
        &self,
        frame: usize,
        keyframe: &Keyframe,
        given: &Given,
    ) -> Vec<FrameObservations> {
        tracker::follow(
            self.frames[frame].iter().copied(),
            Nanos::ZERO,
            given.points,
            &given.take.rig,
            &given.decoder.pose(keyframe),
            &given.start.skeleton,
            given.config,
        )
    }
}

/// Shared input for solving the frames of a take.
#[derive(Clone, Copy, Debug)]
pub(super) struct Given<'a> {
    pub(super) take: &'a Take,
    pub(super) decoder: &'a Decoder,
    pub(super) start: &'a Start,
    pub(super) points: &'a [BodyPoint],
    pub(super) config: &'a Config,
}

/// Whether a frame has enough observations to be solved on its own: it passes the gate of the
/// windows and has at least two views.
pub(super) fn is_enough(
    observations: &[FrameObservations],
    cameras: usize,
    config: &Config,
) -> bool {
    let mut views = vec![0; cameras];
    for observation in observations.iter().flat_map(FrameObservations::observations) {
        views[observation.camera] += 1;
    }
    let total: usize = views.iter().sum();
    let seen = views.iter().filter(|&&count| count >= MIN_VIEW).count();
    total as f64 >= config.gate.lost_observations && seen >= 2
}

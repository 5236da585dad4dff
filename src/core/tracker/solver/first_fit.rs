//! The first keyframe and the body.

use std::sync::Arc;

use super::Solver;
use crate::core::body::{BodyPoint, Skeleton};
use crate::core::cost::{self, FrameObservations, FreeBody, Knot, PathProblem, Scene, Stiffness};
use crate::core::detections::Detections;
use crate::core::manifold::Keyframe;
use crate::core::time::Timestamp;
use crate::core::tracker::acquire::{fit, sight};
use crate::core::tracker::job::{Job, Outcome};

/// Most keyframes that the shape is found with.
const SHAPE_KEYFRAMES: usize = 10;

impl Solver {
    /// The first frame set in which a performer is seen; the shape from all the job's windows.
    pub(super) fn acquire(
        &mut self,
        job: &Job,
        points: &[BodyPoint],
        known: Option<&Arc<Skeleton>>,
    ) -> Outcome {
        for (at, set) in frame_sets(&job.frames, job.half_period()) {
            let Some(sighting) = sight(&set, &job.rig, points, &self.config) else { continue };
            let config = &self.config.cost;
            let scene = Scene { decoder: &self.decoder, rig: &job.rig, points, config };
            let template = known.map_or_else(Skeleton::default, |skeleton| (**skeleton).clone());
            let found = fit(
                &sighting,
                scene,
                &template,
                if known.is_none() { self.config.free_body() } else { FreeBody::Fixed },
                &self.config,
                &mut *self.acquirer,
                &mut self.work,
            );
            let Some((keyframe, rough)) = found else { continue };
            let (keyframe, skeleton) = match known {
                Some(skeleton) => (keyframe, Arc::clone(skeleton)),
                None => {
                    let (keyframe, skeleton) = self.fit_shape(job, points, at, keyframe, rough);
                    (keyframe, Arc::new(skeleton))
                }
            };
            let keyframe = keyframe.quantised();
            let pose = Box::new(self.decoder.pose(&keyframe));
            return Outcome::Acquired { at, keyframe: Box::new(keyframe), skeleton, pose };
        }
        Outcome::NobodyFound
    }

    /// Refines the first keyframe and the shape over all the job's windows at once.
    fn fit_shape(
        &mut self,
        job: &Job,
        points: &[BodyPoint],
        at: Timestamp,
        keyframe: Keyframe,
        rough: Skeleton,
    ) -> (Keyframe, Skeleton) {
        let frames = self.config.window() * self.config.shape_windows.max(1);
        let spacing = frames.div_ceil(SHAPE_KEYFRAMES).max(self.config.keyframe());
        let stretches = frames.div_ceil(spacing) as i64;
        let span = ((job.end - job.start) / stretches).max(1);
        let frames = job.frames.iter().filter(|frame| frame.capture >= at);
        let observed_frames = self.follow(frames, points, &job.rig, &keyframe, &rough);
        let last = observed_frames.last().map_or(at, |observed_frame| observed_frame.capture);
        // Only the shape and the first keyframe are kept: few keyframes and no stiffness will do.
        let cost = cost::Config { stiffness: Stiffness::NONE, ..self.config.cost };
        let scene = Scene { decoder: &self.decoder, rig: &job.rig, points, config: &cost };
        let frames = spacing as f64;
        let mut knots = vec![Knot { capture: at, keyframe, free: true, frames }];
        for stretch in 1..=stretches {
            let (start, end) = (at + span * (stretch - 1), at + span * stretch);
            let inside: Vec<FrameObservations> = observed_frames
                .iter()
                .filter(|observed_frame| {
                    observed_frame.capture > start && observed_frame.capture <= end.min(last)
                })
                .cloned()
                .collect();
            let Some(from) = knots.last().filter(|_| !inside.is_empty()) else { continue };
            let from = Knot { free: false, ..from.clone() };
            let to = Knot { capture: end, keyframe: from.keyframe.clone(), free: true, frames };
            let mut problem = PathProblem::new(
                scene,
                vec![from, to],
                &rough,
                FreeBody::Fixed,
                &inside,
                &mut self.work,
            );
            let mut x = problem.start();
            self.acquirer.minimise(&mut problem, &mut x, self.config.iterations);
            let (keyframes, _) = problem.solution(&x);
            knots.extend(keyframes.into_iter().skip(1).map(|keyframe| Knot {
                capture: end,
                keyframe,
                free: true,
                frames,
            }));
        }
        let (first, free) = (knots[0].keyframe.clone(), self.config.free_body());
        let solved = knots.last().map_or(at, |knot| knot.capture);
        let known: Vec<FrameObservations> =
            observed_frames.into_iter().filter(|m| m.capture <= solved).collect();
        let mut problem = PathProblem::new(scene, knots, &rough, free, &known, &mut self.work);
        let mut x = problem.start();
        self.acquirer.minimise(&mut problem, &mut x, self.config.acquisition_iterations);
        let (keyframes, skeleton) = problem.solution(&x);
        (keyframes.into_iter().next().unwrap_or(first), skeleton)
    }
}

/// Groups frames into sets of one time: each set holds frames of different cameras at most
/// `half_period` after its first.
fn frame_sets(frames: &[Arc<Detections>], half_period: i64) -> Vec<(Timestamp, Vec<&Detections>)> {
    let mut sets: Vec<(Timestamp, Vec<&Detections>)> = Vec::new();
    for frame in frames {
        match sets.last_mut() {
            Some((first, set))
                if frame.capture - *first <= half_period
                    && set.iter().all(|other| other.camera != frame.camera) =>
            {
                set.push(frame);
            }
            _ => sets.push((frame.capture, vec![frame])),
        }
    }
    sets
}

//! The live tracker in simulated time: frames arrive at once and solves take no time.

use std::sync::Arc;

use super::{Delay, Method, Motion, Solved, Take};
use crate::core::manifold::Decoder;
use crate::core::time::Nanos;
use crate::core::tracker::{Config, Input, Latency, Live, Output, Solver, Tracker};
use crate::metrics::FollowedSums;

/// Time reserved for the solve of a window, as in the live node.
const RESERVE: Nanos = Nanos::from_ms(14);

/// The default settings live, with the body of the take.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LiveTracker {
    /// The final poses at a latency.
    Final(Nanos),
    /// The provisional poses.
    Provisional,
}

impl LiveTracker {
    /// Final poses at a latency in milliseconds; `None` if that is no number or too short.
    pub fn at(ms: &str) -> Option<Self> {
        let latency = Nanos::rounded(1e6 * ms.parse::<f64>().ok()?);
        (latency >= Latency::LEAST).then_some(Self::Final(latency))
    }

    fn latency(self, config: &Config, fps: f64) -> Latency {
        let period = Nanos::of_frames(1, fps);
        let wait = period * (config.at_period(1e9 / fps).window() as i64 - 1);
        let declared = match self {
            Self::Final(declared) => declared,
            Self::Provisional => wait * 2,
        };
        Latency::new(declared, [wait, RESERVE, Nanos::ZERO], period, config)
    }
}

impl Method for LiveTracker {
    fn name(&self) -> String {
        match self {
            Self::Final(latency) => format!("bundlemocap (live, {latency:.0})"),
            Self::Provisional => "bundlemocap (live, provisional)".into(),
        }
    }

    /// Of a final pose at most a window, whatever the latency.
    fn delay(&self, fps: f64) -> Delay {
        match self {
            Self::Final(_) => Delay::Frames(Config::default().at_period(1e9 / fps).window()),
            Self::Provisional => Delay::Frames(0),
        }
    }

    fn solve(&mut self, take: &Take, decoder: &Decoder) -> Option<Solved> {
        let config = Config { frame_rate_hz: take.fps, ..Config::default() };
        let live = Live {
            provisional: true,
            time_offsets: false,
            watch_cameras: false,
            output_rate_hz: 0.0,
        };
        let tracker = Tracker::new(config, Arc::clone(&take.rig)).live(live);
        let mut tracker = tracker.with_body(take.body.clone());
        tracker.set_latency(self.latency(&config, take.fps));
        let mut solver = Solver::new(decoder.clone(), config);
        let (mut poses, mut deviations, mut borders) = (Vec::new(), Vec::new(), Vec::new());
        let mut followed = FollowedSums::default();
        let provisional = *self == Self::Provisional;
        let mut handle = |tracker: &mut Tracker, input: Input| {
            tracker.handle(input);
            while let Some(output) = tracker.poll_and_solve(|job| solver.solve(job)) {
                match output {
                    Output::Pose(pose) if pose.provisional == provisional => {
                        deviations.push(pose.deviations);
                        poses.push((pose.capture, pose.pose));
                    }
                    Output::Window(window) => {
                        borders.push(window.end);
                        followed.add(&window);
                    }
                    _ => {}
                }
            }
        };
        let mut now = take.frames.first()?.capture;
        for frame in &take.frames {
            while let Some(wake) = tracker.wake().filter(|at| (now..frame.capture).contains(at)) {
                now = wake + Nanos::new(1);
                handle(&mut tracker, Input::Tick(wake));
            }
            now = now.max(frame.capture);
            handle(&mut tracker, Input::Tick(now));
            handle(&mut tracker, Input::Detections(frame.clone()));
        }
        handle(&mut tracker, Input::End);
        let skeleton = tracker.skeleton().cloned()?;
        let is_found = !poses.is_empty();
        let not_followed = followed.finish();
        let motion = Motion::Poses(skeleton, poses);
        is_found.then_some(Solved { motion, deviations, borders, not_followed })
    }
}

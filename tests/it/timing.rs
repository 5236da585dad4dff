//! When the tracker opens and closes windows, wakes up and extrapolates: with solutions made by
//! hand, without a solver.

use std::sync::Arc;

use bundlemocap::core::body::{Pose, Skeleton, StampedPose, TrackingState};
use bundlemocap::core::detections::{Detections, KeypointFormat};
use bundlemocap::core::manifold::{Keyframe, TimedKeyframe};
use bundlemocap::core::time::{Nanos, Timestamp};
use bundlemocap::core::tracker::{
    Config, Event, EventKind, Input, Job, Latency, Live, Outcome, Output, Solution, Task, Tracked,
    Tracker, Verdict,
};

use crate::solve::{keyframe, ring};

const CAMERAS: usize = 4;
/// The tracker wakes this much after the end of a wait, since the times of a grid are rounded.
const ROUNDING: Nanos = Nanos::new(1000);

/// Capture time of frame `i` at 50 frames per second.
fn at(i: i64) -> Timestamp {
    ms(20 * i)
}

fn ms(milliseconds: i64) -> Timestamp {
    Timestamp::from_ns(1_000_000 * milliseconds)
}

/// A tracker and its outputs, without the solved jobs.
struct Timeline {
    tracker: Tracker,
    job: Option<Job>,
    poses: Vec<StampedPose>,
    events: Vec<Event>,
}

impl Timeline {
    /// Windows of 10 frames of 20 ms, 5 of them final; 5 frames of grace. Windows stop waiting for
    /// a camera after 2 windows.
    fn new() -> Self {
        let config =
            Config { frame_rate_hz: 50.0, shape_windows: 1, grace_windows: 2, ..Config::default() };
        assert_eq!((config.window(), config.publish(), config.deadline_frames), (10, 5, 5));
        let tracker = Tracker::new(config, Arc::new(ring()));
        Self { tracker, job: None, poses: Vec::new(), events: Vec::new() }
    }

    fn live(mut self) -> Self {
        self.tracker = self.tracker.live(Live {
            provisional: false,
            time_offsets: false,
            watch_cameras: false,
            output_rate_hz: 0.0,
        });
        self
    }

    fn handle(&mut self, input: Input) {
        self.tracker.handle(input);
        while let Some(output) = self.tracker.poll() {
            match output {
                Output::Solve(job) => {
                    assert!(self.job.is_none(), "two jobs at a time");
                    self.job = Some(*job);
                }
                Output::Pose(pose) => self.poses.push(*pose),
                Output::Event(event) => self.events.push(event),
                _ => {}
            }
        }
    }

    fn frame(&mut self, camera: usize, i: i64) {
        let (format, people) = (KeypointFormat::Body25, Vec::new());
        let frame = Detections { camera, frame: i as u64, capture: at(i), format, people };
        self.handle(Input::Detections(frame));
    }

    /// Some frames of some cameras.
    fn frames(&mut self, cameras: std::ops::Range<usize>, frames: std::ops::RangeInclusive<i64>) {
        for i in frames {
            cameras.clone().for_each(|camera| self.frame(camera, i));
        }
    }

    /// Solves the job by hand: the performer stands still. Returns the job.
    fn solve(&mut self) -> Job {
        let job = self.job.take().expect("a job is with the solver");
        self.answer(&job);
        job
    }

    fn answer(&mut self, job: &Job) {
        let still = |time: Timestamp| TimedKeyframe::new(time, still());
        let outcome = match &job.task {
            Task::Acquire { .. } => Outcome::Acquired {
                first: Box::new(still(job.start)),
                skeleton: Arc::new(Skeleton::default()),
                pose: Box::new(Pose::rest()),
            },
            _ => Outcome::Tracked(Box::new(Tracked {
                keyframes: job.keyframe_times.iter().copied().map(still).collect(),
                between: Vec::new(),
                poses: vec![Pose::rest(); job.pose_times.len()],
                deviations: None,
                newest: Pose::rest(),
                summary: None,
                residuals: Vec::new(),
                unfollowed: Vec::new(),
                verdict: Verdict::Tracked,
                estimator: None,
            })),
        };
        self.handle(Input::Solved(Solution { number: job.number, outcome }));
    }

    /// Acquires the performer at frame 0 and solves the first window: final up to frame 5, all
    /// cameras have sent frame 10.
    fn begin(mut self) -> Self {
        self.frames(0..CAMERAS, 0..=10);
        assert!(matches!(self.solve().task, Task::Acquire { .. }));
        assert!(matches!(self.solve().task, Task::Track { .. }));
        assert!(self.job.is_none() && self.events.len() == 1, "{:?}", self.events);
        self.events.clear();
        self
    }

    fn kinds(&self) -> Vec<(EventKind, Option<usize>)> {
        self.events.iter().map(|event| (event.kind, event.camera)).collect()
    }
}

fn still() -> Keyframe {
    keyframe(0.7, 0.25)
}

#[test]
fn a_window_closes_when_the_last_camera_reaches_its_end() {
    let mut timeline = Timeline::new();
    timeline.frames(0..CAMERAS, 0..=9);
    timeline.frames(0..CAMERAS - 1, 10..=10);
    assert!(timeline.job.is_none());
    timeline.frame(CAMERAS - 1, 10);
    let job = timeline.solve();
    assert_eq!([job.start, job.publish, job.end], [at(0), at(10), at(10)]);

    let job = timeline.solve();
    assert_eq!([job.start, job.publish, job.end], [at(0), at(5), at(10)]);
    assert_eq!(job.keyframe_times, (1..=10).map(at).collect::<Vec<_>>());
    assert_eq!(job.pose_times, (1..=5).map(at).collect::<Vec<_>>());
    let times: Vec<_> = timeline.poses.iter().map(|pose| pose.capture).collect();
    assert_eq!(times, (0..=5).map(at).collect::<Vec<_>>());

    // The next window opens where the final part of this one ends.
    timeline.frames(0..CAMERAS, 11..=14);
    assert!(timeline.job.is_none());
    timeline.frames(0..CAMERAS, 15..=15);
    let job = timeline.solve();
    assert_eq!([job.start, job.publish, job.end], [at(5), at(10), at(15)]);
    assert!(job.frames.iter().all(|frame| frame.capture > at(5) && frame.capture <= at(15)));
}

#[test]
fn a_frame_within_a_quarter_period_of_the_end_closes_the_window() {
    let close = |ms_before_end: i64| {
        let mut timeline = Timeline::new().begin();
        timeline.frames(0..CAMERAS, 11..=14);
        for camera in 0..CAMERAS {
            let (format, people) = (KeypointFormat::Body25, Vec::new());
            let capture = at(15) - Nanos::from_ms(ms_before_end);
            let frame = Detections { camera, frame: 15, capture, format, people };
            timeline.handle(Input::Detections(frame));
        }
        timeline.job.is_some()
    };
    assert!(close(5) && !close(6));
}

#[test]
fn a_recording_waits_for_a_late_camera_until_the_others_pass_the_deadline() {
    let mut timeline = Timeline::new().begin();
    timeline.frames(0..CAMERAS - 1, 11..=19);
    assert!(timeline.job.is_none(), "the window ends at frame 15, its grace at frame 20");
    timeline.frame(0, 20);
    assert!(timeline.job.is_none(), "the clock of one camera may be fast");
    timeline.frame(1, 20);
    assert_eq!(timeline.solve().end, at(15));
    assert_eq!(timeline.kinds(), [(EventKind::Deadline, Some(3))]);
}

#[test]
fn windows_stop_waiting_for_a_silent_camera_until_it_returns() {
    let mut timeline = Timeline::new().begin();
    timeline.frames(0..CAMERAS - 1, 11..=25);
    assert_eq!([timeline.solve().end, timeline.solve().end], [at(15), at(20)]);
    let (deadline, silent) = ((EventKind::Deadline, Some(3)), (EventKind::Silent, Some(3)));
    assert_eq!(timeline.kinds(), [deadline, deadline, silent]);
    assert!(!timeline.tracker.is_waited_for(3));
    // No grace any more: the others have reached frame 25.
    assert_eq!(timeline.solve().end, at(25));
    assert!(timeline.job.is_none());
    timeline.frame(3, 26);
    assert_eq!(timeline.kinds()[3..], [(EventKind::Returned, Some(3))]);
    assert!(timeline.tracker.is_waited_for(3));
    timeline.frames(0..CAMERAS - 1, 26..=34);
    assert!(timeline.job.is_none(), "the window that ends at frame 30 waits for the camera again");
}

#[test]
fn the_end_closes_the_open_window_at_the_last_frame() {
    let mut timeline = Timeline::new().begin();
    timeline.frames(0..CAMERAS, 11..=12);
    assert!(timeline.job.is_none());
    timeline.handle(Input::End);
    let job = timeline.solve();
    assert_eq!([job.start, job.publish, job.end], [at(5), at(12), at(12)]);
    assert!(timeline.job.is_none());
    assert_eq!(timeline.poses.last().unwrap().capture, at(12));
}

#[test]
fn a_live_window_closes_by_the_clock_and_not_by_a_fast_camera() {
    let mut timeline = Timeline::new().live().begin();
    // Its start is frame 5, its end frame 15, its grace 5 frames.
    assert_eq!(timeline.tracker.wake(), Some(at(20) + ROUNDING));
    timeline.tracker.set_delay(Nanos::from_ms(30));
    assert_eq!(timeline.tracker.wake(), Some(ms(430) + ROUNDING), "the usual delay is added");
    timeline.tracker.set_delay(Nanos::ZERO);
    timeline.frames(0..2, 40..=40);
    timeline.handle(Input::Tick(at(20) - Nanos::new(1)));
    assert!(timeline.job.is_none());
    timeline.handle(Input::Tick(at(20)));
    let job = timeline.job.as_ref().expect("the deadline has passed");
    assert_eq!(job.end, at(15));
    assert_eq!(timeline.kinds(), [2, 3].map(|camera| (EventKind::Deadline, Some(camera))));
    assert_eq!(timeline.tracker.wake(), None, "nothing to wait for but the solution");
}

#[test]
fn the_latency_limits_the_grace() {
    let mut timeline = Timeline::new().live().begin();
    let mut wake = |declared: i64, reserve: i64| {
        let [declared, reserve] = [declared, reserve].map(Nanos::from_ms);
        timeline.tracker.set_latency(Latency { declared, reserve, look_ahead: None });
        timeline.tracker.wake()
    };
    // 300 ms minus the window (200) and its reserve (50), plus the period of the first pose (20):
    // 70 ms.
    assert_eq!(wake(300, 50), Some(ms(370) + ROUNDING));
    assert_eq!(wake(200, 50), Some(ms(300) + ROUNDING), "no grace is left");
    assert_eq!(wake(1000, 50), Some(ms(400) + ROUNDING), "never more than was asked for");
}

#[test]
fn a_pose_that_is_not_solved_when_due_is_extrapolated() {
    let mut timeline = Timeline::new().live();
    let [declared, reserve] = [300, 50].map(Nanos::from_ms);
    let latency = Latency { declared, reserve, look_ahead: None };
    timeline.tracker.set_latency(latency);
    let mut timeline = timeline.begin();
    assert_eq!(timeline.poses.len(), 6, "frames 0 to 5");
    timeline.frames(0..2, 11..=14);
    timeline.handle(Input::Tick(ms(370)));
    let job = timeline.job.take().expect("the deadline has passed");
    // Frame 6 is due at 120 + 300 ms, and extrapolated 3 ms before that.
    assert_eq!(timeline.tracker.wake(), Some(ms(417)));
    timeline.handle(Input::Tick(ms(417) - Nanos::new(1)));
    assert_eq!(timeline.poses.len(), 6);
    timeline.handle(Input::Tick(ms(417)));
    let pose = timeline.poses.last().unwrap();
    assert_eq!((pose.capture, pose.state), (at(6), TrackingState::Coasting));
    assert_eq!(timeline.events.last().unwrap().kind, EventKind::Overdue);
    assert_eq!(timeline.tracker.extrapolated_and_missed(), (1, 0));

    // The solved pose of frame 6 comes too late; those of frames 7 to 10 do not.
    timeline.answer(&job);
    assert_eq!(timeline.tracker.extrapolated_and_missed(), (1, 1));
    let times: Vec<_> = timeline.poses[7..].iter().map(|pose| pose.capture).collect();
    assert_eq!(times, (7..=10).map(at).collect::<Vec<_>>());
    assert!(timeline.poses[7..].iter().all(|pose| pose.state == TrackingState::Tracking));
}

#[test]
fn after_a_restart_the_old_solution_is_dropped_before_the_next_job() {
    let mut timeline = Timeline::new().begin();
    timeline.frames(0..CAMERAS, 11..=15);
    let old = timeline.job.take().expect("a job is with the solver");
    timeline.handle(Input::Restart);
    timeline.frames(0..CAMERAS, 100..=110);
    assert!(timeline.job.is_none(), "one job at a time");
    let poses = timeline.poses.len();
    timeline.answer(&old);
    assert_eq!(timeline.poses.len(), poses);
    let job = timeline.solve();
    assert!(matches!(&job.task, Task::Acquire { skeleton: Some(_) }), "the body stays known");
    assert_eq!(job.start, at(100));
}

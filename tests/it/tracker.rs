//! The tracker on streams with a known truth.

use std::collections::BTreeMap;
use std::sync::Arc;

use bundlemocap::core::body::{
    BODY_JOINTS, BodyPoint, Joint, KeypointOffsets, Pose, SYMMETRIC_OFFSETS, Shape, Skeleton,
    StampedPose, TrackingState, fitted_points,
};
use bundlemocap::core::camera::Rig;
use bundlemocap::core::cost::Observation;
use bundlemocap::core::detections::{Detection, Detections, KeypointFormat, Person};
use bundlemocap::core::manifold::{
    CORRECTED, Correction, Decoder, Interpolation, Keyframe, TimedKeyframe,
};
use bundlemocap::core::optimise::OptimiserKind;
use bundlemocap::core::so3;
use bundlemocap::core::time::{Nanos, Timestamp};
use bundlemocap::core::tracker::{
    Config, Effort, EventKind, FramePeriod, Input, Job, Noise, Outcome, Output, Solver, Task,
    Tracker, Verdict, WindowReport, run_to_end,
};
use nalgebra::{Point2, Vector3};

use crate::solve::{frame, keyframe, observe, ring};

const FORMAT: KeypointFormat = KeypointFormat::Body25;

/// All outputs of a tracker.
#[derive(Default)]
struct Run {
    poses: Vec<StampedPose>,
    windows: Vec<WindowReport>,
    events: BTreeMap<EventKind, u64>,
    skeleton: Option<Arc<Skeleton>>,
}

fn config() -> Config {
    let mut config = Config::paper();
    config.optimiser = OptimiserKind::LevenbergMarquardt;
    config.cost.prior = 1e-5;
    config.cost.shape_prior = 1e-4;
    config.iterations = 200;
    config.change_threshold = 0.0;
    config.acquisition_iterations = 300;
    config
}

fn run(config: Config, frames: impl IntoIterator<Item = Detections>) -> Run {
    run_with(Tracker::new(config, Arc::new(ring())), config, frames)
}

fn run_with(
    mut tracker: Tracker,
    config: Config,
    frames: impl IntoIterator<Item = Detections>,
) -> Run {
    let mut solver = Solver::new(Decoder::embedded().unwrap(), config);
    let mut run = Run::default();
    run_to_end(&mut tracker, &mut solver, frames, |output| match output {
        Output::Pose(pose) => run.poses.push(*pose),
        Output::Window(window) => run.windows.push(*window),
        Output::Event(event) => *run.events.entry(event.kind).or_default() += event.count,
        Output::Skeleton(skeleton) => run.skeleton = Some(skeleton),
        _ => {}
    });
    run
}

#[test]
fn a_restart_keeps_the_frame_period_that_was_measured_before() {
    let known = FramePeriod { ns: 2e7, error_ns: 1.0 };
    let mut tracker = Tracker::new(config(), Arc::new(ring())).with_frame_period(Some(known));
    let person = Person { id: None, points: vec![None; FORMAT.len()] };
    for restart in [None, Some(Input::Restart), Some(Input::Forget)] {
        restart.into_iter().for_each(|restart| tracker.handle(restart));
        let people = vec![person.clone()];
        let (camera, frame, capture) = (0, 1, Timestamp::from_ns(1_000_000_000));
        let frame = Detections { camera, frame, capture, format: FORMAT, people };
        tracker.handle(Input::Detections(frame));
        assert_eq!(tracker.frame_period(), known.ns);
    }
}

/// All jobs of a tracker, with their solutions.
fn solved(config: Config, frames: Vec<Detections>) -> Vec<(Job, Outcome)> {
    let mut tracker = Tracker::new(config, Arc::new(ring()));
    let mut solver = Solver::new(Decoder::embedded().unwrap(), config);
    let mut jobs = Vec::new();
    for input in frames.into_iter().map(Input::Detections).chain([Input::End]) {
        tracker.handle(input);
        let mut solve = |job: &Job| {
            let solution = solver.solve(job);
            jobs.push((job.clone(), solution.outcome.clone()));
            solution
        };
        while tracker.poll_and_solve(&mut solve).is_some() {}
    }
    jobs
}

fn truth_shape() -> Shape {
    Shape::symmetric(std::array::from_fn(|i| 0.6 * (i as f64 * 1.7).sin()))
}

fn truth(i: usize) -> Keyframe {
    let at = |k: usize| keyframe(0.7 + 0.02 * k as f64, 0.25);
    Interpolation::Slerp.keyframe(&at(i / 10), &at(i / 10 + 1), (i % 10) as f64 / 10.0)
}

/// The detections of all cameras in one frame.
fn detections(rig: &Rig, points: &[BodyPoint], seen: &[Observation], i: usize) -> Vec<Detections> {
    let of_camera = |camera: usize| {
        let mut person = Person { id: None, points: vec![None; FORMAT.len()] };
        for observation in seen.iter().filter(|o| o.camera == camera) {
            let pixel = Point2::from(observation.pixel);
            person.points[points[observation.point].index] =
                Some(Detection { pixel, confidence: 0.9 });
        }
        let people = vec![person];
        Detections { camera, frame: i as u64, capture: frame(i), format: FORMAT, people }
    };
    (0..rig.cameras.len()).map(of_camera).collect()
}

/// Exact detections of a motion on the manifold, from all cameras, in order.
fn stream(frames: usize) -> Vec<Detections> {
    stream_of(frames, truth)
}

fn stream_of(frames: usize, truth: impl Fn(usize) -> Keyframe) -> Vec<Detections> {
    let (rig, points, decoder) = (ring(), fitted_points(FORMAT), Decoder::embedded().unwrap());
    let skeleton = Skeleton::new(truth_shape());
    let mut all = Vec::new();
    for i in 0..frames {
        let posture = decoder.pose(&truth(i)).posture(&skeleton);
        let seen = observe(&rig, &points, &posture, &skeleton);
        all.extend(detections(&rig, &points, &seen, i));
    }
    all
}

/// Number of local rotations that keypoints show: all but those of the wrists, the last two.
const SHOWN: usize = BODY_JOINTS - 2;

/// Largest joint error in metres and largest local rotation error in radians, against the truth.
fn worst_errors(run: &Run) -> (f64, f64) {
    let decoder = Decoder::embedded().unwrap();
    let truth_skeleton = Skeleton::new(truth_shape());
    let skeleton = run.skeleton.as_ref().unwrap();
    let (mut metres, mut radians) = (0.0_f64, 0.0_f64);
    for pose in &run.poses {
        let i = (pose.capture.ns() as f64 * 60e-9).round() as usize;
        let expected = decoder.pose(&truth(i));
        let (a, b) = (pose.pose.posture(skeleton), expected.posture(&truth_skeleton));
        for j in 0..a.positions.len() {
            metres = metres.max((a.positions[j] - b.positions[j]).norm());
        }
        for (a, b) in pose.pose.local.iter().zip(&expected.local).take(SHOWN) {
            radians = radians.max(so3::angle_between(a, b));
        }
    }
    (metres, radians)
}

/// With the true body and first keyframe, also for fast motions.
#[test]
fn windows_follow_a_manifold_motion_exactly() {
    let decoder = Decoder::embedded().unwrap();
    let skeleton = Arc::new(Skeleton::new(truth_shape()));
    let (rig, points) = (Arc::new(ring()), fitted_points(FORMAT));
    let mut solver = Solver::new(decoder.clone(), config());
    for seed in [0.3, 0.7, 0.9, 1.1] {
        let at = |k: u64| keyframe(seed + 0.02 * k as f64, 0.8);
        let mut from = at(0);
        for window in 0..3 {
            let truth = |i: u64| {
                Interpolation::Slerp.keyframe(&at(window), &at(window + 1), i as f64 / 10.0)
            };
            let posture = |i: u64| decoder.pose(&truth(i)).posture(&skeleton);
            let seen = |i| observe(&rig, &points, &posture(i), &skeleton);
            let time = |i: u64| frame((10 * window + i) as usize);
            let job = Job {
                number: window,
                window,
                start: time(0),
                end: time(10),
                publish: time(10),
                keyframe_times: vec![time(10)],
                pose_times: (1..=10).map(time).collect(),
                frames: (1..=10)
                    .flat_map(|i| detections(&rig, &points, &seen(i), (10 * window + i) as usize))
                    .map(Arc::new)
                    .collect(),
                format: FORMAT,
                rig: Arc::clone(&rig),
                frame_period: Nanos::new(16_666_666),
                effort: Effort::full(&config()),
                noise: Noise::default(),
                task: Task::Track {
                    estimator: Arc::default(),
                    past: vec![TimedKeyframe::new(time(0), from)],
                    ahead: Vec::new(),
                    skeleton: Arc::clone(&skeleton),
                    coasted: 0,
                },
            };
            let Outcome::Tracked(tracked) = solver.solve(&job).outcome else { panic!("no window") };
            for (i, pose) in (1..).zip(&tracked.poses) {
                let (found, expected) = (pose.posture(&skeleton), posture(i));
                for j in 0..=SHOWN {
                    let metres = (found.positions[j] - expected.positions[j]).norm();
                    assert!(metres < 1e-3, "seed {seed}, window {window}: {metres} m");
                    let angle = so3::angle_between(&found.rotations[j], &expected.rotations[j]);
                    assert!(angle.to_degrees() < 1.0, "seed {seed}, window {window}: {angle} rad");
                }
            }
            from = tracked.keyframes.into_iter().next().unwrap().keyframe;
        }
    }
}

/// Without start values: the body and the first keyframe are found too. The motion is near the
/// middle of the manifold, since further out other codes with another body differ by only 0.02 px.
#[test]
fn a_perfect_recording_of_a_manifold_motion_is_recovered() {
    let run = run(config(), stream(41));
    assert_eq!(run.poses.len(), 41);
    assert!(run.poses.iter().all(|pose| pose.state == TrackingState::Tracking));
    let (metres, radians) = worst_errors(&run);
    assert!(metres < 1e-3, "{metres} m");
    assert!(radians.to_degrees() < 0.5, "{} degrees", radians.to_degrees());
}

#[test]
fn the_short_last_window_is_solved() {
    let run = run(config(), stream(37));
    assert_eq!(run.poses.len(), 37);
    assert_eq!(run.windows.len(), 4);
    assert_eq!(run.poses.last().unwrap().capture, frame(36));
}

#[test]
fn frames_out_of_order_within_a_window_are_used_and_counted() {
    let ordered = run(config(), stream(31));
    let mut frames = stream(31);
    for group in frames.chunks_mut(8) {
        group.reverse();
    }
    let shuffled = run(config(), frames);
    assert_eq!(ordered.poses, shuffled.poses);
    assert!(!ordered.events.contains_key(&EventKind::OutOfOrder));
    assert!(shuffled.events[&EventKind::OutOfOrder] >= 50);
}

#[test]
fn late_duplicate_and_missing_frames_are_counted() {
    let mut frames = stream(61);
    let late = frames.remove(4 * 12);
    frames.push(late);
    frames.insert(9, frames[8].clone());
    let lost = frames.iter().position(|f| f.camera == 2 && f.frame == 45).unwrap();
    frames.remove(lost);
    let run = run(config(), frames);
    assert_eq!(run.events[&EventKind::Late], 1);
    assert_eq!(run.events[&EventKind::Duplicate], 1);
    assert_eq!(run.events[&EventKind::Missing], 2);
    assert_eq!(run.poses.len(), 61);
}

#[test]
fn windows_wait_for_a_silent_camera_for_a_limited_time() {
    let frames = stream(61).into_iter().filter(|f| f.camera != 3 || f.frame < 20);
    let run = run(config(), frames);
    assert!(run.events[&EventKind::Deadline] >= 2);
    assert_eq!(run.poses.len(), 61);
    assert!(run.poses.iter().all(|pose| pose.state == TrackingState::Tracking));
}

#[test]
fn an_absence_is_extrapolated_then_flagged_until_the_performer_returns() {
    let mut frames = stream(121);
    for frame in frames.iter_mut().filter(|f| (40..92).contains(&f.frame)) {
        frame.people.clear();
    }
    let run = run(config(), frames);
    assert_eq!(run.events[&EventKind::Coasted], 3);
    assert_eq!(run.events[&EventKind::Left], 1);
    assert_eq!(run.events[&EventKind::Acquired], 2);
    let state = |i: usize| {
        run.poses.iter().find(|p| (p.capture - frame(i)).abs() < Nanos::new(10)).unwrap().state
    };
    assert_eq!(state(39), TrackingState::Tracking);
    assert_eq!(state(41), TrackingState::Coasting);
    assert_eq!(state(70), TrackingState::Coasting);
    assert_eq!(state(71), TrackingState::Lost);
    assert_eq!(state(91), TrackingState::Lost);
    // From the first frame of the return on.
    assert!((92..121).all(|i| state(i) == TrackingState::Tracking));
    let mut times: Vec<_> = run.poses.iter().map(|pose| pose.capture).collect();
    times.dedup();
    assert_eq!(times.len(), run.poses.len(), "one pose a frame");
    assert!(times.is_sorted());
}

#[test]
fn a_stream_without_people_gives_no_pose_and_an_event() {
    let mut frames = stream(41);
    frames.iter_mut().for_each(|frame| frame.people.clear());
    let run = run(config(), frames);
    assert!(run.poses.is_empty());
    assert!(run.events[&EventKind::NobodyFound] >= 1);
}

#[test]
fn a_bystander_in_some_views_is_not_followed() {
    let clean = run(config(), stream(41));
    let mut frames = stream(41);
    for frame in frames.iter_mut().filter(|f| f.camera < 2) {
        let mut bystander = frame.people[0].clone();
        for point in bystander.points.iter_mut().flatten() {
            point.pixel = Point2::new(0.5 * point.pixel.x + 60.0, 0.5 * point.pixel.y + 30.0);
        }
        frame.people.insert(0, bystander);
    }
    let crowded = run(config(), frames);
    for (a, b) in clean.poses.iter().zip(&crowded.poses) {
        assert!((a.pose.root_position - b.pose.root_position).norm() < 5e-3);
    }
    assert_eq!(clean.poses.len(), crowded.poses.len());
}

/// Twenty people in sixteen views, some with points far outside the image. The work is bounded; one of
/// the people is found.
#[cfg(feature = "research")]
#[test]
fn somebody_is_found_in_a_crowd() {
    let rig = bundlemocap::research::synth::ring_rig(16, 6.0, 2.0).unwrap();
    let rig = Arc::new(rig);
    let (points, decoder) = (fitted_points(FORMAT), Decoder::embedded().unwrap());
    let skeleton = Skeleton::new(truth_shape());
    let mut frames: Vec<Detections> = Vec::new();
    let mut truths = Vec::new();
    for person in 0..20 {
        let mut at = keyframe(0.7 + 0.1 * f64::from(person), 0.25);
        let place = Vector3::new(f64::from(person % 5) - 2.0, 0.0, f64::from(person / 5) - 1.5);
        at.root_position += place;
        truths.push(at.root_position);
        let posture = decoder.pose(&at).posture(&skeleton);
        for i in 0..12 {
            let seen = observe(&rig, &points, &posture, &skeleton);
            for (k, frame) in detections(&rig, &points, &seen, i).into_iter().enumerate() {
                match frames.get_mut(16 * i + k) {
                    Some(set) => set.people.extend(frame.people),
                    None => frames.push(frame),
                }
            }
        }
    }
    for frame in &mut frames {
        let last = frame.people[19].points.iter_mut().flatten().next().unwrap();
        last.pixel = Point2::new(1e9, -1e9);
    }
    let mut tracker = Tracker::new(Config { shape_windows: 1, ..Config::default() }, rig);
    let mut solver = Solver::new(Decoder::embedded().unwrap(), Config::default());
    let mut found = Vec::new();
    for input in frames.into_iter().map(Input::Detections).chain([Input::End]) {
        tracker.handle(input);
        while let Some(output) = tracker.poll_and_solve(|job| solver.solve(job)) {
            if let Output::Pose(pose) = output {
                found.push(pose.pose.root_position);
            }
        }
    }
    let nearest =
        truths.iter().map(|truth| (truth - found[0]).norm()).fold(f64::INFINITY, f64::min);
    assert!(nearest < 0.05, "{nearest}");
}

#[test]
fn frames_of_cameras_without_genlock_are_combined() {
    let (rig, decoder) = (ring(), Decoder::embedded().unwrap());
    let (points, skeleton) = (fitted_points(FORMAT), Skeleton::new(truth_shape()));
    let stagger = Nanos::new(16_666_667) / 5;
    let mut frames = stream(41);
    for frame in &mut frames {
        // Each camera sees the pose of its own time.
        let late = stagger * frame.camera as i64;
        frame.capture = frame.capture + late;
        let s = (frame.frame % 10) as f64 / 10.0 + late.seconds() * 6.0;
        let k = frame.frame as usize / 10 * 10;
        let at = Interpolation::Slerp.keyframe(&truth(k), &truth(k + 10), s);
        let posture = decoder.pose(&at).posture(&skeleton);
        for seen in observe(&rig, &points, &posture, &skeleton) {
            if seen.camera == frame.camera {
                let index = points[seen.point].index;
                let pixel = Point2::from(seen.pixel);
                frame.people[0].points[index] = Some(Detection { pixel, confidence: 0.9 });
            }
        }
    }
    let run = run(config(), frames);
    assert!(run.poses.len() >= 41);
    assert!(run.poses.iter().all(|pose| pose.state == TrackingState::Tracking));
    let on_grid = run.poses.iter().take(40).map(|pose| {
        let i = (pose.capture.ns() as f64 * 60e-9).round() as usize;
        let expected = decoder.pose(&truth(i)).posture(&skeleton);
        let found = pose.pose.posture(run.skeleton.as_ref().unwrap());
        (found.positions[21] - expected.positions[21]).norm()
    });
    assert!(on_grid.fold(0.0, f64::max) < 5e-3);
}

#[test]
fn a_wrong_time_stamp_does_not_break_the_stream() {
    let mut frames = stream(61);
    frames[100].capture = frames[100].capture + Nanos::SECOND * 3600;
    let run = run(config(), frames);
    assert_eq!(run.events[&EventKind::Unusable], 1);
    assert_eq!(run.poses.len(), 61);
    assert!(run.poses.iter().all(|pose| pose.state == TrackingState::Tracking));
}

#[test]
fn frames_with_flaws_are_counted_and_do_not_break_the_stream() {
    let mut frames = stream(61);
    let clean = run(config(), frames.clone());
    for (at, flaw) in (100..).step_by(9).zip(0..4) {
        let frame = &mut frames[at];
        let points = &mut frame.people[0].points;
        let first = points.iter_mut().flatten().next().unwrap();
        match flaw {
            0 => points.truncate(10),
            1 => first.confidence = f64::NAN,
            2 => first.pixel.x = f64::INFINITY,
            _ => frame.capture = Timestamp::from_ns(i64::MAX),
        }
    }
    let found = run(config(), frames);
    assert_eq!(found.events[&EventKind::Unusable], 4);
    assert_eq!(found.poses.len(), clean.poses.len());
    // A detector's score above 1 counts as 1.
    let scaled = |by: f64| {
        let mut frames = stream(61);
        let people = frames.iter_mut().flat_map(|frame| &mut frame.people);
        let points = people.flat_map(|person| &mut person.points).flatten();
        points.for_each(|point| point.confidence = by);
        run(config(), frames).poses
    };
    assert_eq!(scaled(1.0), scaled(70.0));
}

#[test]
fn a_performer_that_only_one_camera_sees_is_not_tracked() {
    let mut frames = stream(61);
    for frame in frames.iter_mut().filter(|f| f.frame > 30 && f.camera > 0) {
        frame.people.clear();
    }
    let run = run(config(), frames);
    assert_eq!(run.events[&EventKind::Coasted], 3);
    assert_eq!(run.poses.last().unwrap().state, TrackingState::Coasting);
}

#[test]
fn a_short_absence_is_extrapolated() {
    let mut frames = stream_of(81, |i| truth(i / 2));
    for frame in frames.iter_mut().filter(|f| (31..51).contains(&f.frame)) {
        frame.people.clear();
    }
    let run = run(config(), frames);
    assert_eq!(run.events[&EventKind::Coasted], 2);
    assert_eq!(run.events[&EventKind::Acquired], 1, "no new search");
    let coasting = |pose: &&StampedPose| pose.state == TrackingState::Coasting;
    assert_eq!(run.poses.iter().filter(coasting).count(), 20);
    assert_eq!(run.poses.last().unwrap().state, TrackingState::Tracking);
}

/// Who is found again at once is the same performer: what is known of the body stays. Later it may be somebody else.
#[test]
fn the_estimate_of_the_body_goes_on_after_a_short_break() {
    let config = Config::default();
    let windows = |away: std::ops::Range<u64>| {
        let mut tracker = Tracker::new(config, Arc::new(ring()));
        let mut solver = Solver::new(Decoder::embedded().unwrap(), config);
        let mut found = 0;
        let frames = stream(400).into_iter().map(|mut frame| {
            frame.people.retain(|_| !away.contains(&frame.frame));
            frame
        });
        run_to_end(&mut tracker, &mut solver, frames, |output| {
            let is_found =
                matches!(&output, Output::Event(event) if event.kind == EventKind::Acquired);
            found += usize::from(is_found);
        });
        (found, tracker.body_estimate().windows())
    };
    let (found, soon) = windows(260..300);
    assert!(found == 2 && soon >= 15, "{found} {soon}");
    let (found, late) = windows(260..340);
    assert!(found == 2 && late <= 4, "{found} {late}");
}

/// A camera at half the rate, with frames at the times between, counts with half of the frames, too.
#[test]
fn each_camera_counts_with_less_effort() {
    let config = Config::default();
    let mut tracker = Tracker::new(config, Arc::new(ring()));
    tracker.set_effort(Effort { stride: 2, ..Effort::full(&config) });
    let is_there =
        |frame: &Detections| frame.camera == 0 || (frame.camera, frame.frame % 2) == (1, 1);
    let run = run_with(tracker, config, stream(120).into_iter().filter(is_there));
    assert!(run.windows.len() > 20, "{}", run.windows.len());
    assert!(
        run.windows.iter().all(|window| window.verdict == Verdict::Tracked),
        "{:?}",
        run.events
    );
}

#[test]
fn the_shape_waits_for_enough_frames() {
    let mut frames = stream(101);
    for frame in frames.iter_mut().filter(|f| f.frame < 25) {
        frame.people.clear();
    }
    let run = run(config(), frames);
    let (found, truth) = (run.skeleton.clone().unwrap(), Skeleton::new(truth_shape()));
    for joint in [Joint::LKnee, Joint::LAnkle, Joint::LElbow, Joint::LWrist] {
        let difference = found.offset(joint).norm() - truth.offset(joint).norm();
        assert!(difference.abs() < 5e-3, "{} {difference} m", joint.name());
    }
    assert!((run.poses[0].capture - frame(25)).abs() < Nanos::new(10));
}

#[test]
fn keypoint_offsets_are_estimated() {
    let (rig, points, decoder) = (ring(), fitted_points(FORMAT), Decoder::embedded().unwrap());
    let marks = |i| if i < SYMMETRIC_OFFSETS { 1.5 * (1.3 * i as f64).sin() } else { 0.0 };
    let marks = KeypointOffsets(std::array::from_fn(marks));
    let (seen_as, body) = (Skeleton::default().with_keypoint_offsets(marks), Skeleton::default());
    let step =
        |i: usize| keyframe(0.7 + 0.02 * i as f64 / 10.0, 0.25 + 0.1 * (i as f64 / 9.0).sin());
    let frames: Vec<_> = (0..240)
        .flat_map(|i| {
            let posture = decoder.pose(&step(i)).posture(&seen_as);
            detections(&rig, &points, &observe(&rig, &points, &posture, &seen_as), i)
        })
        .collect();
    let error = |body_windows: usize| {
        let run = run(Config { body_windows, ..Config::default() }, frames.clone());
        let skeleton = run.skeleton.unwrap();
        let late = run.poses.iter().skip(120).map(|pose| {
            let i = (pose.capture.ns() as f64 * 60e-9).round() as usize;
            let (found, truth) =
                (pose.pose.posture(&skeleton), decoder.pose(&step(i)).posture(&body));
            let pairs = found.positions.iter().zip(&truth.positions);
            pairs.map(|(a, b)| (a - b).norm()).sum::<f64>()
        });
        late.sum::<f64>()
    };
    let (without, with) = (error(0), error(4));
    assert!(with < 0.9 * without, "{with} {without}");
}

#[test]
fn a_wrong_body_is_replaced_within_two_seconds() {
    let moves = |i: usize| {
        let at = |k: usize| keyframe(0.7 + 0.02 * k as f64, 0.25 + 0.1 * (k as f64 / 9.0).sin());
        Interpolation::Slerp.keyframe(&at(i / 10), &at(i / 10 + 1), (i % 10) as f64 / 10.0)
    };
    let frames = stream_of(240, moves);
    let tracked = |body: Skeleton| {
        let config = Config::default();
        let tracker = Tracker::new(config, Arc::new(ring())).with_body_to_check(Arc::new(body));
        let mut found = Vec::new();
        let mut solver = Solver::new(Decoder::embedded().unwrap(), config);
        run_to_end(&mut { tracker }, &mut solver, frames.clone(), |output| {
            if let Output::Event(event) = output
                && event.kind == EventKind::Body
            {
                found.push(event.capture);
            }
        });
        found
    };
    let right = Skeleton::new(truth_shape());
    assert_eq!(tracked(right), []);
    let wrong = Skeleton::new(Shape(truth_shape().0.map(|c| 2.0 - c)));
    let found = tracked(wrong);
    assert_eq!(found.len(), 1, "{found:?}");
    assert!(found[0].seconds_since(frame(0)) < 2.0, "{found:?}");
}

/// The frame with left and right exchanged.
fn with_swapped_sides(mut frame: Detections) -> Detections {
    let keypoints = FORMAT.keypoints();
    let mirrored = |k: usize| {
        let (left, side) = keypoints[k].of_left();
        keypoints.iter().position(|other| other.of_left() == (left, -side)).unwrap_or(k)
    };
    for person in &mut frame.people {
        let seen = person.points.clone();
        (0..seen.len()).for_each(|k| person.points[k] = seen[mirrored(k)]);
    }
    frame
}

#[test]
fn a_start_with_swapped_sides_heals() {
    for swapped in [1, 10, 30] {
        let turn = |frame: Detections| match frame.frame < swapped {
            true => with_swapped_sides(frame),
            false => frame,
        };
        let run = run(Config::default(), stream(181).into_iter().map(turn));
        let error = mean_error(&run, swapped as usize + 60, truth);
        assert!(error < 8e-3, "{swapped} frames: {error} m");
    }
}

/// Within a window the performer moves further than the range of the loss, and back.
#[test]
fn fast_motion_is_tracked() {
    let truth = |i: usize| {
        let (x, y) = (0.4 * i as f64).sin_cos();
        let pose = truth(i / 4);
        Keyframe { root_position: pose.root_position + 0.5 * Vector3::new(x, y, 0.0), ..pose }
    };
    let run = run(Config::default(), stream_of(121, truth));
    assert!(run.poses.len() > 100 && run.windows.iter().all(|w| w.verdict == Verdict::Tracked));
    for pose in &run.poses {
        let i = (pose.capture.ns() as f64 * 60e-9).round() as usize;
        let off = (pose.pose.root_position - truth(i).root_position).norm();
        assert!(off < 0.3, "{off} m in frame {i}");
    }
}

/// Mean distance of the joints from the truth, metres, in the poses from `first` on.
fn mean_error(run: &Run, first: usize, truth: impl Fn(usize) -> Keyframe) -> f64 {
    let (decoder, body) = (Decoder::embedded().unwrap(), Skeleton::new(truth_shape()));
    let skeleton = run.skeleton.as_ref().unwrap();
    let (mut sum, mut count) = (0.0, 0.0);
    for pose in &run.poses {
        let i = (pose.capture.ns() as f64 * 60e-9).round() as usize;
        if i >= first {
            let (a, b) = (pose.pose.posture(skeleton), decoder.pose(&truth(i)).posture(&body));
            let pairs = a.positions.iter().zip(&b.positions);
            sum += pairs.map(|(a, b)| (a - b).norm()).sum::<f64>();
            count += a.positions.len() as f64;
        }
    }
    sum / count
}

/// A knee bends to the side by eleven degrees.
#[test]
fn corrections_follow_poses_beside_the_manifold() {
    let knee = CORRECTED.iter().position(|joint| *joint == Joint::LKnee).unwrap();
    let off = |i: usize| {
        let mut correction = Correction::default();
        correction.0[3 * knee + 2] = 0.2;
        Keyframe { correction, ..truth(i) }
    };
    let error = |correction_prior: f64| {
        let mut config = Config::default();
        config.cost.correction_prior = correction_prior;
        // The feet of this motion are slow, and do not stand.
        config.cost.foot_contact = 0.0;
        let body = Arc::new(Skeleton::new(truth_shape()));
        let tracker = Tracker::new(config, Arc::new(ring())).with_body(body);
        mean_error(&run_with(tracker, config, stream_of(121, off)), 0, off)
    };
    let (without, with) = (error(0.0), error(Config::default().cost.correction_prior));
    assert!(with < 0.85 * without, "{with} {without}");
}

/// The window before ended with the body facing backwards, a minimum that the window's solve does not
/// leave.
#[test]
fn a_fresh_fit_replaces_a_wrong_minimum() {
    let still = |_: usize| truth(0);
    let config = Config::default();
    let (mut job, _) = solved(config, stream_of(61, still)).swap_remove(3);
    let Task::Track { past, ahead, .. } = &mut job.task else { panic!("not tracking") };
    ahead.clear();
    for at in past {
        at.keyframe.root_rotation *= so3::about(1, std::f64::consts::PI);
    }
    let turned = |pose: &Pose| so3::angle_between(&pose.root_rotation, &still(0).root_rotation);
    let mut solver = Solver::new(Decoder::embedded().unwrap(), config);
    let mut outcome = |window: u64| {
        job.window = window;
        solver.solve(&job).outcome
    };
    let Outcome::Tracked(tracked) = outcome(7) else { panic!("not tracked") };
    assert!(tracked.poses.iter().all(|pose| turned(pose) > 2.0));
    // `fresh_fit_windows` is 8.
    let Outcome::Acquired { pose, .. } = outcome(8) else { panic!("not replaced") };
    assert!(turned(&pose) < 0.1, "{} rad", turned(&pose));
}

/// A window's first keyframes are blended with those of the previous window, with shares that fall
/// to zero at the start of the next window.
#[test]
fn a_window_starts_blended_with_the_previous_one() {
    let config = Config { change_threshold: 0.0, iterations: 100, ..Config::default() };
    let mut solver = Solver::new(Decoder::embedded().unwrap(), config);
    let (mut job, _) = solved(config, stream(61)).swap_remove(3);
    let mut positions = |job: &Job| {
        let Outcome::Tracked(tracked) = solver.solve(job).outcome else { panic!("not tracked") };
        tracked.keyframes.iter().map(|at| at.keyframe.root_position).collect::<Vec<_>>()
    };
    let own = positions(&job);
    let Task::Track { ahead, .. } = &mut job.task else { panic!("not tracking") };
    assert_eq!((ahead.len(), own.len()), (5, 10));
    ahead.iter_mut().for_each(|at| at.keyframe.root_position.x += 0.02);
    let shifted = positions(&job);
    let shift = |k: usize| shifted[k].x - own[k].x;
    for (k, expected) in [0.008, 0.006, 0.004, 0.002, 0.0, 0.0].into_iter().enumerate() {
        assert!((shift(k) - expected).abs() < 2e-4, "{k}: {} m", shift(k));
    }
}

/// The residual level of earlier windows scales the prior of a window: for exact detections the
/// prior is nearly zero.
#[test]
fn weights_scale_with_the_residual_level() {
    let jobs = |reference_residual_px: f64| {
        let config = Config { reference_residual_px, ..Config::default() };
        let tracked = solved(config, stream(61)).into_iter().filter_map(|(job, outcome)| {
            let Outcome::Tracked(tracked) = outcome else { return None };
            Some((job.noise, tracked.summary.unwrap().final_cost))
        });
        tracked.collect::<Vec<_>>()
    };
    let (fixed, by_errors) = (jobs(0.0), jobs(7.0));
    assert_eq!(by_errors[0], (Noise::default(), fixed[0].1));
    assert!(by_errors.len() > 5 && by_errors.windows(2).all(|pair| pair[0].0 != pair[1].0));
    let (last, fixed) = (by_errors.last().unwrap().1, fixed.last().unwrap().1);
    assert!(last < 0.65 * fixed, "{last} {fixed}");
}

#[test]
fn two_threads_give_the_same_solutions() {
    let poses = |threads| run(Config { threads, ..Config::default() }, stream(61)).poses;
    let alone = poses(1);
    assert!(alone.len() > 50, "{}", alone.len());
    assert_eq!(poses(2), alone);
}

//! Several performers on a stage: who they are, when they come and go.

use std::sync::Arc;

use bundlemocap::core::body::{Pose, Shape, Skeleton, TrackingState};
use bundlemocap::core::camera::Rig;
use bundlemocap::core::detections::{Detections, Keypoint as K};
use bundlemocap::core::random::Draws;
use bundlemocap::core::stage::{self, Change, Choice, Known, PerformerId, Performers, Stage};
use bundlemocap::core::time::Nanos;
use bundlemocap::core::tracker::EventKind;
use bundlemocap::research::synth::{
    Crowd, Meeting, Motion, MotionStyle, Noise, Recording, ring_rig,
};
use bundlemocap::{Decoder, Output, Solver, StampedPose, Tracker, TrackerConfig};
use nalgebra::Vector3;

const FPS: f64 = 30.0;

type AnyMotion = Box<dyn Fn(f64) -> Pose>;

/// People with bodies of their own, whose places are `at(person, seconds)`.
fn people(
    shapes: &[f64],
    seconds: f64,
    at: impl Fn(usize, f64) -> Vector3<f64> + Clone + 'static,
) -> Crowd<AnyMotion> {
    people_at(FPS, shapes, seconds, at)
}

/// The same at another frame rate.
fn people_at(
    fps: f64,
    shapes: &[f64],
    seconds: f64,
    at: impl Fn(usize, f64) -> Vector3<f64> + Clone + 'static,
) -> Crowd<AnyMotion> {
    let rig = ring_rig(4, 5.0, 2.0).unwrap();
    let one = |(person, shape): (usize, &f64)| {
        let skeleton = Skeleton::new(Shape::symmetric([*shape; 10]));
        let motion = Motion::new(&skeleton, MotionStyle::default());
        let at = at.clone();
        let place = move |seconds: f64| {
            let mut pose = motion.pose(seconds);
            let height = Vector3::y() * pose.root_position.y;
            pose.root_position = at(person, seconds) + height;
            pose
        };
        let mut recording = Recording::new(rig.clone(), skeleton, Box::new(place) as AnyMotion);
        (recording.fps, recording.frames) = (fps, (seconds * fps) as u64);
        (recording.noise, recording.seed) = (Noise::clean(), 5 + person as u64);
        recording
    };
    Crowd::new(shapes.iter().enumerate().map(one).collect())
}

/// What came out of a stage.
#[derive(Default)]
struct Result {
    poses: Vec<(usize, StampedPose)>,
    events: Vec<(usize, EventKind)>,
    /// Events of the cameras.
    cameras: Vec<EventKind>,
    others: usize,
    known: Vec<Known>,
}

impl Result {
    fn events(&self, kind: EventKind) -> Vec<usize> {
        self.events.iter().filter(|event| event.1 == kind).map(|event| event.0).collect()
    }

    /// The largest distance of the tracked roots of a performer from places on the floor, metres.
    fn off(&self, performer: usize, start: f64, at: impl Fn(f64) -> Vector3<f64>) -> f64 {
        let own = self.poses.iter().filter(|(number, pose)| {
            *number == performer && pose.capture.ns() as f64 * 1e-9 >= start
        });
        let off = own.map(|(_, pose)| {
            let seconds = pose.capture.ns() as f64 * 1e-9;
            (pose.pose.root_position.xz() - at(seconds).xz()).norm()
        });
        off.fold(0.0, f64::max)
    }
}

fn run(rig: &Rig, frames: impl Iterator<Item = Detections>, performers: &str) -> Result {
    run_choosing(rig, frames, performers, Choice::default())
}

fn run_choosing(
    rig: &Rig,
    frames: impl Iterator<Item = Detections>,
    performers: &str,
    choice: Choice,
) -> Result {
    run_inputs(rig, frames.map(stage::Input::Detections), performers, choice)
}

fn run_inputs(
    rig: &Rig,
    inputs: impl Iterator<Item = stage::Input>,
    performers: &str,
    choice: Choice,
) -> Result {
    let config = TrackerConfig::default();
    let mut solver = Solver::new(Decoder::embedded().unwrap(), config);
    let tracker = Tracker::new(config, Arc::new(rig.clone()));
    let performers: Performers = performers.parse().unwrap();
    let mut stage = Stage::new(tracker, performers, None).choosing(choice);
    let mut result = Result::default();
    for input in inputs.chain([stage::Input::End]) {
        stage.handle(input);
        while let Some(output) = stage.poll_and_solve(|job| solver.solve(job)) {
            match output {
                stage::Output::Performer(PerformerId(performer), Output::Pose(pose)) => {
                    result.poses.push((performer, *pose));
                }
                stage::Output::Performer(PerformerId(performer), Output::Event(event)) => {
                    result.events.push((performer, event.kind));
                }
                stage::Output::Event(event) => result.cameras.push(event.kind),
                _ => {}
            }
        }
    }
    (result.others, result.known) = (stage.others(), stage.known());
    result
}

fn zero(crowd: &Crowd<AnyMotion>) -> impl Iterator<Item = Detections> + '_ {
    seen(crowd, |_, _, _| true)
}

/// The frames from the time 0, with the people of whom `is_seen(person, camera, seconds)` is true.
fn seen(
    crowd: &Crowd<AnyMotion>,
    is_seen: impl Fn(usize, usize, f64) -> bool,
) -> impl Iterator<Item = Detections> {
    let start = crowd.people()[0].start;
    crowd.detections().map(move |(mut frame, owners)| {
        frame.capture = bundlemocap::Timestamp::default() + (frame.capture - start);
        let seconds = frame.capture.ns() as f64 * 1e-9;
        let mut owners = owners.into_iter();
        frame
            .people
            .retain(|_| owners.next().is_some_and(|owner| is_seen(owner, frame.camera, seconds)));
        frame
    })
}

#[test]
fn one_performer_is_the_trackers_own_affair() {
    let crowd = people(&[0.0], 3.0, |_, _| Vector3::zeros());
    let rig = &crowd.people()[0].rig;
    let config = TrackerConfig::default();
    let mut tracker = Tracker::new(config, Arc::new(rig.clone()));
    let mut solver = Solver::new(Decoder::embedded().unwrap(), config);
    let mut alone = Vec::new();
    bundlemocap::core::tracker::run_to_end(&mut tracker, &mut solver, zero(&crowd), |output| {
        alone.push(format!("{output:?}"));
    });
    let tracker = Tracker::new(config, Arc::new(rig.clone()));
    let mut stage = Stage::new(tracker, Performers::default(), None);
    let mut on_stage = Vec::new();
    for input in zero(&crowd).map(stage::Input::Detections).chain([stage::Input::End]) {
        stage.handle(input);
        while let Some(stage::Output::Performer(PerformerId(0), output)) =
            stage.poll_and_solve(|job| solver.solve(job))
        {
            on_stage.push(format!("{output:?}"));
        }
    }
    assert!(alone.len() > 80 && alone == on_stage);
}

#[test]
fn people_who_cross_and_meet_keep_their_numbers() {
    let meeting = Meeting { people: 3, distance: Some(0.6) };
    let rig = meeting.rig(5).unwrap();
    let person = |person| {
        let (skeleton, motion) = meeting.person(person, 3);
        let mut one = Recording::new(rig.clone(), skeleton, Box::new(motion) as AnyMotion);
        (one.fps, one.frames, one.noise) = (FPS, 14 * FPS as u64, Noise::studio());
        one
    };
    let crowd = Crowd::new((0..3).map(person).collect());
    let result = run(&rig, zero(&crowd), "auto");
    assert_eq!(result.events(EventKind::Entered), [0, 1, 2]);
    assert!(result.events(EventKind::Merged).is_empty() && result.others == 0);
    let mut actors: Vec<usize> = (0..3)
        .map(|performer| {
            let off = |actor: usize| {
                result.off(performer, 0.0, |s| (crowd.people()[actor].motion)(s).root_position)
            };
            let actor = (0..3).min_by(|a, b| off(*a).total_cmp(&off(*b))).unwrap();
            assert!(off(actor) < 0.12, "{performer}: {} m", off(actor));
            let count = result.poses.iter().filter(|(number, _)| *number == performer).count();
            assert!(count + 3 > 14 * FPS as usize, "{count} poses of {performer}");
            actor
        })
        .collect();
    actors.sort_unstable();
    assert_eq!(actors, [0, 1, 2]);
}

/// One is in the region, one comes in after 3.6 s and goes out again, one stays outside.
#[test]
fn who_enters_the_region_becomes_a_performer_and_stays_one() {
    let at = |person: usize, seconds: f64| match person {
        0 => Vector3::new(-0.9, 0.0, 0.0),
        1 => {
            let inwards = (seconds - 3.0).clamp(0.0, 1.5) - (seconds - 6.0).clamp(0.0, 1.5);
            Vector3::new(1.8 - inwards, 0.0, 0.5)
        }
        _ => Vector3::new(-1.6, 0.0, 1.6),
    };
    let crowd = people(&[0.3, -1.0, 1.6], 10.0, at);
    let rig = &crowd.people()[0].rig;
    let region = vec![[-1.2, -1.2], [1.2, -1.2], [1.2, 1.2], [-1.2, 1.2]];
    let choice = Choice { region, ..Choice::default() };
    let result = run_choosing(rig, zero(&crowd), "auto", choice);
    assert_eq!(result.events(EventKind::Entered), [0, 1]);
    assert_eq!((result.others, result.events(EventKind::Merged).len()), (2, 0));
    for performer in 0..2 {
        let own = result.poses.iter().filter(|(number, _)| *number == performer);
        let times: Vec<f64> = own.map(|(_, pose)| pose.capture.ns() as f64 * 1e-9).collect();
        let begin = [0.0, 3.6][performer];
        assert!((begin..begin + 0.4).contains(&times[0]), "{performer}: {}", times[0]);
        assert!(*times.last().unwrap() > 9.8, "{performer}: {times:?}");
        let off = result.off(performer, begin + 0.4, |seconds| at(performer, seconds));
        assert!(off < 0.12, "{performer}: {off} m");
    }
    // All are smaller in the images.
    let choice = Choice { min_height_px: 5e3, ..Choice::default() };
    let result = run_choosing(rig, zero(&crowd), "auto", choice);
    assert_eq!((result.events(EventKind::Entered).len(), result.others), (0, 3));
}

/// The second person leaves for ten seconds and comes back elsewhere; then a taller one comes.
#[test]
fn who_comes_back_has_the_old_number_and_somebody_else_has_a_new_one() {
    let at = |person: usize, seconds: f64| match person {
        0 => Vector3::new(-0.9, 0.0, 0.0),
        1 if seconds < 5.0 => Vector3::new(0.9, 0.0, 0.4),
        1 => Vector3::new(0.5, 0.0, -0.9),
        _ => Vector3::new(0.8, 0.0, 0.9),
    };
    let crowd = people(&[0.3, -1.0, 1.6], 18.0, at);
    let rig = &crowd.people()[0].rig;
    let is_there = |owner: usize, seconds: f64| match owner {
        0 => true,
        1 => seconds < 3.0 || (13.0..15.0).contains(&seconds),
        _ => seconds > 16.5,
    };
    let result = run(rig, seen(&crowd, |owner, _, seconds| is_there(owner, seconds)), "auto");
    assert_eq!(result.events(EventKind::Entered), [0, 1, 2]);
    assert_eq!(result.events(EventKind::Reentered), [1]);
    assert!(result.off(0, 0.0, |s| at(0, s)) < 0.1 && result.off(2, 0.0, |s| at(2, s)) < 0.1);
    let back = result
        .poses
        .iter()
        .filter(|(number, pose)| *number == 1 && pose.capture.ns() > Nanos::from_ms(13_000).ns());
    let back: Vec<_> = back.collect();
    // Within half a second.
    assert!(back[0].1.capture.ns() < Nanos::from_ms(13_500).ns());
    assert!(result.off(1, 13.0, |s| at(1, s)) < 0.12);
    // A tracker without a performer does not search.
    let gone = result.poses.iter().filter(|(number, pose)| {
        *number == 1 && (4_500..13_000).contains(&(pose.capture.ns() / 1_000_000))
    });
    assert_eq!(gone.count(), 0);
}

/// The second one leaves after three seconds; a third one comes after five.
#[test]
fn a_place_is_somebody_elses_when_a_performer_has_left() {
    let at = |person: usize, _: f64| Vector3::new(0.9 * (person as f64 - 1.0), 0.0, 0.5);
    let crowd = people(&[0.3, -1.0, 1.6], 10.0, at);
    let entered = |left_after_s: f64| {
        let frames = seen(&crowd, |person, _, seconds| match person {
            0 => true,
            1 => seconds < 3.0,
            _ => seconds > 5.0,
        });
        let choice = Choice { left_after_s, ..Choice::default() };
        let result = run_choosing(&crowd.people()[0].rig, frames, "2", choice);
        let first = result.poses.iter().filter(|(number, _)| *number == 2);
        let first = first.map(|(_, pose)| pose.capture.ns() as f64 * 1e-9).reduce(f64::min);
        (result.events(EventKind::Entered), result.events(EventKind::Vacated), first)
    };
    let (numbers, left, first) = entered(4.0);
    assert_eq!((numbers, left), (vec![0, 1, 2], vec![1]));
    assert!((7.0..8.0).contains(&first.unwrap()), "{first:?}");
    // Nobody has left yet.
    let (numbers, left, _) = entered(30.0);
    assert_eq!((numbers, left), (vec![0, 1], vec![]));
}

/// The second one walks into the place of the first one, and after a second out again.
#[test]
fn two_who_were_taken_for_one_are_two_when_they_part() {
    let at = |person: usize, seconds: f64| {
        let off = ((seconds - 4.0).abs() - 0.5).clamp(0.0, 1.2);
        Vector3::new(if person == 0 { 0.0 } else { off }, 0.0, 0.3)
    };
    let crowd = people(&[0.5, -0.5], 9.0, at);
    let result = run(&crowd.people()[0].rig, zero(&crowd), "2");
    assert_eq!(result.events(EventKind::Entered), [0, 1]);
    assert_eq!(result.events(EventKind::Merged), [1]);
    assert_eq!(result.events(EventKind::Reentered), [1]);
    let off = result.off(1, 7.0, |seconds| at(1, seconds));
    assert!(off < 0.15, "{off} m");
}

/// They go away together from an embrace. The one who was merged comes back first.
#[test]
fn who_was_merged_comes_back_before_the_other_one() {
    let at = |person: usize, seconds: f64| {
        let off = (4.5 - seconds).clamp(0.0, 1.2);
        Vector3::new(if person == 0 || seconds > 6.0 { 0.0 } else { off }, 0.0, 0.3)
    };
    let crowd = people(&[0.5, -0.8], 12.0, at);
    let is_there = |owner: usize, _: usize, seconds: f64| {
        seconds < 5.5 || seconds > if owner == 1 { 7.5 } else { 20.0 }
    };
    for performers in ["2", "auto"] {
        let result = run(&crowd.people()[0].rig, seen(&crowd, is_there), performers);
        assert_eq!(result.events(EventKind::Merged), [1], "{:?}", result.events);
        assert_eq!(result.events(EventKind::Entered), [0, 1], "{:?}", result.events);
        assert_eq!(result.events(EventKind::Reentered), [1], "{:?}", result.events);
    }
}

#[test]
fn people_above_the_limit_are_counted_and_are_nobodys() {
    let at = |person: usize, seconds: f64| {
        let angle = 2.1 * person as f64 + 0.8 * seconds;
        Vector3::new(angle.sin(), 0.0, angle.cos()) * 0.9
    };
    let crowd = people(&[0.0, 1.0, -1.0], 4.0, at);
    let result = run(&crowd.people()[0].rig, zero(&crowd), "2");
    assert_eq!((result.events(EventKind::Entered), result.others), (vec![0, 1], 1));
    for performer in [0, 1] {
        let off = (0..3).map(|person| result.off(performer, 0.0, |s| at(person, s)));
        assert!(off.fold(f64::MAX, f64::min) < 0.1);
    }
}

/// Two cameras see one person, the other two another, who steps into the same place.
#[test]
fn two_in_one_place_are_one() {
    let at = |person: usize, seconds: f64| {
        let off = if person == 0 { 0.0 } else { (1.0 - 0.5 * seconds).max(0.0) };
        Vector3::new(off, 0.0, 0.0)
    };
    let crowd = people(&[0.0, 0.0], 5.0, at);
    let rig = &crowd.people()[0].rig;
    // In the same pose.
    let both: Vec<Vec<Detections>> =
        crowd.people().iter().map(|person| person.detections().collect()).collect();
    let frames = (0..both[0].len()).map(|index| {
        let camera = both[0][index].camera;
        let mut frame = both[usize::from(camera >= 2)][index].clone();
        frame.capture =
            bundlemocap::Timestamp::default() + (frame.capture - crowd.people()[0].start);
        frame
    });
    let result = run(rig, frames, "auto");
    assert_eq!(result.events(EventKind::Entered), [0, 1]);
    assert_eq!(result.events(EventKind::Merged), [1]);
    let last = result.poses.iter().filter(|(number, _)| *number == 1);
    assert!(last.map(|(_, pose)| pose.capture.ns()).max() < Some(Nanos::from_ms(3_500).ns()));
}

/// Bodies that were seen on another day tell people apart: each of 16 people comes in front of the cameras when four
/// bodies are known, with the own one among them, and without it.
#[test]
fn known_bodies_tell_people_apart() {
    let take = |day: u64, person: u64, seconds: f64| {
        let draws = Draws { seed: 9, stream: person };
        let normals = (0..5).flat_map(|pair| draws.normals(0, pair));
        let mut shape = Shape::default();
        shape
            .0
            .iter_mut()
            .zip(normals)
            .for_each(|(value, normal)| *value = normal.clamp(-2.5, 2.5));
        let skeleton = Skeleton::new(shape);
        let step_time = 0.5 + 0.1 * day as f64;
        let motion = Motion::new(&skeleton, MotionStyle { step_time, ..MotionStyle::default() });
        let rig = ring_rig(4, 4.0 + day as f64, 2.0).unwrap();
        let pose = move |seconds: f64| motion.pose(seconds + 3.3 * day as f64);
        let mut recording = Recording::new(rig, skeleton, Box::new(pose) as AnyMotion);
        (recording.fps, recording.frames) = (60.0, (seconds * 60.0) as u64);
        (recording.noise, recording.seed) = (Noise::clean(), 5 + person);
        recording
    };
    let crowd = |recording: &Recording<AnyMotion>| {
        let rig = Arc::new(recording.rig.clone());
        stage::Crowd::new(rig, TrackerConfig::default(), Performers::Auto, None)
    };
    // What happens, by the time, seconds.
    let run = |crowd: &mut stage::Crowd, recording: &Recording<AnyMotion>| {
        let mut all = Vec::new();
        for frame in recording.detections() {
            crowd.add(frame);
            while let Some((at, changes)) = crowd.next(false) {
                let at = at.seconds_since(recording.start);
                all.extend(changes.into_iter().map(|change| (at, change)));
            }
        }
        all
    };
    let first = |person: u64| {
        let recording = take(0, person, 4.0);
        let mut crowd = crowd(&recording);
        run(&mut crowd, &recording);
        crowd.known().remove(0)
    };
    let people = 16;
    let bodies: Vec<Known> = (0..people).map(first).collect();
    let [mut right, mut wrong] = [0, 0];
    for person in 0..people {
        for is_stranger in [false, true] {
            let known = |number: usize| Known {
                performer: PerformerId(number),
                lengths: bodies[(person as usize + number + usize::from(is_stranger)) % 16].lengths,
                ..Known::default()
            };
            let recording = take(1, person, 1.0);
            let mut crowd = crowd(&recording);
            crowd.know(&[0, 1, 2, 3].map(known));
            let changes = run(&mut crowd, &recording);
            let who = changes.iter().find_map(|(at, change)| match change {
                Change::Returned(number) => Some((*at, Some(*number))),
                Change::Entered(_) => Some((*at, None)),
                _ => None,
            });
            let (at, number) = who.unwrap();
            assert!(at < 0.5, "{person}: {at} s");
            let own = if is_stranger { None } else { Some(0) };
            right += u32::from(number == own);
            wrong += u32::from(number != own && number.is_some());
        }
    }
    assert!(
        right >= 30 && wrong <= 2,
        "{right} of 32 right, {wrong} have the name of somebody else"
    );
}

/// Half of the cameras see one of two people who touch, half the other; then they part, and all see both.
#[test]
fn two_on_one_track_are_two_when_they_part() {
    let at = |person: usize, seconds: f64| {
        let side = [-1.0, 1.0][person];
        Vector3::new(side * (0.17 + 0.8 * (seconds - 3.0).clamp(0.0, 1.5)), 0.0, 0.0)
    };
    let crowd = people(&[0.3, -1.0], 8.0, at);
    let rig = &crowd.people()[0].rig;
    let is_seen =
        |person: usize, camera: usize, seconds: f64| seconds > 3.0 || camera % 2 == person;
    let result = run(rig, seen(&crowd, is_seen), "auto");
    assert_eq!(result.events(EventKind::Entered), [0, 1]);
    let off = |performer: usize, actor: usize| result.off(performer, 4.0, |s| at(actor, s));
    let first = usize::from(off(0, 0) > 0.1);
    assert!(off(0, first) < 0.1 && off(1, 1 - first) < 0.1, "{:?}", result.events);
}

/// The first performer is hidden from 3 to 9 s. The other one, seen from `from` on, is in its place at `cross`.
#[test]
fn a_hidden_performers_place_is_not_somebody_elses() {
    let cases = [
        // After it is lost; bodies that differ much and little.
        (-1.0, 4.0, 6.0),
        (1.2, 4.0, 6.0),
        (-0.3, 4.0, 6.0),
        // While it coasts, by somebody new.
        (-1.0, 3.0, 3.6),
        (-1.0, 3.2, 4.0),
        // In its place, when it is seen first.
        (-1.0, 3.0, 3.3),
        (1.4, 3.5, 3.5),
        (-1.0, 3.8, 3.8),
    ];
    for (other, from, cross) in cases {
        let at = move |person: usize, seconds: f64| match person {
            0 => Vector3::zeros(),
            _ => Vector3::new(1.2 * (seconds - cross).clamp(-1.3, 1.3), 0.0, 0.1),
        };
        let crowd = people(&[0.3, other], 12.0, at);
        let rig = &crowd.people()[0].rig;
        let is_seen = |person: usize, _: usize, seconds: f64| match person {
            0 => !(3.0..9.0).contains(&seconds),
            _ => seconds > from,
        };
        let result = run(rig, seen(&crowd, is_seen), "auto");
        let case = format!("{other} {from} {cross}: {:?}", result.events);
        assert_eq!(result.events(EventKind::Entered), [0, 1], "{case}");
        assert_eq!(result.events(EventKind::Reentered).last(), Some(&0), "{case}");
        for performer in 0..2 {
            let own = result.poses.iter().filter(|(number, _)| *number == performer);
            let last = own.map(|(_, pose)| pose.capture.ns() as f64 * 1e-9).fold(0.0, f64::max);
            let off = result.off(performer, cross + 1.5, |seconds| at(performer, seconds));
            assert!(last > 11.8 && off < 0.1, "{performer} until {last} s, {off} m off; {case}");
        }
    }
}

#[test]
fn what_a_solver_knows_of_the_offsets_of_a_body_is_kept_by_the_stage() {
    let body = Arc::new(Skeleton::default());
    let rig = Arc::new(ring_rig(4, 5.0, 2.0).unwrap());
    let tracker = Tracker::new(TrackerConfig::default(), rig);
    let new = Stage::new(tracker, Performers::Auto, None).without_solving();
    let known = Known { body: Some(Arc::clone(&body)), ..Known::default() };
    let mut stage = new.clone().with_known(&[known]);
    let offsets_are_known = |stage: &Stage| stage.known()[0].offsets_are_known;
    assert!(!offsets_are_known(&stage));
    stage.know_body(PerformerId(0), body, true);
    assert!(offsets_are_known(&stage));
    // The next take begins with it.
    assert!(offsets_are_known(&new.with_known(&stage.known())));
}

/// Detectors change the lengths of bones with the pose. Who is always seen stays the same person, however slow the cameras
/// are.
#[test]
fn slow_cameras_make_nobody_somebody_else() {
    let at = |person: usize, _: f64| Vector3::new(1.4 * person as f64 - 0.7, 0.0, 0.3);
    let [before, after] = [[0.0, 1.0], [1.5, -0.5]].map(|shapes| people(&shapes, 32.0, at));
    let rig = &before.people()[0].rig;
    let changes = zero(&before).zip(zero(&after));
    let changes =
        changes.map(
            |(before, after)| {
                if after.capture.ns() < Nanos::from_ms(12_000).ns() { before } else { after }
            },
        );
    let slow = changes.filter(|frame| frame.frame % 5 == 0);
    let result = run(rig, slow, "auto");
    assert_eq!(result.events(EventKind::Entered), [0, 1]);
    assert!(result.events(EventKind::Reentered).is_empty());
    let last = result.poses.iter().filter(|(_, pose)| pose.capture.ns() > 31_000_000_000);
    assert!(last.count() >= 10);
}

/// The second performer comes back, and at first only the trunk is seen: that does not tell who it is.
#[test]
fn who_comes_back_half_hidden_is_recognised_later() {
    let at = |person: usize, _: f64| Vector3::new(1.8 * person as f64 - 0.9, 0.0, 0.3);
    let crowd = people(&[0.3, -1.0], 10.0, at);
    for performers in ["2", "auto"] {
        let is_there =
            |owner: usize, _: usize, seconds: f64| owner == 0 || !(4.0..6.0).contains(&seconds);
        let frames = seen(&crowd, is_there).map(|mut frame| {
            let half_hidden = 6_000_000_000..6_700_000_000;
            for person in
                frame.people.iter_mut().filter(|_| half_hidden.contains(&frame.capture.ns()))
            {
                for (index, point) in person.points.iter_mut().enumerate() {
                    let trunk = [K::LShoulder, K::RShoulder, K::LHip, K::RHip];
                    let is_trunk = trunk.iter().any(|&k| frame.format.index_of(k) == Some(index));
                    *point = point.filter(|_| is_trunk);
                }
            }
            frame
        });
        let result = run(&crowd.people()[0].rig, frames, performers);
        assert_eq!(result.events(EventKind::Entered), [0, 1], "{performers}");
        assert_eq!(result.events(EventKind::Reentered), [1], "{performers}");
        // What was measured before counts on: twice a frame for 4 and about 3 seconds.
        let measured = result.known[1].lengths[1][1];
        assert!(measured > 2.0 * FPS * 6.5, "{performers}: {measured}");
    }
}

/// A performer goes, and somebody of about the same build comes to the place at once.
#[test]
fn who_comes_where_a_performer_went_is_told_from_it_later() {
    let at = |person: usize, seconds: f64| match person {
        0 => Vector3::new(0.2, 0.0, 0.0),
        _ => Vector3::new(0.9 + 0.5 * (seconds - 3.3).clamp(0.0, 2.0), 0.0, 0.2),
    };
    let crowd = people(&[0.3, -0.42], 9.0, at);
    let is_there = |owner: usize, _: usize, seconds: f64| match owner {
        0 => !(3.0..7.0).contains(&seconds),
        _ => seconds > 3.3,
    };
    let result = run(&crowd.people()[0].rig, seen(&crowd, is_there), "auto");
    assert_eq!(result.events(EventKind::Entered), [0, 1], "{:?}", result.events);
    for performer in 0..2 {
        let off = result.off(performer, 7.5, |seconds| at(performer, seconds));
        assert!(off < 0.1, "{performer}: {off} m");
    }
}

/// Somebody steps into the place of a hidden performer, who is seen again beside it.
#[test]
fn a_performer_who_comes_out_beside_somebody_in_its_place_keeps_the_number() {
    let at = |person: usize, seconds: f64| match person {
        0 => Vector3::new(-1.2 * (seconds - 3.4).clamp(0.0, 1.0), 0.0, 0.0),
        _ => Vector3::new(0.1 + 1.2 * (3.3 - seconds).clamp(0.0, 1.0), 0.0, 0.1),
    };
    let crowd = people(&[0.3, -1.0], 9.0, at);
    for performers in ["2", "auto"] {
        let is_there = |owner: usize, _: usize, seconds: f64| match owner {
            0 => !(3.0..3.7).contains(&seconds),
            _ => seconds > 3.2,
        };
        let result = run(&crowd.people()[0].rig, seen(&crowd, is_there), performers);
        assert_eq!(result.events(EventKind::Entered), [0, 1], "{performers}: {:?}", result.events);
        for performer in 0..2 {
            let off = result.off(performer, 6.0, |seconds| at(performer, seconds));
            assert!(off < 0.1, "{performers}, {performer}: {off} m, {:?}", result.events);
        }
    }
}

/// Two performers meet in one place while a third person looks on.
#[test]
fn the_place_of_a_performer_in_an_embrace_is_kept() {
    let at = |person: usize, seconds: f64| {
        let off = ((seconds - 4.0).abs() - 0.5).clamp(0.0, 1.2);
        match person {
            0 => Vector3::new(0.0, 0.0, 0.3),
            1 => Vector3::new(off, 0.0, 0.3),
            _ => Vector3::new(-1.2, 0.0, -0.6),
        }
    };
    let crowd = people(&[0.5, -0.5, 1.5], 9.0, at);
    let is_there = |owner: usize, _: usize, seconds: f64| owner < 2 || seconds > 2.0;
    let result = run(&crowd.people()[0].rig, seen(&crowd, is_there), "2");
    assert_eq!(result.events(EventKind::Merged), [1]);
    assert_eq!(result.events(EventKind::Entered), [0, 1], "{:?}", result.events);
    assert_eq!(result.events(EventKind::Reentered), [1]);
    assert!(result.off(1, 7.0, |seconds| at(1, seconds)) < 0.15);
}

/// A wrong pairing that lasts for 50 ms is nobody, however fast the cameras are.
#[test]
fn fast_cameras_do_not_confirm_at_once() {
    let at = |person: usize, _: f64| Vector3::new(1.8 * person as f64 - 0.9, 0.0, 0.3);
    let crowd = people_at(240.0, &[0.3, -1.0], 2.0, at);
    let entered = |until: f64| {
        let is_there =
            |owner: usize, _: usize, seconds: f64| owner == 0 || (1.0..until).contains(&seconds);
        let result = run(&crowd.people()[0].rig, seen(&crowd, is_there), "auto");
        result.events(EventKind::Entered)
    };
    assert_eq!((entered(1.05), entered(1.5)), (vec![0], vec![0, 1]));
}

/// The clock of the cameras steps, or they are calibrated in another world, while the second performer is away.
#[test]
fn who_is_away_when_the_clock_or_the_world_changes_is_known_again() {
    let at = |person: usize, _: f64| Vector3::new(1.8 * person as f64 - 0.9, 0.0, 0.3);
    let crowd = people(&[0.3, -1.0], 9.0, at);
    let rig = Arc::new(crowd.people()[0].rig.clone());
    let is_there =
        |owner: usize, _: usize, seconds: f64| owner == 0 || !(3.0..6.0).contains(&seconds);
    let mut moved = Rig::clone(&rig);
    for camera in &mut moved.cameras {
        // The origin is elsewhere by more than people walk in that time.
        camera.translation -= camera.rotation * Vector3::new(30.0, 0.0, 0.0);
    }
    moved.version += 1;
    let hour = Nanos::SECOND * 3600;
    for (step, new_rig) in [(hour, None), (-hour, None), (Nanos::ZERO, Some(Arc::new(moved)))] {
        let mut is_changed = false;
        let mut inputs = Vec::new();
        for mut frame in seen(&crowd, is_there) {
            let is_after = frame.capture.ns() > Nanos::from_ms(4500).ns();
            if is_after && !is_changed {
                is_changed = true;
                inputs.push(match &new_rig {
                    Some(rig) => stage::Input::Rig(Arc::clone(rig)),
                    None => stage::Input::ClockJumped(step),
                });
            }
            frame.capture = frame.capture + hour + if is_after { step } else { Nanos::ZERO };
            inputs.push(stage::Input::Detections(frame));
        }
        for performers in ["2", "auto"] {
            let result = run_inputs(&rig, inputs.iter().cloned(), performers, Choice::default());
            let case = format!("{step} {performers}: {:?}", result.events);
            assert_eq!(result.events(EventKind::Entered), [0, 1], "{case}");
            assert!(result.events(EventKind::Vacated).is_empty(), "{case}");
            assert_eq!(result.events(EventKind::Reentered), [0, 1], "{case}");
        }
    }
}

/// One camera is six times as fast as the others, each of which has a frame at another time.
#[test]
fn slow_cameras_beside_a_fast_one_are_views() {
    let crowd = people_at(60.0, &[0.3], 6.0, |_, _| Vector3::zeros());
    let mixed = || {
        zero(&crowd)
            .filter(|frame| frame.camera == 0 || frame.frame % 6 == 2 * (frame.camera as u64 - 1))
    };
    for performers in ["1", "auto"] {
        let result = run(&crowd.people()[0].rig, mixed(), performers);
        let (tracked, others): (Vec<_>, Vec<_>) = result
            .poses
            .iter()
            .filter(|(_, pose)| pose.capture.ns() > Nanos::from_ms(1500).ns())
            .partition(|(_, pose)| pose.state == TrackingState::Tracking);
        assert!(
            tracked.len() > 240 && others.is_empty(),
            "{performers}: {} and {}",
            tracked.len(),
            others.len()
        );
    }
}

/// No camera sees anybody for three seconds; the detectors are noisy.
#[test]
fn who_is_there_when_all_cameras_stop_for_a_while_is_known_again() {
    let meeting = Meeting { people: 2, distance: None };
    let mut known = 0;
    for seed in 1..=6 {
        let recording = |person| {
            let (body, motion) = meeting.person(person, seed);
            let motion = Box::new(motion) as AnyMotion;
            let mut recording = Recording::new(meeting.rig(4).unwrap(), body, motion);
            (recording.fps, recording.frames) = (FPS, 8 * FPS as u64);
            (recording.noise, recording.seed) = (Noise::studio(), 2 * seed + person as u64);
            recording
        };
        let crowd = Crowd::new((0..2).map(recording).collect());
        let frames = seen(&crowd, |_, _, seconds| !(3.0..6.0).contains(&seconds));
        let result = run(&crowd.people()[0].rig, frames, "auto");
        assert_eq!(result.events(EventKind::Entered)[..2], [0, 1]);
        known += result.events(EventKind::Reentered).len();
    }
    assert!(known > 9, "{known} of 12");
}

/// A bystander is as tall as the second performer, who goes out and comes back.
#[test]
fn who_stands_by_does_not_become_the_performer_who_goes_out() {
    let at = |person: usize, _: f64| Vector3::new(1.3 * person as f64 - 1.3, 0.0, 0.3);
    let crowd = people(&[0.8, 0.1, 0.0], 9.0, at);
    let is_there = |owner: usize, _: usize, seconds: f64| match owner {
        0 => true,
        1 => !(3.0..6.0).contains(&seconds),
        _ => seconds > 1.0,
    };
    let result = run(&crowd.people()[0].rig, seen(&crowd, is_there), "2");
    assert_eq!(result.events(EventKind::Entered), [0, 1]);
    assert_eq!(result.events(EventKind::Reentered), [1], "{:?}", result.events);
    let off = result.off(1, 6.5, |seconds| at(1, seconds));
    assert!(off < 0.12, "{off} m: {:?}", result.events);
}

/// All cameras but one stop at some time of a window.
#[test]
fn a_window_in_which_the_cameras_stop_is_not_tracked() {
    let crowd = people_at(60.0, &[0.3], 4.0, |_, _| Vector3::zeros());
    for cut in 120..130 {
        let frames = zero(&crowd).filter(|frame| frame.camera == 0 || frame.frame <= cut);
        let result = run(&crowd.people()[0].rig, frames, "1");
        let cut = cut as f64 / 60.0;
        let tracked = result.poses.iter().filter(|(_, pose)| pose.state == TrackingState::Tracking);
        let last = tracked.map(|(_, pose)| pose.capture.ns() as f64 * 1e-9).fold(0.0, f64::max);
        assert!((cut - 0.17..cut + 0.05).contains(&last), "{last} s, cut at {cut} s");
    }
}

/// Two cameras see the second person; one of them is nine times as slow as the other.
#[test]
fn somebody_whom_a_slow_camera_sees_is_found() {
    let at = |person: usize, _: f64| Vector3::new(1.8 * person as f64 - 0.9, 0.0, 0.3);
    let crowd = people_at(60.0, &[0.3, -1.0], 6.0, at);
    let is_seen = |owner: usize, camera: usize, _: f64| owner == 0 || camera < 2;
    let frames = seen(&crowd, is_seen).filter(|frame| frame.camera != 1 || frame.frame % 9 == 0);
    let result = run(&crowd.people()[0].rig, frames, "auto");
    assert_eq!(result.events(EventKind::Entered), [0, 1]);
}

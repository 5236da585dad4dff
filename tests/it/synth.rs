//! The procedural motion and synthetic recordings of it.

use std::collections::HashMap;

use bundlemocap::core::body::{Joint, Pose, Shape, Skeleton};
use bundlemocap::core::detections::{Detections, Keypoint, KeypointFormat, Person};
use bundlemocap::core::so3;
use bundlemocap::research::synth::{
    Crowd, Meeting, Motion, MotionStyle, Noise, Recording, position, ring_rig, through,
};
use nalgebra::{Matrix3, Vector3};

const SOLE: [Keypoint; 6] = [
    Keypoint::LBigToe,
    Keypoint::RBigToe,
    Keypoint::LSmallToe,
    Keypoint::RSmallToe,
    Keypoint::LHeel,
    Keypoint::RHeel,
];

fn point(skeleton: &Skeleton, pose: &Pose, keypoint: Keypoint) -> Vector3<f64> {
    position(keypoint, skeleton, &pose.posture(skeleton))
}

fn shapes() -> [Skeleton; 3] {
    [Shape::default(), Shape::symmetric([1.5; 10]), Shape::symmetric([-1.0; 10])].map(Skeleton::new)
}

#[test]
fn the_lower_foot_stays_on_the_floor() {
    for skeleton in shapes() {
        let motion = Motion::new(&skeleton, MotionStyle::default());
        let (mut lowest, mut highest) = (f64::MAX, f64::MIN);
        for frame in 0..1600 {
            let pose = motion.pose(f64::from(frame) / 60.0);
            let low = SOLE.map(|k| point(&skeleton, &pose, k).y).into_iter().fold(9.0, f64::min);
            lowest = lowest.min(low);
            highest = highest.max(low);
        }
        assert!(lowest > -0.03 && highest < 0.04, "{lowest} {highest}");
    }
}

#[test]
fn the_motion_is_smooth_and_lively() {
    let skeleton = Skeleton::default();
    let motion = Motion::new(&skeleton, MotionStyle::default());
    let rate = 240.0;
    let at = |frame: i32| motion.pose(f64::from(frame) / rate).posture(&skeleton).positions;
    let (mut largest_change, mut sum, mut count) = (0.0f64, 0.0, 0.0);
    let mut last = None;
    for frame in 0..(26 * 240) {
        let (a, b, c) = (at(frame), at(frame + 1), at(frame + 2));
        let acceleration =
            Joint::ALL.map(|j| (a[j as usize] - b[j as usize] * 2.0 + c[j as usize]) * rate * rate);
        for (j, now) in acceleration.iter().enumerate() {
            let before = last.map_or(*now, |last: [Vector3<f64>; 22]| last[j]);
            largest_change = largest_change.max((now - before).norm());
            sum += now.norm();
            count += 1.0;
        }
        last = Some(acceleration);
    }
    assert!((0.5..6.0).contains(&(sum / count)), "mean acceleration {}", sum / count);
    // A discontinuous acceleration would jump by its whole size, about 30 m/s^2, in a 4 ms step.
    assert!(largest_change < 12.0, "{largest_change}");
}

#[test]
fn standing_feet_do_not_slide() {
    let skeleton = Skeleton::default();
    let motion = Motion::new(&skeleton, MotionStyle::default());
    let heel = |t: f64| point(&skeleton, &motion.pose(t), Keypoint::LHeel);
    // Both feet stand while the performer stands, squats, reaches and waves.
    for (from, to) in [(-0.3, -0.1), (6.0, 12.9)] {
        assert!((heel(from) - heel(to)).norm() < 0.01);
    }
    let pelvis = |t: f64| motion.pose(t).root_position;
    assert!(pelvis(6.8).y < pelvis(5.7).y - 0.25, "the squat lowers the pelvis");
    assert!((pelvis(2.0) - pelvis(1.0)).norm() > 0.8, "the walk covers ground");
}

#[test]
fn rotations_are_rotations() {
    let motion = Motion::new(&Skeleton::default(), MotionStyle::default());
    for frame in 0..400 {
        let pose = motion.pose(f64::from(frame) / 30.0);
        assert!(so3::is_rotation(&pose.root_rotation, 1e-9));
        assert!(pose.local.iter().all(|r| so3::is_rotation(r, 1e-9)));
    }
}

type Walk = Recording<Box<dyn Fn(f64) -> Pose>>;

fn walk(noise: Noise) -> Walk {
    let skeleton = Skeleton::default();
    let motion = Motion::new(&skeleton, MotionStyle::default());
    let rig = ring_rig(4, 4.0, 1.6).unwrap();
    let pose: Box<dyn Fn(f64) -> Pose> = Box::new(move |seconds| motion.pose(seconds));
    Recording { noise, frames: 780, ..Recording::new(rig, skeleton, pose) }
}

/// The true pixels of all points in a frame.
fn truth(recording: &Walk, frame: &Detections) -> Vec<Option<nalgebra::Vector2<f64>>> {
    let pose = (recording.motion)(frame.capture.ns() as f64 * 1e-9);
    let posture = pose.posture(&recording.skeleton);
    let camera = &recording.rig.cameras[frame.camera];
    let of = |&k: &Keypoint| camera.project(&position(k, &recording.skeleton, &posture));
    recording.format.keypoints().iter().map(of).collect()
}

/// Index, error (pixels) and confidence of each point of the person nearest to the truth.
fn errors(recording: &Walk, frame: &Detections) -> Vec<(usize, f64, f64)> {
    let truth = truth(recording, frame);
    let of = |person: &Person| -> Vec<(usize, f64, f64)> {
        (truth.iter().zip(&person.points).enumerate())
            .filter_map(|(i, (t, p))| t.zip(*p).map(|(t, p)| (i, t, p)))
            .map(|(i, t, p)| (i, (t - p.pixel.coords).norm(), p.confidence))
            .collect()
    };
    let cost = |e: &Vec<(usize, f64, f64)>| e.iter().map(|e| e.1).sum::<f64>() / e.len() as f64;
    let people = frame.people.iter().map(of).filter(|e| !e.is_empty());
    people.min_by(|a, b| cost(a).total_cmp(&cost(b))).unwrap_or_default()
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

#[test]
fn views_without_noise_are_exact_and_nearly_complete() {
    let recording = walk(Noise::none());
    let (mut seen, mut all) = (0, 0);
    for frame in recording.detections() {
        assert_eq!(frame.people.len(), 1);
        let errors = errors(&recording, &frame);
        assert!(errors.iter().all(|&(_, error, confidence)| error < 1e-9 && confidence == 1.0));
        seen += errors.len();
        all += recording.format.keypoints().len();
    }
    assert!(seen as f64 > 0.97 * all as f64, "{seen} of {all} points are in the image");
}

#[test]
fn frames_come_in_capture_order_and_fit_the_truth_poses() {
    let mut recording = walk(Noise::default());
    (recording.frames, recording.stagger, recording.format) = (50, 0.8, KeypointFormat::Halpe26);
    let frames: Vec<Detections> = recording.detections().collect();
    assert_eq!(frames.len(), 200);
    assert!(frames.is_sorted_by_key(|f| (f.capture, f.camera)));
    assert!(frames.iter().flat_map(|f| &f.people).all(|p| p.points.len() == 26));
    let poses: Vec<_> = recording.poses().collect();
    let of_first: Vec<_> = frames.iter().filter(|f| f.camera == 0).map(|f| f.capture).collect();
    assert_eq!(poses.iter().map(|p| p.capture).collect::<Vec<_>>(), of_first);
}

#[test]
fn a_seed_gives_the_same_recording_in_any_order() {
    let mut long = walk(Noise::default());
    long.frames = 90;
    let mut short = walk(Noise::default());
    short.frames = 60;
    let tail: Vec<Detections> = long.detections().take(240).collect();
    assert_eq!(tail, short.detections().collect::<Vec<_>>());
    short.seed += 1;
    assert_ne!(tail, short.detections().collect::<Vec<_>>());
}

#[test]
fn the_studio_level_has_every_kind_of_error() {
    let recording = walk(Noise::default());
    let (mut blank, mut several, mut points, mut frames) = (0usize, 0usize, 0usize, 0usize);
    let (mut sure, mut unsure, mut wrist) = (Vec::new(), Vec::new(), Vec::new());
    let mut gross = HashMap::new();
    for frame in recording.detections() {
        frames += 1;
        blank += usize::from(frame.people.is_empty());
        several += usize::from(frame.people.len() > 1);
        for (index, error, confidence) in errors(&recording, &frame) {
            points += 1;
            if confidence > 0.7 { &mut sure } else { &mut unsure }.push(error);
            if recording.format.keypoints()[index] == Keypoint::LWrist {
                wrist.push(error);
            }
            if error > 40.0 {
                *gross.entry(frame.camera).or_insert(0) += 1;
            }
        }
    }
    let share = |n: usize| n as f64 / frames as f64;
    assert!(blank > 0 && share(blank) < 0.02, "{}", share(blank));
    assert!(several > 0 && share(several) < 0.15, "{}", share(several));
    assert!(points as f64 > 0.90 * (frames * 25) as f64 && points < frames * 25);
    assert!(gross.len() >= 2 && gross.values().sum::<usize>() < points / 50, "{gross:?}");
    let (sure, unsure, wrist) = (median(sure), median(unsure), median(wrist));
    println!("sure {sure:.2} unsure {unsure:.2} wrist {wrist:.2} gross {gross:?}");
    assert!(unsure > 1.1 * sure, "confidence predicts the error: {sure} {unsure}");
    // A person is about 480 px tall. Jitter of 0.6 %, wander of 0.8 % and a bias of 12 mm (about
    // 3 px) add up to 5.7 px along each axis; the median length is 1.18 times that.
    assert!((5.0..10.0).contains(&wrist), "{wrist}");
}

#[test]
fn interpolation_passes_through_the_poses() {
    let motion = Motion::new(&Skeleton::default(), MotionStyle::default());
    let poses: Vec<Pose> = (0..20).map(|f| motion.pose(f64::from(f) / 60.0)).collect();
    let path = through(poses.clone(), 60.0);
    assert_eq!(path(0.0), poses[0]);
    assert_eq!(path(7.0 / 60.0), poses[7]);
    assert_eq!(path(9.0), poses[19]);
    // The cubic is nearer to the smooth motion than linear interpolation.
    let off = |a: &Matrix3<f64>, b: &Matrix3<f64>| so3::log(&(a.transpose() * b)).norm();
    let (mut ours, mut straight) = (0.0, 0.0);
    for frame in 1..18 {
        let seconds = (frame as f64 + 0.5) / 60.0;
        let (between, truth) = (path(seconds), motion.pose(seconds));
        for (j, truth) in truth.local.iter().enumerate() {
            let halfway = so3::slerp(&poses[frame].local[j], &poses[frame + 1].local[j], 0.5);
            ours += off(&between.local[j], truth);
            straight += off(&halfway, truth);
        }
    }
    assert!(ours < 0.2 * straight, "{ours} {straight}");
    assert_eq!(through(Vec::new(), 60.0)(1.0), Pose::rest());
}

/// A crowd of that many people, and where their pelvises are, by frame and person, at 60 fps.
fn crowd(people: usize, distance: Option<f64>, frames: u64) -> Vec<Vec<Vector3<f64>>> {
    let meeting = Meeting { people, distance };
    let motions: Vec<_> = (0..people).map(|person| meeting.person(person, 1).1).collect();
    let at =
        |frame| motions.iter().map(|motion| motion(frame as f64 / 60.0).root_position).collect();
    (0..frames).map(at).collect()
}

#[test]
fn people_of_a_crowd_cross_and_meet_and_do_not_walk_through_each_other() {
    for (people, distance) in [(2, None), (4, Some(0.7)), (5, Some(0.3)), (10, Some(0.7))] {
        let places = crowd(people, distance, 60 * 18);
        let floor = |p: &Vector3<f64>| nalgebra::Vector2::new(p.x, p.z);
        let (mut least, mut nearest, mut fastest) = (f64::MAX, f64::MAX, 0.0_f64);
        for (now, next) in places.iter().zip(&places[1..]) {
            for (a, at) in now.iter().enumerate() {
                nearest = nearest.min(floor(at).norm());
                fastest = fastest.max((floor(&next[a]) - floor(at)).norm() * 60.0);
                let others = now[..a].iter().map(|b| (floor(at) - floor(b)).norm());
                least = others.fold(least, f64::min);
            }
        }
        let expected = distance.unwrap_or(0.65).min(0.65);
        assert!((least - expected).abs() < 0.02, "{people}: {least:.3} m");
        let middle = 0.325 / (std::f64::consts::PI / people as f64).sin();
        assert!(nearest < middle + 0.01, "{people}: {nearest:.3} m from the middle");
        assert!((1.0..1.8).contains(&fastest), "{people}: {fastest:.2} m/s");
    }
}

#[test]
fn people_of_a_crowd_move_smoothly() {
    let meeting = Meeting { people: 4, distance: Some(0.5) };
    for person in 0..4 {
        let (skeleton, motion) = meeting.person(person, 3);
        let at = |frame: i32| motion(f64::from(frame) / 240.0).posture(&skeleton).positions;
        let mut fastest = 0.0_f64;
        for frame in 0..18 * 240 {
            let (now, next) = (at(frame), at(frame + 1));
            let step = next.iter().zip(now).map(|(b, a)| (b - a).norm() * 240.0);
            fastest = step.fold(fastest, f64::max);
        }
        assert!(fastest < 6.5, "{fastest:.1} m/s");
    }
}

#[test]
fn the_nearer_person_hides_the_other() {
    let meeting = Meeting { people: 2, distance: None };
    let rig = meeting.rig(4).unwrap();
    let person = |person| {
        let (skeleton, motion) = meeting.person(person, 1);
        let mut recording = Recording::new(rig.clone(), skeleton, motion);
        (recording.noise, recording.frames) = (Noise::none(), 240);
        recording
    };
    let crowd = Crowd::new(vec![person(0), person(1)]);
    let mut alone: Vec<_> = crowd.people().iter().map(Recording::detections).collect();
    let (mut hidden, mut seen) = (0, 0);
    for (frame, owners) in crowd.detections() {
        let alone: Vec<Detections> =
            alone.iter_mut().map(|frames| frames.next().unwrap()).collect();
        let camera = &rig.cameras[frame.camera];
        let seconds = frame.capture.seconds_since(crowd.people()[0].start);
        let depth = |one: usize| camera.depth(&(crowd.people()[one].motion)(seconds).root_position);
        for (person, owner) in frame.people.iter().zip(&owners) {
            let all = alone[*owner].people[0].points.iter().zip(&person.points);
            for (index, (alone, together)) in all.enumerate() {
                seen += u32::from(together.is_some());
                if alone.is_some() && together.is_none() {
                    hidden += 1;
                    let ahead = depth(1 - owner) - depth(*owner);
                    assert!(ahead < 0.6, "point {index} of {owner} is {ahead:.2} m in front");
                }
            }
        }
    }
    let share = f64::from(hidden) / f64::from(seen + hidden);
    assert!((0.02..0.2).contains(&share), "{hidden} of {} points are hidden", seen + hidden);
    assert_eq!(crowd.detections().collect::<Vec<_>>(), crowd.detections().collect::<Vec<_>>());
}

#[test]
fn a_detector_mixes_people_who_overlap() {
    let frames = |distance: f64, mixed: f64| {
        let meeting = Meeting { people: 2, distance: Some(distance) };
        let rig = meeting.rig(4).unwrap();
        let person = |person| {
            let (skeleton, motion) = meeting.person(person, 1);
            let motion = move |seconds: f64| motion(seconds + 8.0);
            let mut recording = Recording::new(rig.clone(), skeleton, motion);
            (recording.noise, recording.frames) = (Noise { mixed, ..Noise::none() }, 180);
            recording
        };
        Crowd::new(vec![person(0), person(1)]).detections().collect::<Vec<_>>()
    };
    let changed = |distance: f64| {
        let (clear, mixed) = (frames(distance, 0.0), frames(distance, 0.4));
        let (mut exchanged, mut copied) = (0, 0);
        for ((clear, _), (mixed, _)) in clear.iter().zip(&mixed) {
            let points = |frame: &Detections| -> Vec<_> {
                frame.people.iter().map(|person| person.points.clone()).collect()
            };
            let (clear, mixed) = (points(clear), points(mixed));
            if mixed.len() == 2 && mixed[0] == mixed[1] {
                copied += 1;
                assert!(clear.contains(&mixed[0]));
            } else if mixed != clear {
                exchanged += 1;
                for (index, (a, b)) in mixed[0].iter().zip(&mixed[1]).enumerate() {
                    let before = [clear[0][index], clear[1][index]];
                    assert!([[*a, *b], [*b, *a]].contains(&before));
                }
            }
        }
        (exchanged, copied)
    };
    let (exchanged, copied) = changed(0.3);
    assert!(exchanged > 10 && copied > 3, "{exchanged} exchanged, {copied} copied of 720");
    let apart = changed(1.5);
    assert!(apart.0 + apart.1 < exchanged, "{apart:?}");
}

#[test]
fn people_are_led_through_the_crowd_while_they_move_on_their_own() {
    let meeting = Meeting { people: 4, distance: Some(0.7) };
    let motion = Motion::new(&Skeleton::default(), MotionStyle::default());
    let poses: Vec<Pose> = (0..900).map(|frame| motion.pose(f64::from(frame) / 60.0)).collect();
    let led = meeting.lead(1, poses.clone(), 60.0);
    let walker = meeting.person(1, 1).1;
    for (frame, (led, own)) in led.iter().zip(&poses).enumerate() {
        let path = walker(frame as f64 / 60.0);
        let off = (led.root_position - path.root_position).xz().norm();
        assert!(off < 0.3, "{off:.2} m from the path in frame {frame}");
        let [ahead, facing] = [&path, led].map(|pose| pose.root_rotation * Vector3::z());
        assert!(ahead.dot(&facing) > 0.7, "frame {frame}");
        assert_eq!((&led.local, led.root_position.y), (&own.local, own.root_position.y));
    }
}

#[test]
fn bystanders_sit_and_walk_beyond_the_edge_of_the_floor() {
    let meeting = Meeting { people: 3, distance: None };
    for index in 0..4 {
        let (skeleton, motion) = meeting.bystander(index, 1);
        let (mut way, mut last) = (0.0, motion(0.0).root_position);
        for frame in 0..600 {
            let pose = motion(f64::from(frame) / 60.0);
            let at = pose.root_position;
            assert!(at.xz().norm() > meeting.radius() + 0.8);
            way += (at - last).norm();
            last = at;
            let positions = pose.posture(&skeleton).positions;
            let lowest = positions.iter().map(|joint| joint.y).fold(f64::MAX, f64::min);
            assert!((-0.02..0.12).contains(&lowest), "bystander {index}: {lowest:.2} m");
            let [hip, knee] = [Joint::LHip, Joint::LKnee].map(|joint| positions[joint.index()].y);
            assert_eq!(hip - knee < 0.1, index % 2 == 0, "bystander {index} at {frame}");
        }
        assert_eq!(way > 10.0, index % 2 == 1, "bystander {index} walked {way:.1} m");
    }
}

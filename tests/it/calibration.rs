//! Cameras in time and in place: clocks that are shifted and cameras that are turned are found from
//! the performer's motion, and nothing is changed where nothing is wrong.

use std::path::Path;
use std::sync::Arc;

use bundlemocap::core::body::{Pose, Skeleton};
use bundlemocap::core::camera::{Camera, Rig};
use bundlemocap::core::detections::Detections;
use bundlemocap::core::manifold::Decoder;
use bundlemocap::core::so3;
use bundlemocap::core::stage::Performers;
use bundlemocap::core::time::{Nanos, Timestamp};
use bundlemocap::core::tracker::{
    Config, Event, EventKind, Live, Output, Solver, Tracker, run_to_end,
};
use bundlemocap::io::formats::{Convention, Up, read_calibration, write_calibration};
use bundlemocap::io::recording::{Provenance, Writer};
use bundlemocap::io::wire::{self, Topics};
use bundlemocap::offline::{self, CheckedCameras, Options, check_cameras, solve};
use bundlemocap::research::synth::{
    Crowd, Meeting, Motion, MotionStyle, Noise, Recording, ring_rig,
};
use nalgebra::Vector3;

const FPS: f64 = 60.0;

/// A recording of eight seconds of walking and squatting.
struct Take {
    folder: tempfile::TempDir,
    rig: Rig,
}

impl Take {
    fn recording(&self) -> offline::Recording {
        offline::Recording::open(self.folder.path().join("take.mcap")).unwrap()
    }

    fn checked(&self, refine: bool) -> CheckedCameras {
        check_cameras(&mut self.recording(), &Options::default(), refine, &mut ()).unwrap()
    }
}

/// A take whose cameras stamp their frames late by `late` frames. `written` changes the calibration
/// in the recording.
fn take(late: &[f64], noise: Noise, moves: bool, written: impl Fn(&mut Rig)) -> Take {
    stamped(late.len(), noise, moves, written, |camera, frame| Some(frame + late[camera]))
}

/// A take with wrong times: `time(camera, frame)` in frames; `None`: the frame is lost.
fn stamped(
    cameras: usize,
    noise: Noise,
    moves: bool,
    written: impl Fn(&mut Rig),
    time: impl Fn(usize, f64) -> Option<f64>,
) -> Take {
    let folder = tempfile::tempdir().unwrap();
    let skeleton = Skeleton::default();
    let motion = Motion::new(&skeleton, MotionStyle::default());
    let pose = |seconds: f64| -> Pose { motion.pose(if moves { seconds } else { 0.0 }) };
    let rig = ring_rig(cameras, 4.0, 1.6).unwrap();
    let mut recording = Recording::new(rig.clone(), skeleton, pose);
    (recording.frames, recording.noise) = (480, noise);
    let mut in_file = rig.clone();
    written(&mut in_file);

    let at = |time: f64| Timestamp::default() + Nanos::rounded((time + 10.0) * 1e9 / FPS);
    let frames = recording.detections().filter_map(|mut frame| {
        frame.capture = at(time(frame.camera, frame.frame as f64)?);
        Some(frame)
    });
    let path = folder.path().join("take.mcap");
    let (topics, body) = (Topics::default(), wire::Skeleton::from_core(&recording.skeleton));
    let mut writer = writer(&path);
    writer.write(&topics.truth_skeleton(), Timestamp::default(), &body).unwrap();
    for (frame, mut pose) in recording.poses().enumerate() {
        pose.capture = at(frame as f64);
        let message = wire::Pose::from_core(&pose, &recording.skeleton, None);
        writer.write(&topics.truth(), pose.capture, &message).unwrap();
    }
    write(writer, &in_file, frames);
    Take { folder, rig }
}

fn writer(path: &Path) -> Writer {
    Writer::create(path, Topics::default(), &Provenance::default()).unwrap()
}

fn write(mut writer: Writer, rig: &Rig, frames: impl Iterator<Item = Detections>) {
    writer.rig(rig, Timestamp::default()).unwrap();
    for frame in frames {
        let camera = &rig.cameras[frame.camera];
        writer.keypoints(&frame, &camera.name, [camera.width, camera.height]).unwrap();
    }
    writer.finish().unwrap();
}

fn as_it_is(_: &mut Rig) {}

/// Turns the third camera about its centre by one degree.
fn turned(rig: &mut Rig) {
    turn(&mut rig.cameras[2]);
}

/// Turns a camera about its centre by one degree.
fn turn(camera: &mut Camera) {
    let centre = camera.centre_in_world();
    let axis = Vector3::new(0.6, 0.8, 0.0);
    camera.rotation = so3::exp(&(axis * 1f64.to_radians())) * camera.rotation;
    camera.translation = -(camera.rotation * centre);
}

#[test]
fn shifted_clocks_are_found_to_a_tenth_of_a_frame() {
    // About a frame late, each camera might be taken for the one that is right.
    let one_late = (0..4).map(|late| std::array::from_fn(|i| if i == late { 1.2 } else { 0.0 }));
    let takes = [[0.3, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, -3.0], [0.0, 0.0, 5.0, 0.0]];
    for late in takes.into_iter().chain(one_late) {
        let checked = take(&late, Noise::clean(), true, as_it_is).checked(false);
        for (found, late) in checked.offsets.iter().zip(late) {
            println!("{late}: {found}");
            assert_eq!(found.applied, late != 0.0, "{late}: {found}");
            let off = found.offset_frames.unwrap() + late;
            assert!(off.abs() < 0.1 || !found.applied, "{late}: {found}");
        }
    }
}

/// Cameras that were started at another time, have another frame rate, drift, or lose frames.
#[test]
fn large_faults_of_clocks_are_corrected() {
    type Time = fn(f64) -> Option<f64>;
    let cases: [(&str, usize, f64, Time); 6] = [
        ("", 4, -70.0, |frame| Some(frame + 70.0)),
        ("", 4, 9.5, |frame| Some(frame - 0.5 - 9.0)),
        ("", 2, 100.0, |frame| Some(frame - 100.0)),
        ("0.5000 times as fast", 4, 0.0, |frame| (frame % 2.0 == 0.0).then_some(0.5 * frame)),
        ("times as fast as those of the others", 4, 0.0, |frame| Some(1.03 * frame)),
        ("12 frames were lost", 4, 0.0, |frame| match frame {
            ..240.0 => Some(frame),
            240.0..252.0 => None,
            _ => Some(frame - 12.0),
        }),
    ];
    let solved = |cameras: usize, time: Time| {
        let time =
            |camera, frame| if camera == 1 { time(frame) } else { Some(frame) }.map(|f| f + 200.0);
        let take = stamped(cameras, Noise::clean(), true, as_it_is, time);
        solve(&mut take.recording(), &Options::default(), &mut ()).unwrap()
    };
    for (note, cameras, frames, time) in cases {
        let (right, wrong) = (solved(cameras, Some), solved(cameras, time));
        let offsets = wrong.time_offsets.iter().map(|one| one.offset_frames.unwrap());
        let offsets: Vec<f64> = offsets.collect();
        // Of two cameras, either may be shifted.
        assert!((offsets[1] - offsets[0] - frames).abs() < 0.2, "{note}: {offsets:?}");
        let others = wrong.time_offsets.iter().skip(2).chain(&wrong.time_offsets[..1]);
        assert!(!others.clone().any(|one| one.applied) || cameras == 2, "{offsets:?}");
        let start =
            |summary: &offline::Summary| summary.first_capture_time_ns.unwrap() as f64 / 1e9;
        let most = if cameras == 2 { 1.8 } else { 0.1 };
        assert!((start(&wrong) - start(&right)).abs() < most, "{note}: {}", start(&wrong));
        let px = |summary: &offline::Summary| summary.reprojection.cameras["cam02"].unwrap();
        println!("{note}: {:?} px, {:?} {:?}", px(&wrong), wrong.time_offsets[1], wrong.notes);
        assert!(px(&wrong) < 1.15 * px(&right), "{note}: {:?} {:?}", px(&wrong), px(&right));
        assert!(
            note.is_empty() || wrong.notes.iter().any(|n| n.contains(note)),
            "{:?}",
            wrong.notes
        );
        assert!(wrong.check.unwrap().is_clean(), "{:?}", wrong.notes);
    }
}

#[test]
fn a_camera_that_was_started_later_is_corrected_with_several_performers() {
    let meeting = Meeting { people: 3, distance: None };
    let rig = meeting.rig(4).unwrap();
    let one = |person| {
        let (skeleton, motion) = meeting.person(person, 2);
        let mut one = Recording::new(rig.clone(), skeleton, motion);
        (one.noise, one.frames, one.seed) = (Noise::clean(), 480, 3 + person as u64);
        one
    };
    let crowd = Crowd::new((0..3).map(one).collect());
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("take.mcap");
    let frames = crowd.detections().map(|(mut frame, _)| {
        let early = if frame.camera == 2 { 80.0 } else { 0.0 };
        frame.capture = frame.capture + Nanos::rounded((100.0 - early) * 1e9 / FPS);
        frame
    });
    write(writer(&path), &rig, frames);
    let mut take = offline::Recording::open(&path).unwrap();
    let options = Options { performers: Performers::Auto, ..Options::default() };
    let solved = offline::solve_group(&mut take, &options, &mut ()).unwrap();
    assert_eq!(solved.performers.len(), 3);
    for one in &solved.performers {
        let offset = one.summary.time_offsets[2].offset_frames.unwrap();
        assert!((offset - 80.0).abs() < 0.5, "{offset}");
        let px = one.summary.reprojection.cameras["cam03"].unwrap();
        assert!(px < 3.0, "{}: {px}", one.performer);
    }
    let rows = solved.rows();
    assert!(rows.iter().any(|(name, _)| name == "time offset cam03"), "{rows:?}");
}

#[test]
fn clocks_that_agree_stay_as_they_are_under_studio_noise() {
    let checked = take(&[0.0; 4], Noise::studio(), true, as_it_is).checked(false);
    println!("{:?}", checked.offsets);
    assert!(checked.offsets.iter().all(|found| !found.applied), "{:?}", checked.offsets);
    assert!(checked.rig.cameras.iter().all(|camera| camera.time_offset == Nanos::ZERO));
}

#[test]
fn nothing_is_said_of_clocks_where_nobody_moves() {
    for noise in [Noise::jitter_only(), Noise::studio()] {
        let checked = take(&[0.0, 5.0, 0.0, 0.0], noise, false, as_it_is).checked(false);
        println!("{:?}", checked.offsets);
        assert!(checked.offsets.iter().all(|found| found.verdict == "unknown"));
    }
}

/// The events of time offsets of a live tracker, and the offsets that it uses, frames. The second camera is so many frames
/// late.
fn live_offsets(late: f64, noise: Noise, moves: bool) -> (Vec<Event>, Vec<f64>) {
    let skeleton = Skeleton::default();
    let motion = Motion::new(&skeleton, MotionStyle::default());
    let rig = Arc::new(ring_rig(4, 4.0, 1.6).unwrap());
    let pose = |seconds| motion.pose(if moves { seconds } else { 1.0 });
    let mut recording = Recording::new((*rig).clone(), skeleton, pose);
    (recording.frames, recording.noise) = (2400, noise);
    let config = Config { frame_rate_hz: FPS, ..Config::default() };
    let live =
        Live { provisional: false, time_offsets: true, watch_cameras: false, output_rate_hz: 0.0 };
    let mut tracker = Tracker::new(config, rig).live(live);
    let mut solver = Solver::new(Decoder::embedded().unwrap(), config);
    let frames = recording.detections().map(|mut frame| {
        let late = Nanos::rounded(if frame.camera == 1 { late * 1e9 / FPS } else { 0.0 });
        frame.capture = frame.capture + late;
        frame
    });
    let mut events = Vec::new();
    run_to_end(&mut tracker, &mut solver, frames, |output| match output {
        Output::Event(event) if event.kind == EventKind::TimeOffset => events.push(event),
        _ => {}
    });
    let offsets = tracker.rig().cameras.iter().map(|camera| camera.time_offset.seconds() * FPS);
    (events, offsets.collect())
}

#[test]
fn a_live_tracker_corrects_a_shifted_clock() {
    for late in [0.0, 0.7, 2.0, 9.0, 16.0, -5.0] {
        let (events, offsets) = live_offsets(late, Noise::clean(), true);
        println!("{late}: {offsets:.2?} {events:?}");
        assert_eq!(events.is_empty(), late == 0.0);
        assert!(events.iter().all(|event| event.camera == Some(1)));
        let first = events.first().map_or("", |event| &event.detail);
        assert_eq!(first.ends_with("are added to its capture times from now on"), late != 0.0);
        for (camera, frames) in offsets.into_iter().enumerate() {
            let truth = if camera == 1 { -late } else { 0.0 };
            assert!((frames - truth).abs() < 0.25, "{camera}: {frames}");
        }
    }
}

#[test]
fn a_live_tracker_corrects_no_clock_without_motion() {
    for noise in [Noise::jitter_only(), Noise::studio()] {
        for late in [0.0, 6.0, 9.0] {
            let (events, offsets) = live_offsets(late, noise.clone(), false);
            println!("{late}: {offsets:.2?} {events:?}");
            assert!(events.is_empty());
        }
    }
}

/// The events of cameras that a live tracker finds moved, with their seconds. The true cameras are
/// those of `rigs`, each from its second on; the tracker's rig is the first one.
fn watched(noise: &Noise, rigs: &[(f64, Rig)], seconds: f64) -> Vec<(f64, Option<usize>)> {
    let skeleton = Skeleton::default();
    let motion = Motion::new(&skeleton, MotionStyle::default());
    let of_rig = |(begin, rig): &(f64, Rig)| {
        let motion = |seconds| motion.pose(seconds);
        let mut recording = Recording::new(rig.clone(), skeleton.clone(), motion);
        recording.frames = (seconds * recording.fps) as u64;
        recording.noise = noise.clone();
        let begin = Timestamp::default() + Nanos::rounded(begin * 1e9);
        let frames = recording.detections();
        frames.filter(|f| f.capture >= begin).collect::<Vec<_>>()
    };
    let mut frames = Vec::new();
    for rig in rigs {
        let mut next = of_rig(rig);
        let begin = next.first().map(|frame| frame.capture);
        frames.retain(|frame: &bundlemocap::Detections| {
            begin.is_none_or(|begin| frame.capture < begin)
        });
        frames.append(&mut next);
    }
    let config = Config::default();
    let live =
        Live { provisional: false, time_offsets: false, watch_cameras: true, output_rate_hz: 0.0 };
    let mut tracker = Tracker::new(config, Arc::new(rigs[0].1.clone())).live(live);
    let mut solver = Solver::new(Decoder::embedded().unwrap(), config);
    let mut events = Vec::new();
    run_to_end(&mut tracker, &mut solver, frames, |output| match output {
        Output::Event(event) if event.kind == EventKind::CameraMoved => {
            println!(
                "{:.1} s, camera {:?}: {}",
                event.capture.ns() as f64 / 1e9,
                event.camera,
                event.detail
            );
            events.push((event.capture.ns() as f64 / 1e9, event.camera));
        }
        _ => {}
    });
    events
}

#[test]
fn one_of_two_cameras_that_is_moved_is_reported() {
    let mut good = ring_rig(4, 4.0, 1.6).unwrap();
    good.cameras.truncate(2);
    let mut moved = good.clone();
    turn(&mut moved.cameras[1]);
    let events = watched(&Noise::clean(), &[(0.0, good), (30.0, moved)], 40.0);
    assert_eq!(events.len(), 1);
    assert!((30.0..40.0).contains(&events[0].0) && events[0].1.is_none());
}

#[test]
fn no_camera_seems_moved_in_studio_noise() {
    // An hour of each takes some minutes: BUNDLEMOCAP_LONG=1.
    let is_long = std::env::var_os("BUNDLEMOCAP_LONG").is_some();
    let good = ring_rig(4, 4.0, 1.6).unwrap();
    let seconds = if is_long { 3600.0 } else { 60.0 };
    for noise in [Noise::studio(), Noise::clean()].iter().take(if is_long { 2 } else { 1 }) {
        assert_eq!(watched(noise, &[(0.0, good.clone())], seconds), []);
    }
}

#[test]
fn a_camera_that_is_moved_is_left_out_until_it_is_back() {
    let good = ring_rig(4, 4.0, 1.6).unwrap();
    let mut turned_by_a_degree = good.clone();
    turned(&mut turned_by_a_degree);
    let mut shifted = good.clone();
    shifted.cameras[1].translation.x += 0.02;
    let mut turned_away = good.clone();
    (0..10).for_each(|_| turn(&mut turned_away.cameras[3]));
    let mut nearer = good.clone();
    nearer.cameras[0].translation.z -= 0.2;
    let moves = [(&turned_by_a_degree, 2), (&shifted, 1), (&turned_away, 3), (&nearer, 0)];
    let [clean, studio] = [Noise::clean(), Noise::studio()];
    // Each move in one of the noises, the smallest in both.
    for (noise, moves) in [(clean, &moves[..2]), (studio, &moves[1..])] {
        for &(moved, camera) in moves {
            let rigs = [(0.0, good.clone()), (40.0, moved.clone()), (52.0, good.clone())];
            let events = watched(&noise, &rigs, 62.0);
            assert!(events.iter().all(|(_, found)| *found == Some(camera)), "{events:?}");
            // Between the two the tracker may say once where the camera is.
            assert!(events.len() <= 3, "{events:?}");
            let [(found, _), .., (back, _)] = events[..] else { panic!("{events:?}") };
            assert!((40.0..50.0).contains(&found) && (52.0..62.0).contains(&back));
        }
    }
}

#[test]
fn a_held_out_camera_is_shifted_by_the_others() {
    let take = take(&[0.0, 0.0, 0.0, -3.0], Noise::clean(), true, as_it_is);
    let error = |no_sync: bool| {
        let options = Options { hold_out: vec!["cam04".into()], no_sync, ..Options::default() };
        solve(&mut take.recording(), &options, &mut ())
            .unwrap()
            .hold_out
            .unwrap()
            .median_px
            .unwrap()
    };
    let (with, without) = (error(false), error(true));
    println!("held out: {with:.2} px, without the offset {without:.2} px");
    assert!(with < 0.7 * without, "{with} px, {without} px");
}

#[test]
fn a_camera_turned_by_a_degree_is_corrected() {
    for noise in [Noise::clean(), Noise::studio()] {
        let take = take(&[0.0; 4], noise, true, turned);
        let checked = take.checked(true);
        println!("{:?}", checked.corrections);
        for (i, (camera, truth)) in checked.rig.cameras.iter().zip(&take.rig.cameras).enumerate() {
            let off = so3::angle_between(&camera.rotation, &truth.rotation).to_degrees();
            assert!(off < 0.2, "{}: {off} degrees", camera.name);
            assert_eq!(checked.corrections[i].correction.significant, i == 2);
            assert_eq!(*camera == take.recording().rig().cameras[i], i != 2);
        }
    }
}

#[test]
fn errors_of_a_wrong_calibration_are_within_the_standard_deviations() {
    let solved = |cameras: &[usize]| {
        let turned = |rig: &mut Rig| cameras.iter().for_each(|&i| turn(&mut rig.cameras[i]));
        let take = take(&[0.0; 4], Noise::studio(), true, turned);
        solve(&mut take.recording(), &Options::default(), &mut ()).unwrap()
    };
    for cameras in [&[][..], &[2], &[0, 1], &[0, 1, 2]] {
        let summary = solved(cameras);
        let (truth, deviation) = (summary.truth.unwrap(), summary.joint_deviation.unwrap());
        let coverage = truth.coverage.unwrap();
        println!("{cameras:?}: {:.1} mm, {deviation:?}, {coverage:?}", truth.mpjpe_mm);
        // A single wrong camera has little weight in the solve. The deviations do not know that.
        let most = if cameras.is_empty() { 76.0 } else { 95.0 };
        assert!((60.0..most).contains(&coverage.within_1_percent), "{cameras:?}");
        assert!(coverage.within_2_percent > 90.0, "{cameras:?}");
    }
}

#[test]
fn a_good_calibration_stays_as_it_is() {
    for noise in [Noise::clean(), Noise::studio()] {
        let take = take(&[0.0; 4], noise, true, as_it_is);
        let checked = take.checked(true);
        println!("{:?}", checked.corrections);
        assert_eq!(checked.rig, **take.recording().rig());
    }
}

#[test]
fn a_written_calibration_reads_back() {
    let folder = tempfile::tempdir().unwrap();
    let mut rig = ring_rig(3, 4.0, 1.6).unwrap();
    rig.cameras[1].time_offset = Nanos::new(-5_123_457);
    for up in [Up::Y, Up::Z, Up::MinusX] {
        let path: &Path = &folder.path().join("rig.toml");
        write_calibration(path, &rig, up).unwrap();
        // The file says what is up. What is given comes first only where the file is not ours alone.
        let given = Convention::from(Up::MinusZ);
        assert_eq!(read_calibration(path, &given).unwrap().up, Up::MinusZ);
        let given = Convention { file_first: true, ..given };
        let read = read_calibration(path, &given).unwrap();
        assert_eq!((read.up, read.notes), (up, vec![]));
        for (read, camera) in read.rig.cameras.iter().zip(&rig.cameras) {
            assert!((read.rotation - camera.rotation).amax() < 1e-12);
            assert_eq!(read.matrix(), camera.matrix());
            assert_eq!(read.lens(), camera.lens());
            assert_eq!(read.translation, camera.translation);
            assert_eq!((&read.name, read.time_offset), (&camera.name, camera.time_offset));
        }
    }
}

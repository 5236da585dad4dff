//! Comparison of methods on short takes of our own motion.

use std::collections::BTreeSet;
use std::path::Path;
use std::process::{Command, Output};
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use bundlemocap::core::body::{Pose, Skeleton};
use bundlemocap::core::detections::KeypointFormat;
use bundlemocap::core::manifold::Decoder;
use bundlemocap::core::time::{Nanos, Timestamp};
use bundlemocap::research::experiments::ablation::FACTORS;
use bundlemocap::research::experiments::summary::{summaries, to_json};
use bundlemocap::research::experiments::{Case, Score, View, drift, procedural, real, run};
use bundlemocap::research::methods::{Delay, LiveTracker, Method, Motion, Solved, Take, Windows};
use bundlemocap::research::synth::{Noise, SequenceChoice, rig_named};
use serde_json::Value;

/// Two motions of 1.2 s before three cameras.
fn cases(noise: Noise) -> Vec<Case> {
    cases_of("ring3", 1.2, noise)
}

/// Two motions of some seconds before the cameras of a rig.
fn cases_of(rig: &str, seconds: f64, noise: Noise) -> Vec<Case> {
    cases_at(SequenceChoice::default().fps, rig, seconds, noise)
}

/// The same at a frame rate.
fn cases_at(fps: f64, rig: &str, seconds: f64, noise: Noise) -> Vec<Case> {
    let view = View {
        name: "tiny".into(),
        rig: Arc::new(rig_named(rig, None).unwrap()),
        format: KeypointFormat::Body25,
        noise,
        choice: SequenceChoice { fps, seconds, least_seconds: 0.5, ..SequenceChoice::default() },
        seed: 3,
    };
    procedural(2, seconds).iter().filter_map(|subject| Case::new(subject, &view)).collect()
}

/// Returns the truth shifted by a distance, metres; has no poses for the first two frames.
struct Oracle {
    poses: Vec<(Timestamp, Pose)>,
    skeleton: Arc<Skeleton>,
    shift: f64,
}

impl Oracle {
    fn of(case: &Case, shift: f64) -> Self {
        let sequence = case.make();
        let poses = sequence.truth.into_iter().map(|pose| (pose.capture, pose.pose)).collect();
        Self { poses, skeleton: Arc::new(sequence.skeleton), shift }
    }
}

impl Method for Oracle {
    fn name(&self) -> String {
        format!("oracle {}", self.shift)
    }

    fn delay(&self, _: f64) -> Delay {
        Delay::Recording
    }

    fn solve(&mut self, _: &Take, _: &Decoder) -> Option<Solved> {
        let mut poses = self.poses.clone();
        poses.drain(..2);
        poses.iter_mut().for_each(|(_, pose)| pose.root_position.x += self.shift);
        let borders = vec![poses[30].0, poses[40].0];
        let motion = Motion::Poses(Arc::clone(&self.skeleton), poses);
        Some(Solved { motion, deviations: Vec::new(), borders, not_followed: None })
    }
}

/// Finds nobody.
struct Blind;

impl Method for Blind {
    fn name(&self) -> String {
        "blind".into()
    }

    fn delay(&self, _: f64) -> Delay {
        Delay::Frames(0)
    }

    fn solve(&mut self, _: &Take, _: &Decoder) -> Option<Solved> {
        None
    }
}

#[test]
fn scores_match_the_known_errors_of_a_method() {
    let case = cases(Noise::none()).remove(0);
    let solves = AtomicUsize::new(0);
    let make = || -> Vec<Box<dyn Method>> {
        [0.0, 0.05, 2.0].map(|shift| Box::new(Oracle::of(&case, shift)) as _).into()
    };
    let decoder = Decoder::embedded().unwrap();
    let each = || {
        solves.fetch_add(1, Ordering::Relaxed);
    };
    let found = run(std::slice::from_ref(&case), &make, &decoder, 1, &each);
    assert_eq!(solves.into_inner(), 3);
    let score = |row: usize| &found.rows[row].results[0].as_ref().unwrap().0;
    let (exact, shifted, far) = (score(0), score(1), score(2));
    let [exact_pose, shifted_pose] = [exact, shifted].map(|score| score.pose.as_ref().unwrap());
    assert!(exact_pose.mpjpe_mm < 1e-9 && exact.acceleration_error_m_s2.unwrap() < 1e-6);
    assert!(exact.limbs.limb_mm < 1e-9 && exact.held_out_px.unwrap() < 1e-6);
    let all = case.make().truth.len();
    assert_eq!((exact_pose.frames, exact_pose.pck3_percent), (all - 2, 100.0));
    assert!((exact.covered_percent - 100.0 * (all - 2) as f64 / all as f64).abs() < 1e-9);
    assert!(
        (shifted_pose.mpjpe_mm - 50.0).abs() < 1e-6 && (shifted_pose.rmse_mm - 50.0).abs() < 1e-6
    );
    assert!((shifted.limbs.limb_mm - 50.0).abs() < 1e-6 && shifted.held_out_px.unwrap() > 5.0);
    let far_px = far.held_out_px.expect("a body that is far off counts, too");
    assert!(far_px > 20.0 * shifted.held_out_px.unwrap(), "{far_px}");
    assert!(shifted_pose.mpjpe_root_relative_mm < 1e-6);
    assert_eq!((shifted_pose.pck3_percent, shifted_pose.pck7_percent), (0.0, 100.0));
    let jump = exact.velocity_jump.unwrap();
    assert!(jump.excess_m_s.abs() < 1e-9, "the true motion has its own jumps: {jump:?}");
    let skate = exact.foot_skate.unwrap();
    assert!((skate.mm_s - skate.truth_mm_s.unwrap()).abs() < 1e-6);

    let drifts = drift::drifts(&found);
    assert!(drifts[1].slope_mm_per_min.unwrap().value.abs() < 1e-6, "a shift is no drift");
}

#[test]
fn results_do_not_depend_on_threads_and_failures_are_counted() {
    let cases = cases(Noise::studio());
    assert_eq!(cases.len(), 2);
    let make = || -> Vec<Box<dyn Method>> {
        vec![Box::new(Windows::default_settings()), Box::new(Windows::paper()), Box::new(Blind)]
    };
    let decoder = Decoder::embedded().unwrap();
    let solve = |jobs: usize| {
        let found = run(&cases, &make, &decoder, jobs, &|| {});
        let summaries = summaries(&found, 0);
        assert_eq!(summaries.iter().map(|s| s.failed).collect::<Vec<_>>(), [0, 0, 2]);
        without_times(to_json(&found, &summaries))
    };
    assert_eq!(solve(1), solve(2));
}

#[test]
fn a_held_out_camera_is_not_used_at_all() {
    let take = cases(Noise::none()).remove(0).make().take;
    let (rest, seen) = real::without_camera(&take, 1).unwrap();
    let names: Vec<&str> = rest.rig.cameras.iter().map(|camera| camera.name.as_str()).collect();
    assert_eq!(names, ["cam01", "cam03"]);
    assert_eq!(seen.len() * 3, take.frames.len());
    assert_eq!(rest.frames.len(), 2 * seen.len());
    assert!(rest.frames.iter().all(|frame| frame.camera < 2));
    assert!(seen.iter().all(|frame| frame.camera == 0));
    assert_eq!(real::frame_rate(&take.frames).map(f64::round), Some(50.0));
    let two = real::without_camera(&rest, 0);
    assert!(two.is_err(), "one camera alone is no rig");
}

/// A results file without the times, which differ from run to run.
fn without_times(mut value: Value) -> Value {
    match &mut value {
        Value::Object(fields) => {
            fields.remove("ms_per_frame");
            fields.values_mut().for_each(|field| *field = without_times(field.take()));
        }
        Value::Array(items) => items.iter_mut().for_each(|item| *item = without_times(item.take())),
        _ => {}
    }
    value
}

fn eval(folder: &Path, arguments: &str) -> Output {
    Command::new(env!("CARGO_BIN_EXE_bundlemocap"))
        .arg("eval")
        .args(arguments.split_whitespace())
        .arg("--overwrite")
        .current_dir(folder)
        .output()
        .unwrap()
}

/// Runs and expects success; returns the standard output and the results.
fn done(folder: &Path, arguments: &str) -> (String, Value) {
    let output = eval(folder, arguments);
    let errors = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(0), "{arguments}: {errors}");
    let results = std::fs::read_to_string(folder.join("eval/results.json")).unwrap();
    let results = serde_json::from_str(&results).unwrap();
    (String::from_utf8(output.stdout).unwrap(), without_times(results))
}

#[test]
fn two_runs_give_the_same_results_folder() {
    let place = tempfile::tempdir().unwrap();
    let command =
        "methods --rig ring3 --seconds 1.2 --methods default,muvs --noise clean --every 2";
    let (printed, first) = done(place.path(), command);
    assert!(printed.contains("bundlemocap (default)") && printed.contains("MPJPE"), "{printed}");
    assert_eq!(done(place.path(), command).1, first);
    let other = done(place.path(), &format!("{command} --seed 2")).1;
    assert_ne!(other["levels"], first["levels"]);
    assert_eq!(first["levels"][0]["methods"].as_array().map(Vec::len), Some(2));
    let read = |name: &str| std::fs::read_to_string(place.path().join("eval").join(name)).unwrap();
    assert!(read("table.md").contains("| bundlemocap (default) |"));
    let page = read("report.html");
    assert!(
        page.matches("<svg").count() >= 6 && !page.contains("<script") && !page.contains("NaN")
    );
}

#[test]
fn several_cameras_of_a_recording_are_held_out_at_once() {
    let place = tempfile::tempdir().unwrap();
    let synth = ["synth", "--out", "take.mcap", "--seconds", "2", "--cameras", "5"];
    let program = Command::new(env!("CARGO_BIN_EXE_bundlemocap"))
        .args(synth)
        .current_dir(place.path())
        .output();
    assert!(program.unwrap().status.success());
    let methods = "recording take.mcap --methods triangulation,default";
    let (_, all) = done(place.path(), &format!("{methods} --hold-out cam02,cam05"));
    let (_, few) = done(
        place.path(),
        &format!("{methods} --cameras cam01,cam03,cam04 --hold-out cam02,cam05"),
    );
    assert_eq!(all["methods"], few["methods"], "the held-out cameras are not used");
    for method in all["methods"].as_array().unwrap() {
        let held_out = method["hold_out"].as_array().unwrap();
        let cameras: Vec<&str> =
            held_out.iter().map(|held| held["camera"].as_str().unwrap()).collect();
        assert_eq!(cameras, ["cam02", "cam05"]);
        let mean =
            held_out.iter().map(|held| held["median_px"].as_f64().unwrap()).sum::<f64>() / 2.0;
        assert!((method["hold_out_px"].as_f64().unwrap() - mean).abs() < 1e-9 && mean < 15.0);
        assert_eq!(method["cameras_px"].as_object().map(serde_json::Map::len), Some(3));
    }
}

#[test]
fn a_reference_of_another_system_is_fitted_and_its_markers_have_names() {
    let place = tempfile::tempdir().unwrap();
    let run = |arguments: &str| {
        let mut program = Command::new(env!("CARGO_BIN_EXE_bundlemocap"));
        program.args(arguments.split_whitespace()).current_dir(place.path());
        let output = program.output().unwrap();
        assert!(output.status.success(), "{arguments}: {output:?}");
    };
    run("synth --out take.mcap --seconds 3 --noise clean");
    run("solve take.mcap --out out");
    // It begins half a second later, at another rate, and z is up.
    run("export out/poses.mcap --out lab.c3d --fps 100 --up z --start 0.5");
    let sides = ["Shoulder", "Elbow", "Wrist", "Hip", "Knee", "Ankle"];
    let lines =
        sides.map(|name| format!("R{name} = 'R{name}'\nL{name} = ['L{name}', 'L{name}']\n"));
    std::fs::write(place.path().join("map.toml"), format!("[points]\n{}", lines.concat())).unwrap();
    let asked = "recording take.mcap --methods default --hold-out cam02 --reference lab.c3d \
                 --markers map.toml";
    let (printed, results) = done(place.path(), &format!("{asked} --align"));
    assert!(printed.contains("left_knee mm"), "{printed}");
    let reference = &results["methods"][0]["reference"];
    let shift_s = reference["fit"]["shift_s"].as_f64().unwrap();
    assert!((shift_s + 0.5).abs() < 2e-3, "{reference}");
    let rotation = &reference["fit"]["rotation"];
    let is_one = |axis: usize| rotation[axis][axis].as_f64().unwrap() > 0.9999;
    assert!((0..3).all(is_one), "{reference}");
    assert!(reference["mean_mm"].as_f64().unwrap() < 10.0, "{reference}");
    let (_, results) = done(place.path(), asked);
    let reference = &results["methods"][0]["reference"];
    assert!(reference["mean_mm"].as_f64().unwrap() > 50.0, "{reference}");
    assert!(reference.get("fit").is_none(), "{reference}");
}

#[test]
fn each_seed_of_the_protocol_is_a_pass() {
    let place = tempfile::tempdir().unwrap();
    std::fs::write(place.path().join("two.toml"), "seeds = [1, 2]").unwrap();
    let tiny = "methods --rig ring3 --seconds 1.2 --methods muvs --noise clean --every 4";
    let seeds = |results: &Value| results["levels"][0].to_string().matches("\"seed\":").count();
    let (_, one) = done(place.path(), tiny);
    let (_, two) = done(place.path(), &format!("{tiny} --protocol two.toml"));
    assert!(seeds(&one) > 0);
    assert_eq!(seeds(&two), 2 * seeds(&one));
}

#[test]
fn errors_are_as_large_as_their_standard_deviations_at_every_noise_level() {
    let place = tempfile::tempdir().unwrap();
    let levels = ["clean", "studio", "sparse", "uniform", "systematic"];
    let command = "methods --rig ring4 --seconds 6 --every 2 --methods default --noise";
    let (printed, results) = done(place.path(), &format!("{command} {}", levels.join(",")));
    assert!(printed.contains("in 1 sd %"), "{printed}");
    for (level, name) in results["levels"].as_array().unwrap().iter().zip(levels) {
        let mean = &level["methods"][0]["summary"]["mean"];
        let [one, two] = ["within_1_percent", "within_2_percent"].map(|key| mean[key].as_f64());
        let (one, two) = (one.unwrap(), two.unwrap());
        let is_right = (60.0..=76.0).contains(&one) && (90.0..=98.0).contains(&two);
        assert!(is_right, "{name}: {one:.1} % and {two:.1} %");
    }
}

#[test]
fn drift_and_ablation_print_their_tables() {
    let place = tempfile::tempdir().unwrap();
    let tiny = "--rig ring3 --seconds 2 --noise clean --every 4";
    let (printed, results) = done(place.path(), &format!("drift 0.5 {tiny}"));
    assert!(printed.contains("slope mm/min"), "{printed}");
    assert!(results["levels"][0]["drift"][0]["slope_mm_per_min"]["low"].is_number());
    let (printed, _) = done(place.path(), &format!("ablation interpolation {tiny}"));
    assert!(
        printed.contains("keyframe each frame (default)") && printed.contains("lerp"),
        "{printed}"
    );
}

#[test]
fn a_factor_of_the_view_has_a_curve_for_each_method() {
    let place = tempfile::tempdir().unwrap();
    let asked = "ablation noise,new_share,fps,readout --rig ring3 --seconds 1.5 --every 4 \
                 --methods triangulation,muvs";
    let (printed, results) = done(place.path(), asked);
    assert!(printed.contains("Error scale (1: the level): 0.25"), "{printed}");
    let mean = |factor: usize, value: usize| {
        let methods = results["factors"][factor]["values"][value]["methods"].as_array().unwrap();
        let means = methods.iter().map(|m| m["summary"]["mean"]["limb_mm"].as_f64().unwrap());
        let [triangulation, _muvs] = means.collect::<Vec<_>>()[..] else { panic!("{methods:?}") };
        triangulation
    };
    // Triangulation is worse with larger errors, and a filter is for errors that are new in each frame.
    assert!(mean(0, 0) < mean(0, 3) && mean(0, 3) < mean(0, 6), "{results}");
    assert!(mean(1, 4) < mean(1, 0), "{results}");
    // Two rolling shutters do not see the same moment.
    assert!(mean(3, 0) < mean(3, 4), "{results}");
    let report = std::fs::read_to_string(place.path().join("eval/report.html")).unwrap();
    assert_eq!(report.matches("Error in held-out cameras by ").count(), 2 * 4, "{report}");
}

#[test]
fn latencies_print_their_table_and_plots() {
    let place = tempfile::tempdir().unwrap();
    let tiny = "latencies 20,50 --rig ring3 --seconds 2 --noise clean --every 4";
    let (printed, results) = done(place.path(), tiny);
    assert!(printed.contains("live, provisional") && printed.contains("live, 50 ms"), "{printed}");
    assert_eq!(results["levels"][0]["methods"].as_array().map(Vec::len), Some(3));
    let report = std::fs::read_to_string(place.path().join("eval/report.html")).unwrap();
    assert!(report.contains("Acceleration error by latency"));
}

#[test]
fn faster_cameras_are_no_worse() {
    let errors = |fps: f64| {
        let cases = cases_at(fps, "ring3", 6.0, Noise::sparse());
        let methods = || -> Vec<Box<dyn Method>> { vec![Box::new(Windows::default_settings())] };
        let run = run(&cases, &methods, &Decoder::embedded().unwrap(), 1, &|| {});
        let scores = run.rows[0].results.iter().map(|result| &result.as_ref().unwrap().0.limbs);
        let sums = scores.fold([0.0; 2], |[mm, m_s2], limbs| {
            [mm + limbs.limb_mm, m_s2 + limbs.limb_acceleration_error_m_s2.unwrap()]
        });
        sums.map(|sum| sum / run.cases.len() as f64)
    };
    let [usual, fast, fastest] = [60.0, 120.0, 240.0].map(errors);
    println!("60, 120 and 240 frames/s, mm and m/s^2: {usual:.1?}, {fast:.1?}, {fastest:.1?}");
    assert!(fast[0] < 1.04 * usual[0] && fastest[0] < 1.10 * usual[0]);
    // A line between keyframes would have a kink at each.
    assert!(fast[1] < 1.1 * usual[1] && fastest[1] < 1.1 * usual[1]);
}

#[test]
fn provisional_poses_are_nearly_as_smooth_as_final_ones() {
    for noise in [Noise::studio(), Noise::systematic()] {
        let methods = || -> Vec<Box<dyn Method>> {
            let latency = Nanos::from_ms(200);
            vec![Box::new(LiveTracker::Provisional), Box::new(LiveTracker::Final(latency))]
        };
        let run =
            run(&cases_of("ring4", 4.0, noise), &methods, &Decoder::embedded().unwrap(), 1, &|| {});
        let mean = |row: usize, of: fn(&Score) -> f64| {
            let scores = run.rows[row].results.iter().map(|result| of(&result.as_ref().unwrap().0));
            scores.sum::<f64>()
        };
        let acceleration = |score: &Score| score.limbs.limb_acceleration_error_m_s2.unwrap();
        let ratio = mean(0, acceleration) / mean(1, acceleration);
        assert!(ratio < 2.0, "{ratio}");
        let error = |score: &Score| score.limbs.limb_mm;
        let ratio = mean(0, error) / mean(1, error);
        assert!(ratio < 1.2, "{ratio}");
    }
}

#[test]
fn a_crowd_is_scored_beside_its_bystanders() {
    let place = tempfile::tempdir().unwrap();
    let command = "performers 2 --bystanders 2 --rig ring3 --noise clean --seconds 2 --seed 1,2";
    let (printed, results) = done(place.path(), &format!("{command} --jobs 2"));
    assert!(printed.contains("PCP of the nearest"), "{printed}");
    let crowds = results["levels"][0]["crowds"].as_array().unwrap();
    assert_eq!(crowds.iter().map(|one| &one["seed"]).collect::<Vec<_>>(), [1, 2]);
    for crowd in crowds {
        let scores = &crowd["scores"];
        // Two people at 50 Hz; the bystanders are neither missed nor wrong.
        assert_eq!(scores["people"], 200, "{scores}");
        assert_eq!(scores["precision_percent"], 100.0, "{scores}");
        assert!(scores["recall_percent"].as_f64().unwrap() > 99.0, "{scores}");
        assert!(scores["pcp_nearest_percent"].as_f64().unwrap() > 99.0, "{scores}");
    }
    assert_eq!(done(place.path(), command).1["levels"], results["levels"]);
}

#[test]
fn bones_of_bodies_with_a_skin_are_compared_by_body() {
    let place = tempfile::tempdir().unwrap();
    let command =
        "methods --body skinned --rig ring4 --noise none --seconds 3 --every 3 --methods default";
    let (printed, results) = done(place.path(), command);
    assert!(printed.contains("Bones by body, less the true ones"), "{printed}");
    let method = &results["levels"][0]["methods"][0];
    for sequence in method["sequences"].as_array().unwrap() {
        let body = sequence["body"].as_str().unwrap();
        assert!(printed.lines().any(|line| line.starts_with(body)), "{body}: {printed}");
        // Most of the difference is constant: the two bodies define joint centres differently.
        let score = |key: &str| sequence["score"][key].as_f64().unwrap();
        assert!(score("limb_less_offset_mm") < 0.5 * score("limb_mm"), "{sequence}");
        assert!(score("limb_less_offset_mm") < 12.0, "{sequence}");
    }
}

#[test]
fn every_factor_of_an_ablation_is_in_its_help() {
    let place = tempfile::tempdir().unwrap();
    let help = eval(place.path(), "ablation all --help");
    let help = String::from_utf8(help.stdout).unwrap();
    let (_, list) = help.split_once("some of ").unwrap();
    let (list, _) = list.split_once('.').unwrap();
    let words = list.split([',', ';', ':', ' ', '\n']).filter(|word| !word.is_empty());
    let words = BTreeSet::from_iter(words);
    for factor in FACTORS {
        assert!(words.contains(factor), "{factor}: {list}");
    }
}

#[test]
fn wrong_arguments_give_a_one_line_error_with_a_fix() {
    let place = tempfile::tempdir().unwrap();
    let told = |arguments: &str, code: i32, part: &str| {
        let output = eval(place.path(), arguments);
        let errors = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(code), "{arguments}: {errors}");
        assert!(errors.contains(part), "{arguments}: {errors}");
        assert!(!place.path().join("eval").exists(), "{arguments}");
    };
    told("methods --methods guess", 2, "use all, ladder, triangulation");
    told("methods --rig ring3 --body foreign", 2, "--motions");
    told("methods --rig ring3 --hold-out cam01", 2, "--hold-out");
    told("performers 2 --rig ring3 --body foreign", 2, "--motions");
    told("performers 2 --rig ring3 --motions none/", 3, "none");
    told("drift 0.1 --rig ring3", 2, "minutes is 0.1");
    told("methods --rig ring3 --noise loud", 2, "sparse");
    told("methods --rig round", 2, "ring2");
    told("methods --rig ring3 --seconds 0", 2, "--seconds is 0");
    told("methods --rig ring3 --fps 0", 2, "--fps is 0");
    told("ablation shoes --rig ring3", 2, "window");
    told("tune shoes --rig ring3", 2, "muvs");
    told("latencies 5 --rig ring3", 2, "a latency is 5, but must be 6 to");
    told("methods --rig ring3 --motions none/", 3, "none");
    told("methods --rig ring3 --protocol none.toml", 3, "none.toml");
    told("methods --rig ring3 --jobs 0", 2, "--jobs");
    told("recording none.mcap", 3, "none.mcap");
    std::fs::write(place.path().join("bad.toml"), "loudness = 1").unwrap();
    told("methods --protocol bad.toml", 4, "loudness");
}

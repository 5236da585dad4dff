//! Training on synthetic motion, and reading the real corpus if available.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use bundlemocap::core::body::{BODY_JOINTS, Joint};
use bundlemocap::core::manifold::{Decoder, Keyframe};
use bundlemocap::io::formats::bvh::Bvh;
use bundlemocap::research::train::{
    Clip, Options, TrainError, evaluate, evaluate_transition, read_folder, run, train_transition,
    transition_keyframes,
};
use bundlemocap::research::transition::{Transition, TransitionWork};
use nalgebra::{Matrix3, Vector3};

use crate::support::data;

/// Name, parent index and offset of each joint.
type Tree = &'static [(&'static str, usize, [f64; 3])];

const HIP: Tree = &[
    ("hip", 0, [0.0, 0.0, 0.0]),
    ("abdomen", 0, [0.0, 20.0, 0.0]),
    ("chest", 1, [0.0, 12.0, 0.0]),
    ("neck", 2, [0.0, 22.0, 0.0]),
    ("head", 3, [0.0, 7.0, 0.0]),
    ("rCollar", 2, [-3.0, 19.0, 0.0]),
    ("rShldr", 5, [-9.0, 0.0, 0.0]),
    ("rForeArm", 6, [-28.0, 0.0, 0.0]),
    ("rHand", 7, [-23.0, 0.0, 0.0]),
    ("lCollar", 2, [3.0, 19.0, 0.0]),
    ("lShldr", 9, [9.0, 0.0, 0.0]),
    ("lForeArm", 10, [28.0, 0.0, 0.0]),
    ("lHand", 11, [23.0, 0.0, 0.0]),
    ("rButtock", 0, [-8.0, -8.0, 0.0]),
    ("rThigh", 13, [0.0, -2.0, 0.0]),
    ("rShin", 14, [0.0, -41.0, 0.0]),
    ("rFoot", 15, [0.0, -42.0, 0.0]),
    ("lButtock", 0, [8.0, -8.0, 0.0]),
    ("lThigh", 17, [0.0, -2.0, 0.0]),
    ("lShin", 18, [0.0, -41.0, 0.0]),
    ("lFoot", 19, [0.0, -42.0, 0.0]),
];

const HIPS: Tree = &[
    ("Hips", 0, [0.0, 0.0, 0.0]),
    ("LowerBack", 0, [0.0, 0.0, 0.0]),
    ("Spine", 1, [0.0, 2.0, 0.0]),
    ("Spine1", 2, [0.0, 2.0, 0.0]),
    ("Neck", 3, [0.0, 0.0, 0.0]),
    ("Head", 4, [0.0, 1.5, 0.0]),
    ("LeftShoulder", 3, [0.0, 0.0, 0.0]),
    ("LeftArm", 6, [3.5, 0.9, 0.0]),
    ("LeftForeArm", 7, [4.9, 0.0, 0.0]),
    ("LeftHand", 8, [3.4, 0.0, 0.0]),
    ("RightShoulder", 3, [0.0, 0.0, 0.0]),
    ("RightArm", 10, [-3.5, 0.9, 0.0]),
    ("RightForeArm", 11, [-4.9, 0.0, 0.0]),
    ("RightHand", 12, [-3.4, 0.0, 0.0]),
    ("LeftUpLeg", 0, [1.6, -1.8, 0.0]),
    ("LeftLeg", 14, [2.6, -7.1, 0.0]),
    ("LeftFoot", 15, [2.5, -6.8, 0.0]),
    ("LeftToeBase", 16, [0.2, -0.5, 2.1]),
    ("RightUpLeg", 0, [-1.6, -1.8, 0.0]),
    ("RightLeg", 18, [-2.6, -7.1, 0.0]),
    ("RightFoot", 19, [-2.5, -6.8, 0.0]),
    ("RightToeBase", 20, [-0.2, -0.5, 2.1]),
];

/// The BVH text of a tree; `angle(frame, value)` gives each rotation in degrees.
fn bvh_text(tree: Tree, frames: usize, angle: impl Fn(usize, usize) -> f64) -> String {
    let mut text = String::from("HIERARCHY\n");
    open(tree, 0, &mut text);
    write!(text, "MOTION\nFrames: {frames}\nFrame Time: 0.0166667\n").unwrap();
    for frame in 0..frames {
        text += "0 90 0";
        for value in 0..3 * tree.len() {
            write!(text, " {:.4}", angle(frame, value)).unwrap();
        }
        text.push('\n');
    }
    text
}

fn open(tree: Tree, index: usize, text: &mut String) {
    let (name, _, [x, y, z]) = tree[index];
    let (kind, channels) =
        if index == 0 { ("ROOT", "6 Xposition Yposition Zposition") } else { ("JOINT", "3") };
    write!(
        text,
        "{kind} {name}\n{{\nOFFSET {x} {y} {z}\nCHANNELS {channels} Zrotation Yrotation Xrotation\n"
    )
    .unwrap();
    let children: Vec<usize> =
        (1..tree.len()).filter(|&child| child != index && tree[child].1 == index).collect();
    for &child in &children {
        open(tree, child, text);
    }
    if children.is_empty() {
        *text += "End Site\n{\nOFFSET 1 0 0\n}\n";
    }
    *text += "}\n";
}

/// A periodic motion, different for every `clip`.
fn swing(clip: usize) -> impl Fn(usize, usize) -> f64 {
    move |frame, value| {
        let phase = 0.1 * frame as f64 + 1.7 * value as f64;
        (12.0 + 4.0 * (clip % 3) as f64) * (phase * (1.0 + 0.1 * clip as f64)).sin()
    }
}

/// A folder with clips of subjects 01, 02 and `act`.
fn folder() -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    std::fs::create_dir(folder.path().join("more")).unwrap();
    // The trees are listed depth-first, so the values have the order of the tree.
    for (clip, (name, tree)) in
        [("01_01.bvh", HIP), ("01_02.bvh", HIP), ("02_01.bvh", HIP), ("more/act_walk_1.bvh", HIPS)]
            .into_iter()
            .enumerate()
    {
        std::fs::write(folder.path().join(name), bvh_text(tree, 80, swing(clip))).unwrap();
    }
    folder
}

fn tiny(folder: &Path, out: &str) -> Options {
    Options {
        motions: folder.to_owned(),
        out: folder.join(out),
        test_subjects: vec!["02".into()],
        steps: 150,
        batch: 32,
        hidden: 32,
        encoder_hidden: 48,
        layers: 2,
        threads: 2,
        ..Options::default()
    }
}

#[test]
fn the_loss_falls_and_the_same_seed_gives_the_same_bytes() {
    let folder = folder();
    let train = |options: Options| {
        let mut losses = Vec::new();
        let report = run(&options, &mut |progress| losses.push(progress.loss)).unwrap();
        (std::fs::read(&options.out).unwrap(), losses, report)
    };
    let (first, losses, report) = train(tiny(folder.path(), "a.safetensors"));
    assert_eq!(losses.len(), 3);
    assert!(losses[2] < 0.7 * losses[0], "{losses:?}");
    assert_eq!((report.clips, report.frames), (3, 240));

    let one_thread = Options { threads: 1, ..tiny(folder.path(), "a.safetensors") };
    assert_eq!(train(one_thread).0, first);
    let other_seed = Options { seed: 2, ..tiny(folder.path(), "a.safetensors") };
    assert_ne!(train(other_seed).0, first);

    std::fs::write(folder.path().join("a.safetensors"), first).unwrap();
    let again =
        evaluate(&folder.path().join("a.safetensors"), folder.path(), &["02".into()]).unwrap();
    for (written, trained) in again.iter().zip(&report.held_out) {
        assert_eq!((&written.subject, written.frames), (&trained.subject, 80));
        assert!((written.joint_mm - trained.joint_mm).abs() < 1e-3);
    }
    assert_eq!(again.last().unwrap().subject, "all");
    let lines = bundlemocap::research::train::table(&again);
    assert_eq!(lines.lines().count(), 3);
    let row: Vec<&str> = lines.lines().nth(1).unwrap().split_whitespace().take(2).collect();
    assert_eq!(row, ["02", "80"]);
}

#[test]
fn the_weights_record_how_they_were_trained() {
    let folder = folder();
    let options = Options { steps: 2, ..tiny(folder.path(), "b.safetensors") };
    run(&options, &mut |_| ()).unwrap();
    let bytes = std::fs::read(&options.out).unwrap();
    let (_, header) = safetensors::SafeTensors::read_metadata(&bytes).unwrap();
    let metadata = header.metadata().clone().unwrap();
    assert_eq!(metadata["format"], "bundlemocap-manifold");
    assert_eq!(metadata["subjects"], "01,act");
    assert!(metadata["command"].contains("--test-subjects 02 --out b.safetensors"));
    assert!(metadata["held_out_joint_mm"].parse::<f64>().unwrap() > 0.0);
    let tensors = safetensors::SafeTensors::deserialize(&bytes).unwrap();
    for (name, shape) in [
        ("encoder.0.weight", vec![48, 126]),
        ("encoder.2.bias", vec![64]),
        ("decoder.0.weight", vec![32, 32]),
        ("decoder.1.weight", vec![32, 32]),
        ("decoder.2.weight", vec![126, 32]),
    ] {
        assert_eq!(tensors.tensor(name).unwrap().shape(), shape, "{name}");
    }
}

#[test]
fn a_transition_model_learns_and_the_same_seed_gives_the_same_bytes() {
    let folder = folder();
    let options = Options { steps: 400, ..tiny(folder.path(), "t.safetensors") };
    let train = || {
        let mut losses = Vec::new();
        let report = train_transition(&options, None, &mut |_, loss| losses.push(loss)).unwrap();
        (std::fs::read(&options.out).unwrap(), losses, report)
    };
    let (first, losses, report) = train();
    assert_eq!(train().0, first);
    assert_eq!(losses.len(), 8);
    assert!(losses[7] < losses[0] - 0.1, "{losses:?}");
    let (out, subjects) = (&options.out, ["02".to_owned()]);
    let again = evaluate_transition(out, None, folder.path(), &subjects).unwrap();
    assert_eq!(again, report.held_out);
    assert_eq!(again.iter().map(|row| row.fps).collect::<Vec<_>>(), [30.0, 50.0, 60.0]);
    let model = Transition::from_bytes(&first).unwrap();
    assert!(model.fits(&Decoder::embedded().unwrap()));
}

/// Mean negative log likelihood over the transitions of keyframes at 60 fps.
fn mean_neg_log_likelihood(model: &Transition, keyframes: &[&Keyframe]) -> f64 {
    let mut work = TransitionWork::default();
    let of = |three: &[&Keyframe]| {
        model.neg_log_likelihood([three[0], three[1], three[2]], 1.0 / 60.0, &mut work)
    };
    keyframes.windows(3).map(of).sum::<f64>() / (keyframes.len() - 2) as f64
}

#[test]
fn the_transition_model_prefers_real_transitions_to_shuffled_ones() {
    let Some(folder) = corpus() else { return };
    let model = Transition::embedded().unwrap();
    let clips = read_folder(&folder).unwrap();
    let unseen = clips.iter().filter(|clip| ["07", "10"].contains(&clip.subject.as_str()));
    let unseen: Vec<_> = unseen.step_by(4).collect();
    assert!(unseen.len() > 2);
    for clip in unseen {
        let keyframes = transition_keyframes(None, clip, 60.0).unwrap();
        let count = keyframes.len();
        let real: Vec<&Keyframe> = keyframes.iter().collect();
        // Swapped neighbours, and frames taken in turn from the three thirds of the clip.
        let swapped: Vec<&Keyframe> = (0..count & !1).map(|i| &keyframes[i ^ 1]).collect();
        let jumps: Vec<&Keyframe> =
            (0..count).map(|i| &keyframes[(i + (i % 3) * count / 3) % count]).collect();
        let real = mean_neg_log_likelihood(&model, &real);
        assert!(real < mean_neg_log_likelihood(&model, &swapped), "{}", clip.name);
        assert!(real < mean_neg_log_likelihood(&model, &jumps), "{}", clip.name);
    }
}

fn local(clip: &Clip, frame: usize, joint: Joint) -> Matrix3<f64> {
    let six = &clip.poses[frame][6 * (joint.index() - 1)..][..6];
    let column = |at: usize| Vector3::from_fn(|row, _| f64::from(six[at + row]));
    let (a, b) = (column(0), column(3));
    Matrix3::from_columns(&[a, b, a.cross(&b)])
}

/// `pelvis_from_joint`.
fn from_pelvis(clip: &Clip, frame: usize, joint: Joint) -> Matrix3<f64> {
    match joint.parent() {
        Some(parent) => from_pelvis(clip, frame, parent) * local(clip, frame, joint),
        None => Matrix3::identity(),
    }
}

#[test]
fn splayed_legs_are_straightened_and_other_joints_stay() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("a.bvh"), bvh_text(HIPS, 1, |_, _| 0.0)).unwrap();
    let clip = &read_folder(folder.path()).unwrap()[0];
    assert_eq!(clip.subject, "act");
    for (joint, x) in [(Joint::LHip, 2.6), (Joint::RHip, -2.6)] {
        let shank = local(clip, 0, joint) * -Vector3::y();
        assert!((shank - Vector3::new(x, -7.1, 0.0).normalize()).norm() < 1e-6);
    }
    for joint in [Joint::LKnee, Joint::RFoot, Joint::Spine2, Joint::LElbow] {
        assert!((local(clip, 0, joint) - Matrix3::identity()).amax() < 1e-6);
    }
}

#[test]
fn the_own_skeleton_of_a_clip_has_the_bones_of_its_file() {
    let place = folder();
    let clips = read_folder(place.path()).unwrap();
    let files = [
        ("01_01", "01_01.bvh", 0.01, ["rShin", "rFoot", "lForeArm", "lHand"]),
        (
            "act_walk_1",
            "more/act_walk_1.bvh",
            0.056444,
            ["RightLeg", "RightFoot", "LeftForeArm", "LeftHand"],
        ),
    ];
    for (name, path, metres, names) in files {
        let clip = clips.iter().find(|clip| clip.name == name).unwrap();
        let text = std::fs::read_to_string(place.path().join(path)).unwrap();
        let bvh = Bvh::parse(&text).unwrap();
        let (theirs, ours) =
            (bvh.posture(7).unwrap(), clip.pose(7).unwrap().posture(&clip.skeleton));
        let [knee, ankle, elbow, wrist] = names.map(|name| theirs[bvh.joint(name).unwrap()].1);
        let at = |joint: Joint| ours.positions[joint.index()];
        for (bone, file) in [
            (at(Joint::RAnkle) - at(Joint::RKnee), ankle - knee),
            (at(Joint::LWrist) - at(Joint::LElbow), wrist - elbow),
        ] {
            assert!((bone - file * metres).norm() < 1e-5, "{name}: {bone} {file}");
        }
    }
}

#[test]
fn rest_pose_turns_and_missing_spine_joints() {
    let folder = tempfile::tempdir().unwrap();
    let text = bvh_text(HIP, 1, |_, value| if value == 3 { 30.0 } else { 0.0 });
    std::fs::write(folder.path().join("03_01.bvh"), text).unwrap();
    let clip = &read_folder(folder.path()).unwrap()[0];
    let expected = bundlemocap::core::so3::exp(&(Vector3::z() * 30f64.to_radians()));
    assert!((local(clip, 0, Joint::Spine1) - expected).amax() < 1e-6);
    assert!((local(clip, 0, Joint::Spine2) - Matrix3::identity()).amax() < 1e-6);
    assert!((local(clip, 0, Joint::Spine3) - Matrix3::identity()).amax() < 1e-6);
}

#[test]
fn errors_name_the_bad_input() {
    let folder = folder();
    let options = || tiny(folder.path(), "c.safetensors");
    let message = |options: &Options| run(options, &mut |_| ()).unwrap_err().to_string();

    let unknown = Options { test_subjects: vec!["77".into()], ..options() };
    assert_eq!(message(&unknown), "no clip of subject `77`; the clips' subjects are 01, 02, act");
    let all = ["01", "02", "act"].map(str::to_owned).to_vec();
    assert!(matches!(
        run(&Options { test_subjects: all, ..options() }, &mut |_| ()),
        Err(TrainError::NothingLeft { .. })
    ));
    let nowhere = Options { motions: folder.path().join("none"), ..options() };
    assert!(message(&nowhere).contains("none: cannot be read"));
    assert!(message(&Options { batch: 0, ..options() }).contains("`batch` is 0"));
    assert!(message(&Options { kl: f32::NAN, ..options() }).contains("`kl` is NaN"));

    let legless = bvh_text(HIP, 20, swing(0)).replace("lShin", "shin");
    std::fs::write(folder.path().join("04_01.bvh"), legless).unwrap();
    assert!(message(&options()).contains("04_01.bvh: has no joint `lShin`"));
    std::fs::write(folder.path().join("04_01.bvh"), "HIERARCHY\nROOT hip\n{\n").unwrap();
    assert!(message(&options()).contains("04_01.bvh: the file ends"));
    assert!(!options().out.exists());

    let weights = folder.path().join("d.safetensors");
    std::fs::write(&weights, b"no weights").unwrap();
    let error = evaluate(&weights, folder.path(), &[]).unwrap_err().to_string();
    assert!(error.contains("d.safetensors"), "{error}");
}

/// Folder of the motion clips, if available.
fn corpus() -> Option<PathBuf> {
    data("motions/cmu")
}

/// Our joint, and the two ends of its bone in each of the two skeletons.
const BONES: [(Joint, [&str; 2], [&str; 2]); 4] = [
    (Joint::LHip, ["lThigh", "lShin"], ["LeftUpLeg", "LeftLeg"]),
    (Joint::RKnee, ["rShin", "rFoot"], ["RightLeg", "RightFoot"]),
    (Joint::LShoulder, ["lShldr", "lForeArm"], ["LeftArm", "LeftForeArm"]),
    (Joint::RElbow, ["rForeArm", "rHand"], ["RightForeArm", "RightHand"]),
];

/// Direction of our joint's bone at rest.
fn rest_direction(joint: Joint) -> Vector3<f64> {
    match joint {
        Joint::LShoulder => Vector3::x(),
        Joint::RElbow => -Vector3::x(),
        _ => -Vector3::y(),
    }
}

#[test]
fn the_whole_corpus_is_read_and_limb_directions_match_the_files() {
    let Some(folder) = corpus() else { return };
    let clips = read_folder(&folder).unwrap();
    let frames: usize = clips.iter().map(|clip| clip.poses.len()).sum();
    assert_eq!((clips.len(), frames), (173, 86_321));
    assert_eq!(clips[0].poses[0].len(), 6 * BODY_JOINTS);
    for clip in clips.iter().step_by(7) {
        let text = std::fs::read_to_string(folder.join(format!("{}.bvh", clip.name))).unwrap();
        let bvh = Bvh::parse(&text).unwrap();
        let frame = clip.poses.len() / 2;
        let posture = bvh.posture(frame).unwrap();
        let at = |name: &str| posture[bvh.joint(name).unwrap()];
        let splayed = bvh.joint("Hips").is_some();
        let pelvis = at(if splayed { "Hips" } else { "hip" }).0;
        for (joint, hip, hips) in BONES {
            let [from, to] = if splayed { hips } else { hip };
            let file = pelvis.transpose() * (at(to).1 - at(from).1).normalize();
            let ours = from_pelvis(clip, frame, joint) * rest_direction(joint);
            let angle = file.angle(&ours).to_degrees();
            // The rest offset of the first skeleton's forearm is up to 18 degrees off the axis.
            let most = if matches!(joint, Joint::LElbow | Joint::RElbow) { 20.0 } else { 12.0 };
            assert!(angle < most, "{} {}: {angle}", clip.name, joint.name());
        }
    }
}

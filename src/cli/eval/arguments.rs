//! The arguments of `bundlemocap eval`.

use std::path::PathBuf;

use clap::{Args, Subcommand};

use crate::cli::failure::ratio;
use crate::cli::overwrite::Overwrite;
use crate::research::synth::Body;

/// Compare methods on synthetic recordings with ground truth, or on a real recording.
#[derive(Debug, Args)]
#[command(after_help = "\
Synthetic cameras with noisy detectors see each motion; every method solves the same detections. No
method knows the true body, pose or first frame. The folder DIR gets table.md, results.json (all
metrics of each sequence, all settings and seeds) and report.html. Results depend only on the seed,
except for the times.

Examples:
  bundlemocap eval methods --motions motions/ --rig h36m --noise sparse --methods all --out eval
  bundlemocap eval methods --motions motions/ --methods paper,default --every 3 --rig ring4
  bundlemocap eval methods --rig ring4 --methods default --seconds 5
  bundlemocap eval methods --motions motions/ --body foreign --noise uniform
  bundlemocap eval methods --motions motions/ --body skinned --noise none,clean
  bundlemocap eval recording balancing.mcap --reference pose2sim.trc
  bundlemocap eval recording walk.mcap --reference lab.c3d --markers markers.toml --align
  bundlemocap eval recording walk.mcap --hold-out c4,c5 --methods all
  bundlemocap eval drift 10 --motions motions/
  bundlemocap eval latencies 20,35,50,75,100,150,200 --motions motions/ --every 3
  bundlemocap eval performers 2,4,6 --rig ring4 --noise studio --seconds 60
  bundlemocap eval performers 6 --rig ring8 --motions motions/ --body foreign --bystanders 4
  bundlemocap eval ablation window,cameras --motions motions/ --every 4
  bundlemocap eval ablation noise,fps --motions motions/ --methods muvs,paper-body
  bundlemocap eval tune default --motions motions/ --every 12")]
pub(in crate::cli) struct Arguments {
    #[command(subcommand)]
    pub(super) what: What,
}

#[derive(Debug, Subcommand)]
pub(super) enum What {
    Methods(Methods),
    Recording(Recording),
    Performers(Performers),
    Drift(Drift),
    Latencies(Latencies),
    Ablation(Ablation),
    Tune(Tune),
}

/// Compare methods on synthetic recordings.
#[derive(Debug, Args)]
pub(super) struct Methods {
    #[command(flatten)]
    pub(super) named: Named,
    #[command(flatten)]
    pub(super) motions: Motions,
    /// Compare the detector errors of this recording with the noise levels.
    #[arg(long, value_name = "FILE")]
    pub(super) beside: Option<PathBuf>,
}

/// Compare methods on a real recording: reprojection error, error in each camera when held out, and
/// distance to a reference. Times of cameras are not corrected: `check` names wrong ones.
#[derive(Debug, Args)]
pub(super) struct Recording {
    /// The recording.
    pub(super) file: PathBuf,
    #[command(flatten)]
    pub(super) named: Named,
    /// Compare our poses at these declared latencies, milliseconds, and provisional ones.
    #[arg(long, value_name = "MS", value_delimiter = ',', conflicts_with = "methods")]
    pub(super) latencies: Vec<f64>,
    /// Use only these cameras.
    #[arg(long, value_name = "NAMES", value_delimiter = ',')]
    pub(super) cameras: Vec<String>,
    /// Solve without these cameras and report the error in them; default: without each camera in turn.
    #[arg(long, value_name = "NAMES", value_delimiter = ',')]
    pub(super) hold_out: Vec<String>,
    /// Solve with every Nth frame of each camera; the cameras of --hold-out keep theirs.
    #[arg(long, value_name = "N", default_value_t = 1, requires = "hold_out")]
    #[arg(value_parser = clap::value_parser!(u16).range(1..))]
    pub(super) every: u16,
    /// Add normally distributed errors to the keypoints, pixels along each axis, new in each frame; those of
    /// --hold-out stay as they are.
    #[arg(long, value_name = "PX", default_value_t = 0.0, allow_negative_numbers = true)]
    #[arg(requires = "hold_out")]
    pub(super) jitter: f64,
    /// Report the distance to these marker trajectories (TRC with y up, or C3D; frames as in the recording).
    #[arg(long, value_name = "FILE")]
    pub(super) reference: Option<PathBuf>,
    /// TOML file that names the markers of each point for --reference. Below [points],
    /// left_knee = ["LFLE", "LFME"] is the middle of two markers. Default: markers with names such as LKnee
    /// or left_knee.
    #[arg(long, value_name = "TOML", requires = "reference")]
    pub(super) markers: Option<PathBuf>,
    /// Fit the reference to the poses of each method first, in time, rotation and translation. For a reference
    /// of another system.
    #[arg(long, requires = "reference")]
    pub(super) align: bool,
    #[command(flatten)]
    pub(super) output: Output,
}

/// Solve crowds who cross and meet, with bodies of their own, and each of their people alone. With --motions
/// people move as in the clips, without it they walk. Of --rig, only the number of cameras counts.
#[derive(Debug, Args)]
pub(super) struct Performers {
    /// Numbers of people, 2 to 32.
    #[arg(
        required = true,
        value_name = "NUMBERS",
        value_delimiter = ',',
        value_parser = clap::value_parser!(u8).range(2..=32)
    )]
    pub(super) numbers: Vec<u8>,
    /// Distance of the pelvises in the crowds' meetings, metres: 0.7 is arm's length, 0.3 an embrace.
    #[arg(long, value_name = "METRES", default_value_t = 0.7, allow_negative_numbers = true)]
    pub(super) meet: f64,
    /// Number of people who sit beyond the edge of the floor, or walk around it. They are not performers.
    #[arg(long, value_name = "NUMBER", default_value_t = 0, value_parser = clap::value_parser!(u8).range(..=16))]
    pub(super) bystanders: u8,
    #[command(flatten)]
    pub(super) motions: Motions,
}

/// Measure how the error changes over a long motion.
#[derive(Debug, Args)]
pub(super) struct Drift {
    /// Length of the motion, 0.5 to 600 minutes.
    #[arg(allow_negative_numbers = true)]
    pub(super) minutes: f64,
    #[command(flatten)]
    pub(super) named: Named,
    #[command(flatten)]
    pub(super) motions: Motions,
}

/// Measure the live tracker's final poses at declared latencies, in simulated time, and provisional ones.
#[derive(Debug, Args)]
pub(super) struct Latencies {
    /// The latencies.
    #[arg(
        required = true,
        value_name = "MS",
        value_delimiter = ',',
        allow_negative_numbers = true
    )]
    pub(super) latencies: Vec<f64>,
    #[command(flatten)]
    pub(super) motions: Motions,
}

/// Vary our settings one at a time, at the first level of --noise.
#[derive(Debug, Args)]
pub(super) struct Ablation {
    /// All, or some of window, publish, keyframe, interpolation, stiffness, robust_scale, optimiser,
    /// stop, scale, prior, prior_dof, errors, foot_contact, foot_contact_speed, paper_prior; and for the
    /// methods of --methods: cameras, noise, new_share, fps, readout.
    #[arg(required = true, value_name = "FACTORS", value_delimiter = ',')]
    pub(super) factors: Vec<String>,
    #[command(flatten)]
    pub(super) named: Named,
    #[command(flatten)]
    pub(super) motions: Motions,
}

/// Search a method's weights, on the subjects that are not named.
#[derive(Debug, Args)]
pub(super) struct Tune {
    /// The method.
    pub(super) method: String,
    #[command(flatten)]
    pub(super) motions: Motions,
}

/// Which methods.
#[derive(Debug, Args)]
pub(super) struct Named {
    /// Methods by name, all compared ones, or ladder: the steps from the paper's path to the default.
    /// By default all for motions; triangulation, paper-body and default for a recording; live for drift;
    /// paper and default for ablation.
    #[arg(long, value_name = "NAMES", value_delimiter = ',')]
    pub(super) methods: Vec<String>,
}

/// Which motions, and how they are seen.
#[derive(Debug, Args)]
pub(super) struct Motions {
    #[command(flatten)]
    pub(super) views: Views,
    /// Folder of BVH clips with the motions; default: a procedural motion.
    #[arg(long, value_name = "DIR")]
    pub(super) motions: Option<PathBuf>,
    /// Subjects whose clips are used [protocol: 07,10].
    #[arg(long, value_name = "NAMES", value_delimiter = ',', requires = "motions")]
    pub(super) subjects: Vec<String>,
    /// Bodies of the performers: own, shapes of our body model; foreign, each clip's own skeleton
    /// with keypoints at its joints; or skinned, eight bodies of Anny with keypoints on their skin
    /// [protocol: own].
    #[arg(long, value_name = "KIND", value_parser = Body::ALL.map(Body::name))]
    pub(super) body: Option<String>,
    /// Use every Nth clip.
    #[arg(long, value_name = "N", default_value_t = 1)]
    pub(super) every: usize,
    /// Sequences solved in parallel; solve times are comparable only with 1.
    #[arg(long, value_name = "N", default_value_t = 1)]
    pub(super) jobs: usize,
}

/// Cameras and detectors, and how they are solved.
#[derive(Debug, Args)]
pub(super) struct Views {
    /// Settings of motions, rigs and detectors; config/eval.toml lists every setting.
    #[arg(long, value_name = "FILE")]
    pub(super) protocol: Option<PathBuf>,
    /// Longest part of a clip, from its middle, seconds [protocol: 8].
    #[arg(long, allow_negative_numbers = true)]
    pub(super) seconds: Option<f64>,
    /// Frame rate of the cameras, 1 to 1000 Hz [protocol: 50].
    #[arg(long, value_name = "HZ", value_parser = ratio, allow_negative_numbers = true)]
    pub(super) fps: Option<f64>,
    /// Rigs: h36m, h36m-s11, 3dhp, ring2 to ring64; several are used in turn [h36m if its
    /// file is there, else ring4; ring4 for performers].
    #[arg(long, value_name = "NAMES", value_delimiter = ',')]
    pub(super) rig: Vec<String>,
    /// File with the Human3.6M cameras, JSON with the keys intrinsics, extrinsics_S9_S11 and res; default: in
    /// the folder of the variable BUNDLEMOCAP_DATA, or in ../shared.
    #[arg(long, value_name = "FILE")]
    pub(super) h36m: Option<PathBuf>,
    /// Noise levels of the detectors: none, or a level of the protocol (clean, studio, sparse,
    /// uniform, systematic).
    #[arg(long, value_name = "LEVELS", value_delimiter = ',', default_values = ["studio", "sparse"])]
    pub(super) noise: Vec<String>,
    /// Seeds of all random draws; they replace those of the protocol, [1].
    #[arg(long, value_name = "SEEDS", value_delimiter = ',')]
    pub(super) seed: Vec<u64>,
    #[command(flatten)]
    pub(super) output: Output,
}

/// Where the results go, and the manifold.
#[derive(Debug, Args)]
pub(super) struct Output {
    /// Output folder; created if missing.
    #[arg(long, value_name = "DIR", default_value = "eval")]
    pub(super) out: PathBuf,
    #[command(flatten)]
    pub(super) overwrite: Overwrite,
    /// Manifold weights of `bundlemocap train`; default: the embedded weights.
    #[arg(long, value_name = "FILE")]
    pub(super) weights: Option<PathBuf>,
}

impl What {
    pub(super) fn output(&self) -> &Output {
        match self {
            Self::Recording(recording) => &recording.output,
            Self::Methods(Methods { motions, .. })
            | Self::Performers(Performers { motions, .. })
            | Self::Drift(Drift { motions, .. })
            | Self::Latencies(Latencies { motions, .. })
            | Self::Ablation(Ablation { motions, .. })
            | Self::Tune(Tune { motions, .. }) => &motions.views.output,
        }
    }
}

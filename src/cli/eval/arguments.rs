//! The arguments of `bundlemocap eval`.

use std::path::PathBuf;

use clap::Args;

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

--recording solves a real recording instead and reports the reprojection error, the error in each
camera when held out, and the distance to a reference. --drift-minutes measures the error over a long
motion, --performers solves crowds and each of their people alone, --latencies the live tracker's at declared latencies, in simulated time, --ablation varies
our settings one at a time, --tune searches a method's weights on all other subjects.

Without --h36m the Human3.6M cameras are read from the folder of the variable BUNDLEMOCAP_DATA;
default: ../shared.

Examples:
  bundlemocap eval --motions motions/ --rig h36m --noise sparse --methods all --out eval
  bundlemocap eval --motions motions/ --methods paper,default --every 3 --rig ring4
  bundlemocap eval --rig ring4 --methods default --seconds 5
  bundlemocap eval --motions motions/ --body foreign --noise uniform
  bundlemocap eval --recording balancing.mcap --reference pose2sim.trc
  bundlemocap eval --recording walk.mcap --hold-out c4,c5 --methods all
  bundlemocap eval --motions motions/ --drift-minutes 10
  bundlemocap eval --motions motions/ --latencies 20,35,50,75,100,150,200 --every 3
  bundlemocap eval --performers 2,4,6 --rig ring4 --noise studio --seconds 60
  bundlemocap eval --motions motions/ --ablation window,cameras --every 4
  bundlemocap eval --motions motions/ --tune default --every 12")]
pub(in crate::cli) struct Arguments {
    /// Folder of BVH clips with the motions; default: a procedural motion.
    #[arg(long, value_name = "DIR")]
    pub(in crate::cli) motions: Option<PathBuf>,
    /// Output folder; created if missing.
    #[arg(long, value_name = "DIR", default_value = "eval")]
    pub(in crate::cli) out: PathBuf,
    #[command(flatten)]
    pub(in crate::cli) overwrite: Overwrite,
    /// Settings of motions, rigs and detectors; config/eval.toml lists every setting.
    #[arg(long, value_name = "FILE")]
    pub(in crate::cli) protocol: Option<PathBuf>,
    /// Subjects whose clips are used [protocol: 07,10].
    #[arg(long, value_name = "NAMES", value_delimiter = ',')]
    pub(in crate::cli) subjects: Vec<String>,
    /// Bodies of the performers: own, shapes of our body model, or foreign, each clip's own skeleton
    /// with keypoints at its joints [protocol: own].
    #[arg(long, value_name = "KIND", value_parser = Body::ALL.map(Body::name))]
    pub(in crate::cli) body: Option<String>,
    /// Use every Nth clip.
    #[arg(long, value_name = "N", default_value_t = 1)]
    pub(in crate::cli) every: usize,
    /// Longest part of a clip, from its middle, seconds [protocol: 8].
    #[arg(long, allow_negative_numbers = true)]
    pub(in crate::cli) seconds: Option<f64>,
    /// Frame rate of the cameras, 1 to 1000 Hz [protocol: 50].
    #[arg(long, value_name = "HZ", value_parser = ratio, allow_negative_numbers = true)]
    pub(in crate::cli) fps: Option<f64>,
    /// Rigs: h36m, h36m-s11, 3dhp, ring2 to ring64; several are used in turn [h36m].
    #[arg(long, value_name = "NAMES", value_delimiter = ',')]
    pub(in crate::cli) rig: Vec<String>,
    /// File with the Human3.6M cameras.
    #[arg(long, value_name = "FILE")]
    pub(in crate::cli) h36m: Option<PathBuf>,
    /// Noise levels of the detectors: none, or a level of the protocol (clean, studio, sparse,
    /// uniform, systematic).
    #[arg(long, value_name = "LEVELS", value_delimiter = ',', default_values = ["studio", "sparse"])]
    pub(in crate::cli) noise: Vec<String>,
    /// Methods by name, all compared ones, or ladder: the steps from the paper's path to the default.
    /// With --recording by default triangulation, paper-body and default.
    #[arg(long, value_name = "NAMES", value_delimiter = ',')]
    pub(in crate::cli) methods: Vec<String>,
    /// Seed of all random draws; replaces the seeds of the protocol, [1].
    #[arg(long)]
    pub(in crate::cli) seed: Option<u64>,
    /// Sequences solved in parallel; solve times are comparable only with 1.
    #[arg(long, value_name = "N", default_value_t = 1)]
    pub(in crate::cli) jobs: usize,
    /// Manifold weights of `bundlemocap train`; default: the embedded weights.
    #[arg(long, value_name = "FILE")]
    pub(in crate::cli) weights: Option<PathBuf>,
    /// Solve this recording instead of synthetic ones.
    #[arg(long, value_name = "FILE", conflicts_with_all = ["motions", "drift_minutes", "ablation", "tune"])]
    pub(in crate::cli) recording: Option<PathBuf>,
    /// Use only these cameras of the recording.
    #[arg(long, value_name = "NAMES", value_delimiter = ',', requires = "recording")]
    pub(in crate::cli) cameras: Vec<String>,
    /// Solve without these cameras of the recording and report the error in them; default: without
    /// each camera in turn.
    #[arg(long, value_name = "NAMES", value_delimiter = ',', requires = "recording")]
    pub(in crate::cli) hold_out: Vec<String>,
    /// Report the distance to these marker positions (y up, frames as in the recording).
    #[arg(long, value_name = "TRC", requires = "recording")]
    pub(in crate::cli) reference: Option<PathBuf>,
    /// Compare the detector errors of this recording with the noise levels.
    #[arg(long, value_name = "FILE", conflicts_with = "recording")]
    pub(in crate::cli) beside: Option<PathBuf>,
    /// Measure how the error changes over MINUTES.
    #[arg(long, value_name = "MINUTES", conflicts_with_all = ["ablation", "tune"])]
    pub(in crate::cli) drift_minutes: Option<f64>,
    /// Measure final poses at these declared latencies, milliseconds, and provisional ones.
    #[arg(
        long,
        value_name = "MS",
        value_delimiter = ',',
        conflicts_with_all = ["methods", "drift_minutes", "ablation", "tune"]
    )]
    pub(in crate::cli) latencies: Vec<f64>,
    /// Solve crowds of these numbers of people, 2 to 32, who cross and meet before as many cameras as
    /// the first rig has, with bodies of their own; and each of them alone.
    #[arg(
        long,
        value_name = "NUMBERS",
        value_delimiter = ',',
        value_parser = clap::value_parser!(u8).range(2..=32),
        conflicts_with_all = ["methods", "motions", "recording", "drift_minutes", "latencies", "ablation", "tune"]
    )]
    pub(in crate::cli) performers: Vec<u8>,
    /// Distance of the pelvises in the crowds' meetings, metres: 0.7 is arm's length, 0.3 an embrace.
    #[arg(long, value_name = "METRES", default_value_t = 0.7, allow_negative_numbers = true)]
    pub(in crate::cli) meet: f64,
    /// Vary our settings one at a time: all, or some of window, publish, keyframe, interpolation,
    /// stiffness, robust_scale, optimiser, stop, scale, prior, prior_dof, errors, foot_contact,
    /// foot_contact_speed, cameras, noise, fps.
    #[arg(long, value_name = "FACTORS", value_delimiter = ',', conflicts_with = "tune")]
    pub(in crate::cli) ablation: Vec<String>,
    /// Tune the weights of a method, on the subjects that are not named.
    #[arg(long, value_name = "METHOD")]
    pub(in crate::cli) tune: Option<String>,
}

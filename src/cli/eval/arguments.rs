//! The arguments of `bundlemocap eval`.

use std::path::PathBuf;

use clap::Args;

/// Measure methods against each other, on motions with a known truth or on a recording.
#[derive(Debug, Args)]
#[command(after_help = "\
Each motion is seen by the cameras of a rig, with detectors that err; every method solves it from
the same detections. No method is told the true body, pose or first frame. The folder DIR gets
table.md, results.json (every figure, each sequence, all settings and seeds) and report.html.
Everything follows from the seed: two runs give the same figures, but for the times.

With --recording a real recording is solved instead: reprojection, each camera held out in turn,
and the distance to a reference. --drift-minutes, --ablation and --tune measure ours over a long
motion, our settings one by one, and a method's weights on all other subjects.

The Human3.6M cameras are looked for in the folder of the variable BUNDLEMOCAP_DATA, else in
../shared, if --h36m does not name their file.

Examples:
  bundlemocap eval --motions motions/ --rig h36m --noise sparse --methods all --out eval
  bundlemocap eval --motions motions/ --methods paper,default --every 3 --rig ring4
  bundlemocap eval --rig ring4 --methods default --seconds 5
  bundlemocap eval --recording balancing.mcap --reference pose2sim.trc
  bundlemocap eval --motions motions/ --drift-minutes 10
  bundlemocap eval --motions motions/ --ablation window,cameras --every 4
  bundlemocap eval --motions motions/ --tune default --every 12")]
pub(in crate::cli) struct Arguments {
    /// Folder of BVH clips with the motions; our own procedural motion if not given.
    #[arg(long, value_name = "DIR")]
    pub(in crate::cli) motions: Option<PathBuf>,
    /// The folder to write to; it is made if it is not there.
    #[arg(long, value_name = "DIR", default_value = "eval")]
    pub(in crate::cli) out: PathBuf,
    /// Settings of the motions, rigs and detectors; config/eval.toml lists them all.
    #[arg(long, value_name = "FILE")]
    pub(in crate::cli) protocol: Option<PathBuf>,
    /// Subjects whose clips are used [the protocol has 07,10].
    #[arg(long, value_name = "NAMES", value_delimiter = ',')]
    pub(in crate::cli) subjects: Vec<String>,
    /// Use every Nth clip.
    #[arg(long, value_name = "N", default_value_t = 1)]
    pub(in crate::cli) every: usize,
    /// Longest part of a clip, from its middle, seconds [the protocol has 8].
    #[arg(long, allow_negative_numbers = true)]
    pub(in crate::cli) seconds: Option<f64>,
    /// Frames a second of the cameras, 1 to 1000 [the protocol has 50].
    #[arg(long, value_name = "HZ", allow_negative_numbers = true)]
    pub(in crate::cli) fps: Option<f64>,
    /// The cameras: h36m, h36m-s11, 3dhp, ring2 to ring64; several take turns [h36m].
    #[arg(long, value_name = "NAMES", value_delimiter = ',')]
    pub(in crate::cli) rig: Vec<String>,
    /// The file with the Human3.6M cameras.
    #[arg(long, value_name = "FILE")]
    pub(in crate::cli) h36m: Option<PathBuf>,
    /// How the detectors err: none, or a level of the protocol (clean, studio, sparse).
    #[arg(long, value_name = "LEVELS", value_delimiter = ',', default_values = ["studio", "sparse"])]
    pub(in crate::cli) noise: Vec<String>,
    /// Methods by name, or all; of a recording paper and default if not given.
    #[arg(long, value_name = "NAMES", value_delimiter = ',')]
    pub(in crate::cli) methods: Vec<String>,
    /// Seed of everything random; replaces the seeds of the protocol, [1].
    #[arg(long)]
    pub(in crate::cli) seed: Option<u64>,
    /// Sequences solved at the same time; times are fair with 1 only.
    #[arg(long, value_name = "N", default_value_t = 1)]
    pub(in crate::cli) jobs: usize,
    /// Weights of a manifold, from `bundlemocap train`; the embedded ones if not given.
    #[arg(long, value_name = "FILE")]
    pub(in crate::cli) weights: Option<PathBuf>,
    /// Solve this recording instead of synthetic ones.
    #[arg(long, value_name = "FILE", conflicts_with_all = ["motions", "drift_minutes", "ablation", "tune"])]
    pub(in crate::cli) recording: Option<PathBuf>,
    /// Report the distance to these marker positions (y up, frames as in the recording).
    #[arg(long, value_name = "TRC", requires = "recording")]
    pub(in crate::cli) reference: Option<PathBuf>,
    /// Show how the detectors of this recording err beside the levels of noise.
    #[arg(long, value_name = "FILE", conflicts_with = "recording")]
    pub(in crate::cli) beside: Option<PathBuf>,
    /// Measure how the error changes over that many minutes.
    #[arg(long, value_name = "MINUTES", conflicts_with_all = ["ablation", "tune"])]
    pub(in crate::cli) drift_minutes: Option<f64>,
    /// Vary our settings one at a time: all, or some of window, publish, keyframe, interpolation,
    /// stiffness, slack, optimiser, stop, scale, prior, freedom, errors, cameras, noise, fps.
    #[arg(long, value_name = "FACTORS", value_delimiter = ',', conflicts_with = "tune")]
    pub(in crate::cli) ablation: Vec<String>,
    /// Try a grid of weights of a method, on the subjects that are not named.
    #[arg(long, value_name = "METHOD")]
    pub(in crate::cli) tune: Option<String>,
}

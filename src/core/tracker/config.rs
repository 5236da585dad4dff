//! Settings of tracker and solver.

use serde::{Deserialize, Serialize};

use crate::core::cost::{self, FreeBody, LossKind, Stiffness};
use crate::core::limits::{Limit, OutOfRange, check};
use crate::core::optimise::OptimiserKind;

/// What is added to the ratio of a frame rate to the reference rate before it is rounded down: 95 frames/s are
/// clearly more than 60, 90 are not.
const CLEARLY_FASTER: f64 = 0.42;

/// Settings of tracker and solver.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Config {
    /// Frames per second of the cameras; 0 estimates it from the first frames.
    pub frame_rate_hz: f64,
    /// Nominal frames in a window; the keyframes of a window are solved together.
    pub window_frames: usize,
    /// Nominal frames from one keyframe to the next, at most a window.
    pub keyframe_frames: usize,
    /// Nominal frames of a window, from its start, that are final. The next window starts after
    /// them; the rest is look-ahead. A multiple of `keyframe_frames`, at most a window.
    pub publish_frames: usize,
    /// The frame rate for which the three numbers above are meant, Hz. For cameras that are 1.58 times as fast or
    /// faster, they are multiplied by the ratio, a whole number; 0: never. Differs: the paper never does.
    pub reference_rate_hz: f64,
    /// Nominal frames that a window waits for a late camera.
    pub deadline_frames: usize,
    /// Windows that are collected before the first solve; they determine the shape.
    pub shape_windows: usize,
    /// Most iterations of a window's solve.
    pub iterations: usize,
    /// Most iterations of a provisional fit of the open window.
    pub provisional_iterations: usize,
    /// Use every this many windows to estimate the body (shape and keypoint offsets), at most 25
    /// windows; 0 keeps the shape of the first windows and no offsets. Differs: the paper keeps the
    /// shape and has no offsets.
    pub body_windows: usize,
    /// The median error of the detections, pixels, at which the weights of prior and stiffness are
    /// used unchanged. At other errors they are scaled by the square of the ratio; 0 never scales.
    /// Differs: the paper has fixed weights.
    pub reference_residual_px: f64,
    /// Scale of the loss relative to the median error of the detections; between 6 pixels and
    /// `cost.scale_px`. 0 always uses `cost.scale_px`, as the paper does.
    pub relative_scale: f64,
    /// Number of windows in a row that are extrapolated for lack of detections, before the
    /// performer is lost.
    pub coast_windows: usize,
    /// Every this many windows, if some point lies far from two views all the time, a fresh fit is
    /// tried, and replaces the pose if it costs clearly less; 0 never tries. Differs: the paper never
    /// does.
    pub fresh_fit_windows: usize,
    /// Most iterations with a wide loss, which come before a window's usual ones if the views agree on a
    /// point and the body is far from it; 0: none. Differs: the paper has none.
    pub catch_up_iterations: usize,
    /// Windows stop waiting for a camera after this many windows in a row closed without it.
    pub grace_windows: usize,
    /// Iterations of each stage of the acquisition.
    pub acquisition_iterations: usize,
    /// An optimiser stops if a step lowers the cost by less than this fraction.
    pub change_threshold: f64,
    /// The optimiser of the windows.
    pub optimiser: OptimiserKind,
    /// Threads of the node that solve a window together, 1 or 2. The result is the same. `solve` does not use it.
    pub threads: usize,
    /// Weights of the cost.
    pub cost: cost::Config,
    /// Detections below this confidence are not used.
    pub min_confidence: f64,
    /// Gates of association and verdict.
    pub gate: Gate,
}

/// Gates of association and of the verdict on a window. Lengths in the image are fractions of the
/// performer's height in that image, so that they hold at any distance and resolution.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Gate {
    /// A triangulated point agrees with a view within this part of the person's height.
    pub agree: f64,
    /// A detected person is the performer if half of its points lie within this of their expected
    /// positions.
    pub follow: f64,
    /// A window is lost if the median residual exceeds this.
    pub lost_residual: f64,
    /// A window is lost if |z| exceeds this.
    pub lost_latent: f64,
    /// A window is lost if it has fewer observations per frame than this.
    pub lost_observations: f64,
}

impl Default for Config {
    fn default() -> Self {
        Self {
            frame_rate_hz: 0.0,
            window_frames: 10,
            keyframe_frames: 1,
            publish_frames: 5,
            reference_rate_hz: 60.0,
            deadline_frames: 5,
            shape_windows: 3,
            iterations: 6,
            provisional_iterations: 3,
            body_windows: 4,
            reference_residual_px: 7.0,
            relative_scale: 1.3,
            coast_windows: 6,
            fresh_fit_windows: 8,
            catch_up_iterations: 2,
            grace_windows: 6,
            acquisition_iterations: 30,
            change_threshold: 2e-2,
            optimiser: OptimiserKind::LevenbergMarquardt,
            threads: 1,
            cost: cost::Config::default(),
            min_confidence: 0.1,
            gate: Gate::default(),
        }
    }
}

/// Most threads of a window: its frames are in two batches.
pub(super) const MOST_THREADS: usize = 2;

/// The body is estimated with all keyframes of a window at once: the time grows with the cube of their number.
const MOST_KEYFRAMES: f64 = 100.0;

impl Config {
    /// The settings of \[Albanis 2023\]: one keyframe for each window of ten frames, slerp, windows that
    /// do not overlap, L-BFGS with 30 iterations.
    pub fn paper() -> Self {
        Self {
            keyframe_frames: 10,
            publish_frames: 10,
            reference_rate_hz: 0.0,
            iterations: 30,
            change_threshold: 1e-9,
            optimiser: OptimiserKind::Lbfgs,
            body_windows: 0,
            reference_residual_px: 0.0,
            relative_scale: 0.0,
            coast_windows: 3,
            fresh_fit_windows: 0,
            catch_up_iterations: 0,
            grace_windows: 3,
            cost: cost::Config {
                prior: 90.0,
                prior_dof: 0.0,
                loss: LossKind::GemanMcClure,
                scale_px: 60.0,
                jacobian_reuse_radius: 0.0,
                correction_prior: 0.0,
                foot_contact: 0.0,
                stiffness: Stiffness::NONE,
                ..Default::default()
            },
            ..Self::default()
        }
    }

    /// Checks the ranges of all numbers, and that published frames fit the window and its keyframes.
    ///
    /// # Errors
    /// The first number that is out of range.
    pub fn validate(&self) -> Result<(), OutOfRange> {
        check([
            Limit::rate_or_0("frame_rate_hz", self.frame_rate_hz, "0 (estimated) or 1 to 1000"),
            Limit::one_to_1000("window_frames", self.window_frames),
            Limit::one_to_1000("keyframe_frames", self.keyframe_frames),
            Limit(
                "window_frames / keyframe_frames",
                (self.window_frames / self.keyframe_frames.max(1)) as f64,
                0.0..=MOST_KEYFRAMES,
                "at most 100",
            ),
            Limit::one_to_1000("publish_frames", self.publish_frames),
            Limit::rate_or_0("reference_rate_hz", self.reference_rate_hz, "0 (never) or 1 to 1000"),
            Limit::up_to_1000("deadline_frames", self.deadline_frames),
            Limit("shape_windows", self.shape_windows as f64, 1.0..=1e2, "1 to 100"),
            Limit::one_to_1000("iterations", self.iterations),
            Limit::one_to_1000("acquisition_iterations", self.acquisition_iterations),
            Limit::up_to_1000("provisional_iterations", self.provisional_iterations),
            Limit::up_to_1000("body_windows", self.body_windows),
            Limit::up_to_1000("coast_windows", self.coast_windows),
            Limit::up_to_1000("fresh_fit_windows", self.fresh_fit_windows),
            Limit::up_to_1000("catch_up_iterations", self.catch_up_iterations),
            Limit::one_to_1000("grace_windows", self.grace_windows),
            Limit("threads", self.threads as f64, 1.0..=MOST_THREADS as f64, "1 or 2"),
            Limit::from_0("reference_residual_px", self.reference_residual_px),
            Limit::from_0("relative_scale", self.relative_scale),
            Limit("min_confidence", self.min_confidence, 0.0..=1.0, "0 to 1"),
            Limit::from_0("change_threshold", self.change_threshold),
        ])?;
        self.cost.validate().map_err(|error| error.in_table("cost"))?;
        self.gate.validate().map_err(|error| error.in_table("gate"))?;
        let published = self.publish_frames;
        if published <= self.window_frames && published.is_multiple_of(self.keyframe_frames) {
            return Ok(());
        }
        let allowed = "a multiple of keyframe_frames, at most window_frames";
        Err(OutOfRange { key: "publish_frames".into(), value: published as f64, allowed })
    }

    /// The body coefficients that the first windows solve.
    pub(super) fn free_body(&self) -> FreeBody {
        if self.body_windows > 0 { FreeBody::ShapeAndOffsets } else { FreeBody::Shape }
    }

    /// The settings for cameras of that frame period, ns; see [`Config::reference_rate_hz`]. 0: not known.
    #[must_use]
    pub fn at_period(mut self, period_ns: f64) -> Self {
        let ratio = 1e9 / (period_ns * self.reference_rate_hz) + CLEARLY_FASTER;
        let ratio = if ratio.is_finite() { (ratio as usize).max(1) } else { 1 };
        self.window_frames *= ratio;
        self.keyframe_frames *= ratio;
        self.publish_frames *= ratio;
        self
    }

    /// Nominal frames of a window.
    pub fn window(&self) -> usize {
        self.window_frames.max(1)
    }

    /// Nominal frames from one keyframe to the next.
    pub fn keyframe(&self) -> usize {
        self.keyframe_frames.clamp(1, self.window())
    }

    /// Nominal frames of a window that are final: a multiple of those between keyframes.
    pub fn publish(&self) -> usize {
        let keyframes = self.publish_frames.clamp(1, self.window()) / self.keyframe();
        if self.publish_frames >= self.window() {
            return self.window();
        }
        keyframes.max(1) * self.keyframe()
    }
}

impl Gate {
    /// Checks the ranges of all numbers.
    ///
    /// # Errors
    /// The first number that is out of range.
    pub fn validate(&self) -> Result<(), OutOfRange> {
        check([
            Limit::above_0("agree", self.agree),
            Limit::above_0("follow", self.follow),
            Limit::above_0("lost_residual", self.lost_residual),
            Limit::above_0("lost_latent", self.lost_latent),
            Limit::from_0("lost_observations", self.lost_observations),
        ])
    }
}

impl Default for Gate {
    fn default() -> Self {
        Self {
            agree: 0.06,
            follow: 0.20,
            lost_residual: 0.08,
            lost_latent: 20.0,
            lost_observations: 12.0,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn windows_of_fast_cameras_are_as_long_in_time() {
        let frames = |config: Config, fps: f64| {
            let config = config.at_period(1e9 / fps);
            assert_eq!(config.validate(), Ok(()), "{fps}");
            (config.window(), config.keyframe(), config.publish())
        };
        for fps in [15.0, 50.0, 60.0, 75.0, 90.0] {
            assert_eq!(frames(Config::default(), fps), (10, 1, 5), "{fps}");
        }
        for (fps, ratio) in
            [(95.904, 2), (96.0, 2), (100.0, 2), (119.88, 2), (144.0, 2), (180.0, 3), (240.0, 4)]
        {
            let expected = (10 * ratio, ratio, 5 * ratio);
            assert_eq!(frames(Config::default(), fps), expected, "{fps}");
        }
        assert_eq!(frames(Config::paper(), 240.0), (10, 10, 10));
        assert_eq!(Config::default().at_period(0.0), Config::default());
    }
}

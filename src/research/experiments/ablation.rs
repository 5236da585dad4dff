//! Varies one of our settings at a time.

use std::sync::Arc;

use crate::core::camera::CameraError;
use crate::core::manifold::Interpolation;
use crate::core::optimise;
use crate::core::tracker::Config;
use crate::research::methods::{Method, Windows};
use crate::research::synth::ring_rig;

use super::case::View;

/// A varied property of a view.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Seen {
    /// Number of cameras on a ring.
    Cameras,
    /// Scale of the detector's errors; 1: as the level has them.
    Noise,
    /// Share of the errors' variance that is new in each frame.
    NewShare,
    /// Frames per second.
    Fps,
    /// Time from the first row of an image to its last, milliseconds.
    Readout,
}

impl Seen {
    /// What the values are, for tables and plots.
    pub fn label(self) -> &'static str {
        match self {
            Self::Cameras => "cameras",
            Self::Noise => "error scale (1: the level)",
            Self::NewShare => "share of errors new in each frame",
            Self::Fps => "frames/s",
            Self::Readout => "readout of a rolling shutter (ms)",
        }
    }

    /// The view with another value.
    ///
    /// # Errors
    /// None with the values of [`factor`].
    pub fn set(self, view: &View, value: f64) -> Result<View, CameraError> {
        let mut view = view.clone();
        match self {
            Self::Cameras => view.rig = Arc::new(ring_rig(value as usize, 4.5, 1.6)?),
            Self::Noise => view.noise = view.noise.times(value),
            Self::NewShare => view.noise = view.noise.with_new_share(value),
            Self::Fps => view.choice.fps = value,
            Self::Readout => view.noise.readout_s = 1e-3 * value,
        }
        Ok(view)
    }
}

/// A name and the settings it stands for.
type Setting = (String, Config);

/// What is varied.
#[derive(Clone, Debug, PartialEq)]
pub enum Factor {
    /// One of our settings: the rows of one table.
    Settings(Vec<Setting>),
    /// How the motion is seen: rows of some methods at each value.
    Views(Seen, Vec<f64>),
}

/// The names that [`factor`] knows.
pub const FACTORS: [&str; 20] = [
    "window",
    "publish",
    "keyframe",
    "interpolation",
    "stiffness",
    "robust_scale",
    "optimiser",
    "stop",
    "scale",
    "prior",
    "prior_dof",
    "errors",
    "foot_contact",
    "foot_contact_speed",
    "paper_prior",
    "cameras",
    "noise",
    "new_share",
    "fps",
    "readout",
];

/// Thresholds on the relative change of the cost for the optimiser to stop.
const STOPS: [f64; 6] = [0.0005, 0.002, 0.005, 0.01, 0.02, 0.04];

/// The factor with a name.
pub fn factor(name: &str) -> Option<Factor> {
    Some(match name {
        "window" => numbers("window", &[3.0, 5.0, 8.0, 10.0, 15.0, 20.0], |config, frames| {
            config.window_frames = frames as usize;
            config.publish_frames = (frames as usize).div_ceil(2);
        }),
        "publish" => numbers("publish", &[1.0, 2.0, 3.0, 5.0, 8.0, 10.0], |config, frames| {
            config.publish_frames = frames as usize;
        }),
        "keyframe" => numbers("keyframe every", &[1.0, 2.0, 5.0, 10.0], |config, frames| {
            config.keyframe_frames = frames as usize;
            config.publish_frames = config.publish_frames.max(frames as usize);
            config.publish_frames -= config.publish_frames % frames as usize;
        }),
        "stiffness" => {
            numbers("stiffness x", &[0.0, 0.01, 0.03, 0.1, 0.3, 1.0, 3.0], |config, factor| {
                config.cost.stiffness = config.cost.stiffness.times(factor);
            })
        }
        "robust_scale" => {
            numbers("robust scale px", &[3.0, 10.0, 30.0, 100.0, 1000.0], |config, scale| {
                config.cost.stiffness.robust_scale_px = scale;
            })
        }
        "scale" => numbers("scale px", &[10.0, 15.0, 30.0, 50.0, 100.0], |config, scale| {
            config.cost.scale_px = scale;
        }),
        "prior" => numbers("prior", &[2.0, 5.0, 10.0, 20.0, 50.0, 100.0], |config, prior| {
            config.cost.prior = prior;
        }),
        "prior_dof" => numbers("prior dof", &[0.0, 5.0, 10.0, 20.0, 50.0, 100.0], |config, f| {
            config.cost.prior_dof = f;
        }),
        "errors" => numbers("weights for px", &[0.0, 3.5, 5.0, 7.0, 10.0, 14.0], |config, px| {
            config.reference_residual_px = px;
        }),
        "foot_contact" => {
            numbers("foot contact", &[0.0, 1e3, 4e3, 1e4, 4e4, 1e5], |config, weight| {
                config.cost.foot_contact = weight;
            })
        }
        "foot_contact_speed" => {
            numbers("foot contact below m/s", &[0.1, 0.2, 0.3, 0.5, 0.8], |config, speed| {
                config.cost.foot_contact_speed = speed;
            })
        }
        "optimiser" => named(&[
            ("Levenberg-Marquardt", |config| {
                config.optimiser = optimise::OptimiserKind::LevenbergMarquardt
            }),
            ("L-BFGS", |config| config.optimiser = optimise::OptimiserKind::Lbfgs),
        ]),
        "stop" => numbers("stop at a change of", &STOPS, |config, threshold| {
            config.change_threshold = threshold;
        }),
        "interpolation" => named(&[
            ("keyframe each frame", |_| {}),
            ("slerp, keyframe every 5", |config| {
                (config.keyframe_frames, config.cost.interpolation) = (5, Interpolation::Slerp);
            }),
            ("lerp, keyframe every 5", |config| {
                (config.keyframe_frames, config.cost.interpolation) = (5, Interpolation::Lerp);
            }),
        ]),
        "paper_prior" => {
            let paper = Windows::paper_with_body().config();
            numbers_of(
                &paper,
                "paper's prior x",
                &[0.3, 1.0, 3.0, 10.0, 30.0, 100.0],
                |config, f| {
                    config.cost.prior *= f;
                },
            )
        }
        "cameras" => Factor::Views(Seen::Cameras, (2..=8).map(f64::from).collect()),
        "noise" => Factor::Views(Seen::Noise, vec![0.0, 0.25, 0.5, 1.0, 2.0, 3.0, 4.0]),
        "new_share" => Factor::Views(Seen::NewShare, vec![0.0, 0.25, 0.5, 0.75, 1.0]),
        "fps" => Factor::Views(Seen::Fps, vec![15.0, 25.0, 30.0, 50.0, 60.0, 100.0, 120.0]),
        "readout" => Factor::Views(Seen::Readout, vec![0.0, 5.0, 10.0, 20.0, 30.0]),
        _ => return None,
    })
}

fn numbers(name: &str, values: &[f64], set: fn(&mut Config, f64)) -> Factor {
    numbers_of(&Config::default(), name, values, set)
}

/// The same with other settings in place of the default.
fn numbers_of(base: &Config, name: &str, values: &[f64], set: fn(&mut Config, f64)) -> Factor {
    let of = |&value: &f64| {
        let mut config = *base;
        set(&mut config, value);
        let mark = if config == *base { " (default)" } else { "" };
        (format!("{name} {value}{mark}"), config)
    };
    Factor::Settings(values.iter().map(of).collect())
}

/// A setting's name and its change.
type Change<'a> = (&'a str, fn(&mut Config));

fn named(settings: &[Change]) -> Factor {
    let of = |(name, set): &Change| {
        let mut config = Config::default();
        set(&mut config);
        let mark = if config == Config::default() { " (default)" } else { "" };
        (format!("{name}{mark}"), config)
    };
    Factor::Settings(settings.iter().map(of).collect())
}

/// The methods of a table of settings.
pub fn methods(settings: &[Setting]) -> Vec<Box<dyn Method>> {
    let row = |(name, config): &Setting| Box::new(Windows::new(name, *config)) as Box<dyn Method>;
    settings.iter().map(row).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_factor_varies_something_and_has_the_default_in_it() {
        for name in FACTORS {
            match factor(name).unwrap() {
                Factor::Settings(rows) => {
                    assert!(rows.len() > 1, "{name}");
                    let default =
                        rows.iter().filter(|(row, _)| row.ends_with(" (default)")).count();
                    assert_eq!(default, 1, "{name}");
                }
                Factor::Views(_, values) => assert!(values.len() > 1, "{name}"),
            }
        }
        assert_eq!(factor("shoes"), None);
    }
}

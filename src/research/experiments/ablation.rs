//! Varies one of our settings at a time.

use crate::core::camera::CameraError;
use crate::core::manifold::Interpolation;
use crate::core::optimise;
use crate::core::tracker::Config;
use crate::research::methods::{Method, Windows};

use super::case::View;
use super::named::Named;

/// A varied property of a view.
#[derive(Clone, Debug, PartialEq)]
pub enum Seen {
    /// Number of cameras on a ring.
    Cameras(usize),
    /// Noise level.
    Noise(&'static str),
    /// Frames per second.
    Fps(f64),
}

/// A name and the settings it stands for.
type Setting = (String, Config);

/// What is varied.
#[derive(Clone, Debug, PartialEq)]
pub enum Factor {
    /// One of our settings: the rows of one table.
    Settings(Vec<Setting>),
    /// The view of the motion: rows with the paper's settings and with ours.
    Views(Vec<(String, Seen)>),
}

/// The names that [`factor`] knows.
pub const FACTORS: [&str; 17] = [
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
    "cameras",
    "noise",
    "fps",
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
        "cameras" => views((2..=8).map(|n| (format!("{n} cameras"), Seen::Cameras(n)))),
        "noise" => views(
            ["none", "clean", "studio", "sparse"]
                .map(|level| (format!("noise {level}"), Seen::Noise(level)))
                .into_iter(),
        ),
        "fps" => views([30.0, 60.0, 120.0].map(|f| (format!("{f} fps"), Seen::Fps(f))).into_iter()),
        _ => return None,
    })
}

fn numbers(name: &str, values: &[f64], set: fn(&mut Config, f64)) -> Factor {
    let of = |&value: &f64| {
        let mut config = Config::default();
        set(&mut config, value);
        let mark = if config == Config::default() { " (default)" } else { "" };
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

fn views(views: impl Iterator<Item = (String, Seen)>) -> Factor {
    Factor::Views(views.collect())
}

/// The methods of a table of settings.
pub fn methods(settings: &[Setting]) -> Vec<Box<dyn Method>> {
    let row = |(name, config): &Setting| Box::new(Windows::new(name, *config)) as Box<dyn Method>;
    settings.iter().map(row).collect()
}

/// The paper's settings and ours, labelled with the varied property.
pub fn both(name: &str) -> Vec<Box<dyn Method>> {
    let of = |method: Windows| {
        let label = format!("{name}: {}", method.name());
        Named::boxed(label, Box::new(method))
    };
    vec![of(Windows::paper()), of(Windows::default_settings())]
}

/// The view with another number of cameras or frame rate; the protocol of the caller sets the
/// noise.
///
/// # Errors
/// None with the numbers of [`factor`].
pub fn seen(view: &View, how: &Seen) -> Result<View, CameraError> {
    let mut view = view.clone();
    match how {
        Seen::Cameras(count) => {
            view.rig = std::sync::Arc::new(crate::research::synth::ring_rig(*count, 4.5, 1.6)?);
        }
        Seen::Fps(fps) => view.choice.fps = *fps,
        Seen::Noise(_) => {}
    }
    Ok(view)
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
                    let default = rows.iter().filter(|(_, c)| *c == Config::default()).count();
                    assert_eq!(default, 1, "{name}");
                }
                Factor::Views(rows) => assert!(rows.len() > 1, "{name}"),
            }
        }
        assert_eq!(factor("shoes"), None);
    }
}

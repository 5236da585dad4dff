//! Rigs, detectors and motions by name, for `bundlemocap eval`.

use std::path::Path;
use std::sync::Arc;

use super::failure::{Exit, Failure};
use crate::camera::Rig;
use crate::study::{Subject, View, procedural, subjects};
use crate::synth::{Noise, ring_rig};
use crate::train::{Clip, read_folder};

/// Levels of the detectors' errors, the best first.
pub(super) const LEVELS: [&str; 4] = ["none", "clean", "studio", "sparse"];
/// Metres from the middle to the cameras of a ring, and their height.
const RING: [f64; 2] = [4.5, 1.6];
/// Shorter clips are left out, frames.
const SHORTEST: usize = 150;
/// Motions of our own, where no folder is given.
const PROCEDURAL: u64 = 4;

/// The detectors of a level.
pub(super) fn noise(level: &str) -> Result<Noise, Failure> {
    match level {
        "none" => Ok(Noise::none()),
        "clean" => Ok(Noise::jitter_only()),
        "studio" => Ok(Noise::default()),
        "sparse" => Ok(Noise {
            jitter: 0.014,
            missing: 0.05,
            outliers: 0.02,
            occlusions: 0.25,
            swaps: 0.12,
            ..Noise::default()
        }),
        _ => {
            let message = format!("--noise {level} is not known; use {}", LEVELS.join(", "));
            Err(Failure::new(Exit::Usage, message))
        }
    }
}

/// The cameras of a name: ring2 to ring32.
pub(super) fn rig(name: &str) -> Result<Arc<Rig>, Failure> {
    let cameras = name.strip_prefix("ring").and_then(|count| count.parse().ok());
    let Some(cameras) = cameras.filter(|count| (2..=32).contains(count)) else {
        let message = format!("--rig {name} is not known; use ring2 to ring32");
        return Err(Failure::new(Exit::Usage, message));
    };
    Ok(Arc::new(ring_rig(cameras, RING[0], RING[1])?))
}

/// The view of a level, all else as in `view`.
pub(super) fn at_level(view: &View, level: &str) -> Result<View, Failure> {
    Ok(View { name: level.to_owned(), noise: noise(level)?, ..view.clone() })
}

/// The clips of those subjects in a folder, every so manieth.
pub(super) fn clips(folder: &Path, wanted: &[String], every: usize) -> Result<Vec<Clip>, Failure> {
    let clips = read_folder(folder)?;
    let names = crate::train::subjects(&clips).join(", ");
    for subject in wanted {
        if !clips.iter().any(|clip| clip.subject == *subject) {
            let folder = folder.display();
            let message = format!("--subjects: {folder} has no clip of {subject}; it has {names}");
            return Err(Failure::new(Exit::Usage, message));
        }
    }
    let usable = |clip: &Clip| {
        clip.poses.len() > SHORTEST && (wanted.is_empty() || wanted.contains(&clip.subject))
    };
    let chosen: Vec<Clip> = clips.into_iter().filter(usable).step_by(every.max(1)).collect();
    if chosen.is_empty() {
        let message = format!(
            "{}: no clip of subjects {} is longer than {SHORTEST} frames; name others with \
             --subjects",
            folder.display(),
            wanted.join(", ")
        );
        return Err(Failure::new(Exit::NoDetections, message));
    }
    Ok(chosen)
}

/// The motions: clips of a folder, or our own.
pub(super) fn motions(
    folder: Option<&Path>,
    wanted: &[String],
    every: usize,
) -> Result<Vec<Subject>, Failure> {
    match folder {
        Some(folder) => Ok(subjects(&clips(folder, wanted, every)?)),
        None => Ok(procedural(PROCEDURAL).into_iter().step_by(every.max(1)).collect()),
    }
}

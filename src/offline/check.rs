//! Judges the cameras of a recording.

use super::Error;
use super::options::Observer;
use super::recording::{Item, Recording};
use crate::core::tracker::Config;
use crate::diagnose::{Check, Evidence};

/// Judges the cameras of a recording by what they saw, see [`diagnose`](crate::diagnose).
///
/// # Errors
/// The recording cannot be read, or its capture times are not in nanoseconds.
pub fn check(recording: &mut Recording, observer: &mut dyn Observer) -> Result<Check, Error> {
    let rig = recording.rig().clone();
    let period = recording.frame_period(&rig)?;
    let mut evidence = Evidence::new(rig.clone(), Config::default(), period);
    let message = || observer.message();
    recording.stream(&rig, &[], message, |item| {
        if let Item::Detections(frame, percent) = item {
            evidence.add(&frame, percent);
        }
        Ok(())
    })?;
    Ok(evidence.check(&rig))
}

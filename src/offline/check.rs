//! Judges the cameras of a recording.

use super::Error;
use super::options::Observer;
use super::recording::Recording;
use crate::core::camera::Rig;
use crate::core::check::{self, Check, Footage};

/// Judges the cameras of a recording by what they saw, see [`core::check`](crate::core::check).
///
/// # Errors
/// The recording cannot be read, or its capture times are not in nanoseconds.
pub fn check(recording: &mut Recording, observer: &mut dyn Observer) -> Result<Check, Error> {
    let rig = recording.rig().clone();
    // Fails if capture times are in another unit.
    recording.frame_period(&rig)?;
    check_rig(recording, &rig, observer)
}

/// The same for some cameras.
pub(super) fn check_rig(
    recording: &mut Recording,
    rig: &Rig,
    observer: &mut dyn Observer,
) -> Result<Check, Error> {
    let mut footage = Footage::new(rig.cameras.len());
    recording.keypoints(
        rig,
        || observer.message(),
        |camera, frame| {
            if let Ok(detections) = frame.to_core(|_| Some(camera)) {
                footage.add(&detections);
            }
            let points = frame.people.iter().flat_map(|person| person.points.as_chunks::<3>().0);
            footage
                .add_percent(camera, points.filter(|[.., confidence]| *confidence > 1.0).count());
        },
    )?;
    Ok(check::check(&footage, rig))
}

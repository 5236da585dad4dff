//! Judges the cameras of a recording.

use super::Error;
use super::options::Observer;
use super::recording::Recording;
use crate::core::camera::Rig;
use crate::core::check::{self, Check, Footage};
use crate::core::stage::{Change, Crowd};

/// Judges the cameras of a recording by what they saw, see [`core::check`](crate::core::check).
///
/// # Errors
/// The recording cannot be read, or its capture times are not in nanoseconds.
pub fn check(recording: &mut Recording, observer: &mut dyn Observer) -> Result<Check, Error> {
    let rig = recording.rig().clone();
    // Fails if capture times are in another unit.
    recording.frame_period(&rig)?;
    check_rig(recording, &rig, None, observer)
}

/// The same for some cameras. With a crowd of several performers, by how they saw the first one.
pub(super) fn check_rig(
    recording: &mut Recording,
    rig: &Rig,
    mut crowd: Option<Crowd>,
    observer: &mut dyn Observer,
) -> Result<Check, Error> {
    let mut footage = Footage::new(rig.cameras.len());
    let first = |changes: Vec<Change>, footage: &mut Footage| {
        for change in changes {
            if let Change::Frame(0, frame) = change {
                footage.add(&frame);
            }
        }
    };
    recording.keypoints(
        rig,
        || observer.message(),
        |camera, frame| {
            match (frame.to_core(|_| Some(camera)), &mut crowd) {
                (Ok(detections), None) => footage.add(&detections),
                (Ok(detections), Some(crowd)) => {
                    crowd.add(detections);
                    while let Some((_, changes)) = crowd.next(false) {
                        first(changes, &mut footage);
                    }
                }
                (Err(_), _) => {}
            }
            let points = frame.people.iter().flat_map(|person| person.points.as_chunks::<3>().0);
            footage
                .add_percent(camera, points.filter(|[.., confidence]| *confidence > 1.0).count());
        },
    )?;
    while let Some((_, changes)) = crowd.as_mut().and_then(|crowd| crowd.next(true)) {
        first(changes, &mut footage);
    }
    Ok(check::check(&footage, rig))
}

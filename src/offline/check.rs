//! Judges the inputs of a recording.

use super::Error;
use super::options::Observer;
use super::recording::{Item, Recording};
use crate::core::camera::Rig;
use crate::core::check::Footage;

/// The detections of the cameras of a rig.
///
/// # Errors
/// The recording cannot be read.
pub fn footage(
    recording: &mut Recording,
    rig: &Rig,
    observer: &mut dyn Observer,
) -> Result<Footage, Error> {
    let mut footage = Footage::new(rig.cameras.len());
    recording.stream(rig, &[], || observer.message(), |item| {
        if let Item::Detections(frame) = item {
            footage.add(&frame);
        }
        Ok(())
    })?;
    Ok(footage)
}

#[cfg(test)]
mod tests {
    #[test]
    fn debug() {
        for name in ["walk", "sit_to_stand", "balancing", "static", "two_people"] {
            let t = std::time::Instant::now();
            let mut r = super::Recording::open(format!("/tmp/real/{name}.mcap")).unwrap();
            let rig = r.rig().clone();
            let f = super::footage(&mut r, &rig, &mut ()).unwrap();
            println!("{name} {:?}", t.elapsed());
            crate::core::check::debug(&f, &rig);
        }
    }
}

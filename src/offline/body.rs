//! A person's body from several takes.

use std::path::PathBuf;

use serde::Serialize;

use super::Error;
use super::first_pass::FirstPass;
use super::options::{Observer, Options};
use super::recording::Recording;
use crate::core::body::Skeleton;
use crate::core::tracker::{BodyEstimator, shared_body};
use crate::metrics::{SEGMENTS, segment_lengths};

/// A take's part in the body of a person.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct TakeBody {
    /// The recording.
    pub recording: PathBuf,
    /// Number of windows that tell of the body; 0: the take is too short.
    pub windows: usize,
    /// Lengths of the [`SEGMENTS`] of the body that this take alone gives, mean of both sides, millimetres.
    pub alone_mm: [f64; SEGMENTS.len()],
    /// Whether other bones fit this take clearly better: it may show another person.
    pub may_be_another_person: bool,
}

/// The body of a person that fits several takes together: their largest performer's. The bones are the same
/// in all of them, the keypoint offsets are the means of those of the takes. Each recording is read once or
/// twice. The body of `options`, the cameras that are held out and all outputs are ignored.
///
/// # Errors
/// As [`solve`](super::solve), for instance a recording without a performer.
pub fn estimate_body(
    recordings: &mut [Recording],
    options: &Options,
    observer: &mut dyn Observer,
) -> Result<(Skeleton, Vec<TakeBody>), Error> {
    let options = Options { body: None, performers: Default::default(), ..options.clone() };
    let (mut takes, mut estimates) = (Vec::new(), Vec::new());
    for recording in recordings.iter_mut() {
        let mut rig = recording.chosen(&options.cameras, &[])?;
        let period = recording.frame_period(&rig)?;
        let pass = FirstPass::run(recording, &options, &mut rig, period, &mut [], observer)?;
        let alone = pass.lead(recording)?;
        takes.push(TakeBody {
            recording: recording.path().to_owned(),
            windows: pass.estimate.windows(),
            alone_mm: segment_lengths(&alone).map(|length| 1e3 * length),
            may_be_another_person: false,
        });
        estimates.push(pass.estimate);
    }
    let estimates: Vec<&BodyEstimator> = estimates.iter().map(|estimate| &**estimate).collect();
    let (body, others) = shared_body(&estimates).ok_or(Error::NoSharedBody)?;
    for (take, is_other) in takes.iter_mut().zip(others) {
        take.may_be_another_person = is_other;
    }
    Ok((body, takes))
}

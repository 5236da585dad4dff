//! A person's body from several takes.

use std::path::PathBuf;

use serde::Serialize;

use super::Error;
use super::first_pass::FirstPass;
use super::options::{Observer, Options};
use super::recording::Recording;
use crate::core::body::Skeleton;
use crate::core::tracker::shared_body;
use crate::metrics::{SEGMENTS, segment_lengths};

/// A take's part in the body of a person.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct TakeBody {
    /// The recording.
    pub recording: PathBuf,
    /// Number of windows that tell of the body.
    pub windows: usize,
    /// Lengths of the [`SEGMENTS`] of the body that this take alone gives, mean of both sides, millimetres.
    /// `None` of a take that is too short to tell.
    pub alone_mm: Option<[f64; SEGMENTS.len()]>,
    /// Whether its own bones fit it clearly better than those of the other takes do. Then it is
    /// left out, if others agree.
    pub may_be_another_person: bool,
}

/// The body of a person that fits several takes together: that of their largest performer. The bones are the
/// same in all of them, the keypoint offsets are the means of those of the takes. Each recording is read once
/// or twice. The body of `options`, the cameras that are held out and all outputs are ignored.
///
/// # Errors
/// As [`solve`](super::solve), for instance a recording without a performer; all takes are too short.
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
        pass.lead(recording)?;
        takes.push(TakeBody {
            recording: recording.path().to_owned(),
            windows: pass.estimate.windows(),
            alone_mm: None,
            may_be_another_person: false,
        });
        estimates.push(pass.estimate);
    }
    let told: Vec<_> = estimates.iter().map(|one| &**one).filter(|one| one.windows() > 0).collect();
    let (body, parts) = shared_body(&told).ok_or(Error::NoSharedBody)?;
    for (take, part) in takes.iter_mut().filter(|take| take.windows > 0).zip(parts) {
        take.alone_mm = Some(segment_lengths(&part.alone).map(|length| 1e3 * length));
        take.may_be_another_person = part.is_other;
    }
    Ok((body, takes))
}

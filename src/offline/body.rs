//! A person's body from several takes.

use std::path::{Path, PathBuf};

use serde::{Serialize, Serializer};

use super::Error;
use super::first_pass::FirstPass;
use super::options::{Observer, Options};
use super::recording::Recording;
use crate::core::body::Skeleton;
use crate::core::stage::Performers;
use crate::core::tracker::{OTHER_SIZE, shared_body};
use crate::metrics::{SEGMENTS, segment_lengths};

/// A path need not be UTF-8.
fn shown<S: Serializer>(path: &Path, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.collect_str(&path.display())
}

/// A take's part in the body of a person.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct TakeBody {
    /// The recording.
    #[serde(serialize_with = "shown")]
    pub recording: PathBuf,
    /// Number of windows from which the body is estimated; 0: the take is too short.
    pub windows: usize,
    /// Lengths of the [`SEGMENTS`] of the body that this take alone gives, mean of both sides, millimetres.
    /// `None` of a take that is too short.
    pub alone_mm: Option<[f64; SEGMENTS.len()]>,
    /// Why it could not be used, if so.
    pub problem: Option<String>,
    /// Whether its limbs are more than 8 % longer or shorter than in most of the other takes. It is left out if
    /// two takes or more agree.
    pub may_be_another_person: bool,
}

/// The body of a person that fits several takes together: that of their largest performer. The bones are the
/// same in all of them, the keypoint offsets are the means of those of the takes. Each recording is read once
/// or twice. The body of `options`, the cameras that are held out and all outputs are ignored. A recording that
/// cannot be solved is left out.
///
/// # Errors
/// As [`solve`](super::solve), of the first recording, if none can be solved; all takes are too short.
pub fn estimate_body(
    recordings: &mut [Recording],
    options: &Options,
    observer: &mut dyn Observer,
) -> Result<(Skeleton, Vec<TakeBody>), Error> {
    let options = Options { body: None, performers: Performers::default(), ..options.clone() };
    let mut takes = Vec::new();
    // Of takes that are long enough: their number, the length of their limbs (millimetres), and what they tell.
    let (mut estimates, mut first_problem) = (Vec::new(), None);
    let mut of_take = |recording: &mut Recording| {
        let (mut rig, _) = recording.chosen(&options.cameras, &[])?;
        let period = recording.frame_period(&rig)?;
        let pass = FirstPass::run(recording, &options, &mut rig, period, &mut [], observer)?;
        pass.lead(recording)?;
        Ok::<_, Error>(pass.estimate())
    };
    for recording in recordings.iter_mut() {
        let estimate = match of_take(recording) {
            Ok(estimate) => estimate,
            Err(stopped @ Error::Stopped { .. }) => return Err(stopped),
            Err(error) => {
                let (recording, problem) = (recording.path().to_owned(), Some(error.to_string()));
                takes.push(TakeBody { recording, problem, ..TakeBody::default() });
                first_problem.get_or_insert(error);
                continue;
            }
        };
        let windows = estimate.windows();
        let alone = shared_body(&[&estimate]).filter(|_| windows > 0);
        let alone_mm = alone.map(|body| segment_lengths(&body).map(|length| 1e3 * length));
        let limbs = alone_mm.map(|lengths| lengths.iter().sum::<f64>());
        estimates.extend(limbs.map(|limbs| (takes.len(), limbs, estimate)));
        let recording = recording.path().to_owned();
        takes.push(TakeBody { recording, windows, alone_mm, ..TakeBody::default() });
    }
    for (take, limbs, _) in &estimates {
        let differs =
            |(_, other, _): &&(_, f64, _)| limbs.max(*other) / limbs.min(*other) > 1.0 + OTHER_SIZE;
        let differing = estimates.iter().filter(differs).count();
        takes[*take].may_be_another_person = 2 * differing > estimates.len() - 1;
    }
    let agrees = |take: usize| !takes[take].may_be_another_person;
    let are_agreed = estimates.iter().filter(|(take, ..)| agrees(*take)).count() > 1;
    let used = estimates.iter().filter(|(take, ..)| !are_agreed || agrees(*take));
    let used: Vec<_> = used.map(|(.., estimate)| &**estimate).collect();
    match (shared_body(&used), first_problem) {
        (Some(body), _) => Ok((body, takes)),
        (None, Some(problem)) if takes.iter().all(|take| take.problem.is_some()) => Err(problem),
        (None, _) => Err(Error::ShortTakes),
    }
}

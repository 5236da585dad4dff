//! Inputs, outputs and settings of the core.

use std::collections::BTreeSet;
use std::sync::Arc;

use nalgebra::Vector3;

use super::publication::Publication;
use crate::core::stage::{self, Known, PerformerId};
use crate::core::time::{Nanos, Timestamp};
use crate::core::tracker::{self, Job, Solution};
use crate::io::timecode::House;
use crate::io::wire::{self, JournalPerformer, JournalStart, PerformerLabel, StageStatus};
use crate::live::config::Config;

/// Larger messages are rejected, bytes.
pub const MOST_BYTES: usize = 1 << 20;

/// Larger rigs and slates are rejected, bytes: the journal keeps them whole.
pub const MOST_ORDER_BYTES: usize = 256 << 10;

/// Messages of one camera that were not read.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Loss {
    /// Name of the camera; `None`: the rig, or cameras that the rig does not have.
    pub camera: Option<String>,
    /// Messages that were dropped because there were too many.
    pub dropped: u64,
    /// Messages that were refused because they were too large.
    pub too_large: u64,
    /// Size of the largest of these, bytes.
    pub bytes: u64,
}

/// An input of the core.
#[derive(Clone, Debug)]
#[non_exhaustive]
pub enum Input {
    /// A message from the bus.
    Message {
        /// Its topic.
        topic: Arc<str>,
        /// Its bytes.
        payload: Vec<u8>,
    },
    /// A calibration from a file, as the bytes of a `Rig` message.
    RigFile(Vec<u8>),
    /// The solution of a performer's job.
    Solved {
        /// The performer.
        performer: PerformerId,
        /// The solution.
        solution: Box<Solution>,
        /// How long the solver took, nanoseconds.
        took: Nanos,
    },
    /// The solvers that share the performers of the stage, by name and in this order.
    Solvers(Vec<String>),
    /// Time has passed.
    Tick,
    /// Messages that were not read.
    Dropped(Vec<Loss>),
    /// Final poses were published: deviation of each from its due time, microseconds, positive is
    /// late.
    Played(Vec<i32>),
    /// The end of the input.
    End,
}

/// Outputs of the core.
#[derive(Clone, Debug)]
// Each is moved once, some hundred times a second.
#[allow(clippy::large_enum_variant)]
pub enum Output {
    /// A performer's job to solve; at most one of each performer at a time.
    Solve {
        /// The performer.
        performer: PerformerId,
        /// The job.
        job: Box<Job>,
        /// When its solution is needed, on the node's clock. The earliest is the most urgent.
        deadline: Timestamp,
    },
    /// A message to publish.
    Publish(Publication),
    /// A camera was mended: this calibration is in use in place of the one of that version.
    Mended {
        /// The calibration.
        rig: wire::Rig,
        /// Version of the one before.
        instead_of: u64,
    },
    /// The body of a performer with a name, for the folder of known bodies.
    Body {
        /// The performer.
        performer: PerformerId,
        /// The name.
        name: String,
        /// The body, with the measured lengths. `None`: the performer has another name, so what was written of this
        /// performer under this name is not needed.
        body: Option<wire::Skeleton>,
    },
    /// Asks for an [`Input::Tick`] at this time of the node's clock, unless another input comes
    /// later than that. Replaces the time asked for before.
    Wake(Timestamp),
}

/// Settings of a core; the first entry of the journal holds them.
#[derive(Clone, Debug)]
pub struct Settings {
    /// Settings of the tracker.
    pub tracker: tracker::Config,
    /// Settings of the stage.
    pub stage: stage::Config,
    /// Settings of the node.
    pub node: Config,
    /// All settings as TOML.
    pub toml: String,
    /// Fingerprint of the weights, hexadecimal.
    pub weights: String,
    /// The performer's body if it is known, as the bytes of a `Skeleton` message.
    pub body: Option<Vec<u8>>,
    /// What a take keeps of the run before it.
    pub carried: Carried,
    /// The timecode of the house, if there is one.
    pub timecode: Option<House>,
}

/// What a take keeps of the run before it, beside calibration and body.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Carried {
    /// Name of the take; empty: the node was started.
    pub take: String,
    /// Declared latency, if it was declared.
    pub latency: Option<Nanos>,
    /// The part of it that is reserved for a solve; 0: not known.
    pub solve: Nanos,
    /// Corrections of the cameras' time offsets, in the order of the rig; none: not corrected.
    pub time_offsets: Vec<Nanos>,
    /// The performers, if there are several.
    pub performers: Vec<Known>,
    /// The cameras that were moved and are left out, in the order of the rig.
    pub left_out: Vec<usize>,
    /// How the performers are shown, by number.
    pub labels: Vec<PerformerLabel>,
    /// The usual residual of each camera, pixels, in the order of the rig; 0: not known.
    pub usual_px: Vec<f64>,
    /// What a check found wrong with each camera, in the order of the rig; empty: nothing.
    pub verdicts: Vec<String>,
    /// The same of all cameras together.
    pub verdict: String,
    /// The solvers that share the performers of the stage, in the order of their names.
    pub solvers: Vec<String>,
    /// Whether the keypoint offsets of [`Settings::body`] are those of this detector. If not, only its bones are
    /// known: it may be of another day.
    pub offsets_are_known: bool,
}

impl Carried {
    /// Takes another calibration: no camera is left out. If the time offsets differ, none is corrected.
    pub(super) fn recalibrate(&mut self, before: &[u8], now: &[u8]) {
        self.left_out.clear();
        self.verdicts.clear();
        self.verdict.clear();
        let [before, now] = [before, now].map(|rig| {
            let cameras = wire::decode::<wire::Rig>(rig).unwrap_or_default().cameras.into_iter();
            cameras.map(|camera| (camera.name, camera.time_offset_ns)).collect::<Vec<_>>()
        });
        if before != now {
            self.time_offsets.clear();
        }
    }

    /// As the head of a journal has it.
    pub fn of(start: &JournalStart) -> Self {
        let latency = i64::try_from(start.latency_ns).unwrap_or(i64::MAX);
        Self {
            take: start.take.clone(),
            latency: (latency > 0).then(|| Nanos::new(latency)),
            solve: Nanos::new(start.solve_ns.cast_signed()),
            time_offsets: start.time_offsets_ns.iter().copied().map(Nanos::new).collect(),
            performers: start.performers.iter().map(known).collect(),
            left_out: start.left_out.iter().map(|camera| *camera as usize).collect(),
            labels: start.labels.clone(),
            usual_px: start.usual_px.clone(),
            verdicts: start.verdicts.clone(),
            verdict: start.verdict.clone(),
            solvers: start.solvers.clone(),
            offsets_are_known: start.offsets_are_known,
        }
    }
}

/// The performers in the status of another node. A number that is too large or comes twice is left out. A name that is not
/// valid, or is that of this node's `actor`, is cleared.
pub fn people_of(status: &StageStatus, actor: &str) -> Vec<Known> {
    let mut numbers = BTreeSet::new();
    let is_sound = |one: &&JournalPerformer| {
        (one.number as usize) < PerformerId::MOST && numbers.insert(one.number)
    };
    let mut all: Vec<Known> = status.known.iter().filter(is_sound).map(known).collect();
    let is_name = |name: &str| wire::valid_name(name).is_ok() && name != actor;
    all.iter_mut().filter(|one| !is_name(&one.name)).for_each(|one| one.name.clear());
    all
}

/// A performer of the run before, from the head of a journal.
fn known(wire: &JournalPerformer) -> Known {
    let body = wire.body.as_deref().and_then(|body| wire::decode::<wire::Skeleton>(body).ok());
    let mut known = Known {
        performer: PerformerId(wire.number as usize),
        name: wire.name.clone(),
        dropped: wire.dropped,
        body: body.and_then(|body| body.to_core().ok()).map(Arc::new),
        offsets_are_known: wire.offsets_are_known,
        seen: Timestamp::from_ns(wire.seen_ns),
        ..Known::default()
    };
    for (point, wire) in known.points.iter_mut().zip(wire.points_m.as_chunks::<3>().0) {
        *point = Some(Vector3::from(*wire)).filter(|point| point.iter().all(|c| c.is_finite()));
    }
    let lengths = known.lengths.iter_mut().zip(wire.lengths_m.as_chunks::<2>().0);
    let sound = lengths.filter(|(_, measured)| wire::is_length(measured));
    sound.for_each(|(length, measured)| *length = *measured);
    known
}

/// The same as a replay reads it: a message keeps less of a body.
pub(super) fn as_replayed(before: &Known) -> Known {
    known(&wire_known(before))
}

/// The same as a journal has it.
pub(super) fn wire_known(known: &Known) -> JournalPerformer {
    let point = |point: &Option<Vector3<f64>>| -> [f64; 3] {
        point.map_or([f64::NAN; 3], |point| point.into())
    };
    JournalPerformer {
        number: known.performer.0 as u32,
        name: known.name.clone(),
        dropped: known.dropped,
        body: known.body.as_deref().map(|body| wire::encode(&wire::Skeleton::from_core(body))),
        offsets_are_known: known.offsets_are_known,
        seen_ns: known.seen.ns(),
        points_m: known.points.iter().flat_map(point).collect(),
        lengths_m: known.lengths.as_flattened().to_vec(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn invalid_performers_of_another_node_are_left_out_and_invalid_names_cleared() {
        let of = |(number, name): (u32, &str)| JournalPerformer {
            number,
            name: name.to_owned(),
            lengths_m: vec![0.4, 10.0],
            ..JournalPerformer::default()
        };
        let names = ["lead", "../lead", "/tmp/lead", "a*", "actor", "lead"];
        let numbers = [1, 2, 3, 4, 5, 1];
        let mut known: Vec<_> = numbers.into_iter().zip(names).map(of).collect();
        let unsound = vec![0.5, 20.0, -1.0, 30.0, f64::NAN, 3.0, 0.5, 1e300];
        known.push(JournalPerformer { lengths_m: unsound, ..of((6, "other")) });
        known.push(of((u32::MAX, "far")));
        let people = people_of(&StageStatus { known, ..StageStatus::default() }, "actor");
        let found: Vec<_> = people.iter().map(|one| (one.performer.0, &*one.name)).collect();
        assert_eq!(found, [(1, "lead"), (2, ""), (3, ""), (4, ""), (5, ""), (6, "other")]);
        assert_eq!(people[5].lengths[..4], [[0.5, 20.0], [0.0; 2], [0.0; 2], [0.0; 2]]);
    }
}

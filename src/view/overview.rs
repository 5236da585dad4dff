//! What a recording holds, for the page's timeline.

use std::collections::BTreeMap;

use serde::Serialize;

use crate::core::body::TrackingState;
use crate::core::time::{Nanos, Timestamp};
use crate::io::recording::{Entry, Message, Reader, RecordError};
use crate::io::wire::{Event, Topic};

/// What a recording holds. Times are seconds since `start`.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Overview {
    /// Capture time of the first pose or keypoints, nanoseconds, as text: more digits than JSON's numbers.
    pub start_ns: String,
    /// Time from there to the last one.
    pub seconds: f64,
    /// Performers with final poses, by name.
    pub performers: BTreeMap<String, Vec<Run>>,
    /// Events, in the order of the file.
    pub events: Vec<OverviewEvent>,
    /// Number of keypoint frames by camera.
    pub cameras: BTreeMap<String, u64>,
    /// The losses of a damaged file.
    pub damage: Vec<String>,
}

/// Poses of one state in a row.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Run {
    /// Time of the first pose.
    pub from: f64,
    /// Time of the last pose.
    pub to: f64,
    /// `tracking`, `coasting` or `lost`.
    pub state: &'static str,
}

/// An event.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[allow(missing_docs)]
pub struct OverviewEvent {
    pub at: f64,
    pub kind: String,
    pub camera: Option<String>,
    /// The performer, if it concerns one.
    pub actor: Option<String>,
    pub count: u64,
    pub detail: String,
}

/// A pose, for runs: capture time and state.
type Stamp = (Timestamp, TrackingState);

/// What was read so far.
#[derive(Default)]
pub(super) struct Gathered {
    performers: BTreeMap<String, Vec<[Stamp; 2]>>,
    /// Events, each with its performer, if it concerns one.
    events: Vec<(Option<String>, Event)>,
    cameras: BTreeMap<String, u64>,
    /// Smallest and largest capture time.
    span: Option<[Timestamp; 2]>,
    damage: Vec<String>,
}

impl Gathered {
    /// Reads a whole recording. Returns its smallest and largest log time minus capture time.
    pub(super) fn read(
        &mut self,
        reader: &mut Reader,
        mut progress: impl FnMut(),
    ) -> Result<[Nanos; 2], RecordError> {
        let mut delays = None::<[Nanos; 2]>;
        for entry in reader.by_ref() {
            let Entry { topic, log_time, message } = entry?;
            progress();
            let Some(at) = self.add(&topic, message) else { continue };
            let [first, last] = self.span.unwrap_or([at; 2]);
            self.span = Some([first.min(at), last.max(at)]);
            let delay = log_time - at;
            let [least, most] = delays.unwrap_or([delay; 2]);
            delays = Some([least.min(delay), most.max(delay)]);
        }
        self.damage.extend(reader.report().losses());
        Ok(delays.unwrap_or([Nanos::ZERO; 2]))
    }

    /// Adds a message; returns its capture time if it is a final pose or keypoints.
    fn add(&mut self, topic: &str, message: Message) -> Option<Timestamp> {
        match message {
            Message::Pose(pose) if !pose.provisional => {
                let pose = pose.to_core().ok()?;
                let runs = self.performers.entry(Topic::actor(topic)).or_default();
                add(runs, (pose.capture, pose.state));
                Some(pose.capture)
            }
            Message::Keypoints(frame) => {
                let at = Timestamp::from_ns(frame.capture_time_ns);
                *self.cameras.entry(frame.camera).or_default() += 1;
                Some(at)
            }
            Message::Event(event) => {
                let of = Topic::parse(topic).ok().and_then(|topic| topic.topics());
                self.events.push((of.map(|topics| topics.actor), event));
                None
            }
            _ => None,
        }
    }

    pub(super) fn finish(self) -> Overview {
        let [start, end] = self.span.unwrap_or([Timestamp::from_ns(0); 2]);
        let since = |at: Timestamp| at.seconds_since(start);
        let run = |[first, last]: [Stamp; 2]| Run {
            from: since(first.0),
            to: since(last.0),
            state: first.1.name(),
        };
        let runs = |runs: Vec<[Stamp; 2]>| runs.into_iter().map(run).collect();
        let event = |(actor, event): (Option<String>, Event)| OverviewEvent {
            at: since(Timestamp::from_ns(event.capture_time_ns)),
            kind: event.kind,
            camera: event.camera,
            actor,
            count: event.count,
            detail: event.detail,
        };
        Overview {
            start_ns: start.ns().to_string(),
            seconds: since(end),
            performers: self.performers.into_iter().map(|(name, of)| (name, runs(of))).collect(),
            events: self.events.into_iter().map(event).collect(),
            cameras: self.cameras,
            damage: self.damage,
        }
    }
}

/// Continues the last run, or begins one.
fn add(runs: &mut Vec<[Stamp; 2]>, at: Stamp) {
    match runs.last_mut() {
        Some([first, last]) if first.1 == at.1 => *last = at,
        _ => runs.push([at; 2]),
    }
}

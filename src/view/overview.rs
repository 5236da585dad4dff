//! What a recording holds, for the page's timeline.

use std::collections::BTreeMap;

use serde::Serialize;

use crate::core::body::TrackingState;
use crate::core::time::{Nanos, Timestamp};
use crate::io::recording::{Entry, Message, Reader, RecordError};
use crate::io::wire::{Event, Topic};

/// A capture time is wrong if its log time comes this much earlier or later than it usually does.
const FAR: Nanos = Nanos::from_ms(10_000);

/// What a recording holds. Times are capture times, seconds since `start_ns`.
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
    /// Capture times of the first and the last pose or keypoints.
    span: Option<[Timestamp; 2]>,
    damage: Vec<String>,
}

impl Gathered {
    /// Reads a whole recording, the `number`th. Returns its smallest and largest log time minus capture time,
    /// and the performers that an earlier recording has too, with their names here.
    pub(super) fn read(
        &mut self,
        reader: &mut Reader,
        number: usize,
        mut progress: impl FnMut(),
    ) -> Result<([Nanos; 2], BTreeMap<String, String>), RecordError> {
        let (earlier, events) = (std::mem::take(&mut self.performers), self.events.len());
        let mut times = Vec::new();
        for entry in reader.by_ref() {
            let Entry { topic, log_time, message } = entry?;
            progress();
            times.extend(self.add(&topic, message).map(|at| (at, log_time - at)));
        }
        let delays = self.add_times(times);
        self.damage.extend(reader.report().losses());
        let mut renamed = BTreeMap::new();
        for (name, runs) in std::mem::replace(&mut self.performers, earlier) {
            let new = match self.performers.contains_key(&name) {
                true => format!("{name} ({number})"),
                false => name.clone(),
            };
            self.performers.insert(new.clone(), runs);
            renamed.insert(name, new);
        }
        for actor in self.events[events..].iter_mut().filter_map(|(actor, _)| actor.as_mut()) {
            if let Some(new) = renamed.get(actor) {
                actor.clone_from(new);
            }
        }
        Ok((delays, renamed))
    }

    /// Adds capture times, each with the log time minus it. Returns the smallest and the largest such delay;
    /// wrong times are left out, for the span would be years long.
    fn add_times(&mut self, times: Vec<(Timestamp, Nanos)>) -> [Nanos; 2] {
        let mut delays: Vec<Nanos> = times.iter().map(|(_, delay)| *delay).collect();
        delays.sort_unstable();
        let Some(&usual) = delays.get(delays.len() / 2) else { return [Nanos::ZERO; 2] };
        let is_right = |delay: Nanos| (usual - FAR..=usual + FAR).contains(&delay);
        let wrong = delays.iter().filter(|delay| !is_right(**delay)).count();
        if wrong > 0 {
            let what = "messages with a capture time far from the others' are not shown";
            self.damage.push(format!("{wrong} {what}"));
        }
        for (at, _) in times.into_iter().filter(|(_, delay)| is_right(*delay)) {
            let [first, last] = self.span.unwrap_or([at; 2]);
            self.span = Some([first.min(at), last.max(at)]);
        }
        delays.retain(|delay| is_right(*delay));
        [delays[0], delays[delays.len() - 1]]
    }

    /// Adds a message; returns its capture time if it is a final pose or keypoints.
    fn add(&mut self, topic: &str, message: Message) -> Option<Timestamp> {
        match message {
            Message::Pose(pose) if !pose.provisional => {
                let pose = pose.to_core().ok()?;
                let runs = self.performers.entry(Topic::actor(topic)).or_default();
                extend(runs, (pose.capture, pose.state));
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
fn extend(runs: &mut Vec<[Stamp; 2]>, at: Stamp) {
    match runs.last_mut() {
        Some([first, last]) if first.1 == at.1 => *last = at,
        _ => runs.push([at; 2]),
    }
}

//! What a recording holds, for the page's timeline.

use std::collections::BTreeMap;

use serde::Serialize;

use crate::core::body::TrackingState;
use crate::core::time::Timestamp;
use crate::io::recording::{Message, Reader, RecordError};
use crate::io::wire::{Pose, Topic};

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
    /// Smallest and largest log time minus capture time, nanoseconds.
    #[serde(skip)]
    pub(super) delay_ns: [i64; 2],
    #[serde(skip)]
    pub(super) start: Timestamp,
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

impl Overview {
    /// Reads a whole recording; `progress` is called for each message.
    ///
    /// # Errors
    /// As [`Reader`].
    pub fn read(reader: &mut Reader, mut progress: impl FnMut()) -> Result<Self, RecordError> {
        let mut all: BTreeMap<String, Vec<[Stamp; 2]>> = BTreeMap::new();
        let (mut events, mut cameras) = (Vec::new(), BTreeMap::new());
        let (mut span, mut delay) = (None::<[Timestamp; 2]>, None::<[i64; 2]>);
        for entry in reader.by_ref() {
            let entry = entry?;
            progress();
            let capture = match &entry.message {
                Message::Pose(pose) if !pose.provisional => {
                    let Ok(stamp) = stamp(pose) else { continue };
                    add(all.entry(Topic::actor(&entry.topic)).or_default(), stamp);
                    pose.capture_time_ns
                }
                Message::Keypoints(frame) => {
                    *cameras.entry(frame.camera.clone()).or_default() += 1;
                    frame.capture_time_ns
                }
                Message::Event(event) => {
                    let of = Topic::parse(&entry.topic).ok().and_then(|topic| topic.topics());
                    events.push((of.map(|topics| topics.actor), event.clone()));
                    continue;
                }
                _ => continue,
            };
            let at = Timestamp::from_ns(capture);
            let [first, last] = span.unwrap_or([at; 2]);
            span = Some([first.min(at), last.max(at)]);
            let late = entry.log_time.ns().saturating_sub(capture);
            let [least, most] = delay.unwrap_or([late; 2]);
            delay = Some([least.min(late), most.max(late)]);
        }
        let [start, end] = span.unwrap_or([Timestamp::from_ns(0); 2]);
        let since = |at: Timestamp| at.seconds_since(start);
        let run = |[first, last]: [Stamp; 2]| Run {
            from: since(first.0),
            to: since(last.0),
            state: first.1.name(),
        };
        let runs = |runs: Vec<[Stamp; 2]>| runs.into_iter().map(run).collect();
        let event = |(actor, event): (Option<String>, crate::io::wire::Event)| OverviewEvent {
            at: since(Timestamp::from_ns(event.capture_time_ns)),
            kind: event.kind,
            camera: event.camera,
            actor,
            count: event.count,
            detail: event.detail,
        };
        Ok(Self {
            start_ns: start.ns().to_string(),
            seconds: since(end),
            performers: all.into_iter().map(|(name, of)| (name, runs(of))).collect(),
            events: events.into_iter().map(event).collect(),
            cameras,
            damage: reader.report().losses(),
            delay_ns: delay.unwrap_or_default(),
            start,
        })
    }
}

fn stamp(pose: &Pose) -> Result<Stamp, crate::io::wire::DecodeError> {
    let pose = pose.to_core()?;
    Ok((pose.capture, pose.state))
}

/// Continues the last run, or begins one.
fn add(runs: &mut Vec<[Stamp; 2]>, at: Stamp) {
    match runs.last_mut() {
        Some([first, last]) if first.1 == at.1 => *last = at,
        _ => runs.push([at; 2]),
    }
}

//! What a recording holds, for the page's timeline.

use std::collections::BTreeMap;

use nalgebra::Vector3;
use serde::Serialize;
use serde_json::{Value, json};

use crate::core::body::{JOINTS, TrackingState};
use crate::core::time::{Nanos, Timestamp};
use crate::io::recording::{Entry, Message, Reader, RecordError};
use crate::io::report::{BENT, flexion_deg};
use crate::io::wire::{CameraCounters, Event, Pose, Status, Topic, WindowCounters};

/// A capture time is wrong if its log time comes this much earlier or later than it usually does.
const FAR: Nanos = Nanos::from_ms(10_000);
/// A run of poses ends where none comes for so long.
const GAP: Nanos = Nanos::SECOND;

/// What a recording holds. Times are capture times, seconds since `start_ns`.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Overview {
    /// Capture time of the first pose or keypoints, nanoseconds, as text: more digits than JSON's numbers.
    pub start_ns: String,
    /// Time from there to the last one.
    pub seconds: f64,
    /// Performers with final poses, by name.
    pub performers: BTreeMap<String, Vec<Run>>,
    /// Events, in order of capture time.
    pub events: Vec<OverviewEvent>,
    /// The performer or node whose statuses judge the cameras: of the first file that has any.
    pub node: Option<String>,
    /// For the charts: what the nodes said of themselves, at most 600.
    pub statuses: Vec<OverviewStatus>,
    /// For the charts: time and flexions (degrees) of left knee, right knee, left elbow and right elbow, by
    /// performer, at most 600 each; 0 is straight.
    pub angles: BTreeMap<String, Vec<[f32; 5]>>,
    /// Number of keypoint frames by camera.
    pub cameras: BTreeMap<String, u64>,
    /// The losses of a damaged file.
    pub damage: Vec<String>,
}

/// Poses of one state in a row, without a gap.
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
    /// Run of the node, as text: more digits than JSON's numbers.
    pub run: String,
    pub count: u64,
    pub detail: String,
}

/// A part of a status.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct OverviewStatus {
    /// The capture time.
    pub seconds: f64,
    /// What the charts show of it, with the names of `schemas/status.proto`.
    pub status: Value,
}

/// Most points of a curve.
const MOST: usize = 600;

/// A pose, for runs: capture time and state.
type Stamp = (Timestamp, TrackingState);

/// Of a performer.
#[derive(Default)]
struct Performer {
    runs: Vec<[Stamp; 2]>,
    /// Flexions of the joints [`BENT`], degrees.
    angles: Vec<(Timestamp, [f32; BENT.len()])>,
}

/// Statuses with cameras.
type Statuses = Vec<(Timestamp, Charted)>;

/// What the charts show of a status.
struct Charted {
    declared_latency_ns: u64,
    /// Median distance of each camera's points from the body, pixels.
    residuals: Vec<(String, f64)>,
    windows: WindowCounters,
}

/// What was read so far.
#[derive(Default)]
pub(super) struct Gathered {
    performers: BTreeMap<String, Performer>,
    /// Of the file that is being read, by whose they are.
    statuses: BTreeMap<String, Statuses>,
    /// Number of the first file with statuses, the node there, and its statuses.
    node: Option<(usize, String, Statuses)>,
    /// Numbers of the files with a rig, and whether they have poses.
    rigs: Vec<(usize, bool)>,
    has_rig: bool,
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
        Ok((delays, self.end_file(number, earlier, events)))
    }

    /// After the `number`th file: `earlier` performers are of the files before, and so many events. Returns the new
    /// names of performers.
    fn end_file(
        &mut self,
        number: usize,
        earlier: BTreeMap<String, Performer>,
        events: usize,
    ) -> BTreeMap<String, String> {
        let own = std::mem::replace(&mut self.performers, earlier);
        if std::mem::take(&mut self.has_rig) {
            self.rigs.push((number, !own.is_empty()));
        }
        let mut statuses = std::mem::take(&mut self.statuses);
        // With several performers each has statuses, too; the node has no poses then.
        let is_node = |name: &&String| !own.contains_key(*name);
        let node = statuses.keys().find(is_node).or(statuses.keys().next()).cloned();
        let mut renamed = BTreeMap::new();
        for (name, performer) in own {
            let new = match self.performers.contains_key(&name) {
                true => format!("{name} ({number})"),
                false => name.clone(),
            };
            self.performers.insert(new.clone(), performer);
            renamed.insert(name, new);
        }
        if let Some(name) = node.filter(|_| self.node.is_none()) {
            let of_node = statuses.remove(&name).unwrap_or_default();
            self.node = Some((number, renamed.get(&name).unwrap_or(&name).clone(), of_node));
        }
        for actor in self.events[events..].iter_mut().filter_map(|(actor, _)| actor.as_mut()) {
            if let Some(new) = renamed.get(actor) {
                actor.clone_from(new);
            }
        }
        renamed
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
                let angles = angles(&pose);
                let pose = pose.to_core().ok()?;
                let performer = self.performers.entry(Topic::actor(topic)).or_default();
                extend(&mut performer.runs, (pose.capture, pose.state));
                performer.angles.extend(angles.map(|angles| (pose.capture, angles)));
                Some(pose.capture)
            }
            Message::Keypoints(frame) => {
                let at = Timestamp::from_ns(frame.capture_time_ns);
                *self.cameras.entry(frame.camera).or_default() += 1;
                Some(at)
            }
            Message::Rig(_) => {
                self.has_rig = true;
                None
            }
            Message::Event(event) => {
                let of = Topic::parse(topic).ok().and_then(|topic| topic.topics());
                self.events.push((of.map(|topics| topics.actor), event));
                None
            }
            Message::Status(status) if !status.cameras.is_empty() => {
                let at = Timestamp::from_ns(status.capture_time_ns);
                let of_one = self.statuses.entry(Topic::actor(topic)).or_default();
                of_one.push((at, Charted::of(*status)));
                None
            }
            _ => None,
        }
    }

    /// Number of the file whose statuses judge the cameras.
    pub(super) fn judged(&self) -> Option<usize> {
        self.node.as_ref().map(|(number, ..)| *number)
    }

    /// Number of the file whose rig is shown: the file whose statuses count, else the first one with poses.
    pub(super) fn rig(&self) -> Option<usize> {
        let judged = self.judged();
        let rigs = self.rigs.iter();
        let first = rigs.min_by_key(|(file, has_poses)| (Some(*file) != judged, !has_poses, *file));
        first.map(|(file, _)| *file)
    }

    pub(super) fn finish(self) -> Overview {
        let [start, end] = self.span.unwrap_or([Timestamp::from_ns(0); 2]);
        let since = |at: Timestamp| at.seconds_since(start);
        let run = |[first, last]: [Stamp; 2]| Run {
            from: since(first.0),
            to: since(last.0),
            state: first.1.name(),
        };
        let status = |(at, charted): &(Timestamp, Charted)| OverviewStatus {
            seconds: since(*at),
            status: charted.json(),
        };
        let (node, statuses) = self.node.map_or_else(Default::default, |(_, name, statuses)| {
            (Some(name), thin(&statuses).map(status).collect())
        });
        let of_time =
            |(at, [a, b, c, d]): &(Timestamp, [f32; 4])| [since(*at) as f32, *a, *b, *c, *d];
        let (mut runs, mut angles) = (BTreeMap::new(), BTreeMap::new());
        for (name, performer) in self.performers {
            angles.insert(name.clone(), thin(&performer.angles).map(of_time).collect());
            runs.insert(name, performer.runs.into_iter().map(run).collect());
        }
        let event = |(actor, event): (Option<String>, Event)| OverviewEvent {
            at: since(Timestamp::from_ns(event.capture_time_ns)),
            kind: event.kind,
            camera: event.camera,
            actor,
            run: event.run_id.to_string(),
            count: event.count,
            detail: event.detail,
        };
        // They may be of several files.
        let mut events: Vec<_> = self.events.into_iter().map(event).collect();
        events.sort_by(|a, b| a.at.total_cmp(&b.at));
        Overview {
            start_ns: start.ns().to_string(),
            seconds: since(end),
            performers: runs,
            statuses,
            node,
            angles,
            events,
            cameras: self.cameras,
            damage: self.damage,
        }
    }
}

/// Continues the last run, or begins one after a gap or with another state.
fn extend(runs: &mut Vec<[Stamp; 2]>, at: Stamp) {
    match runs.last_mut() {
        Some([first, last]) if first.1 == at.1 && at.0 - last.0 < GAP => *last = at,
        _ => runs.push([at; 2]),
    }
}

/// At most [`MOST`] of them, evenly spread.
fn thin<T>(all: &[T]) -> impl Iterator<Item = &T> {
    all.iter().step_by(all.len().div_ceil(MOST).max(1))
}

fn angles(pose: &Pose) -> Option<[f32; BENT.len()]> {
    let places = pose.joint_positions_m.chunks_exact(3);
    let places: Vec<_> = places.map(|at| Vector3::from_column_slice(at).cast()).collect();
    let places: &[Vector3<f64>; JOINTS] = places.as_slice().try_into().ok()?;
    let mut angles = [0.0; BENT.len()];
    for (angle, joint) in angles.iter_mut().zip(BENT) {
        *angle = flexion_deg(places, joint)? as f32;
    }
    Some(angles)
}

impl Charted {
    fn of(status: Status) -> Self {
        let residual = |camera: CameraCounters| (camera.camera, camera.residual_px);
        Self {
            declared_latency_ns: status.declared_latency_ns,
            residuals: status.cameras.into_iter().map(residual).collect(),
            windows: status.windows.unwrap_or_default(),
        }
    }

    fn json(&self) -> Value {
        let Self { declared_latency_ns, residuals, windows } = self;
        let camera = |(camera, residual_px): &(String, f64)| json!({ "camera": camera, "residual_px": residual_px });
        let cameras: Vec<_> = residuals.iter().map(camera).collect();
        json!({ "declared_latency_ns": declared_latency_ns, "cameras": cameras, "windows": windows })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::core::body::{self, Skeleton, StampedPose};
    use crate::io::wire::Topics;

    #[test]
    fn the_charts_have_the_nodes_states_and_the_performers_angles() {
        let mut all = Gathered::default();
        let of = |actor: &str| Topics { actor: actor.into(), ..Topics::default() };
        let at = |second: i64| Timestamp::from_ns(second * 1_000_000_000);
        for second in 0..2000 {
            let pose = StampedPose::new(at(second), body::Pose::rest(), TrackingState::Tracking);
            let pose = Pose::from_core(&pose, &Skeleton::default(), None);
            assert_eq!(all.add(&of("p1").pose(), Message::Pose(pose)), Some(at(second)));
            for (actor, residual_px) in [("node", 4.0), ("p1", 9.0)] {
                let camera = CameraCounters { residual_px, ..CameraCounters::default() };
                let capture_time_ns = at(second).ns();
                let status = Status { capture_time_ns, cameras: vec![camera], ..Status::default() };
                all.add(&of(actor).status(), Message::Status(Box::new(status)));
            }
        }
        all.span = Some([at(0), at(1999)]);
        all.end_file(1, BTreeMap::new(), 0);
        // A second file: its performer has the same name, and its statuses do not count.
        let pose = StampedPose::new(at(0), body::Pose::rest(), TrackingState::Tracking);
        let earlier = std::mem::take(&mut all.performers);
        all.add(
            &of("p1").pose(),
            Message::Pose(Pose::from_core(&pose, &Skeleton::default(), None)),
        );
        let camera = CameraCounters { residual_px: 99.0, ..CameraCounters::default() };
        let status = Status { cameras: vec![camera], ..Status::default() };
        all.add(&of("node").status(), Message::Status(Box::new(status)));
        assert_eq!(all.end_file(2, earlier, 0)["p1"], "p1 (2)");
        assert_eq!(all.judged(), Some(1));
        let overview = all.finish();
        assert!(overview.performers.keys().eq(["p1", "p1 (2)"]));
        assert_eq!(overview.node.as_deref(), Some("node"));
        assert_eq!(overview.statuses.len(), 500);
        let last = &overview.statuses[499];
        assert!((last.seconds - 1996.0).abs() < 1e-6, "{last:?}");
        assert_eq!(last.status["cameras"][0]["residual_px"], 4.0);
        assert_eq!(overview.angles["p1"].len(), 500);
        let [seconds, knee, ..] = overview.angles["p1"][499];
        assert!(seconds == 1996.0 && knee < 5.0, "{knee} degrees in the rest pose");
    }
}

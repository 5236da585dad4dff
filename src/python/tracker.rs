//! The tracker's loop.

use std::collections::{BTreeMap, VecDeque};
use std::path::PathBuf;
use std::sync::{Mutex, MutexGuard, PoisonError};

use bundlemocap::core::body::JOINTS;
use bundlemocap::core::stage::{Input, Names, Output, Performers, Stage};
use bundlemocap::core::tracker;
use bundlemocap::{
    Decoder, Detections, KeypointFormat, Nanos, PerformerId, Solver, StampedPose, Timestamp,
};
use pyo3::prelude::*;

use crate::arrays::{Array, array};
use crate::camera::Rig;
use crate::error;
use crate::motion::{Body, deviations, positions, rotations, settings};
use crate::recording::{capture, format_of, numbers, people};

/// Most events that wait until somebody takes them.
const MOST_EVENTS: usize = 10_000;
/// Between two frames of a camera: 10 kHz.
const SHORTEST: Nanos = Nanos::new(100_000);
/// Longest time between frames: in a gap the tracker still has a pose for each frame.
const LONGEST: Nanos = Nanos::from_ms(86_400_000);

/// A pose of a performer.
#[pyclass(frozen, module = "bundlemocap")]
pub(crate) struct Pose {
    #[pyo3(get)]
    performer: String,
    pose: StampedPose,
    body: Body,
}

#[pymethods]
impl Pose {
    #[getter]
    fn time_ns(&self) -> i64 {
        self.pose.capture.ns()
    }

    #[getter]
    fn state(&self) -> &'static str {
        self.pose.state.name()
    }

    #[getter]
    fn positions<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        array(py, positions(&self.pose.pose, &self.body), [JOINTS, 3])
    }

    #[getter]
    fn rotations<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        array(py, rotations(&self.pose.pose), [JOINTS, 4])
    }

    #[getter]
    fn deviations<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        array(py, deviations(&self.pose), [JOINTS])
    }

    fn __repr__(&self) -> String {
        format!("Pose of {} at {} ns, {}", self.performer, self.time_ns(), self.state())
    }
}

/// Solves frame by frame.
#[pyclass(frozen, module = "bundlemocap")]
pub(crate) struct Tracker {
    rig: Rig,
    format: KeypointFormat,
    stage: Mutex<Staged>,
}

/// The stage with what it is fed with and what came out.
struct Staged {
    stage: Stage,
    solver: Solver,
    /// The name of the performer, if there is only one.
    only: Option<String>,
    /// Names of the cameras.
    cameras: Vec<String>,
    /// The newest body of each performer.
    bodies: BTreeMap<PerformerId, Body>,
    /// By camera, the number of its next frame.
    frames: Vec<u64>,
    /// By camera, the time of the newest frame.
    last: Vec<Option<Timestamp>>,
    /// The newest of all cameras.
    newest: Option<Timestamp>,
    events: VecDeque<String>,
    has_ended: bool,
}

impl Staged {
    /// Passes in an input; returns the poses.
    fn feed(&mut self, input: Input) -> Vec<Pose> {
        let mut poses = Vec::new();
        self.stage.handle(input);
        while let Some(output) = self.stage.poll_and_solve(|job| self.solver.solve(job)) {
            match output {
                Output::Performer(performer, tracker::Output::Skeleton(body)) => {
                    self.bodies.insert(performer, body);
                }
                Output::Performer(performer, tracker::Output::Pose(pose)) => {
                    let Some(body) = self.bodies.get(&performer).cloned() else { continue };
                    let performer = self.name_of(performer);
                    poses.push(Pose { performer, pose: *pose, body });
                }
                Output::Performer(performer, tracker::Output::Event(event)) => {
                    let text = format!("{}: {}", self.name_of(performer), self.words(&event));
                    self.note(text);
                }
                Output::Event(event) => self.note(self.words(&event)),
                _ => {}
            }
        }
        poses
    }

    /// Keeps an event until somebody takes it, or too many come.
    fn note(&mut self, text: String) {
        if self.events.len() == MOST_EVENTS {
            self.events.pop_front();
        }
        self.events.push_back(text);
    }

    /// As [`solve`](crate::motion::solve) names them.
    fn name_of(&self, performer: PerformerId) -> String {
        match &self.only {
            Some(name) => name.clone(),
            None => self.stage.name_of(performer),
        }
    }

    /// Kind, camera and what was measured.
    fn words(&self, event: &tracker::Event) -> String {
        let camera = event.camera.and_then(|camera| self.cameras.get(camera));
        let camera = camera.map_or(String::new(), |name| format!("{name}: "));
        format!("{}: {camera}{}", event.kind.name(), event.detail)
    }
}

impl Tracker {
    fn stage(&self) -> MutexGuard<'_, Staged> {
        self.stage.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[pymethods]
impl Tracker {
    #[new]
    #[pyo3(signature = (rig, format, *, performers=None, config=None))]
    fn new(
        rig: Rig,
        format: &str,
        performers: Option<&Bound<PyAny>>,
        config: Option<PathBuf>,
    ) -> PyResult<Self> {
        let config = settings(config, performers)?;
        let known = config.known_people().map_err(error)?;
        let decoder = Decoder::embedded().map_err(error)?;
        let tracker = bundlemocap::Tracker::new(config.tracker, rig.0.clone());
        let stage = Staged {
            stage: Stage::new(tracker, config.stage.performers, None)
                .choosing(config.stage.choice())
                .naming(Names::new(config.stage.names.clone()))
                .with_known(&known),
            only: (config.stage.performers == Performers::Number(1)).then_some(config.node.actor),
            cameras: rig.0.cameras.iter().map(|camera| camera.name.clone()).collect(),
            solver: Solver::new(decoder, config.tracker),
            bodies: BTreeMap::new(),
            frames: vec![0; rig.0.cameras.len()],
            last: vec![None; rig.0.cameras.len()],
            newest: None,
            events: VecDeque::new(),
            has_ended: false,
        };
        Ok(Self { rig, format: format_of(format)?, stage: Mutex::new(stage) })
    }

    /// Adds what a camera detected; returns the poses that are new.
    #[pyo3(signature = (camera, time_ns, points, frame=None))]
    fn add(
        &self,
        py: Python,
        camera: &str,
        time_ns: i64,
        points: Array<f64>,
        frame: Option<i64>,
    ) -> PyResult<Vec<Pose>> {
        let (camera, capture) = (self.rig.index_of(camera)?, capture(time_ns)?);
        let frame = frame.map(u64::try_from).transpose();
        let frame = frame.map_err(|_| error("frame: the number of an image is not negative"))?;
        let format = self.format;
        if !(2..=3).contains(&points.shape.len()) {
            let shape = &points.shape;
            let text = format!(
                "points: give those of one image, (people x) points x 3 numbers, not {shape:?}"
            );
            return Err(error(text));
        }
        let people = people(format, &numbers(format, &points, "(people)")?);
        py.detach(|| {
            let mut stage = self.stage();
            if stage.has_ended {
                return Err(error("the tracker has ended; make a new one for the next take"));
            }
            let last = stage.last[camera].replace(capture);
            let newest = stage.newest.unwrap_or(capture);
            let apart = last.map_or(LONGEST, |last| capture - last);
            if !(SHORTEST..=LONGEST).contains(&apart) || (capture - newest).abs() > LONGEST {
                let apart = (capture - last.unwrap_or(newest)).ns();
                stage.last[camera] = last;
                return Err(error(format!(
                    "time_ns is {apart} ns after the frame before: give nanoseconds; the next frame of a camera is \
                     0.1 ms to a day later"
                )));
            }
            stage.newest = Some(newest.max(capture));
            let frame = frame.unwrap_or(stage.frames[camera]);
            stage.frames[camera] = frame.wrapping_add(1);
            Ok(stage.feed(Input::Detections(Detections { camera, frame, capture, format, people })))
        })
    }

    /// The last poses; nothing may be added after it.
    fn end(&self, py: Python) -> Vec<Pose> {
        py.detach(|| {
            let mut stage = self.stage();
            match std::mem::replace(&mut stage.has_ended, true) {
                true => Vec::new(),
                false => stage.feed(Input::End),
            }
        })
    }

    /// What happened since the last call.
    fn take_events(&self, py: Python) -> Vec<String> {
        py.detach(|| std::mem::take(&mut self.stage().events).into())
    }
}

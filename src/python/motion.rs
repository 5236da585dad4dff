//! Solving, and poses as arrays.

use std::collections::BTreeMap;
use std::ops::ControlFlow;
use std::path::PathBuf;
use std::sync::Arc;

use bundlemocap::StampedPose;
use bundlemocap::config::Config;
use bundlemocap::core::body::{JOINTS, Pose as CorePose, Skeleton};
use bundlemocap::core::so3;
use bundlemocap::offline::{self, Observer, Options, solve_group};
use pyo3::prelude::*;
use pyo3::types::PyDict;

use crate::arrays::{Kept, array};
use crate::recording::Recording;
use crate::{error, warn_of};

/// The joint centres in the world.
pub(crate) fn positions(pose: &CorePose, skeleton: &Skeleton) -> impl Iterator<Item = f64> {
    pose.posture(skeleton).positions.into_iter().flat_map(|at| [at.x, at.y, at.z])
}

/// x, y, z, w of the pelvis in the world, then of each joint in its parent.
pub(crate) fn rotations(pose: &CorePose) -> impl Iterator<Item = f64> {
    std::iter::once(&pose.root_rotation).chain(&pose.local).flat_map(so3::xyzw_from_rotation)
}

/// The standard deviations of the joint centres; NaN if they are not known.
pub(crate) fn deviations(pose: &StampedPose) -> impl Iterator<Item = f64> {
    pose.deviations.unwrap_or([f64::NAN; JOINTS]).into_iter()
}

/// The poses of a performer.
#[pyclass(frozen, module = "bundlemocap")]
pub(crate) struct Motion {
    motion: offline::Motion,
    positions: Kept,
    rotations: Kept,
    deviations: Kept,
}

impl From<offline::Motion> for Motion {
    fn from(motion: offline::Motion) -> Self {
        let (positions, rotations, deviations) = Default::default();
        Self { motion, positions, rotations, deviations }
    }
}

#[pymethods]
impl Motion {
    #[getter]
    fn actor(&self) -> &str {
        &self.motion.actor
    }

    #[getter]
    fn fps(&self) -> f64 {
        self.motion.fps
    }

    #[getter]
    fn times_ns<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        array(py, self.motion.poses().map(|pose| pose.capture.ns()), [self.motion.poses().len()])
    }

    #[getter]
    fn positions<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        self.positions.get(py, || {
            let skeleton = &self.motion.skeleton;
            let of = |pose: StampedPose| positions(&pose.pose, skeleton).collect::<Vec<_>>();
            array(py, self.motion.poses().flat_map(of), [self.motion.poses().len(), JOINTS, 3])
        })
    }

    #[getter]
    fn rotations<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        self.rotations.get(py, || {
            let of = |pose: StampedPose| rotations(&pose.pose).collect::<Vec<_>>();
            array(py, self.motion.poses().flat_map(of), [self.motion.poses().len(), JOINTS, 4])
        })
    }

    #[getter]
    fn deviations<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        self.deviations.get(py, || {
            let of = |pose: StampedPose| deviations(&pose).collect::<Vec<_>>();
            array(py, self.motion.poses().flat_map(of), [self.motion.poses().len(), JOINTS])
        })
    }

    #[getter]
    fn states(&self) -> Vec<&'static str> {
        self.motion.poses().map(|pose| pose.state.name()).collect()
    }

    #[getter]
    fn rest_positions<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        let rest = CorePose::rest();
        let all = positions(&rest, &self.motion.skeleton);
        array(py, all, [JOINTS, 3])
    }

    fn __len__(&self) -> usize {
        self.motion.poses().len()
    }

    fn __repr__(&self) -> String {
        let Self { motion, .. } = self;
        format!(
            "Motion of {}: {} poses at {:.2} Hz",
            motion.actor,
            motion.poses().len(),
            motion.fps
        )
    }
}

/// What a solve found.
#[pyclass(frozen, module = "bundlemocap", get_all)]
pub(crate) struct Solved {
    motions: BTreeMap<String, Py<Motion>>,
    summary: Py<PyDict>,
}

fn motions(py: Python, path: &std::path::Path) -> PyResult<BTreeMap<String, Py<Motion>>> {
    let (found, report) = py.detach(|| offline::read_motions(path, false)).map_err(error)?;
    warn_of(py, &path.display().to_string(), &report.losses())?;
    if found.is_empty() {
        let fix = "solve it first, then use its poses.mcap";
        return Err(error(format!("{} holds no poses; {fix}", path.display())));
    }
    let of =
        |motion: offline::Motion| Ok((motion.actor.clone(), Py::new(py, Motion::from(motion))?));
    found.into_iter().map(of).collect()
}

/// The poses of a solved recording (poses.mcap), by name of the performer.
#[pyfunction]
pub(crate) fn read_motions(py: Python, path: PathBuf) -> PyResult<BTreeMap<String, Py<Motion>>> {
    motions(py, &path)
}

/// A take: the path of a recording, or its arrays.
#[derive(FromPyObject)]
pub(crate) enum Take {
    Arrays(Py<Recording>),
    Path(PathBuf),
}

/// The settings of a file, or the defaults, with the given number of performers.
pub(crate) fn settings(
    path: Option<PathBuf>,
    performers: Option<&Bound<PyAny>>,
) -> PyResult<Config> {
    let config = path.map_or(Ok(Config::default()), |path| Config::load_partial(&path));
    let mut config = config.map_err(error)?;
    if let Some(given) = performers {
        let text = given.str()?;
        let performers =
            text.to_str()?.parse().map_err(|what| error(format!("performers: {what}")))?;
        config.stage.performers = performers;
    }
    match config.conflict_of_people() {
        Some(reason) => Err(error(reason)),
        None => Ok(config),
    }
}

/// Solves a recording: a path, or a Recording.
#[pyfunction]
#[pyo3(signature = (
    recording, *, performers=None, cameras=vec![], hold_out=vec![], config=None, out=None, overwrite=false
))]
#[allow(clippy::too_many_arguments)] // Keywords in Python.
pub(crate) fn solve(
    py: Python,
    recording: Take,
    performers: Option<&Bound<PyAny>>,
    cameras: Vec<String>,
    hold_out: Vec<String>,
    config: Option<PathBuf>,
    out: Option<PathBuf>,
    overwrite: bool,
) -> PyResult<Solved> {
    let folder = tempfile::tempdir()?;
    let (path, name) = match recording {
        Take::Path(path) => (path.clone(), path.display().to_string()),
        Take::Arrays(arrays) => {
            let path = folder.path().join("arrays.mcap");
            arrays.get().write(py, path.clone())?;
            (path, "the recording".to_owned())
        }
    };
    let told = |wrong: offline::Error| {
        error(wrong.to_string().replace(&path.display().to_string(), &name))
    };
    let config = settings(config, performers)?;
    let performers = config.stage.performers;
    let out = out.unwrap_or_else(|| folder.path().join("out"));
    let options = Options {
        config: config.tracker,
        cameras,
        hold_out,
        performers,
        choice: config.stage.choice(),
        names: config.stage.names.clone(),
        known: config.known_people().map_err(error)?,
        out: Some(out.clone()),
        overwrite,
        timecode: config.timecode.house().map_err(error)?,
        config_toml: Some(config.to_toml()),
        ..Options::default()
    };
    let mut interrupts = Interrupts::default();
    let group = py.detach(|| {
        let mut recording = offline::Recording::open(&path)?;
        let group = solve_group(&mut recording, &options, &mut interrupts)?;
        Ok::<_, offline::Error>((group, recording.losses()))
    });
    if let Some(interrupt) = interrupts.interrupt {
        return Err(interrupt);
    }
    let (group, losses) = group.map_err(told)?;
    warn_of(py, &name, &losses)?;
    if let Some(folder) = config.bodies_folder() {
        group.write_bodies(folder).map_err(error)?;
    }
    let json = serde_json::to_string(&group).map_err(error)?;
    let summary = py.import("json")?.call_method1("loads", (json,))?.cast_into::<PyDict>()?;
    Ok(Solved { motions: motions(py, &out.join("poses.mcap"))?, summary: summary.unbind() })
}

/// Ends a solve when Python is interrupted.
#[derive(Default)]
struct Interrupts {
    messages: u64,
    interrupt: Option<PyErr>,
}

/// Messages between two looks at Python.
const ATTENTION: u64 = 64;

impl Observer for Interrupts {
    fn message(&mut self) -> ControlFlow<()> {
        self.messages += 1;
        if self.messages.is_multiple_of(ATTENTION) {
            self.interrupt = Python::attach(|py| py.check_signals().err());
        }
        match self.interrupt {
            Some(_) => ControlFlow::Break(()),
            None => ControlFlow::Continue(()),
        }
    }
}

/// A body that is shared.
pub(crate) type Body = Arc<Skeleton>;

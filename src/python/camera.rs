//! Cameras and rigs.

use std::path::PathBuf;
use std::sync::Arc;

use bundlemocap::io::formats::{Auto, Convention, Up, read_calibration, write_calibration};
use bundlemocap::io::wire::valid_name;
use bundlemocap::nalgebra::{Matrix3, Vector3};
use bundlemocap::{Lens, Nanos};
use pyo3::prelude::*;

use crate::arrays::{Array, array};
use crate::{error, warn_of};

/// A calibrated camera.
#[pyclass(frozen, module = "bundlemocap", from_py_object)]
#[derive(Clone)]
pub(crate) struct Camera(pub(crate) bundlemocap::Camera);

fn matrix(array: Array<f64>, name: &str) -> PyResult<Matrix3<f64>> {
    Ok(Matrix3::from_row_slice(&array.of_shape(name, &[3, 3])?))
}

fn rows<'py>(py: Python<'py>, matrix: &Matrix3<f64>) -> PyResult<Bound<'py, PyAny>> {
    array(py, matrix.transpose().iter().copied(), [3, 3])
}

/// Width and height, pixels.
pub(crate) fn image_size(size: [i64; 2]) -> PyResult<[u32; 2]> {
    let pixels = |size: i64| u32::try_from(size).ok().filter(|pixels| *pixels > 0);
    let wrong = || error(format!("size: give width and height in pixels, not {size:?}"));
    Ok([pixels(size[0]).ok_or_else(wrong)?, pixels(size[1]).ok_or_else(wrong)?])
}

#[pymethods]
impl Camera {
    #[new]
    #[pyo3(signature = (
        name, size, matrix, rotation, translation, distortion=None, fisheye=false, time_offset_ns=0
    ))]
    #[allow(clippy::too_many_arguments)] // Keywords in Python.
    fn new(
        name: String,
        size: [i64; 2],
        matrix: Array<f64>,
        rotation: Array<f64>,
        translation: Array<f64>,
        distortion: Option<Array<f64>>,
        fisheye: bool,
        time_offset_ns: i64,
    ) -> PyResult<Self> {
        valid_name(&name).map_err(|source| error(format!("name: {source}")))?;
        let size = image_size(size)?;
        let numbers = distortion.map_or(vec![0.0; 4], |array| array.numbers);
        let of = if fisheye { Lens::fisheye } else { Lens::brown_conrady };
        let lens = of(&numbers).map_err(error)?;
        let translation = Vector3::from_vec(translation.of_shape("translation", &[3])?);
        let (matrix, rotation) =
            (self::matrix(matrix, "matrix")?, self::matrix(rotation, "rotation")?);
        let camera = bundlemocap::Camera::new(name, size, &matrix, lens, rotation, translation);
        let mut camera = camera.map_err(error)?;
        camera.time_offset = Nanos::new(time_offset_ns);
        Ok(Self(camera))
    }

    #[getter]
    fn name(&self) -> &str {
        &self.0.name
    }

    #[getter]
    fn size(&self) -> (u32, u32) {
        (self.0.width, self.0.height)
    }

    #[getter]
    fn matrix<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        rows(py, &self.0.matrix())
    }

    #[getter]
    fn rotation<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        rows(py, &self.0.rotation)
    }

    #[getter]
    fn translation<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        array(py, self.0.translation.iter().copied(), [3])
    }

    #[getter]
    fn distortion<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        let numbers = self.0.lens().coefficients();
        array(py, numbers.iter().copied(), [numbers.len()])
    }

    #[getter]
    fn time_offset_ns(&self) -> i64 {
        self.0.time_offset.ns()
    }

    #[getter]
    fn is_fisheye(&self) -> bool {
        matches!(self.0.lens(), Lens::Fisheye(_))
    }

    /// Pixels (n x 2) of places (n x 3, metres); NaN where the camera cannot see one.
    fn project<'py>(&self, py: Python<'py>, points: Array<f64>) -> PyResult<Bound<'py, PyAny>> {
        if points.shape.len() != 2 || points.shape[1] != 3 {
            let given = points.shape;
            return Err(error(format!("points: give an array of n x 3 numbers, not {given:?}")));
        }
        let (count, numbers) = (points.shape[0], points.numbers);
        let pixels = numbers.chunks_exact(3).flat_map(|at| {
            let pixel = self.0.project(&Vector3::from_row_slice(at));
            pixel.map_or([f64::NAN; 2], Into::into)
        });
        array(py, pixels, [count, 2])?.call_method0("copy")
    }

    fn __repr__(&self) -> String {
        let camera = &self.0;
        format!("Camera({:?}, {} x {})", camera.name, camera.width, camera.height)
    }
}

/// The cameras of a calibration, in a world in metres with y up.
#[pyclass(frozen, module = "bundlemocap", from_py_object)]
#[derive(Clone)]
pub(crate) struct Rig(pub(crate) Arc<bundlemocap::Rig>);

impl Rig {
    /// The index of a camera, by name.
    pub(crate) fn index_of(&self, name: &str) -> PyResult<usize> {
        self.0.index_of(name).ok_or_else(|| {
            let known: Vec<&str> = self.0.cameras.iter().map(|camera| &*camera.name).collect();
            error(format!("the rig has no camera {name:?}; it has {}", known.join(", ")))
        })
    }
}

#[pymethods]
impl Rig {
    #[new]
    fn new(cameras: Vec<Camera>) -> PyResult<Self> {
        let cameras = cameras.into_iter().map(|camera| camera.0).collect();
        Ok(Self(Arc::new(bundlemocap::Rig::new(1, cameras).map_err(error)?)))
    }

    /// Reads a calibration of any kind that `bundlemocap rig --help` lists.
    #[staticmethod]
    #[pyo3(signature = (path, up="auto", unit="auto", poses="auto", set=None))]
    fn read(
        py: Python,
        path: PathBuf,
        up: &str,
        unit: &str,
        poses: &str,
        set: Option<String>,
    ) -> PyResult<Self> {
        let given = [("--up", up), ("--unit", unit), ("--poses", poses)];
        let up = up.parse().map_err(|what| error(format!("up: {what}")))?;
        let unit = unit.parse().map_err(|what| error(format!("unit: {what}")))?;
        let poses = poses.parse().map_err(|what| error(format!("poses: {what}")))?;
        let convention = Convention { up, unit, poses, set, ..Convention::default() };
        let mut calibration = read_calibration(&path, &convention).map_err(error)?;
        // They advise to give what was not.
        let is_given =
            |note: &str| given.iter().any(|(name, value)| *value != "auto" && note.contains(name));
        calibration.notes.retain(|note| !is_given(note));
        warn_of(py, &path.display().to_string(), &calibration.notes)?;
        Ok(Self(Arc::new(calibration.rig)))
    }

    /// Writes TOML in metres, as Pose2Sim has it.
    #[pyo3(signature = (path, up="z"))]
    fn write(&self, path: PathBuf, up: &str) -> PyResult<()> {
        let up: Auto<Up> = up.parse().map_err(|what| error(format!("up: {what}")))?;
        write_calibration(&path, &self.0, up.0.unwrap_or_default()).map_err(error)
    }

    #[getter]
    fn cameras(&self) -> Vec<Camera> {
        self.0.cameras.iter().cloned().map(Camera).collect()
    }

    fn __repr__(&self) -> String {
        format!("Rig of {} cameras", self.0.cameras.len())
    }
}

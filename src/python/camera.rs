//! Cameras and rigs.

use std::path::PathBuf;
use std::sync::Arc;

use bundlemocap::Lens;
use bundlemocap::io::formats::{Auto, Convention, Up, read_calibration, write_calibration};
use bundlemocap::nalgebra::{Matrix3, Vector3};
use numpy::{PyArray1, PyArray2, PyReadonlyArray1, PyReadonlyArray2, ToPyArray};
use pyo3::prelude::*;

use crate::error;

/// A calibrated camera.
#[pyclass(frozen, module = "bundlemocap", from_py_object)]
#[derive(Clone)]
pub(crate) struct Camera(pub(crate) bundlemocap::Camera);

/// A matrix of 3 x 3 numbers.
fn matrix(array: &PyReadonlyArray2<f64>, name: &str) -> PyResult<Matrix3<f64>> {
    let array = array.as_array();
    if array.dim() != (3, 3) {
        return Err(error(format!(
            "{name}: give an array of 3 x 3 numbers, not {:?}",
            array.dim()
        )));
    }
    Ok(Matrix3::from_fn(|row, column| array[(row, column)]))
}

fn rows<'py>(py: Python<'py>, matrix: &Matrix3<f64>) -> PyResult<Bound<'py, PyArray2<f64>>> {
    let rows: Vec<Vec<f64>> = (0..3).map(|row| matrix.row(row).iter().copied().collect()).collect();
    Ok(PyArray2::from_vec2(py, &rows)?)
}

#[pymethods]
impl Camera {
    #[new]
    #[pyo3(signature = (name, size, matrix, rotation, translation, distortion=None, fisheye=false))]
    fn new(
        name: String,
        size: [u32; 2],
        matrix: PyReadonlyArray2<f64>,
        rotation: PyReadonlyArray2<f64>,
        translation: PyReadonlyArray1<f64>,
        distortion: Option<Vec<f64>>,
        fisheye: bool,
    ) -> PyResult<Self> {
        let of = if fisheye { Lens::fisheye } else { Lens::brown_conrady };
        let lens = distortion.map_or(Ok(Lens::IDEAL), |numbers| of(&numbers)).map_err(error)?;
        let [x, y, z] = translation
            .as_array()
            .to_vec()
            .try_into()
            .map_err(|_| error("translation: give 3 numbers, metres"))?;
        let (matrix, rotation) =
            (self::matrix(&matrix, "matrix")?, self::matrix(&rotation, "rotation")?);
        let translation = Vector3::new(x, y, z);
        let camera = bundlemocap::Camera::new(name, size, &matrix, lens, rotation, translation);
        Ok(Self(camera.map_err(error)?))
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
    fn matrix<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        rows(py, &self.0.matrix())
    }

    #[getter]
    fn rotation<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        rows(py, &self.0.rotation)
    }

    #[getter]
    fn translation<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        self.0.translation.as_slice().to_pyarray(py)
    }

    #[getter]
    fn distortion<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        self.0.lens().coefficients().to_pyarray(py)
    }

    #[getter]
    fn is_fisheye(&self) -> bool {
        matches!(self.0.lens(), Lens::Fisheye(_))
    }

    /// Pixels (n x 2) of places (n x 3, metres); NaN where the camera cannot see one.
    fn project<'py>(
        &self,
        py: Python<'py>,
        points: PyReadonlyArray2<f64>,
    ) -> PyResult<Bound<'py, PyArray2<f64>>> {
        let points = points.as_array();
        if points.ncols() != 3 {
            return Err(error("points: give an array of n x 3 numbers, metres"));
        }
        let pixels = points.rows().into_iter().map(|at| {
            let pixel = self.0.project(&Vector3::new(at[0], at[1], at[2]));
            pixel.map_or(vec![f64::NAN; 2], |pixel| vec![pixel.x, pixel.y])
        });
        let pixels: Vec<f64> = pixels.flatten().collect();
        crate::motion::array(py, pixels, [points.nrows(), 2])
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
    #[pyo3(signature = (path, up="auto", unit="auto"))]
    fn read(path: PathBuf, up: &str, unit: &str) -> PyResult<Self> {
        let up = up.parse().map_err(|what| error(format!("up: {what}")))?;
        let unit = unit.parse().map_err(|what| error(format!("unit: {what}")))?;
        let convention = Convention { up, unit, ..Convention::default() };
        let calibration = read_calibration(&path, &convention).map_err(error)?;
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

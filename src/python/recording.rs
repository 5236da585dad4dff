//! Recordings as arrays.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use bundlemocap::io::recording::{Message, Provenance, Reader, Report, Writer};
use bundlemocap::io::wire::{TIMES_NS, Topics};
use bundlemocap::nalgebra::Point2;
use bundlemocap::{Detection, Detections, KeypointFormat, Person, Timestamp};
use pyo3::prelude::*;
use pyo3::types::{PyBytes, PyDict, PyMappingProxy};

use crate::arrays::{Array, Kept, array};
use crate::camera::{Rig, image_size};
use crate::{error, warn_of};

/// The detections of one camera over time.
#[pyclass(frozen, module = "bundlemocap")]
pub(crate) struct Keypoints {
    format: KeypointFormat,
    /// Of the images; `None`: that of the calibration.
    size: Option<[u32; 2]>,
    /// Sorted by capture time.
    frames: Vec<Frame>,
    points: Kept,
}

/// A frame of a camera.
struct Frame {
    capture: Timestamp,
    number: u64,
    people: Vec<Person>,
}

/// A format by name.
pub(crate) fn format_of(name: &str) -> PyResult<KeypointFormat> {
    KeypointFormat::from_name(name).ok_or_else(|| {
        let all = KeypointFormat::ALL.map(KeypointFormat::name).join(", ");
        error(format!("format {name:?} is not known; use {all}"))
    })
}

/// People from points x 3 numbers each: x, y (pixels) and confidence. A point is not seen if one of them is not
/// finite, or if the confidence is not above 0.
pub(crate) fn people(format: KeypointFormat, points: &[[f64; 3]]) -> Vec<Person> {
    let detection = |&[x, y, confidence]: &[f64; 3]| {
        // Messages have the numbers of 32 bits.
        let is_finite = [x, y, confidence].iter().all(|value| (*value as f32).is_finite());
        let is_seen = is_finite && confidence > 0.0;
        let pixel = Point2::new(x, y);
        is_seen.then(|| Detection { pixel, confidence: confidence.min(1.0) })
    };
    let person =
        |points: &[[f64; 3]]| Person { id: None, points: points.iter().map(detection).collect() };
    let people = points.chunks_exact(format.len()).map(person);
    people.filter(|person| person.points.iter().any(Option::is_some)).collect()
}

/// A capture time.
pub(crate) fn capture(ns: i64) -> PyResult<Timestamp> {
    let is_valid = TIMES_NS.contains(&ns);
    is_valid.then(|| Timestamp::from_ns(ns)).ok_or_else(|| {
        error(format!("time {ns} ns is not of the years 1684 to 2255; give nanoseconds since 1970"))
    })
}

/// The numbers of an array whose last two axes are points and x, y, confidence.
pub(crate) fn numbers(
    format: KeypointFormat,
    array: &Array<f64>,
    axes: &str,
) -> PyResult<Vec<[f64; 3]>> {
    let (shape, points) = (&array.shape, format.len());
    if !shape.ends_with(&[points, 3]) {
        let name = format.name();
        return Err(error(format!(
            "points: {name} needs an array of {axes} x {points} x 3 numbers (x, y, confidence), not {shape:?}"
        )));
    }
    Ok(array.numbers.as_chunks().0.to_vec())
}

#[pymethods]
impl Keypoints {
    #[new]
    #[pyo3(signature = (times_ns, points, format, *, frames=None, size=None))]
    fn new(
        times_ns: Array<i64>,
        points: Array<f64>,
        format: &str,
        frames: Option<Array<i64>>,
        size: Option<[i64; 2]>,
    ) -> PyResult<Self> {
        let format = format_of(format)?;
        let size = size.map(image_size).transpose()?;
        let (times, shape) = (times_ns.numbers, &points.shape);
        times.iter().try_for_each(|ns| capture(*ns).map(drop))?;
        if times_ns.shape.len() != 1 {
            return Err(error("times_ns: give an array of one axis"));
        }
        if !(3..=4).contains(&shape.len()) || shape[0] != times.len() {
            return Err(error(format!(
                "points: give frames (x people) x points x 3 numbers, with as many frames as times_ns ({}), not {shape:?}",
                times.len()
            )));
        }
        let all = numbers(format, &points, "frames (x people)")?;
        let of_frame = all.len().checked_div(times.len()).unwrap_or(0).max(1);
        let people = all.chunks(of_frame).map(|points| people(format, points));
        let people = people.chain(std::iter::repeat(Vec::new()));
        let given = frames.map(|frames| frames.of_shape("frames", &times_ns.shape)).transpose()?;
        if given.iter().flatten().any(|number| *number < 0) {
            return Err(error("frames: the numbers of images are not negative"));
        }
        let captures = times.into_iter().map(Timestamp::from_ns).zip(people);
        let frame = |(capture, people)| Frame { capture, number: 0, people };
        let mut frames: Vec<Frame> = captures.map(frame).collect();
        if let Some(numbers) = &given {
            let all = frames.iter_mut().zip(numbers);
            all.for_each(|(frame, number)| frame.number = number.cast_unsigned());
        }
        frames.sort_by_key(|frame| frame.capture);
        if given.is_none() {
            (0..).zip(&mut frames).for_each(|(number, frame)| frame.number = number);
        }
        Ok(Self { format, size, frames, points: Kept::default() })
    }

    #[getter]
    fn format(&self) -> &'static str {
        self.format.name()
    }

    #[getter]
    fn times_ns<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        array(py, self.frames.iter().map(|frame| frame.capture.ns()), [self.frames.len()])
    }

    #[getter]
    fn frames<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        let numbers = self.frames.iter().map(|frame| frame.number.cast_signed());
        array(py, numbers, [self.frames.len()])
    }

    #[getter]
    fn size(&self) -> Option<(u32, u32)> {
        self.size.map(Into::into)
    }

    #[getter]
    fn points<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        self.points.get(py, || {
            let most = self.frames.iter().map(|frame| frame.people.len()).max().unwrap_or(0);
            let points = self.format.len();
            let mut all = Vec::with_capacity(self.frames.len() * most * points * 3);
            for Frame { people, .. } in &self.frames {
                for person in 0..most {
                    for point in 0..points {
                        let found = people.get(person).and_then(|person| person.points[point]);
                        let numbers = found.map(|at| [at.pixel.x, at.pixel.y, at.confidence]);
                        all.extend(numbers.unwrap_or([f64::NAN, f64::NAN, 0.0]));
                    }
                }
            }
            array(py, all, [self.frames.len(), most, points, 3])
        })
    }

    fn __repr__(&self) -> String {
        format!("Keypoints({}, {} frames)", self.format.name(), self.frames.len())
    }
}

/// The calibration and the detections of a take.
#[pyclass(frozen, module = "bundlemocap")]
pub(crate) struct Recording {
    rig: Rig,
    /// By camera.
    keypoints: BTreeMap<String, Py<Keypoints>>,
}

#[pymethods]
impl Recording {
    #[new]
    fn new(rig: Rig, keypoints: &Bound<PyAny>) -> PyResult<Self> {
        let all = keypoints.py().get_type::<PyDict>().call1((keypoints,))?;
        let keypoints: BTreeMap<String, Py<Keypoints>> = all.extract()?;
        keypoints.keys().try_for_each(|name| rig.index_of(name).map(drop))?;
        Ok(Self { rig, keypoints })
    }

    /// Reads a recording (.mcap).
    #[staticmethod]
    fn read(py: Python, path: PathBuf) -> PyResult<Self> {
        let (rig, mut found, report) = py.detach(|| read(&path))?;
        let mut losses = report.losses();
        found.retain(|name, _| {
            let is_known = rig.0.index_of(name).is_some();
            if !is_known {
                losses.push(format!("no calibration of camera {name}; it is left out"));
            }
            is_known
        });
        warn_of(py, &path.display().to_string(), &losses)?;
        let keypoints =
            found.into_iter().map(|(name, keypoints)| Ok((name, Py::new(py, keypoints)?)));
        Ok(Self { rig, keypoints: keypoints.collect::<PyResult<_>>()? })
    }

    /// Writes a recording; a file that is there is replaced.
    pub(crate) fn write(&self, py: Python, path: PathBuf) -> PyResult<()> {
        py.detach(|| self.write_to(&path))
    }

    #[getter]
    fn rig(&self) -> Rig {
        self.rig.clone()
    }

    #[getter]
    fn keypoints<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyMappingProxy>> {
        let all = PyDict::new(py);
        for (name, keypoints) in &self.keypoints {
            all.set_item(name, keypoints.bind(py))?;
        }
        Ok(PyMappingProxy::new(py, all.as_mapping()))
    }

    fn __repr__(&self) -> String {
        format!("Recording of {} cameras", self.keypoints.len())
    }
}

impl Recording {
    fn write_to(&self, path: &Path) -> PyResult<()> {
        let provenance = Provenance::default();
        let mut writer = Writer::create(path, Topics::default(), &provenance).map_err(error)?;
        let mut all = Vec::new();
        for (name, keypoints) in &self.keypoints {
            let (camera, keypoints) = (self.rig.index_of(name)?, keypoints.get());
            let calibrated = &self.rig.0.cameras[camera];
            let size = keypoints.size.unwrap_or([calibrated.width, calibrated.height]);
            for Frame { capture, number, people } in &keypoints.frames {
                let (frame, capture, format) = (*number, *capture, keypoints.format);
                let people = people.clone();
                all.push((Detections { camera, frame, capture, format, people }, name, size));
            }
        }
        all.sort_by_key(|(detections, ..)| (detections.capture, detections.camera));
        let first = all.first().map_or_else(Timestamp::default, |(first, ..)| first.capture);
        writer.rig(&self.rig.0, first).map_err(error)?;
        for (detections, name, size) in &all {
            writer.keypoints(detections, name, *size).map_err(error)?;
        }
        writer.finish().map_err(error)
    }
}

/// A message: topic, capture time (ns), full name of the type, payload.
type Sent<'py> = (String, i64, String, Bound<'py, PyBytes>);

/// The messages of a recording, in the order of the file.
#[pyclass(module = "bundlemocap")]
pub(crate) struct Messages(Reader);

#[pymethods]
impl Messages {
    fn __iter__(this: PyRef<Self>) -> PyRef<Self> {
        this
    }

    fn __next__<'py>(&mut self, py: Python<'py>) -> PyResult<Option<Sent<'py>>> {
        let Some(entry) = py.detach(|| self.0.next_raw()) else {
            let file = self.0.path().display().to_string();
            return warn_of(py, &file, &self.0.report().losses()).map(|()| None);
        };
        let entry = entry.map_err(error)?;
        let payload = PyBytes::new(py, &entry.payload);
        let (topic, schema) = (entry.topic.to_string(), entry.schema.to_string());
        Ok(Some((topic, entry.publish_time.ns(), schema, payload)))
    }
}

/// The messages of a recording (.mcap): topic, capture time, type and payload of each.
#[pyfunction]
pub(crate) fn read_messages(path: PathBuf) -> PyResult<Messages> {
    Ok(Messages(Reader::open(path).map_err(error)?))
}

/// The rig and the keypoints of a file.
fn read(path: &Path) -> PyResult<(Rig, BTreeMap<String, Keypoints>, Report)> {
    let mut rig = None;
    let mut found = BTreeMap::<String, Keypoints>::new();
    // Why the keypoints of a camera are no arrays.
    let mut mixed = Vec::new();
    let mut reader = Reader::open(path).map_err(error)?;
    for entry in reader.by_ref() {
        match entry.map_err(error)?.message {
            Message::Rig(wire) => {
                let new = wire.to_core().map_err(error)?;
                if rig.as_ref().is_some_and(|rig| *rig != new) {
                    return Err(several(path, "calibrations"));
                }
                rig = Some(new);
            }
            Message::Keypoints(frame) => {
                let detections = frame.to_core(|_| Some(0)).map_err(error)?;
                let Detections { format, frame: number, capture, people, .. } = detections;
                let size = [frame.image_width, frame.image_height];
                let size = (!size.contains(&0)).then_some(size);
                let new =
                    || Keypoints { format, size, frames: Vec::new(), points: Kept::default() };
                let name = frame.camera.clone();
                let camera = found.entry(frame.camera).or_insert_with(new);
                camera.size = camera.size.or(size);
                if camera.format != format {
                    mixed.push((name, "keypoint formats of one camera"));
                } else if size.is_some() && camera.size != size {
                    mixed.push((name, "image sizes of one camera"));
                } else {
                    camera.frames.push(Frame { capture, number, people });
                }
            }
            _ => {}
        }
    }
    let none = || error(format!("{} holds no calibrated rig", path.display()));
    let rig = Rig(std::sync::Arc::new(rig.ok_or_else(none)?));
    // Cameras without a calibration are left out anyway.
    if let Some((_, what)) = mixed.iter().find(|(name, _)| rig.index_of(name).is_ok()) {
        return Err(several(path, what));
    }
    found.values_mut().for_each(|camera| camera.frames.sort_by_key(|frame| frame.capture));
    Ok((rig, found, reader.report().clone()))
}

fn several(path: &Path, what: &str) -> PyErr {
    error(format!("{} holds several {what}; give its path to `solve`", path.display()))
}

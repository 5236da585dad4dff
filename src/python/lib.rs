//! bundlemocap for Python: arrays in, arrays out. `bundlemocap/bundlemocap.pyi` describes the functions to users.

mod arrays;
mod camera;
mod motion;
mod recording;
mod tracker;

use std::ffi::OsString;

use bundlemocap::io::wire::SCHEMAS;
use bundlemocap::{Joint, KeypointFormat};
use pyo3::create_exception;
use pyo3::exceptions::PyException;
use pyo3::prelude::*;
use pyo3::types::{PyBytes, PyDict, PyList};

create_exception!(bundlemocap, Error, PyException, "Why something cannot be done, and the fix.");

/// A text for Python: options of the command, such as `--hold-out`, are arguments.
fn in_python(text: &str) -> String {
    let mut parts = text.split("--");
    let mut all = parts.next().unwrap_or_default().to_owned();
    for part in parts {
        // The name of a file may have dashes.
        if all.ends_with(|c: char| c.is_alphanumeric() || "-_".contains(c)) {
            all += "--";
            all += part;
            continue;
        }
        let rest = part.trim_start_matches(|c: char| c.is_ascii_lowercase() || c == '-');
        all += &part[..part.len() - rest.len()].replace('-', "_");
        all += rest;
    }
    all
}

/// The error for Python.
fn error(error: impl std::fmt::Display) -> PyErr {
    Error::new_err(in_python(&error.to_string()))
}

/// Warns of what may be wrong with a file, or was lost of it.
fn warn_of(py: Python, file: &str, what: &[String]) -> PyResult<()> {
    if what.is_empty() {
        return Ok(());
    }
    let text = format!("{file}: {}", in_python(&what.join("; ")));
    py.import("warnings")?.call_method1("warn", (text,)).map(drop)
}

/// The schemas of the messages, by full name: serialised `FileDescriptorSet`s.
#[pyfunction]
fn schemas(py: Python) -> PyResult<Bound<PyDict>> {
    let all = PyDict::new(py);
    for (name, descriptor) in SCHEMAS {
        all.set_item(name, PyBytes::new(py, descriptor))?;
    }
    Ok(all)
}

/// Runs the command of this process, as `bundlemocap` without Python does, and ends it.
#[pyfunction]
fn main(py: Python) -> PyResult<()> {
    let sys = py.import("sys")?;
    let words: Vec<OsString> = sys.getattr("argv")?.extract()?;
    // Python would only note an interrupt, and look at it when the command has ended.
    let signal = py.import("signal")?;
    signal.call_method1("signal", (signal.getattr("SIGINT")?, signal.getattr("SIG_DFL")?))?;
    let code = py.detach(|| bundlemocap::cli::run_with(words));
    sys.call_method1("exit", (code,)).map(drop)
}

/// bundlemocap: 2D keypoints of calibrated cameras in, smooth 3D poses out.
#[pymodule]
#[pyo3(name = "bundlemocap")]
fn bundlemocap_module(module: &Bound<PyModule>) -> PyResult<()> {
    let py = module.py();
    module.add("__version__", env!("CARGO_PKG_VERSION"))?;
    module.add("Error", py.get_type::<Error>())?;
    module.add("JOINTS", PyList::new(py, Joint::ALL.map(Joint::name))?)?;
    let parents = Joint::ALL.map(|joint| joint.parent().map_or(-1, |parent| parent.index() as i64));
    module.add("PARENTS", PyList::new(py, parents)?)?;
    let formats = PyDict::new(py);
    for format in KeypointFormat::ALL {
        let points: Vec<String> = format.keypoints().iter().map(ToString::to_string).collect();
        formats.set_item(format.name(), points)?;
    }
    module.add("FORMATS", formats)?;
    module.add_class::<camera::Camera>()?;
    module.add_class::<camera::Rig>()?;
    module.add_class::<recording::Keypoints>()?;
    module.add_class::<recording::Recording>()?;
    module.add_class::<recording::Messages>()?;
    module.add_class::<motion::Motion>()?;
    module.add_class::<motion::Solved>()?;
    module.add_class::<tracker::Tracker>()?;
    module.add_class::<tracker::Pose>()?;
    module.add_function(wrap_pyfunction!(recording::read_messages, module)?)?;
    module.add_function(wrap_pyfunction!(motion::read_motions, module)?)?;
    module.add_function(wrap_pyfunction!(motion::solve, module)?)?;
    module.add_function(wrap_pyfunction!(schemas, module)?)?;
    module.add_function(wrap_pyfunction!(main, module)?)?;
    Ok(())
}

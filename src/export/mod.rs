//! Poses for other tools, and the report.

mod bars;
mod bvh;
mod figures;
mod motion_file;
mod new_file;
mod plot;
mod report;

use std::path::PathBuf;

pub use bars::Bars;
pub use bvh::{BvhWriter, write_bvh};
pub use figures::{StickFigures, stick_figures};
pub use motion_file::HierarchyWriter;
pub use plot::{Plot, Series};
pub use report::{
    AngleTrack, CameraErrors, Picture, ReportData, Table, WindowRow, flexion_deg, write_report,
};

/// Why an export failed. Nothing is left behind: a file appears whole or not at all.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
#[allow(missing_docs)]
pub enum ExportError {
    #[error("{path}: cannot be written: {source}; check that the folder exists and has room")]
    Write { path: PathBuf, source: std::io::Error },
    #[error("{path}: pose {frame} holds a number that is not finite; leave lost poses out")]
    NotFinite { path: PathBuf, frame: usize },
    #[error("{path}: {fps} frames a second is no frame rate; give one above 0")]
    FrameRate { path: PathBuf, fps: f64 },
}

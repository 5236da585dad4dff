//! Marker trajectories of other programs, as a reference.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use nalgebra::Vector3;
use serde::Deserialize;
use thiserror::Error;

use super::point_names::keypoint_of;
use super::{c3d, trc};
use crate::core::detections::Keypoint;

/// Why a file of marker trajectories cannot be used.
#[derive(Debug, Error)]
#[allow(missing_docs)]
pub enum TrajectoryError {
    #[error("{path}: cannot be read: {source}")]
    Unreadable { path: PathBuf, source: std::io::Error },
    #[error("{path}: {source}")]
    InFile { path: PathBuf, source: Box<TrajectoryError> },
    #[error(
        "is neither a C3D file nor a TRC file, whose line 1 begins with PathFileType; give one of these"
    )]
    Unknown,
    #[error("line {line} is missing; a TRC file has {what} there")]
    TooShort { line: usize, what: &'static str },
    #[error("line {line}: no value for {field}: add it to lines 2 and 3")]
    NoField { line: usize, field: &'static str },
    #[error("{}units {units:?} are unknown; use m, cm or mm", line.map_or(String::new(), |line| format!("line {line}: ")))]
    Units { line: Option<usize>, units: String },
    #[error("line {line}: {cell:?} is not a number")]
    NotANumber { line: usize, cell: String },
    #[error("line {line}: {found} cells, but {markers} markers need at most {most}")]
    TooManyCells { line: usize, found: usize, markers: usize, most: usize },
    #[error("the C3D file ends before {what}; export it again")]
    ShortC3d { what: &'static str },
    #[error("the C3D file is of processor {found}, which is unknown; export it again")]
    Processor { found: u8 },
    #[error("no marker is a point of ours; it has {}. Name the markers of our points in a file: --markers FILE", names.join(", "))]
    NoPoint { names: Vec<String> },
    #[error("{what}")]
    Map { what: String },
}

/// Marker positions over time.
#[derive(Clone, Debug, PartialEq)]
pub struct Trajectories {
    /// Frame rate, hertz.
    pub frame_rate: f64,
    /// Number of row 0's frame in the recording. TRC: OrigDataStartFrame. C3D, which counts from 1: its first frame
    /// less 1.
    pub first_frame: u64,
    /// Names of the markers, in the order of the points.
    pub names: Vec<String>,
    /// The rows, evenly spaced.
    pub rows: Vec<Row>,
}

/// The markers of a frame.
#[derive(Clone, Debug, PartialEq)]
pub struct Row {
    /// The file's own frame number; tools begin at 0 or at 1.
    pub number: i64,
    /// Position of each marker, metres, y up; `None` if it is not known.
    pub points: Vec<Option<Vector3<f64>>>,
}

/// The markers of each of our points:
///
/// ```toml
/// [points]
/// left_knee = ["LFLE", "LFME"]   # their middle
/// left_hip = "LHJC"
/// ```
#[derive(Clone, Debug, PartialEq)]
pub struct MarkerMap {
    path: PathBuf,
    points: Vec<(Keypoint, Vec<String>)>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct MapFile {
    points: BTreeMap<String, Markers>,
}

#[derive(Deserialize)]
#[serde(untagged)]
enum Markers {
    One(String),
    Several(Vec<String>),
}

impl MarkerMap {
    /// Reads a file.
    ///
    /// # Errors
    /// It cannot be read, or a point is not ours.
    pub fn read(path: &Path) -> Result<Self, TrajectoryError> {
        let text = std::fs::read_to_string(path)
            .map_err(|source| TrajectoryError::Unreadable { path: path.into(), source })?;
        let fault = |what| TrajectoryError::Map { what }.in_file(path);
        let file: MapFile = toml::from_str(&text).map_err(|error| fault(error.to_string()))?;
        let mut points = Vec::new();
        for (name, markers) in file.points {
            let point = keypoint_of(&name);
            let point = point.ok_or_else(|| fault(format!("{name} is no point of ours")))?;
            let markers = match markers {
                Markers::One(marker) => vec![marker],
                Markers::Several(markers) => markers,
            };
            points.push((point, markers));
        }
        Ok(Self { path: path.into(), points })
    }
}

impl TrajectoryError {
    fn in_file(self, path: &Path) -> Self {
        Self::InFile { path: path.into(), source: Box::new(self) }
    }
}

impl Trajectories {
    /// Reads a TRC or a C3D file; which of them, is seen in its content. With a map, its points are the markers.
    ///
    /// # Errors
    /// The file is neither, is broken, or no marker is a point of ours.
    pub fn read(path: &Path, map: Option<&MarkerMap>) -> Result<Self, TrajectoryError> {
        let bytes = std::fs::read(path)
            .map_err(|source| TrajectoryError::Unreadable { path: path.into(), source })?;
        let read = if c3d::is_c3d(&bytes) {
            c3d::parse(&bytes)
        } else {
            trc::parse(&String::from_utf8_lossy(&bytes))
        };
        let read = read.map_err(|error| error.in_file(path))?;
        let named = map.map_or(Ok(read.clone()), |map| read.mapped(map, path))?;
        if named.names.iter().all(|name| keypoint_of(name).is_none()) {
            return Err(TrajectoryError::NoPoint { names: named.names }.in_file(path));
        }
        Ok(named)
    }

    /// The points of a map: each is the middle of its markers, where all are known.
    fn mapped(&self, map: &MarkerMap, path: &Path) -> Result<Self, TrajectoryError> {
        let mut columns = Vec::new();
        for (_, markers) in &map.points {
            let column = |marker: &String| {
                self.names.iter().position(|name| is_marker(name, marker)).ok_or_else(|| {
                    let names = self.names.join(", ");
                    let what = format!("{marker} is not in {}, which has {names}", path.display());
                    TrajectoryError::Map { what }.in_file(&map.path)
                })
            };
            columns.push(markers.iter().map(column).collect::<Result<Vec<_>, _>>()?);
        }
        let middle = |row: &Row, columns: &Vec<usize>| {
            let known = columns.iter().map(|column| row.points[*column]);
            let sum = known.sum::<Option<Vector3<f64>>>()?;
            (!columns.is_empty()).then(|| sum / columns.len() as f64)
        };
        let row = |row: &Row| Row {
            points: columns.iter().map(|columns| middle(row, columns)).collect(),
            ..*row
        };
        Ok(Self {
            names: map.points.iter().map(|(point, _)| point.to_string()).collect(),
            rows: self.rows.iter().map(row).collect(),
            ..*self
        })
    }

    /// Column of a keypoint.
    pub fn column_of(&self, keypoint: Keypoint) -> Option<usize> {
        self.names.iter().position(|name| keypoint_of(name) == Some(keypoint))
    }

    /// The markers at a place between rows, counted from row 0; `None` outside.
    pub fn at(&self, row: f64) -> Option<Vec<Option<Vector3<f64>>>> {
        let nearest = row.round();
        // Times are rounded.
        let row = if (row - nearest).abs() < 1e-3 { nearest } else { row };
        let share = row - row.floor();
        let index = (row >= 0.0).then_some(row.floor() as usize)?;
        let before = &self.rows.get(index)?.points;
        if share == 0.0 {
            return Some(before.clone());
        }
        let after = &self.rows.get(index + 1)?.points;
        Some(before.iter().zip(after).map(|(a, b)| Some((*a)?.lerp(&(*b)?, share))).collect())
    }
}

/// Whether a name in a file is that of a marker, with or without the performer's: `Anna:LKNE`.
fn is_marker(name: &str, marker: &str) -> bool {
    name == marker || name.split_once(':').is_some_and(|(_, own)| own == marker)
}

//! Marker trajectories of other programs, as a reference.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use nalgebra::Vector3;
use serde::Deserialize;
use thiserror::Error;

use super::point_names::keypoint_of;
use crate::core::calibration::LIMBS;
use crate::core::detections::Keypoint;

/// Why a file of marker trajectories cannot be used.
#[derive(Debug, Error)]
#[allow(missing_docs)]
#[non_exhaustive]
pub enum TrajectoryError {
    #[error("it has {one} and {other}, of two subjects; give a file of one subject")]
    Subjects { one: String, other: String },
    #[error("{path}: cannot be read: {source}")]
    Unreadable { path: PathBuf, source: std::io::Error },
    #[error("{path}: {source}")]
    InFile { path: PathBuf, source: Box<TrajectoryError> },
    #[error(
        "no C3D file, and no TRC file: line 1 does not begin with PathFileType; give one of these"
    )]
    Unknown,
    #[error("line {line} is missing; a TRC file has {what} there")]
    TooShort { line: usize, what: &'static str },
    #[error("line {line}: no value for {field}: add it to lines 2 and 3")]
    NoField { line: usize, field: &'static str },
    #[error("{place}: units {units:?} are unknown; use m, cm or mm")]
    Units { place: &'static str, units: String },
    #[error("line {line}: {cell:?} is not a number")]
    NotANumber { line: usize, cell: String },
    #[error("line {line}: {found} cells, but {markers} markers need at most {most}")]
    TooManyCells { line: usize, found: usize, markers: usize, most: usize },
    #[error("the C3D file has no {what}, or it is cut off; export it again")]
    NotInC3d { what: &'static str },
    #[error("processor {found} of the C3D file is unknown; export it for 84, 85 or 86")]
    Processor { found: u8 },
    #[error("the frame rate is {rate}, but must be 1 to 10000 Hz")]
    Rate { rate: f64 },
    #[error(
        "no marker has the name of a shoulder, elbow, wrist, hip, knee or ankle; name the markers of these points in a \
         file for --markers. The markers are {}", names.join(", ")
    )]
    NoPoint { names: Vec<String> },
    #[error("{what}")]
    Map { what: String },
}

/// Marker positions over time.
#[derive(Clone, Debug, PartialEq)]
pub struct Trajectories {
    /// Frame rate, hertz.
    pub frame_rate: f64,
    /// Number of row 0's frame, counted from 0 at the rate of the rows.
    pub first_frame: f64,
    /// Names of the markers, in the order of the points.
    pub names: Vec<String>,
    /// Position of each marker in each frame, metres, y up; `None` if it is not known. The frames are evenly spaced.
    pub rows: Vec<Vec<Option<Vector3<f64>>>>,
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
    points: BTreeMap<Keypoint, Vec<String>>,
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
    /// It cannot be read, a point is not ours or is there twice, or has no marker.
    pub fn read(path: &Path) -> Result<Self, TrajectoryError> {
        let text = std::fs::read_to_string(path)
            .map_err(|source| TrajectoryError::Unreadable { path: path.into(), source })?;
        let fault = |what| TrajectoryError::Map { what }.in_file(path);
        let file: MapFile =
            toml::from_str(&text).map_err(|error| fault(error.message().replace('\n', " ")))?;
        let mut points = BTreeMap::new();
        for (name, markers) in file.points {
            let point = keypoint_of(&name).ok_or_else(|| {
                fault(format!("{name} is no point of ours; use names such as left_knee"))
            })?;
            let markers = match markers {
                Markers::One(marker) => vec![marker],
                Markers::Several(markers) => markers,
            };
            if markers.is_empty() {
                return Err(fault(format!("{name} has no marker")));
            }
            if points.insert(point, markers).is_some() {
                return Err(fault(format!("there are two lines for the {point}")));
            }
        }
        Ok(Self { path: path.into(), points })
    }
}

impl TrajectoryError {
    pub(super) fn in_file(self, path: &Path) -> Self {
        Self::InFile { path: path.into(), source: Box::new(self) }
    }
}

impl Trajectories {
    /// The points of a map: each is the middle of its markers, where all are known.
    pub(super) fn mapped(&self, map: &MarkerMap, path: &Path) -> Result<Self, TrajectoryError> {
        let column = |marker: &String| {
            let found = self.column_named(marker);
            found.map_err(|what| {
                let what = format!(
                    "{marker} {what} {}, which has {}",
                    path.display(),
                    self.names.join(", ")
                );
                TrajectoryError::Map { what }.in_file(&map.path)
            })
        };
        let columns = map.points.values();
        let columns = columns.map(|markers| markers.iter().map(column).collect());
        let columns: Vec<Vec<usize>> = columns.collect::<Result<_, _>>()?;
        let row = |row: &Vec<Option<Vector3<f64>>>| {
            let middle = |columns: &Vec<usize>| {
                let sum =
                    columns.iter().map(|column| row[*column]).sum::<Option<Vector3<f64>>>()?;
                Some(sum / columns.len() as f64)
            };
            columns.iter().map(middle).collect()
        };
        Ok(Self {
            names: map.points.keys().map(Keypoint::to_string).collect(),
            rows: self.rows.iter().map(row).collect(),
            ..*self
        })
    }

    /// The column of a marker, with or without the performer's name: `Anna:LKNE`.
    fn column_named(&self, marker: &str) -> Result<usize, &'static str> {
        if let Some(column) = self.names.iter().position(|name| name == marker) {
            return Ok(column);
        }
        let mut plain =
            (0..self.names.len()).filter(|column| plain(&self.names[*column]) == marker);
        match (plain.next(), plain.next()) {
            (Some(column), None) => Ok(column),
            (Some(_), Some(_)) => Err("is the name of several markers in"),
            (None, _) => Err("is not in"),
        }
    }

    /// Checks the rate, and that a marker is a point that can be compared.
    pub(super) fn checked(self) -> Result<Self, TrajectoryError> {
        if !(1.0..=1e4).contains(&self.frame_rate) {
            return Err(TrajectoryError::Rate { rate: self.frame_rate });
        }
        match LIMBS.iter().any(|limb| self.column_of(*limb).is_some()) {
            true => Ok(self),
            false => Err(TrajectoryError::NoPoint { names: self.names }),
        }
    }

    /// Checks that the markers are those of one subject.
    pub(super) fn check_subject(&self) -> Result<(), TrajectoryError> {
        match LIMBS.iter().find_map(|limb| self.rivals(*limb)) {
            Some([one, other]) => Err(TrajectoryError::Subjects { one, other }),
            None => Ok(()),
        }
    }

    /// Two markers that are one keypoint of different subjects.
    fn rivals(&self, keypoint: Keypoint) -> Option<[String; 2]> {
        let is_it = |name: &&String| keypoint_of(plain(name)) == Some(keypoint);
        let mut all = self.names.iter().filter(is_it);
        let first = all.next()?;
        let of = |name: &str| name.split_once(':').map(|(subject, _)| subject.to_owned());
        let other = all.find(|name| of(name) != of(first))?;
        Some([first, other].map(Clone::clone))
    }

    /// Column of a keypoint.
    pub fn column_of(&self, keypoint: Keypoint) -> Option<usize> {
        self.names.iter().position(|name| keypoint_of(plain(name)) == Some(keypoint))
    }
}

/// A marker's name without the performer's.
fn plain(name: &str) -> &str {
    name.split_once(':').map_or(name, |(_, own)| own)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_marker_is_found_with_and_without_a_performers_name() {
        let names = ["Anna:LKNE", "LKNE", "Anna:LANK", "Ben:LANK", "Ben:left_hip"];
        let names: Vec<String> = names.iter().map(|name| (*name).to_owned()).collect();
        let read = Trajectories { frame_rate: 100.0, first_frame: 0.0, names, rows: Vec::new() };
        assert_eq!(read.column_named("LKNE"), Ok(1));
        assert_eq!(read.column_named("Anna:LKNE"), Ok(0));
        assert!(read.column_named("LANK").unwrap_err().contains("several"));
        assert!(read.column_named("LHIP").unwrap_err().contains("not in"));
        assert_eq!(read.column_of(Keypoint::LHip), Some(4));
        assert!(read.clone().checked().is_ok());
        let wrong =
            |rate: f64| Trajectories { frame_rate: rate, ..read.clone() }.checked().is_err();
        assert!([0.0, f64::NAN, f64::INFINITY, -1.0, 1e15].into_iter().all(wrong));
    }
}

//! TRC files: marker trajectories. Those of other programs are read as a reference.

use std::path::{Path, PathBuf};

use nalgebra::Vector3;
use thiserror::Error;

use super::point_names::keypoint_of;
use super::{ExportError, Unit, Up};
use crate::core::detections::Keypoint;
use crate::io::new_file;

/// Why a TRC file cannot be used.
#[derive(Debug, Error)]
#[allow(missing_docs)]
pub enum TrcError {
    #[error("{path}: cannot be read: {source}")]
    Unreadable { path: PathBuf, source: std::io::Error },
    #[error("{path}: {source}")]
    InFile { path: PathBuf, source: Box<TrcError> },
    #[error("line 1 does not begin with PathFileType; give a TRC file")]
    NotTrc,
    #[error("line {line} is missing; a TRC file has {what} there")]
    TooShort { line: usize, what: &'static str },
    #[error("line {line}: no value for {field}: add it to lines 2 and 3")]
    NoField { line: usize, field: &'static str },
    #[error("line {line}: units {units:?} are unknown; use m, cm or mm")]
    Units { line: usize, units: String },
    #[error("line {line}: {cell:?} is not a number")]
    NotANumber { line: usize, cell: String },
    #[error("line {line}: {found} cells, but {markers} markers need at most {most}")]
    TooManyCells { line: usize, found: usize, markers: usize, most: usize },
}

/// Marker positions over time.
#[derive(Clone, Debug, PartialEq)]
pub struct Trc {
    /// Frame rate, hertz.
    pub frame_rate: f64,
    /// Frame number of row 0 in the original recording (OrigDataStartFrame).
    pub first_frame: u64,
    /// Names of the markers, in the order of the points.
    pub names: Vec<String>,
    /// The rows.
    pub rows: Vec<TrcRow>,
}

/// One row of a TRC file.
#[derive(Clone, Debug, PartialEq)]
pub struct TrcRow {
    /// The file's frame number; tools begin at 0 or at 1.
    pub number: i64,
    /// The file's time, seconds.
    pub seconds: f64,
    /// Position of each marker, metres; `None` if a cell is empty or not finite.
    pub points: Vec<Option<Vector3<f64>>>,
}

impl Trc {
    /// Reads a file.
    pub fn read(path: &Path) -> Result<Self, TrcError> {
        let text = std::fs::read_to_string(path)
            .map_err(|source| TrcError::Unreadable { path: path.into(), source })?;
        Self::parse(&text)
            .map_err(|source| TrcError::InFile { path: path.into(), source: Box::new(source) })
    }

    /// Parses the text of a file.
    pub fn parse(text: &str) -> Result<Self, TrcError> {
        let lines: Vec<&str> = text.lines().collect();
        if !lines.first().is_some_and(|line| line.trim_start().starts_with("PathFileType")) {
            return Err(TrcError::NotTrc);
        }
        let line = |line: usize, what| {
            lines.get(line - 1).copied().ok_or(TrcError::TooShort { line, what })
        };
        let header = Header {
            fields: line(2, "the header's field names")?.split('\t').map(str::trim).collect(),
            values: line(3, "the header's values")?.split('\t').map(str::trim).collect(),
        };
        let metres = header.metres()?;
        let names = marker_names(line(4, "the markers' names")?);
        line(5, "the axes")?;
        let rows = (lines.iter().enumerate().skip(5))
            .filter(|(_, text)| !text.trim().is_empty())
            .map(|(index, text)| row(index + 1, text, names.len(), metres))
            .collect::<Result<_, _>>()?;
        let first_frame = header.number("OrigDataStartFrame")?.max(0.0) as u64;
        Ok(Self { frame_rate: header.number("DataRate")?, first_frame, names, rows })
    }

    /// Column of a keypoint.
    pub fn column_of(&self, keypoint: Keypoint) -> Option<usize> {
        self.names.iter().position(|name| keypoint_of(name) == Some(keypoint))
    }
}

struct Header<'a> {
    fields: Vec<&'a str>,
    values: Vec<&'a str>,
}

impl Header<'_> {
    fn value(&self, field: &'static str) -> Result<&str, TrcError> {
        let column = self.fields.iter().position(|&name| name == field);
        let value = column.and_then(|column| self.values.get(column));
        value.copied().ok_or(TrcError::NoField { line: 3, field })
    }

    fn number(&self, field: &'static str) -> Result<f64, TrcError> {
        let value = self.value(field)?;
        value.parse().map_err(|_| TrcError::NotANumber { line: 3, cell: value.into() })
    }

    /// Length of the file's unit in metres.
    fn metres(&self) -> Result<f64, TrcError> {
        match self.value("Units")? {
            "m" => Ok(1.0),
            "cm" => Ok(1e-2),
            "mm" => Ok(1e-3),
            units => Err(TrcError::Units { line: 3, units: units.into() }),
        }
    }
}

/// Names are in every third cell from the third on; cells after the last name are empty.
fn marker_names(line: &str) -> Vec<String> {
    let names: Vec<String> =
        line.split('\t').skip(2).step_by(3).map(|name| name.trim().to_owned()).collect();
    let used = names.iter().rposition(|name| !name.is_empty()).map_or(0, |last| last + 1);
    names[..used].to_vec()
}

fn row(line: usize, text: &str, markers: usize, metres: f64) -> Result<TrcRow, TrcError> {
    let cells: Vec<&str> = text.split('\t').map(str::trim).collect();
    let found = cells.iter().rposition(|cell| !cell.is_empty()).map_or(0, |last| last + 1);
    let most = 2 + 3 * markers;
    if found > most {
        return Err(TrcError::TooManyCells { line, found, markers, most });
    }
    let number = |column: usize| -> Result<f64, TrcError> {
        let cell = cells.get(column).copied().unwrap_or_default();
        if cell.is_empty() {
            return Ok(f64::NAN);
        }
        cell.parse().map_err(|_| TrcError::NotANumber { line, cell: cell.into() })
    };
    let point = |marker: usize| -> Result<Option<Vector3<f64>>, TrcError> {
        let first = 2 + 3 * marker;
        let at = Vector3::new(number(first)?, number(first + 1)?, number(first + 2)?) * metres;
        Ok(at.iter().all(|c| c.is_finite()).then_some(at))
    };
    let points = (0..markers).map(point).collect::<Result<_, _>>()?;
    Ok(TrcRow { number: number(0)? as i64, seconds: number(1)?, points })
}

/// Markers over time, to be written.
#[derive(Clone, Debug)]
pub struct Markers<'a> {
    /// Frame rate, hertz.
    pub fps: f64,
    /// The unit of the file.
    pub unit: Unit,
    /// The axis of the places that points up.
    pub up: Up,
    /// Names without tabs.
    pub names: &'a [String],
    /// Frames, evenly spaced: each marker's place in metres; `None` where it is not known.
    pub frames: &'a [Vec<Option<Vector3<f64>>>],
}

/// Writes a TRC file. Frames count from 1, times from 0.
///
/// # Errors
/// The disk is full, the rate is not above 0, or a place is not finite.
pub fn write_trc(path: &Path, markers: &Markers) -> Result<(), ExportError> {
    let Markers { fps, unit, names, frames, .. } = markers;
    if !(fps.is_finite() && *fps > 0.0) {
        return Err(ExportError::FrameRate { path: path.into(), fps: *fps });
    }
    let file = path.file_name().unwrap_or_default().to_string_lossy();
    let (count, of_names, rate) = (frames.len(), names.len(), (fps * 1e4).round() / 1e4);
    let mut text = format!(
        "PathFileType\t4\t(X/Y/Z)\t{file}\n\
         DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames\n\
         {rate}\t{rate}\t{count}\t{of_names}\t{unit}\t{rate}\t1\t{count}\nFrame#\tTime\t{}\n\t",
        names.join("\t\t\t")
    );
    for marker in 1..=of_names {
        text += &format!("\tX{marker}\tY{marker}\tZ{marker}");
    }
    text += "\n\n";
    for (frame, places) in frames.iter().enumerate() {
        text += &format!("{}\t{:.6}", frame + 1, frame as f64 / fps);
        for place in places {
            match place {
                Some(at) if at.iter().all(|value| value.is_finite()) => {
                    let at = at / unit.metres();
                    text += &format!("\t{:.6}\t{:.6}\t{:.6}", at.x, at.y, at.z);
                }
                Some(_) => return Err(ExportError::NotFinite { path: path.into(), frame }),
                None => text += "\t\t\t",
            }
        }
        text.push('\n');
    }
    new_file::write(path, text.as_bytes()).map_err(ExportError::write(path))
}

#[cfg(test)]
mod tests {
    use super::*;

    const FILE: &str = "PathFileType\t4\t(X/Y/Z)\ta.trc\n\
        DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames\n\
        60\t60\t3\t3\tmm\t60\t7\t3\n\
        Frame#\tTime\tRHip\t\t\tLHip\t\t\tmystery\t\t\t\n\
        \t\tX1\tY1\tZ1\tX2\tY2\tZ2\tX3\tY3\tZ3\n\
        \n\
        1\t0.0166\t1000\t0\t0\t1200\t0\t0\t1\t2\t3\n\
        2\t0.0333\t1000\t0\t0\t\t\t\t1\t2\t3\n\
        3\t0.0500\t1000\t0\t0\t1200\tnan\t0\n";

    #[test]
    fn units_missing_cells_and_unknown_markers_are_handled() {
        let trc = Trc::parse(FILE).unwrap();
        assert_eq!((trc.frame_rate, trc.first_frame, trc.rows.len()), (60.0, 7, 3));
        assert_eq!(trc.names, ["RHip", "LHip", "mystery"]);
        assert_eq!(trc.rows[0].points[1], Some(Vector3::new(1.2, 0.0, 0.0)));
        assert_eq!(trc.rows[1].points[1], None);
        assert_eq!(trc.rows[2].points[1..], [None, None]);
        assert_eq!(trc.column_of(Keypoint::LHip), Some(1));
        assert_eq!(trc.column_of(Keypoint::Nose), None);
    }

    #[test]
    fn errors_name_the_line() {
        let message = |text: &str| Trc::parse(text).unwrap_err().to_string();
        assert!(message("hello").contains("PathFileType"));
        assert!(message(&FILE.replace("mm", "inch")).contains("line 3: units \"inch\""));
        assert!(message(&FILE.replace("0.0333", "soon")).contains("line 8: \"soon\""));
        assert!(message(&FILE.replace("DataRate\tC", "Rate\tC")).contains("DataRate"));
        assert!(message(&FILE.replace("nan\t0\n", "0\t0\t1\t2\t3\t9\n")).contains("line 9: 12"));
        assert!(message("PathFileType\t4\n").contains("line 2"));
        let absent = Trc::read(Path::new("no/such.trc")).unwrap_err().to_string();
        assert!(absent.contains("no/such.trc"), "{absent}");
    }
}

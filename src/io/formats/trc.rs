//! TRC files: marker trajectories.

use std::path::Path;

use nalgebra::Vector3;

use super::trajectories::{Trajectories, TrajectoryError};
use super::{ExportError, Unit, Up};
use crate::io::new_file;

/// A time this near to a frame is that of the frame, periods: files may have milliseconds.
const ON_FRAME: f64 = 0.25;

/// Parses the text of a file.
pub(super) fn parse(text: &str) -> Result<Trajectories, TrajectoryError> {
    let lines: Vec<&str> = text.lines().collect();
    if !lines.first().is_some_and(|line| line.trim_start().starts_with("PathFileType")) {
        return Err(TrajectoryError::Unknown);
    }
    let line = |line: usize, what| {
        lines.get(line - 1).copied().ok_or(TrajectoryError::TooShort { line, what })
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
    let frame_rate = header.number("DataRate")?;
    // The first frame counts at the original rate.
    let original = header.number("OrigDataRate").ok().filter(|rate| *rate >= 1.0);
    let mut first_frame = header.number("OrigDataStartFrame")?.clamp(0.0, 1e9);
    // Most programs count from 1: frame 1 is at the time 0.
    let first = lines.iter().skip(5).find_map(|text| number_and_time(text));
    if let Some((number, time)) = first
        && first_frame >= 1.0
        && number == first_frame
        && (time * frame_rate - (number - 1.0)).abs() < ON_FRAME
    {
        first_frame -= 1.0;
    }
    let first_frame = first_frame * original.map_or(1.0, |original| frame_rate / original);
    Ok(Trajectories { frame_rate, first_frame, names, rows })
}

struct Header<'a> {
    fields: Vec<&'a str>,
    values: Vec<&'a str>,
}

impl Header<'_> {
    fn value(&self, field: &'static str) -> Result<&str, TrajectoryError> {
        let column = self.fields.iter().position(|&name| name == field);
        let value = column.and_then(|column| self.values.get(column));
        value.copied().ok_or(TrajectoryError::NoField { line: 3, field })
    }

    fn number(&self, field: &'static str) -> Result<f64, TrajectoryError> {
        let value = self.value(field)?;
        let number = value.parse().ok().filter(|number: &f64| number.is_finite());
        number.ok_or_else(|| TrajectoryError::NotANumber { line: 3, cell: value.into() })
    }

    /// Length of the file's unit in metres.
    fn metres(&self) -> Result<f64, TrajectoryError> {
        match self.value("Units")? {
            "m" => Ok(1.0),
            "cm" => Ok(1e-2),
            "mm" => Ok(1e-3),
            units => Err(TrajectoryError::Units { place: "line 3", units: units.into() }),
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

/// The frame number and the time of a row, seconds.
fn number_and_time(row: &str) -> Option<(f64, f64)> {
    let mut cells = row.split('\t').map(|cell| cell.trim().parse().ok());
    Some((cells.next()??, cells.next()??))
}

fn row(
    line: usize,
    text: &str,
    markers: usize,
    metres: f64,
) -> Result<Vec<Option<Vector3<f64>>>, TrajectoryError> {
    let cells: Vec<&str> = text.split('\t').map(str::trim).collect();
    let found = cells.iter().rposition(|cell| !cell.is_empty()).map_or(0, |last| last + 1);
    let most = 2 + 3 * markers;
    if found > most {
        return Err(TrajectoryError::TooManyCells { line, found, markers, most });
    }
    let number = |column: usize| -> Result<f64, TrajectoryError> {
        let cell = cells.get(column).copied().unwrap_or_default();
        if cell.is_empty() {
            return Ok(f64::NAN);
        }
        cell.parse().map_err(|_| TrajectoryError::NotANumber { line, cell: cell.into() })
    };
    let point = |marker: usize| -> Result<Option<Vector3<f64>>, TrajectoryError> {
        let first = 2 + 3 * marker;
        let at = Vector3::new(number(first)?, number(first + 1)?, number(first + 2)?) * metres;
        // Some programs write zeros for places that are not known.
        let is_known = at.iter().all(|c| c.is_finite()) && at != Vector3::zeros();
        Ok(is_known.then_some(at))
    };
    (0..markers).map(point).collect()
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

/// Writes a TRC file. Frames count from 1, times from 0. A place that is not known is `nan`: OpenSim's tables drop empty
/// cells at the end of a row.
///
/// # Errors
/// The disk is full, the rate is not above 0, or a place is not finite.
pub fn write_trc(path: &Path, markers: &Markers) -> Result<(), ExportError> {
    let Markers { fps, unit, names, frames, .. } = markers;
    ExportError::check_rate(path, *fps)?;
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
                None => text += "\tnan\tnan\tnan",
            }
        }
        text.push('\n');
    }
    new_file::write(path, text.as_bytes()).map_err(ExportError::write(path))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::core::detections::Keypoint;

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
        let trc = parse(FILE).unwrap();
        assert_eq!((trc.frame_rate, trc.first_frame, trc.rows.len()), (60.0, 7.0, 3));
        assert_eq!(trc.names, ["RHip", "LHip", "mystery"]);
        assert_eq!(trc.rows[0][1], Some(Vector3::new(1.2, 0.0, 0.0)));
        assert_eq!(trc.rows[1][1], None);
        assert_eq!(trc.rows[2][1..], [None, None]);
        let zeros = FILE.replace("1000\t0\t0\t\t\t\t1", "1000\t0\t0\t0\t0\t0\t1");
        assert_eq!(parse(&zeros).unwrap().rows[1][1], None, "a gap of zeros");
        assert_eq!(trc.column_of(Keypoint::LHip), Some(1));
        assert_eq!(trc.column_of(Keypoint::Nose), None);
        // A program that counts frames from 1 and times from 0.
        let cut = FILE.replace("\t7\t3\n", "\t1\t3\n");
        assert_eq!(parse(&cut).unwrap().first_frame, 1.0);
        let from_1 = cut.replace("0.0166", "0.0000");
        assert_eq!(parse(&from_1).unwrap().first_frame, 0.0);
    }

    #[test]
    fn errors_name_the_line() {
        let message = |text: &str| parse(text).unwrap_err().to_string();
        assert!(message("hello").contains("PathFileType"));
        assert!(message(&FILE.replace("mm", "inch")).contains("line 3: units \"inch\""));
        assert!(message(&FILE.replace("1200", "far")).contains("line 7: \"far\""));
        assert!(message(&FILE.replace("DataRate\tC", "Rate\tC")).contains("DataRate"));
        assert!(message(&FILE.replace("nan\t0\n", "0\t0\t1\t2\t3\t9\n")).contains("line 9: 12"));
        assert!(message("PathFileType\t4\n").contains("line 2"));
    }
}

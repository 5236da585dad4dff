//! Reads one OpenPose JSON file.

use std::path::Path;

use nalgebra::Point2;
use serde::Deserialize;

use super::CameraReport;
use crate::core::detections::{Detection, KeypointFormat, Person};
use crate::io::formats::ImportError;

/// The parts of the file that are used.
#[derive(Deserialize)]
#[serde(rename = "frame")]
struct FrameFile {
    people: Option<Vec<RawPerson>>,
}

#[derive(Deserialize)]
#[serde(rename = "person")]
struct RawPerson {
    /// \[-1\] if the detector does not track.
    #[serde(default)]
    person_id: serde_json::Value,
    /// x, y, confidence of each point. `None` is a number that is not finite.
    pose_keypoints_2d: Option<Vec<Option<f64>>>,
}

/// The people of a file; tolerated faults are counted in the report.
///
/// # Errors
/// The text is not from OpenPose, or the keypoints do not fit the format.
pub(super) fn people(
    path: &Path,
    bytes: &[u8],
    format: KeypointFormat,
    report: &mut CameraReport,
) -> Result<Vec<Person>, ImportError> {
    let bytes = bytes.strip_prefix(b"\xef\xbb\xbf").unwrap_or(bytes).trim_ascii();
    if bytes.is_empty() {
        report.empty_files += 1;
        return Ok(Vec::new());
    }
    let raw = parse(path, bytes)?;
    let mut people = Vec::with_capacity(raw.len());
    for (index, raw) in raw.into_iter().enumerate() {
        let numbers = raw.pose_keypoints_2d.unwrap_or_default();
        if !numbers.is_empty() && numbers.len() != 3 * format.len() {
            return Err(point_count(path, index, numbers.len(), format));
        }
        let points: Vec<_> = numbers.chunks_exact(3).map(|p| detection(p, report)).collect();
        if points.iter().all(Option::is_none) {
            report.people_without_points += 1;
            continue;
        }
        people.push(Person { id: id(&raw.person_id), points });
    }
    report.people += people.len() as u64;
    Ok(people)
}

fn parse(path: &Path, bytes: &[u8]) -> Result<Vec<RawPerson>, ImportError> {
    let fault = |what: String| ImportError::NotOpenpose { path: path.to_owned(), what };
    let parsed = match serde_json::from_slice::<FrameFile>(bytes) {
        Err(e) if e.is_syntax() => serde_json::from_slice(&without_non_finite(bytes)),
        other => other,
    };
    let file = parsed.map_err(|e| match e.classify() {
        serde_json::error::Category::Data => fault(format!("not OpenPose's JSON ({e})")),
        _ => fault(format!("not valid JSON ({e})")),
    })?;
    file.people.ok_or_else(|| fault("not OpenPose's JSON (no list \"people\")".into()))
}

/// Python writes NaN, Infinity and -Infinity, which are not JSON; replaces them by null.
fn without_non_finite(bytes: &[u8]) -> Vec<u8> {
    const WORDS: [&[u8]; 3] = [b"-Infinity", b"Infinity", b"NaN"];
    let mut out = Vec::with_capacity(bytes.len());
    let (mut at, mut in_string) = (0, false);
    while at < bytes.len() {
        let rest = &bytes[at..];
        let word = WORDS.into_iter().find(|w| !in_string && rest.starts_with(w));
        let taken = match word {
            Some(word) => {
                out.extend_from_slice(b"null");
                word.len()
            }
            None => {
                let taken = if in_string && rest[0] == b'\\' { rest.len().min(2) } else { 1 };
                in_string ^= rest[0] == b'"';
                out.extend_from_slice(&rest[..taken]);
                taken
            }
        };
        at += taken;
    }
    out
}

/// A point. OpenPose writes unseen points as 0, 0 or with a confidence that is not positive.
fn detection(point: &[Option<f64>], report: &mut CameraReport) -> Option<Detection> {
    let [Some(x), Some(y), Some(confidence)] = *point else {
        report.non_finite_points += 1;
        return None;
    };
    if confidence <= 0.0 || (x == 0.0 && y == 0.0) {
        return None;
    }
    report.points += 1;
    report.clamped_confidences += u64::from(confidence > 1.0);
    Some(Detection { pixel: Point2::new(x, y), confidence: confidence.min(1.0) })
}

/// The detector's id, `[7]` or `7`; negative means none.
fn id(value: &serde_json::Value) -> Option<i64> {
    let first = value.get(0).unwrap_or(value);
    first.as_i64().filter(|id| *id >= 0)
}

fn point_count(path: &Path, person: usize, found: usize, format: KeypointFormat) -> ImportError {
    let fitting: Vec<_> = KeypointFormat::ALL
        .into_iter()
        .filter(|f| 3 * f.len() == found)
        .map(KeypointFormat::name)
        .collect();
    let fits = if fitting.is_empty() {
        "no known format has that length".to_owned()
    } else {
        format!("that length fits {}", fitting.join(" or "))
    };
    ImportError::PointCount { path: path.to_owned(), person, found, format, fits }
}

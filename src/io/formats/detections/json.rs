//! JSON of detectors: the frames of a file and the people of a frame, in the shapes that are in use.
//!
//! | written by | frame | person |
//! |---|---|---|
//! | OpenPose, Pose2Sim | `{"people": [...]}` | `pose_keypoints_2d`: x, y, c of each point |
//! | MMPose | `{"instances": [...]}`, `{"instance_info": [{"frame_id", "instances"}]}` or a list | `keypoints`: x, y of each point, and `keypoint_scores` |
//! | AlphaPose, COCO results | a list for all frames, with `image_id` | `keypoints`: x, y, c of each point |
//! | AlphaPose `--format cmu` and `open` | `{"0.jpg": {"bodies": [...]}}` or `"people"` | `joints` or `pose_keypoints_2d` |
//! | Ultralytics YOLO | a list | `keypoints`: `x`, `y`, `visible` |
//! | MediaPipe | `landmarks`, or a list of points | `x`, `y` as shares of the image, `visibility` |

use std::collections::BTreeMap;

use serde_json::Value;

use super::folders::frame_numbers;
use super::{BOM, CameraReport, RawPerson, table};
use crate::core::detections::Detection;

/// Fields of a frame that hold its people.
const PEOPLE: [&str; 7] =
    ["people", "instances", "bodies", "annots", "pose_landmarks", "landmarks", "instance_info"];
/// Fields of a person that hold its points.
const POINTS: [&str; 5] =
    ["pose_keypoints_2d", "keypoints", "joints", "pose_landmarks", "landmarks"];
/// Fields of a person that hold its id.
const IDS: [&str; 5] = ["person_id", "personID", "track_id", "idx", "id"];

/// A larger number is in pixels. If fewer than half of a person's points have one, all are shares of the image.
const SHARE: f64 = 3.0;

/// Parses JSON, also with NaN and Infinity, which Python writes.
pub(super) fn parse(bytes: &[u8]) -> Result<Value, String> {
    let bytes = bytes.strip_prefix(BOM).unwrap_or(bytes);
    let parsed = match serde_json::from_slice(bytes) {
        Err(error) if error.is_syntax() => serde_json::from_slice(&without_non_finite(bytes)),
        other => other,
    };
    parsed.map_err(|error| format!("not valid JSON ({error})"))
}

/// Replaces NaN, Infinity and -Infinity, which are not JSON, by null.
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

/// The frames of a file that holds all frames of a camera; `None` if it holds one frame.
pub(super) fn frames(file: &Value) -> Option<BTreeMap<u64, Vec<&Value>>> {
    let mut frames = BTreeMap::<u64, Vec<&Value>>::new();
    // MMPose counts from 1.
    if let Some(all) = frames_of_mmpose(file) {
        let number = |frame: &Value| frame.get("frame_id")?.as_u64();
        let first = u64::from(!all.iter().any(|frame| number(frame) == Some(0)));
        for frame in all {
            let number = number(frame)? - first;
            frames.entry(number).or_default().push(frame);
        }
        return Some(frames);
    }
    match file {
        // Nobody was seen at all.
        Value::Array(all) if all.is_empty() => {}
        Value::Array(all) if all.iter().any(|one| one.get("image_id").is_some()) => {
            let ids = || all.iter().map(|person| person.get("image_id"));
            let names = ids().filter_map(|id| id?.as_str());
            let mut named = frame_numbers(names).into_iter();
            for (person, id) in all.iter().zip(ids()) {
                let number = if id?.is_string() { named.next()?? } else { id?.as_u64()? };
                frames.entry(number).or_default().push(person);
            }
        }
        // A list of frames: each is a list of people, or has them in a field.
        Value::Array(all) if all.iter().any(|one| holds_people(one) || is_list(one)) => {
            for (i, frame) in all.iter().enumerate() {
                let numbers = frame.as_object().into_iter().flatten();
                let mut numbers =
                    numbers.filter(|(name, _)| table::FRAME.contains(&&*table::plain(name)));
                let number = numbers.find_map(|(_, number)| number.as_u64());
                frames.entry(number.unwrap_or(i as u64)).or_default().push(frame);
            }
        }
        Value::Object(all) if all.values().any(holds_people) && !holds_people(file) => {
            let numbers = frame_numbers(all.keys().map(String::as_str));
            for (number, frame) in numbers.into_iter().zip(all.values()) {
                frames.entry(number?).or_default().push(frame);
            }
        }
        _ => return None,
    }
    Some(frames)
}

fn holds_people(frame: &Value) -> bool {
    PEOPLE.iter().any(|field| frame.get(field).is_some_and(Value::is_array))
}

/// Whether it is a list of people or of landmarks.
fn is_list(frame: &Value) -> bool {
    let is_entry = |one: &Value| points(one).is_some() || one.get("visibility").is_some();
    frame.as_array().is_some_and(|all| all.iter().any(is_entry))
}

/// The frames of a video. The results of an image have people there.
fn frames_of_mmpose(file: &Value) -> Option<&Vec<Value>> {
    let all = file.get("instance_info")?.as_array()?;
    all.iter().any(|one| one.get("frame_id").is_some()).then_some(all)
}

/// Whether a file is a whole take's for sure, even if it is not alone in its folder.
pub(super) fn is_take(file: &Value) -> bool {
    let has_image = |all: &Vec<Value>| all.iter().any(|one| one.get("image_id").is_some());
    frames_of_mmpose(file).is_some() || file.as_array().is_some_and(has_image)
}

fn points(person: &Value) -> Option<&Value> {
    POINTS.iter().find_map(|field| person.get(field)).filter(|value| !value.is_null())
}

/// The people of a frame, in pixels of an image of that size.
///
/// # Errors
/// It holds no list of people, or a person's points are not numbers.
pub(super) fn people(
    frame: &Value,
    size: [u32; 2],
    report: &mut CameraReport,
) -> Result<Vec<RawPerson>, String> {
    if frame.is_null() {
        return Ok(Vec::new());
    }
    let of_field = PEOPLE.iter().find_map(|field| frame.get(field));
    let list = match (of_field, frame) {
        (Some(Value::Null), _) => return Ok(Vec::new()),
        (Some(list), _) => list,
        // A person by itself, as in lists with image_id.
        (None, person) if points(person).is_some() => {
            return Ok(vec![self::person(person, size, report)?]);
        }
        (None, list) => list,
    };
    let Value::Array(all) = list else {
        return Err("no list of people is found in it".into());
    };
    // Landmarks of one person, without a list around them.
    if all.first().is_some_and(|first| first.get("x").is_some_and(Value::is_number)) {
        return Ok(vec![RawPerson { id: None, points: values(list, None, size, report)? }]);
    }
    if all.iter().any(|one| !one.is_object() && !one.is_array()) {
        return Err("no list of people is found in it".into());
    }
    all.iter().map(|one| person(one, size, report)).collect()
}

fn person(person: &Value, size: [u32; 2], report: &mut CameraReport) -> Result<RawPerson, String> {
    if let Value::Array(_) = person {
        return Ok(RawPerson { id: None, points: values(person, None, size, report)? });
    }
    let others = ["face_keypoints_2d", "hand_left_keypoints_2d", "hand_right_keypoints_2d"];
    let filled = |field: &&str| {
        person.get(field).is_some_and(|v| v.as_array().is_some_and(|v| !v.is_empty()))
    };
    report.left_out |= others.iter().any(filled);
    let id = IDS.iter().find_map(|field| person.get(field));
    // OpenPose's is a list; -1 means none.
    let id = id.and_then(|id| id.get(0).unwrap_or(id).as_i64()).filter(|id| *id >= 0);
    let points = match points(person) {
        Some(points) => values(points, person.get("keypoint_scores"), size, report)?,
        None => Vec::new(),
    };
    Ok(RawPerson { id, points })
}

/// Points x, y, c. x and y are pixels, or normalised: shares of the width and of the height.
fn normalised_or_pixels(
    all: &[[f64; 3]],
    size: [u32; 2],
    report: &mut CameraReport,
) -> Vec<Option<Detection>> {
    // A guessed point may be far outside the image. (0, 0) and (-1, -1) are missing points.
    let is_there = |[x, y, c]: &&[f64; 3]| (*c > 0.0 || c.is_nan()) && (*x > 0.0 || *y > 0.0);
    let is_far = |[x, y, _]: &&[f64; 3]| x.abs() > SHARE || y.abs() > SHARE;
    let there: Vec<&[f64; 3]> = all.iter().filter(is_there).collect();
    let is_share = 2 * there.iter().copied().filter(is_far).count() < there.len().max(1);
    let [width, height] = if is_share { size.map(f64::from) } else { [1.0, 1.0] };
    report.shares |= is_share && !there.is_empty();
    all.iter().map(|[x, y, c]| report.detection(x * width, y * height, *c)).collect()
}

/// The points in one of the shapes: x, y, c one after the other; pairs or triples; fields x, y and visible of all
/// points; fields x, y and visibility of each.
fn values(
    points: &Value,
    scores: Option<&Value>,
    size: [u32; 2],
    report: &mut CameraReport,
) -> Result<Vec<Option<Detection>>, String> {
    let wrong = || "a person's points are not numbers".to_owned();
    let number = |value: &Value| match value {
        Value::Null => Ok(f64::NAN),
        value => value.as_f64().ok_or_else(wrong),
    };
    let list = |value: &Value| value.as_array().ok_or_else(wrong)?.iter().map(number).collect();
    if let (Some(x), Some(y)) = (points.get("x"), points.get("y")) {
        let (x, y): (Vec<f64>, Vec<f64>) = (list(x)?, list(y)?);
        let c = points.get("visible").or(points.get("confidence")).map(&list);
        let c: Vec<f64> = c.unwrap_or_else(|| Ok(vec![1.0; x.len()]))?;
        if x.len() != y.len() || x.len() != c.len() {
            return Err("a person's x, y and visible have different lengths".into());
        }
        let all: Vec<_> = (0..x.len()).map(|i| [x[i], y[i], c[i]]).collect();
        return Ok(normalised_or_pixels(&all, size, report));
    }
    let all = points.as_array().ok_or_else(wrong)?;
    let mut point = |x: f64, y: f64, c: f64| report.detection(x, y, c);
    match all.first() {
        Some(first) if first.is_object() => {
            let of = |one: &Value| {
                let field = |name| one.get(name).map_or(Ok(f64::NAN), number);
                let c = one.get("visibility").or(one.get("score")).map_or(Ok(1.0), number)?;
                Ok::<_, String>([field("x")?, field("y")?, c])
            };
            let all = all.iter().map(of).collect::<Result<Vec<_>, _>>()?;
            Ok(normalised_or_pixels(&all, size, report))
        }
        Some(first) if first.is_array() => {
            let scores: Option<Vec<f64>> = scores.map(&list).transpose()?;
            let of = |(i, one): (usize, &Value)| match list(one)?[..] {
                [x, y] => {
                    let score = scores.as_ref().map_or(Some(1.0), |all| all.get(i).copied());
                    Ok(point(x, y, score.ok_or("a person has fewer scores than points")?))
                }
                [x, y, c] => Ok(point(x, y, c)),
                _ => Err("a point must be x, y or x, y, confidence".to_owned()),
            };
            all.iter().enumerate().map(of).collect()
        }
        _ => {
            let numbers: Vec<f64> = list(points)?;
            if !numbers.len().is_multiple_of(3) {
                return Err(format!("a person has {} numbers, no multiple of 3", numbers.len()));
            }
            Ok(numbers.chunks_exact(3).map(|p| point(p[0], p[1], p[2])).collect())
        }
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn results_of_mmpose_are_of_an_image_or_of_a_video() {
        let person =
            json!({ "keypoints": [[1.0, 2.0], [3.0, 4.0]], "keypoint_scores": [0.9, 0.8] });
        let image = json!({ "meta_info": {}, "instance_info": [person] });
        assert!(frames(&image).is_none() && !is_take(&image));
        let found = people(&image, [100, 100], &mut CameraReport::default()).unwrap();
        assert_eq!((found.len(), found[0].points.len()), (1, 2));
        let nobody = json!({ "meta_info": {}, "instance_info": [] });
        assert!(people(&nobody, [100, 100], &mut CameraReport::default()).unwrap().is_empty());
        let video = json!({ "instance_info": [{ "frame_id": 1, "instances": [person] }] });
        assert!(is_take(&video) && frames(&video).unwrap().contains_key(&0));
    }

    #[test]
    fn most_points_tell_whether_they_are_shares_of_the_image() {
        let x_of = |all: &[[f64; 3]]| {
            let mut report = CameraReport::default();
            let points = normalised_or_pixels(all, [200, 100], &mut report);
            (points[0].unwrap().pixel.x, report.shares)
        };
        // A guessed foot is far below the image.
        let shares = [&[[0.5, 0.5, 0.9]; 10][..], &[[0.5, 3.1, 0.1]]].concat();
        assert_eq!(x_of(&shares), (100.0, true));
        // Most points are missing.
        for missing in [[0.0, 0.0, 0.0], [-1.0, -1.0, 0.0], [-1.0, -1.0, 1.0]] {
            let pixels = [&[[50.0, 40.0, 0.9]; 3][..], &[missing; 10]].concat();
            assert_eq!(x_of(&pixels), (50.0, false));
        }
    }
}

//! Tables of points: CSV and h5 of DeepLabCut, CSV of others, numpy arrays of FreeMoCap, text labels of YOLO.

use std::collections::BTreeMap;

use super::folders::frame_numbers;
use super::{CameraReport, RawPerson, h5};
use crate::core::detections::Detection;

/// The people of each frame of a camera.
pub(super) type Frames = BTreeMap<u64, Vec<RawPerson>>;

/// A table of one camera or of several.
pub(super) struct Table {
    /// Names of the points, if the table has some.
    pub names: Option<Vec<String>>,
    /// By the cameras' names; empty where the table names none.
    pub cameras: BTreeMap<String, (Frames, CameraReport)>,
}

/// A column of a point: of which person, which point, and 0, 1 or 2 for x, y and confidence.
type Column = (String, usize, usize);

/// Reads a CSV. DeepLabCut's has lines `scorer`, `individuals` (of several), `bodyparts` and `coords` at the top;
/// others have one line: `frame` or `image`, perhaps `camera` and `person`, then `NAME_x`, `NAME_y` and perhaps
/// `NAME_c` for each point (or `x0`, `y0`, `c0`).
///
/// # Errors
/// A line that has not the header's length, or a cell that is no number.
pub(super) fn csv(bytes: &[u8]) -> Result<Table, String> {
    let mut reader = csv::ReaderBuilder::new().has_headers(false).flexible(true).from_reader(bytes);
    let lines = reader.records().collect::<Result<Vec<_>, _>>();
    let lines = lines.map_err(|error| format!("not CSV ({error})"))?;
    if let Some(first) = lines.first()
        && first.len() == 1
        && let Some(separator) = [';', '\t'].into_iter().find(|one| first.as_slice().contains(*one))
    {
        return Err(format!(
            "{separator:?} is between its columns; use commas there, and points in numbers"
        ));
    }
    of_lines(&lines)
}

/// Reads an h5 of DeepLabCut.
///
/// # Errors
/// It is another file.
pub(super) fn h5(bytes: &[u8]) -> Result<Table, String> {
    of_lines(&h5::lines(bytes)?)
}

fn of_lines(lines: &[csv::StringRecord]) -> Result<Table, String> {
    let at_top = lines.iter().take_while(|line| TOP.contains(&line.get(0).unwrap_or_default()));
    let at_top = at_top.count();
    let (mut names, mut columns, mut fields) = (Vec::new(), Vec::new(), BTreeMap::new());
    let mut column = |at: usize, person: &str, name: &str, axis: usize| {
        let known = names.iter().position(|other| other == name);
        let point = known.unwrap_or_else(|| {
            names.push(name.to_owned());
            names.len() - 1
        });
        columns.push((at, (person.to_owned(), point, axis)));
    };
    if at_top > 0 {
        let line = |name: &str| lines[..at_top].iter().find(|line| line.get(0) == Some(name));
        let (parts, coords) = (line("bodyparts"), line("coords"));
        let (Some(parts), Some(coords)) = (parts, coords) else {
            return Err("no lines bodyparts and coords at the top".into());
        };
        fields.insert("frame", 0);
        for at in 1..parts.len() {
            let person = line("individuals").map_or(Some(""), |line| line.get(at));
            let person = person.ok_or("line individuals is shorter than line bodyparts")?;
            let axis = axis(coords.get(at).unwrap_or_default());
            column(
                at,
                person,
                &parts[at],
                axis.ok_or_else(|| {
                    format!("column {}: coords must be x, y or likelihood", at + 1)
                })?,
            );
        }
    } else {
        let header = lines.first().ok_or("an empty file")?;
        for (at, cell) in header.iter().enumerate() {
            let name = plain(cell);
            match FIELDS.iter().find(|(_, names)| names.contains(&&*name)) {
                Some((field, _)) => drop(fields.entry(*field).or_insert(at)),
                None => {
                    if let Some((name, axis)) = point_column(cell.trim()) {
                        column(at, "", &name, axis);
                    }
                }
            }
        }
    }
    if !fields.contains_key("frame") && fields.contains_key("person") {
        return Err("it has a column of people but no column frame".into());
    }
    let is_time = |name: &&str| TIMES.contains(&&*plain(name));
    let width = lines.iter().take(at_top.max(1)).map(csv::StringRecord::len).max().unwrap_or(0);
    let is_empty = |line: &csv::StringRecord| line.iter().all(|cell| cell.trim().is_empty());
    // Without numbers, an empty row is a frame in which nobody is seen.
    let is_numbered = ["frame", "image", "index"].iter().any(|field| fields.contains_key(field));
    let is_row = |(_, line): &(usize, &csv::StringRecord)| !is_numbered || !is_empty(line);
    let rows = lines.iter().enumerate().skip(at_top.max(1)).filter(is_row);
    let texts = |field: &str| -> Option<Vec<&str>> {
        let at = *fields.get(field)?;
        Some(rows.clone().map(|(_, line)| line.get(at).unwrap_or_default().trim()).collect())
    };
    // The name of a video is the same in all rows.
    let images = texts("image").filter(|names| names.iter().any(|name| *name != names[0]));
    let numbered = texts("frame").or(images).or_else(|| texts("index"));
    if numbered.is_none()
        && let Some(time) = lines.first().and_then(|header| header.iter().find(is_time))
    {
        return Err(format!(
            "it has a column {time} but no column frame; add one with the number of the frame"
        ));
    }
    if columns.iter().all(|(_, (_, _, axis))| *axis != 1) {
        return Err("no columns of points; name them NAME_x, NAME_y and NAME_c".into());
    }
    let mut table = Table { names: Some(names), cameras: BTreeMap::new() };
    let numbers = numbered.map(|texts| numbers(&texts));
    for (k, (i, line)) in rows.enumerate() {
        let number = numbers.as_ref().map_or(Some(i as u64 - 1), |numbers| numbers[k]);
        row(&mut table, line, number, &fields, &columns, width)
            .map_err(|what| format!("line {}: {what}", i + 1))?;
    }
    if let Some(names) = &table.names
        && names.iter().enumerate().all(|(i, name)| name.parse() == Ok(i))
    {
        table.names = None;
    }
    Ok(table)
}

const TOP: [&str; 4] = ["scorer", "individuals", "bodyparts", "coords"];
const FIELDS: [(&str, &[&str]); 5] = [
    ("frame", FRAME),
    ("image", &["image", "imagename", "imageid", "imagepath", "filename", "file"]),
    // Of the rows, as pandas writes it.
    ("index", &["index", "unnamed0", ""]),
    ("camera", &["camera", "cam", "view"]),
    ("person", &["person", "personid", "id", "trackid", "track"]),
];
/// Names of the number of a frame, as [`plain`] has them.
pub(super) const FRAME: &[&str] =
    &["frame", "framenumber", "frameid", "frameidx", "frameindex", "framenum"];

/// Names of a time.
const TIMES: [&str; 9] = [
    "t",
    "time",
    "times",
    "timems",
    "timesec",
    "timestamp",
    "timestamps",
    "timestampms",
    "seconds",
];

/// A field's name in lower case, without what separates its words.
pub(super) fn plain(name: &str) -> String {
    name.chars().filter(|c| c.is_alphanumeric()).flat_map(char::to_lowercase).collect()
}

fn axis(name: &str) -> Option<usize> {
    match name.trim().to_lowercase().as_str() {
        "x" => Some(0),
        "y" => Some(1),
        "c" | "likelihood" | "conf" | "confidence" | "score" | "visibility" => Some(2),
        _ => None,
    }
}

/// `nose_x`, `nose.x`, `x_nose` or `x0`: the point's name and the axis.
fn point_column(cell: &str) -> Option<(String, usize)> {
    let separators = ['_', '.', ' ', '-'];
    if let Some((name, last)) = cell.rsplit_once(separators)
        && let Some(axis) = axis(last)
    {
        return Some((name.to_owned(), axis));
    }
    if let Some((first, name)) = cell.split_once(separators)
        && let Some(axis) = axis(first)
    {
        return Some((name.to_owned(), axis));
    }
    let digits = cell.find(|c: char| c.is_ascii_digit())?;
    let (first, number) = cell.split_at(digits);
    Some((number.parse::<usize>().ok()?.to_string(), axis(first)?))
}

/// The frame number of each row, from the cells of a column: numbers, or names of images.
fn numbers(texts: &[&str]) -> Vec<Option<u64>> {
    let number = |text: &&str| text.parse::<f64>().ok();
    if !texts.iter().any(|text| number(text).is_some()) {
        return frame_numbers(texts.iter().copied());
    }
    let is_whole = |value: &f64| *value >= 0.0 && value.fract() == 0.0;
    texts.iter().map(|text| number(text).filter(is_whole).map(|value| value as u64)).collect()
}

fn row(
    table: &mut Table,
    line: &csv::StringRecord,
    number: Option<u64>,
    fields: &BTreeMap<&str, usize>,
    columns: &[(usize, Column)],
    width: usize,
) -> Result<(), String> {
    let number = number.ok_or("its frame number is no whole number from 0 on")?;
    if line.iter().skip(width).any(|cell| !cell.trim().is_empty()) {
        let cells = line.len();
        return Err(format!(
            "{cells} cells, the first line has {width}: are there decimal commas?"
        ));
    }
    let cell = |name: &str| fields.get(name).and_then(|at| line.get(*at)).map(str::trim);
    let camera = cell("camera").unwrap_or_default();
    let (frames, report) = table.cameras.entry(camera.to_owned()).or_default();
    let points = columns.iter().map(|(_, (_, point, _))| point + 1).max().unwrap_or(0);
    let mut people = BTreeMap::<&str, Vec<[f64; 3]>>::new();
    for (at, (person, point, axis)) in columns {
        let text = line.get(*at).map(str::trim).ok_or("it is shorter than the first line")?;
        let value = match text {
            "" => f64::NAN,
            text => text.parse().map_err(|_| format!("{text} is not a number"))?,
        };
        let empty = || vec![[f64::NAN, f64::NAN, 1.0]; points];
        people.entry(person.as_str()).or_insert_with(empty)[*point][*axis] = value;
    }
    let id = cell("person").and_then(|id| id.parse::<f64>().ok()).map(|id| id as i64);
    let all = frames.entry(number).or_default();
    for points in people.into_values() {
        let points = points.iter().map(|[x, y, c]| seen(*x, *y, *c, report)).collect();
        all.push(RawPerson { id: id.filter(|id| *id >= 0), points });
    }
    Ok(())
}

/// A point; one without coordinates was not seen.
fn seen(x: f64, y: f64, c: f64, report: &mut CameraReport) -> Option<Detection> {
    if x.is_nan() || y.is_nan() { None } else { report.detection(x, y, c) }
}

/// Reads a numpy array of cameras x frames x points x 2 or 3 (FreeMoCap's 2D data), or of frames x points x 2 or
/// 3. The third number is the confidence. It is a depth if some are negative, or all are 0. The cameras have no names.
///
/// # Errors
/// It is no such array.
pub(super) fn npy(bytes: &[u8]) -> Result<Vec<(Frames, CameraReport)>, String> {
    let file = npyz::NpyFile::new(bytes).map_err(|error| format!("no numpy array ({error})"))?;
    let shape: Vec<usize> = file.shape().iter().map(|size| *size as usize).collect();
    if file.order() != npyz::Order::C {
        return Err("an array by columns; save it by rows (numpy.ascontiguousarray)".into());
    }
    let (cameras, frames, points, numbers) = match shape[..] {
        [cameras, frames, points, numbers @ (2 | 3)] => (cameras, frames, points, numbers),
        [frames, points, numbers @ (2 | 3)] => (1, frames, points, numbers),
        _ => {
            return Err(format!(
                "an array of {shape:?}; cameras x frames x points x 2 or 3 is needed"
            ));
        }
    };
    let size = shape.iter().try_fold(1usize, |size, next| size.checked_mul(*next));
    if shape.contains(&0) || size.is_none_or(|size| size > bytes.len()) {
        return Err(format!("an array of {shape:?}, which the file cannot hold"));
    }
    let all: Vec<f64> = match file.try_data::<f64>() {
        Ok(all) => all.collect::<Result<_, _>>(),
        Err(file) => match file.try_data::<f32>() {
            Ok(all) => all.map(|value| value.map(f64::from)).collect::<Result<_, _>>(),
            Err(_) => return Err("an array of another type than f8 or f4".into()),
        },
    }
    .map_err(|error| format!("the array is cut ({error})"))?;
    let thirds = || all.iter().skip(2).step_by(3).filter(|value| !value.is_nan());
    let is_confidence =
        numbers == 3 && thirds().all(|value| *value >= 0.0) && thirds().any(|value| *value > 0.0);
    let per_frame = points * numbers;
    let camera = |camera: usize| {
        let mut report = CameraReport::default();
        let frame = |frame: usize| {
            let from = (camera * frames + frame) * per_frame;
            let point = |p: &[f64]| {
                let c = if is_confidence { p[2] } else { 1.0 };
                seen(p[0], p[1], c, &mut report)
            };
            let points = all[from..from + per_frame].chunks_exact(numbers).map(point).collect();
            (frame as u64, vec![RawPerson { id: None, points }])
        };
        let frames = (0..frames).map(frame).collect();
        (frames, report)
    };
    Ok((0..cameras).map(camera).collect())
}

/// Reads YOLO's labels of a frame: class, box (4 numbers), and x, y, visibility of each point, in shares of the
/// image; a confidence of the box may follow, or an id, or both.
///
/// # Errors
/// A line with other numbers.
pub(super) fn yolo(
    text: &str,
    size: [u32; 2],
    report: &mut CameraReport,
) -> Result<Vec<RawPerson>, String> {
    let [width, height] = size.map(f64::from);
    report.shares = true;
    let mut people = Vec::new();
    let numbers = |(i, line): (usize, &str)| {
        let numbers: Option<Vec<f64>> =
            line.split_whitespace().map(|word| word.parse().ok()).collect();
        let numbers = numbers.filter(|all| all.len() > 7);
        numbers
            .ok_or_else(|| format!("line {}: not class, box and points as in YOLO's labels", i + 1))
    };
    let lines = text.lines().enumerate().filter(|(_, line)| !line.trim().is_empty());
    let lines = lines.map(numbers).collect::<Result<Vec<_>, _>>()?;
    let last = |numbers: &[f64]| numbers[numbers.len() - 1];
    // A single number after the points is a confidence or an id. The numbers are ids if all are whole numbers from 1, and
    // 1 comes at most once and not alone.
    let may_be_id = |numbers: &Vec<f64>| last(numbers) >= 1.0 && last(numbers).fract() == 0.0;
    let ones = lines.iter().filter(|numbers| last(numbers) == 1.0).count();
    let are_ids = lines.iter().all(may_be_id) && ones < 2 && ones < lines.len();
    for numbers in lines {
        let more = (numbers.len() - 5) % 3;
        let has_id = more == 2 || more == 1 && are_ids;
        let id = has_id.then(|| last(&numbers) as i64);
        let points = numbers[5..].chunks_exact(3);
        let points = points.map(|p| report.detection(p[0] * width, p[1] * height, p[2]));
        people.push(RawPerson { id, points: points.collect() });
    }
    Ok(people)
}

//! Writes C3D files. All numbers are little endian.

use std::io::Write;
use std::path::Path;

use nalgebra::{Vector3, Vector4};

use super::{BLOCK, INTEL, MAGIC};
use crate::io::formats::trc::Markers;
use crate::io::formats::{ExportError, Up};
use crate::io::new_file::NewFile;

/// The parameters begin in the second block.
const PARAMETERS: u8 = 2;
/// A negative scale says that frames have floating point numbers.
const SCALE: f32 = -1.0;
/// Most bytes of a text.
const LONGEST: usize = 127;

/// Most values of a parameter along a dimension.
const MOST: usize = 255;

/// Writes markers over time. Frames count from 1. An event `Lost` is where all markers disappear, an event `Tracked`
/// where they come back; at most 255 events.
///
/// # Errors
/// The disk is full, the rate is not above 0, a place is not finite, or there are more than 255 markers.
pub fn write_c3d(path: &Path, markers: &Markers) -> Result<(), ExportError> {
    let Markers { fps, unit, names, frames, .. } = markers;
    ExportError::check_rate(path, *fps)?;
    let is_finite = |at: &Vector3<f64>| at.iter().all(|metres| metres.is_finite());
    if let Some(frame) = frames.iter().position(|row| !row.iter().flatten().all(is_finite)) {
        return Err(ExportError::NotFinite { path: path.into(), frame });
    }
    let written = || {
        let count = u8::try_from(names.len()).map_err(std::io::Error::other)?;
        // The size of the parameters does not depend on the block of the first frame.
        let blocks = parameters(markers, count, 0).len() / BLOCK;
        let first = u16::from(PARAMETERS) + blocks as u16;
        let mut new = NewFile::create(path)?;
        let file = new.file();
        file.write_all(&header(markers, count, first))?;
        file.write_all(&parameters(markers, count, first))?;
        for places in *frames {
            for place in places {
                let numbers = match place {
                    Some(at) => (at / unit.metres()).push(0.0),
                    None => Vector4::new(0.0, 0.0, 0.0, -1.0),
                };
                for number in &numbers {
                    file.write_all(&(*number as f32).to_le_bytes())?;
                }
            }
        }
        new.finish().map(drop)
    };
    written().map_err(ExportError::write(path))
}

/// The number of frames in the header, at most 65,535; the group TRIAL has the whole number.
fn last_frame(markers: &Markers) -> u16 {
    u16::try_from(markers.frames.len()).unwrap_or(u16::MAX)
}

fn header(markers: &Markers, count: u8, first_block: u16) -> [u8; BLOCK] {
    let mut bytes = [0; BLOCK];
    let mut put = |at: usize, value: &[u8]| bytes[at..at + value.len()].copy_from_slice(value);
    put(0, &[PARAMETERS, MAGIC]);
    put(2, &u16::from(count).to_le_bytes());
    put(6, &1_u16.to_le_bytes());
    put(8, &last_frame(markers).to_le_bytes());
    put(12, &SCALE.to_le_bytes());
    put(16, &first_block.to_le_bytes());
    put(20, &(markers.fps as f32).to_le_bytes());
    bytes
}

fn parameters(markers: &Markers, count: u8, first_block: u16) -> Vec<u8> {
    let Markers { fps, unit, up, names, frames } = markers;
    let (fps, all) = (*fps as f32, frames.len() as u32);
    let mut group = Groups::default();
    group.begin("POINT");
    group.integer("USED", u16::from(count));
    group.float("SCALE", SCALE);
    group.float("RATE", fps);
    group.integer("DATA_START", first_block);
    group.integer("FRAMES", last_frame(markers));
    group.texts("LABELS", names);
    group.texts("DESCRIPTIONS", &vec![String::new(); names.len()]);
    group.text("UNITS", &unit.to_string());
    // The axis to the right, seen from the front, and the one that is up.
    group.text("X_SCREEN", if *up == Up::Z { "+Y" } else { "+X" });
    group.text("Y_SCREEN", &format!("+{}", up.to_string().to_uppercase()));
    group.begin("ANALOG");
    group.integer("USED", 0);
    group.begin("FORCE_PLATFORM");
    group.integer("USED", 0);
    let events = events(frames);
    if !events.is_empty() {
        let seconds = |event: &(usize, &str)| [0.0, event.0 as f32 / fps];
        let labels: Vec<&str> = events.iter().map(|event| event.1).collect();
        group.begin("EVENT");
        group.integer("USED", events.len() as u16);
        group.texts("CONTEXTS", &vec!["General"; events.len()]);
        group.texts("LABELS", &labels);
        group.texts("DESCRIPTIONS", &vec![""; events.len()]);
        // Minutes and seconds.
        group.pairs("TIMES", &events.iter().map(seconds).collect::<Vec<_>>());
    }
    group.begin("TRIAL");
    // Numbers of 32 bits, the lower half first.
    group.integers("ACTUAL_START_FIELD", &[1, 0]);
    group.integers("ACTUAL_END_FIELD", &[all as u16, (all >> 16) as u16]);
    group.float("CAMERA_RATE", fps);
    group.begin("MANUFACTURER");
    group.text("COMPANY", "bundlemocap");
    group.text("SOFTWARE", concat!("bundlemocap ", env!("CARGO_PKG_VERSION")));
    group.finish()
}

/// The frames from which all markers are missing or there again.
fn events(frames: &[Vec<Option<Vector3<f64>>>]) -> Vec<(usize, &'static str)> {
    let is_lost = |frame: usize| frames[frame].iter().all(Option::is_none);
    let changes = (1..frames.len()).filter(|frame| is_lost(*frame) != is_lost(*frame - 1));
    changes.map(|at| (at, if is_lost(at) { "Lost" } else { "Tracked" })).take(MOST).collect()
}

/// The parameters in their groups.
#[derive(Default)]
struct Groups {
    bytes: Vec<u8>,
    /// Number of groups so far.
    groups: u8,
}

impl Groups {
    fn begin(&mut self, name: &str) {
        self.groups += 1;
        let number = self.groups.wrapping_neg();
        self.record(number, name, &[]);
    }

    /// A record with its number, name, content and an empty description.
    fn record(&mut self, number: u8, name: &str, content: &[u8]) {
        self.bytes.extend([name.len() as u8, number]);
        self.bytes.extend(name.as_bytes());
        // The way to the next record.
        self.bytes.extend((content.len() as u16 + 3).to_le_bytes());
        self.bytes.extend(content);
        self.bytes.push(0);
    }

    /// A parameter of a type, with its dimensions.
    fn parameter(&mut self, name: &str, kind: i8, dimensions: &[u8], data: &[u8]) {
        let mut content = vec![kind as u8, dimensions.len() as u8];
        content.extend(dimensions);
        content.extend(data);
        self.record(self.groups, name, &content);
    }

    fn integer(&mut self, name: &str, value: u16) {
        self.parameter(name, 2, &[], &value.to_le_bytes());
    }

    fn integers(&mut self, name: &str, values: &[u16]) {
        let bytes: Vec<u8> = values.iter().flat_map(|value| value.to_le_bytes()).collect();
        self.parameter(name, 2, &[values.len() as u8], &bytes);
    }

    fn float(&mut self, name: &str, value: f32) {
        self.parameter(name, 4, &[], &value.to_le_bytes());
    }

    fn pairs(&mut self, name: &str, values: &[[f32; 2]]) {
        let bytes: Vec<u8> = values.as_flattened().iter().flat_map(|v| v.to_le_bytes()).collect();
        self.parameter(name, 4, &[2, values.len() as u8], &bytes);
    }

    fn text(&mut self, name: &str, text: &str) {
        self.parameter(name, -1, &[text.len() as u8], text.as_bytes());
    }

    /// Texts, filled up with spaces to the longest.
    fn texts<T: AsRef<str>>(&mut self, name: &str, texts: &[T]) {
        let cut = |text: &T| text.as_ref().as_bytes()[..text.as_ref().len().min(LONGEST)].to_vec();
        let mut all: Vec<Vec<u8>> = texts.iter().map(cut).collect();
        let width = all.iter().map(Vec::len).max().unwrap_or(0).max(1);
        all.iter_mut().for_each(|text| text.resize(width, b' '));
        self.parameter(name, -1, &[width as u8, all.len() as u8], &all.concat());
    }

    /// Whole blocks, with their number.
    fn finish(self) -> Vec<u8> {
        let mut all = vec![1, MAGIC, 0, INTEL];
        all.extend(self.bytes);
        // At least one byte of 0 ends the records.
        all.resize((all.len() + 1).next_multiple_of(BLOCK), 0);
        all[2] = (all.len() / BLOCK) as u8;
        all
    }
}

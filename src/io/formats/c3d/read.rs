//! Reads the markers of C3D files, of all processors, with integers or floating point numbers.

use std::collections::HashMap;

use nalgebra::Vector3;

use super::{BLOCK, INTEL, MAGIC};
use crate::io::formats::trajectories::{Trajectories, TrajectoryError};
use crate::io::formats::{Unit, Up};

/// The number of processors of DEC, whose floating point numbers are of their own kind.
const DEC: u8 = 85;
/// The number of processors that are big endian.
const MIPS: u8 = 86;

/// Whether a file begins as a C3D file does, and not as a text.
pub(in crate::io::formats) fn is_c3d(bytes: &[u8]) -> bool {
    matches!(bytes, [1..b' ', MAGIC, ..])
}

/// Parses the bytes of a file. Its axis that is up, by `POINT:Y_SCREEN`, becomes y; without one it is z.
pub(in crate::io::formats) fn parse(bytes: &[u8]) -> Result<Trajectories, TrajectoryError> {
    let start = BLOCK * usize::from(bytes[0].saturating_sub(1));
    let parameters = bytes.get(start..).filter(|bytes| bytes.len() > 4);
    let parameters = parameters.ok_or(not_there("parameters"))?;
    let numbers = Numbers { processor: parameters[3] };
    if ![INTEL, DEC, MIPS].contains(&numbers.processor) {
        return Err(TrajectoryError::Processor { found: numbers.processor });
    }
    let layout = Layout::of(bytes, &numbers)?;
    let trial = group(parameters, &numbers, "TRIAL");
    let points = group(parameters, &numbers, "POINT");
    let float = |name: &str, what| {
        let found = points.get(name).and_then(|parameter| numbers.float(parameter.data));
        found.map(f64::from).ok_or(not_there(what))
    };
    let text = |name: &str| points.get(name).and_then(|parameter| parameter.texts().next());
    let (scale, frame_rate) = (float("SCALE", "POINT:SCALE")?, float("RATE", "POINT:RATE")?);
    let units = text("UNITS").filter(|unit| !unit.is_empty()).unwrap_or_else(|| "mm".into());
    let unit: Unit =
        units.parse().map_err(|_| TrajectoryError::Units { place: "POINT:UNITS", units })?;
    let up = text("Y_SCREEN").map(|axis| axis.trim_start_matches('+').trim().to_lowercase());
    let up: Up = up.and_then(|axis| axis.parse().ok()).unwrap_or_default();
    let turn = up.calibration_from_world().transpose() * unit.metres();
    // Those of more than 255 markers are in several parameters.
    let more = (2..).map_while(|part| points.get(&format!("LABELS{part}")));
    let labels = points.get("LABELS").into_iter().chain(more).flat_map(Parameter::texts);
    let mut names: Vec<String> = labels.take(layout.markers).collect();
    names.resize(layout.markers, String::new());
    // The header has no room for the numbers of a long recording.
    let long = |name: &str| trial.get(name).and_then(|parameter| numbers.long(parameter.data));
    let first = long("ACTUAL_START_FIELD").unwrap_or(layout.first);
    let end = long("ACTUAL_END_FIELD");
    let last = end.unwrap_or(layout.last);
    let frames = last.checked_sub(first).map_or(usize::MAX, |frames| frames as usize + 1);
    let places = layout.places(bytes, &numbers, scale)?;
    // In the header, the frame numbers of a long recording start at 0 again.
    let is_long = end.is_none() && places.len() > usize::from(u16::MAX);
    let frames = if is_long { places.len() } else { frames };
    let places = places.take(frames);
    let turned = |row: Vec<Option<Vector3<f64>>>| {
        row.into_iter().map(|place| place.map(|place| turn * place)).collect()
    };
    Ok(Trajectories {
        frame_rate,
        // Frames count from 1.
        first_frame: f64::from(first.saturating_sub(1)),
        names,
        rows: places.map(turned).collect(),
    })
}

fn not_there(what: &'static str) -> TrajectoryError {
    TrajectoryError::NotInC3d { what }
}

/// What the header says of the frames.
struct Layout {
    markers: usize,
    /// Number of analog values in a frame.
    analog: usize,
    /// Numbers of the first and the last frame, from 1.
    first: u32,
    last: u32,
    /// First byte of the first frame.
    start: usize,
}

impl Layout {
    fn of(bytes: &[u8], numbers: &Numbers) -> Result<Self, TrajectoryError> {
        let header = |at: usize, what| {
            let found = bytes.get(at..).and_then(|bytes| numbers.integer(bytes));
            found.map(|number| number as u16).ok_or(not_there(what))
        };
        Ok(Self {
            markers: header(2, "number of markers")?.into(),
            analog: header(4, "number of analog values")?.into(),
            first: header(6, "first frame")?.into(),
            last: header(8, "last frame")?.into(),
            start: BLOCK * usize::from(header(16, "place of the frames")?.saturating_sub(1)),
        })
    }

    /// The places of the markers in each whole frame, in the file's axes and unit. A negative scale says that all numbers
    /// are floating point numbers in that unit; else they are integers, times the scale.
    fn places<'a>(
        &self,
        bytes: &'a [u8],
        numbers: &'a Numbers,
        scale: f64,
    ) -> Result<impl ExactSizeIterator<Item = Vec<Option<Vector3<f64>>>> + 'a, TrajectoryError>
    {
        let is_float = scale < 0.0;
        let (width, scale) = if is_float { (4, 1.0) } else { (2, scale) };
        let number = move |bytes: &[u8], index: usize| {
            let bytes = bytes.get(width * index..)?;
            match is_float {
                true => numbers.float(bytes).map(f64::from),
                false => numbers.integer(bytes).map(f64::from),
            }
        };
        let place = move |bytes: &[u8]| {
            let at = Vector3::new(number(bytes, 0)?, number(bytes, 1)?, number(bytes, 2)?) * scale;
            // Some programs write zeros for places that are not known.
            let is_known = at.iter().all(|c| c.is_finite()) && at != Vector3::zeros();
            (is_known && number(bytes, 3)? >= 0.0).then_some(at)
        };
        let (markers, length) = (self.markers, width * (4 * self.markers + self.analog));
        let frames = bytes.get(self.start..).unwrap_or_default().chunks_exact(length.max(1));
        if length == 0 || frames.len() == 0 {
            return Err(not_there("frame of markers"));
        }
        Ok(frames
            .map(move |frame| frame.chunks_exact(4 * width).take(markers).map(place).collect()))
    }
}

/// Numbers as a processor has them.
struct Numbers {
    processor: u8,
}

impl Numbers {
    /// The integer of 16 bits at the start.
    fn integer(&self, bytes: &[u8]) -> Option<i16> {
        let bytes = *bytes.first_chunk()?;
        Some(if self.processor == MIPS {
            i16::from_be_bytes(bytes)
        } else {
            i16::from_le_bytes(bytes)
        })
    }

    /// The number of 32 bits at the start: two integers, the lower half first.
    fn long(&self, bytes: &[u8]) -> Option<u32> {
        let [low, high] = [self.integer(bytes)?, self.integer(bytes.get(2..)?)?];
        Some(u32::from(high as u16) << 16 | u32::from(low as u16))
    }

    /// The floating point number at the start.
    fn float(&self, bytes: &[u8]) -> Option<f32> {
        let bytes @ [a, b, c, d] = *bytes.first_chunk()?;
        Some(match self.processor {
            MIPS => f32::from_be_bytes(bytes),
            // The halves are exchanged, and the exponent is larger by two.
            DEC => f32::from_le_bytes([c, d, a, b]) / 4.0,
            _ => f32::from_le_bytes(bytes),
        })
    }
}

/// A parameter's dimensions and bytes.
struct Parameter<'a> {
    dimensions: &'a [u8],
    data: &'a [u8],
}

impl Parameter<'_> {
    /// Its texts without spaces at the ends. The first dimension is their length.
    fn texts(&self) -> impl Iterator<Item = String> {
        let length = self.dimensions.first().map_or(1, |length| usize::from(*length)).max(1);
        let text =
            |bytes: &[u8]| String::from_utf8_lossy(bytes).trim_matches([' ', '\0']).to_owned();
        self.data.chunks(length).map(text)
    }
}

/// The parameters of a group. What is cut off is left out.
fn group<'a>(section: &'a [u8], numbers: &Numbers, name: &str) -> HashMap<String, Parameter<'a>> {
    let (mut id, mut found) = (None, Vec::new());
    let mut rest = section.get(4..).unwrap_or_default();
    // A record: length and number of the name, the name, the way to the next record, the content.
    while let Some((&[length, number], after)) = rest.split_first_chunk()
        && length != 0
        && let Some((own, after)) = after.split_at_checked((length as i8).unsigned_abs().into())
        && let Some(way) = numbers.integer(after)
    {
        let own = String::from_utf8_lossy(own).to_uppercase();
        let number = number as i8;
        if number < 0 && own == name {
            id = Some(-i16::from(number));
        } else if number > 0
            && let Some(parameter) = parameter(&after[2..])
        {
            found.push((i16::from(number), own, parameter));
        }
        if way == 0 {
            break;
        }
        rest = after.get(usize::from(way as u16)..).unwrap_or_default();
    }
    let of_group = found.into_iter().filter(|(number, ..)| Some(*number) == id);
    of_group.map(|(_, name, parameter)| (name, parameter)).collect()
}

fn parameter(content: &[u8]) -> Option<Parameter<'_>> {
    let (&[kind, rank], rest) = content.split_first_chunk()?;
    let (dimensions, data) = rest.split_at_checked(rank.into())?;
    let width = usize::from((kind as i8).unsigned_abs());
    let mut sizes = dimensions.iter().map(|size| usize::from(*size));
    let data = data.get(..sizes.try_fold(width, usize::checked_mul)?)?;
    Some(Parameter { dimensions, data })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::io::formats::c3d::write_c3d;
    use crate::io::formats::trc::Markers;

    fn written() -> Vec<u8> {
        let names = ["LKNE".to_owned(), "Anna:LANK".to_owned()];
        let at = |x: f64| Some(Vector3::new(x, 1.0, -0.25));
        let frames = [vec![at(0.5), None], vec![at(0.75), at(-2.0)]];
        let markers =
            Markers { fps: 120.0, unit: Unit::MM, up: Up::Y, names: &names, frames: &frames };
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.c3d");
        write_c3d(&path, &markers).unwrap();
        std::fs::read(&path).unwrap()
    }

    #[test]
    fn what_is_written_is_read() {
        let read = parse(&written()).unwrap();
        assert_eq!((read.frame_rate, read.first_frame, read.rows.len()), (120.0, 0.0, 2));
        assert_eq!(read.names, ["LKNE", "Anna:LANK"]);
        let place = |row: usize, marker: usize| read.rows[row][marker];
        assert_eq!(place(0, 1), None);
        for (found, x) in [(place(0, 0), 0.5), (place(1, 0), 0.75), (place(1, 1), -2.0)] {
            assert!((found.unwrap() - Vector3::new(x, 1.0, -0.25)).norm() < 1e-6, "{found:?}");
        }
    }

    #[test]
    fn other_processors_and_integers_are_read() {
        // One marker with two analog values a frame, as integers; z is up.
        let record = |number: i8, name: &str, content: &[u8], swap: bool| {
            let mut bytes = vec![name.len() as u8, number as u8];
            bytes.extend(name.as_bytes());
            let way = (content.len() as u16 + 3).to_le_bytes();
            bytes.extend(if swap { [way[1], way[0]] } else { way });
            bytes.extend([content, &[0]].concat());
            bytes
        };
        for processor in [INTEL, DEC, MIPS] {
            let swap = processor == MIPS;
            let integer = |value: i16| if swap { value.to_be_bytes() } else { value.to_le_bytes() };
            let float = |value: f32| {
                let [a, b, c, d] = (value * 4.0).to_le_bytes();
                match processor {
                    INTEL => value.to_le_bytes(),
                    DEC => [c, d, a, b],
                    _ => value.to_be_bytes(),
                }
            };
            let mut file = vec![0; BLOCK];
            (file[0], file[1]) = (2, MAGIC);
            for (at, value) in [(2, 1), (4, 2), (6, 11), (8, 12), (16, 3)] {
                file[at..at + 2].copy_from_slice(&integer(value));
            }
            file.extend([1, MAGIC, 1, processor]);
            file.extend(record(-3, "POINT", &[], swap));
            file.extend(record(3, "SCALE", &[&[4, 0][..], &float(0.5)].concat(), swap));
            file.extend(record(3, "RATE", &[&[4, 0][..], &float(50.0)].concat(), swap));
            file.extend(record(3, "LABELS", b"\xff\x02\x06\x01LKNE  ", swap));
            file.extend(record(3, "UNITS", b"\xff\x01\x02cm", swap));
            file.resize(2 * BLOCK, 0);
            for numbers in [[100, 200, 300, 0, 7, 7], [1, 1, 1, -1, 7, 7]] {
                numbers.into_iter().for_each(|number| file.extend(integer(number)));
            }
            let read = parse(&file).unwrap();
            assert_eq!((read.frame_rate, read.first_frame, read.rows.len()), (50.0, 10.0, 2));
            assert_eq!(read.names, ["LKNE"]);
            let at = read.rows[0][0].unwrap();
            assert!((at - Vector3::new(1.0, 1.5, 0.5)).norm() < 1e-9, "{processor}: {at}");
            assert_eq!(read.rows[1][0], None);
        }
    }

    #[test]
    fn cut_and_broken_files_are_refused_or_shorter() {
        let whole = written();
        for length in 2..whole.len() {
            let _ = parse(&whole[..length]);
        }
        for at in 0..whole.len().min(1400) {
            for value in [0, 1, 127, 128, 255] {
                let mut broken = whole.clone();
                broken[at] = value;
                let _ = parse(&broken);
            }
        }
        let message = |bytes: &[u8]| parse(bytes).unwrap_err().to_string();
        assert!(message(&whole[..530]).contains("POINT:SCALE"), "{}", message(&whole[..530]));
        assert!(message(&whole[..600]).contains("no frame"), "{}", message(&whole[..600]));
        let mut other = whole.clone();
        other[BLOCK + 3] = 9;
        assert!(message(&other).contains("processor 9"), "{}", message(&other));
    }
}

//! Converts `KeypointFrame` to and from [`Detections`].

use nalgebra::Point2;

use super::check::{Field, field};
use super::{DecodeError, DetectedPerson, KeypointFrame, KeypointSet};
use crate::core::detections::{Detection, Detections, KeypointFormat, Person};
use crate::core::stage::{PerformerFrames, PerformerId};
use crate::core::time::{Nanos, TIMES_NS, Timestamp};

/// Frames are not complete further than this after the last one.
const AHEAD: Nanos = Nanos::SECOND;
const COMPLETE: Field = field("KeypointSet", "complete_ns");
const PERFORMER: Field = field("KeypointSet", "performer");
const FRAMES: Field = field("KeypointSet", "frames");
const POINTS: Field = field("KeypointFrame", "people.points");
const CAPTURE: Field = field("KeypointFrame", "capture_time_ns");

impl KeypointFrame {
    /// The detections of `camera` (its name) in an image of `image_size` pixels, width and height.
    /// Pixels and confidences are rounded to `f32`.
    pub fn from_core(detections: &Detections, camera: &str, image_size: [u32; 2]) -> Self {
        Self {
            camera: camera.to_owned(),
            frame: detections.frame,
            capture_time_ns: detections.capture.ns(),
            image_width: image_size[0],
            image_height: image_size[1],
            format: detections.format.name().to_owned(),
            people: detections.people.iter().map(DetectedPerson::from_core).collect(),
        }
    }

    /// The detections; `index_of` maps a camera's name to its index in the rig.
    ///
    /// # Errors
    /// An unknown camera or format, a capture time beyond [`TIMES_NS`], points that do not
    /// fit the format, numbers that are not finite, negative confidences.
    pub fn to_core(
        &self,
        index_of: impl FnOnce(&str) -> Option<usize>,
    ) -> Result<Detections, DecodeError> {
        let camera = index_of(&self.camera)
            .ok_or_else(|| DecodeError::UnknownCamera { name: self.camera.clone() })?;
        if !TIMES_NS.contains(&self.capture_time_ns) {
            let (least, most) = (TIMES_NS.start(), TIMES_NS.end());
            let reason = format!("{} is not from {least} to {most}", self.capture_time_ns);
            return Err(CAPTURE.invalid(reason));
        }
        let format = self.keypoint_format()?;
        let people = self.people.iter().map(|person| person.to_core(format));
        Ok(Detections {
            camera,
            frame: self.frame,
            capture: Timestamp::from_ns(self.capture_time_ns),
            format,
            people: people.collect::<Result<_, _>>()?,
        })
    }

    /// The format of the points.
    ///
    /// # Errors
    /// The name is not known.
    pub fn keypoint_format(&self) -> Result<KeypointFormat, DecodeError> {
        KeypointFormat::from_name(&self.format)
            .ok_or_else(|| DecodeError::UnknownFormat { name: self.format.clone() })
    }
}

impl KeypointSet {
    /// The performer and the frames. The arguments are those of [`KeypointFrame::to_core`].
    ///
    /// # Errors
    /// As [`KeypointFrame::to_core`]; more performers than there can be; several people in a frame.
    pub fn to_core(
        &self,
        index_of: impl Fn(&str) -> Option<usize>,
    ) -> Result<(PerformerId, PerformerFrames), DecodeError> {
        let performer = PERFORMER.performer(self.performer)?;
        if !TIMES_NS.contains(&self.complete_ns) {
            return Err(COMPLETE.invalid(format!("{} is no capture time", self.complete_ns)));
        }
        let frames = self.frames.iter().map(|frame| frame.to_core(&index_of));
        let frames: Vec<Detections> = frames.collect::<Result<_, _>>()?;
        if frames.iter().any(|frame| frame.people.len() > 1) {
            return Err(FRAMES.invalid("several people in a frame"));
        }
        let last = frames.iter().map(|frame| frame.capture).max().unwrap_or_default();
        if Timestamp::from_ns(self.complete_ns) - last > AHEAD {
            return Err(COMPLETE.invalid("is long after the last frame"));
        }
        let frames = PerformerFrames {
            frames,
            complete: Timestamp::from_ns(self.complete_ns),
            returns: self.returns,
            enters: self.enters,
        };
        Ok((performer, frames))
    }
}

impl DetectedPerson {
    fn from_core(person: &Person) -> Self {
        let points = person.points.iter().flat_map(|point| match point {
            Some(Detection { pixel, confidence }) => {
                [pixel.x as f32, pixel.y as f32, *confidence as f32]
            }
            None => [0.0; 3],
        });
        Self { id: person.id, points: points.collect() }
    }

    fn to_core(&self, format: KeypointFormat) -> Result<Person, DecodeError> {
        POINTS.length(self.points.len(), 3 * format.len())?;
        let points = self.points.as_chunks().0.iter().enumerate();
        let points = points.map(|(index, &point)| detection(index, point));
        Ok(Person { id: self.id, points: points.collect::<Result<_, _>>()? })
    }
}

/// Point `index` of a person, from x, y, confidence; `None` where the confidence is 0.
fn detection(index: usize, point: [f32; 3]) -> Result<Option<Detection>, DecodeError> {
    let [x, y, confidence] = point;
    if confidence == 0.0 {
        return Ok(None);
    }
    if !point.iter().all(|number| number.is_finite()) {
        let fix = "a missing point has confidence 0";
        return Err(POINTS.invalid(format!("point {index} is not finite; {fix}")));
    }
    if confidence < 0.0 {
        return Err(POINTS.invalid(format!("point {index} has confidence {confidence}")));
    }
    Ok(Some(Detection {
        pixel: Point2::new(x.into(), y.into()),
        confidence: f64::from(confidence).min(1.0),
    }))
}

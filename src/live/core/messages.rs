//! Turns messages from the bus into inputs of the tracker.

use std::sync::Arc;

use super::Core;
use super::port::{MOST_BYTES, MOST_ORDER_BYTES};
use crate::core::camera::Rig;
use crate::core::detections::Detections;
use crate::core::stage;
use crate::core::time::Nanos;
use crate::core::tracker::EventKind;
use crate::io::wire::{
    self, ActorChannel, DecodeError, KeypointFrame, StageChannel, Topic, Topics,
};
use crate::live::clock::Arrival;

/// Points further than this many image sizes outside the image are not used.
const MOST_OUTSIDE: f64 = 2.0;
/// Most people of a frame that are used.
const MOST_PEOPLE: usize = 64;
/// Number of arrivals that are kept to find those of a frame set.
const MOST_ARRIVALS: usize = 256;
/// Longest name of an unknown camera in an event, characters.
const MOST_NAME: usize = 64;

impl Core {
    /// The patterns of the topics that it reads, those of rigs and of slates first.
    pub(crate) fn inputs(&self) -> Vec<String> {
        let all = Topics { actor: "*".to_owned(), ..self.topics.clone() };
        let mut inputs = vec![all.rig(), all.take()];
        inputs.push(if self.is_solver() { all.actor_keypoints() } else { all.keypoints("*") });
        inputs.extend(self.looks_for_solvers().then(|| all.hand_over()));
        inputs.extend(self.looks_for_solvers().then(|| all.status()));
        inputs
    }

    pub(super) fn message(&mut self, topic: &str, payload: &[u8]) {
        let is_rig = topic == self.topics.rig();
        if is_rig || topic == self.topics.take() {
            return match payload.len() > MOST_ORDER_BYTES {
                true => self.too_large(None, payload, MOST_ORDER_BYTES),
                false if is_rig => self.rig_from_bus(payload),
                false => self.slate(payload),
            };
        }
        match Topic::parse(topic) {
            Ok(topic) if *topic.stage() != *self.topics.stage => {}
            Ok(Topic::Stage { channel: StageChannel::Keypoints { camera }, .. })
                if !self.is_solver() =>
            {
                self.keypoints(camera, payload);
            }
            Ok(Topic::Actor { .. }) if payload.len() > MOST_BYTES => {
                self.too_large(None, payload, MOST_BYTES);
            }
            Ok(Topic::Actor { actor, channel, .. }) => match channel {
                ActorChannel::Keypoints if self.is_solver() => self.keypoint_set(actor, payload),
                ActorChannel::HandOver => self.hand_over(actor, payload),
                ActorChannel::Status if self.reads_status(actor) => {
                    self.status_of_other(actor, payload)
                }
                _ => {}
            },
            Ok(Topic::Stage { .. }) | Err(_) => {}
        }
    }

    fn too_large(&mut self, camera: Option<&str>, payload: &[u8], most: usize) {
        let detail = format!("a message of {} bytes, at most {most}", payload.len());
        self.event(EventKind::Unusable, camera, detail);
    }

    fn keypoints(&mut self, name: &str, payload: &[u8]) {
        let is_known = self.cameras.iter().any(|camera| camera.name() == name);
        let shortened: String = name.chars().take(MOST_NAME).collect();
        let camera = if is_known { name } else { &shortened };
        if payload.len() > MOST_BYTES {
            return self.too_large(Some(camera), payload, MOST_BYTES);
        }
        let Some(calibration) = &self.calibration else {
            let detail = "keypoints before a calibration; publish one, or give --rig".to_owned();
            return self.event(EventKind::Unusable, Some(camera), detail);
        };
        let rig = Arc::clone(&calibration.rig);
        let decoded = wire::decode::<KeypointFrame>(payload);
        let decoded = decoded.and_then(|frame| self.frame(camera, frame, &rig));
        match decoded {
            Ok(frame) => self.detections(frame),
            Err(error) => self.event(EventKind::Unusable, Some(camera), error.to_string()),
        }
    }

    /// Checks a frame that arrived on the topic of `camera`.
    fn frame(
        &mut self,
        camera: &str,
        mut frame: KeypointFrame,
        rig: &Rig,
    ) -> Result<Detections, DecodeError> {
        if frame.camera != camera {
            return Err(DecodeError::Invalid {
                message: "KeypointFrame",
                field: "camera",
                reason: "is not the camera of its topic".to_owned(),
            });
        }
        let size = [frame.image_width, frame.image_height];
        let people = frame.people.len();
        if people > MOST_PEOPLE {
            frame.people.truncate(MOST_PEOPLE);
            let detail = format!("{people} people, the first {MOST_PEOPLE} are used");
            self.event(EventKind::Crowd, Some(camera), detail);
        }
        let mut frame = frame.to_core(|name| rig.index_of(name))?;
        self.check_points(&mut frame, size, rig)?;
        Ok(frame)
    }

    /// Checks the size of a frame's image, and leaves out points that are far outside of it.
    pub(super) fn check_points(
        &mut self,
        frame: &mut Detections,
        size: [u32; 2],
        rig: &Rig,
    ) -> Result<(), DecodeError> {
        let Some(camera) = rig.cameras.get(frame.camera) else { return Ok(()) };
        let [width, height] = [camera.width, camera.height];
        if size != [0, 0] && !camera.is_of_size(size) {
            return Err(DecodeError::Invalid {
                message: "KeypointFrame",
                field: "image_width",
                reason: format!(
                    "the image has {} x {}, the calibration is for {width} x {height}; send pixels of \
                     the calibrated image, or calibrate for this size",
                    size[0], size[1]
                ),
            });
        }
        let is_far = |at: f64, size: u32| {
            let most = f64::from(size) * MOST_OUTSIDE;
            !(-most..=most + f64::from(size)).contains(&at)
        };
        let mut count = 0;
        for point in frame.people.iter_mut().flat_map(|person| &mut person.points) {
            if point.is_some_and(|at| is_far(at.pixel.x, width) || is_far(at.pixel.y, height)) {
                *point = None;
                count += 1;
            }
        }
        if count > 0 {
            let detail = format!("points more than {MOST_OUTSIDE} image sizes outside, not used");
            self.events(EventKind::FarPoint, Some(&camera.name), count, detail);
        }
        Ok(())
    }

    fn detections(&mut self, frame: Detections) {
        let (index, capture) = (frame.camera, frame.capture);
        let Some(camera) = self.cameras.get_mut(index) else { return };
        let name = camera.name().to_owned();
        let (is_usable, warning) = camera.check_unit(capture);
        if !is_usable && warning.is_none() {
            camera.refused();
        }
        if let Some(detail) = warning {
            let detail = format!("{detail}; its frames are not used");
            self.event(EventKind::Unusable, Some(&name), detail);
        }
        if !is_usable {
            return;
        }
        let offset = self.time_offset(index);
        self.clock.correct(index, offset);
        if self.arrive(&frame, offset) {
            self.give(stage::Input::Detections(frame));
        }
    }

    /// Compares the arrival of a frame with that of the cameras' clock. `offset` is added to its capture time.
    /// Returns whether the frame can be used.
    pub(super) fn arrive(&mut self, frame: &Detections, offset: Nanos) -> bool {
        let (now, index, capture) = (self.now, frame.camera, frame.capture);
        let Some(camera) = self.cameras.get_mut(index) else { return false };
        let name = camera.name().to_owned();
        // What is due until now is of the clock so far.
        self.drain();
        let arrival = self.clock.arrive(index, now, capture + offset);
        self.report_strays();
        match arrival {
            Arrival::Used => {}
            Arrival::Refused => {
                if let Some(camera) = self.cameras.get_mut(index) {
                    camera.refused();
                }
                if let Some(stage) = self.stage.as_mut().filter(|_| self.clock.is_left_out(index)) {
                    stage.leave_out(index);
                }
                return false;
            }
            Arrival::NewClock(by) => self.new_clock(by),
        }
        let Some(camera) = self.cameras.get_mut(index) else { return false };
        if let Some(detail) = camera.frame(now, frame.frame, capture) {
            self.event(EventKind::Conflict, Some(&name), detail);
        }
        self.arrivals.push_back((capture + offset, now));
        if self.arrivals.len() > MOST_ARRIVALS {
            self.arrivals.pop_front();
        }
        self.review_delays();
        true
    }
}

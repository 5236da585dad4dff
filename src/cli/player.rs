//! Sends a recording onto the bus, each frame at its time.

use prost::Name as _;

use super::clock::Clock;
use super::take::{Due, Take, What};
use crate::bus::{Bus, BusError, Publisher};
use crate::msg::{KeypointFrame, Rig, Topics, media_type};
use crate::synth::{Disturbance, Disturbed};
use crate::time::Timestamp;

/// How a recording is played.
#[derive(Clone, Copy, Debug)]
pub(super) struct Playing {
    /// When the first frame of the recording is sent.
    pub(super) start: Timestamp,
    /// Seconds of the recording in a second.
    pub(super) speed: f64,
    /// Whether payloads are left as they are.
    pub(super) keep_times: bool,
    /// Whether it goes on from the beginning at the end.
    pub(super) repeat: bool,
    /// Whether the calibration is sent.
    pub(super) rig: bool,
    /// What happens to frames on their way.
    pub(super) disturbance: Disturbance,
}

/// What was sent.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Sent {
    /// Frames by camera, in the order of the take.
    pub(super) frames: Vec<u64>,
    /// Calibrations.
    pub(super) rigs: u64,
    /// Bytes of payload.
    pub(super) bytes: u64,
    /// What was done to frames.
    pub(super) disturbed: Disturbed,
    /// The longest time after its due time that a frame was sent, ns.
    pub(super) worst_late_ns: i64,
    /// From the first frame to the last, ns.
    pub(super) lasted_ns: i64,
}

impl Sent {
    /// Frames of all cameras.
    pub(super) fn all(&self) -> u64 {
        self.frames.iter().sum()
    }
}

/// Sends a take until its end or until `clock` says that an end is wished for. `each` is told what
/// was sent so far.
pub(super) fn play(
    take: &Take,
    how: &Playing,
    bus: &dyn Bus,
    topics: &Topics,
    clock: &dyn Clock,
    mut each: impl FnMut(&Sent),
) -> Result<Sent, BusError> {
    let mut player = Player::new(take, how, bus, topics)?;
    player.rig(0, clock.now())?;
    'playing: for round in 0.. {
        for due in take.round(round, &how.disturbance, &mut player.sent.disturbed) {
            if !clock.wait_until(player.time(due.at)) {
                break 'playing;
            }
            player.send(due, clock)?;
            each(&player.sent);
        }
        if !how.repeat {
            break;
        }
    }
    Ok(player.sent)
}

struct Player<'a> {
    take: &'a Take,
    how: &'a Playing,
    rig: Option<Box<dyn Publisher>>,
    cameras: Vec<Box<dyn Publisher>>,
    encoding: String,
    sent: Sent,
}

impl<'a> Player<'a> {
    fn new(
        take: &'a Take,
        how: &'a Playing,
        bus: &dyn Bus,
        topics: &Topics,
    ) -> Result<Self, BusError> {
        let has_rig = how.rig && take.rig(0).is_some();
        let cameras = take.cameras.iter();
        let cameras = cameras.map(|camera| bus.publisher(&topics.keypoints(&camera.name)));
        Ok(Self {
            take,
            how,
            rig: has_rig.then(|| bus.publisher(&topics.rig())).transpose()?,
            cameras: cameras.collect::<Result<_, _>>()?,
            encoding: media_type(&KeypointFrame::full_name()),
            sent: Sent { frames: vec![0; take.cameras.len()], ..Sent::default() },
        })
    }

    /// The time of the clock, from nanoseconds of the cameras' clock after the first frame.
    fn time(&self, cameras_ns: i64) -> Timestamp {
        self.how.start + (cameras_ns as f64 / self.how.speed).round() as i64
    }

    fn rig(&mut self, index: usize, now: Timestamp) -> Result<(), BusError> {
        if let (Some(publisher), Some(rig)) = (&self.rig, self.take.rig(index)) {
            publisher.put(now, &media_type(&Rig::full_name()), rig)?;
            self.sent.rigs += 1;
            self.sent.bytes += rig.len() as u64;
        }
        Ok(())
    }

    fn send(&mut self, due: Due, clock: &dyn Clock) -> Result<(), BusError> {
        let now = clock.now();
        let (camera, frame, round) = match due.what {
            What::Rig(index) => return self.rig(index, now),
            What::Frame { camera, frame, round } => (camera, frame, round),
        };
        let late = now - self.time(due.at);
        let bytes = if self.how.keep_times {
            let (capture, payload) = self.take.original(camera, frame);
            self.cameras[camera].put(capture, &self.encoding, payload)?;
            payload.len()
        } else {
            let capture = self.time(self.take.captured(camera, frame, round));
            let payload = self.take.stamped(camera, frame, round, capture);
            self.cameras[camera].put(capture, &self.encoding, &payload)?;
            payload.len()
        };
        self.sent.bytes += bytes as u64;
        self.sent.frames[camera] += 1;
        self.sent.worst_late_ns = self.sent.worst_late_ns.max(late);
        self.sent.lasted_ns = now - self.how.start;
        Ok(())
    }
}

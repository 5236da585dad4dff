//! Sends a recording to the bus, each frame at its time.

use prost::Name as _;

use super::take::{Due, Take, What};
use crate::cli::tools::{Disturbance, Disturbed};
use crate::core::time::{Nanos, Timestamp};
use crate::io::bus::{Bus, BusError, Publisher};
use crate::io::wire::{KeypointFrame, Rig, Topics, media_type};

/// A clock for playing.
pub(crate) trait Clock {
    /// The current time, nanoseconds since 1970.
    fn now(&self) -> Timestamp;

    /// Waits until that time; false if the wait was stopped.
    fn wait_until(&self, time: Timestamp) -> bool;
}

/// Settings of the playback.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Playing {
    /// Send time of the first frame.
    pub(crate) start: Timestamp,
    /// Playback speed; 1 is real time.
    pub(crate) speed: f64,
    /// Whether payloads are sent unchanged, with their recorded capture times.
    pub(crate) keep_times: bool,
    /// Whether the recording repeats after its end.
    pub(crate) repeat: bool,
    /// Whether the calibration is sent.
    pub(crate) rig: bool,
    /// How frames are disturbed.
    pub(crate) disturbance: Disturbance,
}

/// What was sent.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Sent {
    /// Frames by camera, in the order of the take.
    pub(crate) frames: Vec<u64>,
    /// Calibrations.
    pub(crate) rigs: u64,
    /// Bytes of payload.
    pub(crate) bytes: u64,
    /// Frames that were disturbed.
    pub(crate) disturbed: Disturbed,
    /// Longest delay of a frame after its due time.
    pub(crate) worst_delay: Nanos,
    /// Time from the first frame to the last.
    pub(crate) lasted: Nanos,
}

impl Sent {
    /// Number of frames of all cameras.
    pub(crate) fn all(&self) -> u64 {
        self.frames.iter().sum()
    }
}

/// Sends a take until its end or until a wait of `clock` is stopped. Calls `each` with the current
/// counts after each message.
pub(crate) fn play(
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
        let next = take.round_start(round + 1);
        if !how.repeat || !clock.wait_until(player.time(next)) {
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

    /// Converts a time of the cameras' clock since the first frame to the node's clock.
    fn time(&self, since_start: Nanos) -> Timestamp {
        self.how.start + Nanos::rounded(since_start.ns() as f64 / self.how.speed)
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
        self.sent.worst_delay = self.sent.worst_delay.max(late);
        self.sent.lasted = now - self.how.start;
        Ok(())
    }
}

#[cfg(all(test, feature = "research"))]
mod tests {
    use std::cell::Cell;
    use std::sync::{Arc, Mutex};

    use super::*;
    use crate::cli::tools::take::tests::{PERIOD, file, of};
    use crate::io::bus::{Guard, Memory, Sample};
    use crate::io::wire::decode;

    /// Jumps to each time that is waited for, and stops after a number of waits.
    struct Manual {
        now: Cell<Timestamp>,
        waits: Cell<u64>,
    }

    impl Clock for Manual {
        fn now(&self) -> Timestamp {
            self.now.get()
        }

        fn wait_until(&self, time: Timestamp) -> bool {
            self.now.set(self.now.get().max(time));
            self.waits.set(self.waits.get().saturating_sub(1));
            self.waits.get() > 0
        }
    }

    const NOW: Timestamp = Timestamp::from_ns(1_000_000_000_000);

    fn how() -> Playing {
        Playing {
            start: NOW + Nanos::new(500),
            speed: 1.0,
            keep_times: false,
            repeat: false,
            rig: true,
            disturbance: Disturbance::default(),
        }
    }

    fn heard(bus: &Memory) -> (Arc<Mutex<Vec<Sample>>>, Box<dyn Guard>) {
        let samples = Arc::new(Mutex::new(Vec::new()));
        let sink = Arc::clone(&samples);
        let guard = bus.subscribe("mocap/**", Box::new(move |s| sink.lock().unwrap().push(s)));
        (samples, guard.unwrap())
    }

    /// The messages that arrive when a take is played, and the report.
    fn played(take: &Take, how: &Playing, waits: u64) -> (Vec<Sample>, Sent) {
        let bus = Memory::new();
        let (samples, _guard) = heard(&bus);
        let clock = Manual { now: Cell::new(NOW), waits: Cell::new(waits) };
        let sent = play(take, how, &bus, &Topics::default(), &clock, |_| {}).unwrap();
        let samples = samples.lock().unwrap().clone();
        (samples, sent)
    }

    fn frame(sample: &Sample) -> KeypointFrame {
        decode(&sample.payload).unwrap()
    }

    #[test]
    fn the_rig_goes_first_then_frames_of_all_cameras_by_capture_time() {
        // The file holds one camera after the other.
        let take = of(&file(&[("b", &[0, 2, 4]), ("a", &[1, 3, 5])]), &[]);
        let (samples, sent) = played(&take, &how(), u64::MAX);
        assert_eq!(&*samples[0].topic, "mocap/stage/rig");
        let frames: Vec<KeypointFrame> = samples[1..].iter().map(frame).collect();
        let cameras: Vec<&str> = frames.iter().map(|f| f.camera.as_str()).collect();
        assert_eq!(cameras, ["b", "a", "b", "a", "b", "a"]);
        let start = how().start.ns();
        let times: Vec<i64> =
            frames.iter().map(|f| (f.capture_time_ns - start) / PERIOD.ns()).collect();
        assert_eq!(times, [0, 1, 2, 3, 4, 5]);
        for (sample, frame) in samples[1..].iter().zip(&frames) {
            assert_eq!(sample.capture.ns(), frame.capture_time_ns);
            assert_eq!(*sample.topic, Topics::default().keypoints(&frame.camera));
            assert_eq!(&*sample.encoding, "application/protobuf;bundlemocap.v1.KeypointFrame");
        }
        assert_eq!((sent.frames, sent.rigs, sent.worst_delay), (vec![3, 3], 1, Nanos::ZERO));
        assert_eq!(sent.lasted, PERIOD * 5);
    }

    #[test]
    fn kept_times_leave_every_byte() {
        let path = file(&[("a", &[0, 1, 2])]);
        let how = Playing { keep_times: true, speed: 4.0, rig: false, ..how() };
        let (samples, sent) = played(&of(&path, &[]), &how, u64::MAX);
        let mut reader = crate::io::recording::Reader::open(path.1).unwrap();
        let mut recorded = Vec::new();
        while let Some(raw) = reader.next_raw() {
            recorded.push(raw.unwrap());
        }
        recorded.retain(|raw| raw.topic.ends_with("keypoints"));
        assert_eq!(samples.len(), 3);
        for (sample, raw) in samples.iter().zip(recorded) {
            assert_eq!((&sample.payload, sample.capture), (&raw.payload, raw.publish_time));
        }
        assert_eq!((sent.rigs, sent.lasted), (0, PERIOD / 2));
    }

    #[test]
    fn speed_scales_the_distance_of_captures() {
        let take = of(&file(&[("a", &[0, 1, 3])]), &[]);
        let (samples, _) = played(&take, &Playing { speed: 0.5, ..how() }, u64::MAX);
        let times = samples[1..].iter().map(|s| (s.capture - how().start).ns() / PERIOD.ns());
        assert_eq!(times.collect::<Vec<_>>(), [0, 2, 6]);
    }

    #[test]
    fn a_loop_goes_on_in_time_and_in_frame_numbers() {
        let take = of(&file(&[("a", &[0, 1, 2])]), &[]);
        // The end of a round is waited for, too.
        let (samples, sent) = played(&take, &Playing { repeat: true, ..how() }, 11);
        assert_eq!(sent.frames, [8]);
        let frames: Vec<KeypointFrame> = samples[1..].iter().map(frame).collect();
        let first = frames[0].frame;
        for (index, frame) in frames.iter().enumerate() {
            assert_eq!(frame.frame, first + index as u64);
            assert_eq!(frame.capture_time_ns, how().start.ns() + index as i64 * PERIOD.ns());
        }
    }

    #[test]
    fn a_camera_alone_keeps_its_place_in_time() {
        let path = file(&[("a", &[0, 2]), ("b", &[1, 3])]);
        let (samples, _) = played(&of(&path, &["b"]), &how(), u64::MAX);
        let times = samples[1..].iter().map(|s| (s.capture - how().start).ns() / PERIOD.ns());
        assert_eq!(times.collect::<Vec<_>>(), [1, 3]);
        let error = Take::read(&path.1, &["c".to_owned()], None).unwrap_err().to_string();
        assert!(error.contains("\"c\"") && error.contains("a, b"), "{error}");
    }

    #[test]
    fn frames_out_of_order_stay_so_unless_the_clock_was_another() {
        let take = of(&file(&[("a", &[0, 2, 1, 3])]), &[]);
        let (samples, _) = played(&take, &how(), u64::MAX);
        let times = |samples: &[Sample]| -> Vec<i64> {
            samples[1..].iter().map(|s| (s.capture - how().start).ns() / PERIOD.ns()).collect()
        };
        assert_eq!(times(&samples), [0, 2, 1, 3]);
        let hour = 3600 * 1_000_000_000 / PERIOD.ns();
        let take = of(&file(&[("a", &[0, hour, 1, 2])]), &[]);
        let (samples, _) = played(&take, &how(), u64::MAX);
        assert_eq!(times(&samples), [0, 1, 2, hour]);
    }

    #[test]
    fn a_bad_network_is_counted() {
        let all: Vec<i64> = (0..200).collect();
        let take = of(&file(&[("a", &all)]), &[]);
        let disturbance = Disturbance { drop: 0.3, duplicate: 0.3, ..Disturbance::default() };
        let (samples, sent) = played(&take, &Playing { disturbance, ..how() }, u64::MAX);
        let Disturbed { dropped, duplicated, .. } = sent.disturbed;
        assert!(dropped > 20 && duplicated > 20);
        assert_eq!(sent.all(), 200 - dropped + duplicated);
        assert_eq!(samples.len() as u64, 1 + sent.all());
    }
}

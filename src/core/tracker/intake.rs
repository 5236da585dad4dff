//! The buffer of detections between arrival and use: ordered by capture time, each frame once.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::sync::Arc;

use super::event::{Event, EventKind};
use super::frame_rate::FrameRate;
use super::waiting::Waiting;
use crate::core::detections::{Detections, KeypointFormat};
use crate::core::time::{Nanos, Timestamp};

/// A capture time that is further than this, and than this many periods, off its camera's line is used
/// only if the camera's next one is off as well.
const STRAY: Nanos = Nanos::from_ms(250);
const STRAY_PERIODS: i64 = 4;
/// A capture time this far after all others, ns, is accepted only if a second one is near it.
const MAX_JUMP: Nanos = Nanos::from_ms(5000);
/// If one camera has gone on alone for this long, the others have stopped.
const ALONE: Nanos = Nanos::from_ms(5000);
/// If more frames than this seem to be missing at once, the counter has jumped.
const MAX_MISSING: u64 = 1_000_000;

/// Number of the last frames of a camera whose number is remembered: those in the buffer, and those that were not used.
const RECENT: usize = 64;

/// Number of steps of a camera's capture time of which the median counts.
const STEPS: usize = 5;

/// Frames by capture time, camera and number.
type Frames = BTreeMap<(Timestamp, usize, u64), Arc<Detections>>;

/// The state of one camera.
#[derive(Clone, Debug, Default)]
struct Seen {
    format: Option<KeypointFormat>,
    watermark: Option<Timestamp>,
    last_used: Option<u64>,
    used: u64,
    /// Number and capture time of its last frame that is not stray.
    last: Option<(u64, Timestamp)>,
    /// The last steps of its capture time.
    steps: [Nanos; STEPS],
    /// Numbers of the last frames that came and were not used.
    unused: BTreeSet<u64>,
    /// Number and capture time of its last frames in the buffer.
    recent: VecDeque<(u64, Timestamp)>,
}

impl Seen {
    /// Notes the time of a frame. Returns by how much an earlier frame is newer, if one is.
    fn reach(&mut self, capture: Timestamp) -> Option<Nanos> {
        let before = self.watermark;
        self.watermark = before.max(Some(capture));
        let step = capture - before?;
        if step < Nanos::ZERO {
            return Some(-step);
        }
        self.steps.rotate_left(1);
        self.steps[STEPS - 1] = step;
        None
    }
}

/// The frames that wait for their window or their frame set, and the state of each camera.
#[derive(Clone, Debug)]
pub(in crate::core) struct Intake {
    frames: Frames,
    cameras: Vec<Seen>,
    format: Option<KeypointFormat>,
    /// Frames up to this time are no longer used.
    closed: Option<Timestamp>,
    /// A capture time far after all others, not accepted yet.
    stray: Option<Timestamp>,
    /// Of each camera, a frame that is off its line and waits for the next one.
    held: Vec<Option<Detections>>,
    rate: FrameRate,
    /// The latest capture time that two cameras have reached, and the newest one at that moment.
    reached: Option<[Timestamp; 2]>,
    /// Which cameras are waited for.
    pub(in crate::core) waiting: Waiting,
}

impl Intake {
    /// A camera that was missing `grace` times in a row is not waited for.
    pub(in crate::core) fn new(cameras: usize, grace: usize) -> Self {
        Self {
            frames: BTreeMap::new(),
            cameras: vec![Seen::default(); cameras],
            format: None,
            closed: None,
            stray: None,
            held: vec![None; cameras],
            rate: FrameRate::new(cameras),
            reached: None,
            waiting: Waiting::new(cameras, grace),
        }
    }

    /// Receives a frame: checks it, and adds it to the buffer. `now` is the capture clock, if
    /// there is one; live, frames that came up to `grace` after it were worth waiting for. Returns what
    /// is to be reported.
    pub(in crate::core) fn receive(
        &mut self,
        mut frame: Detections,
        now: Option<Timestamp>,
        grace: Option<Nanos>,
    ) -> Vec<Event> {
        if let Some(flaw) = frame.flaw() {
            self.came_unused(frame.camera, frame.frame);
            let detail = format!("frame {}: {flaw}", frame.frame);
            return vec![of_frame(&frame, EventKind::Unusable, detail)];
        }
        let points = frame.people.iter_mut().flat_map(|person| &mut person.points);
        points.flatten().for_each(|point| point.confidence = point.confidence.min(1.0));
        let (frames, stray) = self.screen(frame);
        let mut events: Vec<Event> = stray.into_iter().collect();
        for frame in frames {
            events.extend(self.admit(frame, now, grace));
        }
        events
    }

    /// Adds a frame whose time was checked; the camera is waited for from here on.
    pub(in crate::core) fn admit(
        &mut self,
        frame: Detections,
        now: Option<Timestamp>,
        grace: Option<Nanos>,
    ) -> Vec<Event> {
        let (camera, capture) = (frame.camera, frame.capture);
        let mut events = self.vote(camera, frame.format);
        let number = frame.frame;
        let event = self.add(frame, now);
        if matches!(event.as_ref().map(|e| e.kind), Some(EventKind::Late | EventKind::Unusable)) {
            self.came_unused(camera, number);
        }
        let is_used = match event.as_ref().map(|event| event.kind) {
            None | Some(EventKind::OutOfOrder) => true,
            // It would have come in time if it had been waited for.
            Some(EventKind::Late) => grace.is_some_and(|grace| now <= Some(capture + grace)),
            _ => false,
        };
        let is_back = is_used && self.waiting.returned(camera);
        let returned = is_back.then(|| Event {
            capture,
            kind: EventKind::Returned,
            camera: Some(camera),
            window: None,
            count: 1,
            detail: "waited for again".to_owned(),
        });
        events.extend(event.into_iter().chain(returned));
        events
    }

    /// A frame of a camera came and is not used: it is not missing.
    fn came_unused(&mut self, camera: usize, number: u64) {
        let Some(seen) = self.cameras.get_mut(camera) else { return };
        seen.unused.insert(number);
        if seen.unused.len() > RECENT {
            seen.unused.pop_first();
        }
    }

    /// The frames to add when `frame` arrives: none if its capture time is far off its camera's line,
    /// until the camera's next frame; and an event if the frame before it was stray.
    fn screen(&mut self, frame: Detections) -> (Vec<Detections>, Option<Event>) {
        let Some(seen) = self.cameras.get_mut(frame.camera) else { return (vec![frame], None) };
        let period = self.rate.of_camera(frame.camera);
        let limit = period.map_or(STRAY, |p| STRAY.max(Nanos::rounded(p.ns) * STRAY_PERIODS));
        let off = seen.last.map_or(Nanos::ZERO, |(number, capture)| {
            let count = frame.frame.wrapping_sub(number).cast_signed() as f64;
            let by_count = period.map_or(Nanos::ZERO, |p| Nanos::rounded(count * p.ns));
            let (step, by_count) = (frame.capture - capture, frame.capture - (capture + by_count));
            if step.abs() < by_count.abs() { step } else { by_count }
        });
        let slot = &mut self.held[frame.camera];
        if off.abs() > limit && slot.is_none() {
            *slot = Some(frame);
            return (Vec::new(), None);
        }
        let held = slot.take();
        seen.last = Some((frame.frame, frame.capture));
        if off.abs() > limit {
            return (held.into_iter().chain([frame]).collect(), None);
        }
        if let Some(held) = &held {
            self.came_unused(held.camera, held.frame);
        }
        let stray = held.map(|held| {
            let off = held.capture.seconds_since(frame.capture);
            let number = held.frame;
            let detail = format!(
                "frame {number} is {off:+.3} s off the camera's frames before and after it"
            );
            of_frame(&frame, EventKind::Unusable, detail)
        });
        (vec![frame], stray)
    }

    /// The capture times of a camera are so much later from here on; also those of its frames that wait. Returns an
    /// event for each of these that is late now.
    pub(in crate::core) fn shift(&mut self, camera: usize, by: Nanos) -> Vec<Event> {
        let seen = self.cameras.get_mut(camera).filter(|_| by != Nanos::ZERO);
        let Some(seen) = seen else { return Vec::new() };
        self.rate.shift(camera, by);
        seen.watermark = seen.watermark.map(|watermark| watermark + by);
        self.reached = None;
        seen.last = seen.last.map(|(number, capture)| (number, capture + by));
        seen.recent.iter_mut().for_each(|(_, capture)| *capture = *capture + by);
        self.held[camera].iter_mut().for_each(|frame| frame.capture = frame.capture + by);
        // Earlier ones belong to a window that is being solved.
        let waits = |capture: &Timestamp| self.closed.is_none_or(|closed| *capture > closed);
        let is_own = |(capture, of, _): &(Timestamp, usize, u64)| *of == camera && waits(capture);
        let (own, others): (Frames, Frames) =
            std::mem::take(&mut self.frames).into_iter().partition(|(key, _)| is_own(key));
        self.frames = others;
        let mut events = Vec::new();
        for mut frame in own.into_values() {
            let own = Arc::make_mut(&mut frame);
            own.capture = own.capture + by;
            match self.late(&frame) {
                Some(event) => {
                    self.came_unused(camera, frame.frame);
                    events.push(event);
                }
                None => drop(self.frames.insert((frame.capture, camera, frame.frame), frame)),
            }
        }
        events
    }

    /// The event of a frame, if it is late.
    fn late(&self, frame: &Detections) -> Option<Event> {
        self.closed.filter(|closed| frame.capture <= *closed)?;
        let detail = format!("frame {} after its window closed", frame.frame);
        Some(of_frame(frame, EventKind::Late, detail))
    }

    /// The frames that wait for the next one of their camera.
    pub(in crate::core) fn release(&mut self) -> Vec<Detections> {
        self.held.iter_mut().filter_map(Option::take).collect()
    }

    /// Adds a frame; returns an event if the frame has a fault. `now` is the capture clock, if there is
    /// one.
    fn add(&mut self, frame: Detections, now: Option<Timestamp>) -> Option<Event> {
        let event = |kind, detail: String| Some(of_frame(&frame, kind, detail));
        if frame.camera >= self.cameras.len() {
            return event(EventKind::Unusable, format!("the rig has no camera {}", frame.camera));
        }
        if let Some(format) = self.format.filter(|format| *format != frame.format) {
            return Some(of_another_format(&frame, format));
        }
        if let Some(late) = self.late(&frame) {
            let seen = &mut self.cameras[frame.camera];
            if seen.recent.contains(&(frame.frame, frame.capture)) {
                return event(EventKind::Duplicate, format!("frame {} came twice", frame.frame));
            }
            // Otherwise a camera that was slow for a while would count as slow for good.
            seen.reach(frame.capture);
            return Some(late);
        }
        let newest = self.newest().map(|newest| now.map_or(newest, |now| now.max(newest)));
        if let Some(newest) = newest.filter(|newest| frame.capture - *newest > MAX_JUMP) {
            let last = self.stray.replace(frame.capture);
            if last.is_none_or(|last| (frame.capture - last).abs() > MAX_JUMP) {
                let ahead = frame.capture.seconds_since(newest);
                return event(EventKind::Unusable, format!("{ahead:.1} s ahead of all others"));
            }
        }
        let seen = &mut self.cameras[frame.camera];
        let key = (frame.capture, frame.camera, frame.frame);
        let twin = (frame.capture, frame.camera, 0)..=(frame.capture, frame.camera, u64::MAX);
        if self.frames.range(twin).next().is_some() {
            return event(EventKind::Duplicate, format!("frame {} came twice", frame.frame));
        }
        self.rate.note(frame.camera, frame.frame, frame.capture);
        seen.recent.push_back((frame.frame, frame.capture));
        if seen.recent.len() > RECENT {
            seen.recent.pop_front();
        }
        let behind = seen.reach(frame.capture);
        let found = behind.and_then(|by| event(EventKind::OutOfOrder, format!("{by} behind")));
        self.frames.insert(key, Arc::new(frame));
        if let Some((front, newest)) = self.front().zip(self.newest())
            && self.reached.is_none_or(|[before, _]| before != front)
        {
            self.reached = Some([front, newest]);
        }
        found
    }

    /// Notes the format of a camera. The first format is in use until more cameras send another. Then the frames of the
    /// old one leave the buffer; returns an event for each.
    fn vote(&mut self, camera: usize, format: KeypointFormat) -> Vec<Event> {
        let Some(seen) = self.cameras.get_mut(camera) else { return Vec::new() };
        seen.format = Some(format);
        let votes = |format| self.cameras.iter().filter(|c| c.format == Some(format)).count();
        let in_use = self.format.unwrap_or(format);
        let new = if votes(format) > votes(in_use) { format } else { in_use };
        self.format = Some(new);
        if new == in_use {
            return Vec::new();
        }
        let (kept, dropped): (Frames, Frames) =
            std::mem::take(&mut self.frames).into_iter().partition(|(_, of)| of.format == new);
        self.frames = kept;
        dropped.keys().for_each(|(_, camera, number)| self.came_unused(*camera, *number));
        dropped.values().map(|frame| of_another_format(frame, new)).collect()
    }

    /// Number of cameras.
    pub(in crate::core) fn cameras(&self) -> usize {
        self.cameras.len()
    }

    /// The order of the keypoints, after the first frame.
    pub(super) fn format(&self) -> Option<KeypointFormat> {
        self.format
    }

    /// The earliest frame in the buffer.
    pub(in crate::core) fn first(&self) -> Option<Timestamp> {
        self.frames.keys().next().map(|(capture, _, _)| *capture)
    }

    /// The latest frame in the buffer.
    pub(super) fn last(&self) -> Option<Timestamp> {
        self.frames.keys().next_back().map(|(capture, _, _)| *capture)
    }

    /// The latest capture time that any camera has shown.
    pub(super) fn newest(&self) -> Option<Timestamp> {
        self.cameras.iter().filter_map(|seen| seen.watermark).max()
    }

    /// The latest capture time that two cameras have reached, so that a single camera with a fast
    /// clock does not count. With one camera, its own.
    pub(in crate::core) fn front(&self) -> Option<Timestamp> {
        let mut watermarks: Vec<_> =
            self.cameras.iter().filter_map(|seen| seen.watermark).collect();
        watermarks.sort_unstable();
        watermarks.iter().rev().nth(1).or(watermarks.last()).copied()
    }

    /// As [`front`](Self::front). If one camera goes on alone, [`ALONE`] before its latest capture time.
    pub(in crate::core) fn front_or_alone(&self) -> Option<Timestamp> {
        let alone = self.reached.zip(self.newest());
        let alone = alone.filter(|([_, then], newest)| *newest - *then > ALONE);
        self.front().max(alone.map(|(_, newest)| newest - ALONE))
    }

    /// The usual time between two frames of a camera, if it is known.
    pub(in crate::core) fn step(&self, camera: usize) -> Option<Nanos> {
        let mut steps = self.cameras.get(camera)?.steps;
        steps.sort_unstable();
        Some(steps[STEPS / 2]).filter(|step| *step > Nanos::ZERO)
    }

    /// When the next frame of a camera may come, by the shortest of its last steps; `None` before its first frame. The
    /// shortest, because a camera that loses frames is not slow.
    pub(in crate::core) fn next(&self, camera: usize, period: Nanos) -> Option<Timestamp> {
        let seen = self.cameras.get(camera)?;
        let steps = seen.steps.iter().filter(|step| **step > Nanos::ZERO);
        // Capture times jitter.
        Some(seen.watermark? + steps.min().copied().unwrap_or(period).max(period))
    }

    /// Adds the counts of used frames of `before`, which had the same cameras.
    pub(in crate::core) fn count_on_from(&mut self, before: &Self) {
        for (new, old) in self.cameras.iter_mut().zip(&before.cameras) {
            new.used += old.used;
        }
    }

    /// Cameras without a frame at or after `time`.
    pub(in crate::core) fn behind(&self, time: Timestamp) -> impl Iterator<Item = usize> {
        let is_behind = move |seen: &Seen| seen.watermark.is_none_or(|watermark| watermark < time);
        (0..).zip(&self.cameras).filter(move |(_, seen)| is_behind(seen)).map(|(camera, _)| camera)
    }

    /// The cameras' frame rate.
    pub(in crate::core) const fn rate(&mut self) -> &mut FrameRate {
        &mut self.rate
    }

    /// Frames up to `end`, in order; they stay in the buffer.
    pub(super) fn up_to(&self, end: Timestamp) -> Vec<Arc<Detections>> {
        self.frames
            .range(..=(end, usize::MAX, u64::MAX))
            .map(|(_, frame)| Arc::clone(frame))
            .collect()
    }

    /// The latest capture time of a camera.
    pub(super) fn watermark(&self, camera: usize) -> Option<Timestamp> {
        self.cameras.get(camera)?.watermark
    }

    /// An event for each camera with frames in the buffer. For a tracker that begins anew without them.
    pub(in crate::core) fn abandoned(&self) -> impl Iterator<Item = Event> {
        let waiting = |camera: usize| {
            let held = u64::from(self.held[camera].is_some());
            held + self.frames.keys().filter(|(_, own, _)| *own == camera).count() as u64
        };
        let counts = (0..self.cameras.len()).map(move |camera| (camera, waiting(camera)));
        counts.filter(|(_, count)| *count > 0).map(|(camera, count)| Event {
            capture: self.newest().unwrap_or_default(),
            kind: EventKind::Abandoned,
            camera: Some(camera),
            window: None,
            count,
            detail: "waited for a window when tracking began anew".to_owned(),
        })
    }

    /// Number of frames of that camera that were used in windows.
    pub(in crate::core) fn used(&self, camera: usize) -> u64 {
        self.cameras.get(camera).map_or(0, |seen| seen.used)
    }

    /// Whether the frames in the buffer show anybody.
    pub(super) fn shows_somebody(&self) -> bool {
        self.frames.values().any(|frame| !frame.people.is_empty())
    }

    /// Refuses frames up to `end` from now on.
    pub(super) fn refuse(&mut self, end: Timestamp) {
        self.closed = self.closed.max(Some(end));
    }

    /// Removes the next frame set: the earliest frame and those up to `width` after it, at most one of
    /// each camera, in order of capture time. Refuses frames up to the earliest one from now on. Gives an
    /// event for each camera whose frame counter has gaps.
    pub(in crate::core) fn pop_set(&mut self, width: Nanos) -> (Vec<Detections>, Vec<Event>) {
        let Some(first) = self.first() else { return (Vec::new(), Vec::new()) };
        let mut keys: Vec<(Timestamp, usize, u64)> = Vec::new();
        let within = self.frames.range(..=(first + width, usize::MAX, u64::MAX));
        for (key, _) in within {
            if keys.iter().all(|(_, camera, _)| *camera != key.1) {
                keys.push(*key);
            }
        }
        self.refuse(first);
        let used: BTreeMap<_, _> =
            keys.iter().filter_map(|key| self.frames.remove_entry(key)).collect();
        let missing = self.count_used(&used, first);
        (used.into_values().map(Arc::unwrap_or_clone).collect(), missing)
    }

    /// Closes the time up to `end`: drops its frames and refuses later ones. Gives an event for each
    /// camera whose frame counter has gaps.
    pub(super) fn close(&mut self, end: Timestamp) -> Vec<Event> {
        self.refuse(end);
        let rest = self.frames.split_off(&(end + Nanos::new(1), 0, 0));
        let used = std::mem::replace(&mut self.frames, rest);
        self.count_used(&used, end)
    }

    /// Counts the used frames of each camera, and those that are missing between them.
    fn count_used(&mut self, used: &Frames, end: Timestamp) -> Vec<Event> {
        let mut missing = Vec::new();
        for (camera, seen) in self.cameras.iter_mut().enumerate() {
            // In order of capture.
            let numbers: Vec<u64> = used
                .keys()
                .filter(|(_, c, _)| *c == camera)
                .map(|(_, _, number)| *number)
                .collect();
            seen.used += numbers.len() as u64;
            let Some((&first, &last)) = numbers.first().zip(numbers.last()) else { continue };
            let from = seen.last_used.map_or(first, |last| last.saturating_add(1));
            seen.last_used = Some(last);
            // A counter that goes back has begun anew, or somebody else uses the camera's name.
            if from > first || !numbers.is_sorted() {
                seen.unused.clear();
                continue;
            }
            let later = seen.unused.split_off(&last.saturating_add(1));
            let unused = std::mem::replace(&mut seen.unused, later);
            let came = numbers.len() as u64 + unused.range(from..).count() as u64;
            let count = (last - from).saturating_add(1).saturating_sub(came);
            if (1..=MAX_MISSING).contains(&count) {
                missing.push(Event {
                    capture: end,
                    kind: EventKind::Missing,
                    camera: Some(camera),
                    window: None,
                    count,
                    detail: format!("of frames {from} to {last}"),
                });
            }
        }
        missing
    }
}

/// The event of a frame that is not in the format in use.
fn of_another_format(frame: &Detections, in_use: KeypointFormat) -> Event {
    let detail = format!("{} in a stream of {}", frame.format.name(), in_use.name());
    of_frame(frame, EventKind::Unusable, detail)
}

/// An event of a frame.
fn of_frame(frame: &Detections, kind: EventKind, detail: String) -> Event {
    let (capture, camera) = (frame.capture, Some(frame.camera));
    Event { capture, kind, camera, window: None, count: 1, detail }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn frame(camera: usize, number: u64, ms: i64) -> Detections {
        let (capture, people) = (Timestamp::from_ns(ms * 1_000_000), Vec::new());
        Detections { camera, frame: number, capture, format: KeypointFormat::Body25, people }
    }

    /// Frames of one camera, by number and milliseconds. Each is a set.
    fn received(intake: &mut Intake, frames: &[(u64, i64)]) -> Vec<(EventKind, u64)> {
        let mut events = Vec::new();
        for &(number, ms) in frames {
            events.extend(intake.receive(frame(0, number, ms), None, None));
            events.extend(intake.pop_set(Nanos::from_ms(1)).1);
        }
        events.into_iter().map(|event| (event.kind, event.count)).collect()
    }

    #[test]
    fn a_frame_that_comes_again_after_its_set_is_a_duplicate() {
        let mut intake = Intake::new(1, 3);
        let frames = [(0, 0), (1, 20), (1, 20), (2, 40), (1, 20), (5, 100), (4, 80)];
        let expected =
            [EventKind::Duplicate, EventKind::Duplicate, EventKind::Missing, EventKind::Late];
        let found = received(&mut intake, &frames);
        assert_eq!(found.iter().map(|(kind, _)| *kind).collect::<Vec<_>>(), expected);
        assert_eq!(found[2].1, 2);
    }

    #[test]
    fn refused_frames_are_not_missing_although_others_wait() {
        let mut intake = Intake::new(1, 3);
        let mut missing = |until: u64, numbers: std::ops::Range<u64>| {
            let ms = |number: u64| 20 * number as i64;
            for number in numbers.filter(|number| *number != 8) {
                let mut new = frame(0, number, ms(number));
                if number == 12 {
                    new.format = KeypointFormat::Coco17;
                }
                // A camera's format is that of most cameras.
                intake.format = Some(KeypointFormat::Body25);
                if intake.add(new, None).is_some() {
                    intake.came_unused(0, number);
                }
            }
            let events = intake.close(frame(0, 0, ms(until)).capture);
            events.iter().map(|event| event.count).sum::<u64>()
        };
        assert_eq!(missing(5, 0..14), 0);
        assert_eq!(missing(10, 14..17), 1, "frame 8");
        assert_eq!(missing(15, 17..20), 0, "frame 12 was refused");
    }

    #[test]
    fn frames_that_wait_are_counted_when_tracking_begins_anew() {
        let mut intake = Intake::new(2, 3);
        // The last one is off the line of its camera, and waits for the next one.
        for (camera, number, ms) in [(0, 0, 0), (1, 0, 0), (0, 1, 20), (1, 1, 20), (1, 2, 4000)] {
            intake.receive(frame(camera, number, ms), None, None);
        }
        intake.close(Timestamp::from_ns(0));
        let counts: Vec<_> = intake.abandoned().map(|event| (event.camera, event.count)).collect();
        assert_eq!(counts, [(Some(0), 1), (Some(1), 2)]);
    }

    #[test]
    fn a_counter_that_begins_anew_or_never_counts_misses_nothing() {
        let mut intake = Intake::new(1, 3);
        assert_eq!(received(&mut intake, &[(500, 0), (501, 20), (0, 40), (1, 60), (2, 80)]), []);
        assert_eq!(received(&mut intake, &[(4, 120)]), [(EventKind::Missing, 1)]);
        let mut intake = Intake::new(1, 3);
        assert_eq!(received(&mut intake, &[(0, 0), (0, 20), (0, 40)]), []);
        // Within a window.
        let mut intake = Intake::new(1, 3);
        for (number, ms) in [(500, 0), (501, 20), (0, 40), (1, 60)] {
            intake.receive(frame(0, number, ms), None, None);
        }
        assert!(intake.close(Timestamp::from_ns(60_000_000)).is_empty());
    }

    #[test]
    fn all_frames_of_an_abandoned_format_are_counted() {
        let mut intake = Intake::new(4, 3);
        let mut refused = 0;
        for number in 0..6 {
            for camera in 0..4 {
                let mut new = frame(camera, number, 20 * number as i64);
                if number < 3 {
                    new.format = KeypointFormat::Coco17;
                }
                let events = intake.receive(new, None, None);
                refused += events.iter().filter(|e| e.kind == EventKind::Unusable).count();
            }
        }
        assert_eq!(intake.format(), Some(KeypointFormat::Body25));
        assert_eq!(refused + intake.frames.len(), 24);
        assert_eq!(refused, 12 + 2, "the old format, and the new one before its majority");
    }
}

//! What is seen before and after a camera was moved.

use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;

use super::job::Placed;
use crate::core::calibration::Seen;
use crate::core::so3;
use crate::core::time::{Nanos, Timestamp};

/// A frame of each camera in this time is enough.
const EVERY: Nanos = Nanos::from_ms(60);
/// How much of what was seen is remembered, and the least that must be known of the time before a move.
const REMEMBERED: Nanos = Nanos::from_ms(50_000);
const LEAST: Nanos = Nanos::from_ms(8_000);
/// A move may be noticed this late; what was seen in this time before the finding is not used.
const UNSURE: Nanos = Nanos::from_ms(12_000);
/// The solver is asked again after this much more time with the performer in view.
const STEP: Nanos = Nanos::from_ms(10_000);
/// After this much data the fit starts over: the camera may have been moved again.
const LONGEST: Nanos = Nanos::from_ms(80_000);
/// A pose that differs by more than this from the known one is a new pose: 1 degree, 4 cm.
const ANOTHER: (f64, f64) = (0.0175, 0.04);

/// What was seen of late, window by window.
#[derive(Clone, Debug, Default)]
pub(super) struct Memory {
    windows: VecDeque<Seen>,
    /// By camera, the last frame that is kept.
    last: BTreeMap<usize, Timestamp>,
}

impl Memory {
    /// Adds what a window has seen; returns what is kept of it.
    pub(super) fn add(&mut self, mut window: Seen) -> Option<&Seen> {
        window.frames.retain(|frame| {
            let last = self.last.get(&frame.camera);
            let is_kept = last.is_none_or(|last| (frame.capture - *last).abs() >= EVERY);
            if is_kept {
                self.last.insert(frame.camera, frame.capture);
            }
            is_kept
        });
        window.span()?;
        self.windows.push_back(window);
        // Breaks do not count.
        while length(self.windows.iter()) > REMEMBERED {
            self.windows.pop_front();
        }
        self.windows.back()
    }

    /// What was seen before a move that was noticed now, if that is enough.
    fn before(&self, now: Timestamp) -> Option<Seen> {
        let is_sure = |seen: &&Seen| seen.span().is_some_and(|[_, end]| now - end > UNSURE);
        let sure = self.windows.iter().filter(is_sure);
        joined(sure.clone()).filter(|_| length(sure) >= LEAST)
    }
}

/// How long several windows are together.
fn length<'a>(windows: impl Iterator<Item = &'a Seen>) -> Nanos {
    let spans = windows.filter_map(Seen::span);
    spans.fold(Nanos::ZERO, |sum, [begin, end]| sum + (end - begin))
}

/// Several windows as one.
fn joined<'a>(mut windows: impl Iterator<Item = &'a Seen>) -> Option<Seen> {
    let mut all = windows.next()?.clone();
    windows.for_each(|window| all.append(window));
    Some(all)
}

/// A camera that was moved and is left out.
#[derive(Clone, Debug)]
pub(super) struct Mending {
    pub(super) camera: usize,
    before: Arc<Seen>,
    after: Option<Arc<Seen>>,
    /// Length of what must be seen for the next job.
    next: Nanos,
    /// The job that is out.
    pub(super) job: Option<u64>,
    pub(super) known: Option<Placed>,
}

impl Mending {
    /// `None` if too little is known of the time before.
    pub(super) fn new(camera: usize, memory: &Memory, now: Timestamp) -> Option<Self> {
        let before = Arc::new(memory.before(now)?);
        Some(Self { camera, before, after: None, next: STEP, job: None, known: None })
    }

    /// Forgets what was seen since the move, and the job.
    pub(super) fn begin_anew(&mut self) {
        (self.after, self.next, self.job) = (None, STEP, None);
    }

    /// Adds what a window has seen. Returns what was seen before and after the move when the solver is to
    /// be asked.
    pub(super) fn add(&mut self, window: &Seen) -> Option<[Arc<Seen>; 2]> {
        if self.job.is_some() {
            return None;
        }
        if self.next > LONGEST {
            self.begin_anew();
        }
        let Some(after) = &mut self.after else {
            self.after = Some(Arc::new(window.clone()));
            return None;
        };
        let all = Arc::make_mut(after);
        all.append(window);
        let [first, last] = all.span()?;
        if last - first < self.next {
            return None;
        }
        self.next = self.next + STEP;
        Some([Arc::clone(&self.before), Arc::clone(after)])
    }

    /// Notes the answer of the solver. Returns whether the camera is somewhere else than was known.
    pub(super) fn answer(&mut self, placed: Option<Placed>) -> bool {
        self.job = None;
        let Some(placed) = placed else { return false };
        let is_new = self.known.as_ref().is_none_or(|known| {
            let (to, from) = (&placed.camera, &known.camera);
            so3::angle_between(&to.rotation, &from.rotation) > ANOTHER.0
                || (to.centre_in_world() - from.centre_in_world()).norm() > ANOTHER.1
        });
        let error = |placed: &Placed| placed.by.position[1];
        if is_new || self.known.as_ref().is_none_or(|known| error(&placed) < error(known)) {
            self.known = Some(placed);
        }
        is_new
    }
}

//! Arrival minus capture time of one camera's frames: the offset of its clock plus the delay.
//!
//! A late frame is not an offset, and a burst of frames that had queued is not a clock. The smallest
//! offset falls at once, and rises only when all frames of three quarters of a second say so.

use std::collections::VecDeque;

use crate::core::time::{Nanos, Timestamp};
use crate::metrics::statistics::median;

/// Time in one bucket.
const BUCKET: Nanos = Nanos::from_ms(250);
/// Number of buckets that are kept.
const BUCKETS: usize = 12;
/// Number of buckets that make a change lasting.
const LASTING: usize = 3;
/// Number of smallest offsets that are kept, one per second.
const KEPT: usize = 30;
/// Number of smallest offsets that a line needs.
const LINE: usize = 5;
/// The offset from the other cameras is the smallest of this many seconds.
const COMPARED: usize = 10;
/// An offset that grows by more than this at once is a longer delay, not the clock.
const DELAY_CHANGE: Nanos = Nanos::from_ms(20);

/// Smallest and largest offset of the frames that arrived in a quarter of a second.
#[derive(Clone, Copy, Debug)]
struct Bucket {
    number: i64,
    least: Nanos,
    most: Nanos,
    /// The first frame's offset; the sum of what the frames are above it, and their number.
    first: Nanos,
    above: (Nanos, i64),
}

/// Why a camera's frames are not used.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum LeftOut {
    /// Its clock differs from the others' by this.
    Clock(Nanos),
    /// Its frames come this much later than the others'.
    Late(Nanos),
}

/// Frames that do not continue a camera's time line.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Step {
    /// Smallest change of the offset.
    pub(crate) by: Nanos,
    /// Number of frames in a row.
    pub(crate) count: u32,
    /// Arrival of the last one.
    pub(crate) at: Timestamp,
    /// Whether they are refused.
    pub(crate) is_far: bool,
}

/// Offsets of one camera.
#[derive(Clone, Debug, Default)]
pub(crate) struct CameraClock {
    buckets: VecDeque<Bucket>,
    /// Second of the node's clock, and smallest offset in it without changes of the delay and corrections.
    smallest: VecDeque<(i64, Nanos)>,
    /// By how much the delay has grown.
    changed: Nanos,
    /// What is added to its capture times: the offset of the calibration and the correction.
    correction: Nanos,
    /// Whether that has changed since its first frame.
    pub(crate) is_corrected: bool,
    /// Largest capture time, and the last arrival.
    pub(crate) last: Option<(Timestamp, Timestamp)>,
    pub(crate) step: Option<Step>,
    pub(crate) left_out: Option<LeftOut>,
    /// Whether no frame has come for a while, although the others send.
    pub(crate) is_silent: bool,
    /// Number of frames in a row that agree with the other cameras, while it is left out.
    pub(crate) agreeing: u32,
    /// Whether it was reported as left out.
    pub(crate) is_reported: bool,
}

impl CameraClock {
    /// Its frames are not used until it agrees; what they were is forgotten.
    pub(crate) fn leave_out(&mut self, why: LeftOut) {
        *self = Self { left_out: Some(why), ..self.anew() };
    }

    /// It is silent: what its frames were is forgotten.
    pub(crate) fn forget(&mut self) {
        *self = Self { is_silent: true, ..self.anew() };
    }

    /// A clock of which only the correction is known, and what was reported.
    fn anew(&self) -> Self {
        let Self { correction, is_corrected, is_reported, .. } = *self;
        Self { correction, is_corrected, is_reported, ..Self::default() }
    }

    /// What is added to its capture times.
    pub(crate) fn correction(&self) -> Nanos {
        self.correction
    }

    /// Its capture times are corrected by so much from here on.
    pub(crate) fn correct(&mut self, correction: Nanos) {
        let by = correction - std::mem::replace(&mut self.correction, correction);
        if by == Nanos::ZERO {
            return;
        }
        self.is_corrected |= self.last.is_some();
        for Bucket { least, most, first, .. } in &mut self.buckets {
            (*least, *most, *first) = (*least - by, *most - by, *first - by);
        }
        self.last = self.last.map(|(capture, arrival)| (capture + by, arrival));
    }

    /// Whether its frames are used, and come.
    pub(crate) fn is_used(&self) -> bool {
        self.left_out.is_none() && !self.is_silent
    }

    /// Adds a frame. Returns whether a bucket begins.
    pub(crate) fn note(&mut self, now: Timestamp, capture: Timestamp, offset: Nanos) -> bool {
        let largest = self.last.map_or(capture, |(last, _)| last.max(capture));
        (self.last, self.is_silent) = (Some((largest, now)), false);
        let before = self.level();
        let number = now.ns().div_euclid(BUCKET.ns());
        let begins = match self.buckets.back_mut() {
            Some(last) if last.number == number => {
                (last.least, last.most) = (last.least.min(offset), last.most.max(offset));
                last.above = (last.above.0 + (offset - last.first), last.above.1 + 1);
                false
            }
            _ => {
                let (above, first) = ((Nanos::ZERO, 1), offset);
                self.buckets.push_back(Bucket {
                    number,
                    least: offset,
                    most: offset,
                    above,
                    first,
                });
                true
            }
        };
        while self.buckets.len() > BUCKETS {
            self.buckets.pop_front();
        }
        let change = self.level().zip(before).map(|(level, before)| level - before);
        self.changed = match change {
            Some(change) if change > DELAY_CHANGE => self.changed + change,
            Some(change) if change < Nanos::ZERO => (self.changed + change).max(Nanos::ZERO),
            _ => self.changed,
        };
        let second = now.ns().div_euclid(Nanos::SECOND.ns());
        let offset = offset - self.changed + self.correction;
        match self.smallest.back_mut() {
            Some((last, smallest)) if *last == second => *smallest = offset.min(*smallest),
            _ => self.smallest.push_back((second, offset)),
        }
        while self.smallest.len() > KEPT {
            self.smallest.pop_front();
        }
        begins
    }

    /// The time line continues with another offset.
    pub(crate) fn restart(&mut self, now: Timestamp, offset: Nanos) {
        let last = self.last.map(|_| (now - offset, now));
        *self = Self { last, ..self.anew() };
        self.note(now, now - offset, offset);
    }

    fn recent(&self, buckets: usize) -> impl Iterator<Item = &Bucket> {
        self.buckets.iter().rev().take(buckets)
    }

    /// Whether there are enough frames to tell a lasting change.
    pub(crate) fn is_settled(&self) -> bool {
        self.buckets.len() >= LASTING
    }

    /// The lasting smallest offset.
    pub(crate) fn level(&self) -> Option<Nanos> {
        self.recent(LASTING).map(|bucket| bucket.least).min()
    }

    /// What many frames of each of the last buckets reach: half-way from their mean to the largest.
    pub(crate) fn lasting(&self) -> Option<Nanos> {
        let mean = |bucket: &Bucket| bucket.first + bucket.above.0 / bucket.above.1.max(1);
        let reached = |bucket: &Bucket| mean(bucket) + (bucket.most - mean(bucket)) / 2;
        let lasting = self.recent(LASTING).map(reached).min();
        lasting.filter(|_| self.is_settled())
    }

    /// The largest offset of the last buckets.
    pub(crate) fn most(&self) -> Option<Nanos> {
        self.recent(LASTING).map(|bucket| bucket.most).max()
    }

    /// The offset that frames stay below, except outliers: twice as far from the smallest as the
    /// largest of the usual bucket.
    pub(crate) fn usual_most(&self) -> Option<Nanos> {
        let least = self.recent(BUCKETS).map(|bucket| bucket.least).min()?;
        let most = self.recent(BUCKETS).map(|bucket| (bucket.most - least).ns() as f64);
        let spread = median(&most.collect::<Vec<f64>>()).unwrap_or_default();
        Some(least + Nanos::rounded(2.0 * spread))
    }

    /// Smallest offset of the last seconds without changes of the delay and corrections, to be compared.
    pub(crate) fn compared(&self) -> Option<Nanos> {
        self.smallest.iter().rev().take(COMPARED).map(|(_, offset)| *offset).min()
    }

    /// Current offset, ns, and drift, parts per million: a line through the smallest offsets that a
    /// third of outliers does not move.
    pub(crate) fn line(&self, now: Timestamp) -> Option<(f64, f64)> {
        let Line { slope, offset, origin, .. } = self.robust_line()?;
        let at = now.ns() as f64 / 1e9 - origin as f64;
        // ns per second are 1e-9; the drift is in 1e-6.
        let changed = (self.changed - self.correction).ns() as f64;
        Some((offset + changed + slope * at, slope * 1e-3))
    }

    /// Drift, ns per second, if it is significant: offsets of 15 s or more lie on a line.
    pub(crate) fn drift(&self) -> Option<f64> {
        let Line { slope, spread, count, .. } = self.robust_line()?;
        let is_clear = count >= KEPT / 2 && slope.abs() * count as f64 > 6.0 * spread + 1e5;
        is_clear.then_some(slope)
    }

    fn robust_line(&self) -> Option<Line> {
        let &(origin, base) = self.smallest.back()?;
        let count = self.smallest.len();
        if count < LINE {
            let least = self.smallest.iter().map(|(_, offset)| *offset).min()?;
            return Some(Line {
                origin,
                offset: least.ns() as f64,
                slope: 0.0,
                spread: 0.0,
                count,
            });
        }
        let point = |&(second, offset): &(i64, Nanos)| {
            ((second - origin) as f64 + 0.5, (offset - base).ns() as f64)
        };
        let points: Vec<(f64, f64)> = self.smallest.iter().map(point).collect();
        let pairs = points
            .iter()
            .enumerate()
            .flat_map(|(i, a)| points[..i].iter().map(move |b| (a.1 - b.1) / (a.0 - b.0)));
        let slope = median(&pairs.collect::<Vec<f64>>())?;
        let offset = median(&points.iter().map(|(x, y)| y - slope * x).collect::<Vec<f64>>())?;
        let far = points.iter().map(|(x, y)| (y - offset - slope * x).abs());
        let spread = median(&far.collect::<Vec<f64>>())?;
        Some(Line { origin, offset: base.ns() as f64 + offset, slope, spread, count })
    }
}

/// A line through the smallest offsets \[Sen 1968\].
struct Line {
    /// Second at which `offset` holds.
    origin: i64,
    /// ns, without changes of the delay and corrections.
    offset: f64,
    /// ns per second.
    slope: f64,
    /// Median distance from the line, ns.
    spread: f64,
    count: usize,
}

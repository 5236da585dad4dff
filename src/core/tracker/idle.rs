//! Nothing to track is a state of a live tracker, not a failure: no camera sends frames, as between
//! takes, or nobody has been seen for a while.
//!
//! While nothing comes, windows stay open. Poses are extrapolated for as long as a performer may be
//! hidden, then there are none until poses are solved again.

use super::event::EventKind;
use super::state_machine::Tracker;
use crate::core::time::{Nanos, Timestamp};

/// Cameras that have sent nothing for this long, or for four frames, are idle.
const SILENCE: Nanos = Nanos::from_ms(250);
/// A place where nobody has been seen for this long is idle.
const UNSEEN: Nanos = Nanos::from_ms(3000);
/// After idling, poses may be late for this long: frames may have queued.
const RESUMING: Nanos = Nanos::from_ms(1000);

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Why {
    Silent,
    Unseen,
}

/// Whether there is something to track.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Idle {
    /// Why there is nothing, and since when; `None` after a clock jump.
    why: Option<(Why, Option<Timestamp>)>,
    /// When frames came again, or the latency fell.
    resumed: Option<Timestamp>,
    /// Since when nobody has been seen.
    unseen: Option<Timestamp>,
}

impl Idle {
    /// Forgets times of before a clock jump.
    pub(super) fn clock_jumped(&mut self) {
        (self.resumed, self.unseen) = (None, None);
        self.why = self.why.map(|(why, _)| (why, None));
    }
}

impl Tracker {
    /// Whether there is nothing to track: cameras are silent, or nobody has been seen for a while.
    pub fn is_idle(&self) -> bool {
        self.idle.why.is_some()
    }

    /// Whether no frames come, or came just now: poses that are not solved in time say nothing of the
    /// solver.
    pub fn is_resuming(&self) -> bool {
        let is_silent = matches!(self.idle.why, Some((Why::Silent, _)));
        let recent = |now: Timestamp| self.idle.resumed.is_some_and(|at| now - at < RESUMING);
        is_silent || self.now.is_some_and(recent)
    }

    /// Poses may be late for a moment.
    pub(super) fn resume(&mut self) {
        self.idle.resumed = self.now;
    }

    /// Whether no two cameras have come near the end of the open window, so that nothing can be solved.
    pub(super) fn is_starved(&self) -> bool {
        let start = self.start.filter(|_| self.pending.is_none());
        if self.is_fed {
            let end = start.map(|start| start + self.span() - self.tolerance());
            return end.is_some_and(|end| self.complete < Some(end));
        }
        let frames = self.open_frames().saturating_sub(1) as f64 - 0.5;
        let near_end = Nanos::rounded(frames * self.frame_period());
        start.is_some_and(|start| self.intake.front() < Some(start + near_end))
    }

    /// Live: the cameras fall silent, or send again.
    pub(super) fn watch_idle(&mut self) {
        let (Some(now), Some(front)) =
            (self.now.filter(|_| self.live.is_some()), self.intake.front())
        else {
            return;
        };
        if self.is_fed && self.complete.is_none() {
            // Of several performers, nothing comes until it is clear who it is.
            return;
        }
        let frames = Nanos::rounded(4.0 * self.frame_period());
        let is_silent = now - front - self.delay > SILENCE.max(frames);
        match self.idle.why {
            Some((Why::Silent, since)) if !is_silent => {
                self.resume();
                let detail = match self.is_fed {
                    true => "the performer is seen again",
                    false => "frames come again",
                };
                self.end_idle(now, since, detail);
            }
            None if is_silent => {
                let detail = match self.is_fed {
                    true => "the performer is not seen",
                    false => "fewer than two cameras send frames",
                };
                self.begin_idle(Why::Silent, front, detail);
            }
            Some((Why::Unseen, since)) if is_silent => self.idle.why = Some((Why::Silent, since)),
            _ => {}
        }
    }

    /// Nobody was found up to `end`. Returns whether that is news: live, nobody at all is, once.
    pub(super) fn watch_unseen(&mut self, start: Timestamp, end: Timestamp) -> bool {
        if self.live.is_none() || self.sees_somebody() {
            self.seen(end);
            return true;
        }
        let is_news = self.idle.unseen.is_none() && self.idle.why.is_none();
        let since = *self.idle.unseen.get_or_insert(start);
        if self.idle.why.is_none() && end - since > UNSEEN {
            self.begin_idle(Why::Unseen, since, "nobody is seen");
        }
        is_news
    }

    /// Somebody is seen.
    pub(super) fn seen(&mut self, at: Timestamp) {
        self.idle.unseen = None;
        if let Some((Why::Unseen, since)) = self.idle.why {
            self.end_idle(at, since, "somebody is seen");
        }
    }

    fn begin_idle(&mut self, why: Why, since: Timestamp, detail: &str) {
        self.idle.why = Some((why, Some(since)));
        self.event(EventKind::Idle, since, None, detail.to_owned());
    }

    fn end_idle(&mut self, now: Timestamp, since: Option<Timestamp>, detail: &str) {
        self.idle.why = None;
        let after = since.map(|since| format!(", after {:.1} s", now.seconds_since(since)));
        let detail = format!("no longer: {detail}{}", after.unwrap_or_default());
        self.event(EventKind::Idle, now, None, detail);
    }
}

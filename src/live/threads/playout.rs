//! Publishes poses at their due times: a list by due time, and a thread that watches the clock.
//!
//! The thread sleeps until shortly before the next due time, then spins.

use std::collections::BTreeMap;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use crossbeam_channel::Sender;

use super::outlet::Outlet;
use crate::core::time::{Nanos, Timestamp};
use crate::live::clock::wall::{HEAD_START, WallClock};
use crate::live::core::publication::Publication;

/// Time over which deviations are collected.
const BATCH: Nanos = Nanos::SECOND;
/// Most deviations in a batch; a node that is behind sends several batches.
const BATCH_MOST: usize = 4096;

/// Publications by due time; those with equal due times stay in order of arrival.
#[derive(Default)]
pub struct Schedule {
    waiting: BTreeMap<(Timestamp, u64), Publication>,
    count: u64,
}

impl Schedule {
    /// Adds a publication. Returns whether it is now the next one.
    pub fn push(&mut self, due: Timestamp, publication: Publication) -> bool {
        let is_next = self.next_due().is_none_or(|next| due < next);
        self.waiting.insert((due, self.count), publication);
        self.count += 1;
        is_next
    }

    /// Due time of the next publication.
    pub fn next_due(&self) -> Option<Timestamp> {
        self.waiting.first_key_value().map(|((due, _), _)| *due)
    }

    /// The next publication and its due time, if it is due.
    pub fn take_due(&mut self, now: Timestamp) -> Option<(Timestamp, Publication)> {
        let next = self.waiting.first_entry().filter(|next| next.key().0 <= now)?;
        let ((due, _), publication) = next.remove_entry();
        Some((due, publication))
    }
}

/// Deviations from due times, collected for about a second.
#[derive(Default)]
pub struct Deviations {
    batch: Vec<i32>,
    since: Timestamp,
}

impl Deviations {
    /// Adds a publication that left at `left` and was due at `due`.
    pub fn record(&mut self, due: Timestamp, left: Timestamp) {
        if self.batch.is_empty() {
            self.since = left;
        }
        let us = ((left - due).ns() / 1000).clamp(i32::MIN.into(), i32::MAX.into());
        self.batch.push(us as i32);
    }

    /// When the batch is complete; `None` if it is empty.
    pub fn full_at(&self) -> Option<Timestamp> {
        match self.batch.len() {
            0 => None,
            n if n >= BATCH_MOST => Some(self.since),
            _ => Some(self.since + BATCH),
        }
    }

    /// The batch, if it is complete; microseconds, positive is late.
    pub fn take_full(&mut self, now: Timestamp) -> Option<Vec<i32>> {
        self.full_at().filter(|at| *at <= now).map(|_| std::mem::take(&mut self.batch))
    }

    /// The batch as it is.
    pub fn take(&mut self) -> Vec<i32> {
        std::mem::take(&mut self.batch)
    }
}

/// State that the node loop and the timer thread share.
#[derive(Default)]
pub(crate) struct Playout {
    waiting: Mutex<Waiting>,
    changed: Condvar,
}

#[derive(Default)]
struct Waiting {
    schedule: Schedule,
    closed: bool,
}

impl Playout {
    /// Schedules a publication for its due time. Returns at once.
    pub(crate) fn push(&self, due: Timestamp, publication: Publication) {
        if self.lock().schedule.push(due, publication) {
            self.changed.notify_one();
        }
    }

    /// Ends the input; the thread ends after the last publication.
    pub(crate) fn close(&self) {
        self.lock().closed = true;
        self.changed.notify_one();
    }

    /// The thread's loop: publishes until closed and empty.
    pub(crate) fn run(
        self: Arc<Self>,
        clock: WallClock,
        mut outlet: Outlet,
        played: &Sender<Vec<i32>>,
    ) {
        let mut deviations = Deviations::default();
        while let Some((due, publication)) = self.wait(clock, &mut deviations, played) {
            if outlet.put(&publication, clock.now()) {
                deviations.record(due, clock.now());
            }
        }
        let rest = deviations.take();
        if !rest.is_empty() {
            let _ = played.try_send(rest);
        }
    }

    /// Waits for the next due time; `None` when closed and empty.
    fn wait(
        &self,
        clock: WallClock,
        deviations: &mut Deviations,
        played: &Sender<Vec<i32>>,
    ) -> Option<(Timestamp, Publication)> {
        let mut waiting = self.lock();
        loop {
            let now = clock.now();
            if let Some(next) = waiting.schedule.take_due(now) {
                return Some(next);
            }
            if let Some(batch) = deviations.take_full(now) {
                let _ = played.try_send(batch);
            }
            let due = waiting.schedule.next_due();
            if due.is_none() && waiting.closed {
                return None;
            }
            let pause = due.map(|due| clock.until(due));
            waiting = match pause.map(|pause| pause.saturating_sub(HEAD_START)) {
                Some(Duration::ZERO) => {
                    drop(waiting);
                    clock.wait_until(due.unwrap_or(now));
                    self.lock()
                }
                sleep => self.sleep(waiting, clock, sleep, deviations.full_at()),
            };
        }
    }

    /// Sleeps until something changes, at most for `pause`, or until a batch is complete.
    fn sleep<'a>(
        &'a self,
        waiting: MutexGuard<'a, Waiting>,
        clock: WallClock,
        pause: Option<Duration>,
        full_at: Option<Timestamp>,
    ) -> MutexGuard<'a, Waiting> {
        // While poses are due, a batch is sent after the next of them.
        match pause.or_else(|| full_at.map(|at| clock.until(at))) {
            Some(pause) => {
                let slept = self.changed.wait_timeout(waiting, pause);
                slept.unwrap_or_else(PoisonError::into_inner).0
            }
            None => self.changed.wait(waiting).unwrap_or_else(PoisonError::into_inner),
        }
    }

    fn lock(&self) -> MutexGuard<'_, Waiting> {
        self.waiting.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::io::wire::Pose;
    use crate::live::Content;

    fn at(ns: i64) -> Timestamp {
        Timestamp::from_ns(ns)
    }

    fn publication(name: &str) -> Publication {
        let content = Content::Pose(Pose::default());
        Publication { topic: name.into(), capture: Timestamp::default(), due: None, content }
    }

    fn take(schedule: &mut Schedule, now: i64) -> Option<String> {
        schedule.take_due(at(now)).map(|(_, publication)| publication.topic.to_string())
    }

    #[test]
    fn publications_leave_by_due_time_then_in_the_order_in_which_they_came() {
        let mut schedule = Schedule::default();
        assert_eq!(schedule.next_due(), None);
        assert!(schedule.push(at(20), publication("b")));
        assert!(!schedule.push(at(30), publication("d")));
        assert!(!schedule.push(at(20), publication("c")));
        assert!(schedule.push(at(10), publication("a")));
        assert_eq!(schedule.next_due(), Some(at(10)));
        assert_eq!(take(&mut schedule, 9), None);
        assert_eq!(take(&mut schedule, 10).as_deref(), Some("a"));
        assert_eq!(take(&mut schedule, 10), None);
        for expected in ["b", "c", "d"] {
            assert_eq!(take(&mut schedule, 100).as_deref(), Some(expected));
        }
        assert_eq!(take(&mut schedule, 100), None);
    }

    #[test]
    fn deviations_are_given_a_second_after_the_first_or_when_there_are_many() {
        let mut deviations = Deviations::default();
        assert_eq!((deviations.full_at(), deviations.take_full(at(i64::MAX))), (None, None));
        deviations.record(at(1_000_000), at(1_500_000));
        deviations.record(at(2_000_000), at(1_990_000));
        deviations.record(at(0), at(i64::MAX));
        assert_eq!(deviations.full_at(), Some(at(1_500_000) + BATCH));
        assert_eq!(deviations.take_full(at(0) + BATCH), None);
        let batch = deviations.take_full(at(1_500_000) + BATCH);
        assert_eq!(batch, Some(vec![500, -10, i32::MAX]));
        (0..BATCH_MOST).for_each(|_| deviations.record(at(0), at(5)));
        assert_eq!(deviations.take_full(at(5)).map(|batch| batch.len()), Some(BATCH_MOST));
        assert!(deviations.take().is_empty());
    }
}

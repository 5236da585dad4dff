//! What comes from the bus, in a queue of limited length.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};
use std::time::Duration;

use crossbeam_channel::{Receiver, Sender, bounded};

use crate::core::time::Timestamp;
use crate::io::bus::{Bus, BusError, Guard, Sample};
use crate::live::wall::WallClock;

/// Most messages that wait.
const MESSAGES: usize = 16_384;
/// Most bytes that wait.
const BYTES: usize = 256 << 20;

/// A message that came.
#[derive(Clone, Debug)]
pub(crate) struct Received {
    pub(crate) sample: Sample,
    /// When it came, by the wall clock.
    pub(crate) arrival: Timestamp,
}

/// A subscription whose messages wait in a queue; those that come while it is full are dropped and
/// counted.
pub(crate) struct Inbox {
    guard: Option<Box<dyn Guard>>,
    queue: Receiver<Received>,
    count: Arc<Count>,
}

#[derive(Default)]
struct Count {
    waiting_bytes: AtomicUsize,
    dropped: AtomicU64,
}

impl Inbox {
    /// Subscribes to the topics that match.
    pub(crate) fn open(bus: &dyn Bus, pattern: &str) -> Result<Self, BusError> {
        Self::of_size(bus, pattern, MESSAGES, BYTES)
    }

    pub(crate) fn of_size(
        bus: &dyn Bus,
        pattern: &str,
        messages: usize,
        bytes: usize,
    ) -> Result<Self, BusError> {
        let (sender, queue) = bounded(messages);
        let count = Arc::new(Count::default());
        let shared = Arc::clone(&count);
        let clock = WallClock::start();
        let sink = move |sample| {
            shared.take(Received { sample, arrival: clock.now() }, &sender, bytes);
        };
        let guard = bus.subscribe(pattern, Box::new(sink))?;
        Ok(Self { guard: Some(guard), queue, count })
    }

    /// The next message, waiting for it no longer than that.
    pub(crate) fn next(&self, within: Duration) -> Option<Received> {
        let received = self.queue.recv_timeout(within).ok()?;
        self.count.waiting_bytes.fetch_sub(received.sample.payload.len(), Ordering::AcqRel);
        Some(received)
    }

    /// Takes no more messages; those that wait can still be had.
    pub(crate) fn close(&mut self) {
        self.guard = None;
    }

    /// Messages that were dropped.
    pub(crate) fn dropped(&self) -> u64 {
        self.count.dropped.load(Ordering::Acquire)
    }
}

impl Count {
    fn take(&self, received: Received, queue: &Sender<Received>, most_bytes: usize) {
        let bytes = received.sample.payload.len();
        let waiting = self.waiting_bytes.fetch_add(bytes, Ordering::AcqRel);
        // A message that alone is larger than the limit still passes an empty queue.
        let is_full = waiting > 0 && waiting + bytes > most_bytes;
        if is_full || queue.try_send(received).is_err() {
            self.waiting_bytes.fetch_sub(bytes, Ordering::AcqRel);
            self.dropped.fetch_add(1, Ordering::AcqRel);
        }
    }
}

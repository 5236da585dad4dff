//! A queue of limited length for messages from the bus.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};
use std::time::Duration;

use crossbeam_channel::{Receiver, Sender, bounded};

use crate::cli::terminal::complain;
use crate::core::time::Timestamp;
use crate::io::bus::{Bus, BusError, Guard, Sample};
use crate::io::recording::Message;
use crate::io::wire::{DecodeError, ENCODING, schema_of};
use crate::live::WallClock;

/// Most messages that wait.
const MESSAGES: usize = 16_384;
/// Most bytes that wait.
const BYTES: usize = 256 << 20;

/// A received message.
#[derive(Clone, Debug)]
pub(crate) struct Received {
    pub(crate) sample: Sample,
    /// Arrival time, nanoseconds since 1970.
    pub(crate) arrival: Timestamp,
}

impl Received {
    /// The message, by the schema that topic and encoding name.
    pub(crate) fn message(&self) -> Result<Message, DecodeError> {
        let sample = &self.sample;
        match schema_of(&sample.topic, &sample.encoding) {
            Some(schema) => Message::decode(&sample.topic, schema, ENCODING, &sample.payload),
            None => Message::decode(&sample.topic, "", &sample.encoding, &[]),
        }
    }
}

/// Number of messages that could not be used.
#[derive(Default)]
pub(crate) struct Unusable(pub(crate) u64);

impl Unusable {
    /// The value; an error is counted, and the first one is printed.
    pub(crate) fn value<T>(&mut self, result: Result<T, DecodeError>) -> Option<T> {
        let count = |error: &DecodeError| {
            if self.0 == 0 {
                complain("warning", &format!("unusable message: {error}"));
            }
            self.0 += 1;
        };
        result.inspect_err(count).ok()
    }
}

/// A subscription with a queue; messages that arrive while it is full are dropped and counted.
pub(crate) struct Inbox {
    guards: Vec<Box<dyn Guard>>,
    queue: Receiver<Received>,
    count: Arc<Count>,
}

struct Count {
    clock: WallClock,
    waiting_bytes: AtomicUsize,
    dropped: AtomicU64,
}

impl Inbox {
    /// Subscribes to the topics that match the pattern.
    pub(crate) fn open(bus: &dyn Bus, pattern: &str) -> Result<Self, BusError> {
        Self::of_size(bus, &[pattern], MESSAGES, BYTES)
    }

    /// Subscribes to the topics that match one of the patterns.
    pub(crate) fn open_all(bus: &dyn Bus, patterns: &[String]) -> Result<Self, BusError> {
        let patterns: Vec<&str> = patterns.iter().map(String::as_str).collect();
        Self::of_size(bus, &patterns, MESSAGES, BYTES)
    }

    pub(crate) fn of_size(
        bus: &dyn Bus,
        patterns: &[&str],
        messages: usize,
        bytes: usize,
    ) -> Result<Self, BusError> {
        let (sender, queue) = bounded(messages);
        let count = Arc::new(Count {
            clock: WallClock::start(),
            waiting_bytes: AtomicUsize::new(0),
            dropped: AtomicU64::new(0),
        });
        let subscribe = |pattern: &&str| {
            let (shared, sender) = (Arc::clone(&count), sender.clone());
            bus.subscribe(pattern, Box::new(move |sample| shared.take(sample, &sender, bytes)))
        };
        let guards = patterns.iter().map(subscribe).collect::<Result<_, _>>()?;
        Ok(Self { guards, queue, count })
    }

    /// The next message; waits for it at most that long.
    pub(crate) fn next(&self, within: Duration) -> Option<Received> {
        let received = self.queue.recv_timeout(within).ok()?;
        self.count.waiting_bytes.fetch_sub(received.sample.payload.len(), Ordering::AcqRel);
        Some(received)
    }

    /// Ends the subscription; queued messages can still be read.
    pub(crate) fn close(&mut self) {
        self.guards.clear();
    }

    /// Number of dropped messages.
    pub(crate) fn dropped(&self) -> u64 {
        self.count.dropped.load(Ordering::Acquire)
    }
}

impl Count {
    fn take(&self, sample: Sample, queue: &Sender<Received>, most_bytes: usize) {
        let bytes = sample.payload.len();
        let waiting = self.waiting_bytes.fetch_add(bytes, Ordering::AcqRel);
        let received = Received { sample, arrival: self.clock.now() };
        // A single message above the limit still passes an empty queue.
        let is_full = waiting > 0 && waiting + bytes > most_bytes;
        if is_full || queue.try_send(received).is_err() {
            self.waiting_bytes.fetch_sub(bytes, Ordering::AcqRel);
            self.dropped.fetch_add(1, Ordering::AcqRel);
        }
    }
}

//! The queue between the bus and the node loop. `push` never blocks: when the queue is full, it
//! drops and counts the oldest messages.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};

use crossbeam_channel::{Receiver, Sender, TrySendError, bounded};

/// Most bytes that wait, at any number of messages.
const MOST_BYTES: usize = 64 << 20;

/// A message from the bus.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Message {
    /// Its topic.
    pub topic: Arc<str>,
    /// Its bytes.
    pub payload: Vec<u8>,
}

/// The queue; clones share it.
#[derive(Clone)]
pub struct Intake {
    sender: Sender<Message>,
    receiver: Receiver<Message>,
    dropped: Arc<AtomicU64>,
    bytes: Arc<AtomicUsize>,
}

impl Intake {
    /// A queue for that many messages and 64 MiB.
    pub fn new(messages: usize) -> Self {
        let (sender, receiver) = bounded(messages.max(1));
        Self { sender, receiver, dropped: Arc::default(), bytes: Arc::default() }
    }

    /// Adds a message without blocking; drops the oldest messages if there is no room.
    pub fn push(&self, message: Message) {
        let mut waiting =
            self.bytes.fetch_add(message.payload.len(), Ordering::Relaxed) + message.payload.len();
        while waiting > MOST_BYTES && self.drop_oldest() {
            waiting = self.bytes.load(Ordering::Relaxed);
        }
        let mut message = message;
        while let Err(TrySendError::Full(back)) = self.sender.try_send(message) {
            self.drop_oldest();
            message = back;
        }
    }

    /// The receiving end. Call [`Intake::took`] for each received message.
    pub fn receiver(&self) -> &Receiver<Message> {
        &self.receiver
    }

    /// Frees the bytes of a received message.
    pub fn took(&self, message: &Message) {
        self.bytes.fetch_sub(message.payload.len(), Ordering::Relaxed);
    }

    /// The oldest message, if there is one.
    pub fn try_take(&self) -> Option<Message> {
        let message = self.receiver.try_recv().ok()?;
        self.took(&message);
        Some(message)
    }

    /// Messages dropped since the last call.
    pub fn take_dropped(&self) -> u64 {
        match self.dropped.load(Ordering::Relaxed) {
            0 => 0,
            _ => self.dropped.swap(0, Ordering::Relaxed),
        }
    }

    /// Number of queued messages.
    pub fn waiting(&self) -> usize {
        self.receiver.len()
    }

    /// Drops the oldest message; returns whether there was one.
    fn drop_oldest(&self) -> bool {
        let dropped = self.try_take().is_some();
        self.dropped.fetch_add(u64::from(dropped), Ordering::Relaxed);
        dropped
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn message(number: u32, bytes: usize) -> Message {
        Message { topic: number.to_string().into(), payload: vec![0; bytes] }
    }

    fn topics(intake: &Intake) -> Vec<String> {
        std::iter::from_fn(|| intake.try_take()).map(|m| m.topic.to_string()).collect()
    }

    #[test]
    fn the_oldest_make_room_and_are_counted() {
        let intake = Intake::new(3);
        (0..5).for_each(|number| intake.push(message(number, 10)));
        assert_eq!((intake.waiting(), intake.take_dropped(), intake.take_dropped()), (3, 2, 0));
        assert_eq!(topics(&intake), ["2", "3", "4"]);
        intake.push(message(5, 10));
        assert_eq!((topics(&intake), intake.take_dropped()), (vec!["5".to_owned()], 0));
    }

    #[test]
    fn large_payloads_are_bounded_in_bytes() {
        let intake = Intake::new(1000);
        (0..20).for_each(|number| intake.push(message(number, 10 << 20)));
        assert_eq!((intake.waiting(), intake.take_dropped()), (6, 14));
        assert_eq!(topics(&intake), ["14", "15", "16", "17", "18", "19"]);
        intake.push(message(20, 2 * MOST_BYTES));
        intake.push(message(21, 1));
        assert_eq!(topics(&intake), ["21"]);
        assert_eq!(intake.bytes.load(Ordering::Relaxed), 0);
    }

    #[test]
    fn nothing_is_lost_or_counted_twice_with_many_at_once() {
        let intake = Intake::new(8);
        let taken = std::thread::scope(|scope| {
            let pushers: Vec<_> = (0..4)
                .map(|_| scope.spawn(|| (0..5000).for_each(|n| intake.push(message(n, 7)))))
                .collect();
            let mut taken = 0;
            while pushers.iter().any(|pusher| !pusher.is_finished()) {
                taken += u64::from(intake.try_take().is_some());
            }
            taken
        });
        let left = topics(&intake).len() as u64;
        assert_eq!(taken + left + intake.take_dropped(), 20_000);
        assert_eq!(intake.bytes.load(Ordering::Relaxed), 0);
    }
}

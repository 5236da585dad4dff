//! A publisher of commands: who joins later does not get them.

use std::time::{Duration, Instant};

use super::{Bus, BusError, Publisher};
use crate::core::time::Timestamp;

/// The last command is kept for those who join for so long: programs find each other in that time.
const KEPT: Duration = Duration::from_secs(4);

/// Publishes commands on a topic. The bus keeps the last one as long as its publisher lives, so another publisher takes
/// its place.
pub struct CommandPublisher {
    topic: String,
    publisher: Box<dyn Publisher>,
    sent: Option<Instant>,
}

impl CommandPublisher {
    /// Opens the publisher. Open it before the first command, so that others know it.
    ///
    /// # Errors
    /// As [`Bus::publisher`].
    pub fn open(bus: &dyn Bus, topic: String) -> Result<Self, BusError> {
        Ok(Self { publisher: bus.publisher(&topic)?, topic, sent: None })
    }

    /// Sends a command of no capture time.
    ///
    /// # Errors
    /// As [`Publisher::put`].
    pub fn put(&mut self, encoding: &str, payload: &[u8]) -> Result<(), BusError> {
        self.publisher.put(Timestamp::default(), encoding, payload)?;
        self.sent = Some(Instant::now());
        Ok(())
    }

    /// Forgets the last command if it is old. Call it now and then.
    ///
    /// # Errors
    /// As [`Bus::publisher`].
    pub fn forget_old(&mut self, bus: &dyn Bus) -> Result<(), BusError> {
        if self.sent.take_if(|sent| sent.elapsed() > KEPT).is_some() {
            self.publisher = bus.publisher(&self.topic)?;
        }
        Ok(())
    }
}

//! Encodes publications and puts them on the bus, with one publisher per topic, opened at first
//! use. Failures are counted and logged; they never stop the node.

use std::collections::HashMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Instant;

use crate::core::time::{Nanos, Timestamp};
use crate::io::bus::{Bus, BusError, Publisher};
use crate::io::wire::media_type;
use crate::live::core::publication::Publication;

/// Time before opening a topic is tried again, and time over which failures share one log line,
/// nanoseconds.
const PATIENCE: Nanos = Nanos::SECOND;

/// Publishes the messages of one thread.
pub(crate) struct Outlet {
    bus: Arc<dyn Bus>,
    lines: HashMap<Arc<str>, Line>,
    failures: Arc<AtomicU64>,
    /// What is later than this is not published.
    most_late: Option<Nanos>,
    unsaid: u64,
    quiet_until: Timestamp,
}

/// A topic's publisher, or the time of the next try.
enum Line {
    Open { publisher: Box<dyn Publisher>, encoding: String },
    Shut { until: Timestamp },
}

impl Outlet {
    /// Publishes on `bus`; `failures` counts messages that could not be published.
    pub(crate) fn new(bus: Arc<dyn Bus>, failures: Arc<AtomicU64>) -> Self {
        let quiet_until = Timestamp::default();
        Self { bus, lines: HashMap::new(), failures, most_late: None, unsaid: 0, quiet_until }
    }

    /// Does not publish what is later than this: another node may do so by then. It counts as a failure.
    #[must_use]
    pub(crate) fn up_to(self, most_late: Option<Nanos>) -> Self {
        Self { most_late, ..self }
    }

    /// Opens a topic in advance, so that the first message does not wait for it.
    ///
    /// # Errors
    /// The bus refuses the topic.
    pub(crate) fn open(&mut self, topic: &str, schema: &str) -> Result<(), BusError> {
        let line =
            Line::Open { publisher: self.bus.publisher(topic)?, encoding: media_type(schema) };
        self.lines.insert(topic.into(), line);
        Ok(())
    }

    /// Publishes a message. Returns whether that was done.
    pub(crate) fn put(&mut self, publication: &Publication, now: Timestamp) -> bool {
        let put = self.try_put(publication, now);
        if let Err(why) = &put {
            self.failures.fetch_add(1, Ordering::Relaxed);
            self.unsaid += 1;
            self.complain(&publication.topic, why.as_deref(), now);
        }
        put.is_ok()
    }

    /// Fails without an error until it is time to try the topic again.
    fn try_put(&mut self, publication: &Publication, now: Timestamp) -> Result<(), Option<String>> {
        if let (Some(most), Some(due)) = (self.most_late, publication.due)
            && now - due > most
        {
            let text = format!("it is more than {most} late; another solver may publish it");
            return Err(Some(text));
        }
        let topic = &publication.topic;
        if let Some(Line::Shut { until }) = self.lines.get(topic)
            && now < *until
        {
            return Err(None);
        }
        let (schema, payload) = publication.content.encoded();
        if !matches!(self.lines.get(topic), Some(Line::Open { .. })) {
            let begin = Instant::now();
            if let Err(error) = self.open(topic, schema) {
                // A refusal may take seconds.
                let took = i64::try_from(begin.elapsed().as_nanos()).unwrap_or(i64::MAX);
                let until = now + Nanos::new(took) + PATIENCE;
                self.lines.insert(Arc::clone(topic), Line::Shut { until });
                return Err(Some(error.to_string()));
            }
        }
        let Some(Line::Open { publisher, encoding }) = self.lines.get(topic) else {
            return Err(None);
        };
        let put = publisher.put(publication.capture, encoding, &payload);
        put.map_err(|error| Some(error.to_string()))
    }

    fn complain(&mut self, topic: &str, why: Option<&str>, now: Timestamp) {
        if now < self.quiet_until {
            return;
        }
        let Some(why) = why else { return };
        self.quiet_until = now + PATIENCE;
        tracing::warn!(topic, messages = self.unsaid, "cannot publish: {why}");
        self.unsaid = 0;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::io::bus::{Guard, Sink};
    use crate::io::wire::{Pose, decode};
    use crate::live::Content;
    use std::sync::Mutex;

    /// Stores all messages; refuses topics that hold `shut`, and empty payloads.
    #[derive(Clone, Default)]
    struct Fake {
        opened: Arc<AtomicU64>,
        put: Arc<Mutex<Vec<String>>>,
    }

    impl Bus for Fake {
        fn publisher(&self, topic: &str) -> Result<Box<dyn Publisher>, BusError> {
            self.opened.fetch_add(1, Ordering::Relaxed);
            match topic.contains("shut") {
                true => Err(refusal()),
                false => Ok(Box::new(self.clone())),
            }
        }

        fn subscribe(&self, _: &str, _: Sink) -> Result<Box<dyn Guard>, BusError> {
            Err(refusal())
        }

        fn announce(&self, _: &str) -> Result<Box<dyn Guard>, BusError> {
            Err(refusal())
        }

        fn announced(&self, _: &str) -> Result<Vec<String>, BusError> {
            Err(refusal())
        }
    }

    impl Publisher for Fake {
        fn put(&self, capture: Timestamp, encoding: &str, payload: &[u8]) -> Result<(), BusError> {
            if payload.is_empty() {
                return Err(refusal());
            }
            let window = decode::<Pose>(payload).unwrap().window;
            self.put.lock().unwrap().push(format!("{} {encoding} {window}", capture.ns()));
            Ok(())
        }
    }

    fn refusal() -> BusError {
        BusError::Name { name: "x".into(), what: "topic", reason: "it is refused".into() }
    }

    /// A pose of that window; window 0 is encoded as no bytes.
    fn publication(topic: &str, window: u64) -> Publication {
        let content = Content::Pose(Pose { window, ..Pose::default() });
        Publication { topic: topic.into(), capture: Timestamp::from_ns(7), due: None, content }
    }

    #[test]
    fn publishers_are_kept_and_failures_counted() {
        let (bus, failures) = (Fake::default(), Arc::new(AtomicU64::new(0)));
        let mut outlet = Outlet::new(Arc::new(bus.clone()), Arc::clone(&failures));
        let now = Timestamp::from_ns(5_000_000_000);
        outlet.put(&publication("a", 1), now);
        outlet.put(&publication("a", 0), now);
        outlet.put(&publication("a", 2), now);
        assert_eq!(bus.opened.load(Ordering::Relaxed), 1);
        let expected = [1, 2].map(|w| format!("7 application/protobuf;bundlemocap.v1.Pose {w}"));
        assert_eq!(*bus.put.lock().unwrap(), expected);
        assert_eq!(failures.load(Ordering::Relaxed), 1);
    }

    #[test]
    fn what_is_too_late_is_counted_and_not_published() {
        let (bus, failures) = (Fake::default(), Arc::new(AtomicU64::new(0)));
        let most = Some(Nanos::from_ms(2000));
        let mut outlet = Outlet::new(Arc::new(bus.clone()), Arc::clone(&failures)).up_to(most);
        let due = Timestamp::from_ns(5_000_000_000);
        for late in [0, 1999, 2001] {
            let publication = Publication { due: Some(due), ..publication("a", 1) };
            outlet.put(&publication, due + Nanos::from_ms(late));
        }
        assert_eq!((bus.put.lock().unwrap().len(), failures.load(Ordering::Relaxed)), (2, 1));
    }

    #[test]
    fn a_topic_that_cannot_be_opened_is_tried_once_a_second() {
        let (bus, failures) = (Fake::default(), Arc::new(AtomicU64::new(0)));
        let mut outlet = Outlet::new(Arc::new(bus.clone()), Arc::clone(&failures));
        for ms in [0, 10, 999, 1100, 1500] {
            outlet.put(&publication("shut", 1), Timestamp::from_ns(ms * 1_000_000));
        }
        assert_eq!(bus.opened.load(Ordering::Relaxed), 2);
        assert_eq!(failures.load(Ordering::Relaxed), 5);
    }
}

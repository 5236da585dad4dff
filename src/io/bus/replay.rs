//! A bus that plays what was recorded.

use std::sync::{Arc, Mutex, PoisonError};

use super::{Answer, Bus, BusError, Guard, Memory, Publisher, Sample, Sink, check_topic};
use crate::core::time::Timestamp;

/// A bus over a recording: subscribers get what it holds, publishers add to another.
///
/// Nothing happens until [`Replay::play`] is called. Then each sample, in the order of the
/// recording, goes to all who subscribed, on the thread that plays and as fast as they take it.
/// States are kept for those who subscribe later, as on the other buses.
///
/// What is published goes to the writer only and never to subscribers: the recording holds the
/// outputs of its time, and they would come twice.
pub struct Replay {
    memory: Memory,
    recording: Mutex<Box<dyn Iterator<Item = Sample> + Send>>,
    writer: Writer,
}

type Writer = Arc<Mutex<Box<dyn FnMut(&Sample) + Send>>>;

impl Replay {
    /// Over the samples of a recording; what is published is given to `writer`.
    pub fn new(
        recording: impl Iterator<Item = Sample> + Send + 'static,
        writer: impl FnMut(&Sample) + Send + 'static,
    ) -> Self {
        Self {
            memory: Memory::new(),
            recording: Mutex::new(Box::new(recording)),
            writer: Arc::new(Mutex::new(Box::new(writer))),
        }
    }

    /// Plays to the end of the recording and returns how many samples it played. If the recording
    /// grew since, a further call goes on. Sinks must not call it.
    pub fn play(&self) -> usize {
        let mut recording = self.recording.lock().unwrap_or_else(PoisonError::into_inner);
        recording.by_ref().map(|sample| self.memory.publish(&sample)).count()
    }
}

struct ReplayPublisher {
    topic: Arc<str>,
    writer: Writer,
}

impl Publisher for ReplayPublisher {
    fn put(&self, capture: Timestamp, encoding: &str, payload: &[u8]) -> Result<(), BusError> {
        let mut writer = self.writer.lock().unwrap_or_else(PoisonError::into_inner);
        writer(&Sample {
            topic: self.topic.clone(),
            capture,
            encoding: encoding.into(),
            payload: payload.to_vec(),
        });
        Ok(())
    }
}

impl Bus for Replay {
    fn publisher(&self, topic: &str) -> Result<Box<dyn Publisher>, BusError> {
        check_topic(topic)?;
        Ok(Box::new(ReplayPublisher { topic: topic.into(), writer: self.writer.clone() }))
    }

    fn subscribe(&self, pattern: &str, sink: Sink) -> Result<Box<dyn Guard>, BusError> {
        self.memory.subscribe(pattern, sink)
    }

    fn answer(&self, topic: &str, answer: Answer) -> Result<Option<Box<dyn Guard>>, BusError> {
        self.memory.answer(topic, answer)
    }

    fn query(&self, pattern: &str, within: std::time::Duration) -> Result<Vec<Sample>, BusError> {
        self.memory.query(pattern, within)
    }
}

//! A bus that plays a recording.

use std::sync::{Arc, Mutex, PoisonError};

use super::{Answer, Bus, BusError, Guard, Memory, Publisher, Sample, Sink, check_topic};
use crate::core::time::Timestamp;

/// A bus over a recording: subscribers get its samples, publications go to a second recording.
///
/// Nothing happens until [`Replay::play`] is called. It sends each sample, in the order of the
/// recording, to all subscribers, on the calling thread and as fast as they take it. States are
/// kept for those who subscribe later, as on the other buses.
///
/// Publications go to the writer only and never to subscribers: the recording already holds the
/// outputs, and they would arrive twice.
pub struct Replay {
    memory: Memory,
    recording: Mutex<Box<dyn Iterator<Item = Sample> + Send>>,
    writer: Writer,
}

type Writer = Arc<Mutex<Box<dyn FnMut(&Sample) + Send>>>;

impl Replay {
    /// Plays the samples of a recording; publications are passed to `writer`.
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

    /// Plays to the end of the recording and returns the number of played samples. If the recording
    /// has grown since, another call continues. Sinks must not call it.
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

    fn announce(&self, name: &str) -> Result<Box<dyn Guard>, BusError> {
        self.memory.announce(name)
    }

    fn announced(&self, pattern: &str) -> Result<Vec<String>, BusError> {
        self.memory.announced(pattern)
    }

    fn query(&self, pattern: &str, within: std::time::Duration) -> Result<Vec<Sample>, BusError> {
        self.memory.query(pattern, within)
    }
}

//! The bus inside a process.

use std::collections::{HashMap, VecDeque};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use super::{
    Answer, Bus, BusError, Delivery, Guard, Publisher, Sample, Sink, check_pattern, check_topic,
    delivery, matches,
};
use crate::core::time::Timestamp;

/// A bus inside a process; clones are the same bus.
///
/// Sinks are called on the thread that publishes, before `put` returns. If another thread (or the
/// sink itself) is already delivering, that one also delivers this sample; so the order is the same
/// for all sinks, and a sink may publish. A sink that is running while its guard is dropped
/// finishes its call.
#[derive(Clone, Default)]
pub struct Memory {
    state: Arc<Mutex<State>>,
}

#[derive(Default)]
struct State {
    subscribers: Vec<Subscriber>,
    answers: Vec<Answering>,
    /// Announced names, each with the switch of its guard.
    announced: Vec<(String, Arc<AtomicBool>)>,
    history: HashMap<Arc<str>, VecDeque<Sample>>,
    /// Deliveries that wait, in order.
    due: VecDeque<(Sample, Target)>,
    /// Whether a thread is delivering.
    delivering: bool,
}

/// A sink, and the switch that its guard turns off.
type Target = (Arc<Sink>, Arc<AtomicBool>);

struct Subscriber {
    pattern: String,
    target: Target,
}

struct Answering {
    topic: String,
    answer: Arc<Answer>,
    on: Arc<AtomicBool>,
}

impl Memory {
    /// A bus without subscribers.
    pub fn new() -> Self {
        Self::default()
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Passes a sample to all subscribers of its topic; keeps it for late joiners if the topic is a
    /// state.
    pub(super) fn publish(&self, sample: &Sample) {
        self.enqueue(sample);
        self.deliver();
    }

    /// Queues a sample: the first half of [`Memory::publish`], which calls no sink.
    pub(super) fn enqueue(&self, sample: &Sample) {
        let mut state = self.lock();
        state.keep(sample);
        state.send(sample);
    }

    /// Delivers the queued samples, unless another call is delivering.
    pub(super) fn deliver(&self) {
        let Some(_turn) = Turn::take(self) else { return };
        loop {
            let mut state = self.lock();
            let Some((sample, (sink, on))) = state.due.pop_front() else {
                state.delivering = false;
                return;
            };
            drop(state);
            if on.load(Ordering::Acquire) {
                sink(sample);
            }
        }
    }
}

impl State {
    fn keep(&mut self, sample: &Sample) {
        let Delivery::State { history } = delivery(&sample.topic) else { return };
        let kept = self.history.entry(sample.topic.clone()).or_default();
        kept.push_back(sample.clone());
        if kept.len() > history {
            kept.pop_front();
        }
    }

    fn send(&mut self, sample: &Sample) {
        self.subscribers.retain(|s| s.target.1.load(Ordering::Acquire));
        let meant = self.subscribers.iter().filter(|s| matches(&s.pattern, &sample.topic));
        self.due.extend(meant.map(|s| (sample.clone(), s.target.clone())));
    }
}

/// The right to deliver; it is released even if a sink panics.
struct Turn<'a>(&'a Memory);

impl<'a> Turn<'a> {
    fn take(bus: &'a Memory) -> Option<Self> {
        let mut state = bus.lock();
        let free = !std::mem::replace(&mut state.delivering, true);
        free.then_some(Self(bus))
    }
}

impl Drop for Turn<'_> {
    fn drop(&mut self) {
        if std::thread::panicking() {
            self.0.lock().delivering = false;
        }
    }
}

/// Turns a sink or an answer off when it is dropped.
struct Off(Arc<AtomicBool>);

impl Guard for Off {}

impl Drop for Off {
    fn drop(&mut self) {
        self.0.store(false, Ordering::Release);
    }
}

struct MemoryPublisher {
    bus: Memory,
    topic: Arc<str>,
}

impl Publisher for MemoryPublisher {
    fn put(&self, capture: Timestamp, encoding: &str, payload: &[u8]) -> Result<(), BusError> {
        self.bus.publish(&Sample {
            topic: self.topic.clone(),
            capture,
            encoding: encoding.into(),
            payload: payload.to_vec(),
        });
        Ok(())
    }
}

impl Bus for Memory {
    fn publisher(&self, topic: &str) -> Result<Box<dyn Publisher>, BusError> {
        check_topic(topic)?;
        Ok(Box::new(MemoryPublisher { bus: self.clone(), topic: topic.into() }))
    }

    fn subscribe(&self, pattern: &str, sink: Sink) -> Result<Box<dyn Guard>, BusError> {
        check_pattern(pattern)?;
        let on = Arc::new(AtomicBool::new(true));
        let target: Target = (Arc::new(sink), on.clone());
        {
            let mut state = self.lock();
            let known = state.history.iter().filter(|(topic, _)| matches(pattern, topic));
            let late: Vec<Sample> = known.flat_map(|(_, kept)| kept.iter().cloned()).collect();
            state.due.extend(late.into_iter().map(|sample| (sample, target.clone())));
            state.subscribers.push(Subscriber { pattern: pattern.into(), target });
        }
        self.deliver();
        Ok(Box::new(Off(on)))
    }

    fn answer(&self, topic: &str, answer: Answer) -> Result<Option<Box<dyn Guard>>, BusError> {
        check_topic(topic)?;
        let on = Arc::new(AtomicBool::new(true));
        let answering = Answering { topic: topic.into(), answer: Arc::new(answer), on: on.clone() };
        self.lock().answers.push(answering);
        Ok(Some(Box::new(Off(on))))
    }

    fn announce(&self, name: &str) -> Result<Box<dyn Guard>, BusError> {
        check_topic(name)?;
        let on = Arc::new(AtomicBool::new(true));
        self.lock().announced.push((name.into(), on.clone()));
        Ok(Box::new(Off(on)))
    }

    fn announced(&self, pattern: &str) -> Result<Vec<String>, BusError> {
        check_pattern(pattern)?;
        let mut state = self.lock();
        state.announced.retain(|(_, on)| on.load(Ordering::Acquire));
        let names = state.announced.iter().map(|(name, _)| name);
        Ok(names.filter(|name| matches(pattern, name)).cloned().collect())
    }

    fn query(&self, pattern: &str, _within: Duration) -> Result<Vec<Sample>, BusError> {
        check_pattern(pattern)?;
        let asked: Vec<_> = {
            let mut state = self.lock();
            state.answers.retain(|a| a.on.load(Ordering::Acquire));
            let meant = state.answers.iter().filter(|a| matches(pattern, &a.topic));
            meant.map(|a| a.answer.clone()).collect()
        };
        Ok(asked.iter().filter_map(|answer| answer()).collect())
    }
}

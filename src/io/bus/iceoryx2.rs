//! The bus over the shared memory of one host.
//!
//! Topics share a few services of iceoryx2, one per size of history: streams (none), and states by
//! the number of samples that are kept. Each sample holds its topic. So patterns need no list of
//! topics, and a program has one port per class of topics that it subscribes to.
//!
//! An event wakes the receivers; nothing polls. A new subscriber also announces itself by an event,
//! and publishers of states then send it their history. Every second each program removes the
//! leftovers of killed programs. A full buffer drops its oldest sample and never blocks the
//! publisher.
//!
//! Differences to the network: no queries (late joiners get the history), no check that a node is
//! present, at most 1 MiB per sample, and programs see each other only with equal prefix, on one
//! host, and as users who may open each other's files. All must have the same version of this
//! program, since limits are part of the services. 16 bytes per prefix stay in shared memory for
//! good.
//!
//! A program announces itself by an event service of that name; others see its node, and whether
//! that node's process is alive.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, Weak};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use iceoryx2::node::{Node, NodeBuilder, NodeState};
use iceoryx2::port::event_id::EventId;
use iceoryx2::port::listener::{Listener, ListenerWaitError};
use iceoryx2::port::notifier::Notifier;
use iceoryx2::port::publisher::Publisher as Port;
use iceoryx2::port::subscriber::Subscriber;
use iceoryx2::port::update_connections::UpdateConnections;
use iceoryx2::prelude::{
    AllocationStrategy, CallbackProgression, LogLevel, Service, SignalHandlingMode, set_log_level,
};
use iceoryx2::service::ServiceDetails;
use iceoryx2::service::port_factory::event;

use super::frame::{frame, parse};
use super::iceoryx2_services::{
    CLASSES, JOINED, Shm, class, classes, events, limits, persist, service, service_name, settings,
};
use super::receivers::Announcer;
use super::{
    Bus, BusError, Guard, Iceoryx2Config, Memory, Publisher, Receiver, Sample, Sink, check_pattern,
    check_topic, matches,
};
use crate::core::time::Timestamp;

/// First part of the names of services that announce a program.
const ANNOUNCED: &str = "mocap/announced/";

/// Interval of the search for leftovers of killed programs.
const ROUND: Duration = Duration::from_secs(1);

/// The bus over the shared memory of one host.
pub struct Iceoryx2 {
    inner: Arc<Inner>,
    announcer: Announcer,
}

struct Inner {
    shared: Arc<Shared>,
    thread: Option<JoinHandle<()>>,
}

/// What the receiving thread shares with the ports.
struct Shared {
    notifier: Notifier<Shm>,
    publishers: Mutex<Vec<Weak<Outlet>>>,
    subscribers: Mutex<[Option<Inlet>; CLASSES.len()]>,
    /// Distributes samples to the sinks of this process, and stores states for late joiners.
    local: Memory,
    stop: AtomicBool,
    node: Node<Shm>,
}

type Inlet = Subscriber<Shm, [u8], ()>;

struct Outlet {
    class: usize,
    port: Port<Shm, [u8], ()>,
}

impl Iceoryx2 {
    /// Opens the bus. It needs no node: all programs with the same prefix share it.
    ///
    /// # Errors
    /// A prefix that cannot begin a file name, or shared memory that cannot be used.
    pub fn open(config: &Iceoryx2Config) -> Result<Self, BusError> {
        set_log_level(LogLevel::Fatal);
        let node = NodeBuilder::new()
            .signal_handling_mode(SignalHandlingMode::Disabled)
            .config(&settings(&config.prefix)?)
            .create::<Shm>()
            .map_err(|error| BusError::transport("cannot use shared memory", error))?;
        node.try_cleanup_dead_nodes();
        let events = events(&node)?;
        let listener = persist("cannot listen for events", || events.listener_builder().create())?;
        let shared = Arc::new(Shared {
            notifier: persist("cannot send events", || events.notifier_builder().create())?,
            publishers: Mutex::default(),
            subscribers: Mutex::default(),
            local: Memory::new(),
            stop: AtomicBool::new(false),
            node,
        });
        let receiving = shared.clone();
        let thread = std::thread::Builder::new()
            .name("bus".into())
            .spawn(move || receiving.run(&listener))
            .map_err(|error| BusError::transport("cannot start a thread", error))?;
        let inner = Arc::new(Inner { shared, thread: Some(thread) });
        Ok(Self { inner, announcer: Announcer::new(&config.name) })
    }
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Shared {
    /// The receiving thread.
    fn run(&self, listener: &Listener<Shm>) {
        let mut cleaned = Instant::now();
        while !self.stop.load(Ordering::Acquire) {
            let mut seen = [false; JOINED + 1];
            let waited = listener.timed_wait(
                |event| seen.iter_mut().skip(event.id.as_value()).take(1).for_each(|s| *s = true),
                ROUND.saturating_sub(cleaned.elapsed()),
            );
            // A signal, such as the one that lets a stopped process go on, ends a wait early.
            if let Err(error) = waited
                && !matches!(error, ListenerWaitError::InterruptSignal)
            {
                tracing::warn!("the bus cannot wait for events: {error}; it checks once a second");
                std::thread::sleep(ROUND);
            }
            let round = cleaned.elapsed() >= ROUND;
            if seen[JOINED] || round {
                self.connect();
            }
            (0..CLASSES.len()).filter(|&class| seen[class] || round).for_each(|c| self.drain(c));
            if round {
                self.node.try_cleanup_dead_nodes();
                cleaned = Instant::now();
            }
        }
    }

    /// Sends the history to new subscribers.
    fn connect(&self) {
        let outlets: Vec<_> = {
            let mut publishers = lock(&self.publishers);
            publishers.retain(|outlet| outlet.strong_count() > 0);
            publishers.iter().filter_map(Weak::upgrade).collect()
        };
        let mut with_history = [false; CLASSES.len()];
        for outlet in &outlets {
            if let Err(error) = outlet.port.update_connections() {
                tracing::warn!("a subscriber in shared memory cannot be reached: {error}");
            }
            with_history[outlet.class] = outlet.class > 0;
        }
        (0..CLASSES.len()).filter(|&c| with_history[c]).for_each(|class| self.notify(class));
    }

    /// Passes all received samples of a class to the sinks. They are taken and queued under one
    /// lock, so that the order holds across threads, and delivered without it, since sinks may
    /// publish and subscribe.
    fn drain(&self, class: usize) {
        while self.take(class) {
            self.local.deliver();
        }
    }

    /// Takes one sample of a class. Returns whether there was one.
    fn take(&self, class: usize) -> bool {
        let subscribers = lock(&self.subscribers);
        let Some(subscriber) = &subscribers[class] else { return false };
        match subscriber.receive() {
            Ok(None) => return false,
            Ok(Some(sample)) => match parse(sample.payload()) {
                Some(sample) => self.local.enqueue(&sample),
                None => tracing::warn!("a sample in shared memory has an unknown format"),
            },
            Err(error) => {
                tracing::warn!("a sample in shared memory cannot be read: {error}");
                return false;
            }
        }
        true
    }

    /// Wakes all receivers. A receiver that cannot be woken checks by itself within a second.
    fn notify(&self, event: usize) {
        if let Err(error) = self.notifier.notify_with_custom_event_id(EventId::new(event)) {
            tracing::debug!("an event in shared memory did not reach all: {error}");
        }
    }

    /// Creates the port that receives a class, if it does not exist.
    fn listen_to(&self, class: usize) -> Result<(), BusError> {
        let mut subscribers = lock(&self.subscribers);
        if subscribers[class].is_none() {
            let service = service(&self.node, class)?;
            let subscriber = persist("cannot subscribe", || service.subscriber_builder().create())?;
            subscribers[class] = Some(subscriber);
        }
        Ok(())
    }
}

impl Drop for Inner {
    fn drop(&mut self) {
        self.shared.stop.store(true, Ordering::Release);
        self.shared.notify(JOINED);
        let Some(thread) = self.thread.take() else { return };
        // A sink may own the last handle of its bus.
        if thread.thread().id() != std::thread::current().id() && thread.join().is_err() {
            tracing::error!("the receiving thread of the bus panicked");
        }
    }
}

struct Iceoryx2Publisher {
    topic: String,
    outlet: Arc<Outlet>,
    inner: Arc<Inner>,
}

impl Publisher for Iceoryx2Publisher {
    fn put(&self, capture: Timestamp, encoding: &str, payload: &[u8]) -> Result<(), BusError> {
        let bytes = frame(&self.topic, capture, encoding, payload)?;
        let failed =
            |error: String| BusError::transport(format!("cannot publish on {}", self.topic), error);
        let sample = self.outlet.port.loan_slice_uninit(bytes.len());
        let sample = sample.map_err(|error| failed(error.to_string()))?.write_from_slice(&bytes);
        sample.send().map_err(|error| failed(error.to_string()))?;
        self.inner.shared.notify(self.outlet.class);
        Ok(())
    }
}

/// Keeps a subscription and its bus alive.
struct Subscribed {
    _local: Box<dyn Guard>,
    _announced: Option<Box<dyn Guard>>,
    _inner: Arc<Inner>,
}

impl Guard for Subscribed {}

/// Keeps an announced name and its bus alive.
struct Announced {
    _service: event::PortFactory<Shm>,
    _inner: Arc<Inner>,
}

impl Guard for Announced {}

impl Bus for Iceoryx2 {
    fn publisher(&self, topic: &str) -> Result<Box<dyn Publisher>, BusError> {
        check_topic(topic)?;
        let class = class(topic);
        let shared = &self.inner.shared;
        let service = service(&shared.node, class)?;
        let port = persist(&format!("cannot publish on {topic}"), || {
            service
                .publisher_builder()
                .initial_max_slice_len(2048)
                .allocation_strategy(AllocationStrategy::PowerOfTwo)
                .max_loaned_samples(4)
                .override_sample_preallocation(move |_| limits(class).samples())
                .create()
        })?;
        let outlet = Arc::new(Outlet { class, port });
        lock(&shared.publishers).push(Arc::downgrade(&outlet));
        Ok(Box::new(Iceoryx2Publisher { topic: topic.into(), outlet, inner: self.inner.clone() }))
    }

    fn subscribe(&self, pattern: &str, sink: Sink) -> Result<Box<dyn Guard>, BusError> {
        check_pattern(pattern)?;
        let shared = &self.inner.shared;
        // Samples that this program has already received are history for this subscriber.
        classes(pattern).for_each(|class| shared.drain(class));
        let local = shared.local.subscribe(pattern, sink)?;
        classes(pattern).try_for_each(|class| shared.listen_to(class))?;
        shared.notify(JOINED);
        let announced = self.announcer.announce(self, pattern);
        let inner = self.inner.clone();
        Ok(Box::new(Subscribed { _local: local, _announced: announced, _inner: inner }))
    }

    fn answer(
        &self,
        topic: &str,
        _answer: super::Answer,
    ) -> Result<Option<Box<dyn Guard>>, BusError> {
        check_topic(topic).map(|()| None)
    }

    fn announce(&self, name: &str) -> Result<Box<dyn Guard>, BusError> {
        check_topic(name)?;
        let node = &self.inner.shared.node;
        let service = service_name(&format!("{ANNOUNCED}{name}"))?;
        let service = persist(&format!("cannot announce {name}"), || {
            node.service_builder(&service).event().open_or_create()
        })?;
        Ok(Box::new(Announced { _service: service, _inner: self.inner.clone() }))
    }

    fn announced(&self, pattern: &str) -> Result<Vec<String>, BusError> {
        check_pattern(pattern)?;
        let mut names = Vec::new();
        let note = |service: ServiceDetails<Shm>| {
            let nodes = service.dynamic_details.map(|details| details.nodes).unwrap_or_default();
            let name = service.static_details.name().as_str().strip_prefix(ANNOUNCED);
            let name = name.filter(|name| matches(pattern, name));
            if nodes.iter().any(|node| matches!(node, NodeState::Alive(_))) {
                names.extend(name.map(str::to_owned));
            }
            CallbackProgression::Continue
        };
        Shm::list(self.inner.shared.node.config(), note)
            .map_err(|error| BusError::transport("cannot list the programs", error))?;
        Ok(names)
    }

    fn receivers(&self, below: &str) -> Result<Vec<Receiver>, BusError> {
        self.announcer.others(self, below)
    }

    fn query(&self, pattern: &str, _within: Duration) -> Result<Vec<Sample>, BusError> {
        check_pattern(pattern).map(|()| Vec::new())
    }
}

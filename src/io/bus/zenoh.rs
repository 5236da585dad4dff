//! The bus over a network.
//!
//! | | streams | states |
//! |---|---|---|
//! | priority | real time | data |
//! | a full queue | waits 1 ms (tools: 20 ms), then drops until it has room | the same; missed samples are requested again |
//! | late joiners | nothing | the last samples, from the publisher's cache |
//!
//! Streams are not *express*. An express message takes a whole place in each queue on its way, and a queue of a router
//! with zenoh's own settings has two places. Other messages share places, and come up to 1 ms later.
//!
//! States are not sent with congestion control *block*: one stalled receiver would block the node,
//! and so everybody's poses, for seconds. They carry sequence numbers; gaps are detected (at the latest
//! by a heartbeat) and filled from the cache.
//!
//! On the wire a sample is a zenoh sample: payload, encoding, and the capture time as attachment,
//! 8 bytes little endian. Samples of foreign publishers without attachment have capture time 0.
//! Foreign publishers have no cache unless they are advanced publishers of zenoh-ext that number their samples
//! (`sample_miss_detection`).
//!
//! Zenoh's time stamps are off. A foreign router may stamp the samples of all publishers with its own clock. Then
//! zenoh-ext takes them for samples of one source and drops those that are out of order. So only numbered samples, those
//! of our states, come through its subscriber.

use std::sync::Arc;
use std::time::Duration;

use zenoh::bytes::Encoding;
use zenoh::key_expr::{KeyExpr, OwnedKeyExpr};
use zenoh::qos::{CongestionControl, Priority};
use zenoh::query::{ConsolidationMode, Query, QueryTarget, Reply};
use zenoh::sample::Locality;
use zenoh::{Session, Wait};
use zenoh_ext::{
    AdvancedPublisher, AdvancedPublisherBuilderExt, AdvancedSubscriberBuilderExt, CacheConfig,
    HistoryConfig, MissDetectionConfig, RecoveryConfig,
};

use super::certificates::Certificates;
use super::receivers::Announcer;
use super::zenoh_settings::{check_endpoints, settings, why_not_open, without_places};
use super::{
    Answer, Bus, BusError, Delivery, Guard, Publisher, Receiver, Sample, Sink, Watch, ZenohConfig,
    ZenohMode, check_pattern, check_topic, delivery,
};
use crate::core::time::Timestamp;
use crate::io::wire::Topic;

/// Time that publishers' caches have to answer a late joiner.
const HISTORY_WITHIN: Duration = Duration::from_secs(2);

/// Time that the network has to name the announced.
const ANNOUNCED_WITHIN: Duration = Duration::from_secs(1);

/// Interval at which a publisher of states sends its last sequence number, once it has published. Zenoh's *sporadic*
/// heartbeats, only after a message, wait for full queues: one hung receiver would stop everybody.
const HEARTBEAT: Duration = Duration::from_secs(1);

/// The bus over a network.
pub struct Zenoh {
    session: Session,
    announcer: Announcer,
    /// Whether it needs a router.
    is_client: bool,
}

/// Delay before closing, so that the last samples are still sent.
const LINGER: Duration = Duration::from_millis(150);

impl Drop for Zenoh {
    fn drop(&mut self) {
        std::thread::sleep(LINGER);
        if let Err(error) = self.session.close().wait() {
            tracing::debug!("closing: {}", without_places(&error));
        }
    }
}

impl Zenoh {
    /// Opens a session for the node: with the mode and the addresses of the settings.
    ///
    /// # Errors
    /// An address in use, an invalid address, or, as a client, no answer.
    pub fn open_node(config: &ZenohConfig) -> Result<Self, BusError> {
        let mode = match config.mode {
            ZenohMode::Router => "router",
            ZenohMode::Peer => "peer",
            ZenohMode::Client => "client",
        };
        let listen = if config.mode == ZenohMode::Client { &[][..] } else { &config.listen };
        open(config, mode, listen, &config.connect, config.scouting)
    }

    /// Opens a session for a tool: a client of `connect` or, if that is empty, of the addresses on
    /// which the node listens. With `scouting` and without `connect`, a client of any node that is
    /// found.
    ///
    /// # Errors
    /// No answer within some seconds, or an invalid address.
    pub fn open_client(config: &ZenohConfig) -> Result<Self, BusError> {
        let connect: Vec<String> = match (config.connect.is_empty(), config.scouting) {
            (true, true) => Vec::new(),
            (true, false) => config.listen.iter().map(|e| reachable(e)).collect(),
            (false, _) => config.connect.clone(),
        };
        open(config, "client", &[], &connect, config.scouting && connect.is_empty())
    }

    /// The addresses on which this session listens, with their actual ports.
    pub fn listens_on(&self) -> Vec<String> {
        let locators = self.session.info().locators().wait();
        locators.iter().map(|at| format!("{}/{}", at.protocol(), at.address())).collect()
    }
}

/// The local address of a node that listens on all interfaces.
fn reachable(endpoint: &str) -> String {
    endpoint.replacen("/0.0.0.0:", "/127.0.0.1:", 1).replacen("/[::]:", "/[::1]:", 1)
}

fn open(
    config: &ZenohConfig,
    mode: &str,
    listen: &[String],
    connect: &[String],
    scouting: bool,
) -> Result<Zenoh, BusError> {
    check_endpoints("zenoh.listen", listen)?;
    check_endpoints("zenoh.connect", connect)?;
    if mode == "client" && connect.is_empty() && !scouting {
        return Err(BusError::Setting {
            key: "zenoh.connect",
            value: "[]".into(),
            reason: "a client needs an address to connect to, such as \
                     tcp/127.0.0.1:7447"
                .into(),
        });
    }
    let is_encrypted = listen.iter().chain(connect).any(|one| one.starts_with("quic/"));
    let certificates = is_encrypted.then(|| Certificates::read(&config.tls)).transpose()?;
    match zenoh::open(settings(config, mode, listen, connect, scouting)?).wait() {
        Ok(session) => {
            let announcer = Announcer::new(&config.name);
            Ok(Zenoh { session, announcer, is_client: mode == "client" })
        }
        Err(error) => {
            Err(why_not_open(mode, listen, connect, certificates.as_ref(), &without_places(&error)))
        }
    }
}

impl Bus for Zenoh {
    fn publisher(&self, topic: &str) -> Result<Box<dyn Publisher>, BusError> {
        check_topic(topic)?;
        let builder = self
            .session
            .declare_publisher(topic.to_owned())
            .congestion_control(CongestionControl::Drop);
        let sender = match delivery(topic) {
            Delivery::Stream => builder.priority(Priority::RealTime).wait().map(Sender::Stream),
            Delivery::State { history } => builder
                .priority(Priority::Data)
                .cache(CacheConfig::default().max_samples(history))
                .sample_miss_detection(MissDetectionConfig::default().heartbeat(HEARTBEAT))
                .publisher_detection()
                .wait()
                .map(|publisher| Sender::State(Box::new(publisher))),
        };
        let sender = sender.map_err(|e| self.error(format!("cannot publish on {topic}"), e))?;
        Ok(Box::new(ZenohPublisher { sender, session: self.session.clone() }))
    }

    fn subscribe(&self, pattern: &str, sink: Sink) -> Result<Box<dyn Guard>, BusError> {
        check_pattern(pattern)?;
        let key = canonical(pattern)?;
        let sink = Arc::new(sink);
        let subscriber = |takes: fn(&zenoh::sample::Sample) -> bool| {
            let sink = Arc::clone(&sink);
            self.session.declare_subscriber(key.clone()).callback(move |sample| {
                if takes(&sample) {
                    sink(from_zenoh(&sample));
                }
            })
        };
        let error = |e| self.error(format!("cannot subscribe to {pattern}"), e);
        let announced = self.announcer.announce(self, pattern);
        if is_of_streams(pattern) {
            return Ok(self.alive((subscriber(|_| true).wait().map_err(error)?, announced)));
        }
        let unnumbered = subscriber(|sample| sample.source_info().is_none());
        let numbered = subscriber(|sample| sample.source_info().is_some())
            .history(HistoryConfig::default().detect_late_publishers())
            .recovery(RecoveryConfig::default().heartbeat())
            .query_timeout(HISTORY_WITHIN);
        let subscribers = (unnumbered.wait().map_err(error)?, numbered.wait().map_err(error)?);
        Ok(self.alive((subscribers, announced)))
    }

    fn answer(&self, topic: &str, answer: Answer) -> Result<Option<Box<dyn Guard>>, BusError> {
        check_topic(topic)?;
        let key: Arc<str> = topic.into();
        let queryable = self
            .session
            .declare_queryable(topic.to_owned())
            .complete(true)
            .callback(move |query| reply(&query, &key, answer()))
            .wait()
            .map_err(|e| self.error(format!("cannot answer on {topic}"), e))?;
        Ok(Some(self.alive(queryable)))
    }

    fn announce(&self, name: &str) -> Result<Box<dyn Guard>, BusError> {
        check_topic(name)?;
        let token = self.session.liveliness().declare_token(name.to_owned()).wait();
        let token = token.map_err(|e| self.error(format!("cannot announce {name}"), e))?;
        Ok(self.alive(token))
    }

    fn announced(&self, pattern: &str) -> Result<Vec<String>, BusError> {
        check_pattern(pattern)?;
        let replies = self.session.liveliness().get(canonical(pattern)?).timeout(ANNOUNCED_WITHIN);
        let replies =
            replies.wait().map_err(|e| self.error(format!("cannot ask for {pattern}"), e))?;
        let name = |reply: Reply| match reply.into_result() {
            Ok(sample) => Ok(sample.key_expr().to_string()),
            Err(_) => {
                Err(BusError::transport(format!("cannot ask for {pattern}"), "no answer in time"))
            }
        };
        replies.iter().map(name).collect()
    }

    fn is_connected(&self) -> bool {
        !self.is_client || self.session.info().routers_zid().wait().next().is_some()
    }

    fn receivers(&self, below: &str) -> Result<Vec<Receiver>, BusError> {
        self.announcer.others(self, below)
    }

    fn watch(&self, pattern: &str) -> Result<Option<Watch>, BusError> {
        check_pattern(pattern)?;
        let builder = self.session.declare_publisher(canonical(pattern)?);
        // Nothing is put.
        let publisher = builder.allowed_destination(Locality::Remote).wait();
        let publisher = publisher.map_err(|e| self.error(format!("cannot watch {pattern}"), e))?;
        let is_received =
            move || publisher.matching_status().wait().is_ok_and(|status| status.matching());
        Ok(Some(Box::new(is_received)))
    }

    fn query(&self, pattern: &str, within: Duration) -> Result<Vec<Sample>, BusError> {
        check_pattern(pattern)?;
        let replies = self
            .session
            .get(canonical(pattern)?)
            .target(QueryTarget::All)
            .consolidation(ConsolidationMode::None)
            .timeout(within)
            .wait()
            .map_err(|e| self.error(format!("cannot ask for {pattern}"), e))?;
        Ok(replies.iter().filter_map(|r| r.into_result().ok()).map(|s| from_zenoh(&s)).collect())
    }
}

impl Zenoh {
    /// A guard that also keeps the session alive.
    fn alive<T: Send + 'static>(&self, what: T) -> Box<dyn Guard> {
        Box::new(Alive { _what: what, _session: self.session.clone() })
    }

    fn error(&self, what: String, error: zenoh::Error) -> BusError {
        match self.session.is_closed() {
            true => BusError::Closed,
            false => BusError::transport(what, without_places(&error)),
        }
    }
}

/// Whether a pattern matches topics of streams only: it is the name of a stream, perhaps with `*`
/// as the name of stage, actor and camera.
fn is_of_streams(pattern: &str) -> bool {
    match Topic::parse(pattern) {
        Ok(topic) => topic.history().is_none(),
        Err(_) => !pattern.contains('*'),
    }
}

/// A pattern in zenoh's canonical form, such as `*/**` for `**/*`.
fn canonical(pattern: &str) -> Result<KeyExpr<'static>, BusError> {
    let key = OwnedKeyExpr::autocanonize(pattern.to_owned());
    key.map(KeyExpr::from).map_err(|error| BusError::Name {
        name: pattern.into(),
        what: "pattern",
        reason: without_places(&error),
    })
}

fn from_zenoh(sample: &zenoh::sample::Sample) -> Sample {
    let capture = sample.attachment().and_then(|bytes| {
        let bytes: [u8; 8] = bytes.to_bytes().as_ref().try_into().ok()?;
        Some(Timestamp::from_ns(i64::from_le_bytes(bytes)))
    });
    let encoding: Arc<str> = match sample.encoding() {
        unsaid if *unsaid == Encoding::default() => "".into(),
        encoding => encoding.to_string().into(),
    };
    Sample {
        topic: sample.key_expr().as_str().into(),
        capture: capture.unwrap_or_default(),
        encoding,
        payload: sample.payload().to_bytes().into_owned(),
    }
}

fn reply(query: &Query, topic: &str, answer: Option<Sample>) {
    let Some(sample) = answer else { return };
    let sent = query
        .reply(topic.to_owned(), sample.payload)
        .encoding(&*sample.encoding)
        .attachment(sample.capture.ns().to_le_bytes())
        .wait();
    if let Err(error) = sent {
        tracing::warn!("an answer on {topic} was not sent: {}", without_places(&error));
    }
}

enum Sender {
    Stream(zenoh::pubsub::Publisher<'static>),
    State(Box<AdvancedPublisher<'static>>),
}

struct ZenohPublisher {
    sender: Sender,
    session: Session,
}

impl Publisher for ZenohPublisher {
    fn put(&self, capture: Timestamp, encoding: &str, payload: &[u8]) -> Result<(), BusError> {
        let stamp = capture.ns().to_le_bytes();
        let sent = match &self.sender {
            Sender::Stream(publisher) => {
                publisher.put(payload).encoding(encoding).attachment(stamp).wait()
            }
            Sender::State(publisher) => {
                publisher.put(payload).encoding(encoding).attachment(stamp).wait()
            }
        };
        sent.map_err(|error| match self.session.is_closed() {
            true => BusError::Closed,
            false => BusError::transport("cannot publish", without_places(&error)),
        })
    }
}

/// Keeps a subscriber or a queryable, and its session, alive.
struct Alive<T> {
    _what: T,
    _session: Session,
}

impl<T: Send> Guard for Alive<T> {}

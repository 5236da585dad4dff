//! A WebSocket to which Foxglove and Lichtblick connect.

use std::collections::BTreeMap;
use std::io::ErrorKind;
use std::net::{SocketAddr, ToSocketAddrs};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use foxglove::websocket::ServerListener;
use foxglove::{Context, FoxgloveError, Schema, WebSocketServer};
use tokio::runtime::Runtime;
use tokio::sync::mpsc::channel;
use tokio::task::yield_now;
use tokio::time::{sleep, timeout};

use super::{Channels, Scene};
use crate::core::time::{Nanos, Timestamp};
use crate::io::bus::{BusError, Sample};
use crate::io::recording::Message;
use crate::io::wire::{ENCODING, SCHEMA_ENCODING, descriptor, schema_of};
use crate::live::MOST_BYTES;
use crate::view::bus::Live;
use crate::view::server::{ViewError, give_way, reachable};

/// What is passed on, below the stage.
const PATTERNS: [&str; 11] = [
    "rig",
    "status",
    "take",
    "events",
    "camera/*/keypoints",
    "actor/*/skeleton",
    "actor/*/status",
    "actor/*/events",
    "actor/*/pose",
    "actor/*/pose/provisional",
    "actor/*/keyframe",
];
/// Most messages in the queue. When it is full, new messages are dropped; so are those larger than [`MOST_BYTES`].
const WAITING: usize = 4096;
/// After so long without a pose or keypoints, time goes on by the clock of this computer.
const SILENT: Duration = Duration::from_secs(1);
/// How often the number of clients is read, and the pause before a bus that failed is opened again.
const LOOK: Duration = Duration::from_millis(100);
const REST: Duration = Duration::from_secs(1);

/// A WebSocket that is served until this is dropped.
pub struct Bridge {
    address: SocketAddr,
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Bridge {
    /// The address to open in Foxglove or Lichtblick.
    pub fn url(&self) -> String {
        format!("ws://{}", reachable(self.address))
    }
}

impl Drop for Bridge {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

/// Counts the clients.
#[derive(Default)]
struct Clients(AtomicUsize);

impl ServerListener for Clients {
    fn on_client_connect(&self) {
        self.0.fetch_add(1, Ordering::Relaxed);
    }

    fn on_client_disconnect(&self) {
        self.0.fetch_sub(1, Ordering::Relaxed);
    }
}

/// Serves a stage on `address`, such as `127.0.0.1:8766`; port 0 chooses a free one. A session on the bus
/// is open only while a client is connected.
///
/// # Errors
/// The address is in use or not of this computer, or the system refuses a thread.
pub fn bridge(address: &str, live: Arc<Live>) -> Result<Bridge, ViewError> {
    let refused = |source| ViewError::Bridge { address: address.to_owned(), source };
    let resolved = address.to_socket_addrs().map_err(refused)?.next();
    let resolved = resolved.ok_or_else(|| refused(ErrorKind::AddrNotAvailable.into()))?;
    let mut builder = tokio::runtime::Builder::new_current_thread();
    let runtime = builder.enable_all().build().map_err(ViewError::Thread)?;
    let (context, clients) = (Context::new(), Arc::new(Clients::default()));
    let channels = Channels::new(Arc::clone(&context));
    let server = WebSocketServer::new()
        .name(format!("bundlemocap {}", live.topics.stage))
        .context(&context)
        .bind(resolved.ip().to_string(), resolved.port())
        .listener(Arc::clone(&clients) as Arc<dyn ServerListener>)
        .tokio_runtime(runtime.handle());
    let server = runtime.block_on(server.start()).map_err(|error| match error {
        FoxgloveError::Bind(error) => refused(error),
        other => refused(std::io::Error::other(other)),
    })?;
    let address = SocketAddr::new(resolved.ip(), server.port());
    let stop = Arc::new(AtomicBool::new(false));
    let stopped = Arc::clone(&stop);
    let run = move || {
        give_way();
        follow(&live, &runtime, channels, &stopped, &clients);
        drop(server.stop());
    };
    let thread = std::thread::Builder::new().name("foxglove".into()).spawn(run);
    Ok(Bridge { address, stop, thread: Some(thread.map_err(ViewError::Thread)?) })
}

/// Serves, and publishes messages while a client is connected.
///
/// The clients are served on this thread, only within `block_on`. On a thread of their own, a client could ask
/// for a new channel that the library had announced, but did not yet know as announced: it is then refused.
fn follow(
    live: &Live,
    runtime: &Runtime,
    mut channels: Channels,
    stop: &AtomicBool,
    clients: &Clients,
) {
    let is_wanted = || clients.0.load(Ordering::Relaxed) > 0 && !stop.load(Ordering::Relaxed);
    while !stop.load(Ordering::Relaxed) {
        runtime.block_on(async { sleep(LOOK).await });
        if !is_wanted() {
            continue;
        }
        if let Err(error) = pass_on(live, runtime, &mut channels, is_wanted) {
            tracing::warn!("Foxglove gets no messages, trying again: {error}");
            runtime.block_on(async { sleep(REST).await });
        }
    }
}

fn pass_on(
    live: &Live,
    runtime: &Runtime,
    channels: &mut Channels,
    is_wanted: impl Fn() -> bool,
) -> Result<(), BusError> {
    let bus = live.open()?;
    let (out, mut samples) = channel::<Sample>(WAITING);
    let stage = &live.topics.stage;
    let (mut guards, mut shown) = (Vec::new(), Scene::live());
    // Calibration and bodies, by topic.
    let mut kept: BTreeMap<Arc<str>, (&str, Sample)> = BTreeMap::new();
    // The capture time that the programs have reached, and when they did.
    let mut reached: Option<(Instant, Timestamp)> = None;
    let dropped = Arc::new(AtomicUsize::new(0));
    for pattern in PATTERNS {
        let (out, dropped) = (out.clone(), Arc::clone(&dropped));
        // On a thread of the transport: nothing but passing on.
        let sink = move |sample: Sample| {
            if sample.payload.len() > MOST_BYTES || out.try_send(sample).is_err() {
                dropped.fetch_add(1, Ordering::Relaxed);
            }
        };
        guards.push(bus.subscribe(&format!("mocap/{stage}/{pattern}"), Box::new(sink))?);
    }
    while is_wanted() {
        let next = runtime.block_on(async {
            yield_now().await; // Clients are served even if there is always a sample.
            timeout(LOOK, samples.recv()).await
        });
        // Without messages the clock of these programs stands still, and performers who are gone stay.
        if let Some((then, capture)) = reached.filter(|(then, _)| then.elapsed() > SILENT) {
            let capture = capture + Nanos::from(then.elapsed());
            reached = Some((Instant::now(), capture));
            shown.put_held(|_| true, channels);
            shown.put_cameras(capture, channels);
            kept.values().for_each(|(schema, sample)| pass(channels, schema, sample));
        }
        let Ok(Some(sample)) = next else { continue };
        let Some(schema) = schema_of(&sample.topic, &sample.encoding) else { continue };
        let topic = &sample.topic;
        let Ok(message) = Message::decode(topic, schema, ENCODING, &sample.payload) else {
            continue;
        };
        let cameras = shown.next;
        if shown.handle(topic, &message, channels) {
            reached = Some((Instant::now(), sample.capture));
        }
        pass(channels, schema, &sample);
        // Each time the cameras are, for clients that came later.
        if let Message::Rig(_) | Message::Skeleton(_) = message {
            kept.insert(Arc::clone(topic), (schema, sample));
        } else if shown.next != cameras {
            kept.values().for_each(|(schema, sample)| pass(channels, schema, sample));
        }
    }
    let dropped = dropped.load(Ordering::Relaxed);
    if dropped > 0 {
        tracing::warn!(
            "{dropped} messages were not sent to Foxglove: the queue was full, or they were too large"
        );
    }
    Ok(())
}

/// Sends a message of ours as it is.
fn pass(channels: &mut Channels, schema: &str, Sample { topic, payload, capture, .. }: &Sample) {
    let ours = || Some(Schema::new(schema, SCHEMA_ENCODING, descriptor(schema)?));
    let bytes = |bytes: &mut Vec<u8>| bytes.extend_from_slice(payload);
    channels.send(topic, (ENCODING, ours), *capture, bytes);
}

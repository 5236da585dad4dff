//! A WebSocket to which Foxglove and Lichtblick connect.

use std::net::{SocketAddr, TcpListener, ToSocketAddrs};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::mpsc::{RecvTimeoutError, sync_channel};
use std::thread::JoinHandle;
use std::time::Duration;

use foxglove::websocket::{ChannelView, Client, ServerListener};
use foxglove::{Context, WebSocketServer, WebSocketServerHandle};

use super::Topics;
use crate::io::bus::{BusError, Sample};
use crate::io::recording::Message;
use crate::io::wire::{ENCODING, schema_of};
use crate::view::bus::Live;
use crate::view::server::ViewError;

/// Most messages that wait; those that come while it is full are dropped.
const WAITING: usize = 4096;
/// How often it is looked whether somebody wants messages, and after which time a bus that failed is opened again.
const LOOK: Duration = Duration::from_millis(100);
const REST: Duration = Duration::from_secs(1);

/// A WebSocket that is served until this is dropped.
pub struct Bridge {
    address: SocketAddr,
    server: Option<WebSocketServerHandle>,
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
    runtime: Option<tokio::runtime::Runtime>,
}

impl Bridge {
    /// The address to open in Foxglove or Lichtblick.
    pub fn url(&self) -> String {
        format!("ws://{}", self.address)
    }
}

impl Drop for Bridge {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
        if let Some(server) = self.server.take() {
            drop(server.stop());
        }
        if let Some(runtime) = self.runtime.take() {
            runtime.shutdown_background();
        }
    }
}

/// Counts the subscriptions of all clients.
#[derive(Default)]
struct Wanted(AtomicUsize);

impl ServerListener for Wanted {
    fn on_subscribe(&self, _client: Client, _channel: ChannelView) {
        self.0.fetch_add(1, Ordering::Relaxed);
    }

    fn on_unsubscribe(&self, _client: Client, _channel: ChannelView) {
        self.0.fetch_sub(1, Ordering::Relaxed);
    }
}

/// Serves a stage on `address`, such as `127.0.0.1:8766`; port 0 chooses a free one. A session on the bus
/// is open only while somebody wants messages.
///
/// # Errors
/// The address is in use or not of this computer, or the system refuses a thread.
pub fn bridge(address: &str, live: Arc<Live>) -> Result<Bridge, ViewError> {
    let refused = |source| ViewError::Listen { address: address.to_owned(), source };
    let resolved: Vec<SocketAddr> = address.to_socket_addrs().map_err(refused)?.collect();
    // Tells what is wrong with the address, and which port is free.
    let address = TcpListener::bind(&*resolved).and_then(|listener| listener.local_addr());
    let address = address.map_err(refused)?;
    let gives_way = || {
        #[cfg(target_os = "linux")]
        let _ = rustix::process::nice(19);
    };
    let mut builder = tokio::runtime::Builder::new_multi_thread();
    builder.worker_threads(1).thread_name("foxglove").enable_all().on_thread_start(gives_way);
    let runtime = builder.build().map_err(ViewError::Thread)?;
    let (context, wanted) = (Context::new(), Arc::new(Wanted::default()));
    let topics = Topics::new(Arc::clone(&context));
    let server = WebSocketServer::new()
        .name(format!("bundlemocap {}", live.topics.stage))
        .context(&context)
        .bind(address.ip().to_string(), address.port())
        .listener(Arc::clone(&wanted) as Arc<dyn ServerListener>)
        .tokio_runtime(runtime.handle());
    let server = runtime
        .block_on(server.start())
        .map_err(|error| refused(std::io::Error::other(error.to_string())))?;
    let stop = Arc::new(AtomicBool::new(false));
    let shared = (Arc::clone(&stop), wanted);
    let follow = move || {
        gives_way();
        follow(&live, topics, &shared.0, &shared.1);
    };
    let thread = std::thread::Builder::new().name("foxglove-bus".into()).spawn(follow);
    let thread = Some(thread.map_err(ViewError::Thread)?);
    Ok(Bridge { address, server: Some(server), stop, thread, runtime: Some(runtime) })
}

/// Passes messages on while somebody wants them.
fn follow(live: &Live, mut topics: Topics, stop: &AtomicBool, wanted: &Wanted) {
    let is_wanted = || wanted.0.load(Ordering::Relaxed) > 0 && !stop.load(Ordering::Relaxed);
    while !stop.load(Ordering::Relaxed) {
        std::thread::sleep(LOOK);
        if !is_wanted() {
            continue;
        }
        if let Err(error) = pass_on(live, &mut topics, is_wanted) {
            tracing::warn!("no messages for Foxglove: {error}");
            std::thread::sleep(REST);
        }
    }
}

fn pass_on(live: &Live, topics: &mut Topics, is_wanted: impl Fn() -> bool) -> Result<(), BusError> {
    let bus = live.open()?;
    let (out, samples) = sync_channel::<Sample>(WAITING);
    let stage = &live.topics.stage;
    let mut guards = Vec::new();
    for pattern in ["rig", "camera/*/keypoints", "actor/*/skeleton", "actor/*/pose"] {
        let out = out.clone();
        // On a thread of the transport: nothing but passing on.
        let sink = move |sample| drop(out.try_send(sample));
        guards.push(bus.subscribe(&format!("mocap/{stage}/{pattern}"), Box::new(sink))?);
    }
    while is_wanted() {
        let sample = match samples.recv_timeout(LOOK) {
            Ok(sample) => sample,
            Err(RecvTimeoutError::Timeout) => continue,
            Err(RecvTimeoutError::Disconnected) => break,
        };
        let Some(schema) = schema_of(&sample.topic, &sample.encoding) else { continue };
        if let Ok(message) = Message::decode(&sample.topic, schema, ENCODING, &sample.payload) {
            topics.handle(&sample.topic, sample.capture, &message);
        }
    }
    Ok(())
}

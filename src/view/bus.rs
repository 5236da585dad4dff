//! A live page: a client of the bus.

use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError, mpsc};
use std::time::Duration;

use axum::extract::ws::{Message, WebSocket};
use serde::Deserialize;
use serde_json::json;
use tokio::sync::mpsc as queue;
use tokio::time::sleep;

use super::frame;
use super::points::Points;
use crate::core::time::Timestamp;
use crate::io::bus::{Bus, BusError, Guard, Sample, check_pattern};
use crate::io::wire::{Schema, Take, Topics, encode, media_type, valid_name};
use crate::live::WallClock;

/// Most frames that wait for a page; those that come while it is full are dropped and counted.
const WAITING: usize = 4096;
/// Most frames in one message to the page, and the pause after each message.
const TOGETHER: usize = 512;
const PAUSE: Duration = Duration::from_millis(4);

/// Opens a session on the bus.
type Open = Box<dyn Fn() -> Result<Box<dyn Bus>, BusError> + Send + Sync>;

/// A stage on the bus.
pub struct Live {
    /// Name of the capture volume.
    pub(super) stage: String,
    open: Open,
}

impl Live {
    /// The stage of that name; `open` opens a session on its bus for each page.
    pub fn new(
        stage: impl Into<String>,
        open: impl Fn() -> Result<Box<dyn Bus>, BusError> + Send + Sync + 'static,
    ) -> Self {
        Self { stage: stage.into(), open: Box::new(open) }
    }

    /// Publishes a command.
    fn command(&self, bus: &dyn Bus, Slate { id, action, name }: Slate) -> Result<(), BusError> {
        let is_known = ["start", "stop", "reset"].contains(&&*action);
        let is_named = if name.is_empty() { action != "start" } else { valid_name(&name).is_ok() };
        if !is_known || !is_named {
            // The page checks what the user enters.
            return Ok(());
        }
        let topics = Topics { stage: self.stage.clone(), ..Topics::default() };
        let take = Take { id: id.into(), action, name };
        let publisher = bus.publisher(&topics.take())?;
        publisher.put(Timestamp::default(), &media_type(Take::FULL_NAME), &encode(&take))
    }

    /// Whether a page may see topics of that pattern: those of the stage, and where other cameras send.
    fn shows(&self, pattern: &str) -> bool {
        let own = format!("mocap/{}/", self.stage);
        check_pattern(pattern).is_ok()
            && (pattern.starts_with(&own) || pattern == "mocap/*/camera/*/keypoints")
    }
}

/// What a page asks for.
#[derive(Deserialize)]
#[serde(rename_all = "lowercase")]
enum Order {
    /// The messages of topics that match these patterns, and no others.
    Topics(Vec<String>),
    /// To begin or end a take, or to make nodes forget the body; as `bundlemocap take`.
    Take(Slate),
}

/// A command to nodes and recorders.
#[derive(Deserialize)]
struct Slate {
    /// The page finds the answers by it.
    id: u32,
    action: String,
    name: String,
}

/// What goes to the page.
enum Outgoing {
    Frame(Vec<u8>),
    Error(String),
}

/// Serves a page until it goes away.
pub(super) async fn attend(mut socket: WebSocket, live: Arc<Live>) {
    let (out, mut outgoing) = queue::channel(WAITING);
    let (orders, received) = mpsc::channel();
    let dropped = Arc::new(AtomicU64::new(0));
    let shared = (Arc::clone(&live), Arc::clone(&dropped));
    let session = move || follow_orders(&shared.0, &received, &out, &shared.1);
    if std::thread::Builder::new().name("view-bus".into()).spawn(session).is_err() {
        return;
    }
    let (mut batch, mut told) = (Vec::new(), 0);
    loop {
        tokio::select! {
            count = outgoing.recv_many(&mut batch, TOGETHER) => {
                if count == 0 || send(&mut socket, &mut batch).await.is_none() {
                    return;
                }
                let lost = dropped.load(Ordering::Relaxed);
                if lost > told {
                    told = lost;
                    let text = json!({ "dropped": lost }).to_string();
                    if socket.send(Message::Text(text.into())).await.is_err() {
                        return;
                    }
                }
                sleep(PAUSE).await;
            }
            message = socket.recv() => match message {
                Some(Ok(Message::Text(text))) => {
                    let Ok(order) = serde_json::from_str::<Order>(&text) else { return };
                    if orders.send(order).is_err() {
                        return;
                    }
                }
                Some(Ok(Message::Ping(_) | Message::Pong(_))) => {}
                _ => return,
            },
        }
    }
}

/// Sends a batch; `None` if the page is gone.
async fn send(socket: &mut WebSocket, batch: &mut Vec<Outgoing>) -> Option<()> {
    let mut frames = Vec::new();
    for outgoing in batch.drain(..) {
        match outgoing {
            Outgoing::Frame(frame) => frames.extend(frame),
            Outgoing::Error(error) => {
                let text = json!({ "error": error }).to_string();
                socket.send(Message::Text(text.into())).await.ok()?;
                return None;
            }
        }
    }
    socket.send(Message::Binary(frames.into())).await.ok()
}

/// Does what the page asks for until it is gone. Runs on a thread of its own: sessions are opened and closed in
/// blocking calls.
fn follow_orders(
    live: &Live,
    orders: &mpsc::Receiver<Order>,
    out: &queue::Sender<Outgoing>,
    dropped: &Arc<AtomicU64>,
) {
    let refuse = |error: BusError| drop(out.blocking_send(Outgoing::Error(error.to_string())));
    let bus = match (live.open)() {
        Ok(bus) => bus,
        Err(error) => return refuse(error),
    };
    let (clock, points) = (WallClock::start(), Arc::new(Mutex::new(Points::default())));
    let mut guards: Vec<(String, Box<dyn Guard>)> = Vec::new();
    while let Ok(order) = orders.recv() {
        let patterns = match order {
            Order::Topics(patterns) => patterns.into_iter().filter(|pattern| live.shows(pattern)),
            Order::Take(slate) => match live.command(&*bus, slate) {
                Ok(()) => continue,
                Err(error) => return refuse(error),
            },
        };
        let patterns: Vec<String> = patterns.collect();
        guards.retain(|(pattern, _)| patterns.contains(pattern));
        for pattern in patterns {
            if guards.iter().any(|(open, _)| *open == pattern) {
                continue;
            }
            let (out, dropped, points) = (out.clone(), Arc::clone(dropped), Arc::clone(&points));
            let sink = move |Sample { topic, capture, payload, .. }: Sample| {
                let mut bytes = Vec::with_capacity(topic.len() + payload.len() + 24);
                let now = clock.now();
                frame::write(&mut bytes, &topic, capture, now, &payload);
                let mut points = points.lock().unwrap_or_else(PoisonError::into_inner);
                if let Some((topic, payload)) = points.follow(&topic, &payload) {
                    frame::write(&mut bytes, &topic, capture, now, &payload);
                }
                if let Err(queue::error::TrySendError::Full(_)) =
                    out.try_send(Outgoing::Frame(bytes))
                {
                    dropped.fetch_add(1, Ordering::Relaxed);
                }
            };
            match bus.subscribe(&pattern, Box::new(sink)) {
                Ok(guard) => guards.push((pattern, guard)),
                Err(error) => return refuse(error),
            }
        }
    }
}

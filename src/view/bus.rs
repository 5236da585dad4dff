//! A live page: a client of the bus.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc;
use std::time::Duration;

use axum::extract::ws::{Message, WebSocket};
use serde::Deserialize;
use serde_json::json;
use tokio::sync::mpsc as queue;
use tokio::time::sleep;

use super::frame;
use crate::io::bus::{Bus, BusError, Guard, Sample, check_pattern};
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

    /// Whether a page may see topics of that pattern: those of the stage, and where other cameras send.
    fn shows(&self, pattern: &str) -> bool {
        let own = format!("mocap/{}/", self.stage);
        check_pattern(pattern).is_ok()
            && (pattern.starts_with(&own) || pattern == "mocap/*/camera/*/keypoints")
    }
}

/// What a page wants to get.
#[derive(Deserialize)]
struct Wanted {
    topics: Vec<String>,
}

/// What goes to the page.
enum Outgoing {
    Frame(Vec<u8>),
    Error(String),
}

/// Serves a page until it goes away.
pub(super) async fn attend(mut socket: WebSocket, live: Arc<Live>) {
    let (out, mut outgoing) = queue::channel(WAITING);
    let (wanted, orders) = mpsc::channel();
    let dropped = Arc::new(AtomicU64::new(0));
    let shared = (Arc::clone(&live), Arc::clone(&dropped));
    let session = move || subscribe(&shared.0, &orders, &out, &shared.1);
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
                    let Ok(Wanted { mut topics }) = serde_json::from_str(&text) else { return };
                    topics.retain(|pattern| live.shows(pattern));
                    if wanted.send(topics).is_err() {
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

/// Subscribes to what the page wants, until it is gone. Runs on a thread of its own: sessions are opened and
/// closed in blocking calls.
fn subscribe(
    live: &Live,
    orders: &mpsc::Receiver<Vec<String>>,
    out: &queue::Sender<Outgoing>,
    dropped: &Arc<AtomicU64>,
) {
    let refuse = |error: BusError| drop(out.blocking_send(Outgoing::Error(error.to_string())));
    let bus = match (live.open)() {
        Ok(bus) => bus,
        Err(error) => return refuse(error),
    };
    let clock = WallClock::start();
    let mut guards: Vec<(String, Box<dyn Guard>)> = Vec::new();
    while let Ok(patterns) = orders.recv() {
        guards.retain(|(pattern, _)| patterns.contains(pattern));
        for pattern in patterns {
            if guards.iter().any(|(open, _)| *open == pattern) {
                continue;
            }
            let (out, dropped, clock) = (out.clone(), Arc::clone(dropped), clock);
            let sink = move |Sample { topic, capture, payload, .. }: Sample| {
                let mut bytes = Vec::with_capacity(topic.len() + payload.len() + 24);
                frame::write(&mut bytes, &topic, capture, clock.now(), &payload);
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

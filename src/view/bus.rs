//! A live page: a client of the bus.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc;
use std::time::{Duration, Instant};

use axum::extract::ws::{Message, WebSocket};
use serde::Deserialize;
use serde_json::json;
use tokio::sync::{Semaphore, mpsc as queue};
use tokio::time::{interval, sleep, timeout};

use super::frame;
use super::points::Points;
use crate::core::time::Timestamp;
use crate::io::bus::{Bus, BusError, CommandPublisher, Guard, Receiver, Sample, check_pattern};
use crate::io::wire::{Schema, Take, Topics, encode, media_type, valid_name};
use crate::live::WallClock;

/// Most messages that wait for a page; those that come while it is full are dropped and counted.
const WAITING: usize = 4096;
/// Most messages that go to the page together, and the pause after them.
const TOGETHER: usize = 512;
const PAUSE: Duration = Duration::from_millis(12);
/// How often a page is asked whether it is there, and after which silence it is gone.
const PING: Duration = Duration::from_secs(5);
const GONE: Duration = Duration::from_secs(15);
/// How often a page is told who receives what.
const RECEIVERS: Duration = Duration::from_secs(2);
/// Most pages at a time.
const MOST_PAGES: usize = 32;
static PAGES: Semaphore = Semaphore::const_new(MOST_PAGES);

/// Opens a session on the bus.
type Open = Box<dyn Fn() -> Result<Box<dyn Bus>, BusError> + Send + Sync>;

/// A stage on the bus.
pub struct Live {
    /// Those of the node.
    pub(super) topics: Topics,
    open: Open,
}

impl Live {
    /// The stage of a node with these topics; `open` opens a session on its bus for each page.
    pub fn new(
        topics: Topics,
        open: impl Fn() -> Result<Box<dyn Bus>, BusError> + Send + Sync + 'static,
    ) -> Self {
        Self { topics, open: Box::new(open) }
    }

    /// A session on its bus.
    pub(super) fn open(&self) -> Result<Box<dyn Bus>, BusError> {
        (self.open)()
    }

    /// Whether a page may see topics of that pattern: those of the stage, and where other cameras send.
    fn shows(&self, pattern: &str) -> bool {
        let own = format!("mocap/{}/", self.topics.stage);
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
    /// A command of `bundlemocap take`.
    Take(Slate),
}

/// A command to nodes and recorders.
#[derive(Deserialize)]
struct Slate {
    /// The page finds the answers by it.
    id: u32,
    action: String,
    name: String,
    #[serde(default)]
    note: String,
    #[serde(default)]
    mark: String,
    #[serde(default)]
    display_name: String,
    #[serde(default)]
    colour: String,
    #[serde(default)]
    new_name: String,
    #[serde(default)]
    place_m: Vec<f64>,
}

impl Slate {
    /// The command, unless the page has not checked what the user entered.
    fn take(self) -> Option<Take> {
        let Self { id, action, name, note, mark, display_name, colour, new_name, place_m } = self;
        let is_sound = match &*action {
            "start" | "label" | "lock" | "unlock" | "drop" => valid_name(&name).is_ok(),
            "name" => valid_name(&name).is_ok() && valid_name(&new_name).is_ok(),
            "follow" => place_m.len() == 2,
            // Cameras may have any name.
            "mend" => !name.is_empty(),
            "stop" | "reset" | "note" => name.is_empty() || valid_name(&name).is_ok(),
            _ => false,
        };
        let id = id.into();
        let mut take = Take { id, action, name, note, mark, ..Take::default() };
        (take.display_name, take.colour) = (display_name, colour);
        (take.new_name, take.place_m) = (new_name, place_m);
        is_sound.then_some(take)
    }
}

/// What goes to the page.
enum Outgoing {
    /// The bus is open.
    Open,
    /// A message and its time of arrival.
    Sample(Sample, Timestamp),
    /// Who receives topics of performers, of those who announce it; and whether anybody receives poses, if that is
    /// known.
    Receivers(Vec<Receiver>, Option<bool>),
    /// The bus cannot be used.
    Error(String),
}

/// Serves a page until it goes away.
pub(super) async fn attend(mut socket: WebSocket, live: Arc<Live>) {
    let Ok(_permit) = PAGES.try_acquire() else {
        let why = json!({ "error": format!("{MOST_PAGES} pages are open; close one") });
        let _ = socket.send(Message::Text(why.to_string().into())).await;
        return;
    };
    let (out, mut outgoing) = queue::channel(WAITING);
    let (orders, received) = mpsc::channel();
    let dropped = Arc::new(AtomicU64::new(0));
    let shared = (Arc::clone(&live), Arc::clone(&dropped));
    let session = move || follow_orders(&shared.0, &received, &out, &shared.1);
    if std::thread::Builder::new().name("view-bus".into()).spawn(session).is_err() {
        return;
    }
    let (mut batch, mut told, mut points) = (Vec::new(), 0, Points::default());
    let (mut ping, mut heard) = (interval(PING), Instant::now());
    loop {
        tokio::select! {
            count = outgoing.recv_many(&mut batch, TOGETHER) => {
                let lost = dropped.load(Ordering::Relaxed);
                let text = (lost > told).then(|| json!({ "dropped": lost }));
                told = lost;
                let messages = messages(batch.drain(..), text, &mut points);
                for message in messages {
                    if send(&mut socket, message).await.is_none() {
                        return;
                    }
                }
                if count == 0 {
                    return;
                }
                sleep(PAUSE).await;
            }
            message = socket.recv() => {
                heard = Instant::now();
                match message {
                    Some(Ok(Message::Text(text))) => {
                        let Ok(order) = serde_json::from_str::<Order>(&text) else { return };
                        if orders.send(order).is_err() {
                            return;
                        }
                    }
                    Some(Ok(Message::Ping(_) | Message::Pong(_))) => {}
                    _ => return,
                }
            }
            _ = ping.tick() => {
                let is_gone = heard.elapsed() > GONE;
                if is_gone || send(&mut socket, Message::Ping(Vec::new().into())).await.is_none() {
                    return;
                }
            }
        }
    }
}

/// The messages to the page for what came together, and a text.
fn messages(
    batch: impl Iterator<Item = Outgoing>,
    text: Option<serde_json::Value>,
    points: &mut Points,
) -> Vec<Message> {
    let (mut frames, mut texts) = (Vec::new(), Vec::from_iter(text));
    for outgoing in batch {
        match outgoing {
            Outgoing::Open => texts.push(json!({ "open": true })),
            Outgoing::Receivers(all, received) => {
                texts.push(json!({ "receivers": all, "received": received }));
            }
            Outgoing::Error(error) => texts.push(json!({ "error": error })),
            Outgoing::Sample(Sample { topic, capture, payload, .. }, arrival) => {
                frame::write(&mut frames, &topic, capture, arrival, &payload);
                if let Some((topic, payload)) = points.follow(&topic, &payload) {
                    frame::write(&mut frames, &topic, capture, arrival, &payload);
                }
            }
        }
    }
    let texts = texts.into_iter().map(|text| Message::Text(text.to_string().into()));
    let frames = (!frames.is_empty()).then(|| Message::Binary(frames.into()));
    texts.chain(frames).collect()
}

/// Sends a message; `None` if the page is gone.
async fn send(socket: &mut WebSocket, message: Message) -> Option<()> {
    timeout(GONE, socket.send(message)).await.ok()?.ok()
}

/// Does what the page asks for until it is gone. Runs on a thread of its own: sessions are opened and closed in
/// blocking calls.
fn follow_orders(
    live: &Live,
    orders: &mpsc::Receiver<Order>,
    out: &queue::Sender<Outgoing>,
    dropped: &Arc<AtomicU64>,
) {
    if let Err(error) = try_orders(live, orders, out, dropped) {
        drop(out.blocking_send(Outgoing::Error(error.to_string())));
    }
}

fn try_orders(
    live: &Live,
    orders: &mpsc::Receiver<Order>,
    out: &queue::Sender<Outgoing>,
    dropped: &Arc<AtomicU64>,
) -> Result<(), BusError> {
    let bus = live.open()?;
    // It is there before the first command, so that nodes and recorders know it.
    let mut commands = CommandPublisher::open(&*bus, live.topics.take())?;
    let clock = WallClock::start();
    let mut guards: Vec<(String, Box<dyn Guard>)> = Vec::new();
    drop(out.blocking_send(Outgoing::Open));
    let below = format!("mocap/{}/actor", live.topics.stage);
    let watch = bus.watch(&format!("{below}/*/pose"))?;
    let mut next = Instant::now() + RECEIVERS;
    loop {
        let order = orders.recv_timeout(next.saturating_duration_since(Instant::now()));
        let mut patterns = match order {
            Err(mpsc::RecvTimeoutError::Disconnected) => return Ok(()),
            Err(mpsc::RecvTimeoutError::Timeout) => {
                match bus.receivers(&below) {
                    Ok(receivers) => {
                        let received = watch.as_ref().map(|is_received| is_received());
                        drop(out.try_send(Outgoing::Receivers(receivers, received)));
                    }
                    Err(error) => tracing::debug!("who receives is not known: {error}"),
                }
                next = Instant::now() + RECEIVERS;
                commands.forget_old(&*bus)?;
                continue;
            }
            Ok(Order::Topics(patterns)) => patterns,
            Ok(Order::Take(order)) => {
                if let Some(take) = order.take() {
                    let kind = media_type(Take::FULL_NAME);
                    commands.put(&kind, &encode(&take))?;
                }
                continue;
            }
        };
        patterns.retain(|pattern| live.shows(pattern));
        guards.retain(|(pattern, _)| patterns.contains(pattern));
        patterns.retain(|pattern| guards.iter().all(|(open, _)| open != pattern));
        for pattern in patterns {
            let (out, dropped) = (out.clone(), Arc::clone(dropped));
            // On a thread of the transport: nothing but passing on.
            let sink = move |sample: Sample| {
                let sent = out.try_send(Outgoing::Sample(sample, clock.now()));
                if let Err(queue::error::TrySendError::Full(_)) = sent {
                    dropped.fetch_add(1, Ordering::Relaxed);
                }
            };
            let guard = bus.subscribe(&pattern, Box::new(sink))?;
            guards.push((pattern, guard));
        }
    }
}

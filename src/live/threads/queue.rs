//! The queues between the bus and the node loop: one per camera, so that nobody's messages push out
//! another's. `push` never blocks.
//!
//! Slates and rigs come first, each from a queue of its own, then the cameras in turn. All other topics share one queue, since anybody can
//! make up names. When all queues together are full, the longest one drops its oldest message: a flood
//! loses only its own messages, and cameras that send alike lose alike.

use std::collections::{BTreeMap, HashMap, VecDeque};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use crossbeam_channel::{Receiver, Sender, bounded};

use crate::io::bus::LONGEST_TOPIC;
use crate::live::core::port::{Loss, MOST_BYTES, MOST_ORDER_BYTES};

/// Most bytes that wait, at any number of messages.
const MOST_WAITING_BYTES: usize = 64 << 20;
/// Most messages of a camera that are taken in a second: twice the highest frame rate. It bounds the
/// work and the journal.
pub const MOST_A_SECOND: u64 = 2000;
/// The same of all performers of a solver, which have one queue.
pub const MOST_OF_ALL: u64 = 32 * MOST_A_SECOND;
/// Most rigs, and most slates, that are taken in a second.
const MOST_ORDERS_A_SECOND: u64 = 16;
/// Losses are reported this often.
const REPORT: Duration = Duration::from_secs(1);

/// A message from the bus.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Message {
    /// Its topic.
    pub topic: Arc<str>,
    /// Its bytes.
    pub payload: Vec<u8>,
}

/// The queues; clones share them.
#[derive(Clone)]
pub struct Intake {
    lanes: Arc<Mutex<Lanes>>,
    start: Instant,
    signal: (Sender<()>, Receiver<()>),
}

impl Intake {
    /// Queues for that many messages together and 64 MiB. The cameras are not known yet. Messages of
    /// the topics of `orders` come first, in this order. Of all other topics together, `most_of_others` messages are
    /// taken in a second.
    pub fn new(messages: usize, orders: &[String], most_of_others: u64) -> Self {
        let lanes = Lanes::new(messages, orders, most_of_others);
        Self { lanes: Arc::new(Mutex::new(lanes)), start: Instant::now(), signal: bounded(1) }
    }

    /// Adds a message without blocking; drops one if there is no room.
    pub fn push(&self, message: Message) {
        self.lock().push(message, self.start.elapsed());
        let _ = self.signal.0.try_send(());
    }

    /// The next message, if there is one.
    pub fn take(&self) -> Option<Message> {
        self.lock().take()
    }

    /// What was lost since the last report, unless that is less than a second ago.
    pub fn losses(&self) -> Vec<Loss> {
        self.lock().losses(self.start.elapsed())
    }

    /// What was lost since the last report.
    pub fn last_losses(&self) -> Vec<Loss> {
        self.lock().losses(Duration::MAX)
    }

    /// Gives each of these cameras, by topic and name, a queue of its own.
    pub fn set_cameras(&self, cameras: &[(String, String)]) {
        self.lock().set_cameras(cameras);
    }

    /// Number of queued messages.
    pub fn waiting(&self) -> usize {
        self.lock().waiting
    }

    /// Receives when messages may have been added.
    pub fn signal(&self) -> &Receiver<()> {
        &self.signal.1
    }

    fn lock(&self) -> MutexGuard<'_, Lanes> {
        self.lanes.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// The queue of one camera, of rigs, of slates, or of all other topics.
#[derive(Default)]
struct Lane {
    camera: Option<String>,
    messages: VecDeque<Message>,
    bytes: usize,
    /// Messages that were taken in the current second, and their limit.
    taken: u64,
    most_a_second: u64,
    /// Larger messages are refused.
    most_bytes: usize,
}

impl Lane {
    fn orders() -> Self {
        let (most_a_second, most_bytes) = (MOST_ORDERS_A_SECOND, MOST_ORDER_BYTES);
        Self { most_a_second, most_bytes, ..Self::default() }
    }

    fn keypoints(camera: Option<String>, most_a_second: u64) -> Self {
        Self { camera, most_a_second, most_bytes: MOST_BYTES, ..Self::default() }
    }
}

/// The queues without lock and clock.
#[derive(Default)]
struct Lanes {
    /// One for each order, one for all other topics, one for each camera.
    lanes: Vec<Lane>,
    by_topic: HashMap<String, usize>,
    cameras: Vec<(String, String)>,
    orders: Vec<String>,
    most_of_others: u64,
    /// The lane whose turn it is.
    next: usize,
    waiting: usize,
    bytes: usize,
    most: usize,
    second: u64,
    losses: BTreeMap<Option<String>, Loss>,
    report_at: Duration,
}

impl Lanes {
    fn new(most: usize, orders: &[String], most_of_others: u64) -> Self {
        let (orders, most) = (orders.to_vec(), most.max(1));
        let mut lanes = Self { orders, most_of_others, most, ..Self::default() };
        lanes.build();
        lanes
    }

    /// Empty lanes for the current cameras.
    fn build(&mut self) {
        let names = self.cameras.iter().map(|(_, name)| Some(name.clone()));
        self.lanes = self.orders.iter().map(|_| Lane::orders()).collect();
        self.lanes.push(Lane::keypoints(None, self.most_of_others));
        self.lanes.extend(names.map(|name| Lane::keypoints(name, MOST_A_SECOND)));
        let topics = self.cameras.iter().map(|(topic, _)| topic.clone());
        self.by_topic = topics.zip(self.others() + 1..).collect();
        self.by_topic.extend(self.orders.iter().cloned().zip(0..));
        self.next = self.others();
    }

    /// The lane of all other topics.
    fn others(&self) -> usize {
        self.orders.len()
    }

    fn lane_of(&self, topic: &str) -> usize {
        self.by_topic.get(topic).copied().unwrap_or(self.others())
    }

    fn set_cameras(&mut self, cameras: &[(String, String)]) {
        if self.cameras == cameras {
            return;
        }
        self.cameras = cameras.to_vec();
        let old = std::mem::take(&mut self.lanes);
        self.build();
        for message in old.into_iter().flat_map(|lane| lane.messages) {
            let lane = self.lane_of(&message.topic);
            self.lanes[lane].bytes += message.payload.len();
            self.lanes[lane].messages.push_back(message);
        }
    }

    fn push(&mut self, message: Message, now: Duration) {
        if now.as_secs() != self.second {
            self.second = now.as_secs();
            self.lanes.iter_mut().for_each(|lane| lane.taken = 0);
        }
        let (index, bytes) = (self.lane_of(&message.topic), message.payload.len());
        // The journal has all topics.
        if bytes > self.lanes[index].most_bytes || message.topic.len() > LONGEST_TOPIC {
            let loss = self.loss(index);
            (loss.too_large, loss.bytes) = (loss.too_large + 1, loss.bytes.max(bytes as u64));
            return;
        }
        let lane = &mut self.lanes[index];
        if lane.taken >= lane.most_a_second {
            self.loss(index).dropped += 1;
            return;
        }
        lane.taken += 1;
        lane.bytes += bytes;
        lane.messages.push_back(message);
        (self.waiting, self.bytes) = (self.waiting + 1, self.bytes + bytes);
        while self.waiting > self.most {
            self.drop_from(|lane| lane.messages.len());
        }
        while self.bytes > MOST_WAITING_BYTES {
            self.drop_from(|lane| lane.bytes);
        }
    }

    /// Drops the oldest message of the lane with the largest size.
    fn drop_from(&mut self, size: impl Fn(&Lane) -> usize) {
        let largest = (0..self.lanes.len()).max_by_key(|&lane| size(&self.lanes[lane]));
        if let Some(largest) = largest {
            self.take_from(largest);
            self.loss(largest).dropped += 1;
        }
    }

    fn take_from(&mut self, lane: usize) -> Option<Message> {
        let lane = &mut self.lanes[lane];
        let message = lane.messages.pop_front()?;
        lane.bytes -= message.payload.len();
        (self.waiting, self.bytes) = (self.waiting - 1, self.bytes - message.payload.len());
        Some(message)
    }

    /// The next message: an order, or that of the next lane in turn.
    fn take(&mut self) -> Option<Message> {
        if self.waiting == 0 {
            return None;
        }
        let (others, all) = (self.others(), self.lanes.len());
        let in_turn = (self.next..all).chain(others..self.next);
        let lane = (0..others).chain(in_turn).find(|&at| !self.lanes[at].messages.is_empty())?;
        if lane >= others {
            self.next = if lane + 1 < all { lane + 1 } else { others };
        }
        self.take_from(lane)
    }

    fn loss(&mut self, lane: usize) -> &mut Loss {
        let camera = self.lanes[lane].camera.clone();
        let loss = self.losses.entry(camera.clone()).or_default();
        loss.camera = camera;
        loss
    }

    fn losses(&mut self, now: Duration) -> Vec<Loss> {
        if self.losses.is_empty() || now < self.report_at {
            return Vec::new();
        }
        self.report_at = now.saturating_add(REPORT);
        std::mem::take(&mut self.losses).into_values().collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const NOW: Duration = Duration::ZERO;

    fn message(topic: &str, bytes: usize) -> Message {
        Message { topic: topic.into(), payload: vec![0; bytes] }
    }

    fn lanes(most: usize, cameras: &[&str]) -> Lanes {
        let mut lanes = Lanes::new(most, &["take", "rig"].map(String::from), MOST_A_SECOND);
        let cameras: Vec<_> = cameras.iter().map(|&c| (c.to_owned(), c.to_owned())).collect();
        lanes.set_cameras(&cameras);
        lanes
    }

    fn topics(lanes: &mut Lanes) -> String {
        std::iter::from_fn(|| lanes.take()).map(|message| message.topic.to_string()).collect()
    }

    fn dropped(lanes: &mut Lanes) -> Vec<(String, u64)> {
        let losses = lanes.losses(Duration::MAX).into_iter();
        losses.map(|loss| (loss.camera.unwrap_or_default(), loss.dropped)).collect()
    }

    #[test]
    fn cameras_are_served_in_turn_after_rigs_and_slates() {
        let mut lanes = lanes(100, &["a", "b"]);
        for topic in ["a", "a", "a", "x", "b", "y", "rig", "b", "take"] {
            lanes.push(message(topic, 1), NOW);
        }
        assert_eq!(topics(&mut lanes), "takerigxabyaba");
        assert_eq!((lanes.waiting, lanes.bytes), (0, 0));
    }

    #[test]
    fn a_flood_loses_only_its_own_messages() {
        let mut lanes = lanes(16, &["a", "b", "c"]);
        for _ in 0..3 {
            lanes.push(message("b", 1), NOW);
            (0..400).for_each(|_| lanes.push(message("a", 1), NOW));
            (0..400).for_each(|name| lanes.push(message(&format!("made-up {name}"), 1), NOW));
            lanes.push(message("rig", 1), NOW);
        }
        assert_eq!(lanes.waiting, 16);
        let lost = dropped(&mut lanes);
        assert_eq!(lost.iter().map(|(_, count)| count).sum::<u64>(), 3 * 802 - 16);
        assert_eq!(lost.iter().map(|(camera, _)| &**camera).collect::<String>(), "a");
        let left = topics(&mut lanes);
        assert_eq!((left.matches('b').count(), left.matches("rig").count()), (3, 3), "{left}");
    }

    #[test]
    fn a_flood_of_rigs_does_not_push_out_slates() {
        let mut lanes = lanes(100, &["a"]);
        (0..50).for_each(|_| lanes.push(message("rig", 1), NOW));
        lanes.push(message("take", 1), NOW);
        assert_eq!(lanes.take().unwrap().topic, "take".into());
        assert_eq!((lanes.waiting, dropped(&mut lanes)), (16, vec![(String::new(), 34)]));
        lanes.push(message("rig", MOST_ORDER_BYTES + 1), NOW);
        assert_eq!(lanes.losses(Duration::MAX)[0].too_large, 1);
    }

    #[test]
    fn in_an_overload_all_cameras_lose_alike() {
        let names = ["a", "b", "c", "d"];
        let mut lanes = lanes(40, &names);
        // The node reads one message for every three.
        for _ in 0..300 {
            names.iter().for_each(|name| lanes.push(message(name, 1), NOW));
            lanes.take();
        }
        let lost = dropped(&mut lanes);
        assert_eq!(lost.len(), 4);
        let counts = lost.iter().map(|(_, count)| *count);
        assert!(counts.clone().max().unwrap() - counts.min().unwrap() <= 1, "{lost:?}");
    }

    #[test]
    fn a_camera_may_send_so_many_a_second() {
        let mut lanes = lanes(1_000_000, &["a", "b"]);
        (0..5000).for_each(|_| lanes.push(message("a", 1), NOW));
        lanes.push(message("b", 1), NOW);
        assert_eq!(dropped(&mut lanes), [("a".to_owned(), 3000)]);
        lanes.push(message("a", 1), Duration::from_secs(1));
        assert_eq!(lanes.waiting, 2002);
    }

    #[test]
    fn large_messages_are_not_queued_and_bytes_are_bounded() {
        let mut lanes = lanes(1000, &["a", "b"]);
        lanes.push(message("a", MOST_BYTES + 1), NOW);
        lanes.push(message("a", 60 << 20), NOW);
        let too_large =
            Loss { camera: Some("a".into()), too_large: 2, bytes: 60 << 20, dropped: 0 };
        assert_eq!((lanes.waiting, lanes.losses(NOW)), (0, vec![too_large]));
        (0..5).for_each(|_| lanes.push(message("b", MOST_BYTES), NOW));
        (0..100).for_each(|_| lanes.push(message("a", MOST_BYTES), NOW));
        assert_eq!((lanes.waiting, lanes.bytes), (64, MOST_WAITING_BYTES));
        assert_eq!(dropped(&mut lanes), [("a".to_owned(), 41)]);
    }

    #[test]
    fn losses_are_reported_once_a_second() {
        let mut lanes = lanes(1, &["a"]);
        let mut reports = Vec::new();
        for ms in 0..3000 {
            let now = Duration::from_millis(ms);
            lanes.push(message("a", 1), now);
            reports.extend(lanes.losses(now));
        }
        reports.extend(lanes.losses(Duration::MAX));
        assert_eq!(reports.iter().map(|loss| loss.dropped).sum::<u64>(), 2999);
        assert_eq!(reports.len(), 4, "{reports:?}");
    }

    #[test]
    fn messages_that_wait_stay_when_cameras_become_known() {
        let mut lanes = Lanes::new(100, &["rig".to_owned()], MOST_A_SECOND);
        for topic in ["a", "a", "b", "x", "a"] {
            lanes.push(message(topic, 1), NOW);
        }
        lanes.set_cameras(&["b", "a"].map(|name| (name.to_owned(), name.to_owned())));
        assert_eq!(topics(&mut lanes), "xbaaa");
        assert_eq!((lanes.waiting, lanes.bytes), (0, 0));
    }

    #[test]
    fn nothing_is_lost_or_counted_twice_with_many_at_once() {
        let intake = Intake::new(8, &["rig".to_owned()], MOST_A_SECOND);
        intake.set_cameras(&[0, 1].map(|name| (name.to_string(), name.to_string())));
        let taken = std::thread::scope(|scope| {
            let push = |n: u32| intake.push(message(&(n % 3).to_string(), 7));
            let pushers: Vec<_> =
                (0..4).map(|_| scope.spawn(move || (0..5000).for_each(push))).collect();
            let mut taken = 0;
            while pushers.iter().any(|pusher| !pusher.is_finished()) {
                taken += u64::from(intake.take().is_some());
            }
            taken
        });
        let left = std::iter::from_fn(|| intake.take()).count() as u64;
        let lost: u64 = intake.last_losses().iter().map(|loss| loss.dropped).sum();
        assert_eq!(taken + left + lost, 20_000);
    }
}

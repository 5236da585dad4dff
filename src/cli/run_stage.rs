//! `run` with several performers: gives each its detections, and a node.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::{Duration, Instant};

use crossbeam_channel::TryRecvError;

use super::Ended;
use super::clock::{ATTENTION, Stop};
use super::failure::{Exit, Failure};
use super::node::{Parts, say_goodbye, say_hello, start_node};
use crate::config::Config;
use crate::core::camera::Rig;
use crate::core::detections::Detections;
use crate::core::stage::{Change, Crowd};
use crate::core::time::Timestamp;
use crate::core::tracker::{self, EventKind};
use crate::io::bus::Publisher;
use crate::io::wire::{self, Event, KeypointFrame, Schema, Topics, decode, encode, media_type};
use crate::live::tools::inbox::Inbox;
use crate::live::{Presence, RigFile, Running, WallClock};

/// How often the calibration file is checked for changes.
const LOOK: Duration = Duration::from_millis(500);
/// Most frames that wait, and most bytes.
const FRAMES: usize = 4096;
const BYTES: usize = 64 << 20;
/// The name under which the associating node announces itself.
const NAME: &str = "associator";

/// The stage: who is where, and the node of each performer.
struct Stage<'a> {
    parts: &'a Parts,
    config: &'a Config,
    crowd: Option<(Arc<Rig>, Crowd)>,
    rig: Vec<u8>,
    nodes: Vec<(String, Running)>,
    /// Names of the performers so far.
    names: Vec<String>,
    /// By performer and camera.
    publishers: HashMap<(usize, usize), Box<dyn Publisher>>,
    /// Number of messages that could not be used or published since the last log line, and why.
    trouble: Option<(u64, String)>,
    others: usize,
}

/// Runs until stopped; starts a node for each performer who enters.
pub(super) fn run(parts: &Parts, config: &Config, stop: &Stop, seconds: Option<Duration>) -> Ended {
    let topics = Topics { stage: config.node.stage.clone(), actor: NAME.to_owned() };
    let now = WallClock::start().now();
    let _presence = Presence::announce(Arc::clone(&parts.bus), topics.clone(), now)?.alone()?;
    let patterns = [topics.rig(), topics.keypoints("*")];
    let inbox =
        Inbox::of_size(&*parts.bus, &patterns.each_ref().map(String::as_str), FRAMES, BYTES)?;
    let mut stage = Stage {
        parts,
        config,
        crowd: None,
        rig: Vec::new(),
        nodes: Vec::new(),
        names: Vec::new(),
        publishers: HashMap::new(),
        trouble: None,
        others: 0,
    };
    let mut file = match config.node.rig.as_str() {
        "" => None,
        path => {
            let (file, rig) = RigFile::open(path.into(), config.node.rig_up)
                .map_err(|error| Failure::from(crate::live::NodeError::Rig(error)))?;
            stage.calibrate(rig);
            Some(file)
        }
    };
    say_hello(config, None);
    let (begin, mut looked) = (Instant::now(), Instant::now());
    let why = loop {
        if stop.is_set() {
            break "stopped by a signal";
        }
        if seconds.is_some_and(|seconds| begin.elapsed() >= seconds) {
            break "the time of --seconds is over";
        }
        if looked.elapsed() >= LOOK {
            looked = Instant::now();
            if let Some(Ok(Some(rig))) = file.as_mut().map(RigFile::changed) {
                stage.calibrate(rig);
            }
            let is_over = |(_, node): &(String, Running)| {
                node.over().try_recv() == Err(TryRecvError::Disconnected)
            };
            if stage.nodes.iter().any(is_over) {
                break "a node stopped by itself";
            }
            stage.say();
        }
        let Some(received) = inbox.next(ATTENTION) else { continue };
        let sample = received.sample;
        match *sample.topic == *patterns[0] {
            true if file.is_none() => stage.calibrate(sample.payload),
            true => {}
            false => stage.frame(&sample.payload)?,
        }
    };
    tracing::info!("stopping: {why}");
    stage.say();
    let dropped = inbox.dropped();
    if dropped > 0 {
        tracing::warn!(
            "{dropped} frames came faster than they could be associated, and were dropped"
        );
    }
    let mut fault = None;
    for (name, node) in stage.nodes {
        match node.stop() {
            Ok(status) => say_goodbye(&name, status.as_ref()),
            Err(error) => fault = Some(error),
        }
    }
    fault.map_or(Ok(Exit::Done), |error| Err(error.into()))
}

impl Stage<'_> {
    /// Everybody is looked for anew if the cameras are others.
    fn calibrate(&mut self, bytes: Vec<u8>) {
        if bytes == self.rig {
            return;
        }
        let rig = wire::decode::<wire::Rig>(&bytes).and_then(|rig| rig.to_core());
        let rig = match rig {
            Ok(rig) => Arc::new(rig),
            Err(error) => return tracing::warn!("the calibration cannot be used: {error}"),
        };
        let crowd = match self.crowd.take() {
            Some((_, mut crowd)) => {
                crowd.restart(Arc::clone(&rig));
                crowd
            }
            None => {
                let Config { tracker, stage, .. } = self.config;
                Crowd::new(Arc::clone(&rig), *tracker, stage.performers, None)
            }
        };
        self.publishers.clear();
        (0..self.names.len()).for_each(|performer| self.open(&rig, performer));
        (self.crowd, self.rig) = (Some((rig, crowd)), bytes);
    }

    fn frame(&mut self, payload: &[u8]) -> Result<(), Failure> {
        let Some((rig, crowd)) = &mut self.crowd else { return Ok(()) };
        let rig = Arc::clone(rig);
        let frame = decode::<KeypointFrame>(payload);
        match frame.and_then(|frame| frame.to_core(|camera| rig.index_of(camera))) {
            Ok(frame) => crowd.add(frame),
            // The nodes never see it.
            Err(error) => self.failed(error.to_string()),
        }
        while let Some((at, changes)) = self.crowd.as_mut().and_then(|(_, crowd)| crowd.next(false))
        {
            for change in changes {
                self.apply(&rig, at, change)?;
            }
        }
        Ok(())
    }

    fn apply(&mut self, rig: &Rig, at: Timestamp, change: Change) -> Result<(), Failure> {
        match change {
            Change::Frame(performer, mut frame) => {
                frame.capture = frame.capture - rig.cameras[frame.camera].time_offset;
                self.publish(rig, performer, &frame);
            }
            Change::Complete(..) => {}
            Change::Entered(performer) => {
                let name = self.config.stage.name(performer);
                tracing::info!("{name} has entered");
                self.names.push(name);
                self.open(rig, performer);
                self.solve(performer)?;
                self.tell(performer, at, EventKind::Entered, "a new performer".to_owned());
            }
            Change::Returned(performer) => {
                tracing::info!("{} is back", self.names[performer]);
                let detail = "the performer is back".to_owned();
                self.tell(performer, at, EventKind::Reentered, detail);
            }
            Change::Merged(performer, into) => {
                let detail = format!("is {}", self.names[into]);
                tracing::warn!("{} {detail}", self.names[performer]);
                self.tell(performer, at, EventKind::Merged, detail);
            }
        }
        Ok(())
    }

    /// Starts the node of a performer, unless another program solves it.
    fn solve(&mut self, performer: usize) -> Result<(), Failure> {
        if !self.config.stage.solve {
            return Ok(());
        }
        let name = &self.names[performer];
        let mut config = self.config.clone();
        (config.node.actor, config.node.associated) = (name.clone(), true);
        config.node.solver_core = false;
        if performer > 0 {
            config.node.prometheus.clear();
        }
        let (bus, now) = (Arc::clone(&self.parts.bus), WallClock::start().now());
        let presence = Presence::announce(bus, self.topics(performer), now)?;
        if let Some(elder) = presence.elder()? {
            tracing::info!("{name} is solved by {elder}");
            return Ok(());
        }
        let rig = config.node.rig.is_empty().then(|| self.rig.clone());
        let node = start_node(self.parts, &config, presence, None, rig)?;
        self.nodes.push((name.clone(), node));
        Ok(())
    }

    fn topics(&self, performer: usize) -> Topics {
        let actor = self.names[performer].clone();
        Topics { stage: self.config.node.stage.clone(), actor }
    }

    /// Opens the topics of a performer's detections, some time before the first message.
    fn open(&mut self, rig: &Rig, performer: usize) {
        for (index, camera) in rig.cameras.iter().enumerate() {
            let topic = self.topics(performer).actor_keypoints(&camera.name);
            match self.parts.bus.publisher(&topic) {
                Ok(publisher) => drop(self.publishers.insert((performer, index), publisher)),
                Err(error) => self.failed(error.to_string()),
            }
        }
    }

    fn publish(&mut self, rig: &Rig, performer: usize, frame: &Detections) {
        let (camera, encoding) = (&rig.cameras[frame.camera], media_type(KeypointFrame::FULL_NAME));
        let size = [camera.width, camera.height];
        let bytes = encode(&KeypointFrame::from_core(frame, &camera.name, size));
        let publisher = self.publishers.get(&(performer, frame.camera));
        let done = publisher.map(|publisher| publisher.put(frame.capture, &encoding, &bytes));
        if let Some(Err(error)) = done {
            self.failed(error.to_string());
        }
    }

    /// Publishes an event in a performer's life.
    fn tell(&mut self, performer: usize, capture: Timestamp, kind: EventKind, detail: String) {
        let event = tracker::Event { capture, kind, camera: None, window: None, count: 1, detail };
        let bytes = encode(&Event::from_core(&event, None));
        let publisher = self.parts.bus.publisher(&self.topics(performer).actor_events());
        let put = |publisher: Box<dyn Publisher>| {
            publisher.put(capture, &media_type(Event::FULL_NAME), &bytes)
        };
        if let Err(error) = publisher.and_then(put) {
            self.failed(error.to_string());
        }
    }

    fn failed(&mut self, why: String) {
        let (count, _) = self.trouble.take().unwrap_or_default();
        self.trouble = Some((count + 1, why));
    }

    /// Logs what went wrong, and people who are not solved.
    fn say(&mut self) {
        if let Some((count, why)) = self.trouble.take() {
            tracing::warn!("{count} messages could not be used or published: {why}");
        }
        let others = self.crowd.as_ref().map_or(0, |(_, crowd)| crowd.others());
        if others > std::mem::replace(&mut self.others, others) {
            tracing::warn!("{others} more people were seen, not solved; raise [stage] performers");
        }
    }
}

//! The machine's thread: waits for whatever comes first, stamps it, gives it to the core, and does
//! what the core wants. It never waits for anything else.

use std::sync::Arc;
use std::time::Duration;

use crossbeam_channel::{Receiver, Sender, never, select};

use super::board::Board;
use super::core::{Core, Input, Output, Publication};
use super::error::NodeError;
use super::log::EventLog;
use super::outlet::Outlet;
use super::playout::Playout;
use super::queue::{Intake, Message};
use super::wall::WallClock;
use crate::core::time::Timestamp;
use crate::core::tracker::{Job, Solution};
use crate::io::bus::Sample;
use crate::io::wire::{Event, Rig, Schema, Status, decode, media_type};

/// How long the thread sleeps at most when the core wants nothing.
const IDLE: Duration = Duration::from_secs(1);

/// The solver's answer.
pub(super) struct Answer {
    pub(super) solution: Box<Solution>,
    pub(super) took_ns: u64,
}

/// Everything that can wake the machine.
pub(super) struct Inbox {
    pub(super) intake: Intake,
    pub(super) answers: Receiver<Answer>,
    pub(super) played: Receiver<Vec<i32>>,
    pub(super) rigs: Receiver<Vec<u8>>,
    /// A word, or nobody left to say it: the end.
    pub(super) stop: Receiver<()>,
}

/// The core with all that it needs around it.
pub(super) struct NodeLoop {
    pub(super) core: Core,
    pub(super) clock: WallClock,
    pub(super) inbox: Inbox,
    pub(super) jobs: Sender<Box<Job>>,
    pub(super) playout: Arc<Playout>,
    pub(super) outlet: Outlet,
    pub(super) board: Arc<Board>,
    pub(super) rig_topic: String,
    pub(super) progress: Progress,
}

/// Where the machine is.
#[derive(Default)]
pub(super) struct Progress {
    events: EventLog,
    wake: Option<Timestamp>,
    job_out: bool,
    ended: bool,
}

/// What woke the machine.
enum Turn {
    Input(Input),
    Message(Message),
    Nothing,
    Stop,
}

impl NodeLoop {
    /// Runs until the stop, and then until the last answer is in and the last pose has left.
    pub(super) fn run(mut self) -> Result<(), NodeError> {
        let ended = self.serve();
        self.playout.close();
        while ended.is_ok()
            && let Ok(deviations) = self.inbox.played.recv()
        {
            self.feed(Input::Played(deviations));
        }
        self.progress.events.end_seconds(Timestamp::from_ns(i64::MAX));
        ended
    }

    fn serve(&mut self) -> Result<(), NodeError> {
        while !self.progress.ended || self.progress.job_out {
            match self.wait()? {
                Turn::Input(input) => self.feed(input),
                Turn::Message(message) => self.take_in(message),
                Turn::Nothing => self.progress.events.end_seconds(self.clock.now()),
                Turn::Stop => self.end(),
            }
        }
        Ok(())
    }

    fn wait(&mut self) -> Result<Turn, NodeError> {
        let dropped = self.inbox.intake.take_dropped();
        if dropped > 0 {
            return Ok(Turn::Input(Input::Dropped(dropped)));
        }
        let idle = self.progress.wake.map_or(IDLE, |at| self.clock.until(at).min(IDLE));
        let inbox = &self.inbox;
        Ok(select! {
            recv(inbox.intake.receiver()) -> message => match message {
                Ok(message) => {
                    inbox.intake.took(&message);
                    Turn::Message(message)
                }
                Err(_) => Turn::Stop,
            },
            recv(inbox.answers) -> answer => {
                let Ok(Answer { solution, took_ns }) = answer else {
                    return Err(NodeError::Fault { thread: "solver" });
                };
                self.progress.job_out = false;
                Turn::Input(Input::Solved { solution, took_ns })
            }
            recv(inbox.played) -> deviations => match deviations {
                Ok(deviations) => Turn::Input(Input::Played(deviations)),
                Err(_) => return Err(NodeError::Fault { thread: "playout" }),
            },
            recv(inbox.rigs) -> rig => match rig {
                Ok(rig) => {
                    self.offer_rig(&rig);
                    Turn::Input(Input::RigFile(rig))
                }
                Err(_) => return Err(NodeError::Fault { thread: "rig file" }),
            },
            recv(inbox.stop) -> _ => Turn::Stop,
            default(idle) => match self.progress.wake {
                Some(at) if at <= self.clock.now() => Turn::Input(Input::Tick),
                _ => Turn::Nothing,
            },
        })
    }

    /// What waits still comes in before the end.
    fn end(&mut self) {
        while let Some(message) = self.inbox.intake.try_take() {
            self.take_in(message);
        }
        self.inbox.stop = never();
        self.inbox.rigs = never();
        self.progress.ended = true;
        self.feed(Input::End);
    }

    fn take_in(&mut self, message: Message) {
        let Message { topic, payload } = message;
        if *topic == *self.rig_topic {
            self.offer_rig(&payload);
        }
        self.feed(Input::Message { topic, payload });
    }

    /// Keeps a rig for whoever asks for it, if it is one.
    fn offer_rig(&self, payload: &[u8]) {
        if decode::<Rig>(payload).is_ok_and(|rig| rig.to_core().is_ok()) {
            self.board.set_rig(Sample {
                topic: self.rig_topic.as_str().into(),
                capture: Timestamp::default(),
                encoding: media_type(Rig::FULL_NAME).into(),
                payload: payload.into(),
            });
        }
    }

    fn feed(&mut self, input: Input) {
        let now = self.clock.now();
        if self.progress.wake.is_some_and(|at| at <= now) {
            self.progress.wake = None;
        }
        self.core.handle(now, input);
        while let Some(output) = self.core.poll() {
            match output {
                Output::Solve(job) => self.solve(job),
                Output::Wake(at) => self.progress.wake = Some(at),
                Output::Publish(publication) => self.publish(publication, now),
            }
        }
        self.progress.events.end_seconds(now);
    }

    /// The worker takes one job at a time, and the core has one out at most: there is always room.
    fn solve(&mut self, job: Box<Job>) {
        match self.jobs.try_send(job) {
            Ok(()) => self.progress.job_out = true,
            Err(error) => tracing::error!("a job is lost: {error}; please report this fault"),
        }
    }

    fn publish(&mut self, publication: Publication, now: Timestamp) {
        match publication.due {
            Some(due) => self.playout.push(due, publication),
            None => {
                self.look_at(&publication, now);
                self.outlet.put(&publication, now);
            }
        }
    }

    /// Logs events, and keeps the status and the rig.
    fn look_at(&mut self, publication: &Publication, now: Timestamp) {
        match publication.schema {
            Event::FULL_NAME => {
                if let Ok(event) = decode::<Event>(&publication.payload) {
                    self.progress.events.tell(now, &event);
                }
            }
            Status::FULL_NAME => self.board.set_status(&publication.payload),
            Rig::FULL_NAME => self.offer_rig(&publication.payload),
            _ => {}
        }
    }
}

//! The thread of the node loop: waits for the next input, stamps it, passes it to the core, and
//! handles the outputs. Otherwise it waits only for the bus: at most 1 ms for a full queue, and while it opens the topics
//! of a new performer.

use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use crossbeam_channel::{Receiver, Sender, never, select_biased};

use super::outlet::Outlet;
use super::playout::Playout;
use super::queue::{Intake, Message};
use super::solvers::{Answer, Solvers};
use crate::core::stage::PerformerId;
use crate::core::time::{Nanos, Timestamp};
use crate::io::bus::{Guard, Sample};
use crate::io::wire::{Rig, Schema, Skeleton, Topic, decode, media_type};
use crate::live::clock::wall::WallClock;
use crate::live::core::Core;
use crate::live::core::port::{Input, Output};
use crate::live::core::publication::{Content, Publication};
use crate::live::error::NodeError;
use crate::live::observe::board::Board;
use crate::live::observe::log::EventLog;

/// Longest sleep when the core asks for no tick.
const IDLE: Duration = Duration::from_secs(1);
/// After the node has published its rig in answer to another one, it waits so long before it does so again. The wait
/// doubles while others go on.
const RIG_WAIT: Nanos = Nanos::SECOND;
const MOST_RIG_WAIT: Nanos = Nanos::from_ms(60_000);

/// The announcement of a solver.
pub(crate) type Token = Arc<Mutex<Option<Box<dyn Guard>>>>;

/// All sources that can wake the node loop.
pub(crate) struct Inbox {
    pub(crate) intake: Intake,
    pub(crate) answers: Receiver<Answer>,
    pub(crate) played: Receiver<Vec<i32>>,
    pub(crate) rigs: Receiver<Vec<u8>>,
    /// The solvers of the stage, at each change.
    pub(crate) solver_names: Receiver<Vec<String>>,
    /// Stops the loop when asked to, or when all senders are gone.
    pub(crate) stop: Receiver<()>,
}

/// The core, and everything that handles its outputs.
pub(crate) struct NodeLoop {
    pub(crate) core: Core,
    pub(crate) clock: WallClock,
    pub(crate) inbox: Inbox,
    /// Of a solver: its announcement. It ends when the performers are released.
    pub(crate) token: Token,
    pub(crate) jobs: Solvers,
    pub(crate) playout: Arc<Playout>,
    pub(crate) outlet: Outlet,
    pub(crate) board: Arc<Board>,
    pub(crate) rig_topic: String,
    /// Calibrations with a mended camera, each with the version of the one before; for the file.
    pub(crate) mended: Sender<(Rig, u64)>,
    /// For the folder of known bodies, as in [`Output::Body`].
    pub(crate) bodies: Sender<(PerformerId, String, Option<Skeleton>)>,
    pub(crate) progress: Progress,
}

/// The state of the loop.
#[derive(Default)]
pub(crate) struct Progress {
    events: EventLog,
    wake: Option<Timestamp>,
    /// When the node's rig is to be published because somebody else has published another.
    rig_due: Option<Timestamp>,
    /// When that was done last, and the wait after it.
    rig_answered: Option<(Timestamp, Nanos)>,
    jobs_out: usize,
    ended: bool,
}

/// The reason for which the loop woke.
enum Turn {
    Input(Input),
    Message(Message),
    Nothing,
    Stop,
}

impl NodeLoop {
    /// Runs until it is stopped; then waits for the last solution and publishes the last pose.
    pub(crate) fn run(mut self) -> Result<(), NodeError> {
        // The file's rig before any message.
        if let Ok(rig) = self.inbox.rigs.try_recv() {
            self.feed(Input::RigFile(rig));
        }
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
        while !self.progress.ended || self.progress.jobs_out > 0 {
            match self.wait()? {
                Turn::Input(input) => self.feed(input),
                Turn::Message(message) => self.take_in(message),
                Turn::Nothing => self.progress.events.end_seconds(self.clock.now()),
                Turn::Stop => self.end(),
            }
            self.answer_rig();
        }
        Ok(())
    }

    /// The next input. Messages come last and one by one, so that a flood of them holds up nothing
    /// else.
    fn wait(&mut self) -> Result<Turn, NodeError> {
        let losses = self.inbox.intake.losses();
        if !losses.is_empty() {
            return Ok(Turn::Input(Input::Dropped(losses)));
        }
        let pause = match self.inbox.intake.waiting() {
            0 => self.progress.wake.map_or(IDLE, |at| self.clock.until(at).min(IDLE)),
            _ => Duration::ZERO,
        };
        let inbox = &self.inbox;
        select_biased! {
            recv(inbox.stop) -> _ => return Ok(Turn::Stop),
            recv(inbox.answers) -> answer => {
                let Ok(Answer { performer, solution, took }) = answer else {
                    return Err(NodeError::Fault { thread: "solver" });
                };
                self.progress.jobs_out = self.progress.jobs_out.saturating_sub(1);
                return Ok(Turn::Input(Input::Solved { performer, solution, took }));
            }
            recv(inbox.played) -> deviations => return match deviations {
                Ok(deviations) => Ok(Turn::Input(Input::Played(deviations))),
                Err(_) => Err(NodeError::Fault { thread: "playout" }),
            },
            recv(inbox.rigs) -> rig => return match rig {
                Ok(rig) => Ok(Turn::Input(Input::RigFile(rig))),
                Err(_) => Err(NodeError::Fault { thread: "rig file" }),
            },
            recv(inbox.solver_names) -> names => return match names {
                Ok(names) => Ok(Turn::Input(Input::Solvers(names))),
                Err(_) => Err(NodeError::Fault { thread: "solver names" }),
            },
            recv(inbox.intake.signal()) -> _ => {}
            default(pause) => {}
        }
        Ok(match (inbox.intake.take(), self.progress.wake) {
            (Some(message), _) => Turn::Message(message),
            (None, Some(at)) if at <= self.clock.now() => Turn::Input(Input::Tick),
            _ => Turn::Nothing,
        })
    }

    /// Handles the queued messages, then the end.
    fn end(&mut self) {
        for _ in 0..self.inbox.intake.waiting() {
            let Some(message) = self.inbox.intake.take() else { break };
            self.take_in(message);
        }
        let losses = self.inbox.intake.last_losses();
        if !losses.is_empty() {
            self.feed(Input::Dropped(losses));
        }
        self.inbox.stop = never();
        self.inbox.rigs = never();
        self.inbox.solver_names = never();
        self.progress.ended = true;
        self.feed(Input::End);
        drop(self.token.lock().unwrap_or_else(PoisonError::into_inner).take());
    }

    fn take_in(&mut self, message: Message) {
        let Message { topic, payload } = message;
        let is_rig = *topic == *self.rig_topic;
        let is_other = is_rig && self.core.is_other_rig(&payload);
        let before = self.core.rig_hash();
        self.feed(Input::Message { topic, payload });
        // A solver also changes it with the front's keypoints.
        if is_rig || self.core.rig_hash() != before {
            self.offer_rig();
        }
        if is_other {
            let next = self.progress.rig_answered.map(|(last, wait)| last + wait);
            self.progress.rig_due = next.max(Some(self.clock.now()));
        }
    }

    /// Publishes the rig of the node's file if that is due.
    fn answer_rig(&mut self) {
        let now = self.clock.now();
        if self.progress.rig_due.is_none_or(|due| due > now) {
            return;
        }
        let waited = self.progress.rig_answered.filter(|(last, wait)| now < *last + *wait * 2);
        let wait = waited.map_or(RIG_WAIT, |(_, wait)| (wait * 2).min(MOST_RIG_WAIT));
        (self.progress.rig_due, self.progress.rig_answered) = (None, Some((now, wait)));
        let Some(Ok(rig)) = self.core.rig().map(decode::<Rig>) else { return };
        let (topic, capture) = (self.rig_topic.as_str().into(), Timestamp::default());
        self.outlet
            .put(&Publication { topic, capture, due: None, content: Content::Rig(rig) }, now);
    }

    /// Stores the current rig on the board, and gives its cameras queues of their own.
    fn offer_rig(&self) {
        let Some(payload) = self.core.rig() else { return };
        self.inbox.intake.set_cameras(&self.core.camera_topics());
        self.board.set_rig(Sample {
            topic: self.rig_topic.as_str().into(),
            capture: Timestamp::default(),
            encoding: media_type(Rig::FULL_NAME).into(),
            payload: payload.to_vec(),
        });
    }

    fn feed(&mut self, input: Input) {
        let now = self.clock.now();
        if self.progress.wake.is_some_and(|at| at <= now) {
            self.progress.wake = None;
        }
        self.core.handle(now, input);
        while let Some(output) = self.core.poll() {
            match output {
                Output::Solve { performer, job, deadline } => {
                    self.progress.jobs_out += 1;
                    self.jobs.push(deadline, performer, job);
                }
                Output::Wake(at) => self.progress.wake = Some(at),
                Output::Publish(publication) => self.publish(publication, now),
                // There is room: a camera is mended once in a while.
                Output::Mended { rig, instead_of } => {
                    let _ = self.mended.try_send((rig, instead_of));
                }
                Output::Body { performer, name, body } => {
                    if self.bodies.try_send((performer, name, body)).is_err() {
                        let text =
                            "the folder of known bodies is not up to date: the disk is too slow";
                        tracing::warn!("{text}");
                    }
                }
            }
        }
        self.progress.events.end_seconds(now);
    }

    fn publish(&mut self, publication: Publication, now: Timestamp) {
        match publication.due {
            Some(due) => self.playout.push(due, publication),
            None => {
                self.outlet.put(&publication, now);
                self.note(publication, now);
            }
        }
    }

    /// Logs events and stores the status and the rig.
    fn note(&mut self, publication: Publication, now: Timestamp) {
        let is_node = self.core.is_of_node(&publication.topic);
        match publication.content {
            Content::Event(event) => {
                let actor = (!is_node).then(|| Topic::actor(&publication.topic));
                self.progress.events.tell(now, &event, actor.as_deref());
            }
            Content::Status(status) if is_node => self.board.set_status(*status),
            Content::StageStatus(status) => self.board.set_stage(status),
            Content::Status(_) => {}
            Content::Rig(_) => self.offer_rig(),
            Content::Skeleton(_)
            | Content::Pose(_)
            | Content::Keyframe(_)
            | Content::Journal(_)
            | Content::Answer(_)
            | Content::Keypoints(_)
            | Content::HandOver(_) => {}
        }
    }
}

//! Solvers share the performers of a stage that does not solve them: any number of nodes, on any computer.
//!
//! Nobody distributes the performers. Every solver knows which ones are there, by their announcements. A performer
//! belongs to the solver with the largest hash of its name and the performer's number (rendezvous hashing). So if one of n
//! solvers comes or leaves, 1/n of the performers move.
//!
//! Every solver gets everybody's frames, and keeps the newest ones of those whom it does not solve. After each window the
//! solver of a performer publishes a [`HandOver`]. The next solver goes on from there: at once if the one before has
//! released the performer, is gone, or says nothing. A new solver gets performers after half a second, when it has frames
//! of that time.

use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;

use super::Core;
use super::publication::Content;
use crate::core::camera::Rig;
use crate::core::detections::Detections;
use crate::core::fnv::fnv1a;
use crate::core::random::Draws;
use crate::core::stage::{PerformerFrames, PerformerId};
use crate::core::time::{Nanos, Timestamp};
use crate::core::tracker::{self, EventKind};
use crate::io::wire::{self, DecodeError, HandOver, KeypointSet, Topics};

/// The newest frames of performers who are solved elsewhere are kept for this long.
const KEPT: Nanos = Nanos::from_ms(1500);
/// At most so many sets of frames of each are kept.
const MOST_KEPT: usize = 1024;
/// A new solver gets performers after this time.
const SETTLING: Nanos = Nanos::from_ms(500);
/// Capture times go back by at least this if the cameras' clock does.
const BACK: Nanos = Nanos::from_ms(50);
/// Another solver that says nothing of a performer for this long does not solve it.
const SILENT: Nanos = Nanos::SECOND;
/// A performer whose frames end this long before those of others is not followed.
const NO_FRAMES: Nanos = Nanos::SECOND;
/// A state that is older than the known one by up to this is not used. By more, the cameras' clock went back.
const MOST_LATE: Nanos = Nanos::from_ms(60_000);
/// Most calibrations that a solver keeps.
const MOST_RIGS_KEPT: usize = 8;
/// The motion goes on if the frames begin at most this long after its end.
const HOLE: Nanos = Nanos::from_ms(100);

/// Which set of a performer's frames it is; the fields are those of [`KeypointSet`].
#[derive(Clone, Copy)]
struct SetNumber {
    run_id: u64,
    number: u64,
    complete: Timestamp,
}

impl SetNumber {
    /// How many sets between this one and the next were lost, and whether the performer entered with one of them.
    fn lost_before(&self, next: &Self) -> (u64, bool) {
        if next.run_id != self.run_id || next.complete <= self.complete {
            return (0, false);
        }
        match next.number.checked_sub(self.number) {
            Some(after) => (after.saturating_sub(1), false),
            None => (next.number.saturating_sub(1), true),
        }
    }
}

/// A performer of the stage.
#[derive(Default)]
struct Shared {
    /// The name in the topics.
    name: String,
    is_ours: bool,
    /// The last set.
    last: Option<SetNumber>,
    /// The last state, of whoever solves the performer, and when it came.
    state: Option<HandOver>,
    heard: Timestamp,
    /// Solved elsewhere: the newest frames.
    recent: VecDeque<PerformerFrames>,
}

/// What a solver knows of the performers of the stage.
#[derive(Default)]
pub(super) struct Sharing {
    performers: BTreeMap<PerformerId, Shared>,
    /// When the solvers came that came in this run.
    since: BTreeMap<String, Timestamp>,
    /// Up to when the frames of the last set are complete.
    complete: Timestamp,
    /// By camera, the newest capture time.
    newest: BTreeMap<usize, Timestamp>,
    /// Hash of the front's calibration; 0: not known.
    pub(super) front_rig: u64,
    /// The last calibrations that came, with their hashes.
    rigs: VecDeque<(u64, Vec<u8>)>,
}

impl Sharing {
    /// The bodies of performers are forgotten, also for solvers that go on with them.
    pub(super) fn forget(&mut self, is_forgotten: impl Fn(PerformerId) -> bool) {
        let all = self.performers.iter_mut().filter(|(performer, _)| is_forgotten(**performer));
        for state in all.filter_map(|(_, shared)| shared.state.as_mut()) {
            (state.body, state.body_estimate) = (Vec::new(), None);
            (state.past, state.ahead) = (Vec::new(), Vec::new());
        }
    }

    /// The name of a performer.
    pub(super) fn name_of(&self, performer: PerformerId) -> Option<&str> {
        self.performers.get(&performer).map(|shared| shared.name.as_str())
    }

    /// The number of the performer with that name.
    pub(super) fn number_of(&self, name: &str) -> Option<usize> {
        let number = self.performers.iter().find(|(_, shared)| shared.name == name);
        number.map(|(number, _)| number.0)
    }

    /// The performers that this node solves.
    pub(super) fn ours(&self) -> Vec<PerformerId> {
        let ours = self.performers.iter().filter(|(_, shared)| shared.is_ours);
        ours.map(|(number, _)| *number).collect()
    }

    /// Keeps a calibration. If there are many, removes the oldest one that is not the front's.
    pub(super) fn keep_rig(&mut self, hash: u64, bytes: &[u8]) {
        self.rigs.retain(|(kept, _)| *kept != hash);
        self.rigs.push_back((hash, bytes.to_vec()));
        let oldest = self.rigs.iter().position(|(kept, _)| *kept != self.front_rig);
        if let Some(oldest) = oldest.filter(|_| self.rigs.len() > MOST_RIGS_KEPT) {
            self.rigs.remove(oldest);
        }
    }

    /// The front's calibration, if it has come; if the front does not say which one it uses, the last one.
    pub(super) fn rig_of_front(&self) -> Option<&[u8]> {
        let is_used = |kept: u64| self.front_rig == 0 || kept == self.front_rig;
        self.rigs.iter().rfind(|(kept, _)| is_used(*kept)).map(|(_, bytes)| bytes.as_slice())
    }

    /// Whether a calibration may be used: it is the front's, or the front's is not known or has not come.
    pub(super) fn may_use(&self, hash: u64) -> bool {
        let has_come = self.rigs.iter().any(|(kept, _)| *kept == self.front_rig);
        hash == self.front_rig || !has_come
    }

    /// Forgets the frames: the cameras are others from here on.
    pub(super) fn forget_frames(&mut self) {
        self.newest.clear();
        self.performers.values_mut().for_each(|shared| shared.recent.clear());
    }

    /// Whether no performer has entered yet.
    pub(super) fn is_empty(&self) -> bool {
        self.performers.is_empty()
    }

    /// Those of them who are followed: their frames come.
    pub(super) fn followed(&self) -> Vec<PerformerId> {
        let is_followed = |number: &PerformerId| {
            let last = self.performers.get(number).and_then(|shared| shared.last);
            last.is_some_and(|last| self.complete - last.complete < NO_FRAMES)
        };
        self.ours().into_iter().filter(is_followed).collect()
    }
}

/// The solver of a performer.
pub(super) fn solver_of(solvers: &[String], performer: PerformerId) -> Option<&str> {
    let weight = |name: &str| {
        let draws = Draws { seed: fnv1a(name.as_bytes()), stream: 0 };
        draws.uniform(0, performer.0 as u64)
    };
    let weighed = solvers.iter().map(|name| (weight(name), name.as_str()));
    weighed.max_by(|a, b| a.0.total_cmp(&b.0).then_with(|| a.1.cmp(b.1))).map(|(_, name)| name)
}

impl Core {
    /// Whether this node solves performers of another one.
    pub(super) fn is_solver(&self) -> bool {
        self.settings.node.solver
    }

    /// The solvers that are there, in order of their names.
    pub(super) fn solvers(&mut self, names: Vec<String>) {
        let before = std::mem::replace(&mut self.settings.carried.solvers, names);
        let solvers = &self.settings.carried.solvers;
        let new: Vec<String> =
            solvers.iter().filter(|name| !before.contains(name)).cloned().collect();
        new.iter().for_each(|solver| self.peers.heard(solver, self.now));
        let all = self.settings.carried.solvers.join(", ");
        if !self.is_solver() {
            let detail = match all.is_empty() {
                true => "no solver is there: start `bundlemocap run config/solver.toml`".to_owned(),
                false => format!("the performers are solved by {all}"),
            };
            self.is_changed = true;
            return self.event(EventKind::Solver, None, detail);
        }
        let solvers = &self.settings.carried.solvers;
        let is_new = !new.is_empty();
        self.sharing.since.retain(|name, _| solvers.contains(name));
        self.sharing.since.extend(new.into_iter().map(|name| (name, self.now)));
        let all: Vec<PerformerId> = self.sharing.performers.keys().copied().collect();
        for performer in all {
            let shared = self.sharing.performers.get(&performer);
            // Who comes has not got the estimate of the body, which is not in every message.
            let state = shared.filter(|shared| is_new && shared.is_ours);
            if let Some(state) = state.and_then(|shared| shared.state.clone()) {
                self.publish_state(state);
            }
            self.review(performer);
        }
    }

    /// A solver got the frames of a performer.
    pub(super) fn keypoint_set(&mut self, actor: &str, payload: &[u8]) {
        let message = wire::decode::<KeypointSet>(payload);
        if let Ok(message) = &message {
            self.use_rig_of_front(message.rig_hash);
        }
        let Some(calibration) = &self.calibration else {
            let detail = "keypoints before a calibration; give it to the front".to_owned();
            return self.event(EventKind::Unusable, None, detail);
        };
        let rig = Arc::clone(&calibration.rig);
        let checked = message.and_then(|message| Ok((self.checked(&message, &rig)?, message)));
        let ((performer, mut set), message) = match checked {
            Ok(checked) => checked,
            Err(error) => return self.event(EventKind::Unusable, None, error.to_string()),
        };
        let last = self.sharing.performers.get(&performer).and_then(|shared| shared.last);
        let is_back = last.is_some_and(|last| last.complete - set.complete > BACK);
        self.note_arrivals(&set.frames, is_back);
        let label = message.label.filter(|label| label.check().is_ok());
        *self.label_mut(performer.0) = label.unwrap_or_default();
        let (run_id, number, complete) = (message.run_id, message.number, set.complete);
        self.sharing.complete = complete;
        let shared = self.sharing.performers.entry(performer).or_default();
        let next = SetNumber { run_id, number, complete };
        let last = shared.last.replace(next);
        let (lost, entered) = last.map_or((0, false), |last| last.lost_before(&next));
        set.enters |= entered;
        let (is_ours, is_renamed) = (shared.is_ours, shared.name != actor);
        actor.clone_into(&mut shared.name);
        if set.enters {
            // It is somebody else's.
            shared.state = None;
        }
        if !shared.is_ours {
            let oldest = set.complete - KEPT;
            shared.recent.push_back(set);
            shared.recent.retain(|set| set.complete >= oldest);
            if shared.recent.len() > MOST_KEPT {
                shared.recent.pop_front();
            }
        } else if let Some(stage) = &mut self.stage {
            stage.associated(performer, set);
            if is_renamed {
                self.use_name(performer);
            }
        }
        if lost > 0 && is_ours {
            let detail =
                "frames from the front did not arrive: the network or this node is too slow";
            self.tell_of(performer, EventKind::Dropped, lost, detail.to_owned());
        }
        self.review(performer);
    }

    /// The frames of a performer, if they fit the calibration.
    fn checked(
        &mut self,
        message: &KeypointSet,
        rig: &Rig,
    ) -> Result<(PerformerId, PerformerFrames), DecodeError> {
        let (performer, mut set) = message.to_core(|name| rig.index_of(name))?;
        for (frame, sent) in set.frames.iter_mut().zip(&message.frames) {
            self.check_points(frame, [sent.image_width, sent.image_height], rig)?;
        }
        Ok((performer, set))
    }

    /// Compares the cameras' clock with the node's: each frame comes with the sets of several performers. `is_back`: the
    /// times of this performer's sets went back. After a pause, the sets of one performer come before those of the next.
    fn note_arrivals(&mut self, frames: &[Detections], is_back: bool) {
        // Who enters brings frames of some time before.
        let mut last = BTreeMap::new();
        for frame in frames {
            let capture = last.entry(frame.camera).or_insert(frame.capture);
            *capture = frame.capture.max(*capture);
        }
        for frame in frames.iter().filter(|frame| last[&frame.camera] == frame.capture) {
            let newest = self.sharing.newest.entry(frame.camera).or_insert(frame.capture);
            let is_back = is_back && *newest - frame.capture > BACK;
            if frame.capture > *newest || is_back {
                *newest = frame.capture;
                self.arrive(frame, Nanos::ZERO);
            }
        }
    }

    /// A node tells what it knows of a performer.
    pub(super) fn hand_over(&mut self, actor: &str, payload: &[u8]) {
        let message = wire::decode::<HandOver>(payload);
        match message.and_then(|message| Ok((message.to_core()?, message))) {
            Ok((state, message)) if self.is_front() => self.know_body(&state, &message),
            Ok((_, message)) if message.solver == self.topics.actor => {}
            Ok((_, message)) => self.state_of_other(actor, message),
            Err(error) => self.event(EventKind::Unusable, None, error.to_string()),
        }
    }

    /// The node of the stage hears how somebody is built, for the folder of known bodies.
    fn know_body(&mut self, state: &tracker::HandOver, message: &HandOver) {
        let performer = PerformerId(message.performer as usize);
        if let (Some(body), Some(stage)) = (state.known_body(), &mut self.stage)
            && performer.0 < self.performers.len()
        {
            let offsets_are_known = state.estimate.knows_offsets();
            stage.know_body(performer, Arc::clone(body), offsets_are_known);
        }
    }

    /// Another solver tells what it knows of a performer.
    fn state_of_other(&mut self, actor: &str, mut message: HandOver) {
        let (performer, now) = (PerformerId(message.performer as usize), self.now);
        if self.is_other_solver(&message.solver) {
            self.peers.heard(&message.solver, now);
        }
        let is_winner = self.is_winner(performer);
        let shared = self.sharing.performers.entry(performer).or_default();
        // The last state under a former name is of no use.
        if !shared.name.is_empty() && shared.name != actor {
            return;
        }
        actor.clone_into(&mut shared.name);
        let before = shared.state.as_ref();
        // So is an earlier state, such as the last one of a former solver.
        let by = before.map_or(0, |before| before.until_ns.saturating_sub(message.until_ns));
        if (1..=MOST_LATE.ns()).contains(&by) {
            return;
        }
        // Who only knows the body does not know how many windows there were.
        message.window = message.window.max(before.map_or(0, |before| before.window));
        if message.body_estimate.is_none() {
            message.body_estimate = before.and_then(|before| before.body_estimate.clone());
        }
        if shared.is_ours {
            // Both solved the performer: the network between them was cut.
            let is_later = before.is_none_or(|before| message.until_ns > before.until_ns);
            if is_winner && !(message.released && is_later) {
                return;
            }
            shared.is_ours = false;
            self.release_here(performer);
        }
        if let Some(shared) = self.sharing.performers.get_mut(&performer) {
            (shared.state, shared.heard) = (Some(message), now);
        }
        self.review(performer);
    }

    fn is_winner(&self, performer: PerformerId) -> bool {
        solver_of(&self.responding(), performer) == Some(self.topics.actor.as_str())
    }

    /// Takes or releases a performer, if it is time to.
    fn review(&mut self, performer: PerformerId) {
        let solvers = self.responding();
        let Some(winner) = solver_of(&solvers, performer) else { return };
        let is_winner = *winner == *self.topics.actor;
        // Who came just now has no frames of the time before.
        let since = self.sharing.since.get(winner);
        let is_ready = since.is_none_or(|since| self.now - *since >= SETTLING);
        // At the begin of a take everybody begins anew.
        let is_settled =
            self.now - self.began >= SETTLING || !self.settings.carried.take.is_empty();
        let Some(shared) = self.sharing.performers.get(&performer) else { return };
        let is_free = match &shared.state {
            Some(state) => {
                let is_silent = self.now - shared.heard > SILENT;
                state.released || is_silent || !solvers.contains(&state.solver)
            }
            None => is_settled,
        };
        match shared.is_ours {
            _ if self.ended => {}
            false if is_winner && is_free && !shared.recent.is_empty() => self.take_over(performer),
            true if !is_winner && is_ready => self.release(performer),
            true | false => {}
        }
    }

    fn take_over(&mut self, performer: PerformerId) {
        let (Some(shared), Some(stage)) =
            (self.sharing.performers.get_mut(&performer), &mut self.stage)
        else {
            return;
        };
        shared.is_ours = true;
        let mut recent = std::mem::take(&mut shared.recent);
        let from = shared.state.as_ref().map(|state| state.solver.clone());
        let mut state = shared.state.as_ref().and_then(|state| state.to_core().ok());
        // The state may be published before the performer is tracked here.
        if let Some(state) = &mut shared.state {
            state.solver.clone_from(&self.topics.actor);
            state.released = false;
        }
        // Keyframes of other weights are other poses.
        let weights = &self.settings.weights;
        let has_weights = |state: &HandOver| state.past.iter().all(|k| k.weights == *weights);
        let goes_on = shared.state.as_ref().is_none_or(has_weights);
        // Nor can the motion go on after the performer returned, or the cameras' clock went back.
        let begin = recent.iter().rposition(|set| set.returns || set.enters);
        if let (Some(state), Some(oldest), Some(newest)) =
            (&mut state, recent.front(), recent.back())
        {
            let is_past = state.until <= newest.complete;
            let has_frames = oldest.complete <= state.until + HOLE;
            if begin.is_some() || !goes_on || !is_past || !has_frames {
                state.motion = None;
            }
            if !is_past {
                state.until = Timestamp::default();
            }
        }
        // The state may be somebody else's.
        if begin.is_some_and(|begin| recent[begin].enters) {
            state = None;
        }
        stage.take_over(performer, state);
        for set in recent.drain(begin.unwrap_or(0)..) {
            stage.associated(performer, set);
        }
        self.performer(performer).skeleton = None;
        self.use_name(performer);
        let detail = match from.filter(|from| !from.is_empty() && *from != self.topics.actor) {
            Some(from) => format!("solved here from now on; {from} did it before"),
            None => "solved here".to_owned(),
        };
        self.tell_of(performer, EventKind::Solver, 1, detail);
    }

    /// Another solver is to go on with a performer.
    fn release(&mut self, performer: PerformerId) {
        let (solver, number) = (self.topics.actor.clone(), performer.0 as u32);
        let Some(shared) = self.sharing.performers.get_mut(&performer) else { return };
        shared.is_ours = false;
        let new = || HandOver { performer: number, solver, ..HandOver::default() };
        let state = HandOver { released: true, ..shared.state.clone().unwrap_or_else(new) };
        shared.state = Some(state.clone());
        self.publish_state(state);
        self.release_here(performer);
        let mut others = self.responding();
        others.retain(|name| *name != self.topics.actor);
        let next = solver_of(&others, performer).unwrap_or("nobody");
        let detail = format!("not solved here any more; {next} goes on");
        self.tell_of(performer, EventKind::Solver, 1, detail);
    }

    /// Releases all performers without a word: other solvers may solve them by now. This node takes them back when the
    /// others release them, or when nobody solves them.
    pub(super) fn step_back(&mut self) {
        if !self.settings.carried.solvers.iter().any(|solver| self.is_other_solver(solver)) {
            return;
        }
        for performer in self.sharing.ours() {
            if let Some(shared) = self.sharing.performers.get_mut(&performer) {
                (shared.is_ours, shared.heard) = (false, self.now);
            }
            self.release_here(performer);
        }
        // The trackers forget the performers before they get the time, so they miss no pose.
        self.drain();
    }

    /// Releases all performers: the node ends.
    pub(super) fn release_all(&mut self) {
        for performer in self.sharing.ours() {
            self.release(performer);
        }
    }

    fn release_here(&mut self, performer: PerformerId) {
        if let Some(stage) = &mut self.stage {
            stage.release(performer);
        }
    }

    fn tell_of(&mut self, performer: PerformerId, kind: EventKind, count: u64, detail: String) {
        let capture = self.clock.capture_time(self.now);
        let event = tracker::Event { capture, kind, camera: None, window: None, count, detail };
        self.emit(&event, Some(performer), None);
    }

    /// The state of a performer after a window; or the node of the stage has recognised somebody.
    pub(super) fn handed_over(&mut self, performer: PerformerId, state: &tracker::HandOver) {
        if self.is_front() {
            let message = HandOver::from_core(performer.0, "", state, &self.settings.weights);
            let topics = self.performer(performer).topics.clone();
            return self.publish_hand_over(&topics, HandOver { released: true, ..message });
        }
        let (solver, weights) = (&self.topics.actor, &self.settings.weights);
        let mut message = HandOver::from_core(performer.0, solver, state, weights);
        let Some(shared) = self.sharing.performers.get_mut(&performer) else { return };
        if !shared.is_ours {
            return;
        }
        let before = shared.state.replace(message.clone());
        if before.is_some_and(|before| before.body_estimate == message.body_estimate) {
            message.body_estimate = None;
        }
        self.publish_state(message);
    }

    fn publish_state(&mut self, message: HandOver) {
        let name =
            self.sharing.name_of(PerformerId(message.performer as usize)).unwrap_or_default();
        let topics = Topics { actor: name.to_owned(), ..self.topics.clone() };
        self.publish_hand_over(&topics, message);
    }

    fn publish_hand_over(&mut self, topics: &Topics, message: HandOver) {
        let capture = Timestamp::from_ns(message.until_ns);
        let message = HandOver { run_id: self.run_id, ..message };
        self.publish(topics.hand_over(), capture, Content::HandOver(Box::new(message)));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lost_sets_are_seen_by_their_numbers() {
        let at = |ms| Timestamp::default() + Nanos::from_ms(ms);
        let set = |run_id, number, ms| SetNumber { run_id, number, complete: at(ms) };
        let before = set(1, 7, 100);
        assert_eq!(before.lost_before(&set(1, 8, 117)), (0, false));
        assert_eq!(before.lost_before(&set(1, 11, 167)), (3, false));
        // The number is somebody else's, whose first set was lost.
        assert_eq!(before.lost_before(&set(1, 2, 200)), (1, true));
        // The same set again, and that of another front.
        assert_eq!(before.lost_before(&set(1, 7, 100)), (0, false));
        assert_eq!(before.lost_before(&set(2, 1, 117)), (0, false));
    }
}

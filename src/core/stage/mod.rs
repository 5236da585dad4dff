//! All performers in front of the cameras, without I/O.
//!
//! A [`Stage`] is used as a [`Tracker`] is: give it inputs, then poll it. Each output comes with the
//! number of its performer. One performer is the tracker's own affair: it gets every frame as it is.
//! With several, a tracker each gets frames in which its performer is alone:
//!
//! - A [`Crowd`] finds out who is who. Frames of about one time wait for each other and form a set
//!   (`sets`).
//! - Each person in view is followed from set to set by [`associate`](super::association::associate)
//!   and triangulation (`people`, `person`): this depends on the detections alone, and so do the
//!   numbers of the performers. It needs no solved pose, which is some frames late.
//! - A newcomer is a performer after five sets, and its tracker gets the frames from the first one on.
//!   Above the limit it is a bystander: followed, so that its detections are nobody else's.
//! - A performer who is not seen for a second is lost: its tracker gets no frames. Who comes back, by
//!   the lengths of the body (`lengths`), has the old number.
//! - Two in one place for 0.3 s are one: the one who came first.

mod config;
mod crowd;
mod lengths;
mod people;
mod person;
mod sets;

use std::collections::VecDeque;
use std::sync::Arc;

use super::body::Skeleton;
use super::time::Timestamp;
use super::tracker::{self, Event, EventKind, FramePeriod, Input, Job, Output, Solution, Tracker};
pub use config::{Config, Performers, PerformersError};
pub use crowd::Crowd;
pub use people::Change;

/// All performers of a stage.
#[derive(Clone, Debug)]
pub struct Stage {
    /// A new performer's tracker.
    template: Tracker,
    /// Known bodies, by performer.
    bodies: Vec<Option<Arc<Skeleton>>>,
    trackers: Vec<Tracker>,
    /// With several performers.
    crowd: Option<Crowd>,
    events: VecDeque<(usize, Event)>,
    inbox: VecDeque<(usize, Input)>,
}

impl Stage {
    /// Performers who are each tracked by a copy of `template`. `period` is the cameras' frame period,
    /// if it was measured before.
    pub fn new(
        template: Tracker,
        config: tracker::Config,
        performers: Performers,
        period: Option<FramePeriod>,
    ) -> Self {
        let template = template.with_frame_period(period);
        let new = || Crowd::new(Arc::clone(template.rig()), config, performers, period);
        let crowd = (performers.limit() > 1).then(new);
        let trackers = if crowd.is_none() { vec![template.clone()] } else { Vec::new() };
        let (events, inbox) = (VecDeque::new(), VecDeque::new());
        Self { template, bodies: Vec::new(), trackers, crowd, events, inbox }
    }

    /// Tracks performers whose bodies are known, by number. They are not estimated.
    #[must_use]
    pub fn with_bodies(mut self, bodies: Vec<Option<Arc<Skeleton>>>) -> Self {
        if self.crowd.is_none() {
            let known = bodies.first().cloned().flatten();
            self.trackers = self.trackers.into_iter().map(|t| t.with_body(known.clone())).collect();
        }
        Self { bodies, ..self }
    }

    /// The trackers, by performer.
    pub fn trackers(&self) -> &[Tracker] {
        &self.trackers
    }

    /// The most people at a time who were seen for a while and are not tracked.
    pub fn others(&self) -> usize {
        self.crowd.as_ref().map_or(0, Crowd::others)
    }

    /// Processes an input of all performers; solutions go to [`Stage::solved`]. Call [`Stage::poll`]
    /// until it is empty before the next one.
    pub fn handle(&mut self, input: Input) {
        let Some(mut crowd) = self.crowd.take() else {
            return self.inbox.push_back((0, input));
        };
        match &input {
            Input::Detections(frame) => crowd.add(frame.clone()),
            Input::Restart | Input::Forget => crowd.restart(Arc::clone(self.template.rig())),
            Input::Rig(rig) => crowd.restart(Arc::clone(rig)),
            Input::End | Input::Tick(_) | Input::Solved(_) => {}
        }
        while let Some((at, changes)) = crowd.next(matches!(input, Input::End)) {
            changes.into_iter().for_each(|change| self.apply(at, change));
        }
        self.crowd = Some(crowd);
        if !matches!(input, Input::Detections(_) | Input::Solved(_)) {
            self.template.handle(input.clone());
            self.inbox.extend((0..self.trackers.len()).map(|one| (one, input.clone())));
        }
    }

    fn apply(&mut self, at: Timestamp, change: Change) {
        let (performer, kind, detail) = match change {
            Change::Frame(performer, frame) => {
                self.inbox.push_back((performer, Input::Detections(frame)));
                return;
            }
            Change::Entered(performer) => {
                let body = self.bodies.get(performer).cloned().flatten();
                self.trackers.push(self.template.clone().with_body(body));
                (performer, EventKind::Entered, "a new performer".to_owned())
            }
            Change::Returned(performer) => {
                self.inbox.push_back((performer, Input::Restart));
                (performer, EventKind::Reentered, "the performer is back".to_owned())
            }
            Change::Merged(performer, into) => {
                (performer, EventKind::Merged, format!("is performer {}", into + 1))
            }
        };
        let event = Event { capture: at, kind, camera: None, window: None, count: 1, detail };
        self.events.push_back((performer, event));
    }

    /// Processes the solution of a performer's job.
    pub fn solved(&mut self, performer: usize, solution: Solution) {
        if let Some(tracker) = self.trackers.get_mut(performer) {
            tracker.handle(Input::Solved(solution));
        }
    }

    /// The next output and its performer, if there is one.
    pub fn poll(&mut self) -> Option<(usize, Output)> {
        loop {
            if let Some((performer, event)) = self.events.pop_front() {
                return Some((performer, Output::Event(event)));
            }
            let mut trackers = self.trackers.iter_mut().enumerate();
            if let Some(next) = trackers.find_map(|(one, tracker)| Some((one, tracker.poll()?))) {
                return Some(next);
            }
            let (performer, input) = self.inbox.pop_front()?;
            if let Some(tracker) = self.trackers.get_mut(performer) {
                tracker.handle(input);
            }
        }
    }

    /// The next output that is not a job. `solve` solves the jobs on this thread, as with
    /// [`Tracker::poll_and_solve`].
    pub fn poll_and_solve(
        &mut self,
        mut solve: impl FnMut(&Job) -> Solution,
    ) -> Option<(usize, Output)> {
        loop {
            match self.poll()? {
                (performer, Output::Solve(job)) => self.solved(performer, solve(&job)),
                output => return Some(output),
            }
        }
    }
}

//! All performers in front of the cameras, without I/O.
//!
//! Give a [`Stage`] inputs, then poll it. With one performer, frames pass to its tracker unchanged. With
//! several, each has a tracker of its own, which gets frames in which its performer is alone:
//!
//! - A [`Crowd`] assigns detections to people. Frames of about one time form a set (`sets`); a set waits
//!   for cameras as a window does.
//! - Each person in view is followed from set to set by [`associate`](super::association::associate)
//!   and triangulation (`people`, `person`): this depends on the detections alone, and so do the
//!   numbers of the performers. It needs no solved pose, which is some frames late.
//! - A newcomer is a performer after five sets, and its tracker gets the frames from the first one on.
//!   Above the limit, or outside the [region](Config::region), it is a bystander: it is followed, so that its
//!   detections are nobody else's. A bystander who enters the region becomes a performer, up to the limit.
//! - A performer who is not seen for a second is lost: its tracker gets no frames. Who comes back is
//!   recognised by the lengths of the body (`lengths`) and keeps the number. Who is not seen for
//!   [longer](Config::left_after_s) has left: somebody else may have the place. Live, the next newcomer also gets
//!   the number of who has left, unless a name was given to it ([`Names`]).
//! - A performer can be dropped, and a person at a place followed, whatever the choice of people is.
//! - Two tracks closer than 0.15 m for 0.3 s are merged; the older one stays. If they were two people, the other
//!   one is recognised when they part.
//!
//! What belongs to the cameras is owned by the stage: their clock, latency and effort are the same for
//! all performers, and windows close when the stage's sets are complete. Live, time offsets and moved
//! cameras are found from one performer, the lead, and hold for all.

mod associated;
mod cameras;
mod config;
mod crowd;
mod known;
mod lengths;
mod names;
mod people;
mod performer_id;
mod person;
mod presence;
mod sets;

use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;

use super::body::{Skeleton, TrackingState};
use super::camera::Rig;
use super::detections::Detections;
use super::time::{Nanos, Timestamp};
use super::tracker::{
    self, Effort, Event, EventKind, FramePeriod, HandOver, Job, Latency, Solution, Tracker,
};
pub use associated::PerformerFrames;
pub use config::{Choice, Config, Performers, PerformersError};
pub use crowd::Crowd;
pub use known::Known;
pub(crate) use lengths::LENGTHS;
pub use names::{Names, NumberName};
pub use people::{Change, Claimed, FollowError, FrameSet, Owner};
pub use performer_id::PerformerId;
pub use presence::{Attendance, Life, Presence};

/// An input of the stage. Solutions go to [`Stage::solved`].
#[derive(Clone, Debug)]
#[non_exhaustive]
pub enum Input {
    /// A camera's detections.
    Detections(Detections),
    /// A new calibration, as for a [`Tracker`].
    Rig(Arc<Rig>),
    /// The capture clock jumped: capture times are so much later from here on. Everybody is searched again.
    ClockJumped(Nanos),
    /// The capture clock has reached this time.
    Tick(Timestamp),
    /// No more input will come.
    End,
}

/// An output of the stage.
#[derive(Clone, Debug)]
#[non_exhaustive]
pub enum Output {
    /// An output of a performer's tracker.
    Performer(PerformerId, tracker::Output),
    /// An event of the cameras, which concerns everybody.
    Event(Event),
    /// The frames of one performer, if the performers are not solved here.
    Frames(PerformerId, PerformerFrames),
}

/// What happens next.
#[derive(Clone, Debug)]
pub(crate) enum Next {
    /// The tracker of a performer gets an input.
    Tracker(usize, tracker::Input),
    /// The stage puts this out.
    Output(Output),
}

/// All performers of a stage.
#[derive(Clone, Debug)]
pub struct Stage {
    /// A new performer's tracker.
    template: Tracker,
    /// Known bodies, by performer.
    bodies: Vec<Option<Arc<Skeleton>>>,
    /// Bodies by performer, and whether their keypoint offsets are known: of those who have not come yet or, without
    /// solving, of all.
    saved: Vec<Option<(Arc<Skeleton>, bool)>>,
    trackers: Vec<Tracker>,
    /// With several performers.
    crowd: Option<Crowd>,
    /// Whether performers are tracked; otherwise only their frames are put out.
    is_solving: bool,
    /// Whether the frames come from such a stage.
    is_associated: bool,
    /// Not solving: the frames of each performer that are not complete.
    incomplete: BTreeMap<usize, PerformerFrames>,
    /// The performer from whom time offsets and moved cameras are found.
    lead: usize,
    /// With several performers: the corrections of time offsets that are in use.
    corrections: Vec<Nanos>,
    next: VecDeque<Next>,
}

impl Stage {
    /// Performers who are each tracked by a copy of `template`. `period` is the cameras' frame period,
    /// if it was measured before.
    pub fn new(template: Tracker, performers: Performers, period: Option<FramePeriod>) -> Self {
        let template = template.with_frame_period(period);
        let (rig, config) = (template.rig(), template.config());
        let new = || Crowd::new(Arc::clone(rig), config, performers, period);
        let mut crowd = (performers.limit() > 1).then(new);
        if let Some(crowd) = &mut crowd {
            // In a recording that is read as a whole, a number is one person.
            crowd.people_mut().reuses_numbers = template.live_settings().is_some();
        }
        let trackers = if crowd.is_none() { vec![template.clone()] } else { Vec::new() };
        Self {
            corrections: template.time_corrections().to_vec(),
            template,
            bodies: Vec::new(),
            saved: Vec::new(),
            trackers,
            crowd,
            is_solving: true,
            is_associated: false,
            incomplete: BTreeMap::new(),
            lead: 0,
            next: VecDeque::new(),
        }
    }

    /// Several performers: only the people of this choice become performers.
    #[must_use]
    pub fn choosing(mut self, choice: Choice) -> Self {
        if let Some(crowd) = &mut self.crowd {
            crowd.people_mut().choice = choice;
        }
        self
    }

    /// Several performers: what they are called.
    #[must_use]
    pub fn naming(mut self, names: Names) -> Self {
        if let Some(crowd) = &mut self.crowd {
            crowd.people_mut().names = names;
        }
        self
    }

    /// Several performers: the name of one, see [`Names::of`].
    pub fn name_of(&self, performer: PerformerId) -> String {
        match &self.crowd {
            Some(crowd) => crowd.people().names.of(performer),
            None => performer.to_string(),
        }
    }

    /// Several performers: gives a name to one, see [`Names::give`]. Who had it and is not followed is forgotten: it is
    /// this one. Returns who had it.
    ///
    /// # Errors
    /// The name of another number.
    pub fn give_name(
        &mut self,
        performer: PerformerId,
        name: &str,
    ) -> Result<Option<PerformerId>, NumberName> {
        self.crowd.as_mut().map_or(Ok(None), |crowd| crowd.people_mut().give_name(performer, name))
    }

    /// Several performers: everybody who is or was here.
    pub fn attendance(&self) -> Attendance {
        self.crowd.as_ref().map(|crowd| crowd.people().attendance()).unwrap_or_default()
    }

    /// Several performers: the person at a place on the floor, x and z in the world, metres, becomes a performer,
    /// wherever the [region](Config::region) is.
    ///
    /// # Errors
    /// Nobody is there, or a performer, or all places are taken.
    pub fn follow_at(&mut self, place: [f64; 2]) -> Result<(), FollowError> {
        let crowd = self.crowd.as_mut();
        let crowd = crowd.ok_or_else(|| FollowError::Nobody("nobody".to_owned()))?;
        crowd.people_mut().follow_at(place)
    }

    /// Several performers: this one is a performer no more until somebody [follows](Self::follow_at) it. Returns
    /// whether it was one.
    pub fn drop_performer(&mut self, performer: PerformerId) -> bool {
        let Some(crowd) = &mut self.crowd else { return false };
        let Some(at) = crowd.people_mut().drop_performer(performer.0) else { return false };
        // Solved here, it has no poses from here on, not even extrapolated ones.
        self.next.push_back(Next::Tracker(performer.0, tracker::Input::Restart));
        let detail = "dropped: not solved until somebody follows this person";
        self.tell(performer.0, at, EventKind::Vacated, detail.to_owned());
        true
    }

    /// Several performers: those who were seen before, in an earlier take. Their bodies are checked in
    /// the first windows, and estimated anew if they do not fit.
    #[must_use]
    pub fn with_known(mut self, known: &[Known]) -> Self {
        let associated = if self.is_associated { known } else { &[] };
        for one in associated {
            self.take_over(one.performer, None);
            let new = self.template.clone().fed(one.performer.0);
            self.trackers[one.performer.0] =
                new.with_known_body(one.body.clone(), one.offsets_are_known);
        }
        let Some(crowd) = &mut self.crowd else { return self };
        crowd.know(known);
        let count = known.iter().map(|one| one.performer.0 + 1).max().unwrap_or(0);
        self.saved.resize(count, None);
        if !self.is_solving {
            for one in known {
                self.saved[one.performer.0] = one.saved_body();
            }
            return self;
        }
        self.trackers.resize(count, self.template.clone());
        for (number, tracker) in self.trackers.iter_mut().enumerate() {
            let new = self.template.clone();
            let own = known.iter().find(|one| one.performer.0 == number);
            let new = match (self.bodies.get(number).cloned().flatten(), own) {
                (Some(body), _) => new.with_body(Some(body)),
                (None, Some(one)) if one.was_here() => {
                    new.with_known_body(one.body.clone(), one.offsets_are_known)
                }
                (None, one) => {
                    self.saved[number] = one.and_then(Known::saved_body);
                    new
                }
            };
            *tracker = new.fed(number);
        }
        self.begin_to_watch(0);
        self
    }

    /// Several performers: what is known of those so far, for the next take.
    pub fn known(&self) -> Vec<Known> {
        let ours = self.trackers.iter().enumerate().filter(|_| self.is_associated);
        let ours = ours.filter(|(_, tracker)| tracker.known_body().is_some());
        let ours = ours.map(|(one, _)| Known { performer: PerformerId(one), ..Known::default() });
        let known = self.crowd.as_ref().map_or_else(|| ours.collect(), Crowd::known);
        let with_body = |one: Known| {
            let tracked = self.trackers.get(one.performer.0).and_then(|tracker| {
                Some((tracker.known_body()?.clone(), tracker.body_estimate().knows_offsets()))
            });
            let saved = || self.saved.get(one.performer.0)?.clone();
            let (body, offsets_are_known) = tracked.or_else(saved).unzip();
            Known { body, offsets_are_known: offsets_are_known.unwrap_or(false), ..one }
        };
        known.into_iter().map(with_body).collect()
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

    /// As [`Stage::trackers`].
    pub(crate) fn trackers_mut(&mut self) -> &mut [Tracker] {
        &mut self.trackers
    }

    /// The tracker whose times hold for all: the lead's; of frames that another stage assigned, that of the first performer
    /// who is tracked. Without one, that of the next performer.
    pub fn lead(&self) -> &Tracker {
        let lead = match self.is_associated {
            true => self.trackers.iter().find(|tracker| is_tracked(tracker)),
            false => self.trackers.get(self.lead),
        };
        lead.unwrap_or(&self.template)
    }

    /// The most people at a time who were seen for a while and are not tracked.
    pub fn others(&self) -> usize {
        self.crowd.as_ref().map_or(0, Crowd::others)
    }

    /// All trackers, and that of the next performer.
    fn all(&mut self) -> impl Iterator<Item = &mut Tracker> {
        self.trackers.iter_mut().chain([&mut self.template])
    }

    /// Forgets the bodies of some performers, see [`tracker::Input::Forget`].
    pub fn forget(&mut self, whose: impl Fn(PerformerId) -> bool) {
        let saved = self.saved.iter_mut().enumerate();
        saved.filter(|(one, _)| whose(PerformerId(*one))).for_each(|(_, body)| *body = None);
        let forgetting = (0..self.trackers.len()).filter(|one| whose(PerformerId(*one)));
        if self.crowd.is_none() {
            return forgetting.for_each(|one| self.trackers[one].handle(tracker::Input::Forget));
        }
        self.next.extend(forgetting.map(|one| Next::Tracker(one, tracker::Input::Forget)));
        self.template.handle(tracker::Input::Forget);
    }

    /// Sets the effort of all performers, see [`Tracker::set_effort`].
    pub fn set_effort(&mut self, effort: Effort) {
        self.all().for_each(|tracker| tracker.set_effort(effort));
    }

    /// Sets the latency of all performers, see [`Tracker::set_latency`].
    pub fn set_latency(&mut self, latency: Latency) {
        self.all().for_each(|tracker| tracker.set_latency(latency));
    }

    /// Sets the usual delay of the cameras, see [`Tracker::set_delay`].
    pub fn set_delay(&mut self, delay: Nanos) {
        self.all().for_each(|tracker| tracker.set_delay(delay));
    }

    /// The capture time at which a live stage needs an [`Input::Tick`], if no other input arrives
    /// before.
    pub fn wake(&mut self) -> Option<Timestamp> {
        let set = self.crowd.as_mut().and_then(Crowd::wake);
        self.trackers.iter().filter_map(Tracker::wake).chain(set).min()
    }

    /// Processes an input of all performers. Call [`Stage::poll`] until it is empty before the next one.
    pub fn handle(&mut self, input: Input) {
        let Some(mut crowd) = self.crowd.take() else {
            let input = of_tracker(input);
            let template = self.is_associated.then_some(&mut self.template);
            let all = self.trackers.iter_mut().chain(template);
            return all.for_each(|tracker| tracker.handle(input.clone()));
        };
        crowd.set_wait(self.lead().delay(), self.lead().longest_wait());
        let is_end = matches!(input, Input::End);
        match &input {
            Input::Detections(frame) => crowd.add(frame.clone()),
            Input::ClockJumped(by) => crowd.restart(*by),
            Input::Rig(rig) => self.calibrate(&mut crowd, rig),
            Input::Tick(now) => crowd.tick(*now),
            Input::End => crowd.end(),
        }
        // The clock at once: a solution may come before the next poll.
        if let Input::Tick(now) = input {
            self.all().for_each(|tracker| tracker.handle(tracker::Input::Tick(now)));
        }
        let is_of_all = !matches!(input, Input::Detections(_) | Input::Tick(_));
        let input = is_of_all.then(|| of_tracker(input));
        if let Some(input) = input.as_ref().filter(|_| !is_end) {
            self.give_all(input);
        }
        while let Some((at, changes)) = crowd.next(is_end) {
            self.watch(crowd.last());
            changes.into_iter().for_each(|change| self.apply(at, change));
        }
        let events = crowd.events().into_iter().map(|event| Next::Output(Output::Event(event)));
        self.next.extend(events);
        if let Some(input) = input.filter(|_| is_end) {
            self.give_all(&input);
        }
        self.crowd = Some(crowd);
    }

    /// Replaces [`Stage::handle`] and [`Stage::poll`] for a caller that gives the trackers their inputs itself. Offline, the
    /// trackers do not depend on each other.
    pub(crate) fn route(&mut self, input: Input) -> VecDeque<Next> {
        match self.crowd {
            Some(_) => self.handle(input),
            None => self.next.push_back(Next::Tracker(0, of_tracker(input))),
        }
        let mut all = VecDeque::new();
        for (one, tracker) in self.trackers.iter_mut().enumerate() {
            // A new tracker puts out its body first.
            while let Some(output) = tracker.poll() {
                all.push_back(Next::Output(Output::Performer(PerformerId(one), output)));
            }
        }
        all.append(&mut self.next);
        all
    }

    fn give_all(&mut self, input: &tracker::Input) {
        self.template.handle(input.clone());
        let each = (0..self.trackers.len()).map(|one| Next::Tracker(one, input.clone()));
        self.next.extend(each);
    }

    fn apply(&mut self, at: Timestamp, change: Change) {
        let (performer, kind, detail) = match change {
            Change::Frame(performer, frame) if !self.is_solving => {
                return self.incomplete.entry(performer).or_default().frames.push(frame);
            }
            Change::Frame(performer, frame) => {
                let next = Next::Tracker(performer, tracker::Input::Detections(frame));
                return self.next.push_back(next);
            }
            Change::Complete(performer, complete) if !self.is_solving => {
                let Some(frames) = self.incomplete.remove(&performer) else { return };
                let frames = PerformerFrames { complete, ..frames };
                let output = Output::Frames(PerformerId(performer), frames);
                return self.next.push_back(Next::Output(output));
            }
            Change::Complete(performer, until) => {
                let complete = tracker::Input::Complete(until);
                return self.next.push_back(Next::Tracker(performer, complete));
            }
            Change::Entered(performer) => {
                if let Some(saved) = self.saved.get_mut(performer) {
                    // The number was somebody else's.
                    *saved = None;
                }
                let enters = PerformerFrames { enters: true, ..PerformerFrames::default() };
                self.begin_frames(performer, enters);
                if self.is_solving && performer < self.trackers.len() {
                    // The number was somebody else's.
                    self.next.push_back(Next::Tracker(performer, tracker::Input::Forget));
                } else if self.is_solving {
                    let body = self.bodies.get(performer).cloned().flatten();
                    self.trackers.push(self.template.clone().with_body(body).fed(performer));
                    self.begin_to_watch(performer);
                }
                (performer, EventKind::Entered, "a new performer".to_owned())
            }
            Change::Returned(performer) => {
                let returns = PerformerFrames { returns: true, ..PerformerFrames::default() };
                self.begin_frames(performer, returns);
                match self.saved.get_mut(performer).and_then(Option::take) {
                    Some((body, offsets_are_known)) if !self.is_solving => {
                        let state = Box::new(HandOver::of_body(body, offsets_are_known, at));
                        let state = tracker::Output::HandOver(state);
                        let output = Output::Performer(PerformerId(performer), state);
                        self.next.push_back(Next::Output(output));
                    }
                    Some((body, offsets_are_known)) => {
                        let new = self.template.clone().with_known_body(body, offsets_are_known);
                        self.trackers[performer] = new.fed(performer);
                        self.begin_to_watch(performer);
                    }
                    None => {
                        self.next.push_back(Next::Tracker(performer, tracker::Input::Restart));
                    }
                }
                (performer, EventKind::Reentered, "the performer is back".to_owned())
            }
            Change::Vacated(performer) => {
                (performer, EventKind::Vacated, "somebody else may have the place".to_owned())
            }
            Change::Merged(performer, into) => {
                (performer, EventKind::Merged, format!("is {}", PerformerId(into)))
            }
        };
        self.tell(performer, at, kind, detail);
    }

    fn tell(&mut self, performer: usize, at: Timestamp, kind: EventKind, detail: String) {
        let event = Event { capture: at, kind, camera: None, window: None, count: 1, detail };
        let output = Output::Performer(PerformerId(performer), tracker::Output::Event(event));
        self.next.push_back(Next::Output(output));
    }

    /// Processes the solution of a performer's job.
    pub fn solved(&mut self, performer: PerformerId, solution: Solution) {
        if let Some(tracker) = self.trackers.get_mut(performer.0) {
            tracker.handle(tracker::Input::Solved(solution));
        }
    }

    /// The next output, if there is one.
    pub fn poll(&mut self) -> Option<Output> {
        loop {
            let mut trackers = self.trackers.iter_mut().enumerate();
            if let Some((one, output)) =
                trackers.find_map(|(one, tracker)| Some((one, tracker.poll()?)))
            {
                if let tracker::Output::Window(_) = output {
                    self.share_cameras();
                }
                return Some(Output::Performer(PerformerId(one), output));
            }
            match self.next.pop_front()? {
                Next::Output(output) => return Some(output),
                Next::Tracker(performer, input) => {
                    if let Some(tracker) = self.trackers.get_mut(performer) {
                        tracker.handle(input);
                    }
                }
            }
        }
    }

    /// The next output that is not a job. `solve` solves the jobs on this thread, as with
    /// [`Tracker::poll_and_solve`].
    pub fn poll_and_solve(&mut self, mut solve: impl FnMut(&Job) -> Solution) -> Option<Output> {
        loop {
            match self.poll()? {
                Output::Performer(performer, tracker::Output::Solve(job)) => {
                    self.solved(performer, solve(&job));
                }
                output => return Some(output),
            }
        }
    }
}

fn is_tracked(tracker: &Tracker) -> bool {
    tracker.state() == Some(TrackingState::Tracking) && !tracker.is_idle()
}

fn of_tracker(input: Input) -> tracker::Input {
    match input {
        Input::Detections(frame) => tracker::Input::Detections(frame),
        Input::Rig(rig) => tracker::Input::Rig(rig),
        Input::ClockJumped(_) => tracker::Input::ClockJumped,
        Input::Tick(now) => tracker::Input::Tick(now),
        Input::End => tracker::Input::End,
    }
}

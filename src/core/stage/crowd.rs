//! The people in view: frames of all cameras in, frames of each performer alone out.

use std::sync::Arc;

use super::config::Performers;
use super::known::Known;
use super::people::{Change, FrameSet, People};
use super::sets::{Complete, Sets};
use crate::core::association::Gates;
use crate::core::camera::Rig;
use crate::core::detections::Detections;
use crate::core::time::{Nanos, Timestamp};
use crate::core::tracker::{Config, Event, FramePeriod};

/// Follows everybody in view. Give it each frame with [`Crowd::add`], then call [`Crowd::next`] until
/// it is empty. What comes out depends on the frames, their order and the clock alone.
#[derive(Clone, Debug)]
pub struct Crowd {
    rig: Arc<Rig>,
    sets: Sets,
    people: People,
    /// Cameras that were moved: what they see is nobody's.
    left_out: Vec<bool>,
}

impl Crowd {
    /// `period` is the cameras' frame period, if it was measured before.
    pub fn new(
        rig: Arc<Rig>,
        config: Config,
        performers: Performers,
        period: Option<FramePeriod>,
    ) -> Self {
        let gates = Gates {
            follow: config.gate.follow,
            agree: config.gate.agree,
            min_confidence: config.min_confidence,
        };
        let sets = Sets::new(rig.cameras.len(), config, period);
        let people = People::new(performers.limit(), gates);
        Self { rig, sets, people, left_out: Vec::new() }
    }

    /// Who is here.
    pub(super) fn people(&self) -> &People {
        &self.people
    }

    pub(super) fn people_mut(&mut self) -> &mut People {
        &mut self.people
    }

    /// Adds a frame.
    pub fn add(&mut self, frame: Detections) {
        self.sets.add(frame, &self.rig);
    }

    /// No more frames will come.
    pub fn end(&mut self) {
        self.sets.end();
    }

    /// Live: the capture clock has reached this time. Without a clock, frame sets wait for the frames of
    /// the cameras.
    pub fn tick(&mut self, now: Timestamp) {
        self.sets.now = self.sets.now.max(Some(now));
    }

    /// Live: the capture time at which the next frame set has waited long enough.
    pub fn wake(&mut self) -> Option<Timestamp> {
        self.sets.wake().filter(|at| Some(*at) > self.sets.now)
    }

    /// Live: the usual time from the capture of a frame to its arrival, and the longest time that a
    /// frame set may wait, if there is a limit.
    pub fn set_wait(&mut self, delay: Nanos, longest: Option<Nanos>) {
        (self.sets.delay, self.sets.longest_wait) = (delay, longest);
    }

    /// Frame sets do not wait for a camera until it sends a frame.
    pub fn leave_out(&mut self, camera: usize) {
        self.sets.intake().waiting.leave_out(camera);
    }

    /// Whether frame sets wait for a camera, and the number of its frames that were used.
    pub fn camera(&mut self, camera: usize) -> (bool, u64) {
        let intake = self.sets.intake();
        (intake.waiting.is_waited_for(camera), intake.used(camera))
    }

    /// Nominal frame period of the cameras, ns.
    pub fn frame_period(&mut self) -> f64 {
        self.sets.period()
    }

    /// What happened at the next time of which the frames are complete; with `all`, of which there are
    /// any. Capture times are those of the cameras' common clock.
    pub fn next(&mut self, all: bool) -> Option<(Timestamp, Vec<Change>)> {
        let Complete { at, frames, until } = self.sets.next(all)?;
        self.people.period = Nanos::rounded(self.sets.period());
        let intake = self.sets.intake();
        self.people.steps.clear();
        self.people.steps.extend((0..intake.cameras()).map(|c| intake.step(c).unwrap_or_default()));
        let (aside, frames) = frames.into_iter().partition(|frame| self.is_left_out(frame.camera));
        Some((at, self.people.process(at, (frames, aside), until, &self.rig)))
    }

    /// The performers so far, without their bodies.
    pub fn known(&self) -> Vec<Known> {
        self.people.known()
    }

    /// These performers were seen before; all are lost until they are seen again.
    pub fn know(&mut self, known: &[Known]) {
        self.people.know(known, self.rig.cameras.len());
    }

    /// The frames of the last time, and whose their people are.
    pub fn last(&self) -> &FrameSet {
        &self.people.last
    }

    /// What is to be reported of the cameras since the last call.
    pub fn events(&mut self) -> Vec<Event> {
        std::mem::take(&mut self.sets.events)
    }

    /// Whether a camera was moved and is left out.
    pub fn is_left_out(&self, camera: usize) -> bool {
        self.left_out.get(camera) == Some(&true)
    }

    /// By camera, whether it was moved and is left out.
    pub fn leave_out_moved(&mut self, cameras: Vec<bool>) {
        self.left_out = cameras;
    }

    /// The cameras have another calibration from here on.
    pub fn set_rig(&mut self, rig: Arc<Rig>) {
        self.rig = rig;
    }

    /// The capture times of a camera are so much later from here on.
    pub(super) fn shift_time(&mut self, camera: usize, by: Nanos) {
        Arc::make_mut(&mut self.rig).shift_time(camera, by);
        let late = self.sets.intake().shift(camera, by);
        self.sets.events.extend(late);
    }

    /// The cameras.
    pub fn rig(&self) -> &Arc<Rig> {
        &self.rig
    }

    /// Forgets the frames; all performers are lost until they are seen again. Capture times are later by `by` from here
    /// on.
    pub fn restart(&mut self, by: Nanos) {
        let before = self.sets.clear(self.rig.cameras.len());
        self.sets.intake().count_on_from(&before);
        self.sets.events.extend(before.abandoned());
        self.people.restart(by);
    }

    /// The same for other cameras, or for these in another world.
    pub fn leave_world(&mut self, rig: Arc<Rig>) {
        let before = self.sets.clear(rig.cameras.len());
        let is_same = rig.has_cameras_of(&self.rig);
        if is_same {
            self.sets.intake().count_on_from(&before);
        }
        let abandoned = before.abandoned();
        self.sets.events.extend(
            abandoned.map(|event| Event { camera: event.camera.filter(|_| is_same), ..event }),
        );
        self.rig = rig;
        self.people.restart(Nanos::ZERO);
        self.people.leave_world();
    }

    /// The most people at a time who were seen for a while and are no performers.
    pub fn others(&self) -> usize {
        self.people.others
    }
}

//! Whose the detections are: frames of all cameras in, frames of each performer alone out.

use std::sync::Arc;

use super::config::Performers;
use super::people::{Change, People};
use super::sets::Sets;
use crate::core::association::Gates;
use crate::core::camera::Rig;
use crate::core::detections::Detections;
use crate::core::time::Timestamp;
use crate::core::tracker::{Config, FramePeriod};

/// Follows the people in view. The same frames in the same order give the same changes.
#[derive(Clone, Debug)]
pub struct Associator {
    rig: Arc<Rig>,
    sets: Sets,
    people: People,
}

impl Associator {
    /// Nobody is known yet.
    pub fn new(rig: Arc<Rig>, config: Config, performers: Performers) -> Self {
        let gates = Gates {
            follow: config.gate.follow,
            agree: config.gate.agree,
            min_confidence: config.min_confidence,
        };
        let sets = Sets::new(rig.cameras.len(), config);
        Self { rig, sets, people: People::new(performers.limit(), gates) }
    }

    /// Begins with a frame period that was measured before, if there is one.
    #[must_use]
    pub fn with_frame_period(mut self, period: Option<FramePeriod>) -> Self {
        self.sets.know(period);
        self
    }

    /// The cameras.
    pub fn rig(&self) -> &Arc<Rig> {
        &self.rig
    }

    /// Other cameras: the frames are forgotten, everybody is looked for, and recognised by the lengths
    /// of the body.
    pub fn calibrate(&mut self, rig: Arc<Rig>) {
        self.sets.clear(rig.cameras.len());
        self.people.restart();
        self.rig = rig;
    }

    /// Adds a frame; returns what the frames that are complete now have changed, with their time.
    pub fn add(&mut self, frame: Detections) -> Vec<(Timestamp, Change)> {
        self.sets.add(frame, &self.rig);
        self.changes(false)
    }

    /// No more frames come: returns what the last ones have changed.
    pub fn end(&mut self) -> Vec<(Timestamp, Change)> {
        self.changes(true)
    }

    fn changes(&mut self, all: bool) -> Vec<(Timestamp, Change)> {
        let mut changes = Vec::new();
        while let Some((at, frames)) = self.sets.next(all) {
            let of_set = self.people.take(at, frames, &self.rig);
            changes.extend(of_set.into_iter().map(|change| (at, change)));
        }
        changes
    }

    /// The most people at a time who were seen for a while and are no performers.
    pub fn others(&self) -> usize {
        self.people.others
    }
}

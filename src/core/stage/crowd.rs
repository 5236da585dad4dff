//! The people in view: frames of all cameras in, frames of each performer alone out.

use std::sync::Arc;

use super::config::Performers;
use super::people::{Change, People};
use super::sets::Sets;
use crate::core::association::Gates;
use crate::core::camera::Rig;
use crate::core::detections::Detections;
use crate::core::time::Timestamp;
use crate::core::tracker::{Config, FramePeriod};

/// Follows everybody in view. Give it each frame with [`Crowd::add`], then call [`Crowd::next`] until
/// it is empty. What comes out depends on the frames and their order alone.
#[derive(Clone, Debug)]
pub struct Crowd {
    rig: Arc<Rig>,
    sets: Sets,
    people: People,
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
        Self { rig, sets, people: People::new(performers.limit(), gates) }
    }

    /// Adds a frame.
    pub fn add(&mut self, frame: Detections) {
        self.sets.add(frame, &self.rig);
    }

    /// What happened at the next time of which the frames are complete; with `all`, of which there are
    /// any.
    pub fn next(&mut self, all: bool) -> Option<(Timestamp, Vec<Change>)> {
        let (at, frames) = self.sets.next(all)?;
        Some((at, self.people.take(at, frames, &self.rig)))
    }

    /// Forgets the frames; all performers are lost until they are seen again. The cameras are those of
    /// `rig` from here on.
    pub fn restart(&mut self, rig: Arc<Rig>) {
        self.sets.clear(rig.cameras.len());
        self.people.restart();
        self.rig = rig;
    }

    /// The most people at a time who were seen for a while and are no performers.
    pub fn others(&self) -> usize {
        self.people.others
    }
}

//! Whose the detections are, without trackers: for a node that gives each performer its detections.

use std::sync::Arc;

use super::Performers;
use super::people::{Change, People};
use super::sets::Sets;
use crate::core::association::Gates;
use crate::core::camera::Rig;
use crate::core::detections::Detections;
use crate::core::time::Timestamp;
use crate::core::tracker::{Config, FrameRate};

/// Follows the people in view. The same frames in the same order give the same changes.
#[derive(Clone, Debug)]
pub struct Associator {
    rig: Arc<Rig>,
    config: Config,
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
        let sets = sets(&rig, config);
        Self { rig, config, sets, people: People::new(performers.limit(), gates) }
    }

    /// The cameras.
    pub fn rig(&self) -> &Arc<Rig> {
        &self.rig
    }

    /// Other cameras: everybody is looked for, and recognised by the lengths of the body.
    pub fn calibrate(&mut self, rig: Arc<Rig>) {
        (self.sets, self.rig) = (sets(&rig, self.config), rig);
        self.people.restart();
    }

    /// Adds a frame; returns what the frames that are complete now have changed, with their time.
    pub fn add(&mut self, frame: Detections) -> Vec<(Timestamp, Change)> {
        self.sets.add(frame, &self.rig);
        let mut changes = Vec::new();
        while let Some((at, frames)) = self.sets.next(false) {
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

fn sets(rig: &Rig, config: Config) -> Sets {
    let cameras = rig.cameras.len();
    Sets::new(cameras, config, FrameRate::new(cameras))
}

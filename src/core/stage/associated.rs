//! A stage on several nodes: one tells people from each other and puts out the frames of each, others track them.

use std::sync::Arc;

use super::config::Performers;
use super::performer_id::PerformerId;
use super::{Next, Stage};
use crate::core::body::Skeleton;
use crate::core::detections::Detections;
use crate::core::time::Timestamp;
use crate::core::tracker::{self, HandOver, Tracker};

/// The frames of one performer at one time.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PerformerFrames {
    /// The frame of each camera, with the performer alone or with nobody, on the cameras' common clock.
    pub frames: Vec<Detections>,
    /// All frames of the performer up to this time were given.
    pub complete: Timestamp,
    /// Whether the performer returns with them.
    pub returns: bool,
    /// Whether the performer enters with them: the number may have been somebody else's.
    pub enters: bool,
}

/// The node that tells people from each other.
impl Stage {
    /// Tracks nobody: puts out the frames of each performer.
    #[must_use]
    pub fn without_solving(mut self) -> Self {
        self.is_solving = false;
        self
    }

    /// Not solving: the body of a performer, who is solved elsewhere, and whether its keypoint offsets are known.
    pub fn know_body(
        &mut self,
        performer: PerformerId,
        body: Arc<Skeleton>,
        offsets_are_known: bool,
    ) {
        if self.saved.len() <= performer.0 {
            self.saved.resize(performer.0 + 1, None);
        }
        self.saved[performer.0] = Some((body, offsets_are_known));
    }

    /// Not solving: the performer enters or returns with the next frames.
    pub(super) fn begin_frames(&mut self, performer: usize, frames: PerformerFrames) {
        if !self.is_solving {
            self.incomplete.insert(performer, frames);
        }
    }
}

/// The nodes that track them.
impl Stage {
    /// Performers whose frames come from a stage that does not solve them: see [`Stage::associated`].
    pub fn of_associated(template: Tracker) -> Self {
        let stage = Self::new(template.handing_over(), Performers::default(), None);
        Self { trackers: Vec::new(), is_associated: true, ..stage }
    }

    /// Gives the next frames of a performer. If it returns or enters with them, tracking begins anew.
    pub fn associated(&mut self, performer: PerformerId, frames: PerformerFrames) {
        let PerformerFrames { frames, complete, returns, enters } = frames;
        let is_new = self.trackers.get(performer.0).is_none_or(Tracker::is_new);
        let begin = match is_new {
            false if enters => Some(tracker::Input::Forget),
            false if returns => Some(tracker::Input::Restart),
            _ => None,
        };
        let frames = frames.into_iter().map(tracker::Input::Detections);
        let inputs = begin.into_iter().chain(frames).chain([tracker::Input::Complete(complete)]);
        self.next.extend(inputs.map(|input| Next::Tracker(performer.0, input)));
    }

    /// Tracks another performer from here on. With a state, it goes on where another node was.
    pub fn take_over(&mut self, performer: PerformerId, state: Option<HandOver>) {
        while self.trackers.len() <= performer.0 {
            self.trackers.push(self.template.clone().fed(self.trackers.len()));
        }
        if let Some(state) = state {
            self.trackers[performer.0].take_over(state);
        }
    }

    /// Tracks a performer no more.
    pub fn release(&mut self, performer: PerformerId) {
        self.next.push_back(Next::Tracker(performer.0, tracker::Input::Forget));
    }
}

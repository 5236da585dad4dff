//! What belongs to the cameras: it is the same for all performers.

use std::sync::Arc;

use super::crowd::Crowd;
use super::people::{Claimed, FrameSet, Owner};
use super::{Next, Stage, is_tracked};
use crate::core::body::TrackingState;
use crate::core::camera::{Camera, Rig};
use crate::core::detections::Detections;
use crate::core::so3;
use crate::core::time::Nanos;
use crate::core::tracker::{self, Tracker};

/// A camera keeps its place if a new calibration moves and turns it by less, metres and radians.
const SAME_PLACE_M: f64 = 0.1;
const SAME_PLACE_RAD: f64 = 0.035;

impl Stage {
    /// Several performers: a new calibration holds for all.
    pub(super) fn calibrate(&mut self, crowd: &mut Crowd, rig: &Arc<Rig>) {
        if !rig.has_cameras_of(crowd.rig()) {
            self.corrections = vec![Nanos::ZERO; rig.cameras.len()];
            crowd.leave_out_moved(Vec::new());
        } else {
            let changes = crowd.rig().offset_changes(&self.corrections, rig);
            for (camera, by) in changes.into_iter().enumerate() {
                crowd.shift_time(camera, by);
                self.corrections[camera] = Nanos::ZERO;
            }
            self.all().for_each(|tracker| tracker.take_time_offsets(rig));
        }
        let is_same_world = is_same_world(rig, crowd.rig());
        let rig = shifted(rig, &self.corrections);
        if is_same_world { crowd.set_rig(rig) } else { crowd.leave_world(rig) }
    }

    /// Time offsets and moved cameras are found from this performer, if nobody was before.
    pub(super) fn begin_to_watch(&mut self, performer: usize) {
        let live = self.template.live_settings();
        let lead = self.trackers.get_mut(performer).filter(|_| performer == self.lead);
        if let (Some(live), Some(lead)) = (live, lead) {
            lead.watch_for_all(live, None);
        }
    }

    /// Leaves out cameras that were moved in the run before, until a calibration gives them a new pose.
    #[must_use]
    pub fn with_left_out(mut self, cameras: &[usize]) -> Self {
        let left_out: Vec<bool> =
            (0..self.rig().cameras.len()).map(|camera| cameras.contains(&camera)).collect();
        self.all().for_each(|tracker| tracker.leave_out_moved(left_out.clone()));
        if let Some(crowd) = &mut self.crowd {
            crowd.leave_out_moved(left_out);
        }
        self
    }

    /// The cameras that were moved and are left out.
    pub fn left_out(&self) -> Vec<usize> {
        let left_out = self.lead().left_out().into_iter().enumerate();
        left_out.filter_map(|(camera, is_left_out)| is_left_out.then_some(camera)).collect()
    }

    /// The cameras, with the time offsets in use.
    pub fn rig(&self) -> &Arc<Rig> {
        self.crowd.as_ref().map_or(self.lead().rig(), Crowd::rig)
    }

    /// Nominal frame period of the cameras, ns.
    pub fn frame_period(&mut self) -> f64 {
        match &mut self.crowd {
            Some(crowd) => crowd.frame_period(),
            None => self.lead().frame_period(),
        }
    }

    /// Whether frames of a camera are waited for, and the number of them that were used.
    pub fn camera(&mut self, camera: usize) -> (bool, u64) {
        match &mut self.crowd {
            Some(crowd) => crowd.camera(camera),
            None => (self.lead().is_waited_for(camera), self.lead().used(camera)),
        }
    }

    /// A camera is not waited for until one of its frames is given.
    pub fn leave_out(&mut self, camera: usize) {
        match &mut self.crowd {
            Some(crowd) => crowd.leave_out(camera),
            None => self.all().for_each(|tracker| tracker.leave_out(camera)),
        }
    }

    /// Live: the capture times of a camera, by its index in the rig, are corrected by so much from here on, beyond its
    /// calibration and in place of the correction so far. Without that camera, nothing happens.
    pub fn correct_times(&mut self, camera: usize, correction: Nanos) {
        if let (Some(crowd), Some(before)) = (&mut self.crowd, self.corrections.get_mut(camera)) {
            crowd.shift_time(camera, correction - std::mem::replace(before, correction));
        }
        self.all().for_each(|tracker| tracker.correct_times(camera, correction));
    }

    /// By camera, all corrections of time offsets so far.
    pub fn time_corrections(&self) -> &[Nanos] {
        self.lead().time_corrections()
    }

    /// Live: gives the lead the frames of one time, with those people who are no other performer's.
    pub(super) fn watch(&mut self, last: &FrameSet) {
        if !self.template.live_settings().is_some_and(|live| live.watch_cameras) {
            return;
        }
        for Claimed { frame, owners } in &last.frames {
            // A bystander who is followed is not the lead who is hidden.
            let may_be_lead = |owner: &Owner| match owner {
                Owner::Performer(performer) => *performer == self.lead,
                Owner::Other => false,
                Owner::Nobody => true,
            };
            let people = frame.people.iter().zip(owners);
            let people = people.filter(|(_, owner)| may_be_lead(owner));
            let people = people.map(|(person, _)| person.clone()).collect();
            let seen = tracker::Input::WatchFrame(Detections { people, ..*frame });
            self.next.push_back(Next::Tracker(self.lead, seen));
        }
    }

    /// Live: what the lead has found out about the cameras holds for all performers. If the lead is neither tracked nor
    /// hidden for a moment, another one takes over.
    pub(super) fn share_cameras(&mut self) {
        let Some(live) = self.template.live_settings().filter(|_| self.crowd.is_some()) else {
            return;
        };
        // A lead who is hidden for a moment stays the lead, with what is known of moved cameras.
        let is_here = |lead: &Tracker| {
            is_tracked(lead) || lead.state() == Some(TrackingState::Coasting) && !lead.is_idle()
        };
        if !self.trackers.get(self.lead).is_some_and(is_here)
            && let Some(next) = self.trackers.iter().position(is_tracked)
            && let Ok([before, after]) = self.trackers.get_disjoint_mut([self.lead, next])
        {
            after.watch_for_all(live, Some(before));
            self.lead = next;
        }
        let Some(lead) = self.trackers.get(self.lead) else { return };
        let left_out = lead.left_out();
        let corrections = lead.time_corrections().to_vec();
        for (camera, correction) in corrections.into_iter().enumerate() {
            if self.corrections[camera] != correction {
                self.correct_times(camera, correction);
            }
        }
        let is_news = |crowd: &Crowd| {
            left_out.iter().enumerate().any(|(camera, out)| crowd.is_left_out(camera) != *out)
        };
        if self.crowd.as_ref().is_some_and(is_news) {
            // The template has no windows, so it would keep the old calibration.
            self.template.use_next_rig();
            for (number, tracker) in self.trackers.iter_mut().enumerate() {
                if number != self.lead {
                    tracker.leave_out_moved(left_out.clone());
                }
            }
            if let Some(crowd) = &mut self.crowd {
                crowd.leave_out_moved(left_out.clone());
            }
            self.template.leave_out_moved(left_out);
        }
    }
}

/// Whether most cameras keep their place. Then the places of tracked people hold too.
fn is_same_world(rig: &Rig, before: &Rig) -> bool {
    let stays = |(now, then): &(&Camera, &Camera)| {
        (now.centre_in_world() - then.centre_in_world()).norm() < SAME_PLACE_M
            && so3::angle_between(&now.rotation, &then.rotation) < SAME_PLACE_RAD
    };
    let both = rig.cameras.iter().zip(&before.cameras);
    rig.has_cameras_of(before) && 2 * both.filter(stays).count() > rig.cameras.len()
}

/// The cameras with these times added to their offsets.
fn shifted(rig: &Arc<Rig>, by: &[Nanos]) -> Arc<Rig> {
    if by.iter().all(|by| *by == Nanos::ZERO) {
        return Arc::clone(rig);
    }
    let mut rig = Rig::clone(rig);
    rig.shift_times(by);
    Arc::new(rig)
}

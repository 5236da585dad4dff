//! Who is on the stage, for its status message.

use super::Core;
use super::performer::Progress;
use super::port::{Output, wire_known};
use super::publication::Content;
use super::sharing::solver_of;
use crate::core::stage::{Attendance, Life, PerformerId, Presence, Stage};
use crate::core::time::Nanos;
use crate::io::wire::{self, StagePerformer, StageStatus};

/// Who was not seen for this long is lost.
const LOST: Nanos = Nanos::from_ms(2000);

impl Core {
    /// Publishes who is there.
    pub(super) fn publish_stage_status(&mut self, progress: &[Progress]) {
        // The node of the stage tells it.
        if self.is_solver() {
            return;
        }
        let attendance = match &self.stage {
            Some(stage) if self.is_several() => stage.attendance(),
            _ => self.one_present(progress),
        };
        let capture = self.clock.capture_time(self.now);
        let performers = attendance.performers.iter();
        let known = self.stage.as_ref().map_or_else(Vec::new, Stage::known);
        let status = StageStatus {
            capture_time_ns: capture.ns(),
            node_time_ns: self.now.ns(),
            run_id: self.run_id,
            node: self.topics.actor.clone(),
            performers: performers.map(|one| self.stage_performer(one, progress)).collect(),
            tentative: attendance.tentative as u32,
            others: attendance.others as u32,
            places: self.settings.stage.performers.limit() as u32,
            known: known.iter().map(wire_known).collect(),
        };
        self.publish(self.topics.stage_status(), capture, Content::StageStatus(status));
    }

    /// The only performer, as the tracker knows it.
    fn one_present(&self, progress: &[Progress]) -> Attendance {
        let life = match progress.first().map(|one| one.state) {
            Some("tracking") => Life::Confirmed,
            Some("coasting") => Life::Coasting,
            _ => Life::Lost,
        };
        let present = |&(place, seen): &_| Presence {
            performer: PerformerId(0),
            life,
            place: Some(place),
            seen,
            views: 0,
        };
        let last = self.performers.first().and_then(|performer| performer.tracked.as_ref());
        Attendance { performers: last.map(present).into_iter().collect(), ..Attendance::default() }
    }

    fn stage_performer(&self, present: &Presence, progress: &[Progress]) -> StagePerformer {
        let &Presence { performer, life, place, seen, views } = present;
        let own = self.performers.get(performer.0);
        let is_solved = self.settings.stage.solve;
        let name = self.name_of(performer.0);
        let other = self.status_of(&name);
        let own_state = progress.get(performer.0).filter(|_| is_solved).map(|one| one.state);
        let state = other.map(|other| &*other.tracker_state).or(own_state);
        let residual_px = other.map(|other| other.residual_px).or(own.map(|own| own.residual_px));
        let unseen = self.clock.capture_time(self.now) - seen;
        // Without frames the stage does not know that time goes on.
        let life = if life.is_here() && unseen > LOST { Life::Lost } else { life };
        StagePerformer {
            name,
            life: life.name().to_owned(),
            tracker_state: state.unwrap_or_default().to_owned(),
            solver: match is_solved {
                true => self.topics.actor.clone(),
                false => solver_of(&self.responding(), performer).unwrap_or_default().to_owned(),
            },
            place_m: place.map_or_else(Vec::new, Vec::from),
            unseen_s: unseen.seconds().max(0.0),
            views: views as u32,
            residual_px: residual_px.unwrap_or(0.0),
            label: self.label_of(performer.0).cloned(),
        }
    }

    /// Puts out the bodies of the performers with names, for the folder of known bodies.
    pub(super) fn put_out_bodies(&mut self) {
        if self.settings.stage.bodies.is_empty() {
            return;
        }
        let known = self.stage.as_ref().map_or_else(Vec::new, Stage::known);
        for known in known.iter().filter(|one| one.was_here() && !one.name.is_empty()) {
            let body = wire::Skeleton::of_known(known);
            if body.is_some() {
                let (performer, name) = (known.performer, known.name.clone());
                self.outputs.push_back(Output::Body { performer, name, body });
            }
        }
    }

    /// Several performers: those whom this node solves or has solved; not those of another day who have not come yet.
    pub(super) fn solved_here(&self) -> Vec<PerformerId> {
        match &self.stage {
            _ if self.is_solver() => self.sharing.ours(),
            Some(stage) if self.is_several() && self.settings.stage.solve => {
                stage.attendance().performers.iter().map(|one| one.performer).collect()
            }
            _ => Vec::new(),
        }
    }

    /// Several performers: those who are followed.
    pub(super) fn followed(&self) -> Vec<PerformerId> {
        if self.is_solver() {
            return self.sharing.followed();
        }
        let all = self.stage.as_ref().map(Stage::attendance).unwrap_or_default();
        let here = all.performers.into_iter().filter(|one| one.life.is_here());
        here.map(|one| one.performer).collect()
    }
}

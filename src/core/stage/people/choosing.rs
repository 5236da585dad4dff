//! People whom somebody wants, or does not want, to be performers; and their names.

use super::{Absent, Member, People, Role, Wish};
use crate::core::stage::names::NumberName;
use crate::core::stage::performer_id::PerformerId;
use crate::core::time::Timestamp;

/// Who is pointed at is not farther from there, metres.
const NEAR_M: f64 = 1.0;

/// Why nobody at a place becomes a performer.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum FollowError {
    /// Nobody is there. The text lists the places (x, z, metres) of people who are not performers.
    #[error("nobody is seen within {NEAR_M} m of this place; seen are: {0}")]
    Nobody(String),
    /// The person there is a performer.
    #[error("{0} is there, and is a performer already")]
    Performer(String),
    /// All places are taken.
    #[error("all {0} places are taken; drop a performer, or raise [stage] performers")]
    Full(usize),
}

impl People {
    /// The person at a place on the floor, x and z, is to become a performer, whatever the choice is.
    pub(in crate::core::stage) fn follow_at(&mut self, place: [f64; 2]) -> Result<(), FollowError> {
        let away = |member: &Member| {
            let at = member.person.place()?;
            Some(libm::hypot(at[0] - place[0], at[1] - place[1])).filter(|away| *away <= NEAR_M)
        };
        let near = self.members.iter().enumerate();
        let near = near.filter_map(|(index, member)| Some((index, away(member)?)));
        let nearest = near.min_by(|a, b| a.1.total_cmp(&b.1));
        let nearest = nearest.ok_or_else(|| FollowError::Nobody(self.others()))?.0;
        if let Role::Performer(performer) = self.members[nearest].role {
            return Err(FollowError::Performer(self.names.of(PerformerId(performer))));
        }
        if !self.has_place() {
            // A performer who was merged with another one may be nobody.
            let is_merged = |one: &&mut Absent| one.merged.is_some() && one.keeps_place();
            let merged = self.absent.iter_mut().find(is_merged);
            merged.ok_or(FollowError::Full(self.limit))?.has_left = true;
        }
        self.members[nearest].wish = Wish::Wanted;
        Ok(())
    }

    /// The places of those who are no performers, for a message.
    fn others(&self) -> String {
        let is_other = |one: &&Member| !matches!(one.role, Role::Performer(_));
        let places = self.members.iter().filter(is_other).filter_map(|one| one.person.place());
        let places: Vec<String> =
            places.map(|at| format!("somebody at {:.2},{:.2}", at[0], at[1])).collect();
        match places.is_empty() {
            true if self.members.is_empty() => "nobody".to_owned(),
            true => "only performers".to_owned(),
            false => places.join("; "),
        }
    }

    /// A performer is one no more, and does not become one again unless somebody follows it. Returns the time of the
    /// last frame set, if there is such a performer.
    pub(in crate::core::stage) fn drop_performer(&mut self, performer: usize) -> Option<Timestamp> {
        let is_own = |m: &Member| matches!(m.role, Role::Performer(own) if own == performer);
        if let Some(index) = self.members.iter().position(is_own) {
            self.absent.push(Absent::new(performer, self.members[index].person.clone()));
            self.make_bystander(index, self.absent.len() - 1);
            return Some(self.at);
        }
        let is_own = |one: &&mut Absent| one.performer == performer && !one.is_unwanted;
        let absent = self.absent.iter_mut().find(is_own);
        absent.map(Absent::make_unwanted).map(|()| self.at)
    }

    /// A member who is the performer at this place in `absent` is a bystander until somebody follows it.
    pub(super) fn make_bystander(&mut self, index: usize, place: usize) {
        self.absent[place].make_unwanted();
        let member = &mut self.members[index];
        // Somebody who is to be followed waits for a place.
        if member.wish != Wish::Wanted || matches!(member.role, Role::Performer(_)) {
            member.wish = Wish::Unwanted;
        }
        member.role = Role::Bystander;
        member.was = Some(self.absent[place].performer);
    }

    /// Gives a name to a performer. Who had it and is not followed is this one. Returns who had it.
    pub(in crate::core::stage) fn give_name(
        &mut self,
        performer: PerformerId,
        name: &str,
    ) -> Result<Option<PerformerId>, NumberName> {
        let before = self.names.owner(name).filter(|before| *before != performer);
        self.names.give(performer, name)?;
        self.absent.retain(|one| Some(PerformerId(one.performer)) != before);
        Ok(before)
    }
}

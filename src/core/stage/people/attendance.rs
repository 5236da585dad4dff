//! Who is or was here.

use super::{ELSEWHERE, Member, People, Role};
use crate::core::stage::performer_id::PerformerId;
use crate::core::stage::person::Person;
use crate::core::stage::presence::{Attendance, Life, Presence};

impl People {
    /// Everybody who is or was here.
    pub(in crate::core::stage) fn attendance(&self) -> Attendance {
        let presence = |performer: usize, life: Life, person: &Person| Presence {
            performer: PerformerId(performer),
            life,
            place: person.place(),
            seen: person.seen,
            views: person.views,
        };
        let mut all = Attendance::default();
        for Member { person, role, .. } in &self.members {
            match role {
                Role::Performer(performer) => {
                    let is_seen = person.unseen(self.at) <= self.at_least(ELSEWHERE);
                    let life = if is_seen { Life::Confirmed } else { Life::Coasting };
                    all.performers.push(presence(*performer, life, person));
                }
                Role::Candidate(_) => all.tentative += 1,
                Role::Bystander => all.others += 1,
            }
        }
        // Those of another day were not here yet.
        for one in self.absent.iter().filter(|one| one.merged.is_none() && one.person.was_here()) {
            let life = if one.has_left { Life::Left } else { Life::Lost };
            all.performers.push(presence(one.performer, life, &one.person));
        }
        all.performers.sort_by_key(|one| one.performer);
        all
    }
}

//! Candidates become performers: new ones, or those of before.

use super::{Absent, Change, ELSEWHERE, LOST, Member, People, Role, Wish};
use crate::core::stage::performer_id::PerformerId;
use crate::core::stage::person::{Person, apart};
use crate::core::time::{Nanos, Timestamp};

/// A newcomer is a person after so many frame sets and so long; after so many if it may be a performer of before; and
/// after so many if it is still not clear which one.
const CONFIRMED: (u32, Nanos) = (5, Nanos::from_ms(60));
const RECOGNISED: (u32, Nanos) = (15, Nanos::from_ms(230));
pub(super) const UNDECIDED: (u32, Nanos) = (30, Nanos::from_ms(480));
/// Performers who were followed for this long keep their places if they are merged with another one.
const FOLLOWED: Nanos = Nanos::from_ms(2000);
/// How far people get while they are not seen, metres and m/s.
const AWAY_M: f64 = 0.6;
const AWAY_M_S: f64 = 3.0;
/// After an interruption of up to this time, a person may be the performer who was nearest to that place, within these
/// metres.
const INTERRUPTED: Nanos = Nanos::from_ms(1500);
const IN_PLACE_M: f64 = 0.5;
/// After an interruption of up to this time, a performer is expected as far from its last place as people walk, m/s.
const SOON: Nanos = Nanos::from_ms(5000);
const WALK_M_S: f64 = 1.5;
/// Nobody else can come so near so soon, whatever the lengths say: time and metres.
const AT_ONCE: (Nanos, f64) = (Nanos::from_ms(500), 0.25);
/// Bodies that differ by less (`Lengths::difference`) are one person's.
const SAME_BODY: f64 = 1.7;
/// The same where a performer is expected: one is missed near there, or all who may come are known.
const EXPECTED_BODY: f64 = 2.5;
/// Up to this difference, more is to be measured.
const DOUBTFUL_BODY: f64 = 3.0;
/// Who was merged with another absent performer is left out if a candidate differs from that one by less than this much
/// more.
const DOUBLE: f64 = 0.5;

/// Who a member is.
enum Verdict {
    /// Not known yet.
    Unsure,
    /// The performer at this place in `absent`.
    Known(usize),
    /// Nobody of before.
    New,
}

impl People {
    /// Whether somebody may become a performer: those who are lost keep their places until they have left.
    pub(super) fn has_place(&self) -> bool {
        let present =
            self.members.iter().filter(|member| matches!(member.role, Role::Performer(_)));
        let lost = self.absent.iter().filter(|one| one.keeps_place());
        present.count() + lost.count() < self.limit
    }

    /// Whether a performer who is absent may be a person who comes now.
    fn may_return(&self, one: &Absent) -> bool {
        let is_there = |performer: usize| {
            self.members.iter().any(|m| matches!(m.role, Role::Performer(own) if own == performer))
        };
        one.is_unwanted
            || (one.was_followed() || one.merged.is_none_or(is_there))
                && (one.keeps_place() || self.has_place())
    }

    /// Candidates become performers or bystanders: who is known best first, then the largest.
    pub(super) fn confirm(&mut self, at: Timestamp, changes: &mut Vec<Change>) {
        let is_open = self.has_place();
        let is_ready = |&index: &usize| {
            let Member { person, role, wish, close_since, .. } = &self.members[index];
            let is_known = || matches!(self.judge(index, at), Verdict::Known(_));
            match role {
                // Somebody in the place of another member may be the same person.
                Role::Candidate(_) => person.is_seen_for(CONFIRMED) && close_since.is_none(),
                // Who comes to the region later, or is recognised later.
                Role::Bystander if person.seen < at => false,
                Role::Bystander => {
                    is_open && self.is_chosen(index) || *wish == Wish::Open && is_known()
                }
                Role::Performer(_) => false,
            }
        };
        let ready = (0..self.members.len()).filter(is_ready);
        // Who is known best comes first: the others are somebody else.
        let rank = |index: usize| {
            let known =
                self.most_alike(index, at).map_or(f64::INFINITY, |(_, difference)| difference);
            (known, -self.members[index].person.size())
        };
        let mut ready: Vec<_> = ready.map(|index| (rank(index), index)).collect();
        ready.sort_by(|(a, _), (b, _)| a.0.total_cmp(&b.0).then(a.1.total_cmp(&b.1)));
        let mut gone = Vec::new();
        for (_, index) in ready {
            if let Some(other) = self.elsewhere(index, at) {
                // The performer goes on here; its tracker has had frames without it meanwhile.
                let candidate = self.members[index].person.clone();
                self.members[other].person.go_on_as(candidate, DOUBTFUL_BODY);
                gone.push(index);
                continue;
            }
            let performer = match self.judge(index, at) {
                Verdict::Unsure => continue,
                Verdict::Known(place) => {
                    let Member { person, was, .. } = &mut self.members[index];
                    let Absent { performer, person: before, .. } = &self.absent[place];
                    let performer = *performer;
                    // Otherwise the person has the measurements of before.
                    if *was != Some(performer) {
                        person.was_before(before);
                    }
                    if self.is_unwanted(index, place) {
                        self.make_bystander(index, place);
                        continue;
                    }
                    self.absent.remove(place);
                    changes.push(Change::Returned(performer));
                    performer
                }
                Verdict::New => {
                    let Some(performer) = self.new_performer(index) else {
                        self.members[index].role = Role::Bystander;
                        continue;
                    };
                    changes.push(Change::Entered(performer));
                    performer
                }
            };
            self.members[index].was = None;
            let role = std::mem::replace(&mut self.members[index].role, Role::Performer(performer));
            if let Role::Candidate(frames) = role {
                changes.extend(frames.into_iter().map(|frame| Change::Frame(performer, frame)));
            }
        }
        gone.sort_unstable();
        for index in gone.into_iter().rev() {
            self.members.remove(index);
        }
    }

    /// Who a member is.
    fn judge(&self, index: usize, at: Timestamp) -> Verdict {
        let person = &self.members[index].person;
        let may_return = self.absent.iter().any(|one| self.may_return(one));
        if let Some(place) = self.in_place_of(index) {
            return Verdict::Known(place);
        }
        let is_early = may_return && !person.is_seen_for(RECOGNISED);
        if is_early || self.is_taken_for(person, at) {
            return Verdict::Unsure;
        }
        // Too little is seen to compare them.
        let is_unknown = |one: &Absent| {
            one.person.was_here()
                && self.may_return(one)
                && one.may_be_there(person, at)
                && one.person.lengths.difference(&person.lengths).is_none()
        };
        let is_undecided = !person.is_seen_for(UNDECIDED);
        let gate = |place: usize| {
            let is_expected = !self.has_place() || self.absent[place].is_expected_as(person);
            if is_expected { EXPECTED_BODY } else { SAME_BODY }
        };
        match self.most_alike(index, at) {
            Some((place, difference)) if difference < gate(place) => Verdict::Known(place),
            Some(_) if is_undecided => Verdict::Unsure,
            None if is_undecided && self.absent.iter().any(is_unknown) => Verdict::Unsure,
            _ => Verdict::New,
        }
    }

    /// The place in `absent` of the performer who stood where this member is when everybody was lost at once.
    fn in_place_of(&self, index: usize) -> Option<usize> {
        let off = |one: &Absent, member: &Member| {
            let (before, now) = (&one.person, &member.person);
            let gap = now.first - before.seen;
            let is_possible = one.is_interrupted
                && !one.is_elsewhere
                && matches!(member.role, Role::Candidate(_))
                && (Nanos::ZERO..INTERRUPTED).contains(&gap)
                && now.seen - now.first < AT_ONCE.0
                && self.may_return(one);
            let off = apart(before.points(), now.points()).filter(|_| is_possible)?;
            let is_alike = || {
                let difference = before.lengths.difference(&now.lengths);
                difference.is_some_and(|difference| difference < EXPECTED_BODY)
            };
            let is_it = off < IN_PLACE_M && (gap < AT_ONCE.0 && off < AT_ONCE.1 || is_alike());
            is_it.then_some(off)
        };
        let place = nearest(self.absent.iter().map(|one| off(one, &self.members[index])))?;
        let here = nearest(self.members.iter().map(|other| off(&self.absent[place], other)));
        (here == Some(index)).then_some(place)
    }

    /// Whether this may be a performer, while somebody else may be followed as that performer.
    fn is_taken_for(&self, candidate: &Person, at: Timestamp) -> bool {
        let performers =
            self.members.iter().filter(|member| matches!(member.role, Role::Performer(_)));
        performers.filter_map(|member| member.person.in_doubt()).any(|before| {
            let difference = before.lengths.difference(&candidate.lengths);
            difference.is_none_or(|difference| difference < EXPECTED_BODY)
                && is_in_reach(before, candidate, at)
        })
    }

    /// Whether a member who is a performer of before is to be nobody.
    fn is_unwanted(&self, index: usize, place: usize) -> bool {
        let (one, only) = (&self.absent[place], &self.choice.only);
        let name = self.names.of(PerformerId(one.performer));
        let is_other = !one.person.was_here() && !only.is_empty() && !only.contains(&name);
        let is_wanted = self.members[index].wish == Wish::Wanted && self.has_place();
        (one.is_unwanted || is_other) && !is_wanted
    }

    /// Whether a member whom we do not know may become a performer.
    fn is_chosen(&self, index: usize) -> bool {
        let Member { person, wish, .. } = &self.members[index];
        match wish {
            Wish::Open if !self.choice.only.is_empty() => false,
            Wish::Open => self.choice.takes(person.place(), person.height_px),
            Wish::Wanted => true,
            Wish::Unwanted => false,
        }
    }

    /// The number of a member who becomes a performer: that of one who has left, or else the next one. `None` if it
    /// may not become one.
    fn new_performer(&mut self, index: usize) -> Option<usize> {
        if !self.has_place() || !self.is_chosen(index) {
            return None;
        }
        let is_free = |one: &Absent| {
            let is_named = self.names.given(PerformerId(one.performer)).is_some();
            self.reuses_numbers && one.has_left && !one.is_unwanted && !is_named
        };
        let free = self.absent.iter().enumerate().filter(|(_, one)| is_free(one));
        let free = free.min_by_key(|(_, one)| one.performer).map(|(place, _)| place);
        let number = match free {
            Some(place) => {
                let number = self.absent.remove(place).performer;
                let into = self.absent.iter_mut().filter(|one| one.merged == Some(number));
                into.for_each(|one| one.merged = None);
                number
            }
            None if self.known < PerformerId::MOST => {
                self.known += 1;
                self.known - 1
            }
            None => return None,
        };
        self.names.enter(PerformerId(number));
        Some(number)
    }

    /// The performer who is expected in a place where it is not, and may be this candidate: no view shows both.
    fn elsewhere(&self, candidate: usize, at: Timestamp) -> Option<usize> {
        let Member { person: candidate, role, .. } = &self.members[candidate];
        let is_bystander = matches!(role, Role::Bystander);
        let missed = (0..self.members.len()).filter(|&index| {
            let Member { person, role, .. } = &self.members[index];
            matches!(role, Role::Performer(_))
                && !person.is_beside(candidate)
                && person.unseen(at) > self.at_least(ELSEWHERE)
                && !stood_by(is_bystander, candidate, person)
                && is_in_reach(person, candidate, at)
        });
        let differences = missed.filter_map(|index| {
            let difference = self.members[index].person.lengths.difference(&candidate.lengths)?;
            (difference < EXPECTED_BODY).then_some((index, difference))
        });
        differences.min_by(|a, b| a.1.total_cmp(&b.1)).map(|(index, _)| index)
    }

    /// The place in `absent` of the performer who may be a candidate and is most alike, if any is, and how much they
    /// differ.
    fn most_alike(&self, candidate: usize, at: Timestamp) -> Option<(usize, f64)> {
        let Member { person: candidate, was, role, .. } = &self.members[candidate];
        let is_bystander = matches!(role, Role::Bystander);
        let is_somebody = |one: &Absent| self.members.iter().any(|m| m.was == Some(one.performer));
        let differences = self.absent.iter().enumerate().filter_map(|(place, one)| {
            if *was == Some(one.performer) {
                return Some((place, 0.0));
            }
            let difference = one.person.lengths.difference(&candidate.lengths)?;
            let is_possible = !is_somebody(one)
                && !stood_by(is_bystander, candidate, &one.person)
                && one.may_be_there(candidate, at)
                && self.may_return(one);
            is_possible.then_some((place, difference))
        });
        let alike = differences.filter(|(_, difference)| *difference < DOUBTFUL_BODY);
        let alike: Vec<(usize, f64)> = alike.collect();
        // Who was merged with somebody else who is away may have been the same person.
        let is_double = |&&(place, difference): &&(usize, f64)| {
            let into = self.absent[place].merged;
            alike.iter().any(|&(other, of_other)| {
                into == Some(self.absent[other].performer) && of_other < difference + DOUBLE
            })
        };
        let others = alike.iter().filter(|one| !is_double(one));
        others.min_by(|a, b| a.1.total_cmp(&b.1)).copied()
    }
}

impl Absent {
    /// Whether nobody else may have the place.
    pub(super) fn keeps_place(&self) -> bool {
        !self.has_left && (self.merged.is_none() || self.was_followed())
    }

    /// Whether this was a person of its own for a while.
    fn was_followed(&self) -> bool {
        self.person.seen - self.person.first > FOLLOWED
    }

    /// Whether the performer was lost together with others, and a candidate is soon where it may have walked to.
    fn is_expected_as(&self, candidate: &Person) -> bool {
        let gap = candidate.first - self.person.seen;
        let reach = AWAY_M + WALK_M_S * gap.seconds();
        let off = || apart(self.person.points(), candidate.points());
        self.is_interrupted
            && !self.is_elsewhere
            && (Nanos::ZERO..SOON).contains(&gap)
            && off().is_some_and(|off| off < reach)
    }

    /// Whether the performer can have got to where a candidate is.
    fn may_be_there(&self, candidate: &Person, at: Timestamp) -> bool {
        self.is_elsewhere || !self.person.was_here() || is_in_reach(&self.person, candidate, at)
    }
}

/// The index of the least distance.
fn nearest(offs: impl Iterator<Item = Option<f64>>) -> Option<usize> {
    let known = offs.enumerate().filter_map(|(index, off)| Some((index, off?)));
    known.min_by(|a, b| a.1.total_cmp(&b.1)).map(|(index, _)| index)
}

/// Whether a candidate was a bystander while the person was seen: then it is somebody else.
fn stood_by(is_bystander: bool, candidate: &Person, person: &Person) -> bool {
    is_bystander && person.sets > 0 && candidate.first + LOST < person.seen
}

/// Whether a person who was not seen for a while can have got to where the candidate is.
fn is_in_reach(person: &Person, candidate: &Person, at: Timestamp) -> bool {
    let reach = AWAY_M + AWAY_M_S * person.unseen(at).seconds().max(0.0);
    apart(person.points(), candidate.points()).is_some_and(|off| off < reach)
}

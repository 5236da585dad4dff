//! Who is there: people are found, followed, lost and found again.

mod attendance;
mod choosing;
mod recognition;

use super::config::Choice;
use super::known::Known;
use super::lengths::Lengths;
use super::names::Names;
use super::performer_id::PerformerId;
use super::person::{HIDDEN, Person, Sight, apart};
use crate::core::association::{
    Assigned, Association, Gates, KEYPOINTS, Newcomer, Part, associate, pixels_of,
};
use crate::core::camera::Rig;
use crate::core::detections::Detections;
use crate::core::time::{Nanos, Timestamp};
pub use choosing::FollowError;
use recognition::UNDECIDED;

/// A newcomer who is not seen for this long was none.
const DOUBTFUL: Nanos = Nanos::from_ms(120);
/// A performer who is not seen for this long is lost, and a bystander is forgotten.
const LOST: Nanos = Nanos::from_ms(1000);
/// Two people who were seen last within this time were lost at once: the cameras stopped, nobody walked out.
const LOST_AT_ONCE: Nanos = Nanos::from_ms(100);
/// A performer who is not seen for this long may be where a newcomer is.
const ELSEWHERE: Nanos = Nanos::from_ms(150);
/// A person counts as away only after this many frame periods.
const MIN_PERIODS: f64 = 2.5;
/// People who are this near each other on average, metres, for this long are one. The second distance holds if each view
/// shows only one of them.
const SAME_M: f64 = 0.15;
const SAME_UNSEEN_M: f64 = 0.3;
const SAME_TIME: Nanos = Nanos::from_ms(300);
/// A bystander counts after this time.
const STAYED: Nanos = Nanos::from_ms(500);
/// Most people who are followed.
const MOST: usize = 64;

/// What a person is to us.
#[derive(Clone, Debug)]
enum Role {
    /// Not confirmed; with the frames so far.
    Candidate(Vec<Detections>),
    Performer(usize),
    /// Followed, so that its detections are nobody else's.
    Bystander,
}

/// Whether somebody wants a person to be a performer.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
enum Wish {
    /// Nobody said: the choice decides.
    #[default]
    Open,
    Wanted,
    Unwanted,
}

#[derive(Clone, Debug)]
struct Member {
    person: Person,
    role: Role,
    wish: Wish,
    /// The number that this person had as a performer, if it is one no more.
    was: Option<usize>,
    /// Since when the member is in the place of an older one.
    close_since: Option<Timestamp>,
}

/// A performer who is not followed.
#[derive(Clone, Debug)]
struct Absent {
    performer: usize,
    person: Person,
    /// The performer with whom this one was merged. They may be two people after all.
    merged: Option<usize>,
    /// Whether somebody else may have the place.
    has_left: bool,
    /// Whether this one is to be a bystander on return.
    is_unwanted: bool,
    /// Whether the last place is in the world of another calibration.
    is_elsewhere: bool,
    /// Whether others were lost at the same time, as at the start of a take or where all cameras stop: people stay about
    /// where they were.
    is_interrupted: bool,
}

/// What happened to a performer, by number from 0.
#[derive(Clone, Debug, PartialEq)]
pub enum Change {
    /// A new performer.
    Entered(usize),
    /// A performer who was lost is there again.
    Returned(usize),
    /// A performer was not seen for so long that somebody else may have the place, or is dropped.
    Vacated(usize),
    /// The first one was the second one, who goes on.
    Merged(usize, usize),
    /// A frame with the performer alone, or with nobody.
    Frame(usize, Detections),
    /// All frames of the performer up to this time were given.
    Complete(usize, Timestamp),
}

/// The frames of one time.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct FrameSet {
    /// In order of capture time, at most one of each camera.
    pub frames: Vec<Claimed>,
    /// The performers who are followed, by number from 0.
    pub performers: Vec<usize>,
}

/// A frame, and whose its people are.
#[derive(Clone, Debug, PartialEq)]
pub struct Claimed {
    /// The frame, with everybody in it.
    pub frame: Detections,
    /// By person.
    pub owners: Vec<Owner>,
}

/// Whose a detection is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Owner {
    /// A performer's, by number from 0.
    Performer(usize),
    /// That of somebody who is not a performer.
    Other,
    /// Nobody's.
    Nobody,
}

/// All people in view.
#[derive(Clone, Debug, Default)]
pub(super) struct People {
    gates: Gates,
    /// Most performers at a time.
    limit: usize,
    pub(super) choice: Choice,
    members: Vec<Member>,
    absent: Vec<Absent>,
    /// When the one who was lost last was seen.
    last_lost: Option<Timestamp>,
    /// Number of performers so far.
    known: usize,
    pub(super) names: Names,
    /// Whether a newcomer gets the number of a performer without a name who has left.
    pub(super) reuses_numbers: bool,
    /// The time of the last set.
    at: Timestamp,
    /// The cameras' frame period.
    pub(super) period: Nanos,
    /// By camera, the usual time between two frames; 0: not known.
    pub(super) steps: Vec<Nanos>,
    /// Most bystanders at a time.
    pub(super) others: usize,
    pub(super) last: FrameSet,
}

impl People {
    pub(super) fn new(limit: usize, gates: Gates) -> Self {
        Self { gates, limit, ..Self::default() }
    }

    /// A time, but at least [`MIN_PERIODS`] frame periods.
    fn at_least(&self, time: Nanos) -> Nanos {
        time.max(Nanos::rounded(MIN_PERIODS * self.period.ns() as f64))
    }

    /// The performers so far, without their bodies.
    pub(super) fn known(&self) -> Vec<Known> {
        let is_named = |one: &Absent| self.names.given(PerformerId(one.performer)).is_some();
        let absent = self.absent.iter().filter(|one| one.merged.is_none() || is_named(one));
        let known = |performer: usize, person: &Person| Known {
            performer: PerformerId(performer),
            name: self.names.given(PerformerId(performer)).unwrap_or_default().to_owned(),
            seen: person.seen,
            points: *person.points(),
            lengths: person.lengths.sums(),
            ..Known::default()
        };
        let absent = absent.map(|one| {
            let here = self.dropped(one);
            let person = here.unwrap_or(&one.person);
            let known = Known { dropped: one.is_unwanted, ..known(one.performer, person) };
            match one.is_elsewhere && here.is_none() {
                true => Known { points: [None; KEYPOINTS], ..known },
                false => known,
            }
        });
        let present = self.members.iter().filter_map(|member| match member.role {
            Role::Performer(performer) => Some(known(performer, &member.person)),
            _ => None,
        });
        let mut all: Vec<Known> = absent.chain(present).collect();
        all.sort_by_key(|one| one.performer);
        all
    }

    /// The bystander who was dropped and is this performer, if it is in view.
    fn dropped(&self, one: &Absent) -> Option<&Person> {
        let is_it = |member: &&Member| {
            member.was == Some(one.performer) && matches!(member.role, Role::Bystander)
        };
        // Those of another day who are not wanted were never here.
        let member = self.members.iter().find(is_it).filter(|_| one.person.was_here());
        member.map(|member| &member.person)
    }

    /// Remembers where dropped performers are who are in view and go away.
    fn keep_dropped(&mut self, goes: impl Fn(&Person) -> bool) {
        for index in 0..self.absent.len() {
            if let Some(person) = self.dropped(&self.absent[index]).filter(|one| goes(one)).cloned()
            {
                let one = &mut self.absent[index];
                (one.person, one.is_interrupted, one.is_elsewhere) = (person, true, false);
            }
        }
    }

    /// These performers were seen before.
    pub(super) fn know(&mut self, known: &[Known], cameras: usize) {
        for one in known {
            let mut person = Person::new(one.points, one.seen, cameras);
            person.lengths = Lengths::of(one.lengths);
            let has_left = one.dropped || !one.was_here();
            let absent = Absent::new(one.performer.0, person);
            let is_unwanted = one.dropped;
            self.absent.push(Absent { has_left, is_unwanted, is_interrupted: true, ..absent });
            self.known = self.known.max(one.performer.0 + 1);
        }
        self.names.know(known);
    }

    /// Nobody is in view any more. Capture times are later by `by` from here on.
    pub(super) fn restart(&mut self, by: Nanos) {
        self.keep_dropped(|_| true);
        for member in std::mem::take(&mut self.members) {
            if let Role::Performer(performer) = member.role {
                let absent = Absent::new(performer, member.person);
                self.absent.push(Absent { is_interrupted: true, ..absent });
            }
        }
        for one in &mut self.absent {
            one.person.shift_times(by);
        }
    }

    /// The cameras are calibrated in another world from here on.
    pub(super) fn leave_world(&mut self) {
        self.absent.iter_mut().for_each(|one| one.is_elsewhere = true);
    }

    /// Finds all people in `frames`, which have one time. Frames `aside` (of moved cameras) are not searched.
    /// All frames up to `complete` have arrived.
    pub(super) fn process(
        &mut self,
        at: Timestamp,
        (frames, aside): (Vec<Detections>, Vec<Detections>),
        complete: Timestamp,
        rig: &Rig,
    ) -> Vec<Change> {
        self.at = at;
        let hidden_after = self.at_least(HIDDEN);
        self.members.iter_mut().for_each(|one| one.person.hidden_after = hidden_after);
        let seen: Vec<&Detections> = frames.iter().collect();
        let expected: Vec<_> = self.members.iter().map(|m| m.person.expected(at)).collect();
        let found = associate(rig, &seen, &expected, &self.gates);
        let owners = self.owners(&frames, &found);
        let mut changes = Vec::new();
        for (member, assigned) in self.members.iter_mut().zip(&found.performers) {
            let alone = member.person.follow(at, &frames, assigned, rig, &self.gates);
            match &mut member.role {
                Role::Candidate(earlier) => earlier.extend(alone),
                Role::Performer(performer) => {
                    changes.extend(alone.map(|frame| Change::Frame(*performer, frame)));
                }
                Role::Bystander => {}
            }
        }
        for Newcomer { points, views, .. } in found.newcomers {
            if self.members.len() < MOST {
                let mut person = Person::new(points, at, rig.cameras.len());
                let alone = person.follow(at, &frames, &views, rig, &self.gates);
                let role = Role::Candidate(alone.collect());
                let (wish, was) = (Wish::Open, None);
                self.members.push(Member { person, role, wish, was, close_since: None });
            }
        }
        self.tell_from_hidden();
        self.drop_doubles(at, &mut changes);
        self.lose(at, &mut changes);
        self.confirm(at, &mut changes);
        let stays = |member: &&Member| {
            matches!(member.role, Role::Bystander) && at - member.person.first > STAYED
        };
        self.others = self.others.max(self.members.iter().filter(stays).count());
        let performers = self.members.iter().filter_map(|member| match member.role {
            Role::Performer(performer) => Some(performer),
            _ => None,
        });
        let performers: Vec<usize> = performers.collect();
        changes.extend(performers.iter().map(|&one| Change::Complete(one, complete)));
        let claimed = |(frame, owners)| Claimed { frame, owners };
        let nobodys = aside.into_iter().map(|frame| {
            let owners = vec![Owner::Nobody; frame.people.len()];
            Claimed { frame, owners }
        });
        let frames = frames.into_iter().zip(owners).map(claimed).chain(nobodys).collect();
        self.last = FrameSet { frames, performers };
        changes
    }

    /// By frame and person, whose the detections are.
    fn owners(&self, frames: &[Detections], found: &Association) -> Vec<Vec<Owner>> {
        let mut owners: Vec<Vec<Owner>> =
            frames.iter().map(|frame| vec![Owner::Nobody; frame.people.len()]).collect();
        let of_member = |member: &Member| match member.role {
            Role::Performer(performer) => Owner::Performer(performer),
            _ => Owner::Other,
        };
        let members = self.members.iter().map(of_member).zip(&found.performers);
        let newcomers = found.newcomers.iter().map(|newcomer| (Owner::Other, &newcomer.views));
        for (owner, views) in newcomers.chain(members) {
            for (owners, assigned) in owners.iter_mut().zip(views) {
                // A limb that a detector gave to somebody else does not make it the performer's.
                let person = assigned.parts[Part::Upper as usize];
                let person = person.or(assigned.parts.iter().flatten().next().copied());
                if let Some(person) = person {
                    owners[person] = owner;
                }
            }
        }
        owners
    }

    /// A performer who was hidden is lost if it turns out that somebody else is followed in its place. The same holds
    /// for dropped performers.
    fn tell_from_hidden(&mut self) {
        for member in &mut self.members {
            let Some(before) = member.person.settle(UNDECIDED) else { continue };
            if let Role::Performer(performer) = member.role {
                // Who was merged with it meanwhile may be the one who is followed.
                let merged = self.absent.iter_mut().filter(|one| one.merged == Some(performer));
                merged.for_each(|one| one.merged = None);
                self.absent.push(Absent::new(performer, before));
            } else if let Some(was) = member.was {
                let dropped = self.absent.iter_mut().find(|one| one.performer == was);
                dropped.into_iter().for_each(|one| one.person = before.clone());
            } else {
                continue;
            }
            member.role = Role::Candidate(Vec::new());
            (member.wish, member.was) = (Wish::Open, None);
        }
    }

    /// Two members who are seen in one place are one person: the older one stays.
    fn drop_doubles(&mut self, at: Timestamp, changes: &mut Vec<Change>) {
        let places: Vec<_> = self.members.iter().map(|m| m.person.predicted(at)).collect();
        let is_hidden: Vec<_> = self.members.iter().map(|m| m.person.is_hidden(at)).collect();
        // Numbers are in the order of entry, unless they are used again.
        let rank = |Member { role, person, .. }: &Member| match *role {
            Role::Performer(number) if self.reuses_numbers => (0, person.first, number),
            Role::Performer(number) => (0, Timestamp::default(), number),
            Role::Bystander => (1, person.first, usize::MAX),
            Role::Candidate(_) => (2, person.first, usize::MAX),
        };
        let ranks: Vec<_> = self.members.iter().map(rank).collect();
        let mut dropped = Vec::new();
        for index in 0..self.members.len() {
            let is_double = |other: &usize| {
                let [one, two] = [&self.members[*other].person, &self.members[index].person];
                let same = if one.splits_views_with(two) { SAME_UNSEEN_M } else { SAME_M };
                (ranks[*other], *other) < (ranks[index], index)
                    && !is_hidden[*other]
                    && apart(&places[*other], &places[index]).is_some_and(|off| off < same)
            };
            let older = (0..places.len()).find(is_double);
            let member = &mut self.members[index];
            let Some(older) = older else {
                member.close_since = None;
                continue;
            };
            if at - *member.close_since.get_or_insert(at) > SAME_TIME {
                // Nobody but a performer is older than a performer.
                let older = ranks[older].2;
                dropped.push((index, older));
                if let Role::Performer(performer) = member.role {
                    changes.push(Change::Merged(performer, older));
                }
            }
        }
        for (index, older) in dropped.into_iter().rev() {
            let member = self.members.remove(index);
            if let Role::Performer(performer) = member.role {
                let absent = Absent::new(performer, member.person);
                self.absent.push(Absent { merged: Some(older), ..absent });
            }
        }
    }

    /// Members who were not seen for too long go; performers who were not seen for much longer have left.
    fn lose(&mut self, at: Timestamp, changes: &mut Vec<Change>) {
        let [doubtful, lost] = [DOUBTFUL, LOST].map(|time| self.at_least(time));
        self.keep_dropped(|person| person.unseen(at) > lost);
        let is_gone = |member: &mut Member| {
            let longest = match member.role {
                // Slow cameras have fewer frames.
                Role::Candidate(_) => {
                    let steps = member.person.cameras().filter_map(|c| self.steps.get(c));
                    let slowest = steps.max().map_or(0.0, |step| step.ns() as f64);
                    doubtful.max(Nanos::rounded(MIN_PERIODS * slowest)).min(lost)
                }
                Role::Performer(_) | Role::Bystander => lost,
            };
            member.person.unseen(at) > longest
        };
        let is_somebody = |member: &&Member| !matches!(member.role, Role::Candidate(_));
        let members = self.members.iter().filter(is_somebody).map(|member| member.person.seen);
        let seen: Vec<Timestamp> = members.chain(self.last_lost).collect();
        for member in self.members.extract_if(.., is_gone).filter(|member| is_somebody(&member)) {
            let person = member.person;
            self.last_lost = Some(person.seen);
            if let Role::Performer(performer) = member.role {
                let is_near = |other: &&Timestamp| (**other - person.seen).abs() < LOST_AT_ONCE;
                let is_interrupted = seen.iter().filter(is_near).count() > 1;
                self.absent.push(Absent { is_interrupted, ..Absent::new(performer, person) });
            }
        }
        let left_after = self.choice.left_after();
        for one in self.absent.iter_mut().filter(|one| !one.has_left) {
            one.has_left = one.person.unseen(at) > left_after;
            // Those of an earlier take may not be here today.
            if one.has_left && one.merged.is_none() && one.person.sets > 0 {
                changes.push(Change::Vacated(one.performer));
            }
        }
    }
}

impl Absent {
    /// A performer who is lost.
    fn new(performer: usize, person: Person) -> Self {
        let [has_left, is_unwanted, is_elsewhere, is_interrupted] = [false; 4];
        let merged = None;
        Self { performer, person, merged, has_left, is_unwanted, is_elsewhere, is_interrupted }
    }

    fn make_unwanted(&mut self) {
        (self.has_left, self.is_unwanted) = (true, true);
    }
}

impl Person {
    /// Takes what is the person's in the frames of a time; returns each frame with the person alone.
    fn follow<'a>(
        &mut self,
        at: Timestamp,
        frames: &'a [Detections],
        assigned: &'a [Assigned],
        rig: &Rig,
        gates: &Gates,
    ) -> impl Iterator<Item = Detections> + use<'a> {
        let own = |(frame, assigned): (&Detections, &Assigned)| {
            let person = assigned.person(frame)?;
            let sight: Sight = (frame.camera, pixels_of(frame, &person, gates.min_confidence));
            Some((sight, (frame.camera, person.id.filter(|_| assigned.is_owned()))))
        };
        let (views, ids): (Vec<_>, Vec<_>) = frames.iter().zip(assigned).filter_map(own).unzip();
        let owned = frames.iter().zip(assigned).filter(|(_, assigned)| assigned.is_owned());
        self.owned = owned.map(|(frame, _)| frame.camera).collect();
        self.update(at, &views, &ids, rig, gates);
        frames.iter().zip(assigned).map(|(frame, assigned)| {
            let people = assigned.person(frame).into_iter().collect();
            Detections { people, ..*frame }
        })
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;

    use super::*;

    /// How many are left of two people this far from each other, metres, who have detections in these views.
    fn left_of(apart: f64, views: [&[usize]; 2]) -> usize {
        let at = |ms: i64| Timestamp::default() + Nanos::from_ms(ms);
        let mut people = People::new(4, Gates::default());
        for (performer, owned) in views.into_iter().enumerate() {
            let point = Some(Vector3::new(apart * performer as f64, 1.0, 0.0));
            let mut person = Person::new([point; KEYPOINTS], at(0), 4);
            (person.owned, person.hidden_after) = (owned.to_vec(), Nanos::SECOND);
            let (role, wish) = (Role::Performer(performer), Wish::Open);
            people.members.push(Member { person, role, wish, was: None, close_since: None });
        }
        let mut changes = Vec::new();
        (0..50).for_each(|set| people.drop_doubles(at(10 * set), &mut changes));
        assert_eq!(changes.len(), 2 - people.members.len(), "each is said");
        people.members.len()
    }

    /// In another take they would be taken for somebody who has come.
    #[test]
    fn who_was_dropped_is_known_where_it_is_now() {
        let at = |ms: i64| Timestamp::default() + Nanos::from_ms(ms);
        let somebody =
            |x: f64, ms: i64| Person::new([Some(Vector3::new(x, 1.0, 0.0)); KEYPOINTS], at(ms), 4);
        let mut people = People::new(4, Gates::default());
        let (role, wish) = (Role::Performer(0), Wish::Open);
        let person = somebody(0.0, 0);
        people.members.push(Member { person, role, wish, was: None, close_since: None });
        people.drop_performer(0);
        people.members[0].person = somebody(3.0, 5000);
        let [known] = &people.known()[..] else { panic!("one performer") };
        assert!(known.dropped && known.seen == at(5000), "{known:?}");
        assert_eq!(known.points[0].unwrap().x, 3.0);
        people.restart(Nanos::ZERO);
        assert_eq!(people.absent[0].person.points()[0].unwrap().x, 3.0);
    }

    #[test]
    fn people_whom_no_view_shows_beside_each_other_are_one() {
        assert_eq!(left_of(0.25, [&[0, 3], &[1, 2]]), 1);
        assert_eq!(left_of(0.25, [&[0, 1], &[1, 2]]), 2);
        // One of them is hidden.
        assert_eq!(left_of(0.25, [&[0, 1, 2], &[]]), 2);
        assert_eq!(left_of(0.25, [&[3], &[0, 1, 2]]), 2);
        assert_eq!(left_of(0.4, [&[0, 3], &[1, 2]]), 2);
        assert_eq!(left_of(0.1, [&[0, 1], &[1, 2]]), 1);
    }
}

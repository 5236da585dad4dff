//! Who is there: people are found, confirmed, followed, lost and found again.

use std::sync::Arc;

use super::config::Choice;
use super::lengths::{BONES, Lengths};
use super::names::{Names, NumberName};
use super::performer_id::PerformerId;
use super::person::{Person, Sight, apart};
use crate::core::association::{
    Assigned, Association, Gates, Newcomer, Part, Points, associate, pixels_of,
};
use crate::core::body::Skeleton;
use crate::core::camera::Rig;
use crate::core::detections::Detections;
use crate::core::time::{Nanos, Timestamp};

/// A newcomer is a person after so many sets; after so many if it may be somebody who was lost; and after so many if
/// it is like one of those, but not enough.
const CONFIRMED: u32 = 5;
const RECOGNISED: u32 = 15;
const DOUBTED: u32 = 30;
/// A newcomer who is not seen for this long was none.
const DOUBTFUL: Nanos = Nanos::from_ms(120);
/// A performer who is not seen for this long is lost, and a bystander is forgotten.
const LOST: Nanos = Nanos::from_ms(1000);
/// A performer who is not seen for this long may be where a newcomer is.
const ELSEWHERE: Nanos = Nanos::from_ms(150);
/// How far people get while they are not seen, metres and m/s.
const AWAY_M: f64 = 0.6;
const AWAY_M_S: f64 = 3.0;
/// Bodies that differ by less than this multiple of the usual are one person's; where all performers are known, or
/// one is missed near there, by less than the second.
const SAME_BODY: f64 = 1.7;
const ALIKE_BODY: f64 = 2.5;
/// Such bodies may be one person's.
const LIKE_BODY: f64 = 3.0;
/// People who are this near each other on average, metres, for this long are one.
const SAME_M: f64 = 0.15;
const SAME_TIME: Nanos = Nanos::from_ms(300);
/// Who is pointed at is not farther from there, metres.
const NEAR_M: f64 = 1.0;
/// A bystander counts after this time.
const STAYED: Nanos = Nanos::from_ms(500);
/// Most people who are followed.
const MOST: usize = 64;
/// Most numbers of performers in a run.
const NUMBERS: usize = 256;

/// What a person is to us.
#[derive(Clone, Debug)]
enum Role {
    /// Not confirmed; with the frames so far.
    Candidate(Vec<Detections>),
    Performer(usize),
    /// Above the number of performers.
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
    /// The performer who this was, and is no more.
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
    /// Whether nobody wants this one back.
    is_unwanted: bool,
}

/// How far a performer is here.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum Life {
    /// Followed and seen.
    Confirmed,
    /// Followed, but not seen at the moment.
    Coasting,
    /// Not followed any more: recognised on return, and keeps the place.
    Lost,
    /// Away for so long that somebody else may have the place.
    Left,
}

impl Life {
    /// Whether the performer is followed.
    pub const fn is_here(self) -> bool {
        matches!(self, Self::Confirmed | Self::Coasting)
    }

    /// The name in messages.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Confirmed => "confirmed",
            Self::Coasting => "coasting",
            Self::Lost => "lost",
            Self::Left => "left",
        }
    }
}

/// A performer who is or was here.
#[derive(Clone, Debug, PartialEq)]
pub struct Presence {
    /// Who it is.
    pub performer: PerformerId,
    /// How far the performer is here.
    pub life: Life,
    /// Where the trunk is or was last: x and z in the world, metres.
    pub place: Option<[f64; 2]>,
    /// When the performer was seen last.
    pub seen: Timestamp,
    /// In how many cameras at that time.
    pub views: usize,
}

/// Everybody who is or was here.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Attendance {
    /// The performers, by number.
    pub performers: Vec<Presence>,
    /// People who are seen, but not for long enough to be anybody.
    pub tentative: usize,
    /// People who are seen and are not performers.
    pub others: usize,
}

/// Who a member is.
enum Verdict {
    /// Not known yet.
    Unsure,
    /// The performer at this place in `absent`.
    Known(usize),
    /// Nobody of before.
    New,
}

/// Why nobody at a place becomes a performer.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum FollowError {
    /// Nobody is there.
    #[error("nobody is seen within {NEAR_M} m of this place")]
    Nobody,
    /// That one is followed.
    #[error("{0} is there, and is followed")]
    Performer(String),
    /// All places are taken.
    #[error("all {0} places are taken; drop a performer, or raise [stage] performers")]
    Full(usize),
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

/// What is known of a performer who was seen before.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Known {
    /// Who it is.
    pub performer: PerformerId,
    /// The name that was given; empty: none.
    pub name: String,
    /// Whether it is nobody until somebody follows it.
    pub dropped: bool,
    /// The body, once its estimate is complete.
    pub body: Option<Arc<Skeleton>>,
    /// When the performer was seen last.
    pub seen: Timestamp,
    /// Where its points were then, metres. None: in another place, on another day.
    pub points: Points,
    /// Of each length of the body, the sum of the measurements, metres, and their number.
    pub lengths: [[f64; 2]; BONES],
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
#[derive(Clone, Debug)]
pub(super) struct People {
    gates: Gates,
    /// Most performers at a time.
    limit: usize,
    pub(super) choice: Choice,
    members: Vec<Member>,
    absent: Vec<Absent>,
    /// Number of performers so far.
    known: usize,
    pub(super) names: Names,
    /// Whether a newcomer gets the number of a performer without a name who has left.
    pub(super) reuses_numbers: bool,
    /// The time of the last set.
    at: Timestamp,
    /// Most bystanders at a time.
    pub(super) others: usize,
    pub(super) last: FrameSet,
}

impl People {
    pub(super) fn new(limit: usize, gates: Gates) -> Self {
        Self {
            gates,
            limit,
            choice: Choice::default(),
            members: Vec::new(),
            absent: Vec::new(),
            known: 0,
            names: Names::default(),
            reuses_numbers: false,
            at: Timestamp::default(),
            others: 0,
            last: FrameSet::default(),
        }
    }

    /// The performers so far, without their bodies.
    pub(super) fn known(&self) -> Vec<Known> {
        let is_named = |one: &Absent| self.names.given(PerformerId(one.performer)).is_some();
        let absent = self.absent.iter().filter(|one| one.merged.is_none() || is_named(one));
        let absent = absent.map(|one| (one.performer, one.is_unwanted, &one.person));
        let present = self.members.iter().filter_map(|member| match member.role {
            Role::Performer(performer) => Some((performer, false, &member.person)),
            _ => None,
        });
        let known = |(performer, dropped, person): (usize, bool, &Person)| Known {
            performer: PerformerId(performer),
            name: self.names.given(PerformerId(performer)).unwrap_or_default().to_owned(),
            dropped,
            body: None,
            seen: person.seen,
            points: *person.points(),
            lengths: person.lengths.sums(),
        };
        let mut all: Vec<Known> = absent.chain(present).map(known).collect();
        all.sort_by_key(|one| one.performer);
        all
    }

    /// These performers were seen before.
    pub(super) fn know(&mut self, known: &[Known], cameras: usize) {
        for one in known {
            let mut person = Person::new(one.points, one.seen, cameras);
            person.lengths = Lengths::of(one.lengths);
            let has_left = one.dropped || !person.was_here();
            let absent = Absent::new(one.performer.0, person);
            self.absent.push(Absent { has_left, is_unwanted: one.dropped, ..absent });
            self.known = self.known.max(one.performer.0 + 1);
        }
        self.names.know(known.iter().map(|one| (one.performer, &*one.name)));
    }

    /// Nobody is in view any more.
    pub(super) fn restart(&mut self) {
        for member in std::mem::take(&mut self.members) {
            if let Role::Performer(performer) = member.role {
                self.absent.push(Absent::new(performer, member.person));
            }
        }
    }

    /// Everybody who is or was here.
    pub(super) fn attendance(&self) -> Attendance {
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
                    let is_seen = person.unseen(self.at) <= ELSEWHERE;
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

    /// The person at a place on the floor, x and z, is to become a performer, whatever the choice is.
    pub(super) fn follow_at(&mut self, place: [f64; 2]) -> Result<(), FollowError> {
        let away = |member: &Member| {
            let at = member.person.place()?;
            Some(libm::hypot(at[0] - place[0], at[1] - place[1])).filter(|away| *away <= NEAR_M)
        };
        let near = self.members.iter().enumerate();
        let near = near.filter_map(|(index, member)| Some((index, away(member)?)));
        let nearest = near.min_by(|a, b| a.1.total_cmp(&b.1)).ok_or(FollowError::Nobody)?.0;
        if let Role::Performer(performer) = self.members[nearest].role {
            return Err(FollowError::Performer(self.names.of(PerformerId(performer))));
        }
        if !self.has_place() {
            return Err(FollowError::Full(self.limit));
        }
        self.members[nearest].wish = Wish::Wanted;
        Ok(())
    }

    /// A performer is one no more, and does not become one again unless somebody follows it. Whether the performer
    /// was here.
    pub(super) fn drop_performer(&mut self, performer: usize) -> bool {
        let is_own = |m: &&mut Member| matches!(m.role, Role::Performer(own) if own == performer);
        let mut person = None;
        if let Some(member) = self.members.iter_mut().find(is_own) {
            (member.role, member.wish) = (Role::Bystander, Wish::Unwanted);
            member.was = Some(performer);
            person = Some(member.person.clone());
        }
        if let Some(person) = person {
            self.absent.push(Absent::new(performer, person));
        }
        let absent = self.absent.iter_mut().find(|one| one.performer == performer);
        absent.map(|one| (one.has_left, one.is_unwanted) = (true, true)).is_some()
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

    /// Two members in one place are one person: the older one stays.
    fn drop_doubles(&mut self, at: Timestamp, changes: &mut Vec<Change>) {
        let places: Vec<_> = self.members.iter().map(|m| m.person.predicted(at)).collect();
        let rank = |member: &Member| match member.role {
            Role::Performer(performer) => performer,
            Role::Bystander => usize::MAX - 1,
            Role::Candidate(_) => usize::MAX,
        };
        let ranks: Vec<(usize, Timestamp)> =
            self.members.iter().map(|m| (rank(m), m.person.first)).collect();
        let mut dropped = Vec::new();
        for (index, member) in self.members.iter_mut().enumerate() {
            let is_double = |other: &usize| {
                (ranks[*other], *other) < (ranks[index], index)
                    && apart(&places[*other], &places[index]).is_some_and(|off| off < SAME_M)
            };
            let Some(older) = (0..places.len()).find(is_double) else {
                member.close_since = None;
                continue;
            };
            if at - *member.close_since.get_or_insert(at) > SAME_TIME {
                dropped.push((index, ranks[older].0));
                if let Role::Performer(performer) = member.role {
                    changes.push(Change::Merged(performer, ranks[older].0));
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
        let is_gone = |member: &mut Member| {
            let longest = match member.role {
                Role::Candidate(_) => DOUBTFUL,
                Role::Performer(_) | Role::Bystander => LOST,
            };
            member.person.unseen(at) > longest
        };
        for member in self.members.extract_if(.., is_gone) {
            if let Role::Performer(performer) = member.role {
                self.absent.push(Absent::new(performer, member.person));
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

    /// Whether somebody may become a performer: those who are lost keep their places until they have left.
    fn has_place(&self) -> bool {
        let present =
            self.members.iter().filter(|member| matches!(member.role, Role::Performer(_)));
        let lost = self.absent.iter().filter(|one| !one.has_left && one.merged.is_none());
        present.count() + lost.count() < self.limit
    }

    /// Whether a performer who is absent may be a person who comes now.
    fn may_return(&self, one: &Absent) -> bool {
        let is_there = |performer: usize| {
            self.members.iter().any(|m| matches!(m.role, Role::Performer(own) if own == performer))
        };
        let has_own_place = !one.has_left && one.merged.is_none();
        one.is_unwanted || one.merged.is_none_or(is_there) && (has_own_place || self.has_place())
    }

    /// Candidates become performers or bystanders: who is known best first, then the largest.
    fn confirm(&mut self, at: Timestamp, changes: &mut Vec<Change>) {
        let is_open = self.has_place();
        let is_ready = |&index: &usize| {
            let Member { person, role, wish, .. } = &self.members[index];
            let is_known = || matches!(self.judge(index, at), Verdict::Known(_));
            match role {
                Role::Candidate(_) => person.sets >= CONFIRMED,
                // Who comes to the region later, or is recognised later.
                Role::Bystander if !is_open || person.seen < at => false,
                Role::Bystander => self.is_chosen(index) || *wish == Wish::Open && is_known(),
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
                self.members[other].person = self.members[index].person.clone();
                gone.push(index);
                continue;
            }
            let performer = match self.judge(index, at) {
                Verdict::Unsure => continue,
                Verdict::Known(place) if self.is_unwanted(index, place) => {
                    let (member, one) = (&mut self.members[index], &mut self.absent[place]);
                    (member.role, member.wish) = (Role::Bystander, Wish::Unwanted);
                    member.was = Some(one.performer);
                    (one.is_unwanted, one.has_left) = (true, true);
                    continue;
                }
                Verdict::Known(place) => {
                    let performer = self.absent.remove(place).performer;
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
        let sets = self.members[index].person.sets;
        let may_return = self.absent.iter().any(|one| self.may_return(one));
        if may_return && sets < RECOGNISED {
            return Verdict::Unsure;
        }
        let gate = if self.has_place() { SAME_BODY } else { ALIKE_BODY };
        match self.most_alike(index, at) {
            Some((place, difference)) if difference < gate => Verdict::Known(place),
            Some(_) if sets < DOUBTED => Verdict::Unsure,
            _ => Verdict::New,
        }
    }

    /// Whether a member who is a performer of before is to be nobody.
    fn is_unwanted(&self, index: usize, place: usize) -> bool {
        let (one, only) = (&self.absent[place], &self.choice.only);
        let name = self.names.of(PerformerId(one.performer));
        let is_other = !one.person.was_here() && !only.is_empty() && !only.contains(&name);
        let is_wanted = self.members[index].wish == Wish::Wanted && self.has_place();
        (one.is_unwanted || is_other) && !is_wanted
    }

    /// Gives a name to a performer. Whoever had it and is not here is this one.
    pub(super) fn name(&mut self, performer: PerformerId, name: &str) -> Result<(), NumberName> {
        let before = self.names.owner(name).filter(|before| *before != performer);
        self.names.give(performer, name)?;
        self.absent.retain(|one| Some(PerformerId(one.performer)) != before);
        Ok(())
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
            None if self.known < NUMBERS => {
                self.known += 1;
                self.known - 1
            }
            None => return None,
        };
        self.names.enter(PerformerId(number));
        Some(number)
    }

    /// The performer who is expected in a place where it is not, and may be this candidate.
    fn elsewhere(&self, candidate: usize, at: Timestamp) -> Option<usize> {
        let candidate = &self.members[candidate].person;
        let missed = (0..self.members.len()).filter(|&index| {
            let Member { person, role, .. } = &self.members[index];
            matches!(role, Role::Performer(_))
                && person.unseen(at) > ELSEWHERE
                && may_be_there(person, candidate, at)
        });
        let differences = missed.filter_map(|index| {
            let difference = self.members[index].person.lengths.difference(&candidate.lengths)?;
            (difference < ALIKE_BODY).then_some((index, difference))
        });
        differences.min_by(|a, b| a.1.total_cmp(&b.1)).map(|(index, _)| index)
    }

    /// The place in `absent` of the performer who may be a candidate and is most alike, if any is, and how much they
    /// differ.
    fn most_alike(&self, candidate: usize, at: Timestamp) -> Option<(usize, f64)> {
        let Member { person: candidate, was, .. } = &self.members[candidate];
        let is_somebody = |one: &Absent| self.members.iter().any(|m| m.was == Some(one.performer));
        let differences = self.absent.iter().enumerate().filter_map(|(place, one)| {
            if *was == Some(one.performer) {
                return Some((place, 0.0));
            }
            let difference = one.person.lengths.difference(&candidate.lengths)?;
            let is_possible = !is_somebody(one)
                && (!one.person.was_here() || may_be_there(&one.person, candidate, at))
                && self.may_return(one);
            is_possible.then_some((place, difference))
        });
        let alike = differences.filter(|(_, difference)| *difference < LIKE_BODY);
        alike.min_by(|a, b| a.1.total_cmp(&b.1))
    }
}

impl Absent {
    /// A performer who is lost.
    fn new(performer: usize, person: Person) -> Self {
        Self { performer, person, merged: None, has_left: false, is_unwanted: false }
    }
}

/// Whether a person who was not seen for a while can have got to where the candidate is.
fn may_be_there(person: &Person, candidate: &Person, at: Timestamp) -> bool {
    // The cameras' clock may have been set back.
    let reach = AWAY_M + AWAY_M_S * person.unseen(at).seconds().max(0.0);
    apart(person.points(), candidate.points()).is_some_and(|off| off < reach)
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
            Some((sight, (frame.camera, person.id)))
        };
        let (views, ids): (Vec<_>, Vec<_>) = frames.iter().zip(assigned).filter_map(own).unzip();
        self.update(at, &views, &ids, rig, gates);
        frames.iter().zip(assigned).map(|(frame, assigned)| {
            let people = assigned.person(frame).into_iter().collect();
            Detections { people, ..*frame }
        })
    }
}

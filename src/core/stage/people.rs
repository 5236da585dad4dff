//! Who is there: people are found, confirmed, followed, lost and found again.

use std::sync::Arc;

use super::config::Choice;
use super::lengths::{BONES, Lengths};
use super::performer_id::PerformerId;
use super::person::{Person, Sight, apart};
use crate::core::association::{
    Assigned, Association, Gates, Newcomer, Part, Points, associate, pixels_of,
};
use crate::core::body::Skeleton;
use crate::core::camera::Rig;
use crate::core::detections::Detections;
use crate::core::time::{Nanos, Timestamp};

/// A newcomer is a person after so many sets, and after so many if it may be somebody who was lost.
const CONFIRMED: u32 = 5;
const RECOGNISED: u32 = 15;
/// A newcomer who is not seen for this long was none.
const DOUBTFUL: Nanos = Nanos::from_ms(120);
/// A performer who is not seen for this long is lost, and a bystander is forgotten.
const LOST: Nanos = Nanos::from_ms(1000);
/// A performer who is not seen for this long may be where a newcomer is.
const ELSEWHERE: Nanos = Nanos::from_ms(150);
/// How far people get while they are not seen, metres and m/s.
const AWAY_M: f64 = 0.6;
const AWAY_M_S: f64 = 3.0;
/// Bodies that differ by less are one person's; where all performers are known, by less than the
/// second.
const SAME_BODY: f64 = 0.08;
const ALIKE_BODY: f64 = 0.12;
/// People who are this near each other on average, metres, for this long are one.
const SAME_M: f64 = 0.15;
const SAME_TIME: Nanos = Nanos::from_ms(300);
/// A bystander counts after this time.
const STAYED: Nanos = Nanos::from_ms(500);
/// Most people who are followed.
const MOST: usize = 64;
/// Most numbers of performers in a run.
const NUMBERS: usize = 256;

/// What a person is to us.
#[derive(Clone, Debug)]
enum Life {
    /// Not confirmed; with the frames so far.
    Candidate(Vec<Detections>),
    Performer(usize),
    /// Above the number of performers.
    Bystander,
}

#[derive(Clone, Debug)]
struct Member {
    person: Person,
    life: Life,
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
}

/// What happened to a performer, by number from 0.
#[derive(Clone, Debug, PartialEq)]
pub enum Change {
    /// A new performer.
    Entered(usize),
    /// A performer who was lost is there again.
    Returned(usize),
    /// A performer was not seen for so long that somebody else may have the place.
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
    /// The body, once its estimate is complete.
    pub body: Option<Arc<Skeleton>>,
    /// When the performer was seen last.
    pub seen: Timestamp,
    /// Where its points were then, metres.
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
            others: 0,
            last: FrameSet::default(),
        }
    }

    /// The performers so far, without their bodies.
    pub(super) fn known(&self) -> Vec<Known> {
        let absent = self.absent.iter().filter(|one| one.merged.is_none());
        let absent = absent.map(|one| (one.performer, &one.person));
        let present = self.members.iter().filter_map(|member| match member.life {
            Life::Performer(performer) => Some((performer, &member.person)),
            _ => None,
        });
        let known = |(performer, person): (usize, &Person)| Known {
            performer: PerformerId(performer),
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
            self.absent.push(Absent::new(one.performer.0, person));
            self.known = self.known.max(one.performer.0 + 1);
        }
    }

    /// Nobody is in view any more.
    pub(super) fn restart(&mut self) {
        for member in std::mem::take(&mut self.members) {
            if let Life::Performer(performer) = member.life {
                self.absent.push(Absent::new(performer, member.person));
            }
        }
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
        let seen: Vec<&Detections> = frames.iter().collect();
        let expected: Vec<_> = self.members.iter().map(|m| m.person.expected(at)).collect();
        let found = associate(rig, &seen, &expected, &self.gates);
        let owners = self.owners(&frames, &found);
        let mut changes = Vec::new();
        for (member, assigned) in self.members.iter_mut().zip(&found.performers) {
            let alone = member.person.follow(at, &frames, assigned, rig, &self.gates);
            match &mut member.life {
                Life::Candidate(earlier) => earlier.extend(alone),
                Life::Performer(performer) => {
                    changes.extend(alone.map(|frame| Change::Frame(*performer, frame)));
                }
                Life::Bystander => {}
            }
        }
        for Newcomer { points, views, .. } in found.newcomers {
            if self.members.len() < MOST {
                let mut person = Person::new(points, at, rig.cameras.len());
                let alone = person.follow(at, &frames, &views, rig, &self.gates);
                let life = Life::Candidate(alone.collect());
                self.members.push(Member { person, life, close_since: None });
            }
        }
        self.drop_doubles(at, &mut changes);
        self.lose(at, &mut changes);
        self.confirm(at, &mut changes);
        let stays = |member: &&Member| {
            matches!(member.life, Life::Bystander) && at - member.person.first > STAYED
        };
        self.others = self.others.max(self.members.iter().filter(stays).count());
        let performers = self.members.iter().filter_map(|member| match member.life {
            Life::Performer(performer) => Some(performer),
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
        let of_member = |member: &Member| match member.life {
            Life::Performer(performer) => Owner::Performer(performer),
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
        let rank = |member: &Member| match member.life {
            Life::Performer(performer) => performer,
            Life::Bystander => usize::MAX - 1,
            Life::Candidate(_) => usize::MAX,
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
                if let Life::Performer(performer) = member.life {
                    changes.push(Change::Merged(performer, ranks[older].0));
                }
            }
        }
        for (index, older) in dropped.into_iter().rev() {
            let member = self.members.remove(index);
            if let Life::Performer(performer) = member.life {
                let absent = Absent::new(performer, member.person);
                self.absent.push(Absent { merged: Some(older), ..absent });
            }
        }
    }

    /// Members who were not seen for too long go; performers who were not seen for much longer have left.
    fn lose(&mut self, at: Timestamp, changes: &mut Vec<Change>) {
        let is_gone = |member: &mut Member| {
            let longest = match member.life {
                Life::Candidate(_) => DOUBTFUL,
                Life::Performer(_) | Life::Bystander => LOST,
            };
            member.person.unseen(at) > longest
        };
        for member in self.members.extract_if(.., is_gone) {
            if let Life::Performer(performer) = member.life {
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
            self.members.iter().filter(|member| matches!(member.life, Life::Performer(_)));
        let lost = self.absent.iter().filter(|one| !one.has_left && one.merged.is_none());
        present.count() + lost.count() < self.limit
    }

    /// Whether a performer who is absent may be a person who comes now.
    fn may_return(&self, one: &Absent) -> bool {
        let is_there = |performer: usize| {
            self.members.iter().any(|m| matches!(m.life, Life::Performer(own) if own == performer))
        };
        let has_own_place = !one.has_left && one.merged.is_none();
        one.merged.is_none_or(is_there) && (has_own_place || self.has_place())
    }

    /// Candidates become performers, the largest first, or bystanders.
    fn confirm(&mut self, at: Timestamp, changes: &mut Vec<Change>) {
        let is_open = self.known < NUMBERS && self.has_place();
        let is_ready = |index: &usize| {
            let Member { person, life, .. } = &self.members[*index];
            match life {
                Life::Candidate(_) => person.sets >= CONFIRMED,
                // Who comes to the region later.
                Life::Bystander => is_open && person.seen == at && self.is_chosen(*index),
                Life::Performer(_) => false,
            }
        };
        let mut ready: Vec<usize> = (0..self.members.len()).filter(is_ready).collect();
        let size = |index: &usize| self.members[*index].person.size();
        ready.sort_by(|a, b| size(b).total_cmp(&size(a)).then(a.cmp(b)));
        let mut gone = Vec::new();
        for index in ready {
            if let Some(other) = self.elsewhere(index, at) {
                // The performer goes on here; its tracker has had frames without it meanwhile.
                self.members[other].person = self.members[index].person.clone();
                gone.push(index);
                continue;
            }
            let may_return = self.absent.iter().any(|one| self.may_return(one));
            if may_return && self.members[index].person.sets < RECOGNISED {
                continue;
            }
            let returned = self.recognise(index, at);
            let performer = match returned {
                Some(place) => self.absent.remove(place).performer,
                None if self.known < NUMBERS && self.has_place() && self.is_chosen(index) => {
                    self.known += 1;
                    self.known - 1
                }
                None => {
                    self.members[index].life = Life::Bystander;
                    continue;
                }
            };
            changes.push(match returned {
                Some(_) => Change::Returned(performer),
                None => Change::Entered(performer),
            });
            let life = std::mem::replace(&mut self.members[index].life, Life::Performer(performer));
            if let Life::Candidate(frames) = life {
                changes.extend(frames.into_iter().map(|frame| Change::Frame(performer, frame)));
            }
        }
        gone.sort_unstable();
        for index in gone.into_iter().rev() {
            self.members.remove(index);
        }
    }

    /// Whether a member may become a performer.
    fn is_chosen(&self, index: usize) -> bool {
        let person = &self.members[index].person;
        self.choice.takes(person.place(), person.height_px)
    }

    /// The performer who is expected in a place where it is not, and may be this candidate.
    fn elsewhere(&self, candidate: usize, at: Timestamp) -> Option<usize> {
        let candidate = &self.members[candidate].person;
        let missed = (0..self.members.len()).filter(|&index| {
            let Member { person, life, .. } = &self.members[index];
            matches!(life, Life::Performer(_))
                && person.unseen(at) > ELSEWHERE
                && may_be_there(person, candidate, at)
        });
        let differences = missed.filter_map(|index| {
            let difference = self.members[index].person.lengths.difference(&candidate.lengths)?;
            (difference < SAME_BODY).then_some((index, difference))
        });
        differences.min_by(|a, b| a.1.total_cmp(&b.1)).map(|(index, _)| index)
    }

    /// The place in `absent` of the performer whom a candidate is.
    fn recognise(&self, candidate: usize, at: Timestamp) -> Option<usize> {
        let candidate = &self.members[candidate].person;
        let gate = if self.has_place() { SAME_BODY } else { ALIKE_BODY };
        let differences = self.absent.iter().enumerate().filter_map(|(place, one)| {
            let difference = one.person.lengths.difference(&candidate.lengths)?;
            let is_possible = difference < gate
                && may_be_there(&one.person, candidate, at)
                && self.may_return(one);
            is_possible.then_some((place, difference))
        });
        differences.min_by(|a, b| a.1.total_cmp(&b.1)).map(|(place, _)| place)
    }
}

impl Absent {
    /// A performer who is lost.
    fn new(performer: usize, person: Person) -> Self {
        Self { performer, person, merged: None, has_left: false }
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

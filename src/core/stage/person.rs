//! One person, followed from frame set to frame set by triangulation.

use nalgebra::Vector3;

use super::lengths::Lengths;
use crate::core::association::{Expectation, Gates, KEYPOINTS, LastSeen, Pixels, Points};
use crate::core::camera::{Rig, View, triangulate_near, triangulate_robust};
use crate::core::detections::Keypoint as K;
use crate::core::points::extent;
use crate::core::time::{Nanos, Timestamp};

/// The points whose motion is the person's.
const TRUNK: [K; 6] = [K::LShoulder, K::RShoulder, K::LHip, K::RHip, K::LEar, K::REar];
/// So many of them are triangulated where a person is seen.
const LEAST_TRUNK: usize = 2;
/// Who is seen has a detection of its own in so many views. A track that has only parts of other people's detections is
/// not seen.
const LEAST_OWNED: usize = 2;
/// A triangulated point is not further than this from the predicted one, metres, and this faster than
/// the body since it was last seen, m/s.
const REACH_M: f64 = 0.35;
const REACH_M_S: f64 = 4.0;
/// Time constants of the measured velocity and of its decay while a person is not seen, seconds.
const MEASURED_S: f64 = 0.12;
const DECAY_S: f64 = 0.4;
/// Who was in no view for this long, or is this far from where it was expected, metres, may be somebody else.
pub(super) const HIDDEN: Nanos = Nanos::from_ms(100);
const LEAP_M: f64 = 0.25;
/// Bodies that differ by more ([`Lengths::difference`]) are not those of one person, even if one was seen in one pose only.
const OTHER_BODY: f64 = 4.0;
/// No person is faster, m/s.
const FASTEST_M_S: f64 = 6.0;

/// A person in one view: the camera and the points.
pub(super) type Sight = (usize, Pixels);

/// Where a person is, and how the body is built.
#[derive(Clone, Debug)]
pub(super) struct Person {
    points: Points,
    /// When each was last triangulated.
    fresh: [Timestamp; KEYPOINTS],
    velocity: Vector3<f64>,
    /// The time of the points.
    at: Timestamp,
    /// When the person was last triangulated, and at first.
    pub(super) seen: Timestamp,
    pub(super) first: Timestamp,
    /// Number of sets in which the person was.
    pub(super) sets: u32,
    /// Number of views in the last of them.
    pub(super) views: usize,
    last: Vec<Option<LastSeen>>,
    /// The cameras in whose last frames a detection is the person's, and not only parts of somebody else's.
    pub(super) owned: Vec<usize>,
    pub(super) lengths: Lengths,
    /// Sum over the sets of the extents in all views, pixels.
    extents: f64,
    /// The largest extent in a view when the person was last seen, pixels.
    pub(super) height_px: f64,
    /// When a view showed the trunk last.
    in_view: Timestamp,
    /// After so long without the trunk in any view the person is hidden.
    pub(super) hidden_after: Nanos,
    doubt: Option<Box<Doubt>>,
}

/// A person who was hidden, or leapt, may be somebody else.
#[derive(Clone, Debug)]
struct Doubt {
    /// The person as it was before.
    before: Person,
    /// The lengths since then; they are not the person's yet.
    lengths: Lengths,
    /// When they began.
    first: Timestamp,
    /// If they differ from those before by more, this is somebody else.
    most: f64,
}

impl Person {
    /// A person found at a time.
    pub(super) fn new(points: Points, at: Timestamp, cameras: usize) -> Self {
        Self {
            points,
            fresh: [at; KEYPOINTS],
            velocity: Vector3::zeros(),
            at,
            seen: at,
            first: at,
            sets: 0,
            views: 0,
            last: vec![None; cameras],
            owned: Vec::new(),
            lengths: Lengths::default(),
            extents: 0.0,
            height_px: 0.0,
            in_view: at,
            hidden_after: HIDDEN,
            doubt: None,
        }
    }

    /// How large the person is in the images, pixels.
    pub(super) fn size(&self) -> f64 {
        self.extents / f64::from(self.sets.max(1))
    }

    /// Whether it is known where the person was last.
    pub(super) fn was_here(&self) -> bool {
        self.points.iter().any(Option::is_some)
    }

    /// Whether the person was seen in so many sets, for so long.
    pub(super) fn is_seen_for(&self, (sets, time): (u32, Nanos)) -> bool {
        self.sets >= sets && self.seen - self.first >= time
    }

    /// Capture times are later by `by` from here on.
    pub(super) fn shift_times(&mut self, by: Nanos) {
        (self.seen, self.first) = (self.seen + by, self.first + by);
    }

    /// The person as it was before it was hidden, as long as somebody else may be followed in its place.
    pub(super) fn in_doubt(&self) -> Option<&Self> {
        self.doubt.as_ref().map(|doubt| &doubt.before)
    }

    /// Goes on as `other`, who was found elsewhere. That is somebody else if the lengths turn out to differ by more than
    /// `most` (no unit, see [`Lengths::difference`]).
    pub(super) fn go_on_as(&mut self, other: Self, most: f64) {
        let before = self.doubt.take().map_or_else(|| self.clone(), |doubt| doubt.before);
        *self = Self {
            lengths: before.lengths,
            sets: before.sets + other.sets,
            extents: before.extents + other.extents,
            first: before.first,
            doubt: Some(Box::new(Doubt {
                lengths: other.lengths,
                first: other.first,
                most,
                before,
            })),
            ..other
        };
    }

    /// The person is this one of before, and has its measurements, too.
    pub(super) fn was_before(&mut self, before: &Self) {
        self.lengths.join(&before.lengths);
        if before.sets > 0 {
            self.first = self.first.min(before.first);
        }
    }

    /// After so many frame sets and so long since the person was hidden: the person as it was before, if its lengths
    /// differ too much from those since. Then this is somebody else.
    pub(super) fn settle(&mut self, (sets, time): (u32, Nanos)) -> Option<Self> {
        let is_measured = |doubt: &mut Box<Doubt>| {
            self.sets - doubt.before.sets >= sets && self.seen - doubt.first >= time
        };
        let Doubt { before, lengths, first, most } = *self.doubt.take_if(is_measured)?;
        if before.lengths.difference(&lengths).is_none_or(|difference| difference <= most) {
            self.lengths.join(&lengths);
            return None;
        }
        (self.first, self.lengths) = (first, lengths);
        self.sets -= before.sets;
        self.extents -= before.extents;
        Some(before)
    }

    /// Where the person was last.
    pub(super) fn points(&self) -> &Points {
        &self.points
    }

    /// Where the person stands: the middle of the trunk, x and z.
    pub(super) fn place(&self) -> Option<[f64; 2]> {
        let trunk: Vec<Vector3<f64>> =
            TRUNK.iter().filter_map(|&keypoint| self.points[keypoint as usize]).collect();
        let middle = trunk.iter().sum::<Vector3<f64>>() / trunk.len() as f64;
        (!trunk.is_empty()).then_some([middle.x, middle.z])
    }

    /// The cameras that have shown the person.
    pub(super) fn cameras(&self) -> impl Iterator<Item = usize> {
        (0..).zip(&self.last).filter_map(|(camera, last)| last.is_some().then_some(camera))
    }

    /// Time since the person was last seen.
    pub(super) fn unseen(&self, now: Timestamp) -> Nanos {
        now - self.seen
    }

    /// Whether a view shows this person beside another one.
    pub(super) fn is_beside(&self, other: &Self) -> bool {
        self.owned.iter().any(|camera| other.owned.contains(camera))
    }

    /// Whether this one and another one are both seen, and no view shows both.
    pub(super) fn splits_views_with(&self, other: &Self) -> bool {
        let are_seen = [self, other].iter().all(|one| one.owned.len() >= LEAST_OWNED);
        are_seen && !self.is_beside(other)
    }

    /// Whether no view has shown the person lately.
    pub(super) fn is_hidden(&self, at: Timestamp) -> bool {
        at - self.in_view > self.hidden_after
    }

    /// What the person is expected to look like.
    pub(super) fn expected(&self, at: Timestamp) -> Expectation {
        let (points, last) = (self.predicted(at), self.last.clone());
        Expectation { points, last, is_hidden: self.is_hidden(at) }
    }

    /// The points at another time.
    pub(super) fn predicted(&self, at: Timestamp) -> Points {
        // After a pause of all cameras, nobody knows how far the person went.
        let seconds = at.seconds_since(self.at).min(DECAY_S);
        // The velocity decays only while nothing is seen.
        let unseen = self.at.seconds_since(self.seen).max(0.0);
        let moved = self.velocity * (seconds * libm::exp(-unseen / DECAY_S));
        self.points.map(|point| Some(point? + moved))
    }

    /// Takes what the views show at a time. Returns whether the person was seen in space.
    pub(super) fn update(
        &mut self,
        at: Timestamp,
        views: &[Sight],
        ids: &[(usize, Option<i64>)],
        rig: &Rig,
        gates: &Gates,
    ) -> bool {
        for ((camera, pixels), (_, id)) in views.iter().zip(ids) {
            self.last[*camera] = Some(LastSeen { pixels: *pixels, id: *id });
        }
        if at <= self.at && self.sets > 0 {
            return false;
        }
        let predicted = self.predicted(at);
        let extents: Vec<f64> =
            views.iter().map(|(_, pixels)| extent(pixels.iter().flatten().copied())).collect();
        let gate = gates.agree * extents.iter().fold(0.0, |a: f64, b| a.max(*b));
        let mut seen: Vec<View> = Vec::with_capacity(views.len());
        let found: Points = std::array::from_fn(|index| {
            seen.clear();
            seen.extend(views.iter().filter_map(|(c, pixels)| Some((*c, pixels[index]?, 1.0))));
            let seed = index as u64;
            let point = match predicted[index] {
                Some(near) => triangulate_near(rig, &seen, gate, seed, near),
                None => triangulate_robust(rig, &seen, gate, seed),
            };
            let point = point?.point;
            let age = at.seconds_since(self.fresh[index]);
            let is_near =
                |predicted: Vector3<f64>| (point - predicted).norm() <= REACH_M + REACH_M_S * age;
            predicted[index].is_none_or(is_near).then_some(point)
        });
        let of_trunk: Vec<Vector3<f64>> = TRUNK
            .iter()
            .filter_map(|&k| Some(found[k as usize]? - predicted[k as usize]?))
            .collect();
        let seconds = at.seconds_since(self.at);
        let is_seen = of_trunk.len() >= LEAST_TRUNK && self.owned.len() >= LEAST_OWNED;
        let mut shift = Vector3::zeros();
        if is_seen {
            shift = of_trunk.iter().sum::<Vector3<f64>>() / of_trunk.len() as f64;
        }
        // A limb alone may be somebody else's.
        let has_trunk = |(_, pixels): &Sight| {
            TRUNK.iter().filter(|&&k| pixels[k as usize].is_some()).count() >= LEAST_TRUNK
        };
        let is_own = |(camera, _): &&Sight| self.owned.contains(camera);
        if views.iter().filter(is_own).any(has_trunk) {
            if self.doubt.is_none() && (self.is_hidden(at) || shift.norm() > LEAP_M) {
                let (before, lengths) = (self.clone(), Lengths::default());
                let doubt = Doubt { before, lengths, first: at, most: OTHER_BODY };
                self.doubt = Some(Box::new(doubt));
            }
            self.in_view = at;
        }
        if is_seen {
            if seconds > 0.0 {
                let share = 1.0 - libm::exp(-seconds / MEASURED_S);
                self.velocity += shift / seconds * share;
                let fast = self.velocity.norm() / FASTEST_M_S;
                self.velocity /= fast.max(1.0);
            }
            self.seen = at;
            self.sets += 1;
            self.views = views.len();
            self.extents += extents.iter().sum::<f64>();
            self.height_px = extents.iter().copied().fold(0.0, f64::max);
            match &mut self.doubt {
                Some(doubt) => doubt.lengths.add(&found),
                None => self.lengths.add(&found),
            }
        }
        for (index, found) in found.into_iter().enumerate() {
            if found.is_some() {
                self.fresh[index] = at;
            }
            self.points[index] = found.or(predicted[index].map(|point| point + shift));
        }
        self.at = at;
        is_seen
    }
}

/// Mean distance of the points that both have, metres. `None` without any.
pub(super) fn apart(a: &Points, b: &Points) -> Option<f64> {
    let both = a.iter().zip(b).filter_map(|(a, b)| Some(((*a)? - (*b)?).norm()));
    let (sum, count) = both.fold((0.0, 0.0), |(sum, count), off| (sum + off, count + 1.0));
    (count > 0.0).then(|| sum / count)
}

#[cfg(all(test, feature = "research"))]
mod tests {
    use super::*;
    use crate::research::synth::ring_rig;

    #[test]
    fn who_has_only_parts_of_somebody_elses_detections_is_not_seen() {
        let rig = ring_rig(4, 5.0, 2.0).unwrap();
        let mut points: Points = [None; KEYPOINTS];
        for (index, &keypoint) in TRUNK.iter().enumerate() {
            points[keypoint as usize] = Some(Vector3::new(0.1 * index as f64, 1.2, 0.05));
        }
        let sight =
            |camera: usize| (camera, points.map(|point| rig.cameras[camera].project(&point?)));
        let views: Vec<Sight> = (0..4).map(sight).collect();
        let ids = [0, 1, 2, 3].map(|camera| (camera, None));
        let is_seen = |owned: &[usize]| {
            let mut person = Person::new(points, Timestamp::default(), 4);
            person.owned = owned.to_vec();
            let at = Timestamp::default() + Nanos::from_ms(20);
            person.update(at, &views, &ids, &rig, &Gates::default())
        };
        assert!(is_seen(&[0, 2]));
        assert!(!is_seen(&[]) && !is_seen(&[3]));
    }
}

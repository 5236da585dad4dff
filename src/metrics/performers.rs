//! Several people followed at once, with the metrics of \[Bernardin 2008\] and the field's PCP.

use std::collections::BTreeMap;

use nalgebra::Vector3;
use serde::Serialize;

use crate::core::association::{Edge, matching};
use crate::core::body::{JOINTS, Joint};

/// The joints of a person, world, metres.
pub type Positions = [Vector3<f64>; JOINTS];

/// An estimate is the person's if the mean distance of the joints is below this, metres.
const GATE_M: f64 = 0.25;
/// The limbs of PCP: head, trunk, upper arms, forearms, thighs, shanks.
const LIMBS: [(Joint, Joint); 10] = [
    (Joint::Neck, Joint::Head),
    (Joint::Pelvis, Joint::Neck),
    (Joint::LShoulder, Joint::LElbow),
    (Joint::RShoulder, Joint::RElbow),
    (Joint::LElbow, Joint::LWrist),
    (Joint::RElbow, Joint::RWrist),
    (Joint::LHip, Joint::LKnee),
    (Joint::RHip, Joint::RKnee),
    (Joint::LKnee, Joint::LAnkle),
    (Joint::RKnee, Joint::RAnkle),
];

/// How well people are followed. With `people` the number of true people, over all frames:
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct TrackingErrors {
    /// Number of true people, summed over the frames.
    pub people: usize,
    /// Share of them that have an estimate, percent.
    pub recall_percent: f64,
    /// Share of the estimates that are of somebody, percent.
    pub precision_percent: f64,
    /// How often a person's estimate is another one than the last time.
    pub switches: usize,
    /// 1 - (people without an estimate + estimates of nobody + switches) / people, percent.
    pub mota_percent: f64,
    /// Share of the limbs whose ends are off by at most half their true length on average, percent;
    /// those of people without an estimate count as wrong.
    pub pcp_percent: f64,
    /// Mean distance of the joints of people with an estimate, millimetres.
    pub mpjpe_mm: f64,
}

/// Sums [`TrackingErrors`] over frames.
#[derive(Clone, Debug, Default)]
pub struct TrackingSums {
    /// By person: the last estimate.
    last: BTreeMap<usize, usize>,
    people: usize,
    matched: usize,
    estimates: usize,
    switches: usize,
    limbs: usize,
    distance: f64,
}

impl TrackingSums {
    /// Adds a frame: numbers and joints of the estimates and of the true people. An estimate stays with
    /// its person while it is near; the others are assigned with the least distance in sum.
    pub fn add(&mut self, estimates: &[(usize, Positions)], people: &[(usize, Positions)]) {
        let near = |person: usize, estimate: usize| {
            let off = apart(&people[person].1, &estimates[estimate].1);
            (off < GATE_M).then_some(off)
        };
        let mut is_taken = vec![false; estimates.len()];
        let mut matched = vec![None; people.len()];
        for (person, (number, _)) in people.iter().enumerate() {
            let last = self.last.get(number);
            let same = estimates.iter().position(|(estimate, _)| Some(estimate) == last);
            if let Some(estimate) = same.filter(|&estimate| near(person, estimate).is_some()) {
                (matched[person], is_taken[estimate]) = (Some(estimate), true);
            }
        }
        let mut edges = Vec::new();
        for row in (0..people.len()).filter(|row| matched[*row].is_none()) {
            for column in (0..estimates.len()).filter(|column| !is_taken[*column]) {
                edges.extend(near(row, column).map(|off| Edge { row, column, gain: GATE_M - off }));
            }
        }
        let others = matching(people.len(), estimates.len(), &edges);
        self.people += people.len();
        self.estimates += estimates.len();
        for (((number, truth), matched), other) in people.iter().zip(matched).zip(others) {
            let Some(estimate) = matched.or(other) else { continue };
            let (estimate, positions) = &estimates[estimate];
            self.matched += 1;
            self.distance += apart(truth, positions);
            self.limbs += LIMBS.iter().filter(|limb| is_right(truth, positions, **limb)).count();
            let last = self.last.insert(*number, *estimate);
            self.switches += usize::from(last.is_some_and(|last| last != *estimate));
        }
    }

    /// The errors so far; `None` without people.
    pub fn errors(&self) -> Option<TrackingErrors> {
        let Self { people, matched, estimates, switches, .. } = *self;
        let percent = |part: usize, all: usize| 100.0 * part as f64 / all.max(1) as f64;
        let wrong = people - matched + (estimates - matched) + switches;
        (people > 0).then(|| TrackingErrors {
            people,
            recall_percent: percent(matched, people),
            precision_percent: percent(matched, estimates),
            switches,
            mota_percent: 100.0 - percent(wrong, people),
            pcp_percent: percent(self.limbs, people * LIMBS.len()),
            mpjpe_mm: 1e3 * self.distance / matched.max(1) as f64,
        })
    }
}

/// Mean distance of the joints, metres.
fn apart(a: &Positions, b: &Positions) -> f64 {
    a.iter().zip(b).map(|(a, b)| (a - b).norm()).sum::<f64>() / JOINTS as f64
}

fn is_right(truth: &Positions, estimate: &Positions, (from, to): (Joint, Joint)) -> bool {
    let off = |joint: Joint| (truth[joint.index()] - estimate[joint.index()]).norm();
    let length = (truth[from.index()] - truth[to.index()]).norm();
    off(from) + off(to) <= length
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::core::body::{Pose, Skeleton};

    fn at(x: f64) -> Positions {
        let mut pose = Pose::rest();
        pose.root_position.x = x;
        pose.posture(&Skeleton::default()).positions
    }

    #[test]
    fn nobody_is_lost_and_nobody_is_invented() {
        let mut sums = TrackingSums::default();
        assert_eq!(sums.errors(), None);
        for _ in 0..10 {
            sums.add(&[(7, at(1.01)), (3, at(0.03))], &[(0, at(0.0)), (1, at(1.0))]);
        }
        let errors = sums.errors().unwrap();
        assert!((errors.mpjpe_mm - 20.0).abs() < 1e-9);
        let perfect = TrackingErrors {
            people: 20,
            recall_percent: 100.0,
            precision_percent: 100.0,
            switches: 0,
            mota_percent: 100.0,
            pcp_percent: 100.0,
            ..errors
        };
        assert_eq!(errors, perfect);
    }

    #[test]
    fn every_kind_of_error_counts_once() {
        let people = [(0, at(0.0)), (1, at(1.0))];
        let mut sums = TrackingSums::default();
        sums.add(&[(0, at(0.0)), (1, at(1.0))], &people);
        // Exchanged: two switches.
        sums.add(&[(1, at(0.0)), (0, at(1.0))], &people);
        // One is missed, and one is of nobody.
        sums.add(&[(1, at(0.0)), (2, at(5.0))], &people);
        // Back, with the number from before.
        sums.add(&[(1, at(0.0)), (0, at(1.0))], &people);
        let errors = sums.errors().unwrap();
        assert_eq!((errors.people, errors.switches), (8, 2));
        assert!((errors.recall_percent - 87.5).abs() < 1e-9, "{errors:?}");
        assert!((errors.precision_percent - 87.5).abs() < 1e-9, "{errors:?}");
        assert!((errors.mota_percent - 50.0).abs() < 1e-9, "{errors:?}");
        assert!((errors.pcp_percent - 87.5).abs() < 1e-9, "{errors:?}");
    }

    #[test]
    fn an_estimate_stays_with_its_person_while_it_is_near() {
        let mut sums = TrackingSums::default();
        sums.add(&[(0, at(0.0)), (1, at(0.2))], &[(0, at(0.0)), (1, at(0.2))]);
        // Each is nearer to the other one now.
        sums.add(&[(0, at(0.15)), (1, at(0.05))], &[(0, at(0.0)), (1, at(0.2))]);
        assert_eq!(sums.errors().unwrap().switches, 0);
    }

    #[test]
    fn a_limb_is_wrong_beyond_half_its_length() {
        let mut sums = TrackingSums::default();
        // 10 cm is less than half of every limb but the head.
        let head = (at(0.0)[Joint::Neck.index()] - at(0.0)[Joint::Head.index()]).norm();
        sums.add(&[(0, at(0.1))], &[(0, at(0.0))]);
        let right = if head >= 0.2 { 100.0 } else { 90.0 };
        assert!((sums.errors().unwrap().pcp_percent - right).abs() < 1e-9);
        // 20 cm is more than half of every limb but the trunk.
        let mut sums = TrackingSums::default();
        sums.add(&[(0, at(0.2))], &[(0, at(0.0))]);
        let lengths = LIMBS.map(|(a, b)| (at(0.0)[a.index()] - at(0.0)[b.index()]).norm());
        let right = lengths.iter().filter(|length| **length >= 0.4).count();
        assert!((sums.errors().unwrap().pcp_percent - 10.0 * right as f64).abs() < 1e-9);
    }
}

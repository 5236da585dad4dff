//! Several performers against their truth: who is found, who is mistaken for whom, and how far off.

use std::collections::BTreeMap;

use nalgebra::Vector3;
use serde::Serialize;

use super::limbs::LIMB_JOINTS;
use crate::core::association::{Edge, matching};
use crate::core::body::{JOINTS, Joint};

/// Joint centres of a person, world, metres.
pub type JointPositions = [Vector3<f64>; JOINTS];

/// An estimate at a larger mean distance of its joints is not the true person's, metres.
const GATE_M: f64 = 0.5;
/// A limb is right if the mean error of its ends is below this share of its length.
const PCP: f64 = 0.5;
/// The limbs of PCP: arms, legs, head and trunk.
const LIMBS: [(Joint, Joint); 10] = [
    (Joint::LShoulder, Joint::LElbow),
    (Joint::LElbow, Joint::LWrist),
    (Joint::RShoulder, Joint::RElbow),
    (Joint::RElbow, Joint::RWrist),
    (Joint::LHip, Joint::LKnee),
    (Joint::LKnee, Joint::LAnkle),
    (Joint::RHip, Joint::RKnee),
    (Joint::RKnee, Joint::RAnkle),
    (Joint::Neck, Joint::Head),
    (Joint::Pelvis, Joint::Neck),
];
/// Those that XRMoCap counts: all but the trunk.
const WITHOUT_TRUNK: &[(Joint, Joint)] = LIMBS.split_at(9).0;

/// Scores of several performers over all times. Joint distances are those of the
/// [limb joints](LIMB_JOINTS), which every body has. A true person and an estimate match if the mean
/// distance is below 0.5 m; a match of the time before is kept, the others are those with the least
/// distances in sum \[Bernardin 2008\].
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct PerformerScores {
    /// Number of true people, summed over the times.
    pub people: u64,
    /// True people without a match.
    pub misses: u64,
    /// Estimates without a match.
    pub false_positives: u64,
    /// Times at which a true person's match is another one than its last.
    pub id_switches: u64,
    /// 1 - (misses + false positives + switches) / people, %.
    pub mota_percent: f64,
    /// Share of the true people that have a match, %.
    pub recall_percent: f64,
    /// Share of the estimates that have a match, %.
    pub precision_percent: f64,
    /// Share of the limbs of all true people that are right, %; those of a miss are wrong.
    pub pcp_percent: f64,
    /// PCP as XRMoCap counts it, %: the limbs without the trunk, against the nearest estimate, whoever it is;
    /// times without an estimate do not count; the mean over the people.
    pub pcp_nearest_percent: f64,
    /// Mean joint distance of the matches, millimetres.
    pub mpjpe_mm: f64,
    /// By true person.
    pub performers: BTreeMap<String, PerformerScore>,
}

/// Scores of one true person.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct PerformerScore {
    /// Its matches, in order.
    pub matched: Vec<String>,
    /// Share of the times with a match, %.
    pub recall_percent: f64,
    /// Mean joint distance of its matches, millimetres.
    pub mpjpe_mm: Option<f64>,
}

/// Collects the scores of several performers, time by time.
#[derive(Clone, Debug, Default)]
pub struct PerformerSums {
    misses: u64,
    false_positives: u64,
    switches: u64,
    right_limbs: u64,
    estimates: u64,
    truths: BTreeMap<String, TruthSums>,
}

#[derive(Clone, Debug, Default)]
struct TruthSums {
    times: u64,
    matches: u64,
    /// Times at which there is an estimate, and the right limbs of the nearest one.
    nearest: [u64; 2],
    /// Sum over the matches of their mean joint distance, millimetres.
    error_mm: f64,
    matched: Vec<String>,
}

impl PerformerSums {
    /// Adds the people of one time, by name.
    pub fn add(
        &mut self,
        estimates: &BTreeMap<String, JointPositions>,
        truths: &BTreeMap<String, JointPositions>,
    ) {
        let (estimates, truths) =
            (estimates.iter().collect::<Vec<_>>(), truths.iter().collect::<Vec<_>>());
        let distance =
            |truth: usize, estimate: usize| mean_distance(truths[truth].1, estimates[estimate].1);
        let kept = |truth: usize| {
            let last = self.truths.get(truths[truth].0)?.matched.last()?;
            let estimate = estimates.iter().position(|(name, _)| *name == last)?;
            let off = distance(truth, estimate);
            (off < GATE_M).then_some((off, truth, estimate))
        };
        // Two may have had one estimate, one after the other: the nearer one keeps it.
        let mut all: Vec<_> = (0..truths.len()).filter_map(kept).collect();
        all.sort_by(|a, b| a.0.total_cmp(&b.0));
        let mut pairs: Vec<Option<usize>> = vec![None; truths.len()];
        for (_, truth, estimate) in all {
            if !pairs.contains(&Some(estimate)) {
                pairs[truth] = Some(estimate);
            }
        }
        let mut edges = Vec::new();
        for row in (0..truths.len()).filter(|row| pairs[*row].is_none()) {
            for column in (0..estimates.len()).filter(|column| !pairs.contains(&Some(*column))) {
                let gain = GATE_M - distance(row, column);
                edges.extend((gain > 0.0).then_some(Edge { row, column, gain }));
            }
        }
        let others = matching(truths.len(), estimates.len(), &edges);
        pairs.iter_mut().zip(others).for_each(|(pair, other)| *pair = pair.or(other));

        self.estimates += estimates.len() as u64;
        self.false_positives += (estimates.len() - pairs.iter().flatten().count()) as u64;
        for ((name, truth), pair) in truths.iter().zip(pairs) {
            let sums = self.truths.entry((*name).clone()).or_default();
            sums.times += 1;
            let by_distance =
                estimates.iter().map(|(_, estimate)| (mean_distance(truth, estimate), estimate));
            if let Some((_, nearest)) = by_distance.min_by(|a, b| a.0.total_cmp(&b.0)) {
                sums.nearest[0] += 1;
                sums.nearest[1] += right(WITHOUT_TRUNK, truth, nearest);
            }
            let Some((other, estimate)) = pair.map(|pair| estimates[pair]) else {
                self.misses += 1;
                continue;
            };
            if sums.matched.last() != Some(other) {
                self.switches += u64::from(!sums.matched.is_empty());
                sums.matched.push(other.clone());
            }
            sums.matches += 1;
            sums.error_mm += 1e3 * mean_distance(truth, estimate);
            self.right_limbs += right(&LIMBS, truth, estimate);
        }
    }

    /// The scores; `None` without a match.
    pub fn scores(&self) -> Option<PerformerScores> {
        let people: u64 = self.truths.values().map(|sums| sums.times).sum();
        let matches = people - self.misses;
        let error_mm: f64 = self.truths.values().map(|sums| sums.error_mm).sum();
        let mean = |sum: f64, count: u64| (count > 0).then(|| sum / count as f64);
        let percent = |part: u64, all: u64| 100.0 * part as f64 / all.max(1) as f64;
        let wrong = self.misses + self.false_positives + self.switches;
        let nearest: Vec<f64> = (self.truths.values().filter(|sums| sums.nearest[0] > 0))
            .map(|sums| percent(sums.nearest[1], sums.nearest[0] * WITHOUT_TRUNK.len() as u64))
            .collect();
        let score = |(name, sums): (&String, &TruthSums)| {
            let score = PerformerScore {
                matched: sums.matched.clone(),
                recall_percent: percent(sums.matches, sums.times),
                mpjpe_mm: mean(sums.error_mm, sums.matches),
            };
            (name.clone(), score)
        };
        Some(PerformerScores {
            people,
            misses: self.misses,
            false_positives: self.false_positives,
            id_switches: self.switches,
            mota_percent: 100.0 * (1.0 - wrong as f64 / people.max(1) as f64),
            recall_percent: percent(matches, people),
            precision_percent: percent(self.estimates - self.false_positives, self.estimates),
            pcp_percent: percent(self.right_limbs, people * LIMBS.len() as u64),
            pcp_nearest_percent: nearest.iter().sum::<f64>() / nearest.len().max(1) as f64,
            mpjpe_mm: mean(error_mm, matches)?,
            performers: self.truths.iter().map(score).collect(),
        })
    }
}

/// Mean distance of the limb joints, metres.
fn mean_distance(a: &JointPositions, b: &JointPositions) -> f64 {
    let distance = |joint: Joint| (a[joint.index()] - b[joint.index()]).norm();
    LIMB_JOINTS.map(distance).iter().sum::<f64>() / LIMB_JOINTS.len() as f64
}

/// Number of the limbs that are right.
fn right(limbs: &[(Joint, Joint)], truth: &JointPositions, estimate: &JointPositions) -> u64 {
    let error = |joint: &Joint| (truth[joint.index()] - estimate[joint.index()]).norm();
    let is_right = |(from, to): &&(Joint, Joint)| {
        let length = (truth[from.index()] - truth[to.index()]).norm();
        (error(from) + error(to)) / 2.0 <= PCP * length
    };
    limbs.iter().filter(is_right).count() as u64
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::core::body::{Pose, Skeleton};

    /// People at these places on the floor, metres, by name.
    fn people(all: Named) -> BTreeMap<String, JointPositions> {
        let one = |(name, x): &(&str, f64)| {
            let mut pose = Pose::rest();
            pose.root_position = Vector3::new(*x, 0.9, 0.0);
            ((*name).to_owned(), pose.posture(&Skeleton::default()).positions)
        };
        all.iter().map(one).collect()
    }

    type Named<'a> = &'a [(&'a str, f64)];

    fn scores(times: &[(Named, Named)]) -> PerformerScores {
        let mut sums = PerformerSums::default();
        times.iter().for_each(|(found, truth)| sums.add(&people(found), &people(truth)));
        sums.scores().unwrap()
    }

    /// Two who had one estimate, one after the other, come near each other: the nearer one has it.
    #[test]
    fn one_estimate_is_of_one_person() {
        let apart: Named = &[("a", 0.0), ("b", 5.0)];
        let scores = scores(&[
            (&[("p1", 0.0)], apart),
            (&[("p1", 5.0)], apart),
            (&[("p1", 5.0)], &[("a", 5.2), ("b", 5.0)]),
        ]);
        assert_eq!((scores.misses, scores.false_positives), (3, 0));
        assert_eq!(scores.precision_percent, 100.0);
    }

    #[test]
    fn people_are_counted_and_their_errors_are_measured() {
        let truth: &[(&str, f64)] = &[("anna", 0.0), ("ben", 2.0)];
        // All found; ben missed; a third one found; nobody found.
        let found: [&[(&str, f64)]; 4] = [
            &[("p1", 0.01), ("p2", 2.03)],
            &[("p1", 0.01)],
            &[("p1", 0.01), ("p2", 2.03), ("p3", 5.0)],
            &[],
        ];
        let scores = scores(&found.map(|found| (found, truth)));
        assert_eq!((scores.people, scores.misses, scores.false_positives), (8, 3, 1));
        assert_eq!((scores.id_switches, scores.mota_percent), (0, 50.0));
        assert_eq!((scores.recall_percent, scores.pcp_percent), (62.5, 62.5));
        assert!((scores.precision_percent - 100.0 * 5.0 / 6.0).abs() < 1e-9);
        assert!((scores.mpjpe_mm - (3.0 * 10.0 + 2.0 * 30.0) / 5.0).abs() < 1e-9);
        let [anna, ben] = ["anna", "ben"].map(|name| &scores.performers[name]);
        assert_eq!((anna.recall_percent, ben.recall_percent), (75.0, 50.0));
        assert!((ben.mpjpe_mm.unwrap() - 30.0).abs() < 1e-9);
        assert_eq!(ben.matched, ["p2"]);
    }

    #[test]
    fn a_switch_is_counted_once_and_a_match_is_kept_while_it_is_near() {
        let truth: &[(&str, f64)] = &[("anna", 0.0), ("ben", 0.3)];
        let scores = scores(&[
            (&[("p1", 0.0), ("p2", 0.3)], truth),
            // Nearer to the other one, but within the gate.
            (&[("p1", 0.2), ("p2", 0.1)], truth),
            // Exchanged, far from where the match would be kept.
            (&[("p1", 2.0), ("p2", 0.0)], &[("anna", 0.0), ("ben", 2.0)]),
            (&[("p1", 2.0), ("p2", 0.0)], &[("anna", 0.0), ("ben", 2.0)]),
        ]);
        assert_eq!((scores.id_switches, scores.misses), (2, 0));
        assert_eq!(scores.performers["anna"].matched, ["p1", "p2"]);
    }

    #[test]
    fn limbs_are_right_up_to_half_their_length() {
        let of = |off: f64| scores(&[(&[("p1", off)], &[("anna", 0.0)])]).pcp_percent;
        let body = Skeleton::default();
        let legs = [Joint::LKnee, Joint::RKnee, Joint::LAnkle, Joint::RAnkle];
        let shortest = legs.map(|joint| body.offset(joint).norm()).into_iter().fold(9.0, f64::min);
        // The legs, the trunk, and no arm.
        assert_eq!((of(0.01), of(0.499 * shortest)), (100.0, 50.0), "{shortest}");
    }

    #[test]
    fn the_nearest_counts_whoever_it_is() {
        let truth: &[(&str, f64)] = &[("anna", 0.0), ("ben", 0.1)];
        // Ben is missed, but Anna's estimate is near enough for his long limbs; nobody is found.
        let scores = scores(&[(&[("p1", 0.0)], truth), (&[], truth)]);
        assert_eq!((scores.recall_percent, scores.pcp_percent), (25.0, 25.0));
        let ben = 2.0 * scores.pcp_nearest_percent - 100.0;
        assert!((60.0..100.0).contains(&ben), "{ben}");
    }
}

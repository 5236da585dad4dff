//! How a body is built: the lengths that tell who it is.

use crate::core::association::Points;
use crate::core::detections::Keypoint as K;

/// Number of lengths.
pub(crate) const LENGTHS: usize = 10;
/// Each length: chains of keypoints, whose left and right count as one; and its usual difference between two takes of
/// one person, as a part of it. Detectors move hips and elbows with the pose, so a thigh differs by 5 %, but the
/// length from shoulder to knee by 1.2 %. Measured on one person who walks, and who sits down, with 4 and 9 cameras.
const CHAINS: [(&[&[K]], f64); LENGTHS] = [
    (&[&[K::LShoulder, K::RShoulder]], 0.012),
    (&[&[K::LShoulder, K::LHip, K::LKnee], &[K::RShoulder, K::RHip, K::RKnee]], 0.012),
    (&[&[K::LHip, K::LKnee], &[K::RHip, K::RKnee]], 0.05),
    (&[&[K::LKnee, K::LAnkle], &[K::RKnee, K::RAnkle]], 0.012),
    (&[&[K::LHip, K::RHip]], 0.06),
    (&[&[K::LShoulder, K::LElbow, K::LWrist], &[K::RShoulder, K::RElbow, K::RWrist]], 0.015),
    (&[&[K::LElbow, K::LWrist], &[K::RElbow, K::RWrist]], 0.02),
    (&[&[K::HeadTop, K::LShoulder], &[K::HeadTop, K::RShoulder]], 0.015),
    (&[&[K::HeadTop, K::LEar], &[K::HeadTop, K::REar]], 0.015),
    (&[&[K::LEar, K::REar]], 0.025),
];
/// Standard deviation of one measurement, as a part of the length.
const OFF: f64 = 0.06;
/// Lengths measured less often than this are not compared.
const LEAST: f64 = 5.0;
/// So many lengths must be there to compare.
const COMPARED: usize = 4;
/// After this many measurements, one that differs by more than this part counts as that part.
const KNOWN: f64 = 20.0;
const STRAY: f64 = 0.1;

/// Mean lengths of a person's bones, from triangulated points.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Lengths {
    /// Sum, metres, and number.
    sums: [(f64, f64); LENGTHS],
}

impl Lengths {
    /// Sum, metres, and number of the measurements of each length.
    pub(super) fn sums(&self) -> [[f64; 2]; LENGTHS] {
        self.sums.map(|(sum, count)| [sum, count])
    }

    /// The lengths with these sums and numbers.
    pub(super) fn of(sums: [[f64; 2]; LENGTHS]) -> Self {
        Self { sums: sums.map(|[sum, count]| (sum, count)) }
    }

    /// Adds the points of a frame set.
    pub(super) fn add(&mut self, points: &Points) {
        for ((sum, count), (sides, _)) in self.sums.iter_mut().zip(CHAINS) {
            for side in sides {
                let step = |pair: &[K]| {
                    Some((points[pair[0] as usize]? - points[pair[1] as usize]?).norm())
                };
                let Some(mut length) = side.windows(2).map(step).sum::<Option<f64>>() else {
                    continue;
                };
                if *count >= KNOWN {
                    let mean = *sum / *count;
                    length = length.clamp(mean * (1.0 - STRAY), mean * (1.0 + STRAY));
                }
                (*sum, *count) = (*sum + length, *count + 1.0);
            }
        }
    }

    /// Adds the measurements of the same person.
    pub(super) fn join(&mut self, other: &Self) {
        for ((sum, count), other) in self.sums.iter_mut().zip(other.sums) {
            (*sum, *count) = (*sum + other.0, *count + other.1);
        }
    }

    /// How much two bodies differ, no unit: the root mean square of the lengths' differences, each divided by its usual
    /// difference between two takes of one person. `None` if too few lengths are known.
    pub(super) fn difference(&self, other: &Self) -> Option<f64> {
        let both = self.sums.iter().zip(&other.sums).zip(CHAINS);
        let known = both.filter(|((a, b), _)| a.1 >= LEAST && b.1 >= LEAST);
        let squares = known.map(|((a, b), (_, usual))| {
            let off = 2.0 * (a.0 / a.1 - b.0 / b.1) / (a.0 / a.1 + b.0 / b.1);
            off * off / (usual * usual + OFF * OFF * (1.0 / a.1 + 1.0 / b.1))
        });
        let squares: Vec<f64> = squares.collect();
        let mean = squares.iter().sum::<f64>() / squares.len() as f64;
        (squares.len() >= COMPARED).then(|| mean.sqrt())
    }
}

//! How a body is built: the lengths that tell who it is.

use crate::core::association::Points;
use crate::core::detections::Keypoint as K;

/// Number of lengths.
pub(super) const BONES: usize = 7;
/// The bones of a length; left and right count as one.
const LENGTHS: [&[(K, K)]; BONES] = [
    &[(K::LShoulder, K::RShoulder)],
    &[(K::LShoulder, K::LHip), (K::RShoulder, K::RHip)],
    &[(K::LShoulder, K::LElbow), (K::RShoulder, K::RElbow)],
    &[(K::LElbow, K::LWrist), (K::RElbow, K::RWrist)],
    &[(K::LHip, K::LKnee), (K::RHip, K::RKnee)],
    &[(K::LKnee, K::LAnkle), (K::RKnee, K::RAnkle)],
    &[(K::LHip, K::RHip)],
];
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
    sums: [(f64, f64); BONES],
}

impl Lengths {
    /// Sum, metres, and number of the measurements of each length.
    pub(super) fn sums(&self) -> [[f64; 2]; BONES] {
        self.sums.map(|(sum, count)| [sum, count])
    }

    /// The lengths with these sums and numbers.
    pub(super) fn of(sums: [[f64; 2]; BONES]) -> Self {
        Self { sums: sums.map(|[sum, count]| (sum, count)) }
    }

    /// Adds the points of a frame set.
    pub(super) fn add(&mut self, points: &Points) {
        for ((sum, count), bones) in self.sums.iter_mut().zip(LENGTHS) {
            for (a, b) in bones {
                let Some((a, b)) = points[*a as usize].zip(points[*b as usize]) else { continue };
                let mut length = (a - b).norm();
                if *count >= KNOWN {
                    let mean = *sum / *count;
                    length = length.clamp(mean * (1.0 - STRAY), mean * (1.0 + STRAY));
                }
                (*sum, *count) = (*sum + length, *count + 1.0);
            }
        }
    }

    /// How much two bodies differ: the root mean square of the lengths' relative differences. `None`
    /// if too little is known.
    pub(super) fn difference(&self, other: &Self) -> Option<f64> {
        let both = self.sums.iter().zip(&other.sums);
        let known = both.filter(|(a, b)| a.1 >= LEAST && b.1 >= LEAST);
        let relative = known.map(|(a, b)| 2.0 * (a.0 / a.1 - b.0 / b.1) / (a.0 / a.1 + b.0 / b.1));
        let squares: Vec<f64> = relative.map(|off| off * off).collect();
        let mean = squares.iter().sum::<f64>() / squares.len() as f64;
        (squares.len() >= COMPARED).then(|| mean.sqrt())
    }
}

//! Memory of a problem: its moments in two lanes, which are computed one after the other or at the
//! same time, with the same results.

use std::ops::Add;

use nalgebra::Vector3;

use super::observation::Moment;
use super::observation_batch::Lane;

/// Memory that problems use in turn; grows to the largest and stays.
#[derive(Clone, Debug, Default)]
pub struct Workspace {
    pub(super) lanes: [Lane; 2],
    /// Whether the lanes are computed at the same time.
    in_parallel: bool,
    /// The points' offsets in their joints' frames, for the present shape.
    pub(super) offsets: Vec<Vector3<f64>>,
    /// Half of a change of coordinates.
    pub(super) half: Vec<f64>,
}

/// What was done, to count the arithmetic.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Counts {
    /// Codes decoded.
    pub decoded: usize,
    /// Codes at which the decoder was linearised.
    pub linearised: usize,
    /// Gradients carried back through the decoder.
    pub gradients: usize,
    /// Moments of which rows were made for a Hessian.
    pub moments: usize,
}

impl Add for Counts {
    type Output = Self;

    fn add(self, other: Self) -> Self {
        Self {
            decoded: self.decoded + other.decoded,
            linearised: self.linearised + other.linearised,
            gradients: self.gradients + other.gradients,
            moments: self.moments + other.moments,
        }
    }
}

impl Counts {
    /// What was done after `before`.
    pub fn since(self, before: Self) -> Self {
        Self {
            decoded: self.decoded - before.decoded,
            linearised: self.linearised - before.linearised,
            gradients: self.gradients - before.gradients,
            moments: self.moments - before.moments,
        }
    }
}

/// What the moments of the first lane are a multiple of: so many codes go through a layer at once.
const TOGETHER: usize = 4;

/// The moments of the two lanes; fewer than twice as many are all in the second.
pub(super) fn in_lanes(moments: &[Moment]) -> [&[Moment]; 2] {
    moments.split_at(moments.len() / 2 / TOGETHER * TOGETHER).into()
}

impl Workspace {
    /// Memory for problems whose lanes are computed at the same time, by the pool of `rayon` that the
    /// problem is solved in.
    pub fn in_parallel() -> Self {
        Self { in_parallel: true, ..Self::default() }
    }

    /// What was done since it was made.
    pub fn counts(&self) -> Counts {
        let [first, second] = &self.lanes;
        first.counts + second.counts
    }

    /// What each moment cost at the last evaluation.
    pub(super) fn costs(&self) -> impl Iterator<Item = f64> {
        self.lanes.iter().flat_map(|lane| &lane.costs).copied()
    }

    /// Another problem begins.
    pub(super) fn forget(&mut self) {
        self.lanes.iter_mut().for_each(Lane::forget);
    }

    /// Computes both lanes.
    pub(super) fn compute(
        &mut self,
        moments: &[Moment],
        compute: impl Fn(&[Moment], &[Vector3<f64>], &mut Lane) + Sync,
    ) {
        let Self { lanes: [first, second], in_parallel, offsets, .. } = self;
        let [early, late] = in_lanes(moments);
        let mut early = || compute(early, offsets, first);
        let mut late = || compute(late, offsets, second);
        match in_parallel {
            true => rayon::join(early, late),
            false => (early(), late()),
        };
    }
}

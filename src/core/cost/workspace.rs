//! Memory of a problem: its moments in two lanes, which are computed one after the other or at the
//! same time, with the same results.

use std::ops::Add;

use nalgebra::Vector3;

use super::observation::FrameObservations;
use super::observation_batch::ObservationBatch;

/// Memory that problems use in turn; grows to the largest and stays.
#[derive(Clone, Debug, Default)]
pub struct Workspace {
    pub(super) batches: [ObservationBatch; 2],
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
    pub observed_frames: usize,
}

impl Add for Counts {
    type Output = Self;

    fn add(self, other: Self) -> Self {
        Self {
            decoded: self.decoded + other.decoded,
            linearised: self.linearised + other.linearised,
            gradients: self.gradients + other.gradients,
            observed_frames: self.observed_frames + other.observed_frames,
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
            observed_frames: self.observed_frames - before.observed_frames,
        }
    }
}

/// What the moments of the first lane are a multiple of: so many codes go through a layer at once.
const TOGETHER: usize = 4;

/// The moments of the two lanes; fewer than twice as many are all in the second.
pub(super) fn in_lanes(observed_frames: &[FrameObservations]) -> [&[FrameObservations]; 2] {
    observed_frames.split_at(observed_frames.len() / 2 / TOGETHER * TOGETHER).into()
}

impl Workspace {
    /// Memory for problems whose lanes are computed at the same time, by the pool of `rayon` that the
    /// problem is solved in.
    pub fn in_parallel() -> Self {
        Self { in_parallel: true, ..Self::default() }
    }

    /// What was done since it was made.
    pub fn counts(&self) -> Counts {
        let [first, second] = &self.batches;
        first.counts + second.counts
    }

    /// What each moment cost at the last evaluation.
    pub(super) fn costs(&self) -> impl Iterator<Item = f64> {
        self.batches.iter().flat_map(|batch| &batch.costs).copied()
    }

    /// Another problem begins.
    pub(super) fn forget(&mut self) {
        self.batches.iter_mut().for_each(ObservationBatch::forget);
    }

    /// Computes both lanes.
    pub(super) fn compute(
        &mut self,
        observed_frames: &[FrameObservations],
        compute: impl Fn(&[FrameObservations], &[Vector3<f64>], &mut ObservationBatch) + Sync,
    ) {
        let Self { batches: [first, second], in_parallel, offsets, .. } = self;
        let [early, late] = in_lanes(observed_frames);
        let mut early = || compute(early, offsets, first);
        let mut late = || compute(late, offsets, second);
        match in_parallel {
            true => rayon::join(early, late),
            false => (early(), late()),
        };
    }
}

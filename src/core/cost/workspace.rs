//! Memory of a problem: its frames in two batches. Computing them in sequence or in parallel gives
//! the same results.

use nalgebra::Vector3;

use super::counts::Counts;
use super::observation::FrameObservations;
use super::observation_batch::ObservationBatch;

/// Memory for a series of problems; it grows to the largest and stays.
#[derive(Clone, Debug, Default)]
pub struct Workspace {
    pub(super) batches: [ObservationBatch; 2],
    /// Whether the batches are computed in parallel.
    in_parallel: bool,
    /// The points' offsets, see `Attachment::offset`, for the present shape.
    pub(super) offsets: Vec<Vector3<f64>>,
    /// Memory of the chain rule of a block.
    pub(super) half: Vec<f64>,
}

/// The first batch holds a multiple of this many frames: so many codes go through a layer at once.
const TOGETHER: usize = 4;

/// The frames of the two batches; fewer than 8 are all in the second.
pub(super) fn in_batches(observations: &[FrameObservations]) -> [&[FrameObservations]; 2] {
    observations.split_at(observations.len() / 2 / TOGETHER * TOGETHER).into()
}

impl Workspace {
    /// Memory for problems whose batches are computed in parallel, in the `rayon` pool of the
    /// caller.
    pub fn in_parallel() -> Self {
        Self { in_parallel: true, ..Self::default() }
    }

    /// The counts since the workspace was made.
    pub fn counts(&self) -> Counts {
        let [first, second] = &self.batches;
        first.counts + second.counts
    }

    /// The cost of each frame at the last evaluation.
    pub(super) fn costs(&self) -> impl Iterator<Item = f64> {
        self.batches.iter().flat_map(|batch| &batch.costs).copied()
    }

    /// Starts another problem.
    pub(super) fn forget(&mut self) {
        self.batches.iter_mut().for_each(ObservationBatch::forget);
    }

    /// Computes both batches.
    pub(super) fn compute(
        &mut self,
        observations: &[FrameObservations],
        compute: impl Fn(&[FrameObservations], &[Vector3<f64>], &mut ObservationBatch) + Sync,
    ) {
        let Self { batches: [first, second], in_parallel, offsets, .. } = self;
        let [early, late] = in_batches(observations);
        let mut early = || compute(early, offsets, first);
        let mut late = || compute(late, offsets, second);
        match in_parallel {
            true => rayon::join(early, late),
            false => (early(), late()),
        };
    }
}

//! What is known of a performer.

use std::sync::Arc;

use super::lengths::LENGTHS;
use super::performer_id::PerformerId;
use crate::core::association::Points;
use crate::core::body::Skeleton;
use crate::core::time::Timestamp;

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
    /// Whether its keypoint offsets are those of this detector. If not, only its bones are known.
    pub offsets_are_known: bool,
    /// When the performer was seen last.
    pub seen: Timestamp,
    /// Where its points were then, metres. None: in another place, on another day.
    pub points: Points,
    /// Of each length of the body, the sum of the measurements, metres, and their number.
    pub lengths: [[f64; 2]; LENGTHS],
}

impl Known {
    /// The body, and whether its keypoint offsets are known.
    pub(super) fn saved_body(&self) -> Option<(Arc<Skeleton>, bool)> {
        Some((self.body.clone()?, self.offsets_are_known))
    }

    /// Whether it is known where the performer was last. Otherwise it was in another place, or on another day.
    pub fn was_here(&self) -> bool {
        self.points.iter().any(Option::is_some)
    }
}

//! Who is or was on the stage.

use super::performer_id::PerformerId;
use crate::core::named;
use crate::core::time::Timestamp;

named! {
    /// How far a performer is here.
    #[derive(Clone, Copy, Debug, PartialEq, Eq)]
    #[non_exhaustive]
    pub enum Life {
        /// Followed and seen.
        Confirmed = "confirmed",
        /// Followed, but not seen at the moment.
        Coasting = "coasting",
        /// Not followed any more: recognised on return, and keeps the place.
        Lost = "lost",
        /// Away for so long that somebody else may have the place.
        Left = "left",
    }
}

impl Life {
    /// Whether the performer is followed.
    pub const fn is_here(self) -> bool {
        matches!(self, Self::Confirmed | Self::Coasting)
    }
}

/// A performer who is or was here.
#[derive(Clone, Debug, PartialEq)]
pub struct Presence {
    /// Who it is.
    pub performer: PerformerId,
    /// How far the performer is here.
    pub life: Life,
    /// Where the trunk is or was last: x and z in the world, metres.
    pub place: Option<[f64; 2]>,
    /// When the performer was seen last.
    pub seen: Timestamp,
    /// In how many cameras at that time.
    pub views: usize,
}

/// Everybody who is or was here.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Attendance {
    /// The performers, by number.
    pub performers: Vec<Presence>,
    /// People who are seen, but not for long enough to be anybody.
    pub tentative: usize,
    /// People who are seen and are not performers.
    pub others: usize,
}

//! Who a performer is.

use std::fmt;

/// A performer of a stage, by number from 0 in the order of entering.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct PerformerId(pub usize);

/// The name: p1, p2, ...
impl fmt::Display for PerformerId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "p{}", self.0 + 1)
    }
}

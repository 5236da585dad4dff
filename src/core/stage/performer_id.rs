//! Who a performer is.

use std::fmt;

/// A performer of a stage, by number from 0. The numbers are given in the order of entering.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct PerformerId(pub usize);

impl PerformerId {
    /// Numbers are below this.
    pub const MOST: usize = 256;

    /// Whether a text is what some number is called.
    pub fn is_name(text: &str) -> bool {
        text.strip_prefix('p')
            .is_some_and(|n| !n.is_empty() && n.bytes().all(|b| b.is_ascii_digit()))
    }
}

/// What the number is called: p1, p2, ...
impl fmt::Display for PerformerId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "p{}", self.0 + 1)
    }
}

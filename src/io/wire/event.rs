//! Checks of `Event`, which the core has no type of its own for.

use super::check::field;
use super::{DecodeError, Event};

impl Event {
    /// Checks what came from outside.
    ///
    /// # Errors
    /// No kind, or a count of zero.
    pub fn validated(self) -> Result<Self, DecodeError> {
        if self.kind.is_empty() {
            return Err(field("Event", "kind").invalid("is empty"));
        }
        if self.count == 0 {
            return Err(field("Event", "count").invalid("is 0, must be at least 1"));
        }
        Ok(self)
    }
}

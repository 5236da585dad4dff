//! Checks how a performer is to be shown.

use super::PerformerLabel;

/// Most characters of a name to show.
const MOST_SHOWN: usize = 60;

impl PerformerLabel {
    /// Fails, with what to do, if the name is too long or has line breaks, or the colour is none.
    pub(crate) fn check(&self) -> Result<(), String> {
        let Self { display_name, colour, .. } = self;
        if display_name.chars().count() > MOST_SHOWN || display_name.chars().any(char::is_control) {
            return Err(format!(
                "the name to show is too long or has line breaks; at most {MOST_SHOWN} characters"
            ));
        }
        let is_hex =
            |digits: &str| digits.len() == 6 && digits.bytes().all(|b| b.is_ascii_hexdigit());
        match colour.is_empty() || colour.strip_prefix('#').is_some_and(is_hex) {
            true => Ok(()),
            false => Err(format!("colour {colour:?}: write # and six hex digits, such as #0072b2")),
        }
    }
}

//! Checks the name and the colour that programs show for a performer.

use super::PerformerLabel;

/// Most characters of a name to show.
const MOST_SHOWN: usize = 60;

impl PerformerLabel {
    /// Checks the name to show (at most 60 characters, no control characters) and the colour (`#` and six hex digits).
    ///
    /// # Errors
    /// A text for the user: what is wrong, and what is right.
    pub fn check(&self) -> Result<(), String> {
        let Self { display_name, colour, .. } = self;
        if display_name.chars().count() > MOST_SHOWN || display_name.chars().any(char::is_control) {
            return Err(format!(
                "the name to show may have {MOST_SHOWN} characters, and no line breaks or other control characters"
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn long_names_line_breaks_and_wrong_colours_are_refused() {
        let check = |display_name: &str, colour: &str| {
            let (display_name, colour) = (display_name.to_owned(), colour.to_owned());
            PerformerLabel { display_name, colour, locked: false }.check()
        };
        let long = "x".repeat(MOST_SHOWN);
        for (name, colour) in [("", ""), ("Lead, as a child", "#0072b2"), (&*long, "#ABCDEF")] {
            assert_eq!(check(name, colour), Ok(()));
        }
        let too_long = format!("{long}x");
        for (name, colour) in [(&*too_long, ""), ("a\nb", ""), ("", "red"), ("", "#0072b")] {
            assert!(check(name, colour).is_err(), "{name:?} {colour:?}");
        }
    }
}

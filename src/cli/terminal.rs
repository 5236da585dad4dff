//! Output to the terminal: lines, tables, progress. A closed pipe is not an error.

use std::io::{ErrorKind, Write};
use std::sync::OnceLock;
use std::time::Duration;

use indicatif::{ProgressBar, ProgressStyle};

/// Prints to standard output. [`unwritten`] tells whether it failed.
pub(crate) fn say(text: &str) {
    let _ = tell(text);
}

/// Why standard output could not be written, if it is not a closed pipe.
static UNWRITTEN: OnceLock<String> = OnceLock::new();

/// Prints to standard output; false if that is not possible.
pub(crate) fn tell(text: &str) -> bool {
    let mut out = std::io::stdout().lock();
    let written = writeln!(out, "{text}").and_then(|()| out.flush());
    if let Err(error) = &written
        && error.kind() != ErrorKind::BrokenPipe
    {
        UNWRITTEN.get_or_init(|| error.to_string());
    }
    written.is_ok()
}

/// Why standard output could not be written, if it is not a closed pipe.
pub(crate) fn unwritten() -> Option<&'static str> {
    UNWRITTEN.get().map(String::as_str)
}

/// Prints `kind: text` to standard error.
pub(crate) fn complain(kind: &str, text: &str) {
    let _ = writeln!(std::io::stderr().lock(), "{kind}: {text}");
}

/// Prints one line to standard error.
pub(crate) fn note(text: &str) {
    let _ = writeln!(std::io::stderr().lock(), "{text}");
}

/// Rows of a name and a value, with aligned values.
pub(crate) fn table(rows: &[(String, String)]) -> String {
    let width = rows.iter().map(|(name, _)| name.chars().count()).max().unwrap_or(0);
    let lines = rows.iter().map(|(name, value)| {
        let gap = " ".repeat(width - name.chars().count() + 2);
        format!("{name}{gap}{value}").trim_end().to_owned()
    });
    lines.collect::<Vec<_>>().join("\n")
}

/// A progress bar on standard error, hidden if that is not a terminal.
pub(crate) fn progress(total: u64, unit: &str) -> ProgressBar {
    let template = format!("{{bar:32}} {{pos}}/{{len}} {unit} {{msg}} {{eta}} left");
    let bar = ProgressBar::new(total);
    if let Ok(style) = ProgressStyle::with_template(&template) {
        bar.set_style(style);
    }
    bar.enable_steady_tick(Duration::from_millis(250));
    bar
}

/// A status line on standard error for work of unknown length, hidden if that is not a terminal.
pub(crate) fn ticker() -> ProgressBar {
    let bar = ProgressBar::new_spinner();
    if let Ok(style) = ProgressStyle::with_template("{spinner} {msg}") {
        bar.set_style(style);
    }
    bar.enable_steady_tick(Duration::from_millis(250));
    bar
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_stand_in_one_column() {
        let row = |a: &str, b: &str| (a.to_owned(), b.to_owned());
        assert_eq!(
            table(&[row("a", "1"), row("long", "2"), row("", "3")]),
            "a     1\nlong  2\n      3"
        );
    }
}

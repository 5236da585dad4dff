//! Output to the terminal: lines, tables, progress. A closed pipe is not an error.

use std::io::Write;
use std::time::Duration;

use indicatif::{ProgressBar, ProgressStyle};

/// Prints to standard output.
pub(crate) fn say(text: &str) {
    let _ = tell(text);
}

/// Prints to standard output; false if the pipe is closed.
pub(crate) fn tell(text: &str) -> bool {
    writeln!(std::io::stdout().lock(), "{text}").is_ok()
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

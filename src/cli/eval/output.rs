//! Output files of `bundlemocap eval`: table.md, results.json, report.html.

use std::path::Path;

use serde_json::Value;

use crate::cli::failure::Failure;
use crate::cli::terminal::say;
use crate::io::report::{ReportData, write_report};
use crate::offline::output::{OutputFolder, text as file};
use crate::research::experiments::summary::{markdown, text};

/// The files of the output folder.
pub(super) const FILES: [&str; 3] = ["table.md", "results.json", "report.html"];

/// Prints the leading tables of the report and writes the output folder.
pub(super) fn write(out: &Path, report: &ReportData, results: &Value) -> Result<(), Failure> {
    let folder = OutputFolder::make(out)?;
    let tables: Vec<String> = report.leading.iter().map(markdown).collect();
    let page = format!("# {}\n\n{}\n\n{}", report.title, report.subtitle, tables.join("\n"));
    let [table, json, html] = FILES.map(|name| folder.file(name));
    file(&table, &page)?;
    file(&json, &format!("{results:#}\n"))?;
    write_report(&html, report)?;
    let printed: Vec<String> = report.leading.iter().map(text).collect();
    say(&printed.join("\n\n"));
    say(&format!("\nwritten to {}: {}", out.display(), FILES.join(", ")));
    Ok(())
}

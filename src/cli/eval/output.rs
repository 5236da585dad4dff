//! Output files of `bundlemocap eval`: table.md, results.json, report.html.

use std::path::Path;

use serde_json::Value;

use crate::cli::failure::Failure;
use crate::cli::terminal::say;
use crate::io::report::{ReportData, write_report};
use crate::offline::output::{OutputFolder, text as file};
use crate::research::experiments::summary::{markdown, text};

/// Prints the leading tables of the report and writes the output folder.
pub(super) fn write(out: &Path, report: &ReportData, results: &Value) -> Result<(), Failure> {
    let folder = OutputFolder::make(out)?;
    let tables: Vec<String> = report.leading.iter().map(markdown).collect();
    let page = format!("# {}\n\n{}\n\n{}", report.title, report.subtitle, tables.join("\n"));
    file(&folder.file("table.md"), &page)?;
    file(&folder.file("results.json"), &format!("{results:#}\n"))?;
    write_report(&folder.file("report.html"), report)?;
    let printed: Vec<String> = report.leading.iter().map(text).collect();
    say(&printed.join("\n\n"));
    say(&format!("\nwritten to {}: table.md, results.json, report.html", out.display()));
    Ok(())
}

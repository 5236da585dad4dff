//! `bundlemocap info`

use std::path::PathBuf;

use clap::Args;
use serde_json::{Value, json};

use super::Ended;
use super::failure::{Exit, json};
use super::terminal::{say, table};
use crate::io::recording::{Info, METADATA, scan, summary};

/// Show the content of a recording.
#[derive(Debug, Args)]
#[command(after_help = "\
With --json: seconds (first to last message), bytes (of the file), rig (names of the calibrated
cameras), cameras (by name: format, image_size [width, height] in pixels), topics (by name: schema,
count, rate_hz or null), metadata (version, config, weights, command or null), damage (one text per
loss), checked (true if the whole file was read).

Examples:
  bundlemocap info balancing.mcap
  bundlemocap info balancing.mcap --check       read the whole file and show any damage
  bundlemocap info out/poses.mcap --json")]
pub(super) struct Arguments {
    /// MCAP recording of this program.
    file: PathBuf,
    /// Read the whole file, not only its index.
    #[arg(long)]
    check: bool,
    /// Print one JSON object.
    #[arg(long)]
    json: bool,
}

pub(super) fn run(arguments: &Arguments) -> Ended {
    let info = if arguments.check { scan(&arguments.file) } else { summary(&arguments.file) }?;
    if arguments.json {
        say(&json(&object(&info))?);
    } else {
        say(&table(&rows(&info)));
    }
    Ok(if info.report.is_clean() { Exit::Done } else { Exit::InPart })
}

fn rows(info: &Info) -> Vec<(String, String)> {
    let mut rows = Vec::new();
    let mut row = |name: String, value: String| rows.push((name, value));
    row("length".into(), format!("{:.3} s", info.seconds()));
    row("size".into(), format!("{} bytes", info.bytes));
    let cameras = if info.rig.is_empty() { "none".to_owned() } else { info.rig.join(", ") };
    row("calibrated cameras".into(), cameras);
    for (name, camera) in &info.cameras {
        let [width, height] = camera.image_size;
        row(format!("camera {name}"), format!("{}, {width} x {height}", camera.format));
    }
    for (topic, held) in &info.topics {
        let rate = held.rate.map_or_else(String::new, |rate| format!(", {rate:.1} Hz"));
        row(topic.clone(), format!("{} x {}{rate}", held.count, held.schema));
    }
    for (key, value) in info.metadata.get(METADATA).into_iter().flatten() {
        if key != "config" && !value.is_empty() {
            row(key.clone(), value.clone());
        }
    }
    for lost in info.report.losses() {
        row("damage".into(), lost);
    }
    rows
}

fn object(info: &Info) -> Value {
    let topics = info.topics.iter().map(|(topic, held)| {
        let value = json!({ "schema": held.schema, "count": held.count, "rate_hz": held.rate });
        (topic.clone(), value)
    });
    let cameras = info.cameras.iter().map(|(name, camera)| {
        let value = json!({ "format": camera.format, "image_size": camera.image_size });
        (name.clone(), value)
    });
    json!({
        "seconds": info.seconds(),
        "bytes": info.bytes,
        "rig": info.rig,
        "cameras": cameras.collect::<serde_json::Map<_, _>>(),
        "topics": topics.collect::<serde_json::Map<_, _>>(),
        "metadata": info.metadata.get(METADATA),
        "damage": info.report.losses(),
        "checked": info.scanned,
    })
}

//! `bundlemocap view`

use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use clap::Args;

use super::Ended;
use super::bus::{BusArguments, topics};
use super::clock::{ATTENTION, Stop};
use super::failure::{Exit, Failure};
use super::terminal::{complain, progress, say};
use crate::config::Config;
use crate::io::bus::open_client;
use crate::io::recording::summary;
use crate::io::wire::{KeypointFrame, Pose, Schema};
use crate::view::{Live, Recorded, Running, Source, ViewError, start};

/// Where the page is served.
pub(super) const ADDRESS: &str = "127.0.0.1:8765";

/// Where Foxglove and Lichtblick connect.
pub(super) const FOXGLOVE: &str = "127.0.0.1:8766";

/// Show a stage live, or a recording, in a browser.
#[derive(Debug, Args)]
#[command(after_help = "\
Serves a page until Ctrl-C; open the printed address in a browser. The page works without internet. It
shows the performers and the cameras in 3D, each camera's keypoints with the solved body over them, what
is wrong with a camera, and events. A recording has a timeline; the place in it is in the address, such
as http://127.0.0.1:8765/#t=12.35.

On an address that others can reach, such as 0.0.0.0:8765, the page needs the token in the printed
address.

Examples:
  bundlemocap view                                         the stage of a node on this computer
  bundlemocap view --connect tcp/192.168.1.10:7447
  bundlemocap view out/poses.mcap
  bundlemocap view out/poses.mcap take.mcap                the poses over the keypoints that they are from
  bundlemocap view a/poses.mcap b/poses.mcap               two solves of a take over each other
  bundlemocap view take_03.mcap --listen 0.0.0.0:8765")]
pub(super) struct Arguments {
    /// Recordings of one take to show, such as its poses and its keypoints; without one, what is on the bus.
    #[arg(conflicts_with_all = ["config", "bus", "connect", "stage", "actor"])]
    files: Vec<PathBuf>,
    /// Address of the page; port 0 chooses a free one. Not that of the bus, which is --connect.
    #[arg(long, value_name = "ADDRESS", default_value = ADDRESS)]
    listen: String,
    #[command(flatten)]
    bus: BusArguments,
}

impl From<ViewError> for Failure {
    fn from(error: ViewError) -> Self {
        match error {
            ViewError::Recording(error) => error.into(),
            ViewError::Listen { .. } | ViewError::Bridge { .. } => {
                Self::new(Exit::Usage, error.to_string())
            }
            ViewError::Thread(_) => Self::new(Exit::Unexpected, error.to_string()),
        }
    }
}

pub(super) fn run(arguments: &Arguments) -> Ended {
    let stop = Stop::on_signals()?;
    let source = match &*arguments.files {
        [] => live(arguments.bus.settings()?),
        paths => recorded(paths)?,
    };
    let page = serve(&arguments.listen, source)?;
    say(&format!("open {}", page.url()));
    while !stop.is_set() {
        std::thread::sleep(Duration::from_millis(50).max(ATTENTION));
    }
    Ok(Exit::Done)
}

fn recorded(paths: &[PathBuf]) -> Result<Source, Failure> {
    let (mut messages, mut is_empty) = (0, true);
    let shown = [KeypointFrame::FULL_NAME, Pose::FULL_NAME];
    for path in paths {
        let topics = summary(path)?.topics;
        messages += topics.values().map(|topic| topic.count).sum::<u64>();
        is_empty &= !topics.values().any(|topic| shown.contains(&&*topic.schema));
    }
    if is_empty {
        complain("warning", "no poses and no keypoints: there is nothing to see");
    }
    let bar = progress(messages, "messages");
    let recorded = Recorded::open(paths, || bar.inc(1))?;
    bar.finish_and_clear();
    Ok(Source::Recorded(Arc::new(recorded)))
}

/// The stage of the settings.
pub(super) fn live(config: Config) -> Source {
    Source::Live(stage(config, "bundlemocap page"))
}

/// The stage of the settings, for a client of the bus that others see so.
pub(super) fn stage(config: Config, name: &str) -> Arc<Live> {
    let (topics, bus) = (topics(&config), config.bus.named(name));
    Arc::new(Live::new(topics, move || open_client(&bus)))
}

/// Serves the page.
pub(super) fn serve(address: &str, source: Source) -> Result<Running, Failure> {
    Ok(start(address, source)?)
}

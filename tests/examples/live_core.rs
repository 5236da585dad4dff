//! The live node without bus, threads and clock: a recording in simulated time.
//!
//! Messages arrive 5 ms after their capture, and each job takes 5 ms.
//!
//! ```text
//! cargo run --release --example live_core
//! ```

use std::collections::BTreeMap;
use std::error::Error;
use std::path::Path;

use bundlemocap::config::Config;
use bundlemocap::io::recording::Reader;
use bundlemocap::io::wire::{KeypointFrame, Rig, Schema};
use bundlemocap::live::{Content, Core, Input, Output};
use bundlemocap::{Decoder, Nanos, Solver, Timestamp};

const DELAY: Nanos = Nanos::from_ms(5);

fn main() -> Result<(), Box<dyn Error>> {
    let config = Config::default();
    let decoder = Decoder::embedded()?;
    let mut core = Core::new(config.core_settings(&decoder)?);
    let mut solver = Solver::new(decoder, config.tracker);

    // What happens, by time on the node's clock; the number keeps the order of what happens at one time.
    let mut happens: BTreeMap<(Timestamp, u64), Input> = BTreeMap::new();
    let mut number = 0;
    let mut add = |happens: &mut BTreeMap<_, _>, at: Timestamp, input: Input| {
        number += 1;
        happens.insert((at, number), input);
    };
    let mut reader = Reader::open(Path::new("recordings/walk.mcap"))?;
    while let Some(entry) = reader.next_raw() {
        let entry = entry?;
        if [Rig::FULL_NAME, KeypointFrame::FULL_NAME].contains(&&*entry.schema) {
            let message = Input::Message { topic: entry.topic, payload: entry.payload };
            add(&mut happens, entry.publish_time + DELAY, message);
        }
    }

    while let Some(((now, _), input)) = happens.pop_first() {
        core.handle(now, input);
        while let Some(output) = core.poll() {
            match output {
                Output::Wake(at) => add(&mut happens, at, Input::Tick),
                Output::Solve { performer, job, .. } => {
                    let solution = Box::new(solver.solve(&job));
                    let solved = Input::Solved { performer, solution, took: DELAY };
                    add(&mut happens, now + DELAY, solved);
                }
                // The calibration was published too; a node writes it to its file.
                Output::Mended { .. } | Output::Body { .. } => {}
                Output::Publish(publication) => {
                    if let (Content::Pose(pose), Some(due)) =
                        (&publication.content, publication.due)
                    {
                        let after = due - Timestamp::from_ns(pose.capture_time_ns);
                        println!(
                            "{} ns, {} ms later: {}",
                            pose.capture_time_ns,
                            after.ms(),
                            publication.topic
                        );
                    }
                }
            }
        }
        // The node watches its clock for ever; the recording has ended.
        if happens.values().all(|input| matches!(input, Input::Tick)) {
            break;
        }
    }
    Ok(())
}

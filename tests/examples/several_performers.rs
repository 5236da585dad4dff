//! Everybody in a recording, for programs with their own input, output and threads.
//!
//! ```text
//! cargo run --release -- synth --performers 3 --out crowd.mcap
//! cargo run --release --example several_performers -- crowd.mcap
//! ```

use std::error::Error;
use std::path::Path;
use std::sync::Arc;

use bundlemocap::core::stage::{Input, Output, Performers, Stage};
use bundlemocap::io::recording::{Message, Reader};
use bundlemocap::{Decoder, Rig, Solver, Tracker, TrackerConfig, core::tracker};

fn main() -> Result<(), Box<dyn Error>> {
    let path = std::env::args().nth(1).ok_or("usage: several_performers RECORDING")?;
    let config = TrackerConfig::default();
    let mut solver = Solver::new(Decoder::embedded()?, config);
    let mut stage: Option<(Stage, Arc<Rig>)> = None;
    for entry in Reader::open(Path::new(&path))? {
        match (entry?.message, &mut stage) {
            (Message::Rig(rig), None) => {
                let rig = Arc::new(rig.to_core()?);
                let tracker = Tracker::new(config, Arc::clone(&rig));
                stage = Some((Stage::new(tracker, Performers::Auto, None), rig));
            }
            (Message::Keypoints(frame), Some((stage, rig))) => {
                let detections = frame.to_core(|camera| rig.index_of(camera))?;
                drive(stage, &mut solver, Input::Detections(detections));
            }
            _ => {}
        }
    }
    let (mut stage, _) = stage.ok_or("the recording holds no rig")?;
    drive(&mut stage, &mut solver, Input::End);
    println!("{} performers", stage.trackers().len());
    Ok(())
}

/// Gives the stage an input, then solves what it asks for. A live program polls with `Stage::poll`,
/// solves jobs on other threads and returns them with `Stage::solved`.
fn drive(stage: &mut Stage, solver: &mut Solver, input: Input) {
    stage.handle(input);
    while let Some(output) = stage.poll_and_solve(|job| solver.solve(job)) {
        match output {
            Output::Performer(performer, tracker::Output::Pose(pose)) => {
                let [x, y, z] = pose.pose.root_position.into();
                println!("{performer} {} ns: pelvis at {x:.3} {y:.3} {z:.3} m", pose.capture.ns());
            }
            Output::Performer(performer, tracker::Output::Event(event)) => {
                println!("{performer} {}: {}", event.kind.name(), event.detail);
            }
            Output::Event(event) => println!("{}: {}", event.kind.name(), event.detail),
            _ => {}
        }
    }
}

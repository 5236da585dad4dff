//! The tracker's loop by hand, for programs with their own input, output and threads.
//!
//! ```text
//! cargo run --release --example track_loop
//! ```

use std::error::Error;
use std::path::Path;
use std::sync::Arc;

use bundlemocap::io::recording::{Message, Reader};
use bundlemocap::{Decoder, Input, Output, Rig, Solver, Tracker, TrackerConfig};

fn main() -> Result<(), Box<dyn Error>> {
    let config = TrackerConfig::default();
    let mut solver = Solver::new(Decoder::embedded()?, config);
    let mut tracker: Option<(Tracker, Arc<Rig>)> = None;
    for entry in Reader::open(Path::new("recordings/walk.mcap"))? {
        match (entry?.message, &mut tracker) {
            (Message::Rig(rig), None) => {
                let rig = Arc::new(rig.to_core()?);
                tracker = Some((Tracker::new(config, Arc::clone(&rig)), rig));
            }
            (Message::Keypoints(frame), Some((tracker, rig))) => {
                let detections = frame.to_core(|camera| rig.index_of(camera))?;
                drive(tracker, &mut solver, Input::Detections(detections));
            }
            _ => {}
        }
    }
    let (mut tracker, _) = tracker.ok_or("the recording holds no rig")?;
    drive(&mut tracker, &mut solver, Input::End);
    Ok(())
}

/// Gives the tracker an input, then does what it asks for until it asks for nothing more. A live
/// program solves the jobs on another thread and returns the solutions when they are ready.
fn drive(tracker: &mut Tracker, solver: &mut Solver, input: Input) {
    tracker.handle(input);
    while let Some(output) = tracker.poll() {
        match output {
            Output::Solve(job) => tracker.handle(Input::Solved(solver.solve(&job))),
            Output::Skeleton(_) => println!("the body is known"),
            Output::Pose(pose) => {
                let [x, y, z] = pose.pose.root_position.into();
                println!("{} ns: pelvis at {x:.3} {y:.3} {z:.3} m", pose.capture.ns());
            }
            Output::Event(event) => println!("{}: {}", event.kind.name(), event.detail),
            _ => {}
        }
    }
}

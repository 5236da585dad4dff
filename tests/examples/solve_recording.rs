//! Solves a recording and prints its summary:
//! `cargo run --release --example solve_recording -- recordings/walk.mcap`

use bundlemocap::core::body::{Skeleton, StampedPose};
use bundlemocap::offline::{self, Observer, Options, Recording};

/// Follows the pelvis.
struct Highest(f64);

impl Observer for Highest {
    fn pose(&mut self, _performer: &str, pose: &StampedPose, _skeleton: &Skeleton) {
        self.0 = self.0.max(pose.pose.root_position.y);
    }
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let path = std::env::args().nth(1).ok_or("give the path of a recording")?;
    let mut recording = Recording::open(&path)?;
    // With `out: Some(folder)` the poses are written too.
    let options = Options::default();
    let mut highest = Highest(f64::MIN);
    let summary = offline::solve(&mut recording, &options, &mut highest)?;
    println!("{summary}");
    println!("highest pelvis  {:.2} m", highest.0);
    Ok(())
}

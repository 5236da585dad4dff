//! Judges the cameras of a recording.
mod consensus;
mod footage;
mod reading;

pub use footage::Footage;
use crate::core::camera::Rig;
use consensus::Scene;
use reading::Reading;

/// debug
pub fn debug(footage: &Footage, rig: &Rig) {
    let t = std::time::Instant::now();
    let scene = Scene::new(footage, rig.cameras.iter().map(Reading::new).collect(), 60);
    let Some(consensus) = scene.agree() else { println!("no consensus"); return };
    println!("{:?} members {:?} total {:.2} rival {:.2}", t.elapsed(), consensus.members, consensus.total, consensus.rival);
    for (i, camera) in rig.cameras.iter().enumerate() {
        let points = scene.points(&consensus, Some(i));
        println!("  {} {:?}", camera.name, scene.fit(i, &scene.readings[i], &points));
    }
    println!("{:?}", t.elapsed());
}

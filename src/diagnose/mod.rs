//! Judges the cameras of a recording: what is wrong with their keypoints, calibrations and clocks, and
//! what would fix it.
//!
//! Pairs of cameras propose where the performer is; the largest set of cameras that agree is believed.
//! Known faults are undone on each other camera (its pixels, labels, calibration, time); the one
//! that makes it agree is named. If the cameras that agree are no majority, exchanged calibrations and
//! faults of all cameras are tried too. The fewest faults win that make most cameras agree on a performer
//! of human size, upright, with feet forwards. With two cameras nothing tells which one is wrong; all
//! that makes them agree is listed. If that is only a shift of the capture times, one of the two is named.
//!
//! [`Evidence`] is of one performer at some instants. Of several people, each camera's detection of the
//! performer is used; where there is none, everybody who is nobody else is kept, because a wrong camera
//! sees the performer in another place.

mod change;
mod clock;
mod consensus;
mod evidence;
mod exchange;
mod footage;
mod hypotheses;
mod judge;
mod order;
mod performer;
mod placement;
mod reading;
mod times;

pub use evidence::Evidence;
use footage::Footage;
pub use hypotheses::Finding;
pub(crate) use times::WrongTimes;

use std::fmt;

use serde::Serialize;

use crate::core::camera::Rig;
use crate::core::detections::KeypointFormat;
use consensus::Scene;
use judge::{Judged, judge};
use reading::Reading;

/// Instants at which cameras are compared.
const INSTANTS: usize = 60;
/// A camera of which fewer points agree fits loosely. That is no finding.
const LOOSELY_PERCENT: f64 = 60.0;
/// A check in which fewer points agree does not clear a camera that another check finds wrong.
const LEAST_PERCENT: f64 = 30.0;
/// Below this, a camera does not see the performer of the others.
const NONE_PERCENT: f64 = 10.0;
/// If no two cameras agree at more than this part of the times at which two see somebody, something is wrong.
const MOST_DISAGREEING: f64 = 0.15;
/// The order of the keypoints is wrong if another one makes the limbs this much less strange.
const LESS_STRANGE: f64 = 0.5;
/// Faults that only somebody who moves shows.
const MOTION: [&str; 5] = ["time_shift", "frame_rate", "frames_lost", "frames_added", "shuffled"];
/// Limbs of people are less strange than this.
const STRANGE: f64 = 0.35;

/// A recording's cameras, judged.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Check {
    /// The performer's height by trunk and legs, metres.
    pub performer_height_m: Option<f64>,
    /// Median direction from hips to shoulders, in the world.
    pub performer_up: Option<[f64; 3]>,
    /// In the rig's order.
    pub cameras: Vec<CameraCheck>,
    /// What is wrong with all cameras or the whole recording.
    pub findings: Vec<Finding>,
    /// How strange the performer's limbs are, see `performer::strangeness`.
    #[serde(skip)]
    strangeness: Option<f64>,
}

/// A camera, judged.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct CameraCheck {
    /// The camera.
    pub camera: String,
    /// Share of its points that are within 5 % of the performer's height of where the other cameras
    /// see them, percent.
    pub agreeing_percent: Option<f64>,
    /// Median distance of its points from where the others see them, pixels.
    pub error_px: Option<f64>,
    /// The same without its fault, if one is named.
    pub error_after_fix_px: Option<f64>,
    /// What is wrong; empty if it fits.
    pub findings: Vec<Finding>,
    /// Mean error, as a fraction of the performer's height in the image; large ones count as [`FAR`](consensus::FAR).
    #[serde(skip)]
    pub(crate) mean_error: Option<f64>,
    /// What is wrong with its capture times, if that is its fault.
    #[serde(skip)]
    pub(crate) times: Option<WrongTimes>,
    /// Whether it sees people, but hardly ever where the others see the performer.
    #[serde(skip)]
    sees_others: bool,
}

impl Check {
    /// Whether nothing is wrong.
    pub fn is_clean(&self) -> bool {
        self.warnings().next().is_none()
    }

    /// A line for each camera with something wrong, and one for each other finding.
    pub fn warnings(&self) -> impl Iterator<Item = String> {
        let wrong = self.cameras.iter().filter(|camera| !camera.findings.is_empty());
        let of_cameras =
            wrong.map(|camera| format!("camera {}: {}", camera.camera, camera.verdict()));
        let others = self.findings.iter().map(|Finding { what, fix, .. }| format!("{what}; {fix}"));
        of_cameras.chain(others)
    }

    /// What is wrong with all cameras or the whole recording, in words; empty: nothing was found.
    pub fn fault(&self) -> String {
        let texts = self.findings.iter().map(|Finding { what, fix, .. }| format!("{what}; {fix}"));
        texts.collect::<Vec<_>>().join("; ")
    }

    /// Whether a fault with this name concerns all cameras or the whole recording.
    pub fn finds(&self, cause: &str) -> bool {
        self.findings.iter().any(|finding| finding.cause == cause)
    }

    /// The unit of length of the calibration, metres, that would make the performer an adult. `None` if the
    /// performer is as high as people are, or no usual unit does. `read`: the unit with which it was read, metres.
    pub fn unit(&self, read: f64) -> Option<f64> {
        let metres = performer::unit(self.performer_height_m? / read)?.0;
        self.finds("scale").then_some(metres)
    }

    /// How far the performer's height is from the mean of adults: |ln(height / mean)|; infinite if it is not known.
    pub fn odd_height(&self) -> f64 {
        self.performer_height_m.map_or(f64::INFINITY, performer::oddness)
    }

    /// Number of cameras with a fault, and of faults of all cameras, without those of the calibration's unit and axis.
    fn faults(&self) -> usize {
        let of_world = ["scale", "up_axis"];
        let others = self.findings.iter().filter(|finding| !of_world.contains(&finding.cause));
        others.count() + self.cameras.iter().filter(|camera| !camera.findings.is_empty()).count()
    }

    /// How wrong the order of the keypoints seems, no unit; 0: nothing is wrong. Limbs that are not those of people count
    /// more than any number of faults.
    pub fn odd_order(&self) -> f64 {
        let strange = Some(self.strangeness.unwrap_or(STRANGE)).filter(|by| *by >= STRANGE);
        1000.0 * strange.unwrap_or(0.0) + self.faults() as f64
    }

    /// By camera of the rig, the camera whose images it has; `None` if they are not exchanged.
    pub fn exchanged(&self, rig: &Rig) -> Option<Vec<usize>> {
        let is_of = |camera: usize, found: &Finding| {
            hypotheses::is_another(&rig.cameras[camera].name) == *found
        };
        let of = |own: usize| {
            let findings = &self.cameras.get(own)?.findings;
            (0..rig.cameras.len()).find(|other| findings.iter().any(|one| is_of(*other, one)))
        };
        let named: Vec<Option<usize>> = (0..rig.cameras.len()).map(of).collect();
        let keeps = |own: usize| (!named.contains(&Some(own))).then_some(own);
        let mut all: Vec<Option<usize>> =
            named.iter().enumerate().map(|(own, of)| of.or_else(|| keeps(own))).collect();
        // What is left over belongs together, if it is one camera; cameras without images may be any.
        let is_seen = |own: &usize| self.cameras[*own].agreeing_percent.is_some();
        let mut alone: Vec<usize> = (0..all.len()).filter(|own| all[*own].is_none()).collect();
        if alone.iter().filter(|own| is_seen(own)).count() <= 1 {
            alone.sort_by_key(|own| !is_seen(own));
            for own in alone {
                all[own] = (0..all.len()).find(|camera| !all.contains(&Some(*camera)));
            }
        }
        let is_exchange = (0..all.len()).all(|camera| all.contains(&Some(camera)));
        (is_exchange && !all.is_sorted()).then(|| all.into_iter().flatten().collect())
    }

    /// Whether it names a fault that only somebody who moves shows.
    fn tells_of_motion(&self) -> bool {
        let mut findings = self.cameras.iter().flat_map(|camera| &camera.findings);
        findings.any(|finding| MOTION.contains(&finding.cause))
    }

    /// Whether it judges all cameras: nothing is wrong, and no camera sees others than the rest.
    fn is_of_all(&self) -> bool {
        self.is_clean() && self.cameras.iter().all(|camera| !camera.sees_others)
    }

    /// The cameras that agree on the performer.
    fn agreeing(&self) -> impl Iterator<Item = usize> {
        let cameras = self.cameras.iter().enumerate();
        cameras.filter(|(_, camera)| camera.agrees()).map(|(camera, _)| camera)
    }

    /// Combines the checks by several performers; the one who moves most is first. With a wrong calibration, one person may
    /// seem to be two performers in two places, each in other cameras. So a performer counts only if a camera that agrees on
    /// it agrees on the first one too, or on another one who counts. A camera that sees others, and agrees on nobody who
    /// counts, has a finding.
    fn of_performers(mut checks: Vec<Self>) -> Self {
        let mut all = checks.remove(0);
        let mut agreeing: Vec<usize> = all.agreeing().collect();
        let is_clean = all.is_clean();
        let see_others: Vec<bool> = all.cameras.iter().map(|camera| camera.sees_others).collect();
        let counts =
            |agreeing: &[usize], check: &Self| check.agreeing().any(|one| agreeing.contains(&one));
        while let Some(at) = checks.iter().position(|check| counts(&agreeing, check)) {
            let check = checks.remove(at);
            agreeing.extend(check.agreeing());
            if !is_clean {
                all = all.joined(check);
            }
        }
        for ((index, camera), sees_others) in all.cameras.iter_mut().enumerate().zip(see_others) {
            let is_apart = sees_others && !agreeing.contains(&index) && agreeing.len() > 1;
            if is_apart && camera.findings.is_empty() {
                // Its numbers come from cameras that are apart too.
                (camera.agreeing_percent, camera.error_px) = (None, None);
                camera.findings.push(Finding::new(
                    "apart",
                    "it sees people, but not where the other cameras see somebody",
                    "is its calibration of this take, is its clock right, and does it look at the same place?",
                ));
            }
        }
        all
    }

    /// Combines the checks by two performers. A camera that fits in one of them is right.
    fn joined(self, other: Self) -> Self {
        if self.findings.len() != other.findings.len() {
            return if self.findings.len() < other.findings.len() { self } else { other };
        }
        // A finding says more than a loose fit.
        let rank = |one: &CameraCheck| {
            let share = one.agreeing_percent.unwrap_or(0.0);
            (one.findings.is_empty() && share >= LEAST_PERCENT, !one.findings.is_empty(), share)
        };
        let both = self.cameras.into_iter().zip(other.cameras);
        let better = |(a, b)| if rank(&b) > rank(&a) { b } else { a };
        Self { cameras: both.map(better).collect(), ..self }
    }

    /// Whether the cameras agree on somebody.
    pub fn agrees(&self) -> bool {
        let is_judged = self.cameras.iter().any(|camera| camera.agreeing_percent.is_some());
        is_judged && !self.finds("disagree") && !self.finds("no_agreement")
    }
}

/// A line for each camera, then one for the performer and one for each other finding.
impl fmt::Display for Check {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let names = self.cameras.iter().map(|camera| camera.camera.chars().count());
        let width = names.max().unwrap_or(0).max("performer".len());
        let number = |value: Option<f64>, unit: &str| match value {
            Some(value) => format!("{value:.0} {unit}"),
            None => format!("- {unit}"),
        };
        for camera in &self.cameras {
            let [share, error] = [(camera.agreeing_percent, "%"), (camera.error_px, "px")]
                .map(|(value, unit)| number(value, unit));
            let judged = camera.verdict();
            writeln!(f, "{:<width$}  {share:>5}  {error:>7}  {judged}", camera.camera)?;
        }
        let height = self.performer_height_m;
        let height = height.map_or("not found".to_owned(), |height| format!("{height:.2} m high"));
        write!(f, "{:<width$}  {height}", "performer")?;
        for Finding { what, fix, .. } in &self.findings {
            write!(f, "\n{:<width$}  {what}; {fix}", "all")?;
        }
        Ok(())
    }
}

impl CameraCheck {
    /// Whether it was judged and nothing is wrong.
    pub fn fits(&self) -> bool {
        self.findings.is_empty()
            && self.agreeing_percent.is_some_and(|percent| percent >= LOOSELY_PERCENT)
    }

    /// Whether nothing is wrong with it, and some of its points fit.
    fn agrees(&self) -> bool {
        self.findings.is_empty() && self.agreeing_percent.unwrap_or(0.0) >= NONE_PERCENT
    }

    /// What is wrong with it, in words; empty: nothing was found.
    pub fn fault(&self) -> String {
        if self.findings.is_empty() { String::new() } else { self.verdict() }
    }

    /// The verdict in words.
    pub fn verdict(&self) -> String {
        if self.findings.is_empty() {
            let verdict = match self.agreeing_percent {
                None => "not judged",
                Some(percent) if percent < LOOSELY_PERCENT => "fits loosely, cause not found",
                Some(_) => "fits",
            };
            return verdict.to_owned();
        }
        let texts = self.findings.iter().map(|Finding { what, fix, .. }| format!("{what}; {fix}"));
        let fixed =
            self.error_after_fix_px.map_or(String::new(), |px| format!(" (then {px:.0} px)"));
        texts.collect::<Vec<_>>().join("; ") + &fixed
    }
}

/// Judges the cameras of a rig: by all their frames, with the largest people and with everybody, by the frames in which
/// somebody is `alone`, and by what they saw of one performer, where each may be anybody in its frame.
fn check(
    frames: &Footage,
    everybody: &Footage,
    alone: &Footage,
    footage: &Footage,
    rig: &Rig,
) -> Check {
    let mut scene = Scene::new(footage, rig.cameras.iter().map(Reading::new).collect(), INSTANTS);
    scene.start = frames.start(&rig.cameras);
    let mut cameras: Vec<CameraCheck> = (0..rig.cameras.len())
        .map(|camera| CameraCheck {
            camera: rig.cameras[camera].name.clone(),
            agreeing_percent: None,
            error_px: None,
            error_after_fix_px: None,
            findings: order::findings(frames, alone, &rig.cameras, camera),
            mean_error: None,
            times: None,
            sees_others: false,
        })
        .collect();
    let Some(mut judged) = judge(&scene, &rig.cameras) else {
        let finding = Finding::new(
            "no_agreement",
            "no two cameras agree on a person, whatever is tried",
            "is it the calibration of this take, and do the cameras share a clock?",
        );
        // With two cameras, a finding of one of them explains it.
        let is_explained = cameras.len() == 2 && cameras.iter().any(|row| !row.findings.is_empty());
        let findings = if is_explained { Vec::new() } else { vec![finding] };
        let (performer_height_m, performer_up, strangeness) = (None, None, None);
        return Check { performer_height_m, performer_up, cameras, findings, strangeness };
    };
    let times = change::find(&scene, &mut judged, &rig.cameras);
    let Judged { scene: fixed, consensus, findings, general } = &judged;
    for (camera, row) in cameras.iter_mut().enumerate() {
        let points = fixed.points(consensus, Some(camera));
        let fit = |scene: &Scene| fixed.fit(camera, &scene.readings[camera], &points);
        // A fault of all cameras is no camera's own.
        if let Some(fit) = fit(if general.is_empty() { &scene } else { fixed }) {
            // Errors behind the camera are infinite.
            row.error_px = Some(fit.px).filter(|px| px.is_finite());
            row.agreeing_percent = Some(100.0 * fit.share);
            row.mean_error = Some(fit.mean);
        }
        if row.findings.is_empty() && !row.agrees() {
            let everybody = Scene { footage: everybody, ..fixed.clone() };
            row.sees_others = everybody.sees_others(camera, &points);
        }
        if row.findings.is_empty() && !consensus.members[camera] {
            let is_member = |other: usize| consensus.members[other];
            row.findings.extend(order::away(frames, &rig.cameras, camera, is_member));
        }
        // A camera whose frames are wrong by themselves disagrees because of that.
        if let Some(finding) = findings[camera].as_ref().filter(|_| row.findings.is_empty()) {
            row.findings.push(finding.clone());
            row.times = times[camera];
            let fixed_px = fit(fixed).map(|fit| fit.px);
            // A fault of a part of the recording is not undone.
            let is_less = |px: &f64| row.error_px.is_none_or(|now| *px < now);
            row.error_after_fix_px = fixed_px.filter(|px| px.is_finite() && is_less(px));
        }
    }
    let points = fixed.points(consensus, None);
    let mut general = general.clone();
    if general.is_empty() && cameras.iter().all(|row| row.findings.is_empty()) {
        general.extend(disagreeing(fixed, consensus));
    }
    // Two cameras that disagree show no performer.
    if general.iter().all(|finding| finding.cause != "disagree") {
        general.extend(performer::findings(&points, consensus.count()));
    }
    let strangeness = performer::strangeness(&points);
    if let Some(finding) = strangeness.and_then(|now| wrong_format(fixed, consensus, now)) {
        general = vec![finding];
    }
    let (performer_height_m, performer_up) = (performer::height_m(&points), performer::up(&points));
    Check { performer_height_m, performer_up, cameras, findings: general, strangeness }
}

/// No two cameras agree in a part of the recording, although they see somebody.
fn disagreeing(scene: &Scene, consensus: &consensus::Consensus) -> Option<Finding> {
    let [none, all] = scene.disagreeing(consensus);
    (none as f64 > MOST_DISAGREEING * all as f64).then(|| {
        let share = 100 * none / all.max(1);
        let what =
            format!("no two cameras agree at {share} % of the times at which two see somebody");
        Finding::new("disagree_at_times", what, "was a camera moved, or is it another person?")
    })
}

/// Whether the limbs are less strange in the order of another format with as many points. `now`: how strange they are.
fn wrong_format(scene: &Scene, consensus: &consensus::Consensus, now: f64) -> Option<Finding> {
    let declared =
        scene.footage.tracks.iter().find_map(|track| Some(track.frames.first()?.format))?;
    let others = KeypointFormat::ALL.into_iter();
    let others = others.filter(|other| *other != declared && other.len() == declared.len());
    others.into_iter().find_map(|other| {
        let format = Some(other);
        let readings = scene.readings.iter().map(|reading| Reading { format, ..reading.clone() });
        let scene = scene.with(readings.collect());
        let then = performer::strangeness(&scene.points(consensus, None))?;
        (then < LESS_STRANGE * now && now > STRANGE).then(|| {
            let [declared, other] = [declared.name(), other.name()];
            let what = format!("the keypoints are in the order of {other}, not of {declared}");
            Finding::new("keypoint_order", what, format!("import with --format {other}"))
        })
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Four cameras; these agree on a performer, and these see others.
    fn check(agreeing: [usize; 2], others: &[usize]) -> Check {
        let camera = |index: usize| CameraCheck {
            camera: format!("cam{index}"),
            agreeing_percent: agreeing.contains(&index).then_some(90.0),
            error_px: None,
            error_after_fix_px: None,
            findings: Vec::new(),
            mean_error: None,
            times: None,
            sees_others: others.contains(&index),
        };
        let cameras = (0..4).map(camera).collect();
        let (performer_height_m, performer_up, strangeness) = (None, None, None);
        Check { performer_height_m, performer_up, cameras, findings: Vec::new(), strangeness }
    }

    #[test]
    fn cameras_that_share_no_performer_with_the_first_ones_are_apart() {
        let named = |checks: Vec<Check>| -> Vec<usize> {
            let cameras = Check::of_performers(checks).cameras;
            let is_named = |index: &usize| {
                cameras[*index].findings.iter().any(|finding| finding.cause == "apart")
            };
            (0..4).filter(is_named).collect()
        };
        let (mover, other) = (check([0, 1], &[2, 3]), check([2, 3], &[]));
        assert_eq!(named(vec![mover.clone(), other.clone()]), [2, 3]);
        // A third performer is in both pairs of cameras.
        assert!(named(vec![mover, other.clone(), check([1, 2], &[])]).is_empty());
        // They look at another place.
        assert!(named(vec![check([0, 1], &[]), other]).is_empty());
    }
}

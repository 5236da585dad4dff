//! The results of one performer.

use std::collections::BTreeMap;

use super::Error;
use super::driver::State;
use super::hold_out::{HeldOut, HoldOut};
use super::options::Observer;
use super::poses::{Comparisons, PoseSummary, Poses};
use super::recording::Recording;
use super::summary::{DeviationPercentiles, Reprojection, SolveTime, Summary};
use super::windows::Windows;
use crate::core::body::Skeleton;
use crate::core::camera::Rig;
use crate::core::time::Timestamp;
use crate::core::tracker::{EventKind, Output};
use crate::diagnose::Check;

/// The results of a solve for one performer.
pub(super) struct Collected {
    /// Name of the performer.
    pub(super) name: String,
    pub(super) poses: Poses,
    pub(super) windows: Windows,
    pub(super) events: BTreeMap<EventKind, u64>,
    pub(super) comparisons: Comparisons,
}

impl Collected {
    /// Takes an output of the performer.
    pub(super) fn add(
        &mut self,
        output: &Output,
        state: &State,
        observer: &mut dyn Observer,
    ) -> Result<(), Error> {
        match output {
            Output::Pose(pose) => {
                let Some(skeleton) = &state.skeleton else { return Ok(()) };
                observer.pose(&self.name, pose, skeleton);
                self.poses.add(pose.as_ref().into(), skeleton, &mut self.comparisons)?;
            }
            Output::Event(event) => *self.events.entry(event.kind).or_default() += event.count,
            Output::Window(report) => self.windows.add(report, state.window_solve),
            Output::Skeleton(_)
            | Output::Keyframe(_)
            | Output::Solve(_)
            | Output::HandOver(_)
            | Output::Placed { .. } => {}
        }
        Ok(())
    }

    fn count(&self, kind: EventKind) -> u64 {
        self.events.get(&kind).copied().unwrap_or(0)
    }

    pub(super) fn summarise(
        mut self,
        recording: &Recording,
        rig: &Rig,
        skeleton: &Skeleton,
        poses: PoseSummary,
        seconds: f64,
        is_alone: bool,
    ) -> (Self, Summary) {
        let comparisons = std::mem::take(&mut self.comparisons);
        let held_out: Vec<HoldOut> =
            comparisons.held_out.into_iter().map(HeldOut::finish).collect();
        let frames = self.poses.count;
        let most_mm = if is_alone { f64::INFINITY } else { SOMEBODY_ELSE_MM };
        let truth = poses.fps.and_then(|fps| comparisons.truths.nearest(skeleton, fps, most_mm));
        let (truth, true_skate) = truth.unzip();
        let references = comparisons.references.iter().filter_map(|reference| reference.finish());
        let summary = Summary {
            version: env!("CARGO_PKG_VERSION"),
            recording: recording.path().display().to_string(),
            first_capture_time_ns: self.poses.start.map(Timestamp::ns),
            frames_recorded: 0,
            frames,
            frames_lost: self.poses.flagged,
            windows: self.windows.count,
            lost: self.windows.lost,
            hidden: self.windows.hidden,
            windows_without_performer: self.count(EventKind::NobodyFound),
            frame_rate_hz: poses.fps,
            reprojection: Reprojection::new(&self.windows, rig),
            hold_out: HoldOut::of_all(&held_out),
            hold_out_cameras: held_out,
            mean_acceleration_m_s2: poses.acceleration,
            not_followed: std::mem::take(&mut self.windows.followed).finish(),
            foot_skate: true_skate.unwrap_or(poses.feet),
            floor_m: poses.floor,
            joint_deviation: DeviationPercentiles::new(&self.poses),
            truth,
            reference: references.min_by(|a, b| a.mean_mm.total_cmp(&b.mean_mm)),
            solve_ms: SolveTime::new(&self.windows),
            frames_per_second: frames as f64 / seconds.max(1e-9),
            events: EventKind::ALL.map(|kind| (kind.name(), self.count(kind))).into(),
            damage: recording.losses(),
            time_offsets: Vec::new(),
            check: None,
            notes: poses.note.into_iter().collect(),
        };
        (self, summary)
    }
}

/// Of several performers, one who is farther from a true one is somebody else.
const SOMEBODY_ELSE_MM: f64 = 500.0;
/// Among several people, a performer may need so many frames to be found.
const FEW_FRAMES: u64 = 10;

/// The error if no performer was found. `others`: most people at a time who were seen and are not performers.
pub(super) fn nobody(
    all: &[Collected],
    recording: &Recording,
    rig: &Rig,
    check: &Check,
    others: usize,
    is_several: bool,
) -> Error {
    let count = |kind| all.iter().map(|one| one.count(kind)).sum::<u64>();
    let path = recording.path().to_owned();
    if others > 0 && count(EventKind::Entered) + count(EventKind::Reentered) == 0 {
        let evidence = format!(
            "people were seen, at most {others} at a time, but [stage] only, region or min_height_px excludes \
             all of them; change these settings"
        );
        return Error::NobodyFound { path, evidence };
    }
    let lost = all.iter().map(|one| one.windows.lost as u64).sum::<u64>();
    let (tried, frames) = (count(EventKind::NobodyFound) + lost, recording.frames());
    if is_several && tried == 0 && frames < FEW_FRAMES {
        let evidence = format!(
            "it has {frames} frames of a camera, too few to tell who is a performer; with one performer, a frame is \
             enough"
        );
        return Error::NobodyFound { path, evidence };
    }
    let unusable = match count(EventKind::Unusable) {
        0 => String::new(),
        unusable => format!(", {unusable} frames could not be used"),
    };
    let evidence = format!(
        "no performer is seen by two of the {} cameras at once ({} windows tried{unusable}{}); \
         check the calibration, the keypoint format ({}) and that the cameras share a clock",
        rig.cameras.len(),
        tried,
        out_of_time(count(EventKind::Late), count(EventKind::Duplicate)),
        recording.format(),
    );
    let found = check.warnings().map(|warning| format!("; {warning}"));
    let evidence = found.fold(evidence, |all, warning| all + &warning);
    Error::NobodyFound { path, evidence }
}

/// A note on the frames of a recording that is not sorted by capture time.
fn out_of_time(late: u64, duplicate: u64) -> String {
    if late == 0 && duplicate == 0 {
        return String::new();
    }
    format!(
        ", {late} frames came late and {duplicate} came twice; they were not used: is the recording \
         sorted by capture time?"
    )
}

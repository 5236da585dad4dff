//! Processes the poses of a solve one by one.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use super::Error;
use super::bvh::{BvhFile, States};
use super::compact_pose::CompactPose;
use super::hold_out::HeldOut;
use super::reference::{FrameClock, ReferenceComparison};
use super::series::{Bin, Mean, Series};
use super::truth::TruthComparisons;
use crate::core::body::{JOINTS, Skeleton};
use crate::core::time::Timestamp;
use crate::io::formats::Style;
use crate::io::report::{BENT, PlayerPose, flexion_deg};
use crate::metrics::statistics::median;
use crate::metrics::{Distribution, Floor, FootSkate, FootSkateSums, MeanAcceleration};

/// Number of first poses that give the frame rate; they wait in memory until then.
const HEAD: usize = 4096;
/// Frame rate of a single pose, hertz.
const FALLBACK_FPS: f64 = 60.0;
/// Most poses of all performers that play in the report: 36 minutes of one at 60 Hz, fewer a second of a longer
/// take. So many take 34 MB in report.html.
pub(super) const PLAYED: usize = 1 << 17;

impl Bin for CompactPose {
    /// The first pose is kept.
    fn merge(&mut self, _next: Self) {}
}

impl Bin for PlayerPose {
    /// The first pose is kept.
    fn merge(&mut self, _next: Self) {}
}

/// The comparisons that wait for poses, and their inputs.
#[derive(Default)]
pub(super) struct Comparisons {
    pub(super) truths: TruthComparisons,
    pub(super) held_out: Vec<HeldOut>,
    pub(super) references: Vec<ReferenceComparison>,
    /// The newest frame of the camera whose frame numbers are those of the recording.
    pub(super) clock: Option<FrameClock>,
}

/// The poses of a solve: counted, compared, and written as BVH.
#[derive(Default)]
pub(super) struct Poses {
    bvh_path: Option<PathBuf>,
    /// The first capture time of the recording.
    pub(super) start: Option<Timestamp>,
    /// The newest pose; another of the same time replaces it.
    newest: Option<CompactPose>,
    /// The poses before it, until the frame rate is known.
    head: Vec<CompactPose>,
    body: Option<Stream>,
    pub(super) count: usize,
    /// Number of poses that are not tracked.
    pub(super) flagged: usize,
    /// Poses for the stick figures.
    pub(super) shown: Series<CompactPose>,
    /// Poses that play in the report.
    pub(super) played: Series<PlayerPose>,
    /// Flexion of the joints [`BENT`], degrees.
    pub(super) angles: [Series<Mean<Timestamp, 1>>; BENT.len()],
    /// Standard deviations of the joint centres, metres: their mean and the largest.
    pub(super) deviations: Series<Mean<Timestamp, 2>>,
    /// Of every joint in every pose, millimetres.
    pub(super) deviations_mm: Distribution,
}

/// The consumers that need the frame rate.
struct Stream {
    fps: f64,
    acceleration: MeanAcceleration,
    feet: FootSkateSums,
    floor: Floor,
    bvh: Option<BvhFile>,
}

/// The results over all poses.
#[derive(Default)]
pub(super) struct PoseSummary {
    /// `None` for fewer than two poses.
    pub(super) fps: Option<f64>,
    pub(super) acceleration: Option<f64>,
    /// With contacts by the poses themselves.
    pub(super) feet: Option<FootSkate>,
    pub(super) floor: Option<f64>,
    pub(super) states: States,
    pub(super) note: Option<String>,
}

impl Poses {
    /// Written as BVH to a path, if given. At most `played` poses are kept for the report.
    pub(super) fn new(bvh_path: Option<PathBuf>, played: usize) -> Self {
        Self { bvh_path, played: Series::up_to(played), ..Self::default() }
    }

    /// Whether any pose can be used.
    pub(super) fn found_somebody(&self) -> bool {
        self.count + usize::from(self.newest.is_some()) + self.head.len() > self.all_flagged()
    }

    fn all_flagged(&self) -> usize {
        let waiting = self.head.iter().chain(&self.newest);
        self.flagged + waiting.filter(|pose| !pose.is_tracked()).count()
    }

    /// Adds a pose. Poses are in order of capture time.
    pub(super) fn add(
        &mut self,
        pose: CompactPose,
        skeleton: &Arc<Skeleton>,
        comparisons: &mut Comparisons,
    ) -> Result<(), Error> {
        match self.newest.replace(pose) {
            Some(before)
                if self.newest.as_ref().is_some_and(|new| new.capture != before.capture) =>
            {
                self.settled(before, skeleton, comparisons)
            }
            _ => Ok(()),
        }
    }

    /// Adds a pose that will not be replaced.
    fn settled(
        &mut self,
        pose: CompactPose,
        skeleton: &Arc<Skeleton>,
        comparisons: &mut Comparisons,
    ) -> Result<(), Error> {
        if self.body.is_some() {
            return self.stream(&pose, skeleton, comparisons);
        }
        self.head.push(pose);
        if self.head.len() == HEAD { self.begin(skeleton, comparisons) } else { Ok(()) }
    }

    /// Computes the frame rate and adds the poses that waited for it.
    fn begin(
        &mut self,
        skeleton: &Arc<Skeleton>,
        comparisons: &mut Comparisons,
    ) -> Result<(), Error> {
        let head = std::mem::take(&mut self.head);
        let fps = frame_rate(&head);
        let style = Style::default();
        let create = |path: &PathBuf| BvhFile::create(path, skeleton, fps, self.start, &style);
        let bvh = self.bvh_path.as_ref().map(create).transpose()?;
        let (acceleration, feet) = (MeanAcceleration::new(fps), FootSkateSums::new(fps));
        self.body = Some(Stream { fps, acceleration, feet, floor: Floor::default(), bvh });
        head.iter().try_for_each(|pose| self.stream(pose, skeleton, comparisons))
    }

    fn stream(
        &mut self,
        pose: &CompactPose,
        skeleton: &Arc<Skeleton>,
        comparisons: &mut Comparisons,
    ) -> Result<(), Error> {
        let Some(body) = &mut self.body else { return Ok(()) };
        self.count += 1;
        self.flagged += usize::from(!pose.is_tracked());
        let (capture, full) = (pose.capture, pose.pose());
        let posture = full.posture(skeleton);
        for (joint, series) in BENT.into_iter().zip(&mut self.angles) {
            if let Some(degrees) = flexion_deg(&posture.positions, joint) {
                series.push(Mean::new(capture, [degrees]));
            }
        }
        if let Some(deviations) = pose.deviations() {
            let mean = deviations.iter().sum::<f64>() / JOINTS as f64;
            let most = deviations.iter().copied().fold(0.0, f64::max);
            self.deviations.push(Mean::new(capture, [mean, most]));
            deviations.iter().for_each(|metres| self.deviations_mm.add(1e3 * metres));
        }
        match pose.is_tracked() {
            true => {
                body.feet.add(&posture, None);
                body.floor.add(&posture, skeleton, body.fps);
            }
            false => {
                body.feet.gap();
                body.floor.gap();
            }
        }
        self.played.push(PlayerPose::new(capture, pose.state, &full));
        body.acceleration.add(capture, pose.is_tracked().then_some(posture));
        if let Some(bvh) = &mut body.bvh {
            bvh.write(pose)?;
        }
        comparisons.truths.add_pose(pose, skeleton, body.fps);
        for held_out in &mut comparisons.held_out {
            held_out.add_pose(capture, pose.usable(), skeleton);
        }
        if let (Some(clock), Some(pose)) = (comparisons.clock, pose.usable())
            && !comparisons.references.is_empty()
        {
            let posture = pose.posture(skeleton);
            let frame = clock.frame_at(capture, body.fps);
            for reference in &mut comparisons.references {
                reference.add(frame, body.fps, &(&**skeleton, &posture));
            }
        }
        self.shown.push(pose.clone());
        Ok(())
    }

    /// Adds the waiting poses and completes the BVH file.
    pub(super) fn finish(
        &mut self,
        skeleton: &Arc<Skeleton>,
        comparisons: &mut Comparisons,
    ) -> Result<PoseSummary, Error> {
        if let Some(pose) = self.newest.take() {
            self.settled(pose, skeleton, comparisons)?;
        }
        if self.body.is_none() {
            self.begin(skeleton, comparisons)?;
        }
        let Some(Stream { fps, acceleration, feet, floor, bvh }) = self.body.take() else {
            return Ok(PoseSummary::default());
        };
        let path = self.bvh_path.as_deref().unwrap_or(Path::new(""));
        let (states, note) = match bvh {
            Some(bvh) => bvh.finish(path)?,
            None => Default::default(),
        };
        let several = self.count > 1;
        let (acceleration, feet, floor) = (acceleration.mean(), feet.finish(), floor.height());
        Ok(PoseSummary { fps: several.then_some(fps), acceleration, feet, floor, states, note })
    }
}

/// Poses per second, from the median interval; 60 for fewer than two poses.
pub(crate) fn frame_rate(poses: &[CompactPose]) -> f64 {
    rate(&poses.iter().map(|pose| pose.capture).collect::<Vec<_>>())
}

/// As [`frame_rate`], from capture times in order.
pub(crate) fn rate(captures: &[Timestamp]) -> f64 {
    let periods: Vec<f64> =
        captures.windows(2).map(|pair| (pair[1] - pair[0]).ns() as f64).collect();
    let Some(period) = median(&periods).filter(|period| *period > 0.0) else {
        return FALLBACK_FPS;
    };
    let rate = 1e9 / period;
    // Capture times are whole nanoseconds: 60 frames/s look like 59.9999988.
    let usual = [rate.round(), (1.001 * rate).round() / 1.001];
    usual.into_iter().find(|usual| (1e9 / usual - period).abs() < 1.0).unwrap_or(rate)
}

//! How poses are changed, and how they are written.

use std::str::FromStr;

use clap::builder::{PossibleValuesParser, TypedValueParser};
use clap::{Args, ValueEnum};

use super::{Format, ON_FRAME};
use crate::cli::failure::{Exit, Failure, ratio};
use crate::core::body::{JointDeviations, StampedPose, TrackingState};
use crate::core::time::{Nanos, Timestamp};
use crate::io::formats::{JointAxes, JointNames, RestPose, Style, Unit, Up};
use crate::offline::Motion;
use crate::offline::compact_pose::CompactPose;

/// Poses further apart than this are on two sides of a gap, periods.
const GAP_PERIODS: f64 = 1.5;

/// Reads a value of an enum by its name, as `named!` gives it.
macro_rules! one_of {
    ($Enum:ty) => {
        // Other names are refused before.
        PossibleValuesParser::new(<$Enum>::ALL.map(<$Enum>::name))
            .map(|name| <$Enum>::from_name(&name).unwrap_or_default())
    };
}

/// How poses are changed before they are written.
#[derive(Debug, Args)]
#[command(next_help_heading = "Options of files")]
pub(in crate::cli) struct Changes {
    /// Frames per second: poses are interpolated; default: those of the recording.
    #[arg(long, value_name = "HZ", value_parser = rate)]
    fps: Option<f64>,
    /// Leave out the movement over the floor: the pelvis stays above the origin.
    #[arg(long)]
    in_place: bool,
    /// What becomes of poses that are lost or coasting: too little was seen, or they did not fit.
    #[arg(long, value_enum, default_value_t = Lost::Keep)]
    pub(in crate::cli) lost: Lost,
}

/// How poses are written.
#[derive(Debug, Args)]
#[command(next_help_heading = "Options of files")]
pub(super) struct Options {
    #[command(flatten)]
    pub(super) changes: Changes,
    /// The pose in which all rotations are zero: T, A with the arms 45 degrees lower, or N with hanging
    /// arms (.glb .usda .bvh .csv).
    #[arg(long, value_name = "POSE", default_value = "t", value_parser =
        one_of!(RestPose))]
    rest: RestPose,
    /// Names of the joints (.glb .usda .bvh .csv).
    #[arg(long, value_name = "WHOSE", default_value = "ours", value_parser =
        one_of!(JointNames))]
    names: JointNames,
    /// Axes of the joints in that pose: y along the bone, or those of the world (.glb .usda).
    #[arg(long, value_name = "AXES", default_value = "bone", value_parser =
        one_of!(JointAxes))]
    axes: JointAxes,
    /// Axis that points up (.bvh .trc .c3d .csv); with z, (x, y, z) becomes (z, x, y).
    #[arg(long, value_name = "AXIS", default_value = "y", value_parser =
        PossibleValuesParser::new(["y", "z"]).try_map(|name| Up::from_str(&name)))]
    up: Up,
    /// Unit of length (.bvh .trc .c3d); default: the usual one of the format.
    #[arg(long, value_parser =
        PossibleValuesParser::new(["m", "cm", "mm"]).try_map(|name| Unit::from_str(&name)))]
    unit: Option<Unit>,
}

/// What becomes of poses that are not tracked.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(in crate::cli) enum Lost {
    /// Written like others; .csv and .npz say which they are. In .trc and .c3d they are empty.
    Keep,
    /// The same, and beside each .bvh, .glb, .usda and .mot a .states.csv says which they are.
    Mark,
    /// Left out, as if nothing had been solved there.
    Skip,
}

fn rate(text: &str) -> Result<f64, String> {
    match ratio(text) {
        Ok(fps) if (0.1..=1000.0).contains(&fps) => Ok(fps),
        _ => Err("give 0.1 to 1000, such as 30 or 30000/1001".into()),
    }
}

impl Options {
    pub(super) fn style(&self) -> Style {
        let mut style = Style::new(self.rest, self.up);
        (style.names, style.unit, style.joint_axes) = (self.names, self.unit, self.axes);
        style
    }

    /// Fails if an option has no meaning for a format.
    pub(super) fn check(&self, format: Format) -> Result<(), Failure> {
        use Format::{Angles, Bvh, C3d, Csv, Glb, Mot, Npz, Trc, Usda};
        let [animations, markers]: [&[Format]; 2] = [&[Glb, Usda, Bvh, Csv], &[Bvh, Trc, C3d]];
        let options: [(&str, bool, &[Format]); 6] = [
            ("--axes", self.axes != JointAxes::Bone, &[Glb, Usda]),
            ("--rest", self.rest != RestPose::T, animations),
            ("--names", self.names != JointNames::Ours, animations),
            ("--up", self.up != Up::Y, &[Bvh, Trc, C3d, Csv]),
            ("--unit", self.unit.is_some(), markers),
            (
                "--lost mark",
                self.changes.lost == Lost::Mark,
                &[Bvh, Glb, Usda, Mot, Csv, Angles, Npz, Trc, C3d],
            ),
        ];
        let wrong = options.iter().find(|(_, given, of)| *given && !of.contains(&format));
        wrong.map_or(Ok(()), |(option, _, of)| {
            let names = of.iter().map(|format| format!(".{}", format.name()));
            let names = names.collect::<Vec<_>>().join(", ");
            let format = format.name();
            let message =
                format!(".{format}: {option} is for {names}; export this file without it");
            Err(Failure::new(Exit::Usage, message))
        })
    }
}

impl Changes {
    /// Whether the files have another frame rate.
    pub(super) fn is_resampled(&self) -> bool {
        self.fps.is_some()
    }

    /// Whether one of them changes the poses.
    pub(super) fn changes_poses(&self) -> bool {
        self.fps.is_some() || self.in_place || self.lost == Lost::Skip
    }

    /// Whether one of them is given.
    pub(in crate::cli) fn is_given(&self) -> bool {
        self.changes_poses() || self.lost != Lost::Keep
    }

    /// A note on poses that are in the files and not tracked, unless the files say which.
    pub(in crate::cli) fn note_lost(&self, one: &Motion) -> Option<String> {
        let lost = one.poses.iter().filter(|pose| !pose.is_tracked()).count();
        let what =
            "poses are coasting or lost; --lost mark lists them, --lost skip leaves them out";
        (lost > 0 && self.lost == Lost::Keep)
            .then(|| format!("{}: {lost} of {} {what}", one.actor, one.poses.len()))
    }

    /// The poses as the files have them; `start`: the time of the files' first frame, `fps`: frames per
    /// second of the poses. Returns them with their new frame rate.
    pub(super) fn apply(
        &self,
        mut poses: Vec<CompactPose>,
        start: Timestamp,
        fps: f64,
    ) -> (Vec<CompactPose>, f64) {
        if self.lost == Lost::Skip {
            poses.retain(CompactPose::is_tracked);
        }
        if let Some(wanted) = self.fps {
            poses = resampled(&poses, start, fps, wanted);
        }
        if self.in_place {
            for pose in &mut poses {
                (pose.root_position.x, pose.root_position.z) = (0.0, 0.0);
            }
        }
        (poses, self.fps.unwrap_or(fps))
    }
}

/// The poses at `start` + k / `wanted`, interpolated; none in a gap.
fn resampled(poses: &[CompactPose], start: Timestamp, fps: f64, wanted: f64) -> Vec<CompactPose> {
    let mut found = Vec::new();
    let same = ON_FRAME / fps;
    for (index, pose) in poses.iter().enumerate() {
        let apart = |after: &CompactPose| after.capture.seconds_since(pose.capture);
        let after = poses.get(index + 1).filter(|after| apart(after) * fps <= GAP_PERIODS);
        let end = after.map_or(same, |after| apart(after) - same);
        let first = (pose.capture.seconds_since(start) - same) * wanted;
        for k in first.ceil() as i64.. {
            let at = start + Nanos::rounded(k as f64 / wanted * 1e9);
            let since = at.seconds_since(pose.capture);
            if since >= end {
                break;
            }
            found.push(match after {
                Some(after) if since > same => between(pose, after, at, since / apart(after)),
                _ => pose.at(at),
            });
        }
    }
    found
}

/// The pose at `s` on the way from one to the next, as sure as the less sure of them.
fn between(from: &CompactPose, to: &CompactPose, at: Timestamp, s: f64) -> CompactPose {
    let rank = |state| TrackingState::ALL.iter().position(|one| *one == state);
    let state = if rank(from.state) < rank(to.state) { to.state } else { from.state };
    let pose = from.pose().interpolate(&to.pose(), s);
    let larger =
        |(a, b): (JointDeviations, JointDeviations)| std::array::from_fn(|j| a[j].max(b[j]));
    let deviations = from.deviations().zip(to.deviations()).map(larger);
    (&StampedPose { deviations, ..StampedPose::new(at, pose, state) }).into()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::offline::compact_pose::tests::{in_state, tracked};

    fn at(poses: &[CompactPose]) -> Vec<(i64, f64)> {
        let of = |pose: &CompactPose| (pose.capture.ns() / 1_000_000, pose.root_position.x);
        poses.iter().map(of).map(|(ms, x)| (ms, (x * 1e6).round() / 1e6)).collect()
    }

    #[test]
    fn poses_are_interpolated_at_even_times_and_not_in_gaps() {
        let ms = |ms: i64, x: f64| tracked(ms * 1_000_000, x);
        let poses = [ms(20, 2.0), ms(40, 4.0), ms(60, 6.0), ms(120, 12.0), ms(140, 14.0)];
        let start = Timestamp::default();
        let resampled = |fps| at(&resampled(&poses, start, 50.0, fps));
        assert_eq!(resampled(25.0), [(40, 4.0), (120, 12.0)]);
        let doubled = [(20, 2.0), (30, 3.0), (40, 4.0), (50, 5.0), (60, 6.0)];
        let after = [(120, 12.0), (130, 13.0), (140, 14.0)];
        assert_eq!(resampled(100.0), [&doubled[..], &after].concat());
        // Times that are rounded to nanoseconds are those of the poses.
        let rounded: Vec<_> = (0..60).map(|k| tracked(k * 1_000_000_000 / 60, k as f64)).collect();
        let same = super::resampled(&rounded, start, 60.0, 60.0);
        assert!(same.len() == 60 && same[59].root_position.x == 59.0);
    }

    #[test]
    fn an_interpolated_pose_is_as_sure_as_the_less_sure_of_two() {
        let poses = [tracked(0, 0.0), in_state(20_000_000, 1.0, TrackingState::Lost)];
        let found = resampled(&poses, Timestamp::default(), 50.0, 100.0);
        let states: Vec<_> = found.iter().map(|pose| pose.state).collect();
        assert_eq!(states, [TrackingState::Tracking, TrackingState::Lost, TrackingState::Lost]);
        assert!(found[1].deviations().is_some());
    }
}

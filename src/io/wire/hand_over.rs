//! Converts `HandOver` to and from [`tracker::HandOver`].

use std::ops::RangeInclusive;
use std::sync::Arc;

use super::check::{Field, field};
use super::{BodyEstimate, DecodeError, HandOver, Keyframe, TIMES_NS};
use crate::core::body::{BODY_COEFFICIENTS, Skeleton, TrackingState};
use crate::core::manifold::{Interpolation, StampedKeyframe, TimedKeyframe};
use crate::core::time::{Grid, Timestamp};
use crate::core::tracker::{self, BodyEstimator, EstimateNumbers, Motion, Noise};

const fn at(name: &'static str) -> Field {
    field("HandOver", name)
}

/// Most keyframes that are not final.
const MOST_AHEAD: usize = 1000;
/// Frame periods: of 1000 to 1 frame a second, nanoseconds.
const PERIODS_NS: RangeInclusive<f64> = 1e6..=1e9;
/// Most windows of a run.
const MOST_WINDOWS: u64 = 1 << 53;

fn time(name: &'static str, ns: i64) -> Result<Timestamp, DecodeError> {
    let is_time = TIMES_NS.contains(&ns);
    is_time.then(|| Timestamp::from_ns(ns)).ok_or_else(|| at(name).invalid("is no capture time"))
}

impl HandOver {
    /// The state of a performer, by number from 0, whom `solver` solves. `weights` is the fingerprint of the decoder's
    /// weights.
    pub fn from_core(
        performer: usize,
        solver: &str,
        state: &tracker::HandOver,
        weights: &str,
    ) -> Self {
        let numbers = state.estimate.numbers();
        let mut message = Self {
            performer: performer as u32,
            solver: solver.to_owned(),
            until_ns: state.until.ns(),
            window: state.window,
            body: state.skeleton.iter().flat_map(|body| body.coefficients()).collect(),
            body_estimate: Some(BodyEstimate {
                windows: numbers.windows as u32,
                is_check: numbers.is_check,
                coefficients: numbers.coefficients,
                information: numbers.information,
                pull: numbers.pull,
                other_take: numbers.other_take,
            }),
            ..Self::default()
        };
        let (Some(motion), Some(skeleton)) = (&state.motion, &state.skeleton) else {
            return message;
        };
        let keyframe = |timed: &TimedKeyframe| {
            let stamped = StampedKeyframe {
                capture: timed.capture,
                start: timed.capture,
                window: state.window,
                keyframe: timed.keyframe.clone(),
                shape: *skeleton.shape(),
                interpolation: Interpolation::default(),
                grid: motion.frames,
                state: TrackingState::Tracking,
                rig_version: 0,
            };
            Keyframe::from_core(&stamped, weights)
        };
        message.past = motion.past.iter().map(keyframe).collect();
        message.ahead = motion.ahead.iter().map(keyframe).collect();
        message.coasted = motion.coasted as u32;
        message.first_pose_ns = motion.first_pose.ns();
        message.noise = motion.noise.numbers().to_vec();
        message.first_fit = motion.first_fit.unwrap_or_default();
        message.deviations_m = motion.deviations.map_or_else(Vec::new, Vec::from);
        message
    }

    /// The state. Without a body estimate, the estimate begins anew.
    ///
    /// # Errors
    /// What [`Keyframe::to_core`] refuses; wrong lengths, numbers that are not finite.
    pub fn to_core(&self) -> Result<tracker::HandOver, DecodeError> {
        let body = match self.body.is_empty() {
            true => None,
            false => Some(at("body").numbers::<BODY_COEFFICIENTS, f64>(&self.body)?),
        };
        let skeleton = body.map(|body| Skeleton::default().with_coefficients(&body));
        let estimate = self.body_estimate.as_ref().map(BodyEstimate::to_core).transpose()?;
        at("performer").performer(self.performer)?;
        if self.window > MOST_WINDOWS {
            return Err(at("window").invalid(format!("{} is too large", self.window)));
        }
        Ok(tracker::HandOver {
            until: time("until_ns", self.until_ns)?,
            window: self.window,
            skeleton: skeleton.map(Arc::new),
            estimate: Arc::new(estimate.unwrap_or_default()),
            motion: self.motion()?,
        })
    }

    fn motion(&self) -> Result<Option<Motion>, DecodeError> {
        let Some(first) = self.past.first() else { return Ok(None) };
        let Grid { origin, period_ns } = first.to_core()?.grid;
        if !PERIODS_NS.contains(&period_ns) {
            return Err(at("past").invalid(format!("a frame period of {period_ns} ns")));
        }
        let timed = |keyframe: &Keyframe| {
            let stamped = keyframe.to_core()?;
            Ok(TimedKeyframe::new(stamped.capture, stamped.keyframe))
        };
        let all = |some: &[Keyframe]| some.iter().map(timed).collect::<Result<Vec<_>, _>>();
        let (past, ahead) = (all(&self.past)?, all(&self.ahead)?);
        let times = past.iter().chain(&ahead).map(|timed| timed.capture);
        for at in times.clone().chain([origin]) {
            time("past", at.ns())?;
        }
        let is_rising = times.clone().zip(times.skip(1)).all(|(a, b)| a < b);
        if !is_rising
            || past.len() > 2
            || ahead.len() > MOST_AHEAD
            || past.last().map(|last| last.capture.ns()) != Some(self.until_ns)
        {
            return Err(at("past").invalid("not one or two keyframes up to until_ns"));
        }
        let noise = at("noise").numbers::<5, f64>(&self.noise)?;
        if noise.iter().any(|number| *number < 0.0) {
            return Err(at("noise").invalid("is negative"));
        }
        let first_fit = at("first_fit").numbers::<1, f64>(&[self.first_fit])?[0];
        let deviations = at("deviations_m");
        Ok(Some(Motion {
            past,
            ahead,
            coasted: self.coasted as usize,
            frames: Grid { origin, period_ns },
            first_pose: time("first_pose_ns", self.first_pose_ns)?,
            noise: Noise::of_numbers(noise),
            first_fit: Some(first_fit).filter(|fit| *fit > 0.0),
            deviations: match self.deviations_m.is_empty() {
                true => None,
                false => Some(deviations.numbers(&self.deviations_m)?),
            },
        }))
    }
}

impl BodyEstimate {
    fn to_core(&self) -> Result<BodyEstimator, DecodeError> {
        let at = |name| field("BodyEstimate", name);
        at("coefficients").finite(&self.coefficients)?;
        at("information").finite(&self.information)?;
        at("pull").finite(&self.pull)?;
        at("other_take").finite(&self.other_take)?;
        if ![0, BODY_COEFFICIENTS].contains(&self.other_take.len()) {
            return Err(at("other_take").invalid("is not a body"));
        }
        let numbers = EstimateNumbers {
            windows: self.windows as usize,
            is_check: self.is_check,
            other_take: self.other_take.clone(),
            coefficients: self.coefficients.clone(),
            information: self.information.clone(),
            pull: self.pull.clone(),
        };
        BodyEstimator::of_numbers(&numbers)
            .ok_or_else(|| at("information").invalid("does not fit the number of windows"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn states_that_no_tracker_has_are_refused() {
        let good = HandOver { body: vec![0.0; BODY_COEFFICIENTS], ..HandOver::default() };
        assert!(good.to_core().is_ok());
        let estimate = BodyEstimate { windows: 3, ..BodyEstimate::default() };
        let other_take = BodyEstimate { other_take: vec![0.0; 3], ..BodyEstimate::default() };
        let past = Keyframe { capture_time_ns: 5, ..Keyframe::default() };
        for (bad, field) in [
            (HandOver { body: vec![0.0; 3], ..good.clone() }, "body"),
            (HandOver { body: vec![f64::NAN; BODY_COEFFICIENTS], ..good.clone() }, "body"),
            (HandOver { until_ns: i64::MAX, ..good.clone() }, "until_ns"),
            (HandOver { window: u64::MAX, ..good.clone() }, "window"),
            (HandOver { body_estimate: Some(estimate), ..good.clone() }, "information"),
            (HandOver { body_estimate: Some(other_take), ..good.clone() }, "other_take"),
            (HandOver { past: vec![past], ..good.clone() }, "Keyframe"),
        ] {
            let error = bad.to_core().unwrap_err().to_string();
            assert!(error.contains(field), "{field}: {error}");
        }
    }
}

//! Filters of a coordinate over the frames of a recording. Both see the whole recording, and delay
//! nothing.

use std::f64::consts::{PI, SQRT_2};

use nalgebra::{Matrix2, Vector2};
use serde::{Deserialize, Serialize};

/// Samples that are mirrored at both ends of a track.
const MIRRORED: usize = 9;

/// A filter of a track without gaps.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Filter {
    /// A Butterworth filter of second order, forwards and then backwards: fourth order, no phase.
    /// At `cutoff_hz` the amplitude halves. \[Winter 2009\]
    Butterworth {
        /// Cut-off frequency, Hz, below half of the frame rate.
        cutoff_hz: f64,
    },
    /// A Kalman filter with constant velocity, and a Rauch-Tung-Striebel smoother.
    Kalman {
        /// Standard deviation of a measured coordinate, metres.
        noise_m: f64,
        /// Standard deviation of the acceleration, constant during a frame, m/s^2.
        acceleration_m_s2: f64,
    },
}

impl Filter {
    /// The name in tables.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Butterworth { .. } => "Butterworth",
            Self::Kalman { .. } => "Kalman",
        }
    }

    /// The smoothed track of samples at `fps`.
    pub fn smooth(self, track: &[f64], fps: f64) -> Vec<f64> {
        match self {
            // Slow frames have no such frequencies, and the filter would not be stable.
            Self::Butterworth { cutoff_hz } if cutoff_hz >= 0.5 * fps => track.to_vec(),
            Self::Butterworth { cutoff_hz } => zero_phase(track, cutoff_hz / fps),
            Self::Kalman { noise_m, acceleration_m_s2 } => {
                kalman(track, fps.recip(), noise_m, acceleration_m_s2)
            }
        }
    }
}

/// Forwards and backwards, with the track mirrored about its end points.
fn zero_phase(track: &[f64], cutoff: f64) -> Vec<f64> {
    let (Some(&first), Some(&last)) = (track.first(), track.last()) else { return Vec::new() };
    let pad = MIRRORED.min(track.len() - 1);
    let head = track[1..=pad].iter().rev().map(|x| 2.0 * first - x);
    let tail = track[track.len() - 1 - pad..].iter().rev().skip(1).map(|x| 2.0 * last - x);
    let padded: Vec<f64> = head.chain(track.iter().copied()).chain(tail).collect();
    let mut once = low_pass(padded.into_iter(), cutoff);
    once.reverse();
    let mut twice = low_pass(once.into_iter(), cutoff);
    twice.reverse();
    twice[pad..pad + track.len()].to_vec()
}

/// A Butterworth filter of second order by the bilinear transform; `cutoff` is in cycles per sample.
/// It starts as if the first sample had been there for ever.
fn low_pass(samples: impl Iterator<Item = f64>, cutoff: f64) -> Vec<f64> {
    let k = (PI * cutoff).tan();
    let scale = (1.0 + SQRT_2 * k + k * k).recip();
    let (b, a1, a2) =
        (k * k * scale, 2.0 * (k * k - 1.0) * scale, (1.0 - SQRT_2 * k + k * k) * scale);
    let mut past = None;
    let step = |x: f64| {
        let (x1, x2, y1, y2) = past.unwrap_or((x, x, x, x));
        let y = b * (x + 2.0 * x1 + x2) - a1 * y1 - a2 * y2;
        past = Some((x, x1, y, y1));
        y
    };
    samples.map(step).collect()
}

/// State: position and velocity. The first velocity is unknown within 10 m/s.
fn kalman(track: &[f64], dt: f64, noise: f64, acceleration: f64) -> Vec<f64> {
    let Some(&first) = track.first() else { return Vec::new() };
    let f = Matrix2::new(1.0, dt, 0.0, 1.0);
    let g = Vector2::new(0.5 * dt * dt, dt) * acceleration;
    let q = g * g.transpose();
    let mut state = Vector2::new(first, 0.0);
    let mut spread = Matrix2::new(noise * noise, 0.0, 0.0, 100.0);
    // Each frame's filtered state and spread, and what they predict for the next frame.
    let mut steps = Vec::with_capacity(track.len());
    for (frame, x) in track.iter().enumerate() {
        if frame > 0 {
            let gain = spread.column(0) / (spread[(0, 0)] + noise * noise);
            state += gain * (x - state.x);
            spread -= gain * spread.row(0);
        }
        let (next, next_spread) = (f * state, f * spread * f.transpose() + q);
        steps.push((state, spread, next, next_spread));
        (state, spread) = (next, next_spread);
    }
    let mut smoothed = Vec::with_capacity(track.len());
    let mut after: Option<Vector2<f64>> = None;
    for (state, spread, next, next_spread) in steps.into_iter().rev() {
        let gain = next_spread.try_inverse().map(|inverse| spread * f.transpose() * inverse);
        let state = match (after, gain) {
            (Some(after), Some(gain)) => state + gain * (after - next),
            _ => state,
        };
        after = Some(state);
        smoothed.push(state.x);
    }
    smoothed.reverse();
    smoothed
}

#[cfg(test)]
mod tests {
    use super::*;

    const FPS: f64 = 60.0;
    const BOTH: [Filter; 2] = [
        Filter::Butterworth { cutoff_hz: 6.0 },
        Filter::Kalman { noise_m: 0.01, acceleration_m_s2: 20.0 },
    ];

    fn wave(hz: f64) -> Vec<f64> {
        (0..600).map(|t| (2.0 * PI * hz * f64::from(t) / FPS).sin()).collect()
    }

    #[test]
    fn a_straight_track_is_kept_to_its_ends() {
        let line: Vec<f64> = (0..100).map(|t| 1.0 + 0.01 * f64::from(t)).collect();
        for filter in BOTH {
            let off = filter.smooth(&line, FPS).into_iter().zip(&line).map(|(a, b)| (a - b).abs());
            assert!(off.fold(0.0, f64::max) < 2e-3, "{}", filter.name());
            assert_eq!(filter.smooth(&[], FPS), [0.0; 0]);
            assert!((filter.smooth(&[3.0], FPS)[0] - 3.0).abs() < 1e-12);
        }
    }

    /// Amplitude and phase shift of the middle of a smoothed wave.
    fn response(filter: Filter, hz: f64) -> (f64, f64) {
        let smooth = filter.smooth(&wave(hz), FPS);
        let (mut sine, mut cosine) = (0.0, 0.0);
        for (t, y) in smooth.iter().enumerate().take(420).skip(180) {
            let phase = 2.0 * PI * hz * t as f64 / FPS;
            (sine, cosine) = (sine + y * phase.sin() / 120.0, cosine + y * phase.cos() / 120.0);
        }
        (sine.hypot(cosine), cosine.atan2(sine))
    }

    #[test]
    fn the_butterworth_filter_halves_its_cut_off_frequency_and_shifts_nothing() {
        // |H|^2 = 1 / (1 + (tan(pi f / fps) / tan(pi 6 / fps))^4), twice over the track.
        for hz in [1.0, 3.0, 6.0, 12.0] {
            let warped = |hz: f64| (PI * hz / FPS).tan();
            let expected = 1.0 / (1.0 + (warped(hz) / warped(6.0)).powi(4));
            let (amplitude, shift) = response(BOTH[0], hz);
            assert!((amplitude - expected).abs() < 1e-3, "{hz} Hz: {amplitude} {expected}");
            assert!(shift.abs() < 1e-3, "{hz} Hz: {shift}");
        }
    }

    #[test]
    fn the_kalman_smoother_keeps_slow_motion_and_damps_fast_noise() {
        let (slow, fast) = (response(BOTH[1], 1.0), response(BOTH[1], 20.0));
        assert!(slow.0 > 0.98 && slow.1.abs() < 1e-3, "{slow:?}");
        assert!(fast.0 < 0.1, "{fast:?}");
    }
}

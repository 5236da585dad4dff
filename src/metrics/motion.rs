//! Velocity jumps where windows meet.

use serde::Serialize;

use super::statistics::mean;
use crate::core::body::{JOINTS, Posture};

/// Velocity jumps from frame to frame at window borders and elsewhere: mean over joints and frames
/// of |v(t+) - v(t-)|, m/s, with v(t+) - v(t-) = (P(t+1) - 2 P(t) + P(t-1)) fps.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct VelocityJump {
    /// At window borders.
    pub border_m_s: f64,
    /// At all other frames.
    pub inside_m_s: f64,
    /// At window borders, less the true motion's jump in these frames.
    pub excess_m_s: f64,
}

/// Measures runs of the same times, without gaps, at `fps`; `borders` are indices into them. `None`
/// if the inner frames have no border, or only borders.
pub fn velocity_jump(
    estimate: &[Posture],
    truth: &[Posture],
    borders: &[usize],
    fps: f64,
) -> Option<VelocityJump> {
    let is_border = |(frame, _): &(usize, f64)| borders.contains(frame);
    let (at, inside): (Vec<_>, Vec<_>) = velocity_jumps(estimate, fps).partition(is_border);
    let true_at: Vec<_> = velocity_jumps(truth, fps).filter(is_border).collect();
    let mean = |jumps: &[(usize, f64)]| mean(&jumps.iter().map(|jump| jump.1).collect::<Vec<_>>());
    let border_m_s = mean(&at)?;
    let excess_m_s = border_m_s - mean(&true_at)?;
    Some(VelocityJump { border_m_s, inside_m_s: mean(&inside)?, excess_m_s })
}

/// Mean over joints of |v(t+) - v(t-)|, m/s, at every inner frame of a run without gaps.
pub fn velocity_jumps(run: &[Posture], fps: f64) -> impl Iterator<Item = (usize, f64)> + '_ {
    run.windows(3).enumerate().map(move |(before, triple)| {
        let at = |frame: usize, joint: usize| triple[frame].positions[joint];
        let jump = |j: usize| (at(2, j) - at(1, j) * 2.0 + at(0, j)).norm() * fps;
        (before + 1, (0..JOINTS).map(jump).sum::<f64>() / JOINTS as f64)
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::metrics::made_up::{FPS, close, run};

    #[test]
    fn a_kink_at_a_border_stands_out() {
        // Speeds 1, 1, 2, 2.25, 2.5 cm a frame: jumps of 0, 1, 0.25, 0.25 cm a frame.
        let truth = run(&[0.0, 0.01, 0.02, 0.0325, 0.045, 0.0575]);
        let run = run(&[0.0, 0.01, 0.02, 0.04, 0.0625, 0.0875]);
        let jump = velocity_jump(&run, &truth, &[2], FPS).unwrap();
        close(jump.border_m_s, 0.01 * FPS);
        close(jump.inside_m_s, 0.005 / 3.0 * FPS);
        close(jump.excess_m_s, 0.0075 * FPS);
        assert_eq!(velocity_jump(&run, &run, &[], FPS), None);
        assert_eq!(velocity_jump(&run, &run, &[0, 5], FPS), None, "the ends have no jump");
        assert_eq!(velocity_jump(&run[..2], &run[..2], &[1], FPS), None);
    }
}

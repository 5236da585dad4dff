//! States and moves of a corpus, as defined by `crate::core::manifold::state_of` and `move_of`.

use nalgebra::{Matrix3, Vector3};

use super::super::corpus::{Clip, FPS, Frame, mirrored, pose_vector, resampled};
use super::super::evaluate::encode;
use super::super::model::Model;
use crate::core::body::FASTEST;
use crate::core::manifold::{Correction, Keyframe};
use crate::research::transition::{MOVE, STATE, move_of, state_of};

/// Frame rates of the samples, Hz.
pub const RATES: [f64; 3] = [30.0, 50.0, 60.0];

/// Transitions at one frame rate.
#[derive(Clone, Debug, Default)]
pub struct Samples {
    /// Rows of [`STATE`] values.
    pub states: Vec<f32>,
    /// Rows of [`MOVE`] values.
    pub moves: Vec<f32>,
}

impl Samples {
    /// All transitions of clips at `fps`, except those with a pelvis faster than 15 m/s, and of
    /// their mirror images if `mirror`.
    pub fn of(model: &Model, clips: &[Clip], fps: f64, mirror: bool) -> Self {
        let mut samples = Self::default();
        for clip in clips {
            samples.add(&keyframes(model, clip, fps, false), fps);
            if mirror {
                samples.add(&keyframes(model, clip, fps, true), fps);
            }
        }
        samples
    }

    fn add(&mut self, keyframes: &[Keyframe], fps: f64) {
        let step = fps.recip();
        for three in keyframes.windows(3) {
            let [a, b, c] = [&three[0], &three[1], &three[2]];
            let jumps = |a: &Keyframe, b: &Keyframe| {
                (b.root_position - a.root_position).norm() > FASTEST * step
            };
            if jumps(a, b) || jumps(b, c) {
                continue;
            }
            self.states.extend(state_of(a, b, step).map(|v| v as f32));
            self.moves.extend(move_of([a, b, c], step).map(|v| v as f32));
        }
    }

    /// Number of transitions.
    pub fn len(&self) -> usize {
        self.moves.len() / MOVE
    }

    /// State and move of each transition.
    pub fn rows(&self) -> impl Iterator<Item = (&[f32], &[f32])> {
        self.states.chunks_exact(STATE).zip(self.moves.chunks_exact(MOVE))
    }
}

/// A clip at `fps` as keyframes: code of the manifold and pelvis.
pub fn keyframes(model: &Model, clip: &Clip, fps: f64, mirror: bool) -> Vec<Keyframe> {
    let frames: Vec<Frame> = (0..clip.poses.len())
        .filter_map(|frame| clip.pose(frame))
        .map(|pose| ((pose.root_rotation, pose.root_position), pose.local))
        .collect();
    let frames = if fps == FPS {
        frames.iter().map(|(root, locals)| (*root, pose_vector(locals))).collect()
    } else {
        resampled(&frames, fps / FPS)
    };
    let poses: Vec<_> =
        frames.iter().map(|(_, pose)| if mirror { mirrored(pose) } else { *pose }).collect();
    let flip = Matrix3::from_diagonal(&Vector3::new(if mirror { -1.0 } else { 1.0 }, 1.0, 1.0));
    let codes = encode(model, &poses);
    codes
        .iter()
        .zip(&frames)
        .map(|(code, ((rotation, position), _))| Keyframe {
            z: code.map(f64::from),
            root_rotation: flip * rotation * flip,
            root_position: flip * position,
            correction: Correction::default(),
        })
        .collect()
}

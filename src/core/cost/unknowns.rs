//! The unknowns of a path.
//!
//! In this order: for each free keyframe its code (32), a rotation vector w (3) with
//! R = exp(w) R_initial, and its position (3); then, if they are free, the shape (17 coefficients, or
//! the 10 of equal sides) and the keypoint offsets (78).

use nalgebra::{Matrix3, Vector3};

use crate::core::body::{BODY_COEFFICIENTS, SYMMETRIC_SHAPE, Skeleton};
use crate::core::manifold::{Keyframe, LATENT, TimedKeyframe};
use crate::core::so3;
use crate::core::time::Timestamp;

/// Number of unknowns of one keyframe.
pub(super) const KEYFRAME: usize = LATENT + 6;

/// A frame takes the values of a keyframe within this fraction of the keyframe interval.
const AT_KEYFRAME: f64 = 1e-4;

/// A keyframe of the path to solve.
#[derive(Clone, Debug, PartialEq)]
pub struct PathKeyframe {
    /// Its time, and its value or start value.
    pub timed: TimedKeyframe,
    /// Whether it is an unknown.
    pub free: bool,
    /// Its number of nominal frames: the factor of its prior and its stiffness.
    pub frames: f64,
}

impl PathKeyframe {
    /// A keyframe to solve, with its start value and its number of nominal frames.
    pub fn free(timed: TimedKeyframe, frames: f64) -> Self {
        Self { timed, free: true, frames }
    }

    /// A keyframe with a fixed value.
    pub fn fixed(timed: TimedKeyframe) -> Self {
        Self { timed, free: false, frames: 0.0 }
    }
}

/// The body coefficients that are unknowns.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FreeBody {
    /// None.
    Fixed,
    /// The shape, equal on both sides.
    Shape,
    /// The whole shape and the keypoint offsets.
    ShapeAndOffsets,
}

/// The values of the unknowns: the keyframes and the body.
#[derive(Clone, Debug)]
pub(super) struct Unknowns {
    initial: Vec<PathKeyframe>,
    pub(super) keyframes: Vec<Keyframe>,
    /// The rotation vector of each keyframe; zero if it is fixed.
    pub(super) rotation_vectors: Vec<Vector3<f64>>,
    pub(super) skeleton: Skeleton,
    /// Number of free body coefficients.
    pub(super) body: usize,
}

/// A frame's place on the path: the two keyframes around it, and its position between them.
#[derive(Clone, Copy)]
pub(super) struct Place {
    pub(super) from: usize,
    pub(super) to: usize,
    pub(super) s: f64,
}

impl Unknowns {
    pub(super) fn new(path: Vec<PathKeyframe>, skeleton: &Skeleton, free: FreeBody) -> Self {
        Self {
            keyframes: path.iter().map(|at| at.timed.keyframe.clone()).collect(),
            rotation_vectors: vec![Vector3::zeros(); path.len()],
            initial: path,
            skeleton: skeleton.clone(),
            body: match free {
                FreeBody::Fixed => 0,
                FreeBody::Shape => SYMMETRIC_SHAPE,
                FreeBody::ShapeAndOffsets => BODY_COEFFICIENTS,
            },
        }
    }

    /// Number of unknowns.
    pub(super) fn count(&self) -> usize {
        self.body_at() + self.body
    }

    /// Number of a frame's coordinates: code, rotation and position at its time, and the body.
    pub(super) fn coordinates(&self) -> usize {
        KEYFRAME + self.body
    }

    /// Whether a frame's Hessian is simply added to that of one keyframe; its rotation then has the
    /// keyframe's coordinates.
    pub(super) fn is_direct(&self, place: Place) -> bool {
        place.from == place.to && self.body == 0
    }

    /// The left tangent of the pelvis by the coordinates of a frame's rotation.
    pub(super) fn root_tangent(&self, place: Place) -> Matrix3<f64> {
        match self.is_direct(place) {
            true => so3::left_jacobian(&self.rotation_vectors[place.to]),
            false => Matrix3::identity(),
        }
    }

    /// Whether a keyframe is an unknown.
    pub(super) fn is_free(&self, keyframe: usize) -> bool {
        self.initial[keyframe].free
    }

    /// The index of a keyframe among the free ones.
    pub(super) fn number(&self, keyframe: usize) -> usize {
        self.initial[..keyframe].iter().filter(|at| at.free).count()
    }

    /// The time of a keyframe.
    pub(super) fn capture(&self, keyframe: usize) -> Timestamp {
        self.initial[keyframe].timed.capture
    }

    /// Number of nominal frames of a keyframe.
    pub(super) fn frames(&self, keyframe: usize) -> f64 {
        self.initial[keyframe].frames
    }

    /// Number of nominal frames of each free keyframe.
    pub(super) fn free_frames(&self) -> impl Iterator<Item = f64> + '_ {
        self.initial.iter().filter(|at| at.free).map(|at| at.frames)
    }

    /// Index of the body's first coefficient.
    pub(super) fn body_at(&self) -> usize {
        self.number(self.initial.len()) * KEYFRAME
    }

    /// The unknowns to start from.
    pub(super) fn start(&self) -> Vec<f64> {
        self.start_at(|_, at| at.timed.keyframe.clone())
    }

    /// The unknowns to start from, with other values of the free keyframes.
    pub(super) fn start_at(&self, value: impl Fn(usize, &PathKeyframe) -> Keyframe) -> Vec<f64> {
        let mut x = Vec::with_capacity(self.count());
        for (k, at) in self.initial.iter().enumerate().filter(|(_, at)| at.free) {
            let keyframe = value(k, at);
            let initial = &at.timed.keyframe.root_rotation;
            let turn = so3::log(&(keyframe.root_rotation * initial.transpose()));
            x.extend_from_slice(&keyframe.z);
            x.extend_from_slice(turn.as_slice());
            x.extend_from_slice(keyframe.root_position.as_slice());
        }
        x.extend(self.skeleton.coefficients().take(self.body));
        x
    }

    /// Sets the keyframes and the body to the values `x`.
    pub(super) fn take(&mut self, x: &[f64]) {
        let mut rest = x;
        for (k, at) in self.initial.iter().enumerate().filter(|(_, at)| at.free) {
            let (mine, others) = rest.split_at(KEYFRAME);
            rest = others;
            let keyframe = &mut self.keyframes[k];
            keyframe.z.copy_from_slice(&mine[..LATENT]);
            self.rotation_vectors[k] = Vector3::from_column_slice(&mine[LATENT..LATENT + 3]);
            keyframe.root_rotation =
                so3::exp(&self.rotation_vectors[k]) * at.timed.keyframe.root_rotation;
            keyframe.root_position = Vector3::from_column_slice(&mine[LATENT + 3..]);
        }
        if self.body > 0 {
            self.skeleton = self.skeleton.with_coefficients(rest);
        }
    }

    /// The place of a capture time on the path; a keyframe, if it is within a part in 10 000.
    pub(super) fn place(&self, capture: Timestamp) -> Place {
        let last = self.initial.len() - 1;
        if last == 0 {
            return Place { from: 0, to: 0, s: 1.0 };
        }
        let to =
            self.initial[1..last].iter().take_while(|at| at.timed.capture < capture).count() + 1;
        let (t0, t1) = (self.capture(to - 1), self.capture(to));
        match capture.fraction(t0, t1) {
            s if s.abs() < AT_KEYFRAME => Place { from: to - 1, to: to - 1, s: 1.0 },
            s if (s - 1.0).abs() < AT_KEYFRAME => Place { from: to, to, s: 1.0 },
            s => Place { from: to - 1, to, s },
        }
    }
}

//! What a path is solved for.
//!
//! In this order: for each free keyframe its code (32), a rotation vector w (3) with
//! R = exp(w) R_initial, and its position (3); then the shape (10) and the marks (39),
//! where they are free.

use nalgebra::{Matrix3, Vector3};

use crate::core::body::{BODY_COEFFICIENTS, SHAPE_COEFFICIENTS, Skeleton};
use crate::core::manifold::{Keyframe, LATENT};
use crate::core::so3;
use crate::core::time::Timestamp;

/// Unknowns of one keyframe.
pub(super) const KEYFRAME: usize = LATENT + 6;

/// A moment this close to a knot, as a part of the time between two, is taken for the knot's.
const ON_KNOT: f64 = 1e-4;

/// A keyframe of the path.
#[derive(Clone, Debug, PartialEq)]
pub struct Knot {
    /// Where on the time axis.
    pub capture: Timestamp,
    /// Its value, or the value to start from.
    pub keyframe: Keyframe,
    /// Whether it is solved for.
    pub free: bool,
    /// How many nominal frames it stands for: so often its prior and its stiffness count.
    pub frames: f64,
}

/// What of the body is solved for, besides the keyframes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FreeBody {
    /// Nothing.
    Fixed,
    /// The shape.
    Shape,
    /// The shape, and where the detector marks points.
    ShapeAndOffsets,
}

/// The keyframes and the body that the unknowns stand for.
#[derive(Clone, Debug)]
pub(super) struct Unknowns {
    initial: Vec<Knot>,
    pub(super) keyframes: Vec<Keyframe>,
    /// The rotation vector of each keyframe; zero where it is fixed.
    pub(super) turns: Vec<Vector3<f64>>,
    pub(super) skeleton: Skeleton,
    /// How many coefficients of the body are solved for.
    pub(super) body: usize,
}

/// The two keyframes about a moment and how far it is between them.
#[derive(Clone, Copy)]
pub(super) struct Place {
    pub(super) from: usize,
    pub(super) to: usize,
    pub(super) s: f64,
}

impl Unknowns {
    pub(super) fn new(knots: Vec<Knot>, skeleton: &Skeleton, free: FreeBody) -> Self {
        Self {
            keyframes: knots.iter().map(|knot| knot.keyframe.clone()).collect(),
            turns: vec![Vector3::zeros(); knots.len()],
            initial: knots,
            skeleton: skeleton.clone(),
            body: match free {
                FreeBody::Fixed => 0,
                FreeBody::Shape => SHAPE_COEFFICIENTS,
                FreeBody::ShapeAndOffsets => BODY_COEFFICIENTS,
            },
        }
    }

    /// How many there are.
    pub(super) fn count(&self) -> usize {
        self.body_at() + self.body
    }

    /// Coordinates of a moment: code, rotation and position where it is on the path, and the body.
    pub(super) fn coordinates(&self) -> usize {
        KEYFRAME + self.body
    }

    /// Whether a moment's Hessian is a part of that of a single knot, once its rotation is
    /// parametrised as the knot's is.
    pub(super) fn is_direct(&self, place: Place) -> bool {
        place.from == place.to && self.body == 0
    }

    /// How the pelvis turns with the coordinates of a moment's rotation.
    pub(super) fn knot_turn(&self, place: Place) -> Matrix3<f64> {
        match self.is_direct(place) {
            true => so3::left_jacobian(&self.turns[place.to]),
            false => Matrix3::identity(),
        }
    }

    /// Whether a keyframe is solved for.
    pub(super) fn is_free(&self, keyframe: usize) -> bool {
        self.initial[keyframe].free
    }

    /// The number of a keyframe among those that are solved for.
    pub(super) fn number(&self, keyframe: usize) -> usize {
        self.initial[..keyframe].iter().filter(|knot| knot.free).count()
    }

    /// Where a keyframe is on the time axis.
    pub(super) fn capture(&self, keyframe: usize) -> Timestamp {
        self.initial[keyframe].capture
    }

    /// How many nominal frames a keyframe stands for.
    pub(super) fn frames(&self, keyframe: usize) -> f64 {
        self.initial[keyframe].frames
    }

    /// The same of each keyframe that is solved for.
    pub(super) fn free_frames(&self) -> impl Iterator<Item = f64> + '_ {
        self.initial.iter().filter(|knot| knot.free).map(|knot| knot.frames)
    }

    /// Where the body begins.
    pub(super) fn body_at(&self) -> usize {
        self.number(self.initial.len()) * KEYFRAME
    }

    /// The unknowns to start from.
    pub(super) fn start(&self) -> Vec<f64> {
        let initial = |_: usize, knot: &Knot| knot.keyframe.clone();
        self.start_at(initial)
    }

    /// The unknowns to start from, with other values of the free keyframes.
    pub(super) fn start_at(&self, value: impl Fn(usize, &Knot) -> Keyframe) -> Vec<f64> {
        let mut x = Vec::with_capacity(self.count());
        for (k, knot) in self.initial.iter().enumerate().filter(|(_, knot)| knot.free) {
            let keyframe = value(k, knot);
            let initial = &knot.keyframe.root_rotation;
            let turn = so3::log(&(keyframe.root_rotation * initial.transpose()));
            x.extend_from_slice(&keyframe.z);
            x.extend_from_slice(turn.as_slice());
            x.extend_from_slice(keyframe.root_position.as_slice());
        }
        x.extend(self.skeleton.coefficients().take(self.body));
        x
    }

    /// Moves the keyframes and the body to where `x` says.
    pub(super) fn take(&mut self, x: &[f64]) {
        let mut rest = x;
        for (k, knot) in self.initial.iter().enumerate().filter(|(_, knot)| knot.free) {
            let (mine, others) = rest.split_at(KEYFRAME);
            rest = others;
            let keyframe = &mut self.keyframes[k];
            keyframe.z.copy_from_slice(&mine[..LATENT]);
            self.turns[k] = Vector3::from_column_slice(&mine[LATENT..LATENT + 3]);
            keyframe.root_rotation = so3::exp(&self.turns[k]) * knot.keyframe.root_rotation;
            keyframe.root_position = Vector3::from_column_slice(&mine[LATENT + 3..]);
        }
        if self.body > 0 {
            self.skeleton = self.skeleton.with_coefficients(rest);
        }
    }

    /// Where on the path a capture time is; on a knot, if it is within a part in 10 000.
    pub(super) fn place(&self, capture: Timestamp) -> Place {
        let last = self.initial.len() - 1;
        if last == 0 {
            return Place { from: 0, to: 0, s: 1.0 };
        }
        let to = self.initial[1..last].iter().take_while(|knot| knot.capture < capture).count() + 1;
        let (t0, t1) = (self.initial[to - 1].capture, self.initial[to].capture);
        match (capture - t0) as f64 / (t1 - t0).max(1) as f64 {
            s if s.abs() < ON_KNOT => Place { from: to - 1, to: to - 1, s: 1.0 },
            s if (s - 1.0).abs() < ON_KNOT => Place { from: to, to, s: 1.0 },
            s => Place { from: to - 1, to, s },
        }
    }
}

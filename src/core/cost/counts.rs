//! Counts of the work of a problem.

use std::ops::Add;

/// Counts of what was computed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Counts {
    /// Codes decoded.
    pub decoded: usize,
    /// Codes at which the decoder was linearised.
    pub linearised: usize,
    /// Gradients carried back through the decoder.
    pub gradients: usize,
    /// Frames whose Hessian was computed.
    pub frames: usize,
}

impl Add for Counts {
    type Output = Self;

    fn add(self, other: Self) -> Self {
        Self {
            decoded: self.decoded + other.decoded,
            linearised: self.linearised + other.linearised,
            gradients: self.gradients + other.gradients,
            frames: self.frames + other.frames,
        }
    }
}

impl Counts {
    /// The counts since `before`.
    pub fn since(self, before: Self) -> Self {
        Self {
            decoded: self.decoded - before.decoded,
            linearised: self.linearised - before.linearised,
            gradients: self.gradients - before.gradients,
            frames: self.frames - before.frames,
        }
    }
}

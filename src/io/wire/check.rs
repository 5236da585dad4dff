//! Checks of data from the wire.

use nalgebra::{Matrix3, Vector3};

use super::DecodeError;
use crate::core::so3;
use crate::core::stage::PerformerId;

/// A field of a schema, named in errors.
#[derive(Clone, Copy)]
pub(super) struct Field {
    pub message: &'static str,
    pub field: &'static str,
}

/// The field with that name.
pub(super) const fn field(message: &'static str, field: &'static str) -> Field {
    Field { message, field }
}

impl Field {
    pub(super) fn invalid(self, reason: impl Into<String>) -> DecodeError {
        let Self { message, field } = self;
        DecodeError::Invalid { message, field, reason: reason.into() }
    }

    /// The performer with that number, from 0.
    pub(super) fn performer(self, number: u32) -> Result<PerformerId, DecodeError> {
        let performer = PerformerId(number as usize);
        let is_one = performer.0 < PerformerId::MOST;
        is_one.then_some(performer).ok_or_else(|| self.invalid(format!("{number} is too large")))
    }

    /// Fails unless there are `expected` entries.
    pub(super) fn length(self, found: usize, expected: usize) -> Result<(), DecodeError> {
        let Self { message, field } = self;
        if found == expected {
            return Ok(());
        }
        Err(DecodeError::Length { message, field, found, expected })
    }

    /// Fails unless every entry is finite.
    pub(super) fn finite<T: Copy + Into<f64>>(self, values: &[T]) -> Result<(), DecodeError> {
        let Self { message, field } = self;
        match values.iter().position(|&value| !value.into().is_finite()) {
            Some(index) => Err(DecodeError::NotFinite { message, field, index }),
            None => Ok(()),
        }
    }

    /// Exactly N finite numbers.
    pub(super) fn numbers<const N: usize, T: Copy + Into<f64>>(
        self,
        values: &[T],
    ) -> Result<[f64; N], DecodeError> {
        self.length(values.len(), N)?;
        self.finite(values)?;
        Ok(std::array::from_fn(|index| values[index].into()))
    }

    /// N finite numbers, or only the first `least`; the others are 0.
    pub(super) fn padded<const N: usize, T: Copy + Into<f64>>(
        self,
        values: &[T],
        least: usize,
    ) -> Result<[f64; N], DecodeError> {
        if values.len() != least {
            return self.numbers(values);
        }
        self.finite(values)?;
        Ok(std::array::from_fn(|index| values.get(index).map_or(0.0, |&value| value.into())))
    }

    /// Exactly N points of three finite numbers.
    pub(super) fn vectors<const N: usize, T: Copy + Into<f64>>(
        self,
        values: &[T],
    ) -> Result<[Vector3<f64>; N], DecodeError> {
        self.length(values.len(), 3 * N)?;
        self.finite(values)?;
        Ok(std::array::from_fn(|i| Vector3::from_fn(|row, _| values[3 * i + row].into())))
    }

    /// Exactly N quaternions x, y, z, w.
    pub(super) fn rotations<const N: usize, T: Copy + Into<f64>>(
        self,
        values: &[T],
    ) -> Result<[Matrix3<f64>; N], DecodeError> {
        self.length(values.len(), 4 * N)?;
        self.finite(values)?;
        let mut rotations = [Matrix3::identity(); N];
        for (index, (rotation, xyzw)) in
            rotations.iter_mut().zip(values.chunks_exact(4)).enumerate()
        {
            let xyzw = std::array::from_fn(|i| xyzw[i].into());
            *rotation = so3::rotation_from_xyzw(xyzw)
                .ok_or_else(|| self.invalid(format!("quaternion {index} has length zero")))?;
        }
        Ok(rotations)
    }

    /// One quaternion.
    pub(super) fn rotation<T: Copy + Into<f64>>(
        self,
        values: &[T],
    ) -> Result<Matrix3<f64>, DecodeError> {
        self.rotations::<1, T>(values).map(|[rotation]| rotation)
    }

    /// One point.
    pub(super) fn vector<T: Copy + Into<f64>>(
        self,
        values: &[T],
    ) -> Result<Vector3<f64>, DecodeError> {
        self.vectors::<1, T>(values).map(|[vector]| vector)
    }
}

//! Converts `Skeleton` to and from [`body::Skeleton`].

use super::check::{Field, field};
use super::{DecodeError, Skeleton};
use crate::core::body::{self, JOINTS, Joint, KeypointOffsets, SYMMETRIC_SHAPE, Shape};
use crate::core::stage::{Known, LENGTHS};

/// Largest distance of rest offsets from those that the shape gives, metres.
const OFFSET_TOLERANCE: f64 = 1e-6;

const fn at(name: &'static str) -> Field {
    field("Skeleton", name)
}

/// Index of the parent on the wire.
fn parent_index(joint: Joint) -> i32 {
    joint.parent().map_or(-1, |parent| parent.index() as i32)
}

/// Whether these are the sum, metres, and the number of measurements of a length.
pub(crate) fn is_length(measured: &[f64; 2]) -> bool {
    measured.iter().all(|x| (0.0..1e9).contains(x))
}

impl Skeleton {
    /// The joints, their rest offsets, the shape and the keypoint offsets.
    pub fn from_core(skeleton: &body::Skeleton) -> Self {
        let offsets = Joint::ALL.iter().flat_map(|&joint| skeleton.offset(joint).iter());
        Self {
            joint_names: Joint::ALL.map(|joint| joint.name().to_owned()).to_vec(),
            parents: Joint::ALL.map(parent_index).to_vec(),
            rest_offsets_m: offsets.copied().collect(),
            shape: skeleton.shape().0.to_vec(),
            keypoint_offsets_m: skeleton.keypoint_offsets().metres().to_vec(),
            run_id: 0,
            lengths_m: Vec::new(),
        }
    }

    /// The body of somebody who is known, with the measured lengths; `None` before the body is estimated.
    pub fn of_known(known: &Known) -> Option<Self> {
        let lengths_m = known.lengths.as_flattened().to_vec();
        Some(Self { lengths_m, ..Self::from_core(known.body.as_deref()?) })
    }

    /// The measured lengths, if there are any.
    pub fn lengths(&self) -> Option<[[f64; 2]; LENGTHS]> {
        let (pairs, rest) = self.lengths_m.as_chunks::<2>();
        let is_sound = rest.is_empty() && pairs.iter().all(is_length);
        pairs.try_into().ok().filter(|_| is_sound)
    }

    /// The body with that shape and those keypoint offsets.
    ///
    /// # Errors
    /// Other joints than ours, wrong lengths, numbers that are not finite, offsets that do not fit
    /// the shape.
    pub fn to_core(&self) -> Result<body::Skeleton, DecodeError> {
        self.check_joints()?;
        let offsets = at("rest_offsets_m").vectors::<JOINTS, _>(&self.rest_offsets_m)?;
        let shape = Shape(at("shape").padded(&self.shape, SYMMETRIC_SHAPE)?);
        let skeleton = body::Skeleton::new(shape);
        for (joint, offset) in Joint::ALL.into_iter().zip(offsets) {
            let apart = (skeleton.offset(joint) - offset).norm();
            if apart > OFFSET_TOLERANCE {
                let reason = format!(
                    "{} is {:.3} mm from the position that the shape gives; it was \
                     written for another template",
                    joint.name(),
                    apart * 1e3
                );
                return Err(at("rest_offsets_m").invalid(reason));
            }
        }
        let offsets = at("keypoint_offsets_m").padded(&self.keypoint_offsets_m, 0)?;
        Ok(skeleton.with_keypoint_offsets(KeypointOffsets::of_metres(offsets)))
    }

    /// The true body of a synthetic recording. Its joints need not fit the shape: foreign bodies have none.
    ///
    /// # Errors
    /// As [`Self::to_core`], but for offsets that do not fit.
    pub fn to_truth(&self) -> Result<body::Skeleton, DecodeError> {
        self.to_core().or_else(|_| {
            self.check_joints()?;
            let offsets = at("rest_offsets_m").vectors::<JOINTS, _>(&self.rest_offsets_m)?;
            Ok(body::Skeleton::with_joint_offsets(offsets))
        })
    }

    fn check_joints(&self) -> Result<(), DecodeError> {
        at("joint_names").length(self.joint_names.len(), JOINTS)?;
        at("parents").length(self.parents.len(), JOINTS)?;
        let found = self.joint_names.iter().zip(&self.parents);
        for (joint, (name, &parent)) in Joint::ALL.into_iter().zip(found) {
            if name != joint.name() {
                let reason = format!("joint {} is {name:?}, not {}", joint.index(), joint.name());
                return Err(at("joint_names").invalid(reason));
            }
            if parent != parent_index(joint) {
                return Err(at("parents").invalid(format!("{name} has parent {parent}")));
            }
        }
        Ok(())
    }
}

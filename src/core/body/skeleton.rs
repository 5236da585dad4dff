//! Our own T-pose template and the shape coefficients that move its joints.
//!
//! The template is a mean adult, halfway between the sexes, of stature 1.72 m. Joint-to-joint
//! lengths of thigh, shank, upper arm, forearm and trunk are rounded from \[de Leva 1996, tables 2
//! to 4\]; heights, foot length and head from \[Winter 2009, fig. 4.1\]; the hip centres sit at
//! 0.36 of the pelvic width from the midline \[Bell 1990\]; breadths from \[Gordon 2014\]. The
//! spine is divided so that its joints lie near L4, T12 and T9.
//!
//! A coefficient of 1 is one standard deviation of adults, both sexes together, rounded from the
//! coefficients of variation in \[Gordon 2014\]. The coefficient of a segment covers the variation
//! that stature does not explain. The last coefficients make a segment longer on the left and
//! shorter on the right: legs differ by some 4 mm \[Knutson 2005\].

use nalgebra::Vector3;

use super::joints::{JOINTS, Joint};
use super::keypoint_offsets::{KeypointOffsets, OFFSETS};

/// Number of shape coefficients that change both sides alike.
pub const SYMMETRIC_SHAPE: usize = 10;

/// Number of shape coefficients.
pub const SHAPE_COEFFICIENTS: usize = 17;

/// Number of body coefficients: the shape, then the keypoint offsets.
pub const BODY_COEFFICIENTS: usize = SHAPE_COEFFICIENTS + OFFSETS;

/// A shape coefficient.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[allow(missing_docs)]
#[repr(usize)]
pub enum ShapeCoefficient {
    Stature,
    Trunk,
    Thigh,
    Shank,
    Foot,
    ShoulderBreadth,
    HipBreadth,
    UpperArm,
    Forearm,
    Head,
    ThighSides,
    ShankSides,
    FootSides,
    ShoulderSides,
    HipSides,
    UpperArmSides,
    ForearmSides,
}

use ShapeCoefficient as C;

impl ShapeCoefficient {
    /// Every coefficient, in order.
    pub const ALL: [Self; SHAPE_COEFFICIENTS] = [
        C::Stature,
        C::Trunk,
        C::Thigh,
        C::Shank,
        C::Foot,
        C::ShoulderBreadth,
        C::HipBreadth,
        C::UpperArm,
        C::Forearm,
        C::Head,
        C::ThighSides,
        C::ShankSides,
        C::FootSides,
        C::ShoulderSides,
        C::HipSides,
        C::UpperArmSides,
        C::ForearmSides,
    ];

    /// Relative change of a length for a coefficient of 1.
    const fn spread(self) -> f64 {
        match self {
            C::Stature => 0.052,
            C::Trunk => 0.030,
            C::Thigh | C::Shank => 0.035,
            C::Foot => 0.035,
            C::ShoulderBreadth => 0.050,
            C::HipBreadth => 0.070,
            C::UpperArm | C::Forearm => 0.035,
            C::Head => 0.040,
            C::ShoulderSides | C::HipSides => 0.014,
            C::ThighSides | C::ShankSides | C::FootSides | C::UpperArmSides | C::ForearmSides => {
                0.007
            }
        }
    }
}

/// All coefficients in standard deviations; all zero is the template.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Shape(pub [f64; SHAPE_COEFFICIENTS]);

impl Shape {
    /// A shape of equal sides.
    pub fn symmetric(values: [f64; SYMMETRIC_SHAPE]) -> Self {
        Self(std::array::from_fn(|i| values.get(i).copied().unwrap_or(0.0)))
    }
}

/// The part of the body that an offset belongs to; it sets how shape scales the offset.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Part {
    Trunk,
    Shoulder,
    Hip,
    Thigh,
    Shank,
    Foot,
    UpperArm,
    Forearm,
    Head,
}

impl Part {
    /// Relative change of an offset's x, y and z for a change of 1 in `coefficient`. `side` is 1 on
    /// the left, -1 on the right and 0 in the middle.
    fn scale(self, coefficient: ShapeCoefficient, side: f64) -> Vector3<f64> {
        let axes = match (self, coefficient) {
            (_, C::Stature)
            | (Self::Thigh, C::Thigh)
            | (Self::Shank, C::Shank)
            | (Self::Foot, C::Foot)
            | (Self::UpperArm, C::UpperArm)
            | (Self::Forearm, C::Forearm)
            | (Self::Head, C::Head) => Vector3::new(1.0, 1.0, 1.0),
            (Self::Trunk | Self::Shoulder, C::Trunk) => Vector3::new(0.0, 1.0, 1.0),
            (Self::Shoulder, C::ShoulderBreadth) | (Self::Hip, C::HipBreadth) => Vector3::x(),
            (Self::Shoulder, C::ShoulderSides) | (Self::Hip, C::HipSides) => Vector3::x() * side,
            (Self::Thigh, C::ThighSides)
            | (Self::Shank, C::ShankSides)
            | (Self::Foot, C::FootSides)
            | (Self::UpperArm, C::UpperArmSides)
            | (Self::Forearm, C::ForearmSides) => Vector3::new(side, side, side),
            _ => Vector3::zeros(),
        };
        axes * coefficient.spread()
    }

    /// `template` under `shape`: template * (1 + sum of coefficient * scale), per axis.
    pub(super) fn scaled(self, template: &Vector3<f64>, side: f64, shape: &Shape) -> Vector3<f64> {
        C::ALL.iter().zip(shape.0).fold(*template, |offset, (&coefficient, value)| {
            offset + self.derivative(template, side, coefficient) * value
        })
    }

    /// The derivative of [`Part::scaled`] by one coefficient; constant, since it is linear.
    pub(super) fn derivative(
        self,
        template: &Vector3<f64>,
        side: f64,
        by: ShapeCoefficient,
    ) -> Vector3<f64> {
        template.component_mul(&self.scale(by, side))
    }
}

/// A joint's offset from its parent in the rest pose, left side and midline, and its part.
fn template_of(joint: Joint) -> ([f64; 3], Part) {
    match joint {
        Joint::Pelvis => ([0.0, 0.0, 0.0], Part::Trunk),
        Joint::LHip => ([0.086, -0.080, 0.000], Part::Hip),
        Joint::LKnee => ([0.000, -0.409, 0.005], Part::Thigh),
        Joint::LAnkle => ([0.000, -0.424, -0.020], Part::Shank),
        Joint::LFoot => ([0.015, -0.050, 0.130], Part::Foot),
        Joint::Spine1 => ([0.0, 0.105, -0.012], Part::Trunk),
        Joint::Spine2 => ([0.0, 0.125, 0.000], Part::Trunk),
        Joint::Spine3 => ([0.0, 0.055, 0.005], Part::Trunk),
        Joint::Neck => ([0.0, 0.205, -0.018], Part::Trunk),
        Joint::Head => ([0.0, 0.085, 0.035], Part::Head),
        Joint::LCollar => ([0.055, 0.120, -0.010], Part::Shoulder),
        Joint::LShoulder => ([0.117, 0.023, -0.008], Part::Shoulder),
        Joint::LElbow => ([0.275, 0.000, -0.006], Part::UpperArm),
        Joint::LWrist => ([0.264, 0.000, 0.006], Part::Forearm),
        right => {
            let (offset, part) = template_of(right.mirrored());
            ([-offset[0], offset[1], offset[2]], part)
        }
    }
}

/// A body of one shape: each joint's offset from its parent, and the keypoint offsets.
#[derive(Clone, Debug, PartialEq)]
pub struct Skeleton {
    shape: Shape,
    keypoint_offsets: KeypointOffsets,
    offsets: [Vector3<f64>; JOINTS],
    offsets_by_shape: [[Vector3<f64>; SHAPE_COEFFICIENTS]; JOINTS],
}

impl Skeleton {
    /// The body with a shape and without keypoint offsets.
    pub fn new(shape: Shape) -> Self {
        let template = Joint::ALL.map(|joint| {
            let (offset, part) = template_of(joint);
            (Vector3::from(offset), part, joint.side())
        });
        Self {
            shape,
            keypoint_offsets: KeypointOffsets::default(),
            offsets: template.map(|(offset, part, side)| part.scaled(&offset, side, &shape)),
            offsets_by_shape: template
                .map(|(offset, part, side)| C::ALL.map(|by| part.derivative(&offset, side, by))),
        }
    }

    /// The shape.
    pub fn shape(&self) -> &Shape {
        &self.shape
    }

    /// The same body with other keypoint offsets.
    pub fn with_keypoint_offsets(self, keypoint_offsets: KeypointOffsets) -> Self {
        Self { keypoint_offsets, ..self }
    }

    /// A body of another origin: its joints' offsets from their parents in the rest pose, metres,
    /// which no shape coefficient moves.
    pub fn with_joint_offsets(offsets: [Vector3<f64>; JOINTS]) -> Self {
        let offsets_by_shape = [[Vector3::zeros(); SHAPE_COEFFICIENTS]; JOINTS];
        Self { offsets, offsets_by_shape, ..Self::default() }
    }

    /// The keypoint offsets.
    pub fn keypoint_offsets(&self) -> &KeypointOffsets {
        &self.keypoint_offsets
    }

    /// All coefficients: the shape, then the keypoint offsets.
    pub fn coefficients(&self) -> impl Iterator<Item = f64> {
        self.shape.0.into_iter().chain(self.keypoint_offsets.0)
    }

    /// The same body with `values` as its first coefficients.
    pub fn with_coefficients(&self, values: &[f64]) -> Self {
        let (mut shape, mut keypoint_offsets) = (self.shape, self.keypoint_offsets);
        let all = shape.0.iter_mut().chain(&mut keypoint_offsets.0);
        all.zip(values).for_each(|(out, value)| *out = *value);
        Self::new(shape).with_keypoint_offsets(keypoint_offsets)
    }

    /// Offset of a joint from its parent in the rest pose, metres; zero for the pelvis.
    pub fn offset(&self, joint: Joint) -> &Vector3<f64> {
        &self.offsets[joint.index()]
    }

    /// Derivative of [`Skeleton::offset`] by each shape coefficient, metres per standard deviation.
    pub fn offset_by_shape(&self, joint: Joint) -> &[Vector3<f64>; SHAPE_COEFFICIENTS] {
        &self.offsets_by_shape[joint.index()]
    }
}

impl Default for Skeleton {
    fn default() -> Self {
        Self::new(Shape::default())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn length(skeleton: &Skeleton, joint: Joint) -> f64 {
        skeleton.offset(joint).norm()
    }

    #[test]
    fn the_template_is_symmetric() {
        let skeleton = Skeleton::default();
        for joint in Joint::ALL {
            let (left, right) = (skeleton.offset(joint), skeleton.offset(joint.mirrored()));
            assert_eq!((-left.x, left.y, left.z), (right.x, right.y, right.z));
        }
    }

    #[test]
    fn each_coefficient_moves_its_own_segments_only() {
        let template = Skeleton::default();
        let mut shape = Shape::default();
        shape.0[ShapeCoefficient::Thigh as usize] = 2.0;
        let long = Skeleton::new(shape);
        for joint in Joint::ALL {
            let change = length(&long, joint) / length(&template, joint).max(1e-9) - 1.0;
            let expected = if matches!(joint, Joint::LKnee | Joint::RKnee) { 0.07 } else { 0.0 };
            if joint != Joint::Pelvis {
                assert!((change - expected).abs() < 1e-12, "{} {change}", joint.name());
            }
        }
    }

    #[test]
    fn sides_change_left_and_right_in_opposite_directions() {
        let mut shape = Shape::default();
        shape.0[ShapeCoefficient::ThighSides as usize] = 2.0;
        let (body, template) = (Skeleton::new(shape), Skeleton::default());
        let change = |joint| length(&body, joint) / length(&template, joint) - 1.0;
        assert!((change(Joint::LKnee) - 0.014).abs() < 1e-12);
        assert!((change(Joint::RKnee) + 0.014).abs() < 1e-12);
        assert_eq!((change(Joint::LAnkle), change(Joint::RElbow)), (0.0, 0.0));
    }

    #[test]
    fn stature_scales_everything() {
        let mut shape = Shape::default();
        shape.0[ShapeCoefficient::Stature as usize] = 1.0;
        let (tall, template) = (Skeleton::new(shape), Skeleton::default());
        for joint in &Joint::ALL[1..] {
            assert!((length(&tall, *joint) / length(&template, *joint) - 1.052).abs() < 1e-12);
        }
    }
}

//! The target skeleton, read from a BVH file and converted to metres.

use std::path::{Path, PathBuf};

use nalgebra::{Matrix3, Vector3};

use super::map::{Map, UNITS, Up};
use super::names::{self, Convention};
use super::{Mapping, RetargetError};
use crate::core::body::{JOINTS, Joint};
use crate::io::formats::bvh::{Bvh, BvhError, BvhJoint, Channel};

/// Typical leg length, hip to knee to ankle, for guessing units, metres.
const LEG: f64 = 0.83;
/// The same of children and tall adults.
const LEGS: std::ops::Range<f64> = 0.42..1.4;
/// Unit of the CMU database's skeletons, 1 / 0.45 inches, in metres.
const CMU_UNIT: f64 = 0.056_444;
/// Directions within this angle of an axis snap to it, cosine of 20 degrees.
const UPRIGHT: f64 = 0.94;
/// The same of the heading: hips that were measured are a little uneven, but a rest pose may face any direction. Cosine
/// of 3 degrees.
const AHEAD: f64 = 0.9986;

/// The skeleton that poses are retargeted to.
#[derive(Clone, Debug, PartialEq)]
pub struct Target {
    /// Path of the file, for errors.
    pub(super) path: PathBuf,
    bvh: Bvh,
    guessed: [Option<usize>; JOINTS],
    convention: Option<Convention>,
    unit: f64,
    pub(super) up: Option<Up>,
    /// Offsets from the parent at zero rotation, metres.
    offsets: Vec<Vector3<f64>>,
    /// Positions at zero rotation, metres.
    rest: Vec<Vector3<f64>>,
}

impl Target {
    /// Reads a BVH file and ignores its frames. The map may give the unit.
    ///
    /// # Errors
    /// The file cannot be read or is not BVH.
    pub fn read(path: &Path, map: &Map) -> Result<Self, RetargetError> {
        let bytes = std::fs::read(path)
            .map_err(|source| RetargetError::Read { path: path.into(), source })?;
        let text = String::from_utf8(bytes).map_err(|_| BvhError::Encoding);
        let bvh = text
            .and_then(|text: String| Bvh::parse_hierarchy(&text))
            .map_err(|source| RetargetError::Bvh { path: path.into(), source })?;
        Ok(Self::new(bvh, path, map))
    }

    /// The skeleton of a parsed file; errors name `path`.
    pub fn new(bvh: Bvh, path: &Path, map: &Map) -> Self {
        let names: Vec<&str> = bvh.joints().iter().map(|joint| joint.name.as_str()).collect();
        let (guessed, convention) = names::guess(&names);
        let mut target = Self {
            path: path.into(),
            guessed,
            convention,
            unit: 1.0,
            up: map.up,
            offsets: bvh.joints().iter().map(|joint| joint.offset).collect(),
            rest: Vec::new(),
            bvh,
        };
        target.place();
        target.unit = map.unit.unwrap_or_else(|| guess_unit(target.left_leg(map)));
        target.offsets.iter_mut().for_each(|offset| *offset *= target.unit);
        target.place();
        target
    }

    /// Length of the left leg in the file's unit, before the mapping exists.
    fn left_leg(&self, map: &Map) -> Option<f64> {
        let leg = [Joint::LHip, Joint::LKnee, Joint::LAnkle].map(|joint| {
            let named = map.joints.iter().find(|(ours, _)| *ours == joint);
            match named {
                Some((_, name)) => self.bvh.joint(name.as_deref()?),
                None => self.guessed[joint.index()],
            }
        });
        self.path_length(&leg)
    }

    /// Computes rest positions from offsets.
    fn place(&mut self) {
        let mut rest: Vec<Vector3<f64>> = Vec::with_capacity(self.offsets.len());
        for (joint, offset) in self.joints().iter().zip(&self.offsets) {
            rest.push(joint.parent.map_or(Vector3::zeros(), |parent| rest[parent]) + offset);
        }
        self.rest = rest;
    }

    /// The parsed file.
    pub fn bvh(&self) -> &Bvh {
        &self.bvh
    }

    /// The joints, parents before children.
    pub fn joints(&self) -> &[BvhJoint] {
        self.bvh.joints()
    }

    /// The naming convention of the joints, if known.
    pub fn convention(&self) -> Option<Convention> {
        self.convention
    }

    /// Metres per unit of the file.
    pub fn unit(&self) -> f64 {
        self.unit
    }

    pub(super) fn guessed(&self) -> [Option<usize>; JOINTS] {
        self.guessed
    }

    pub(super) fn name(&self, joint: usize) -> &str {
        &self.joints()[joint].name
    }

    /// The names of all joints, for errors.
    pub(super) fn names(&self) -> String {
        self.joints().iter().map(|joint| joint.name.as_str()).collect::<Vec<_>>().join(", ")
    }

    /// Offset from the parent at zero rotation, metres.
    pub(super) fn offset(&self, joint: usize) -> &Vector3<f64> {
        &self.offsets[joint]
    }

    /// Position at zero rotation, metres.
    pub(super) fn rest(&self, joint: usize) -> &Vector3<f64> {
        &self.rest[joint]
    }

    /// Vector from a joint to `end`, or else to its first child or its end site; metres at zero
    /// rotation.
    pub(super) fn bone(&self, joint: usize, end: Option<usize>) -> Option<Vector3<f64>> {
        let child = || self.joints().iter().position(|other| other.parent == Some(joint));
        let site = || self.joints()[joint].end.map(|end| end * self.unit);
        match end.or_else(child) {
            Some(end) => Some(self.rest[end] - self.rest[joint]),
            None => site(),
        }
        .filter(|bone| bone.norm() > 1e-6)
    }

    /// Whether a joint is below another one or the same.
    pub(super) fn is_below(&self, joint: usize, above: usize) -> bool {
        self.upwards(joint).any(|at| at == above)
    }

    /// A joint, its parent, and so on to the root.
    pub(super) fn upwards(&self, joint: usize) -> impl Iterator<Item = usize> {
        std::iter::successors(Some(joint), |&at| self.joints()[at].parent)
    }

    /// Length of the path along joints; `None` if one is missing.
    fn path_length(&self, joints: &[Option<usize>]) -> Option<f64> {
        let pairs = joints.windows(2);
        pairs.map(|pair| Some((self.rest[pair[1]?] - self.rest[pair[0]?]).norm())).sum()
    }

    /// Mean length of the legs, hip to knee to ankle, metres.
    pub(super) fn leg_length(&self, mapping: &Mapping) -> f64 {
        let leg = |joints: [Joint; 3]| self.path_length(&joints.map(|joint| mapping.joint(joint)));
        let left = [Joint::LHip, Joint::LKnee, Joint::LAnkle];
        let sides = [left, left.map(Joint::mirrored)].map(|side| leg(side).unwrap_or(0.0));
        0.5 * (sides[0] + sides[1])
    }

    /// The joint whose position channels move the body: the hips, or else one above them.
    pub(super) fn mover(&self, hips: usize) -> Option<usize> {
        let moves = |&joint: &usize| {
            let channels = self.joints()[joint].channels.iter();
            channels.filter(|channel| matches!(channel, Channel::Position(_))).count() == 3
        };
        self.upwards(hips).find(moves)
    }

    /// F = `ours_from_target` at rest: maps the target's left to +x and its up to +y. Up within 20
    /// degrees of an axis of the file snaps to it, left within 3.
    pub(super) fn facing(&self, mapping: &Mapping) -> Result<Matrix3<f64>, RetargetError> {
        let at = |joint| mapping.joint(joint).map_or(Vector3::zeros(), |t| self.rest[t]);
        let middle = |joint: Joint| 0.5 * (at(joint) + at(joint.mirrored()));
        let shape =
            |what: &str| RetargetError::Shape { target: self.path.clone(), what: what.into() };
        let up = (middle(Joint::LShoulder) - middle(Joint::LHip)).try_normalize(1e-6);
        let up = snapped(
            up.ok_or_else(|| shape("its shoulders and hips have the same position"))?,
            UPRIGHT,
        );
        let across = at(Joint::LHip) - at(Joint::RHip);
        let left = (across - up * up.dot(&across)).try_normalize(1e-6);
        let left = snapped(
            left.ok_or_else(|| shape("its left and right hips have the same position"))?,
            AHEAD,
        );
        let left = (left - up * up.dot(&left)).normalize();
        Ok(Matrix3::from_columns(&[left, up, left.cross(&up)]).transpose())
    }
}

/// The nearest axis if the cosine of its angle is at least `near`, else `direction`.
fn snapped(direction: Vector3<f64>, near: f64) -> Vector3<f64> {
    let axis = direction.iamax();
    if direction[axis].abs() < near {
        return direction;
    }
    Vector3::ith(axis, direction[axis].signum())
}

/// The unit, in metres: a usual one that makes the leg a child's or a tall adult's, or else any that makes it nearest to
/// an adult's by ratio; 0.01 without a leg.
fn guess_unit(leg: Option<f64>) -> f64 {
    let Some(leg) = leg.filter(|leg| *leg > 0.0) else { return 0.01 };
    if let Some(unit) = [1.0, 0.01, 0.001].into_iter().find(|unit| LEGS.contains(&(leg * unit))) {
        return unit;
    }
    let off = |unit: &f64| (leg * unit / LEG).ln().abs();
    let units = UNITS.iter().map(|unit| unit.1).chain([CMU_UNIT]);
    units.min_by(|a, b| off(a).total_cmp(&off(b))).unwrap_or(0.01)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn units_are_guessed_from_the_leg() {
        let guesses = [(0.9, 1.0), (78.0, 0.01), (860.0, 0.001), (33.0, 0.0254), (14.8, CMU_UNIT)];
        let of_a_child = [(0.45, 1.0), (50.0, 0.01), (2.8, 0.3048)];
        let guesses = guesses.into_iter().chain(of_a_child);
        for (leg, unit) in guesses {
            assert_eq!(guess_unit(Some(leg)), unit, "{leg}");
        }
        assert_eq!((guess_unit(None), guess_unit(Some(0.0))), (0.01, 0.01));
    }

    #[test]
    fn directions_near_an_axis_snap_to_it() {
        assert_eq!(snapped(Vector3::new(0.05, -0.99, 0.1), UPRIGHT), -Vector3::y());
        let between = Vector3::new(0.6, 0.8, 0.0);
        assert_eq!(snapped(between, UPRIGHT), between);
    }
}

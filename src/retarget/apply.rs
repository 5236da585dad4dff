//! Applies our poses to a target skeleton.

use nalgebra::{Matrix3, Vector3};

use super::align::alignments;
use super::channels::reachable;
use super::mapping::Follow;
use super::{Map, Mapping, RetargetError, Target, Up};
use crate::core::body::{Bone, JOINTS, Joint, Pose, Posture, Skeleton};
use crate::core::so3;
use crate::io::wire::{self, RetargetedPose};

/// Retargets poses to a target skeleton.
#[derive(Clone, Debug)]
pub struct Retarget {
    target: Target,
    mapping: Mapping,
    hips: usize,
    /// The joint whose position channels move the body.
    mover: Option<usize>,
    /// Rotation `ours_from_file`, from the file's world to y up.
    world: Matrix3<f64>,
    /// Given by the user.
    scale: Option<f64>,
    leg: f64,
    fitted: Option<Fitted>,
}

/// Values that depend on the shape of our body.
#[derive(Clone, Debug)]
struct Fitted {
    skeleton: Skeleton,
    /// The alignments A_t.
    align: Vec<Matrix3<f64>>,
    scale: f64,
    /// Length of the target's legs over ours: the scale of heights.
    legs: f64,
    /// Height of the ankles above the balls of the feet, metres: ours, the target's.
    ankles: [f64; 2],
}

/// The target skeleton in a pose; our world, y up, metres.
#[derive(Clone, Debug, PartialEq)]
pub struct Figure {
    /// `parent_from_joint` of each joint of the target; `world_from_joint` of the first.
    pub locals: Vec<Matrix3<f64>>,
    /// `world_from_joint` rotations.
    pub rotations: Vec<Matrix3<f64>>,
    /// Joint centres.
    pub positions: Vec<Vector3<f64>>,
    /// Index of the joint that corresponds to our pelvis.
    pub hips: usize,
    /// The bones of Unity's humanoid that the target has, by our joints: the joint centre in the world, and the
    /// `world_from_joint` rotation, which is zero in the T-pose.
    ours: [Option<(Vector3<f64>, Matrix3<f64>)>; JOINTS],
}

impl Retarget {
    /// Maps our joints to the target's.
    ///
    /// # Errors
    /// Errors of [`Mapping::new`]; hips or legs of the target have no extent.
    pub fn new(target: Target, map: &Map) -> Result<Self, RetargetError> {
        let mapping = Mapping::new(&target, map)?;
        let leg = target.leg_length(&mapping);
        let shape =
            |what: &str| RetargetError::Shape { target: target.path.clone(), what: what.into() };
        if !(leg.is_finite() && leg > 1e-6) {
            return Err(shape("its legs have no length"));
        }
        let Some(hips) = mapping.joint(Joint::Pelvis) else {
            return Err(shape("it has no hips"));
        };
        let up = target.facing(&mapping)?.transpose() * Vector3::y();
        let up = target.up.unwrap_or(if up.z > 0.94 { Up::Z } else { Up::Y });
        let world = match up {
            Up::Y => Matrix3::identity(),
            Up::Z => Matrix3::new(1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, -1.0, 0.0),
        };
        let mover = target.mover(hips);
        Ok(Self { target, mapping, hips, mover, world, scale: map.scale, leg, fitted: None })
    }

    /// Whether the figure can move: the hips or a joint above them has three position channels.
    pub fn moves(&self) -> bool {
        self.mover.is_some()
    }

    /// The target.
    pub fn target(&self) -> &Target {
        &self.target
    }

    /// The mapping between our joints and the target's.
    pub fn mapping(&self) -> &Mapping {
        &self.mapping
    }

    /// Scale of the movement over the floor, target over ours.
    pub fn scale(&self, skeleton: &Skeleton) -> f64 {
        self.scale.unwrap_or(self.leg / leg_length(skeleton))
    }

    /// Rotation `ours_from_file` of the file's world.
    pub(super) fn world(&self) -> &Matrix3<f64> {
        &self.world
    }

    pub(super) fn mover(&self) -> Option<usize> {
        self.mover
    }

    /// The target in a pose of our body `skeleton`.
    ///
    /// # Errors
    /// The target's rest pose has no facing; [`Retarget::new`] excludes this.
    pub fn apply(&mut self, pose: &Pose, skeleton: &Skeleton) -> Result<Figure, RetargetError> {
        let known = self.fitted.take().filter(|fitted| fitted.skeleton == *skeleton);
        let fitted = match known {
            Some(fitted) => fitted,
            None => self.fit(skeleton)?,
        };
        let figure = self.figure(&fitted, &pose.posture(skeleton));
        self.fitted = Some(fitted);
        Ok(figure)
    }

    fn fit(&self, skeleton: &Skeleton) -> Result<Fitted, RetargetError> {
        let align = alignments(&self.target, &self.mapping, skeleton)?;
        let scale = self.scale(skeleton);
        let ours = -0.5 * (skeleton.offset(Joint::LFoot).y + skeleton.offset(Joint::RFoot).y);
        let legs = self.leg / leg_length(skeleton);
        let theirs = self.ankle_height(&align).unwrap_or(legs * ours);
        Ok(Fitted { skeleton: skeleton.clone(), align, scale, legs, ankles: [ours, theirs] })
    }

    /// Mean height of the target's ankles above its toes, metres.
    fn ankle_height(&self, align: &[Matrix3<f64>]) -> Option<f64> {
        let feet = [(Joint::LAnkle, Joint::LFoot), (Joint::RAnkle, Joint::RFoot)];
        let heights = feet.map(|(ankle, toes)| {
            let ankle = self.mapping.joint(ankle)?;
            Some(-(align[ankle] * self.target.bone(ankle, self.mapping.joint(toes))?).y)
        });
        let heights: Vec<f64> = heights.into_iter().flatten().collect();
        let count = heights.len();
        (count > 0).then(|| heights.iter().sum::<f64>() / count as f64)
    }

    fn figure(&self, fitted: &Fitted, posture: &Posture) -> Figure {
        let count = self.target.joints().len();
        let mut figure = Figure {
            locals: Vec::with_capacity(count),
            rotations: Vec::with_capacity(count),
            positions: Vec::with_capacity(count),
            hips: self.hips,
            ours: [None; JOINTS],
        };
        for (index, joint) in self.target.joints().iter().enumerate() {
            let parent = joint.parent.map(|parent| figure.rotations[parent]);
            // The parent of the first joint is the file's world.
            let outer = parent.unwrap_or(self.world);
            let wanted = match self.mapping.follow[index] {
                Follow::World => self.world,
                Follow::Parent => outer,
                Follow::Ours(from, to, share) => {
                    turned(posture, from, to, share) * fitted.align[index]
                }
            };
            let in_file = reachable(&joint.channels, &(outer.transpose() * wanted));
            let rotation = outer * in_file;
            figure.locals.push(if parent.is_some() { in_file } else { rotation });
            figure.rotations.push(rotation);
        }
        // The legs may hang from the hips or from the spine.
        self.place(&mut figure, &Vector3::zeros());
        let hips = self.hips_position(fitted, posture, &figure);
        self.place(&mut figure, &hips);
        figure.ours = Joint::ALL.map(|joint| {
            let index = self.mapping.humanoid(&self.target, joint)?;
            let turn = figure.rotations[index] * fitted.align[index].transpose();
            Some((figure.positions[index], turn))
        });
        figure
    }

    /// Where the target's hips are to be, metres, so that its hip joints are where ours are. `figure` has the hips at the
    /// origin.
    fn hips_position(&self, fitted: &Fitted, posture: &Posture, figure: &Figure) -> Vector3<f64> {
        let mut hips = Vector3::zeros();
        for joint in [Joint::LHip, Joint::RHip] {
            let scale = Vector3::new(fitted.scale, fitted.legs, fitted.scale);
            let wanted = posture.positions[joint.index()].component_mul(&scale);
            let own = self.mapping.joint(joint).map(|index| figure.positions[index]);
            hips += 0.5 * (wanted - own.unwrap_or_default());
        }
        hips.y += fitted.ankles[1] - fitted.legs * fitted.ankles[0];
        hips
    }

    /// Computes the positions of all joints from their rotations and the position of the hips, metres.
    fn place(&self, figure: &mut Figure, hips: &Vector3<f64>) {
        figure.positions.clear();
        for index in 0..figure.rotations.len() {
            figure.positions.push(self.position(index, figure, hips));
        }
    }

    /// Position of a joint, given the joints before it and the position of the hips, metres.
    fn position(&self, index: usize, figure: &Figure, hips: &Vector3<f64>) -> Vector3<f64> {
        let rest = self.target.rest(index);
        match (self.mapping.follow[index], self.mover) {
            _ if index == self.hips && self.mover.is_some() => *hips,
            // The joint that moves the body, or one between it and the hips.
            (Follow::World, Some(mover)) if self.target.is_below(index, mover) => {
                hips - self.world * (self.target.rest(self.hips) - rest)
            }
            (Follow::World, _) => self.world * rest,
            _ => match self.target.joints()[index].parent {
                Some(parent) => {
                    figure.positions[parent] + figure.rotations[parent] * self.target.offset(index)
                }
                None => self.world * rest,
            },
        }
    }
}

/// Our global rotation, interpolated from one joint to another by `share`.
fn turned(posture: &Posture, from: Joint, to: Joint, share: f64) -> Matrix3<f64> {
    let at = |joint: Joint| &posture.rotations[joint.index()];
    if from == to || share == 0.0 { *at(from) } else { so3::slerp(at(from), at(to), share) }
}

/// Mean length of our legs, hip to knee to ankle, metres.
fn leg_length(skeleton: &Skeleton) -> f64 {
    let legs = [Joint::LKnee, Joint::LAnkle, Joint::RKnee, Joint::RAnkle];
    0.5 * legs.iter().map(|&joint| skeleton.offset(joint).norm()).sum::<f64>()
}

impl Figure {
    /// The bones of Unity's humanoid that the target has, by our joints. The parent of a bone is the nearest bone
    /// above it that is there.
    pub fn bones(&self) -> Vec<Bone> {
        let bone = |joint: Joint| {
            let (position, turn) = self.ours[joint.index()]?;
            let above = std::iter::successors(joint.parent(), |joint| joint.parent());
            let parent = above.filter_map(|joint| self.ours[joint.index()]).next();
            let (origin, outer) = parent.unwrap_or((Vector3::zeros(), Matrix3::identity()));
            let inner = outer.transpose();
            Some((joint, inner * (position - origin), inner * turn))
        };
        Joint::ALL.into_iter().filter_map(bone).collect()
    }

    /// The figure as a message; times and state are copied from its source `pose`.
    pub fn message(&self, pose: &wire::Pose, target: &Target) -> RetargetedPose {
        let xyzw = |rotation| so3::xyzw_from_rotation(rotation).map(|component| component as f32);
        RetargetedPose {
            capture_time_ns: pose.capture_time_ns,
            due_time_ns: pose.due_time_ns,
            run_id: pose.run_id,
            timecode: pose.timecode.clone(),
            state: pose.state,
            hips: self.hips as u32,
            hips_position_m: self.positions[self.hips].iter().copied().collect(),
            local_rotations: self.locals.iter().flat_map(xyzw).collect(),
            joint_names: target.joints().iter().map(|joint| joint.name.clone()).collect(),
        }
    }
}

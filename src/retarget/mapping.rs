//! Maps each joint of the target to the joint of ours that it follows.
//!
//! Hips, limbs, neck and head are found by name, or given by the user. The rest follows from the
//! hierarchy:
//! - The trunk is the chain from the hips to the joint where arms and neck branch off. Joint k of n
//!   has our rotation at position 3 k / n, interpolated between pelvis (0), spine1, spine2 and
//!   spine3 (3). So any number of joints shares the bend of the spine.
//! - The same holds for the chain from there to the head (spine3, neck, head) and to each upper arm
//!   (spine3, collar).
//! - A joint that the user names keeps its own position in the chain.
//! - Other joints of the trunk from which a leg hangs follow the pelvis.
//! - All other joints move rigidly with their parent.

use super::map::Map;
use super::names::REQUIRED;
use super::{RetargetError, Target};
use crate::core::body::{JOINTS, Joint};

/// The source of a target joint's rotation.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Follow {
    /// Fixed in the file's world; for joints above the hips.
    World,
    /// Rigid with its parent.
    Parent,
    /// Our rotation, interpolated from the first joint to the second by a share in \[0, 1).
    Ours(Joint, Joint, f64),
}

/// The target's joint for each of ours, and the rotation that each target joint follows.
#[derive(Clone, Debug, PartialEq)]
pub struct Mapping {
    joints: [Option<usize>; JOINTS],
    pub(super) follow: Vec<Follow>,
}

/// The target joints that the user names, by our index.
type Named = [Option<usize>; JOINTS];

/// Our joint, and the joint of ours that it must be below.
const BELOW: [(Joint, Joint); 19] = [
    (Joint::LHip, Joint::Pelvis),
    (Joint::RHip, Joint::Pelvis),
    (Joint::LKnee, Joint::LHip),
    (Joint::RKnee, Joint::RHip),
    (Joint::LAnkle, Joint::LKnee),
    (Joint::RAnkle, Joint::RKnee),
    (Joint::LFoot, Joint::LAnkle),
    (Joint::RFoot, Joint::RAnkle),
    (Joint::LShoulder, Joint::Pelvis),
    (Joint::RShoulder, Joint::Pelvis),
    (Joint::Spine3, Joint::Pelvis),
    (Joint::LShoulder, Joint::Spine3),
    (Joint::RShoulder, Joint::Spine3),
    (Joint::LShoulder, Joint::LCollar),
    (Joint::RShoulder, Joint::RCollar),
    (Joint::LElbow, Joint::LShoulder),
    (Joint::RElbow, Joint::RShoulder),
    (Joint::LWrist, Joint::LElbow),
    (Joint::RWrist, Joint::RElbow),
];

impl Mapping {
    /// Maps the joints that the user names, then those found by name.
    ///
    /// # Errors
    /// The target does not have a given name, a required joint is missing, a joint is mapped to two
    /// of ours, or joints are in the wrong order in the hierarchy.
    pub fn new(target: &Target, map: &Map) -> Result<Self, RetargetError> {
        let mut joints = target.guessed();
        let mut named = [None; JOINTS];
        for (ours, name) in &map.joints {
            let theirs = name.as_ref().map(|name| their_joint(target, map, *ours, name));
            joints[ours.index()] = theirs.transpose()?;
            named[ours.index()] = joints[ours.index()];
        }
        check_complete(target, &joints)?;
        let follow = vec![Follow::Parent; target.joints().len()];
        let mut mapping = Self { joints, follow };
        mapping.check_once(target)?;
        mapping.check_below(target)?;
        mapping.share(target, map, &named)?;
        mapping.check_once(target)?;
        Ok(mapping)
    }

    /// The target's joint for one of ours; in a chain, the nearest one.
    pub fn joint(&self, ours: Joint) -> Option<usize> {
        self.joints[ours.index()]
    }

    /// The target's joint for a bone of Unity's humanoid, by our name. A trunk of one or two joints is named from
    /// below: spine, chest.
    pub(super) fn humanoid(&self, target: &Target, ours: Joint) -> Option<usize> {
        let trunk = [Joint::Spine1, Joint::Spine2, Joint::Spine3];
        let place = trunk.iter().position(|joint| *joint == ours);
        let (Some(place), Some(hips)) = (place, self.joint(Joint::Pelvis)) else {
            return self.joint(ours);
        };
        let top = trunk.iter().rev().find_map(|joint| self.joint(*joint))?;
        let whole = chain(target, hips, top);
        if whole.len() > trunk.len() { self.joint(ours) } else { whole.get(place + 1).copied() }
    }

    /// A text for people: pairs of mapped joints, our joints without a counterpart, and joints of
    /// the target that do not follow ours.
    pub fn summary(&self, target: &Target) -> String {
        let pairs = Joint::ALL.iter().filter_map(|ours| {
            let theirs = self.joint(*ours)?;
            Some(format!("{} -> {}", ours.name(), target.name(theirs)))
        });
        let mut text = pairs.collect::<Vec<_>>().join(", ");
        let missing: Vec<&str> = (Joint::ALL.iter())
            .filter(|ours| self.joint(**ours).is_none())
            .map(|ours| ours.name())
            .collect();
        let unmapped: Vec<&str> = (self.follow.iter().enumerate())
            .filter(|(_, follow)| !matches!(follow, Follow::Ours(..)))
            .map(|(joint, _)| target.name(joint))
            .collect();
        for (what, names) in [("no counterpart", missing), ("not mapped", unmapped)] {
            if !names.is_empty() {
                text += &format!("; {what}: {}", names.join(", "));
            }
        }
        text
    }

    fn check_below(&self, target: &Target) -> Result<(), RetargetError> {
        for (ours, parent_ours) in BELOW {
            let (Some(child), Some(parent)) = (self.joint(ours), self.joint(parent_ours)) else {
                continue;
            };
            if !target.is_below(child, parent) {
                return Err(not_below(target, (child, ours), (parent, parent_ours)));
            }
        }
        Ok(())
    }

    fn check_once(&self, target: &Target) -> Result<(), RetargetError> {
        for second in Joint::ALL {
            let earlier = Joint::ALL[..second.index()].iter();
            let same = |first: &&Joint| {
                self.joint(**first).is_some() && self.joint(**first) == self.joint(second)
            };
            if let (Some(&first), Some(joint)) = (earlier.clone().find(same), self.joint(second)) {
                return Err(twice(target, joint, first, second));
            }
        }
        Ok(())
    }

    /// Determines what each target joint follows.
    fn share(&mut self, target: &Target, map: &Map, named: &Named) -> Result<(), RetargetError> {
        use Joint::{LCollar, LShoulder, Pelvis, RCollar, RShoulder, Spine1, Spine2, Spine3};
        for joint in Joint::ALL {
            if let Some(theirs) = self.joint(joint) {
                self.follow[theirs] = Follow::Ours(joint, joint, 0.0);
            }
        }
        let Some(hips) = self.joint(Pelvis) else { return Ok(()) };
        target.upwards(hips).skip(1).for_each(|above| self.follow[above] = Follow::World);
        let branch = self.branch(target, hips);
        let chest = named[Spine3.index()].unwrap_or(branch);
        // From a named chest to where arms and head branch off, all turn with it.
        for &joint in &chain(target, chest, branch)[1..] {
            self.follow[joint] = Follow::Ours(Spine3, Spine3, 0.0);
        }
        let trunk = chain(target, hips, chest);
        self.spread(target, &trunk[1..], &[Pelvis, Spine1, Spine2, Spine3], named)?;
        // In Biped the legs hang from the spine. The chest bends all the same.
        let legs = [Joint::LHip, Joint::RHip].map(|hip| self.joint(hip));
        let carries = |at: usize| legs.iter().flatten().any(|&hip| target.is_below(hip, at));
        let is_free = |joint: &&usize| **joint != chest && !named.contains(&Some(**joint));
        for &joint in trunk[1..].iter().filter(is_free).filter(|&&joint| carries(joint)) {
            self.follow[joint] = Follow::Ours(Pelvis, Pelvis, 0.0);
        }
        self.share_neck(target, branch, named)?;
        for (collar, shoulder) in [(LCollar, LShoulder), (RCollar, RShoulder)] {
            let none = map.joints.iter().any(|(ours, to)| *ours == collar && to.is_none());
            let Some(arm) = self.joint(shoulder).filter(|_| !none) else { continue };
            let whole = chain(target, branch, arm);
            let between = &whole[1..whole.len().max(2) - 1];
            self.spread(target, between, &[Spine3, collar], named)?;
        }
        Ok(())
    }

    fn share_neck(
        &mut self,
        target: &Target,
        branch: usize,
        named: &Named,
    ) -> Result<(), RetargetError> {
        use Joint::{Head, Neck, Spine3};
        let (top, ours): (_, &[Joint]) = match (self.joint(Head), self.joint(Neck)) {
            (Some(head), _) => ((head, Head), &[Spine3, Neck, Head]),
            (None, Some(neck)) => ((neck, Neck), &[Spine3, Neck]),
            (None, None) => return Ok(()),
        };
        if top.0 == branch || !target.is_below(top.0, branch) {
            return Err(not_below(target, top, (branch, Spine3)));
        }
        self.joints[Neck.index()] = None;
        self.spread(target, &chain(target, branch, top.0)[1..], ours, named)
    }

    /// The joint where both arms and the head branch off.
    fn branch(&self, target: &Target, hips: usize) -> usize {
        let ends = [Joint::LShoulder, Joint::RShoulder, Joint::Neck, Joint::Head];
        let ends: Vec<usize> = ends.iter().filter_map(|&joint| self.joint(joint)).collect();
        let above = |at: &usize| ends.iter().all(|&end| end != *at && target.is_below(end, *at));
        ends.first().and_then(|&end| target.upwards(end).find(above)).unwrap_or(hips)
    }

    /// Distributes the rotations of `ours` over a chain; `ours[0]` belongs to the joint before it.
    fn spread(
        &mut self,
        target: &Target,
        chain: &[usize],
        ours: &[Joint],
        named: &Named,
    ) -> Result<(), RetargetError> {
        let fixed = self.fixed(target, chain, ours, named)?;
        let last = ours.len() - 1;
        for (index, &theirs) in chain.iter().enumerate() {
            let at = place_of(index + 1, &fixed);
            let (from, share) = (at.floor() as usize, at.fract());
            self.follow[theirs] = Follow::Ours(ours[from], ours[(from + 1).min(last)], share);
        }
        for (place, &joint) in ours.iter().enumerate().skip(1) {
            let off = |index: usize| (place_of(index + 1, &fixed) - place as f64).abs();
            let near = (0..chain.len()).filter(|&index| off(index) < 0.5);
            let near = near.min_by(|&a, &b| off(a).total_cmp(&off(b)));
            self.joints[joint.index()] = near.map(|index| chain[index]);
        }
        Ok(())
    }

    /// Pairs of positions in the chain and in `ours` that are fixed. Both start from 1; 0 is the
    /// joint before the chain.
    fn fixed(
        &self,
        target: &Target,
        chain: &[usize],
        ours: &[Joint],
        named: &Named,
    ) -> Result<Vec<(usize, usize)>, RetargetError> {
        let mut fixed = vec![(0, 0)];
        let mut before = (0, 0);
        for (place, &joint) in ours.iter().enumerate().skip(1) {
            let Some(theirs) = named[joint.index()] else { continue };
            let at = chain.iter().position(|&at| at == theirs).map(|at| at + 1);
            let Some(at) = at.filter(|at| *at > before.0) else {
                let parent = ours[before.1];
                let above = self.joint(parent).unwrap_or(theirs);
                return Err(not_below(target, (theirs, joint), (above, parent)));
            };
            before = (at, place);
            fixed.push(before);
        }
        if before.0 < chain.len() {
            fixed.push((chain.len(), ours.len() - 1));
        }
        Ok(fixed)
    }
}

/// The position in ours of a position in the chain: linear between the fixed ones.
fn place_of(at: usize, fixed: &[(usize, usize)]) -> f64 {
    for pair in fixed.windows(2) {
        let ((a, a_ours), (b, b_ours)) = (pair[0], pair[1]);
        if at <= b {
            let whole = (at - a) * (b_ours - a_ours);
            return a_ours as f64 + whole as f64 / (b - a) as f64;
        }
    }
    fixed.last().map_or(0.0, |last| last.1 as f64)
}

/// The joints from `top` down to `end`, both included; only `top` if `end` is not below it.
fn chain(target: &Target, top: usize, end: usize) -> Vec<usize> {
    if !target.is_below(end, top) {
        return vec![top];
    }
    let mut way: Vec<usize> = target.upwards(end).take_while(|&at| at != top).collect();
    way.push(top);
    way.reverse();
    way
}

fn their_joint(
    target: &Target,
    map: &Map,
    ours: Joint,
    name: &str,
) -> Result<usize, RetargetError> {
    target.bvh().joint(name).ok_or_else(|| RetargetError::TheirJoint {
        path: map.path.clone(),
        key: ours.name().into(),
        value: name.into(),
        target: target.path.clone(),
        theirs: target.names(),
    })
}

fn check_complete(target: &Target, joints: &[Option<usize>; JOINTS]) -> Result<(), RetargetError> {
    let missing = REQUIRED.into_iter().filter(|joint| joints[joint.index()].is_none());
    let missing: Vec<&'static str> = missing.map(Joint::name).collect();
    let Some(&example) = missing.first() else { return Ok(()) };
    Err(RetargetError::Missing {
        target: target.path.clone(),
        missing: missing.join(", "),
        example,
        theirs: target.names(),
    })
}

fn twice(target: &Target, joint: usize, first: Joint, second: Joint) -> RetargetError {
    RetargetError::Twice {
        target: target.path.clone(),
        joint: target.name(joint).into(),
        first: first.name(),
        second: second.name(),
    }
}

fn not_below(target: &Target, child: (usize, Joint), parent: (usize, Joint)) -> RetargetError {
    RetargetError::NotBelow {
        target: target.path.clone(),
        child: target.name(child.0).into(),
        ours: child.1.name(),
        parent: target.name(parent.0).into(),
        parent_ours: parent.1.name(),
    }
}

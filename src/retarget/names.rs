//! Finds our joints in a skeleton by the joint names of common programs.
//!
//! Case, separators and a prefix (`mixamorig:`, `Character1_`) are ignored. Spine joints and
//! collars are not found by name but from the hierarchy, see `mapping`.

use crate::core::body::{JOINTS, Joint};

/// A naming convention of joints.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[allow(missing_docs)]
pub enum Convention {
    Mixamo,
    Cmu,
    MotionBuilder,
    Unity,
    Ours,
    Daz,
    Anatomical,
    Unreal,
    Biped,
}

impl Convention {
    /// The display name.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Mixamo => "Mixamo",
            Self::Cmu => "CMU",
            Self::MotionBuilder => "MotionBuilder",
            Self::Unity => "Unity",
            Self::Ours => "bundlemocap",
            Self::Daz => "Daz",
            Self::Anatomical => "anatomical",
            Self::Unreal => "Unreal",
            Self::Biped => "Biped",
        }
    }
}

/// Joint names of a convention. Names of limbs come without the marker of the side.
struct Names {
    convention: Convention,
    /// Markers of left and right in the names.
    sides: [&'static str; 2],
    /// Whether the marker is at the end of the name.
    at_end: bool,
    hips: &'static [&'static str],
    neck: &'static [&'static str],
    /// Upper leg, lower leg, foot, upper arm, lower arm, hand.
    limbs: [&'static str; 6],
    toes: &'static [&'static str],
}

const LEFT_RIGHT: [&str; 2] = ["left", "right"];
const L_R: [&str; 2] = ["l", "r"];

const TABLE: [Names; 7] = [
    Names {
        convention: Convention::MotionBuilder,
        sides: LEFT_RIGHT,
        at_end: false,
        hips: &["hips"],
        neck: &["neck"],
        limbs: ["upleg", "leg", "foot", "arm", "forearm", "hand"],
        toes: &["toebase", "toe", "toes"],
    },
    Names {
        convention: Convention::Unity,
        sides: LEFT_RIGHT,
        at_end: false,
        hips: &["hips"],
        neck: &["neck"],
        limbs: ["upperleg", "lowerleg", "foot", "upperarm", "lowerarm", "hand"],
        toes: &["toes", "toebase", "toe"],
    },
    Names {
        convention: Convention::Ours,
        sides: L_R,
        at_end: false,
        hips: &["pelvis"],
        neck: &["neck"],
        limbs: ["hip", "knee", "ankle", "shoulder", "elbow", "wrist"],
        toes: &["foot"],
    },
    Names {
        convention: Convention::Daz,
        sides: L_R,
        at_end: false,
        hips: &["hip"],
        neck: &["neck"],
        limbs: ["thigh", "shin", "foot", "shldr", "forearm", "hand"],
        toes: &["toe", "toes"],
    },
    Names {
        convention: Convention::Anatomical,
        sides: LEFT_RIGHT,
        at_end: false,
        hips: &["hips", "pelvis", "hip"],
        neck: &["neck"],
        limbs: ["hip", "knee", "ankle", "shoulder", "elbow", "wrist"],
        toes: &["toe", "toes", "toebase", "foot"],
    },
    Names {
        convention: Convention::Unreal,
        sides: L_R,
        at_end: true,
        hips: &["pelvis"],
        neck: &["neck01", "neck"],
        limbs: ["thigh", "calf", "foot", "upperarm", "lowerarm", "hand"],
        toes: &["ball"],
    },
    Names {
        convention: Convention::Biped,
        sides: L_R,
        at_end: false,
        hips: &["pelvis"],
        neck: &["neck"],
        limbs: ["thigh", "calf", "foot", "upperarm", "forearm", "hand"],
        toes: &["toe0"],
    },
];

/// Our joints of one side in the order of [`Names::limbs`].
const LIMBS: [Joint; 6] =
    [Joint::LHip, Joint::LKnee, Joint::LAnkle, Joint::LShoulder, Joint::LElbow, Joint::LWrist];

impl Names {
    /// The normalised names of a joint, the most likely first.
    fn of(&self, joint: Joint) -> Vec<String> {
        let left = if joint.mirrored() < joint { joint.mirrored() } else { joint };
        let plain: &[&str] = match left {
            Joint::Pelvis => self.hips,
            Joint::Neck => self.neck,
            Joint::Head => &["head"],
            Joint::LFoot => self.toes,
            _ => match LIMBS.iter().position(|&limb| limb == left) {
                Some(at) => &self.limbs[at..=at],
                None => &[],
            },
        };
        if joint.mirrored() == joint {
            return plain.iter().map(|&name| name.to_owned()).collect();
        }
        let side = self.sides[usize::from(joint != left)];
        let with_side = |name: &&str| match self.at_end {
            true => format!("{name}{side}"),
            false => format!("{side}{name}"),
        };
        plain.iter().map(with_side).collect()
    }

    /// The joints found among normalised names, by our index.
    fn find(&self, plain: &[String]) -> [Option<usize>; JOINTS] {
        Joint::ALL.map(|joint| {
            let names = self.of(joint);
            names.iter().find_map(|name| plain.iter().position(|found| found == name))
        })
    }
}

/// Joints that retargeting requires.
pub(super) const REQUIRED: [Joint; 11] = [
    Joint::Pelvis,
    Joint::LHip,
    Joint::RHip,
    Joint::LKnee,
    Joint::RKnee,
    Joint::LAnkle,
    Joint::RAnkle,
    Joint::LShoulder,
    Joint::RShoulder,
    Joint::LElbow,
    Joint::RElbow,
];

/// The joints found by the convention that finds most, by our index, and that convention if it
/// finds more than half of the required joints.
pub(super) fn guess(names: &[&str]) -> ([Option<usize>; JOINTS], Option<Convention>) {
    let plain = plain(names);
    let found = TABLE.iter().map(|table| (table.find(&plain), table.convention));
    let score = |joints: &[Option<usize>; JOINTS]| {
        let required = REQUIRED.iter().filter(|joint| joints[joint.index()].is_some()).count();
        (required, joints.iter().flatten().count())
    };
    let mut best = ([None; JOINTS], Convention::MotionBuilder);
    for candidate in found {
        if score(&candidate.0) > score(&best.0) {
            best = candidate;
        }
    }
    let (joints, convention) = best;
    let known = 2 * score(&joints).0 > REQUIRED.len();
    (joints, known.then(|| refined(convention, names, &plain)))
}

/// Distinguishes Mixamo and CMU, which name limbs as MotionBuilder does. (CMU's other conversion
/// uses Daz names.)
fn refined(convention: Convention, names: &[&str], plain: &[String]) -> Convention {
    let has = |name: &str| plain.iter().any(|found| found == name);
    match convention {
        Convention::MotionBuilder
            if names.iter().any(|name| name.to_lowercase().starts_with("mixamorig")) =>
        {
            Convention::Mixamo
        }
        Convention::MotionBuilder if has("lhipjoint") || has("lowerback") => Convention::Cmu,
        other => other,
    }
}

/// Prefixes of programs after separators are removed.
const PREFIXES: [&str; 3] = ["mixamorig", "bip001", "bip01"];

/// Normalised names: lower case, without prefix and separators.
fn plain(names: &[&str]) -> Vec<String> {
    let shared = shared_prefix(names);
    let plain = |name: &&str| {
        let name = name.get(shared..).unwrap_or(name);
        let name = name.rsplit([':', '|']).next().unwrap_or(name);
        let mut text: String = name.chars().filter(|c| c.is_alphanumeric()).collect();
        text.make_ascii_lowercase();
        let cut = PREFIXES.iter().find_map(|prefix| text.strip_prefix(prefix));
        cut.filter(|rest| !rest.is_empty()).map(str::to_owned).unwrap_or(text)
    };
    names.iter().map(plain).collect()
}

/// Length in bytes of the prefix that all names share, up to its last `_`, `:`, `.`, `-` or `|`.
fn shared_prefix(names: &[&str]) -> usize {
    let Some((first, rest)) = names.split_first() else { return 0 };
    let same = |name: &&str| first.bytes().zip(name.bytes()).take_while(|(a, b)| a == b).count();
    let shared = rest.iter().map(same).min().unwrap_or(0);
    first.as_bytes()[..shared].iter().rposition(|b| b"_:.-|".contains(b)).map_or(0, |at| at + 1)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn prefixes_case_and_separators_are_ignored() {
        let same = |names: &[&str], expected: &[&str]| assert_eq!(plain(names), expected);
        same(&["mixamorig:Hips", "mixamorig:LeftUpLeg"], &["hips", "leftupleg"]);
        same(&["mixamorig1_Hips", "mixamorig1_Spine"], &["hips", "spine"]);
        same(&["Character1_Hips", "Character1_Left Leg"], &["hips", "leftleg"]);
        same(&["Bip01 Pelvis", "Bip01 L Thigh"], &["pelvis", "lthigh"]);
        same(&["pelvis", "l_hip"], &["pelvis", "lhip"]);
        same(&["Ünder_a", "Ünder_b"], &["a", "b"]);
        same(&["Armature|Hips", "LEFT-Arm"], &["hips", "leftarm"]);
    }

    #[test]
    fn few_names_match_no_convention() {
        assert_eq!(guess(&["Hips", "LeftFoot", "RightFoot"]).1, None);
        assert_eq!(guess(&[]), ([None; JOINTS], None));
    }
}

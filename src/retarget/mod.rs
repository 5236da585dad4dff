//! Retargets poses of our body to another skeleton, given by the hierarchy of a BVH file.
//!
//! [`Target`] is that skeleton, [`Map`] holds the user's settings, [`Mapping`] maps its joints to
//! ours, and [`Retarget`] applies poses:
//!
//! - Global rotations: G_t = G_j A_t. The alignment A_t rotates the target's zero pose (T, A, or
//!   with its own axes) to our T-pose. For limbs, A_t is the alignment of the parent bone followed
//!   by the smallest rotation that aligns the target's bone with ours. So limbs have the same
//!   direction as ours in every pose. Trunk, shoulders and head keep the target's own rest posture,
//!   and feet keep their slope, because these differ between bodies at rest.
//! - Spine and neck: chains of any length; see [`Mapping`].
//! - Position: the movement of the middle of the hip joints is scaled by the ratio s of the leg
//!   lengths (hip, knee, ankle), or over the floor by a given scale. Its height is scaled about the ankles, y' = s (y - a) + a', where
//!   a and a' are the heights of our and the target's ankles above the balls of the feet. So feet
//!   on our floor are on the target's floor.
//!
//! Our world is y up, metres. The target's rest pose may face anywhere; its left and right hips
//! give the heading.
//!
//! ```
//! use bundlemocap::core::body::{Pose, Skeleton};
//! use bundlemocap::retarget::{Map, Retarget, Target};
//! # let folder = tempfile::tempdir()?;
//! # let path = folder.path().join("target.bvh");
//! # bundlemocap::io::formats::bvh::write_bvh(&path, &Skeleton::default(), 60.0, [])?;
//! let target = Target::read(&path, &Map::default())?;
//! let mut retarget = Retarget::new(target, &Map::default())?;
//! let figure = retarget.apply(&Pose::rest(), &Skeleton::default())?;
//! assert_eq!(figure.positions.len(), 22);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

mod align;
mod apply;
mod channels;
mod map;
mod mapping;
mod names;
mod target;

use std::path::PathBuf;

pub use apply::{Figure, Retarget};
pub use channels::Channels;
pub use map::{Map, Up};
pub use mapping::Mapping;
pub use names::Convention;
pub use target::Target;

use crate::io::formats::bvh::BvhError;

/// Why poses cannot be retargeted to a skeleton.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
#[allow(missing_docs)]
pub enum RetargetError {
    #[error("cannot read {path}: {source}; check the path")]
    Read { path: PathBuf, source: std::io::Error },
    #[error("{path}: {source}")]
    Bvh { path: PathBuf, source: BvhError },
    #[error("{path}, line {line}: {reason}; a map has `scale`, `unit`, `up` and a table [joints]")]
    Map { path: PathBuf, line: usize, reason: String },
    #[error("{path}: {key} is {value}, but must be {allowed}")]
    Value { path: PathBuf, key: String, value: String, allowed: &'static str },
    #[error("{path}: joints.{key} is not one of our joints; use one of {ours}")]
    OurJoint { path: PathBuf, key: String, ours: String },
    #[error("{path}: joints.{key} = {value:?}, but {target} has no such joint; it has {theirs}")]
    TheirJoint { path: PathBuf, key: String, value: String, target: PathBuf, theirs: String },
    #[error(
        "{target}: no joint found for {missing}; name them in a --map file, for example \
         [joints] {example} = \"...\"; the skeleton has {theirs}"
    )]
    Missing { target: PathBuf, missing: String, example: &'static str, theirs: String },
    #[error("{target}: {joint} is mapped to both {first} and {second}; change one with --map")]
    Twice { target: PathBuf, joint: String, first: &'static str, second: &'static str },
    #[error(
        "{target}: {child} ({ours}) must be below {parent} ({parent_ours}) in the hierarchy; name \
         other joints with --map"
    )]
    NotBelow {
        target: PathBuf,
        child: String,
        ours: &'static str,
        parent: String,
        parent_ours: &'static str,
    },
    #[error("{target}: {what}; the skeleton cannot be used")]
    Shape { target: PathBuf, what: String },
}

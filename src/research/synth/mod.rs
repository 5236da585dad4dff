//! Synthetic recordings with ground truth.
//!
//! The cameras of a rig see a [`Motion`] (or any function from seconds to a pose) through detectors
//! with realistic errors ([`Noise`]). A seed determines everything; frames can be generated in any
//! order.
//!
//! ```
//! use bundlemocap::core::body::Skeleton;
//! use bundlemocap::research::synth::{Motion, MotionStyle, Recording, ring_rig};
//!
//! let skeleton = Skeleton::default();
//! let motion = Motion::new(&skeleton, MotionStyle::default());
//! let rig = ring_rig(4, 4.0, 1.6)?;
//! let mut recording = Recording::new(rig, skeleton, |seconds| motion.pose(seconds));
//! recording.frames = 10;
//! assert_eq!(recording.detections().count(), 40);
//! assert_eq!(recording.poses().count(), 10);
//! # Ok::<(), bundlemocap::core::camera::CameraError>(())
//! ```

mod body;
mod crowd;
mod curves;
mod detector;
mod h36m;
mod leg;
mod meeting;
mod motion;
mod noise;
mod points;
mod protocol;
mod recording;
mod rigs;
mod ring;
mod sequence;
mod skinned;
mod write;

pub use body::{Body, Places};
pub use crowd::Crowd;
pub use detector::position;
pub use h36m::{H36mError, h36m_rig};
pub use meeting::Meeting;
pub use motion::{Motion, MotionStyle};
pub use noise::Noise;
pub use protocol::{Protocol, SequenceChoice};
pub use recording::{Recording, bumped, through};
pub use rigs::{RigError, rig_named, tdhp_like_rig};
pub use ring::{ring_around, ring_rig};
pub use sequence::{Sequence, sequence};
pub use skinned::Skinned;

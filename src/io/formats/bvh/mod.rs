//! Reads and writes BVH files.

mod motion_file;
mod read;
mod write;

pub use motion_file::HierarchyWriter;
pub use read::{Bvh, BvhError, BvhJoint, Channel};
pub use write::{BvhWriter, write_bvh};

//! C3D files of markers.
//!
//! A file has a header of 512 bytes, then parameters in groups, then the frames. A frame has four numbers for each
//! marker: x, y, z, and its residual, which is negative if its place is not known.
//!
//! Source: the C3D file format user guide, c3d.org.

mod read;
mod write;

pub(super) use read::{is_c3d, parse};
pub use write::write_c3d;

const BLOCK: usize = 512;
/// The second byte of the header and of the parameters.
const MAGIC: u8 = 0x50;
/// The number of processors that are little endian.
const INTEL: u8 = 84;

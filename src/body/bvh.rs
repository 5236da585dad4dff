//! BVH files as data: hierarchy and motion, no unit and no up axis.

//! Poses of our body on another skeleton.

//! `Rig` to and from [`crate::camera::Rig`].

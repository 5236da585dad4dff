//! The configuration file: every module's `Config` in one tree.

//! Code that `build.rs` generates from `schemas/*.proto`.
#![allow(missing_docs, clippy::all)]

include!(concat!(env!("OUT_DIR"), "/bundlemocap.v1.rs"));

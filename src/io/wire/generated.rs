//! What `build.rs` makes of `schemas/*.proto`.
#![allow(missing_docs, clippy::all)]

include!(concat!(env!("OUT_DIR"), "/bundlemocap.v1.rs"));

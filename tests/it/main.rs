//! Integration tests, one binary. Tests of a feature are built with it.

#[cfg(feature = "research")]
mod association;
#[cfg(all(feature = "cli", feature = "zenoh", feature = "iceoryx2"))]
mod bus;
#[cfg(feature = "research")]
mod calibration;
#[cfg(feature = "research")]
mod calibration_formats;
mod camera;
#[cfg(feature = "research")]
mod check;
#[cfg(feature = "cli")]
mod cli;
#[cfg(feature = "cli")]
mod clocks;
#[cfg(feature = "cli")]
mod cluster;
#[cfg(all(feature = "cli", feature = "zenoh", feature = "iceoryx2"))]
mod doctor;
#[cfg(feature = "cli")]
mod experiments;
#[cfg(feature = "research")]
mod export;
#[cfg(feature = "research")]
mod followed;
mod frame_rate;
#[cfg(feature = "research")]
mod genlock;
mod import;
#[cfg(feature = "cli")]
mod interactions;
mod jacobians;
mod layers;
#[cfg(feature = "cli")]
mod live;
#[cfg(all(feature = "cli", feature = "zenoh"))]
mod machines;
mod manifold;
#[cfg(feature = "cli")]
mod mend;
mod messages;
#[cfg(feature = "research")]
mod methods;
#[cfg(all(feature = "cli", feature = "zenoh", feature = "iceoryx2"))]
mod node;
#[cfg(feature = "cli")]
mod program;
#[cfg(all(feature = "cli", feature = "zenoh", feature = "iceoryx2"))]
mod python;
mod recording;
#[cfg(all(feature = "cli", feature = "zenoh", feature = "iceoryx2"))]
mod retarget;
#[cfg(feature = "cli")]
mod several;
#[cfg(feature = "cli")]
mod sharing;
#[cfg(feature = "cli")]
mod slate;
mod solve;
#[cfg(feature = "research")]
mod stage;
#[cfg(feature = "live")]
mod storms;
mod support;
#[cfg(feature = "research")]
mod synth;
#[cfg(all(feature = "cli", feature = "zenoh", feature = "iceoryx2"))]
mod take;
mod timing;
#[cfg(all(feature = "cli", feature = "zenoh"))]
mod tls;
#[cfg(all(feature = "cli", feature = "zenoh", feature = "iceoryx2"))]
mod tools;
mod tracker;
#[cfg(feature = "research")]
mod train;
#[cfg(feature = "view")]
mod view;
#[cfg(all(feature = "cli", feature = "zenoh", feature = "iceoryx2"))]
mod vmc;

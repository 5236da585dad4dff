//! Tracking one performer: a machine that does no I/O.
//!
//! The contract: give inputs to [`Tracker::handle`], then call [`Tracker::poll`] until it is empty.
//! The machine reads no clock, file or socket. Solving is I/O too: [`Output::Solve`] holds a
//! [`Job`], which [`Solver::solve`] answers, on any thread, and the answer comes back as
//! [`Input::Solved`]. The same inputs in the same order give the same outputs, to the byte.
//!
//! A window is `window_frames` nominal frame periods long, of which the first `publish_frames` are
//! final when it is solved; the next window begins after them. It closes when every camera's
//! watermark (the latest capture time it has shown) has passed its end, or when the newest capture
//! time or tick is `deadline_frames` past it. At most one job is out at a time.

mod acquire;
mod answer;
mod association;
mod config;
mod effort;
mod event;
mod intake;
mod job;
mod noise;
mod offset_estimator;
mod playout;
mod port;
mod solver;
mod spin_pool;
mod tracker;
mod verdict;
mod waiting;

pub use association::follow;
pub use config::{Config, Gate};
pub use effort::Effort;
pub use event::{Event, EventKind};
pub use job::{
    Job, Outcome, ProvisionalFit, Residual, Solution, Task, TimedKeyframe, Tracked, Verdict,
};
pub use noise::Noise;
pub use offset_estimator::OffsetEstimator;
pub use playout::{Latency, Live};
pub use port::{Input, KeyframeAt, Output, Performer, WindowReport};
pub use solver::Solver;
pub use tracker::Tracker;

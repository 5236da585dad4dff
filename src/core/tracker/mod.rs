//! Tracking one performer, without I/O.
//!
//! Give an input to [`Tracker::handle`], then call [`Tracker::poll`] until it returns `None`. The
//! tracker reads no clock, no file and no socket. It does not solve either: [`Output::Solve`] holds
//! a [`Job`], [`Solver::solve`] solves it on any thread, and the solution goes back as
//! [`Input::Solved`]. The same inputs in the same order give the same outputs, byte for byte. On
//! one thread, [`Tracker::poll_and_solve`] does both, and [`run_to_end`] runs a whole recording.
//!
//! A window is `window_frames` nominal frame periods long, times a whole number for cameras that are faster
//! than `reference_rate_hz`. After its solve, its first
//! `publish_frames` are final, and the next window starts after them. A window closes when every
//! camera that is waited for has sent a frame at its end or later, or when its deadline passes: `deadline_frames`
//! after its end, measured on the capture time that two cameras have reached or, live, on the clock of
//! [`Input::Tick`]. The solver has at most one window at a time.
//!
//! # A performer's states
//! 1. **Searching.** Robust triangulation matches persons across the views of a frame set. The best
//!    match gives the root; fits start from several poses, and the best one is the first keyframe.
//! 2. **Acquiring.** The first `shape_windows` windows are solved together, for the body too. After
//!    that, each `body_windows`th window adds to the estimate. If a fit is bad in the first eight, the
//!    body is dropped: from a wrong body the estimate converges to a wrong one.
//! 3. **Tracking.** In each view the performer is the person nearest to the predicted body. The solve
//!    starts from the previous window's look-ahead, or from the last motion continued, whichever costs
//!    less. If the new frames cost far more than the known ones, the new keyframes are first solved one
//!    by one with a looser loss. Where the views agree on a point and the body is far from it, a first
//!    solve has a wide loss for its detections. Every `fresh_fit_windows`th window, if a point lies far
//!    from two views all the time, a fresh fit is tried.
//! 4. **Coasting.** Too little is visible. The last motion continues and decays, for at most
//!    `coast_windows` windows; from the second one on the performer is searched elsewhere too.
//! 5. **Lost.** The fit is bad, or coasting took too long. The search starts again with the known body.

mod acquire;
mod agreement;
mod apply;
mod association;
mod body_estimator;
mod cameras;
mod config;
mod effort;
mod event;
mod frame_rate;
mod hand_over;
mod idle;
pub(super) mod intake;
mod job;
mod mending;
mod noise;
mod playout;
mod port;
mod published;
mod send;
mod solver;
mod spin_pool;
mod state_machine;
mod take_over;
mod verdict;
pub(super) mod waiting;
mod window;

pub use crate::core::limits::OutOfRange;
pub use crate::core::optimise::{OptimiserKind, Summary};
pub use agreement::Unfollowed;
#[doc(hidden)]
pub use association::follow;
#[doc(hidden)]
pub use body_estimator::{
    BodyEstimator, EstimateNumbers, OTHER_SIZE, WINDOWS as BODY_WINDOWS, shared_body,
};
pub use config::{Config, Gate};
pub use effort::Effort;
pub use event::{Event, EventKind};
#[doc(hidden)]
pub use frame_rate::{FramePeriod, FrameRate, KEPT as RATE_FRAMES, UnitCheck};
pub use hand_over::{HandOver, Motion};
pub use job::{Job, Outcome, Placed, PoseAt, ProvisionalFit, Solution, Task, Tracked, Verdict};
pub use noise::{Noise, Residual};
pub use playout::{Latency, Live};
pub use port::{Input, Output, WindowReport};
pub use solver::{Solver, solve_aside};
pub use state_machine::{Tracker, run_to_end};
pub(super) use window::FALLBACK_PERIOD;

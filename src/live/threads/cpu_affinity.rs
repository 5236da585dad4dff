//! A processor core for the solver.
//!
//! The scheduler may let a busy thread finish its time slice, some milliseconds, before it wakes
//! another thread on the same core. So the solver gets a core of its own, and all other threads of
//! the process, including the one that publishes on time, stay off it.

#[cfg(target_os = "linux")]
use rustix::thread::{CpuSet, sched_getaffinity, sched_setaffinity};

/// The solver's core.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SolverCore(usize);

impl SolverCore {
    /// Reserves the last core that the process may use: this thread, and threads that it starts
    /// later, stay off it. `None` with fewer than two cores, or if the system refuses.
    #[cfg(target_os = "linux")]
    pub fn reserve() -> Option<Self> {
        let mut allowed = sched_getaffinity(None).ok()?;
        let last = (0..CpuSet::MAX_CPU).rfind(|&core| allowed.is_set(core))?;
        allowed.unset(last);
        if allowed.count() == 0 {
            return None;
        }
        sched_setaffinity(None, &allowed).ok().map(|()| Self(last))
    }

    /// `None`: CPU affinity is not supported on this system.
    #[cfg(not(target_os = "linux"))]
    pub fn reserve() -> Option<Self> {
        None
    }

    /// Moves this thread to the core.
    #[cfg(not(target_os = "linux"))]
    pub(crate) fn enter(self) {}

    /// Moves this thread to the core.
    #[cfg(target_os = "linux")]
    pub(crate) fn enter(self) {
        let mut only = CpuSet::new();
        only.set(self.0);
        if let Err(error) = sched_setaffinity(None, &only) {
            tracing::warn!("the solver has no core of its own: {error}");
        }
    }
}

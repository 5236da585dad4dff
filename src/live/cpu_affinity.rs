//! The solver's processor core.
//!
//! The scheduler lets a thread that computes finish its time slice, some milliseconds, before it
//! wakes another one on the same core. So the solver gets a core of its own, and the thread that
//! publishes on time, with all others of the process, keeps off it.

#[cfg(target_os = "linux")]
use rustix::thread::{CpuSet, sched_getaffinity, sched_setaffinity};

/// The solver's core.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SolverCore(usize);

impl SolverCore {
    /// Sets the last core that the process may use aside: this thread, and those that it starts
    /// from now on, keep off it. `None` with fewer than two cores, or where the system refuses.
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

    /// None: this system has no affinity that is known here.
    #[cfg(not(target_os = "linux"))]
    pub fn reserve() -> Option<Self> {
        None
    }

    /// Moves this thread to the core.
    #[cfg(not(target_os = "linux"))]
    pub(super) fn enter(self) {}

    /// Moves this thread to the core.
    #[cfg(target_os = "linux")]
    pub(super) fn enter(self) {
        let mut only = CpuSet::new();
        only.set(self.0);
        if let Err(error) = sched_setaffinity(None, &only) {
            tracing::warn!("the solver shares its core: {error}");
        }
    }
}

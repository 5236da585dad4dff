//! Threads that solve in parallel.

use std::hint::spin_loop;
use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, Ordering};

use rayon::{ThreadPool, ThreadPoolBuildError, ThreadPoolBuilder, Yield};

/// Threads for work in parts of less than a millisecond.
pub(super) struct SpinPool(ThreadPool);

impl SpinPool {
    pub(super) fn of(threads: usize) -> Result<Self, ThreadPoolBuildError> {
        let name = |n| format!("solver {n}");
        ThreadPoolBuilder::new().num_threads(threads).thread_name(name).build().map(Self)
    }

    /// Runs `work` on one of the threads; the others take its `rayon` tasks. They stay awake
    /// meanwhile, since waking them takes as long as a task.
    pub(super) fn run(&self, work: impl FnMut() + Send) {
        let (work, is_over) = (Mutex::new(work), AtomicBool::new(false));
        self.0.broadcast(|thread| {
            if thread.index() == 0 {
                let _over = SetOnDrop(&is_over);
                if let Ok(mut work) = work.lock() {
                    work();
                }
            } else {
                while !is_over.load(Ordering::Relaxed) {
                    if rayon::yield_now() != Some(Yield::Executed) {
                        spin_loop();
                    }
                }
            }
        });
    }
}

/// Releases the other threads, even if the work panics.
struct SetOnDrop<'a>(&'a AtomicBool);

impl Drop for SetOnDrop<'_> {
    fn drop(&mut self) {
        self.0.store(true, Ordering::Relaxed);
    }
}

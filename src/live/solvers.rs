//! The solver threads, and the jobs that wait for them.
//!
//! The job with the earliest deadline comes first. Searches take longest; with several threads, one is kept
//! free of them, so that who enters delays nobody.

use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::Instant;

use crossbeam_channel::{Receiver, Sender, bounded};

use super::cpu_affinity::SolverCore;
use super::error::NodeError;
use crate::core::stage::PerformerId;
use crate::core::time::{Nanos, Timestamp};
use crate::core::tracker::{Job, Solution, Solver, Task};

/// A solver without a core of its own gives way to the other threads of the program.
#[cfg(unix)]
const GIVES_WAY: i32 = 10;

/// A solution from a solver's thread.
pub(super) struct Answer {
    pub(super) performer: PerformerId,
    pub(super) solution: Box<Solution>,
    pub(super) took: Nanos,
}

/// Jobs that wait for a thread.
#[derive(Default)]
struct Waiting {
    jobs: Vec<(Timestamp, PerformerId, Box<Job>)>,
    /// Searches that are being solved, and how many may be.
    searches: usize,
    most_searches: usize,
    is_closed: bool,
}

impl Waiting {
    /// The most urgent job that may be solved now.
    fn pop(&mut self) -> Option<(PerformerId, Box<Job>)> {
        let is_full = self.searches >= self.most_searches;
        let may_be_next = |job: &Job| !(is_full && is_search(job));
        let ready = (0..self.jobs.len()).filter(|&index| may_be_next(&self.jobs[index].2));
        let next = ready.min_by_key(|&index| (self.jobs[index].0, self.jobs[index].1))?;
        let (_, performer, job) = self.jobs.swap_remove(next);
        self.searches += usize::from(is_search(&job));
        Some((performer, job))
    }
}

fn is_search(job: &Job) -> bool {
    matches!(job.task, Task::Acquire { .. })
}

/// The way to the solver threads; they end when it is dropped.
pub(super) struct Solvers(Arc<(Mutex<Waiting>, Condvar)>);

impl Solvers {
    /// Starts a thread for each solver; the first one runs on `core`, if there is one.
    ///
    /// # Errors
    /// The system cannot start a thread.
    pub(super) fn start(
        solvers: Vec<Solver>,
        mut core: Option<SolverCore>,
        threads: &mut Vec<(&'static str, JoinHandle<()>)>,
    ) -> Result<(Self, Receiver<Answer>), NodeError> {
        let count = solvers.len().max(1);
        let waiting = Waiting { most_searches: (count - 1).max(1), ..Waiting::default() };
        let shared = Arc::new((Mutex::new(waiting), Condvar::new()));
        // Each performer has one job out at most; the node loop takes all answers.
        let (sender, answers) = bounded(count);
        for solver in solvers {
            let core = core.take();
            let (shared, sender) = (Arc::clone(&shared), sender.clone());
            let work = move || serve(solver, core, &shared, &sender);
            let thread = std::thread::Builder::new().name("solver".into()).spawn(work);
            threads.push(("solver", thread.map_err(NodeError::Thread)?));
        }
        Ok((Self(shared), answers))
    }

    /// Adds a job. Returns at once.
    pub(super) fn push(&self, deadline: Timestamp, performer: PerformerId, job: Box<Job>) {
        lock(&self.0.0).jobs.push((deadline, performer, job));
        self.0.1.notify_one();
    }
}

impl Drop for Solvers {
    fn drop(&mut self) {
        lock(&self.0.0).is_closed = true;
        self.0.1.notify_all();
    }
}

fn lock(waiting: &Mutex<Waiting>) -> MutexGuard<'_, Waiting> {
    waiting.lock().unwrap_or_else(PoisonError::into_inner)
}

/// The loop of a thread: solves until there are no more jobs and none will come.
fn serve(
    mut solver: Solver,
    core: Option<SolverCore>,
    (waiting, changed): &(Mutex<Waiting>, Condvar),
    answers: &Sender<Answer>,
) {
    match core {
        Some(core) => core.enter(),
        // It shares the cores with the threads that publish on time.
        #[cfg(unix)]
        None => drop(rustix::process::nice(GIVES_WAY)),
        #[cfg(not(unix))]
        None => {}
    }
    loop {
        let mut open = lock(waiting);
        let (performer, job) = loop {
            if let Some(next) = open.pop() {
                break next;
            }
            if open.is_closed {
                return;
            }
            open = changed.wait(open).unwrap_or_else(PoisonError::into_inner);
        };
        drop(open);
        let begin = Instant::now();
        let solution = Box::new(solver.solve(&job));
        let took = Nanos::from(begin.elapsed());
        if is_search(&job) {
            lock(waiting).searches -= 1;
            changed.notify_one();
        }
        if answers.send(Answer { performer, solution, took }).is_err() {
            return;
        }
    }
}

//! The solver threads, and the jobs that wait for them.
//!
//! The job with the earliest deadline comes first. Searches take longest; with several threads, one is kept
//! free of them, so that a new performer delays nobody. Jobs that no pose waits for (moved cameras) have their
//! own thread.

use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::Instant;

use crossbeam_channel::{Receiver, Sender, bounded};

use super::cpu_affinity::SolverCore;
use crate::core::stage::PerformerId;
use crate::core::time::{Nanos, Timestamp};
use crate::core::tracker::{self, Job, Solution, Task};
use crate::live::error::NodeError;

/// A solver without a core of its own gives way to the other threads of the program.
#[cfg(target_os = "linux")]
const GIVES_WAY: i32 = 10;

/// A solution from a solver's thread.
pub(crate) struct Answer {
    pub(crate) performer: PerformerId,
    pub(crate) solution: Box<Solution>,
    pub(crate) took: Nanos,
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
    /// The most urgent job that is ready; `aside`: only jobs that no pose waits for, otherwise only the others.
    fn pop(&mut self, aside: bool) -> Option<(PerformerId, Box<Job>)> {
        let is_full = self.searches >= self.most_searches;
        let may_be_next = |job: &Job| job.is_aside() == aside && !(is_full && is_search(job));
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

/// The way to the solver threads. Each of them has one too: all end when one is dropped, so also when a
/// thread panics.
pub(crate) struct Solvers(Arc<(Mutex<Waiting>, Condvar)>);

impl Solvers {
    /// Starts a thread for each function that solves, the first one on `core`, if there is one; and one for
    /// the jobs that no pose waits for.
    ///
    /// # Errors
    /// The system cannot start a thread.
    pub(crate) fn start(
        solvers: Vec<impl FnMut(&Job) -> Solution + Send + 'static>,
        mut core: Option<SolverCore>,
        threads: &mut Vec<(&'static str, JoinHandle<()>)>,
    ) -> Result<(Self, Receiver<Answer>), NodeError> {
        let count = solvers.len().max(1);
        let waiting = Waiting { most_searches: (count - 1).max(1), ..Waiting::default() };
        let shared = Arc::new((Mutex::new(waiting), Condvar::new()));
        // The node loop takes all answers.
        let (sender, answers) = bounded(count + 1);
        for solver in solvers {
            let place = core.take().map_or(Place::Shared, Place::Core);
            start(solver, place, &shared, &sender, threads)?;
        }
        start(tracker::solve_aside, Place::Aside, &shared, &sender, threads)?;
        Ok((Self(shared), answers))
    }

    /// Adds a job. Returns at once.
    pub(crate) fn push(&self, deadline: Timestamp, performer: PerformerId, job: Box<Job>) {
        lock(&self.0.0).jobs.push((deadline, performer, job));
        self.0.1.notify_all();
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

/// Where a thread runs.
enum Place {
    /// On a core of its own.
    Core(SolverCore),
    /// It shares the cores with the threads that publish on time.
    Shared,
    /// The same, for the jobs that no pose waits for.
    Aside,
}

fn start(
    solve: impl FnMut(&Job) -> Solution + Send + 'static,
    place: Place,
    shared: &Arc<(Mutex<Waiting>, Condvar)>,
    answers: &Sender<Answer>,
    threads: &mut Vec<(&'static str, JoinHandle<()>)>,
) -> Result<(), NodeError> {
    let (all, answers) = (Solvers(Arc::clone(shared)), answers.clone());
    let work = move || serve(solve, place, &all.0, &answers);
    let thread = std::thread::Builder::new().name("solver".into()).spawn(work);
    threads.push(("solver", thread.map_err(NodeError::Thread)?));
    Ok(())
}

/// The loop of a thread: solves until there are no more jobs and none will come.
fn serve(
    mut solve: impl FnMut(&Job) -> Solution,
    place: Place,
    (waiting, changed): &(Mutex<Waiting>, Condvar),
    answers: &Sender<Answer>,
) {
    let aside = matches!(place, Place::Aside);
    match place {
        Place::Core(core) => core.enter(),
        // Elsewhere it is the priority of the whole process.
        #[cfg(target_os = "linux")]
        Place::Shared | Place::Aside => drop(rustix::process::nice(GIVES_WAY)),
        #[cfg(not(target_os = "linux"))]
        _ => {}
    }
    loop {
        let mut open = lock(waiting);
        let (performer, job) = loop {
            if let Some(next) = open.pop(aside) {
                break next;
            }
            if open.is_closed {
                return;
            }
            open = changed.wait(open).unwrap_or_else(PoisonError::into_inner);
        };
        drop(open);
        let begin = Instant::now();
        let solution = Box::new(solve(&job));
        let took = Nanos::from(begin.elapsed());
        if is_search(&job) {
            lock(waiting).searches -= 1;
            changed.notify_all();
        }
        if answers.send(Answer { performer, solution, took }).is_err() {
            return;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::core::camera::Rig;
    use crate::core::detections::KeypointFormat;

    fn search() -> Box<Job> {
        let at = Timestamp::default();
        Box::new(Job {
            number: 0,
            window: 0,
            start: at,
            end: at,
            publish: at,
            keyframe_times: vec![at],
            pose_times: vec![at],
            frames: Vec::new(),
            format: KeypointFormat::Body25,
            rig: Arc::new(Rig { version: 1, cameras: Vec::new() }),
            frame_period: Nanos::from_ms(20),
            effort: tracker::Effort::full(&tracker::Config::default()),
            noise: tracker::Noise::default(),
            task: Task::Acquire { skeleton: None },
        })
    }

    #[test]
    fn all_threads_end_if_one_panics() {
        let solvers = [(); 2].map(|()| |_: &Job| -> Solution { panic!("a fault of the solver") });
        let mut threads = Vec::new();
        let (solvers, answers) = Solvers::start(solvers.into(), None, &mut threads).unwrap();
        solvers.push(Timestamp::default(), PerformerId(0), search());
        // The other thread does not wait for ever: the node learns of it.
        assert!(answers.recv().is_err());
        let panicked = threads.into_iter().filter_map(|(_, thread)| thread.join().err()).count();
        assert_eq!(panicked, 1);
    }
}

//! Solves every case with every method.

use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Instant;

use super::case::{Case, CaseName, Sequence};
use super::score::{Score, Trace, entries, score};
use crate::core::manifold::Decoder;
use crate::research::methods::{Delay, Method, Solved};

/// Makes the methods. Each case has its own, so that no state passes between cases.
pub type Methods<'a> = dyn Fn() -> Vec<Box<dyn Method>> + Sync + 'a;

/// The results of one method on all cases.
#[derive(Clone, Debug, PartialEq)]
pub struct Row {
    /// The method's name.
    pub method: String,
    /// Delay of a pose.
    pub delay: Delay,
    /// By case; `None` if nobody was found.
    pub results: Vec<Option<(Score, Trace)>>,
}

/// A subject's name and the score on one of its cases.
pub(super) type Scored<'a> = (&'a str, &'a Score);

/// The results of all methods on all cases.
#[derive(Clone, Debug, PartialEq)]
pub struct Run {
    /// The cases.
    pub cases: Vec<CaseName>,
    /// By method.
    pub rows: Vec<Row>,
}

/// Solves every case with every method on `jobs` threads; the results except for the times do not
/// depend on `jobs`. `each` is called after each solve.
pub fn run(
    cases: &[Case],
    methods: &Methods,
    decoder: &Decoder,
    jobs: usize,
    each: &(dyn Fn() + Sync),
) -> Run {
    let of_cases = in_parallel(cases, jobs, |case| {
        let mut sequence = case.make();
        sequence.take = sequence.take.with_body(decoder);
        let solve = |mut method: Box<dyn Method>| {
            let begin = Instant::now();
            let solved = method.solve(&sequence.take, decoder);
            let ms = begin.elapsed().as_secs_f64() * 1e3;
            each();
            solved.map(|solved| (solved, ms / sequence.truth.len().max(1) as f64))
        };
        let solved: Vec<_> = methods().into_iter().map(solve).collect();
        scores(&sequence, &solved)
    });
    let fps = cases.first().map_or(0.0, Case::fps);
    let mut rows: Vec<Row> = methods().iter().map(|method| Row::of(method.as_ref(), fps)).collect();
    for of_case in of_cases {
        for (row, result) in rows.iter_mut().zip(of_case) {
            row.results.push(result);
        }
    }
    Run { cases: cases.iter().map(|case| case.name().clone()).collect(), rows }
}

/// The result of each item, in their order, computed on `jobs` threads.
pub fn in_parallel<T: Sync, R: Send>(
    items: &[T],
    jobs: usize,
    each: impl Fn(&T) -> R + Sync,
) -> Vec<R> {
    let (next, results) = (AtomicUsize::new(0), Mutex::new(Vec::new()));
    let work = || {
        while let Some((index, item)) = {
            let index = next.fetch_add(1, Ordering::Relaxed);
            items.get(index).map(|item| (index, item))
        } {
            let result = each(item);
            if let Ok(mut results) = results.lock() {
                results.push((index, result));
            }
        }
    };
    std::thread::scope(|scope| {
        for _ in 1..jobs.clamp(1, items.len().max(1)) {
            scope.spawn(work);
        }
        work();
    });
    let mut results = results.into_inner().unwrap_or_default();
    results.sort_by_key(|(index, _)| *index);
    results.into_iter().map(|(_, result)| result).collect()
}

/// The scores of each result, with its milliseconds per frame, in the frames that all of them have.
fn scores(sequence: &Sequence, solved: &[Option<(Solved, f64)>]) -> Vec<Option<(Score, Trace)>> {
    let entries: Vec<_> =
        solved.iter().flatten().map(|(solved, _)| entries(sequence, &solved.motion)).collect();
    let in_all = |frame: &usize| entries.iter().all(|entries| entries[*frame].is_some());
    let frames: Vec<usize> = (0..sequence.truth.len()).filter(in_all).collect();
    let of = |result: &Option<(Solved, f64)>| {
        let (solved, ms) = result.as_ref()?;
        score(sequence, solved, &frames, *ms)
    };
    solved.iter().map(of).collect()
}

impl Row {
    fn of(method: &dyn Method, fps: f64) -> Self {
        Self { method: method.name(), delay: method.delay(fps), results: Vec::new() }
    }

    /// Number of cases without a performer found.
    pub fn failed(&self) -> usize {
        self.results.iter().filter(|result| result.is_none()).count()
    }
}

impl Run {
    /// The scores of each method in the cases that all methods solved, with the cases' subjects. A method that solved
    /// none does not count.
    pub(super) fn common(&self) -> Vec<Vec<Scored<'_>>> {
        let has_any = |row: &&Row| row.results.iter().any(Option::is_some);
        let solved_by_all =
            |case: &usize| self.rows.iter().filter(has_any).all(|row| row.results[*case].is_some());
        let cases: Vec<usize> = (0..self.cases.len()).filter(solved_by_all).collect();
        self.rows.iter().map(|row| scored(row, &self.cases, &cases)).collect()
    }

    /// The row of a method.
    pub fn row(&self, method: &str) -> Option<usize> {
        self.rows.iter().position(|row| row.method == method)
    }
}

fn scored<'a>(row: &'a Row, cases: &'a [CaseName], chosen: &[usize]) -> Vec<Scored<'a>> {
    let of = |&case: &usize| Some((&*cases[case].subject, &row.results[case].as_ref()?.0));
    chosen.iter().filter_map(of).collect()
}

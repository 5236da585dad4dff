//! L-BFGS with a strong Wolfe line search \[Nocedal 2006, alg. 7.4, 3.5 and 3.6\].
//!
//! The constants are those of PyTorch, which the paper used: c1 = 1e-4, c2 = 0.9, at most 25 trials
//! in a line search, 100 pairs kept, first step min(1, 1 / |g|_1), a pair kept if y . s > 1e-10.

use std::collections::VecDeque;

use super::{Optimiser, Problem, Summary, Termination};

const SUFFICIENT_DECREASE: f64 = 1e-4;
const CURVATURE: f64 = 0.9;
const MAX_TRIALS: usize = 25;
const HISTORY: usize = 100;
const MIN_CURVATURE: f64 = 1e-10;

/// L-BFGS with a strong Wolfe line search.
#[derive(Clone, Debug)]
pub struct Lbfgs {
    /// Stop if a step lowers the cost by less than this fraction of it.
    pub change_threshold: f64,
    /// Stop if no entry of the gradient exceeds this.
    pub gradient_threshold: f64,
}

impl Default for Lbfgs {
    fn default() -> Self {
        Self { change_threshold: 1e-9, gradient_threshold: 1e-6 }
    }
}

/// A step s, the change of the gradient y over it, and 1 / (y . s).
struct Pair {
    s: Vec<f64>,
    y: Vec<f64>,
    rho: f64,
}

/// A point of a line search: step length, cost, slope along the direction, gradient.
#[derive(Clone)]
struct Trial {
    step: f64,
    cost: f64,
    slope: f64,
    gradient: Vec<f64>,
}

impl Optimiser for Lbfgs {
    fn minimise(&mut self, problem: &mut dyn Problem, x: &mut [f64], iterations: usize) -> Summary {
        let n = x.len();
        let mut gradient = vec![0.0; n];
        let mut cost = problem.gradient(x, &mut gradient);
        let mut summary = Summary::at_start(cost, iterations);
        if !cost.is_finite() {
            return Summary { termination: Termination::NotFinite, ..summary };
        }
        let mut pairs: VecDeque<Pair> = VecDeque::new();
        while summary.iterations < iterations {
            let steepest = gradient.iter().fold(0.0_f64, |m, g| m.max(g.abs()));
            if steepest <= self.gradient_threshold {
                summary.termination = Termination::SmallGradient {
                    value: steepest,
                    threshold: self.gradient_threshold,
                };
                break;
            }
            summary.iterations += 1;
            let direction = two_loops(&pairs, &gradient);
            let first = if pairs.is_empty() {
                (1.0 / gradient.iter().map(|g| g.abs()).sum::<f64>()).min(1.0)
            } else {
                1.0
            };
            let start = Trial { step: 0.0, cost, slope: dot(&gradient, &direction), gradient };
            let found =
                Line { problem, x, direction: &direction, evaluations: &mut summary.evaluations }
                    .search(&start, first);
            if found.cost >= cost || !found.cost.is_finite() {
                summary.termination = Termination::NoDescent { value: found.step };
                break;
            }
            let s: Vec<f64> = direction.iter().map(|d| d * found.step).collect();
            let y: Vec<f64> =
                found.gradient.iter().zip(&start.gradient).map(|(a, b)| a - b).collect();
            x.iter_mut().zip(&s).for_each(|(x, s)| *x += s);
            let curvature = dot(&y, &s);
            if curvature > MIN_CURVATURE {
                if pairs.len() == HISTORY {
                    pairs.pop_front();
                }
                pairs.push_back(Pair { s, y, rho: 1.0 / curvature });
            }
            let change = (cost - found.cost) / cost.abs().max(f64::MIN_POSITIVE);
            (cost, gradient) = (found.cost, found.gradient);
            if change < self.change_threshold {
                summary.termination =
                    Termination::SmallChange { value: change, threshold: self.change_threshold };
                break;
            }
        }
        Summary { final_cost: cost, ..summary }
    }
}

/// The quasi-Newton direction -H g.
fn two_loops(pairs: &VecDeque<Pair>, gradient: &[f64]) -> Vec<f64> {
    let mut q: Vec<f64> = gradient.iter().map(|g| -g).collect();
    let mut alphas = Vec::with_capacity(pairs.len());
    for pair in pairs.iter().rev() {
        let alpha = pair.rho * dot(&pair.s, &q);
        q.iter_mut().zip(&pair.y).for_each(|(q, y)| *q -= alpha * y);
        alphas.push(alpha);
    }
    if let Some(last) = pairs.back() {
        let scale = 1.0 / (last.rho * dot(&last.y, &last.y));
        q.iter_mut().for_each(|q| *q *= scale);
    }
    for (pair, alpha) in pairs.iter().zip(alphas.into_iter().rev()) {
        let beta = pair.rho * dot(&pair.y, &q);
        q.iter_mut().zip(&pair.s).for_each(|(q, s)| *q += (alpha - beta) * s);
    }
    q
}

/// A search along one direction.
struct Line<'a> {
    problem: &'a mut dyn Problem,
    x: &'a [f64],
    direction: &'a [f64],
    evaluations: &'a mut usize,
}

impl Line<'_> {
    fn at(&mut self, step: f64) -> Trial {
        *self.evaluations += 1;
        let x: Vec<f64> = self.x.iter().zip(self.direction).map(|(x, d)| x + step * d).collect();
        let mut gradient = vec![0.0; x.len()];
        let cost = self.problem.gradient(&x, &mut gradient);
        Trial { step, cost, slope: dot(&gradient, self.direction), gradient }
    }

    /// Brackets a step that satisfies the strong Wolfe conditions, then zooms in on it.
    fn search(&mut self, start: &Trial, first: f64) -> Trial {
        let mut previous = start.clone();
        let mut step = first;
        for trial in 0..MAX_TRIALS {
            let now = self.at(step);
            let budget = MAX_TRIALS - trial;
            let too_high = !now.cost.is_finite()
                || now.cost > start.cost + SUFFICIENT_DECREASE * step * start.slope
                || (trial > 0 && now.cost >= previous.cost);
            if too_high {
                return self.zoom(start, previous, now, budget);
            }
            if now.slope.abs() <= -CURVATURE * start.slope {
                return now;
            }
            if now.slope >= 0.0 {
                return self.zoom(start, now, previous, budget);
            }
            let (low, high) = (step + 0.01 * (step - previous.step), step * 10.0);
            step = cubic_minimum(&previous, &now, low, high);
            previous = now;
        }
        previous
    }

    /// `low` has the lowest cost so far; the minimum lies between it and `high`.
    fn zoom(&mut self, start: &Trial, mut low: Trial, mut high: Trial, budget: usize) -> Trial {
        for _ in 0..budget {
            let (a, b) = (low.step.min(high.step), low.step.max(high.step));
            if (b - a) * start.slope.abs() < 1e-14 {
                break;
            }
            let margin = 0.1 * (b - a);
            let now = self.at(cubic_minimum(&low, &high, a + margin, b - margin));
            let too_high = !now.cost.is_finite()
                || now.cost > start.cost + SUFFICIENT_DECREASE * now.step * start.slope
                || now.cost >= low.cost;
            if too_high {
                high = now;
                continue;
            }
            if now.slope.abs() <= -CURVATURE * start.slope {
                return now;
            }
            if now.slope * (high.step - low.step) >= 0.0 {
                high = low;
            }
            low = now;
        }
        low
    }
}

/// The minimum of the cubic through two points and slopes, clamped between `low` and `high`.
fn cubic_minimum(p: &Trial, q: &Trial, low: f64, high: f64) -> f64 {
    let (p, q) = if p.step <= q.step { (p, q) } else { (q, p) };
    let d1 = p.slope + q.slope - 3.0 * (p.cost - q.cost) / (p.step - q.step);
    let square = d1 * d1 - p.slope * q.slope;
    let middle = 0.5 * (low + high);
    if square.is_nan() || square < 0.0 {
        return middle;
    }
    let d2 = square.sqrt();
    let step = q.step - (q.step - p.step) * ((q.slope + d2 - d1) / (q.slope - p.slope + 2.0 * d2));
    if step.is_finite() { step.clamp(low, high) } else { middle }
}

fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

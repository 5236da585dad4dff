//! AdamW with warm-up, cosine decay, clipping of the gradient, and averaged weights.

/// Decay of the first moment.
const BETA1: f32 = 0.9;
/// Decay of the second moment.
const BETA2: f32 = 0.99;
/// Added to the root of the second moment.
const EPSILON: f32 = 1e-8;

/// How steps are taken.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Config {
    /// Learning rate after the warm-up.
    pub learning_rate: f32,
    /// Steps over which the learning rate rises from 0.
    pub warm_up: usize,
    /// All steps; the learning rate falls to 0 along a cosine.
    pub steps: usize,
    /// Longest gradient; longer ones are shortened to it.
    pub longest_gradient: f32,
    /// Share by which weights shrink per step and unit of learning rate.
    pub weight_decay: f32,
    /// Decay of the averaged weights per step.
    pub averaging: f32,
}

/// Moments and averages of a parameter vector \[Loshchilov 2019, alg. 2\].
#[derive(Clone, Debug)]
pub struct Optimiser {
    config: Config,
    step: usize,
    first: Vec<f32>,
    second: Vec<f32>,
    averaged: Vec<f32>,
}

impl Optimiser {
    /// Before the first step.
    pub fn new(config: Config, parameters: &[f32]) -> Self {
        let zeros = vec![0.0; parameters.len()];
        Self { config, step: 0, first: zeros.clone(), second: zeros, averaged: parameters.to_vec() }
    }

    /// Moves `parameters` against `gradient`. Averaging follows slower the longer it runs, so
    /// that early weights are soon forgotten: its decay is min(averaging, step / (step + 10)).
    pub fn step(&mut self, parameters: &mut [f32], gradient: &[f32]) {
        self.step += 1;
        let config = self.config;
        let rate = learning_rate(&config, self.step);
        let correct1 = 1.0 - BETA1.powi(self.step as i32);
        let correct2 = 1.0 - BETA2.powi(self.step as i32);
        let size = norm(gradient);
        let scale =
            if size > config.longest_gradient { config.longest_gradient / size } else { 1.0 };
        let keep = config.averaging.min(self.step as f32 / (self.step as f32 + 10.0));
        let shrink = 1.0 - rate * config.weight_decay;
        let (pace, root) = (rate / correct1, 1.0 / correct2.sqrt());
        let moments = self.first.iter_mut().zip(&mut self.second).zip(&mut self.averaged);
        for ((parameter, by), ((first, second), averaged)) in
            parameters.iter_mut().zip(gradient).zip(moments)
        {
            let by = by * scale;
            *first = BETA1 * *first + (1.0 - BETA1) * by;
            *second = BETA2 * *second + (1.0 - BETA2) * by * by;
            *parameter = *parameter * shrink - pace * *first / (second.sqrt() * root + EPSILON);
            *averaged = keep * *averaged + (1.0 - keep) * *parameter;
        }
    }

    /// The averaged parameters.
    pub fn averaged(&self) -> &[f32] {
        &self.averaged
    }
}

/// Linear warm-up, then rate (1 + cos(pi progress)) / 2.
fn learning_rate(config: &Config, step: usize) -> f32 {
    let warm = (step as f32 / config.warm_up.max(1) as f32).min(1.0);
    let progress = (step as f32 / config.steps.max(1) as f32).min(1.0);
    config.learning_rate * warm * 0.5 * (1.0 + (std::f32::consts::PI * progress).cos())
}

/// Euclidean length, summed in blocks so that the order of sums is fixed and fast.
fn norm(values: &[f32]) -> f32 {
    let mut lanes = [0.0f32; 16];
    let mut total = 0.0f64;
    for block in values.chunks(16 * 1024) {
        lanes.fill(0.0);
        for row in block.chunks(16) {
            lanes.iter_mut().zip(row).for_each(|(lane, value)| *lane += value * value);
        }
        total += lanes.iter().map(|lane| f64::from(*lane)).sum::<f64>();
    }
    total.sqrt() as f32
}

#[cfg(test)]
mod tests {
    use super::*;

    const CONFIG: Config = Config {
        learning_rate: 0.05,
        warm_up: 10,
        steps: 400,
        longest_gradient: 1.0,
        weight_decay: 0.0,
        averaging: 0.9,
    };

    #[test]
    fn a_quadratic_is_minimised() {
        let target = [1.0, -2.0, 0.5];
        let mut parameters = [0.0; 3];
        let mut optimiser = Optimiser::new(CONFIG, &parameters);
        for _ in 0..CONFIG.steps {
            let gradient: Vec<f32> =
                parameters.iter().zip(target).map(|(p, t)| 10.0 * (p - t)).collect();
            optimiser.step(&mut parameters, &gradient);
        }
        for (value, target) in optimiser.averaged().iter().zip(target) {
            assert!((value - target).abs() < 1e-2, "{value} {target}");
        }
    }

    #[test]
    fn the_learning_rate_rises_then_falls_to_zero() {
        assert!(learning_rate(&CONFIG, 1) < learning_rate(&CONFIG, 10));
        assert!(learning_rate(&CONFIG, 200) < learning_rate(&CONFIG, 11));
        assert!(learning_rate(&CONFIG, 400) < 1e-6);
    }
}

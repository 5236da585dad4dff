//! The work that the solver spends on a job.

use super::config::Config;

/// The work that the solver spends on a job.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Effort {
    /// Most iterations of a window.
    pub iterations: usize,
    /// Most iterations of a provisional fit of the open window; 0: no fit.
    pub provisional_iterations: usize,
    /// Use every Nth frame of a camera.
    pub stride: usize,
    /// Whether poses have standard deviations.
    pub deviations: bool,
}

impl Effort {
    /// The number of levels; 0 is the full effort.
    pub const LEVELS: u32 = 6;
    /// The first level that uses fewer frames.
    pub const FEWER_FRAMES: u32 = 3;

    /// The effort in the settings.
    pub fn full(config: &Config) -> Self {
        Self {
            iterations: config.iterations,
            provisional_iterations: config.provisional_iterations,
            stride: 1,
            deviations: true,
        }
    }

    /// Whether there is time for more than the usual iterations of a window: no level with fewer frames.
    pub(super) fn has_time(&self, config: &Config) -> bool {
        self.stride == 1 || self.iterations == config.iterations
    }

    /// The effort at a degradation level: higher levels first use fewer iterations, then fewer
    /// frames. The keyframes stay the same, so that the latency does not grow.
    pub fn at(level: u32, config: &Config) -> Self {
        let full = Self::full(config);
        let part = |count: usize, of: usize| (count / of).max(1).min(count);
        let (iterations, provisional_iterations, stride) = match level {
            0 => (full.iterations, full.provisional_iterations, 1),
            1 => (part(full.iterations, 3), part(full.provisional_iterations, 2), 1),
            2 => (part(full.iterations, 8), part(full.provisional_iterations, 4), 1),
            3 => (part(full.iterations, 8), part(full.provisional_iterations, 4), 2),
            4 => (part(full.iterations, 8), 0, 3),
            _ => (part(full.iterations, 15), 0, 5),
        };
        Self { iterations, provisional_iterations, stride, ..full }
    }
}

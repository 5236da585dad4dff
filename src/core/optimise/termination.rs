//! Why an optimiser stopped, with the measured value and the threshold.

/// Why an optimiser stopped.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Termination {
    /// The largest entry of the gradient fell below the threshold.
    SmallGradient {
        /// Largest absolute entry.
        value: f64,
        /// Threshold.
        threshold: f64,
    },
    /// The relative change of the cost fell below the threshold.
    SmallChange {
        /// Relative change.
        value: f64,
        /// Threshold.
        threshold: f64,
    },
    /// No step lowers the cost any more.
    NoDescent {
        /// The damping or step length of the last trial.
        value: f64,
    },
    /// The budget is used up.
    IterationLimit {
        /// The budget.
        iterations: usize,
    },
    /// The cost is not finite at the start.
    NotFinite,
}

impl Termination {
    /// A short lower-case name.
    pub const fn name(self) -> &'static str {
        match self {
            Self::SmallGradient { .. } => "small gradient",
            Self::SmallChange { .. } => "small change",
            Self::NoDescent { .. } => "no descent",
            Self::IterationLimit { .. } => "iteration limit",
            Self::NotFinite => "not finite",
        }
    }
}

/// The result of an optimiser.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Summary {
    /// Cost before.
    pub initial_cost: f64,
    /// Cost after.
    pub final_cost: f64,
    /// Accepted and refused steps.
    pub iterations: usize,
    /// Evaluations of the cost, with or without derivatives.
    pub evaluations: usize,
    /// Why it stopped.
    pub termination: Termination,
}

impl Summary {
    /// The state after the first evaluation, with a budget of `iterations`.
    pub(super) const fn at_start(cost: f64, iterations: usize) -> Self {
        Self {
            initial_cost: cost,
            final_cost: cost,
            iterations: 0,
            evaluations: 1,
            termination: Termination::IterationLimit { iterations },
        }
    }
}

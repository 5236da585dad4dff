//! Compares methods: takes in, tables and plots out.
//!
//! A [`Case`] is a motion with a known truth and a view; [`run`] solves cases with every method;
//! [`summary`] makes the tables, [`plots`] the plots. Everything follows from seeds: two runs give
//! the same results except for the times. [`real`] compares methods on a recording without a truth.

pub mod ablation;
mod case;
pub mod drift;
pub mod latency;
pub mod methods;
mod named;
pub mod plots;
pub mod real;
mod run;
mod score;
pub mod summary;
pub mod sweep;

pub use case::{Case, CaseName, Sequence, Subject, View, in_turn, procedural, subjects};
pub use named::Named;
pub use run::{Methods, Row, Run, in_parallel, run};
pub use score::{REACH, Score, Trace, score, true_heights};

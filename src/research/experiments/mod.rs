//! Methods measured against each other: takes in, tables and plots out.
//!
//! A [`Case`] is a motion with a known truth and how it is seen; [`run`] solves cases by every
//! method; [`summary`] makes the tables, [`plots`] the pictures. Everything follows from seeds:
//! two runs give the same figures, but for the times. [`real`] does the same on a recording
//! without a truth.

pub mod ablation;
mod case;
pub mod drift;
pub mod methods;
mod named;
pub mod plots;
pub mod real;
mod run;
mod score;
pub mod summary;
pub mod sweep;

pub use case::{Case, CaseName, Sequence, Subject, View, procedural, subjects};
pub use named::Named;
pub use run::{Methods, Row, Run, run};
pub use score::{REACH, Score, Trace, score, true_heights};

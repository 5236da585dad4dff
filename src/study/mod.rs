//! Methods measured against each other: takes in, tables and plots out.
//!
//! A [`Case`] is a motion with a known truth and how it is seen; [`run`] solves cases by every
//! method; [`summary`] makes the tables, [`plots`] the pictures. Everything follows from seeds:
//! two runs give the same figures, but for the times.

mod case;
pub mod methods;
pub mod plots;
mod run;
mod score;
pub mod summary;

pub use case::{Case, CaseName, Sequence, Subject, View, procedural, subjects};
pub use run::{Methods, Row, Run, run};
pub use score::{REACH, Score, Trace, score, true_heights};

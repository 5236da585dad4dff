//! What an operator sees of the node: log lines with advice, metrics, the last status.

pub(super) mod advice;
pub(super) mod board;
pub(super) mod endpoint;
pub mod log;
pub mod metrics;
pub(super) mod process;

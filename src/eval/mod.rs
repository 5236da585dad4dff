//! Metrics and references.

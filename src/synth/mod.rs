//! Synthetic recordings with a known truth.

//! The sans-IO machine: window assembly, acquisition, tracking.

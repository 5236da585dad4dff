//! Optimisers that know no bodies.

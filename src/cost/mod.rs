//! The window problem: reprojection, robust loss, prior.

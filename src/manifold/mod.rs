//! The pose manifold: decoder, weights, interpolation.

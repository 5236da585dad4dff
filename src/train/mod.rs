//! Training the pose manifold.

//! Cameras: projection, distortion, rigs, triangulation.

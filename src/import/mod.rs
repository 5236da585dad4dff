//! Detections and calibrations of other tools.

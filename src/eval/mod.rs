//! Metrics and references.

mod detector_statistics;
mod metrics;
mod reprojection;
pub mod statistics;
pub mod trc;

pub use detector_statistics::{
    ConfidenceBin, DetectorStatistics, DetectorTracks, PointTrack, Seen,
};
pub use metrics::{PoseErrors, acceleration_error, mean_acceleration, pose_errors};
pub use reprojection::{ReprojectionErrors, ReprojectionSample};
pub use trc::{ReferenceDistance, Trc, TrcError, distance_to_reference};

//! The report of a solve: one HTML page with plots and drawings as SVG, in which the take plays.

mod bars;
pub(crate) mod body;
mod page;
mod player;
mod plot;
mod rig;
mod stick_figure;

pub use bars::Bars;
pub use page::{
    AngleTrack, BENT, CameraErrors, Picture, ReportData, Table, WindowRow, flexion_deg,
    write_report,
};
pub use player::{Moment, MomentKind, Player, PlayerPose, Track};
pub use plot::{Plot, Series};
pub use rig::{Drawn, draw_rig};
pub use stick_figure::{StickFigures, stick_figures};

//! The take in 3D inside the report: poses as data, and the page's own scene.

use std::fmt::Write as _;

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD as BASE64;
use nalgebra::Matrix3;
use serde_json::json;

use super::plot::escape;
use crate::core::body::{JOINTS, Joint, Pose, Skeleton, TrackingState};
use crate::core::camera::Rig;
use crate::core::so3;
use crate::core::time::Timestamp;
use crate::io::wire;

/// The modules of the page that draw the scene, each after those that it imports, and the player.
const MODULES: [(&str, &str); 7] = [
    ("three.js", include_str!("scene/three.js")),
    ("colours.js", include_str!("scene/colours.js")),
    ("lens.js", include_str!("scene/lens.js")),
    ("body.js", include_str!("scene/body.js")),
    ("scene.js", include_str!("scene/scene.js")),
    ("loop.js", include_str!("scene/loop.js")),
    ("player.js", include_str!("scene/player.js")),
];
/// Gives each module an address, as the modules import each other by name, and starts the player.
const LOADER: &str = "const urls = {};
for (const { dataset, textContent } of document.querySelectorAll('script[data-module]')) {
  const put = (text, [name, url]) => text.replaceAll(`\"./${name}\"`, `\"${url}\"`);
  const text = Object.entries(urls).reduce(put, textContent);
  urls[dataset.module] = URL.createObjectURL(new Blob([text], { type: 'text/javascript' }));
}
import(urls['player.js']);";

/// A take that plays.
#[derive(Clone, Debug)]
pub struct Player {
    /// The cameras.
    pub rig: Rig,
    /// The capture time that is shown as 0 s.
    pub start: Timestamp,
    /// The performers.
    pub tracks: Vec<Track>,
    /// The worst moments.
    pub moments: Vec<Moment>,
}

/// A bad moment of a performer.
#[derive(Clone, Debug)]
pub struct Moment {
    /// The capture time.
    pub at: Timestamp,
    /// What was there, in words.
    pub what: String,
    /// What kind it is.
    pub kind: MomentKind,
    /// How bad it is among those of its kind.
    pub size: f64,
}

/// Kinds of bad moments, the worst first.
#[derive(Clone, Copy, Debug, Eq, Ord, PartialEq, PartialOrd)]
pub enum MomentKind {
    /// The body is not where the cameras agree that a point is; the size is for how many frames.
    NotFollowed,
    /// The performer was lost; the size is for how long.
    Lost,
    /// A window of high cost; the size is the cost.
    Costly,
}

/// A performer of a player.
#[derive(Clone, Debug)]
pub struct Track {
    /// Name.
    pub name: String,
    /// The body.
    pub body: Skeleton,
    /// Poses in order of time.
    pub poses: Vec<PlayerPose>,
}

/// A pose of a player.
#[derive(Clone, Debug)]
pub struct PlayerPose {
    /// The capture time.
    pub capture: Timestamp,
    /// The quality of the pose.
    pub state: TrackingState,
    /// The pelvis in the world, millimetres.
    root_mm: [i32; 3],
    /// Of each joint's rotation, the root's first: the quaternion x y z w, times 32767.
    rotations: [[i16; 4]; JOINTS],
}

impl PlayerPose {
    /// A pose, rounded to 1 mm and about 0.004 degrees.
    pub fn new(capture: Timestamp, state: TrackingState, pose: &Pose) -> Self {
        let rounded = |rotation: &Matrix3<f64>| {
            so3::xyzw_from_rotation(rotation).map(|number| (32767.0 * number).round() as i16)
        };
        let root_mm = [0, 1, 2].map(|axis| (1000.0 * pose.root_position[axis]).round() as i32);
        let rotation = |j: usize| j.checked_sub(1).map_or(&pose.root_rotation, |j| &pose.local[j]);
        let rotations = std::array::from_fn(|j| rounded(rotation(j)));
        Self { capture, state, root_mm, rotations }
    }
}

impl Track {
    fn json(&self, start: Timestamp) -> serde_json::Value {
        let Self { name, body, poses } = self;
        let seconds = poses.iter().map(|pose| pose.capture.seconds_since(start) as f32);
        let seconds: Vec<u8> = seconds.flat_map(f32::to_le_bytes).collect();
        let states: Vec<u8> = poses.iter().map(|pose| pose.state as u8).collect();
        let root_mm: Vec<u8> =
            poses.iter().flat_map(|pose| pose.root_mm).flat_map(i32::to_le_bytes).collect();
        let rotations = poses.iter().flat_map(|pose| pose.rotations.as_flattened());
        let rotations: Vec<u8> = rotations.flat_map(|number| number.to_le_bytes()).collect();
        let [seconds, states, root_mm, rotations, rest] =
            [seconds, states, root_mm, rotations, super::body::rest(body)]
                .map(|bytes| BASE64.encode(bytes));
        let offsets = wire::Skeleton::from_core(body).rest_offsets_m;
        json!({ "name": name, "seconds": seconds, "states": states, "root_mm": root_mm,
                "rotations": rotations, "rest": rest, "offsets": offsets })
    }
}

impl Player {
    pub(super) fn html(&self) -> String {
        let take = json!({
            "rig": wire::Rig::from_core(&self.rig),
            "body": super::body::template(),
            "head": Joint::Head.index(),
            "states": TrackingState::ALL.map(TrackingState::name),
            "performers": self.tracks.iter().map(|track| track.json(self.start)).collect::<Vec<_>>(),
        });
        let mut page = "<section class=\"player\"><div class=\"scene\"><canvas id=\"canvas\" \
                        aria-label=\"The performers in 3D\"></canvas><div id=\"labels\"></div></div>\n\
                        <div class=\"transport\"><button id=\"play\" type=\"button\">Play</button>\
                        <input id=\"time\" type=\"range\" step=\"any\" aria-label=\"Time\">\
                        <output id=\"clock\"></output> <label>Speed <select id=\"speed\">\
                        <option>0.25</option><option>0.5</option><option selected>1</option>\
                        <option>2</option><option>4</option></select></label> \
                        <button id=\"loop\" type=\"button\">Loop from here</button></div>\n\
                        <p class=\"keys\">Keys: space plays, ← → one frame, [ ] speed, L loop.</p>\n"
            .to_owned();
        if !self.moments.is_empty() {
            page += "<h3>Worst moments</h3><ol class=\"moments\">";
            for Moment { at, what, .. } in &self.moments {
                let (at, what) = (at.seconds_since(self.start), escape(what));
                let _ = write!(page, "<li><a href=\"#t={at:.2}\">{at:.2} s</a> {what}</li>");
            }
            page += "</ol>";
        }
        // `</` and `<!--` would mean something to the page.
        let take = take.to_string().replace('<', "\\u003c");
        let _ = write!(
            page,
            "</section>\n<script type=\"application/json\" id=\"take\">{take}</script>"
        );
        for (name, text) in MODULES {
            let _ =
                write!(page, "<script type=\"text/plain\" data-module=\"{name}\">{text}</script>");
        }
        page + "<script>" + LOADER + "</script>\n"
    }
}

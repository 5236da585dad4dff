//! The take in 3D inside the report: poses as data, and the page's own scene.

use std::fmt::Write as _;

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD as BASE64;
use serde_json::json;

use super::plot::escape;
use crate::core::body::{JOINTS, Joint, Posture, TrackingState};
use crate::core::camera::Rig;
use crate::core::time::Timestamp;
use crate::io::wire;

/// The modules of the page that draw the scene, each after those that it imports, and the player.
const MODULES: [(&str, &str); 5] = [
    ("three.js", include_str!("scene/three.js")),
    ("colours.js", include_str!("scene/colours.js")),
    ("lens.js", include_str!("scene/lens.js")),
    ("scene.js", include_str!("scene/scene.js")),
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
    /// By performer, the name and the poses in order of time.
    pub tracks: Vec<(String, Vec<PlayerPose>)>,
    /// Capture times, and what was there.
    pub moments: Vec<(Timestamp, String)>,
}

/// A pose of a player.
#[derive(Clone, Debug)]
pub struct PlayerPose {
    /// The capture time.
    pub capture: Timestamp,
    /// The quality of the pose.
    pub state: TrackingState,
    /// Joint centres in the world, millimetres.
    pub joints_mm: [[i16; 3]; JOINTS],
}

impl PlayerPose {
    /// A pose in a posture, rounded to millimetres.
    pub fn new(capture: Timestamp, state: TrackingState, posture: &Posture) -> Self {
        let joints_mm =
            posture.positions.map(|at| [at.x, at.y, at.z].map(|metres| (1000.0 * metres) as i16));
        Self { capture, state, joints_mm }
    }
}

impl Player {
    fn track(&self, (name, poses): &(String, Vec<PlayerPose>)) -> serde_json::Value {
        let seconds = poses.iter().map(|pose| pose.capture.seconds_since(self.start) as f32);
        let seconds: Vec<u8> = seconds.flat_map(f32::to_le_bytes).collect();
        let states: Vec<u8> = poses.iter().map(|pose| pose.state as u8).collect();
        let joints = poses.iter().flat_map(|pose| pose.joints_mm.as_flattened());
        let joints: Vec<u8> = joints.flat_map(|mm| mm.to_le_bytes()).collect();
        let [seconds, states, joints_mm] =
            [seconds, states, joints].map(|bytes| BASE64.encode(bytes));
        json!({ "name": name, "seconds": seconds, "states": states, "joints_mm": joints_mm })
    }

    pub(super) fn html(&self) -> String {
        let parent = |joint: &Joint| joint.parent().map_or(-1, |parent| parent.index() as i32);
        let take = json!({
            "rig": wire::Rig::from_core(&self.rig),
            "parents": Joint::ALL.iter().map(parent).collect::<Vec<_>>(),
            "head": Joint::Head.index(),
            "states": TrackingState::ALL.map(TrackingState::name),
            "performers": self.tracks.iter().map(|track| self.track(track)).collect::<Vec<_>>(),
        });
        let mut page = "<section class=\"player\"><div class=\"scene\"><canvas id=\"canvas\" \
                        aria-label=\"The performers in 3D\"></canvas><div id=\"labels\"></div></div>\n\
                        <div class=\"transport\"><button id=\"play\" type=\"button\">Play</button>\
                        <input id=\"time\" type=\"range\" step=\"any\" aria-label=\"Time\">\
                        <output id=\"clock\"></output></div>\n"
            .to_owned();
        if !self.moments.is_empty() {
            page += "<h3>Worst moments</h3><ol class=\"moments\">";
            for (at, what) in &self.moments {
                let (at, what) = (at.seconds_since(self.start), escape(what));
                let _ = write!(page, "<li><a href=\"#t={at:.2}\">{at:.2} s</a> {what}</li>");
            }
            page += "</ol>";
        }
        // `</` would end the element.
        let take = take.to_string().replace("</", "<\\/");
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

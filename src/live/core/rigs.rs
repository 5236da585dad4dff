//! Rigs from a file and from the bus: which is used, and what is said about it.

use std::sync::Arc;

use super::port::Input;
use super::publication::Content;
use super::{Calibration, Core};
use crate::core::camera::Rig;
use crate::core::fnv::fnv1a;
use crate::core::stage;
use crate::core::time::{Nanos, Timestamp};
use crate::core::tracker::EventKind;
use crate::io::wire::{self, ActorChannel, Topic};
use crate::live::clock::Clock;
use crate::metrics::CameraState;

/// Most cameras of a rig.
const MOST_CAMERAS: usize = 256;
/// Most rigs that are remembered.
const MOST_RIGS: usize = 64;
/// Most cameras that an event names, and most characters for them.
const MOST_NAMES: usize = 16;
const MOST_CHARS: usize = 256;

impl Core {
    pub(super) fn rig_file(&mut self, bytes: Vec<u8>) {
        if self.journal.count == 0 {
            let before = self.rig_at_start.replace(bytes.clone());
            if let Some(before) = before.filter(|before| *before != bytes) {
                self.settings.carried.recalibrate(&before, &bytes);
            }
        }
        if self.calibrate(&bytes, "the file")
            && let Ok(rig) = wire::decode::<wire::Rig>(&bytes)
        {
            self.publish(self.topics.rig(), Timestamp::default(), Content::Rig(rig));
        }
    }

    /// Whether a rig from the bus differs from that of the node's file. Recordings use the last one on the bus; so do
    /// solvers until the front says which one it uses.
    pub(crate) fn is_other_rig(&self, rig: &[u8]) -> bool {
        self.has_rig_file() && !self.is_solver() && self.rig().is_some_and(|own| own != rig)
    }

    /// Whether a file gives the rig.
    fn has_rig_file(&self) -> bool {
        !self.settings.node.rig.is_empty()
    }

    /// Whether the input is a rig that is in use or was refused before, or a status that nobody needs: the journal needs no
    /// copy of it. The node's own rig comes back from the bus too; a run may begin with that.
    pub(super) fn changes_nothing(&self, input: &Input) -> bool {
        let Input::Message { topic, payload } = input else { return false };
        if let Ok(Topic::Actor { actor, channel: ActorChannel::Status, .. }) = Topic::parse(topic) {
            return !self.reads_status(actor);
        }
        if self.journal.count == 0 {
            return false;
        }
        let is_refused = || {
            let known = &self.known_rigs;
            self.has_rig_file() && (known.len() >= MOST_RIGS || known.contains(&fnv1a(payload)))
        };
        **topic == *self.topics.rig() && (self.rig() == Some(payload) || is_refused())
    }

    /// Takes a rig from the bus, unless a file gives the rig, or the front of a solver uses another one.
    pub(super) fn rig_from_bus(&mut self, bytes: &[u8]) {
        if !self.has_rig_file() {
            if let (true, Ok(rig)) = (self.is_solver(), wire::decode::<wire::Rig>(bytes)) {
                let hash = hash_of(&rig);
                self.sharing.keep_rig(hash, bytes);
                if !self.sharing.may_use(hash) {
                    return;
                }
            }
            self.calibrate(bytes, "the bus");
            return;
        }
        // A run may begin with a rig that is known.
        let hash = fnv1a(bytes);
        if self.known_rigs.contains(&hash) {
            return;
        }
        self.known_rigs.push(hash);
        let what = wire::decode::<wire::Rig>(bytes).map_or("not a rig".into(), |rig| told(&rig));
        let detail = format!("{what}, from the bus; this node's rig comes from its file");
        self.event(EventKind::RigRefused, None, detail);
    }

    /// The front uses the calibration with that hash, and so does a solver without a file of its own.
    pub(super) fn use_rig_of_front(&mut self, hash: u64) {
        if self.has_rig_file() || self.sharing.front_rig == hash {
            return;
        }
        self.sharing.front_rig = hash;
        match self.sharing.rig_of_front().map(<[u8]>::to_vec) {
            Some(bytes) => {
                self.calibrate(&bytes, "the front");
            }
            None => {
                let detail =
                    "the calibration of the front has not come; the last one on the bus is used";
                self.event(EventKind::Unusable, None, detail.to_owned());
            }
        }
    }

    /// Sets the calibration. Returns whether it is new and usable.
    pub(super) fn calibrate(&mut self, bytes: &[u8], source: &str) -> bool {
        if self.calibration.as_ref().is_some_and(|in_use| in_use.bytes == bytes) {
            return false;
        }
        let decoded = wire::decode::<wire::Rig>(bytes).and_then(|rig| Ok((rig.to_core()?, rig)));
        let (rig, message) = match decoded {
            Ok((rig, _)) if rig.cameras.len() > MOST_CAMERAS => {
                let detail = format!("{} cameras, at most {MOST_CAMERAS}", rig.cameras.len());
                return self.refuse_rig(detail);
            }
            Ok((rig, message)) => (Arc::new(rig), message),
            Err(error) => {
                return self.refuse_rig(error.to_string());
            }
        };
        let names: Vec<&str> = rig.cameras.iter().map(|camera| camera.name.as_str()).collect();
        if !names.iter().copied().eq(self.cameras.iter().map(CameraState::name)) {
            // What was found is of the cameras and the clock of before.
            self.drain();
            self.forget_due_times();
            self.cameras = names.into_iter().map(CameraState::new).collect();
            self.clock = Clock::new(self.cameras.len());
            self.sharing.forget_frames();
        }
        for (camera, new) in self.cameras.iter_mut().zip(&rig.cameras) {
            camera.set_verdict("");
            let before = self.calibration.as_ref().map(|before| &before.rig);
            let before = before.and_then(|rig| rig.cameras.get(rig.index_of(&new.name)?));
            if !before.is_some_and(|before| before.has_pose_of(new)) {
                camera.placed = None;
                camera.set_usual_px(0.0);
            }
        }
        self.verdict.clear();
        self.tell_ended_corrections(&rig);
        self.known_rigs.extend(self.has_rig_file().then(|| fnv1a(bytes)));
        self.event(EventKind::RigChanged, None, format!("{}, from {source}", told(&message)));
        let (bytes, hash) = (bytes.to_vec(), hash_of(&message));
        if self.is_solver() {
            self.sharing.keep_rig(hash, &bytes);
        }
        self.calibration = Some(Calibration { rig: Arc::clone(&rig), bytes, hash });
        match self.stage {
            // With several performers it holds for the next frame.
            Some(_) if self.is_several() => {
                let detail = format!("calibration {} from here on", rig.version);
                self.give(stage::Input::Rig(rig));
                self.event(EventKind::Calibrated, None, detail);
            }
            Some(_) => self.give(stage::Input::Rig(rig)),
            None => self.begin(rig),
        }
        true
    }

    /// Reports the corrections that end with a new calibration of the same cameras, see [`Rig::offset_changes`].
    fn tell_ended_corrections(&mut self, new: &Rig) {
        let Some(stage) = self.stage.as_ref().filter(|stage| stage.rig().has_cameras_of(new))
        else {
            return;
        };
        let corrections = stage.time_corrections().to_vec();
        if stage.rig().offset_changes(&corrections, new).is_empty() {
            return;
        }
        // Frames that were given have the times from before.
        self.drain();
        let all = new.cameras.iter().zip(corrections);
        for (camera, correction) in all.filter(|(_, correction)| *correction != Nanos::ZERO) {
            let detail = format!(
                "the calibration has other time offsets: the correction of {:+.1} ms ends",
                correction.ms()
            );
            self.event(EventKind::TimeOffset, Some(&camera.name), detail);
        }
    }

    fn refuse_rig(&mut self, why: String) -> bool {
        self.event(EventKind::Unusable, None, why);
        false
    }

    /// Topics and names of the cameras.
    pub(crate) fn camera_topics(&self) -> Vec<(String, String)> {
        let read = self.cameras.iter().filter(|_| !self.is_solver());
        let names = read.map(|camera| camera.name().to_owned());
        let topic = |camera: &str| self.topics.keypoints(camera);
        names.map(|name| (topic(&name), name)).collect()
    }
}

/// A rig in words: its version and its cameras.
fn told(rig: &wire::Rig) -> String {
    let names = rig.cameras.iter().map(|camera| camera.name.as_str());
    let mut names: Vec<&str> = names.take(MOST_NAMES).collect();
    if rig.cameras.len() > names.len() {
        names.push("...");
    }
    let (version, cameras) = (rig.version, rig.cameras.len());
    let names: String = names.join(", ").chars().take(MOST_CHARS).collect();
    format!("version {version} of {cameras} cameras ({names})")
}

/// Which calibration a message is, whoever encoded it.
fn hash_of(rig: &wire::Rig) -> u64 {
    fnv1a(&wire::encode(rig))
}

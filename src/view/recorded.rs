//! A page that shows a recording.

use std::path::{Path, PathBuf};

use super::frame;
use super::overview::Overview;
use crate::core::time::{Nanos, Timestamp};
use crate::io::recording::{Reader, RecordError, Spans};
use crate::io::wire::{ActorChannel, StageChannel, Topic};

/// Longest span of one answer, and the bytes after which an answer ends.
const LONGEST: Nanos = Nanos::from_ms(60_000);

/// A recording that is shown.
pub struct Recorded {
    path: PathBuf,
    spans: Spans,
    overview: Overview,
}

impl Recorded {
    /// Opens a recording and reads it once; `progress` is called for each message.
    ///
    /// # Errors
    /// As [`Reader`].
    pub fn open(path: &Path, progress: impl FnMut()) -> Result<Self, RecordError> {
        let overview = Overview::read(&mut Reader::open(path)?, progress)?;
        Ok(Self { path: path.to_owned(), spans: Spans::open(path)?, overview })
    }

    /// What it holds.
    pub fn overview(&self) -> &Overview {
        &self.overview
    }

    /// Its file name.
    pub(super) fn name(&self) -> String {
        self.path.file_name().unwrap_or_default().to_string_lossy().into_owned()
    }

    /// The frames of a span of capture time. Of what is sent once and counts from then on (the rig and the
    /// skeletons), those from the beginning of the recording.
    pub(super) fn frames(
        &self,
        [from, to]: [Timestamp; 2],
        kinds: &[&str],
    ) -> Result<Vec<u8>, RecordError> {
        let to = to.min(from + LONGEST);
        let [least, most] = self.overview.delay_ns;
        let (mut states, mut frames) = (Vec::new(), Vec::new());
        let begin = self.overview.start + Nanos::new(least) - Nanos::from_ms(1000);
        let logged = [from + Nanos::new(least), to + Nanos::new(most.saturating_add(1))];
        if kinds.contains(&"state") {
            let until = [Timestamp::from_ns(0).min(begin), logged[1]];
            self.spans.read(
                until,
                |topic| kind(topic) == Some("state"),
                |entry| {
                    let (at, log) = (entry.publish_time, entry.log_time);
                    frame::write(&mut states, &entry.topic, at, log, &entry.payload);
                },
            )?;
        }
        let is_wanted =
            |topic: &str| kind(topic).is_some_and(|kind| kind != "state" && kinds.contains(&kind));
        self.spans.read(logged, is_wanted, |entry| {
            if (from..to).contains(&entry.publish_time) {
                let (at, log) = (entry.publish_time, entry.log_time);
                frame::write(&mut frames, &entry.topic, at, log, &entry.payload);
            }
        })?;
        states.extend(frames);
        Ok(states)
    }
}

/// The kind of a topic, as the page asks for it.
fn kind(topic: &str) -> Option<&'static str> {
    Some(match Topic::parse(topic).ok()? {
        Topic::Stage { channel, .. } => match channel {
            StageChannel::Rig => "state",
            StageChannel::Keypoints { .. } => "keypoints",
            _ => return None,
        },
        Topic::Actor { channel, .. } => match channel {
            ActorChannel::Skeleton => "state",
            ActorChannel::Pose => "pose",
            ActorChannel::Status => "status",
            ActorChannel::Truth => "truth",
            _ => return None,
        },
    })
}

//! A page that shows a recording.

use std::collections::BTreeMap;
use std::path::PathBuf;

use super::frame;
use super::overview::{Gathered, Overview};
use super::points::Points;
use crate::core::time::{Nanos, Timestamp};
use crate::io::file_name;
use crate::io::recording::{RawEntry, Reader, RecordError, Spans};
use crate::io::wire::{ActorChannel, StageChannel, Topic, Topics};

/// Longest span of one answer.
const LONGEST: Nanos = Nanos::from_ms(60_000);

/// A recording that is shown; or several of one take, such as its keypoints and its poses, or two solves of it.
pub struct Recorded {
    files: Vec<File>,
    /// Number of the file whose statuses count, from 0.
    judged: Option<usize>,
    /// Number of the file whose rig counts, from 0.
    rig: Option<usize>,
    overview: Overview,
}

struct File {
    path: PathBuf,
    spans: Spans,
    /// Smallest and largest log time minus capture time.
    delays: [Nanos; 2],
    /// Performers that an earlier file has too, with their names here.
    renamed: BTreeMap<String, String>,
}

impl Recorded {
    /// Opens recordings and reads each once; `progress` is called for each message.
    ///
    /// # Errors
    /// As [`Reader`].
    pub fn open(paths: &[PathBuf], mut progress: impl FnMut()) -> Result<Self, RecordError> {
        let (mut files, mut all) = (Vec::<File>::new(), Gathered::default());
        for (number, path) in (1..).zip(paths) {
            let (delays, renamed) = all.read(&mut Reader::open(path)?, number, &mut progress)?;
            files.push(File { path: path.clone(), spans: Spans::open(path)?, delays, renamed });
        }
        let [judged, rig] = [all.judged(), all.rig()].map(|file| file.map(|number| number - 1));
        Ok(Self { files, judged, rig, overview: all.finish() })
    }

    /// What they hold.
    pub fn overview(&self) -> &Overview {
        &self.overview
    }

    /// The file names.
    pub(super) fn name(&self) -> String {
        self.files.iter().map(|file| file_name(&file.path)).collect::<Vec<_>>().join(", ")
    }

    /// The frames of a span of capture time. Of what is sent once and counts from then on (the rig and the
    /// skeletons), those from the beginning of the recording.
    pub(super) fn frames(
        &self,
        [from, to]: [Timestamp; 2],
        kinds: &[&str],
    ) -> Result<Vec<u8>, RecordError> {
        let to = to.min(from + LONGEST);
        let (mut entries, mut points) = (Vec::new(), Points::default());
        for (number, File { spans, delays: [least, most], renamed, .. }) in (0..).zip(&self.files) {
            let known = entries.len();
            let until = to + *most + Nanos::new(1);
            let before = [Timestamp::from_ns(i64::MIN), until];
            let is_state = |topic: &str| {
                let kind = kind(topic);
                kind == Some("state") || kind == Some("rig") && self.rig == Some(number)
            };
            entries.extend(spans.read(before, is_state)?);
            let is_streamed = |topic: &str| {
                let is_other = |kind| kind == "status" && self.judged != Some(number);
                kind(topic).is_some_and(|kind| kinds.contains(&kind) && !is_other(kind))
            };
            let streamed = spans.read([from + *least, until], is_streamed)?;
            let is_inside = |entry: &RawEntry| (from..to).contains(&entry.publish_time);
            entries.extend(streamed.into_iter().filter(is_inside));
            for entry in &mut entries[known..] {
                let new = renamed.get(&Topic::actor(&entry.topic));
                let topics = Topic::parse(&entry.topic).ok().and_then(|topic| topic.topics());
                if let (Some(new), Some(Topics { actor, .. })) = (new, topics) {
                    let [old, new] = [actor, new.clone()].map(|name| format!("/actor/{name}/"));
                    entry.topic = entry.topic.replacen(&old, &new, 1).into();
                }
            }
        }
        // States first, then what they are needed for.
        let order = |entry: &RawEntry| match kind(&entry.topic) {
            Some("rig" | "state") => 0,
            // It may correct the keypoints' times.
            Some("status") => 1,
            Some("keypoints") => 2,
            _ => 3,
        };
        entries.sort_by_key(order);
        let mut frames = Vec::new();
        for RawEntry { topic, log_time, publish_time, payload, .. } in &entries {
            frame::write(&mut frames, topic, *publish_time, *log_time, payload);
            if let Some((topic, payload)) = points.follow(topic, payload) {
                frame::write(&mut frames, &topic, *publish_time, *log_time, &payload);
            }
        }
        Ok(frames)
    }
}

/// The kind of a topic, as the page asks for it.
fn kind(topic: &str) -> Option<&'static str> {
    Some(match Topic::parse(topic).ok()? {
        Topic::Stage { channel, .. } => match channel {
            StageChannel::Rig => "rig",
            StageChannel::Keypoints { .. } => "keypoints",
            _ => return None,
        },
        Topic::Actor { channel, .. } => match channel {
            ActorChannel::Skeleton => "state",
            ActorChannel::Pose => "pose",
            ActorChannel::Provisional => "provisional",
            ActorChannel::Status => "status",
            _ => return None,
        },
    })
}

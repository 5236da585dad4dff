//! Recordings of what is on the bus: one of everything, and one of each take.
//!
//! A take's file begins with the calibration and the inputs of the second before its slate: a node
//! may handle them after the slate. It ends a second after the take, when the last poses are there.

use std::collections::{BTreeMap, VecDeque};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use super::silence::Silence;
use crate::core::time::{Nanos, Timestamp};
use crate::io::recording::{Provenance, RawEntry, RecordError, Writer};
use crate::io::wire::{StageChannel, Take, Topic, Topics, valid_name};

/// Inputs of this time before a take are in its file, and messages of this time after it.
const MARGIN: Nanos = Nanos::SECOND;
/// Most inputs that are kept for the next take.
const MOST_RECENT: usize = 65_536;
/// Recording stops when the disk has less room, bytes: enough for the end of the files.
const LEAST_ROOM: u64 = 64 << 20;
/// A warning is given when the disk has room for less than this time, or for fewer bytes.
const WARN_SECONDS: u64 = 600;
const WARN_ROOM: u64 = 256 << 20;

/// Counts of recorded messages.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Recorded {
    /// Messages by topic.
    pub(crate) topics: BTreeMap<Arc<str>, u64>,
    /// Messages on all topics.
    pub(crate) messages: u64,
    /// Bytes of payload.
    pub(crate) bytes: u64,
    /// Messages that were dropped because the queue to the disk was full.
    pub(crate) dropped: u64,
    /// Messages on topics above the limit, which are not recorded.
    pub(crate) skipped: u64,
}

/// A file that is being written.
struct Open {
    path: PathBuf,
    writer: Writer,
    recorded: Recorded,
}

impl Open {
    fn write(&mut self, entry: &RawEntry) -> Result<(), RecordError> {
        match self.writer.write_raw(entry) {
            Err(RecordError::TooManyTopics { .. }) => self.recorded.skipped += 1,
            done => {
                done?;
                self.recorded.messages += 1;
                self.recorded.bytes += entry.payload.len() as u64;
                *self.recorded.topics.entry(Arc::clone(&entry.topic)).or_default() += 1;
            }
        }
        Ok(())
    }

    fn finish(self) -> Result<(PathBuf, Recorded), RecordError> {
        self.writer.finish()?;
        Ok((self.path, self.recorded))
    }
}

/// The take that is recorded.
struct Running {
    name: String,
    file: Open,
    /// The command that ended it, and when its file ends.
    ends: Option<(u64, Timestamp)>,
}

/// Something to say or to answer.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum Said {
    /// To the one who records.
    Warning(String),
    /// To the one who gave the command of that id; `Err`: it was refused.
    Answer(u64, Result<String, String>),
}

/// The open files.
pub(crate) struct Recorder {
    topics: Topics,
    provenance: Provenance,
    folder: PathBuf,
    all: Option<Open>,
    take: Option<Running>,
    rig: Option<RawEntry>,
    /// The inputs of the last second.
    recent: VecDeque<RawEntry>,
    silence: Silence,
    /// What is not said again: topics above the limit, little room.
    is_skipping_said: bool,
    is_room_said: bool,
    /// Bytes before the last second.
    bytes: [u64; 2],
}

impl Recorder {
    /// Records everything to `file` if there is one, and takes to `folder`.
    pub(crate) fn start(
        file: Option<&Path>,
        folder: &Path,
        topics: Topics,
        provenance: Provenance,
    ) -> Result<Self, RecordError> {
        let open = |path: &Path| -> Result<Open, RecordError> {
            let writer = Writer::live(path, topics.clone(), &provenance)?;
            Ok(Open { path: path.to_owned(), writer, recorded: Recorded::default() })
        };
        Ok(Self {
            all: file.map(open).transpose()?,
            topics,
            provenance,
            folder: folder.to_owned(),
            take: None,
            rig: None,
            recent: VecDeque::new(),
            silence: Silence::default(),
            is_skipping_said: false,
            is_room_said: false,
            bytes: [0; 2],
        })
    }

    /// Writes a message to the open files.
    pub(crate) fn write(&mut self, entry: RawEntry) -> Result<(), RecordError> {
        let files = self.all.iter_mut().chain(self.take.iter_mut().map(|take| &mut take.file));
        for file in files {
            file.write(&entry)?;
        }
        self.bytes[1] += entry.payload.len() as u64;
        self.silence.came(&entry.topic, entry.log_time);
        match Topic::parse(&entry.topic) {
            Ok(Topic::Stage { channel: StageChannel::Rig, .. }) => self.rig = Some(entry),
            Ok(Topic::Stage { channel: StageChannel::Keypoints { .. }, .. }) => {
                let from = entry.log_time - MARGIN;
                self.recent.push_back(entry);
                let is_old = |first: &RawEntry| first.log_time < from;
                while self.recent.len() > MOST_RECENT || self.recent.front().is_some_and(is_old) {
                    self.recent.pop_front();
                }
            }
            _ => {}
        }
        Ok(())
    }

    /// Handles a slate. The end of a take is answered when its file is complete.
    pub(crate) fn slate(&mut self, take: &Take, now: Timestamp) -> Result<Vec<Said>, RecordError> {
        let running = self.take.as_ref().filter(|running| running.ends.is_none());
        let is_other = |name: &str| !take.name.is_empty() && take.name != name;
        let refuse = |why: String| Ok(vec![Said::Answer(take.id, Err(why))]);
        match (take.action.as_str(), running) {
            ("start", _) => match valid_name(&take.name) {
                Ok(()) => self.begin(take),
                Err(error) => refuse(error.to_string()),
            },
            ("stop", Some(running)) if is_other(&running.name) => {
                refuse(format!("take {} is recorded, not {}", running.name, take.name))
            }
            ("stop", Some(_)) => {
                self.take.iter_mut().for_each(|run| run.ends = Some((take.id, now + MARGIN)));
                Ok(Vec::new())
            }
            _ => Ok(Vec::new()),
        }
    }

    fn begin(&mut self, take: &Take) -> Result<Vec<Said>, RecordError> {
        let mut said = self.end_take()?;
        let path = self.free_path(&take.name);
        let mut provenance = self.provenance.clone();
        provenance.more.insert("take".into(), take.name.clone());
        let writer = match Writer::live(&path, self.topics.clone(), &provenance) {
            Ok(writer) => writer,
            Err(error) => {
                said.push(Said::Answer(take.id, Err(error.to_string())));
                return Ok(said);
            }
        };
        let mut file = Open { path, writer, recorded: Recorded::default() };
        for entry in self.rig.iter().chain(&self.recent) {
            file.write(entry)?;
        }
        said.push(Said::Answer(take.id, Ok(format!("recording to {}", file.path.display()))));
        self.take = Some(Running { name: take.name.clone(), file, ends: None });
        Ok(said)
    }

    /// `NAME.mcap`, or `NAME_2.mcap` and so on if that exists.
    fn free_path(&self, name: &str) -> PathBuf {
        let path = |file: String| self.folder.join(file);
        let is_free =
            |file: &String| !path(file.clone()).exists() && !path(format!("{file}.part")).exists();
        let names = (2..).map(|number: u64| format!("{name}_{number}.mcap"));
        let file = std::iter::once(format!("{name}.mcap")).chain(names).find(is_free);
        path(file.unwrap_or_default())
    }

    fn end_take(&mut self) -> Result<Vec<Said>, RecordError> {
        let Some(Running { file, ends, .. }) = self.take.take() else { return Ok(Vec::new()) };
        let (path, recorded) = file.finish()?;
        let text = format!("{}: {} messages", path.display(), recorded.messages);
        Ok(vec![match ends {
            Some((id, _)) => Said::Answer(id, Ok(text)),
            None => Said::Warning(format!("the next take began: {text}")),
        }])
    }

    /// Ends the take's file if it is time.
    pub(crate) fn tick(&mut self, now: Timestamp) -> Result<Vec<Said>, RecordError> {
        let ends = self.take.as_ref().and_then(|take| take.ends);
        if ends.is_some_and(|(_, at)| now >= at) { self.end_take() } else { Ok(Vec::new()) }
    }

    /// Work that is done once a second: flushes the files, and reports silent streams, skipped
    /// topics and little `room` on the disk, bytes. The second value is false if there is too little
    /// to go on.
    pub(crate) fn second(
        &mut self,
        now: Timestamp,
        room: Option<u64>,
    ) -> Result<(Vec<Said>, bool), RecordError> {
        let mut said = Vec::new();
        let files = self.all.iter_mut().chain(self.take.iter_mut().map(|take| &mut take.file));
        let mut skipped = 0;
        for file in files {
            file.writer.flush()?;
            skipped += file.recorded.skipped;
        }
        if skipped > 0 && !std::mem::replace(&mut self.is_skipping_said, true) {
            let most = Writer::MOST_TOPICS;
            said.push(Said::Warning(format!(
                "more than {most} topics: further ones are not recorded; choose with --topics"
            )));
        }
        said.extend(self.silence.report(now).map(Said::Warning));
        let [before, bytes] = self.bytes;
        self.bytes = [bytes; 2];
        let rate = bytes - before;
        let Some(room) = room else { return Ok((said, true)) };
        let left = room.saturating_sub(LEAST_ROOM);
        let megabytes = room >> 20;
        if left == 0 {
            let text = format!("{megabytes} MB of room on the disk, recording stops");
            said.push(Said::Warning(text));
            return Ok((said, false));
        }
        let is_little = left < WARN_ROOM.max(rate * WARN_SECONDS);
        if is_little && !std::mem::replace(&mut self.is_room_said, true) {
            let minutes = left / rate.max(1) / 60;
            said.push(Said::Warning(format!(
                "{megabytes} MB of room on the disk, for about {minutes} minutes; make room"
            )));
        }
        self.is_room_said &= is_little;
        Ok((said, true))
    }

    /// Counts of the file of everything, or else of the take.
    pub(crate) fn recorded(&self) -> Recorded {
        let file = self.all.as_ref().or(self.take.as_ref().map(|take| &take.file));
        file.map(|file| file.recorded.clone()).unwrap_or_default()
    }

    /// Completes all files; returns the counts of the file of everything.
    pub(crate) fn finish(mut self) -> Result<(Recorded, Vec<Said>), RecordError> {
        let said = self.end_take()?;
        let recorded = self.all.map(Open::finish).transpose()?;
        Ok((recorded.map(|(_, recorded)| recorded).unwrap_or_default(), said))
    }
}

/// Bytes that may still be written on the disk of that folder, if the system says so.
pub(crate) fn room(folder: &Path) -> Option<u64> {
    let stat = rustix::fs::statvfs(folder).ok()?;
    Some(stat.f_bavail.saturating_mul(stat.f_frsize))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::io::recording::Reader;
    use crate::io::wire::{ENCODING, schema_of};

    fn at(seconds: f64) -> Timestamp {
        Timestamp::from_ns(1_700_000_000_000_000_000 + (seconds * 1e9) as i64)
    }

    fn entry(topic: &str, seconds: f64) -> RawEntry {
        RawEntry {
            topic: topic.into(),
            schema: schema_of(topic, "").unwrap_or_default().into(),
            encoding: ENCODING.into(),
            log_time: at(seconds),
            publish_time: at(seconds),
            payload: vec![0; 100],
        }
    }

    fn slate(action: &str, name: &str) -> Take {
        Take { id: 3, action: action.into(), name: name.into() }
    }

    /// In a folder of its own, without a file of everything.
    fn recorder() -> (tempfile::TempDir, Recorder) {
        let folder = tempfile::tempdir().unwrap();
        let (topics, provenance) = (Topics::default(), Provenance::default());
        let recorder = Recorder::start(None, folder.path(), topics, provenance).unwrap();
        (folder, recorder)
    }

    #[test]
    fn a_take_has_the_rig_the_inputs_around_it_and_a_number_of_its_own() {
        let (folder, mut recorder) = recorder();
        let topics = Topics::default();
        recorder.write(entry(&topics.rig(), 0.0)).unwrap();
        for round in 0..2 {
            let begin = f64::from(10 * round);
            for i in 0..50 {
                let now = begin + 0.1 * f64::from(i);
                if i == 20 {
                    let said = recorder.slate(&slate("start", "walk"), at(now)).unwrap();
                    assert!(matches!(&said[..], [Said::Answer(3, Ok(_))]), "{said:?}");
                }
                if i == 30 {
                    assert!(recorder.slate(&slate("stop", ""), at(now)).unwrap().is_empty());
                }
                recorder.write(entry(&topics.keypoints("a"), now)).unwrap();
                recorder.write(entry(&topics.pose(), now)).unwrap();
                let ended = recorder.tick(at(now)).unwrap();
                assert_eq!(ended.len(), usize::from(i == 40), "{i} {ended:?}");
            }
        }
        // Another recorder may have it.
        assert!(recorder.slate(&slate("stop", ""), at(30.0)).unwrap().is_empty());
        recorder.slate(&slate("start", "run"), at(31.0)).unwrap();
        let refused = recorder.slate(&slate("stop", "walk"), at(31.0)).unwrap();
        assert!(matches!(&refused[..], [Said::Answer(3, Err(_))]), "{refused:?}");
        recorder.finish().unwrap();
        for file in ["walk.mcap", "walk_2.mcap"] {
            let mut reader = Reader::open(folder.path().join(file)).unwrap();
            let mut counts = BTreeMap::<Arc<str>, u64>::new();
            while let Some(entry) = reader.next_raw() {
                *counts.entry(entry.unwrap().topic).or_default() += 1;
            }
            // Frames of the second before, of the take and of the second after it; poses since it.
            let counts: Vec<u64> = counts.into_values().collect();
            assert!(matches!(counts[..], [21, 31..=32, 1]), "{file} {counts:?}");
        }
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 3);
    }

    #[test]
    fn topics_above_the_limit_are_counted_and_said_once() {
        let (_folder, mut recorder) = recorder();
        recorder.slate(&slate("start", "walk"), at(0.0)).unwrap();
        for i in 0..Writer::MOST_TOPICS + 10 {
            recorder.write(entry(&format!("mocap/stage/thing/{i}"), 0.0)).unwrap();
        }
        let recorded = recorder.recorded();
        assert_eq!((recorded.messages, recorded.skipped), (Writer::MOST_TOPICS as u64, 10));
        let said = recorder.second(at(1.0), None).unwrap().0;
        assert!(matches!(&said[..], [Said::Warning(text)] if text.contains("16384")), "{said:?}");
        assert!(recorder.second(at(2.0), None).unwrap().0.is_empty());
        recorder.finish().unwrap();
    }

    #[test]
    fn silence_and_little_room_are_said_once_and_a_full_disk_stops() {
        let (_folder, mut recorder) = recorder();
        let topic = Topics::default().keypoints("a");
        let said = |recorder: &mut Recorder, seconds: f64, megabytes: u64| {
            let (said, goes_on) = recorder.second(at(seconds), Some(megabytes << 20)).unwrap();
            (said.len(), goes_on)
        };
        recorder.write(entry(&topic, 0.0)).unwrap();
        assert_eq!(said(&mut recorder, 2.0, 5000), (0, true));
        assert_eq!(said(&mut recorder, 4.0, 5000), (1, true), "silent");
        assert_eq!(said(&mut recorder, 5.0, 5000), (0, true), "said before");
        recorder.write(entry(&topic, 6.0)).unwrap();
        assert_eq!(said(&mut recorder, 10.0, 5000), (1, true), "silent again");
        assert_eq!(said(&mut recorder, 11.0, 300), (1, true), "little room");
        assert_eq!(said(&mut recorder, 12.0, 299), (0, true), "said before");
        assert_eq!(said(&mut recorder, 13.0, 60), (1, false), "full");
    }
}

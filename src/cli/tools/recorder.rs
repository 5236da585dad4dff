//! Recordings of what is on the bus: one of everything, and one of each take.
//!
//! A take's file begins with the calibration, the last hand-overs, and the inputs of the second before its slate: a node
//! may handle them after the slate. It ends a second and the latency (at most two seconds) after the take.

use std::collections::BTreeMap;
use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, UNIX_EPOCH};

use super::before::{Before, MARGIN};
use super::numbers::Numbers;
use super::room::Room;
use super::silence::Silence;
use crate::core::time::{Nanos, Timestamp};
use crate::io::recording::{Provenance, RawEntry, RecordError, Writer, part_of};
use crate::io::wire::{
    ActorChannel, StageChannel, Status, Take, Topic, Topics, decode, valid_name,
};

/// The list of notes in the folder of takes.
const NOTES: &str = "takes.csv";
/// Limit of the wait for the last poses at the end of a file, so that commands are answered soon.
const LONGEST_LATENCY: Nanos = Nanos::from_ms(2000);

/// Counts of recorded messages.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Recorded {
    /// Messages by topic.
    pub(crate) topics: BTreeMap<Arc<str>, u64>,
    /// The numbers of frames and of sets.
    pub(crate) numbers: Numbers,
    /// Messages on all topics.
    pub(crate) messages: u64,
    /// Bytes of payload.
    pub(crate) bytes: u64,
    /// Messages that were dropped because the queue to the disk was full.
    pub(crate) dropped: u64,
    /// Messages on topics above the limit, which are not recorded.
    pub(crate) skipped: u64,
    /// Takes that could not be completed.
    pub(crate) failed: u64,
}

impl Recorded {
    /// What is in the file of a take, and what is missing.
    fn text(&self) -> String {
        let missing = self.numbers.all_missing();
        let missing: Vec<_> =
            missing.map(|(camera, frames)| format!("{camera} {frames}")).collect();
        let messages = format!("{} messages", self.messages);
        match missing.is_empty() {
            true => messages,
            false => format!("{messages}; missing by their numbers: {}", missing.join(", ")),
        }
    }
}

/// A file that is being written.
struct Open {
    path: PathBuf,
    writer: Writer,
    recorded: Recorded,
    /// Why it will not be complete.
    broken: Option<String>,
}

impl Open {
    fn create(path: PathBuf, topics: &Topics, about: &Provenance) -> Result<Self, RecordError> {
        let writer = Writer::live(&path, topics.clone(), about)?;
        Ok(Self { path, writer, recorded: Recorded::default(), broken: None })
    }

    fn write(&mut self, entry: &RawEntry) -> Result<(), RecordError> {
        match self.writer.write_raw(entry) {
            Err(RecordError::TooManyTopics { .. }) => self.recorded.skipped += 1,
            done => {
                done?;
                self.recorded.messages += 1;
                self.recorded.bytes += entry.payload.len() as u64;
                self.recorded.numbers.add(entry);
                *self.recorded.topics.entry(Arc::clone(&entry.topic)).or_default() += 1;
            }
        }
        Ok(())
    }

    /// Completes it; returns its path and what it has, or why it is not complete.
    fn finish(self) -> Result<(PathBuf, Recorded), String> {
        match self.broken {
            Some(why) => Err(why),
            None => {
                self.writer.finish().map_err(|error| error.to_string())?;
                Ok((self.path, self.recorded))
            }
        }
    }
}

/// A take that is recorded.
struct Running {
    name: String,
    file: Open,
}

/// A take after its end, until its file is complete.
struct Ending {
    file: Open,
    until: Timestamp,
    /// The command that ended it; `None`: the next take began, or the recording ended.
    command: Option<u64>,
}

/// The open files of takes.
fn of_takes<'a>(
    take: &'a mut Option<Running>,
    ending: &'a mut [Ending],
) -> impl Iterator<Item = &'a mut Open> {
    let ending = ending.iter_mut().map(|ending| &mut ending.file);
    take.iter_mut().map(|take| &mut take.file).chain(ending)
}

/// Something to say or to answer.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum Said {
    /// To the one who records.
    Warning(String),
    /// To the one who gave the command of that id; `Err`: it was refused. Of id 0: to everybody.
    Answer(u64, Result<String, String>),
}

/// `NAME`, `NAME_2` and so on.
fn numbered(name: &str) -> impl Iterator<Item = String> {
    let more = (2..).map(move |number: u64| format!("{name}_{number}"));
    std::iter::once(name.to_owned()).chain(more)
}

/// The open files.
pub(crate) struct Recorder {
    topics: Topics,
    provenance: Provenance,
    folder: PathBuf,
    all: Option<Open>,
    take: Option<Running>,
    /// The take that ended because the disk was full, until the next one.
    cut: Option<String>,
    /// The running take, or the last one: its name, and the name of its file without the ending.
    last: Option<(String, String)>,
    ending: Vec<Ending>,
    /// Messages on topics above the limit, of all complete takes.
    skipped: u64,
    /// Number of takes that could not be completed.
    failed: u64,
    before: Before,
    /// The longest latency of a node so far: its last poses come this late.
    latency: Nanos,
    silence: Silence,
    room: Room,
    /// Topics above the limit are not said again.
    is_skipping_said: bool,
    /// Whether a take may run that began before this recorder.
    may_join: bool,
    /// By topic of a status with such a take, the node's time, ns.
    running: BTreeMap<Arc<str>, i64>,
}

impl Recorder {
    /// Records everything to `file` if there is one, and takes to `folder`.
    pub(crate) fn start(
        file: Option<&Path>,
        folder: &Path,
        topics: Topics,
        provenance: Provenance,
    ) -> Result<Self, RecordError> {
        let open = |path: &Path| Open::create(path.to_owned(), &topics, &provenance);
        Ok(Self {
            all: file.map(open).transpose()?,
            topics,
            provenance,
            folder: folder.to_owned(),
            take: None,
            cut: None,
            last: None,
            ending: Vec::new(),
            skipped: 0,
            failed: 0,
            before: Before::default(),
            latency: Nanos::ZERO,
            silence: Silence::default(),
            room: Room::default(),
            is_skipping_said: false,
            may_join: true,
            running: BTreeMap::new(),
        })
    }

    /// Does something with all open files. If it fails with that of a take, the others go on.
    fn each(
        &mut self,
        act: impl Fn(&mut Open) -> Result<(), RecordError>,
    ) -> Result<Vec<Said>, RecordError> {
        self.all.as_mut().map_or(Ok(()), &act)?;
        let mut said = Vec::new();
        for file in of_takes(&mut self.take, &mut self.ending).filter(|file| file.broken.is_none())
        {
            if let Err(error) = act(file) {
                let path = file.path.display();
                let text = format!("{path}: what follows is not recorded: {error}");
                said.push(Said::Answer(0, Err(text)));
                file.broken = Some(error.to_string());
            }
        }
        Ok(said)
    }

    /// Writes a message to the open files. First completes those whose time has come, and opens a file if a node says that
    /// a take runs which began before this recorder.
    pub(crate) fn write(&mut self, entry: RawEntry) -> Result<Vec<Said>, RecordError> {
        let mut said = self.tick(entry.log_time)?;
        said.extend(self.join(&entry)?);
        said.extend(self.each(|file| file.write(&entry))?);
        self.room.wrote(entry.payload.len());
        self.silence.came(&entry.topic, entry.log_time);
        let Ok(topic) = Topic::parse(&entry.topic) else { return Ok(said) };
        if topic.stage() != self.topics.stage {
            return Ok(said);
        }
        match topic {
            Topic::Stage { channel: StageChannel::Status, .. } => {
                decode(&entry.payload).iter().for_each(|status| self.silence.forget_absent(status));
            }
            Topic::Actor { channel: ActorChannel::Status, .. } => {
                let latency = decode::<Status>(&entry.payload).map_or(0, |s| s.declared_latency_ns);
                let latency = Nanos::new(i64::try_from(latency).unwrap_or(0)).min(LONGEST_LATENCY);
                self.latency = self.latency.max(latency);
            }
            _ => {}
        }
        self.before.keep(entry);
        Ok(said)
    }

    /// The command, if this is one for the stage that is recorded.
    pub(crate) fn command(&self, topic: &str, payload: &[u8]) -> Option<Take> {
        match Topic::parse(topic) {
            Ok(Topic::Stage { stage, channel: StageChannel::Take })
                if stage == self.topics.stage =>
            {
                decode(payload).ok()
            }
            _ => None,
        }
    }

    fn join(&mut self, entry: &RawEntry) -> Result<Vec<Said>, RecordError> {
        let topic = Topic::parse(&entry.topic);
        let is_status = matches!(topic, Ok(Topic::Actor { stage, channel: ActorChannel::Status, .. })
            if stage == self.topics.stage);
        let status = (self.may_join && is_status).then(|| decode::<Status>(&entry.payload));
        let Some(Ok(Status { take: name, node_time_ns, .. })) = status else {
            return Ok(Vec::new());
        };
        if valid_name(&name).is_err() {
            return Ok(Vec::new());
        }
        // The first one may be the last one of a node that has ended, or of a performer who had another name.
        let before = self.running.insert(Arc::clone(&entry.topic), node_time_ns);
        if before.is_none_or(|before| before == node_time_ns) {
            return Ok(Vec::new());
        }
        self.may_join = false;
        let said = self.begin(&Take { name: name.clone(), ..Take::default() }, entry.log_time)?;
        let as_warning = |said| match said {
            Said::Answer(_, Ok(text)) => Said::Warning(format!(
                "take {name} began before this recorder: {text}; earlier frames are not in the file"
            )),
            Said::Answer(_, Err(text)) | Said::Warning(text) => Said::Warning(text),
        };
        Ok(said.into_iter().map(as_warning).collect())
    }

    /// Handles a slate. The end of a take is answered when its file is complete.
    pub(crate) fn slate(&mut self, take: &Take, now: Timestamp) -> Result<Vec<Said>, RecordError> {
        let is_other = |name: &str| !take.name.is_empty() && take.name != name;
        let refuse = |why: String| Ok(vec![Said::Answer(take.id, Err(why))]);
        self.may_join &= !matches!(take.action.as_str(), "start" | "stop");
        match (take.action.as_str(), &self.take) {
            ("start", _) => match valid_name(&take.name) {
                Ok(()) => self.begin(take, now),
                Err(error) => refuse(error.to_string()),
            },
            ("stop", Some(running)) if is_other(&running.name) => {
                refuse(format!("take {} is recorded, not {}", running.name, take.name))
            }
            ("stop", _) => {
                self.stop(Some(take.id), now);
                match self.cut.take_if(|cut| !is_other(cut)) {
                    Some(cut) => refuse(format!("take {cut} has already ended: the disk was full")),
                    None => Ok(Vec::new()),
                }
            }
            ("note", _) => {
                let noted = self.note(take, now).map_err(|error| error.to_string());
                Ok(vec![Said::Answer(take.id, noted)])
            }
            _ => Ok(Vec::new()),
        }
    }

    /// Adds a line to the list of takes.
    fn note(&self, take: &Take, now: Timestamp) -> std::io::Result<String> {
        let is_last = |(last, _): &&(String, String)| take.name.is_empty() || *last == take.name;
        let last = self.last.as_ref().filter(is_last).map(|(_, file)| file);
        let name = match last {
            Some(name) => name.clone(),
            None if take.name.is_empty() => {
                let why = "no take was recorded since this recorder began; give the take's name";
                return Err(std::io::Error::other(why));
            }
            // The last take of that name.
            None => {
                let is_there = |file: &String| self.folder.join(format!("{file}.mcap")).exists();
                let last = numbered(&take.name).take_while(is_there).last();
                let none = || format!("no take {} is in {}", take.name, self.folder.display());
                last.ok_or_else(|| std::io::Error::other(none()))?
            }
        };
        let path = self.folder.join(NOTES);
        let is_new = !path.exists();
        let file = std::fs::OpenOptions::new().create(true).append(true).open(&path);
        let mut file =
            file.map_err(|error| std::io::Error::other(format!("{}: {error}", path.display())))?;
        if is_new {
            writeln!(file, "time,take,mark,note")?;
        }
        let quoted = |text: &str| format!("\"{}\"", text.replace('"', "\"\""));
        let (mark, note) = (quoted(&take.mark), quoted(&take.note));
        let time = UNIX_EPOCH + Duration::from_nanos(now.ns().unsigned_abs());
        let time = humantime::format_rfc3339_seconds(time);
        writeln!(file, "{time},{},{mark},{note}", quoted(&name))?;
        Ok(format!("noted for {name} in {}", path.display()))
    }

    /// The take ends, and its file after [`MARGIN`] and the latency of the last poses.
    fn stop(&mut self, command: Option<u64>, now: Timestamp) {
        let stopped = self.take.take();
        let until = now + MARGIN + self.latency;
        self.ending.extend(stopped.map(|Running { file, .. }| Ending { file, until, command }));
    }

    fn begin(&mut self, take: &Take, now: Timestamp) -> Result<Vec<Said>, RecordError> {
        self.stop(None, now);
        let free = match self.room.free() {
            Ok(free) => free,
            Err(why) => return Ok(vec![Said::Answer(take.id, Err(why))]),
        };
        self.cut = None;
        let path = self.free_path(&take.name);
        let mut provenance = self.provenance.clone();
        provenance.more.insert("take".into(), take.name.clone());
        let stem = path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
        let mut file = match Open::create(path, &self.topics, &provenance) {
            Ok(file) => file,
            Err(error) => return Ok(vec![Said::Answer(take.id, Err(error.to_string()))]),
        };
        for entry in self.before.take(now) {
            if let Err(error) = file.write(&entry) {
                return Ok(vec![Said::Answer(take.id, Err(error.to_string()))]);
            }
        }
        let free = free.map_or(String::new(), |free| format!(", {:.1} GB free", free as f64 / 1e9));
        let text = format!("recording to {}{free}", file.path.display());
        self.last = Some((take.name.clone(), stem));
        self.take = Some(Running { name: take.name.clone(), file });
        Ok(vec![Said::Answer(take.id, Ok(text))])
    }

    /// `NAME.mcap`, or `NAME_2.mcap` and so on if that exists.
    fn free_path(&self, name: &str) -> PathBuf {
        let path = |file: String| self.folder.join(file);
        // A take that has not ended yet keeps its name, even if its file was removed.
        let is_open =
            |file: &String| self.ending.iter().any(|one| one.file.path == path(file.clone()));
        let is_there =
            |file: &String| path(file.clone()).exists() || path(format!("{file}.part")).exists();
        let is_free = |file: &String| !is_there(file) && !is_open(file);
        let file = numbered(name).map(|name| format!("{name}.mcap")).find(is_free);
        path(file.unwrap_or_default())
    }

    /// The take that is recorded.
    pub(crate) fn running(&self) -> Option<&str> {
        self.take.as_ref().map(|take| take.name.as_str())
    }

    /// Completes the files whose time has come.
    pub(crate) fn tick(&mut self, now: Timestamp) -> Result<Vec<Said>, RecordError> {
        let mut said = Vec::new();
        for Ending { file, command, .. } in self.ending.extract_if(.., |take| now >= take.until) {
            let path = file.path.display().to_string();
            // The other takes go on.
            let done = match file.finish() {
                Ok((_, recorded)) => {
                    self.skipped += recorded.skipped;
                    Ok(format!("{path}: {}", recorded.text()))
                }
                Err(why) => {
                    self.failed += 1;
                    Err(format!("{path} is not complete: {why}"))
                }
            };
            said.push(match (command, done) {
                (Some(id), done) => Said::Answer(id, done),
                (None, Ok(text)) => Said::Warning(format!("the take was not stopped: {text}")),
                (None, Err(text)) => Said::Warning(text),
            });
        }
        Ok(said)
    }

    /// Work that is done once a second: flushes the files, and reports silent streams, skipped
    /// topics and little `room` on the disk, bytes. If there is too little, the take ends; the second
    /// value is false if everything is recorded, which ends too.
    pub(crate) fn second(
        &mut self,
        now: Timestamp,
        room: Option<u64>,
    ) -> Result<(Vec<Said>, bool), RecordError> {
        let mut said = self.each(|file| file.writer.flush())?;
        let mut skipped = 0;
        for file in self.all.iter_mut().chain(of_takes(&mut self.take, &mut self.ending)) {
            skipped += file.recorded.skipped;
            let part = part_of(&file.path);
            if file.broken.is_none() && !part.exists() {
                file.broken = Some("somebody has removed or moved it".to_owned());
                let text = format!("{} is gone: what is recorded there is lost", part.display());
                said.push(Said::Warning(text));
            }
        }
        if skipped > 0 && !std::mem::replace(&mut self.is_skipping_said, true) {
            let most = Writer::MOST_TOPICS;
            said.push(Said::Warning(format!(
                "more than {most} topics: further ones are not recorded; choose with --topics"
            )));
        }
        said.extend(self.silence.report(now).map(Said::Warning));
        let (warning, goes_on) = self.room.report(room);
        said.extend(warning.map(Said::Warning));
        if goes_on || self.all.is_some() {
            return Ok((said, goes_on));
        }
        // Commands are still answered, and there may be room again.
        if let Some(Running { name, file }) = self.take.take() {
            let what = match file.finish() {
                Ok((path, recorded)) => {
                    self.skipped += recorded.skipped;
                    format!("{}: {}", path.display(), recorded.text())
                }
                Err(why) => why,
            };
            let text = format!("take {name} ends before its time, the disk is full; {what}");
            said.push(Said::Answer(0, Err(text)));
            self.failed += 1;
            self.cut = Some(name);
        }
        Ok((said, true))
    }

    /// Counts of the file of everything, or else of the take.
    pub(crate) fn recorded(&self) -> Recorded {
        let file = self.all.as_ref().or(self.take.as_ref().map(|take| &take.file));
        file.map(|file| file.recorded.clone()).unwrap_or_default()
    }

    /// Completes all files; returns the counts of the file of everything. Without one, what was
    /// skipped is that of all takes.
    pub(crate) fn finish(mut self) -> Result<(Recorded, Vec<Said>), RecordError> {
        self.stop(None, Timestamp::default());
        let said = self.tick(Timestamp::from_ns(i64::MAX))?;
        let takes = Recorded { skipped: self.skipped, ..Recorded::default() };
        let recorded = match self.all {
            Some(Open { writer, recorded, .. }) => writer.finish().map(|_| recorded)?,
            None => takes,
        };
        Ok((Recorded { failed: self.failed, ..recorded }, said))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::io::recording::Reader;
    use crate::io::wire::{ENCODING, encode, schema_of};

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
        Take { id: 3, action: action.into(), name: name.into(), ..Take::default() }
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
                let ended = recorder.write(entry(&topics.keypoints("a"), now)).unwrap();
                assert_eq!(ended.len(), usize::from(i == 40), "{i} {ended:?}");
                recorder.write(entry(&topics.pose(), now)).unwrap();
            }
        }
        // A note is for the file, whatever the name of the take.
        let note = Take { mark: "good".into(), ..slate("note", "walk") };
        let said = recorder.slate(&note, at(29.0)).unwrap();
        assert!(
            matches!(&said[..], [Said::Answer(3, Ok(text))] if text.contains("walk_2 ")),
            "{said:?}"
        );
        let said = recorder.slate(&slate("note", "wlak"), at(29.0)).unwrap();
        assert!(
            matches!(&said[..], [Said::Answer(3, Err(why))] if why.contains("wlak")),
            "{said:?}"
        );
        // Another recorder may have it.
        assert!(recorder.slate(&slate("stop", ""), at(30.0)).unwrap().is_empty());
        recorder.slate(&slate("start", "run"), at(31.0)).unwrap();
        let refused = recorder.slate(&slate("stop", "walk"), at(31.0)).unwrap();
        assert!(matches!(&refused[..], [Said::Answer(3, Err(_))]), "{refused:?}");
        recorder.finish().unwrap();
        for file in ["walk.mcap", "walk_2.mcap"] {
            let mut reader = Reader::open(folder.path().join(file)).unwrap();
            let mut counts = BTreeMap::<Arc<str>, u64>::new();
            let mut first = None;
            while let Some(entry) = reader.next_raw().transpose().unwrap() {
                // The rig of long before does not make the take longer.
                let first = *first.get_or_insert(entry.log_time);
                assert!(entry.log_time.seconds_since(first) < 3.2, "{file}");
                *counts.entry(entry.topic).or_default() += 1;
            }
            // Frames of the second before, of the take and of the second after it; poses since it.
            let counts: Vec<u64> = counts.into_values().collect();
            assert!(matches!(counts[..], [20, 30..=31, 1]), "{file} {counts:?}");
        }
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 4);
    }

    #[test]
    fn a_take_that_began_before_the_recorder_is_recorded_from_there() {
        let (folder, mut recorder) = recorder();
        std::fs::write(folder.path().join("walk.mcap.part"), "of a recorder that has died")
            .unwrap();
        let status = |take: &str, seconds: f64| {
            let node_time_ns = at(seconds).ns();
            let payload = encode(&Status { take: take.into(), node_time_ns, ..Status::default() });
            RawEntry { payload, ..entry(&Topics::default().status(), seconds) }
        };
        assert!(recorder.write(status("", 0.0)).unwrap().is_empty());
        recorder.write(entry(&Topics::default().keypoints("a"), 0.5)).unwrap();
        // It may be of a node that has ended.
        assert!(recorder.write(status("walk", 0.1)).unwrap().is_empty());
        assert!(recorder.write(status("walk", 0.1)).unwrap().is_empty());
        let said = recorder.write(status("walk", 1.0)).unwrap();
        let is_said =
            |text: &str| text.contains("walk began before") && text.contains("walk_2.mcap");
        assert!(matches!(&said[..], [Said::Warning(text)] if is_said(text)), "{said:?}");
        assert!(recorder.write(status("walk", 2.0)).unwrap().is_empty());
        recorder.slate(&slate("stop", ""), at(3.0)).unwrap();
        assert_eq!(recorder.tick(at(5.0)).unwrap().len(), 1);
        // A status may be older than the slate.
        assert!(recorder.write(status("walk", 5.0)).unwrap().is_empty());
        let mut reader = Reader::open(folder.path().join("walk_2.mcap")).unwrap();
        // The frame and the statuses: what came in the second before, and in the one after.
        assert_eq!(std::iter::from_fn(|| reader.next_raw()).count(), 6);
        // Another recorder knows the take by its file.
        std::fs::rename(folder.path().join("walk.mcap.part"), folder.path().join("walk.mcap"))
            .unwrap();
        let (topics, provenance) = (Topics::default(), Provenance::default());
        let mut next = Recorder::start(None, folder.path(), topics, provenance).unwrap();
        for (name, expected) in [("walk", "noted for walk_2 "), ("", "give the take's name")] {
            let said = next.slate(&slate("note", name), at(6.0)).unwrap();
            let [Said::Answer(3, Ok(text) | Err(text))] = &said[..] else { panic!("{said:?}") };
            assert!(text.contains(expected), "{text}");
        }
    }

    #[test]
    fn a_take_has_its_last_second_although_the_next_one_begins() {
        let (folder, mut recorder) = recorder();
        let mut said = Vec::new();
        for i in 0..50 {
            let now = at(0.1 * f64::from(i));
            let command = match i {
                0 => slate("start", "a"),
                5 => slate("start", "b"),
                20 => slate("stop", "b"),
                23 => slate("start", "b"),
                _ => slate("", ""),
            };
            said.extend(recorder.slate(&command, now).unwrap());
            let pose = entry(&Topics::default().pose(), 0.1 * f64::from(i));
            said.extend(recorder.write(pose).unwrap());
        }
        said.extend(recorder.finish().unwrap().1);
        let poses = |file: &str| {
            let mut reader = Reader::open(folder.path().join(file)).unwrap();
            std::iter::from_fn(|| reader.next_raw()).count()
        };
        assert_eq!(["a.mcap", "b.mcap", "b_2.mcap"].map(poses), [15, 25, 27]);
        let is_warning = |said: &&Said| matches!(said, Said::Warning(_));
        assert_eq!((said.len(), said.iter().filter(is_warning).count()), (6, 2), "{said:?}");
    }

    #[test]
    fn a_take_whose_folder_goes_away_is_said_and_the_next_one_is_recorded() {
        let (folder, mut recorder) = recorder();
        recorder.slate(&slate("start", "a"), at(0.0)).unwrap();
        recorder.write(entry(&Topics::default().pose(), 0.0)).unwrap();
        std::fs::remove_dir_all(folder.path()).unwrap();
        let (said, goes_on) = recorder.second(at(1.0), None).unwrap();
        let is_told = |said: &Said| matches!(said, Said::Warning(text) if text.contains("a.mcap.part is gone"));
        assert!(goes_on && said.iter().any(is_told), "{said:?}");
        assert!(!recorder.second(at(2.0), None).unwrap().0.iter().any(is_told));
        recorder.slate(&slate("stop", "a"), at(2.0)).unwrap();
        let said = recorder.tick(at(4.0)).unwrap();
        let [Said::Answer(3, Err(text))] = &said[..] else { panic!("{said:?}") };
        assert!(text.contains("a.mcap is not complete"), "{text}");
        std::fs::create_dir(folder.path()).unwrap();
        // The next one has the same name, also while the lost one ends.
        recorder.slate(&slate("start", "b"), at(5.0)).unwrap();
        std::fs::remove_file(folder.path().join("b.mcap.part")).unwrap();
        recorder.slate(&slate("start", "b"), at(6.0)).unwrap();
        recorder.second(at(6.1), None).unwrap();
        recorder.slate(&slate("stop", "b"), at(6.5)).unwrap();
        let said = recorder.tick(at(8.0)).unwrap();
        let [Said::Warning(lost), Said::Answer(3, Ok(whole))] = &said[..] else {
            panic!("{said:?}")
        };
        assert!(lost.contains("b.mcap is not complete") && whole.contains("b_2.mcap"), "{said:?}");
        assert_eq!(recorder.finish().unwrap().0.failed, 2);
    }

    #[test]
    fn a_full_disk_ends_the_take_and_the_next_one_is_recorded_when_there_is_room() {
        let (folder, mut recorder) = recorder();
        let refusals = |said: &[Said]| -> Vec<(u64, String)> {
            let refusal = |said: &Said| match said {
                Said::Answer(id, Err(why)) => Some((*id, why.clone())),
                _ => None,
            };
            said.iter().filter_map(refusal).collect()
        };
        recorder.slate(&slate("start", "walk"), at(0.0)).unwrap();
        recorder.write(entry(&Topics::default().pose(), 0.0)).unwrap();
        assert!(recorder.second(at(1.0), Some(5 << 30)).unwrap().1);
        let (said, goes_on) = recorder.second(at(2.0), Some(60 << 20)).unwrap();
        assert!(goes_on, "for commands");
        let [(0, told)] = &refusals(&said)[..] else { panic!("{said:?}") };
        assert!(told.contains("the disk is full") && told.ends_with("1 messages"), "{told}");
        let mut reader = Reader::open(folder.path().join("walk.mcap")).unwrap();
        assert_eq!(std::iter::from_fn(|| reader.next_raw()).count(), 1);
        for (action, why) in [
            ("start", "only 60 MB are free on the disk"),
            ("stop", "take walk has already ended: the disk was full"),
        ] {
            let said = recorder.slate(&slate(action, "walk"), at(3.0)).unwrap();
            let [(3, text)] = &refusals(&said)[..] else { panic!("{said:?}") };
            assert!(text.starts_with(why), "{text}");
        }
        recorder.second(at(4.0), Some(5 << 30)).unwrap();
        let said = recorder.slate(&slate("start", "run"), at(5.0)).unwrap();
        assert!(matches!(&said[..], [Said::Answer(3, Ok(_))]), "{said:?}");
        assert_eq!(recorder.finish().unwrap().0.failed, 1);
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
        // Also those of a take that is over.
        recorder.slate(&slate("stop", ""), at(2.0)).unwrap();
        assert_eq!(recorder.tick(at(4.0)).unwrap().len(), 1);
        assert_eq!(recorder.finish().unwrap().0.skipped, 10);
    }
}

//! `bundlemocap solve` of several recordings, and `bundlemocap summary`

use std::collections::BTreeMap;
use std::fs::{File, OpenOptions, TryLockError};
use std::io::{Read, Seek, Write};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};
use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};

use clap::Args;
use indicatif::ProgressBar;
use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::Ended;
use super::failure::{Exit, Failure};
use super::solve::{Arguments, Prepared, Solved, alone};
use super::terminal::{complain, progress, say, table};
use crate::core::fnv::{fnv1a, fnv1a_after};
use crate::offline::output::text as write_text;

/// The poses of a take.
const POSES: &str = "poses.mcap";
/// What was done for a take. While it is being done, the file is locked and empty.
const MANIFEST: &str = "manifest.json";
/// The measurements of a take, as `solve --json` prints them.
const SUMMARY: &str = "summary.json";

/// What a take's outputs follow from, and how it ended.
#[derive(Debug, PartialEq, Serialize, Deserialize)]
struct Manifest {
    version: String,
    /// The recording, and what all takes share.
    inputs: BTreeMap<String, Fingerprint>,
    settings: Value,
    exit_code: i32,
    /// The poses that were written.
    poses: Option<Fingerprint>,
}

/// A file's length and hash.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
struct Fingerprint {
    bytes: u64,
    hash: String,
}

/// How a take ended.
enum Outcome {
    Solved(Solved),
    /// It was solved before.
    Kept(Exit),
    /// Another process solves it.
    Busy,
    Failed(Failure),
}

/// A take to solve.
struct Take<'a> {
    file: &'a Path,
    name: String,
    out: PathBuf,
}

/// Solves one recording into the folder of --out, or several into folders of their own.
pub(super) fn run(arguments: &Arguments) -> Ended {
    let prepared = Prepared::of(arguments)?;
    match &arguments.files[..] {
        [only] if arguments.jobs.is_none() => alone(arguments, &prepared, only),
        _ => each(arguments, &prepared),
    }
}

/// Solves each recording into a folder of its own.
fn each(arguments: &Arguments, prepared: &Prepared) -> Ended {
    if arguments.json {
        let message = "--json is of one recording; `bundlemocap summary DIR --json` prints several";
        return Err(Failure::new(Exit::Usage, message));
    }
    let takes = takes(&arguments.files, &arguments.out)?;
    let inputs = arguments.shared_inputs()?.into_iter();
    let inputs = inputs.map(|(role, path)| Ok((role, fingerprint(&path)?)));
    let shelf = Shelf { arguments, prepared, inputs: inputs.collect::<Result<_, Failure>>()? };
    let bar = progress(takes.len() as u64, "takes");
    let (next, ended) = (AtomicUsize::new(0), Mutex::new(Vec::new()));
    let work = || {
        while let Some(take) = takes.get(next.fetch_add(1, Ordering::Relaxed)) {
            // A fault of ours in one take must not stop the others.
            let solved = catch_unwind(AssertUnwindSafe(|| shelf.solve(take)));
            let outcome = solved.unwrap_or_else(|_| {
                Err(Failure::new(Exit::Unexpected, "a fault of the program; see above"))
            });
            let outcome = outcome.unwrap_or_else(Outcome::Failed);
            bar.suspend(|| tell(take, &outcome));
            bar.inc(1);
            if let Ok(mut ended) = ended.lock() {
                ended.push(outcome);
            }
        }
    };
    std::thread::scope(|scope| {
        let jobs = usize::from(arguments.jobs.unwrap_or(1)).min(takes.len());
        (0..jobs).for_each(|_| drop(scope.spawn(work)));
    });
    bar.finish_and_clear();
    let ended = ended.into_inner().unwrap_or_default();
    let count = |is: fn(&Outcome) -> bool| ended.iter().filter(|one| is(one)).count();
    let solved = count(|one| matches!(one, Outcome::Solved(_)));
    let kept = count(|one| matches!(one, Outcome::Kept(_)));
    let busy = count(|one| matches!(one, Outcome::Busy));
    let failed = count(|one| matches!(one, Outcome::Failed(_)));
    let busy = if busy > 0 { format!(", {busy} being solved elsewhere") } else { String::new() };
    let of = takes.len();
    say(&format!("{solved} solved, {kept} solved before, {failed} failed{busy}, of {of}"));
    let is_whole = |one: &Outcome| match one {
        Outcome::Solved(solved) => solved.exit == Exit::Done,
        Outcome::Kept(exit) => *exit == Exit::Done,
        Outcome::Busy | Outcome::Failed(_) => false,
    };
    Ok(if ended.iter().all(is_whole) { Exit::Done } else { Exit::InPart })
}

fn tell(take: &Take, outcome: &Outcome) {
    let name = &take.name;
    let part = |exit: Exit| if exit == Exit::Done { "" } else { ", in part" };
    match outcome {
        Outcome::Solved(solved) => {
            for (kind, text) in &solved.lines {
                complain(kind, &format!("{name}: {text}"));
            }
            say(&format!("{name}: solved{}", part(solved.exit)));
        }
        Outcome::Kept(exit) => say(&format!("{name}: solved before{}", part(*exit))),
        Outcome::Busy => complain("note", &format!("{name}: another process solves it")),
        Outcome::Failed(failure) => complain("error", &format!("{name}: {}", failure.line())),
    }
}

/// The takes by the names of their files, which must differ.
fn takes<'a>(files: &'a [PathBuf], out: &Path) -> Result<Vec<Take<'a>>, Failure> {
    let mut takes = BTreeMap::<String, Take>::new();
    for file in files {
        let name = file.file_stem().unwrap_or_default().to_string_lossy().into_owned();
        let out = out.join(&name);
        if let Some(other) = takes.insert(name.clone(), Take { file, name, out }) {
            let message = format!(
                "{} and {} would be solved into one folder; rename one",
                other.file.display(),
                file.display()
            );
            return Err(Failure::new(Exit::Usage, message));
        }
    }
    Ok(takes.into_values().collect())
}

/// What the takes of a command share.
struct Shelf<'a> {
    arguments: &'a Arguments,
    prepared: &'a Prepared,
    inputs: BTreeMap<String, Fingerprint>,
}

impl Shelf<'_> {
    /// Solves a take if it is not solved, and nobody else is at it.
    fn solve(&self, take: &Take) -> Result<Outcome, Failure> {
        let overwrite = self.arguments.overwrite;
        let path = take.out.join(MANIFEST);
        let unwritten = |error: std::io::Error| {
            Failure::new(Exit::Unexpected, format!("cannot write {}: {error}", path.display()))
        };
        // Files beside which there is no manifest are somebody else's.
        let is_empty =
            std::fs::read_dir(&take.out).map_or(true, |mut files| files.next().is_none());
        if !(overwrite || is_empty || path.exists()) {
            let what = "holds other files; choose another --out, or use --overwrite";
            return Err(Failure::new(Exit::Usage, format!("{} {what}", take.out.display())));
        }
        std::fs::create_dir_all(&take.out).map_err(unwritten)?;
        let mut open = OpenOptions::new();
        let file = open.read(true).write(true).create(true).truncate(false).open(&path);
        let mut file = file.map_err(unwritten)?;
        match file.try_lock() {
            Ok(()) => {}
            Err(TryLockError::WouldBlock) => return Ok(Outcome::Busy),
            Err(TryLockError::Error(error)) => return Err(unwritten(error)),
        }
        let mut text = String::new();
        file.read_to_string(&mut text).map_err(unwritten)?;
        let before = serde_json::from_str::<Manifest>(&text).ok();
        let mut inputs = self.inputs.clone();
        inputs.insert("recording".into(), fingerprint(take.file)?);
        // Of the known bodies, those that existed after the solve. Others may have come since.
        let known = |role: &String| before.iter().any(|before| before.inputs.contains_key(role));
        for (role, path) in self.prepared.bodies()?.into_iter().filter(|(role, _)| known(role)) {
            inputs.insert(role, fingerprint(&path)?);
        }
        let mut wanted = Manifest {
            version: env!("CARGO_PKG_VERSION").into(),
            inputs,
            settings: self.prepared.settings(self.arguments),
            exit_code: before.as_ref().map_or(0, |before| before.exit_code),
            poses: fingerprint(&take.out.join(POSES)).ok(),
        };
        if before.as_ref() == Some(&wanted) && wanted.poses.is_some() {
            let whole = wanted.exit_code == Exit::Done as i32;
            return Ok(Outcome::Kept(if whole { Exit::Done } else { Exit::InPart }));
        }
        // An empty manifest is of a take that failed or was interrupted.
        if !text.is_empty() && !overwrite {
            let what =
                "was solved from other inputs, settings or by another version, or was changed";
            let message = format!("{} {what}; use --overwrite", take.out.display());
            return Err(Failure::new(Exit::Usage, message));
        }
        file.set_len(0).map_err(unwritten)?;
        let quiet = |_| ProgressBar::hidden();
        let solved = self.prepared.solve(self.arguments, take.file, &take.out, true, quiet);
        let mut note = |text: &str| {
            file.set_len(0)?;
            file.rewind()?;
            file.write_all(text.as_bytes())?;
            file.sync_all()
        };
        let solved = match solved {
            Ok(solved) => solved,
            Err(failure) => {
                // A solve that fails leaves the files as they were.
                note(&text).map_err(unwritten)?;
                return Err(failure);
            }
        };
        write_text(&take.out.join(SUMMARY), &solved.json()?)?;
        for (role, path) in self.prepared.bodies()? {
            wanted.inputs.insert(role, fingerprint(&path)?);
        }
        wanted.exit_code = solved.exit as i32;
        wanted.poses = Some(fingerprint(&take.out.join(POSES))?);
        let text = serde_json::to_string_pretty(&wanted);
        text.map_err(std::io::Error::from).and_then(|text| note(&text)).map_err(unwritten)?;
        Ok(Outcome::Solved(solved))
    }
}

/// Length and hash of a file, which is read in parts.
fn fingerprint(path: &Path) -> Result<Fingerprint, Failure> {
    let read = || {
        let (mut file, mut part) = (File::open(path)?, vec![0; 1 << 16]);
        let (mut bytes, mut hash) = (0, fnv1a(&[]));
        loop {
            match file.read(&mut part)? {
                0 => return Ok((bytes, hash)),
                count => (bytes, hash) = (bytes + count as u64, fnv1a_after(hash, &part[..count])),
            }
        }
    };
    let (bytes, hash) = read().map_err(|error: std::io::Error| {
        Failure::new(Exit::Unreadable, format!("{}: cannot be read ({error})", path.display()))
    })?;
    Ok(Fingerprint { bytes, hash: format!("{hash:016x}") })
}

/// Print a table of the takes that `bundlemocap solve` of several recordings has solved.
#[derive(Debug, Args)]
#[command(after_help = "\
Exit code 6: a take is not solved, or in part.

Examples:
  bundlemocap solve takes/*.mcap --out out --jobs 2
  bundlemocap summary out
  bundlemocap summary out --json")]
pub(super) struct SummaryArguments {
    /// Folder with a folder for each take.
    folder: PathBuf,
    /// Print one JSON object with the summary of each take.
    #[arg(long)]
    json: bool,
}

pub(super) fn summary(arguments: &SummaryArguments) -> Ended {
    let unread = |error: std::io::Error| {
        let message = format!("{}: cannot be read ({error})", arguments.folder.display());
        Failure::new(Exit::Unreadable, message)
    };
    let mut takes = BTreeMap::new();
    for entry in std::fs::read_dir(&arguments.folder).map_err(unread)? {
        let folder = entry.map_err(unread)?.path();
        let read = |name: &str| std::fs::read_to_string(folder.join(name)).ok();
        let Some(manifest) = read(MANIFEST) else { continue };
        let manifest = serde_json::from_str::<Manifest>(&manifest).ok();
        // The summary of a take that is being solved anew is of the solve before.
        let summary = read(SUMMARY).filter(|_| manifest.is_some());
        let summary = summary.and_then(|text| serde_json::from_str::<Value>(&text).ok());
        let name = folder.file_name().unwrap_or_default().to_string_lossy().into_owned();
        takes.insert(name, manifest.zip(summary));
    }
    if takes.is_empty() {
        let message = format!("{} holds no solved takes", arguments.folder.display());
        return Err(Failure::new(Exit::NotOurs, message));
    }
    if arguments.json {
        let of =
            |take: &Option<(Manifest, Value)>| take.as_ref().map(|(_, summary)| summary.clone());
        let all: BTreeMap<_, _> = takes.iter().map(|(name, take)| (name, of(take))).collect();
        let text = serde_json::to_string_pretty(&all);
        say(&text.map_err(|error| Failure::new(Exit::Unexpected, error.to_string()))?);
    } else {
        let rows = takes.iter().flat_map(|(name, take)| match take {
            Some((manifest, summary)) => rows(name, summary, manifest.exit_code),
            None => vec![(
                name.clone(),
                "not solved: it failed, was interrupted, or is being solved".into(),
            )],
        });
        say(&table(&rows.collect::<Vec<_>>()));
    }
    let is_whole = |take: &Option<(Manifest, Value)>| {
        take.as_ref().is_some_and(|(manifest, _)| manifest.exit_code == Exit::Done as i32)
    };
    Ok(if takes.values().all(is_whole) { Exit::Done } else { Exit::InPart })
}

/// A row for each performer of a take. `exit`: the exit code of its solve.
fn rows(name: &str, summary: &Value, exit: i32) -> Vec<(String, String)> {
    let part =
        if exit == Exit::Done as i32 { String::new() } else { format!("; exit code {exit}") };
    let row = |name: String, summary: &Value| {
        let number = |path: &str| summary.pointer(path).and_then(Value::as_f64);
        let whole = |path: &str| number(path).unwrap_or(0.0);
        let px =
            number("/reprojection/median_px").map_or("- px".to_owned(), |px| format!("{px:.1} px"));
        let lost = whole("/lost");
        let text = format!(
            "{} frames, {px}, {lost} of {} windows lost{part}",
            whole("/frames"),
            whole("/windows")
        );
        (name, text)
    };
    match summary.get("performers").and_then(Value::as_array) {
        None => vec![row(name.to_owned(), summary)],
        Some(all) => all
            .iter()
            .map(|one| {
                let performer = one.get("performer").and_then(Value::as_str).unwrap_or_default();
                row(format!("{name} {performer}"), one)
            })
            .collect(),
    }
}

//! `bundlemocap solve` of several recordings, and `bundlemocap summary`

use std::collections::BTreeMap;
use std::fs::{File, OpenOptions};
use std::io::{Read, Seek, Write};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Mutex, PoisonError};

use clap::Args;
use indicatif::ProgressBar;
use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::Ended;
use super::failure::{Exit, Failure, json};
use super::solve::{Arguments, Prepared, Solved, alone, locked};
use super::terminal::{complain, progress, say, table};
use crate::core::fnv::{fnv1a, fnv1a_after};
use crate::io::file_name;
use crate::io::new_file::remove_parts;
use crate::offline::output::text as write_text;

/// What was done for a take. While it is being done, the file is locked and empty.
const MANIFEST: &str = "manifest.json";
/// The measurements of a take, as `solve --json` prints them.
const SUMMARY: &str = "summary.json";

/// What a take's outputs follow from.
#[derive(Debug, PartialEq, Serialize, Deserialize)]
struct Origin {
    version: String,
    /// The recording, and what all takes share.
    inputs: BTreeMap<String, Fingerprint>,
    settings: Value,
}

/// A take that was solved.
#[derive(Debug, Serialize, Deserialize)]
struct Manifest {
    #[serde(flatten)]
    origin: Origin,
    exit_code: i32,
    /// The files that were written, by name.
    outputs: BTreeMap<String, Fingerprint>,
}

/// In place of the manifest: why a take could not be solved.
#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct NotSolved {
    error: String,
    #[serde(default)]
    exit_code: Option<i32>,
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
    /// Another process is at it.
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
        [only] if arguments.jobs.is_none() => {
            let exit = alone(arguments, &prepared, only)?;
            forget_manifest(&arguments.out);
            Ok(exit)
        }
        _ => each(arguments, &prepared),
    }
}

/// Solves each recording into a folder of its own.
fn each(arguments: &Arguments, prepared: &Prepared) -> Ended {
    if arguments.json {
        let message = "--json is of one recording without --jobs; `bundlemocap summary DIR --json` prints several";
        return Err(Failure::new(Exit::Usage, message));
    }
    let takes = takes(&arguments.files, &arguments.out)?;
    let inputs = arguments.shared_inputs()?.into_iter();
    let inputs = inputs.map(|(role, path)| Ok((role, fingerprint(&path)?)));
    let shelf = Shelf { arguments, prepared, inputs: inputs.collect::<Result<_, Failure>>()? };
    let bar = progress(takes.len() as u64, "takes");
    let solve = |take: &Take, waits: bool| {
        // A fault of ours in one take must not stop the others.
        let solved = catch_unwind(AssertUnwindSafe(|| shelf.solve(take, waits)));
        let outcome = solved.unwrap_or_else(|_| {
            Err(Failure::new(Exit::Unexpected, "a fault of the program; see above"))
        });
        let outcome = outcome.unwrap_or_else(Outcome::Failed);
        bar.suspend(|| tell(take, &outcome));
        bar.inc(u64::from(!matches!(outcome, Outcome::Busy)));
        outcome
    };
    // People who become known in one take are recognised in the next.
    let is_in_order = prepared.makes_known();
    if is_in_order && arguments.jobs.is_some_and(|jobs| jobs > 1) {
        complain("note", "with names and known bodies, one take is solved after the other");
    }
    let jobs = if is_in_order { 1 } else { usize::from(arguments.jobs.unwrap_or(1)) };
    let solve_all = |indices: &[usize], waits: bool| {
        let (next, ended) = (AtomicUsize::new(0), Mutex::new(Vec::new()));
        let work = || {
            while !prepared.stop.is_set()
                && let Some(&index) = indices.get(next.fetch_add(1, Ordering::Relaxed))
            {
                let outcome = (index, solve(&takes[index], waits));
                ended.lock().unwrap_or_else(PoisonError::into_inner).push(outcome);
            }
        };
        std::thread::scope(|scope| {
            (0..jobs.min(indices.len())).for_each(|_| drop(scope.spawn(work)));
        });
        ended.into_inner().unwrap_or_else(PoisonError::into_inner)
    };
    let mut ended = solve_all(&(0..takes.len()).collect::<Vec<_>>(), false);
    // Another process may be at them, or may have been stopped.
    let busy = ended.extract_if(.., |(_, outcome)| matches!(outcome, Outcome::Busy));
    let busy: Vec<usize> = busy.map(|(index, _)| index).collect();
    ended.extend(solve_all(&busy, true));
    bar.finish_and_clear();
    let ended: Vec<Outcome> = ended.into_iter().map(|(_, outcome)| outcome).collect();
    let count = |is: fn(&Outcome) -> bool| ended.iter().filter(|one| is(one)).count();
    let solved = count(|one| matches!(one, Outcome::Solved(_)));
    let kept = count(|one| matches!(one, Outcome::Kept(_)));
    let failed = count(|one| matches!(one, Outcome::Failed(_)));
    let (open, of) = (takes.len() - solved - kept - failed, takes.len());
    let open = if open > 0 { format!(", {open} not solved yet") } else { String::new() };
    say(&format!("{solved} solved, {kept} solved before, {failed} failed{open}, of {of}"));
    let exit = |one: &Outcome| match one {
        Outcome::Solved(solved) => solved.exit,
        Outcome::Kept(exit) => *exit,
        Outcome::Failed(failure) => failure.exit,
        Outcome::Busy => Exit::InPart,
    };
    Ok(match &ended[..] {
        [only] if of == 1 => exit(only),
        all if all.len() == of && all.iter().all(|one| exit(one) == Exit::Done) => Exit::Done,
        _ => Exit::InPart,
    })
}

fn tell(take: &Take, outcome: &Outcome) {
    let name = &take.name;
    let part = |exit: Exit| if exit == Exit::Done { "" } else { ", in part" };
    match outcome {
        Outcome::Solved(solved) => {
            for (kind, text) in &solved.lines {
                complain(kind, &format!("{name}: {text}"));
            }
            for (offset, value) in solved.offsets() {
                complain("note", &format!("{name}: {offset} {value}"));
            }
            say(&format!("{name}: solved{}", part(solved.exit)));
        }
        Outcome::Kept(exit) => say(&format!("{name}: solved before{}", part(*exit))),
        Outcome::Busy => {
            let text = "another process solves it; this one waits for it at the end";
            complain("note", &format!("{name}: {text}"));
        }
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
    /// Solves a take if it is not solved. If another process is at it: with `waits`, after that; else it is
    /// [`Outcome::Busy`].
    fn solve(&self, take: &Take, waits: bool) -> Result<Outcome, Failure> {
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
        // A mistyped name gets no folder.
        let opened = File::open(take.file).map_err(|error| unread(take.file, &error))?;
        if opened.metadata().is_ok_and(|about| about.is_dir()) {
            let what = format!("{} is a folder, not a recording", take.file.display());
            return Err(Failure::new(Exit::Unreadable, what));
        }
        std::fs::create_dir_all(&take.out).map_err(unwritten)?;
        let mut open = OpenOptions::new();
        let file = open.read(true).write(true).create(true).truncate(false).open(&path);
        let mut file = file.map_err(unwritten)?;
        if !locked(&file, waits.then_some(&self.prepared.stop)).map_err(unwritten)? {
            return Ok(Outcome::Busy);
        }
        let mut text = String::new();
        file.read_to_string(&mut text).map_err(unwritten)?;
        let before = serde_json::from_str::<Manifest>(&text).ok();
        let mut inputs = self.inputs.clone();
        inputs.insert("recording".into(), fingerprint(take.file)?);
        // Of the known bodies, those that existed after the solve. Others may have come since.
        let known =
            |role: &String| before.iter().any(|before| before.origin.inputs.contains_key(role));
        for (role, path) in self.prepared.bodies()?.into_iter().filter(|(role, _)| known(role)) {
            inputs.insert(role, fingerprint(&path)?);
        }
        let version = env!("CARGO_PKG_VERSION").into();
        let origin = Origin { version, inputs, settings: self.prepared.settings(self.arguments) };
        // Why it can only be solved with --overwrite.
        let conflict = match &before {
            Some(before) if before.origin == origin => {
                let is_changed = |(name, written): &(&String, &Fingerprint)| {
                    fingerprint(&take.out.join(name)).ok().as_ref() != Some(*written)
                };
                let Some((changed, _)) = before.outputs.iter().find(is_changed) else {
                    let whole = before.exit_code == Exit::Done as i32;
                    return Ok(Outcome::Kept(if whole { Exit::Done } else { Exit::InPart }));
                };
                let changed = take.out.join(changed);
                Some(format!("{} was changed or removed after the solve", changed.display()))
            }
            // Without a text it was interrupted.
            _ if text.is_empty() || serde_json::from_str::<NotSolved>(&text).is_ok() => None,
            _ => {
                let out = take.out.display();
                Some(format!("{out} was solved from other inputs, settings or by another version"))
            }
        };
        if let Some(conflict) = conflict.filter(|_| !overwrite) {
            return Err(Failure::new(Exit::Usage, format!("{conflict}; use --overwrite")));
        }
        file.set_len(0).map_err(unwritten)?;
        remove_parts(&take.out);
        let result = self.solve_anew(take, origin);
        let text = match &result {
            Ok((_, manifest)) => json(manifest)?,
            // A solve that fails leaves the files as they were.
            Err(_) if before.is_some() => text,
            Err(failure) => {
                json(&NotSolved { error: failure.line(), exit_code: Some(failure.exit as i32) })?
            }
        };
        let mut write = || {
            file.set_len(0)?;
            file.rewind()?;
            file.write_all(text.as_bytes())?;
            file.sync_all()
        };
        write().map_err(unwritten)?;
        result.map(|(solved, _)| Outcome::Solved(solved))
    }

    /// Solves a take into its folder.
    fn solve_anew(&self, take: &Take, mut origin: Origin) -> Result<(Solved, Manifest), Failure> {
        let quiet = |_| ProgressBar::hidden();
        let solved = self.prepared.solve(self.arguments, take.file, &take.out, true, quiet)?;
        write_text(&take.out.join(SUMMARY), &solved.json()?)?;
        let bodies = self.prepared.bodies()?.into_iter();
        for (role, path) in bodies.filter(|(role, _)| solved.knows(role)) {
            origin.inputs.insert(role, fingerprint(&path)?);
        }
        let names = solved.files().into_iter().chain([SUMMARY.to_owned()]);
        let outputs = names.map(|name| Ok((name.clone(), fingerprint(&take.out.join(name))?)));
        let outputs = outputs.collect::<Result<_, Failure>>()?;
        let exit_code = solved.exit as i32;
        Ok((solved, Manifest { origin, exit_code, outputs }))
    }
}

fn unread(path: &Path, error: &std::io::Error) -> Failure {
    Failure::new(Exit::Unreadable, format!("{}: cannot be read ({error})", path.display()))
}

/// Removes the manifest of an earlier solve of several takes: this take was solved alone.
fn forget_manifest(folder: &Path) {
    let path = folder.join(MANIFEST);
    let text = std::fs::read_to_string(&path).unwrap_or_default();
    if serde_json::from_str::<Manifest>(&text).is_ok() {
        let _ = std::fs::remove_file(path);
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
    let (bytes, hash) = read().map_err(|error: std::io::Error| unread(path, &error))?;
    Ok(Fingerprint { bytes, hash: format!("{hash:016x}") })
}

/// Print a table of the takes that `bundlemocap solve` of several recordings has solved.
#[derive(Debug, Args)]
#[command(after_help = "\
Of a take that is not solved it shows why.

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
    let unread = |error: std::io::Error| unread(&arguments.folder, &error);
    let mut takes = BTreeMap::new();
    for entry in std::fs::read_dir(&arguments.folder).map_err(unread)? {
        let folder = entry.map_err(unread)?.path();
        let read = |name: &str| std::fs::read_to_string(folder.join(name)).ok();
        let Some(text) = read(MANIFEST) else { continue };
        let manifest = serde_json::from_str::<Manifest>(&text).ok();
        // The summary of a take that is being solved anew is of the solve before.
        let summary = read(SUMMARY).filter(|_| manifest.is_some());
        let summary = summary.and_then(|text| serde_json::from_str::<Value>(&text).ok());
        let summary = summary.filter(Value::is_object);
        let name = file_name(&folder);
        takes.insert(name, manifest.zip(summary).ok_or_else(|| not_solved(&text)));
    }
    if takes.is_empty() {
        let folder = arguments.folder.display();
        let message =
            format!("{folder} holds no solved takes; give the --out of `solve` of several takes");
        return Err(Failure::new(Exit::NotOurs, message));
    }
    if arguments.json {
        let of = |take: &Result<(Manifest, Value), NotSolved>| match take {
            Ok((manifest, summary)) => {
                let mut summary = summary.clone();
                summary["exit_code"] = manifest.exit_code.into();
                summary
            }
            Err(reason) => serde_json::json!(reason),
        };
        let all: BTreeMap<_, _> = takes.iter().map(|(name, take)| (name, of(take))).collect();
        say(&json(&all)?);
    } else {
        let rows = takes.iter().flat_map(|(name, take)| match take {
            Ok((manifest, summary)) => rows(name, summary, manifest.exit_code),
            Err(reason) => vec![(name.clone(), format!("not solved: {}", reason.error))],
        });
        say(&table(&rows.collect::<Vec<_>>()));
    }
    let is_whole = |take: &Result<(Manifest, Value), NotSolved>| {
        take.as_ref().is_ok_and(|(manifest, _)| manifest.exit_code == Exit::Done as i32)
    };
    Ok(if takes.values().all(is_whole) { Exit::Done } else { Exit::InPart })
}

/// Why a take is not solved. `text` is what is in place of its manifest.
fn not_solved(text: &str) -> NotSolved {
    let unknown = "it was interrupted, is being solved, was solved by another version, or its summary.json is missing";
    let unknown = || NotSolved { error: unknown.to_owned(), exit_code: None };
    serde_json::from_str(text).unwrap_or_else(|_| unknown())
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
        let frames = whole("/frames");
        let of = number("/frames_recorded").filter(|recorded| *recorded > frames);
        let of = of.map_or_else(String::new, |recorded| format!(" of {recorded}"));
        let (flagged, lost, windows) = (whole("/frames_lost"), whole("/lost"), whole("/windows"));
        let text = format!(
            "{frames}{of} frames ({flagged} flagged), {px}, {lost} of {windows} windows lost{part}"
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

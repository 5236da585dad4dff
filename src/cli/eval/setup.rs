//! The protocol of `bundlemocap eval`, overridden by the options.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use super::arguments::Motions;
use crate::cli::failure::{Exit, Failure, frame_rate_option, within};
use crate::cli::solve::decoder;
use crate::cli::terminal::{complain, note, progress};
use crate::core::camera::Rig;
use crate::core::detections::KeypointFormat;
use crate::core::manifold::{Decoder, EMBEDDED, trained_on};
use crate::research::experiments::{Case, Methods, Run, Subject, View, procedural, run, subjects};
use crate::research::synth::{Body, Noise, Protocol, RigError, rig_named};
use crate::research::train::{self, Clip, read_folder};

/// The rig if neither a protocol nor an option names one.
const RIG: &str = "h36m";
/// File of the Human3.6M cameras in `BUNDLEMOCAP_DATA` or `../shared`.
const H36M: &str = "recordings/h36m_rig/cameras.json";
/// Number of procedural motions, used without a folder of clips.
const PROCEDURAL: usize = 4;

/// Shared by all measurements.
pub(super) struct Setup {
    /// The protocol, overridden by the options.
    pub(super) protocol: Protocol,
    pub(super) decoder: Decoder,
    pub(super) subjects: Vec<Subject>,
    /// Used in turn.
    rigs: Vec<Arc<Rig>>,
    format: KeypointFormat,
    pub(super) jobs: usize,
}

impl Setup {
    /// Reads protocol, weights, rigs and motions.
    pub(super) fn new(motions: &Motions) -> Result<Self, Failure> {
        Self::of(motions, false, usual_rig(motions))
    }

    /// As [`Setup::new`], for crowds: of their rig only the number of cameras counts, so it needs no file.
    pub(super) fn of_crowds(motions: &Motions) -> Result<Self, Failure> {
        Self::of(motions, false, "ring4")
    }

    /// As [`Setup::new`], with the clips of all subjects that are not named.
    pub(super) fn of_others(motions: &Motions) -> Result<Self, Failure> {
        Self::of(motions, true, usual_rig(motions))
    }

    fn of(motions: &Motions, others: bool, rig_without_protocol: &str) -> Result<Self, Failure> {
        let Motions { views, every, jobs, .. } = motions;
        let protocol = protocol(motions, rig_without_protocol)?;
        let seconds = protocol.sequence.seconds;
        let format = KeypointFormat::from_name(&protocol.format).ok_or_else(|| {
            let message = format!("format {:?} of the protocol is unknown", protocol.format);
            Failure::new(Exit::KeypointFormat, format!("{message}; use body_25 or halpe_26"))
        })?;
        let folder = motions.motions.as_deref();
        if protocol.sequence.body == Body::Foreign && folder.is_none() {
            let message = "foreign bodies are the skeletons of clips; give clips with --motions";
            return Err(Failure::new(Exit::Usage, message));
        }
        let of_name = |name: &String| rig(name, views.h36m.as_deref()).map(Arc::new);
        let (every, jobs) = ((*every).max(1), *jobs);
        within("--jobs", jobs as f64, 1.0, 64.0)?;
        let subjects = match folder {
            Some(folder) => subjects(&clips(folder, &protocol.subjects, others, every)?),
            None => procedural(PROCEDURAL.div_ceil(every), seconds),
        };
        if protocol.seeds.is_empty() {
            let message = "the protocol names no seed; give one with --seed";
            return Err(Failure::new(Exit::Usage, message));
        }
        if folder.is_some() && !others {
            warn_of_training(views.output.weights.as_deref(), &protocol);
        }
        let setup = Self {
            decoder: decoder(views.output.weights.as_deref())?,
            subjects: usable(subjects, &protocol),
            rigs: protocol.rigs.iter().map(of_name).collect::<Result<_, _>>()?,
            format,
            jobs,
            protocol,
        };
        // A mistyped level is found before the first solve.
        views.noise.iter().try_for_each(|level| setup.view(level).map(drop))?;
        Ok(setup)
    }

    /// Keeps the first rig, and says so if there are more.
    pub(super) fn keep_first_rig(&mut self) {
        keep_first("rig", &mut self.protocol.rigs);
    }

    /// Keeps the first seed, and says so if there are more.
    pub(super) fn keep_first_seed(&mut self) {
        keep_first("seed", &mut self.protocol.seeds);
    }

    /// The view of a level of noise with the first rig and the first seed.
    pub(super) fn view(&self, level: &str) -> Result<View, Failure> {
        let noise = match (self.protocol.levels.get(level), level) {
            (Some(noise), _) => noise.clone(),
            (None, "none") => Noise::none(),
            _ => {
                let known: Vec<&str> = self.protocol.levels.keys().map(String::as_str).collect();
                let message = format!("--noise {level} is unknown; use none, {}", known.join(", "));
                return Err(Failure::new(Exit::Usage, message));
            }
        };
        let Some(rig) = self.rigs.first().map(Arc::clone) else {
            let message = "the protocol has no rig; give one with --rig";
            return Err(Failure::new(Exit::Usage, message));
        };
        Ok(View {
            name: level.to_owned(),
            rig,
            format: self.format,
            noise,
            choice: self.protocol.sequence.clone(),
            seed: self.protocol.seeds[0],
        })
    }

    /// The cases of a view: all motions for each seed, with the rigs in turn.
    pub(super) fn cases(&self, view: &View) -> Vec<Case> {
        self.passes(view, &self.rigs)
    }

    /// The cases of a view: all motions for each seed, with the view's own rig.
    pub(super) fn cases_of_rig(&self, view: &View) -> Vec<Case> {
        self.passes(view, std::slice::from_ref(&view.rig))
    }

    fn passes(&self, view: &View, rigs: &[Arc<Rig>]) -> Vec<Case> {
        let pass = |&seed: &u64| {
            let pairs = self.subjects.iter().zip(rigs.iter().cycle());
            pairs.filter_map(move |(subject, rig)| {
                Case::new(subject, &View { rig: Arc::clone(rig), seed, ..view.clone() })
            })
        };
        self.protocol.seeds.iter().flat_map(pass).collect()
    }

    /// Solves cases with methods; shows a progress bar.
    pub(super) fn solve(
        &self,
        what: &str,
        cases: &[Case],
        methods: &Methods,
    ) -> Result<Run, Failure> {
        if cases.is_empty() {
            let seconds = self.protocol.sequence.least_seconds;
            let message = format!(
                "no motion has {seconds} s within {} m; name other subjects, or lower \
                 sequence.least_seconds of the protocol",
                self.protocol.sequence.radius_m
            );
            return Err(Failure::new(Exit::NoDetections, message));
        }
        let bar = progress((cases.len() * methods().len()) as u64, "solves");
        bar.set_message(what.to_owned());
        let run = run(cases, methods, &self.decoder, self.jobs, &|| bar.inc(1));
        bar.finish_and_clear();
        Ok(run)
    }

    /// One line for reports: motions and views.
    pub(super) fn subtitle(&self) -> String {
        let body = self.protocol.sequence.body.name();
        format!("{} motions of {body} bodies, {}", self.subjects.len(), self.views())
    }

    /// How long and how the motions are seen.
    pub(super) fn views(&self) -> String {
        let Protocol { sequence, rigs, seeds, .. } = &self.protocol;
        let seeds: Vec<String> = seeds.iter().map(u64::to_string).collect();
        format!(
            "up to {} s at {} fps, cameras {}, seed {}",
            sequence.seconds,
            sequence.fps,
            rigs.join(" and "),
            seeds.join(", ")
        )
    }
}

fn keep_first(what: &str, all: &mut Vec<impl std::fmt::Display>) {
    if all.len() > 1 {
        note(&format!("only the first {what} is used, {}", all[0]));
        all.truncate(1);
    }
}

/// Warns if the weights were trained on subjects of the protocol.
fn warn_of_training(weights: Option<&Path>, protocol: &Protocol) {
    let trained = match weights {
        Some(path) => trained_on(&std::fs::read(path).unwrap_or_default()),
        None => trained_on(EMBEDDED),
    };
    let known = protocol.subjects.iter().filter(|subject| trained.contains(subject));
    let known: Vec<&str> = known.map(String::as_str).collect();
    if !known.is_empty() {
        let known = known.join(", ");
        let text =
            format!("the weights were trained on subjects {known}: the errors are too small");
        complain("warning", &text);
    }
}

fn protocol(motions: &Motions, rig_without_protocol: &str) -> Result<Protocol, Failure> {
    let Motions { views, subjects, body, .. } = motions;
    let mut protocol = match &views.protocol {
        Some(path) => read_protocol(path)?,
        None => Protocol { rigs: vec![rig_without_protocol.to_owned()], ..Protocol::default() },
    };
    if !subjects.is_empty() {
        protocol.subjects.clone_from(subjects);
    }
    if !views.rig.is_empty() {
        protocol.rigs.clone_from(&views.rig);
    }
    if let Some(body) = body.as_deref().and_then(Body::from_name) {
        protocol.sequence.body = body;
    }
    protocol.sequence.fps = frame_rate_option(views.fps.unwrap_or(protocol.sequence.fps))?;
    if let Some(seconds) = views.seconds {
        protocol.sequence.seconds = within("--seconds", seconds, 0.5, 36_000.0)?;
        let least = &mut protocol.sequence.least_seconds;
        *least = least.min(seconds);
    }
    if !views.seed.is_empty() {
        protocol.seeds.clone_from(&views.seed);
    }
    Ok(protocol)
}

fn read_protocol(path: &Path) -> Result<Protocol, Failure> {
    let path_name = path.display();
    let text = std::fs::read_to_string(path).map_err(|error| {
        let message = format!("cannot read the protocol {path_name}: {error}; check the path");
        Failure::new(Exit::Unreadable, message)
    })?;
    toml::from_str(&text).map_err(|error: toml::de::Error| {
        let message = format!("{path_name}: {error}; config/eval.toml lists every key");
        Failure::new(Exit::Malformed, message)
    })
}

/// The rig of a name; see [`rig_named`].
pub(super) fn rig(name: &str, h36m: Option<&Path>) -> Result<Rig, Failure> {
    let known = h36m.map(Path::to_owned).or_else(known_h36m);
    rig_named(name, known.as_deref()).map_err(|error| match error {
        RigError::Name(_) => Failure::new(Exit::Usage, format!("--rig: {error}")),
        RigError::NeedsFile(_) => {
            let message = format!("--rig: {error} with --h36m, or use --rig ring4");
            Failure::new(Exit::Usage, message)
        }
        _ => Failure::new(Exit::BadCalibration, error.to_string()),
    })
}

/// Subjects whose motion has a usable section for a seed; the others are named on standard error.
fn usable(subjects: Vec<Subject>, protocol: &Protocol) -> Vec<Subject> {
    let Protocol { sequence: choice, seeds, .. } = protocol;
    let is_usable =
        |subject: &Subject| seeds.iter().any(|&seed| subject.section(choice, seed).is_some());
    let (usable, others): (Vec<_>, Vec<_>) = subjects.into_iter().partition(is_usable);
    if !others.is_empty() {
        let names: Vec<&str> = others.iter().map(|subject| subject.name.as_str()).collect();
        note(&format!(
            "skipped {}: no {} s within {} m with plausible motion",
            names.join(", "),
            choice.least_seconds,
            choice.radius_m
        ));
    }
    usable
}

/// The rig if neither a protocol nor an option names one: Human3.6M's, or without its file a ring, with a note.
fn usual_rig(Motions { views, .. }: &Motions) -> &'static str {
    if views.h36m.is_some() || known_h36m().is_some() {
        return RIG;
    }
    if views.rig.is_empty() && views.protocol.is_none() {
        let text = "the cameras are ring4; for those of Human3.6M give their file with --h36m";
        complain("note", text);
    }
    "ring4"
}

fn known_h36m() -> Option<PathBuf> {
    let folder = std::env::var_os("BUNDLEMOCAP_DATA").unwrap_or_else(|| "../shared".into());
    Some(Path::new(&folder).join(H36M)).filter(|path| path.exists())
}

/// Every Nth clip of the named subjects in a folder, or of all others.
fn clips(
    folder: &Path,
    named: &[String],
    others: bool,
    every: usize,
) -> Result<Vec<Clip>, Failure> {
    let clips = read_folder(folder)?;
    let names = train::subjects(&clips).join(", ");
    let at = folder.display();
    for subject in named {
        if !clips.iter().any(|clip| clip.subject == *subject) {
            let message = format!("--subjects: {at} has no clip of {subject}; it has {names}");
            return Err(Failure::new(Exit::Usage, message));
        }
    }
    let wanted = |clip: &Clip| named.contains(&clip.subject) != others;
    let chosen: Vec<Clip> = clips.into_iter().filter(wanted).step_by(every).collect();
    if chosen.is_empty() {
        let message = format!("{at}: no clip is left; it has clips of {names}, see --subjects");
        return Err(Failure::new(Exit::NoDetections, message));
    }
    Ok(chosen)
}

//! Several performers who cross and meet, together and each alone.

use std::path::Path;

use serde_json::{Value, json};

use super::arguments;
use super::output::write;
use super::setup::{Setup, within};
use crate::cli::failure::{Exit, Failure};
use crate::cli::terminal::progress;
use crate::core::body::Pose;
use crate::core::stage::Performers;
use crate::io::recording::Provenance;
use crate::io::report::{ReportData, Table};
use crate::metrics::PerformerScores;
use crate::metrics::statistics::mean;
use crate::offline::{Group, Options, Recording, solve, solve_group};
use crate::research::experiments::View;
use crate::research::synth::{self, Crowd, Meeting};

type AnyMotion = Box<dyn Fn(f64) -> Pose>;

/// Solves crowds of these numbers of people at each noise level.
pub(super) fn run(asked: &arguments::Performers) -> Result<(), Failure> {
    let distance = within("--meet", asked.meet, 0.2, 1.5)?;
    let setup = Setup::without_clips(&asked.views)?;
    let folder = tempfile::tempdir().map_err(|error| {
        Failure::new(Exit::Unexpected, format!("cannot make a folder: {error}"))
    })?;
    let mut report = ReportData {
        title: "Performers who cross and meet".into(),
        subtitle: format!("{}; {distance} m apart when they meet", setup.subtitle()),
        ..ReportData::default()
    };
    let mut levels = Vec::new();
    for level in &asked.views.noise {
        let (mut rows, mut results) = (Vec::new(), Vec::new());
        for (&number, &seed) in asked
            .numbers
            .iter()
            .flat_map(|n| setup.protocol.seeds.iter().map(move |seed| (n, seed)))
        {
            let meeting = Meeting { people: number.into(), distance: Some(distance) };
            let view = View { seed, ..setup.view(level)? };
            let solved = Solved::new(meeting, &view, &setup, folder.path())?;
            rows.push(solved.row(number, seed));
            results.push(solved.json(number, seed));
        }
        let header = [
            "performers",
            "seed",
            "found",
            "recall %",
            "precision %",
            "ID switches",
            "MOTA %",
            "PCP %",
            "MPJPE mm",
            "each alone mm",
            "worst ratio",
        ];
        let header = header.map(str::to_owned).into();
        report.leading.push(Table { title: format!("Noise: {level}"), header, rows });
        levels.push(json!({ "level": level, "crowds": results }));
    }
    let results = json!({
        "version": env!("CARGO_PKG_VERSION"),
        "meet_m": distance,
        "protocol": setup.protocol,
        "levels": levels,
    });
    write(&asked.views.output.out, &report, &results)
}

/// A crowd, solved together and one by one.
struct Solved {
    group: Group,
    scores: PerformerScores,
    /// By person: MPJPE when alone, millimetres.
    alone_mm: Vec<Option<f64>>,
}

impl Solved {
    fn new(meeting: Meeting, view: &View, setup: &Setup, folder: &Path) -> Result<Self, Failure> {
        let seconds = setup.protocol.sequence.seconds;
        let rig = meeting.rig(view.rig.cameras.len())?;
        let person = |person: usize| {
            let (skeleton, motion) = meeting.person(person, view.seed);
            let motion: AnyMotion = Box::new(motion);
            let mut one = synth::Recording::new(rig.clone(), skeleton, motion);
            (one.fps, one.frames) = (view.choice.fps, (seconds * view.choice.fps) as u64);
            (one.format, one.noise, one.seed) = (view.format, view.noise.clone(), view.seed);
            one.noise.strangers = 0.0;
            one
        };
        let path = folder.join("crowd.mcap");
        let bar = progress(2 * meeting.people as u64, "solves");
        Crowd::new((0..meeting.people).map(person).collect()).write(
            &path,
            &Provenance::default(),
            || {},
        )?;
        let alone = Options { decoder: Some(setup.decoder.clone()), ..Options::default() };
        let options = Options { performers: Performers::Auto, ..alone.clone() };
        let group = solve_group(&mut Recording::open(&path)?, &options, &mut ())?;
        let mut alone_mm = Vec::new();
        for number in 0..meeting.people {
            bar.inc(1);
            // The same draws as in the crowd.
            let mut one = person(number);
            one.seed = view.seed.wrapping_add((number as u64) << 32);
            Crowd::alone(one).write(&path, &Provenance::default(), || {})?;
            let alone = solve(&mut Recording::open(&path)?, &alone, &mut ())?;
            alone_mm.push(alone.truth.map(|truth| truth.mpjpe_mm));
        }
        bar.finish_and_clear();
        let scores = group.scores.clone().ok_or_else(|| {
            Failure::new(Exit::NobodyFound, "nobody was found; use a lower --noise")
        })?;
        Ok(Self { group, scores, alone_mm })
    }

    /// The MPJPE of each person in the crowd over that when alone.
    fn ratios(&self) -> Vec<f64> {
        let people = (1..).zip(&self.alone_mm).filter_map(|(number, alone)| {
            let together = self.scores.performers.get(&format!("p{number}"))?.mpjpe_mm?;
            Some(together / (*alone)?)
        });
        people.collect()
    }

    fn row(&self, number: u8, seed: u64) -> Vec<String> {
        let alone: Vec<f64> = self.alone_mm.iter().copied().flatten().collect();
        let worst = self.ratios().into_iter().fold(0.0, f64::max);
        let scores = &self.scores;
        vec![
            number.to_string(),
            seed.to_string(),
            self.group.performers.len().to_string(),
            format!("{:.2}", scores.recall_percent),
            format!("{:.2}", scores.precision_percent),
            scores.id_switches.to_string(),
            format!("{:.2}", scores.mota_percent),
            format!("{:.2}", scores.pcp_percent),
            format!("{:.1}", scores.mpjpe_mm),
            mean(&alone).map_or("none".to_owned(), |mm| format!("{mm:.1}")),
            format!("{worst:.2}"),
        ]
    }

    fn json(&self, number: u8, seed: u64) -> Value {
        json!({
            "people": number,
            "seed": seed,
            "performers": self.group.performers.len(),
            "scores": self.scores,
            "alone_mpjpe_mm": self.alone_mm,
        })
    }
}

//! Several performers who cross and meet, together and each alone.

use std::f64::consts::TAU;
use std::path::Path;

use serde_json::{Value, json};

use super::arguments;
use super::output::write;
use super::setup::Setup;
use crate::cli::failure::{Exit, Failure, within};
use crate::cli::terminal::progress;
use crate::core::body::{Pose, Skeleton};
use crate::core::stage::{Choice, Performers};
use crate::io::recording::Provenance;
use crate::io::report::{ReportData, Table};
use crate::metrics::PerformerScores;
use crate::metrics::statistics::mean;
use crate::offline::{Group, Options, Recording, solve_group};
use crate::research::experiments::{View, in_parallel, in_turn};
use crate::research::synth::{self, Body, Crowd, Meeting, Places, Protocol, through};
use crate::research::train;

type AnyMotion = Box<dyn Fn(f64) -> Pose>;
type Person = synth::Recording<AnyMotion>;

/// Who is within this distance of the floor's edge becomes a performer, metres; bystanders are farther away.
const MARGIN: f64 = 0.5;
/// Corners of the region in which people become performers.
const CORNERS: usize = 24;

/// Solves crowds of these numbers of people at each noise level.
pub(super) fn run(asked: &arguments::Performers) -> Result<(), Failure> {
    let distance = within("--meet", asked.meet, 0.2, 1.5)?;
    let mut setup = Setup::of_crowds(&asked.motions)?;
    setup.keep_first_rig();
    let folder = tempfile::tempdir().map_err(|error| {
        Failure::new(Exit::Unexpected, format!("cannot make a folder: {error}"))
    })?;
    let has_clips = asked.motions.motions.is_some();
    if setup.protocol.sequence.body == Body::Skinned && !has_clips {
        let message =
            "without clips, performers have bodies of our model; give clips with --motions";
        return Err(Failure::new(Exit::Usage, message));
    }
    let motion = if has_clips { setup.subtitle() } else { format!("walking, {}", setup.views()) };
    let mut report = ReportData {
        title: "Performers who cross and meet".into(),
        subtitle: format!(
            "{motion}; {distance} m apart when they meet; {} bystanders",
            asked.bystanders
        ),
        ..ReportData::default()
    };
    let crowds =
        asked.numbers.iter().flat_map(|&n| setup.protocol.seeds.iter().map(move |&s| (n, s)));
    let crowds: Vec<(u8, u64)> = crowds.collect();
    let noises = &asked.motions.views.noise;
    let bar = progress((noises.len() * crowds.len()) as u64, "crowds");
    let mut levels = Vec::new();
    for level in noises {
        let view = setup.view(level)?;
        let solved = in_parallel(&crowds, setup.jobs, |&(number, seed)| {
            let scene = Scene {
                meeting: Meeting { people: number.into(), distance: Some(distance) },
                bystanders: asked.bystanders.into(),
                view: View { seed, ..view.clone() },
                setup: &setup,
                has_clips,
            };
            let solved = scene.solve(&folder.path().join(format!("{number} {seed}.mcap")));
            bar.inc(1);
            solved
        });
        let solved: Vec<Solved> = solved.into_iter().collect::<Result<_, _>>()?;
        let header = [
            "performers",
            "seed",
            "found",
            "recall %",
            "precision %",
            "ID switches",
            "MOTA %",
            "PCP %",
            "PCP of the nearest %",
            "MPJPE mm",
            "each alone mm",
            "worst ratio",
        ];
        let of_crowds = || crowds.iter().zip(&solved);
        report.leading.push(Table {
            title: format!("Noise: {level}"),
            header: header.map(str::to_owned).into(),
            rows: of_crowds().map(|(&(number, seed), one)| one.row(number, seed)).collect(),
        });
        let results = of_crowds().map(|(&(number, seed), one)| one.json(number, seed));
        levels.push(json!({ "level": level, "crowds": results.collect::<Vec<_>>() }));
    }
    bar.finish_and_clear();
    let results = json!({
        "version": env!("CARGO_PKG_VERSION"),
        "meet_m": distance,
        "bystanders": asked.bystanders,
        "protocol": setup.protocol,
        "levels": levels,
    });
    write(&asked.motions.views.output.out, &report, &results)
}

/// A crowd and how it is seen.
struct Scene<'a> {
    meeting: Meeting,
    bystanders: usize,
    view: View,
    setup: &'a Setup,
    /// Whether they move as in clips.
    has_clips: bool,
}

impl Scene<'_> {
    /// The crowd and each of its people, solved; the file `path` holds one recording after the other.
    fn solve(&self, path: &Path) -> Result<Solved, Failure> {
        let Self { meeting, bystanders, view, .. } = self;
        let mut people = Vec::new();
        for person in 0..meeting.people {
            people.push(self.person(person)?);
        }
        for bystander in 0..*bystanders {
            let (skeleton, motion) = meeting.bystander(bystander, view.seed);
            people.push(self.recording(skeleton, Places::Own, Box::new(motion))?);
        }
        let mut crowd = Crowd::new(people);
        crowd.bystanders = *bystanders;
        let group = self.solve_one(&crowd, path)?;
        let scores = group.scores.clone().ok_or_else(|| {
            Failure::new(Exit::NobodyFound, "nobody was found; use a lower --noise")
        })?;
        let mut alone_mm = Vec::new();
        for number in 0..meeting.people {
            // The same draws as in the crowd.
            let mut one = self.person(number)?;
            one.seed = view.seed.wrapping_add((number as u64) << 32);
            let alone = self.solve_one(&Crowd::alone(one), path)?;
            alone_mm.push(alone.scores.map(|scores| scores.mpjpe_mm));
        }
        Ok(Solved { group, scores, alone_mm })
    }

    fn solve_one(&self, crowd: &Crowd<AnyMotion>, path: &Path) -> Result<Group, Failure> {
        crowd.write(path, &Provenance::default(), || {})?;
        let away = self.meeting.radius() + MARGIN;
        let corner = |corner: usize| {
            let (sin, cos) = (TAU * corner as f64 / CORNERS as f64).sin_cos();
            [away * sin, away * cos]
        };
        let options = Options {
            decoder: Some(self.setup.decoder.clone()),
            performers: Performers::Auto,
            threads: 1,
            // The truth has the cameras' times.
            no_sync: true,
            choice: Choice { region: (0..CORNERS).map(corner).collect(), ..Choice::default() },
            ..Options::default()
        };
        Ok(solve_group(&mut Recording::open(path)?, &options, &mut ())?)
    }

    fn person(&self, person: usize) -> Result<Person, Failure> {
        let Self { meeting, view, setup, .. } = self;
        if !self.has_clips {
            let (skeleton, motion) = meeting.person(person, view.seed);
            return self.recording(skeleton, Places::Own, Box::new(motion));
        }
        // Everybody has the clips of one subject, and begins with another one.
        let choice = &view.choice;
        let subjects = &setup.protocol.subjects;
        let whose = &subjects[person % subjects.len()];
        let own = setup.subjects.iter().filter(|clip| clip.subject == *whose);
        let own: Vec<_> = own.collect();
        let first = person / subjects.len() % own.len().max(1);
        let clips = own.iter().cycle().skip(first).take(own.len()).copied();
        let seed = Protocol::seed_of(view.seed, &person.to_string());
        let (skeleton, places, poses) =
            in_turn(clips, choice, seed, choice.seconds).ok_or_else(|| {
                let message =
                    format!("no clip of {whose} is long enough; leave it out of --subjects");
                Failure::new(Exit::NoDetections, message)
            })?;
        let poses = meeting.lead(person, poses, train::FPS);
        self.recording(skeleton, places, Box::new(through(poses, train::FPS)))
    }

    fn recording(
        &self,
        skeleton: Skeleton,
        places: Places,
        motion: AnyMotion,
    ) -> Result<Person, Failure> {
        let Self { meeting, view, .. } = self;
        let rig = meeting.rig(view.rig.cameras.len())?;
        let mut one = synth::Recording::new(rig, skeleton, motion);
        one.places = places;
        (one.fps, one.frames) = (view.choice.fps, (view.choice.seconds * view.choice.fps) as u64);
        (one.format, one.noise, one.seed) = (view.format, view.noise.clone(), view.seed);
        one.noise.strangers = 0.0;
        Ok(one)
    }
}

/// A crowd, solved together and one by one.
struct Solved {
    group: Group,
    scores: PerformerScores,
    /// By person: MPJPE when alone, millimetres.
    alone_mm: Vec<Option<f64>>,
}

impl Solved {
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
            format!("{:.2}", scores.pcp_nearest_percent),
            format!("{:.1}", scores.mpjpe_mm),
            match mean(&alone) {
                None => "none".to_owned(),
                Some(mm) if alone.len() == self.alone_mm.len() => format!("{mm:.1}"),
                Some(mm) => format!("{mm:.1} ({} of {})", alone.len(), self.alone_mm.len()),
            },
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

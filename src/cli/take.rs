//! `bundlemocap take`

use std::time::{Duration, Instant};

use clap::{Args, ValueEnum};

use super::Ended;
use super::bus::{BusArguments, check_name, open, topics};
use super::clock::ATTENTION;
use super::failure::{Exit, Failure, value_name};
use super::terminal::{complain, say};
use crate::cli::tools::inbox::Inbox;
use crate::io::bus::{Bus, CommandPublisher};
use crate::io::wire::{Schema, Take, TakeAnswer, Topics, decode, encode, media_type};
use crate::live::WallClock;

/// Time from opening the bus to the command, for nodes and recorders to connect.
const LEAD: Duration = Duration::from_millis(500);
/// Longest wait for answers: a recorder ends a file up to three seconds after the command.
pub(super) const PATIENCE: Duration = Duration::from_secs(4);
/// Wait for further answers once a node and a recorder have answered.
const GRACE: Duration = Duration::from_millis(300);

/// Begin or end a take, or write a note about it; name, choose, label or reset performers; mend a camera or its clock.
#[derive(Debug, Args)]
#[command(after_help = "\
Actions:
  start  Recorders begin NAME.mcap in their folder. Nodes begin a run of their own for the take,
         so that `replay` can verify it alone: they keep calibration, body, latency and time
         offsets, search the performer anew, and publish no poses for some tenths of a second.
  stop   Recorders end the file, one second and the latency later. Nodes go on.
  reset  Nodes forget the performers' bodies, or that of performer NAME: somebody else comes.
  name   Performer NAME is called NEW_NAME from now on, also in the topics. A performer who had
         this name and is not here any more loses it.
  follow The person at X,Z (metres, on the floor) becomes a performer, also outside of [stage]
         region.
  drop   Performer NAME is not solved any more, until somebody follows this person.
  label  Sets the name and the colour that programs show for performer NAME, until the node
         ends. An option that is not given is set to its default.
  lock   Keeps the body of performer NAME at a reset.
  unlock Ends the lock: a reset forgets the body again.
  mend   Nodes correct the calibration of a moved camera, once its new pose is known (event
         camera_moved). The node overwrites its TOML calibration file and keeps a copy; another
         format stays unchanged.
  clock  Nodes add MS milliseconds to the capture times of camera NAME, beyond its calibration
         and in place of what they added before. A node does this by itself if it finds a wrong
         clock, and may change it again.
  note   Recorders add --note and --mark to takes.csv in their folder, for NAME, or else for the
         running take or the last one.

Prints who answered. Exit code 13: nobody did. Exit code 6: no recorder or no node answered, or one
refused.

Examples:
  bundlemocap take start walk_01
  bundlemocap take stop
  bundlemocap take note --mark good --note \"left hand is best\"
  bundlemocap take name p3 lead
  bundlemocap take follow 1.2,-0.5
  bundlemocap take drop p2
  bundlemocap take label p3 --display-name \"the lead\" --colour '#d55e00'
  bundlemocap take mend cam03
  bundlemocap take clock cam03 -100
  bundlemocap take reset --connect tcp/192.168.1.10:7447")]
pub(super) struct Arguments {
    /// What to do.
    #[arg(value_enum)]
    action: Action,
    /// Name of the take: letters, digits, `-`, `_` and `.`. Without it: the running take; for
    /// note, else the last one. For mend and clock: the name of the camera. For name, drop, label, lock and
    /// unlock: the performer, such as p3; for reset: all without one. For follow: X,Z.
    #[arg(allow_hyphen_values = true, required_if_eq_any([
        ("action", "start"), ("action", "mend"), ("action", "label"), ("action", "lock"), ("action", "unlock"),
        ("action", "name"), ("action", "drop"), ("action", "follow"), ("action", "clock"),
    ]))]
    name: Option<String>,
    /// For name: the new name: letters, digits, `-`, `_` and `.`. For clock: milliseconds.
    #[arg(allow_hyphen_values = true, value_name = "NEW_NAME|MS",
        required_if_eq_any([("action", "name"), ("action", "clock")]))]
    value: Option<String>,
    /// Text of the note.
    #[arg(long, default_value = "", hide_default_value = true)]
    note: String,
    /// Rating of the take.
    #[arg(long, value_parser = ["good", "bad"])]
    mark: Option<String>,
    /// For label: the name to show. Default: that of the topics.
    #[arg(long, default_value = "", hide_default_value = true)]
    display_name: String,
    /// For label: the colour, such as '#d55e00'. Default: chosen by the program that shows it.
    #[arg(long, default_value = "", hide_default_value = true)]
    colour: String,
    #[command(flatten)]
    bus: BusArguments,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Action {
    /// Begin a take.
    Start,
    /// End the take.
    Stop,
    /// Forget the performers' bodies.
    Reset,
    /// Give another name to a performer.
    Name,
    /// Make the person at a place a performer.
    Follow,
    /// Stop solving a performer.
    Drop,
    /// Give a performer a name and a colour to show.
    Label,
    /// Keep a performer's body when the others are forgotten.
    Lock,
    /// Forget the performer's body again at a reset.
    Unlock,
    /// Correct the calibration of a moved camera.
    Mend,
    /// Correct the capture times of a camera.
    Clock,
    /// Write a note about a take.
    Note,
}

impl Action {
    /// Who must answer.
    const fn roles(self) -> &'static [&'static str] {
        match self {
            Self::Start | Self::Stop => &["node", "recorder"],
            Self::Note => &["recorder"],
            _ => &["node"],
        }
    }
}

/// Who must answer a command.
pub(super) fn roles(action: &str) -> &'static [&'static str] {
    Action::from_str(action, false).map_or(&[], Action::roles)
}

pub(super) fn run(arguments: &Arguments) -> Ended {
    let name = arguments.name.clone().unwrap_or_default();
    let mut take = Take {
        action: value_name(arguments.action),
        name: name.clone(),
        note: arguments.note.clone(),
        mark: arguments.mark.clone().unwrap_or_default(),
        display_name: arguments.display_name.clone(),
        colour: arguments.colour.clone(),
        ..Take::default()
    };
    match arguments.action {
        Action::Follow => take.place_m = place(&name)?,
        // Cameras may have any name.
        Action::Mend | Action::Clock => {}
        _ if name.is_empty() => {}
        _ if name.starts_with('-') => return Err(no_option(&name)),
        _ => check_name("NAME", &name)?,
    }
    match (arguments.action, &arguments.value) {
        (_, None) => {}
        (Action::Clock, Some(value)) => {
            let ms = value.parse().ok().filter(|ms: &f64| ms.is_finite());
            let why = || format!("clock needs milliseconds, such as -100, not {value:?}");
            take.offset_ms = ms.ok_or_else(|| Failure::new(Exit::Usage, why()))?;
        }
        (_, Some(value)) if value.starts_with('-') => return Err(no_option(value)),
        (Action::Name, Some(value)) => {
            check_name("NEW_NAME", value)?;
            take.new_name.clone_from(value);
        }
        (_, Some(value)) => {
            let why = format!("{value:?} is one word too many: NEW_NAME is for name, MS for clock");
            return Err(Failure::new(Exit::Usage, why));
        }
    }
    let is_noted = !(take.note.is_empty() && take.mark.is_empty());
    if (arguments.action == Action::Note) != is_noted {
        let why = match is_noted {
            true => "--note and --mark are for note; use `bundlemocap take note NAME`",
            false => "note needs --note, --mark, or both",
        };
        return Err(Failure::new(Exit::Usage, why));
    }
    let is_shown = !(take.display_name.is_empty() && take.colour.is_empty());
    if arguments.action != Action::Label && is_shown {
        return Err(Failure::new(Exit::Usage, "--display-name and --colour are for label"));
    }
    let config = arguments.bus.settings()?;
    let bus = open(&config)?;
    let mut slate = Slate::open(&*bus, &topics(&config))?;
    std::thread::sleep(LEAD);
    let answers = answered(&mut slate, take, arguments.action.roles())?;
    for TakeAnswer { role, text, refused, .. } in &answers {
        match refused {
            true => complain("warning", &format!("{role}: {text}")),
            false => say(&format!("{role}: {text}")),
        }
    }
    if answers.is_empty() {
        let fix = "is `bundlemocap run` up, on this --stage and bus, and may your certificate give commands?";
        return Err(Failure::new(Exit::Bus, format!("nobody answered; {fix}")));
    }
    let is_missing = |role: &&&str| !answers.iter().any(|answer| answer.role == **role);
    let missing: Vec<&&str> = arguments.action.roles().iter().filter(is_missing).collect();
    for role in &missing {
        let fix = match (**role, arguments.action) {
            ("recorder", Action::Stop) => {
                ": is `bundlemocap record` up, and does it record a take?"
            }
            _ => "",
        };
        complain("warning", &format!("no {role} answered{fix}"));
    }
    let is_done = missing.is_empty() && answers.iter().all(|answer| !answer.refused);
    Ok(if is_done { Exit::Done } else { Exit::InPart })
}

/// A word that begins with `-`: a name does not.
fn no_option(word: &str) -> Failure {
    let why = format!("{word:?} is not an option of `take`, and a NAME does not begin with `-`");
    Failure::new(Exit::Usage, why)
}

/// The place of a text such as `1.2,-0.5`.
fn place(text: &str) -> Result<Vec<f64>, Failure> {
    let numbers = text.split(',').map(|number| number.trim().parse::<f64>());
    let place: Option<Vec<f64>> =
        numbers.map(|number| number.ok().filter(|n| n.is_finite())).collect();
    place.filter(|place| place.len() == 2).ok_or_else(|| {
        let fix = "write X,Z in metres, such as 1.2,-0.5";
        Failure::new(Exit::Usage, format!("follow needs a place, not {text:?}: {fix}"))
    })
}

/// Publishes a command and collects the answers.
fn answered(slate: &mut Slate, take: Take, roles: &[&str]) -> Result<Vec<TakeAnswer>, Failure> {
    let take = slate.send(take)?;
    let (begin, mut all) = (Instant::now(), Vec::<TakeAnswer>::new());
    let mut until = PATIENCE;
    while begin.elapsed() < until {
        let answer = slate.answer_within(ATTENTION);
        let Some(answer) = answer.filter(|answer| answer.id == take.id) else { continue };
        all.push(answer);
        if roles.iter().all(|role| all.iter().any(|answer| answer.role == *role)) {
            until = PATIENCE.min(begin.elapsed() + GRACE);
        }
    }
    Ok(all)
}

/// Publishes commands and hears the answers.
pub(super) struct Slate {
    inbox: Inbox,
    commands: CommandPublisher,
}

impl Slate {
    pub(super) fn open(bus: &dyn Bus, topics: &Topics) -> Result<Self, Failure> {
        let inbox = Inbox::open(bus, &topics.take_answers())?;
        Ok(Self { inbox, commands: CommandPublisher::open(bus, topics.take())? })
    }

    /// Who joins later does not get the last command. Call it now and then.
    pub(super) fn forget_old(&mut self, bus: &dyn Bus) -> Result<(), Failure> {
        Ok(self.commands.forget_old(bus)?)
    }

    /// Publishes a command under a new id; returns it with this id.
    pub(super) fn send(&mut self, take: Take) -> Result<Take, Failure> {
        let take = Take { id: WallClock::start().now().ns().unsigned_abs(), ..take };
        let kind = media_type(Take::FULL_NAME);
        self.commands.put(&kind, &encode(&take))?;
        Ok(take)
    }

    /// The next answer, to whatever command, if one has come.
    pub(super) fn answer(&self) -> Option<TakeAnswer> {
        self.answer_within(Duration::ZERO)
    }

    fn answer_within(&self, wait: Duration) -> Option<TakeAnswer> {
        decode(&self.inbox.next(wait)?.sample.payload).ok()
    }
}

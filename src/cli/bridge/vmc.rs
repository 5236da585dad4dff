//! `bundlemocap bridge vmc`

use std::collections::BTreeMap;
use std::fmt::{self, Display};
use std::net::{SocketAddr, ToSocketAddrs, UdpSocket};
use std::path::PathBuf;
use std::time::{Duration, Instant};

use clap::Args;

use crate::cli::Ended;
use crate::cli::bus::{BusArguments, check_name, open};
use crate::cli::clock::{ATTENTION, Stop};
use crate::cli::failure::{Exit, Failure};
use crate::cli::retarget::{character, summary};
use crate::cli::terminal::{complain, note, say};
use crate::cli::tools::inbox::{Inbox, Received, Unusable};
use crate::core::body::{Skeleton, StampedPose, TrackingState};
use crate::core::time::Timestamp;
use crate::io::recording::Message;
use crate::io::vmc;
use crate::io::wire::{StageChannel, Take, Topic, decode};
use crate::retarget::Retarget;

/// A performer without poses for this long is lost.
const GONE: Duration = Duration::from_secs(2);

/// Send poses in the VMC protocol, for Unity, Unreal, Warudo, VSeeFace and other avatar programs.
#[derive(Debug, Args)]
#[command(after_help = "\
With --skeleton the poses are retargeted to that BVH file's skeleton first, as `bundlemocap retarget`
does: the sizes of the bones and the height of the hips are the character's.

The protocol has no names of performers: each performer needs an address of its own. An address
without a name is for --actor, or else for the first performer who comes; when this one leaves, for
the next.

A final pose is sent when it is due. A performer who is lost, or has no poses for two seconds, is sent
as not tracked, without bones. The other program may start later.

Examples:
  bundlemocap bridge vmc
  bundlemocap bridge vmc --to 192.168.1.30:39539 --provisional
  bundlemocap bridge vmc --to p1=127.0.0.1:39539 --to p2=127.0.0.1:39549
  bundlemocap bridge vmc --skeleton robot.bvh --map robot.toml")]
pub(super) struct Arguments {
    /// Address of the receiving program. With NAME= before it, it gets that performer. May be repeated.
    #[arg(long, value_name = "[NAME=]HOST:PORT", default_value = "127.0.0.1:39539")]
    to: Vec<String>,
    /// Send provisional poses: earlier, less exact, and fewer when the node is overloaded.
    #[arg(long)]
    provisional: bool,
    /// BVH file with the skeleton of a character.
    #[arg(long, value_name = "BVH")]
    skeleton: Option<PathBuf>,
    /// Joint map of that file, TOML; `bundlemocap retarget --help` shows one.
    #[arg(long, value_name = "TOML", requires = "skeleton")]
    map: Option<PathBuf>,
    #[command(flatten)]
    bus: BusArguments,
}

pub(super) fn run(arguments: &Arguments) -> Ended {
    let stop = Stop::on_signals()?;
    let config = arguments.bus.settings()?;
    let topics = arguments.bus.topics(&config);
    let only = (topics.actor != "*").then_some(&*topics.actor);
    let character = match &arguments.skeleton {
        Some(path) => {
            let character = character(path, arguments.map.as_deref())?;
            note(&summary(path, &character));
            Some(character)
        }
        None => None,
    };
    let mut bridge = Bridge::new(&arguments.to, only, arguments.provisional, character)?;
    let bus = open(&config)?;
    let mut patterns = vec![topics.skeleton(), topics.pose(), topics.take()];
    patterns.extend(arguments.provisional.then(|| topics.provisional()));
    let inbox = Inbox::open_all(&*bus, &patterns)?;
    note(&format!("sending poses to {}; Ctrl-C ends it", arguments.to.join(", ")));
    while !stop.is_set() {
        if let Some(received) = inbox.next(ATTENTION) {
            bridge.handle(&received);
        }
        bridge.end_silent(GONE);
    }
    bridge.end_silent(Duration::ZERO);
    bridge.count.dropped = inbox.dropped();
    say(&bridge.count.to_string());
    Ok(bridge.judged())
}

/// What is sent where.
struct Bridge {
    targets: Vec<Target>,
    is_provisional: bool,
    bodies: BTreeMap<String, Skeleton>,
    first: Option<Timestamp>,
    count: Count,
    /// New names that were asked for: the name before, and when. A name is removed with its first pose.
    renamed: BTreeMap<String, (String, Instant)>,
}

/// A program that receives a performer.
struct Target {
    address: SocketAddr,
    socket: UdpSocket,
    /// Without a name it is for whoever comes.
    is_named: bool,
    performer: Option<String>,
    /// The skeleton that gets the poses, if it is not the performer's.
    character: Option<Retarget>,
    /// The last pose and when it was sent, until the performer is silent.
    last: Option<(StampedPose, Instant)>,
    sent: u64,
}

#[derive(Default)]
struct Count {
    sent: u64,
    /// Of performers without an address.
    without: BTreeMap<String, u64>,
    /// Before the body.
    early: u64,
    unusable: Unusable,
    unsent: u64,
    dropped: u64,
}

impl fmt::Display for Count {
    fn fmt(&self, to: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { sent, without, early, unusable, unsent, dropped } = self;
        write!(to, "{sent} poses sent")?;
        let rest = [
            (early, "came before the body"),
            (&unusable.0, "unusable messages"),
            (unsent, "refused by the network"),
            (dropped, "messages dropped because this computer is too slow"),
        ];
        for (count, what) in rest.iter().filter(|(count, _)| **count > 0) {
            write!(to, ", {count} {what}")?;
        }
        for (actor, count) in without {
            write!(to, ", {count} of {actor} without an address")?;
        }
        Ok(())
    }
}

impl Bridge {
    /// `only`: the performer whose topics are received, if it is one.
    fn new(
        addresses: &[String],
        only: Option<&str>,
        is_provisional: bool,
        character: Option<Retarget>,
    ) -> Result<Self, Failure> {
        let mut targets = Vec::<Target>::new();
        for text in addresses {
            let wrong =
                |why: &dyn Display| Failure::new(Exit::Usage, format!("--to {text}: {why}"));
            let (name, address) = match text.split_once('=') {
                Some((name, address)) => (Some(name), address),
                None => (only, text.as_str()),
            };
            if let Some(name) = name {
                check_name("--to", name)?;
                if only.is_some_and(|only| only != name) {
                    return Err(wrong(&"another performer than that of --actor or --config"));
                }
            }
            let all = address.to_socket_addrs().map_err(|error| {
                wrong(&format!("{error}; give an address such as 127.0.0.1:39539"))
            })?;
            // Many programs listen on IPv4 alone.
            let all: Vec<SocketAddr> = all.collect();
            let address = all.iter().find(|one| one.is_ipv4()).or(all.first()).copied();
            let address = address.ok_or_else(|| wrong(&"the host has no address"))?;
            if targets.iter().any(|one| one.address == address) {
                return Err(wrong(&"this address is given twice"));
            }
            if targets.iter().any(|one| one.performer.as_deref() == name) {
                let why = match name {
                    Some(_) => "this performer has another address already",
                    None => "there is another address without a name; give NAME=HOST:PORT",
                };
                return Err(wrong(&why));
            }
            targets.push(Target {
                address,
                socket: socket_for(address).map_err(|error| wrong(&error))?,
                is_named: name.is_some(),
                performer: name.map(str::to_owned),
                character: character.clone(),
                last: None,
                sent: 0,
            });
        }
        let (first, bodies, count) = (None, BTreeMap::new(), Count::default());
        let renamed = BTreeMap::new();
        Ok(Self { targets, is_provisional, bodies, first, count, renamed })
    }

    fn handle(&mut self, received: &Received) {
        let topic = Topic::parse(&received.sample.topic);
        if let Ok(Topic::Stage { channel: StageChannel::Take, .. }) = topic {
            let take = decode::<Take>(&received.sample.payload).ok();
            if let Some(take) = take.filter(|take| take.action == "name") {
                self.renamed.insert(take.new_name, (take.name, Instant::now()));
            }
            return;
        }
        let actor = Topic::actor(&received.sample.topic);
        match received.message() {
            Ok(Message::Skeleton(body)) => {
                if let Some(body) = self.count.unusable.value(body.to_core()) {
                    self.bodies.insert(actor, body);
                }
            }
            Ok(Message::Pose(pose)) => {
                if let Some(pose) = self.count.unusable.value(pose.to_core()) {
                    self.send(&actor, pose);
                }
            }
            Ok(_) => {}
            Err(error) => drop(self.count.unusable.value::<()>(Err(error))),
        }
    }

    /// The first pose under a new name goes to the address of the name before.
    fn follow_name(&mut self, actor: &str) {
        let Some((before, asked)) = self.renamed.remove(actor) else { return };
        let is_of = |one: &Target, name: &str| one.performer.as_deref() == Some(name);
        // Another performer had the name, or got it later: the command was refused.
        let is_known = self.targets.iter().any(|one| is_of(one, actor));
        if is_known || self.count.without.contains_key(actor) || asked.elapsed() > GONE {
            return;
        }
        let mut targets = self.targets.iter_mut();
        if let Some(target) = targets.find(|one| !one.is_named && is_of(one, &before)) {
            note(&format!("{} gets {actor}, who was {before}", target.address));
            target.performer = Some(actor.to_owned());
        }
    }

    fn send(&mut self, actor: &str, pose: StampedPose) {
        self.follow_name(actor);
        let Some(target) = target_of(&mut self.targets, actor) else {
            let count = self.count.without.entry(actor.to_owned()).or_default();
            if *count == 0 {
                complain("note", &format!("{actor} is not sent; give --to {actor}=HOST:PORT"));
            }
            *count += 1;
            return;
        };
        let Some(body) = self.bodies.get(actor) else {
            self.count.early += 1;
            return;
        };
        // No provisional pose is lost: the final ones say it.
        let is_newer = target.last.as_ref().is_some_and(|(last, _)| last.capture < pose.capture);
        let is_lost = pose.state == TrackingState::Lost;
        if self.is_provisional && !pose.provisional && !(is_lost && is_newer) {
            return;
        }
        let first = *self.first.get_or_insert(pose.capture);
        target.claim(actor);
        match target.send(body, &pose, first) {
            Ok(()) => self.count.sent += 1,
            Err(error) => {
                if self.count.unsent == 0 {
                    complain("warning", &format!("a pose is not sent: {error}"));
                }
                self.count.unsent += 1;
            }
        }
        target.last = Some((pose, Instant::now()));
    }

    /// Sends performers who had no pose for that time as lost. Their addresses without a name become free.
    fn end_silent(&mut self, time: Duration) {
        for target in &mut self.targets {
            let Some((mut pose, _)) = target.last.take_if(|(_, at)| at.elapsed() >= time) else {
                continue;
            };
            pose.state = TrackingState::Lost;
            if let Some(body) = target.performer.as_ref().and_then(|name| self.bodies.get(name)) {
                // A network that refuses it has been reported with a pose.
                drop(target.send(body, &pose, self.first.unwrap_or_default()));
            }
            target.free();
        }
    }

    /// The exit code; says which programs got nothing.
    fn judged(&self) -> Exit {
        for Target { address, .. } in self.targets.iter().filter(|target| target.sent == 0) {
            let what = "check --stage, the performer's name, and whether the node runs";
            complain("warning", &format!("nothing was sent to {address}: {what}"));
        }
        if self.count.sent > 0 { Exit::Done } else { Exit::InPart }
    }
}

impl Target {
    fn send(
        &mut self,
        body: &Skeleton,
        pose: &StampedPose,
        first: Timestamp,
    ) -> std::io::Result<()> {
        let seconds = pose.capture.seconds_since(first);
        let other = |error: &dyn Display| std::io::Error::other(error.to_string());
        let bones = match &mut self.character {
            Some(character) => {
                character.apply(&pose.pose, body).map_err(|error| other(&error))?.bones()
            }
            None => vmc::bones(body, &pose.pose),
        };
        let packets = vmc::packets(&bones, pose.state, seconds).map_err(|error| other(&error))?;
        for packet in packets {
            self.socket.send_to(&packet, self.address)?;
        }
        self.sent += 1;
        Ok(())
    }

    /// Reserves the address for a performer, if it is free.
    fn claim(&mut self, actor: &str) {
        if self.performer.is_none() {
            note(&format!("{} gets {actor}", self.address));
            self.performer = Some(actor.to_owned());
        }
    }

    /// Whoever comes next may have an address without a name.
    fn free(&mut self) {
        if !self.is_named {
            self.performer = None;
        }
    }
}

/// A socket that never waits; it may also send to all computers of a network.
fn socket_for(address: SocketAddr) -> std::io::Result<UdpSocket> {
    let socket = UdpSocket::bind(if address.is_ipv4() { "0.0.0.0:0" } else { "[::]:0" })?;
    socket.set_nonblocking(true)?;
    if address.is_ipv4() {
        socket.set_broadcast(true)?;
    }
    Ok(socket)
}

/// Where the poses of a performer go. The first who comes takes an address without a name.
fn target_of<'a>(targets: &'a mut [Target], actor: &str) -> Option<&'a mut Target> {
    let is_of = |target: &Target| target.performer.as_deref() == Some(actor);
    let of = targets.iter().position(is_of);
    Some(&mut targets[of.or_else(|| targets.iter().position(|one| one.performer.is_none()))?])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_address_without_a_name_is_free_when_its_performer_is_silent() {
        let addresses = ["p2=127.0.0.1:9", "127.0.0.1:10"].map(str::to_owned);
        let mut bridge = Bridge::new(&addresses, None, false, None).unwrap();
        let address = |bridge: &mut Bridge, actor: &str| {
            let target = target_of(&mut bridge.targets, actor)?;
            target.claim(actor);
            Some(target.address.port())
        };
        assert_eq!(address(&mut bridge, "p1"), Some(10));
        assert_eq!(address(&mut bridge, "p2"), Some(9));
        assert_eq!((address(&mut bridge, "p3"), address(&mut bridge, "p1")), (None, Some(10)));
        for target in &mut bridge.targets {
            target.free();
        }
        assert_eq!((address(&mut bridge, "p3"), address(&mut bridge, "p1")), (Some(10), None));
        assert_eq!(address(&mut bridge, "p2"), Some(9));
        // p3 is called star.
        bridge.renamed.insert("star".into(), ("p3".into(), Instant::now()));
        bridge.follow_name("star");
        assert_eq!((address(&mut bridge, "star"), address(&mut bridge, "p3")), (Some(10), None));
        // Nobody can be called p2: another performer is.
        bridge.renamed.insert("p2".into(), ("star".into(), Instant::now()));
        bridge.follow_name("p2");
        assert_eq!((address(&mut bridge, "star"), address(&mut bridge, "p2")), (Some(10), Some(9)));
    }
}

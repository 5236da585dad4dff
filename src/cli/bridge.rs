//! `bundlemocap bridge`

use std::collections::BTreeMap;
use std::net::{SocketAddr, ToSocketAddrs, UdpSocket};
use std::time::{Duration, Instant};

use clap::{Args, Subcommand};

use super::Ended;
use super::bus::{BusArguments, check_name, open};
use super::clock::{ATTENTION, Stop};
use super::failure::{Exit, Failure};
use super::terminal::{complain, note, say};
use crate::cli::tools::inbox::{Inbox, Received};
use crate::core::body::{Skeleton, StampedPose};
use crate::core::time::Timestamp;
use crate::io::recording::Message;
use crate::io::vmc;
use crate::io::wire::{DecodeError, Topic};

/// A performer without poses for this long gives the address without a name to another.
const GONE: Duration = Duration::from_secs(2);

/// Send live poses to other programs.
#[derive(Debug, Args)]
pub(super) struct Arguments {
    #[command(subcommand)]
    protocol: Protocol,
}

#[derive(Debug, Subcommand)]
enum Protocol {
    Vmc(Vmc),
}

/// Send poses in the VMC protocol, for Unity, Unreal, Warudo, VSeeFace and other avatar programs.
#[derive(Debug, Args)]
#[command(after_help = "\
The protocol has no names of performers: each performer needs an address of its own. An address
without a name is for --actor, or else for the first performer who comes; when this one leaves, for
the next.

A final pose is sent when it is due. A lost pose is sent as not tracked, without bones. The other
program may start later.

Examples:
  bundlemocap bridge vmc
  bundlemocap bridge vmc --to 192.168.1.30:39539 --provisional
  bundlemocap bridge vmc --to p1=127.0.0.1:39539 --to p2=127.0.0.1:39549")]
struct Vmc {
    /// Address of the program that receives; with a performer's name before it, of that performer. May be repeated.
    #[arg(long, value_name = "[NAME=]HOST:PORT", default_value = "127.0.0.1:39539")]
    to: Vec<String>,
    /// Send provisional poses: earlier, less exact.
    #[arg(long)]
    provisional: bool,
    #[command(flatten)]
    bus: BusArguments,
}

pub(super) fn run(arguments: &Arguments) -> Ended {
    let Protocol::Vmc(arguments) = &arguments.protocol;
    let stop = Stop::on_signals()?;
    let mut bridge = Bridge::to(&arguments.to, arguments.bus.actor())?;
    let config = arguments.bus.settings()?;
    let topics = arguments.bus.topics(&config);
    let poses = if arguments.provisional { topics.provisional() } else { topics.pose() };
    let bus = open(&config)?;
    let inbox = Inbox::open_all(&*bus, &[topics.skeleton(), poses])?;
    note(&format!("sending poses to {}; Ctrl-C ends it", arguments.to.join(", ")));
    while !stop.is_set() {
        if let Some(received) = inbox.next(ATTENTION) {
            bridge.take(&received);
        }
    }
    bridge.count.dropped = inbox.dropped();
    say(&bridge.count.to_string());
    Ok(Exit::Done)
}

/// What is sent where.
struct Bridge {
    socket: UdpSocket,
    named: BTreeMap<String, SocketAddr>,
    /// The address for whoever comes, who that is, and the time of that performer's last pose.
    unnamed: Option<SocketAddr>,
    served: Option<(String, Instant)>,
    bodies: BTreeMap<String, Skeleton>,
    first: Option<Timestamp>,
    count: Count,
}

#[derive(Default)]
struct Count {
    sent: u64,
    /// Of performers without an address.
    without: BTreeMap<String, u64>,
    /// Before the body.
    early: u64,
    unusable: u64,
    unsent: u64,
    dropped: u64,
}

impl std::fmt::Display for Count {
    fn fmt(&self, to: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self { sent, without, early, unusable, unsent, dropped } = self;
        write!(to, "{sent} poses sent")?;
        let rest = [
            (early, "came before the body"),
            (unusable, "unusable messages"),
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
    fn to(addresses: &[String], actor: Option<&str>) -> Result<Self, Failure> {
        let wrong = |text: &str, why: &dyn std::fmt::Display| {
            Failure::new(
                Exit::Usage,
                format!("--to {text}: {why}; give an address such as 127.0.0.1:39539"),
            )
        };
        let (mut named, mut unnamed) = (BTreeMap::new(), None);
        for text in addresses {
            let (name, address) = match text.split_once('=') {
                Some((name, address)) => (Some(name), address),
                None => (actor, text.as_str()),
            };
            let resolved = address.to_socket_addrs().map_err(|error| wrong(text, &error))?.next();
            let resolved = resolved.ok_or_else(|| wrong(text, &"no such computer"))?;
            let earlier = match name {
                Some(name) => {
                    check_name("--to", name)?;
                    named.insert(name.to_owned(), resolved)
                }
                None => unnamed.replace(resolved),
            };
            if earlier.is_some() {
                return Err(wrong(text, &"this performer has another address already"));
            }
        }
        let is_v6 = named.values().chain(&unnamed).any(SocketAddr::is_ipv6);
        let socket = UdpSocket::bind(if is_v6 { "[::]:0" } else { "0.0.0.0:0" })
            .and_then(|socket| socket.set_nonblocking(true).map(|()| socket))
            .map_err(|error| Failure::new(Exit::Unexpected, format!("no UDP socket: {error}")))?;
        let (served, first) = (None, None);
        let (bodies, count) = (BTreeMap::new(), Count::default());
        Ok(Self { socket, named, unnamed, served, bodies, first, count })
    }

    fn take(&mut self, received: &Received) {
        let actor = Topic::actor(&received.sample.topic);
        match received.message() {
            Ok(Message::Skeleton(body)) => {
                if let Some(body) = self.usable(body.to_core()) {
                    self.bodies.insert(actor, body);
                }
            }
            Ok(Message::Pose(pose)) => {
                if let Some(pose) = self.usable(pose.to_core()) {
                    self.send(&actor, &pose);
                }
            }
            Ok(_) => {}
            Err(error) => drop(self.usable::<()>(Err(error))),
        }
    }

    fn send(&mut self, actor: &str, pose: &StampedPose) {
        let Some(address) = self.address(actor) else {
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
        let first = *self.first.get_or_insert(pose.capture);
        let packets = vmc::packets(body, &pose.pose, pose.state, pose.capture.seconds_since(first));
        let sent = packets.map_err(std::io::Error::other).and_then(|packets| {
            packets.iter().try_for_each(|packet| self.socket.send_to(packet, address).map(drop))
        });
        match sent {
            Ok(()) => self.count.sent += 1,
            Err(error) => {
                if self.count.unsent == 0 {
                    complain("warning", &format!("a pose is not sent to {address}: {error}"));
                }
                self.count.unsent += 1;
            }
        }
    }

    /// Where the poses of a performer go.
    fn address(&mut self, actor: &str) -> Option<SocketAddr> {
        if let Some(address) = self.named.get(actor) {
            return Some(*address);
        }
        let address = self.unnamed?;
        let is_free =
            self.served.as_ref().is_none_or(|(who, last)| who != actor && last.elapsed() > GONE);
        if is_free {
            note(&format!("{address} gets {actor}"));
        } else if self.served.as_ref().is_some_and(|(who, _)| who != actor) {
            return None;
        }
        self.served = Some((actor.to_owned(), Instant::now()));
        Some(address)
    }

    /// The value; errors are counted, and the first one is printed.
    fn usable<T>(&mut self, result: Result<T, DecodeError>) -> Option<T> {
        result
            .inspect_err(|error| {
                if self.count.unusable == 0 {
                    complain("warning", &format!("unusable message: {error}"));
                }
                self.count.unusable += 1;
            })
            .ok()
    }
}

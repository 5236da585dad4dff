//! `bundlemocap bridge osc`

use std::collections::{BTreeMap, VecDeque};
use std::fmt;
use std::io::ErrorKind;
use std::net::{SocketAddr, UdpSocket};
use std::time::{Instant, SystemTime};

use clap::Args;
use rosc::{OscMessage, OscPacket, OscType, decoder, encoder};

use crate::cli::Ended;
use crate::cli::bus::{BusArguments, open};
use crate::cli::clock::{ATTENTION, Stop};
use crate::cli::failure::{Exit, Failure};
use crate::cli::take::{PATIENCE, Slate, roles};
use crate::cli::terminal::{complain, note, say};
use crate::io::wire::{Take, TakeAnswer, valid_name};

/// Most commands whose answers are still sent on.
const OPEN: usize = 64;
/// Longest packet, bytes.
const PACKET: usize = 65_536;

/// Begin, end and rate takes by OSC, from phones, show control and Unreal.
#[derive(Debug, Args)]
#[command(after_help = "\
Messages:
  /take/start [NAME]           begins a take; without a name it is named after the time (UTC)
  /take/start SLATE NUMBER     begins SLATE_NUMBER
  /take/stop                   ends the take
  /take/note TEXT              a note about the running take or the last one
  /take/mark good|bad          rates it
  /take/reset                  somebody else comes: nodes forget the performers' bodies
  /take/reset NAME             the same of one performer
  /RecordStart SLATE NUMBER    as Unreal starts the face capture of a phone; with /RecordStop
  /OSCSetSendTarget IP PORT    answers go there; without it, to where the command came from

Some buttons send a number, or true and false, when they are pressed and when they are let go. The
command is done when the button is pressed.

Each node and each recorder answers with /take/answer ROLE TEXT DONE. DONE is 1. It is 0 if the command
was refused, or if nobody of that role is there. A wrong message to /take/ is answered by the role
bridge. A name gets `_` for each character that it cannot have. OSC has no passwords: anybody who
reaches the port can begin and end takes. The default is this computer alone.

Examples:
  bundlemocap bridge osc
  bundlemocap bridge osc --listen 0.0.0.0:8000 --connect tcp/192.168.1.10:7447")]
pub(super) struct Arguments {
    /// Address to listen on; 0.0.0.0 for phones and other computers.
    #[arg(long, value_name = "HOST:PORT", default_value = "127.0.0.1:8000")]
    listen: String,
    #[command(flatten)]
    bus: BusArguments,
}

pub(super) fn run(arguments: &Arguments) -> Ended {
    let stop = Stop::on_signals()?;
    let config = arguments.bus.settings()?;
    let socket = UdpSocket::bind(&arguments.listen).map_err(|error| {
        let fix = "give a free port of this computer, such as 127.0.0.1:8000";
        Failure::new(Exit::Usage, format!("--listen {}: {error}; {fix}", arguments.listen))
    })?;
    let unusable = |error: std::io::Error| Failure::new(Exit::Unexpected, error.to_string());
    socket.set_read_timeout(Some(ATTENTION)).map_err(unusable)?;
    let at = socket.local_addr().map_err(unusable)?;
    let bus = open(&config)?;
    let slate = Slate::open(&*bus, &crate::cli::bus::topics(&config))?;
    let mut bridge =
        Bridge { socket, slate, asked: VecDeque::new(), target: None, count: Count::default() };
    note(&format!("takes commands on {at}; Ctrl-C ends it"));
    let mut packet = vec![0; PACKET];
    while !stop.is_set() {
        match bridge.socket.recv_from(&mut packet) {
            Ok((length, from)) => bridge.handle(&packet[..length], from)?,
            // The answer to a client that is gone.
            Err(error) if error.kind() == ErrorKind::ConnectionReset => {}
            Err(error) if matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut) => {}
            Err(error) if error.kind() == ErrorKind::Interrupted => {}
            Err(error) => return Err(unusable(error)),
        }
        bridge.send_answers();
        bridge.slate.forget_old(&*bus)?;
    }
    say(&bridge.count.to_string());
    Ok(Exit::Done)
}

struct Bridge {
    socket: UdpSocket,
    slate: Slate,
    /// The newest commands.
    asked: VecDeque<Asked>,
    /// Where all answers go, if a client has said it.
    target: Option<SocketAddr>,
    count: Count,
}

/// A command.
struct Asked {
    id: u64,
    from: SocketAddr,
    at: Instant,
    /// Who has not answered.
    missing: Vec<&'static str>,
}

#[derive(Default)]
struct Count {
    commands: u64,
    answers: u64,
    unsent: u64,
    /// By reason.
    unusable: BTreeMap<String, u64>,
}

impl fmt::Display for Count {
    fn fmt(&self, to: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { commands, answers, unsent, unusable } = self;
        write!(to, "{commands} commands, {answers} answers")?;
        if *unsent > 0 {
            write!(to, ", {unsent} refused by the network")?;
        }
        let unusable: u64 = unusable.values().sum();
        if unusable > 0 {
            write!(to, ", {unusable} messages that are no command")?;
        }
        Ok(())
    }
}

impl Bridge {
    fn handle(&mut self, packet: &[u8], from: SocketAddr) -> Result<(), Failure> {
        match decoder::decode_udp(packet) {
            Ok((_, packet)) => self.open_packet(packet, from),
            Err(error) => {
                self.reject(from, &format!("not OSC ({error})"));
                Ok(())
            }
        }
    }

    /// Bundles are done at once, whatever their time.
    fn open_packet(&mut self, packet: OscPacket, from: SocketAddr) -> Result<(), Failure> {
        match packet {
            OscPacket::Bundle(bundle) => {
                bundle.content.into_iter().try_for_each(|packet| self.open_packet(packet, from))
            }
            OscPacket::Message(message) if message.addr == "/OSCSetSendTarget" => {
                match target(&message.args) {
                    Some(target) => self.target = Some(target),
                    None => self.reject(from, "/OSCSetSendTarget needs an IP address and a port"),
                }
                Ok(())
            }
            OscPacket::Message(message) => match command(&message) {
                Ok(None) => Ok(()),
                Ok(Some(take)) => {
                    let take = self.slate.send(take)?;
                    let name = [" ", &take.name].concat();
                    say(&format!("{from}: {}{}", take.action, name.trim_end()));
                    self.count.commands += 1;
                    let missing = roles(&take.action).to_vec();
                    self.asked.truncate(OPEN - 1);
                    self.asked.push_front(Asked { id: take.id, from, at: Instant::now(), missing });
                    Ok(())
                }
                Err(reason) => {
                    self.reject(from, &reason);
                    // An answer to an answer would be answered.
                    if message.addr.starts_with("/take/") && message.addr != "/take/answer" {
                        self.answer(from, "bridge", &reason, false);
                    }
                    Ok(())
                }
            },
        }
    }

    /// Counts a message; the first of a reason is printed.
    fn reject(&mut self, from: SocketAddr, reason: &str) {
        // A flood of different messages is not kept.
        let is_new = !self.count.unusable.contains_key(reason);
        let reason = if is_new && self.count.unusable.len() >= OPEN { "others" } else { reason };
        let count = self.count.unusable.entry(reason.to_owned()).or_default();
        if *count == 0 {
            complain("warning", &format!("{from}: {}", reason.escape_debug()));
        }
        *count += 1;
    }

    /// Sends on the answers that have come, and says who has not answered in time.
    fn send_answers(&mut self) {
        while let Some(TakeAnswer { id, role, text, refused, .. }) = self.slate.answer() {
            let Some(asked) = self.asked.iter_mut().find(|asked| asked.id == id) else { continue };
            asked.missing.retain(|missing| *missing != role);
            let from = asked.from;
            self.answer(from, &role, &text, !refused);
        }
        let mut late = Vec::new();
        for asked in self.asked.iter_mut().filter(|asked| asked.at.elapsed() > PATIENCE) {
            late.extend(asked.missing.drain(..).map(|role| (asked.from, role)));
        }
        for (from, role) in late {
            complain("warning", &format!("no {role} answered"));
            self.answer(from, role, "no answer", false);
        }
    }

    fn answer(&mut self, from: SocketAddr, role: &str, text: &str, is_done: bool) {
        say(&format!("{role}: {text}"));
        let args = vec![
            OscType::String(role.to_owned()),
            OscType::String(text.to_owned()),
            OscType::Int(i32::from(is_done)),
        ];
        let message = OscMessage { addr: "/take/answer".into(), args };
        let packet = encoder::encode(&OscPacket::Message(message));
        let sent = packet.map_err(|error| error.to_string()).and_then(|packet| {
            let to = self.target.unwrap_or(from);
            self.socket.send_to(&packet, to).map_err(|error| format!("{to}: {error}"))
        });
        match sent {
            Ok(_) => self.count.answers += 1,
            Err(error) => {
                if self.count.unsent == 0 {
                    complain("warning", &format!("an answer is not sent: {error}"));
                }
                self.count.unsent += 1;
            }
        }
    }
}

/// An IP address and a port; phones send the port as a number, others as text.
fn target(args: &[OscType]) -> Option<SocketAddr> {
    let [OscType::String(host), port] = args else { return None };
    Some(SocketAddr::new(host.parse().ok()?, word(port)?.parse().ok()?))
}

/// An argument as text.
fn word(arg: &OscType) -> Option<String> {
    match arg {
        OscType::String(text) => Some(text.clone()),
        OscType::Int(number) => Some(number.to_string()),
        OscType::Long(number) => Some(number.to_string()),
        OscType::Float(number) => Some(number.to_string()),
        OscType::Double(number) => Some(number.to_string()),
        _ => None,
    }
}

/// The command of a message, or why it is none; `None`: a button was let go.
fn command(OscMessage { addr, args }: &OscMessage) -> Result<Option<Take>, String> {
    let action = match addr.as_str() {
        "/RecordStart" => "start",
        "/RecordStop" => "stop",
        addr => addr.strip_prefix("/take/").unwrap_or_default(),
    };
    let is_button = matches!(action, "start" | "stop" | "reset");
    let (args, is_pressed) = match &args[..] {
        [one] if is_button => {
            pressed(one).map_or((&args[..], true), |is_pressed| (&[], is_pressed))
        }
        all => (all, true),
    };
    if !is_pressed {
        return Ok(None);
    }
    let words: Option<Vec<String>> = args.iter().map(word).collect();
    let words = words.ok_or_else(|| format!("{addr}: give texts and numbers"))?;
    let words: Vec<&str> = words.iter().map(String::as_str).collect();
    let take = Take { action: action.to_owned(), ..Take::default() };
    let take = match (action, &words[..]) {
        ("start", []) => Ok(Take { name: named_after(SystemTime::now()), ..take }),
        ("start", [name]) if !name.is_empty() => Ok(Take { name: valid(name), ..take }),
        ("start", [slate, number]) => {
            Ok(Take { name: valid(&format!("{slate}_{number}")), ..take })
        }
        ("reset", [name]) if !name.is_empty() => Ok(Take { name: valid(name), ..take }),
        ("stop", _) | ("reset", []) => Ok(take),
        ("note", [text]) if !text.is_empty() => Ok(Take { note: (*text).to_owned(), ..take }),
        ("mark", [mark @ ("good" | "bad")]) => {
            Ok(Take { action: "note".to_owned(), mark: (*mark).to_owned(), ..take })
        }
        ("start", _) => Err(format!("{addr}: give a name, or a slate and a number")),
        ("reset", _) => Err(format!("{addr}: give one name, or none for all")),
        ("note", _) => Err(format!("{addr}: give a text")),
        ("mark", _) => Err(format!("{addr}: give good or bad")),
        _ => Err(format!("{addr} is no command; `bundlemocap bridge osc --help` lists them")),
    };
    take.map(Some)
}

/// Whether a button is pressed, if the argument is of one.
fn pressed(arg: &OscType) -> Option<bool> {
    match arg {
        OscType::Bool(is_pressed) => Some(*is_pressed),
        OscType::Int(number) => Some(*number != 0),
        OscType::Float(number) => Some(*number != 0.0),
        OscType::Double(number) => Some(*number != 0.0),
        OscType::Nil | OscType::Inf => Some(true),
        _ => None,
    }
}

/// A name with the characters that a name may have.
fn valid(name: &str) -> String {
    let allowed = |c: char| if valid_name(c.encode_utf8(&mut [0; 4])).is_ok() { c } else { '_' };
    name.chars().map(allowed).collect()
}

/// `take_2026-11-26T091500Z`
fn named_after(time: SystemTime) -> String {
    format!("take_{}", humantime::format_rfc3339_seconds(time)).replace(':', "")
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    fn said(addr: &str, args: &[OscType]) -> Result<(String, String, String, String), String> {
        let take = command(&OscMessage { addr: addr.into(), args: args.to_vec() })?;
        let take = take.ok_or("a button that is let go")?;
        Ok((take.action, take.name, take.note, take.mark))
    }

    fn text(text: &str) -> OscType {
        OscType::String(text.into())
    }

    #[test]
    fn messages_become_commands() {
        let is = |found: Result<_, String>, action: &str, name: &str, note: &str, mark: &str| {
            let wanted = [action, name, note, mark].map(str::to_owned).into();
            assert_eq!(found, Ok(wanted));
        };
        is(said("/take/start", &[text("walk 01")]), "start", "walk_01", "", "");
        is(said("/take/start", &[text("walk"), OscType::Float(2.0)]), "start", "walk_2", "", "");
        is(
            said("/RecordStart", &[text("Scene 1/a"), OscType::Int(7)]),
            "start",
            "Scene_1_a_7",
            "",
            "",
        );
        is(said("/RecordStop", &[]), "stop", "", "", "");
        is(said("/take/stop", &[OscType::Float(1.0)]), "stop", "", "", "");
        is(said("/take/note", &[text("left hand")]), "note", "", "left hand", "");
        is(said("/take/mark", &[text("good")]), "note", "", "", "good");
        is(said("/take/reset", &[]), "reset", "", "", "");
        is(said("/take/reset", &[text("p2")]), "reset", "p2", "", "");
        for wrong in [&[text("")][..], &[text("p2"), text("p3")]] {
            assert!(said("/take/reset", wrong).unwrap_err().contains("one name"));
        }
        for pressed in [OscType::Bool(true), OscType::Float(1.0), OscType::Inf] {
            assert!(said("/take/start", &[pressed]).unwrap().1.starts_with("take_20"));
        }
        for released in [OscType::Bool(false), OscType::Float(0.0), OscType::Int(0)] {
            assert!(said("/take/stop", &[released]).unwrap_err().contains("let go"));
        }
        let named = said("/take/start", &[]).unwrap().1;
        assert!(valid_name(&named).is_ok() && named.starts_with("take_20"), "{named}");
        let time = SystemTime::UNIX_EPOCH + Duration::from_secs(1_795_252_800);
        assert_eq!(named_after(time), "take_2026-11-21T092000Z");
    }

    #[test]
    fn other_messages_are_refused_with_the_reason() {
        for (addr, args, reason) in [
            ("/take/start", vec![text("")], "give a name"),
            ("/take/start", vec![OscType::Blob(vec![1])], "give texts and numbers"),
            ("/take/mark", vec![text("great")], "good or bad"),
            ("/take/note", vec![], "give a text"),
            ("/take/erase", vec![], "is no command"),
            ("/VMC/Ext/OK", vec![OscType::Int(1)], "is no command"),
        ] {
            let found = said(addr, &args).unwrap_err();
            assert!(found.contains(reason), "{addr}: {found}");
        }
    }

    #[test]
    fn answers_go_where_a_client_says() {
        let at = "127.0.0.1:9001".parse().ok();
        assert_eq!(target(&[text("127.0.0.1"), OscType::Int(9001)]), at);
        assert_eq!(target(&[text("127.0.0.1"), text("9001")]), at);
        assert_eq!(target(&[text("127.0.0.1")]), None);
        assert_eq!(target(&[text("127.0.0.1"), OscType::Int(70_000)]), None);
    }
}

//! Sessions announce what they subscribe to, so that others can say who receives what.
//!
//! The name is `mocap/receivers/{program}/{computer}/{session}/{pattern}`, with `+` for `*` and `++` for `**`.

use std::collections::{BTreeMap, BTreeSet};
use std::hash::{BuildHasher, RandomState};

use super::{Bus, BusError, Guard, Receiver, check_topic};

const ROOT: &str = "mocap/receivers";
/// Longest name of a program and of a computer, characters: names of topics have a limit.
const LONGEST: usize = 40;

/// Announces the subscriptions of a session.
pub(super) struct Announcer {
    /// Of the session, with a slash at the end.
    name: String,
}

impl Announcer {
    /// A new session; an empty name stands for the name of the program's file.
    pub(super) fn new(program: &str) -> Self {
        let file = std::env::current_exe().unwrap_or_default();
        let file = file.file_stem().unwrap_or_default().to_string_lossy();
        let program = part(if program.is_empty() { &file } else { program });
        let computer = part(&rustix::system::uname().nodename().to_string_lossy());
        let number = RandomState::new().hash_one(0);
        Self { name: format!("{ROOT}/{program}/{computer}/{}.{number:x}/", std::process::id()) }
    }

    /// Announces a subscription. Its name may be too long, or the bus may not allow it; the subscription does
    /// not depend on it.
    pub(super) fn announce(&self, bus: &dyn Bus, pattern: &str) -> Option<Box<dyn Guard>> {
        let name = format!("{}{}", self.name, parts(pattern, ["*", "**"], ["+", "++"]));
        bus.announce(&name)
            .inspect_err(|error| tracing::warn!("a subscription is not announced: {error}"))
            .ok()
    }

    /// The other sessions that receive any topic below a name.
    pub(super) fn others(&self, bus: &dyn Bus, below: &str) -> Result<Vec<Receiver>, BusError> {
        check_topic(below)?;
        let names = bus.announced(&format!("{ROOT}/**"))?;
        let mut receivers = BTreeMap::new();
        for name in names.iter().filter(|name| !name.starts_with(&self.name)) {
            let parts_of = Vec::from_iter(name.splitn(6, '/'));
            let [_, _, program, computer, session, pattern] = parts_of[..] else { continue };
            let pattern = parts(pattern, ["+", "++"], ["*", "**"]);
            if !reaches_below(&pattern, below) {
                continue;
            }
            let about = [program, computer, session];
            receivers.entry(about).or_insert_with(BTreeSet::new).insert(pattern);
        }
        let receiver = |(about, patterns): ([&str; 3], _)| {
            let [program, computer, session] = about.map(str::to_owned);
            Receiver { program, computer, session, patterns }
        };
        Ok(receivers.into_iter().map(receiver).collect())
    }
}

/// A pattern with some of its parts replaced.
fn parts(pattern: &str, from: [&str; 2], to: [&str; 2]) -> String {
    let replaced = |part| from.iter().position(|one| *one == part).map_or(part, |k| to[k]);
    pattern.split('/').map(replaced).collect::<Vec<_>>().join("/")
}

/// A text as one part of a topic.
fn part(text: &str) -> String {
    let is_reserved = |c: char| c.is_control() || "/*$?#@".contains(c);
    let tame = text.chars().take(LONGEST).map(|c| if is_reserved(c) { '_' } else { c });
    let tame: String = tame.collect();
    if tame.is_empty() { "unknown".to_owned() } else { tame }
}

/// Whether a pattern matches any topic below a name.
fn reaches_below(pattern: &str, name: &str) -> bool {
    let mut parts = pattern.split('/');
    for wanted in name.split('/') {
        match parts.next() {
            Some("**") => return true,
            Some(part) if part == "*" || part == wanted => {}
            _ => return false,
        }
    }
    parts.next().is_some()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::io::bus::Memory;

    #[test]
    fn a_pattern_reaches_below_a_name() {
        for pattern in ["**", "a/**", "a/b/**", "a/*/c", "a/b/*/d", "*/**"] {
            assert!(reaches_below(pattern, "a/b"), "{pattern}");
        }
        for pattern in ["a/b", "a/*", "b/**", "a/c/d", "*"] {
            assert!(!reaches_below(pattern, "a/b"), "{pattern}");
        }
    }

    #[test]
    fn others_are_seen_with_their_patterns_and_strange_names_are_tamed() {
        let bus = Memory::new();
        let (own, other) = (Announcer::new(""), Announcer::new("@a/b*\n"));
        let patterns =
            ["mocap/s/actor/*/pose", "mocap/**", "mocap/s/actor/a+b/pose", "mocap/s/rig"];
        let announce =
            |one: &Announcer| patterns.map(|pattern| one.announce(&bus, pattern).unwrap());
        let _guards = [&own, &other].map(announce);
        let _foreign = bus.announce("mocap/receivers/not/ours").unwrap();
        let receivers = own.others(&bus, "mocap/s/actor").unwrap();
        let [Receiver { program, computer, session, patterns: found }] = &receivers[..] else {
            panic!("{receivers:?}")
        };
        assert_eq!(program, "_a_b__");
        assert!(!computer.is_empty() && session.starts_with(&std::process::id().to_string()));
        let wanted = ["mocap/**", "mocap/s/actor/*/pose", "mocap/s/actor/a+b/pose"];
        assert!(found.iter().eq(wanted), "{found:?}");
        assert!(own.announce(&bus, &"a".repeat(200)).is_none(), "too long");
        assert!(own.others(&bus, "mocap/*").is_err());
        assert_eq!(part(""), "unknown");
    }
}

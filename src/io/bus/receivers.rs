//! Who receives what: sessions announce their subscriptions.
//!
//! The name is `receivers/{program}/{computer}/{process}.{session}/{pattern}`, with `+` in place of `*`. Programs of
//! others may announce theirs so too.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::atomic::{AtomicU32, Ordering};

use serde::Serialize;

use super::{Bus, BusError, Guard, check_topic};

const ROOT: &str = "receivers";
/// Sessions of this process so far.
static SESSIONS: AtomicU32 = AtomicU32::new(0);

/// A session that subscribes to topics.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Receiver {
    /// What the program calls itself, such as `bundlemocap record`.
    pub program: String,
    /// The name of its computer.
    pub computer: String,
    /// The number of its process, a dot, and the number of its session.
    pub session: String,
    /// The patterns that it subscribes to.
    pub patterns: BTreeSet<String>,
}

/// A session, as it announces itself.
pub(super) struct Session {
    /// `receivers/{program}/{computer}/{process}.{session}`
    name: String,
}

impl Session {
    /// A new session; an empty name stands for the name of the program's file.
    pub(super) fn new(program: &str) -> Self {
        let file = std::env::current_exe().unwrap_or_default();
        let file = file.file_stem().unwrap_or_default().to_string_lossy();
        let program = part(if program.is_empty() { &file } else { program });
        let computer = part(&rustix::system::uname().nodename().to_string_lossy());
        let process = std::process::id();
        let session = SESSIONS.fetch_add(1, Ordering::Relaxed);
        Self { name: format!("{ROOT}/{program}/{computer}/{process}.{session}") }
    }

    /// Announces a subscription. A bus may refuse it, for its name is too long or its rules forbid it; the
    /// subscription does not depend on it.
    pub(super) fn announce(&self, bus: &dyn Bus, pattern: &str) -> Option<Box<dyn Guard>> {
        let name = format!("{}/{}", self.name, pattern.replace('*', "+"));
        bus.announce(&name)
            .inspect_err(|error| tracing::debug!("a subscription is not announced: {error}"))
            .ok()
    }

    /// The other sessions that receive any topic below a name.
    pub(super) fn others(&self, bus: &dyn Bus, below: &str) -> Result<Vec<Receiver>, BusError> {
        check_topic(below)?;
        let mut receivers = BTreeMap::<String, Receiver>::new();
        for name in bus.announced(&format!("{ROOT}/**"))? {
            let parts: Vec<&str> = name.splitn(5, '/').collect();
            let [_, program, computer, session, pattern] = parts[..] else { continue };
            let session_name = &name[..name.len() - pattern.len() - 1];
            let pattern = pattern.replace('+', "*");
            if session_name == self.name || !reaches_below(&pattern, below) {
                continue;
            }
            let receiver = receivers.entry(session_name.to_owned()).or_insert_with(|| Receiver {
                program: program.into(),
                computer: computer.into(),
                session: session.into(),
                patterns: BTreeSet::new(),
            });
            receiver.patterns.insert(pattern);
        }
        Ok(receivers.into_values().collect())
    }
}

/// A text as one part of a topic.
fn part(text: &str) -> String {
    let is_reserved = |c: char| c.is_control() || "/*$?#+".contains(c);
    text.chars().skip_while(|c| *c == '@').map(|c| if is_reserved(c) { '_' } else { c }).collect()
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
        let (own, other) = (Session::new(""), Session::new("@a/b*+\n"));
        let patterns = ["mocap/s/actor/*/pose", "mocap/**", "mocap/s/rig"];
        let _guards: Vec<_> =
            [&own, &other].iter().flat_map(|one| patterns.map(|p| one.announce(&bus, p))).collect();
        let _foreign = bus.announce("receivers/not/ours").unwrap();
        let receivers = own.others(&bus, "mocap/s/actor").unwrap();
        let [Receiver { program, patterns: found, .. }] = &receivers[..] else {
            panic!("{receivers:?}")
        };
        assert_eq!(program, "a_b___");
        assert!(found.iter().eq(["mocap/**", "mocap/s/actor/*/pose"]), "{found:?}");
        assert!(own.announce(&bus, &"a".repeat(200)).is_none(), "too long");
        assert!(own.others(&bus, "mocap/*").is_err());
    }
}

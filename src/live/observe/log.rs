//! Logs one line per event to standard error. It never blocks and limits the rate of lines.

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::io::{self, Write};
use std::time::Duration;

use crossbeam_channel::{Receiver, Sender, bounded};
use tracing_subscriber::filter::{EnvFilter, ParseError};
use tracing_subscriber::fmt::MakeWriter;

use super::advice::{advice, goes_on, is_fine};
use crate::core::time::{Nanos, Timestamp};
use crate::io::wire::Event;
use crate::live::error::NodeError;

/// Environment variable with the log filter, such as `debug` or `warn,zenoh=info`.
pub const VARIABLE: &str = "BUNDLEMOCAP_LOG";

/// Most lines per second, kind and camera of what happens once; the rest are counted.
const LINES_A_SECOND: u32 = 3;
/// Longest time between two lines on what goes on.
const LONGEST: Nanos = Nanos::from_ms(60_000);
/// What went on is over after this time without it.
const OVER: Nanos = Nanos::from_ms(10_000);
/// Most cameras and performers that are named in a line.
const MOST_NAMES: usize = 4;
/// Most pairs of kind and camera that are counted separately in a second.
const MOST_KEYS: usize = 256;
/// Most lines that wait for standard error.
const MOST_WAITING: usize = 1024;
/// Longest wait for standard error at the end.
const PATIENCE: Duration = Duration::from_secs(1);

/// Flushes the waiting lines when it is dropped.
pub struct LogGuard(Lines);

/// Starts logging to standard error with the filter in [`VARIABLE`], by default `info`; the
/// transports log from `warn` up.
///
/// # Errors
/// The text in [`VARIABLE`] is not a filter, or a thread cannot be started.
pub fn start() -> Result<LogGuard, NodeError> {
    let asked = std::env::var(VARIABLE).unwrap_or_default();
    let filter = filter(&asked).map_err(|error| NodeError::Log {
        variable: VARIABLE,
        value: asked.clone(),
        reason: error.to_string(),
    })?;
    let lines = Lines::new(io::stderr()).map_err(NodeError::Thread)?;
    let colour = io::IsTerminal::is_terminal(&io::stderr());
    let subscriber = tracing_subscriber::fmt().compact().with_env_filter(filter);
    // A second start in one process keeps the first logger.
    let _ = subscriber.with_target(false).with_ansi(colour).with_writer(lines.clone()).try_init();
    Ok(LogGuard(lines))
}

fn filter(asked: &str) -> Result<EnvFilter, ParseError> {
    let asked = if asked.trim().is_empty() { "info" } else { asked };
    // These lines of zenoh do not help anybody: each attempt to connect, states that newer ones have replaced during an
    // outage, and `Unknown id` if a program ends that was not allowed to declare something.
    let of_zenoh = match asked.contains("zenoh") {
        true => "",
        false => {
            "zenoh::net::runtime::orchestrator=error,zenoh::net::routing::hat=off,zenoh_ext=error,"
        }
    };
    EnvFilter::try_new(format!("zenoh=warn,{of_zenoh}iceoryx2=warn,foxglove=warn,{asked}"))
}

impl Drop for LogGuard {
    fn drop(&mut self) {
        self.0.flush_within(PATIENCE);
    }
}

/// Passes lines to a slow writer without blocking: lines beyond [`MOST_WAITING`] are lost.
#[derive(Clone)]
struct Lines(Sender<Line>);

enum Line {
    Text(Vec<u8>),
    /// Asks for an answer when all earlier lines are written.
    Mark(Sender<()>),
}

impl Lines {
    fn new(out: impl Write + Send + 'static) -> io::Result<Self> {
        let (sender, receiver) = bounded(MOST_WAITING);
        let work = move || write_all(&receiver, out);
        std::thread::Builder::new().name("log".into()).spawn(work)?;
        Ok(Self(sender))
    }

    fn flush_within(&self, time: Duration) {
        let (done, written) = bounded(1);
        if self.0.send_timeout(Line::Mark(done), time).is_ok() {
            let _ = written.recv_timeout(time);
        }
    }
}

fn write_all(lines: &Receiver<Line>, mut out: impl Write) {
    for line in lines {
        match line {
            Line::Text(text) => drop(out.write_all(&text)),
            Line::Mark(done) => {
                let _ = out.flush();
                let _ = done.try_send(());
            }
        }
    }
}

impl Write for Lines {
    fn write(&mut self, text: &[u8]) -> io::Result<usize> {
        let _ = self.0.try_send(Line::Text(text.into()));
        Ok(text.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

impl<'a> MakeWriter<'a> for Lines {
    type Writer = Self;

    fn make_writer(&'a self) -> Self {
        self.clone()
    }
}

/// Logs the node's events. What happens once has a line of its own. What goes on, such as late
/// frames, shares one line a second, with what to do; while nothing changes, that line comes after 1, 2,
/// 4 and at most 60 s.
#[derive(Default)]
pub struct EventLog {
    limiter: Limiter,
    going: BTreeMap<String, Going>,
    /// Kinds in the last such line, when it was written, and the wait for the next.
    said: Vec<String>,
    last: Option<Timestamp>,
    wait: Nanos,
}

/// Events of one kind since the last line.
#[derive(Default)]
struct Going {
    count: u64,
    /// Cameras and performers.
    names: BTreeSet<String>,
    /// What the first of them says.
    detail: String,
}

impl EventLog {
    /// Logs an event, or counts it. `actor` is the performer, if there are several.
    pub fn tell(&mut self, now: Timestamp, event: &Event, actor: Option<&str>) {
        let camera = event.camera.as_deref();
        if goes_on(&event.kind) {
            let going = self.going.entry(event.kind.clone()).or_default();
            if going.count == 0 {
                going.detail = one_line(&event.detail);
            }
            going.count = going.count.saturating_add(event.count);
            let more = camera.or(actor).filter(|_| going.names.len() <= MOST_NAMES);
            going.names.extend(more.map(one_line));
        } else if self.limiter.admits(now, &event.kind, camera.or(actor), event.count) {
            let is_fine = is_fine(&event.kind, &event.detail);
            line(is_fine, actor, camera, event.window, &text(event));
        }
        self.end_seconds(now);
    }

    /// Logs what goes on, and a summary of the withheld lines at the end of their second.
    pub fn end_seconds(&mut self, now: Timestamp) {
        for (kind, camera, count) in self.limiter.withheld(now) {
            let of = camera.map_or(String::new(), |name| format!(" of {name}"));
            let text = format!("and {count} more {}{of} in the last second", spoken(&kind));
            line(is_fine(&kind, ""), None, None, None, &text);
        }
        if let Some(text) = self.going(now) {
            tracing::warn!("{text}");
        }
    }

    /// The line on what goes on, if it is time for one.
    fn going(&mut self, now: Timestamp) -> Option<String> {
        let since = self.last.map(|last| now - last);
        if self.going.is_empty() {
            if since.is_some_and(|since| since > self.wait + OVER) {
                (self.last, self.wait) = (None, Nanos::ZERO);
                self.said.clear();
            }
            return None;
        }
        let is_new = self.going.keys().any(|kind| !self.said.contains(kind));
        let wait = if is_new { Nanos::SECOND.min(self.wait) } else { self.wait };
        if since.is_some_and(|since| since < wait) {
            return None;
        }
        self.wait = if is_new { Nanos::SECOND } else { (self.wait * 2).min(LONGEST) };
        self.last = Some(now);
        let going = std::mem::take(&mut self.going);
        self.said = going.keys().cloned().collect();
        let most = going.iter().max_by_key(|(_, going)| going.count);
        let advice = most.map(|(kind, going)| advice(kind).unwrap_or(&going.detail));
        let advice = advice.unwrap_or_default();
        let kinds = going.iter().map(|(kind, Going { count, names, .. })| {
            let named: Vec<&str> = names.iter().take(MOST_NAMES).map(String::as_str).collect();
            let more = if names.len() > MOST_NAMES { " ..." } else { "" };
            match named.is_empty() {
                true => format!("{count} {}", spoken(kind)),
                false => format!("{count} {} ({}{more})", spoken(kind), named.join(" ")),
            }
        });
        Some(format!("{}: {advice}", kinds.collect::<Vec<_>>().join(", ")))
    }
}

/// `late (3 times): detail`.
fn text(event: &Event) -> String {
    let mut text = spoken(&event.kind);
    if event.count > 1 {
        text += &format!(" ({} times)", event.count);
    }
    if !event.detail.is_empty() {
        text += &format!(": {}", event.detail);
    }
    one_line(&text)
}

/// Replaces control characters; names from outside may hold them.
fn one_line(text: &str) -> String {
    let plain = |c: char| if c.is_control() { '\u{fffd}' } else { c };
    text.chars().map(plain).collect()
}

fn spoken(kind: &str) -> String {
    kind.replace('_', " ")
}

/// What belongs to a good run is logged as information, all else as a warning.
fn line(is_fine: bool, actor: Option<&str>, camera: Option<&str>, window: Option<u64>, text: &str) {
    if is_fine {
        tracing::info!(actor, camera, window, "{text}");
    } else {
        tracing::warn!(actor, camera, window, "{text}");
    }
}

/// A kind, a camera, and the number of withheld lines.
type Withheld = (String, Option<String>, u64);

/// Counts lines by kind and camera in each second.
#[derive(Default)]
struct Limiter {
    seen: HashMap<(String, Option<String>), Seen>,
    ends: Timestamp,
}

#[derive(Default)]
struct Seen {
    lines: u32,
    withheld: u64,
}

impl Limiter {
    /// Whether an event that stands for `count` events may be logged; otherwise it is counted.
    fn admits(&mut self, now: Timestamp, kind: &str, camera: Option<&str>, count: u64) -> bool {
        if self.seen.is_empty() {
            self.ends = now + Nanos::SECOND;
        }
        let mut key = (kind.to_owned(), camera.map(str::to_owned));
        if self.seen.len() >= MOST_KEYS && !self.seen.contains_key(&key) {
            key = ("other".to_owned(), None);
        }
        let seen = self.seen.entry(key).or_default();
        seen.lines += 1;
        let admitted = seen.lines <= LINES_A_SECOND;
        seen.withheld += if admitted { 0 } else { count };
        admitted
    }

    /// Withheld lines of a past second, by kind, then camera.
    fn withheld(&mut self, now: Timestamp) -> Vec<Withheld> {
        if self.seen.is_empty() || now < self.ends {
            return Vec::new();
        }
        let seen = self.seen.drain().filter(|(_, seen)| seen.withheld > 0);
        let mut all: Vec<Withheld> =
            seen.map(|((kind, camera), seen)| (kind, camera, seen.withheld)).collect();
        all.sort();
        all
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ms(ms: i64) -> Timestamp {
        Timestamp::from_ns(ms * 1_000_000)
    }

    #[test]
    fn what_goes_on_is_one_line_a_second_and_then_fewer() {
        let mut log = EventLog::default();
        let mut lines = Vec::new();
        let mut event = |log: &mut EventLog, at: i64, kind: &str, camera: &str| {
            let camera = Some(camera.to_owned());
            let event = Event { kind: kind.into(), camera, count: 1, ..Event::default() };
            let going = log.going.entry(event.kind.clone()).or_default();
            going.count += 1;
            going.names.extend(event.camera);
            lines.extend(log.going(ms(at)).map(|line| (at, line)));
        };
        for at in (0..20_000).step_by(10) {
            event(&mut log, at, "late", if at % 20 == 0 { "a" } else { "b" });
            if at >= 17_500 {
                event(&mut log, at, "missing", "c");
            }
        }
        let times: Vec<i64> = lines.iter().map(|(at, _)| *at).collect();
        assert_eq!(times, [0, 1000, 3000, 7000, 15_000, 17_500, 18_500], "{lines:?}");
        assert!(lines[1].1.starts_with("100 late (a b): frames come after"), "{}", lines[1].1);
        assert!(lines[6].1.contains("99 missing (c)"), "{}", lines[6].1);
        assert!(log.going(ms(60_000)).is_some(), "the rest");
        assert!(log.going(ms(90_000)).is_none() && log.last.is_none(), "it is over");
    }

    #[test]
    fn unusable_messages_of_many_cameras_share_a_line() {
        let mut log = EventLog::default();
        for camera in 0..300 {
            let (kind, camera) = ("unusable".to_owned(), Some(camera.to_string()));
            let detail = format!("no calibration, {}", camera.as_deref().unwrap_or_default());
            log.tell(ms(0), &Event { kind, camera, detail, count: 1, ..Event::default() }, None);
        }
        assert!(log.limiter.seen.is_empty());
        let line = log.going(ms(1000)).unwrap();
        assert!(line.starts_with("299 unusable (1 2 3 4 ...): no calibration, 1"), "{line}");
    }

    #[test]
    fn a_flood_is_few_lines_and_a_summary_each_second() {
        let mut limiter = Limiter::default();
        let admitted = (0..100).filter(|i| limiter.admits(ms(i * 5), "late", Some("a"), 2)).count();
        assert_eq!(admitted, LINES_A_SECOND as usize);
        assert!(limiter.admits(ms(500), "late", Some("b"), 1), "another camera");
        assert!(limiter.admits(ms(500), "missing", Some("a"), 1), "another kind");
        assert!(limiter.withheld(ms(999)).is_empty());
        let late = |camera: &str, n| ("late".to_owned(), Some(camera.to_owned()), n);
        assert_eq!(limiter.withheld(ms(1000)), [late("a", 194)]);
        assert!(limiter.withheld(ms(5000)).is_empty());
        assert!(limiter.admits(ms(5000), "late", Some("a"), 1), "a new second");
    }

    #[test]
    fn invented_names_do_not_fill_the_memory() {
        let mut limiter = Limiter::default();
        let admitted = (0..10_000)
            .filter(|i| limiter.admits(ms(0), "unusable", Some(&i.to_string()), 1))
            .count();
        let lines = MOST_KEYS + LINES_A_SECOND as usize;
        assert_eq!(admitted, lines);
        assert!(limiter.seen.len() <= MOST_KEYS + 1);
        let rest = limiter.withheld(ms(1000));
        assert_eq!(rest, [("other".to_owned(), None, (10_000 - lines) as u64)]);
    }

    #[test]
    fn an_event_is_one_line() {
        let event = Event { kind: "out_of_order".into(), count: 3, ..Event::default() };
        assert_eq!(text(&event), "out of order (3 times)");
        let event = Event { kind: "late".into(), count: 1, detail: "5 ms".into(), ..event };
        assert_eq!(text(&event), "late: 5 ms");
        let event = Event { detail: "camera \"a\nb\u{1b}[31m\"".into(), ..event };
        assert_eq!(text(&event), "late: camera \"a\u{fffd}b\u{fffd}[31m\"");
    }

    #[test]
    fn filters_are_checked() {
        for good in ["", "debug", "warn,zenoh=info", "off"] {
            assert!(filter(good).is_ok(), "{good:?}");
        }
        assert!(filter("bundlemocap=loud").is_err());
    }

    #[test]
    fn a_writer_that_is_stuck_is_not_waited_for() {
        /// Waits for a signal before each line, then passes it on.
        struct Stuck(Receiver<()>, Sender<Vec<u8>>);
        impl Write for Stuck {
            fn write(&mut self, text: &[u8]) -> io::Result<usize> {
                let _ = self.0.recv();
                let _ = self.1.send(text.into());
                Ok(text.len())
            }
            fn flush(&mut self) -> io::Result<()> {
                Ok(())
            }
        }
        let (go, word) = bounded(0);
        let (out, written) = crossbeam_channel::unbounded();
        let mut lines = Lines::new(Stuck(word, out)).unwrap();
        for i in 0..3 * MOST_WAITING {
            lines.write_all(format!("{i}\n").as_bytes()).unwrap();
        }
        drop(go);
        lines.flush_within(Duration::from_secs(60));
        let count = written.try_iter().count();
        assert!((MOST_WAITING..=MOST_WAITING + 1).contains(&count), "{count}");
    }
}

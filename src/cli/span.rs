//! The part of a recording that is used: `--start` and `--end`.

use std::path::{Path, PathBuf};

use clap::Args;

use super::failure::{Exit, Failure};
use crate::config::{Config, TimecodeConfig};
use crate::core::time::{Nanos, Timestamp};
use crate::io::recording::{RawEntry, Reader, TAKE};
use crate::io::timecode::House;
use crate::io::wire::journal_entry::Input;
use crate::io::wire::{Journal, KeypointFrame, Pose, Schema, decode};
use crate::io::with_ending;
use crate::offline::output::text;

/// A node's settings are searched in this much of a live recording.
const SEARCHED: Nanos = Nanos::from_ms(5000);

/// The part of a recording that is used.
#[derive(Debug, Args)]
pub(super) struct SpanArguments {
    /// Begin here: seconds since the recording's first frame, frames such as 240f (`export` and `retarget`), or a
    /// timecode such as 01:00:00:00, with [timecode] in the settings or in those of the recording.
    #[arg(long, value_name = "TIME", allow_negative_numbers = true)]
    start: Option<String>,
    /// End here, inclusive; as --start.
    #[arg(long, value_name = "TIME", allow_negative_numbers = true)]
    end: Option<String>,
}

impl SpanArguments {
    /// Whether one of them is given.
    pub(super) fn is_given(&self) -> bool {
        self.start.is_some() || self.end.is_some()
    }

    /// The capture time of --start, if it is given and valid, without the frames before it that have the same timecode.
    pub(super) fn first(&self, of: &Times) -> Option<Timestamp> {
        self.start.as_ref().and_then(|text| of.time(text).ok())
    }

    /// First and last capture time in the recording, if one of them is given. With a timecode, all frames that have it
    /// are in, also those a little before it.
    pub(super) fn within(&self, of: &Times) -> Result<Option<[Timestamp; 2]>, Failure> {
        if self.start.is_none() && self.end.is_none() {
            return Ok(None);
        }
        let half = |text: &String| match &of.house {
            Some(house) if text.contains(':') => house.half_frames(),
            _ => [Nanos::ZERO; 2],
        };
        let at = |option: &str, text: &Option<String>, default: i64| match text {
            Some(text) => match of.time(text) {
                Ok(time) => Ok((time, half(text))),
                Err(reason) => Err(Failure::new(Exit::Usage, format!("{option} {text}: {reason}"))),
            },
            None => Ok((Timestamp::from_ns(default), [Nanos::ZERO; 2])),
        };
        let (start, [before, _]) = at("--start", &self.start, i64::MIN)?;
        let (end, [_, after]) = at("--end", &self.end, i64::MAX)?;
        let (start, end) = (start - before, end + after);
        if start > end {
            return Err(Failure::new(Exit::Usage, "--end is before --start"));
        }
        Ok(Some([start, end]))
    }
}

/// The times of a recording.
pub(super) struct Times {
    /// Capture time of the first frame of the take.
    pub(super) first: Timestamp,
    /// Frames per second, where frames can be counted.
    pub(super) rate: Option<f64>,
    /// The timecode of the settings, or else of those of the recording or its node.
    pub(super) house: Option<House>,
    /// The settings of that timecode.
    pub(super) timecode: TimecodeConfig,
}

impl Times {
    pub(super) fn of(path: &Path, config: Option<&Config>) -> Result<Self, Failure> {
        let mut reader = Reader::open(path)?;
        let theirs = reader.own_metadata("config");
        let theirs = theirs.and_then(|toml| Config::parse_partial(toml, path).ok());
        let of = |config: &Config| config.timecode.clone();
        let given = config.map(of).filter(|timecode| timecode.house().is_ok_and(|h| h.is_some()));
        let mut timecode = given.or_else(|| theirs.as_ref().map(of)).unwrap_or_default();
        // The first pose of a solve may be later than the first frame.
        let start = reader.metadata().get(TAKE).and_then(|take| take.get("first_capture_time_ns"));
        let start = start.and_then(|ns| Some(Timestamp::from_ns(ns.parse().ok()?)));
        let mut first = None::<RawEntry>;
        let mut house = timecode.house()?;
        while let Some(entry) = reader.next_raw().transpose()? {
            let is_late = |first: &RawEntry| entry.log_time - first.log_time > SEARCHED;
            if first.as_ref().is_some_and(|first| house.is_some() || is_late(first)) {
                break;
            }
            match &*entry.schema {
                KeypointFrame::FULL_NAME | Pose::FULL_NAME => first = first.or(Some(entry)),
                Journal::FULL_NAME if house.is_none() => {
                    timecode = of_node(&entry.payload).unwrap_or_default();
                    house = timecode.house()?;
                }
                _ => {}
            }
        }
        let first = start.or_else(|| first.as_ref().and_then(captured)).unwrap_or_default();
        Ok(Self { first, rate: None, house, timecode })
    }

    /// The capture time of a number of seconds or frames since the first frame, or of a timecode.
    fn time(&self, text: &str) -> Result<Timestamp, String> {
        if text.contains(':') {
            let house = self.house.ok_or(
                "no timecode is known; give seconds, or [timecode] in the --config of `play` or `solve`",
            )?;
            return house.capture(text, self.first).map_err(|error| error.to_string());
        }
        let (number, unit) = match text.strip_suffix('f') {
            Some(frames) => {
                let rate = self.rate.ok_or(
                    "give seconds or a timecode; only `export` and `retarget` count frames",
                )?;
                (frames.parse::<u32>().map(f64::from).ok(), 1.0 / rate)
            }
            None => (text.parse::<f64>().ok(), 1.0),
        };
        match number.map(|number| number * unit) {
            Some(seconds) if (0.0..1e9).contains(&seconds) => {
                Ok(self.first + Nanos::rounded((seconds * 1e9).round()))
            }
            _ => {
                let frames = if self.rate.is_some() { " frames such as 120f," } else { "" };
                Err(format!(
                    "give seconds since the first frame,{frames} or a timecode such as 01:00:00:00"
                ))
            }
        }
    }

    /// Writes the timecode of the first frame of a file beside it, if its format has no place for it.
    pub(super) fn beside(&self, file: &Path, first: Option<Timestamp>) -> Result<(), Failure> {
        match (self.sidecar(file), self.timecode_at(first)) {
            (Some(path), Some(line)) => Ok(text(&path, &(line + "\n"))?),
            _ => Ok(()),
        }
    }

    /// The file beside another that has its timecode, if there is one: `take1.timecode.txt` of take1.bvh,
    /// `take1.trc.timecode.txt` of take1.trc.
    pub(super) fn sidecar(&self, file: &Path) -> Option<PathBuf> {
        let is_bvh = file.extension().is_some_and(|ending| ending.eq_ignore_ascii_case("bvh"));
        let stem = if is_bvh { file.with_extension("") } else { file.to_owned() };
        self.house.map(|_| with_ending(&stem, ".timecode.txt"))
    }

    /// Timecode and rate of a frame, or else of the first one, if there is a timecode.
    pub(super) fn timecode_at(&self, frame: Option<Timestamp>) -> Option<String> {
        let house = self.house?;
        let label = house.label(frame.map_or(self.first, |at| at.max(self.first)));
        Some(format!("{label} {}", house.rate()))
    }
}

/// The capture time of a frame or a pose: MCAP's own times cannot be before the epoch.
fn captured(entry: &RawEntry) -> Option<Timestamp> {
    let ns = match &*entry.schema {
        KeypointFrame::FULL_NAME => decode::<KeypointFrame>(&entry.payload).ok()?.capture_time_ns,
        _ => decode::<Pose>(&entry.payload).ok()?.capture_time_ns,
    };
    Some(Timestamp::from_ns(ns))
}

/// The timecode of the node whose journal begins with that part.
fn of_node(part: &[u8]) -> Option<TimecodeConfig> {
    let start = match decode::<Journal>(part).ok()?.entries.into_iter().next()?.input? {
        Input::Start(start) => start,
        _ => return None,
    };
    Some(Config::parse(&start.config, Path::new("the journal")).ok()?.timecode)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_are_seconds_or_timecodes() {
        let first = Timestamp::from_ns(1_795_252_800_000_000_000);
        let house = House::new("25", "10:00:00:00 at 1795252790.0").ok();
        let (rate, timecode) = (Some(50.0), TimecodeConfig::default());
        let times = Times { first, rate, house, timecode };
        let after = |text: &str| times.time(text).map(|at| (at - first).ns());
        assert_eq!(after("1.5"), Ok(1_500_000_000));
        assert_eq!(after("10:00:11:05"), Ok(1_200_000_000));
        assert_eq!(after("75f"), after("1.5"));
        assert!(after("10:00:00:25").is_err() && after("-1").is_err() && after("x").is_err());
        assert!(after("1.5f").is_err());
        assert!(
            Times { house: None, rate: None, ..times }
                .time("10:00:00:00")
                .unwrap_err()
                .contains("[timecode]")
        );
    }
}

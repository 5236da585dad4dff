//! Exit codes, errors in one line, and JSON.

use std::path::Path;

use clap::ValueEnum;
use serde::Serialize;

use super::terminal::complain;
use crate::cli::tools::take::TakeError;
use crate::config::ConfigError;
use crate::core::camera::CameraError;
use crate::core::manifold::WeightsError;
use crate::io::bus::BusError;
use crate::io::formats::{ExportError, TrajectoryError};
use crate::io::recording::RecordError;
use crate::io::timecode::TimecodeError;
use crate::offline;

/// Exit codes. The numbers are part of the interface: their meaning never changes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub(crate) enum Exit {
    Done = 0,
    /// Not caused by the input, such as a full disk.
    Unexpected = 1,
    /// Wrong arguments; clap uses the same number.
    Usage = 2,
    Unreadable = 3,
    Malformed = 4,
    NobodyFound = 5,
    InPart = 6,
    NoDetections = 7,
    CameraMismatch = 8,
    BadCalibration = 9,
    KeypointFormat = 10,
    Weights = 11,
    NotOurs = 12,
    Bus = 13,
    Differs = 14,
    Suspicious = 15,
    SecondNode = 16,
    NotReady = 17,
}

/// The codes as shown in `--help`.
pub(crate) const EXIT_CODES: &str = "\
Exit codes:
   0  done
   1  unexpected: the output cannot be written, `solve` was stopped, or a bug
   2  wrong arguments
   3  an input is missing or cannot be read
   4  malformed input
   5  nobody found: no performer in two cameras
   6  partly done: windows that fit badly; a damaged recording; a replay up to lost inputs or a
      restart; a failed take among several of `solve`, `summary` or `check`; a take that `body` left
      out; a camera that `calibrate` left out; `record` lost or got no messages, or the disk is full;
      `play` lost its connection; a node or recorder did not answer `take`, or refused; no poses came
      for `retarget --out` or `bridge vmc`, or `retarget` could not write a file; `decode` left out
      windows without their previous keyframe
   7  no detections in the folder
   8  a camera without calibration, or the reverse
   9  unusable calibration
  10  unknown keypoint format, or not the format of the data
  11  weights of another shape or version
  12  a recording without the required topics
  13  the bus cannot be opened or reached, or nobody answered `take`
  14  the replay differs from the recording
  15  `check --strict` or `body --strict` found something wrong
  16  another node publishes this performer
  17  `doctor` found something wrong";

/// The value of `--fps`, a number or a ratio such as `60000/1001`.
pub(crate) fn ratio(text: &str) -> Result<f64, String> {
    let number = |text: &str| text.trim().parse::<f64>().map_err(|error| error.to_string());
    match text.split_once('/') {
        Some((above, below)) => Ok(number(above)? / number(below)?),
        None => number(text),
    }
}

/// The value of an option, if it is in range.
pub(crate) fn within(option: &str, value: f64, low: f64, high: f64) -> Result<f64, Failure> {
    if (low..=high).contains(&value) {
        return Ok(value);
    }
    let message = format!("{option} is {value}, but must be {low} to {high}");
    Err(Failure::new(Exit::Usage, message))
}

/// The value of `--fps`, if it is a valid frame rate.
pub(crate) fn frame_rate_option(fps: f64) -> Result<f64, Failure> {
    let with_example = |wrong: Failure| Failure::new(wrong.exit, wrong.message + ", such as 60");
    within("--fps", fps, 1.0, 1000.0).map_err(with_example)
}

/// The name of a value on the command line.
pub(crate) fn value_name(value: impl ValueEnum) -> String {
    value.to_possible_value().map_or_else(String::new, |value| value.get_name().to_owned())
}

/// The exit code after a file was read. Warns if something was lost: then the file was read in part.
pub(super) fn done_or_in_part(file: &Path, losses: &[String]) -> Exit {
    if losses.is_empty() {
        return Exit::Done;
    }
    complain("warning", &format!("{}: {}", file.display(), losses.join("; ")));
    Exit::InPart
}

/// JSON for people and programs.
pub(crate) fn json(value: &impl Serialize) -> Result<String, Failure> {
    let text = serde_json::to_string_pretty(value);
    text.map_err(|error| Failure::new(Exit::Unexpected, error.to_string()))
}

/// Why a command failed.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Failure {
    pub(crate) exit: Exit,
    pub(crate) message: String,
}

impl Failure {
    pub(crate) fn new(exit: Exit, message: impl Into<String>) -> Self {
        Self { exit, message: message.into() }
    }

    /// Unusable weights.
    pub(crate) fn weights(path: &Path, source: &WeightsError) -> Self {
        Self::new(Exit::Weights, format!("{}: {source}", path.display()))
    }

    /// The message as one line.
    pub(crate) fn line(&self) -> String {
        self.message
            .split('\n')
            .map(str::trim)
            .filter(|s| !s.is_empty())
            .collect::<Vec<_>>()
            .join(" ")
    }
}

impl From<RecordError> for Failure {
    fn from(error: RecordError) -> Self {
        let exit = match &error {
            RecordError::Read { path, .. } if path.is_dir() => {
                let text =
                    format!("{0} is a folder; give recordings, such as {0}/*.mcap", path.display());
                return Self::new(Exit::Unreadable, text);
            }
            RecordError::Read { .. } => Exit::Unreadable,
            RecordError::NotMcap { .. } => Exit::Malformed,
            RecordError::NoChannels { .. }
            | RecordError::NoBody { .. }
            | RecordError::NoLengths { .. } => Exit::NotOurs,
            RecordError::NoBodyOf { .. }
            | RecordError::NoName { .. }
            | RecordError::ManyBodies { .. }
            | RecordError::SeveralBodies { .. } => Exit::Usage,
            RecordError::Write { .. }
            | RecordError::LeftOver { .. }
            | RecordError::TooManyTopics { .. } => Exit::Unexpected,
        };
        let fix =
            if exit == Exit::Unreadable { "; check the path and its permissions" } else { "" };
        Self::new(exit, format!("{error}{fix}"))
    }
}

/// The exit code of each kind of error.
macro_rules! failures {
    ($($Error:ty { $($pattern:pat => $exit:ident,)+ })+) => {
        $(impl From<$Error> for $crate::cli::failure::Failure {
            fn from(error: $Error) -> Self {
                let exit = match &error {
                    $($pattern => $crate::cli::failure::Exit::$exit,)+
                };
                Self::new(exit, error.to_string())
            }
        })+
    };
}
pub(super) use failures;

failures! {
    BusError {
        BusError::Name { .. } => Usage,
        BusError::Setting { .. } => Malformed,
        _ => Bus,
    }
    TimecodeError {
        _ => Usage,
    }
    ConfigError {
        ConfigError::Unreadable { .. } => Unreadable,
        ConfigError::Malformed { .. }
        | ConfigError::OutOfRange { .. }
        | ConfigError::Timecode { .. }
        | ConfigError::Together { .. }
        | ConfigError::Name { .. } => Malformed,
    }
    CameraError {
        _ => BadCalibration,
    }
    ExportError {
        _ => Unexpected,
    }
}

impl From<offline::Error> for Failure {
    fn from(error: offline::Error) -> Self {
        use offline::Error as E;
        let exit = match error {
            E::Recording(error) => return error.into(),
            E::Export(error) => return error.into(),
            E::NoKeypoints { .. } | E::NoRig { .. } => Exit::NotOurs,
            E::EmptySpan { .. } | E::FewCameras { .. } => Exit::Usage,
            E::KeypointFormat { .. } => Exit::KeypointFormat,
            E::BadRig { .. } | E::ImageSize { .. } | E::Rig { .. } => Exit::BadCalibration,
            E::Uncalibrated { .. } | E::NoSuchCamera { .. } | E::SilentCamera { .. } => {
                Exit::CameraMismatch
            }
            E::TimeUnit { .. } => Exit::Malformed,
            E::NobodyFound { .. } | E::ShortTakes => Exit::NobodyFound,
            E::Weights(_) => Exit::Weights,
            E::Exists { .. } | E::NoFolder { .. } => Exit::Usage,
            E::Write { .. } | E::Stopped { .. } => Exit::Unexpected,
        };
        Self::new(exit, error.to_string())
    }
}

impl From<TakeError> for Failure {
    fn from(error: TakeError) -> Self {
        let exit = match error {
            TakeError::Record(error) => return error.into(),
            TakeError::NoKeypoints { .. } => Exit::NotOurs,
            TakeError::EmptySpan { .. } => Exit::Usage,
            TakeError::UnknownCamera { .. } => Exit::CameraMismatch,
        };
        Self::new(exit, error.to_string())
    }
}

impl From<TrajectoryError> for Failure {
    fn from(error: TrajectoryError) -> Self {
        match &error {
            TrajectoryError::Unreadable { .. } => {
                Self::new(Exit::Unreadable, format!("{error}; check the path"))
            }
            _ => Self::new(Exit::Malformed, error.to_string()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn help_lists_every_code() {
        for code in 0..=Exit::NotReady as u8 {
            assert!(EXIT_CODES.contains(&format!("\n  {code:>2}  ")), "{code}");
        }
    }

    #[test]
    fn messages_become_one_line() {
        assert_eq!(Failure::new(Exit::Usage, "a\n  b\n\nc").line(), "a b c");
    }
}

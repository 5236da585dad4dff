//! SMPTE timecode of capture times (SMPTE ST 12-1), with drop frame.
//!
//! Timecode numbers frames. At the rates of NTSC, 1000/1001 of a whole number, a number would fall
//! behind the clock by 3.6 s an hour. Drop frame leaves out the numbers of the first two frames (four
//! at 59.94) of each minute but every tenth; no frame is left out.

use std::fmt;
use std::str::FromStr;

use crate::core::time::{Nanos, Timestamp};

/// A rate of timecode.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Rate {
    /// Numbers in a second.
    numbers: i64,
    /// Whether frames come at 1000/1001 of that.
    is_ntsc: bool,
    is_drop: bool,
}

/// Names and rates.
const RATES: [(&str, Rate); 14] = [
    ("23.976", Rate::ntsc(24, false)),
    ("23.98", Rate::ntsc(24, false)),
    ("24", Rate::whole(24)),
    ("25", Rate::whole(25)),
    ("29.97", Rate::ntsc(30, false)),
    ("29.97df", Rate::ntsc(30, true)),
    ("30", Rate::whole(30)),
    ("47.952", Rate::ntsc(48, false)),
    ("48", Rate::whole(48)),
    ("50", Rate::whole(50)),
    ("59.94", Rate::ntsc(60, false)),
    ("59.94df", Rate::ntsc(60, true)),
    ("60", Rate::whole(60)),
    ("100", Rate::whole(100)),
];

impl Rate {
    const fn whole(numbers: i64) -> Self {
        Self { numbers, is_ntsc: false, is_drop: false }
    }

    const fn ntsc(numbers: i64, is_drop: bool) -> Self {
        Self { numbers, is_ntsc: true, is_drop }
    }

    /// Numbers that are left out in a minute.
    const fn dropped(self) -> i64 {
        if self.is_drop { self.numbers / 15 } else { 0 }
    }

    /// Frames of ten minutes.
    const fn ten_minutes(self) -> i64 {
        600 * self.numbers - 9 * self.dropped()
    }

    /// Frames of a day of timecode.
    pub const fn day(self) -> i64 {
        144 * self.ten_minutes()
    }

    /// A frame of the day as a timecode, such as `01:00:00:00`, or `01:00:00;00` with drop frame.
    pub fn label(self, frame: i64) -> String {
        let frame = frame.rem_euclid(self.day());
        let (tens, rest) = (frame / self.ten_minutes(), frame % self.ten_minutes());
        let dropped = self.dropped();
        // The first minute of ten is whole, the others are shorter.
        let (first, minute) = (60 * self.numbers, 60 * self.numbers - dropped);
        let minutes = if rest < first { 0 } else { 1 + (rest - first) / minute };
        let number = frame + dropped * (9 * tens + minutes);
        let (seconds, frames) = (number / self.numbers, number % self.numbers);
        let sign = if self.is_drop { ';' } else { ':' };
        let digits = if self.numbers > 100 { 3 } else { 2 };
        let (hours, minutes, seconds) = (seconds / 3600, seconds / 60 % 60, seconds % 60);
        format!("{hours:02}:{minutes:02}:{seconds:02}{sign}{frames:0digits$}")
    }

    /// The frame of the day with that timecode.
    ///
    /// # Errors
    /// The text is no timecode, or its number is left out at this rate.
    pub fn frame(self, text: &str) -> Result<i64, TimecodeError> {
        let what = "timecode";
        let wrong = |reason: &'static str| TimecodeError { what, text: text.to_owned(), reason };
        let parts: Vec<&str> = text.split([':', ';', '.']).collect();
        let is_number = |part: &&str| part.len() <= 3 && part.bytes().all(|b| b.is_ascii_digit());
        let numbers: Vec<i64> = parts
            .iter()
            .filter(|part| is_number(part))
            .filter_map(|part| part.parse().ok())
            .collect();
        let ([hours, minutes, seconds, frames], 4) = (&numbers[..], parts.len()) else {
            return Err(wrong("write hours:minutes:seconds:frames"));
        };
        if *hours > 23 || *minutes > 59 || *seconds > 59 || *frames >= self.numbers {
            return Err(wrong("a part is too large"));
        }
        if *seconds == 0 && *frames < self.dropped() && minutes % 10 != 0 {
            return Err(wrong("drop frame leaves this number out"));
        }
        let minutes = 60 * hours + minutes;
        let number = (60 * minutes + seconds) * self.numbers + frames;
        Ok(number - self.dropped() * (minutes - minutes / 10))
    }

    /// Nanoseconds of that many frames, as a fraction.
    const fn period(self) -> (i128, i128) {
        let (base, whole) = (self.numbers as i128, 1_000_000_000);
        if self.is_ntsc { (whole * 1001, base * 1000) } else { (whole, base) }
    }
}

impl FromStr for Rate {
    type Err = TimecodeError;

    fn from_str(text: &str) -> Result<Self, TimecodeError> {
        let known = RATES.iter().find(|(name, _)| name.eq_ignore_ascii_case(text));
        let reason =
            "use 23.976, 24, 25, 29.97, 29.97df, 30, 47.952, 48, 50, 59.94, 59.94df, 60 or 100";
        let what = "rate";
        known.map(|(_, rate)| *rate).ok_or(TimecodeError { what, text: text.to_owned(), reason })
    }
}

/// The timecode of a house: which timecode belongs to which capture time.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct House {
    rate: Rate,
    /// A frame of the day, and when it was captured.
    frame: i64,
    at: Timestamp,
}

impl House {
    /// Timecode of that rate. `offset` is a timecode and its capture time, seconds since the cameras'
    /// epoch: `01:00:00:00 at 1795252800.25`.
    ///
    /// # Errors
    /// An unknown rate, or no such offset.
    pub fn new(rate: &str, offset: &str) -> Result<Self, TimecodeError> {
        let rate: Rate = rate.parse()?;
        let reason = "write a timecode and its capture time, such as 01:00:00:00 at 1795252800.25";
        let wrong = TimecodeError { what: "offset", text: offset.to_owned(), reason };
        let (timecode, seconds) = offset.split_once(" at ").ok_or_else(|| wrong.clone())?;
        let at = nanoseconds(seconds.trim()).ok_or(wrong)?;
        Ok(Self { rate, frame: rate.frame(timecode.trim())?, at: Timestamp::from_ns(at) })
    }

    /// Its rate.
    pub fn rate(&self) -> Rate {
        self.rate
    }

    /// How long before and after the time of a timecode's frame captures have this timecode: half a frame.
    pub fn half_frames(&self) -> [Nanos; 2] {
        let (numerator, denominator) = self.rate.period();
        [numerator, numerator - 1]
            .map(|whole| Nanos::new(i64::try_from(whole / (2 * denominator)).unwrap_or(i64::MAX)))
    }

    /// The timecode of the frame nearest to a capture time.
    pub fn label(&self, capture: Timestamp) -> String {
        let (numerator, denominator) = self.rate.period();
        let passed = i128::from(capture.ns()) - i128::from(self.at.ns());
        let frames = (2 * passed * denominator + numerator).div_euclid(2 * numerator);
        let day = i128::from(self.rate.day());
        self.rate.label((i128::from(self.frame) + frames).rem_euclid(day) as i64)
    }

    /// The capture time of a timecode: of its days the one nearest to `near`.
    ///
    /// # Errors
    /// The text is no timecode of this rate.
    pub fn capture(&self, timecode: &str, near: Timestamp) -> Result<Timestamp, TimecodeError> {
        let (numerator, denominator) = self.rate.period();
        let time = |frames: i128| (frames * numerator).div_euclid(denominator);
        let (at, near) = (i128::from(self.at.ns()), i128::from(near.ns()));
        let frames = i128::from(self.rate.frame(timecode)? - self.frame);
        let day = i128::from(self.rate.day());
        let days = (near - at - time(frames) + time(day) / 2).div_euclid(time(day));
        let ns = at + time(frames + days * day);
        Ok(Timestamp::from_ns(i64::try_from(ns).unwrap_or(i64::MAX)))
    }
}

/// Nanoseconds of a decimal number of seconds, exactly.
fn nanoseconds(seconds: &str) -> Option<i64> {
    let (whole, part) = seconds.split_once('.').unwrap_or((seconds, ""));
    let is_number = |text: &str| text.bytes().all(|b| b.is_ascii_digit());
    if whole.is_empty() || !is_number(whole) || !is_number(part) || part.len() > 9 {
        return None;
    }
    let part: i64 = format!("{part:0<9}").parse().ok()?;
    whole.parse::<i64>().ok()?.checked_mul(1_000_000_000)?.checked_add(part)
}

/// A text that is no timecode, rate or offset.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{what} {text:?}: {reason}")]
pub struct TimecodeError {
    what: &'static str,
    text: String,
    reason: &'static str,
}

impl fmt::Display for Rate {
    fn fmt(&self, to: &mut fmt::Formatter<'_>) -> fmt::Result {
        let name = RATES.iter().find(|(_, rate)| rate == self).map_or("", |(name, _)| name);
        to.write_str(name)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rate(name: &str) -> Rate {
        name.parse().unwrap()
    }

    /// Known pairs: the two numbers before and after a dropped minute, ten minutes, an hour, a day.
    #[test]
    fn frames_have_the_numbers_of_the_standard() {
        for (name, frame, label) in [
            ("29.97df", 1799, "00:00:59;29"),
            ("29.97df", 1800, "00:01:00;02"),
            ("29.97df", 3597, "00:01:59;29"),
            ("29.97df", 3598, "00:02:00;02"),
            ("29.97df", 17_981, "00:09:59;29"),
            ("29.97df", 17_982, "00:10:00;00"),
            ("29.97df", 107_892, "01:00:00;00"),
            ("29.97df", 2_589_407, "23:59:59;29"),
            ("59.94df", 3599, "00:00:59;59"),
            ("59.94df", 3600, "00:01:00;04"),
            ("59.94df", 215_784, "01:00:00;00"),
            ("29.97", 1800, "00:01:00:00"),
            ("29.97", 108_000, "01:00:00:00"),
            ("23.976", 86_400, "01:00:00:00"),
            ("25", 90_000, "01:00:00:00"),
            ("50", 180_049, "01:00:00:49"),
        ] {
            assert_eq!(rate(name).label(frame), label);
            assert_eq!(rate(name).frame(label), Ok(frame), "{label}");
        }
        assert_eq!(rate("29.97df").label(2_589_408), "00:00:00;00", "a new day");
    }

    #[test]
    fn each_number_of_a_day_is_of_one_frame() {
        for name in ["29.97df", "59.94df", "25"] {
            let rate = rate(name);
            for frame in (0..rate.day()).step_by(7) {
                assert_eq!(rate.frame(&rate.label(frame)), Ok(frame));
            }
        }
    }

    #[test]
    fn capture_times_are_exact_over_a_day() {
        let house = House::new("29.97df", "01:00:00;00 at 1795252800.25").unwrap();
        let at = |ns: i64| Timestamp::from_ns(1_795_252_800_250_000_000 + ns);
        assert_eq!(house.label(at(0)), "01:00:00;00");
        // Half a frame is 16.68 ms.
        assert_eq!(house.label(at(16_000_000)), "01:00:00;00");
        assert_eq!(house.label(at(17_000_000)), "01:00:00;01");
        assert_eq!(house.label(at(-1_000_000_000)), "00:59:59;00");
        // An hour of drop frame is 3.6 ms short of an hour.
        assert_eq!(house.label(at(3_599_996_400_000)), "02:00:00;00");
        let capture = house.capture("02:00:00;00", at(0)).unwrap();
        assert_eq!(capture, at(3_599_996_400_000));
        // Half an hour before midnight and half an hour after it, near the next evening.
        let next = at(23 * 3_600_000_000_000);
        let midnight = house.capture("00:30:00;00", next).unwrap();
        assert!((midnight - next).seconds().abs() < 1900.0);
        assert_eq!(house.label(midnight), "00:30:00;00");
    }

    #[test]
    fn what_is_no_timecode_is_refused() {
        let df = rate("29.97df");
        for text in [
            "",
            "1:2:3",
            "00:01:00;00",
            "00:01:00;01",
            "24:00:00:00",
            "00:00:00:30",
            "a:0:0:0",
            "-1:0:0:0",
        ] {
            assert!(df.frame(text).is_err(), "{text}");
        }
        assert!(rate("30").frame("00:01:00:00").is_ok());
        assert!("29.98".parse::<Rate>().is_err());
        for offset in
            ["01:00:00:00", "01:00:00:00 at", "x at 3", "01:00:00:00 at 1.5s", "01:00:00:00 at -1"]
        {
            assert!(House::new("25", offset).is_err(), "{offset}");
        }
    }
}

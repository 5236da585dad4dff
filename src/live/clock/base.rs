//! The difference between the node's clock and the cameras', and what kind of clock that makes.

use crate::core::time::Nanos;

/// Frames may come this much before their capture time: the error of a synchronised clock.
pub(crate) const AHEAD: Nanos = Nanos::from_ms(20);
/// A longer delay than this is a clock that is behind.
pub(crate) const LONGEST_DELAY: Nanos = Nanos::from_ms(2000);
/// TAI is ahead of UTC by this, since 2017.
const TAI: Nanos = Nanos::from_ms(37_000);
/// The bases that are known without a measurement: the node's own clock, and TAI.
const COMMON: [Nanos; 2] = [Nanos::ZERO, Nanos::from_ms(-37_000)];
/// A clock that has drifted by less than this is still the node's.
const DRIFTED: Nanos = Nanos::from_ms(2);
/// A clock is followed by at most this a second, so that poses stay evenly spaced.
const FOLLOWED: Nanos = Nanos::new(500_000);
/// Frames that come this much before their capture time are reported.
const EARLY_FRAMES: Nanos = Nanos::from_ms(-1);

/// Node's clock minus capture clock.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Base {
    value: Nanos,
    /// The part that is drift.
    drifted: Nanos,
}

impl Base {
    /// The base for a smallest offset: the cameras' clock is the node's, or TAI, if the rest is a
    /// plausible delay.
    pub(crate) fn of(least: Nanos) -> Self {
        let is_delay = |base: &Nanos| (-AHEAD..LONGEST_DELAY).contains(&(least - *base));
        let value = COMMON.into_iter().find(is_delay).unwrap_or(least);
        Self { value, drifted: Nanos::ZERO }
    }

    pub(crate) fn value(self) -> Nanos {
        self.value
    }

    /// Whether delays are known: the clock is, or was before it drifted, the node's clock or TAI.
    pub(crate) fn is_common(self) -> bool {
        COMMON.contains(&(self.value - self.drifted))
    }

    /// The base after the clock has stepped.
    pub(crate) fn stepped(self, by: Nanos) -> Self {
        let value = self.value + by;
        let common = COMMON.into_iter().find(|common| (value - *common).abs() < AHEAD);
        Self { value: common.unwrap_or(value), drifted: Nanos::ZERO }
    }

    /// Follows a drift, ns per second; called once a second.
    pub(crate) fn follow(&mut self, drift: f64) {
        let step = Nanos::rounded(drift).clamp(-FOLLOWED, FOLLOWED);
        (self.value, self.drifted) = (self.value + step, self.drifted + step);
    }

    /// Which clock the cameras use.
    pub(crate) fn kind(self) -> &'static str {
        match self.value - self.drifted {
            _ if self.is_common() && self.drifted.abs() > DRIFTED => "drifting",
            Nanos::ZERO => "shared",
            origin if origin == -TAI => "tai",
            _ if self.value.abs() > Nanos::SECOND * 86_400 => "foreign",
            _ if self.value < Nanos::ZERO => "ahead",
            _ => "behind",
        }
    }

    /// Whether frames with that delay come before their capture time.
    pub(crate) fn is_early(delay: Nanos) -> bool {
        delay < EARLY_FRAMES
    }

    /// The kind of the clock, in words, and what to do; for frames that come after `delay`.
    pub(crate) fn describe(self, delay: Nanos) -> String {
        let by = self.value.seconds().abs();
        let fix =
            "synchronise cameras and node (PTP or NTP), or poses are late by an unknown delay";
        match self.kind() {
            _ if Self::is_early(delay) => format!(
                "frames come {:.1} ms before their capture time: the cameras' clock is ahead of the \
                 node's; synchronise both (PTP or NTP)",
                -delay.ms()
            ),
            "shared" => format!("the cameras use the node's clock, frames come after {delay:.1}"),
            "tai" => format!(
                "the cameras use TAI, 37 s ahead of the node's UTC, frames come after {delay:.1}"
            ),
            "drifting" => format!("the cameras' clock drifts against the node's; {fix}"),
            "foreign" => format!("the cameras' clock has another epoch than the node's; {fix}"),
            kind => {
                let than = if kind == "ahead" { "ahead of" } else { "behind" };
                format!("the cameras' clock is {by:.3} s {than} the node's; {fix}")
            }
        }
    }
}

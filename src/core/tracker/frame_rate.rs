//! The frame rate of the cameras: lines through capture times over frame numbers.
//!
//! Each camera's period is the slope of a least-squares line through the capture times of its last
//! frames over their numbers. A counter that does not count the images, but for example the messages,
//! is replaced by rounded steps. Jumps begin parallel lines of the same slope. If the last frames have
//! another slope, by a whole period, the frames before them are dropped. Cameras near the fastest are
//! pooled, and the only listed rate within three standard errors takes the place of the result.

use std::collections::VecDeque;

use crate::core::points::median;
use crate::core::time::{Nanos, Timestamp};

/// Usual frame rates; a measured rate is replaced by one if it fits no other.
const COMMON_RATES_HZ: [f64; 18] = [
    24e3 / 1001.0,
    24.0,
    25.0,
    30e3 / 1001.0,
    30.0,
    48e3 / 1001.0,
    48.0,
    50.0,
    60e3 / 1001.0,
    60.0,
    72.0,
    90.0,
    100.0,
    120e3 / 1001.0,
    120.0,
    144.0,
    200.0,
    240.0,
];
/// A measured rate is clamped to this range.
const RATES_HZ: std::ops::RangeInclusive<f64> = 1.0..=1000.0;
/// Frames of each camera that are kept.
pub const KEPT: usize = 1024;
/// Frames that a line needs.
const LEAST: usize = 5;
/// The newest frames; a rate changes for good if a line through them has another slope than one
/// through the frames before.
const RECENT: usize = 32;
/// A frame counter is used if its step is within this range of the median step in time.
const SAME_STEP: std::ops::Range<f64> = 0.6..1.5;
/// A counter is judged if more than this share of the steps in time is two or more median ones long.
const UNCOUNTED: f64 = 0.02;
/// A step is a multiple of the median one within this fraction of it.
const MULTIPLE: f64 = 0.25;
/// A frame further off the line than this many periods, and this fraction of the step, begins a new
/// line of the same slope: the clock or the counter has jumped.
const JUMP: [f64; 2] = [4.0, 0.05];
/// A jump back by more than this begins anew.
const BACK: Nanos = Nanos::from_ms(100);
/// Without a usable counter, a gap of more frames than this is a jump.
const COUNTED_GAP: f64 = 30.0;
/// Least standard deviation of capture times, ns.
const LEAST_JITTER: f64 = 1000.0;
/// Least relative standard error of a rate: cameras' oscillators are that exact.
const LEAST_ERROR: f64 = 3e-5;
/// Cameras within this fraction of the fastest one, and three standard errors, have one rate.
const SAME_RATE: f64 = 0.02;
/// Cameras without frames for this long do not count.
const ABSENT: Nanos = Nanos::from_ms(10_000);
/// A shorter mean step is not one of nanoseconds.
const LEAST_STEP: f64 = 1e5;
/// Frames that the mean step is taken of.
const STEPS: usize = 30;

/// A measured frame period.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FramePeriod {
    /// The period, ns.
    pub ns: f64,
    /// Its standard error, ns.
    pub error_ns: f64,
}

/// The frames of one camera, and its period.
#[derive(Clone, Debug, Default)]
struct Camera {
    /// Frame numbers and capture times, in order of capture.
    frames: VecDeque<(u64, Timestamp)>,
    /// Frames since the last measurement.
    new: usize,
    line: Option<Line>,
    /// Whether its counter counts what is sent, and not the images.
    counts_messages: bool,
}

/// The period of a camera, and whether its frame counter is usable.
#[derive(Clone, Copy, Debug)]
struct Line {
    period: FramePeriod,
    is_counted: bool,
}

/// The frame rate of several cameras.
#[derive(Clone, Debug)]
pub struct FrameRate {
    cameras: Vec<Camera>,
    /// Measured before.
    known: Option<FramePeriod>,
}

impl FrameRate {
    /// No frames of that many cameras.
    pub fn new(cameras: usize) -> Self {
        Self { cameras: vec![Camera::default(); cameras], known: None }
    }

    /// A period that was measured before; it counts while the cameras agree with it.
    pub fn know(&mut self, period: Option<FramePeriod>) {
        self.known = period;
    }

    /// The period that was measured before.
    pub(super) fn known(&self) -> Option<FramePeriod> {
        self.known
    }

    /// Notes a frame; unknown cameras are ignored.
    pub fn note(&mut self, camera: usize, number: u64, capture: Timestamp) {
        if let Some(camera) = self.cameras.get_mut(camera) {
            camera.note(number, capture);
        }
    }

    /// The capture times of a camera are so much later from here on.
    pub(super) fn shift(&mut self, camera: usize, by: Nanos) {
        let camera = self.cameras.get_mut(camera);
        let frames = camera.into_iter().flat_map(|camera| &mut camera.frames);
        frames.for_each(|(_, capture)| *capture = *capture + by);
    }

    /// The period of a camera whose frame counter is usable.
    pub(super) fn of_camera(&self, camera: usize) -> Option<FramePeriod> {
        let line = self.cameras.get(camera)?.line?;
        line.is_counted.then_some(line.period)
    }

    /// The period of the fastest cameras, from all cameras of about that rate. A listed rate takes its
    /// place if no other is within three standard errors.
    pub fn period(&self) -> Option<FramePeriod> {
        let lines = self.lines();
        let bound = |period: &FramePeriod| period.ns + 3.0 * period.error_ns;
        let Some(fastest) = lines.iter().copied().min_by(|a, b| bound(a).total_cmp(&bound(b)))
        else {
            return self.known;
        };
        let is_alike = |period: &&FramePeriod| {
            let error = libm::hypot(period.error_ns, fastest.error_ns);
            (period.ns - fastest.ns).abs() <= SAME_RATE * fastest.ns + 3.0 * error
        };
        let (mut weights, mut sum) = (0.0, 0.0);
        for period in lines.iter().chain(&self.known).filter(is_alike) {
            let weight = 1.0 / (period.error_ns * period.error_ns);
            weights += weight;
            sum += weight * (period.ns - fastest.ns);
        }
        let ns = fastest.ns + sum / weights;
        let pooled =
            FramePeriod { ns, error_ns: (1.0 / libm::sqrt(weights)).max(LEAST_ERROR * ns) };
        (pooled.ns >= LEAST_STEP).then(|| pooled.snapped())
    }

    /// The periods of the cameras that send. Cameras without a usable counter count only if all others
    /// are much slower: their lost frames are guessed.
    fn lines(&self) -> Vec<FramePeriod> {
        let last = |camera: &Camera| camera.frames.back().map(|(_, capture)| *capture);
        let newest = self.cameras.iter().filter_map(last).max();
        let sends =
            |camera: &&Camera| last(camera).zip(newest).is_some_and(|(a, b)| b - a < ABSENT);
        let lines: Vec<Line> = self.cameras.iter().filter(sends).filter_map(|c| c.line).collect();
        let counted = lines.iter().filter(|line| line.is_counted).map(|line| line.period.ns);
        let counted = counted.fold(f64::INFINITY, f64::min);
        let counts = |line: &&Line| line.is_counted || line.period.ns * SAME_STEP.end < counted;
        lines.iter().filter(counts).map(|line| line.period).collect()
    }
}

impl FramePeriod {
    /// The only listed rate within three standard errors, or else this.
    fn snapped(self) -> Self {
        let rate = (1e9 / self.ns).clamp(*RATES_HZ.start(), *RATES_HZ.end());
        match self.listed() {
            Some(rate) => Self { ns: 1e9 / rate, error_ns: 0.25 * LEAST_ERROR * self.ns },
            None => Self { ns: 1e9 / rate, ..self },
        }
    }

    /// The only listed rate within three standard errors, Hz.
    fn listed(&self) -> Option<f64> {
        let near = |rate: &f64| (1e9 / rate - self.ns).abs() <= 3.0 * self.error_ns;
        let mut near = COMMON_RATES_HZ.into_iter().filter(near);
        near.next().filter(|_| near.next().is_none())
    }

    /// Whether another period differs from this one by more than two standard errors.
    pub(super) fn differs_from(&self, other: f64) -> bool {
        (self.ns - other).abs() > 2.0 * self.error_ns
    }
}

impl Camera {
    fn note(&mut self, number: u64, capture: Timestamp) {
        if self.frames.back().is_some_and(|(_, last)| *last - capture > BACK) {
            self.frames.clear();
            self.counts_messages = false;
        }
        let later = self.frames.iter().rev().take_while(|(_, other)| *other > capture).count();
        self.frames.insert(self.frames.len() - later, (number, capture));
        if self.frames.len() > KEPT {
            self.frames.pop_front();
        }
        self.new += 1;
        if self.new > self.frames.len() / RECENT {
            self.new = 0;
            self.measure();
        }
    }

    /// Measures the period. Drops the old frames after a lasting change; while the newest frames have
    /// two rates, the period stays.
    fn measure(&mut self) {
        let frames: &[(u64, Timestamp)] = self.frames.make_contiguous();
        // With coarse time stamps the steps look as if frames were lost, but the counter has a usual rate.
        let is_usual =
            || Line::fit(frames, true).is_some_and(|line| line.period.listed().is_some());
        if let Some(counts) = counts_messages(&steps(frames)) {
            self.counts_messages = counts && !is_usual();
        }
        let fit = |frames| Line::fit(frames, !self.counts_messages);
        if let Some((old, recent)) = frames.split_at_checked(frames.len().saturating_sub(RECENT))
            && let (Some(before), Some(now)) = (fit(old), fit(recent))
            && old.len() >= RECENT / 2
            && now.differs_from(&before)
        {
            let (first, second) = recent.split_at(RECENT / 2);
            let halves = fit(first).zip(fit(second));
            if let Some((before, now)) = halves
                && !now.differs_from(&before)
            {
                self.line = Some(now);
                self.frames.drain(..self.frames.len() - RECENT / 2);
            }
            return;
        }
        self.line = fit(frames).or(self.line);
    }
}

impl Line {
    /// The least-squares slope of the capture time over the frame number, of one line or, after jumps,
    /// several parallel ones. Without a usable counter, steps are rounded multiples of the median one.
    fn fit(frames: &[(u64, Timestamp)], has_counter: bool) -> Option<Self> {
        if frames.len() < LEAST {
            return None;
        }
        let steps = steps(frames);
        let mut times: Vec<f64> = steps.iter().map(|(_, time)| *time).collect();
        let counting = steps.iter().filter(|(count, _)| *count != 0.0);
        let mut by_count: Vec<f64> = counting.map(|(count, time)| time / count).collect();
        let step = median(&mut times)?;
        let counted = median(&mut by_count).unwrap_or(0.0);
        let is_counted = has_counter
            && 2 * by_count.len() > times.len()
            && SAME_STEP.contains(&(counted / step));
        let nominal = if is_counted { counted } else { step };
        if nominal <= 0.0 {
            return None;
        }
        let (mut sums, mut line) = (Sums::default(), Sums::default());
        let (mut x, mut y, mut span) = (0.0, 0.0, 0.0);
        line.add(x, y);
        for (count, time) in steps {
            let count = if is_counted { count } else { (time / nominal).round() };
            let off = time - count * nominal;
            let limit = nominal * (JUMP[0] + JUMP[1] * count.abs());
            if off.abs() > limit || (!is_counted && count > COUNTED_GAP) {
                sums.add_line(&line);
                (line, x, y) = (Sums::default(), 0.0, 0.0);
            } else {
                (x, y, span) = (x + count, y + off, span + count);
            }
            line.add(x, y);
        }
        sums.add_line(&line);
        let [xx, xy, yy] = sums.squares;
        let freedom = sums.count - 1.0;
        // Two publishers of one name take turns.
        let is_regular = is_counted || SAME_STEP.contains(&(span / sums.count));
        if freedom < 1.0 || xx <= 0.0 || !is_regular {
            return None;
        }
        let slope = xy / xx;
        let jitter = libm::sqrt(((yy - slope * xy) / freedom).max(LEAST_JITTER * LEAST_JITTER));
        // Few frames show their jitter badly.
        let error_ns = jitter / libm::sqrt(xx) * (1.0 + 6.0 / freedom);
        let ns = nominal + slope;
        let error_ns = error_ns.max(LEAST_ERROR * ns);
        (ns > 0.0).then_some(Self { period: FramePeriod { ns, error_ns }, is_counted })
    }

    /// Whether the slopes differ, by a whole period over the newest frames.
    fn differs_from(&self, other: &Self) -> bool {
        let (a, b) = (self.period, other.period);
        let apart = (a.ns - b.ns).abs();
        let error = libm::hypot(a.error_ns, b.error_ns);
        apart > 4.0 * error && apart * RECENT as f64 > a.ns.max(b.ns)
    }
}

/// The steps between frames, of the counter and of the time, ns.
fn steps(frames: &[(u64, Timestamp)]) -> Vec<(f64, f64)> {
    let step = |pair: &[(u64, Timestamp)]| {
        let count = pair[1].0.wrapping_sub(pair[0].0).cast_signed();
        (count as f64, (pair[1].1 - pair[0].1).ns() as f64)
    };
    frames.windows(2).map(step).collect()
}

/// Whether a counter counts what was sent and not the images: the times show that frames were lost, but mostly not the
/// counter. `None`: too few frames tell.
fn counts_messages(steps: &[(f64, f64)]) -> Option<bool> {
    let step = median(&mut steps.iter().map(|(_, time)| *time).collect::<Vec<f64>>())?;
    let is_lost = |three: &&[(f64, f64)]| {
        let [(_, before), (_, time), (_, after)] = three else { return false };
        let multiple = (time / step).round();
        (2.0..=COUNTED_GAP).contains(&multiple)
            && (time / step - multiple).abs() < MULTIPLE
            && before + time + after > (multiple + 1.5) * step
    };
    let lost: Vec<&[(f64, f64)]> = steps.windows(3).filter(is_lost).collect();
    let counted = lost.iter().filter(|three| three[1].0 > 1.0).count();
    let (frames, gaps) = (steps.len() as f64, lost.len() as f64);
    let time: f64 = steps.iter().map(|(_, time)| time).sum();
    let is_short = steps.len() < RECENT - 1;
    // Jitter that looks like gaps makes as many steps short.
    let short = steps.iter().filter(|(_, time)| *time < 0.5 * step).count();
    let tells = gaps > UNCOUNTED * frames
        && gaps > 4.0 * short as f64
        && time > step * (frames + 0.5 * gaps);
    (!is_short && tells).then_some(2 * counted < lost.len())
}

/// Sums of squared deviations from the means, of points on one line or on several.
#[derive(Clone, Copy, Debug, Default)]
struct Sums {
    /// Points, less one for each line that was added.
    count: f64,
    mean: [f64; 2],
    /// Of x, of x and y, of y.
    squares: [f64; 3],
}

impl Sums {
    fn add(&mut self, x: f64, y: f64) {
        self.count += 1.0;
        let [dx, dy] = [x - self.mean[0], y - self.mean[1]];
        self.mean = [self.mean[0] + dx / self.count, self.mean[1] + dy / self.count];
        let after = [x - self.mean[0], y - self.mean[1]];
        self.squares[0] += dx * after[0];
        self.squares[1] += dx * after[1];
        self.squares[2] += dy * after[1];
    }

    fn add_line(&mut self, line: &Self) {
        self.count += line.count - 1.0;
        for (sum, square) in self.squares.iter_mut().zip(line.squares) {
            *sum += square;
        }
    }
}

/// Finds capture times that are not in nanoseconds.
#[derive(Clone, Debug, Default)]
pub struct UnitCheck {
    times: VecDeque<Timestamp>,
}

impl UnitCheck {
    /// Adds the capture time of a camera's next frame. Returns what is wrong with the last ones and how
    /// to fix it.
    pub fn add(&mut self, capture: Timestamp) -> Option<String> {
        self.times.push_back(capture);
        if self.times.len() <= STEPS {
            return None;
        }
        self.times.pop_front();
        let ends = self.times.iter().min().zip(self.times.iter().max());
        let step = ends.map_or(0.0, |(first, last)| (*last - *first).ns() as f64);
        let step = step / (STEPS - 1) as f64;
        let (unit, factor) = match step {
            0.0 => {
                return Some("capture times do not advance; send them in nanoseconds".to_owned());
            }
            LEAST_STEP.. => return None,
            1000.0.. => ("microseconds", "1000"),
            1.0.. => ("milliseconds", "1000000"),
            _ => ("seconds", "1000000000"),
        };
        Some(format!(
            "capture times advance by {step:.3} ns a frame, as if they were in {unit}; send \
             nanoseconds: multiply them by {factor}"
        ))
    }
}

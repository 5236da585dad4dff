//! Disturbs a stream of frames like a bad network does; for tests and demonstrations.

use crate::core::random::Draws;
use crate::core::time::{Nanos, Timestamp};

/// Separates these random numbers from others of the same seed.
const STREAM: u64 = 0x6469_7374_7572_6264;
/// Index of the random number for the delay.
const DELAY: u64 = 16;

/// Shares of frames that are disturbed, each 0 to 1. A frame has at most one disturbance.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Disturbance {
    /// Share of lost frames.
    pub drop: f64,
    /// Share of frames delayed by up to `longest_delay`.
    pub late: f64,
    /// Share of frames sent twice, the second time together with the camera's next frame.
    pub duplicate: f64,
    /// Share of frames sent after the camera's next frame.
    pub reorder: f64,
    /// Longest delay of a late frame.
    pub longest_delay: Nanos,
    /// Seed of the random choice.
    pub seed: u64,
}

/// A frame to send.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Sending {
    /// Index of the frame.
    pub frame: usize,
    /// When it is sent.
    pub due: Timestamp,
}

/// Number of disturbed frames.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Disturbed {
    /// Lost.
    pub dropped: u64,
    /// Delayed.
    pub late: u64,
    /// Sent twice.
    pub duplicated: u64,
    /// Sent after the next.
    pub reordered: u64,
}

/// Disturbance of a frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Fate {
    Drop = 1,
    Late,
    Duplicate,
    Reorder,
}

impl Disturbance {
    /// Send times of the frames of one camera, in ascending order. `due` are the undisturbed
    /// send times, ascending; `stream` separates the random numbers of cameras and rounds.
    pub fn apply(&self, stream: u64, due: &[Timestamp], counts: &mut Disturbed) -> Vec<Sending> {
        let all = due;
        let mut sent = Vec::with_capacity(all.len());
        for (frame, &due) in all.iter().enumerate() {
            let next = all.get(frame + 1).copied();
            let mut send = |due, order| sent.push((due, order, frame));
            let (order, behind) = (2 * frame as u64, 2 * frame as u64 + 3);
            match self.fate(stream, frame as u64) {
                Some(Fate::Drop) => counts.dropped += 1,
                Some(Fate::Late) => {
                    counts.late += 1;
                    let part = self.draws(stream).uniform(DELAY, frame as u64);
                    let delay = part * self.longest_delay.ns() as f64;
                    send(due + Nanos::new(delay as i64), order);
                }
                Some(Fate::Duplicate) => {
                    counts.duplicated += 1;
                    send(due, order);
                    send(next.unwrap_or(due), behind);
                }
                Some(Fate::Reorder) if next.is_some() => {
                    counts.reordered += 1;
                    send(next.unwrap_or(due), behind);
                }
                _ => send(due, order),
            }
        }
        sent.sort_unstable();
        sent.into_iter().map(|(due, _, frame)| Sending { frame, due }).collect()
    }

    fn draws(&self, stream: u64) -> Draws {
        Draws { seed: self.seed ^ stream.rotate_left(32), stream: STREAM }
    }

    /// The disturbance of a frame, if any.
    fn fate(&self, stream: u64, frame: u64) -> Option<Fate> {
        let draws = self.draws(stream);
        let shares = [
            (Fate::Drop, self.drop),
            (Fate::Late, self.late),
            (Fate::Duplicate, self.duplicate),
            (Fate::Reorder, self.reorder),
        ];
        let happens = |(what, share): &(Fate, f64)| draws.uniform(*what as u64, frame) < *share;
        shares.into_iter().find(happens).map(|(what, _)| what)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const PERIOD: i64 = 10;

    fn apply(disturbance: Disturbance, stream: u64) -> (Vec<(usize, i64)>, Disturbed) {
        let due: Vec<Timestamp> =
            (0..1000).map(|frame| Timestamp::from_ns(frame * PERIOD)).collect();
        let mut counts = Disturbed::default();
        let sent = disturbance.apply(stream, &due, &mut counts);
        (sent.into_iter().map(|sending| (sending.frame, sending.due.ns())).collect(), counts)
    }

    #[test]
    fn nothing_happens_by_default() {
        let (sent, counts) = apply(Disturbance::default(), 0);
        let all: Vec<_> = (0..1000).map(|frame| (frame as usize, frame * PERIOD)).collect();
        assert_eq!((sent, counts), (all, Disturbed::default()));
    }

    #[test]
    fn a_seed_says_what_happens_to_which_frame() {
        let half = |seed| Disturbance { drop: 0.5, seed, ..Disturbance::default() };
        assert_eq!(apply(half(1), 0), apply(half(1), 0));
        assert_ne!(apply(half(1), 0), apply(half(2), 0));
        assert_ne!(apply(half(1), 0), apply(half(1), 1));
        let (sent, counts) = apply(half(1), 0);
        assert_eq!(sent.len() as u64 + counts.dropped, 1000);
        assert!((400..600).contains(&counts.dropped), "{counts:?}");
    }

    #[test]
    fn late_frames_come_later_by_no_more_than_the_limit() {
        let (sent, counts) = apply(
            Disturbance { late: 0.2, longest_delay: Nanos::new(35), ..Disturbance::default() },
            0,
        );
        assert_eq!(sent.len(), 1000);
        assert!(sent.is_sorted_by_key(|&(_, due)| due));
        let delays: Vec<i64> =
            sent.iter().map(|&(frame, due)| due - frame as i64 * PERIOD).collect();
        assert!(delays.iter().all(|delay| (0..35).contains(delay)));
        let late = delays.iter().filter(|&&delay| delay > 0).count() as u64;
        assert!(late > 100 && late <= counts.late, "{late} of {counts:?}");
    }

    #[test]
    fn duplicates_come_twice_and_reordered_frames_after_the_next() {
        let (sent, counts) = apply(Disturbance { duplicate: 1.0, ..Disturbance::default() }, 0);
        assert_eq!((sent.len(), counts.duplicated), (2000, 1000));
        assert_eq!(sent[..5], [(0, 0), (1, 10), (0, 10), (2, 20), (1, 20)]);
        let some = Disturbance { reorder: 0.1, seed: 3, ..Disturbance::default() };
        let (sent, counts) = apply(some, 0);
        let order: Vec<usize> = sent.iter().map(|&(frame, _)| frame).collect();
        let behind = order.windows(2).filter(|pair| pair[0] > pair[1]).count() as u64;
        assert!((50..150).contains(&counts.reordered), "{counts:?}");
        assert!(behind > 0 && behind <= counts.reordered);
        let mut sorted = order;
        sorted.sort_unstable();
        assert_eq!(sorted, (0..1000).collect::<Vec<_>>());
    }
}

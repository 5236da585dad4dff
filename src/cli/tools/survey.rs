//! What the cameras on the bus send, on every stage.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use super::inbox::{Inbox, Received};
use crate::core::detections::KeypointFormat;
use crate::core::time::{Nanos, Timestamp};
use crate::core::tracker::UnitCheck;
use crate::io::bus::{Bus, BusError};
use crate::io::wire::{self, KeypointFrame, StageChannel, Topic, Topics};
use crate::live::clock::base::Base;
use crate::metrics::statistics::{median, percentiles};

/// Longest wait for the next message.
const PATIENCE: Duration = Duration::from_millis(50);

/// What a camera sends.
#[derive(Clone, Debug, Default)]
pub(crate) struct Seen {
    /// Messages that hold keypoints.
    pub(crate) frames: u64,
    /// What is wrong with the last message that could not be used.
    pub(crate) unreadable: Option<String>,
    /// Width and height of the last image, pixels.
    pub(crate) size: [u32; 2],
    pub(crate) format: Option<KeypointFormat>,
    /// Frames that show somebody.
    pub(crate) with_people: u64,
    captures: Vec<Timestamp>,
    units: UnitCheck,
    /// Arrival minus capture time, seconds.
    offsets: Vec<f64>,
}

impl Seen {
    /// Frames per second, by the median step between capture times.
    pub(crate) fn rate_hz(&self) -> Option<f64> {
        let steps = self.captures.windows(2).map(|pair| pair[1].seconds_since(pair[0]));
        median(&steps.collect::<Vec<f64>>()).filter(|step| *step > 0.0).map(|step| 1.0 / step)
    }

    /// Difference between the clock of this computer and the camera's, and the least delay after it.
    fn clock(&self) -> Option<(Base, Nanos)> {
        let least = self.offsets.iter().copied().reduce(f64::min)?;
        let base = Base::of(Nanos::rounded(1e9 * least));
        Some((base, Nanos::rounded(1e9 * least) - base.value()))
    }

    /// An error in words if the camera's clock is neither this computer's nor TAI.
    pub(crate) fn clock_check(&self) -> Option<Result<(), String>> {
        let (base, delay) = self.clock()?;
        let is_right = base.is_common() && !Base::is_early(delay);
        Some(if is_right { Ok(()) } else { Err(base.describe(delay)) })
    }

    /// Median and 99th percentile of the delay, seconds.
    pub(crate) fn delay_s(&self) -> Option<[f64; 2]> {
        let base = self.clock()?.0.value().seconds();
        Some(percentiles(&self.offsets, [50.0, 99.0])?.map(|offset| offset - base))
    }

    fn add(&mut self, received: &Received) {
        let frame = wire::decode::<KeypointFrame>(&received.sample.payload)
            .and_then(|frame| Ok((frame.to_core(|_| Some(0))?, frame)));
        let (detections, frame) = match frame {
            Ok(frame) => frame,
            Err(error) => {
                self.unreadable = Some(error.to_string());
                return;
            }
        };
        if let Some(fault) = self.units.add(detections.capture) {
            self.unreadable = Some(fault);
        }
        self.frames += 1;
        self.size = [frame.image_width, frame.image_height];
        self.format = Some(detections.format);
        self.with_people += u64::from(!detections.people.is_empty());
        self.captures.push(detections.capture);
        self.offsets.push(received.arrival.seconds_since(detections.capture));
    }
}

/// The stages on which cameras send, other than `stage`, with the names of their cameras.
pub(crate) fn other_stages(seen: &BTreeMap<(String, String), Seen>, stage: &str) -> Vec<String> {
    let mut others: BTreeMap<&str, Vec<&str>> = BTreeMap::new();
    for (of, camera) in seen.keys().filter(|(of, _)| of != stage) {
        others.entry(of).or_default().push(camera);
    }
    others.iter().map(|(of, cameras)| format!("{of} ({})", cameras.join(", "))).collect()
}

/// Listens to the keypoints of all stages for some time, or until `goes_on` is false. By stage and
/// camera.
///
/// # Errors
/// The bus refuses the subscription.
pub(crate) fn survey(
    bus: &dyn Bus,
    time: Duration,
    goes_on: impl Fn() -> bool,
) -> Result<BTreeMap<(String, String), Seen>, BusError> {
    let all = Topics { stage: "*".to_owned(), actor: "*".to_owned() };
    let inbox = Inbox::open(bus, &all.keypoints("*"))?;
    let begin = Instant::now();
    let mut found: BTreeMap<_, Seen> = BTreeMap::new();
    while begin.elapsed() < time && goes_on() {
        let Some(received) = inbox.next(PATIENCE) else { continue };
        if let Ok(Topic::Stage { stage, channel: StageChannel::Keypoints { camera } }) =
            Topic::parse(&received.sample.topic)
        {
            found.entry((stage.to_owned(), camera.to_owned())).or_default().add(&received);
        }
    }
    Ok(found)
}

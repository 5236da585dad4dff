//! Streams that fall silent.

use std::collections::BTreeMap;
use std::sync::Arc;

use crate::core::time::{Nanos, Timestamp};
use crate::io::bus::{Delivery, delivery};

/// A stream is silent after this time without a message.
const SILENT: Nanos = Nanos::from_ms(3000);
/// Most streams that are watched.
const MOST_STREAMS: usize = 65_536;
/// Most streams that are named at once.
const MOST_NAMES: usize = 8;

/// When the last message of each stream came, and whether its silence was reported.
#[derive(Default)]
pub(super) struct Silence(BTreeMap<Arc<str>, (Timestamp, bool)>);

impl Silence {
    /// Notes a message; states are not watched.
    pub(super) fn came(&mut self, topic: &Arc<str>, at: Timestamp) {
        if delivery(topic) == Delivery::Stream && self.0.len() < MOST_STREAMS {
            self.0.insert(Arc::clone(topic), (at, false));
        }
    }

    /// Names the streams that fell silent since the last call.
    pub(super) fn report(&mut self, now: Timestamp) -> Option<String> {
        let mut silent: Vec<&str> = Vec::new();
        for (topic, (last, is_said)) in &mut self.0 {
            if now - *last > SILENT && !std::mem::replace(is_said, true) {
                silent.push(topic);
            }
        }
        let named = silent.get(..silent.len().min(MOST_NAMES)).filter(|list| !list.is_empty())?;
        let more = match silent.len() - named.len() {
            0 => String::new(),
            more => format!(" and {more} more"),
        };
        let (seconds, list) = (SILENT.seconds(), named.join(", "));
        Some(format!("silent for {seconds:.0} s: {list}{more}"))
    }
}

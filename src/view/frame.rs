//! A message on its way to the page.

use crate::core::time::Timestamp;

/// Appends a frame, as the [module](super) describes it.
pub(super) fn write(
    out: &mut Vec<u8>,
    topic: &str,
    capture: Timestamp,
    arrival: Timestamp,
    payload: &[u8],
) {
    out.extend((topic.len() as u32).to_le_bytes());
    out.extend(topic.as_bytes());
    out.extend(capture.ns().to_le_bytes());
    out.extend(arrival.ns().to_le_bytes());
    out.extend((payload.len() as u32).to_le_bytes());
    out.extend(payload);
}

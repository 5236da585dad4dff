//! Encoding of samples as bytes, for shared memory.

use super::{BusError, Sample};
use crate::core::time::Timestamp;

/// Largest sample with its header, bytes.
const LARGEST: usize = 1 << 20;

/// The header: version, lengths of topic and encoding, capture time.
const HEAD: usize = 12;
const VERSION: u8 = 1;

/// Encodes a sample.
pub(super) fn frame(
    topic: &str,
    capture: Timestamp,
    encoding: &str,
    payload: &[u8],
) -> Result<Vec<u8>, BusError> {
    let before = HEAD + topic.len() + encoding.len();
    let (Ok(topic_bytes), Ok(encoding_bytes), true) = (
        u8::try_from(topic.len()),
        u16::try_from(encoding.len()),
        before + payload.len() <= LARGEST,
    ) else {
        let most = LARGEST.saturating_sub(before);
        return Err(BusError::TooLarge { topic: topic.into(), bytes: payload.len(), most });
    };
    let mut bytes = Vec::with_capacity(before + payload.len());
    bytes.extend([VERSION, topic_bytes]);
    bytes.extend(encoding_bytes.to_le_bytes());
    bytes.extend(capture.ns().to_le_bytes());
    bytes.extend(topic.as_bytes());
    bytes.extend(encoding.as_bytes());
    bytes.extend(payload);
    Ok(bytes)
}

/// Decodes a sample; `None` if the bytes are not a sample, or too many.
pub(super) fn parse(bytes: &[u8]) -> Option<Sample> {
    if bytes.len() > LARGEST {
        return None;
    }
    let (head, rest) = bytes.split_first_chunk::<HEAD>()?;
    let [VERSION, topic_bytes, e0, e1, capture @ ..] = *head else { return None };
    let (topic, rest) = rest.split_at_checked(topic_bytes.into())?;
    let (encoding, payload) = rest.split_at_checked(u16::from_le_bytes([e0, e1]).into())?;
    Some(Sample {
        topic: std::str::from_utf8(topic).ok()?.into(),
        capture: Timestamp::from_ns(i64::from_le_bytes(capture)),
        encoding: std::str::from_utf8(encoding).ok()?.into(),
        payload: payload.to_vec(),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cut_and_foreign_samples_are_none() {
        let bytes = frame("a/rig", Timestamp::from_ns(-7), "text/plain", b"payload").unwrap();
        let sample = parse(&bytes).unwrap();
        assert_eq!((&*sample.topic, &*sample.encoding), ("a/rig", "text/plain"));
        assert_eq!((sample.capture.ns(), &*sample.payload), (-7, b"payload".as_slice()));
        for length in 0..bytes.len() - b"payload".len() {
            assert_eq!(parse(&bytes[..length]), None);
        }
        assert_eq!(parse(&[2; 40]), None);
        assert_eq!(parse(&[&[1, 1, 0, 0], &[0xFF; 30][..]].concat()), None);
    }

    #[test]
    fn a_payload_above_the_limit_is_refused_with_the_limit() {
        let error = frame("t", Timestamp::default(), "", &vec![0; LARGEST]).unwrap_err();
        assert_eq!(
            error.to_string(),
            "t: a payload of 1048576 bytes; this bus carries at most 1048563"
        );
        assert!(frame("t", Timestamp::default(), &"e".repeat(70_000), b"").is_err());
    }
}

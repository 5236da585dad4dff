//! The hash of weights, messages and runs.

/// FNV-1a of the bytes, 64 bits: h = 0xcbf29ce484222325, and for each byte b,
/// h = (h xor b) * 0x100000001b3 modulo 2^64.
pub fn fnv1a(bytes: &[u8]) -> u64 {
    fnv1a_after(0xcbf2_9ce4_8422_2325, bytes)
}

/// The same of bytes that come after others with that hash.
pub fn fnv1a_after(hash: u64, bytes: &[u8]) -> u64 {
    bytes.iter().fold(hash, |hash, &byte| (hash ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3))
}

#[cfg(test)]
mod tests {
    #[test]
    fn known_hashes() {
        assert_eq!(super::fnv1a(b""), 0xcbf2_9ce4_8422_2325);
        assert_eq!(super::fnv1a(b"foobar"), 0x8594_4171_f739_67e8);
        assert_eq!(super::fnv1a_after(super::fnv1a(b"foo"), b"bar"), super::fnv1a(b"foobar"));
    }
}

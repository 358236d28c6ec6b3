//! Stable sort of key–payload pairs.

use std::ops::Range;

/// The part of a key that takes part in the comparison, bits `bits.start .. bits.end` counted from
/// the lowest.
fn digits(key: u32, bits: &Range<u32>) -> u32 {
    let kept = u64::from(key) & ((1u64 << bits.end) - 1);
    (kept >> bits.start) as u32
}

/// Sorts pairs by the bits `bits` of the keys (within 0..32), ascending; pairs whose bits are equal
/// keep their order.
pub fn by_bits(keys: &[u32], payload: &[u32], bits: Range<u32>) -> (Vec<u32>, Vec<u32>) {
    assert_eq!(keys.len(), payload.len());
    assert!(bits.start <= bits.end && bits.end <= 32);
    let mut order: Vec<usize> = (0..keys.len()).collect();
    order.sort_by_key(|&i| digits(keys[i], &bits));
    (order.iter().map(|&i| keys[i]).collect(), order.iter().map(|&i| payload[i]).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sorts_only_by_the_bits_asked_for() {
        let keys = [0x35, 0x14, 0x25, 0x04];
        let payload = [0, 1, 2, 3];
        assert_eq!(by_bits(&keys, &payload, 0..32).1, [3, 1, 2, 0]);
        assert_eq!(by_bits(&keys, &payload, 0..4).1, [1, 3, 0, 2]);
        assert_eq!(by_bits(&keys, &payload, 4..8).1, [3, 1, 2, 0]);
        assert_eq!(by_bits(&keys, &payload, 5..5).1, payload);
        assert_eq!(by_bits(&[u32::MAX, 0], &[8, 9], 31..32).0, [0, u32::MAX]);
    }
}

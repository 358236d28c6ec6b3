//! Prefix sums and reductions.

/// Exclusive prefix sum modulo 2³²: `out[i] = in[0] + … + in[i − 1]`.
pub fn exclusive(values: &[u32]) -> Vec<u32> {
    values
        .iter()
        .scan(0u32, |sum, &v| {
            let before = *sum;
            *sum = sum.wrapping_add(v);
            Some(before)
        })
        .collect()
}

/// Sum of all values modulo 2³².
pub fn sum(values: &[u32]) -> u32 {
    values.iter().fold(0, |sum, &v| sum.wrapping_add(v))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sums() {
        assert!(exclusive(&[]).is_empty());
        assert_eq!(exclusive(&[3, 0, 7, 1]), [0, 3, 3, 10]);
        assert_eq!(exclusive(&[u32::MAX, 2, 5]), [0, u32::MAX, 1]);
        assert_eq!(sum(&[u32::MAX, 2, 5]), 6);
    }
}

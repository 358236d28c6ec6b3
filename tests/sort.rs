//! The radix sort on the device.

mod common;

use splat4d::ops::sort::RadixSort;

// 16 workgroups for the values and 32 blocks of the table, with a limit of 6 workgroups along an axis.
common::cases! { "sort", folded to 6:
    sizes, powers_of_two, bit_ranges, orders, count_below_capacity,
}

#[test]
fn bits_past_the_key_are_refused() {
    let device = common::device();
    for bits in [0..33, std::ops::Range { start: 5, end: 4 }] {
        let error = RadixSort::plan(&device, 10, bits).unwrap_err();
        assert!(error.to_string().contains("bits within 0..32"), "{error}");
    }
}

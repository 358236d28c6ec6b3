//! Prefix sums by reduce-then-scan: no workgroup waits for another. Few values take one workgroup.

use crate::gpu::kernel;

/// Values that one workgroup handles.
pub const BLOCK: u32 = 4096;

kernel! {
    /// Writes the exclusive prefix sums of few values; a single workgroup.
    pub struct Single("scan/single"), workgroup: [256, 1, 1],
    params: SingleParams {
        /// Where the number of values lies in `count`.
        count_at: u32,
        /// The number is capped here.
        capacity: u32,
        /// Where the sum of all values goes in `total`.
        total_at: u32,
    },
    args: SingleArgs {
        /// Holds the number of values.
        count: Read<u32>,
        /// The values.
        values: ReadVec4<u32>,
        /// Gets the sum of all values before each value.
        prefix: WriteVec4<u32>,
        /// Gets the sum of all values.
        total: Write<u32>,
    }
}

kernel! {
    /// Sums each block of [`BLOCK`] values.
    pub struct Reduce("scan/reduce"), workgroup: [256, 1, 1],
    params: ReduceParams {
        /// Where the number of values lies in `count`.
        count_at: u32,
        /// The number is capped here.
        capacity: u32,
    },
    args: ReduceArgs {
        /// Holds the number of values.
        count: Read<u32>,
        /// The values.
        values: ReadVec4<u32>,
        /// Gets the sum of each block.
        sums: Write<u32>,
    }
}

kernel! {
    /// Replaces the blocks' sums by their exclusive prefix sums; a single workgroup.
    pub struct Spine("scan/spine"), workgroup: [256, 1, 1],
    params: SpineParams {
        /// Where the number of values (not blocks) lies in `count`.
        count_at: u32,
        /// The number is capped here.
        capacity: u32,
        /// Where the sum of all values goes in `total`.
        total_at: u32,
    },
    args: SpineArgs {
        /// Holds the number of values.
        count: Read<u32>,
        /// The blocks' sums.
        sums: ReadWrite<u32>,
        /// Gets the sum of all values.
        total: Write<u32>,
    }
}

kernel! {
    /// Writes the exclusive prefix sums of each block.
    pub struct Downsweep("scan/downsweep"), workgroup: [256, 1, 1],
    params: DownsweepParams {
        /// Where the number of values lies in `count`.
        count_at: u32,
        /// The number is capped here.
        capacity: u32,
    },
    args: DownsweepArgs {
        /// Holds the number of values.
        count: Read<u32>,
        /// The values.
        values: ReadVec4<u32>,
        /// The sum of all values before each block.
        sums: Read<u32>,
        /// Gets the sum of all values before each value.
        prefix: WriteVec4<u32>,
    }
}

//! Prefix sums by reduce-then-scan: no workgroup waits for another. A small number of values takes one
//! workgroup.

use crate::gpu::kernel;

/// Number of values that one workgroup handles.
pub const BLOCK: u32 = 4096;

kernel! {
    /// Writes the exclusive prefix sums of a small number of values with a single workgroup.
    pub struct Single("scan/single"), workgroup: [256, 1, 1],
    params: SingleParams {
        /// Index of the number of values in `count`.
        count_at: u32,
        /// Capacity; the number is clamped to it.
        capacity: u32,
        /// Index in `total` that receives the sum of all values.
        total_at: u32,
    },
    args: SingleArgs {
        /// Holds the number of values.
        count: Read<u32>,
        /// The values.
        values: ReadVec4<u32>,
        /// Receives the sum of all values before each value.
        prefix: WriteVec4<u32>,
        /// Receives the sum of all values.
        total: Write<u32>,
    }
}

kernel! {
    /// Sums each block of [`BLOCK`] values.
    pub struct Reduce("scan/reduce"), workgroup: [256, 1, 1],
    params: ReduceParams {
        /// Index of the number of values in `count`.
        count_at: u32,
        /// Capacity; the number is clamped to it.
        capacity: u32,
    },
    args: ReduceArgs {
        /// Holds the number of values.
        count: Read<u32>,
        /// The values.
        values: ReadVec4<u32>,
        /// Receives the sum of each block.
        sums: Write<u32>,
    }
}

kernel! {
    /// Replaces the blocks' sums by their exclusive prefix sums; a single workgroup.
    pub struct Spine("scan/spine"), workgroup: [256, 1, 1],
    params: SpineParams {
        /// Index of the number of values (not blocks) in `count`.
        count_at: u32,
        /// Capacity; the number is clamped to it.
        capacity: u32,
        /// Index in `total` that receives the sum of all values.
        total_at: u32,
    },
    args: SpineArgs {
        /// Holds the number of values.
        count: Read<u32>,
        /// The blocks' sums.
        sums: ReadWrite<u32>,
        /// Receives the sum of all values.
        total: Write<u32>,
    }
}

kernel! {
    /// Writes the exclusive prefix sums of each block.
    pub struct Downsweep("scan/downsweep"), workgroup: [256, 1, 1],
    params: DownsweepParams {
        /// Index of the number of values in `count`.
        count_at: u32,
        /// Capacity; the number is clamped to it.
        capacity: u32,
    },
    args: DownsweepArgs {
        /// Holds the number of values.
        count: Read<u32>,
        /// The values.
        values: ReadVec4<u32>,
        /// The sum of all values before each block.
        sums: Read<u32>,
        /// Receives the sum of all values before each value.
        prefix: WriteVec4<u32>,
    }
}

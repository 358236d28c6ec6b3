//! Stable least-significant-digit radix sort, counting and scattering by runs.
//!
//! Every invocation processes a run of consecutive keys in order and keeps one counter per digit, so the
//! sort is stable whatever the subgroup size. The counters are in shared memory. With
//! `own_counters`, which is faster on software devices, they are in a private array of the invocation.

use crate::gpu::kernel;

/// Number of runs that one workgroup handles; their counters fill 32 KiB of shared memory.
pub const RUNS_PER_GROUP: u32 = 32;
/// Largest width in bits of a digit whose counters are in shared memory.
pub const SHARED_DIGIT_BITS: u32 = 8;
/// Largest width in bits of a digit whose counters are private to an invocation.
pub const OWN_DIGIT_BITS: u32 = 9;
/// Number of words that [`Plan`] writes.
pub const PLAN_WORDS: usize = 7;
/// Index at which [`Plan`] writes the number of the table's entries.
pub const PLAN_TABLE_AT: usize = 3;
/// Index at which [`Plan`] writes the grid over the runs.
pub const PLAN_GRID_AT: usize = 4;

kernel! {
    /// Divides the keys into runs.
    pub struct Plan("sort/plan"), workgroup: [1, 1, 1],
    params: PlanParams {
        /// Index of the number of keys in `count`.
        count_at: u32,
        /// Capacity; the number is clamped to it.
        capacity: u32,
        /// Number of digit values of a pass.
        bins: u32,
        /// Length of the shortest run, except the last; all runs but the last are multiples of four
        /// keys.
        min_run: u32,
        /// Largest number of runs.
        max_runs: u32,
        /// Largest number of workgroups along one axis; a larger grid is folded.
        group_limit: u32,
    },
    args: PlanArgs {
        /// Holds the number of keys.
        count: Read<u32>,
        /// Receives [`PLAN_WORDS`] words: keys, keys in a run, runs, entries of the table, grid.
        plan: Write<u32>,
    }
}

kernel! {
    /// Counts the digits of each run.
    pub struct Count("sort/count"), workgroup: [32, 1, 1],
    constants: CountConstants {
        /// Whether the counters are in a private array of the invocation instead of shared memory.
        own_counters: bool = false,
    },
    params: CountParams {
        /// The digit's lowest bit.
        shift: u32,
        /// The digit's mask after the shift.
        mask: u32,
        /// Number of digit values of a pass.
        bins: u32,
    },
    args: CountArgs {
        /// The words that [`Plan`] wrote.
        plan: Read<u32>,
        /// The keys.
        keys: ReadVec4<u32>,
        /// Receives the counts, `[digit][run]`.
        table: Write<u32>,
    }
}

kernel! {
    /// Moves each run's pairs to their places.
    pub struct Scatter("sort/scatter"), workgroup: [32, 1, 1],
    constants: CountConstants,
    params: ScatterParams {
        /// The digit's lowest bit.
        shift: u32,
        /// The digit's mask after the shift.
        mask: u32,
        /// Number of digit values of a pass.
        bins: u32,
    },
    args: ScatterArgs {
        /// The words that [`Plan`] wrote.
        plan: Read<u32>,
        /// Exclusive prefix sums of the table.
        offsets: Read<u32>,
        /// The keys.
        keys: ReadVec4<u32>,
        /// The payload of each key.
        payload: ReadVec4<u32>,
        /// Receives the keys, sorted by the digit.
        sorted_keys: Write<u32>,
        /// Receives the payloads in the same order.
        sorted_payload: Write<u32>,
    }
}

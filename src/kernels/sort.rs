//! Stable least-significant-digit radix sort, counting and scattering by runs.
//!
//! Every invocation owns a run of consecutive keys and a counter per digit, and walks its run in
//! order: stable by construction, whatever the subgroup size. The counters lie in shared memory; with
//! specialisation constant 0 set, which pays on software devices, in an array of the invocation's own.

use crate::gpu::kernel;

/// Runs that one workgroup handles; their counters fill 32 KiB of shared memory.
pub const RUNS_PER_GROUP: u32 = 32;
/// Most bits of a digit whose counters are shared memory.
pub const SHARED_DIGIT_BITS: u32 = 8;
/// Most bits of a digit whose counters are an invocation's own.
pub const OWN_DIGIT_BITS: u32 = 9;
/// Words that [`Plan`] writes.
pub const PLAN_WORDS: usize = 7;
/// Where [`Plan`] writes the number of the table's entries.
pub const PLAN_TABLE_AT: usize = 3;
/// Where [`Plan`] writes the grid over the runs.
pub const PLAN_GRID_AT: usize = 4;

kernel! {
    /// Cuts the keys into runs.
    pub struct Plan("sort/plan"), workgroup: [1, 1, 1],
    params: PlanParams {
        /// Where the number of keys lies in `count`.
        count_at: u32,
        /// The number is capped here.
        capacity: u32,
        /// Digits that a pass tells apart.
        bins: u32,
        /// Runs are no shorter, but for the last; all but the last are whole fours.
        min_run: u32,
        /// There are no more runs.
        max_runs: u32,
        /// Workgroups along one axis; beyond it the grid is folded.
        group_limit: u32,
    },
    args: PlanArgs {
        /// Holds the number of keys.
        count: Read<u32>,
        /// Gets [`PLAN_WORDS`] words: keys, keys in a run, runs, entries of the table, grid.
        plan: Write<u32>,
    }
}

kernel! {
    /// Counts the digits of each run.
    pub struct Count("sort/count"), workgroup: [32, 1, 1],
    params: CountParams {
        /// The digit's lowest bit.
        shift: u32,
        /// The digit's mask after the shift.
        mask: u32,
        /// Digits that a pass tells apart.
        bins: u32,
    },
    args: CountArgs {
        /// What [`Plan`] wrote.
        plan: Read<u32>,
        /// The keys.
        keys: ReadVec4<u32>,
        /// Gets the counts, `[digit][run]`.
        table: Write<u32>,
    }
}

kernel! {
    /// Moves each run's pairs to their places.
    pub struct Scatter("sort/scatter"), workgroup: [32, 1, 1],
    params: ScatterParams {
        /// The digit's lowest bit.
        shift: u32,
        /// The digit's mask after the shift.
        mask: u32,
        /// Digits that a pass tells apart.
        bins: u32,
    },
    args: ScatterArgs {
        /// What [`Plan`] wrote.
        plan: Read<u32>,
        /// Exclusive prefix sums of the table.
        offsets: Read<u32>,
        /// The keys.
        keys: ReadVec4<u32>,
        /// What goes with them.
        payload: ReadVec4<u32>,
        /// Gets the keys, sorted by the digit.
        sorted_keys: Write<u32>,
        /// Gets what goes with them.
        sorted_payload: Write<u32>,
    }
}

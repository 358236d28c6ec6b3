//! Stable radix sort of key–payload pairs whose number is read from a device buffer.

use crate::gpu::{Buffer, Device, DeviceKind, Groups, Recorder, View, ViewMut};
use crate::kernels::sort::{
    Count, CountArgs, CountConstants, CountParams, OWN_DIGIT_BITS, PLAN_GRID_AT, PLAN_TABLE_AT,
    PLAN_WORDS, Plan, PlanArgs, PlanParams, SHARED_DIGIT_BITS, Scatter, ScatterArgs, ScatterParams,
};
use crate::ops::scan::{Scan, ScanArgs, ScanScratch};
use crate::{Error, Result};
use std::ops::Range;

/// How the keys are divided into runs of consecutive keys, each processed by one invocation.
#[derive(Clone, Copy, Debug)]
struct Runs {
    /// Shortest run. Shorter ones would spend more time on counters than on keys.
    least: usize,
    /// Largest number of runs. More would not occupy the device better.
    most: usize,
    /// Whether each invocation keeps its counters in a private array instead of shared memory.
    own_counters: bool,
}

/// Enough runs to occupy the cores. The lanes of a subgroup write to neighbouring places; the shorter
/// their runs, the more of these places share a cache line. More runs than these make a table of
/// counters that costs more than that gains.
const SOFTWARE: Runs = Runs { least: 1024, most: 512, own_counters: true };
/// Enough runs to occupy a large GPU.
const GPU: Runs = Runs { least: 256, most: 16_384, own_counters: false };

impl Runs {
    /// Number of runs for `keys` keys.
    fn of(&self, keys: usize) -> usize {
        keys.div_ceil(self.least).min(self.most)
    }

    /// Number of passes over `width` bits. Wide digits save passes and cost counters: each counter is
    /// set, written, summed and read once a pass, which costs one and a half times as much as a key. The
    /// cost is weighed for the shortest runs, so that the result does not depend on the number of keys
    /// and a larger sort's scratch serves a smaller one.
    fn passes(&self, width: u32) -> u32 {
        let usual = width.div_ceil(SHARED_DIGIT_BITS);
        let fewest = if self.own_counters { width.div_ceil(OWN_DIGIT_BITS) } else { usual };
        let cost = |passes: u32| {
            let counters = 1usize << width.div_ceil(passes.max(1));
            passes as usize * (2 * self.least + 3 * counters)
        };
        // Zero bits still take one pass, over a digit of width 0, since only the device knows how many
        // pairs to copy.
        (fewest..=usual).min_by_key(|&passes| cost(passes)).unwrap_or(usual).max(1)
    }
}

/// A stable sort by some bits of the keys, ascending.
///
/// ```
/// use splat4d::gpu::{Device, Request};
/// use splat4d::ops::sort::{RadixSort, SortArgs};
/// # fn main() -> splat4d::Result<()> {
/// let device = Device::open(&Request::software())?;
/// let mut stream = device.stream()?;
/// let count = device.upload("count", &[3u32])?;
/// let keys = device.upload("keys", &[7u32, 2, 7])?;
/// let payload = device.upload("payload", &[10u32, 11, 12])?;
/// let mut sorted_keys = device.buffer("sorted keys", 3)?;
/// let mut sorted_payload = device.buffer("sorted payload", 3)?;
///
/// let sort = RadixSort::plan(&device, 3, 0..8)?;
/// let mut scratch = sort.scratch(&device)?;
/// let mut recorder = stream.record()?;
/// let args = SortArgs {
///     count: count.view(),
///     count_at: 0,
///     keys: keys.view(),
///     payload: payload.view(),
///     sorted_keys: sorted_keys.view_mut(),
///     sorted_payload: sorted_payload.view_mut(),
/// };
/// sort.record(&mut recorder, args, &mut scratch)?;
/// stream.submit(recorder)?;
/// assert_eq!(stream.download(&sorted_payload)?, [11, 10, 12]);
/// # Ok(())
/// # }
/// ```
#[derive(Clone, Debug)]
pub struct RadixSort {
    capacity: usize,
    bits: Range<u32>,
    passes: u32,
    digit_bits: u32,
    runs: Runs,
}

/// Intermediate buffers of a sort.
pub struct SortScratch {
    plan: Buffer<u32>,
    table: Buffer<u32>,
    offsets: Buffer<u32>,
    total: Buffer<u32>,
    scan: ScanScratch,
    /// Pairs between two passes; empty where one pass is enough.
    keys: Buffer<u32>,
    payload: Buffer<u32>,
}

/// The buffers of one sort. The input does not change.
pub struct SortArgs<'a> {
    /// Holds the number of pairs; it is clamped to the capacity.
    pub count: View<'a, u32>,
    /// Index of that number in `count`.
    pub count_at: usize,
    /// The keys; at least as many elements as the capacity.
    pub keys: View<'a, u32>,
    /// The payload of each key; at least as many elements as the capacity.
    pub payload: View<'a, u32>,
    /// Receives the sorted keys; elements from the number of pairs on do not change.
    pub sorted_keys: ViewMut<'a, u32>,
    /// Receives the payloads in the order of the sorted keys.
    pub sorted_payload: ViewMut<'a, u32>,
}

impl RadixSort {
    /// Plans a sort of at most `capacity` pairs by the bits `bits` of their keys, counted from the
    /// lowest. Other bits are ignored; pairs whose bits are equal keep their order.
    ///
    /// # Errors
    /// [`Error::Input`] for bits beyond 32 or more than 2³² − 1 pairs.
    pub fn plan(device: &Device, capacity: usize, bits: Range<u32>) -> Result<RadixSort> {
        if bits.start > bits.end || bits.end > 32 || u32::try_from(capacity).is_err() {
            return Err(Error::Input(format!(
                "a sort of {capacity} pairs by the bits {bits:?}: at most 2³² − 1 pairs, bits \
                 within 0..32"
            )));
        }
        let runs = match device.info().kind {
            DeviceKind::Software => SOFTWARE,
            _ => GPU,
        };
        Ok(RadixSort::in_runs(runs, capacity, bits))
    }

    fn in_runs(runs: Runs, capacity: usize, bits: Range<u32>) -> RadixSort {
        let width = bits.end - bits.start;
        // A shift by all 32 bits of a key is undefined.
        let bits = if width == 0 { 0..0 } else { bits };
        let passes = runs.passes(width);
        RadixSort {
            capacity,
            passes,
            // Evenly, since a pass over narrower digits costs less: 12 bits are 6 + 6, not 8 + 4.
            digit_bits: width.div_ceil(passes),
            bits,
            runs,
        }
    }

    /// The same sort with the runs of GPUs, so that it can be compared with the oracle on any device.
    #[cfg(feature = "check")]
    pub(crate) fn with_gpu_runs(self) -> RadixSort {
        RadixSort::in_runs(GPU, self.capacity, self.bits)
    }

    fn bins(&self) -> usize {
        1 << self.digit_bits
    }

    fn table_len(&self) -> usize {
        self.bins() * self.runs.of(self.capacity)
    }

    /// Allocates the intermediate buffers of [`record`](Self::record).
    ///
    /// # Errors
    /// [`Error::OutOfMemory`].
    pub fn scratch(&self, device: &Device) -> Result<SortScratch> {
        let between = if self.passes > 1 { self.capacity } else { 0 };
        let table = self.table_len();
        Ok(SortScratch {
            plan: device.buffer("sort plan", PLAN_WORDS)?,
            table: device.buffer("sort table", table)?,
            offsets: device.buffer("sort offsets", table)?,
            total: device.buffer("sort total", 1)?,
            scan: Scan::plan(table)?.scratch(device)?,
            keys: device.buffer("sort keys", between)?,
            payload: device.buffer("sort payload", between)?,
        })
    }

    /// Records the sort: `sort/plan`; for each pass of up to 8 bits (9 on software devices)
    /// `sort/count`, those of [`Scan::record`], `sort/scatter`.
    ///
    /// # Errors
    /// [`Error::Shape`] for a buffer that is too short; else as for [`Recorder::dispatch`].
    pub fn record(
        &self,
        recorder: &mut Recorder,
        mut args: SortArgs<'_>,
        scratch: &mut SortScratch,
    ) -> Result<()> {
        let shapes = [
            ("count", args.count_at + 1, args.count.len()),
            ("keys", self.capacity, args.keys.len()),
            ("payload", self.capacity, args.payload.len()),
            ("sorted_keys", self.capacity, args.sorted_keys.len()),
            ("sorted_payload", self.capacity, args.sorted_payload.len()),
        ];
        super::at_least("sort", &shapes)?;
        let params = PlanParams {
            count_at: args.count_at as u32,
            capacity: self.capacity as u32,
            bins: self.bins() as u32,
            min_run: self.runs.least as u32,
            max_runs: self.runs.most as u32,
            group_limit: recorder.device().limits().groups,
        };
        recorder.dispatch::<Plan>(
            Groups([1, 1, 1]),
            params,
            PlanArgs { count: args.count, plan: scratch.plan.view_mut() },
        )?;
        for pass in 0..self.passes {
            let shift = self.bits.start + pass * self.digit_bits;
            let width = self.digit_bits.min(self.bits.end - shift);
            let digit = (shift, (1u32 << width) - 1);
            // The last pass must end in the output, so the passes before it alternate between the two
            // targets from there.
            let to_output = (self.passes - 1 - pass).is_multiple_of(2);
            let (between, out) = (
                (scratch.keys.view_mut(), scratch.payload.view_mut()),
                (args.sorted_keys.reborrow(), args.sorted_payload.reborrow()),
            );
            let (from, to) = if to_output { (between, out) } else { (out, between) };
            let source = match pass {
                0 => (args.keys, args.payload),
                _ => (from.0.as_view(), from.1.as_view()),
            };
            let tables =
                (&scratch.plan, &mut scratch.table, &mut scratch.offsets, &mut scratch.total);
            self.record_pass(recorder, digit, source, to, tables, &mut scratch.scan)?;
        }
        Ok(())
    }

    /// One pass over the digit `(key >> shift) & mask`.
    fn record_pass(
        &self,
        recorder: &mut Recorder,
        (shift, mask): (u32, u32),
        (keys, payload): (View<'_, u32>, View<'_, u32>),
        (sorted_keys, sorted_payload): (ViewMut<'_, u32>, ViewMut<'_, u32>),
        (plan, table, offsets, total): (
            &Buffer<u32>,
            &mut Buffer<u32>,
            &mut Buffer<u32>,
            &mut Buffer<u32>,
        ),
        scan: &mut ScanScratch,
    ) -> Result<()> {
        let bins = self.bins() as u32;
        let constants = CountConstants { own_counters: self.runs.own_counters };
        recorder.dispatch_indirect_specialised::<Count>(
            constants,
            plan,
            PLAN_GRID_AT,
            CountParams { shift, mask, bins },
            CountArgs { plan: plan.view(), keys, table: table.view_mut() },
        )?;
        Scan::plan(self.table_len())?.record(
            recorder,
            ScanArgs {
                count: plan.view(),
                count_at: PLAN_TABLE_AT,
                values: table.view(),
                prefix: offsets.view_mut(),
                total: total.view_mut(),
                total_at: 0,
            },
            scan,
        )?;
        recorder.dispatch_indirect_specialised::<Scatter>(
            constants,
            plan,
            PLAN_GRID_AT,
            ScatterParams { shift, mask, bins },
            ScatterArgs {
                plan: plan.view(),
                offsets: offsets.view(),
                keys,
                payload,
                sorted_keys,
                sorted_payload,
            },
        )
    }
}

//! Stable radix sort of key–payload pairs whose number is read from a device buffer.

use crate::gpu::{Buffer, Device, Groups, Profile, Recorder, View, ViewMut};
use crate::kernels::sort::{
    Count, CountArgs, CountConstants, CountParams, OWN_DIGIT_BITS, PLAN_GRID_AT, PLAN_TABLE_AT,
    PLAN_WORDS, Plan, PlanArgs, PlanParams, SHARED_DIGIT_BITS, Scatter, ScatterArgs, ScatterParams,
};
use crate::ops::scan::{Scan, ScanArgs, ScanScratch};
use crate::{Error, Result};
use std::ops::Range;

/// Number of passes over `width` bits. Wide digits save passes and cost counters: each counter is set,
/// written, summed and read once a pass, which costs one and a half times as much as a key. The cost is
/// weighed for the shortest runs, so that the result does not depend on the number of keys and a larger
/// sort's scratch serves a smaller one.
fn passes(profile: &Profile, width: u32) -> u32 {
    let usual = width.div_ceil(SHARED_DIGIT_BITS);
    let fewest = if profile.own_counters { width.div_ceil(OWN_DIGIT_BITS) } else { usual };
    let cost = |passes: u32| {
        let counters = 1usize << width.div_ceil(passes.max(1));
        passes as usize * (2 * profile.least_run + 3 * counters)
    };
    // Zero bits still take one pass, over a digit of width 0, since only the device knows how many
    // pairs to copy.
    (fewest..=usual).min_by_key(|&passes| cost(passes)).unwrap_or(usual).max(1)
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
    /// Largest number of runs of consecutive keys; one invocation processes a run.
    most_runs: usize,
    /// Length of the shortest run.
    least_run: usize,
    own_counters: bool,
    /// Number of counters of all runs.
    table_len: usize,
    scan: Scan,
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
        let profile = device.profile();
        let width = bits.end - bits.start;
        let passes = passes(profile, width);
        // Evenly, since a pass over narrower digits costs less: 12 bits are 6 + 6, not 8 + 4.
        let digit_bits = width.div_ceil(passes);
        let runs = capacity.div_ceil(profile.least_run).min(profile.most_runs);
        let table_len = runs << digit_bits;
        Ok(RadixSort {
            capacity,
            // A shift by all 32 bits of a key is undefined.
            bits: if width == 0 { 0..0 } else { bits },
            passes,
            digit_bits,
            most_runs: profile.most_runs,
            least_run: profile.least_run,
            own_counters: profile.own_counters,
            table_len,
            scan: Scan::plan(device, table_len)?,
        })
    }

    fn bins(&self) -> usize {
        1 << self.digit_bits
    }

    /// Number of pairs that the scratch holds between two passes.
    fn between(&self) -> usize {
        if self.passes > 1 { self.capacity } else { 0 }
    }

    /// Allocates the intermediate buffers of [`record`](Self::record).
    ///
    /// # Errors
    /// [`Error::OutOfMemory`].
    pub fn scratch(&self, device: &Device) -> Result<SortScratch> {
        let between = self.between();
        let table = self.table_len;
        Ok(SortScratch {
            plan: device.buffer("sort plan", PLAN_WORDS)?,
            table: device.buffer("sort table", table)?,
            offsets: device.buffer("sort offsets", table)?,
            total: device.buffer("sort total", 1)?,
            scan: self.scan.scratch(device)?,
            keys: device.buffer("sort keys", between)?,
            payload: device.buffer("sort payload", between)?,
        })
    }

    /// Records the sort: `sort/plan`; for each pass of up to 8 bits (9 under
    /// [`Profile::SOFTWARE`]) `sort/count`, those of [`Scan::record`], `sort/scatter`.
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
            ("scratch's table", self.table_len, scratch.table.len()),
            ("scratch's keys", self.between(), scratch.keys.len()),
        ];
        super::at_least("sort", &shapes)?;
        let params = PlanParams {
            count_at: args.count_at as u32,
            capacity: self.capacity as u32,
            bins: self.bins() as u32,
            min_run: self.least_run as u32,
            max_runs: self.most_runs as u32,
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
        let constants = CountConstants { own_counters: self.own_counters };
        recorder.dispatch_indirect_specialised::<Count>(
            constants,
            plan,
            PLAN_GRID_AT,
            CountParams { shift, mask, bins },
            CountArgs { plan: plan.view(), keys, table: table.view_mut() },
        )?;
        self.scan.record(
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

//! Exclusive prefix sums of values whose number is read from a device buffer.

use crate::gpu::{Buffer, Device, Groups, Recorder, View, ViewMut};
use crate::kernels::indirect;
use crate::kernels::scan::{
    BLOCK, Downsweep, DownsweepArgs, DownsweepParams, Reduce, ReduceArgs, ReduceParams, Single,
    SingleArgs, SingleParams, Spine, SpineArgs, SpineParams,
};
use crate::{Error, Result};

/// Exclusive prefix sums (modulo 2³²) of at most `capacity` values.
///
/// ```
/// use splat4d::gpu::{Device, Request};
/// use splat4d::ops::scan::{Scan, ScanArgs};
/// # fn main() -> splat4d::Result<()> {
/// let device = Device::open(&Request::software())?;
/// let mut stream = device.stream()?;
/// let (count, values) = (device.upload("count", &[4u32])?, device.upload("values", &[3u32, 1, 4, 1])?);
/// let (mut prefix, mut total) = (device.buffer("prefix", 4)?, device.buffer("total", 1)?);
///
/// let scan = Scan::plan(&device, 4)?;
/// let mut scratch = scan.scratch(&device)?;
/// let mut recorder = stream.record()?;
/// let (count, values) = (count.view(), values.view());
/// let out = (prefix.view_mut(), total.view_mut());
/// let args = ScanArgs { count, count_at: 0, values, prefix: out.0, total: out.1, total_at: 0 };
/// scan.record(&mut recorder, args, &mut scratch)?;
/// stream.submit(recorder)?;
/// assert_eq!(stream.download(&prefix)?, [0, 3, 4, 8]);
/// assert_eq!(stream.download(&total)?, [9]);
/// # Ok(())
/// # }
/// ```
#[derive(Clone, Copy, Debug)]
pub struct Scan {
    capacity: usize,
    /// Whether a single workgroup scans all values.
    single: bool,
}

/// Intermediate buffers of a scan.
pub struct ScanScratch {
    sums: Buffer<u32>,
    grid: Buffer<u32>,
}

/// The buffers of one scan.
pub struct ScanArgs<'a> {
    /// Holds the number of values; it is clamped to the capacity.
    pub count: View<'a, u32>,
    /// Index of that number in `count`.
    pub count_at: usize,
    /// The values; at least as many elements as the capacity.
    pub values: View<'a, u32>,
    /// Receives `prefix[i] = values[0] + … + values[i − 1]`; elements from the number of values on do
    /// not change.
    pub prefix: ViewMut<'a, u32>,
    /// Receives the sum of all values.
    pub total: ViewMut<'a, u32>,
    /// Index in `total` that receives the sum.
    pub total_at: usize,
}

impl Scan {
    /// Plans a scan of at most `capacity` values.
    ///
    /// # Errors
    /// [`Error::Input`] beyond 2³² − 1 values.
    pub fn plan(device: &Device, capacity: usize) -> Result<Scan> {
        if u32::try_from(capacity).is_err() {
            return Err(Error::Input(format!("a scan of {capacity} values: at most 2³² − 1")));
        }
        Ok(Scan { capacity, single: capacity <= device.profile().single_scan })
    }

    /// Allocates the intermediate buffers of [`record`](Self::record).
    ///
    /// # Errors
    /// [`Error::OutOfMemory`].
    pub fn scratch(&self, device: &Device) -> Result<ScanScratch> {
        let blocks = self.capacity.div_ceil(BLOCK as usize);
        Ok(ScanScratch {
            sums: device.buffer("scan sums", blocks)?,
            grid: device.buffer("scan grid", 3)?,
        })
    }

    /// Records the scan: `scan/single` for a small capacity, else `indirect/arguments`,
    /// `scan/reduce`, `scan/spine`, `scan/downsweep`.
    ///
    /// # Errors
    /// [`Error::Shape`] for a buffer that is too short; else as for [`Recorder::dispatch`].
    pub fn record(
        &self,
        recorder: &mut Recorder,
        mut args: ScanArgs<'_>,
        scratch: &mut ScanScratch,
    ) -> Result<()> {
        let shapes = [
            ("count", args.count_at + 1, args.count.len()),
            ("values", self.capacity, args.values.len()),
            ("prefix", self.capacity, args.prefix.len()),
            ("total", args.total_at + 1, args.total.len()),
        ];
        super::at_least("scan", &shapes)?;
        let (count, count_at, capacity) = (args.count, args.count_at as u32, self.capacity as u32);
        let total_at = args.total_at as u32;
        if self.single {
            return recorder.dispatch::<Single>(
                Groups([1, 1, 1]),
                SingleParams { count_at, capacity, total_at },
                SingleArgs { count, values: args.values, prefix: args.prefix, total: args.total },
            );
        }
        indirect::record_arguments(
            recorder,
            count,
            args.count_at,
            self.capacity,
            BLOCK,
            scratch.grid.view_mut(),
            0,
        )?;
        recorder.dispatch_indirect::<Reduce>(
            &scratch.grid,
            0,
            ReduceParams { count_at, capacity },
            ReduceArgs { count, values: args.values, sums: scratch.sums.view_mut() },
        )?;
        recorder.dispatch::<Spine>(
            Groups([1, 1, 1]),
            SpineParams { count_at, capacity, total_at },
            SpineArgs { count, sums: scratch.sums.view_mut(), total: args.total.reborrow() },
        )?;
        recorder.dispatch_indirect::<Downsweep>(
            &scratch.grid,
            0,
            DownsweepParams { count_at, capacity },
            DownsweepArgs {
                count,
                values: args.values,
                sums: scratch.sums.view(),
                prefix: args.prefix.reborrow(),
            },
        )
    }
}

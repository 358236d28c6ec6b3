//! Profiles: the time of an execution by kernel.

use std::collections::BTreeMap;

use serde::Serialize;

use super::job::{Entry, Pace};
use crate::gpu::{Detail, Device};
use crate::kernels;
use crate::report::{Peaks, Place, Spread, Work};
use crate::{Error, Result};

/// The profile of a row's executions. Times are medians over the executions, in nanoseconds.
#[derive(Clone, Debug, Serialize)]
pub struct Profile {
    /// Identifier of the row.
    pub id: &'static str,
    /// The size of its input.
    pub size: String,
    /// Number of profiled executions.
    pub executions: usize,
    /// Device time from the start to the end of the submissions, ns.
    pub device: f64,
    /// Host time from the first call to the last result, ns.
    pub wall: f64,
    /// Fraction of the host time in which the device does not work.
    pub host_share: f64,
    /// Bytes and operations of an execution, as far as they are counted.
    pub work: Work,
    /// Invocations per subgroup.
    pub subgroup_size: u32,
    /// The kernels, the most expensive first.
    pub kernels: Vec<KernelShare>,
}

/// One kernel of a [`Profile`].
#[derive(Clone, Debug, Serialize)]
pub struct KernelShare {
    /// Name of the kernel.
    pub kernel: &'static str,
    /// Invocations of its workgroup.
    pub workgroup: [u32; 3],
    /// Number of dispatches per execution.
    pub dispatches: usize,
    /// Time of all its dispatches, ns.
    pub time: f64,
    /// Fraction of the total kernel time.
    pub share: f64,
}

impl Profile {
    /// Bytes and operations per second relative to the device's peaks; `None` if they are not
    /// counted.
    pub fn shares(&self, peaks: &Peaks) -> [Option<f64>; 2] {
        let share = |count: u64, most: Option<f64>| {
            (count > 0).then_some(count as f64 / self.device * 1e9 / most?)
        };
        [share(self.work.bytes, peaks.bytes), share(self.work.operations, peaks.operations)]
    }
}

/// Executes an entry repeatedly with a timestamp after every dispatch. `None` for a row that does
/// not run on the device.
///
/// # Errors
/// [`Error::Unsupported`] on a device without timestamps; a failed submission.
pub fn profile(device: &Device, entry: &Entry, pace: Pace, seed: u64) -> Result<Option<Profile>> {
    let mut job = (entry.prepare)(device, seed)?;
    if job.place != Place::Device {
        return Ok(None);
    }
    // Warm-up: the first executions compile pipelines and fill caches.
    for _ in 0..2 {
        job.sample(device)?;
    }
    let (mut walls, mut spans) = (Vec::new(), Vec::new());
    let mut times: BTreeMap<&'static str, Vec<f64>> = BTreeMap::new();
    let mut dispatches: BTreeMap<&'static str, usize> = BTreeMap::new();
    while walls.len() < pace.least {
        let sample = job.metered(device, Detail::Dispatches)?;
        let meter = sample.meter.ok_or_else(|| Error::Unsupported {
            kernel: "a profile".into(),
            missing: "timestamps".into(),
        })?;
        walls.push(sample.wall);
        spans.push(meter.nanoseconds);
        let mut sums: BTreeMap<&'static str, f64> = BTreeMap::new();
        dispatches.clear();
        for time in &meter.kernels {
            *sums.entry(time.kernel).or_default() += time.nanoseconds;
            *dispatches.entry(time.kernel).or_default() += 1;
        }
        for (kernel, sum) in sums {
            times.entry(kernel).or_default().push(sum);
        }
    }
    let median = |samples: Vec<f64>| {
        Spread::new(samples)
            .map(|spread| spread.median())
            .ok_or_else(|| Error::Failed("the device's timestamps make no sense".into()))
    };
    let executions = walls.len();
    let mut kernels = Vec::new();
    for (kernel, samples) in times {
        let info = kernels::ALL.iter().find(|info| info.name == kernel);
        kernels.push(KernelShare {
            kernel,
            workgroup: info.map_or([0; 3], |info| info.workgroup),
            dispatches: dispatches.get(kernel).copied().unwrap_or(0),
            time: median(samples)?,
            share: 0.0,
        });
    }
    let sum: f64 = kernels.iter().map(|kernel| kernel.time).sum();
    for kernel in &mut kernels {
        kernel.share = kernel.time / sum;
    }
    kernels.sort_by(|a, b| b.time.total_cmp(&a.time));
    let (span, wall) = (median(spans)?, median(walls)?);
    Ok(Some(Profile {
        id: entry.id,
        size: entry.size.clone(),
        executions,
        device: span,
        wall,
        host_share: (1.0 - span / wall).max(0.0),
        work: job.work,
        subgroup_size: device.info().subgroup_size,
        kernels,
    }))
}

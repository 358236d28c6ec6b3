//! The benchmark: every op and pipeline, held against the oracle and then timed; and speed against
//! error.
//!
//! An [`Entry`] prepares a [`Job`]: it uploads its input, executes once, compares with the oracle in
//! f64, and counts what one execution moves and calculates. [`measure`] times the job only when the
//! comparison passed. [`curves`] tells how time and memory grow. Times are the device's own, by
//! timestamps around the submissions; uploads and downloads lie outside. Where a device has no
//! timestamps, the host's clock stands in and the row says so.

mod cpu;
mod frame;
mod job;
mod pipelines;
mod profile;
mod rows;
mod scale;
mod scenes;
mod speed;
mod truth;
mod verify;

pub use job::{Entry, Job, Pace, measure};
pub use profile::{KernelShare, Profile, profile};
pub use scale::curves;
pub use speed::{
    Budget, ErrorMeasure, Shot, choose, measure_settings, still_scene, sweep, sweep_motion,
};

use crate::Result;
use crate::gpu::{Device, DeviceKind};
use crate::report::{Peaks, Machine, Row};

/// Every row, in the order of a report. `quick`: the small sizes only.
pub fn entries(quick: bool) -> Vec<Entry> {
    let mut all = rows::entries(quick);
    all.extend(cpu::entries(quick));
    all.extend(pipelines::entries(quick));
    all
}

/// What a device is, for the report.
pub fn machine(device: &Device) -> Machine {
    let info = device.info();
    Machine {
        device: info.name.clone(),
        driver: info.driver.clone(),
        kind: format!("{:?}", info.kind),
        software: info.kind == DeviceKind::Software,
        subgroup_size: info.subgroup_size,
        threads: std::thread::available_parallelism().map_or(1, usize::from),
    }
}

/// The most that a device copies and calculates, from the rows that measure it.
pub fn peaks(rows: &[Row]) -> Peaks {
    let most = |id: &str, rate: fn(&Row) -> Option<f64>| {
        rows.iter().filter(|row| row.id == id).filter_map(rate).reduce(f64::max)
    };
    Peaks {
        bytes: most("roofline/copy", Row::bandwidth),
        operations: most("roofline/fma", Row::throughput),
    }
}

/// The source's commit: `SPLAT4D_COMMIT` where it is set, else what `git` says of the folder that
/// the program was built in, where that still exists; `-dirty` where files differ from it.
pub fn commit() -> Option<String> {
    if let Ok(commit) = std::env::var("SPLAT4D_COMMIT") {
        return Some(commit);
    }
    let output = std::process::Command::new("git")
        .args(["-C", env!("CARGO_MANIFEST_DIR"), "describe", "--always", "--dirty", "--abbrev=12"])
        .stderr(std::process::Stdio::null())
        .output()
        .ok()?;
    let text = String::from_utf8(output.stdout).ok()?;
    let text = text.trim();
    (output.status.success() && !text.is_empty()).then(|| text.to_owned())
}

/// Measures the entries whose name holds `filter`, and the device's peaks in any case, one after
/// the other; `each` hears of every row.
///
/// # Errors
/// What `each` returns; a lost device. A row that cannot run on the device is a row without speed.
pub fn run(
    device: &Device,
    entries: &[Entry],
    filter: Option<&str>,
    pace: Pace,
    seed: u64,
    mut each: impl FnMut(&Row) -> Result<()>,
) -> Result<Vec<Row>> {
    let mut rows = Vec::new();
    let wanted = |entry: &&Entry| entry.matches(filter) || entry.id.starts_with("roofline/");
    for entry in entries.iter().filter(wanted) {
        let row = measure(device, entry, pace, seed)?;
        each(&row)?;
        rows.push(row);
    }
    Ok(rows)
}

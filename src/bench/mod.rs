//! Benchmarks: every op and pipeline is compared with the oracle and then timed; and speed is
//! measured against error.
//!
//! An [`Entry`] prepares a [`Job`]: it uploads its input, executes once, compares with the oracle in
//! f64, and counts the bytes and operations of one execution. [`measure`] times the job only if the
//! comparison passed. [`curves`] measures how time and memory grow with size. Times are device
//! times from timestamps around the submissions, without uploads and downloads. On a device without
//! timestamps the host's clock is used and the row states it.

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
use crate::report::{Machine, Peaks, Row};

/// Every row, in the order of a report. `quick`: the small sizes only.
pub fn entries(quick: bool) -> Vec<Entry> {
    let mut all = rows::entries(quick);
    all.extend(cpu::entries(quick));
    all.extend(pipelines::entries(quick));
    all
}

/// The description of a device for the report.
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

/// The peak bandwidth and peak arithmetic of a device, from the rows that measure them.
pub fn peaks(rows: &[Row]) -> Peaks {
    let most = |id: &str, rate: fn(&Row) -> Option<f64>| {
        rows.iter().filter(|row| row.id == id).filter_map(rate).reduce(f64::max)
    };
    Peaks {
        bytes: most("roofline/copy", Row::bandwidth),
        operations: most("roofline/fma", Row::throughput),
    }
}

/// The source's commit: `SPLAT4D_COMMIT` if it is set, else its value when the program was built, as packages
/// set it, else the commit that `git` reports for the folder in which the program was built, if that still
/// exists; with `-dirty` if files differ from it.
pub fn commit() -> Option<String> {
    if let Ok(commit) = std::env::var("SPLAT4D_COMMIT") {
        return Some(commit);
    }
    if let Some(commit) = option_env!("SPLAT4D_COMMIT") {
        return Some(commit.to_owned());
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

/// Measures the entries whose name contains `filter`, and always the device's peaks, one after the
/// other; `each` is called with every row.
///
/// # Errors
/// An error of `each`; a lost device. An entry that cannot run on the device gives a row without
/// speed.
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

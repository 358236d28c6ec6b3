//! Benchmark measurements as data, and their output as JSON, CSV, plots, an HTML page and comparisons.
//!
//! Times are in nanoseconds, rates per second. A row whose result misses its error bound has an error and
//! no time; [`Row::timed`] and [`Row::missed`] are the only ways to make one.
//!
//! [`Ablation`] reports the contribution of each component of a reconstruction. [`ResultTable`] reports the
//! results of a protocol on the scenes of a dataset, beside published ones.

mod ablation;
mod ablation_page;
mod compare;
mod csv;
mod curve;
mod html;
mod lines;
mod numbers;
mod plot;
mod spread;
mod table;
mod table_latex;
mod table_page;

use std::path::Path;

use serde::{Deserialize, Serialize};

pub use crate::types::Work;
pub use ablation::{Ablation, AblationRow, Better, Figure, Summary};
pub use compare::{Comparison, Verdict, compare};
pub use csv::{csv, record};
pub use curve::{Curve, CurvePoint, PowerLaw};
pub use html::{escape, page};
pub use lines::{LINE_COLOURS, Line, LinePlot};
pub use numbers::{duration, rate, scientific};
pub use spread::Spread;
pub use table::{PublishedRow, ResultTable, SceneRow};

use crate::{Error, Result, io};

/// Value of [`Measurements::format`] in files written by this version.
const FORMAT: u32 = 2;

/// All measurements of one benchmark run.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Measurements {
    /// Version of this file format.
    pub format: u32,
    /// Version of the crate.
    pub version: String,
    /// Commit of the source, where it is known.
    pub commit: Option<String>,
    /// End of the run, seconds since 1970.
    pub unix_seconds: u64,
    /// The machine that it ran on.
    pub machine: Machine,
    /// Measured peak rates of the device.
    #[serde(alias = "ceilings")]
    pub peaks: Peaks,
    /// One row per operation or pipeline and size.
    pub rows: Vec<Row>,
    /// Speed against error, by setting.
    pub sweeps: Vec<Sweep>,
    /// Settings chosen for an error budget, where one was given.
    pub choice: Option<Choice>,
    /// Scaling of time and memory with size, where it was requested.
    #[serde(default)]
    pub curves: Vec<Curve>,
}

/// The machine that measurements were made on.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Machine {
    /// Name of the Vulkan device.
    pub device: String,
    /// Name of its driver.
    pub driver: String,
    /// `Discrete`, `Integrated`, `Software`, …
    pub kind: String,
    /// Whether the device is a software implementation on the CPU; its times do not indicate those of a GPU.
    pub software: bool,
    /// Number of invocations in a subgroup.
    pub subgroup_size: u32,
    /// Number of hardware threads of the CPU.
    pub threads: usize,
}

/// Peak rates of a device, measured with kernels that do nothing else.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Peaks {
    /// Memory bandwidth of a copy, bytes read and written per second.
    pub bytes: Option<f64>,
    /// Arithmetic rate of f32 multiply-adds, operations per second.
    pub operations: Option<f64>,
}

/// Where a row's work was executed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Place {
    /// On the Vulkan device.
    Device,
    /// By scalar code on the CPU.
    Processor,
}

/// Clock that a time was measured with.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Clock {
    /// Timestamp queries on the device around the measured work only.
    Device,
    /// The host's clock, from submission to completion.
    Host,
}

/// Error of a result relative to the f64 oracle, and its bound.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Accuracy {
    /// Largest error of all compared values, as a share of the bound; above 1 fails. Infinite where the
    /// result is not finite, or an integer differs.
    #[serde(with = "numbers::maybe_infinite")]
    pub of_bound: f64,
    /// Largest error, in the output's unit.
    #[serde(with = "numbers::maybe_infinite")]
    pub error: f64,
    /// Name of the output with the largest share.
    pub output: String,
}

impl Accuracy {
    /// Whether all errors are within the bound.
    pub fn passed(&self) -> bool {
        self.of_bound <= 1.0
    }
}

/// One measurement.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Row {
    /// Identifier, `family/what`.
    pub id: String,
    /// Size of the input, in words.
    pub size: String,
    /// Where the work was executed.
    pub place: Place,
    /// Clock of the time.
    pub clock: Clock,
    /// Error relative to the oracle.
    pub accuracy: Accuracy,
    /// Data volume and arithmetic of one execution.
    pub work: Work,
    time: Option<Spread>,
}

impl Row {
    /// Makes a row with a time. If the accuracy fails, the row keeps its error and drops the time.
    pub fn timed(
        id: impl Into<String>,
        size: impl Into<String>,
        (place, clock): (Place, Clock),
        accuracy: Accuracy,
        work: Work,
        time: Spread,
    ) -> Row {
        let time = accuracy.passed().then_some(time);
        Row { id: id.into(), size: size.into(), place, clock, accuracy, work, time }
    }

    /// Makes a row that missed its error bound; it has no time.
    pub fn missed(
        id: impl Into<String>,
        size: impl Into<String>,
        place: Place,
        accuracy: Accuracy,
    ) -> Row {
        let (work, clock) = (Work::default(), Clock::Host);
        Row { id: id.into(), size: size.into(), place, clock, accuracy, work, time: None }
    }

    /// Time of an execution; `None` where the result missed its bound.
    pub fn time(&self) -> Option<&Spread> {
        self.time.as_ref().filter(|_| self.accuracy.passed())
    }

    /// Unique name of the row.
    pub fn name(&self) -> String {
        let place = match self.place {
            Place::Device => "",
            Place::Processor => " (processor)",
        };
        format!("{}{place}, {}", self.id, self.size)
    }

    /// Achieved bandwidth, bytes per second.
    pub fn bandwidth(&self) -> Option<f64> {
        self.per_second(self.work.bytes)
    }

    /// Achieved arithmetic rate, operations per second.
    pub fn throughput(&self) -> Option<f64> {
        self.per_second(self.work.operations)
    }

    fn per_second(&self, count: u64) -> Option<f64> {
        let time = self.time()?.median();
        (count > 0 && time > 0.0).then(|| count as f64 / time * 1e9)
    }

    /// The larger of the row's shares of the device's two peak rates; `None` for work on the CPU.
    pub fn share(&self, peaks: &Peaks) -> Option<f64> {
        if self.place == Place::Processor {
            return None;
        }
        let of = |rate: Option<f64>, most: Option<f64>| Some(rate? / most?);
        let (bytes, operations) =
            (of(self.bandwidth(), peaks.bytes), of(self.throughput(), peaks.operations));
        [bytes, operations].into_iter().flatten().reduce(f64::max)
    }
}

/// Error of an image relative to the f64 oracle's at the best settings.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct ImageError {
    /// Largest difference of any channel.
    pub max: f64,
    /// Root of the mean square.
    pub rmse: f64,
    /// PSNR in dB with a peak of 1; capped at 200, also for equal images.
    pub psnr: f64,
}

/// Measurements at one setting of the tuning parameters.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Point {
    /// The parameter that was changed; empty for the best settings.
    pub knob: String,
    /// Its value.
    pub value: String,
    /// All parameters, in the format of `--settings`.
    pub settings: serde_json::Value,
    /// Time per frame.
    pub time: Spread,
    /// Time per frame relative to the best settings, from samples taken in alternation, so that other load
    /// affects both alike.
    pub ratio: Spread,
    /// Error of the image.
    pub error: ImageError,
}

/// Measurements with the tuning parameters changed one after the other on one scene.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Sweep {
    /// Name of the scene.
    pub scene: String,
    /// Number of Gaussians.
    pub gaussians: usize,
    /// Width and height of the images, pixels.
    pub size: [u32; 2],
    /// Clock of the times.
    pub clock: Clock,
    /// The points.
    pub points: Vec<Point>,
}

impl Sweep {
    /// Indices of the Pareto-optimal points in time and error, in the order of time.
    pub fn front(&self, error: impl Fn(&ImageError) -> f64) -> Vec<usize> {
        let mut order: Vec<usize> = (0..self.points.len()).collect();
        let key = |i: usize| (self.points[i].ratio.median(), error(&self.points[i].error));
        order.sort_by(|&a, &b| key(a).partial_cmp(&key(b)).unwrap_or(std::cmp::Ordering::Equal));
        let mut best = f64::INFINITY;
        order.retain(|&i| {
            let better = key(i).1 < best;
            best = best.min(key(i).1);
            better
        });
        order
    }
}

/// The settings chosen for an error budget.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Choice {
    /// Name of the scene.
    pub scene: String,
    /// The error budget.
    pub budget: f64,
    /// Error measure: `max` or `rmse`.
    pub measure: String,
    /// The settings, in the format of `--settings`.
    pub settings: serde_json::Value,
    /// Time per frame with these settings over that with the best ones, on the view that the search did not
    /// use.
    pub time_ratio: f64,
    /// The error on that view.
    pub error: ImageError,
    /// Whether the budget is met on that view.
    pub met: bool,
    /// Number of views that the search used.
    pub views: usize,
}

impl Measurements {
    /// The files that [`Measurements::write_report`] writes to its folder.
    pub const REPORT_FILES: [&str; 3] = ["bench.json", "bench.csv", "index.html"];

    /// Empty measurements.
    pub fn new(machine: Machine, commit: Option<String>) -> Measurements {
        Measurements {
            format: FORMAT,
            version: env!("CARGO_PKG_VERSION").into(),
            commit,
            unix_seconds: 0,
            machine,
            peaks: Peaks::default(),
            rows: Vec::new(),
            sweeps: Vec::new(),
            choice: None,
            curves: Vec::new(),
        }
    }

    /// Reads a file written by [`save`](Self::save).
    ///
    /// # Errors
    /// The file is missing, is not such JSON, or has another format version.
    pub fn open(path: impl AsRef<Path>) -> Result<Measurements> {
        let path = path.as_ref();
        let value = io::read_json(path)?;
        let format = value.get("format").and_then(serde_json::Value::as_u64);
        if format != Some(u64::from(FORMAT)) {
            let what = format!(
                "is no result of `splat4d bench` in layout {FORMAT} (its `format` is {})",
                format.map_or("missing".into(), |f| f.to_string())
            );
            return Err(Error::format(path, what));
        }
        serde_json::from_value(value)
            .map_err(|e| Error::format(path, format!("is no result of `splat4d bench`: {e}")))
    }

    /// Writes the measurements as JSON, by rename.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn save(&self, path: impl AsRef<Path>) -> Result<()> {
        io::write_atomically(path, |sink| {
            serde_json::to_writer_pretty(sink, self).map_err(std::io::Error::other)
        })
    }

    /// Writes `bench.json`, `bench.csv` and `index.html` to a folder.
    ///
    /// # Errors
    /// The folder cannot be written, or a plot could not be drawn.
    pub fn write_report(&self, folder: impl AsRef<Path>) -> Result<()> {
        use std::io::Write;
        let folder = folder.as_ref();
        let page = page(self)?;
        let [results, rows, whole] = Measurements::REPORT_FILES.map(|name| folder.join(name));
        self.save(results)?;
        let table = csv(self);
        io::write_atomically(rows, |s| s.write_all(table.as_bytes()))?;
        io::write_atomically(whole, |s| s.write_all(page.as_bytes()))
    }
}

#[cfg(test)]
mod tests;

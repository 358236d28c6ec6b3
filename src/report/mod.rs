//! Measurements as data, and what is made of them: JSON, CSV, plots, one page, comparisons.
//!
//! Times are nanoseconds, rates are per second. A row whose result misses its bound has an error and
//! no time; [`Row::timed`] and [`Row::missed`] are the only ways to make one.
//!
//! [`Ablation`] is what the components of a reconstruction are worth, [`ResultTable`] what a protocol finds on the
//! scenes of a data set, beside published figures.

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

/// What [`Measurements::format`] says of files written by this version.
const FORMAT: u32 = 2;

/// Everything that one run of the benchmark measured.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Measurements {
    /// Version of this layout.
    pub format: u32,
    /// Version of the crate.
    pub version: String,
    /// The source's commit, where it is known.
    pub commit: Option<String>,
    /// When it ended, in seconds since 1970.
    pub unix_seconds: u64,
    /// What it ran on.
    pub machine: Machine,
    /// What that can do at most.
    #[serde(alias = "ceilings")]
    pub peaks: Peaks,
    /// One per op or pipeline and size.
    pub rows: Vec<Row>,
    /// Speed against error.
    pub sweeps: Vec<Sweep>,
    /// What was chosen for an error budget, where one was given.
    pub choice: Option<Choice>,
    /// Time and memory against size, where these were asked for.
    #[serde(default)]
    pub curves: Vec<Curve>,
}

/// What measurements were made on.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Machine {
    /// The Vulkan device.
    pub device: String,
    /// Its driver.
    pub driver: String,
    /// `Discrete`, `Integrated`, `Software`, …
    pub kind: String,
    /// Whether the processor does the device's work: its times say nothing of a GPU.
    pub software: bool,
    /// Lanes of a subgroup.
    pub subgroup_size: u32,
    /// Threads of the processor.
    pub threads: usize,
}

/// The most that a device was seen to do, by kernels that do nothing else.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Peaks {
    /// Bytes read and written by a copy, a second.
    pub bytes: Option<f64>,
    /// Operations of multiply-adds in f32, a second.
    pub operations: Option<f64>,
}

/// Where a row's work was done.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Place {
    /// On the Vulkan device.
    Device,
    /// By plain code on the processor.
    Processor,
}

/// What a time was read from.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Clock {
    /// Timestamps on the device around the work alone.
    Device,
    /// The host's clock, from submission to the end.
    Host,
}

/// How far a result lies from the oracle in f64, and how far it may.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Accuracy {
    /// Largest difference over all that was compared, as a share of the bound: above 1 fails.
    /// Infinite where the result is not finite, or an integer differs.
    #[serde(with = "numbers::maybe_infinite")]
    pub of_bound: f64,
    /// Largest difference, in the output's unit.
    #[serde(with = "numbers::maybe_infinite")]
    pub error: f64,
    /// The output in which the largest share lies.
    pub output: String,
}

impl Accuracy {
    /// Whether all is within its bound.
    pub fn passed(&self) -> bool {
        self.of_bound <= 1.0
    }
}

/// What one execution moves and calculates, counted from the data it ran on: every input once,
/// every output once, per dispatch; an addition, a multiplication or a transcendental is one
/// operation. For integer work such as a sort, an operation is one on a key.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Work {
    /// Bytes read and written.
    pub bytes: u64,
    /// Operations.
    pub operations: u64,
}

/// One measurement.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Row {
    /// `family/what`.
    pub id: String,
    /// The size of the input, in words.
    pub size: String,
    /// Where the work was done.
    pub place: Place,
    /// What the time was read from.
    pub clock: Clock,
    /// The result against the oracle.
    pub accuracy: Accuracy,
    /// What one execution does.
    pub work: Work,
    time: Option<Spread>,
}

impl Row {
    /// A row that passed, with its time. One that did not pass keeps its error and loses its time.
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

    /// A row that missed its bound: it has no time.
    pub fn missed(
        id: impl Into<String>,
        size: impl Into<String>,
        place: Place,
        accuracy: Accuracy,
    ) -> Row {
        let (work, clock) = (Work::default(), Clock::Host);
        Row { id: id.into(), size: size.into(), place, clock, accuracy, work, time: None }
    }

    /// How long it took; `None` where the result missed its bound.
    pub fn time(&self) -> Option<&Spread> {
        self.time.as_ref().filter(|_| self.accuracy.passed())
    }

    /// What tells rows apart.
    pub fn name(&self) -> String {
        let place = match self.place {
            Place::Device => "",
            Place::Processor => " (processor)",
        };
        format!("{}{place}, {}", self.id, self.size)
    }

    /// Bytes a second.
    pub fn bandwidth(&self) -> Option<f64> {
        self.per_second(self.work.bytes)
    }

    /// Operations a second.
    pub fn throughput(&self) -> Option<f64> {
        self.per_second(self.work.operations)
    }

    fn per_second(&self, count: u64) -> Option<f64> {
        let time = self.time()?.median();
        (count > 0 && time > 0.0).then(|| count as f64 / time * 1e9)
    }

    /// The larger of the shares of the device's two peaks that the row reaches; `None` for work
    /// on the processor.
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

/// How far an image lies from the oracle's in f64 at the best settings.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct ImageError {
    /// Largest difference of a channel.
    pub max: f64,
    /// Root of the mean square.
    pub rmse: f64,
    /// Decibels against 1; capped at 200, where the images are equal.
    pub psnr: f64,
}

/// One setting of the knobs.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Point {
    /// The knob that was turned; empty for all at their best.
    pub knob: String,
    /// What it was turned to.
    pub value: String,
    /// All knobs, as `--settings` reads them.
    pub settings: serde_json::Value,
    /// Time of a frame.
    pub time: Spread,
    /// Time of a frame over that with all knobs at their best, sample by sample in turns, so that
    /// whatever else the machine does weighs on both.
    pub ratio: Spread,
    /// What the image lost.
    pub error: ImageError,
}

/// Knobs turned one after the other on one scene.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Sweep {
    /// The scene.
    pub scene: String,
    /// Its number of Gaussians.
    pub gaussians: usize,
    /// Width and height of the images.
    pub size: [u32; 2],
    /// What the time was read from.
    pub clock: Clock,
    /// The points.
    pub points: Vec<Point>,
}

impl Sweep {
    /// Indices of the points that no other beats in both time and error, by time.
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
    /// The scene.
    pub scene: String,
    /// The error that was allowed.
    pub budget: f64,
    /// `max` or `rmse`.
    pub measure: String,
    /// The settings, as `--settings` reads them.
    pub settings: serde_json::Value,
    /// Time of a frame with them over that without, on the view that the search did not use.
    pub time_ratio: f64,
    /// The error on that view.
    pub error: ImageError,
    /// Whether it is within the budget there.
    pub met: bool,
    /// Views that the search used.
    pub views: usize,
}

impl Measurements {
    /// What [`Measurements::write_report`] writes into its folder.
    pub const REPORT_FILES: [&str; 3] = ["bench.json", "bench.csv", "index.html"];

    /// Nothing measured yet.
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

    /// Reads a file that [`save`](Self::save) wrote.
    ///
    /// # Errors
    /// A file that is missing, is no such JSON, or is of another version's layout.
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

    /// Writes JSON, by rename.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn save(&self, path: impl AsRef<Path>) -> Result<()> {
        io::write_atomically(path, |sink| {
            serde_json::to_writer_pretty(sink, self).map_err(std::io::Error::other)
        })
    }

    /// Writes `bench.json`, `bench.csv` and `index.html` into a folder.
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

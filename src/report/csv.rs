//! Rows and points as one CSV table (RFC 4180).

use super::{Clock, Curve, CurvePoint, Measurements, Place, Point, Row, Spread, Sweep};

/// CSV with one line per row and per point of a sweep or a curve. A row that missed its error bound has no
/// times; for a curve, bytes are those of the device memory.
pub fn csv(measured: &Measurements) -> String {
    let mut table = String::new();
    record(&mut table, Line::default().columns().map(|(name, _)| name.to_owned()));
    let mut add = |line: Line| record(&mut table, line.columns().map(|(_, value)| value));
    for row in &measured.rows {
        add(Line::of_row(measured, row));
    }
    for sweep in &measured.sweeps {
        sweep.points.iter().for_each(|point| add(Line::of_sweep(measured, sweep, point)));
    }
    for curve in &measured.curves {
        curve.points.iter().for_each(|point| add(Line::of_curve(measured, curve, point)));
    }
    table
}

/// A line of the table; what its kind does not have is empty.
#[derive(Default)]
struct Line {
    kind: String,
    id: String,
    size: String,
    place: &'static str,
    /// Clock, device, driver, whether it is a software driver, commit.
    run: [String; 5],
    /// Median and quartiles in nanoseconds, number of samples.
    times: [String; 4],
    over_best_settings: String,
    bytes: String,
    operations: String,
    share_of_peak: String,
    error: String,
    error_of_bound: String,
    rmse: String,
    psnr: String,
}

impl Line {
    fn of_row(measured: &Measurements, row: &Row) -> Line {
        Line {
            kind: "row".into(),
            id: row.id.clone(),
            size: row.size.clone(),
            place: match row.place {
                Place::Device => "device",
                Place::Processor => "processor",
            },
            run: run(measured, row.clock),
            times: times(row.time()),
            bytes: row.work.bytes.to_string(),
            operations: row.work.operations.to_string(),
            share_of_peak: row.share(&measured.peaks).map_or(String::new(), |s| s.to_string()),
            error: row.accuracy.error.to_string(),
            error_of_bound: row.accuracy.of_bound.to_string(),
            ..Line::default()
        }
    }

    fn of_sweep(measured: &Measurements, sweep: &Sweep, point: &Point) -> Line {
        let [width, height] = sweep.size;
        Line {
            kind: format!("sweep of {}", sweep.scene),
            id: point.knob.clone(),
            size: format!("{}; {width}×{height}", point.value),
            place: "device",
            run: run(measured, sweep.clock),
            times: times(Some(&point.time)),
            over_best_settings: point.ratio.median().to_string(),
            error: point.error.max.to_string(),
            rmse: point.error.rmse.to_string(),
            psnr: point.error.psnr.to_string(),
            ..Line::default()
        }
    }

    fn of_curve(measured: &Measurements, curve: &Curve, point: &CurvePoint) -> Line {
        let bytes = point.taken.or(point.foreseen);
        Line {
            kind: format!("curve over {}", curve.axis),
            id: curve.pipeline.clone(),
            size: point.size.to_string(),
            place: "device",
            run: run(measured, curve.clock),
            times: times(point.time.as_ref()),
            bytes: bytes.map_or(String::new(), |bytes| bytes.to_string()),
            ..Line::default()
        }
    }

    /// Name and value of each column, in order.
    fn columns(self) -> [(&'static str, String); 21] {
        let [clock, device, driver, software, commit] = self.run;
        let [median, low, high, samples] = self.times;
        [
            ("kind", self.kind),
            ("id", self.id),
            ("size", self.size),
            ("place", self.place.into()),
            ("clock", clock),
            ("device", device),
            ("driver", driver),
            ("software", software),
            ("commit", commit),
            ("median_ns", median),
            ("quartile_1_ns", low),
            ("quartile_3_ns", high),
            ("samples", samples),
            ("over_best_settings", self.over_best_settings),
            ("bytes", self.bytes),
            ("operations", self.operations),
            ("share_of_peak", self.share_of_peak),
            ("error", self.error),
            ("error_of_bound", self.error_of_bound),
            ("rmse", self.rmse),
            ("psnr_db", self.psnr),
        ]
    }
}

fn run(measured: &Measurements, clock: Clock) -> [String; 5] {
    let clock = match clock {
        Clock::Device => "device",
        Clock::Host => "host",
    };
    [
        clock.to_owned(),
        measured.machine.device.clone(),
        measured.machine.driver.clone(),
        measured.machine.software.to_string(),
        measured.commit.clone().unwrap_or_default(),
    ]
}

fn times(spread: Option<&Spread>) -> [String; 4] {
    let Some(spread) = spread else { return Default::default() };
    let [low, high] = spread.quartiles();
    [
        spread.median().to_string(),
        low.to_string(),
        high.to_string(),
        spread.samples().len().to_string(),
    ]
}

/// Appends a record to a table.
pub fn record(table: &mut String, fields: impl IntoIterator<Item = String>) {
    let quoted = |field: String| match field.contains([',', '"', '\n', '\r']) {
        true => format!("\"{}\"", field.replace('"', "\"\"")),
        false => field,
    };
    table.push_str(&fields.into_iter().map(quoted).collect::<Vec<_>>().join(","));
    table.push_str("\r\n");
}

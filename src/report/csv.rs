//! Rows and points as one CSV table (RFC 4180).

use super::{Clock, Measurements, Place, Spread};

const HEADER: [&str; 21] = [
    "kind",
    "id",
    "size",
    "place",
    "clock",
    "device",
    "driver",
    "software",
    "commit",
    "median_ns",
    "quartile_1_ns",
    "quartile_3_ns",
    "samples",
    "over_best_settings",
    "bytes",
    "operations",
    "share_of_peak",
    "error",
    "error_of_bound",
    "rmse",
    "psnr_db",
];

/// CSV with one line per row and per point of a sweep or a curve. A row that missed its error bound has no
/// times; for a curve, bytes are those of the device memory.
pub fn csv(measured: &Measurements) -> String {
    let mut table = String::new();
    line(&mut table, HEADER.map(str::to_owned));
    let about = |clock: Clock| {
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
    };
    for row in &measured.rows {
        let place = match row.place {
            Place::Device => "device",
            Place::Processor => "processor",
        };
        let [clock, device, driver, software, commit] = about(row.clock);
        let [median, low, high, samples] = times(row.time());
        let share = row.share(&measured.peaks).map_or(String::new(), |s| s.to_string());
        let (work, accuracy) = (row.work, &row.accuracy);
        line(
            &mut table,
            [
                "row".into(),
                row.id.clone(),
                row.size.clone(),
                place.into(),
                clock,
                device,
                driver,
                software,
                commit,
                median,
                low,
                high,
                samples,
                String::new(),
                work.bytes.to_string(),
                work.operations.to_string(),
                share,
                accuracy.error.to_string(),
                accuracy.of_bound.to_string(),
                String::new(),
                String::new(),
            ],
        );
    }
    for sweep in &measured.sweeps {
        for point in &sweep.points {
            let [clock, device, driver, software, commit] = about(sweep.clock);
            let [median, low, high, samples] = times(Some(&point.time));
            let [width, height] = sweep.size;
            line(
                &mut table,
                [
                    format!("sweep of {}", sweep.scene),
                    point.knob.clone(),
                    format!("{}; {width}×{height}", point.value),
                    "device".into(),
                    clock,
                    device,
                    driver,
                    software,
                    commit,
                    median,
                    low,
                    high,
                    samples,
                    point.ratio.median().to_string(),
                    String::new(),
                    String::new(),
                    String::new(),
                    point.error.max.to_string(),
                    String::new(),
                    point.error.rmse.to_string(),
                    point.error.psnr.to_string(),
                ],
            );
        }
    }
    for curve in &measured.curves {
        for point in &curve.points {
            let [clock, device, driver, software, commit] = about(curve.clock);
            let [median, low, high, samples] = times(point.time.as_ref());
            let bytes = point.taken.or(point.foreseen).map_or(String::new(), |b| b.to_string());
            let none = String::new;
            line(
                &mut table,
                [
                    format!("curve over {}", curve.axis),
                    curve.pipeline.clone(),
                    point.size.to_string(),
                    "device".into(),
                    clock,
                    device,
                    driver,
                    software,
                    commit,
                    median,
                    low,
                    high,
                    samples,
                    none(),
                    bytes,
                    none(),
                    none(),
                    none(),
                    none(),
                    none(),
                    none(),
                ],
            );
        }
    }
    table
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

fn line(table: &mut String, fields: [String; HEADER.len()]) {
    record(table, fields);
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

//! The benchmark report as one self-contained page, without scripts, fonts or images from elsewhere.

use std::fmt::Write;

use super::numbers::{duration, rate, scientific};
use super::{
    Choice, Clock, Curve, CurvePoint, Machine, Measurements, Place, PowerLaw, Row, Spread, Sweep,
    plot,
};
use crate::Result;

pub(super) const STYLE: &str = "\
body{font:15px/1.5 system-ui,sans-serif;max-width:76rem;margin:2rem auto;padding:0 1rem;color:#222}\
h1,h2,h3{line-height:1.2}table{border-collapse:collapse;margin:1rem 0;font-size:13px}\
th,td{padding:.2rem .6rem;text-align:right;border-bottom:1px solid #ddd;white-space:nowrap}\
th:first-child,td:first-child{text-align:left}thead th{border-bottom:2px solid #888}\
.missed{background:#fdd}.tag{background:#ffe9b0;border-radius:3px;padding:0 .4em;font-size:12px}\
.wide{overflow-x:auto}figure{display:inline-block;margin:0 1rem 1rem 0}svg{max-width:100%}\
code{background:#f3f3f3;padding:0 .2em}";

/// The report as an HTML page.
///
/// # Errors
/// A plot could not be drawn.
pub fn page(measured: &Measurements) -> Result<String> {
    let machine = &measured.machine;
    let mut body = String::new();
    about(&mut body, measured);
    for sweep in &measured.sweeps {
        speed_against_error(&mut body, sweep)?;
    }
    if let Some(choice) = &measured.choice {
        chosen(&mut body, choice);
    }
    scale(&mut body, &measured.curves)?;
    rows(&mut body, measured);
    Ok(format!(
        "<!doctype html>\n<html lang=\"en\"><head><meta charset=\"utf-8\">\
         <meta name=\"viewport\" content=\"width=device-width,initial-scale=1\">\
         <link rel=\"icon\" href=\"data:,\">\
         <title>splat4d bench: {}</title><style>{STYLE}</style></head><body>\n{body}</body></html>\n",
        escape(&machine.device)
    ))
}

/// Escapes text for HTML elements and attributes.
pub fn escape(text: &str) -> String {
    let mut out = String::with_capacity(text.len());
    for c in text.chars() {
        match c {
            '&' => out.push_str("&amp;"),
            '<' => out.push_str("&lt;"),
            '>' => out.push_str("&gt;"),
            '"' => out.push_str("&quot;"),
            '\'' => out.push_str("&#39;"),
            c => out.push(c),
        }
    }
    out
}

fn about(body: &mut String, measured: &Measurements) {
    let Machine { device, driver, kind, software, subgroup_size, threads } = &measured.machine;
    let tag = if *software { " <span class=\"tag\">software driver</span>" } else { "" };
    let peak = |value: Option<f64>, unit: &str| {
        value.map_or("not measured".to_owned(), |value| rate(value, unit))
    };
    let facts = [
        ("Device", format!("{}{tag}", escape(device))),
        ("Driver", escape(driver)),
        ("Kind", format!("{}, subgroups of {subgroup_size}", escape(kind))),
        ("Processor threads", threads.to_string()),
        ("splat4d", escape(&measured.version)),
        ("Commit", escape(measured.commit.as_deref().unwrap_or("not known"))),
        ("Measured", date(measured.unix_seconds)),
        ("Most that it copies", peak(measured.peaks.bytes, "B")),
        ("Most that it calculates", peak(measured.peaks.operations, "flop")),
    ];
    body.push_str("<h1>splat4d bench</h1>\n<table>");
    for (name, value) in facts {
        let _ = write!(body, "<tr><th>{name}</th><td>{value}</td></tr>");
    }
    body.push_str("</table>\n");
    if *software {
        body.push_str(
            "<p>A software driver runs on the processor: its times compare versions of this \
             program with each other, and say nothing of a GPU.</p>\n",
        );
    }
}

/// Time in RFC 3339 format, UTC.
fn date(unix_seconds: u64) -> String {
    let since = std::time::Duration::from_secs(unix_seconds);
    match std::time::UNIX_EPOCH.checked_add(since) {
        // The format does not exist beyond the year 9999.
        Some(time) if unix_seconds < 253_402_300_800 => {
            humantime::format_rfc3339_seconds(time).to_string()
        }
        _ => format!("{unix_seconds} s after 1970"),
    }
}

fn speed_against_error(body: &mut String, sweep: &Sweep) -> Result<()> {
    let [width, height] = sweep.size;
    let _ = write!(
        body,
        "<h2>Speed against error: {}</h2>\n<p>{} Gaussians, {width}×{height}, {}. The error is \
         against the image that the oracle renders in f64 with every knob at its best; the line \
         joins the settings that no other beats in both. Each setting was timed in turns with the \
         best ones; what counts is the ratio.</p>\n",
        escape(&sweep.scene),
        sweep.gaussians,
        clock(sweep.clock)
    );
    let largest = plot::pareto(sweep, "largest error of a channel", |e| e.max)?;
    let mean = plot::pareto(sweep, "root mean square error", |e| e.rmse)?;
    let _ = writeln!(body, "<figure>{largest}</figure><figure>{mean}</figure>");
    let (by_max, by_rmse) = (sweep.front(|e| e.max), sweep.front(|e| e.rmse));
    body.push_str(
        "<div class=\"wide\"><table><thead><tr><th>knob</th><th>value</th><th>median</th>\
         <th>quartiles</th><th>time over best</th><th>quartiles</th><th>largest error</th>\
         <th>RMSE</th><th>PSNR</th><th>unbeaten</th></tr></thead><tbody>",
    );
    for (i, point) in sweep.points.iter().enumerate() {
        let [low, high] = point.ratio.quartiles();
        let knob = if point.knob.is_empty() { "all at their best" } else { &point.knob };
        let unbeaten = match (by_max.contains(&i), by_rmse.contains(&i)) {
            (true, true) => "both",
            (true, false) => "largest",
            (false, true) => "RMSE",
            (false, false) => "",
        };
        let _ = write!(
            body,
            "<tr><td>{}</td><td>{}</td>{}<td>{:.3}</td><td>{low:.3} to {high:.3}</td><td>{}</td>\
             <td>{}</td><td>{:.1} dB</td><td>{unbeaten}</td></tr>",
            escape(knob),
            escape(&point.value),
            times(Some(&point.time)),
            point.ratio.median(),
            scientific(point.error.max),
            scientific(point.error.rmse),
            point.error.psnr
        );
    }
    body.push_str("</tbody></table></div>\n");
    Ok(())
}

fn chosen(body: &mut String, choice: &Choice) {
    let met = if choice.met { "met" } else { "<b>missed</b>" };
    let _ = write!(
        body,
        "<h2>Settings for an error of {}</h2>\n<p>{}, {} error; searched on {} views. On a view \
         that the search did not use the budget is {met}: largest {}, RMSE {}, PSNR {:.1} dB, in \
         {:.3} of the time of the best settings.</p>\n<p><code>{}</code></p>\n",
        choice.budget,
        escape(&choice.scene),
        escape(&choice.measure),
        choice.views,
        scientific(choice.error.max),
        scientific(choice.error.rmse),
        choice.error.psnr,
        choice.time_ratio,
        escape(&choice.settings.to_string())
    );
}

/// Bytes per mebibyte.
const MEBI: f64 = 1_048_576.0;

fn scale(body: &mut String, curves: &[Curve]) -> Result<()> {
    let mut axes: Vec<&str> = Vec::new();
    for curve in curves {
        if !axes.contains(&curve.axis.as_str()) {
            axes.push(&curve.axis);
        }
    }
    for axis in axes {
        let of: Vec<&Curve> = curves.iter().filter(|curve| curve.axis == axis).collect();
        let _ = writeln!(body, "<h2>Time and memory against {}</h2>", escape(axis));
        let time = plot::growth(&of, "milliseconds", 1e6, Curve::times)?;
        let memory = plot::growth(&of, "MiB of device memory", MEBI, Curve::bytes)?;
        let _ = writeln!(body, "<figure>{time}</figure><figure>{memory}</figure>");
        for curve in of {
            one_curve(body, curve);
        }
    }
    Ok(())
}

fn one_curve(body: &mut String, curve: &Curve) {
    let law = |law: Option<PowerLaw>| {
        law.map_or("not enough points".to_owned(), |law| {
            let [from, to] = law.range;
            let PowerLaw { exponent, off, .. } = law;
            format!("size^{exponent:.2} from {from} to {to} (points off by up to {off:.2} times)")
        })
    };
    let _ = write!(
        body,
        "<h3>{}</h3>\n<p>{}; {}. Time ~ {}; between the two largest ~ {}. Memory ~ {}.</p>\n\
         <div class=\"wide\"><table><thead><tr><th>{}</th><th>median</th><th>quartiles</th>\
         <th>memory foreseen</th><th>memory taken</th><th>dearest kernels</th></tr></thead><tbody>",
        escape(&curve.pipeline),
        escape(&curve.held),
        clock(curve.clock),
        law(curve.time_law()),
        curve.last_law().map_or("unknown".into(), |law| format!("size^{:.2}", law.exponent)),
        law(curve.memory_law()),
        escape(&curve.axis),
    );
    let mebi = |bytes: Option<u64>| {
        bytes.map_or(String::new(), |bytes| format!("{:.1} MiB", bytes as f64 / MEBI))
    };
    for point in &curve.points {
        let CurvePoint { size, time, foreseen, taken, left_out, kernels } = point;
        let cells = match left_out {
            Some(why) => format!("<td colspan=\"2\">{}</td>", escape(why)),
            None => times(time.as_ref()),
        };
        let dearest: Vec<String> =
            kernels.iter().take(3).map(|(k, time)| format!("{k} {}", duration(*time))).collect();
        let _ = write!(
            body,
            "<tr><td>{size}</td>{cells}<td>{}</td><td>{}</td><td>{}</td></tr>",
            mebi(*foreseen),
            mebi(*taken),
            escape(&dearest.join(", "))
        );
    }
    body.push_str("</tbody></table></div>\n");
}

fn rows(body: &mut String, measured: &Measurements) {
    if measured.rows.is_empty() {
        return;
    }
    body.push_str(
        "<h2>Ops and pipelines</h2>\n<p>Every row was held against the oracle in f64 before it was \
         timed; one that misses its bound has no speed. Bytes and operations are counted from the \
         row's own data: every input and output of a dispatch once.</p>\n\
         <div class=\"wide\"><table><thead><tr><th>row</th><th>size</th><th>median</th>\
         <th>quartiles</th><th>bandwidth</th><th>operations</th><th>share of peak</th>\
         <th>largest error</th><th>of its bound</th><th>clock</th></tr></thead><tbody>",
    );
    for row in &measured.rows {
        one_row(body, row, measured);
    }
    body.push_str("</tbody></table></div>\n");
}

fn one_row(body: &mut String, row: &Row, measured: &Measurements) {
    let missed = if row.accuracy.passed() { "" } else { " class=\"missed\"" };
    let tag = match row.place {
        Place::Processor => " <span class=\"tag\">processor</span>",
        Place::Device if measured.machine.software => " <span class=\"tag\">software</span>",
        Place::Device => "",
    };
    let show = |rate: Option<String>| rate.unwrap_or_default();
    let _ = write!(
        body,
        "<tr{missed}><td>{}{tag}</td><td>{}</td>{}<td>{}</td><td>{}</td><td>{}</td><td>{}</td>\
         <td>{}</td><td>{}</td></tr>",
        escape(&row.id),
        escape(&row.size),
        times(row.time()),
        show(row.bandwidth().map(|r| rate(r, "B"))),
        show(row.throughput().map(|r| rate(r, "op"))),
        show(row.share(&measured.peaks).map(|s| format!("{:.1} %", 100.0 * s))),
        scientific(row.accuracy.error),
        match row.accuracy.passed() {
            true => format!("{:.2}", row.accuracy.of_bound),
            false => format!(
                "{} missed in {}",
                scientific(row.accuracy.of_bound),
                escape(&row.accuracy.output)
            ),
        },
        clock(row.clock)
    );
}

/// Median and quartiles as two table cells.
fn times(spread: Option<&Spread>) -> String {
    let Some(spread) = spread else { return "<td>no speed</td><td></td>".into() };
    let [low, high] = spread.quartiles();
    format!(
        "<td>{}</td><td>{} to {}</td>",
        duration(spread.median()),
        duration(low),
        duration(high)
    )
}

fn clock(clock: Clock) -> &'static str {
    match clock {
        Clock::Device => "device timestamps",
        Clock::Host => "host clock",
    }
}

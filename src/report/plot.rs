//! Plots of speed against error, and of scaling with size, as SVG.

use super::{Curve, ImageError, PowerLaw, Sweep};
use crate::{Error, Result};
use plotters::coord::combinators::WithKeyPoints;
use plotters::prelude::*;

const SIZE: (u32, u32) = (820, 460);
/// Width of the legend with the parameter names, pixels.
const LEGEND: u32 = 150;
/// Lower end of the logarithmic error axis; smaller errors, including 0, are drawn here.
const FLOOR: f64 = 1e-9;
/// One colour per parameter, distinguishable for most people (Okabe and Ito's, and three more).
pub(super) const COLOURS: [RGBColor; 10] = [
    RGBColor(0, 0, 0),
    RGBColor(230, 159, 0),
    RGBColor(86, 180, 233),
    RGBColor(0, 158, 115),
    RGBColor(0, 114, 178),
    RGBColor(213, 94, 0),
    RGBColor(204, 121, 167),
    RGBColor(120, 120, 120),
    RGBColor(200, 190, 40),
    RGBColor(140, 20, 40),
];

/// Time per frame relative to the best settings against `error`, both logarithmic; the line joins the
/// Pareto-optimal points.
pub(super) fn pareto(
    sweep: &Sweep,
    title: &str,
    error: impl Fn(&ImageError) -> f64,
) -> Result<String> {
    let mut svg = String::new();
    draw(&mut svg, sweep, title, error).map_err(|e| {
        Error::Failed(format!("the plot of {} could not be drawn: {e}", sweep.scene))
    })?;
    Ok(svg)
}

fn draw(
    svg: &mut String,
    sweep: &Sweep,
    title: &str,
    error: impl Fn(&ImageError) -> f64,
) -> std::result::Result<(), Box<dyn std::error::Error>> {
    let at = |i: usize| {
        let point = &sweep.points[i];
        (point.ratio.median(), error(&point.error).max(FLOOR))
    };
    let all: Vec<(f64, f64)> = (0..sweep.points.len()).map(at).collect();
    let (x, y) = (range(all.iter().map(|p| p.0), 1.15), range(all.iter().map(|p| p.1), 2.0));
    let root = SVGBackend::with_string(svg, SIZE).into_drawing_area();
    root.fill(&WHITE)?;
    let (left, legend) = root.split_horizontally(SIZE.0 - LEGEND);
    let mut chart = ChartBuilder::on(&left)
        .margin(10)
        .x_label_area_size(42)
        .y_label_area_size(70)
        .build_cartesian_2d(ticked(x), (y.0..y.1).log_scale())?;
    chart
        .configure_mesh()
        .x_desc("time of a frame over that of the best settings")
        .y_desc(title)
        .x_label_formatter(&|v| format!("{v}"))
        .y_label_formatter(&|v| format!("{v:.0e}"))
        .light_line_style(WHITE.mix(0.0))
        .draw()?;
    let front: Vec<(f64, f64)> = sweep.front(&error).into_iter().map(at).collect();
    chart.draw_series(LineSeries::new(front, BLACK.mix(0.35).stroke_width(2)))?;
    let mut knobs: Vec<&str> = Vec::new();
    for point in &sweep.points {
        if !knobs.contains(&point.knob.as_str()) {
            knobs.push(&point.knob);
        }
    }
    for (number, knob) in knobs.iter().enumerate() {
        let colour = COLOURS[number % COLOURS.len()];
        let of = (0..sweep.points.len()).filter(|&i| sweep.points[i].knob == *knob);
        let label = if knob.is_empty() { "all at their best" } else { knob };
        chart.draw_series(of.map(|i| Circle::new(all[i], 5, colour.filled())))?;
        let y = 30 + 22 * number as i32;
        legend.draw(&Circle::new((12, y), 5, colour.filled()))?;
        legend.draw(&Text::new(label.to_owned(), (24, y - 6), ("sans-serif", 13)))?;
    }
    root.present()?;
    Ok(())
}

/// Values of curves against their size, both logarithmic, each with its power law.
pub(super) fn growth(
    curves: &[&Curve],
    title: &str,
    unit: f64,
    of: impl Fn(&Curve) -> Vec<(u64, f64)>,
) -> Result<String> {
    let mut svg = String::new();
    let lines: Vec<(&Curve, Vec<(u64, f64)>)> = curves
        .iter()
        .map(|&curve| (curve, of(curve).iter().map(|&(s, v)| (s, v / unit)).collect()))
        .collect();
    draw_growth(&mut svg, &lines, title)
        .map_err(|e| Error::Failed(format!("the plot of {title} could not be drawn: {e}")))?;
    Ok(svg)
}

fn draw_growth(
    svg: &mut String,
    lines: &[(&Curve, Vec<(u64, f64)>)],
    title: &str,
) -> std::result::Result<(), Box<dyn std::error::Error>> {
    let all = || lines.iter().flat_map(|(_, points)| points);
    let (x, y) = (range(all().map(|p| p.0 as f64), 1.3), range(all().map(|p| p.1), 1.5));
    let root = SVGBackend::with_string(svg, SIZE).into_drawing_area();
    root.fill(&WHITE)?;
    let (left, legend) = root.split_horizontally(SIZE.0 - LEGEND);
    let mut chart = ChartBuilder::on(&left)
        .margin(10)
        .x_label_area_size(42)
        .y_label_area_size(70)
        .build_cartesian_2d((x.0..x.1).log_scale(), (y.0..y.1).log_scale())?;
    let axis = lines.first().map_or("", |(curve, _)| curve.axis.as_str());
    chart
        .configure_mesh()
        .x_desc(axis)
        .y_desc(title)
        .x_label_formatter(&|v| format!("{v}"))
        .y_label_formatter(&|v| format!("{v}"))
        .light_line_style(WHITE.mix(0.0))
        .draw()?;
    for (number, (curve, points)) in lines.iter().enumerate() {
        let colour = COLOURS[(number + 4) % COLOURS.len()];
        chart.draw_series(
            points.iter().map(|&(s, v)| Circle::new((s as f64, v), 4, colour.filled())),
        )?;
        let y = 30 + 40 * number as i32;
        legend.draw(&Circle::new((12, y), 5, colour.filled()))?;
        let label = |text: String, below: i32| {
            legend.draw(&Text::new(text, (24, y - 6 + below), ("sans-serif", 12)))
        };
        label(curve.pipeline.clone(), 0)?;
        if let Some(law) = PowerLaw::fit(points) {
            let ends = law.range.map(|size| (size as f64, law.at(size as f64)));
            chart.draw_series(LineSeries::new(ends, colour.mix(0.5).stroke_width(2)))?;
            label(format!("~ size^{:.2}", law.exponent), 16)?;
        }
    }
    root.present()?;
    Ok(())
}

/// A logarithmic axis of ratios with closer ticks than powers of ten.
fn ticked((low, high): (f64, f64)) -> WithKeyPoints<LogCoord<f64>> {
    let ticks = [0.01, 0.02, 0.05, 0.1, 0.2, 0.3, 0.5, 0.7, 0.8, 0.9, 1.0, 1.1, 1.2, 1.5];
    let more = [2.0, 3.0, 5.0, 7.0, 10.0, 20.0, 50.0, 100.0];
    let within = ticks.into_iter().chain(more).filter(|v| (low..=high).contains(v)).collect();
    LogCoord::from((low..high).log_scale()).with_key_points(within)
}

/// The range of the values with a margin, never empty.
fn range(values: impl Iterator<Item = f64>, room: f64) -> (f64, f64) {
    let (mut low, mut high) = (f64::INFINITY, 0.0f64);
    for value in values.filter(|v| v.is_finite() && *v > 0.0) {
        (low, high) = (low.min(value), high.max(value));
    }
    if low > high {
        return (0.1, 10.0);
    }
    (low / room, high * room)
}

//! An ablation as one self-contained HTML page.

use std::fmt::Write;

use plotters::prelude::*;

use super::html::{STYLE, escape};
use super::plot::COLOURS;
use super::{Ablation, AblationRow, Better, Figure};
use crate::{Error, Result};

const WIDTH: u32 = 820;
/// Heights of the axis and of each row, pixels.
const HEIGHTS: (u32, u32) = (90, 26);

/// The HTML page.
///
/// # Errors
/// The plot could not be drawn.
pub(super) fn page(found: &Ablation) -> Result<String> {
    let Ablation { version, clip, frames, size: [width, height], steps, seeds, machine, .. } =
        found;
    let clip = escape(clip);
    let mut body = format!(
        "<h1>What each component is worth: {clip}</h1>\n<p>{frames} frames of {width}×{height}, \
         {steps} steps, {} seed{}, on {} ({}), splat4d {}. Each row is a whole reconstruction with \
         one component off. A cell is the median over the seeds, below it its difference from the \
         full run of the same seed, and with several seeds the worst.</p>\n",
        seeds.len(),
        if seeds.len() == 1 { "" } else { "s" },
        escape(&machine.device),
        escape(&machine.driver),
        escape(version),
    );
    if machine.software {
        body.push_str("<p>Times of a software driver say nothing of a GPU.</p>\n");
    }
    let drawn: Vec<&Figure> = found.figures.iter().filter(|f| f.title.contains("dB")).collect();
    if found.rows.len() > 1 && !drawn.is_empty() {
        let plot = changes(found, &drawn)?;
        let _ = writeln!(body, "<figure>{plot}</figure>");
        legend(&mut body, &drawn);
    }
    table(&mut body, found);
    Ok(format!(
        "<!doctype html>\n<html lang=\"en\"><head><meta charset=\"utf-8\">\
         <meta name=\"viewport\" content=\"width=device-width,initial-scale=1\">\
         <link rel=\"icon\" href=\"data:,\">\
         <title>splat4d ablate: {clip}</title><style>{STYLE}</style></head><body>\n{body}</body></html>\n"
    ))
}

fn table(body: &mut String, found: &Ablation) {
    body.push_str("<div class=\"wide\"><table><thead><tr><th>without</th>");
    for figure in &found.figures {
        let _ = write!(body, "<th>{}</th>", escape(&figure.title));
    }
    body.push_str("<th>what is so then</th></tr></thead><tbody>");
    for row in &found.rows {
        let AblationRow { component, without, failed, .. } = row;
        let class = if failed.is_some() { " class=\"missed\"" } else { "" };
        let _ = write!(body, "<tr{class}><td>{}</td>", escape(component));
        match failed {
            Some(why) => {
                let columns = found.figures.len();
                let _ = write!(body, "<td colspan=\"{columns}\">{}</td>", escape(why));
            }
            None => found.figures.iter().for_each(|figure| cell(body, found, row, figure)),
        }
        let _ = write!(body, "<td>{}</td></tr>", escape(without));
    }
    body.push_str("</tbody></table></div>\n");
}

fn cell(body: &mut String, found: &Ablation, row: &AblationRow, figure: &Figure) {
    let Some(summary) = found.summary(row, figure) else {
        body.push_str("<td>–</td>");
        return;
    };
    // SSIM values need more digits than decibels.
    let digits = if figure.title.starts_with("SSIM") { 4 } else { 2 };
    let _ = write!(body, "<td>{:.digits$}", summary.median);
    let is_full = found.rows.first().is_some_and(|full| full.component == row.component);
    if let Some(change) = summary.change.filter(|_| !is_full) {
        let sign = if change < 0.0 { "−" } else { "+" };
        let _ = write!(body, "<br>{sign}{:.digits$}", change.abs());
    }
    if found.seeds.len() > 1 {
        let _ = write!(body, "<br>worst {:.digits$}", summary.worst);
    }
    body.push_str("</td>");
}

fn legend(body: &mut String, drawn: &[&Figure]) {
    body.push_str("<p>Difference from the full run:");
    for (figure, RGBColor(r, g, b)) in drawn.iter().zip(COLOURS.iter().cycle()) {
        let title = escape(&figure.title);
        let _ = write!(body, " <span style=\"color:rgb({r},{g},{b})\">● {title}</span>");
    }
    body.push_str("</p>\n");
}

/// A plot of the change of each metric without each component, as dots beside the full run's line.
fn changes(found: &Ablation, drawn: &[&Figure]) -> Result<String> {
    let mut svg = String::new();
    draw(&mut svg, found, drawn)
        .map_err(|e| Error::Failed(format!("the plot of the ablation could not be drawn: {e}")))?;
    Ok(svg)
}

fn draw(
    svg: &mut String,
    found: &Ablation,
    drawn: &[&Figure],
) -> std::result::Result<(), Box<dyn std::error::Error>> {
    let rows = &found.rows[1..];
    let change = |row: &AblationRow, figure: &Figure| {
        let change = found.summary(row, figure)?.change.filter(|change| change.is_finite())?;
        // Improvements are drawn to the right.
        Some(if figure.better == Better::More { change } else { -change })
    };
    let all = || rows.iter().flat_map(|row| drawn.iter().filter_map(|f| change(row, f)));
    let most = all().fold(0.5, |most: f64, change| most.max(change.abs())) * 1.1;
    let height = HEIGHTS.0 + HEIGHTS.1 * rows.len() as u32;
    let root = SVGBackend::with_string(svg, (WIDTH, height)).into_drawing_area();
    root.fill(&WHITE)?;
    let end = rows.len() as f64;
    let mut chart = ChartBuilder::on(&root)
        .margin(10)
        .margin_left(150)
        .x_label_area_size(42)
        .build_cartesian_2d(-most..most, end..0.0)?;
    chart
        .configure_mesh()
        .disable_y_mesh()
        .x_desc("dB over the full run")
        .x_label_formatter(&|v| format!("{v:.1}"))
        .light_line_style(WHITE.mix(0.0))
        .draw()?;
    chart.draw_series(LineSeries::new([(0.0, 0.0), (0.0, end)], BLACK.mix(0.5)))?;
    for (i, row) in rows.iter().enumerate() {
        let y = i as f64 + 0.5;
        for (figure, colour) in drawn.iter().zip(COLOURS.iter().cycle()) {
            let dot = change(row, figure).map(|x| Circle::new((x, y), 4, colour.filled()));
            chart.draw_series(dot)?;
        }
        let (_, place) = chart.backend_coord(&(0.0, y));
        root.draw(&Text::new(row.component.clone(), (8, place - 6), ("sans-serif", 13)))?;
    }
    root.present()?;
    Ok(())
}

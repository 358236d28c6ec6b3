//! Line plots as SVG; the page's style sets the colours.

use crate::{Error, Result};
use plotters::coord::ranged1d::{Ranged, ValueFormatter};
use plotters::prelude::*;

/// Size of a plot, small enough that its text stays legible on a phone.
const SIZE: (u32, u32) = (420, 240);
/// Font of the text.
const FONT: (&str, u32) = ("sans-serif", 15);
/// Colours of the lines in the order of their series. The page's style may override them, as well as black,
/// grey and the grid's colour.
pub const LINE_COLOURS: [RGBColor; 2] = [RGBColor(0, 99, 173), RGBColor(168, 82, 0)];
/// Colour of the grid.
const GRID: RGBColor = RGBColor(226, 228, 231);

/// A line of a plot.
#[derive(Clone, Debug, PartialEq)]
pub struct Line {
    /// Name in the legend; a plot of one line has no legend.
    pub name: String,
    /// Points in the order of x; non-finite ones are left out.
    pub points: Vec<(f64, f64)>,
}

/// A plot of one or two lines over the same axis.
#[derive(Clone, Debug, PartialEq)]
pub struct LinePlot {
    /// Name of the plot in error messages.
    pub title: String,
    /// Label of the horizontal axis.
    pub x: String,
    /// Label of the vertical axis.
    pub y: String,
    /// Whether the vertical axis is logarithmic; then only positive values are drawn.
    pub logarithmic: bool,
    /// The lines.
    pub lines: Vec<Line>,
    /// Positions of markers on the horizontal axis, where a new section begins.
    pub marks: Vec<f64>,
}

impl LinePlot {
    /// Renders the plot as SVG; `None` with fewer than two points.
    ///
    /// # Errors
    /// [`Error::Failed`] where drawing fails.
    pub fn svg(&self) -> Result<Option<String>> {
        let drawn = |(x, y): &&(f64, f64)| {
            x.is_finite() && y.is_finite() && (!self.logarithmic || *y > 0.0)
        };
        let lines: Vec<Vec<(f64, f64)>> = self
            .lines
            .iter()
            .map(|line| line.points.iter().filter(drawn).copied().collect())
            .collect();
        if lines.iter().all(|points| points.len() < 2) {
            return Ok(None);
        }
        let all = || lines.iter().flatten();
        let ends = |of: fn(&(f64, f64)) -> f64| {
            all().map(of).fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), v| (l.min(v), h.max(v)))
        };
        let (x, y) = (ends(|p| p.0), ends(|p| p.1));
        let mut svg = String::new();
        let failed = |e: Box<dyn std::error::Error>| {
            Error::Failed(format!("the plot of {} could not be drawn: {e}", self.title))
        };
        match self.logarithmic {
            true => {
                let axis = LogCoord::from(((y.0 / 1.1)..(y.1 * 1.1)).log_scale());
                self.draw(&mut svg, &lines, x, axis, (y.0 / 1.1, y.1 * 1.1)).map_err(failed)?;
            }
            false => {
                // A constant series gets a span around its value.
                let flat = y.1 - y.0 <= 1e-9 * y.1.abs();
                let span = if flat { y.1.abs() } else { y.1 - y.0 };
                let margin = (0.05 * span).max(f64::MIN_POSITIVE);
                let (low, high) = (y.0 - margin, y.1 + margin);
                let axis = plotters::coord::types::RangedCoordf64::from(low..high);
                self.draw(&mut svg, &lines, x, axis, (low, high)).map_err(failed)?;
            }
        }
        Ok(Some(svg))
    }

    fn draw<Y>(
        &self,
        svg: &mut String,
        lines: &[Vec<(f64, f64)>],
        (from, to): (f64, f64),
        axis: Y,
        (low, high): (f64, f64),
    ) -> std::result::Result<(), Box<dyn std::error::Error>>
    where
        Y: Ranged<ValueType = f64> + ValueFormatter<f64>,
    {
        let root = SVGBackend::with_string(svg, SIZE).into_drawing_area();
        let mut chart = ChartBuilder::on(&root)
            .margin(6)
            .margin_top(24)
            .margin_right(14)
            .x_label_area_size(36)
            .y_label_area_size(52)
            .build_cartesian_2d(from..to.max(from + 1.0), axis)?;
        chart
            .configure_mesh()
            .x_desc(self.x.as_str())
            .x_labels(6)
            .y_labels(5)
            .x_label_formatter(&|v| number(*v))
            .y_label_formatter(&|v| number(*v))
            .label_style(FONT)
            .axis_desc_style(FONT)
            .bold_line_style(GRID)
            .light_line_style(GRID.mix(0.0))
            .draw()?;
        for &mark in self.marks.iter().filter(|mark| (from..to).contains(mark)) {
            let ends = [(mark, low), (mark, high)];
            chart.draw_series(LineSeries::new(ends, BLACK.mix(0.5).stroke_width(1)))?;
        }
        for (points, colour) in lines.iter().zip(LINE_COLOURS) {
            chart.draw_series(LineSeries::new(points.iter().copied(), colour.stroke_width(2)))?;
        }
        root.draw(&Text::new(self.y.clone(), (6, 4), FONT))?;
        let mut end = SIZE.0 as i32 - 12;
        if self.lines.len() > 1 {
            for (line, colour) in self.lines.iter().zip(LINE_COLOURS).rev() {
                end -= 7 * line.name.chars().count() as i32;
                root.draw(&Text::new(line.name.clone(), (end, 4), FONT))?;
                let stroke = vec![(end - 24, 11), (end - 6, 11)];
                root.draw(&PathElement::new(stroke, colour.stroke_width(2)))?;
                end -= 36;
            }
        }
        root.present()?;
        drop(chart);
        Ok(())
    }
}

/// A short label for a tick.
fn number(value: f64) -> String {
    match value.abs() {
        0.0 => "0".into(),
        v if v >= 1e6 => format!("{} M", trimmed(value / 1e6)),
        v if v >= 1e4 => format!("{} k", trimmed(value / 1e3)),
        v if v >= 1e-3 => trimmed(value),
        _ => format!("{value:.0e}"),
    }
}

/// At most three decimals, without trailing zeros.
fn trimmed(value: f64) -> String {
    let text = format!("{value:.3}");
    text.trim_end_matches('0').trim_end_matches('.').to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn plot(points: Vec<(f64, f64)>, logarithmic: bool) -> Option<String> {
        let line = |name: &str| Line { name: name.into(), points: points.clone() };
        let (title, x, y) = ("t".into(), "step".into(), "dB".into());
        let lines = vec![line("a<b"), line("other")];
        LinePlot { title, x, y, logarithmic, lines, marks: vec![2.5, 99.0] }.svg().unwrap()
    }

    #[test]
    fn lines_are_drawn_through_what_is_finite() {
        for logarithmic in [false, true] {
            let svg = plot(vec![(1.0, 2.0), (2.0, f64::NAN), (3.0, 0.5), (4.0, 1.0)], logarithmic);
            let svg = svg.unwrap();
            assert!(svg.contains("a&lt;b") && svg.contains("step") && svg.contains("dB"), "{svg}");
            assert!(!svg.contains("NaN") && !svg.contains("inf"), "{svg}");
            assert_eq!(svg.matches("#0063AD").count(), 2, "the line, and in the legend: {svg}");
        }
        // Constant series, and values without a logarithm.
        assert!(plot(vec![(1.0, 7.0), (2.0, 7.0)], false).is_some());
        assert!(plot(vec![(1.0, 0.0), (2.0, 0.0)], false).is_some());
        assert_eq!(plot(vec![(1.0, 0.0), (2.0, 0.0)], true), None);
        assert_eq!(plot(vec![(1.0, 3.0)], false), None);
    }

    #[test]
    fn numbers_are_short() {
        let shown = [0.0, 0.25, 12.0, 12_000.0, 2_500_000.0, -3.5, 1e-5].map(number);
        assert_eq!(shown, ["0", "0.25", "12", "12 k", "2.5 M", "-3.5", "1e-5"]);
    }
}

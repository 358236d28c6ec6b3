//! Charts for a page, as inline SVG with colours from the page's style: they follow the light or dark
//! scheme, and scale with the page while staying legible.

use std::fmt::Write;

use splat4d::report::escape;

/// Size of a chart; text has a size of 12 of these units.
const WIDTH: f64 = 400.0;
const HEIGHT: f64 = 210.0;
/// Margins for the axes.
const LEFT: f64 = 52.0;
const RIGHT: f64 = 12.0;
const TOP: f64 = 30.0;
const BOTTOM: f64 = 36.0;
/// Maximum number of points of a line with dots.
const DOTTED: usize = 64;
/// Depth of a drawn frustum.
const FRUSTUM: f64 = 15.0;
/// Width of a digit.
const DIGIT: f64 = 6.8;

/// CSS rules that a page with charts needs.
pub const STYLE: &str = "\
svg{display:block;width:100%;height:auto;font:12px system-ui,sans-serif;fill:var(--ink)}\
svg text{paint-order:stroke;stroke:var(--paper);stroke-width:3px}\
.grid{stroke:var(--faint);stroke-width:1;fill:none}.axis{stroke:var(--dim);stroke-width:1;fill:none}\
.a,.b{fill:none;stroke-width:1.8;stroke-linejoin:round}.a{stroke:var(--one)}\
.b{stroke:var(--two);stroke-dasharray:5 3}.da{fill:var(--one)}.db{fill:var(--two)}\
.cloud{stroke:var(--dim);stroke-width:1.6;stroke-linecap:round;fill:none;opacity:.55}\
.view{stroke:var(--two);stroke-width:1;stroke-linejoin:round;fill:var(--two);fill-opacity:.08}\
.bad{fill:var(--bad);opacity:.22}.cross{stroke:var(--bad);stroke-width:2;fill:none}";

/// Values by frame; `None` is a gap.
pub struct Series<'a> {
    pub name: &'a str,
    pub values: Vec<Option<f64>>,
}

/// A chart over the frames of a clip, with one or two series on an axis from 0. `unit` is that of the
/// values; bands mark `doubtful` frames.
pub fn over_frames(title: &str, unit: &str, series: &[Series], doubtful: &[usize]) -> String {
    let frames = series.iter().map(|s| s.values.len()).max().unwrap_or(0);
    let all = series.iter().flat_map(|s| s.values.iter().flatten());
    let most = all.copied().filter(|v| v.is_finite()).fold(0.0, f64::max);
    let ticks = ticks(0.0, if most > 0.0 { most } else { 1.0 }, 4);
    let top = ticks.last().copied().unwrap_or(1.0);
    let last = frames.saturating_sub(1).max(1) as f64;
    let x = |frame: f64| LEFT + (WIDTH - LEFT - RIGHT) * frame / last;
    let y = |value: f64| HEIGHT - BOTTOM - (HEIGHT - BOTTOM - TOP) * value / top;
    let mut svg = open(title, HEIGHT);
    for frame in doubtful {
        let (low, high) =
            (x(*frame as f64 - 0.5).max(LEFT), x(*frame as f64 + 0.5).min(WIDTH - RIGHT));
        let _ = write!(
            svg,
            "<rect class=\"bad\" x=\"{low:.1}\" y=\"{TOP}\" width=\"{:.1}\" height=\"{:.1}\">\
             <title>frame {frame} is doubtful</title></rect>",
            (high - low).max(1.5),
            HEIGHT - BOTTOM - TOP
        );
    }
    for tick in &ticks {
        line(&mut svg, "grid", (LEFT, y(*tick)), (WIDTH - RIGHT, y(*tick)));
        text(&mut svg, (LEFT - 6.0, y(*tick) + 4.0), "end", &number(*tick, top));
    }
    for frame in frame_ticks(frames) {
        line(&mut svg, "axis", (x(frame as f64), y(0.0)), (x(frame as f64), y(0.0) + 4.0));
        text(&mut svg, (x(frame as f64), y(0.0) + 16.0), "middle", &frame.to_string());
    }
    line(&mut svg, "axis", (LEFT, y(0.0)), (WIDTH - RIGHT, y(0.0)));
    text(&mut svg, (LEFT + (WIDTH - LEFT - RIGHT) / 2.0, HEIGHT - 5.0), "middle", "frame");
    text(&mut svg, (4.0, 14.0), "start", unit);
    legend(&mut svg, series);
    for (series, class) in series.iter().zip(["a", "b"]) {
        let mut path = String::new();
        let mut begun = false;
        for (frame, value) in series.values.iter().enumerate() {
            match value.filter(|v| v.is_finite()) {
                Some(value) => {
                    let command = if begun { 'L' } else { 'M' };
                    let _ = write!(path, "{command}{:.1} {:.1}", x(frame as f64), y(value));
                    begun = true;
                }
                None => begun = false,
            }
        }
        let _ = write!(svg, "<path class=\"{class}\" d=\"{path}\"/>");
        if series.values.len() <= DOTTED {
            for (frame, value) in series.values.iter().enumerate() {
                let Some(value) = value.filter(|v| v.is_finite()) else { continue };
                mark(&mut svg, class, (x(frame as f64), y(value)));
            }
        }
    }
    svg + "</svg>"
}

/// A camera on a map.
#[derive(Clone, Copy)]
pub struct Placed {
    /// Position on the map: right, and up.
    pub at: [f64; 2],
    /// Viewing direction on the map, of length at most 1.
    pub looks: [f64; 2],
    /// Half of the visible extent, projected to the map, over its distance.
    pub spread: f64,
    pub doubtful: bool,
}

/// Contents of a map: `axes` name the horizontal and the vertical axis, with their unit.
pub struct Map<'a> {
    pub title: &'a str,
    pub axes: [&'a str; 2],
    pub cameras: &'a [Placed],
    pub points: &'a [[f64; 2]],
}

/// Height of a map.
const SIDE: f64 = 340.0;

/// A map of cameras and points on a plane, with the same scale on both axes.
pub fn map(map: &Map) -> String {
    let place = Placement::of(map);
    let mut svg = open(map.title, SIDE);
    place.draw_grid(&mut svg, map.axes);
    let mut cloud = String::new();
    for point in map.points {
        let (x, y) = place.at(*point);
        let _ = write!(cloud, "M{x:.1} {y:.1}h0");
    }
    let _ = write!(svg, "<path class=\"cloud\" d=\"{cloud}\"/>");
    // Frusta of a subset of the cameras, because those of a long clip would overlap.
    let every = map.cameras.len().div_ceil(24).max(1);
    let views: String = map.cameras.iter().step_by(every).map(|c| place.frustum(c)).collect();
    let _ = write!(svg, "<path class=\"view\" d=\"{views}\"/>");
    let mut path = String::new();
    for (i, camera) in map.cameras.iter().enumerate() {
        let command = if i == 0 { 'M' } else { 'L' };
        let (x, y) = place.at(camera.at);
        let _ = write!(path, "{command}{x:.1} {y:.1}");
    }
    let _ = write!(svg, "<path class=\"a\" d=\"{path}\"/>");
    for camera in map.cameras.iter().filter(|camera| camera.doubtful) {
        let (x, y) = place.at(camera.at);
        let (left, right, top, low) = (x - 4.0, x + 4.0, y - 4.0, y + 4.0);
        let _ = write!(
            svg,
            "<path class=\"cross\" d=\"M{left:.1} {top:.1}L{right:.1} {low:.1}M{left:.1} \
             {low:.1}L{right:.1} {top:.1}\"/>"
        );
    }
    if let (Some(first), Some(last)) = (map.cameras.first(), map.cameras.last()) {
        place.draw_ends(&mut svg, first, last);
    }
    svg + "</svg>"
}

/// Where the points of a map lie in its drawing.
struct Placement {
    /// Left, upper, right and lower edge of the plot.
    plot: (f64, f64, f64, f64),
    /// The point of the map in the middle of the plot.
    middle: [f64; 2],
    /// Units of the drawing per unit of the map.
    scale: f64,
}

impl Placement {
    /// The placement in which all cameras and points are seen.
    fn of(map: &Map) -> Placement {
        let plot = (LEFT, TOP, WIDTH - RIGHT, SIDE - BOTTOM);
        let all = || map.cameras.iter().map(|c| c.at).chain(map.points.iter().copied());
        let bounds = |axis: usize| {
            let ends = all()
                .map(|p| p[axis])
                .fold((f64::MAX, f64::MIN), |(low, high), v| (low.min(v), high.max(v)));
            if ends.0 <= ends.1 { ends } else { (-1.0, 1.0) }
        };
        let (across, up) = (bounds(0), bounds(1));
        let (wide, high) = (plot.2 - plot.0, plot.3 - plot.1);
        let room = 1.15;
        let scale =
            (wide / (across.1 - across.0).max(1e-9)).min(high / (up.1 - up.0).max(1e-9)) / room;
        // Cameras that coincide up to rounding still get a map of finite extent.
        let scale = scale.min(wide / (1e-6 * (1.0 + across.1.abs() + up.1.abs())));
        let middle = [across, up].map(|(low, high)| 0.5 * (low + high));
        Placement { plot, middle, scale }
    }

    /// The place of a point, in the units of the drawing.
    fn at(&self, [across, up]: [f64; 2]) -> (f64, f64) {
        let (left, top, right, low) = self.plot;
        (
            0.5 * (left + right) + self.scale * (across - self.middle[0]),
            0.5 * (top + low) - self.scale * (up - self.middle[1]),
        )
    }

    /// Draws grid lines and labels of both axes.
    fn draw_grid(&self, svg: &mut String, axes: [&str; 2]) {
        let (left, top, right, low) = self.plot;
        let (wide, high) = ((right - left) / self.scale, (low - top) / self.scale);
        let shown = |middle: f64, length: f64| {
            let half = 0.5 * length;
            let ticks = ticks(middle - half, middle + half, 5).into_iter();
            ticks.filter(move |t| (t - middle).abs() <= half)
        };
        for tick in shown(self.middle[0], wide) {
            let (x, _) = self.at([tick, 0.0]);
            line(svg, "grid", (x, top), (x, low));
            text(svg, (x, low + 15.0), "middle", &number(tick, wide));
        }
        for tick in shown(self.middle[1], high) {
            let (_, y) = self.at([0.0, tick]);
            line(svg, "grid", (left, y), (right, y));
            text(svg, (left - 6.0, y + 4.0), "end", &number(tick, high));
        }
        text(svg, (0.5 * (left + right), SIDE - 5.0), "middle", axes[0]);
        text(svg, (4.0, 14.0), "start", axes[1]);
    }

    /// The outline of a camera's frustum, as commands of a path.
    fn frustum(&self, camera: &Placed) -> String {
        let [dx, dy] = camera.looks.map(|v| FRUSTUM * v);
        // A camera that looks up or down on the map is drawn with its full width but less depth.
        let length = dx.hypot(dy).max(1e-9);
        let (px, py) = (-dy / length, dx / length);
        let half = FRUSTUM * camera.spread.min(1.5);
        let corner = |side: f64| (dx + side * half * px, -(dy + side * half * py));
        let (left, right) = (corner(1.0), corner(-1.0));
        let (x, y) = self.at(camera.at);
        format!(
            "M{x:.1} {y:.1}l{:.1} {:.1}l{:.1} {:.1}z",
            left.0,
            left.1,
            right.0 - left.0,
            right.1 - left.1
        )
    }

    /// Marks and labels the first and the last camera.
    fn draw_ends(&self, svg: &mut String, first: &Placed, last: &Placed) {
        // The labels point away from each other, because the two positions may be close: left and right,
        // or above and below where the labels of the vertical axis leave no room.
        let (leftmost, _) = self.at([first.at[0].min(last.at[0]), 0.0]);
        let beside = leftmost - self.plot.0 > 7.0 + DIGIT * "first".len() as f64;
        let (mut sides, swapped) = match beside {
            true => ([("end", (-7.0, 4.0)), ("start", (7.0, 4.0))], first.at[0] > last.at[0]),
            false => ([("middle", (0.0, -7.0)), ("middle", (0.0, 15.0))], first.at[1] < last.at[1]),
        };
        if swapped {
            sides.reverse();
        }
        let ends = [(first, "a", "first"), (last, "b", "last")];
        for ((camera, class, name), (anchor, aside)) in ends.into_iter().zip(sides) {
            let at = self.at(camera.at);
            mark(svg, class, at);
            text(svg, (at.0 + aside.0, at.1 + aside.1), anchor, name);
        }
    }
}

fn open(title: &str, height: f64) -> String {
    let title = escape(title);
    format!("<svg viewBox=\"0 0 {WIDTH} {height}\" role=\"img\"><title>{title}</title>")
}

fn line(svg: &mut String, class: &str, from: (f64, f64), to: (f64, f64)) {
    let _ = write!(
        svg,
        "<path class=\"{class}\" d=\"M{:.1} {:.1}L{:.1} {:.1}\"/>",
        from.0, from.1, to.0, to.1
    );
}

fn text(svg: &mut String, at: (f64, f64), anchor: &str, words: &str) {
    let words = escape(words);
    let _ = write!(
        svg,
        "<text x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"{anchor}\">{words}</text>",
        at.0, at.1
    );
}

/// A disc for the first series, a square for the second.
fn mark(svg: &mut String, class: &str, (x, y): (f64, f64)) {
    let _ = match class {
        "a" => write!(svg, "<circle class=\"da\" cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"2.6\"/>"),
        _ => write!(
            svg,
            "<rect class=\"db\" x=\"{:.1}\" y=\"{:.1}\" width=\"5\" height=\"5\"/>",
            x - 2.5,
            y - 2.5
        ),
    };
}

/// Legend of two series, at the top right.
fn legend(svg: &mut String, series: &[Series]) {
    if series.len() < 2 {
        return;
    }
    let mut end = WIDTH - RIGHT;
    for (series, class) in series.iter().zip(["a", "b"]).rev() {
        text(svg, (end, 14.0), "end", series.name);
        let begin = end - DIGIT * series.name.chars().count() as f64 - 8.0;
        line(svg, class, (begin - 26.0, 10.0), (begin, 10.0));
        mark(svg, class, (begin - 13.0, 10.0));
        end = begin - 38.0;
    }
}

/// Round numbers from at or below `low` to at or above `high`, in about `count` steps.
fn ticks(low: f64, high: f64, count: usize) -> Vec<f64> {
    let raw = (high - low) / count as f64;
    let power = 10f64.powf(raw.log10().floor());
    let rounded = [1.0, 2.0, 2.5, 5.0, 10.0].map(|m| m * power);
    let step = rounded.into_iter().find(|step| *step >= 0.999 * raw).unwrap_or(raw);
    let (first, last) = ((low / step + 1e-9).floor() as i64, (high / step - 1e-9).ceil() as i64);
    (first..=last.max(first + 1)).map(|i| i as f64 * step).collect()
}

/// Frames that are labelled on an axis.
fn frame_ticks(frames: usize) -> Vec<usize> {
    let last = frames.saturating_sub(1);
    let steps = [1, 2, 5].into_iter().cycle().zip([1, 1, 1, 10, 10, 10, 100, 100, 100, 1000]);
    let step = steps.map(|(m, power)| m * power).find(|step| last / step <= 8);
    (0..=last).step_by(step.unwrap_or(last.max(1))).collect()
}

/// The label of a tick, with digits appropriate for the span of values.
fn number(value: f64, span: f64) -> String {
    let value = if value.abs() < 1e-9 * span { 0.0 } else { value };
    let text = match span {
        _ if value == 0.0 => "0".into(),
        s if !(1e-3..1e5).contains(&s) => format!("{value:.1e}"),
        s if s >= 20.0 => format!("{value:.0}"),
        s if s >= 2.0 => format!("{value:.1}"),
        s if s >= 0.2 => format!("{value:.2}"),
        s if s >= 0.02 => format!("{value:.3}"),
        _ => format!("{value:.4}"),
    };
    text.replace('-', "−")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ticks_are_round_and_hold_the_range() {
        assert_eq!(ticks(0.0, 7.0, 4), [0.0, 2.0, 4.0, 6.0, 8.0]);
        assert_eq!(ticks(0.0, 100.0, 4), [0.0, 25.0, 50.0, 75.0, 100.0]);
        for high in [1e-9, 0.37, 3.0, 1234.5, 1e9] {
            let found = ticks(0.0, high, 4);
            assert!(found[0] == 0.0 && found[found.len() - 1] >= 0.999 * high, "{high}: {found:?}");
            assert!(found.len() < 8, "{found:?}");
        }
        assert_eq!(frame_ticks(9), [0, 1, 2, 3, 4, 5, 6, 7, 8]);
        assert_eq!(frame_ticks(50), [0, 10, 20, 30, 40]);
        assert_eq!(frame_ticks(1), [0]);
        assert_eq!(number(-0.5, 3.0), "−0.5");
    }

    #[test]
    fn gaps_and_names_survive() {
        let series = [
            Series { name: "a<b", values: vec![Some(1.0), None, Some(3.0), Some(f64::INFINITY)] },
            Series { name: "more", values: vec![None; 4] },
        ];
        let svg = over_frames("t", "px", &series, &[3]);
        assert!(svg.contains("a&lt;b") && svg.contains("frame 3 is doubtful"));
        assert!(!svg.contains("NaN") && !svg.contains("inf"), "{svg}");
        assert_eq!(svg.matches("<circle").count(), 1 + 2, "one in the legend");
    }

    #[test]
    fn labels_of_the_path_leave_those_of_the_axis_free() {
        let camera = |at| Placed { at, looks: [1.0, 0.0], spread: 0.5, doubtful: false };
        let anchors = |last: f64, ahead: f64| {
            let (cameras, points) =
                ([[0.0; 2], [last, 0.0]].map(camera), [[ahead, 1.0], [ahead, -1.0]]);
            let map = Map { title: "t", axes: ["x", "y"], cameras: &cameras, points: &points };
            let svg = super::map(&map);
            ["first", "last"].map(|name| {
                let (before, _) = svg.split_once(&format!(">{name}</text>")).unwrap();
                before.rsplit('"').nth(1).unwrap().to_owned()
            })
        };
        assert_eq!(anchors(0.0, 0.0), ["end", "start"]);
        assert_eq!(anchors(-0.1, 0.0), ["start", "end"], "away from each other");
        assert_eq!(anchors(0.0, 4.0), ["middle", "middle"], "the cameras are at the left edge");
    }

    #[test]
    fn maps_of_one_place_have_a_size() {
        let camera = Placed { at: [1.0, 2.0], looks: [0.0, 1.0], spread: 0.5, doubtful: true };
        for points in [&[][..], &[[0.0, 5.0]][..]] {
            let cameras = [camera; 3];
            let svg = map(&Map { title: "t", axes: ["x", "y"], cameras: &cameras, points });
            assert!(!svg.contains("NaN") && !svg.contains("inf"), "{svg}");
            assert_eq!(svg.matches("class=\"cross\"").count(), 3);
            assert!(svg.contains("l-7.5 -15.0l15.0 0.0z"), "a frustum opens upward: {svg}");
        }
        let empty = map(&Map { title: "t", axes: ["x", "y"], cameras: &[], points: &[] });
        assert!(!empty.contains("NaN"));
    }
}

//! What `track` found as one page that needs nothing but itself: where the camera went, what moves, what
//! the motion leaves unexplained, and how well each frame is known.

use std::collections::BTreeMap;
use std::fmt::Write;

use glam::DVec3;
use splat4d::Result;
use splat4d::geometry::se3::angle_between;
use splat4d::report::escape;
use splat4d::track::{FrameQuality, Track};
use splat4d::types::{Image, Pose};

use super::charts::{self, Map, Placed, Series};
use super::known::focal_source;
use super::track_pictures::{self, HEAT, Pictures};

/// Static points on a map, at most.
const CLOUD: usize = 1500;

const STYLE: &str = "\
:root{color-scheme:light dark;--paper:#fff;--ink:#1c1e21;--dim:#6b7076;--faint:#e2e4e7;--one:#0063ad;\
--two:#a85200;--bad:#c42b1c;--note:#fff6dd}\
@media(prefers-color-scheme:dark){:root{--paper:#15171a;--ink:#e6e8ea;--dim:#9aa0a6;--faint:#33373c;\
--one:#6fb7ff;--two:#ffb35c;--bad:#ff7a6e;--note:#2d2817}}\
*{box-sizing:border-box}body{font:15px/1.5 system-ui,sans-serif;background:var(--paper);color:var(--ink);\
max-width:88rem;margin:0 auto;padding:1rem;overflow-wrap:anywhere}\
h1,h2,h3{line-height:1.25;margin:1.6em 0 .5em}h1{font-size:1.5rem;margin-top:.3em}h2{font-size:1.2rem}\
h3{font-size:1rem;margin:0 0 .2em}p{max-width:60rem;margin:.5em 0}\
.facts{display:grid;grid-template-columns:repeat(auto-fit,minmax(min(19rem,100%),1fr));gap:.1rem 2rem;margin:0}\
.facts div{display:flex;justify-content:space-between;gap:1rem;border-bottom:1px solid var(--faint);padding:.25rem 0}\
dt{color:var(--dim)}dd{margin:0;text-align:right}\
.notes{background:var(--note);border-left:4px solid var(--two);padding:.5rem 1rem .5rem 2rem;margin:1rem 0}\
.grid-of{display:grid;grid-template-columns:repeat(auto-fit,minmax(min(21rem,100%),1fr));gap:1.5rem}\
.maps{grid-template-columns:repeat(auto-fit,minmax(min(17rem,100%),1fr))}\
figure{margin:0;min-width:0}figcaption{color:var(--dim);font-size:13px}\
.pair{display:grid;grid-template-columns:1fr 1fr;gap:3px}.pair img{width:100%;height:auto;display:block}\
.scale{display:grid;grid-template-columns:auto minmax(6rem,16rem) auto 1fr;gap:.6rem;align-items:center;\
font-size:13px;margin:.5rem 0}.scale i{height:.9rem;border:1px solid var(--dim)}\
.grey{display:inline-block;width:.9rem;height:.9rem;background:#808080;border:1px solid var(--dim);\
vertical-align:-2px;margin-right:.3rem}\
.wide{overflow-x:auto}table{border-collapse:collapse;font-size:13px;font-variant-numeric:tabular-nums}\
th,td{padding:.2rem .7rem;text-align:right;border-bottom:1px solid var(--faint);white-space:nowrap}\
th:nth-child(2),td:nth-child(2){text-align:left}summary{cursor:pointer;margin:1rem 0}\
.doubt{color:var(--bad);font-weight:600}";

/// What the page is made of.
pub struct Page<'a> {
    /// What the clip is called.
    pub clip: &'a str,
    /// By frame.
    pub names: &'a [String],
    pub frames: &'a [Image],
    pub track: &'a Track,
    /// World to camera, in the unit of what is written.
    pub poses: &'a [Pose],
    /// Were poses supplied? Else their unit is the median depth.
    pub supplied: bool,
    pub landmarks: usize,
    /// Flow from the frames that are shown, as kept on the way.
    pub flow: &'a BTreeMap<usize, (Image, Option<Image>)>,
    pub notes: &'a [String],
}

impl Page<'_> {
    /// The page.
    ///
    /// # Errors
    /// A picture cannot be encoded.
    pub fn html(&self) -> Result<String> {
        let (pictures, brightest) = track_pictures::draw(self.frames, self.track, self.flow)?;
        let mut body = format!("<h1>splat4d track: {}</h1>\n", escape(self.clip));
        self.facts(&mut body);
        self.notes(&mut body);
        self.doubtful(&mut body);
        self.path(&mut body);
        self.charts(&mut body);
        self.strip(&mut body, &pictures, brightest);
        self.table(&mut body);
        Ok(format!(
            "<!doctype html>\n<html lang=\"en\"><head><meta charset=\"utf-8\">\
             <meta name=\"viewport\" content=\"width=device-width,initial-scale=1\">\
             <link rel=\"icon\" href=\"data:,\"><title>splat4d track: {}</title>\
             <style>{STYLE}{}</style></head><body>\n{body}</body></html>\n",
            escape(self.clip),
            charts::STYLE
        ))
    }

    /// What lengths are measured in.
    fn unit(&self) -> &'static str {
        if self.supplied { "unit of the given poses" } else { "median depths" }
    }

    fn facts(&self, body: &mut String) {
        let found = &self.track.quality;
        let k = &self.track.intrinsics;
        let across = 2.0 * (0.5 * f64::from(k.width) / k.fx).atan().to_degrees();
        let source = focal_source(found.focal_source);
        let std = match found.focal_std {
            0.0 => String::new(),
            std if std.is_finite() => format!(" ± {:.1} px ({:.1} %)", k.fx * std, 100.0 * std),
            _ => " ± unknown".into(),
        };
        let camera = match (found.tripod, self.supplied) {
            (true, _) => "fixed (tripod)".to_owned(),
            _ if found.turns => "turns in place".into(),
            (_, true) => "poses were given".into(),
            _ => format!("moves, parallax {:.1}°", found.parallax_deg),
        };
        let facts = [
            ("Frames", format!("{} of {}×{}", self.frames.len(), k.width, k.height)),
            ("Focal length", format!("{:.1} px{std}, {source}", k.fx)),
            ("Field of view, horizontal", format!("{across:.1}°")),
            ("Camera", camera),
            ("Adjusted observations that agree", format!("{:.1} %", 100.0 * found.inlier_share)),
            ("Their error, RMS by their weight", format!("{:.2} px", found.reprojection_rms)),
            ("Pixels that move", format!("{:.1} %", 100.0 * found.dynamic_share)),
            ("Objects that move", self.track.movers.len().to_string()),
            ("Points followed", found.tracks.to_string()),
            ("Points triangulated", self.landmarks.to_string()),
            ("Static points", self.track.points.len().to_string()),
            ("Doubtful frames", found.doubtful_frames.len().to_string()),
        ];
        body.push_str("<dl class=\"facts\">");
        for (name, value) in facts {
            let _ = write!(body, "<div><dt>{name}</dt><dd>{}</dd></div>", escape(&value));
        }
        body.push_str("</dl>\n");
    }

    fn notes(&self, body: &mut String) {
        if self.notes.is_empty() {
            return;
        }
        body.push_str("<ul class=\"notes\">");
        for note in self.notes {
            let _ = write!(body, "<li>{}</li>", escape(note));
        }
        body.push_str("</ul>\n");
    }

    fn doubtful(&self, body: &mut String) {
        body.push_str("<h2>Doubtful frames</h2>\n");
        let doubtful = &self.track.quality.doubtful_frames;
        if doubtful.is_empty() {
            body.push_str(
                "<p>None: enough static points agree with the camera of every frame.</p>\n",
            );
            return;
        }
        body.push_str(
            "<p>Too few static points agree with the cameras of these. They are shaded in the charts and \
             crossed on the maps.</p>\n<ul>",
        );
        for &frame in doubtful {
            let FrameQuality { inliers, observations, .. } = self.track.quality.per_frame[frame];
            let _ = write!(
                body,
                "<li>frame {frame}, <b>{}</b>: {inliers} of {observations} observations agree</li>",
                escape(&self.names[frame])
            );
        }
        body.push_str("</ul>\n");
    }

    fn path(&self, body: &mut String) {
        body.push_str("<h2>Where the camera went</h2>\n");
        if self.track.quality.tripod {
            body.push_str(
                "<p>The camera is fixed: it has one place and looks in one direction.</p>\n",
            );
        }
        if self.track.quality.turns {
            body.push_str("<p>The camera turns in place: it has one place.</p>\n");
        }
        let axes = Axes::of(self.poses);
        let unit = self.unit();
        let [right, ahead, up] =
            ["right", "ahead", "up"].map(|direction| format!("{direction} ({unit})"));
        let every = self.track.points.len().div_ceil(CLOUD).max(1);
        let points: Vec<DVec3> = self
            .track
            .points
            .iter()
            .step_by(every)
            .map(|point| axes.of_world(self.track.unit * point.position))
            .collect();
        let cameras: Vec<(DVec3, DVec3)> = self
            .poses
            .iter()
            .map(|pose| {
                let world_from_view = pose.inverse();
                (
                    axes.of_world(world_from_view.translation),
                    axes.of_world(world_from_view.rotation * DVec3::Z),
                )
            })
            .collect();
        let above = |v: DVec3| [v.x, v.z];
        let side = |v: DVec3| [v.z, v.y];
        body.push_str("<div class=\"grid-of maps\">");
        let mut map =
            |title: &str, axes: [&str; 2], with: bool, flat: &dyn Fn(DVec3) -> [f64; 2]| {
                let placed = |(i, (at, looks)): (usize, &(DVec3, DVec3))| Placed {
                    at: flat(*at),
                    looks: flat(*looks),
                    doubtful: self.track.quality.doubtful_frames.contains(&i),
                };
                let placed: Vec<Placed> = cameras.iter().enumerate().map(placed).collect();
                let flat_points = || inner(points.iter().map(|p| flat(*p)).collect());
                let points = if with { flat_points() } else { Vec::new() };
                let drawn = charts::map(&Map { title, axes, cameras: &placed, points: &points });
                let _ = write!(body, "<figure><h3>{title}</h3>{drawn}</figure>");
            };
        map("From above, with static points", [&right, &ahead], true, &above);
        map("From the side, with static points", [&ahead, &up], true, &side);
        if !self.track.quality.tripod && !self.track.quality.turns {
            map("The path alone, from above", [&right, &ahead], false, &above);
            map("The path alone, from the side", [&ahead, &up], false, &side);
        }
        body.push_str(
            "</div>\n<p>The line is the camera's path from its first frame (disc) to its last (square); short \
             strokes tell where it looks. Up is the mean upward direction of the pictures. Of the points, \
             those within the middle nine tenths along each axis are shown.</p>\n",
        );
    }

    fn charts(&self, body: &mut String) {
        let track = self.track;
        let per_frame = &track.quality.per_frame;
        let of =
            |value: &dyn Fn(&FrameQuality) -> Option<f64>| per_frame.iter().map(value).collect();
        let doubtful = &track.quality.doubtful_frames;
        let unit = self.unit();
        body.push_str(
            "<h2>Frame by frame</h2>\n<p>An observation is a static point, followed through three frames or \
             more, as one frame sees it. It agrees if it lies within three robust standard deviations of where \
             cameras and depth place it.</p>\n<div class=\"grid-of\">",
        );
        let mut chart = |title: &str, unit: &str, series: &[Series]| {
            let drawn = charts::over_frames(title, unit, series, doubtful);
            let _ = write!(body, "<figure><h3>{title}</h3>{drawn}</figure>");
        };
        let one = |values| [Series { name: "", values }];
        chart(
            "Observations of static points",
            "number",
            &[
                Series { name: "agree", values: of(&|f| Some(f.inliers as f64)) },
                Series { name: "all", values: of(&|f| Some(f.observations as f64)) },
            ],
        );
        chart("Share that agrees", "%", &one(of(&|f| share(f).map(|share| 100.0 * share))));
        chart("Reprojection error of those, RMS", "px", &one(of(&|f| f.rms)));
        let moving = track.masks.iter().map(|mask| Some(100.0 * moving(mask))).collect();
        chart("Pixels that move", "%", &one(moving));
        if !track.quality.tripod {
            let steps = self.steps();
            let step = |value: &dyn Fn(&(f64, f64)) -> f64| -> Vec<Option<f64>> {
                std::iter::once(None).chain(steps.iter().map(|s| Some(value(s)))).collect()
            };
            chart("Way from the frame before", unit, &one(step(&|s| s.0)));
            chart("Turn from the frame before", "degrees", &one(step(&|s| s.1)));
        }
        if per_frame.iter().any(|frame| frame.position_std.is_some()) {
            chart("Standard deviation of the place", unit, &one(of(&|f| f.position_std)));
            chart(
                "Standard deviation of the rotation",
                "degrees",
                &one(of(&|f| f.rotation_std_deg)),
            );
        }
        body.push_str("</div>\n");
        body.push_str(match (track.quality.tripod, self.supplied) {
            (true, _) => "<p>A fixed camera's poses are locked to one: they have no deviations.</p>\n",
            _ if track.quality.turns => {
                "<p>Deviations are not told of a camera that turns in place.</p>\n"
            }
            (_, true) => "<p>Given poses are kept: they have no deviations.</p>\n",
            _ => {
                "<p>Deviations are measured from the first frame at a held scale, from the inverse of the \
                 adjustment's normal equations. They take errors of observations to be independent; along a \
                 track they are not wholly, so that poses are known somewhat less well.</p>\n"
            }
        });
    }

    /// By frame from the second on: how far the camera went since the one before, and by how many degrees
    /// it turned.
    fn steps(&self) -> Vec<(f64, f64)> {
        let step = |pair: &[Pose]| {
            let [before, here] = [pair[0], pair[1]].map(|pose| pose.inverse().translation);
            let turned = angle_between(pair[0].rotation, pair[1].rotation);
            (before.distance(here), turned.to_degrees())
        };
        self.poses.windows(2).map(step).collect()
    }

    fn strip(&self, body: &mut String, pictures: &[Pictures], brightest: f64) {
        let colours: Vec<String> = HEAT
            .iter()
            .map(|colour| {
                let [r, g, b] = colour.map(|v| (v * 255.0).round());
                format!("rgb({r},{g},{b})")
            })
            .collect();
        let _ = write!(
            body,
            "<h2>What moves</h2>\n<p>Left, a frame with outlines of what moves, light inside and dark outside. \
             Right, residual flow: how far each pixel goes from this frame to the next (from the last one, to the one before) \
             beside where a world that stands still would take it.</p>\n\
             <div class=\"scale\"><span>0 px</span>\
             <i style=\"background:linear-gradient(90deg,{})\"></i><span>{brightest} px and more</span>\
             <span><i class=\"grey\"></i>flow not to be believed</span></div>\n<div class=\"grid-of\">",
            colours.join(",")
        );
        for Pictures { frame, outlined, residual } in pictures {
            let name = escape(&self.names[*frame]);
            let quality = &self.track.quality.per_frame[*frame];
            let doubt = match self.track.quality.doubtful_frames.contains(frame) {
                true => " · <span class=\"doubt\">doubtful</span>",
                false => "",
            };
            let agree =
                share(quality).map_or(String::new(), |s| format!(" · {:.0} % agree", 100.0 * s));
            let _ = write!(
                body,
                "<figure><div class=\"pair\"><img src=\"{outlined}\" alt=\"frame {frame} with outlines of \
                 what moves\"><img src=\"{residual}\" alt=\"residual flow of frame {frame}\"></div>\
                 <figcaption>frame {frame} · {name}{agree} · {:.1} % moves{doubt}</figcaption></figure>",
                100.0 * moving(&self.track.masks[*frame])
            );
        }
        body.push_str("</div>\n");
    }

    fn table(&self, body: &mut String) {
        let unit = self.unit();
        let _ = write!(
            body,
            "<details><summary>All figures as a table</summary><div class=\"wide\"><table><thead><tr>\
             <th>frame</th><th>name</th><th>observations</th><th>agree</th><th>RMS (px)</th>\
             <th>moves (%)</th><th>way ({unit})</th><th>turn (°)</th><th>place ± ({unit})</th>\
             <th>rotation ± (°)</th><th>doubtful</th></tr></thead><tbody>"
        );
        let steps = self.steps();
        let show =
            |value: Option<f64>| value.map_or("–".to_owned(), |value| format!("{value:.3}"));
        for (frame, quality) in self.track.quality.per_frame.iter().enumerate() {
            let step = frame.checked_sub(1).map(|before| steps[before]);
            let doubtful = self.track.quality.doubtful_frames.contains(&frame);
            let _ = write!(
                body,
                "<tr><td>{frame}</td><td>{}</td><td>{}</td><td>{}</td><td>{}</td><td>{:.1}</td>\
                 <td>{}</td><td>{}</td><td>{}</td><td>{}</td><td>{}</td></tr>",
                escape(&self.names[frame]),
                quality.observations,
                quality.inliers,
                show(quality.rms),
                100.0 * moving(&self.track.masks[frame]),
                small(step.map(|step| step.0)),
                show(step.map(|step| step.1)),
                small(quality.position_std),
                small(quality.rotation_std_deg),
                if doubtful { "yes" } else { "" }
            );
        }
        body.push_str("</tbody></table></div></details>\n");
    }
}

/// A length or an angle that may be small.
fn small(value: Option<f64>) -> String {
    value.map_or("–".to_owned(), |value| format!("{value:.5}"))
}

/// Share of a frame's observations that agree.
fn share(frame: &FrameQuality) -> Option<f64> {
    (frame.observations > 0).then(|| frame.inliers as f64 / frame.observations as f64)
}

/// Share of a frame's pixels that move.
fn moving(mask: &Image) -> f64 {
    let moving = mask.pixels.iter().filter(|p| **p > 0.5).count();
    moving as f64 / mask.pixels.len().max(1) as f64
}

/// Axes of a map: right, up and ahead as the cameras see them on average.
struct Axes {
    right: DVec3,
    up: DVec3,
    ahead: DVec3,
}

impl Axes {
    fn of(poses: &[Pose]) -> Axes {
        let mean =
            |axis: DVec3| poses.iter().map(|pose| pose.inverse().rotation * axis).sum::<DVec3>();
        let up = (-mean(DVec3::Y)).try_normalize().unwrap_or(DVec3::NEG_Y);
        // Cameras that look all ways have no direction in common: the first one's will do.
        let first = poses.first().map_or(DVec3::Z, |pose| pose.inverse().rotation * DVec3::Z);
        let ahead = [mean(DVec3::Z), first]
            .into_iter()
            .find_map(|v| v.reject_from_normalized(up).try_normalize())
            .unwrap_or_else(|| up.any_orthonormal_vector());
        Axes { right: ahead.cross(up), up, ahead }
    }

    /// A place or a direction as (right, up, ahead).
    fn of_world(&self, v: DVec3) -> DVec3 {
        DVec3::new(v.dot(self.right), v.dot(self.up), v.dot(self.ahead))
    }
}

/// Points within the middle nine tenths along both axes: a few far ones would leave the map empty.
fn inner(points: Vec<[f64; 2]>) -> Vec<[f64; 2]> {
    let limits = [0, 1].map(|axis| {
        let mut values: Vec<f64> = points.iter().map(|p| p[axis]).collect();
        values.sort_by(f64::total_cmp);
        let last = values.len().saturating_sub(1);
        let at = |share: usize| values.get(last * share / 20).copied().unwrap_or(0.0);
        (at(1), at(19))
    });
    let inside = |p: &[f64; 2]| [0, 1].iter().all(|&i| (limits[i].0..=limits[i].1).contains(&p[i]));
    points.into_iter().filter(inside).collect()
}

#[cfg(test)]
mod tests {
    use glam::DQuat;

    use super::*;

    #[test]
    fn maps_are_seen_as_cameras_see() {
        let poses = [Pose::IDENTITY, Pose::new(DQuat::IDENTITY, DVec3::new(-1.0, 0.0, -2.0))];
        let axes = Axes::of(&poses);
        // The second camera is to the right of the first and ahead of it; y points down.
        let at = axes.of_world(poses[1].inverse().translation);
        assert!(at.abs_diff_eq(DVec3::new(1.0, 0.0, 2.0), 1e-12), "{at}");
        assert!(axes.of_world(DVec3::Y).abs_diff_eq(DVec3::NEG_Y, 1e-12));
        // Of cameras that look to opposite sides, the first one tells.
        let turned = Pose::new(DQuat::from_rotation_y(std::f64::consts::PI), DVec3::ZERO);
        let axes = Axes::of(&[Pose::IDENTITY, turned]);
        assert!(axes.ahead.is_finite() && axes.up.abs_diff_eq(DVec3::NEG_Y, 1e-9));
    }

    #[test]
    fn far_points_are_left_out() {
        let mut points: Vec<[f64; 2]> = (0..100).map(|i| [f64::from(i), 1.0]).collect();
        points[50] = [50.0, 1e9];
        let kept = inner(points);
        assert_eq!(kept.len(), 90);
        assert!(kept.iter().all(|p| p[1] == 1.0));
        assert!(inner(Vec::new()).is_empty());
    }
}

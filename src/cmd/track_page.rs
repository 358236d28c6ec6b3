//! The result of `track` as one self-contained page: the camera path, the movers, the residual flow, and
//! the uncertainty of each frame.

use std::collections::BTreeMap;
use std::fmt::Write;

use splat4d::Result;
use splat4d::geometry::se3::angle_between;
use splat4d::report::escape;
use splat4d::track::{FrameQuality, Track};
use splat4d::types::{Image, Pose};

use super::camera_maps;
use super::charts::{self, Series};
use super::known::focal_source;
use super::origins::Origin;
use super::page;
use super::pictures::heat_key;
use super::track_pictures::{self, Pictures};

/// Contents of the page.
pub struct Page<'a> {
    /// Name of the clip.
    pub clip: &'a str,
    /// Name of each frame.
    pub names: &'a [String],
    pub frames: &'a [Image],
    pub track: &'a Track,
    /// World to camera, in the unit of the output.
    pub poses: &'a [Pose],
    /// Whether poses were supplied; else their unit is the median depth.
    pub supplied: bool,
    pub landmarks: usize,
    /// Flow from the displayed frames, kept during tracking.
    pub flow: &'a BTreeMap<usize, (Image, Option<Image>)>,
    pub origins: &'a [Origin],
    pub notes: &'a [String],
}

impl Page<'_> {
    /// The HTML page.
    ///
    /// # Errors
    /// An image cannot be encoded.
    pub fn html(&self) -> Result<String> {
        let (pictures, brightest) = track_pictures::draw(self.frames, self.track, self.flow)?;
        let mut body = String::new();
        self.facts(&mut body);
        page::origins(&mut body, self.origins);
        page::notes(&mut body, self.notes);
        let shown = "shaded in the charts and crossed on the maps";
        page::doubtful(&mut body, self.track, self.names, shown);
        camera_maps::section(&mut body, self.track, self.poses, self.unit());
        self.charts(&mut body);
        self.strip(&mut body, &pictures, brightest);
        self.table(&mut body);
        Ok(page::document(&format!("splat4d track: {}", self.clip), "", &body))
    }

    /// Unit of lengths.
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
        page::facts(body, &facts);
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

    /// Per frame from the second on: the camera's translation since the previous frame, and its rotation in
    /// degrees.
    fn steps(&self) -> Vec<(f64, f64)> {
        let step = |pair: &[Pose]| {
            let [before, here] = [pair[0], pair[1]].map(|pose| pose.inverse().translation);
            let turned = angle_between(pair[0].rotation, pair[1].rotation);
            (before.distance(here), turned.to_degrees())
        };
        self.poses.windows(2).map(step).collect()
    }

    fn strip(&self, body: &mut String, pictures: &[Pictures], brightest: f64) {
        let _ = write!(
            body,
            "<h2>What moves</h2>\n<p>Left, a frame with outlines of what moves, light inside and dark outside. \
             Right, residual flow: how far each pixel goes from this frame to the next (from the last one, to the one before) \
             beside where a world that stands still would take it.</p>\n\
             <div class=\"scale\">{}<span><i class=\"grey\"></i>flow not to be believed</span></div>\n<div class=\"grid-of\">",
            heat_key(brightest, " px")
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

/// Share of a frame's observations that are inliers.
fn share(frame: &FrameQuality) -> Option<f64> {
    (frame.observations > 0).then(|| frame.inliers as f64 / frame.observations as f64)
}

/// Share of a frame's pixels on movers.
fn moving(mask: &Image) -> f64 {
    let moving = mask.pixels.iter().filter(|p| **p > 0.5).count();
    moving as f64 / mask.pixels.len().max(1) as f64
}

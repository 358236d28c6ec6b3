//! The result of `reconstruct` as one self-contained page.

use std::fmt::Write;

use splat4d::Result;
use splat4d::report::escape;
use splat4d::track::Track;
use splat4d::types::Pose;

use super::common::thousands;
use super::info::dynamic_share;
use super::known::focal_source;
use super::origins::Origin;
use super::pictures::heat_key;
use super::run_page::{self, Curves, Run};
use super::{camera_maps, page, player};

const CURVES: Curves = Curves {
    between: "Up to the upright line the static world is trained alone, from there on all.",
    about: "Each point is of one training view or one offset view, so that points scatter as views differ.",
};

/// Contents of the page.
pub struct Page<'a> {
    /// Name of the clip.
    pub clip: &'a str,
    /// Name of each frame.
    pub names: &'a [String],
    pub track: &'a Track,
    /// Whether poses were supplied; else their unit is the median depth.
    pub supplied: bool,
    pub origins: &'a [Origin],
    pub run: Run<'a>,
}

impl Page<'_> {
    /// The HTML page.
    ///
    /// # Errors
    /// A plot cannot be drawn.
    pub fn html(&self) -> Result<String> {
        let mut body = format!("<p class=\"lead\">{}</p>\n", escape(&self.sentence()));
        self.facts(&mut body);
        let notes = self.run.report["notes"].as_array().into_iter().flatten();
        let notes: Vec<String> = notes.filter_map(|n| n.as_str().map(str::to_owned)).collect();
        page::notes(&mut body, &notes);
        self.strip(&mut body);
        run_page::orbit(&mut body, &self.run.pictures.orbit);
        let shown = "marked in the strip and crossed on the maps";
        page::doubtful(&mut body, self.track, self.names, shown);
        let poses: Vec<Pose> = (self.track.view_from_world.iter())
            .map(|pose| Pose::new(pose.rotation, self.track.unit * pose.translation))
            .collect();
        let unit = if self.supplied { "unit of the given poses" } else { "median depths" };
        camera_maps::section(&mut body, self.track, &poses, unit);
        let title = format!("splat4d reconstruct: {}", self.clip);
        self.run.document(&title, body, &CURVES, self.origins)
    }

    fn number(&self, key: &str) -> f64 {
        self.run.report[key].as_f64().unwrap_or(f64::NAN)
    }

    /// A one-sentence summary.
    fn sentence(&self) -> String {
        let (found, scene) = (&self.track.quality, self.run.scene);
        let k = &self.track.intrinsics;
        let camera = match (found.tripod, self.supplied) {
            (true, _) => "a camera that stands still".to_owned(),
            _ if found.turns => "a camera that turns in place".into(),
            (_, true) => "a camera of given poses".into(),
            _ => format!("a moving camera (parallax {:.1}°)", found.parallax_deg),
        };
        let moving = match scene.moves() {
            true => format!(
                "{:.1} % of the pixels move; {} Gaussians, {:.1} % of which follow {} control points,",
                100.0 * found.dynamic_share,
                thousands(scene.gaussians.len()),
                100.0 * dynamic_share(scene),
                scene.control_points.len()
            ),
            false => format!("nothing else moves; {} Gaussians", thousands(scene.gaussians.len())),
        };
        format!(
            "{} frames of {}×{}, filmed by {camera}: {moving} show the input at {:.2} dB (PSNR).",
            self.names.len(),
            k.width,
            k.height,
            self.number("psnr_input")
        )
    }

    fn facts(&self, body: &mut String) {
        let found = &self.track.quality;
        let k = &self.track.intrinsics;
        let std = match found.focal_std {
            0.0 => String::new(),
            std if std.is_finite() => format!(" ± {:.1} px", k.fx * std),
            _ => " ± unknown".into(),
        };
        let source = focal_source(found.focal_source);
        let text = |key: &str| self.run.report[key].as_str().unwrap_or_default().to_owned();
        page::facts(
            body,
            &[
                ("PSNR, input", format!("{:.2} dB", self.number("psnr_input"))),
                ("SSIM, input", format!("{:.4}", self.number("ssim_input"))),
                ("Focal length", format!("{:.1} px{std}, {source}", k.fx)),
                ("Observations that agree", format!("{:.1} %", 100.0 * found.inlier_share)),
                ("Their error, RMS", format!("{:.2} px", found.reprojection_rms)),
                ("Pixels that move", format!("{:.1} %", 100.0 * found.dynamic_share)),
                ("Objects that move", self.track.movers.len().to_string()),
                ("Doubtful frames", found.doubtful_frames.len().to_string()),
                ("Quality", text("quality")),
                ("Device", text("device")),
            ],
        );
    }

    fn strip(&self, body: &mut String) {
        let doubtful = &self.track.quality.doubtful_frames;
        let name = |&frame: &usize| {
            let doubt = if doubtful.contains(&frame) { " · doubtful" } else { "" };
            let psnr = self.run.quality.get(frame).map_or(f64::NAN, |quality| quality.psnr);
            format!("frame {frame} · {} · {psnr:.2} dB{doubt}", self.names[frame])
        };
        let names: Vec<String> = self.run.pictures.frames.iter().map(name).collect();
        let _ = writeln!(
            body,
            "<h2>Input and render</h2>\n<p>The input as it was trained on, undistorted and of one \
             exposure, and what the scene shows from the same cameras. The error is the mean over the \
             channels, which go from 0 to 1.</p>\n<div class=\"scale\">{}</div>",
            heat_key(self.run.pictures.most_error, "")
        );
        player::draw(body, "frame", &self.run.pictures.lanes, &names);
    }
}

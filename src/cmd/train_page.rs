//! The result of `train` as one self-contained page.

use glam::DVec3;
use splat4d::Result;
use splat4d::data::{Point, View};
use splat4d::report::escape;
use splat4d::types::Pose;

use super::camera_maps::{self, Cameras};
use super::common::thousands;
use super::info::dynamic_share;
use super::pictures::heat_key;
use super::run_page::{self, Curves, Run};
use super::{page, player};

const CURVES: Curves = Curves {
    between: "Up to the upright line all stands still (the warm-up), from there on it moves.",
    about: "Each point is of one training view, so that points scatter as views differ.",
};

/// Contents of the page.
pub struct Page<'a> {
    /// Name of the dataset.
    pub dataset: &'a str,
    /// Points of the dataset.
    pub points: &'a [Point],
    /// The displayed views: held-out ones, or, without any, training views.
    pub views: &'a [View],
    pub notes: &'a [String],
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
        page::notes(&mut body, self.notes);
        self.strip(&mut body);
        run_page::orbit(&mut body, &self.run.pictures.orbit);
        self.cameras(&mut body);
        self.run.document(&format!("splat4d train: {}", self.dataset), body, &CURVES, &[])
    }

    fn held_out(&self) -> u64 {
        self.run.report["held_out"].as_u64().unwrap_or(0)
    }

    fn decibels(&self, key: &str) -> String {
        self.run.report[key].as_f64().map_or("none".into(), |value| format!("{value:.2} dB"))
    }

    /// A one-sentence summary.
    fn sentence(&self) -> String {
        let scene = self.run.scene;
        let gaussians = thousands(scene.gaussians.len());
        let made = match scene.moves() {
            true => format!(
                "{gaussians} Gaussians, {:.1} % of which follow {} control points,",
                100.0 * dynamic_share(scene),
                scene.control_points.len()
            ),
            false => format!("{gaussians} Gaussians, none of which moves,"),
        };
        let test = match self.held_out() {
            0 => ".".to_owned(),
            n => format!(", and {n} that were held out at {}.", self.decibels("psnr_test")),
        };
        format!(
            "{made} show the {} images that they were trained on at {} (PSNR){test}",
            self.run.report["images"],
            self.decibels("psnr_input")
        )
    }

    fn facts(&self, body: &mut String) {
        let text = |key: &str| self.run.report[key].as_str().map_or("none".into(), str::to_owned);
        let ssim = self.run.report["ssim_test"].as_f64();
        page::facts(
            body,
            &[
                ("PSNR, trained on", self.decibels("psnr_input")),
                ("PSNR, held out", self.decibels("psnr_test")),
                ("SSIM, held out", ssim.map_or("none".into(), |value| format!("{value:.4}"))),
                ("Gaussians", thousands(self.run.scene.gaussians.len())),
                ("Control points", self.run.scene.control_points.len().to_string()),
                ("Density control", text("density")),
                ("Steps", self.run.report["steps"].to_string()),
                ("Device", text("device")),
            ],
        );
    }

    fn strip(&self, body: &mut String) {
        let name = |&frame: &usize| {
            let psnr = self.run.quality.get(frame).map_or(f64::NAN, |quality| quality.psnr);
            format!("{} · {psnr:.2} dB", self.views[frame].name)
        };
        let names: Vec<String> = self.run.pictures.frames.iter().map(name).collect();
        let shown = match self.held_out() {
            0 => "Images that the scene was trained on",
            _ => "Images that were held out",
        };
        *body += &format!(
            "<h2>Images and render</h2>\n<p>{shown}, and what the scene shows from the same cameras. The \
             error is the mean over the channels, which go from 0 to 1.</p>\n<div \
             class=\"scale\">{}</div>\n",
            heat_key(self.run.pictures.most_error, "")
        );
        player::draw(body, "image", &self.run.pictures.lanes, &names);
    }

    fn cameras(&self, body: &mut String) {
        let Some(first) = self.run.scene.cameras.first() else { return };
        let poses: Vec<Pose> =
            self.run.scene.cameras.iter().map(|known| known.camera.view_from_world).collect();
        let place = |p: &Point| DVec3::from_array(p.position.map(f64::from));
        let centre = |i: usize| poses[i].inverse().translation;
        let cameras = Cameras {
            poses: &poses,
            intrinsics: &first.camera.intrinsics,
            points: camera_maps::thinned(self.points.iter().map(place)),
            doubtful: &[],
            travels: (1..poses.len()).any(|i| centre(i) != centre(0)),
        };
        body.push_str("<h2>Where the cameras are</h2>\n");
        camera_maps::maps(body, &cameras, "unit of the dataset", "the dataset's points");
        body.push_str(
            "<p>The line goes through the images, trained on and held out, in the order of their times, from \
             the first (disc) to the last (square); triangles are what some of them see. Up is the mean \
             upward direction of the images.",
        );
        if !self.points.is_empty() {
            body.push_str(
                " Of the points, those within the middle nine tenths along each axis are shown.",
            );
        }
        body.push_str("</p>\n");
    }
}

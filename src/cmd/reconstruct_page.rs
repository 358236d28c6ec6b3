//! What `reconstruct` made of a clip as one page that needs nothing but itself.

use std::ffi::OsString;
use std::fmt::Write;

use serde_json::Value;
use splat4d::Result;
use splat4d::report::{Line, LinePlot, escape};
use splat4d::scene::Scene;
use splat4d::track::Track;
use splat4d::train::{Measured, Phase};
use splat4d::types::Pose;

use super::clock::Clock;
use super::common::{bytes, thousands};
use super::info::dynamic_share;
use super::known::focal_source;
use super::model::Choice;
use super::pictures::heat_key;
use super::quality::Quality;
use super::reconstruct_pictures::Pictures;
use super::{camera_maps, page, player};

/// Beside that of all pages. A plot's own colours are those of light paper.
const STYLE: &str = "\
.lead{font-size:1.1rem}.plots{grid-template-columns:repeat(auto-fit,minmax(min(20rem,100%),1fr))}\
.plots svg{font-family:system-ui,sans-serif}\
.plots [fill=\"#000000\"]{fill:var(--ink)}.plots [stroke=\"#000000\"]{stroke:var(--dim)}\
.plots [stroke=\"#E2E4E7\"]{stroke:var(--faint)}\
.plots [stroke=\"#0063AD\"]{stroke:var(--one)}.plots [stroke=\"#A85200\"]{stroke:var(--two)}\
.model{width:100%}.model th,.model td{white-space:normal;text-align:left;vertical-align:top}\
.bar{display:inline-block;height:.7rem;background:var(--one);vertical-align:-1px}\
.stages td:nth-child(3){text-align:left;width:45%}.stages td:nth-child(2){text-align:right}\
pre{background:var(--faint);padding:.6rem .8rem;white-space:pre-wrap;border-radius:4px}\
@media(max-width:34rem){.model thead{display:none}.model tr{display:block;padding:.4rem 0;\
border-bottom:1px solid var(--faint)}.model td{display:block;border:0;padding:.05rem 0}\
.model td:first-child{font-weight:600}.model td:empty{display:none}}";

/// What the page is made of.
pub struct Page<'a> {
    /// What the clip is called.
    pub clip: &'a str,
    /// By frame.
    pub names: &'a [String],
    pub track: &'a Track,
    /// Were poses supplied? Else their unit is the median depth.
    pub supplied: bool,
    pub scene: &'a Scene,
    /// How close the scene comes to each frame.
    pub quality: &'a [Quality],
    pub pictures: &'a Pictures,
    pub history: &'a [Measured],
    pub model: &'a [Choice],
    pub clock: &'a Clock,
    /// As `report.json` holds it.
    pub report: &'a Value,
    /// The words of the command that made it, the program's name first.
    pub command: &'a [OsString],
}

impl Page<'_> {
    /// The page.
    ///
    /// # Errors
    /// A plot cannot be drawn.
    pub fn html(&self) -> Result<String> {
        let mut body = format!("<p class=\"lead\">{}</p>\n", escape(&self.sentence()));
        self.facts(&mut body);
        let notes = self.report["notes"].as_array().into_iter().flatten();
        let notes: Vec<String> = notes.filter_map(|n| n.as_str().map(str::to_owned)).collect();
        page::notes(&mut body, &notes);
        self.strip(&mut body);
        self.orbit(&mut body);
        let shown = "marked in the strip and crossed on the maps";
        page::doubtful(&mut body, self.track, self.names, shown);
        let poses: Vec<Pose> = (self.track.view_from_world.iter())
            .map(|pose| Pose::new(pose.rotation, self.track.unit * pose.translation))
            .collect();
        let unit = if self.supplied { "unit of the given poses" } else { "median depths" };
        camera_maps::section(&mut body, self.track, &poses, unit);
        self.training(&mut body)?;
        self.model(&mut body);
        self.stages(&mut body);
        self.command(&mut body);
        body += &player::script();
        let style = format!("{STYLE}{}", player::STYLE);
        Ok(page::document(&format!("splat4d reconstruct: {}", self.clip), &style, &body))
    }

    fn number(&self, key: &str) -> f64 {
        self.report[key].as_f64().unwrap_or(f64::NAN)
    }

    /// What was found, in a sentence.
    fn sentence(&self) -> String {
        let (found, scene) = (&self.track.quality, self.scene);
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
        let text = |key: &str| self.report[key].as_str().unwrap_or_default().to_owned();
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
            let psnr = self.quality.get(frame).map_or(f64::NAN, |quality| quality.psnr);
            format!("frame {frame} · {} · {psnr:.2} dB{doubt}", self.names[frame])
        };
        let names: Vec<String> = self.pictures.frames.iter().map(name).collect();
        let _ = writeln!(
            body,
            "<h2>Input and render</h2>\n<p>The input as it was trained on, undistorted and of one \
             exposure, and what the scene shows from the same cameras. The error is the mean over the \
             channels, which go from 0 to 1.</p>\n<div class=\"scale\">{}</div>",
            heat_key(self.pictures.most_error, "")
        );
        player::draw(body, "frame", &self.pictures.lanes, &names);
    }

    fn orbit(&self, body: &mut String) {
        let orbit = &self.pictures.orbit;
        let count = orbit.pictures.len();
        let names: Vec<String> = (1..=count).map(|i| format!("{i} of {count}")).collect();
        body.push_str(
            "<h2>From aside</h2>\n<p>The camera leaves its path on a gentle ellipse while time runs, as by \
             <code>splat4d render --path orbit</code>.</p>\n",
        );
        player::draw(body, "view", std::slice::from_ref(orbit), &names);
    }

    fn training(&self, body: &mut String) -> Result<()> {
        body.push_str("<h2>Training</h2>\n");
        let still = self.history.iter().filter(|m| m.phase == Phase::Static).map(|m| m.step).max();
        let before = still.unwrap_or(0);
        let step = |m: &Measured| {
            f64::from(m.step) + f64::from(if m.phase == Phase::Joint { before } else { 0 })
        };
        let line = |name: &str, value: &dyn Fn(&Measured) -> Option<f64>| Line {
            name: name.into(),
            points: self.history.iter().filter_map(|m| Some((step(m), value(m)?))).collect(),
        };
        let joint = self.history.iter().any(|m| m.phase == Phase::Joint);
        let marks = if joint && before > 0 { vec![f64::from(before)] } else { Vec::new() };
        let plots = [
            (
                "Loss",
                "each picture's, before its step",
                true,
                vec![line("L1", &|m| Some(m.l1)), line("1 − SSIM", &|m| Some(1.0 - m.ssim))],
            ),
            ("PSNR", "dB", false, vec![line("PSNR", &|m| m.psnr)]),
            ("Gaussians", "number", false, vec![line("Gaussians", &|m| Some(m.gaussians as f64))]),
        ];
        let mut drawn = String::new();
        for (title, y, logarithmic, lines) in plots {
            let (x, y) = ("step".into(), y.into());
            let plot =
                LinePlot { title: title.into(), x, y, logarithmic, lines, marks: marks.clone() };
            if let Some(svg) = plot.svg()? {
                let _ = write!(drawn, "<figure><h3>{title}</h3>{svg}</figure>");
            }
        }
        if drawn.is_empty() {
            body.push_str("<p>Too few steps were measured for a curve.</p>\n");
            return Ok(());
        }
        let _ = writeln!(body, "<div class=\"grid-of plots\">{drawn}</div>");
        body.push_str(
            "<p>Each point is of one picture, of the input or from aside, so that points scatter as pictures \
             differ.",
        );
        if !marks.is_empty() {
            body.push_str(
                " Up to the upright line the static world is trained alone, from there on all.",
            );
        }
        if self.history.first().is_some_and(|m| m.step > 100) {
            body.push_str(" The run went on from a checkpoint; what lay before it is not shown.");
        }
        body.push_str("</p>\n");
        Ok(())
    }

    fn model(&self, body: &mut String) {
        body.push_str(
            "<h2>What was modelled, and what was left out</h2>\n<table class=\"model\"><thead><tr><th>what</th>\
             <th>chosen</th><th>because</th><th>saves</th></tr></thead><tbody>",
        );
        for Choice { what, chosen, because, saves } in self.model {
            let saves = saves.as_ref().map_or(String::new(), |saves| format!("saves {saves}"));
            let _ = write!(body, "<tr><td>{}</td>", escape(what));
            for cell in [chosen, because, &saves] {
                let _ = write!(body, "<td>{}</td>", escape(cell));
            }
            body.push_str("</tr>");
        }
        body.push_str("</tbody></table>\n");
    }

    fn stages(&self, body: &mut String) {
        let stages = self.clock.stages();
        let all: f64 = stages.iter().map(|(_, seconds)| seconds).sum();
        let most = stages.iter().map(|(_, seconds)| *seconds).fold(1e-9, f64::max);
        body.push_str("<h2>Time and memory</h2>\n<table class=\"stages\"><tbody>");
        for (stage, seconds) in stages {
            let _ = write!(
                body,
                "<tr><th>{}</th><td>{seconds:.1} s</td><td><i class=\"bar\" style=\"width:{:.1}%\"></i></td></tr>",
                escape(stage),
                100.0 * seconds / most
            );
        }
        let whole = |key: &str| self.report[key].as_u64().unwrap_or(0);
        let _ = writeln!(
            body,
            "</tbody></table>\n<p>{all:.1} s before this page; {:.1} ms for a step of the last stage. Device memory: \
             {} at most, {} were foreseen.</p>",
            self.number("milliseconds_per_step"),
            bytes(whole("peak_bytes")),
            bytes(whole("predicted_bytes"))
        );
    }

    fn command(&self, body: &mut String) {
        let words: Vec<String> = self.command.iter().map(quoted).collect();
        let _ = writeln!(
            body,
            "<h2>The command</h2>\n<pre>{}</pre>\n<p>splat4d {}</p>",
            escape(&words.join(" ")),
            env!("CARGO_PKG_VERSION")
        );
    }
}

/// A word as a shell takes it.
fn quoted(word: &OsString) -> String {
    let text = word.to_string_lossy();
    let plain = |c: char| c.is_ascii_alphanumeric() || "-_./,:=@%+".contains(c);
    match !text.is_empty() && text.chars().all(plain) {
        true => text.into_owned(),
        false => format!("'{}'", text.replace('\'', r"'\''")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn words_are_quoted_where_a_shell_would_take_them_apart() {
        let found = ["clip.mp4", "--size", "a b", "it's", "", "$x"].map(|w| quoted(&w.into()));
        assert_eq!(found, ["clip.mp4", "--size", "'a b'", r"'it'\''s'", "''", "'$x'"]);
    }
}

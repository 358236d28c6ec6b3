//! Common parts of the pages of `reconstruct` and `train`: the curves, the model, time and memory, the
//! command.

use std::ffi::OsString;
use std::fmt::Write;
use std::io::Write as _;
use std::path::Path;

use serde_json::{Value, json};
use splat4d::Result;
use splat4d::data::View;
use splat4d::gpu::Device;
use splat4d::io::write_atomically;
use splat4d::report::{Line, LinePlot, escape};
use splat4d::scene::Scene;
use splat4d::train::{Measured, Phase};

use super::clock::Clock;
use super::common::bytes;
use super::model::Choice;
use super::origins::Origin;
use super::player::{self, Lane};
use super::quality::Quality;
use super::reconstruct_pictures::Pictures;
use super::watcher::steps_before;
use super::{page, sheet};

/// File name of the page.
pub const FILE: &str = "report.html";
/// Style in addition to the common one. The plots' own colours are for a light background.
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
.model td:first-child{font-weight:600}.model td:empty{display:none}\
.model td:nth-child(4)::before{content:\"saves \"}}";

/// Results of a training, independent of its input.
pub struct Run<'a> {
    pub scene: &'a Scene,
    /// Quality of the scene for each displayed image.
    pub quality: &'a [Quality],
    pub pictures: &'a Pictures,
    pub history: &'a [Measured],
    pub model: &'a [Choice],
    pub clock: &'a Clock,
    /// Contents of `report.json`.
    pub report: &'a Value,
}

/// Captions of the curves.
pub struct Curves {
    /// Meaning of the vertical line between the stages.
    pub between: &'static str,
    /// Meaning of each point.
    pub about: &'static str,
}

impl Run<'_> {
    /// The complete page: `body`, followed by the common sections.
    ///
    /// # Errors
    /// A plot cannot be drawn.
    pub fn document(
        &self,
        title: &str,
        mut body: String,
        curves: &Curves,
        origins: &[Origin],
    ) -> Result<String> {
        training(&mut body, self.history, curves)?;
        model(&mut body, self.model);
        page::origins(&mut body, origins);
        stages(&mut body, self.clock, self.report);
        command(&mut body, &words());
        body += &player::script();
        Ok(page::document(title, &format!("{STYLE}{}", player::STYLE), &body))
    }

    /// Writes a page to a folder, with report.json and sheet.png beside it.
    ///
    /// # Errors
    /// A file cannot be written; an image cannot be rendered.
    pub fn save(&self, folder: &Path, page: &str, device: &Device, views: &[View]) -> Result<()> {
        write_atomically(folder.join(FILE), |sink| sink.write_all(page.as_bytes()))?;
        let mut report = self.report.clone();
        report["training"] = json!(self.history);
        sheet::write(folder, device, self.scene, &sheet::spread(views), &report)
    }
}

/// Adds novel views.
pub fn orbit(body: &mut String, orbit: &Lane) {
    let count = orbit.pictures.len();
    let names: Vec<String> = (1..=count).map(|i| format!("{i} of {count}")).collect();
    body.push_str(
        "<h2>From aside</h2>\n<p>The camera leaves its path on a gentle ellipse while time runs, as by \
         <code>splat4d render --path orbit</code>.</p>\n",
    );
    player::draw(body, "view", std::slice::from_ref(orbit), &names);
}

/// Adds the curves of a training.
fn training(body: &mut String, history: &[Measured], curves: &Curves) -> Result<()> {
    body.push_str("<h2>Training</h2>\n");
    let before = steps_before(history, Phase::Joint);
    let step = |m: &Measured| f64::from(m.step + if m.phase == Phase::Joint { before } else { 0 });
    let line = |name: &str, value: &dyn Fn(&Measured) -> Option<f64>| Line {
        name: name.into(),
        points: history.iter().filter_map(|m| Some((step(m), value(m)?))).collect(),
    };
    let joint = history.iter().any(|m| m.phase == Phase::Joint);
    let marks = if joint && before > 0 { vec![f64::from(before)] } else { Vec::new() };
    let plots = [
        (
            "Loss",
            "each image's, before its step",
            true,
            vec![line("L1", &|m| Some(m.l1)), line("1 − SSIM", &|m| Some(1.0 - m.ssim))],
        ),
        ("PSNR", "dB", false, vec![line("PSNR", &|m| m.psnr)]),
        ("Gaussians", "number", false, vec![line("Gaussians", &|m| Some(m.gaussians as f64))]),
    ];
    let mut drawn = String::new();
    for (title, y, logarithmic, lines) in plots {
        let (x, y) = ("step".into(), y.into());
        let plot = LinePlot { title: title.into(), x, y, logarithmic, lines, marks: marks.clone() };
        if let Some(svg) = plot.svg()? {
            let _ = write!(drawn, "<figure><h3>{title}</h3>{svg}</figure>");
        }
    }
    if drawn.is_empty() {
        body.push_str("<p>Too few steps were measured for a curve.</p>\n");
        return Ok(());
    }
    let _ = writeln!(body, "<div class=\"grid-of plots\">{drawn}</div>");
    let _ = write!(body, "<p>{}", escape(curves.about));
    if !marks.is_empty() {
        let _ = write!(body, " {}", escape(curves.between));
    }
    if history.first().is_some_and(|m| m.step > 100) {
        body.push_str(" The run went on from a checkpoint of one that measured nothing: what lay before it is not shown.");
    }
    body.push_str("</p>\n");
    Ok(())
}

/// Adds the model report.
fn model(body: &mut String, model: &[Choice]) {
    body.push_str(
        "<h2>What was modelled, and what was left out</h2>\n<table class=\"model\"><thead><tr><th>what</th>\
         <th>chosen</th><th>because</th><th>saves</th></tr></thead><tbody>",
    );
    for Choice { what, chosen, because, saves } in model {
        let _ = write!(body, "<tr><td>{}</td>", escape(what));
        for cell in [chosen, because, saves.as_deref().unwrap_or_default()] {
            let _ = write!(body, "<td>{}</td>", escape(cell));
        }
        body.push_str("</tr>");
    }
    body.push_str("</tbody></table>\n");
}

/// Adds stages and memory; `report` has the contents of `report.json`.
fn stages(body: &mut String, clock: &Clock, report: &Value) {
    let stages = clock.stages();
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
    let whole = |key: &str| report[key].as_u64().unwrap_or(0);
    let _ = writeln!(
        body,
        "</tbody></table>\n<p>{all:.1} s before this page; {:.1} ms for a step of the last stage. Device memory: \
         {} at most, {} were foreseen.</p>",
        report["milliseconds_per_step"].as_f64().unwrap_or(f64::NAN),
        bytes(whole("peak_bytes")),
        bytes(whole("predicted_bytes"))
    );
}

/// Adds the command that made the page, and the program's version.
fn command(body: &mut String, words: &[OsString]) {
    let words: Vec<String> = words.iter().map(quoted).collect();
    let _ = writeln!(
        body,
        "<h2>The command</h2>\n<pre>{}</pre>\n<p>splat4d {}</p>",
        escape(&words.join(" ")),
        env!("CARGO_PKG_VERSION")
    );
}

/// The words of the current command, with its name without the folder.
fn words() -> Vec<OsString> {
    let words = std::env::args_os().skip(1);
    std::iter::once("splat4d".into()).chain(words).collect()
}

/// Quotes a word for a shell.
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

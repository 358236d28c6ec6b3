//! Evaluates a scene on held-out images, whole and by region, and writes a table and side-by-side
//! comparisons.

use std::collections::HashSet;
use std::fmt::Write;
use std::io::Write as _;
use std::path::{Path, PathBuf};

use serde_json::{Map, Value, json};
use splat4d::data::write_png;
use splat4d::eval::{fit_pose, masked_mean, masked_psnr, ssim_map};
use splat4d::observe::onnx::LpipsNetwork;
use splat4d::renderer::Renderer;
use splat4d::types::{Camera, Image};
use splat4d::{Error, Result, io};
use tempfile::TempDir;

use super::outputs::{Inputs, Outputs};
use super::quality::{Quality, mean};

/// Minimum share of an image's pixels for a region to be scored: the PSNR of a few pixels is not
/// meaningful, and would weigh as much in the mean as any other.
const LEAST_SHARE: f64 = 1e-3;

/// The regions, by their names in the JSON.
const REGIONS: [&str; 4] = ["covisible", "movers", "outside_movers", "static_covisible"];

/// A held-out image.
pub struct Shot {
    /// Name in messages.
    pub name: String,
    /// Group that it is averaged with: a held-out camera's distance.
    pub distance: String,
    /// Camera in the scene's frame, with the image's size.
    pub camera: Camera,
    /// Time in the scene.
    pub time: f64,
    /// The ground-truth image.
    pub truth: Image,
    /// 1 on movers; `None` where unknown.
    pub movers: Option<Image>,
    /// 1 where some input frame saw the static point behind the pixel, and on movers.
    pub covisible: Option<Image>,
}

impl Shot {
    /// The masks of [`REGIONS`], as far as they are known.
    fn regions(&self) -> [Option<Image>; 4] {
        let movers = self.movers.as_ref();
        let static_here = movers.map(inverse);
        let both = self.covisible.as_ref().zip(static_here.as_ref()).map(|(a, b)| {
            let pixels = a.pixels.iter().zip(&b.pixels).map(|(x, y)| x.min(*y)).collect();
            Image { pixels, ..*a }
        });
        [self.covisible.clone(), movers.cloned(), static_here, both]
    }
}

fn inverse(mask: &Image) -> Image {
    Image { pixels: mask.pixels.iter().map(|v| 1.0 - v).collect(), ..*mask }
}

/// Share of the pixels that a mask selects.
fn share(mask: &Image) -> f64 {
    mask.pixels.iter().filter(|v| **v > 0.5).count() as f64 / mask.pixels.len() as f64
}

/// Scores of one image.
#[derive(Clone)]
pub struct Scores {
    distance: String,
    whole: Quality,
    /// PSNR and SSIM of each of [`REGIONS`]; `None` where a region is unknown or too small.
    regions: [Option<(f64, f64)>; 4],
    /// Share of the pixels that no input frame saw.
    not_filmed: Option<f64>,
}

impl Scores {
    /// Compares a rendered image with the true one.
    ///
    /// # Errors
    /// The image or a mask has another size; the network for LPIPS fails.
    pub fn of(shot: &Shot, picture: &Image, lpips: Option<&mut LpipsNetwork>) -> Result<Scores> {
        let whole = Quality::of(&shot.name, picture, &shot.truth, None)?.with_lpips(
            lpips,
            picture,
            &shot.truth,
        )?;
        let similarity = ssim_map(picture, &shot.truth)?;
        let mut regions = [None; 4];
        for (score, mask) in regions.iter_mut().zip(shot.regions()) {
            if let Some(mask) = mask.filter(|mask| share(mask) >= LEAST_SHARE) {
                let psnr = masked_psnr(picture, &shot.truth, &mask)?;
                *score = Some((psnr, masked_mean(&similarity, &mask)?));
            }
        }
        let not_filmed = shot.covisible.as_ref().map(|seen| 1.0 - share(seen));
        Ok(Scores { distance: shot.distance.clone(), whole, regions, not_filmed })
    }

    fn json(&self) -> Value {
        let mut row = self.whole.json();
        for (name, score) in REGIONS.iter().zip(&self.regions) {
            row[name] = json!(score.map(|(psnr, ssim)| json!({ "psnr": psnr, "ssim": ssim })));
        }
        row["not_filmed_share"] = json!(self.not_filmed);
        row
    }
}

/// Scores of an image from the aligned pose, and from the pose fitted to it.
pub struct Judged {
    aligned: Scores,
    fitted: Option<Scores>,
}

/// Renders a scene for held-out images and scores it.
pub struct Judge<'a> {
    /// Renderer with the scene loaded.
    pub renderer: &'a mut Renderer,
    /// Background colour.
    pub background: [f32; 3],
    /// Whether each pose is also fitted to its image.
    pub fit: bool,
    /// Output of the side-by-side comparisons.
    pub comparisons: Option<&'a Comparisons>,
    /// Network for LPIPS.
    pub lpips: Option<&'a mut LpipsNetwork>,
}

impl Judge<'_> {
    /// Scores one image, the `index`-th of all.
    pub fn judge(&mut self, index: usize, shot: &Shot) -> Result<Judged> {
        let rendered = self.renderer.render(&shot.camera, shot.time)?;
        let picture = eight_bits(rendered.over(self.background));
        let aligned = Scores::of(shot, &picture, self.lpips.as_deref_mut())?;
        if let Some(comparisons) = self.comparisons {
            comparisons.write(index, &shot.truth, &picture)?;
        }
        let fitted = match (self.fit, median_depth(&rendered.mean_depth())) {
            (false, _) => None,
            (true, Some(depth)) => Some(self.fitted(shot, depth)?),
            // Nothing is visible, so no pose can be fitted.
            (true, None) => Some(aligned.clone()),
        };
        Ok(Judged { aligned, fitted })
    }

    /// Scores from the pose that best fits the static pixels seen by the input.
    fn fitted(&mut self, shot: &Shot, depth: f64) -> Result<Scores> {
        let [covisible, _, outside_movers, both] = shot.regions();
        let mask = both.or(covisible).or(outside_movers);
        let Judge { renderer, background, lpips, .. } = self;
        let mut render = |camera: &Camera| -> Result<Image> {
            Ok(renderer.render(camera, shot.time)?.over(*background))
        };
        let mut camera = shot.camera;
        if mask.as_ref().is_none_or(|mask| share(mask) >= LEAST_SHARE) {
            let fit = fit_pose(&camera, depth, &shot.truth, mask.as_ref(), &mut render)?;
            camera.view_from_world = fit.view_from_world;
        }
        let picture = eight_bits(render(&camera)?);
        Scores::of(shot, &picture, lpips.as_deref_mut())
    }
}

/// The image quantised to 8 bits, as in published evaluations.
pub fn eight_bits(mut picture: Image) -> Image {
    picture.pixels.iter_mut().for_each(|v| *v = (v.clamp(0.0, 1.0) * 255.0).round() / 255.0);
    picture
}

/// The median depth of a rendered image; `None` where it is empty.
fn median_depth(depth: &Image) -> Option<f64> {
    let mut known: Vec<f32> = depth.pixels.iter().copied().filter(|d| *d > 0.0).collect();
    let middle = known.len() / 2;
    (!known.is_empty()).then(|| f64::from(*known.select_nth_unstable_by(middle, f32::total_cmp).1))
}

/// The keys about held-out images.
pub fn keys(judged: &[Judged]) -> Map<String, Value> {
    let aligned: Vec<&Scores> = judged.iter().map(|j| &j.aligned).collect();
    let fitted: Option<Vec<&Scores>> = judged.iter().map(|j| j.fitted.as_ref()).collect();
    let whole = |figure: fn(&Quality) -> Option<f64>| {
        mean(aligned.iter().map(|scores| figure(&scores.whole)))
    };
    let per_frame: Vec<Value> = aligned.iter().map(|scores| scores.json()).collect();
    Map::from_iter([
        ("psnr".into(), json!(whole(|q| Some(q.psnr)))),
        ("ssim".into(), json!(whole(|q| Some(q.ssim)))),
        ("ms_ssim".into(), json!(whole(|q| q.ms_ssim))),
        ("lpips".into(), json!(whole(|q| q.lpips))),
        ("per_frame".into(), json!(per_frame)),
        ("held_out".into(), rows(&aligned)),
        (
            "held_out_fitted".into(),
            fitted.filter(|f| !f.is_empty()).map_or(Value::Null, |f| rows(&f)),
        ),
    ])
}

/// A row for each distance, in the order of the images, and, if there are several, one over all.
fn rows(scores: &[&Scores]) -> Value {
    let mut distances: Vec<&str> = Vec::new();
    for Scores { distance, .. } in scores {
        if !distances.contains(&distance.as_str()) {
            distances.push(distance);
        }
    }
    let row = |distance: &str, of: &[&Scores]| {
        let whole = |figure: fn(&Quality) -> Option<f64>| mean(of.iter().map(|s| figure(&s.whole)));
        let psnr = |s: &&Scores| (s.whole.name.clone(), s.whole.psnr);
        let (worst, worst_picture) = worst(of.iter().map(psnr));
        let mut row = json!({
            "distance": distance,
            "pictures": of.len(),
            "psnr": whole(|q| Some(q.psnr)),
            "ssim": whole(|q| Some(q.ssim)),
            "ms_ssim": whole(|q| q.ms_ssim),
            "lpips": whole(|q| q.lpips),
            "worst": worst,
            "worst_picture": worst_picture,
            "not_filmed_share": mean(of.iter().map(|s| s.not_filmed)),
        });
        for (k, name) in REGIONS.iter().enumerate() {
            row[name] = region(of, k);
        }
        row
    };
    let mut rows: Vec<Value> = Vec::new();
    for distance in &distances {
        let of: Vec<&Scores> = scores.iter().copied().filter(|s| s.distance == *distance).collect();
        rows.push(row(distance, &of));
    }
    if distances.len() > 1 {
        rows.push(row("all", scores));
    }
    Value::Array(rows)
}

/// Means over the images in which a region is known and large enough.
fn region(of: &[&Scores], k: usize) -> Value {
    let known: Vec<(&str, f64, f64)> = of
        .iter()
        .filter_map(|s| s.regions[k].map(|(psnr, ssim)| (s.whole.name.as_str(), psnr, ssim)))
        .collect();
    if known.is_empty() {
        return Value::Null;
    }
    let (worst, worst_picture) =
        worst(known.iter().map(|(name, psnr, _)| (name.to_string(), *psnr)));
    json!({
        "psnr": mean(known.iter().map(|(_, psnr, _)| Some(*psnr))),
        "ssim": mean(known.iter().map(|(_, _, ssim)| Some(*ssim))),
        "worst": worst,
        "worst_picture": worst_picture,
        "pictures": known.len(),
    })
}

/// The lowest PSNR and its image.
fn worst(of: impl Iterator<Item = (String, f64)>) -> (Option<f64>, Option<String>) {
    of.min_by(|a, b| a.1.total_cmp(&b.1)).map(|(name, psnr)| (psnr, name)).unzip()
}

/// The rows of [`keys`] as a table.
pub fn table(found: &Value) -> String {
    let mut text = String::new();
    for (key, title) in
        [("held_out", "held out"), ("held_out_fitted", "held out, each pose fitted to its image")]
    {
        let Some(rows) = found[key].as_array().filter(|rows| !rows.is_empty()) else { continue };
        let _ = writeln!(
            text,
            "{title}: PSNR in dB (of the worst image)\n\
             {:14}{:>8}{:>15}{:>8}{:>9}{:>8}{:>16}{:>16}{:>16}{:>12}",
            "distance",
            "images",
            "whole",
            "SSIM",
            "MS-SSIM",
            "LPIPS",
            "movers",
            "outside",
            "static, filmed",
            "not filmed"
        );
        for row in rows {
            let decibels = |of: &Value| match (of["psnr"].as_f64(), of["worst"].as_f64()) {
                (Some(psnr), Some(worst)) => format!("{psnr:.2} ({worst:.2})"),
                _ => "–".to_owned(),
            };
            let figure = |of: &Value| of.as_f64().map_or("–".to_owned(), |v| format!("{v:.4}"));
            let _ = writeln!(
                text,
                "{:14}{:>8}{:>15}{:>8}{:>9}{:>8}{:>16}{:>16}{:>16}{:>12}",
                row["distance"].as_str().unwrap_or_default(),
                row["pictures"].as_u64().unwrap_or_default(),
                decibels(row),
                figure(&row["ssim"]),
                figure(&row["ms_ssim"]),
                figure(&row["lpips"]),
                decibels(&row["movers"]),
                decibels(&row["outside_movers"]),
                decibels(&row["static_covisible"]),
                row["not_filmed_share"]
                    .as_f64()
                    .map_or("–".to_owned(), |v| format!("{:.1} %", 100.0 * v)),
            );
        }
    }
    text
}

/// Files with the true image, the rendered one and their difference side by side. They are written to a
/// temporary place until all exist, so that a command that fails leaves none.
pub struct Comparisons {
    files: Vec<PathBuf>,
    until_all_are_there: TempDir,
}

impl Comparisons {
    /// One file per name in a folder; checks that all can be written and that none is an input of the
    /// command.
    ///
    /// # Errors
    /// Those of [`Outputs::folder`] and [`Inputs::spared_by`].
    pub fn new(folder: &Path, names: &[String], inputs: &Inputs) -> Result<Comparisons> {
        let mut taken = HashSet::new();
        let mut files = Vec::with_capacity(names.len());
        for name in names {
            let plain = plain(name);
            let mut unique = format!("{plain}.png");
            let mut count = 1;
            while !taken.insert(unique.clone()) {
                count += 1;
                unique = format!("{plain}_{count}.png");
            }
            files.push(folder.join(unique));
        }
        Outputs::default().folder(folder, &["0.png"])?;
        for file in &files {
            if file.is_dir() {
                return Err(Error::format(file, "is a folder, where an image is to be written"));
            }
            inputs.spared_by(file)?;
        }
        let elsewhere = tempfile::tempdir().map_err(Error::io(std::env::temp_dir()))?;
        Ok(Comparisons { files, until_all_are_there: elsewhere })
    }

    /// Temporary path of the file for the `index`-th name.
    fn elsewhere(&self, index: usize) -> PathBuf {
        self.until_all_are_there.path().join(format!("{index}.png"))
    }

    /// Writes the file for the `index`-th name.
    pub fn write(&self, index: usize, truth: &Image, picture: &Image) -> Result<()> {
        let (width, height) = (truth.width, truth.height);
        let mut sheet = Image::new(3 * width, height, 3);
        for y in 0..height {
            for x in 0..width {
                for c in 0..3 {
                    let (a, b) = (truth.at(x, y)[c], picture.at(x, y)[c].clamp(0.0, 1.0));
                    sheet.at_mut(x, y)[c] = a;
                    sheet.at_mut(x + width, y)[c] = b;
                    sheet.at_mut(x + 2 * width, y)[c] = (a - b).abs();
                }
            }
        }
        write_png(self.elsewhere(index), &sheet)
    }

    /// Moves the files to their final place.
    pub fn finish(self) -> Result<()> {
        for (index, file) in self.files.iter().enumerate() {
            let drawn = self.elsewhere(index);
            if drawn.exists() {
                let bytes = io::read(&drawn)?;
                io::write_atomically(file, |sink| sink.write_all(&bytes))?;
            }
        }
        Ok(())
    }
}

/// An image's name as a file name in one folder, without its extension.
fn plain(name: &str) -> String {
    let stem = Path::new(name).with_extension("");
    let text = stem.to_string_lossy();
    let kept = text.chars().map(|c| if c.is_alphanumeric() || c == '-' { c } else { '_' });
    kept.collect::<String>().trim_start_matches('_').to_owned()
}

//! `export --compact`: the scene in reduced precision, and the resulting image error.

use std::path::Path;

use serde_json::{Value, json};
use splat4d::eval::psnr;
use splat4d::renderer::Renderer;
use splat4d::scene::html::{self, Opening};
use splat4d::scene::{Scene, compact};
use splat4d::types::ControlPoints;
use splat4d::{Error, Result};

use super::common::{Common, bytes};
use super::interrupt;
use super::meter::Meter;

/// Number of compared views.
const VIEWS: usize = 12;
/// Maximum number of key times of paths that replace a network.
const MOST_KEYS: usize = 120;

/// When paths replace a network.
#[derive(Clone, Copy, PartialEq)]
pub enum Paths {
    WhereSmaller,
    Always,
}

/// Writes a scene in compact form, and returns its size and error: `export --help` lists the keys.
pub fn write(output: &Path, scene: &Scene, common: &Common) -> Result<Value> {
    let baked = baked(scene, common, Paths::WhereSmaller)?;
    compact::write(output, baked.as_ref().unwrap_or(scene))?;
    let folder = tempfile_beside(output)?;
    measured(output, folder.path(), scene, baked.is_some(), common)
}

/// Writes a page that plays a scene, and returns the size and error of its compact scene.
pub fn write_page(
    output: &Path,
    scene: &Scene,
    common: &Common,
    opening: &Opening,
) -> Result<Value> {
    let baked = baked(scene, common, Paths::Always)?;
    let small = baked.as_ref().unwrap_or(scene);
    html::write(output, small, opening)?;
    let folder = tempfile_beside(output)?;
    let packed = folder.path().join("packed.safetensors");
    compact::write(&packed, &Scene { report: Value::Null, ..small.clone() })?;
    measured(&packed, folder.path(), scene, baked.is_some(), common)
}

/// Size and error of a compact scene relative to its source.
fn measured(
    packed: &Path,
    folder: &Path,
    scene: &Scene,
    baked: bool,
    common: &Common,
) -> Result<Value> {
    let written =
        |path: &Path| Ok::<u64, Error>(std::fs::metadata(path).map_err(Error::io(path))?.len());
    // The plain size is that of a new file, because the input may have another format.
    let plain = folder.join("plain.safetensors");
    scene.save(&plain)?;
    let (plain, small) = (written(&plain)?, written(packed)?);
    let views = compared(scene, &Scene::open(packed, false)?.scene, common)?;
    let mean = views.iter().sum::<f64>() / views.len().max(1) as f64;
    let input = scene.report["psnr_input"].as_f64();
    let some = |value: f64| (!views.is_empty()).then_some(value);
    Ok(json!({
        "plain_bytes": plain,
        "scene_bytes": small,
        "share": small as f64 / plain as f64,
        "baked": baked,
        "psnr": some(mean),
        "psnr_worst": some(views.iter().copied().fold(f64::INFINITY, f64::min)),
        "psnr_lost": input.filter(|_| !views.is_empty()).map(|input| lost(input, mean)),
        "views": views.len(),
    }))
}

/// The text output.
pub fn told(compact: &Value) -> String {
    let plain = bytes(compact["plain_bytes"].as_u64().unwrap_or(0));
    let share = 100.0 * compact["share"].as_f64().unwrap_or(0.0);
    let small = bytes(compact["scene_bytes"].as_u64().unwrap_or(0));
    let mut text =
        format!("the compact scene: {small}, {share:.1} % of the plain form's {plain}\n");
    match (compact["psnr"].as_f64(), compact["psnr_worst"].as_f64()) {
        (Some(mean), Some(worst)) => {
            let views = &compact["views"];
            text += &format!(
                "{mean:.2} dB PSNR against the scene as it was ({worst:.2} at worst, {views} views)"
            );
            if let Some(lost) = compact["psnr_lost"].as_f64() {
                text +=
                    &format!("; of the scene's own PSNR against its input that takes {lost:.3} dB");
            }
            text.push('\n');
        }
        _ => text += "the scene knows no cameras to compare images from\n",
    }
    text
}

/// Decrease of a PSNR when an independent error with another PSNR is added.
fn lost(psnr: f64, added: f64) -> f64 {
    10.0 * (1.0 + 10f64.powf((psnr - added) / 10.0)).log10()
}

fn tempfile_beside(output: &Path) -> Result<tempfile::TempDir> {
    let parent = match output.parent() {
        Some(parent) if parent != Path::new("") => parent,
        _ => Path::new("."),
    };
    tempfile::Builder::new().prefix(".splat4d-").tempdir_in(parent).map_err(Error::io(parent))
}

/// The scene with paths in place of its network; `None` where it has no network, or where the paths are
/// larger and only smaller ones are requested.
pub fn baked(scene: &Scene, common: &Common, paths: Paths) -> Result<Option<Scene>> {
    let Some(network) = scene.network.as_ref().filter(|_| scene.moves()) else { return Ok(None) };
    let mut times: Vec<f64> = scene.cameras.iter().map(|camera| camera.time).collect();
    times.sort_by(f64::total_cmp);
    times.dedup();
    let keys = times.len().clamp(2, MOST_KEYS);
    let larger = keys * scene.control_points.len() * 8 >= network.parameters.len();
    if larger && paths == Paths::WhereSmaller {
        return Ok(None);
    }
    let mut renderer = Renderer::new(&common.open_device()?, scene)?;
    let mut motions = Vec::new();
    for key in 0..keys {
        interrupt::check()?;
        motions.extend(renderer.motions(key as f64 / (keys - 1) as f64)?);
    }
    let control_points = ControlPoints { paths: motions, ..scene.control_points.clone() };
    Ok(Some(Scene { control_points, network: None, ..scene.clone() }))
}

/// PSNR of some views of the compact scene relative to the plain one.
fn compared(plain: &Scene, small: &Scene, common: &Common) -> Result<Vec<f64>> {
    let count = plain.cameras.len().min(VIEWS);
    if count == 0 {
        return Ok(Vec::new());
    }
    let device = common.open_device()?;
    let mut renderers = [Renderer::new(&device, plain)?, Renderer::new(&device, small)?];
    let mut meter = Meter::new("comparing", "views", count as u64, 0);
    let mut found = Vec::new();
    for i in 0..count {
        interrupt::check()?;
        let known = &plain.cameras[i * plain.cameras.len() / count];
        let mut pictures = Vec::new();
        for renderer in &mut renderers {
            pictures.push(renderer.render(&known.camera, known.time)?.over(plain.background));
        }
        found.push(psnr(&pictures[0], &pictures[1])?.min(100.0));
        meter.advance();
    }
    Ok(found)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_an_added_error_takes() {
        assert!((lost(30.0, 30.0) - 10.0 * 2f64.log10()).abs() < 1e-12);
        assert!(lost(30.0, 50.0) < 0.05);
    }
}

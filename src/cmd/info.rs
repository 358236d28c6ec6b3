//! `splat4d info`: shows the contents of a scene file.

use std::fmt::Write;
use std::path::PathBuf;

use clap::Args;
use serde_json::{Value, json};
use splat4d::Result;
use splat4d::scene::{Opened, Scene};
use splat4d::types::{Gaussians, NetShape};

use super::common::{Answer, thousands};

const AFTER_HELP: &str = "\
Example:
  splat4d info scene.safetensors

JSON: gaussians, dropped, sh_degree, dynamic_share, control_points, path_keys (key times of their
paths, 0 without), neighbours, network ({depth, width, skip, position_frequencies,
time_frequencies, position_octave, parameters} or null), cameras, times ([first,
last] or null), width, height, focal (of the first camera, or null), bounding_box ([[x, y, z],
[x, y, z]] or null), background, up, report";

/// Show the contents of a scene file or a 3DGS PLY
#[derive(Args)]
#[command(after_help = AFTER_HELP)]
pub struct InfoArgs {
    /// A scene file or a 3DGS PLY
    #[arg(value_name = "SCENE|PLY")]
    scene: PathBuf,
    /// Skip Gaussians with NaN, infinite or out-of-range values
    #[arg(long)]
    drop_bad: bool,
}

/// Share of the Gaussians that are bound to control points.
pub fn dynamic_share(scene: &Scene) -> f64 {
    let moving = scene.gaussians.motion_logits.iter().filter(|&&m| m > 0.0).count();
    moving as f64 / scene.gaussians.len().max(1) as f64
}

/// Runs the command.
pub fn run(args: &InfoArgs) -> Result<Answer> {
    let Opened { scene, dropped } = Scene::open(&args.scene, args.drop_bad)?;
    let g = &scene.gaussians;
    let bounds = bounding_box(g);
    let network = scene.network.as_ref().map(|network| {
        let NetShape { depth, width, skip, .. } = network.shape;
        let NetShape { position_frequencies, time_frequencies, position_octave, .. } =
            network.shape;
        json!({
            "depth": depth, "width": width, "skip": skip,
            "position_frequencies": position_frequencies, "time_frequencies": time_frequencies,
            "position_octave": position_octave,
            "parameters": network.parameters.len(),
        })
    });
    let first = scene.cameras.first();
    let last = scene.cameras.last();
    let times = first.zip(last).map(|(first, last)| [first.time, last.time]);
    let json = json!({
        "gaussians": g.len(),
        "dropped": dropped,
        "sh_degree": g.sh_degree,
        "dynamic_share": dynamic_share(&scene),
        "control_points": scene.control_points.len(),
        "path_keys": scene.control_points.keys(),
        "neighbours": scene.neighbours,
        "network": network,
        "cameras": scene.cameras.len(),
        "times": times,
        "width": first.map(|c| c.camera.intrinsics.width),
        "height": first.map(|c| c.camera.intrinsics.height),
        "focal": first.map(|c| c.camera.intrinsics.fx),
        "bounding_box": bounds,
        "background": scene.background,
        "up": scene.up,
        "report": scene.report,
    });
    let mut text = String::new();
    let _ = writeln!(text, "Gaussians       {}", thousands(g.len()));
    if dropped > 0 {
        let _ =
            writeln!(text, "left out        {} (not finite or out of range)", thousands(dropped));
    }
    let _ = writeln!(text, "dynamic         {:.1} %", 100.0 * dynamic_share(&scene));
    let _ = writeln!(text, "harmonics       degree {}", g.sh_degree);
    let _ = writeln!(text, "control points  {}", scene.control_points.len());
    if scene.control_points.keys() > 0 {
        let _ = writeln!(text, "paths           {} key times", scene.control_points.keys());
    }
    if let Some(network) = &scene.network {
        let NetShape { depth, width, .. } = network.shape;
        let parameters = thousands(network.parameters.len());
        let _ =
            writeln!(text, "network         {depth} layers of {width}, {parameters} parameters");
    }
    match first {
        Some(first) => {
            let k = first.camera.intrinsics;
            let (count, focal) = (scene.cameras.len(), k.fx);
            let size = format!("{}×{}", k.width, k.height);
            let _ = writeln!(text, "cameras         {count}, {size}, focal length {focal:.1} px");
        }
        None => {
            let _ = writeln!(text, "cameras         none");
        }
    }
    if let Some([low, high]) = bounds {
        let _ = writeln!(text, "bounding box    {low:.3?} to {high:.3?}");
    }
    if scene.report != Value::Null {
        let _ = writeln!(text, "report          {:#}", scene.report);
    }
    Ok(Answer { json, text })
}

/// Bounding box of the static Gaussians, or of all where there are none: the canonical positions of dynamic
/// ones are arbitrary.
fn bounding_box(g: &Gaussians) -> Option<[[f32; 3]; 2]> {
    let mut chosen: Vec<usize> = (0..g.len()).filter(|i| !g.moves(*i)).collect();
    if chosen.is_empty() {
        chosen = (0..g.len()).collect();
    }
    let first = g.positions[*chosen.first()?];
    Some(chosen.iter().map(|i| g.positions[*i]).fold([first, first], |[low, high], p| {
        [std::array::from_fn(|k| low[k].min(p[k])), std::array::from_fn(|k| high[k].max(p[k]))]
    }))
}

//! Rendering speed of a scene with some settings, and its error relative to the oracle.

use serde_json::{Value, json};
use splat4d::bench::{Pace, Shot, machine, measure_settings};
use splat4d::gpu::Device;
use splat4d::report::{Clock, Spread, scientific};
use splat4d::scene::Scene;
use splat4d::types::Tuning;
use splat4d::{Error, Result};

use super::common::{Answer, say, thousands};
use super::shots::Shots;

/// Number of measured views; the oracle is slow for each.
const VIEWS: usize = 3;

/// Measures on views spread over the path.
pub fn measure(device: &Device, scene: &Scene, tuning: &Tuning, shots: &Shots) -> Result<Answer> {
    let count = shots.len().min(VIEWS);
    let views: Vec<Shot> = (0..count)
        .map(|i| shots.at((2 * i + 1) * shots.len() / (2 * count)))
        .map(|shot| Shot { camera: shot.camera, time: shot.time })
        .collect();
    let Some(first) = views.first() else {
        return Err(Error::Input("the path has no camera to measure from".into()));
    };
    let software = machine(device).software;
    if software {
        say("note: a software driver: its times say nothing of a GPU");
    }
    let (point, clock) = measure_settings(device, scene, tuning, &views, Pace::FULL)?;
    let rate = Spread::new(point.time.samples().iter().map(|time| 1e9 / time).collect())
        .ok_or_else(|| Error::Failed("no time was measured".into()))?;
    let milliseconds = point.time.quartiles().map(|time| time / 1e6);
    let k = first.camera.intrinsics;
    let json = json!({
        "frames_per_second": spread(&rate),
        "milliseconds": { "median": point.time.median() / 1e6, "quartiles": milliseconds },
        "ratio": spread(&point.ratio),
        "clock": clock,
        "error": point.error,
        "settings": point.settings,
        "views": views.len(),
        "rounds": point.time.samples().len(),
        "width": k.width,
        "height": k.height,
        "gaussians": scene.gaussians.len(),
        "device": device.info().name,
        "software": software,
    });
    let [low, high] = rate.quartiles();
    let by = match clock {
        Clock::Device => "the device's clock, without download",
        Clock::Host => "the host's clock, with download",
    };
    let [least, most] = point.ratio.quartiles();
    let text = format!(
        "{:.1} frames a second ({low:.1} to {high:.1}, quartiles of {} rounds over {} views), {}×{}, {} \
         Gaussians\nby {by}; {:.3} of the time of the most accurate settings ({least:.3} to \
         {most:.3})\nerror against the oracle in f64: largest {}, RMSE {}, PSNR {:.1} dB\nsettings: {}\n",
        rate.median(),
        point.time.samples().len(),
        views.len(),
        k.width,
        k.height,
        thousands(scene.gaussians.len()),
        point.ratio.median(),
        scientific(point.error.max),
        scientific(point.error.rmse),
        point.error.psnr,
        point.settings,
    );
    Ok(Answer { json, text })
}

fn spread(spread: &Spread) -> Value {
    json!({ "median": spread.median(), "quartiles": spread.quartiles() })
}

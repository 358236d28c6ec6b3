//! How close pictures come to others.

use serde_json::{Value, json};
use splat4d::Result;
use splat4d::data::View;
use splat4d::eval::{masked_psnr, ms_ssim, psnr, ssim};
use splat4d::observe::onnx::LpipsNetwork;
use splat4d::renderer::Renderer;
use splat4d::scene::Scene;
use splat4d::types::{Image, SH_C0};

use super::interrupt;
use super::meter::Meter;

/// The smaller side needs more than this for MS-SSIM's five scales.
const MS_SSIM_SIDE: u32 = 160;

/// How close one picture comes to another.
#[derive(Clone)]
pub struct Quality {
    /// What messages call it.
    pub name: String,
    /// dB; infinite for equal pictures.
    pub psnr: f64,
    /// As the 3DGS family reports it.
    pub ssim: f64,
    /// `None` for pictures that are too small.
    pub ms_ssim: Option<f64>,
    /// `None` where no network measures it.
    pub lpips: Option<f64>,
}

impl Quality {
    /// Compares a picture with the true one; PSNR over the pixels where `valid` is 1.
    pub fn of(
        name: &str,
        picture: &Image,
        truth: &Image,
        valid: Option<&Image>,
    ) -> Result<Quality> {
        let large = truth.width.min(truth.height) > MS_SSIM_SIDE;
        Ok(Quality {
            name: name.to_owned(),
            psnr: match valid {
                Some(valid) => masked_psnr(picture, truth, valid)?,
                None => psnr(picture, truth)?,
            },
            ssim: ssim(picture, truth)?,
            ms_ssim: if large { Some(ms_ssim(picture, truth)?) } else { None },
            lpips: None,
        })
    }

    /// With LPIPS, where there is a network for it; of all pixels.
    pub fn with_lpips(
        self,
        network: Option<&mut LpipsNetwork>,
        picture: &Image,
        truth: &Image,
    ) -> Result<Quality> {
        let lpips = network.map(|network| network.distance(picture, truth)).transpose()?;
        Ok(Quality { lpips, ..self })
    }

    /// `{name, psnr, ssim, ms_ssim, lpips}`.
    pub fn json(&self) -> Value {
        let Quality { name, psnr, ssim, ms_ssim, lpips } = self;
        json!({ "name": name, "psnr": psnr, "ssim": ssim, "ms_ssim": ms_ssim, "lpips": lpips })
    }
}

/// Renders a scene from the cameras of some pictures and compares.
pub fn measure(
    renderer: &mut Renderer,
    views: &[View],
    background: [f32; 3],
    what: &'static str,
) -> Result<Vec<Quality>> {
    let mut meter = Meter::new(what, "pictures", views.len() as u64, 0);
    let mut found = Vec::with_capacity(views.len());
    for view in views {
        interrupt::check()?;
        let picture = renderer.render(&view.camera, view.time)?.over(background);
        found.push(Quality::of(&view.name, &picture, &view.image, view.valid.as_ref())?);
        meter.advance();
    }
    Ok(found)
}

/// Mean of a figure over some pictures; `None` without pictures, or where one lacks the figure.
pub fn mean(figures: impl Iterator<Item = Option<f64>>) -> Option<f64> {
    let values: Option<Vec<f64>> = figures.collect();
    let values = values.filter(|values| !values.is_empty())?;
    Some(values.iter().sum::<f64>() / values.len() as f64)
}

/// The scene with its dynamic Gaussians white and all others black: over black, it renders as the
/// share of each pixel that moves.
pub fn motion_only(scene: &Scene) -> Scene {
    let mut scene = scene.clone();
    let g = &mut scene.gaussians;
    g.sh_degree = 0;
    g.sh = (0..g.len())
        .map(|i| {
            let moves = g.motion_logits.get(i).is_some_and(|&m| m > 0.0);
            [(if moves { 0.5 } else { -0.5 }) / SH_C0; 3]
        })
        .collect();
    scene
}

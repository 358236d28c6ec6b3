//! Image quality of a scene relative to reference images.

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

/// The smaller side must exceed this for the five scales of MS-SSIM, pixels.
const MS_SSIM_SIDE: u32 = 160;

/// Quality of one image relative to another.
#[derive(Clone)]
pub struct Quality {
    /// Name in messages.
    pub name: String,
    /// PSNR in dB; infinite for equal images.
    pub psnr: f64,
    /// SSIM as 3DGS and related work report it.
    pub ssim: f64,
    /// MS-SSIM; `None` for images that are too small.
    pub ms_ssim: Option<f64>,
    /// LPIPS; `None` without a network.
    pub lpips: Option<f64>,
}

impl Quality {
    /// Compares an image with the true one; PSNR is over the pixels where `valid` is 1.
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

    /// Adds LPIPS over all pixels, if there is a network.
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

/// Renders a scene from the cameras of some images and compares.
pub fn measure(
    renderer: &mut Renderer,
    views: &[View],
    background: [f32; 3],
    what: &'static str,
) -> Result<Vec<Quality>> {
    let mut meter = Meter::new(what, "images", views.len() as u64, 0);
    let mut found = Vec::with_capacity(views.len());
    for view in views {
        interrupt::check()?;
        let picture = renderer.render(&view.camera, view.time)?.over(background);
        found.push(Quality::of(&view.name, &picture, &view.image, view.valid.as_ref())?);
        meter.advance();
    }
    Ok(found)
}

/// Mean of a metric over some images; `None` without images, or where it is missing for one.
pub fn mean(figures: impl Iterator<Item = Option<f64>>) -> Option<f64> {
    let values: Option<Vec<f64>> = figures.collect();
    let values = values.filter(|values| !values.is_empty())?;
    Some(values.iter().sum::<f64>() / values.len() as f64)
}

/// The scene with white dynamic and black static Gaussians: over a black background, it renders as the
/// movers' share of each pixel.
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

//! The whole renderer, forward and backward: projection, binning and blending.

use super::Real;
use super::bin::{Bins, bin};
use super::project::{Splat, project};
use super::project_backward::{SplatGradient, ViewGradient, project_backward};
use super::raster::{self, Pixels};
use super::view::{Cloud, View};
use crate::types::RenderSettings;

/// A rendered image with the intermediate results for the backward pass.
#[derive(Clone, Debug)]
pub struct Rendered<R> {
    /// Every Gaussian's splat, `None` for the culled.
    pub splats: Vec<Option<Splat<R>>>,
    /// The tiles' lists.
    pub bins: Bins,
    /// The image.
    pub pixels: Pixels<R>,
}

/// Renders `cloud` as `view` sees it.
pub fn forward<R: Real>(
    cloud: &Cloud<R>,
    view: &View<R>,
    settings: &RenderSettings,
) -> Rendered<R> {
    let splats = project(cloud, view, settings);
    let bins = bin(&splats, settings, view.width, view.height);
    let pixels = raster::forward(&splats, &bins, settings, view.width, view.height);
    Rendered { splats, bins, pixels }
}

/// Gradients with respect to the Gaussians, the camera and the splats, given that with respect to
/// the pixels.
pub fn backward<R: Real>(
    cloud: &Cloud<R>,
    view: &View<R>,
    settings: &RenderSettings,
    rendered: &Rendered<R>,
    gradient: &Pixels<R>,
) -> (Cloud<R>, ViewGradient<R>, Vec<SplatGradient<R>>) {
    let splats = raster::backward(
        &rendered.splats,
        &rendered.bins,
        settings,
        view.width,
        view.height,
        &rendered.pixels,
        gradient,
    );
    let (gaussians, camera) = project_backward(cloud, view, settings, &rendered.splats, &splats);
    (gaussians, camera, splats)
}

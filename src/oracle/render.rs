//! The renderer from Gaussians to pixels and back: projection, binning and blending in a row.

use super::Real;
use super::bin::{Bins, bin};
use super::project::{Splat, project};
use super::project_backward::{SplatGradient, ViewGradient, project_backward};
use super::raster::{self, Pixels};
use super::view::{Cloud, View};
use crate::types::RenderSettings;

/// An image with what the backward pass reads again.
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

/// Gradients to the Gaussians, the camera and, on the way, the splats, given that to the pixels.
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

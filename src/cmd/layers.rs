//! The layers that `render` writes of each image.

use std::path::Path;

use clap::ValueEnum;
use splat4d::data::{exr, flo, write_png};
use splat4d::renderer::{Rendered, Renderer};
use splat4d::scene::SceneCamera;
use splat4d::types::Image;
use splat4d::{Error, Result};

use super::pictures::{self, DepthScale};

/// Flow value that marks unknown pixels in `.flo` files.
const UNKNOWN_FLOW: f32 = 1e10;
/// Minimum flow length that is shown at full saturation, pixels.
const LEAST_FLOW: f64 = 1.0;

/// A layer of a rendered image.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Layer {
    /// Colour over the background
    #[value(alias = "color")]
    Colour,
    /// Mean depth along z
    Depth,
    /// Opacity of each pixel
    Alpha,
    /// Share of each pixel that comes from movers
    Motion,
    /// Motion to the next image of the path, in pixels
    Flow,
    /// Normals in the camera frame
    Normal,
}

impl Layer {
    /// Suffix of the layer's files after the number.
    fn mark(self) -> &'static str {
        match self {
            Layer::Colour => "",
            Layer::Depth => "_depth",
            Layer::Alpha => "_alpha",
            Layer::Motion => "_motion",
            Layer::Flow => "_flow",
            Layer::Normal => "_normal",
        }
    }

    /// Whether the layer needs an additional rendering pass.
    pub fn is_repainted(self) -> bool {
        matches!(self, Layer::Motion | Layer::Flow | Layer::Normal)
    }
}

/// Writes images in order. The first image determines the shading ranges of depth and flow for all.
pub struct Writer<'a> {
    what: &'a [Layer],
    /// Whether float images are written as well.
    float: bool,
    /// Whether file names are only numbers.
    plain: bool,
    background: [f32; 3],
    depths: Option<DepthScale>,
    most_flow: Option<f64>,
}

/// One image of a path.
pub struct Picture<'a> {
    pub index: usize,
    pub shot: SceneCamera,
    pub next: Option<SceneCamera>,
    pub rendered: &'a Rendered,
}

impl<'a> Writer<'a> {
    /// A writer of these layers; `plain` for a single layer with plain numbers as file names.
    pub fn new(what: &'a [Layer], float: bool, plain: bool, background: [f32; 3]) -> Writer<'a> {
        Writer { what, float, plain, background, depths: None, most_flow: None }
    }

    /// File name suffixes of all layers.
    pub fn endings(what: &[Layer], float: bool) -> Vec<String> {
        let of = |layer: &Layer| {
            let float = float.then_some(if *layer == Layer::Flow { ".flo" } else { ".exr" });
            let mark = layer.mark();
            [Some(".png"), float].into_iter().flatten().map(move |kind| format!("{mark}{kind}"))
        };
        what.iter().flat_map(of).collect()
    }

    /// Writes all layers of one image, which `renderer` has just rendered.
    pub fn write(
        &mut self,
        folder: &Path,
        renderer: &mut Renderer,
        picture: &Picture,
    ) -> Result<()> {
        for layer in self.what {
            let mark = if self.plain { "" } else { layer.mark() };
            let file = |kind: &str| folder.join(format!("{:04}{mark}{kind}", picture.index));
            if let Some((shown, map)) = self.drawn(*layer, renderer, picture)? {
                write_png(file(".png"), &shown)?;
                match layer {
                    _ if !self.float => {}
                    Layer::Flow => flo::write(file(".flo"), &known(map))?,
                    Layer::Depth => exr::write_depth(file(".exr"), &map)?,
                    Layer::Alpha | Layer::Motion => exr::write_grey(file(".exr"), &map)?,
                    Layer::Colour | Layer::Normal => exr::write_rgba(file(".exr"), &map)?,
                }
            }
        }
        Ok(())
    }

    /// The layer for display, and its values; `None` for flow without a next image.
    fn drawn(
        &mut self,
        layer: Layer,
        renderer: &mut Renderer,
        picture: &Picture,
    ) -> Result<Option<(Image, Image)>> {
        let Picture { shot, next, rendered, .. } = picture;
        Ok(Some(match layer {
            Layer::Colour => (rendered.over(self.background), rendered.rgba.clone()),
            Layer::Depth => {
                let depth = rendered.mean_depth();
                self.depths = self.depths.or_else(|| DepthScale::of([&depth]));
                let black = || Image::new(depth.width, depth.height, 3);
                (self.depths.map_or_else(black, |scale| scale.shade(&depth)), depth)
            }
            Layer::Alpha => {
                let pixels = rendered.rgba.pixels.chunks_exact(4).map(|p| p[3]).collect();
                let alpha = Image { channels: 1, pixels, ..rendered.rgba };
                (pictures::grey(&alpha), alpha)
            }
            Layer::Motion => {
                let moving = renderer.moving()?;
                (pictures::grey(&moving), moving)
            }
            Layer::Normal => {
                let normals = renderer.normals(&shot.camera, shot.time)?;
                (pictures::normals(&normals), normals)
            }
            Layer::Flow => {
                let Some(next) = next else { return Ok(None) };
                let (from, to) = ((&shot.camera, shot.time), (&next.camera, next.time));
                let flow = renderer.flow(rendered, from, to)?;
                let lengths = || pictures::lengths(&flow);
                let most = || pictures::brightest([lengths()].iter(), LEAST_FLOW);
                let most = *self.most_flow.get_or_insert_with(most);
                (pictures::flow(&flow, most), flow)
            }
        }))
    }
}

/// Flow values as stored in files.
fn known(mut flow: Image) -> Image {
    flow.pixels.iter_mut().filter(|v| !v.is_finite()).for_each(|v| *v = UNKNOWN_FLOW);
    flow
}

/// Checks that a path has enough images for every layer.
pub fn check(what: &[Layer], pictures: usize) -> Result<()> {
    if what.contains(&Layer::Flow) && pictures < 2 {
        let text = "--what flow is the motion to the next image, and the path has only one; give more \
                    --frames or --times";
        return Err(Error::Input(text.into()));
    }
    Ok(())
}

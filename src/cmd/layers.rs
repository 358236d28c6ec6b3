//! What `render` writes of each picture.

use std::path::Path;

use clap::ValueEnum;
use splat4d::data::transforms::TimedCamera;
use splat4d::data::{exr, flo, write_png};
use splat4d::renderer::{Rendered, Renderer};
use splat4d::types::Image;
use splat4d::{Error, Result};

use super::pictures::{self, DepthScale};

/// By which `.flo` marks what is not known.
const UNKNOWN_FLOW: f32 = 1e10;
/// Shades of flow reach to so many pixels at least.
const LEAST_FLOW: f64 = 1.0;

/// One of the things that a picture shows.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Layer {
    /// Colour over the background
    #[value(alias = "color")]
    Colour,
    /// Mean depth along z
    Depth,
    /// How opaque each pixel is
    Alpha,
    /// How much of each pixel comes from what moves
    Motion,
    /// Motion to the next picture of the path, in pixels
    Flow,
    /// Normals in the camera's axes
    Normal,
}

impl Layer {
    /// What its files' names hold after the number.
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

    /// Whether the picture is blended once more for it.
    pub fn is_repainted(self) -> bool {
        matches!(self, Layer::Motion | Layer::Flow | Layer::Normal)
    }
}

/// Writes pictures, one after the other. What the first one tells decides how depth and flow are shaded
/// in all.
pub struct Writer<'a> {
    what: &'a [Layer],
    /// Float images too.
    float: bool,
    /// The names have numbers alone.
    plain: bool,
    background: [f32; 3],
    depths: Option<DepthScale>,
    most_flow: Option<f64>,
}

/// One picture of a path.
pub struct Picture<'a> {
    pub index: usize,
    pub shot: TimedCamera,
    pub next: Option<TimedCamera>,
    pub rendered: &'a Rendered,
}

impl<'a> Writer<'a> {
    /// A writer of these; `plain`: of one, under plain numbers.
    pub fn new(what: &'a [Layer], float: bool, plain: bool, background: [f32; 3]) -> Writer<'a> {
        Writer { what, float, plain, background, depths: None, most_flow: None }
    }

    /// What the names of all files end with.
    pub fn endings(what: &[Layer], float: bool) -> Vec<String> {
        let of = |layer: &Layer| {
            let float = float.then_some(if *layer == Layer::Flow { ".flo" } else { ".exr" });
            let mark = layer.mark();
            [Some(".png"), float].into_iter().flatten().map(move |kind| format!("{mark}{kind}"))
        };
        what.iter().flat_map(of).collect()
    }

    /// Writes all of one picture, which `renderer` has just rendered.
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

    /// As people see it, and as it is; nothing where there is no next picture for flow.
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

/// Flow as its files hold it.
fn known(mut flow: Image) -> Image {
    flow.pixels.iter_mut().filter(|v| !v.is_finite()).for_each(|v| *v = UNKNOWN_FLOW);
    flow
}

/// That a path has a picture for every layer.
pub fn check(what: &[Layer], pictures: usize) -> Result<()> {
    if what.contains(&Layer::Flow) && pictures < 2 {
        let text = "--what flow is the motion to the next picture, and the path has only one; give more \
                    --frames or --times";
        return Err(Error::Input(text.into()));
    }
    Ok(())
}

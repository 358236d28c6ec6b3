//! Rendering of Gaussians and its gradients, by tiled rasterisation.
//!
//! The forward pass projects every Gaussian to a splat, lists the visible splats and sorts them by
//! depth. In that order it emits an intersection for every tile that a splat overlaps, and sorts the
//! intersections by tile. That sort is stable, so depth order holds within a tile. Then it blends tile
//! by tile. The number of intersections stays on the device. Where it exceeds the capacity of the
//! buffers, the farthest intersections are dropped and [`Frame::counts`] reports it, so that the caller
//! can grow the buffers and repeat the frame.

mod backward;
mod forward;
mod stages;

pub use backward::{FrameGradients, PixelGradientViews, PixelGradients};
pub use stages::{SplatViews, SplatViewsMut, TileLists};

use super::countable;
use super::gaussians::GaussianViews;
use super::scan::{Scan, ScanScratch};
use super::sort::{RadixSort, SortScratch};
use crate::gpu::{Buffer, Device, Groups, Profile, Stream, View, ViewMut};
use crate::types::{Camera, DEPTH_BITS, RasterKind, RenderSettings};
use crate::{Error, Result};

/// Side of a tile in pixels.
pub const TILE: u32 = 16;

/// A camera as the kernels read it: the rotation of `view_from_world` row by row (9 values), the camera
/// centre in the world rounded to f32 (3) and its rounding error (3), fx, fy, cx, cy in pixels, one
/// unused value.
pub fn device_camera(camera: &Camera) -> [f32; 20] {
    let rotation = camera.view_from_world.rotation_matrix();
    let (k, centre) = (camera.intrinsics, camera.centre());
    let rest = centre - centre.as_vec3().as_dvec3();
    let rows = rotation.transpose().to_cols_array();
    let mut floats = [0.0f32; 20];
    let values = rows
        .into_iter()
        .chain(centre.to_array())
        .chain(rest.to_array())
        .chain([k.fx, k.fy, k.cx, k.cy]);
    for (slot, value) in floats.iter_mut().zip(values) {
        *slot = value as f32;
    }
    floats
}

/// The plan of a [`Frame`]: image size, capacities, settings.
#[derive(Clone, Debug)]
pub struct Render {
    gaussians: usize,
    intersections: usize,
    width: u32,
    height: u32,
    settings: RenderSettings,
    raster: RasterKind,
    profile: Profile,
    subgroup_size: u32,
    depth_sort: RadixSort,
    tile_sort: RadixSort,
    scan: Scan,
}

/// A plan with everything that the rendering of an image reads and writes besides the scene. Without
/// gradients ([`Render::frame`]) it renders; with them ([`Render::differentiable`]) it also
/// differentiates.
///
/// ```no_run
/// use splat4d::gpu::Device;
/// use splat4d::ops::gaussians::GaussianBuffers;
/// use splat4d::ops::render::Render;
/// use splat4d::types::{Camera, Gaussians};
/// # fn draw(device: &Device, scene: &Gaussians, camera: &Camera) -> splat4d::Result<()> {
/// let mut stream = device.stream()?;
/// let gaussians = GaussianBuffers::from_host(&mut stream, scene)?;
/// let (n, k) = (gaussians.len, camera.intrinsics);
/// let render = Render::plan(device, n, 1 << 20, k.width, k.height, Default::default())?;
/// let mut frame = render.differentiable(device)?;
/// let mut recorder = stream.record()?;
/// frame.forward(&mut recorder, camera, gaussians.views(), Default::default())?;
///
/// // … a loss writes its gradient with respect to the image …
/// recorder.fill(frame.gradients.pixels.rgba.view_mut(), 0);
/// recorder.fill(frame.gradients.pixels.depth.view_mut(), 0);
///
/// let mut gradients = GaussianBuffers::new(device, n, gaussians.sh_degree)?;
/// let views = gaussians.views();
/// frame.backward(&mut recorder, views, Default::default(), &mut gradients, true)?;
/// stream.submit(recorder)?;
/// let by_pose = stream.download(frame.gradients.pose())?;
/// let counts = frame.counts(&mut stream)?;
/// assert!(counts.intersections <= frame.plan().intersection_capacity(), "else plan with more");
/// # Ok(())
/// # }
/// ```
pub struct Frame<G = ()> {
    pub(crate) plan: Render,
    pub(crate) scratch: RenderScratch,
    /// The image.
    pub pixels: PixelBuffers,
    /// The buffers of the backward pass; `()` in a frame that is not differentiated.
    pub gradients: G,
}

/// Intermediate buffers of the forward pass; the backward pass reads them again.
pub(crate) struct RenderScratch {
    pub(crate) camera: Buffer<f32>,
    pub(crate) count: Buffer<u32>,
    pub(crate) visible_count: Buffer<u32>,
    pub(crate) intersection_count: Buffer<u32>,
    /// The visible count and the intersection count, side by side, for the host to read.
    pub(crate) counts: Buffer<u32>,
    pub(crate) fits: Buffer<u32>,
    pub(crate) grid: Buffer<u32>,
    pub(crate) means: Buffer<[f32; 4]>,
    pub(crate) conics: Buffer<[f32; 4]>,
    pub(crate) colours: Buffer<[f32; 4]>,
    pub(crate) rectangles: Buffer<[u32; 2]>,
    pub(crate) tile_counts: Buffer<u32>,
    pub(crate) visible: Buffer<u32>,
    pub(crate) visible_from_splat: Buffer<u32>,
    pub(crate) keys: Buffer<u32>,
    pub(crate) splat_from_visible: Buffer<u32>,
    pub(crate) sorted_keys: Buffer<u32>,
    pub(crate) splat_from_rank: Buffer<u32>,
    pub(crate) rank_counts: Buffer<u32>,
    pub(crate) emitted_from_rank: Buffer<u32>,
    pub(crate) tiles: Buffer<u32>,
    pub(crate) emitted: Buffer<u32>,
    pub(crate) splat_from_emitted: Buffer<u32>,
    pub(crate) sorted_tiles: Buffer<u32>,
    pub(crate) emitted_from_sorted: Buffer<u32>,
    pub(crate) ranges: Buffer<[u32; 2]>,
    pub(crate) scan: ScanScratch,
    pub(crate) depth_sort: SortScratch,
    pub(crate) tile_sort: SortScratch,
}

/// A rendered image on the device.
pub struct PixelBuffers {
    /// Width, pixels.
    pub width: u32,
    /// Height, pixels.
    pub height: u32,
    /// Premultiplied colour without background, and alpha.
    pub rgba: Buffer<[f32; 4]>,
    /// Sum of α · T · z over the splats of a pixel (T: transmittance, z: depth in the camera frame).
    pub depth: Buffer<f32>,
    pub(crate) last: Buffer<u32>,
}

/// Views of the buffers that a rendered image is written to, in pixel order (row by row). The buffers
/// are arbitrary; they may belong to a host application. An output that is `None` goes to the frame's
/// own [`pixels`](Frame::pixels), which the backward pass reads.
#[derive(Default)]
pub struct PixelViews<'a> {
    /// Premultiplied colour without background, and alpha.
    pub rgba: Option<ViewMut<'a, [f32; 4]>>,
    /// Sum of α · T · z over the splats of a pixel (T: transmittance, z: depth in the camera frame).
    pub depth: Option<ViewMut<'a, f32>>,
    /// For the backward pass: one past the last intersection that each pixel blended, counted from its
    /// tile's first.
    pub last: Option<ViewMut<'a, u32>>,
}

impl PixelBuffers {
    /// Writable views of all of it.
    pub fn views_mut(&mut self) -> PixelViews<'_> {
        PixelViews {
            rgba: Some(self.rgba.view_mut()),
            depth: Some(self.depth.view_mut()),
            last: Some(self.last.view_mut()),
        }
    }
}

/// Counts of the last frame; see [`Frame::counts`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct FrameCounts {
    /// Gaussians that were not culled.
    pub visible: usize,
    /// (splat, tile) pairs, including those that did not fit. 2³² − 1 stands for that many or more,
    /// which exceeds the capacity of any renderer.
    pub intersections: usize,
}

impl FrameCounts {
    /// Reads the counts from the two words that the device wrote.
    pub fn from_device(words: [u32; 2]) -> FrameCounts {
        FrameCounts { visible: words[0] as usize, intersections: words[1] as usize }
    }
}

impl Render {
    /// Plans a renderer for at most `gaussians` Gaussians and `intersections` (splat, tile) pairs, for
    /// images of `width` × `height` pixels.
    ///
    /// # Errors
    /// [`Error::Input`] for an image without pixels or with more than 65,535 tiles along a side;
    /// [`Error::RangeLimit`] for 2³² Gaussians or pairs, or more.
    pub fn plan(
        device: &Device,
        gaussians: usize,
        intersections: usize,
        width: u32,
        height: u32,
        settings: RenderSettings,
    ) -> Result<Render> {
        let (columns, rows) = (width.div_ceil(TILE), height.div_ceil(TILE));
        if columns == 0 || rows == 0 || columns > 0xffff || rows > 0xffff {
            return Err(Error::Input(format!("cannot render an image of {width}×{height} pixels")));
        }
        countable(device, "means", gaussians, 16)?;
        countable(device, "tile keys", intersections, 4)?;
        // Intersections that were counted but not emitted get one tile index past the last.
        let tile_bits = 32 - (columns * rows).leading_zeros();
        Ok(Render {
            gaussians,
            intersections,
            width,
            height,
            settings,
            raster: RasterKind::default(),
            profile: *device.profile(),
            subgroup_size: device.subgroup_size(),
            // Depth is positive, so its sign bit is never set.
            depth_sort: RadixSort::plan(device, gaussians, 0..DEPTH_BITS)?,
            tile_sort: RadixSort::plan(device, intersections, 0..tile_bits)?,
            scan: Scan::plan(device, gaussians)?,
        })
    }

    /// The same renderer, but only the highest `bits` of a depth's 31 bits decide the order of splats.
    /// Splats whose keys are equal keep the order of their indices. Fewer bits need fewer passes of the
    /// sort.
    ///
    /// # Errors
    /// [`Error::Input`] for no bits or more than 31.
    pub fn with_depth_bits(mut self, device: &Device, bits: u32) -> Result<Render> {
        if !(1..=DEPTH_BITS).contains(&bits) {
            return Err(Error::Input(format!("a depth of {bits} bits: it must have 1 to 31")));
        }
        self.depth_sort = RadixSort::plan(device, self.gaussians, DEPTH_BITS - bits..DEPTH_BITS)?;
        Ok(self)
    }

    /// The same renderer with another blending kernel.
    pub fn with_raster(self, raster: RasterKind) -> Render {
        Render { raster, ..self }
    }

    /// Capacity: the largest number of (splat, tile) pairs of a frame.
    pub fn intersection_capacity(&self) -> usize {
        self.intersections
    }

    /// The settings of projection and blending.
    pub fn settings(&self) -> &RenderSettings {
        &self.settings
    }

    fn tiles(&self) -> usize {
        (self.width.div_ceil(TILE) * self.height.div_ceil(TILE)) as usize
    }

    /// Allocates a frame that is rendered but not differentiated.
    ///
    /// # Errors
    /// [`Error::OutOfMemory`].
    pub fn frame(&self, device: &Device) -> Result<Frame> {
        let (scratch, pixels) = (self.scratch(device)?, self.pixels(device)?);
        Ok(Frame { plan: self.clone(), scratch, pixels, gradients: () })
    }

    fn scratch(&self, device: &Device) -> Result<RenderScratch> {
        let (n, m) = (self.gaussians, self.intersections);
        Ok(RenderScratch {
            camera: device.buffer("camera", 20)?,
            count: device.buffer("Gaussian count", 1)?,
            visible_count: device.buffer("visible count", 1)?,
            intersection_count: device.buffer("intersection count", 1)?,
            counts: device.buffer("frame counts", 2)?,
            fits: device.buffer("frame fits", 1)?,
            grid: device.buffer("ranges grid", 3)?,
            means: device.buffer("means", n)?,
            conics: device.buffer("conics", n)?,
            colours: device.buffer("colours", n)?,
            rectangles: device.buffer("tile rectangles", n)?,
            tile_counts: device.buffer("tile counts", n)?,
            visible: device.buffer("visible", n)?,
            visible_from_splat: device.buffer("compaction offsets", n)?,
            keys: device.buffer("depth keys", n)?,
            splat_from_visible: device.buffer("visible splats", n)?,
            sorted_keys: device.buffer("sorted depth keys", n)?,
            splat_from_rank: device.buffer("depth order", n)?,
            rank_counts: device.buffer("tile counts by rank", n)?,
            emitted_from_rank: device.buffer("intersection offsets", n)?,
            tiles: device.buffer("tile keys", m)?,
            emitted: device.buffer("emitted intersections", m)?,
            splat_from_emitted: device.buffer("splat of intersection", m)?,
            sorted_tiles: device.buffer("sorted tile keys", m)?,
            emitted_from_sorted: device.buffer("sorted intersections", m)?,
            ranges: device.buffer("tile ranges", self.tiles())?,
            scan: self.scan.scratch(device)?,
            depth_sort: self.depth_sort.scratch(device)?,
            tile_sort: self.tile_sort.scratch(device)?,
        })
    }

    /// Allocates an image of this renderer's size.
    ///
    /// # Errors
    /// [`Error::OutOfMemory`].
    pub fn pixels(&self, device: &Device) -> Result<PixelBuffers> {
        let pixels = self.width as usize * self.height as usize;
        Ok(PixelBuffers {
            width: self.width,
            height: self.height,
            rgba: device.buffer("rendered rgba", pixels)?,
            depth: device.buffer("rendered depth", pixels)?,
            last: device.buffer("last intersections", pixels)?,
        })
    }

    fn check(&self, camera: &Camera, gaussians: &GaussianViews<'_>) -> Result<()> {
        gaussians.check("render")?;
        self.check_count(gaussians.len)?;
        let k = camera.intrinsics;
        if (k.width, k.height) != (self.width, self.height) {
            return Err(Error::Input(format!(
                "the renderer was planned for {}×{} pixels, the camera has {}×{}",
                self.width, self.height, k.width, k.height
            )));
        }
        Ok(())
    }

    fn check_count(&self, gaussians: usize) -> Result<()> {
        if gaussians > self.gaussians {
            return Err(Error::Shape {
                op: "render",
                arg: "gaussians",
                expected: format!("at most {}", self.gaussians),
                actual: gaussians,
            });
        }
        Ok(())
    }

    fn tile_groups(&self, device: &Device) -> Result<Groups> {
        Groups::linear(self.tiles(), 1, device.limits())
    }
}

impl<G> Frame<G> {
    /// The plan.
    pub fn plan(&self) -> &Render {
        &self.plan
    }

    /// Waits for the submitted frames and reads the counts of the last one. If it has more intersections
    /// than [`Render::intersection_capacity`], the image is incomplete and must be rendered again with a
    /// larger frame.
    ///
    /// # Errors
    /// A failed submission.
    pub fn counts(&self, stream: &mut Stream) -> Result<FrameCounts> {
        let counts = stream.download(&self.scratch.counts)?;
        Ok(FrameCounts::from_device([counts[0], counts[1]]))
    }

    /// The counts on the device; [`FrameCounts::from_device`] reads them.
    pub fn device_counts(&self) -> View<'_, u32> {
        self.scratch.counts.view()
    }

    /// On the device: 1 if all intersections of the last frame fitted, else 0.
    pub fn fits(&self) -> View<'_, u32> {
        self.scratch.fits.view()
    }

    /// One word for each Gaussian: 1 if it was visible in the last frame, else 0.
    pub fn visible(&self) -> View<'_, u32> {
        self.scratch.visible.view()
    }
}

//! Rendering Gaussians, forward and backward.
//!
//! Project every Gaussian; list the visible ones and sort them by depth; emit an intersection per
//! tile reached, in that order; sort the intersections by tile alone (stable, so depth order holds
//! within a tile); blend tile by tile. The number of intersections stays on the device: where it
//! exceeds what the buffers hold, the farthest are left out, and [`RenderScratch::counts`] tells, so
//! that the caller grows the buffers and repeats the frame.

use super::at_least;
use super::gaussians::{GaussianBuffers, GaussianViews};
use super::scan::{Scan, ScanArgs, ScanScratch};
use super::sort::{RadixSort, SortArgs, SortScratch};
use crate::gpu::{Buffer, Device, Groups, Recorder, Stream, View, ViewMut};
use crate::kernels::indirect::record_arguments;
use crate::kernels::{bin, project, raster};
use crate::types::{Camera, DEPTH_BITS, RasterKind, RenderSettings};
use crate::{Error, Result};

/// Side of a tile in pixels.
pub const TILE: u32 = 16;

/// A camera as the kernels read it: the rotation of `view_from_world` row by row (9), the centre in
/// the world (3) and what its rounding left (3), fx, fy, cx, cy, one spare.
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

/// A renderer for images of one size.
#[derive(Clone, Debug)]
pub struct Render {
    gaussians: usize,
    intersections: usize,
    width: u32,
    height: u32,
    settings: RenderSettings,
    raster: RasterKind,
    depth_sort: RadixSort,
    tile_sort: RadixSort,
    scan: Scan,
}

/// What a renderer works in between its dispatches, and what its backward pass needs again.
pub struct RenderScratch {
    pub(crate) camera: Buffer<f32>,
    pub(crate) count: Buffer<u32>,
    pub(crate) visible_count: Buffer<u32>,
    pub(crate) intersection_count: Buffer<u32>,
    /// Both of these, side by side, for the host.
    pub(crate) counts: Buffer<u32>,
    pub(crate) fits: Buffer<u32>,
    pub(crate) grid: Buffer<u32>,
    pub(crate) means: Buffer<[f32; 4]>,
    pub(crate) conics: Buffer<[f32; 4]>,
    pub(crate) colours: Buffer<[f32; 4]>,
    pub(crate) rectangles: Buffer<[u32; 2]>,
    pub(crate) tile_counts: Buffer<u32>,
    pub(crate) visible: Buffer<u32>,
    pub(crate) compact_offsets: Buffer<u32>,
    pub(crate) keys: Buffer<u32>,
    pub(crate) splat_ids: Buffer<u32>,
    pub(crate) sorted_keys: Buffer<u32>,
    pub(crate) order: Buffer<u32>,
    pub(crate) rank_counts: Buffer<u32>,
    pub(crate) rank_offsets: Buffer<u32>,
    pub(crate) tiles: Buffer<u32>,
    pub(crate) emitted: Buffer<u32>,
    pub(crate) splats: Buffer<u32>,
    pub(crate) sorted_tiles: Buffer<u32>,
    pub(crate) intersections: Buffer<u32>,
    pub(crate) ranges: Buffer<[u32; 2]>,
    pub(crate) scan: ScanScratch,
    pub(crate) depth_sort: SortScratch,
    pub(crate) tile_sort: SortScratch,
}

/// What only the backward pass works in.
pub struct BackwardScratch {
    pub(crate) slots_a: Buffer<[f32; 4]>,
    pub(crate) slots_b: Buffer<[f32; 4]>,
    pub(crate) slots_c: Buffer<[f32; 2]>,
    pub(crate) means: Buffer<[f32; 4]>,
    pub(crate) covariances: Buffer<[f32; 4]>,
    pub(crate) colours: Buffer<[f32; 4]>,
    pub(crate) pose_partials: Buffer<f32>,
    pub(crate) pose: Buffer<f32>,
}

/// A rendered image on the device.
pub struct PixelBuffers {
    /// Width, pixels.
    pub width: u32,
    /// Height, pixels.
    pub height: u32,
    /// Premultiplied colour without background, and alpha.
    pub rgba: Buffer<[f32; 4]>,
    /// Sum of α · T · z over the splats of a pixel.
    pub depth: Buffer<f32>,
    pub(crate) last: Buffer<u32>,
}

/// The gradient of a loss by a rendered image.
pub struct PixelGradients {
    /// By premultiplied colour and alpha.
    pub rgba: Buffer<[f32; 4]>,
    /// By depth.
    pub depth: Buffer<f32>,
}

/// What the last frame held; see [`RenderScratch::counts`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct FrameCounts {
    /// Gaussians that were not culled.
    pub visible: usize,
    /// (splat, tile) pairs, counted in full even where they did not fit.
    pub intersections: usize,
}

impl FrameCounts {
    /// From the two words that the device wrote.
    pub fn from_device(words: [u32; 2]) -> FrameCounts {
        FrameCounts { visible: words[0] as usize, intersections: words[1] as usize }
    }
}

impl Render {
    /// A renderer for at most `gaussians` Gaussians and `intersections` (splat, tile) pairs.
    ///
    /// # Errors
    /// [`Error::Input`] for an image without pixels or with more than 65,535 tiles along a side.
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
        // One tile more than there are takes what was counted and not emitted.
        let tile_bits = 32 - (columns * rows).leading_zeros();
        Ok(Render {
            gaussians,
            intersections,
            width,
            height,
            settings,
            raster: RasterKind::default(),
            // Depth is positive, so its sign bit is never set.
            depth_sort: RadixSort::plan(device, gaussians, 0..DEPTH_BITS)?,
            tile_sort: RadixSort::plan(device, intersections, 0..tile_bits)?,
            scan: Scan::plan(gaussians)?,
        })
    }

    /// The same, but only the highest `bits` of a depth's 31 decide the order of splats; those that
    /// these do not tell apart keep the order of their index. Fewer bits, fewer passes of the sort.
    /// To be called before [`scratch`](Self::scratch).
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

    /// The same, blending in another way.
    pub fn with_raster(self, raster: RasterKind) -> Render {
        Render { raster, ..self }
    }

    /// Number of (splat, tile) pairs that there is room for.
    pub fn intersection_capacity(&self) -> usize {
        self.intersections
    }

    /// The constants of blending.
    pub fn settings(&self) -> &RenderSettings {
        &self.settings
    }

    fn tiles(&self) -> usize {
        (self.width.div_ceil(TILE) * self.height.div_ceil(TILE)) as usize
    }

    /// What [`forward`](Self::forward) works in.
    ///
    /// # Errors
    /// [`Error::OutOfMemory`].
    pub fn scratch(&self, device: &Device) -> Result<RenderScratch> {
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
            compact_offsets: device.buffer("compaction offsets", n)?,
            keys: device.buffer("depth keys", n)?,
            splat_ids: device.buffer("visible splats", n)?,
            sorted_keys: device.buffer("sorted depth keys", n)?,
            order: device.buffer("depth order", n)?,
            rank_counts: device.buffer("tile counts by rank", n)?,
            rank_offsets: device.buffer("intersection offsets", n)?,
            tiles: device.buffer("tile keys", m)?,
            emitted: device.buffer("emitted intersections", m)?,
            splats: device.buffer("splat of intersection", m)?,
            sorted_tiles: device.buffer("sorted tile keys", m)?,
            intersections: device.buffer("sorted intersections", m)?,
            ranges: device.buffer("tile ranges", self.tiles())?,
            scan: self.scan.scratch(device)?,
            depth_sort: self.depth_sort.scratch(device)?,
            tile_sort: self.tile_sort.scratch(device)?,
        })
    }

    /// What [`backward`](Self::backward) works in besides.
    ///
    /// # Errors
    /// [`Error::OutOfMemory`].
    pub fn backward_scratch(&self, device: &Device) -> Result<BackwardScratch> {
        let (n, m) = (self.gaussians, self.intersections);
        Ok(BackwardScratch {
            slots_a: device.buffer("gradient slots a", m)?,
            slots_b: device.buffer("gradient slots b", m)?,
            slots_c: device.buffer("gradient slots c", m)?,
            means: device.buffer("mean gradients", n)?,
            covariances: device.buffer("covariance gradients", n)?,
            colours: device.buffer("colour gradients", n)?,
            pose_partials: device.buffer("pose partials", 8 * n.div_ceil(64))?,
            pose: device.buffer("pose gradient", 6)?,
        })
    }

    /// An image of this renderer's size.
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

    /// The gradient of an image of this renderer's size.
    ///
    /// # Errors
    /// [`Error::OutOfMemory`].
    pub fn pixel_gradients(&self, device: &Device) -> Result<PixelGradients> {
        let pixels = self.width as usize * self.height as usize;
        Ok(PixelGradients {
            rgba: device.buffer("rgba gradient", pixels)?,
            depth: device.buffer("depth gradient", pixels)?,
        })
    }

    /// Records the rendering of `gaussians` from `camera` into `pixels`.
    ///
    /// # Errors
    /// [`Error::Shape`] when there are more Gaussians than planned for or the camera's image has
    /// another size; else as for [`Recorder::dispatch`].
    pub fn forward(
        &self,
        recorder: &mut Recorder,
        camera: &Camera,
        gaussians: GaussianViews<'_>,
        scratch: &mut RenderScratch,
        pixels: &mut PixelBuffers,
    ) -> Result<()> {
        self.check(camera, &gaussians)?;
        self.check_scratch(scratch)?;
        self.check_pixels("render", pixels)?;
        recorder.update(scratch.camera.view_mut(), &device_camera(camera))?;
        recorder.update(scratch.count.view_mut(), &[gaussians.len as u32])?;
        self.project(recorder, gaussians, scratch)?;
        self.bin(recorder, gaussians.len, scratch)?;
        self.blend(recorder, scratch.colours.view(), scratch, pixels)
    }

    /// Records the blending of other colours, one for each Gaussian, over what the last
    /// [`forward`](Self::forward) with this scratch has projected and sorted. Alpha and depth come
    /// out the same.
    ///
    /// # Errors
    /// [`Error::Shape`] where sizes differ; else as for [`Recorder::dispatch`].
    pub fn blend(
        &self,
        recorder: &mut Recorder,
        colours: View<'_, [f32; 4]>,
        scratch: &RenderScratch,
        pixels: &mut PixelBuffers,
    ) -> Result<()> {
        self.check_scratch(scratch)?;
        self.check_pixels("blend", pixels)?;
        let s = scratch;
        let groups = self.tile_groups(recorder.device())?;
        let RenderSettings { alpha_cut, alpha_cap, transmittance_stop, .. } = self.settings;
        // Two kernels of one interface.
        macro_rules! dispatch {
            ($kernel:ident, $params:ident, $args:ident) => {
                recorder.dispatch::<raster::$kernel>(
                    groups,
                    raster::$params {
                        width: self.width,
                        height: self.height,
                        alpha_cut,
                        alpha_cap,
                        transmittance_stop,
                    },
                    raster::$args {
                        ranges: s.ranges.view(),
                        intersections: s.intersections.view(),
                        splats: s.splats.view(),
                        means: s.means.view(),
                        conics: s.conics.view(),
                        colours,
                        rgba: pixels.rgba.view_mut(),
                        depth: pixels.depth.view_mut(),
                        last: pixels.last.view_mut(),
                    },
                )
            };
        }
        match self.raster {
            RasterKind::Subgroup => dispatch!(Forward, ForwardParams, ForwardArgs),
            RasterKind::Shared => dispatch!(ForwardShared, ForwardSharedParams, ForwardSharedArgs),
        }
    }

    fn check(&self, camera: &Camera, gaussians: &GaussianViews<'_>) -> Result<()> {
        gaussians.check("render")?;
        if gaussians.len > self.gaussians {
            return Err(Error::Shape {
                op: "render",
                arg: "gaussians",
                expected: format!("at most {}", self.gaussians),
                actual: gaussians.len,
            });
        }
        let k = camera.intrinsics;
        if (k.width, k.height) != (self.width, self.height) {
            return Err(Error::Input(format!(
                "the renderer was planned for {}×{} pixels, the camera has {}×{}",
                self.width, self.height, k.width, k.height
            )));
        }
        Ok(())
    }

    /// A scratch of another plan may be too small for this one.
    fn check_scratch(&self, scratch: &RenderScratch) -> Result<()> {
        at_least(
            "render",
            &[
                ("scratch's Gaussians", self.gaussians, scratch.means.len()),
                ("scratch's intersections", self.intersections, scratch.tiles.len()),
                ("scratch's tiles", self.tiles(), scratch.ranges.len()),
            ],
        )
    }

    fn check_pixels(&self, op: &'static str, pixels: &PixelBuffers) -> Result<()> {
        if (pixels.width, pixels.height) == (self.width, self.height) {
            return Ok(());
        }
        Err(Error::Shape {
            op,
            arg: "pixels",
            expected: format!("an image of {}×{}", self.width, self.height),
            actual: pixels.width as usize * pixels.height as usize,
        })
    }

    fn project(
        &self,
        recorder: &mut Recorder,
        gaussians: GaussianViews<'_>,
        s: &mut RenderScratch,
    ) -> Result<()> {
        let groups = Groups::linear(gaussians.len, 64, recorder.device().limits())?;
        recorder.dispatch_specialised::<project::Forward>(
            &[gaussians.half_sh, gaussians.half_shapes, gaussians.half_rotations].map(u32::from),
            groups,
            project::ForwardParams {
                count: gaussians.len as u32,
                width: self.width,
                height: self.height,
                sh_degree: gaussians.sh_degree,
                near: self.settings.near,
                dilation: self.settings.dilation,
                alpha_cut: self.settings.alpha_cut,
                tangent_clamp: self.settings.tangent_clamp,
            },
            project::ForwardArgs {
                camera: s.camera.view(),
                positions: gaussians.positions,
                log_scales: gaussians.log_scales,
                rotations: gaussians.rotations,
                opacity_logits: gaussians.opacity_logits,
                sh0: gaussians.sh[0],
                sh1: gaussians.sh[1],
                sh2: gaussians.sh[2],
                sh3: gaussians.sh[3],
                means: s.means.view_mut(),
                conics: s.conics.view_mut(),
                colours: s.colours.view_mut(),
                rectangles: s.rectangles.view_mut(),
                tile_counts: s.tile_counts.view_mut(),
                visible: s.visible.view_mut(),
            },
        )
    }

    fn bin(&self, recorder: &mut Recorder, len: usize, s: &mut RenderScratch) -> Result<()> {
        let limits = *recorder.device().limits();
        let groups = Groups::linear(len, 64, &limits)?;
        let (count, capacity) = (len as u32, self.intersections as u32);
        self.scan.record(
            recorder,
            ScanArgs {
                count: s.count.view(),
                count_at: 0,
                values: s.visible.view(),
                prefix: s.compact_offsets.view_mut(),
                total: s.visible_count.view_mut(),
                total_at: 0,
            },
            &mut s.scan,
        )?;
        recorder.dispatch::<bin::Compact>(
            groups,
            bin::CompactParams { count },
            bin::CompactArgs {
                visible: s.visible.view(),
                offsets: s.compact_offsets.view(),
                means: s.means.view(),
                keys: s.keys.view_mut(),
                splats: s.splat_ids.view_mut(),
            },
        )?;
        self.depth_sort.record(
            recorder,
            SortArgs {
                count: s.visible_count.view(),
                count_at: 0,
                keys: s.keys.view(),
                payload: s.splat_ids.view(),
                sorted_keys: s.sorted_keys.view_mut(),
                sorted_payload: s.order.view_mut(),
            },
            &mut s.depth_sort,
        )?;
        recorder.dispatch::<bin::Counts>(
            groups,
            bin::CountsParams { count },
            bin::CountsArgs {
                visible_count: s.visible_count.view(),
                order: s.order.view(),
                tile_counts: s.tile_counts.view(),
                counts: s.rank_counts.view_mut(),
            },
        )?;
        self.scan.record(
            recorder,
            ScanArgs {
                count: s.count.view(),
                count_at: 0,
                values: s.rank_counts.view(),
                prefix: s.rank_offsets.view_mut(),
                total: s.intersection_count.view_mut(),
                total_at: 0,
            },
            &mut s.scan,
        )?;
        recorder.dispatch::<bin::Fits>(
            Groups([1, 1, 1]),
            bin::FitsParams { capacity },
            bin::FitsArgs {
                visible_count: s.visible_count.view(),
                total: s.intersection_count.view(),
                counts: s.counts.view_mut(),
                fits: s.fits.view_mut(),
            },
        )?;
        recorder.dispatch::<bin::Emit>(
            groups,
            bin::EmitParams { count, capacity, width: self.width, height: self.height },
            bin::EmitArgs {
                visible_count: s.visible_count.view(),
                order: s.order.view(),
                counts: s.rank_counts.view(),
                offsets: s.rank_offsets.view(),
                rectangles: s.rectangles.view(),
                means: s.means.view(),
                conics: s.conics.view(),
                tiles: s.tiles.view_mut(),
                intersections: s.emitted.view_mut(),
                splats: s.splats.view_mut(),
            },
        )?;
        self.tile_sort.record(
            recorder,
            SortArgs {
                count: s.intersection_count.view(),
                count_at: 0,
                keys: s.tiles.view(),
                payload: s.emitted.view(),
                sorted_keys: s.sorted_tiles.view_mut(),
                sorted_payload: s.intersections.view_mut(),
            },
            &mut s.tile_sort,
        )?;
        recorder.fill(s.ranges.view_mut(), 0);
        record_arguments(
            recorder,
            s.intersection_count.view(),
            0,
            self.intersections,
            64,
            s.grid.view_mut(),
            0,
        )?;
        recorder.dispatch_indirect::<bin::Ranges>(
            &s.grid,
            0,
            bin::RangesParams { capacity, tile_count: self.tiles() as u32 },
            bin::RangesArgs {
                total: s.intersection_count.view(),
                tiles: s.sorted_tiles.view(),
                ranges: s.ranges.view_mut(),
            },
        )
    }

    fn tile_groups(&self, device: &Device) -> Result<Groups> {
        Groups::linear(self.tiles(), 1, device.limits())
    }

    /// Records the gradients of a loss by every parameter, given those by the image that
    /// [`forward`](Self::forward) has just rendered with the same camera, Gaussians and scratch.
    /// Culled Gaussians get zeros. With `with_pose` the gradient by a left perturbation of
    /// `view_from_world` (translation, rotation) comes too: [`BackwardScratch::pose`].
    ///
    /// # Errors
    /// [`Error::Shape`] when `gradients` has too little room; else as for [`Recorder::dispatch`].
    pub fn backward(
        &self,
        recorder: &mut Recorder,
        gaussians: GaussianViews<'_>,
        scratch: &RenderScratch,
        pixels: &PixelBuffers,
        pixel_gradients: &PixelGradients,
        backward: &mut BackwardScratch,
        gradients: &mut GaussianBuffers,
        with_pose: bool,
    ) -> Result<()> {
        gaussians.check("render backward")?;
        if gaussians.half_sh || gaussians.half_shapes || gaussians.half_rotations {
            let what = "gradients need every attribute in f32; 16 bits are for rendering";
            return Err(Error::Input(what.into()));
        }
        gradients.len = gaussians.len;
        gradients.views().at_degree(gaussians.sh_degree).check("render backward gradients")?;
        let colours = scratch.colours.view();
        let n = gaussians.len;
        self.blend_backward(recorder, colours, n, scratch, pixels, pixel_gradients, backward)?;
        let groups = Groups::linear(gaussians.len, 64, recorder.device().limits())?;
        let (s, b) = (scratch, backward);
        let [sh0, sh1, sh2, sh3] = gradients.sh.each_mut().map(Buffer::view_mut);
        recorder.dispatch::<project::Backward>(
            groups,
            project::BackwardParams {
                count: gaussians.len as u32,
                width: self.width,
                height: self.height,
                sh_degree: gaussians.sh_degree,
                near: self.settings.near,
                dilation: self.settings.dilation,
                tangent_clamp: self.settings.tangent_clamp,
                with_pose: u32::from(with_pose),
            },
            project::BackwardArgs {
                camera: s.camera.view(),
                positions: gaussians.positions,
                log_scales: gaussians.log_scales,
                rotations: gaussians.rotations,
                sh1: gaussians.sh[1],
                sh2: gaussians.sh[2],
                sh3: gaussians.sh[3],
                visible: s.visible.view(),
                opacity_logits: gaussians.opacity_logits,
                colours: s.colours.view(),
                mean_gradients: b.means.view(),
                covariance_gradients: b.covariances.view(),
                colour_gradients: b.colours.view(),
                position_gradients: gradients.positions.view_mut(),
                log_scale_gradients: gradients.log_scales.view_mut(),
                rotation_gradients: gradients.rotations.view_mut(),
                opacity_gradients: gradients.opacity_logits.view_mut(),
                sh0_gradients: sh0,
                sh1_gradients: sh1,
                sh2_gradients: sh2,
                sh3_gradients: sh3,
                pose_partials: b.pose_partials.view_mut(),
            },
        )?;
        if !with_pose {
            return Ok(());
        }
        recorder.dispatch::<project::Pose>(
            Groups([1, 1, 1]),
            project::PoseParams { groups: gaussians.len.div_ceil(64) as u32 },
            project::PoseArgs { pose_partials: b.pose_partials.view(), pose: b.pose.view_mut() },
        )
    }

    /// Records the gradients of a loss by the projected splats, colours among them, of the first
    /// `count` Gaussians, given those by the picture that [`blend`](Self::blend) (or
    /// [`forward`](Self::forward)) has made of these colours: what
    /// [`BackwardScratch::colour_gradients`] and [`BackwardScratch::mean_gradients`] give.
    ///
    /// # Errors
    /// As for [`backward`](Self::backward).
    pub fn blend_backward(
        &self,
        recorder: &mut Recorder,
        colours: View<'_, [f32; 4]>,
        count: usize,
        scratch: &RenderScratch,
        pixels: &PixelBuffers,
        pixel_gradients: &PixelGradients,
        backward: &mut BackwardScratch,
    ) -> Result<()> {
        self.check_scratch(scratch)?;
        self.check_pixels("render backward", pixels)?;
        let area = self.width as usize * self.height as usize;
        at_least(
            "render backward",
            &[
                ("Gaussians of the scratch", count, backward.means.len()),
                ("intersections of the scratch", self.intersections, backward.slots_a.len()),
                ("rgba gradients", area, pixel_gradients.rgba.len()),
                ("depth gradients", area, pixel_gradients.depth.len()),
            ],
        )?;
        let limits = *recorder.device().limits();
        let groups = Groups::linear(count, 64, &limits)?;
        let (s, b) = (scratch, backward);
        recorder.dispatch::<raster::Backward>(
            self.tile_groups(recorder.device())?,
            raster::BackwardParams {
                width: self.width,
                height: self.height,
                alpha_cut: self.settings.alpha_cut,
                alpha_cap: self.settings.alpha_cap,
            },
            raster::BackwardArgs {
                ranges: s.ranges.view(),
                intersections: s.intersections.view(),
                splats: s.splats.view(),
                means: s.means.view(),
                conics: s.conics.view(),
                colours,
                rgba: pixels.rgba.view(),
                depth: pixels.depth.view(),
                last: pixels.last.view(),
                rgba_gradient: pixel_gradients.rgba.view(),
                depth_gradient: pixel_gradients.depth.view(),
                slots_a: b.slots_a.view_mut(),
                slots_b: b.slots_b.view_mut(),
                slots_c: b.slots_c.view_mut(),
            },
        )?;
        recorder.dispatch::<raster::Gather>(
            groups,
            raster::GatherParams { count: count as u32, capacity: self.intersections as u32 },
            raster::GatherArgs {
                visible_count: s.visible_count.view(),
                order: s.order.view(),
                counts: s.rank_counts.view(),
                offsets: s.rank_offsets.view(),
                slots_a: b.slots_a.view(),
                slots_b: b.slots_b.view(),
                slots_c: b.slots_c.view(),
                means: s.means.view(),
                conics: s.conics.view(),
                mean_gradients: b.means.view_mut(),
                covariance_gradients: b.covariances.view_mut(),
                colour_gradients: b.colours.view_mut(),
            },
        )
    }
}

impl RenderScratch {
    /// Waits for the frames submitted and gives the last one's counts. More intersections than the
    /// renderer has room for mean that the frame must be repeated with more.
    ///
    /// # Errors
    /// A failed submission.
    pub fn counts(&self, stream: &mut Stream) -> Result<FrameCounts> {
        let counts = stream.download(&self.counts)?;
        Ok(FrameCounts::from_device([counts[0], counts[1]]))
    }

    /// The counts on the device; [`FrameCounts::from_device`] reads them.
    pub fn device_counts(&self) -> View<'_, u32> {
        self.counts.view()
    }

    /// On the device: 1 where the last frame's intersections all fitted, else 0.
    pub fn fits(&self) -> View<'_, u32> {
        self.fits.view()
    }

    /// Which Gaussians the last frame showed: 1 for visible.
    pub fn visible(&self) -> View<'_, u32> {
        self.visible.view()
    }
}

impl BackwardScratch {
    /// The gradient by the camera's pose: translation, rotation.
    pub fn pose(&self) -> &Buffer<f32> {
        &self.pose
    }

    /// Gradients of the last frame by the projected splats: by mean x, mean y (pixels), depth and
    /// opacity. Those of culled Gaussians are undefined.
    pub fn mean_gradients(&self) -> View<'_, [f32; 4]> {
        self.means.view()
    }

    /// Gradients of the last frame by the colours of the first `count` Gaussians: red, green, blue
    /// and nothing. Those of culled Gaussians are undefined.
    pub fn colour_gradients(&self, count: usize) -> View<'_, [f32; 4]> {
        self.colours.range(0..count)
    }
}

impl PixelGradients {
    /// The depth's gradient, for a loss without a depth term to fill with zeros.
    pub fn depth_mut(&mut self) -> ViewMut<'_, f32> {
        self.depth.view_mut()
    }
}

//! The forward pass: from Gaussians to a rendered image.

use super::{PixelBuffers, PixelViews, Render, RenderScratch, device_camera};
use crate::Result;
use crate::gpu::{Groups, Profile, Recorder, View};
use crate::kernels::indirect::record_arguments;
use crate::kernels::{bin, project, raster};
use crate::ops::gaussians::GaussianViews;
use crate::ops::scan::ScanArgs;
use crate::ops::sort::SortArgs;
use crate::types::{Camera, RasterKind, RenderSettings};

impl Render {
    /// Records the rendering of `gaussians` from `camera` into `pixels`. Dispatches: `project/forward`;
    /// those of [`Scan::record`](crate::ops::scan::Scan::record); `bin/compact`; those of
    /// [`RadixSort::record`](crate::ops::sort::RadixSort::record) by depth; `bin/counts`; a scan;
    /// `bin/emit`, `bin/fits`; a sort by tile; `indirect/arguments`, `bin/ranges`; `raster/forward` or
    /// `raster/forward_shared`.
    ///
    /// # Errors
    /// [`Error::Shape`](crate::Error::Shape) when there are more Gaussians than planned for or the
    /// camera's image has another size; else as for [`Recorder::dispatch`].
    pub fn forward(
        &self,
        recorder: &mut Recorder,
        camera: &Camera,
        gaussians: GaussianViews<'_>,
        scratch: &mut RenderScratch,
        pixels: &mut PixelBuffers,
    ) -> Result<()> {
        self.forward_into(recorder, camera, gaussians, scratch, pixels.views_mut())
    }

    /// As [`forward`](Self::forward), into views of arbitrary buffers.
    ///
    /// # Errors
    /// As for [`forward`](Self::forward); [`Error::Shape`](crate::Error::Shape) where a view is too
    /// short.
    pub fn forward_into(
        &self,
        recorder: &mut Recorder,
        camera: &Camera,
        gaussians: GaussianViews<'_>,
        scratch: &mut RenderScratch,
        pixels: PixelViews<'_>,
    ) -> Result<()> {
        self.check_pixels("render", &pixels)?;
        let count = gaussians.len;
        self.project(recorder, camera, gaussians, scratch)?;
        self.bin(recorder, count, scratch)?;
        self.blend_into(recorder, scratch.colours.view(), scratch, pixels)
    }

    /// Records the blending of other colours, one for each Gaussian, with the splats that the last
    /// [`forward`](Self::forward) with this scratch projected and sorted. Alpha and depth are the same
    /// as in that pass.
    ///
    /// # Errors
    /// [`Error::Shape`](crate::Error::Shape) where sizes differ; else as for [`Recorder::dispatch`].
    pub fn blend(
        &self,
        recorder: &mut Recorder,
        colours: View<'_, [f32; 4]>,
        scratch: &RenderScratch,
        pixels: &mut PixelBuffers,
    ) -> Result<()> {
        self.blend_into(recorder, colours, scratch, pixels.views_mut())
    }

    /// As [`blend`](Self::blend), into views of arbitrary buffers.
    ///
    /// # Errors
    /// As for [`blend`](Self::blend); [`Error::Shape`](crate::Error::Shape) where a view is too short.
    pub fn blend_into(
        &self,
        recorder: &mut Recorder,
        colours: View<'_, [f32; 4]>,
        scratch: &RenderScratch,
        pixels: PixelViews<'_>,
    ) -> Result<()> {
        self.check_scratch(scratch)?;
        self.check_pixels("blend", &pixels)?;
        let s = scratch;
        let groups = self.tile_groups(recorder.device())?;
        let RenderSettings { alpha_cut, alpha_cap, transmittance_stop, .. } = self.settings;
        let params = raster::ForwardParams {
            width: self.width,
            height: self.height,
            alpha_cut,
            alpha_cap,
            transmittance_stop,
        };
        let args = raster::ForwardArgs {
            ranges: s.ranges.view(),
            emitted_from_sorted: s.emitted_from_sorted.view(),
            splat_from_emitted: s.splat_from_emitted.view(),
            means: s.means.view(),
            conics: s.conics.view(),
            colours,
            rgba: pixels.rgba,
            depth: pixels.depth,
            last: pixels.last,
        };
        match self.raster {
            RasterKind::Subgroup => {
                let Profile { shuffles, spread, .. } = self.profile;
                let constants = raster::ForwardConstants { shuffles, spread };
                recorder.dispatch_specialised::<raster::Forward>(constants, groups, params, args)
            }
            RasterKind::Shared => recorder.dispatch::<raster::ForwardShared>(groups, params, args),
        }
    }

    /// Records the first stage alone, `project/forward`. It projects the Gaussians to splats, which the
    /// scratch then holds ([`RenderScratch::splats`]).
    ///
    /// # Errors
    /// As for [`forward`](Self::forward).
    pub fn project(
        &self,
        recorder: &mut Recorder,
        camera: &Camera,
        gaussians: GaussianViews<'_>,
        scratch: &mut RenderScratch,
    ) -> Result<()> {
        self.check(camera, &gaussians)?;
        self.check_scratch(scratch)?;
        let s = scratch;
        recorder.update(s.camera.view_mut(), &device_camera(camera))?;
        let groups = Groups::linear(gaussians.len, 64, recorder.device().limits())?;
        let [band1, band2, band3] = gaussians.bands();
        let GaussianViews { half_sh, half_scales, half_rotations, half_opacities, .. } = gaussians;
        recorder.dispatch_specialised::<project::Forward>(
            project::ForwardConstants {
                half_sh,
                half_scales,
                half_rotations,
                half_opacities,
                band1,
                band2,
                band3,
            },
            groups,
            project::ForwardParams {
                count: gaussians.len as u32,
                width: self.width,
                height: self.height,
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

    /// Records the second stage alone, which lists the scratch's first `len` splats by tile, front to
    /// back ([`RenderScratch::tile_lists`]). The splats are those of [`project`](Self::project), or
    /// splats that a host application wrote ([`RenderScratch::splats_mut`]). The third stage is
    /// [`blend`](Self::blend).
    ///
    /// # Errors
    /// As for [`forward`](Self::forward).
    pub fn bin(
        &self,
        recorder: &mut Recorder,
        len: usize,
        scratch: &mut RenderScratch,
    ) -> Result<()> {
        self.check_count(len)?;
        self.check_scratch(scratch)?;
        let s = scratch;
        recorder.update(s.count.view_mut(), &[len as u32])?;
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
                splat_from_visible: s.splat_from_visible.view_mut(),
            },
        )?;
        self.depth_sort.record(
            recorder,
            SortArgs {
                count: s.visible_count.view(),
                count_at: 0,
                keys: s.keys.view(),
                payload: s.splat_from_visible.view(),
                sorted_keys: s.sorted_keys.view_mut(),
                sorted_payload: s.splat_from_rank.view_mut(),
            },
            &mut s.depth_sort,
        )?;
        recorder.dispatch::<bin::Counts>(
            groups,
            bin::CountsParams { count },
            bin::CountsArgs {
                visible_count: s.visible_count.view(),
                splat_from_rank: s.splat_from_rank.view(),
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
        recorder.dispatch_specialised::<bin::Emit>(
            bin::EmitConstants { spread: self.profile.spread },
            groups,
            bin::EmitParams { count, capacity, width: self.width, height: self.height },
            bin::EmitArgs {
                visible_count: s.visible_count.view(),
                splat_from_rank: s.splat_from_rank.view(),
                counts: s.rank_counts.view(),
                offsets: s.rank_offsets.view(),
                rectangles: s.rectangles.view(),
                means: s.means.view(),
                conics: s.conics.view(),
                tiles: s.tiles.view_mut(),
                emitted: s.emitted.view_mut(),
                splat_from_emitted: s.splat_from_emitted.view_mut(),
                total: s.intersection_count.view_mut(),
            },
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
        self.tile_sort.record(
            recorder,
            SortArgs {
                count: s.intersection_count.view(),
                count_at: 0,
                keys: s.tiles.view(),
                payload: s.emitted.view(),
                sorted_keys: s.sorted_tiles.view_mut(),
                sorted_payload: s.emitted_from_sorted.view_mut(),
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
}

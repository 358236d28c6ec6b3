//! The forward pass: from Gaussians to a rendered image.

use super::{Frame, PixelViews, device_camera};
use crate::Result;
use crate::gpu::{Groups, Profile, Recorder, View};
use crate::kernels::indirect::record_arguments;
use crate::kernels::{bin, project, raster};
use crate::ops::at_least;
use crate::ops::gaussians::GaussianViews;
use crate::ops::scan::ScanArgs;
use crate::ops::sort::SortArgs;
use crate::types::{Camera, RasterKind, RenderSettings};

impl<G> Frame<G> {
    /// Records the rendering of `gaussians` from `camera` into `out`. Dispatches: `project/forward`;
    /// those of [`Scan::record`](crate::ops::scan::Scan::record); `bin/compact`; those of
    /// [`RadixSort::record`](crate::ops::sort::RadixSort::record) by depth; `bin/counts`; a scan;
    /// `bin/emit`, `bin/fits`; a sort by tile; `indirect/arguments`, `bin/ranges`; `raster/forward` or
    /// `raster/forward_shared`.
    ///
    /// # Errors
    /// [`Error::Shape`](crate::Error::Shape) when there are more Gaussians than planned for, the
    /// camera's image has another size or a view of `out` is too short; else as for
    /// [`Recorder::dispatch`].
    pub fn forward(
        &mut self,
        recorder: &mut Recorder,
        camera: &Camera,
        gaussians: GaussianViews<'_>,
        out: PixelViews<'_>,
    ) -> Result<()> {
        let count = gaussians.len;
        self.project(recorder, camera, gaussians)?;
        self.bin(recorder, count)?;
        self.blend(recorder, None, out)
    }

    /// Records the first stage alone, `project/forward`. It projects the Gaussians to splats
    /// ([`splats`](Self::splats)).
    ///
    /// # Errors
    /// As for [`forward`](Self::forward).
    pub fn project(
        &mut self,
        recorder: &mut Recorder,
        camera: &Camera,
        gaussians: GaussianViews<'_>,
    ) -> Result<()> {
        let Frame { plan, scratch: s, .. } = self;
        plan.check(camera, &gaussians)?;
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
                width: plan.width,
                height: plan.height,
                near: plan.settings.near,
                dilation: plan.settings.dilation,
                alpha_cut: plan.settings.alpha_cut,
                tangent_clamp: plan.settings.tangent_clamp,
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

    /// Records the second stage alone, which lists the first `len` splats by tile, front to back
    /// ([`tile_lists`](Self::tile_lists)). The splats are those of [`project`](Self::project), or
    /// splats that a host application wrote ([`splats_mut`](Self::splats_mut)).
    ///
    /// # Errors
    /// As for [`forward`](Self::forward).
    pub fn bin(&mut self, recorder: &mut Recorder, len: usize) -> Result<()> {
        let Frame { plan, scratch: s, .. } = self;
        plan.check_count(len)?;
        recorder.update(s.count.view_mut(), &[len as u32])?;
        self.rank(recorder, len)?;
        self.emit(recorder, len)?;
        self.list(recorder)
    }

    /// Records the order of the visible splats by depth.
    fn rank(&mut self, recorder: &mut Recorder, len: usize) -> Result<()> {
        let Frame { plan, scratch: s, .. } = self;
        let groups = Groups::linear(len, 64, recorder.device().limits())?;
        let count = len as u32;
        plan.scan.record(
            recorder,
            ScanArgs {
                count: s.count.view(),
                count_at: 0,
                values: s.visible.view(),
                prefix: s.visible_from_splat.view_mut(),
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
                visible_from_splat: s.visible_from_splat.view(),
                means: s.means.view(),
                keys: s.keys.view_mut(),
                splat_from_visible: s.splat_from_visible.view_mut(),
            },
        )?;
        plan.depth_sort.record(
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
        )
    }

    /// Records the intersections of the splats with the tiles, in the order of depth.
    fn emit(&mut self, recorder: &mut Recorder, len: usize) -> Result<()> {
        let Frame { plan, scratch: s, .. } = self;
        let groups = Groups::linear(len, 64, recorder.device().limits())?;
        let (count, capacity) = (len as u32, plan.intersections as u32);
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
        plan.scan.record(
            recorder,
            ScanArgs {
                count: s.count.view(),
                count_at: 0,
                values: s.rank_counts.view(),
                prefix: s.emitted_from_rank.view_mut(),
                total: s.intersection_count.view_mut(),
                total_at: 0,
            },
            &mut s.scan,
        )?;
        recorder.dispatch_specialised::<bin::Emit>(
            bin::EmitConstants { spread: plan.profile.spread },
            groups,
            bin::EmitParams { count, capacity, width: plan.width, height: plan.height },
            bin::EmitArgs {
                visible_count: s.visible_count.view(),
                splat_from_rank: s.splat_from_rank.view(),
                counts: s.rank_counts.view(),
                emitted_from_rank: s.emitted_from_rank.view(),
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
        )
    }

    /// Records the lists of the intersections by tile.
    fn list(&mut self, recorder: &mut Recorder) -> Result<()> {
        let Frame { plan, scratch: s, .. } = self;
        let capacity = plan.intersections as u32;
        plan.tile_sort.record(
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
            plan.intersections,
            64,
            s.grid.view_mut(),
            0,
        )?;
        recorder.dispatch_indirect::<bin::Ranges>(
            &s.grid,
            0,
            bin::RangesParams { capacity, tile_count: plan.tiles() as u32 },
            bin::RangesArgs {
                total: s.intersection_count.view(),
                tiles: s.sorted_tiles.view(),
                ranges: s.ranges.view_mut(),
            },
        )
    }

    /// Records the third stage alone, which blends colours, one for each Gaussian, with the splats that
    /// the last [`project`](Self::project) and [`bin`](Self::bin) projected and sorted: the projected
    /// colours, or others. Alpha and depth do not depend on the colours.
    ///
    /// # Errors
    /// As for [`forward`](Self::forward).
    pub fn blend(
        &mut self,
        recorder: &mut Recorder,
        colours: Option<View<'_, [f32; 4]>>,
        out: PixelViews<'_>,
    ) -> Result<()> {
        let Frame { plan, scratch: s, pixels: own, .. } = self;
        let area = plan.width as usize * plan.height as usize;
        let rgba = out.rgba.unwrap_or(own.rgba.view_mut());
        let depth = out.depth.unwrap_or(own.depth.view_mut());
        let last = out.last.unwrap_or(own.last.view_mut());
        at_least(
            "render",
            &[("rgba", area, rgba.len()), ("depth", area, depth.len()), ("last", area, last.len())],
        )?;
        let groups = plan.tile_groups(recorder.device())?;
        let RenderSettings { alpha_cut, alpha_cap, transmittance_stop, .. } = plan.settings;
        let params = raster::ForwardParams {
            width: plan.width,
            height: plan.height,
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
            colours: colours.unwrap_or(s.colours.view()),
            rgba,
            depth,
            last,
        };
        match plan.raster {
            RasterKind::Subgroup => {
                let Profile { shuffles, spread, .. } = plan.profile;
                let constants = raster::ForwardConstants { shuffles, spread };
                recorder.dispatch_specialised::<raster::Forward>(constants, groups, params, args)
            }
            RasterKind::Shared => recorder.dispatch::<raster::ForwardShared>(groups, params, args),
        }
    }
}

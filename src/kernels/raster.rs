//! Blending of splats in tiles, and its gradients.

use crate::gpu::kernel;

kernel! {
    /// Blends the splats of a tile front to back. Both constants are for software devices.
    pub struct Forward("raster/forward"), workgroup: [32, 1, 1],
    constants: ForwardConstants {
        /// Whether lanes exchange values by shuffles instead of broadcasts and ballots.
        shuffles: bool = false,
        /// Whether workgroups are interleaved so that costly ones are distributed over all cores.
        spread: bool = false,
    },
    params: ForwardParams {
        /// Image width, pixels.
        width: u32,
        /// Image height, pixels.
        height: u32,
        /// Smallest α that is blended.
        alpha_cut: f32,
        /// Largest α.
        alpha_cap: f32,
        /// Blending stops before the transmittance falls to this.
        transmittance_stop: f32,
    },
    args: ForwardArgs {
        /// Begin and end of each tile's range in `emitted_from_sorted`.
        ranges: Read<[u32; 2]>,
        /// Intersections, sorted by tile.
        emitted_from_sorted: Read<u32>,
        /// Gaussian of each intersection.
        splat_from_emitted: Read<u32>,
        /// From `project/forward`.
        means: Read<[f32; 4]>,
        /// From `project/forward`.
        conics: Read<[f32; 4]>,
        /// From `project/forward`.
        colours: Read<[f32; 4]>,
        /// Premultiplied colour without background, and alpha.
        rgba: Write<[f32; 4]>,
        /// Sum of α · T · z (T: transmittance, z: depth).
        depth: Write<f32>,
        /// One past the last intersection blended, counted from the tile's first.
        last: Write<u32>,
    }
}

kernel! {
    /// [`Forward`](struct@Forward) with an invocation per pixel and splats staged in shared memory.
    pub struct ForwardShared("raster/forward_shared") like Forward, workgroup: [256, 1, 1]
}

kernel! {
    /// Computes partial sums of the gradients, one slot per (splat, tile). With v = α · ∂L/∂α and
    /// whitened offsets (h, k) from the mean, a slot holds the moments of v over the tile, then the
    /// gradients with respect to colour and depth.
    pub struct Backward("raster/backward"), workgroup: [32, 1, 1],
    constants: BackwardConstants {
        /// As in [`ForwardConstants`].
        shuffles: bool = false,
        /// Whether a workgroup has several subgroups, whose sums are combined in shared memory.
        several: bool = true,
        /// As in [`ForwardConstants`].
        spread: bool = false,
    },
    params: BackwardParams {
        /// Image width, pixels.
        width: u32,
        /// Image height, pixels.
        height: u32,
        /// Smallest α that is blended.
        alpha_cut: f32,
        /// Largest α.
        alpha_cap: f32,
    },
    args: BackwardArgs {
        /// Begin and end of each tile's range in `emitted_from_sorted`.
        ranges: Read<[u32; 2]>,
        /// Intersections, sorted by tile.
        emitted_from_sorted: Read<u32>,
        /// Gaussian of each intersection.
        splat_from_emitted: Read<u32>,
        /// From `project/forward`.
        means: Read<[f32; 4]>,
        /// From `project/forward`.
        conics: Read<[f32; 4]>,
        /// From `project/forward`.
        colours: Read<[f32; 4]>,
        /// From `raster/forward`.
        rgba: Read<[f32; 4]>,
        /// From `raster/forward`.
        depth: Read<f32>,
        /// From `raster/forward`.
        last: Read<u32>,
        /// Gradient of the loss with respect to premultiplied colour and alpha.
        rgba_gradient: Read<[f32; 4]>,
        /// Gradient of the loss with respect to depth.
        depth_gradient: Read<f32>,
        /// v, v·h, v·k, v·h².
        slots_a: Write<[f32; 4]>,
        /// v·h·k, v·k², red, green.
        slots_b: Write<[f32; 4]>,
        /// Blue, depth.
        slots_c: Write<[f32; 2]>,
    }
}

kernel! {
    /// [`Backward`](struct@Backward) with 8 invocations a tile, for narrow subgroups.
    pub struct BackwardNarrow("raster/backward_narrow") like Backward, workgroup: [8, 1, 1],
    constants: BackwardConstants
}

kernel! {
    /// Sums each visible splat's slots and turns the moments into gradients.
    pub struct Gather("raster/gather"), workgroup: [64, 1, 1],
    constants: GatherConstants {
        /// Whether workgroups are interleaved so that costly ones are distributed over all cores.
        spread: bool = false,
    },
    params: GatherParams {
        /// Number of Gaussians.
        count: u32,
        /// Capacity of the buffers, intersections.
        capacity: u32,
    },
    args: GatherArgs {
        /// Number of visible Gaussians.
        visible_count: Read<u32>,
        /// Visible Gaussians, sorted by depth.
        splat_from_rank: Read<u32>,
        /// Number of tiles of each Gaussian, by depth rank.
        counts: Read<u32>,
        /// Exclusive sums of `counts`: the first intersection of each rank.
        emitted_from_rank: Read<u32>,
        /// From `raster/backward`.
        slots_a: Read<[f32; 4]>,
        /// From `raster/backward`.
        slots_b: Read<[f32; 4]>,
        /// From `raster/backward`.
        slots_c: Read<[f32; 2]>,
        /// From `project/forward`.
        means: Read<[f32; 4]>,
        /// From `project/forward`.
        conics: Read<[f32; 4]>,
        /// Gradients with respect to mean x, mean y (pixels), depth, opacity.
        mean_gradients: Write<[f32; 4]>,
        /// Gradients with respect to the whitened covariance: xx, xy, yy.
        covariance_gradients: Write<[f32; 4]>,
        /// Gradients with respect to red, green, blue.
        colour_gradients: Write<[f32; 4]>,
    }
}

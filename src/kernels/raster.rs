//! Blending of splats in tiles, and its gradients.

use crate::gpu::kernel;

kernel! {
    /// Blends front to back. Specialisation constants, both for software devices: 0, whether lanes
    /// exchange values by shuffles; 1, whether costly workgroups are spread over all.
    pub struct Forward("raster/forward"), workgroup: [32, 1, 1],
    params: ForwardParams {
        /// Image width, pixels.
        width: u32,
        /// Image height, pixels.
        height: u32,
        /// Least α that counts.
        alpha_cut: f32,
        /// Largest α.
        alpha_cap: f32,
        /// Blending stops before the transmittance falls to this.
        transmittance_stop: f32,
    },
    args: ForwardArgs {
        /// Begin and end of each tile.
        ranges: Read<[u32; 2]>,
        /// Intersections by tile.
        intersections: Read<u32>,
        /// Gaussian of each intersection.
        splats: Read<u32>,
        /// From projection.
        means: Read<[f32; 4]>,
        /// From projection.
        conics: Read<[f32; 4]>,
        /// From projection.
        colours: Read<[f32; 4]>,
        /// Premultiplied colour without background, and alpha.
        rgba: Write<[f32; 4]>,
        /// Sum of α · T · z.
        depth: Write<f32>,
        /// One past the last intersection blended, from the tile's first.
        last: Write<u32>,
    }
}

kernel! {
    /// [`Forward`](struct@Forward) with an invocation per pixel and splats staged in shared memory.
    pub struct ForwardShared("raster/forward_shared") like Forward, workgroup: [256, 1, 1]
}

kernel! {
    /// Partial sums of gradients per (splat, tile).
    pub struct Backward("raster/backward"), workgroup: [32, 1, 1],
    params: BackwardParams {
        /// Image width, pixels.
        width: u32,
        /// Image height, pixels.
        height: u32,
        /// Least α that counts.
        alpha_cut: f32,
        /// Largest α.
        alpha_cap: f32,
    },
    args: BackwardArgs {
        /// Begin and end of each tile.
        ranges: Read<[u32; 2]>,
        /// Intersections by tile.
        intersections: Read<u32>,
        /// Gaussian of each intersection.
        splats: Read<u32>,
        /// From projection.
        means: Read<[f32; 4]>,
        /// From projection.
        conics: Read<[f32; 4]>,
        /// From projection.
        colours: Read<[f32; 4]>,
        /// From the forward pass.
        rgba: Read<[f32; 4]>,
        /// From the forward pass.
        depth: Read<f32>,
        /// From the forward pass.
        last: Read<u32>,
        /// Of the loss, by colour and alpha.
        rgba_gradient: Read<[f32; 4]>,
        /// Of the loss, by depth.
        depth_gradient: Read<f32>,
        /// v, v·dx, v·dy, v·dx².
        slots_a: Write<[f32; 4]>,
        /// v·dx·dy, v·dy², red, green.
        slots_b: Write<[f32; 4]>,
        /// Blue, depth.
        slots_c: Write<[f32; 2]>,
    }
}

kernel! {
    /// [`Backward`](struct@Backward) with 8 invocations a tile, for narrow subgroups. Specialisation
    /// constants: 0 and 2 as 0 and 1 of [`Forward`](struct@Forward); 1, whether the subgroups are
    /// smaller, so that sums of several meet in shared memory.
    pub struct BackwardNarrow("raster/backward_narrow") like Backward, workgroup: [8, 1, 1]
}

kernel! {
    /// Sums each visible splat's slots. Specialisation constant 0: whether costly workgroups are spread
    /// over all.
    pub struct Gather("raster/gather"), workgroup: [64, 1, 1],
    params: GatherParams {
        /// Number of Gaussians.
        count: u32,
        /// Intersections that the buffers hold.
        capacity: u32,
    },
    args: GatherArgs {
        /// How many are visible.
        visible_count: Read<u32>,
        /// Gaussians by depth.
        order: Read<u32>,
        /// Tiles by rank.
        counts: Read<u32>,
        /// Exclusive sums of `counts`.
        offsets: Read<u32>,
        /// From the backward pass.
        slots_a: Read<[f32; 4]>,
        /// From the backward pass.
        slots_b: Read<[f32; 4]>,
        /// From the backward pass.
        slots_c: Read<[f32; 2]>,
        /// From projection.
        means: Read<[f32; 4]>,
        /// From projection.
        conics: Read<[f32; 4]>,
        /// By mean x, mean y, depth, opacity.
        mean_gradients: Write<[f32; 4]>,
        /// By the whitened covariance: xx, xy, yy.
        covariance_gradients: Write<[f32; 4]>,
        /// By red, green, blue.
        colour_gradients: Write<[f32; 4]>,
    }
}

//! Binning: lists of the visible splats by depth and of the intersections by tile.

use crate::gpu::kernel;

kernel! {
    /// Lists the visible splats with their depth as sort key.
    pub struct Compact("bin/compact"), workgroup: [64, 1, 1],
    params: CompactParams {
        /// Number of Gaussians.
        count: u32,
    },
    args: CompactArgs {
        /// 1 for a visible Gaussian, else 0.
        visible: Read<u32>,
        /// Exclusive sums of `visible`: where a visible Gaussian stands in the list.
        visible_from_splat: Read<u32>,
        /// Splat means; z is the depth.
        means: Read<[f32; 4]>,
        /// The bits of the depth as an unsigned integer.
        keys: Write<u32>,
        /// Index of the Gaussian.
        splat_from_visible: Write<u32>,
    }
}

kernel! {
    /// Orders the tile counts of the visible splats by depth.
    pub struct Counts("bin/counts"), workgroup: [64, 1, 1],
    params: CountsParams {
        /// Number of Gaussians.
        count: u32,
    },
    args: CountsArgs {
        /// Number of visible Gaussians.
        visible_count: Read<u32>,
        /// Visible Gaussians, sorted by depth.
        splat_from_rank: Read<u32>,
        /// Number of tiles of each Gaussian.
        tile_counts: Read<u32>,
        /// Number of tiles of each Gaussian, by depth rank; 0 past the last.
        counts: Write<u32>,
    }
}

kernel! {
    /// Emits a (tile, intersection) pair for each tile that a splat overlaps.
    pub struct Emit("bin/emit"), workgroup: [64, 1, 1],
    constants: EmitConstants {
        /// Whether workgroups are interleaved so that costly ones are distributed over all cores.
        spread: bool = false,
    },
    params: EmitParams {
        /// Number of Gaussians.
        count: u32,
        /// Capacity of the buffers, intersections.
        capacity: u32,
        /// Image width, pixels.
        width: u32,
        /// Image height, pixels.
        height: u32,
    },
    args: EmitArgs {
        /// Number of visible Gaussians.
        visible_count: Read<u32>,
        /// Visible Gaussians, sorted by depth.
        splat_from_rank: Read<u32>,
        /// Number of tiles of each Gaussian, by depth rank.
        counts: Read<u32>,
        /// Exclusive sums of `counts`: the first intersection of each rank.
        emitted_from_rank: Read<u32>,
        /// From `project/forward`.
        rectangles: Read<[u32; 2]>,
        /// From `project/forward`.
        means: Read<[f32; 4]>,
        /// From `project/forward`.
        conics: Read<[f32; 4]>,
        /// Tile of each intersection.
        tiles: Write<u32>,
        /// The index of each intersection, in the order in which they are emitted.
        emitted: Write<u32>,
        /// Gaussian of each intersection.
        splat_from_emitted: Write<u32>,
        /// Number of intersections. On input, the sum of `counts` modulo 2³²; set to 2³² − 1 where the
        /// sum overflowed.
        total: ReadWrite<u32>,
    }
}

kernel! {
    /// Finds the range of each tile in the sorted intersections.
    pub struct Ranges("bin/ranges"), workgroup: [64, 1, 1],
    params: RangesParams {
        /// Capacity of the buffers, intersections.
        capacity: u32,
        /// Number of tiles.
        tile_count: u32,
    },
    args: RangesArgs {
        /// Number of intersections.
        total: Read<u32>,
        /// Sorted tiles.
        tiles: Read<u32>,
        /// Begin and end of each tile; must be zero before.
        ranges: ReadWrite<[u32; 2]>,
    }
}

kernel! {
    /// Writes a frame's counts, and whether its intersections fitted.
    pub struct Fits("bin/fits"), workgroup: [1, 1, 1],
    params: FitsParams {
        /// Capacity of the buffers, intersections.
        capacity: u32,
    },
    args: FitsArgs {
        /// Number of visible splats.
        visible_count: Read<u32>,
        /// Number of intersections.
        total: Read<u32>,
        /// Both counts: visible splats, intersections.
        counts: Write<u32>,
        /// 1 where all intersections fitted, else 0.
        fits: Write<u32>,
    }
}

//! Binning: visible splats by depth, intersections by tile.

use crate::gpu::kernel;

kernel! {
    /// Lists the visible splats with their depth as a key.
    pub struct Compact("bin/compact"), workgroup: [64, 1, 1],
    params: CompactParams {
        /// Number of Gaussians.
        count: u32,
    },
    args: CompactArgs {
        /// 1 for visible.
        visible: Read<u32>,
        /// Exclusive sums of `visible`.
        offsets: Read<u32>,
        /// Depth in z.
        means: Read<[f32; 4]>,
        /// Bits of the depth.
        keys: Write<u32>,
        /// Index of the Gaussian.
        splats: Write<u32>,
    }
}

kernel! {
    /// Tiles of each visible splat in order of depth.
    pub struct Counts("bin/counts"), workgroup: [64, 1, 1],
    params: CountsParams {
        /// Number of Gaussians.
        count: u32,
    },
    args: CountsArgs {
        /// How many are visible.
        visible_count: Read<u32>,
        /// Gaussians by depth.
        order: Read<u32>,
        /// Tiles by Gaussian.
        tile_counts: Read<u32>,
        /// Tiles by rank, 0 past the last.
        counts: Write<u32>,
    }
}

kernel! {
    /// Emits a (tile, intersection) pair per tile reached. Specialisation constant 0: whether costly
    /// workgroups are spread over all.
    pub struct Emit("bin/emit"), workgroup: [64, 1, 1],
    params: EmitParams {
        /// Number of Gaussians.
        count: u32,
        /// Intersections that the buffers hold.
        capacity: u32,
        /// Image width, pixels.
        width: u32,
        /// Image height, pixels.
        height: u32,
    },
    args: EmitArgs {
        /// How many are visible.
        visible_count: Read<u32>,
        /// Gaussians by depth.
        order: Read<u32>,
        /// Tiles by rank.
        counts: Read<u32>,
        /// Exclusive sums of `counts`.
        offsets: Read<u32>,
        /// From projection.
        rectangles: Read<[u32; 2]>,
        /// From projection.
        means: Read<[f32; 4]>,
        /// From projection.
        conics: Read<[f32; 4]>,
        /// Tile of each intersection.
        tiles: Write<u32>,
        /// The intersection's own number.
        intersections: Write<u32>,
        /// Gaussian of each intersection.
        splats: Write<u32>,
        /// Number of intersections: the sum of `counts`, which wraps; becomes 2³² − 1 where it did.
        total: ReadWrite<u32>,
    }
}

kernel! {
    /// Where each tile's intersections begin and end.
    pub struct Ranges("bin/ranges"), workgroup: [64, 1, 1],
    params: RangesParams {
        /// Intersections that the buffers hold.
        capacity: u32,
        /// Number of tiles.
        tile_count: u32,
    },
    args: RangesArgs {
        /// Number of intersections.
        total: Read<u32>,
        /// Sorted tiles.
        tiles: Read<u32>,
        /// Begin and end by tile; zeroed before.
        ranges: ReadWrite<[u32; 2]>,
    }
}

kernel! {
    /// What a frame held, and whether it fitted.
    pub struct Fits("bin/fits"), workgroup: [1, 1, 1],
    params: FitsParams {
        /// Intersections that the buffers hold.
        capacity: u32,
    },
    args: FitsArgs {
        /// How many splats are visible.
        visible_count: Read<u32>,
        /// Number of intersections.
        total: Read<u32>,
        /// Both.
        counts: Write<u32>,
        /// 1 where all intersections fitted, else 0.
        fits: Write<u32>,
    }
}

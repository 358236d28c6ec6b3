//! The as-rigid-as-possible energy of control points.

use crate::gpu::kernel;

kernel! {
    /// Computes the best-fitting rotation, the energy and the edge gradients of every control point.
    pub struct Fit("arap/fit"), workgroup: [64, 1, 1],
    params: FitParams {
        /// Number of control points.
        node_count: u32,
        /// Number of places per control point.
        k: u32,
        /// First row of `transforms` at the first time.
        first_at: u32,
        /// First row of `transforms` at the second time.
        second_at: u32,
        /// Number of nearest neighbours that count at any distance.
        always: u32,
        /// Further neighbours count only when they are nearer than this, world units.
        reach: f32,
        /// Weight of the energy divided by the number of control points.
        scale: f32,
    },
    args: FitArgs {
        /// Canonical positions.
        nodes: ReadVec3<f32>,
        /// Logarithms of the radii.
        log_radii: Read<f32>,
        /// Nearest control points of each control point; most rows include the control point itself.
        neighbours: Read<u32>,
        /// Motions at the two times.
        transforms: Read<[f32; 4]>,
        /// The energy of each control point.
        energies: Write<f32>,
        /// Gradients of the edges, two vectors a place.
        edge_gradients: Write<[f32; 4]>,
    }
}

kernel! {
    /// Sums the edges' gradients at both of their ends.
    pub struct Gather("arap/gather"), workgroup: [64, 1, 1],
    params: GatherParams {
        /// Number of control points.
        node_count: u32,
        /// Number of places per control point.
        k: u32,
        /// First row of `transforms` at the first time.
        first_at: u32,
        /// First row of `transforms` at the second time.
        second_at: u32,
    },
    args: GatherArgs {
        /// Begin of each control point's range in `place_from_sorted`, and the end of the last.
        starts: Read<u32>,
        /// Places, ordered by control point.
        place_from_sorted: Read<u32>,
        /// As [`Fit`] writes them.
        edge_gradients: Read<[f32; 4]>,
        /// Gradient with respect to the motions; the translations' part is accumulated.
        transform_gradients: ReadWrite<[f32; 4]>,
    }
}

//! As-rigid-as-possible motion of control points.

use crate::gpu::kernel;

kernel! {
    /// Rotation, energy and edge gradients of every control point.
    pub struct Fit("arap/fit"), workgroup: [64, 1, 1],
    params: FitParams {
        /// Control points.
        node_count: u32,
        /// Places per control point.
        k: u32,
        /// First row of `transforms` at the first time.
        first_at: u32,
        /// First row of `transforms` at the second time.
        second_at: u32,
        /// So many neighbours count at any distance.
        always: u32,
        /// The others count only when nearer than this.
        reach: f32,
        /// Weight of the energy divided by the number of control points.
        scale: f32,
    },
    args: FitArgs {
        /// Canonical positions.
        nodes: ReadVec3<f32>,
        /// Logarithms of the radii.
        log_radii: Read<f32>,
        /// Nearest control points, most rows with the control point itself.
        neighbours: Read<u32>,
        /// Motions at the two times.
        transforms: Read<[f32; 4]>,
        /// One for each control point.
        energies: Write<f32>,
        /// Two vectors a place.
        edge_gradients: Write<[f32; 4]>,
    }
}

kernel! {
    /// Adds the edges' gradients at both ends.
    pub struct Gather("arap/gather"), workgroup: [64, 1, 1],
    params: GatherParams {
        /// Control points.
        node_count: u32,
        /// Places per control point.
        k: u32,
        /// First row at the first time.
        first_at: u32,
        /// First row at the second time.
        second_at: u32,
    },
    args: GatherArgs {
        /// Where each control point's places begin.
        starts: Read<u32>,
        /// Places in the order of their control points.
        places: Read<u32>,
        /// As [`Fit`] writes them.
        edge_gradients: Read<[f32; 4]>,
        /// Added to, translations only.
        transform_gradients: ReadWrite<[f32; 4]>,
    }
}

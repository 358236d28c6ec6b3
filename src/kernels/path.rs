//! Paths of control points: their motions at evenly spaced key times, interpolated between.

use crate::gpu::kernel;

kernel! {
    /// The motions by the paths.
    pub struct Evaluate("path/evaluate"), workgroup: [64, 1, 1],
    params: EvaluateParams {
        /// Control points.
        node_count: u32,
        /// Key times.
        key_count: u32,
        /// Control points times times.
        rows: u32,
    },
    args: EvaluateArgs {
        /// Eight values for each control point, key after key.
        paths: Read<f32>,
        /// Times in [0, 1].
        times: Read<f32>,
        /// Two vectors a row, time after time: translation and padding; rotation.
        transforms: Write<[f32; 4]>,
    }
}

kernel! {
    /// The gradient with respect to the paths.
    pub struct Gather("path/gather"), workgroup: [64, 1, 1],
    params: GatherParams {
        /// Control points.
        node_count: u32,
        /// Key times.
        key_count: u32,
        /// Times.
        time_count: u32,
    },
    args: GatherArgs {
        /// Times in [0, 1].
        times: Read<f32>,
        /// Laid out as the motions.
        transform_gradients: Read<[f32; 4]>,
        /// Laid out as the paths.
        gradients: Write<f32>,
    }
}

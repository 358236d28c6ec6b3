//! Paths of control points: motions at evenly spaced key times, with interpolation between them.

use crate::gpu::kernel;

kernel! {
    /// Evaluates the motions of control points from their paths.
    pub struct Evaluate("path/evaluate"), workgroup: [64, 1, 1],
    params: EvaluateParams {
        /// Number of control points.
        node_count: u32,
        /// Number of key times.
        key_count: u32,
        /// Number of rows: control points × times.
        rows: u32,
    },
    args: EvaluateArgs {
        /// The paths: eight values for each control point, key after key.
        paths: Read<f32>,
        /// Times in [0, 1].
        times: Read<f32>,
        /// Two vectors a row, for one time after the other: translation and the opacity-logit offset; rotation.
        transforms: Write<[f32; 4]>,
    }
}

kernel! {
    /// Computes the gradient with respect to the paths.
    pub struct Gather("path/gather"), workgroup: [64, 1, 1],
    params: GatherParams {
        /// Number of control points.
        node_count: u32,
        /// Number of key times.
        key_count: u32,
        /// Number of times.
        time_count: u32,
    },
    args: GatherArgs {
        /// Times in [0, 1].
        times: Read<f32>,
        /// Gradient with respect to the motions, in their layout.
        transform_gradients: Read<[f32; 4]>,
        /// Gradient with respect to the paths, in their layout.
        gradients: Write<f32>,
    }
}

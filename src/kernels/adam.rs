//! The Adam optimiser.

use crate::gpu::kernel;

kernel! {
    /// One step of Adam over a flat array.
    pub struct Step("adam/step"), workgroup: [64, 1, 1],
    constants: StepConstants {
        /// Whether rows whose entry in `visible` is 0 stay unchanged.
        masked: bool = false,
        /// Number of values in a row.
        row: u32 = 1,
        /// Whether a row has fewer than three values.
        short_rows: bool = true,
        /// Whether the parameter `row` replaces the constant.
        any_row: bool = false,
    },
    params: StepParams {
        /// Number of values.
        count: u32,
        /// Learning rate.
        rate: f32,
        /// Decay of the first moment.
        beta1: f32,
        /// Decay of the second moment.
        beta2: f32,
        /// 1 − β₁.
        rest1: f32,
        /// 1 − β₂.
        rest2: f32,
        /// 1 / (1 − β₁ᵗ).
        unbias1: f32,
        /// 1 / (1 − β₂ᵗ).
        unbias2: f32,
        /// Added to the square root of the second moment.
        epsilon: f32,
        /// Number of values in a row, with `any_row`.
        row: u32,
    },
    args: StepArgs {
        /// One word a row; 0 leaves the row unchanged.
        visible: Read<u32>,
        /// Gradients.
        gradients: ReadVec4<f32>,
        /// Parameters.
        parameters: ReadWriteVec4<f32>,
        /// First moments.
        first: ReadWriteVec4<f32>,
        /// Second moments.
        second: ReadWriteVec4<f32>,
        /// One word, to which the number of non-finite gradients in rows that are not masked is added.
        broken: ReadWrite<u32>,
    }
}

kernel! {
    /// Writes which Gaussians a step may change.
    pub struct Gate("adam/gate"), workgroup: [64, 1, 1],
    params: GateParams {
        /// Number of Gaussians.
        count: u32,
    },
    args: GateArgs {
        /// 1 where the frame fitted, else 0.
        fits: Read<u32>,
        /// 1 for each Gaussian that is trained, else 0.
        trainable: Read<u32>,
        /// 1 for each Gaussian that the step may change, else 0.
        gate: Write<u32>,
    }
}

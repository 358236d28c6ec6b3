//! The optimiser.

use crate::gpu::kernel;

kernel! {
    /// One step of Adam over a flat array. Specialisation constants: 0 whether rows whose entry in
    /// `visible` is 0 stay as they are, 1 the values of a row, 2 whether those are fewer than three, 3
    /// whether `row` tells them instead.
    pub struct Step("adam/step"), workgroup: [64, 1, 1],
    params: StepParams {
        /// Values.
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
        /// Added to the root of the second moment.
        epsilon: f32,
        /// Values of a row, where constant 3 is set.
        row: u32,
    },
    args: StepArgs {
        /// One word a row.
        visible: Read<u32>,
        /// Gradients.
        gradients: ReadVec4<f32>,
        /// Parameters.
        parameters: ReadWriteVec4<f32>,
        /// First moments.
        first: ReadWriteVec4<f32>,
        /// Second moments.
        second: ReadWriteVec4<f32>,
        /// One word, to which the number of gradients is added that would count but are not finite.
        broken: ReadWrite<u32>,
    }
}

kernel! {
    /// Which Gaussians a step may change.
    pub struct Gate("adam/gate"), workgroup: [64, 1, 1],
    params: GateParams {
        /// Number of Gaussians.
        count: u32,
    },
    args: GateArgs {
        /// 1 where the frame fitted, else 0.
        fits: Read<u32>,
        /// 1 for each Gaussian that trains.
        trainable: Read<u32>,
        /// 1 for each Gaussian that the step may change.
        gate: Write<u32>,
    }
}

//! Rendered motion against motion masks.

use crate::gpu::kernel;

kernel! {
    /// Probabilities of motion as colours.
    pub struct Paint("mask/paint"), workgroup: [64, 1, 1],
    params: PaintParams {
        /// Gaussians.
        count: u32,
    },
    args: PaintArgs {
        /// Motion logits.
        motion_logits: Read<f32>,
        /// Red is the probability.
        colours: Write<[f32; 4]>,
    }
}

kernel! {
    /// The loss's gradient by the rendered probability, and the votes' weights.
    pub struct Compare("mask/compare"), workgroup: [64, 1, 1],
    params: CompareParams {
        /// Pixels.
        pixels: u32,
        /// Weight of the loss over the number of pixels.
        factor: f32,
    },
    args: CompareArgs {
        /// Rendered; red counts.
        rgba: Read<[f32; 4]>,
        /// 1 where something moves.
        mask: Read<f32>,
        /// Gradient, mask, 1, 0.
        rgba_gradient: Write<[f32; 4]>,
    }
}

kernel! {
    /// Gradients by the motion logits, and votes.
    pub struct Vote("mask/vote"), workgroup: [64, 1, 1],
    params: VoteParams {
        /// Gaussians.
        count: u32,
    },
    args: VoteArgs {
        /// What [`Compare`] wrote, gathered by Gaussian.
        colour_gradients: Read<[f32; 4]>,
        /// Not 0 for what the picture shows.
        visible: Read<u32>,
        /// 0 where the picture's intersections did not all fit.
        fits: Read<u32>,
        /// Motion logits.
        motion_logits: Read<f32>,
        /// Added to.
        motion_gradients: ReadWrite<f32>,
        /// Votes for motion, and votes: added to.
        votes: ReadWrite<f32>,
        /// Their quotient.
        evidence: Write<f32>,
    }
}

//! The mask loss: rendered probabilities of motion against motion masks.

use crate::gpu::kernel;

kernel! {
    /// Writes the probabilities of motion as colours.
    pub struct Paint("mask/paint"), workgroup: [64, 1, 1],
    params: PaintParams {
        /// Number of Gaussians.
        count: u32,
    },
    args: PaintArgs {
        /// Motion logits.
        motion_logits: Read<f32>,
        /// Colours whose red is the probability.
        colours: Write<[f32; 4]>,
    }
}

kernel! {
    /// Computes the loss's gradient with respect to the rendered probability, and the weights of the
    /// votes.
    pub struct Compare("mask/compare"), workgroup: [64, 1, 1],
    params: CompareParams {
        /// Number of pixels.
        pixels: u32,
        /// Weight of the loss divided by the number of pixels.
        factor: f32,
    },
    args: CompareArgs {
        /// The rendered image; red is the probability of motion.
        rgba: Read<[f32; 4]>,
        /// 1 where something moves.
        mask: Read<f32>,
        /// Gradient, mask, 1, 0.
        rgba_gradient: Write<[f32; 4]>,
    }
}

kernel! {
    /// Computes the gradients with respect to the motion logits, and the votes.
    pub struct Vote("mask/vote"), workgroup: [64, 1, 1],
    params: VoteParams {
        /// Number of Gaussians.
        count: u32,
    },
    args: VoteArgs {
        /// What [`Compare`] wrote, gathered by Gaussian.
        colour_gradients: Read<[f32; 4]>,
        /// Not 0 for a Gaussian that is visible in the image.
        visible: Read<u32>,
        /// 0 where the frame's intersections did not all fit.
        fits: Read<u32>,
        /// Motion logits.
        motion_logits: Read<f32>,
        /// Gradients with respect to the motion logits; accumulated.
        motion_gradients: ReadWrite<f32>,
        /// Votes for motion, and all votes; accumulated.
        votes: ReadWrite<f32>,
        /// Votes for motion divided by all votes.
        evidence: Write<f32>,
    }
}

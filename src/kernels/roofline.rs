//! Microbenchmarks of a device's peak bandwidth and peak arithmetic, the reference for the roofline of
//! other kernels.

use crate::gpu::kernel;

/// Number of vectors that a workgroup of [`Copy`](struct@Copy) copies.
pub const COPY_PER_GROUP: u32 = 512;
/// Number of floating-point operations of an invocation of [`Fma`](struct@Fma) in one round.
pub const FMA_OPERATIONS: u64 = 4 * 32;

kernel! {
    /// Copies vectors.
    pub struct Copy("roofline/copy"), workgroup: [64, 1, 1],
    params: CopyParams {
        /// Number of vectors.
        count: u32,
    },
    args: CopyArgs {
        /// The vectors to copy.
        source: Read<[f32; 4]>,
        /// The copies.
        target: Write<[f32; 4]>,
    }
}

kernel! {
    /// Evaluates chains of multiply-adds.
    pub struct Fma("roofline/fma"), workgroup: [64, 1, 1],
    params: FmaParams {
        /// Number of seeds.
        count: u32,
        /// Number of rounds; each chain does four multiply-adds a round.
        rounds: u32,
    },
    args: FmaArgs {
        /// Initial values of the chains.
        seeds: Read<f32>,
        /// The sum of each seed's sixteen chains.
        sums: Write<f32>,
    }
}

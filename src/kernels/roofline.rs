//! What a device can do at most: plain copying and plain arithmetic, for other kernels to be
//! measured against.

use crate::gpu::kernel;

/// Vectors that a workgroup of [`Copy`](struct@Copy) moves.
pub const COPY_PER_GROUP: u32 = 512;
/// Floating-point operations of an invocation of [`Fma`](struct@Fma) in one round.
pub const FMA_OPERATIONS: u64 = 4 * 32;

kernel! {
    /// Copies vectors.
    pub struct Copy("roofline/copy"), workgroup: [64, 1, 1],
    params: CopyParams {
        /// Number of vectors.
        count: u32,
    },
    args: CopyArgs {
        /// From here.
        source: Read<[f32; 4]>,
        /// To here.
        target: Write<[f32; 4]>,
    }
}

kernel! {
    /// Chains of multiply-adds.
    pub struct Fma("roofline/fma"), workgroup: [64, 1, 1],
    params: FmaParams {
        /// Number of seeds.
        count: u32,
        /// Each chain takes four multiply-adds a round.
        rounds: u32,
    },
    args: FmaArgs {
        /// What the chains start from.
        seeds: Read<f32>,
        /// The sum of each seed's sixteen chains.
        sums: Write<f32>,
    }
}

//! Dense optical flow: pyramid, semi-global start, dense inverse search, variational refinement,
//! forward–backward check. `oracle::flow` has the mathematics.

use crate::gpu::kernel;

kernel! {
    /// Computes the luma of encoded colours.
    pub struct Luma("flow/luma"), workgroup: [64, 1, 1],
    params: LumaParams {
        /// Number of pixels.
        count: u32,
        /// Number of values per pixel.
        channels: u32,
    },
    args: LumaArgs {
        /// `count · channels` values.
        pixels: Read<f32>,
        /// One value per pixel.
        luma: Write<f32>,
    }
}

kernel! {
    /// Computes the next level of a pyramid.
    pub struct Halve("flow/halve"), workgroup: [16, 4, 1],
    params: HalveParams {
        /// Width of the level, pixels.
        width: i32,
        /// Height of the level, pixels.
        height: i32,
    },
    args: HalveArgs {
        /// Luma of the level.
        luma: Read<f32>,
        /// Luma of the next level, half as wide and high, rounded up.
        halved: Write<f32>,
    }
}

kernel! {
    /// Computes the first and second derivatives of the luminance.
    pub struct Derivatives("flow/derivatives"), workgroup: [16, 4, 1],
    params: DerivativesParams {
        /// Width of the level, pixels.
        width: i32,
        /// Height of the level, pixels.
        height: i32,
    },
    args: DerivativesArgs {
        /// Luma of the level.
        luma: Read<f32>,
        /// ∂x, ∂y, ∂xx, ∂xy, ∂yy of each pixel.
        derivatives: Write<f32>,
    }
}

kernel! {
    /// The census transform: which of the 24 neighbours of a pixel are brighter.
    pub struct Census("flow/census"), workgroup: [16, 4, 1],
    params: CensusParams {
        /// Width of the level, pixels.
        width: i32,
        /// Height of the level, pixels.
        height: i32,
    },
    args: CensusArgs {
        /// Luma of the level.
        luma: Read<f32>,
        /// 24 bits per pixel.
        census: Write<u32>,
    }
}

kernel! {
    /// Semi-global matching along one direction, with a workgroup per row or column.
    pub struct Path("flow/path"), workgroup: [32, 1, 1],
    params: PathParams {
        /// Width of the level, pixels.
        width: i32,
        /// Height of the level, pixels.
        height: i32,
        /// Largest displacement along each axis, pixels.
        radius: i32,
        /// Direction of the path: 0 from the left, 1 from the right, 2 from above, 3 from below. Path 0
        /// must come first, since it overwrites the volume.
        path: u32,
        /// Cost of a change of the displacement by one.
        small_step: u32,
        /// Cost of a larger change.
        large_step: u32,
    },
    args: PathArgs {
        /// Census of the first image.
        census_a: Read<u32>,
        /// Census of the second image.
        census_b: Read<u32>,
        /// Costs per pixel and displacement.
        volume: ReadWrite<u32>,
    }
}

kernel! {
    /// Selects the cheapest displacement of each pixel.
    pub struct Cheapest("flow/cheapest"), workgroup: [64, 1, 1],
    params: CheapestParams {
        /// Number of pixels.
        count: u32,
        /// Largest displacement along each axis, pixels.
        radius: i32,
    },
    args: CheapestArgs {
        /// Costs per pixel and displacement.
        volume: Read<u32>,
        /// Displacements, pixels.
        flow: Write<[f32; 2]>,
    }
}

kernel! {
    /// Upsamples a flow to the next finer level.
    pub struct Upsample("flow/upsample"), workgroup: [16, 4, 1],
    params: UpsampleParams {
        /// Width of the coarser level, pixels.
        coarse_width: i32,
        /// Height of the coarser level, pixels.
        coarse_height: i32,
        /// Width of the level, pixels.
        width: i32,
        /// Height of the level, pixels.
        height: i32,
    },
    args: UpsampleArgs {
        /// The coarser level's flow.
        coarse: Read<[f32; 2]>,
        /// This level's flow.
        flow: Write<[f32; 2]>,
    }
}

kernel! {
    /// Inverse search: each patch finds its displacement.
    pub struct Search("flow/search"), workgroup: [8, 4, 1],
    params: SearchParams {
        /// Width of the level, pixels.
        width: i32,
        /// Height of the level, pixels.
        height: i32,
        /// Number of Gauss–Newton steps.
        search_steps: u32,
        /// Gradients below this count as noise.
        noise: f32,
        /// Width of the guess, pixels; 0 without a guess.
        guess_width: i32,
        /// Height of the guess, pixels.
        guess_height: i32,
        /// Number of pixels of the guess per pixel of this level.
        guess_scale: f32,
    },
    args: SearchArgs {
        /// Luminance of the first image.
        luma_a: Read<f32>,
        /// Luminance of the second image.
        luma_b: Read<f32>,
        /// Derivatives of the first image.
        derivatives_a: Read<f32>,
        /// A flow to start from.
        start: Read<[f32; 2]>,
        /// A guess of the flow at full resolution.
        guess: Read<[f32; 2]>,
        /// Two per patch: flow, shift, cost; slope.
        patches: Write<[f32; 4]>,
    }
}

kernel! {
    /// Each patch tries the displacements of its neighbours.
    pub struct Propagate("flow/propagate"), workgroup: [8, 4, 1],
    params: PropagateParams {
        /// Width of the level, pixels.
        width: i32,
        /// Height of the level, pixels.
        height: i32,
        /// Number of Gauss–Newton steps.
        search_steps: u32,
        /// Gradients below this count as noise.
        noise: f32,
        /// Distance of the neighbours, in patches.
        reach: i32,
    },
    args: PropagateArgs {
        /// Luminance of the first image.
        luma_a: Read<f32>,
        /// Luminance of the second image.
        luma_b: Read<f32>,
        /// Derivatives of the first image.
        derivatives_a: Read<f32>,
        /// Patches as [`Search`] writes them.
        patches: Read<[f32; 4]>,
        /// The improved patches.
        spread: Write<[f32; 4]>,
    }
}

kernel! {
    /// Blends the patches into a dense flow.
    pub struct Densify("flow/densify"), workgroup: [16, 4, 1],
    params: DensifyParams {
        /// Width of the level, pixels.
        width: i32,
        /// Height of the level, pixels.
        height: i32,
    },
    args: DensifyArgs {
        /// Luminance of the first image.
        luma_a: Read<f32>,
        /// Luminance of the second image.
        luma_b: Read<f32>,
        /// Patches as [`Search`] writes them.
        patches: Read<[f32; 4]>,
        /// Displacements, pixels.
        flow: Write<[f32; 2]>,
    }
}

kernel! {
    /// Weights the data terms by forward–backward agreement.
    pub struct Trust("flow/trust"), workgroup: [16, 4, 1],
    params: TrustParams {
        /// Width of the level, pixels.
        width: i32,
        /// Height of the level, pixels.
        height: i32,
    },
    args: TrustArgs {
        /// The flow to judge.
        forward: Read<[f32; 2]>,
        /// The flow in the other direction.
        backward: Read<[f32; 2]>,
        /// Weight of the data terms, in (0, 1].
        trust: Write<f32>,
    }
}

kernel! {
    /// Sets up the linear equations of variational refinement.
    pub struct Linearise("flow/linearise"), workgroup: [16, 4, 1],
    params: LineariseParams {
        /// Width of the level, pixels.
        width: i32,
        /// Height of the level, pixels.
        height: i32,
        /// Weight of brightness constancy.
        brightness: f32,
        /// Weight of gradient constancy.
        gradient: f32,
        /// Weight of smoothness.
        smoothness: f32,
        /// Gradient at which the weight of smoothness has fallen to 1/e.
        edge: f32,
        /// Gradients below this count as noise.
        noise: f32,
        /// Residual below which the penalties are approximately quadratic, pixels.
        kink: f32,
    },
    args: LineariseArgs {
        /// Luminance of the first image.
        luma_a: Read<f32>,
        /// Luminance of the second image.
        luma_b: Read<f32>,
        /// Derivatives of the first image.
        derivatives_a: Read<f32>,
        /// Derivatives of the second image.
        derivatives_b: Read<f32>,
        /// The flow to linearise about.
        flow: Read<[f32; 2]>,
        /// Weight of the data terms.
        trust: Read<f32>,
        /// Slopes of the flow that are not penalised, as [`Slopes`] writes them; zeros for none.
        slopes: Read<[f32; 4]>,
        /// For each pixel the matrix entries a, b, c and the smoothness weight.
        matrices: Write<[f32; 4]>,
        /// Right-hand sides of the equations.
        sides: Write<[f32; 2]>,
    }
}

kernel! {
    /// Estimates the slopes of a flow around each pixel.
    pub struct Slopes("flow/slopes"), workgroup: [16, 4, 1],
    params: SlopesParams {
        /// Width of the level, pixels.
        width: i32,
        /// Height of the level, pixels.
        height: i32,
    },
    args: SlopesArgs {
        /// The flow.
        flow: Read<[f32; 2]>,
        /// Weight of each pixel, in (0, 1].
        trust: Read<f32>,
        /// Per pixel du/dx, du/dy, dv/dx, dv/dy.
        slopes: Write<[f32; 4]>,
    }
}

kernel! {
    /// Adds to the right-hand sides the differences between neighbours that the slopes predict.
    pub struct Slant("flow/slant"), workgroup: [16, 4, 1],
    params: SlantParams {
        /// Width of the level, pixels.
        width: i32,
        /// Height of the level, pixels.
        height: i32,
    },
    args: SlantArgs {
        /// As [`Linearise`] writes them.
        matrices: Read<[f32; 4]>,
        /// As [`Slopes`] writes them.
        slopes: Read<[f32; 4]>,
        /// Right-hand sides as [`Linearise`] writes them.
        sides: ReadWrite<[f32; 2]>,
    }
}

kernel! {
    /// Half a red–black sweep of successive over-relaxation.
    pub struct Relax("flow/relax"), workgroup: [16, 4, 1],
    params: RelaxParams {
        /// Width of the level, pixels.
        width: i32,
        /// Height of the level, pixels.
        height: i32,
        /// The pixels to update: those with (x + y) mod 2 equal to this.
        colour: u32,
        /// Over-relaxation factor, in (0, 2).
        relaxation: f32,
    },
    args: RelaxArgs {
        /// As [`Linearise`] writes them.
        matrices: Read<[f32; 4]>,
        /// As [`Linearise`] writes them.
        sides: Read<[f32; 2]>,
        /// The flow.
        flow: ReadWrite<[f32; 2]>,
    }
}

kernel! {
    /// Computes the 3×3 median of a flow.
    pub struct Median("flow/median"), workgroup: [16, 4, 1],
    params: MedianParams {
        /// Width of the level, pixels.
        width: i32,
        /// Height of the level, pixels.
        height: i32,
    },
    args: MedianArgs {
        /// A flow.
        flow: Read<[f32; 2]>,
        /// Its median.
        filtered: Write<[f32; 2]>,
    }
}

kernel! {
    /// Computes the confidence of a flow.
    pub struct Confidence("flow/confidence"), workgroup: [16, 4, 1],
    params: ConfidenceParams {
        /// Width of the level, pixels.
        width: i32,
        /// Height of the level, pixels.
        height: i32,
    },
    args: ConfidenceArgs {
        /// Luminance of the first image.
        luma_a: Read<f32>,
        /// Luminance of the second image.
        luma_b: Read<f32>,
        /// The flow to judge.
        forward: Read<[f32; 2]>,
        /// The flow in the other direction.
        backward: Read<[f32; 2]>,
        /// The confidence, in [0, 1].
        confidence: Write<f32>,
    }
}

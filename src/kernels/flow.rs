//! Dense optical flow: pyramid, semi-global start, dense inverse search, variational refinement,
//! forward–backward check. `oracle::flow` has the mathematics.

use crate::gpu::kernel;

kernel! {
    /// Luma of encoded colours.
    pub struct Luma("flow/luma"), workgroup: [64, 1, 1],
    params: LumaParams {
        /// Pixels.
        count: u32,
        /// Values per pixel.
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
    /// The next level of a pyramid.
    pub struct Halve("flow/halve"), workgroup: [16, 4, 1],
    params: HalveParams {
        /// Width of the level, pixels.
        width: i32,
        /// Height of the level, pixels.
        height: i32,
    },
    args: HalveArgs {
        /// A level.
        luma: Read<f32>,
        /// The next, half as wide and high, rounded up.
        halved: Write<f32>,
    }
}

kernel! {
    /// First and second derivatives of the luminance.
    pub struct Derivatives("flow/derivatives"), workgroup: [16, 4, 1],
    params: DerivativesParams {
        /// Width of the level, pixels.
        width: i32,
        /// Height of the level, pixels.
        height: i32,
    },
    args: DerivativesArgs {
        /// A level.
        luma: Read<f32>,
        /// ∂x, ∂y, ∂xx, ∂xy, ∂yy of each pixel.
        derivatives: Write<f32>,
    }
}

kernel! {
    /// Which of the 24 neighbours of a pixel are brighter.
    pub struct Census("flow/census"), workgroup: [16, 4, 1],
    params: CensusParams {
        /// Width of the level, pixels.
        width: i32,
        /// Height of the level, pixels.
        height: i32,
    },
    args: CensusArgs {
        /// A level.
        luma: Read<f32>,
        /// 24 bits per pixel.
        census: Write<u32>,
    }
}

kernel! {
    /// Semi-global matching along one direction; a workgroup per row or column.
    pub struct Path("flow/path"), workgroup: [32, 1, 1],
    params: PathParams {
        /// Width of the level, pixels.
        width: i32,
        /// Height of the level, pixels.
        height: i32,
        /// Displacements reach this far along each axis.
        radius: i32,
        /// From the left, the right, above, below: 0 to 3. 0 goes first: it overwrites the volume.
        path: u32,
        /// Cost of a step of one.
        small_step: u32,
        /// Cost of any greater step.
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
    /// The cheapest displacement of each pixel.
    pub struct Cheapest("flow/cheapest"), workgroup: [64, 1, 1],
    params: CheapestParams {
        /// Pixels.
        count: u32,
        /// Displacements reach this far along each axis.
        radius: i32,
    },
    args: CheapestArgs {
        /// Costs per pixel and displacement.
        volume: Read<u32>,
        /// Displacements.
        flow: Write<[f32; 2]>,
    }
}

kernel! {
    /// A flow brought to the next finer level.
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
        /// This level's.
        flow: Write<[f32; 2]>,
    }
}

kernel! {
    /// Patches find their displacements.
    pub struct Search("flow/search"), workgroup: [8, 4, 1],
    params: SearchParams {
        /// Width of the level, pixels.
        width: i32,
        /// Height of the level, pixels.
        height: i32,
        /// Gauss–Newton steps.
        search_steps: u32,
        /// Gradients below this are noise.
        noise: f32,
        /// Width of the guess; 0 where there is none.
        guess_width: i32,
        /// Height of the guess.
        guess_height: i32,
        /// Pixels of the guess to one of this level.
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
        /// A flow of the full image.
        guess: Read<[f32; 2]>,
        /// Two per patch: flow, shift, cost; slope.
        patches: Write<[f32; 4]>,
    }
}

kernel! {
    /// Patches try their neighbours' displacements.
    pub struct Propagate("flow/propagate"), workgroup: [8, 4, 1],
    params: PropagateParams {
        /// Width of the level, pixels.
        width: i32,
        /// Height of the level, pixels.
        height: i32,
        /// Gauss–Newton steps.
        search_steps: u32,
        /// Gradients below this are noise.
        noise: f32,
        /// How many patches away the neighbours are.
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
    /// Blends patches into a flow per pixel.
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
        /// Displacements.
        flow: Write<[f32; 2]>,
    }
}

kernel! {
    /// How far data terms are trusted, by forward–backward agreement.
    pub struct Trust("flow/trust"), workgroup: [16, 4, 1],
    params: TrustParams {
        /// Width of the level, pixels.
        width: i32,
        /// Height of the level, pixels.
        height: i32,
    },
    args: TrustArgs {
        /// The flow that is judged.
        forward: Read<[f32; 2]>,
        /// The other direction's.
        backward: Read<[f32; 2]>,
        /// In (0, 1].
        trust: Write<f32>,
    }
}

kernel! {
    /// The equations of variational refinement.
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
        /// Gradient at which smoothness has fallen to 1/e.
        edge: f32,
        /// Gradients below this are noise.
        noise: f32,
        /// Where the penalties turn quadratic, pixels.
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
        /// a, b, c and the smoothness.
        matrices: Write<[f32; 4]>,
        /// Right-hand sides.
        sides: Write<[f32; 2]>,
    }
}

kernel! {
    /// Half a red–black sweep.
    pub struct Relax("flow/relax"), workgroup: [16, 4, 1],
    params: RelaxParams {
        /// Width of the level, pixels.
        width: i32,
        /// Height of the level, pixels.
        height: i32,
        /// (x + y) mod 2 of the pixels solved.
        colour: u32,
        /// Over-relaxation, in (0, 2).
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
    /// The 3×3 median of a flow.
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
    /// How far a flow is to be believed.
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
        /// The flow that is judged.
        forward: Read<[f32; 2]>,
        /// The other direction's.
        backward: Read<[f32; 2]>,
        /// In [0, 1].
        confidence: Write<f32>,
    }
}

//! Density control.

use crate::gpu::kernel;

kernel! {
    /// Weights of the draw by opacity, and who is dead.
    pub struct Weigh("density/weigh"), workgroup: [64, 1, 1],
    params: WeighParams {
        /// Gaussians.
        count: u32,
        /// 0 for all, 1 for static ones, 2 for dynamic ones.
        motion_class: u32,
        /// Whether there are motion logits.
        has_motion: u32,
        /// Weight of an opaque Gaussian.
        largest: u32,
        /// Opacity logit up to which one is dead.
        dead_logit: f32,
    },
    args: WeighArgs {
        /// Opacity logits.
        opacity_logits: Read<f32>,
        /// Motion logits, where there are any.
        motion_logits: Read<f32>,
        /// Weights.
        weights: Write<u32>,
        /// 1 for the dead.
        dead: Write<u32>,
    }
}

kernel! {
    /// The rows that get new Gaussians.
    pub struct Slots("density/slots"), workgroup: [64, 1, 1],
    params: SlotsParams {
        /// Gaussians.
        count: u32,
        /// So many rows behind the last, or 0 for the dead ones.
        grown: u32,
    },
    args: SlotsArgs {
        /// 1 for the dead.
        dead: Read<u32>,
        /// Their prefix sums.
        dead_prefix: Read<u32>,
        /// Rows.
        slots: Write<u32>,
    }
}

kernel! {
    /// Draws a target for every slot.
    pub struct Draw("density/draw"), workgroup: [64, 1, 1],
    params: DrawParams {
        /// Gaussians.
        count: u32,
        /// Not 0 when slots lie behind the last Gaussian.
        grown: u32,
        /// Seed.
        seed: u32,
        /// Step, a part of the random numbers' counter.
        step_number: u32,
    },
    args: DrawArgs {
        /// Prefix sums of the weights.
        weight_prefix: Read<u32>,
        /// Sum of the weights; number of slots.
        totals: Read<u32>,
        /// Rows to fill.
        slots: Read<u32>,
        /// Row that each slot copies, or `u32::MAX`.
        targets: Write<u32>,
        /// How often each Gaussian was drawn; zero before.
        drawn: ReadWrite<u32>,
        /// 1 for what was drawn or replaced.
        touched: Write<u32>,
    }
}

kernel! {
    /// Opacity and scale of what was drawn.
    pub struct Shrink("density/shrink"), workgroup: [64, 1, 1],
    params: ShrinkParams {
        /// Gaussians.
        count: u32,
        /// No opacity logit comes out below this.
        dead_logit: f32,
    },
    args: ShrinkArgs {
        /// How often each was drawn.
        drawn: Read<u32>,
        /// Opacity logits.
        opacity_logits: ReadWrite<f32>,
        /// Log-scales.
        log_scales: ReadWriteVec3<f32>,
    }
}

kernel! {
    /// Copies rows from targets to slots.
    pub struct Copy("density/copy"), workgroup: [64, 1, 1],
    params: CopyParams {
        /// Values of a row.
        width: u32,
    },
    args: CopyArgs {
        /// Sum of the weights; number of slots.
        totals: Read<u32>,
        /// Rows to fill.
        slots: Read<u32>,
        /// Rows to copy.
        targets: Read<u32>,
        /// The array.
        values: ReadWrite<f32>,
    }
}

kernel! {
    /// Zeros the moments of what was drawn or replaced.
    pub struct Zero("density/zero"), workgroup: [64, 1, 1],
    params: ZeroParams {
        /// Rows.
        count: u32,
        /// Values of a row.
        width: u32,
    },
    args: ZeroArgs {
        /// 1 where to zero.
        touched: Read<u32>,
        /// The array.
        values: Write<f32>,
    }
}

kernel! {
    /// Noise on the centres.
    pub struct Jitter("density/jitter"), workgroup: [64, 1, 1],
    params: JitterParams {
        /// Gaussians.
        count: u32,
        /// Seed.
        seed: u32,
        /// Step.
        step_number: u32,
        /// Size of the noise.
        size: f32,
    },
    args: JitterArgs {
        /// Log-scales.
        log_scales: ReadVec3<f32>,
        /// Quaternions.
        rotations: Read<[f32; 4]>,
        /// Opacity logits.
        opacity_logits: Read<f32>,
        /// Centres.
        positions: ReadWriteVec3<f32>,
    }
}

kernel! {
    /// What adaptive control does with every Gaussian.
    pub struct Decide("density/decide"), workgroup: [64, 1, 1],
    params: DecideParams {
        /// Gaussians.
        count: u32,
        /// Mean gradient norm above which one grows.
        gradient: f32,
        /// Logarithm of the largest scale that is cloned, not split.
        log_small: f32,
        /// Logarithm of the scale beyond which one is pruned.
        log_large: f32,
        /// Opacity logit below which one is pruned.
        prune_logit: f32,
    },
    args: DecideArgs {
        /// Two values each.
        statistics: Read<f32>,
        /// Opacity logits.
        opacity_logits: Read<f32>,
        /// Log-scales.
        log_scales: ReadVec3<f32>,
        /// 0 prune, 1 keep, 2 clone, 3 split.
        actions: Write<u32>,
        /// 1 for survivors.
        kept: Write<u32>,
        /// 1 for what would add one.
        added: Write<u32>,
    }
}

kernel! {
    /// The rows of the new arrays.
    pub struct Layout("density/layout"), workgroup: [64, 1, 1],
    params: LayoutParams {
        /// Gaussians.
        count: u32,
        /// Rows that there is room for.
        capacity: u32,
    },
    args: LayoutArgs {
        /// As [`Decide`] writes them.
        actions: Read<u32>,
        /// Prefix sums of the survivors.
        kept_prefix: Read<u32>,
        /// Prefix sums of the added.
        added_prefix: Read<u32>,
        /// Survivors; candidates to add; gets the rows in the end.
        totals: ReadWrite<u32>,
        /// Source, and origin in the two upper bits.
        rows: Write<u32>,
    }
}

kernel! {
    /// Brings an array into the new order.
    pub struct Gather("density/gather"), workgroup: [64, 1, 1],
    params: GatherParams {
        /// Values of a row.
        width: u32,
        /// Whether only kept rows carry values.
        fresh_zero: u32,
    },
    args: GatherArgs {
        /// As [`Layout`] leaves them.
        totals: Read<u32>,
        /// The new rows.
        rows: Read<u32>,
        /// The old array.
        values: Read<f32>,
        /// The new one.
        gathered: Write<f32>,
    }
}

kernel! {
    /// Draws the parts of split Gaussians.
    pub struct Parts("density/parts"), workgroup: [64, 1, 1],
    params: PartsParams {
        /// Seed.
        seed: u32,
        /// Step.
        step_number: u32,
        /// Logarithm of the factor by which parts are smaller.
        log_shrink: f32,
    },
    args: PartsArgs {
        /// As [`Layout`] leaves them.
        totals: Read<u32>,
        /// The new rows.
        rows: Read<u32>,
        /// Quaternions, in the new order.
        rotations: Read<[f32; 4]>,
        /// Centres, in the new order.
        positions: ReadWriteVec3<f32>,
        /// Log-scales, in the new order.
        log_scales: ReadWriteVec3<f32>,
    }
}

kernel! {
    /// Adds a view's screen-space gradients to the statistics.
    pub struct Accumulate("density/accumulate"), workgroup: [64, 1, 1],
    params: AccumulateParams {
        /// Gaussians.
        count: u32,
        /// Half the image's width in pixels.
        half_width: f32,
        /// Half its height.
        half_height: f32,
    },
    args: AccumulateArgs {
        /// By mean x, mean y (pixels), depth and opacity.
        mean_gradients: Read<[f32; 4]>,
        /// Not 0 for what the view shows.
        visible: Read<u32>,
        /// 0 where the view's intersections did not all fit: nothing is added then.
        fits: Read<u32>,
        /// Sum of norms; number of views.
        statistics: ReadWrite<f32>,
    }
}

kernel! {
    /// Opacity reset.
    pub struct Reset("density/reset"), workgroup: [64, 1, 1],
    params: ResetParams {
        /// Gaussians.
        count: u32,
        /// No logit stays above it.
        limit: f32,
    },
    args: ResetArgs {
        /// Opacity logits.
        opacity_logits: ReadWrite<f32>,
    }
}

kernel! {
    /// Adds the regularisers' gradients.
    pub struct Regularise("density/regularise"), workgroup: [64, 1, 1],
    params: RegulariseParams {
        /// Number of Gaussians.
        count: u32,
        /// Weight of the mean opacity over the number of Gaussians.
        opacity_factor: f32,
        /// Weight of the mean scale over the number of scales.
        scale_factor: f32,
    },
    args: RegulariseArgs {
        /// 1 per Gaussian.
        opacity_logits: Read<f32>,
        /// 3 per Gaussian.
        log_scales: ReadVec3<f32>,
        /// Added to.
        opacity_gradients: ReadWrite<f32>,
        /// Added to.
        log_scale_gradients: ReadWriteVec3<f32>,
    }
}

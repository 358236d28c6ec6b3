//! Density control: MCMC relocation, and clone, split, prune.

use crate::gpu::kernel;

kernel! {
    /// Computes the weights of the draw from the opacities, and marks the dead Gaussians.
    pub struct Weigh("density/weigh"), workgroup: [64, 1, 1],
    params: WeighParams {
        /// Number of Gaussians.
        count: u32,
        /// 0 for all, 1 for static ones, 2 for dynamic ones.
        motion_class: u32,
        /// Whether `motion_logits` holds motion logits.
        has_motion: u32,
        /// Weight of an opaque Gaussian.
        largest: u32,
        /// Opacity logit up to which a Gaussian is dead.
        dead_logit: f32,
    },
    args: WeighArgs {
        /// Opacity logits.
        opacity_logits: Read<f32>,
        /// Motion logits; not read unless `has_motion` is set.
        motion_logits: Read<f32>,
        /// Weights of the draw.
        weights: Write<u32>,
        /// 1 for a dead Gaussian, else 0.
        dead: Write<u32>,
    }
}

kernel! {
    /// Lists the slots: the rows that receive Gaussians.
    pub struct Slots("density/slots"), workgroup: [64, 1, 1],
    params: SlotsParams {
        /// Number of Gaussians.
        count: u32,
        /// Number of rows after the last that become slots; 0 makes the dead Gaussians the slots.
        grown: u32,
    },
    args: SlotsArgs {
        /// 1 for a dead Gaussian, else 0.
        dead: Read<u32>,
        /// Exclusive prefix sums of `dead`.
        dead_prefix: Read<u32>,
        /// Row of each slot.
        row_from_slot: Write<u32>,
    }
}

kernel! {
    /// Draws a target for every slot.
    pub struct Draw("density/draw"), workgroup: [64, 1, 1],
    params: DrawParams {
        /// Number of Gaussians.
        count: u32,
        /// Not 0 when the slots are rows after the last Gaussian.
        grown: u32,
        /// Seed of the random numbers.
        seed: u32,
        /// Step, a part of the random numbers' counter.
        step_number: u32,
    },
    args: DrawArgs {
        /// Prefix sums of the weights.
        weight_prefix: Read<u32>,
        /// Sum of the weights; number of slots.
        totals: Read<u32>,
        /// Row that each slot fills.
        row_from_slot: Read<u32>,
        /// Row that each slot copies, or `u32::MAX` for none.
        target_from_slot: Write<u32>,
        /// How often each Gaussian was drawn; must be zero before.
        drawn: ReadWrite<u32>,
        /// 1 for a Gaussian that was drawn or replaced; must be zero before.
        touched: Write<u32>,
    }
}

kernel! {
    /// Updates opacity and scale of the Gaussians that were drawn.
    pub struct Shrink("density/shrink"), workgroup: [64, 1, 1],
    params: ShrinkParams {
        /// Number of Gaussians.
        count: u32,
        /// Lower limit of the new opacity logits.
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
        /// Number of values in a row.
        width: u32,
    },
    args: CopyArgs {
        /// Sum of the weights; number of slots.
        totals: Read<u32>,
        /// Row that each slot fills.
        row_from_slot: Read<u32>,
        /// Row that each slot copies, or `u32::MAX` for none.
        target_from_slot: Read<u32>,
        /// The array.
        values: ReadWrite<f32>,
    }
}

kernel! {
    /// Zeroes the moments of Gaussians that were drawn or replaced.
    pub struct Zero("density/zero"), workgroup: [64, 1, 1],
    params: ZeroParams {
        /// Number of rows.
        count: u32,
        /// Number of values in a row.
        width: u32,
    },
    args: ZeroArgs {
        /// 1 for a row to zero.
        touched: Read<u32>,
        /// The array.
        values: Write<f32>,
    }
}

kernel! {
    /// Adds noise to the centres.
    pub struct Jitter("density/jitter"), workgroup: [64, 1, 1],
    params: JitterParams {
        /// Number of Gaussians.
        count: u32,
        /// Seed of the random numbers.
        seed: u32,
        /// Step, a part of the random numbers' counter.
        step_number: u32,
        /// Factor of the noise.
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
    /// Decides what adaptive control does with every Gaussian.
    pub struct Decide("density/decide"), workgroup: [64, 1, 1],
    params: DecideParams {
        /// Number of Gaussians.
        count: u32,
        /// Mean gradient norm above which a Gaussian is cloned or split.
        gradient: f32,
        /// Logarithm of the largest scale that is cloned, not split.
        log_small: f32,
        /// Logarithm of the scale above which a Gaussian is pruned.
        log_large: f32,
        /// Opacity logit below which a Gaussian is pruned.
        prune_logit: f32,
    },
    args: DecideArgs {
        /// Sum of gradient norms and number of views of each Gaussian.
        statistics: Read<f32>,
        /// Opacity logits.
        opacity_logits: Read<f32>,
        /// Log-scales.
        log_scales: ReadVec3<f32>,
        /// 0 prune, 1 keep, 2 clone, 3 split.
        actions: Write<u32>,
        /// 1 for a survivor, else 0.
        kept: Write<u32>,
        /// 1 for a Gaussian that would add a row, else 0.
        added: Write<u32>,
    }
}

kernel! {
    /// Lays out the rows of the new arrays.
    pub struct Layout("density/layout"), workgroup: [64, 1, 1],
    params: LayoutParams {
        /// Number of Gaussians.
        count: u32,
        /// Capacity of the arrays, rows.
        capacity: u32,
    },
    args: LayoutArgs {
        /// As [`Decide`] writes them.
        actions: Read<u32>,
        /// Exclusive prefix sums of the survivors.
        kept_prefix: Read<u32>,
        /// Exclusive prefix sums of the added rows.
        added_prefix: Read<u32>,
        /// Survivors; candidates to add; receives the final number of rows.
        totals: ReadWrite<u32>,
        /// Source row, and in the two upper bits 0 for a survivor, 1 for a copy, 2 for a part.
        source_from_row: Write<u32>,
    }
}

kernel! {
    /// Copies an array into the new order.
    pub struct Gather("density/gather"), workgroup: [64, 1, 1],
    params: GatherParams {
        /// Number of values in a row.
        width: u32,
        /// Whether rows that do not belong to a survivor become zero.
        fresh_zero: u32,
    },
    args: GatherArgs {
        /// As [`Layout`] leaves them.
        totals: Read<u32>,
        /// The source of each new row, as [`Layout`] writes it.
        source_from_row: Read<u32>,
        /// The old array.
        values: Read<f32>,
        /// The new array.
        gathered: Write<f32>,
    }
}

kernel! {
    /// Draws centres and scales of the parts of split Gaussians.
    pub struct Parts("density/parts"), workgroup: [64, 1, 1],
    params: PartsParams {
        /// Seed of the random numbers.
        seed: u32,
        /// Step, a part of the random numbers' counter.
        step_number: u32,
        /// Logarithm of the factor by which parts are smaller.
        log_shrink: f32,
    },
    args: PartsArgs {
        /// As [`Layout`] leaves them.
        totals: Read<u32>,
        /// The source of each new row, as [`Layout`] writes it.
        source_from_row: Read<u32>,
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
        /// Number of Gaussians.
        count: u32,
        /// Half the image's width, pixels.
        half_width: f32,
        /// Half the image's height, pixels.
        half_height: f32,
    },
    args: AccumulateArgs {
        /// Gradients with respect to mean x, mean y (pixels), depth and opacity.
        mean_gradients: Read<[f32; 4]>,
        /// Not 0 for a Gaussian that is visible in the view.
        visible: Read<u32>,
        /// 0 where the view's intersections did not all fit; nothing is added then.
        fits: Read<u32>,
        /// Sum of gradient norms and number of views of each Gaussian; accumulated.
        statistics: ReadWrite<f32>,
    }
}

kernel! {
    /// Resets opacities.
    pub struct Reset("density/reset"), workgroup: [64, 1, 1],
    params: ResetParams {
        /// Number of Gaussians.
        count: u32,
        /// Upper limit of the logits.
        limit: f32,
    },
    args: ResetArgs {
        /// Opacity logits.
        opacity_logits: ReadWrite<f32>,
    }
}

kernel! {
    /// Adds the gradients of the opacity and scale regularisers.
    pub struct Regularise("density/regularise"), workgroup: [64, 1, 1],
    params: RegulariseParams {
        /// Number of Gaussians.
        count: u32,
        /// Weight of the mean opacity, divided by the number of Gaussians.
        opacity_factor: f32,
        /// Weight of the mean scale, divided by the number of scales.
        scale_factor: f32,
    },
    args: RegulariseArgs {
        /// 1 per Gaussian.
        opacity_logits: Read<f32>,
        /// 3 per Gaussian.
        log_scales: ReadVec3<f32>,
        /// Gradients with respect to the opacity logits; accumulated.
        opacity_gradients: ReadWrite<f32>,
        /// Gradients with respect to the log-scales; accumulated.
        log_scale_gradients: ReadWriteVec3<f32>,
    }
}

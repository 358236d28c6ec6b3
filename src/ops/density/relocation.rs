//! MCMC density control: dead Gaussians move onto live ones, and new ones are added as copies of live
//! ones.

use super::{DEAD_OPACITY, WORKGROUP, equal, logit};
use crate::error::{Error, Result};
use crate::gpu::{Buffer, Device, Groups, Recorder, View, ViewMut};
use crate::kernels::density as kernels;
use crate::ops::scan::{Scan, ScanArgs, ScanScratch};
use crate::types::MotionClass;

/// Relocation and growth of Gaussians, up to a fixed capacity.
///
/// [`relocate`](Self::relocate) or [`grow`](Self::grow) draws targets and changes their opacity and
/// scale. Afterwards, call [`copy`](Self::copy) for every other parameter array, and
/// [`zero`](Self::zero) for every array of optimiser moments.
///
/// ```no_run
/// use splat4d::gpu::{Device, Recorder};
/// use splat4d::ops::density::{Relocation, RelocationArgs};
/// use splat4d::ops::gaussians::GaussianBuffers;
/// use splat4d::types::MotionClass;
/// # fn round(
/// #     device: &Device, recorder: &mut Recorder, gaussians: &mut GaussianBuffers,
/// # ) -> splat4d::Result<()> {
/// let n = gaussians.len;
/// let mut relocation = Relocation::new(device, gaussians.capacity())?;
/// let args = RelocationArgs {
///     opacity_logits: gaussians.opacity_logits.range_mut(0..n),
///     log_scales: gaussians.log_scales.range_mut(0..3 * n),
///     motion_logits: None,
///     class: MotionClass::Any,
///     seed: 7,
///     step: 1,
/// };
/// relocation.relocate(recorder, args)?;
/// // Copy every other parameter array likewise.
/// relocation.copy(recorder, gaussians.positions.range_mut(0..3 * n), 3)?;
/// # Ok(())
/// # }
/// ```
pub struct Relocation {
    capacity: usize,
    /// Number of rows after the last round.
    rows: usize,
    /// Upper bound of the number of slots of the last round.
    most_slots: usize,
    scan: Scan,
    scratch: ScanScratch,
    count: Buffer<u32>,
    weights: Buffer<u32>,
    dead: Buffer<u32>,
    weight_prefix: Buffer<u32>,
    dead_prefix: Buffer<u32>,
    totals: Buffer<u32>,
    row_from_slot: Buffer<u32>,
    target_from_slot: Buffer<u32>,
    drawn: Buffer<u32>,
    touched: Buffer<u32>,
}

/// Inputs of one round.
pub struct RelocationArgs<'a> {
    /// Opacity logits of the present Gaussians; changed in place.
    pub opacity_logits: ViewMut<'a, f32>,
    /// Log-scales, three values each; changed in place.
    pub log_scales: ViewMut<'a, f32>,
    /// Motion logits, where the scene has any.
    pub motion_logits: Option<View<'a, f32>>,
    /// The Gaussians that take part. A round for static ones and another for dynamic ones keep the dead
    /// in their class.
    pub class: MotionClass,
    /// Seed of the draw.
    pub seed: u32,
    /// Number of the round or step; each number gives different draws.
    pub step: u32,
}

impl Relocation {
    /// Allocates for up to `capacity` Gaussians.
    ///
    /// # Errors
    /// [`Error::OutOfMemory`].
    pub fn new(device: &Device, capacity: usize) -> Result<Relocation> {
        let scan = Scan::plan(device, capacity)?;
        let words = |label: &str| device.buffer::<u32>(label, capacity);
        Ok(Relocation {
            capacity,
            rows: 0,
            most_slots: 0,
            scratch: scan.scratch(device)?,
            scan,
            count: device.buffer("relocation count", 1)?,
            weights: words("relocation weights")?,
            dead: words("relocation dead")?,
            weight_prefix: words("relocation weight sums")?,
            dead_prefix: words("relocation dead sums")?,
            totals: device.buffer("relocation totals", 2)?,
            row_from_slot: words("relocation slots")?,
            target_from_slot: words("relocation targets")?,
            drawn: words("relocation draws")?,
            touched: words("relocation touched")?,
        })
    }

    /// Records a round in which every dead Gaussian of the class becomes a copy of a live one, drawn
    /// with probability proportional to opacity: `density/weigh`, two scans, `density/slots`,
    /// `density/draw`, `density/shrink`. Where none is alive, the dead do not change.
    ///
    /// # Errors
    /// [`Error::Shape`] where the lengths disagree or there are more than planned.
    pub fn relocate(&mut self, recorder: &mut Recorder, args: RelocationArgs<'_>) -> Result<()> {
        self.round(recorder, args, 0)
    }

    /// Records a round that appends `added` Gaussians, each a copy of a live one drawn by opacity (of
    /// the first one where none is alive). Every parameter array must have capacity for them.
    ///
    /// # Errors
    /// [`Error::Shape`] where the lengths disagree or the result exceeds the capacity; [`Error::Input`]
    /// without a Gaussian to copy.
    pub fn grow(
        &mut self,
        recorder: &mut Recorder,
        args: RelocationArgs<'_>,
        added: usize,
    ) -> Result<()> {
        if added == 0 {
            (self.rows, self.most_slots) = (args.opacity_logits.len(), 0);
            return Ok(());
        }
        if args.opacity_logits.is_empty() {
            return Err(Error::Input("density control: no Gaussian to grow from".into()));
        }
        self.round(recorder, args, added)
    }

    fn round(
        &mut self,
        recorder: &mut Recorder,
        mut args: RelocationArgs<'_>,
        grown: usize,
    ) -> Result<()> {
        let count = args.opacity_logits.len();
        equal("log_scales", 3 * count, args.log_scales.len())?;
        if let Some(motion) = args.motion_logits {
            equal("motion_logits", count, motion.len())?;
        }
        if count + grown > self.capacity {
            let expected = format!("at most {}", self.capacity);
            let (arg, actual) = ("Gaussians", count + grown);
            return Err(Error::Shape { op: "density control", arg, expected, actual });
        }
        self.rows = count + grown;
        self.most_slots = if grown > 0 { grown } else { count };
        self.weigh(recorder, &args)?;
        if grown > 0 {
            recorder.update(self.totals.range_mut(1..2), &[grown as u32])?;
        }
        self.draw(recorder, &args, grown)?;
        recorder.dispatch::<kernels::Shrink>(
            Groups::linear(count, WORKGROUP, recorder.device().limits())?,
            kernels::ShrinkParams { count: count as u32, dead_logit: logit(DEAD_OPACITY) },
            kernels::ShrinkArgs {
                drawn: self.drawn.view(),
                opacity_logits: args.opacity_logits.reborrow(),
                log_scales: args.log_scales.reborrow(),
            },
        )
    }

    /// Records the weights and the dead Gaussians with their sums.
    fn weigh(&mut self, recorder: &mut Recorder, args: &RelocationArgs<'_>) -> Result<()> {
        let count = args.opacity_logits.len();
        recorder.update(self.count.view_mut(), &[count as u32])?;
        let logits = args.opacity_logits.as_view();
        recorder.dispatch::<kernels::Weigh>(
            Groups::linear(count, WORKGROUP, recorder.device().limits())?,
            kernels::WeighParams {
                count: count as u32,
                motion_class: args.class as u32,
                has_motion: u32::from(args.motion_logits.is_some()),
                largest: MotionClass::largest_weight(count),
                dead_logit: logit(DEAD_OPACITY),
            },
            kernels::WeighArgs {
                opacity_logits: logits,
                // A placeholder that is bound but not read in a scene without motion.
                motion_logits: args.motion_logits.unwrap_or(logits),
                weights: self.weights.view_mut(),
                dead: self.dead.view_mut(),
            },
        )?;
        for (values, prefix, total_at) in
            [(&self.weights, &mut self.weight_prefix, 0), (&self.dead, &mut self.dead_prefix, 1)]
        {
            let args = ScanArgs {
                count: self.count.view(),
                count_at: 0,
                values: values.view(),
                prefix: prefix.view_mut(),
                total: self.totals.view_mut(),
                total_at,
            };
            self.scan.record(recorder, args, &mut self.scratch)?;
        }
        Ok(())
    }

    /// Records the list of slots, and the draw of a target for each.
    fn draw(
        &mut self,
        recorder: &mut Recorder,
        args: &RelocationArgs<'_>,
        grown: usize,
    ) -> Result<()> {
        let count = args.opacity_logits.len();
        let limits = *recorder.device().limits();
        let over = |items: usize| Groups::linear(items, WORKGROUP, &limits);
        recorder.fill(self.drawn.view_mut(), 0);
        recorder.fill(self.touched.view_mut(), 0);
        recorder.dispatch::<kernels::Slots>(
            over(count.max(grown))?,
            kernels::SlotsParams { count: count as u32, grown: grown as u32 },
            kernels::SlotsArgs {
                dead: self.dead.view(),
                dead_prefix: self.dead_prefix.view(),
                row_from_slot: self.row_from_slot.view_mut(),
            },
        )?;
        recorder.dispatch::<kernels::Draw>(
            over(self.most_slots)?,
            kernels::DrawParams {
                count: count as u32,
                grown: grown as u32,
                seed: args.seed,
                step_number: args.step,
            },
            kernels::DrawArgs {
                weight_prefix: self.weight_prefix.view(),
                totals: self.totals.view(),
                row_from_slot: self.row_from_slot.view(),
                target_from_slot: self.target_from_slot.view_mut(),
                drawn: self.drawn.view_mut(),
                touched: self.touched.view_mut(),
            },
        )
    }

    /// Records the copies in one parameter array of rows of `width` values: each slot becomes a copy of
    /// its target. After growth the array must hold the new rows too.
    ///
    /// # Errors
    /// [`Error::Shape`] when the array has fewer rows than the round leaves.
    pub fn copy(
        &self,
        recorder: &mut Recorder,
        values: ViewMut<'_, f32>,
        width: usize,
    ) -> Result<()> {
        self.enough_rows("parameters", values.len(), width)?;
        if width == 0 {
            return Ok(());
        }
        recorder.dispatch::<kernels::Copy>(
            Groups::linear(self.most_slots * width, WORKGROUP, recorder.device().limits())?,
            kernels::CopyParams { width: width as u32 },
            kernels::CopyArgs {
                totals: self.totals.view(),
                row_from_slot: self.row_from_slot.view(),
                target_from_slot: self.target_from_slot.view(),
                values,
            },
        )
    }

    /// Records the zeroing of one array of optimiser moments, for Gaussians that were drawn or replaced.
    ///
    /// # Errors
    /// [`Error::Shape`] when the array has fewer rows than the round leaves.
    pub fn zero(
        &self,
        recorder: &mut Recorder,
        values: ViewMut<'_, f32>,
        width: usize,
    ) -> Result<()> {
        self.enough_rows("moments", values.len(), width)?;
        if width == 0 || self.most_slots == 0 {
            return Ok(());
        }
        recorder.dispatch::<kernels::Zero>(
            Groups::linear(self.rows * width, WORKGROUP, recorder.device().limits())?,
            kernels::ZeroParams { count: self.rows as u32, width: width as u32 },
            kernels::ZeroArgs { touched: self.touched.view(), values },
        )
    }

    fn enough_rows(&self, arg: &'static str, actual: usize, width: usize) -> Result<()> {
        super::super::at_least("density control", &[(arg, self.rows * width, actual)])
    }

    /// The weights of the last draw.
    pub fn weights(&self) -> View<'_, u32> {
        self.weights.view()
    }

    /// The sum of the last draw's weights, and the number of its slots.
    pub fn totals(&self) -> View<'_, u32> {
        self.totals.view()
    }

    /// The row that each slot of the last round fills; [`totals`](Self::totals) gives their number.
    pub fn row_from_slot(&self) -> View<'_, u32> {
        self.row_from_slot.view()
    }

    /// The row that each slot copies; `u32::MAX` where the slot does not change.
    pub fn target_from_slot(&self) -> View<'_, u32> {
        self.target_from_slot.view()
    }
}

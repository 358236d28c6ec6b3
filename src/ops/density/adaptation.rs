//! Adaptive density control: clone, split, prune, compact.

use super::{WORKGROUP, equal, logit};
use crate::error::{Error, Result};
use crate::gpu::{Buffer, Device, Groups, Recorder, View, ViewMut};
use crate::kernels::density as kernels;
use crate::ops::scan::{Scan, ScanArgs, ScanScratch};
use crate::types::AdaptSettings;

/// Adaptive density control of Gaussians, up to a fixed capacity.
///
/// [`plan`](Self::plan) decides what happens to each Gaussian and lays out the new rows. Then
/// [`gather`](Self::gather) copies every array into the new order (into another array), and
/// [`draw_parts`](Self::draw_parts) draws the parts of split Gaussians. The third word of
/// [`totals`](Self::totals) is the final number of rows.
///
/// ```no_run
/// use splat4d::gpu::{Buffer, Device, Recorder};
/// use splat4d::ops::density::{Adaptation, AdaptationArgs};
/// use splat4d::ops::gaussians::GaussianBuffers;
/// use splat4d::types::AdaptSettings;
/// # fn round(
/// #     device: &Device, recorder: &mut Recorder, gaussians: &mut GaussianBuffers,
/// #     fresh: &mut GaussianBuffers, statistics: &Buffer<f32>,
/// # ) -> splat4d::Result<()> {
/// let settings = AdaptSettings::default();
/// let n = gaussians.len;
/// let mut adaptation = Adaptation::new(device, gaussians.capacity())?;
/// let args = AdaptationArgs {
///     statistics: statistics.range(0..2 * n),
///     opacity_logits: gaussians.opacity_logits.range(0..n),
///     log_scales: gaussians.log_scales.range(0..3 * n),
/// };
/// adaptation.plan(recorder, &settings, args)?;
/// // Gather every other array likewise; `totals` gives the new number of Gaussians.
/// let (from, to) = (gaussians.positions.view(), fresh.positions.view_mut());
/// adaptation.gather(recorder, from, to, 3, false)?;
/// # Ok(())
/// # }
/// ```
pub struct Adaptation {
    capacity: usize,
    /// Upper bound of the number of rows after the last plan.
    most_rows: usize,
    scan: Scan,
    scratch: ScanScratch,
    count: Buffer<u32>,
    actions: Buffer<u32>,
    kept: Buffer<u32>,
    added: Buffer<u32>,
    kept_prefix: Buffer<u32>,
    added_prefix: Buffer<u32>,
    totals: Buffer<u32>,
    source_from_row: Buffer<u32>,
}

/// Inputs of the decision.
pub struct AdaptationArgs<'a> {
    /// Sum of screen-space gradient norms and number of views, of each Gaussian.
    pub statistics: View<'a, f32>,
    /// Opacity logits.
    pub opacity_logits: View<'a, f32>,
    /// Log-scales, three values each.
    pub log_scales: View<'a, f32>,
}

impl Adaptation {
    /// Allocates for up to `capacity` Gaussians, before and after a round.
    ///
    /// # Errors
    /// [`Error::Input`] beyond 2³⁰ − 1; [`Error::OutOfMemory`].
    pub fn new(device: &Device, capacity: usize) -> Result<Adaptation> {
        if capacity >= 1 << 30 {
            return Err(Error::Input(format!("adaptive control of {capacity}: at most 2³⁰ − 1")));
        }
        let scan = Scan::plan(device, capacity)?;
        let words = |label: &str| device.buffer::<u32>(label, capacity);
        Ok(Adaptation {
            capacity,
            most_rows: 0,
            scratch: scan.scratch(device)?,
            scan,
            count: device.buffer("adaptation count", 1)?,
            actions: words("adaptation actions")?,
            kept: words("adaptation survivors")?,
            added: words("adaptation added")?,
            kept_prefix: words("adaptation survivor sums")?,
            added_prefix: words("adaptation added sums")?,
            totals: device.buffer("adaptation totals", 3)?,
            source_from_row: words("adaptation rows")?,
        })
    }

    /// Records the decision and the layout of the new rows: survivors in order, then added rows, as far
    /// as the capacity allows. A Gaussian whose second part does not fit is not split. Dispatches:
    /// `density/decide`, two scans, `density/layout`.
    ///
    /// # Errors
    /// [`Error::Shape`] where the lengths disagree or there are more than planned.
    pub fn plan(
        &mut self,
        recorder: &mut Recorder,
        settings: &AdaptSettings,
        args: AdaptationArgs<'_>,
    ) -> Result<()> {
        let count = args.opacity_logits.len();
        equal("statistics", 2 * count, args.statistics.len())?;
        equal("log_scales", 3 * count, args.log_scales.len())?;
        if count > self.capacity {
            let expected = format!("at most {}", self.capacity);
            let (arg, actual) = ("Gaussians", count);
            return Err(Error::Shape { op: "density control", arg, expected, actual });
        }
        self.most_rows = (2 * count).min(self.capacity);
        let limits = *recorder.device().limits();
        recorder.update(self.count.view_mut(), &[count as u32])?;
        recorder.dispatch::<kernels::Decide>(
            Groups::linear(count, WORKGROUP, &limits)?,
            kernels::DecideParams {
                count: count as u32,
                gradient: settings.gradient as f32,
                log_small: settings.small.ln() as f32,
                log_large: settings.large.ln() as f32,
                prune_logit: logit(settings.opacity),
            },
            kernels::DecideArgs {
                statistics: args.statistics,
                opacity_logits: args.opacity_logits,
                log_scales: args.log_scales,
                actions: self.actions.view_mut(),
                kept: self.kept.view_mut(),
                added: self.added.view_mut(),
            },
        )?;
        recorder.fill(self.totals.view_mut(), 0);
        for (values, prefix, total_at) in
            [(&self.kept, &mut self.kept_prefix, 0), (&self.added, &mut self.added_prefix, 1)]
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
        recorder.dispatch::<kernels::Layout>(
            Groups::linear(count, WORKGROUP, &limits)?,
            kernels::LayoutParams { count: count as u32, capacity: self.capacity as u32 },
            kernels::LayoutArgs {
                actions: self.actions.view(),
                kept_prefix: self.kept_prefix.view(),
                added_prefix: self.added_prefix.view(),
                totals: self.totals.view_mut(),
                source_from_row: self.source_from_row.view_mut(),
            },
        )
    }

    /// Records the copy of one array of rows of `width` values into the new order. With `moments`, rows
    /// that do not belong to a survivor become zero.
    ///
    /// # Errors
    /// [`Error::Shape`] when `gathered` is too short for the rows that the plan may produce.
    pub fn gather(
        &self,
        recorder: &mut Recorder,
        values: View<'_, f32>,
        gathered: ViewMut<'_, f32>,
        width: usize,
        moments: bool,
    ) -> Result<()> {
        if width == 0 {
            return Ok(());
        }
        let needed = self.most_rows * width;
        super::super::at_least("density control", &[("gathered", needed, gathered.len())])?;
        recorder.dispatch::<kernels::Gather>(
            Groups::linear(needed, WORKGROUP, recorder.device().limits())?,
            kernels::GatherParams { width: width as u32, fresh_zero: u32::from(moments) },
            kernels::GatherArgs {
                totals: self.totals.view(),
                source_from_row: self.source_from_row.view(),
                values,
                gathered,
            },
        )
    }

    /// Records the drawing of the parts of split Gaussians, in the gathered arrays.
    ///
    /// # Errors
    /// [`Error::Shape`] when an array is too short for the rows that the plan may produce.
    pub fn draw_parts(
        &self,
        recorder: &mut Recorder,
        positions: ViewMut<'_, f32>,
        log_scales: ViewMut<'_, f32>,
        rotations: View<'_, [f32; 4]>,
        seed: u32,
        step: u32,
    ) -> Result<()> {
        let rows = self.most_rows;
        let shapes = [
            ("positions", 3 * rows, positions.len()),
            ("log_scales", 3 * rows, log_scales.len()),
            ("rotations", rows, rotations.len()),
        ];
        super::super::at_least("density control", &shapes)?;
        recorder.dispatch::<kernels::Parts>(
            Groups::linear(rows, WORKGROUP, recorder.device().limits())?,
            kernels::PartsParams {
                seed,
                step_number: step,
                log_shrink: AdaptSettings::SPLIT_SHRINK.ln() as f32,
            },
            kernels::PartsArgs {
                totals: self.totals.view(),
                source_from_row: self.source_from_row.view(),
                rotations,
                positions,
                log_scales,
            },
        )
    }

    /// Three words: survivors, candidates to add, and the final number of rows.
    pub fn totals(&self) -> View<'_, u32> {
        self.totals.view()
    }

    /// For each new row the index of its source row, and in the two upper bits 0 for a survivor, 1 for a
    /// copy, 2 for a part of a split Gaussian.
    pub fn source_from_row(&self) -> View<'_, u32> {
        self.source_from_row.view()
    }
}

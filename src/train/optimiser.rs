//! Adam over the Gaussians' parameter groups.

use super::settings::TrainSettings;
use crate::gpu::{Buffer, Device, Recorder, Stream, View, ViewMut};
use crate::ops::adam::{Adam, AdamArgs, gate};
use crate::ops::gaussians::{GaussianBuffers, SH_BAND};
use crate::types::{AdamSettings, Gaussians};
use crate::{Error, Result};

/// A step of the schedule.
pub struct GaussianStep<'a> {
    /// The settings of training.
    pub settings: &'a TrainSettings,
    /// Number of the step, from 0.
    pub step: u32,
    /// The unit of the positions' learning rate, world units.
    pub extent: f64,
    /// On the device: 0 where nothing is to change.
    pub fits: View<'a, u32>,
}

/// The optimiser's state for a set of Gaussians.
pub struct GaussianOptimiser {
    adam: Adam,
    /// First moments.
    pub(crate) first: GaussianBuffers,
    /// Second moments.
    pub(crate) second: GaussianBuffers,
    /// 1 for each Gaussian that is trained, else 0.
    pub(crate) trainable: Buffer<u32>,
    gate: Buffer<u32>,
}

impl GaussianOptimiser {
    /// Allocates for up to `capacity` Gaussians, all trainable, with zero moments.
    ///
    /// # Errors
    /// [`Error::OutOfMemory`], or a failed submission.
    pub fn new(stream: &mut Stream, capacity: usize, sh_degree: u32) -> Result<GaussianOptimiser> {
        let device: Device = stream.device().clone();
        let mut optimiser = GaussianOptimiser {
            adam: Adam::new(&device)?,
            first: GaussianBuffers::new(&device, capacity, sh_degree)?,
            second: GaussianBuffers::new(&device, capacity, sh_degree)?,
            trainable: device.buffer("trainable", capacity)?,
            gate: device.buffer("gate", capacity)?,
        };
        let mut recorder = stream.record()?;
        for moments in [&mut optimiser.first, &mut optimiser.second] {
            for buffer in
                [&mut moments.positions, &mut moments.log_scales, &mut moments.opacity_logits]
            {
                recorder.fill(buffer.view_mut(), 0);
            }
            recorder.fill(moments.rotations.view_mut(), 0);
            for band in &mut moments.sh {
                recorder.fill(band.view_mut(), 0);
            }
        }
        recorder.fill(optimiser.trainable.view_mut(), 1);
        stream.submit(recorder)?;
        Ok(optimiser)
    }

    /// Waits and reads first and second moments of the first `count` Gaussians.
    pub(super) fn moments(&mut self, stream: &mut Stream, count: usize) -> Result<[Gaussians; 2]> {
        let mut read = |moments: &mut GaussianBuffers| {
            moments.len = count;
            moments.download(stream)
        };
        Ok([read(&mut self.first)?, read(&mut self.second)?])
    }

    /// Waits, and counts the gradients that were not finite and were skipped.
    pub(super) fn broken(&self, stream: &mut Stream) -> Result<u64> {
        self.adam.broken(stream)
    }

    /// Restores first and second moments.
    pub(super) fn set_moments(
        &mut self,
        stream: &mut Stream,
        moments: &[Gaussians; 2],
    ) -> Result<()> {
        self.first.upload(stream, &moments[0])?;
        self.second.upload(stream, &moments[1])
    }

    /// Records the update of the Gaussians by their gradients. Bands above the step's degree do not
    /// change.
    ///
    /// # Errors
    /// [`Error::Shape`] when the Gaussians exceed the capacity; else as for [`Recorder::dispatch`].
    pub fn record(
        &mut self,
        recorder: &mut Recorder,
        GaussianStep { settings, step, extent, fits }: GaussianStep<'_>,
        gaussians: &mut GaussianBuffers,
        gradients: &GaussianBuffers,
    ) -> Result<()> {
        let n = gaussians.len;
        if n > self.gate.len() {
            let expected = format!("at most {}", self.gate.len());
            return Err(Error::Shape { op: "optimiser", arg: "gaussians", expected, actual: n });
        }
        gate(recorder, fits, self.trainable.range(0..n), self.gate.range_mut(0..n))?;
        let rates = settings.rates;
        let GaussianOptimiser { adam, first, second, gate, .. } = self;
        let mut group = |row: usize,
                         rate: f64,
                         parameters: ViewMut<'_, f32>,
                         gradients: View<'_, f32>,
                         first: ViewMut<'_, f32>,
                         second: ViewMut<'_, f32>| {
            if rate == 0.0 || row == 0 {
                return Ok(());
            }
            let settings = AdamSettings { rate, step: step + 1, ..AdamSettings::default() };
            let visible = Some((row, gate.range(0..n)));
            let args = AdamArgs { gradients, parameters, first, second, visible };
            adam.record(recorder, &settings, args)
        };
        group(
            3,
            settings.position_rate_at(step) * extent,
            gaussians.positions.range_mut(0..3 * n),
            gradients.positions.range(0..3 * n),
            first.positions.range_mut(0..3 * n),
            second.positions.range_mut(0..3 * n),
        )?;
        group(
            3,
            rates.log_scale,
            gaussians.log_scales.range_mut(0..3 * n),
            gradients.log_scales.range(0..3 * n),
            first.log_scales.range_mut(0..3 * n),
            second.log_scales.range_mut(0..3 * n),
        )?;
        group(
            4,
            rates.rotation,
            gaussians.rotations.range_mut(0..n).floats(),
            gradients.rotations.range(0..n).floats(),
            first.rotations.range_mut(0..n).floats(),
            second.rotations.range_mut(0..n).floats(),
        )?;
        group(
            1,
            rates.opacity,
            gaussians.opacity_logits.range_mut(0..n),
            gradients.opacity_logits.range(0..n),
            first.opacity_logits.range_mut(0..n),
            second.opacity_logits.range_mut(0..n),
        )?;
        for band in 0..=settings.sh_degree_at(step) as usize {
            let row = SH_BAND[band];
            group(
                row,
                if band == 0 { rates.sh0 } else { rates.sh_rest },
                gaussians.sh[band].range_mut(0..row * n),
                gradients.sh[band].range(0..row * n),
                first.sh[band].range_mut(0..row * n),
                second.sh[band].range_mut(0..row * n),
            )?;
        }
        Ok(())
    }
}

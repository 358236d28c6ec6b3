//! Selection of the dynamic Gaussians: their motion logits, and the training of these.
//!
//! At first motion is soft: the motion of every Gaussian whose logit is not clearly static is weighted
//! by its probability of motion, so that the images determine it. Every few steps the rendered
//! probabilities are compared with the motion masks, and L_rigid penalises the displacement of Gaussians
//! that the masks show to be static. After that the selection is fixed: each Gaussian moves fully or not
//! at all, as in rendering, for the rest of the training.

use super::settings::{SelectionSettings, exponential};
use crate::Result;
use crate::gpu::{Buffer, Recorder, Stream, View, ViewMut};
use crate::ops::adam::{Adam, AdamArgs};
use crate::ops::deform::SoftMotion;
use crate::ops::mask::{self, VoteArgs};
use crate::ops::motion::SoftGradients;
use crate::ops::render::{Frame, FrameGradients, PixelGradientViews, PixelViews};
use crate::types::AdamSettings;
#[cfg(feature = "files")]
use serde::{Deserialize, Serialize};

/// The motion logits of a scene's Gaussians.
pub(super) struct Selection {
    logits: Buffer<f32>,
    training: Option<Training>,
}

/// State of the logits' training.
struct Training {
    settings: SelectionSettings,
    adam: Adam,
    gradients: Buffer<f32>,
    first: Buffer<f32>,
    second: Buffer<f32>,
    /// Evidence from the masks for each Gaussian: votes for motion, and all votes.
    votes: Buffer<f32>,
    /// Votes for motion divided by all votes; 1 before the first vote.
    evidence: Buffer<f32>,
    colours: Buffer<[f32; 4]>,
}

/// Saved state of the motion logits' training: moments, votes, evidence.
#[derive(Clone, Debug, PartialEq)]
#[cfg_attr(feature = "files", derive(Serialize, Deserialize))]
pub struct SelectionState {
    moments: [Vec<f32>; 2],
    votes: Vec<f32>,
    evidence: Vec<f32>,
}

impl Selection {
    /// Allocates for up to `capacity` Gaussians and uploads the logits of the present ones. The logits
    /// are trained if there are settings.
    pub(super) fn new(
        stream: &mut Stream,
        logits: &[f32],
        capacity: usize,
        settings: Option<SelectionSettings>,
    ) -> Result<Selection> {
        let device = stream.device().clone();
        let mut buffer = device.buffer("motion logits", capacity)?;
        stream.upload(&mut buffer, logits)?;
        let training = match settings {
            None => None,
            Some(settings) => {
                let mut recorder = stream.record()?;
                let mut filled = |label: &str, len: usize, value: f32| -> Result<Buffer<f32>> {
                    let mut buffer = device.buffer(label, len)?;
                    recorder.fill(buffer.view_mut(), value.to_bits());
                    Ok(buffer)
                };
                let training = Training {
                    settings,
                    adam: Adam::new(&device)?,
                    gradients: filled("motion logit gradients", capacity, 0.0)?,
                    first: filled("motion logit first moments", capacity, 0.0)?,
                    second: filled("motion logit second moments", capacity, 0.0)?,
                    votes: filled("votes for motion", 2 * capacity, 0.0)?,
                    evidence: filled("evidence of motion", capacity, 1.0)?,
                    colours: device.buffer("painted motion", capacity)?,
                };
                stream.submit(recorder)?;
                Some(training)
            }
        };
        Ok(Selection { logits: buffer, training })
    }

    /// The logits of the first `count` Gaussians.
    pub(super) fn logits(&self, count: usize) -> View<'_, f32> {
        self.logits.range(0..count)
    }

    /// Waits and reads the logits of the first `count` Gaussians.
    pub(super) fn download(&self, stream: &mut Stream, count: usize) -> Result<Vec<f32>> {
        let mut logits = stream.download(&self.logits)?;
        logits.truncate(count);
        Ok(logits)
    }

    /// Waits and reads the state of the first `count` Gaussians, without their logits; `None` where the
    /// logits are not trained.
    pub(super) fn state(
        &self,
        stream: &mut Stream,
        count: usize,
    ) -> Result<Option<SelectionState>> {
        let Some(training) = &self.training else { return Ok(None) };
        let mut read = |buffer: &Buffer<f32>, len: usize| -> Result<Vec<f32>> {
            let mut values = stream.download(buffer)?;
            values.truncate(len);
            Ok(values)
        };
        Ok(Some(SelectionState {
            moments: [read(&training.first, count)?, read(&training.second, count)?],
            votes: read(&training.votes, 2 * count)?,
            evidence: read(&training.evidence, count)?,
        }))
    }

    /// Restores a saved state.
    pub(super) fn set_state(&mut self, stream: &mut Stream, state: &SelectionState) -> Result<()> {
        let Some(training) = &mut self.training else { return Ok(()) };
        stream.upload(&mut training.first, &state.moments[0])?;
        stream.upload(&mut training.second, &state.moments[1])?;
        stream.upload(&mut training.votes, &state.votes)?;
        stream.upload(&mut training.evidence, &state.evidence)
    }

    /// The training state, while motion is soft.
    fn soft_at(&self, step: u32, steps: u32) -> Option<&Training> {
        self.training.as_ref().filter(|t| step < t.settings.steps_of(steps))
    }

    /// Whether motion is soft in step `step` (from 0) of `steps`.
    pub(super) fn is_soft(&self, step: u32, steps: u32) -> bool {
        self.soft_at(step, steps).is_some()
    }

    /// The logit above which a Gaussian is dynamic.
    pub(super) fn least(&self, step: u32, steps: u32) -> f32 {
        self.soft_at(step, steps).map_or(0.0, |t| t.settings.least_logit)
    }

    /// Soft motion of the first `count` Gaussians in a step; `None` where the listed ones move fully.
    pub(super) fn soft(&self, count: usize, step: u32, steps: u32) -> Option<SoftMotion<'_>> {
        let training = self.soft_at(step, steps)?;
        let evidence = training.evidence.range(0..count);
        Some(SoftMotion { logits: self.logits(count), evidence })
    }

    /// The gradients for [`soft`](Self::soft), zeroed; `listed` is the number of dynamic Gaussians.
    pub(super) fn soft_gradients(
        &mut self,
        recorder: &mut Recorder,
        count: usize,
        listed: usize,
        step: u32,
        steps: u32,
    ) -> Option<SoftGradients<'_>> {
        if !self.is_soft(step, steps) {
            return None;
        }
        let Selection { logits, training } = self;
        let training = training.as_mut()?;
        recorder.fill(training.gradients.view_mut(), 0);
        Some(SoftGradients {
            soft: SoftMotion {
                logits: logits.range(0..count),
                evidence: training.evidence.range(0..count),
            },
            logits: training.gradients.range_mut(0..count),
            rigid_scale: (training.settings.rigid_weight / listed.max(1) as f64) as f32,
        })
    }

    /// Whether [`differentiate`](Self::differentiate) overwrites the step's render with the rendered
    /// probability of motion.
    pub(super) fn repaints(&self, mask: Option<&Buffer<f32>>, step: u32, steps: u32) -> bool {
        let every = self.training.as_ref().map(|training| training.settings.mask_every.max(1));
        let due = every.is_some_and(|every| step.is_multiple_of(every));
        due && mask.is_some() && self.is_soft(step, steps)
    }

    /// Records the gradients of the mask loss of the view that has just been rendered and
    /// differentiated, in steps that have one. They add to those of
    /// [`soft_gradients`](Self::soft_gradients).
    pub(super) fn differentiate(
        &mut self,
        recorder: &mut Recorder,
        frame: &mut Frame<FrameGradients>,
        mask: Option<&Buffer<f32>>,
        count: usize,
        step: u32,
        steps: u32,
    ) -> Result<()> {
        if !self.repaints(mask, step, steps) {
            return Ok(());
        }
        let Selection { logits, training } = self;
        let (Some(training), Some(mask)) = (training, mask) else { return Ok(()) };
        let settings = training.settings;
        let last = settings.steps_of(steps);
        let weight = exponential(settings.mask_weight, settings.mask_weight_last, step, last);
        // The loss occurs in one of several steps and is weighted to count for all of them.
        let weight = weight * f64::from(settings.mask_every.max(1));
        mask::paint(recorder, logits.range(0..count), training.colours.view_mut())?;
        let colours = training.colours.view();
        frame.blend(recorder, Some(colours), PixelViews::default())?;
        let Frame { pixels, gradients, .. } = frame;
        mask::compare(recorder, pixels, mask.view(), weight, &mut gradients.pixels)?;
        let by = PixelGradientViews::default();
        frame.blend_backward(recorder, Some(colours), count, by)?;
        mask::vote(
            recorder,
            VoteArgs {
                colour_gradients: frame.gradients.colours(count),
                visible: frame.visible(),
                fits: frame.fits(),
                motion_logits: logits.range(0..count),
                motion_gradients: training.gradients.range_mut(0..count),
                votes: training.votes.range_mut(0..2 * count),
                evidence: training.evidence.range_mut(0..count),
            },
        )
    }

    /// Records the update of the logits of the first `count` Gaussians, while motion is soft. Nothing
    /// changes where `fits` holds 0.
    pub(super) fn update(
        &mut self,
        recorder: &mut Recorder,
        fits: View<'_, u32>,
        count: usize,
        step: u32,
        steps: u32,
    ) -> Result<()> {
        if !self.is_soft(step, steps) {
            return Ok(());
        }
        let Selection { logits, training } = self;
        let Some(training) = training else { return Ok(()) };
        let rate = training.settings.rate;
        training.adam.record(
            recorder,
            &AdamSettings { rate, step: step + 1, ..AdamSettings::default() },
            AdamArgs {
                gradients: training.gradients.range(0..count),
                parameters: logits.range_mut(0..count),
                first: training.first.range_mut(0..count),
                second: training.second.range_mut(0..count),
                // The array is a single row, so that a frame that did not fit changes nothing.
                visible: Some((count, fits)),
            },
        )
    }

    /// Waits, and counts the gradients that were not finite and were skipped.
    pub(super) fn broken(&self, stream: &mut Stream) -> Result<u64> {
        self.training.as_ref().map_or(Ok(0), |training| training.adam.broken(stream))
    }

    /// Every array with a row for each Gaussian, with its number of floats per row.
    pub(super) fn rows(&mut self) -> Vec<(usize, ViewMut<'_, f32>)> {
        let mut all = vec![(1, self.logits.view_mut())];
        if let Some(training) = &mut self.training {
            all.push((2, training.votes.view_mut()));
            all.push((1, training.evidence.view_mut()));
        }
        all
    }

    /// The optimiser's moments, with their number of floats per row.
    pub(super) fn moments(&mut self) -> Vec<(usize, ViewMut<'_, f32>)> {
        let training = self.training.iter_mut();
        training.flat_map(|t| [(1, t.first.view_mut()), (1, t.second.view_mut())]).collect()
    }

    /// An empty selection of the same capacity and settings, as target of a gather.
    pub(super) fn spare(&self, stream: &mut Stream) -> Result<Selection> {
        let settings = self.training.as_ref().map(|t| t.settings);
        Selection::new(stream, &[], self.logits.len(), settings)
    }
}

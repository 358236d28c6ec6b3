//! How hard the loss pulls at each Gaussian's place in the picture.

use crate::Result;
use crate::gpu::{Buffer, Recorder, Stream, View};
use crate::ops::density;
use crate::ops::render::{BackwardScratch, RenderScratch};

/// Per Gaussian, over the pictures since the last round of density control: the sum of the
/// gradients' norms by the place in the picture, in units of half the picture, and the number of
/// pictures that showed it.
pub(in crate::train) struct Statistics {
    sums: Buffer<f32>,
}

impl Statistics {
    /// For up to `capacity` Gaussians, all zero.
    pub(in crate::train) fn new(stream: &mut Stream, capacity: usize) -> Result<Statistics> {
        let sums = stream.device().buffer("growth statistics", 2 * capacity)?;
        let mut statistics = Statistics { sums };
        statistics.clear(stream)?;
        Ok(statistics)
    }

    /// Begins anew: after a round rows belong to others.
    pub(in crate::train) fn clear(&mut self, stream: &mut Stream) -> Result<()> {
        let mut recorder = stream.record()?;
        recorder.fill(self.sums.view_mut(), 0);
        stream.submit(recorder)?;
        Ok(())
    }

    /// Records what a picture of a size adds, whose backward pass has just been recorded.
    pub(in crate::train) fn add(
        &mut self,
        recorder: &mut Recorder,
        count: usize,
        scratch: &RenderScratch,
        backward: &BackwardScratch,
        size: (u32, u32),
    ) -> Result<()> {
        density::accumulate(
            recorder,
            self.sums.range_mut(0..2 * count),
            backward.mean_gradients(),
            scratch.visible(),
            scratch.fits(),
            [size.0, size.1],
        )
    }

    /// Waits and reads those of the first `count` Gaussians, two values each.
    pub(in crate::train) fn download(&self, stream: &mut Stream, count: usize) -> Result<Vec<f32>> {
        let mut sums = stream.download(&self.sums)?;
        sums.truncate(2 * count);
        Ok(sums)
    }

    /// Puts them back.
    pub(in crate::train) fn restore(&mut self, stream: &mut Stream, sums: &[f32]) -> Result<()> {
        stream.upload(&mut self.sums, sums)
    }

    /// Of the first `count` Gaussians, two values each.
    pub(super) fn of(&self, count: usize) -> View<'_, f32> {
        self.sums.range(0..2 * count)
    }
}

//! Statistics of the gradient of the loss with respect to each Gaussian's image position.

use crate::Result;
use crate::gpu::{Buffer, Recorder, Stream, View};
use crate::ops::density;
use crate::ops::render::{Frame, FrameGradients};

/// For each Gaussian, over the views since the last round of density control: the sum of the norms of
/// the gradient with respect to the image position, in units of half the image, and the number of views
/// in which it was visible.
pub(in crate::train) struct Statistics {
    sums: Buffer<f32>,
}

impl Statistics {
    /// Allocates for up to `capacity` Gaussians, all zero.
    pub(in crate::train) fn new(stream: &mut Stream, capacity: usize) -> Result<Statistics> {
        let sums = stream.device().buffer("growth statistics", 2 * capacity)?;
        let mut statistics = Statistics { sums };
        statistics.clear(stream)?;
        Ok(statistics)
    }

    /// Resets all sums, since after a round the rows belong to other Gaussians.
    pub(in crate::train) fn clear(&mut self, stream: &mut Stream) -> Result<()> {
        let mut recorder = stream.record()?;
        recorder.fill(self.sums.view_mut(), 0);
        stream.submit(recorder)?;
        Ok(())
    }

    /// Records the addition of a view, whose backward pass has just been recorded.
    pub(in crate::train) fn add(
        &mut self,
        recorder: &mut Recorder,
        count: usize,
        frame: &Frame<FrameGradients>,
    ) -> Result<()> {
        density::accumulate(
            recorder,
            self.sums.range_mut(0..2 * count),
            frame.gradients.means(),
            frame.visible(),
            frame.fits(),
            [frame.pixels.width, frame.pixels.height],
        )
    }

    /// Waits and reads the sums of the first `count` Gaussians, two values each.
    pub(in crate::train) fn download(&self, stream: &mut Stream, count: usize) -> Result<Vec<f32>> {
        let mut sums = stream.download(&self.sums)?;
        sums.truncate(2 * count);
        Ok(sums)
    }

    /// Restores the sums.
    pub(in crate::train) fn restore(&mut self, stream: &mut Stream, sums: &[f32]) -> Result<()> {
        stream.upload(&mut self.sums, sums)
    }

    /// The sums of the first `count` Gaussians, two values each.
    pub(super) fn of(&self, count: usize) -> View<'_, f32> {
        self.sums.range(0..2 * count)
    }
}

//! Editing of scenes in device memory.

use super::{Half, Renderer};
use crate::types::Gaussians;
use crate::{Error, Result};
use std::ops::Range;

/// Edits run on the renderer's own stream and wait until they are done. In a frame that is recorded
/// before an edit and submitted after it, each Gaussian may be in its old or its new state.
impl Renderer {
    /// Appends Gaussians and returns their index range. If the capacity is exceeded, the buffers
    /// grow to at least twice their length. In a static scene motion logits are ignored; in a
    /// moving scene, Gaussians without motion logits are static.
    ///
    /// # Errors
    /// [`Error::Shape`] if arrays differ in length, or if the degree of the spherical harmonics
    /// exceeds the scene's; [`Error::OutOfMemory`]; a failed submission.
    pub fn append(&mut self, gaussians: &Gaussians) -> Result<Range<usize>> {
        let (first, end) = (self.len(), self.len() + gaussians.len());
        self.check_logits(gaussians)?;
        if end > self.gaussians.capacity() {
            let capacity = end.max(2 * self.gaussians.capacity());
            self.gaussians.reserve(&mut self.stream, capacity)?;
            self.resources = None;
        }
        self.gaussians.upload_at(&mut self.stream, first, gaussians)?;
        self.gaussians.len = end;
        self.revise(first, gaussians)?;
        Ok(first..end)
    }

    /// Replaces the Gaussians from index `first` on.
    ///
    /// # Errors
    /// [`Error::Shape`] if the range exceeds the end; else as for [`append`](Self::append).
    pub fn replace(&mut self, first: usize, gaussians: &Gaussians) -> Result<()> {
        self.check_logits(gaussians)?;
        if first + gaussians.len() > self.len() {
            return Err(Error::Shape {
                op: "replace",
                arg: "gaussians",
                expected: format!("at most {} from {first} on", self.len().saturating_sub(first)),
                actual: gaussians.len(),
            });
        }
        self.gaussians.upload_at(&mut self.stream, first, gaussians)?;
        self.revise(first, gaussians)
    }

    /// Removes a range of Gaussians. The later ones move down by the length of the range and keep
    /// their order.
    ///
    /// # Errors
    /// [`Error::Shape`] for a range out of bounds; [`Error::OutOfMemory`]; a failed submission.
    pub fn remove(&mut self, range: Range<usize>) -> Result<()> {
        if range.start > range.end || range.end > self.len() {
            return Err(Error::Shape {
                op: "remove",
                arg: "range",
                expected: format!("a range within {}", self.len()),
                actual: range.end,
            });
        }
        self.gaussians.remove(&mut self.stream, range.clone())?;
        if !self.motion_logits.is_empty() {
            self.motion_logits.drain(range);
        }
        self.list_dynamic()
    }

    fn check_logits(&self, gaussians: &Gaussians) -> Result<()> {
        let (expected, actual) = (gaussians.len(), gaussians.motion_logits.len());
        if actual != 0 && actual != expected {
            let expected = format!("0 or {expected}");
            return Err(Error::Shape { op: "edit", arg: "motion_logits", expected, actual });
        }
        Ok(())
    }

    /// Stores the motion logits of the Gaussians from index `first` on.
    fn revise(&mut self, first: usize, gaussians: &Gaussians) -> Result<()> {
        if self.motion.is_some() {
            self.motion_logits.resize(self.gaussians.len, f32::NEG_INFINITY);
            let logits = &mut self.motion_logits[first..first + gaussians.len()];
            match gaussians.motion_logits.is_empty() {
                true => logits.fill(f32::NEG_INFINITY),
                false => logits.copy_from_slice(&gaussians.motion_logits),
            }
        }
        self.list_dynamic()
    }

    /// Updates the data that is derived from the set of Gaussians.
    fn list_dynamic(&mut self) -> Result<()> {
        if let Some(motion) = &mut self.motion {
            motion.reserve(&self.device, self.gaussians.capacity())?;
            motion.set_dynamic(&mut self.stream, &self.motion_logits, 0.0)?;
            let mut recorder = self.stream.record()?;
            motion.refresh(&mut recorder, self.gaussians.views().positions)?;
            let ticket = self.stream.submit(recorder)?;
            self.stream.wait(ticket)?;
        }
        if self.half.is_used() {
            let gaussians = self.gaussians.download(&mut self.stream)?;
            self.half = Half::new(&self.device, &gaussians, &self.tuning)?;
        }
        if let Some(resources) = &mut self.resources {
            resources.moving = None;
        }
        Ok(())
    }
}

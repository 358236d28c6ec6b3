//! Previews: the scene in its current state of training, for an observer.

use super::observer::{Checkpoint, Measured, Observer, Phase};
use super::trainer::Trainer;
use crate::Result;
use crate::ops::loss::LossValue;
use crate::scene::Scene;

impl Trainer {
    /// Waits and copies the current scene, in the unit of training. Copying it does not change the
    /// course of the training.
    ///
    /// # Errors
    /// As for [`step`](Self::step).
    pub(super) fn glimpse(&mut self) -> Result<Scene> {
        self.settle()?;
        let optimiser = &mut self.scene;
        let mut scene = Scene::of(optimiser.gaussians()?);
        if let Some((points, network)) = optimiser.motion()? {
            (scene.control_points, scene.network) = (points, network);
            let motion = optimiser.motion.as_ref().expect("it gave its parameters");
            scene.neighbours = motion.motion.skin.neighbours().k() as u32;
        }
        scene.settings = optimiser.settings.render;
        scene.background = optimiser.settings.background;
        Ok(scene)
    }
}

/// An observer that passes scenes on after `place` has changed them: to the unit and cameras of the
/// finished scene.
pub struct Placed<'a> {
    pub inner: &'a mut dyn Observer,
    pub place: &'a dyn Fn(&mut Scene),
}

impl Observer for Placed<'_> {
    fn progress(&mut self, phase: Phase, step: u32, steps: u32) -> Result<()> {
        self.inner.progress(phase, step, steps)
    }

    fn loss(&mut self, loss: LossValue) {
        self.inner.loss(loss);
    }

    fn measures(&mut self) -> bool {
        self.inner.measures()
    }

    fn measured(&mut self, measured: &Measured) {
        self.inner.measured(measured);
    }

    fn wants_scene(&mut self) -> bool {
        self.inner.wants_scene()
    }

    fn scene(&mut self, mut scene: Scene) {
        (self.place)(&mut scene);
        self.inner.scene(scene);
    }

    fn wants_checkpoint(&mut self) -> bool {
        self.inner.wants_checkpoint()
    }

    fn checkpoint(&mut self, checkpoint: &Checkpoint) -> Result<()> {
        self.inner.checkpoint(checkpoint)
    }
}

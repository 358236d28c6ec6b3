//! What is due between steps: rounds of density control and of control points, the final decision which
//! Gaussians move, and the lists of dynamic Gaussians that follow from these.

use super::growth::Population;
use super::scene_optimiser::SceneOptimiser;
use crate::Result;
#[cfg(feature = "files")]
use serde::{Deserialize, Serialize};

/// Number of steps between synchronisations. At each one the host waits for the device, and the dynamic
/// Gaussians are listed anew and matched with their control points.
pub const SYNC_INTERVAL: u32 = 100;

/// Numbers of control points that training has added and removed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[cfg_attr(feature = "files", derive(Serialize, Deserialize))]
pub struct ControlChanges {
    /// Control points added where the loss had large gradients.
    pub added: usize,
    /// Control points removed because no Gaussian followed them.
    pub removed: usize,
}

impl SceneOptimiser {
    /// Whether the host waits for the device after this number of steps.
    pub(super) fn syncs(&self) -> bool {
        self.step.is_multiple_of(SYNC_INTERVAL)
    }

    /// Does what is due after a step. No step may be in flight where the scene [syncs](Self::syncs).
    pub(super) fn rounds(&mut self) -> Result<()> {
        let revised = self.revise_control_points()?;
        let grown = self.grow()?;
        if self.syncs() || revised || grown || self.chooses() {
            self.list_dynamic()?;
        }
        Ok(())
    }

    /// Runs a round of density control if one is due, and returns whether it did.
    fn grow(&mut self) -> Result<bool> {
        let Some(growth) = &mut self.growth else { return Ok(false) };
        if !growth.due(self.step) {
            return Ok(false);
        }
        let population = Population {
            gaussians: &mut self.gaussians,
            selection: self.selection.as_mut(),
            optimiser: &mut self.optimiser,
        };
        growth.round(&mut self.stream, self.step, population, self.statistics.as_ref())?;
        if let Some(statistics) = &mut self.statistics {
            statistics.clear(&mut self.stream)?;
        }
        Ok(true)
    }

    /// Runs a round of adding and removing control points if one is due, and returns whether it changed
    /// any. It reads the statistics before growth clears them.
    fn revise_control_points(&mut self) -> Result<bool> {
        let (Some(motion), Some(control), Some(statistics)) =
            (&mut self.motion, &self.settings.motion.control, &mut self.statistics)
        else {
            return Ok(false);
        };
        if !control.due(self.step, self.settings.steps) {
            return Ok(false);
        }
        let sums = statistics.download(&mut self.stream, self.gaussians.len)?;
        let (added, removed) = motion.revise(&mut self.stream, control, &self.gaussians, &sums)?;
        if self.growth.is_none() {
            statistics.clear(&mut self.stream)?;
        }
        self.control_changes.added += added;
        self.control_changes.removed += removed;
        Ok(added + removed > 0)
    }

    /// Whether soft motion has ended with this step.
    fn chooses(&self) -> bool {
        let steps = self.settings.steps;
        self.selection
            .as_ref()
            .is_some_and(|s| s.is_soft(self.step - 1, steps) && !s.is_soft(self.step, steps))
    }

    /// Lists the dynamic Gaussians, and finds the control points that they follow.
    pub(super) fn list_dynamic(&mut self) -> Result<()> {
        if let (Some(motion), Some(selection)) = (&mut self.motion, &self.selection) {
            let logits = selection.download(&mut self.stream, self.gaussians.len)?;
            let least = selection.least(self.step, self.settings.steps);
            motion.set_dynamic(&mut self.stream, &logits, least, &self.gaussians)?;
        }
        Ok(())
    }
}

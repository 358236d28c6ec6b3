//! What happens between some steps: rounds of growth and of control points, the choice of who moves,
//! and the lists that follow from all of it.

use super::growth::Population;
use super::trainer::{SYNC_INTERVAL, Trainer};
use crate::Result;
#[cfg(feature = "files")]
use serde::{Deserialize, Serialize};

/// Control points that came and went in training.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[cfg_attr(feature = "files", derive(Serialize, Deserialize))]
pub struct ControlChanges {
    /// Added where the loss pulled.
    pub added: usize,
    /// Removed where nothing followed.
    pub removed: usize,
}

impl Trainer {
    /// Whatever is due after a step. At every [`SYNC_INTERVAL`]th the device is waited for.
    pub(super) fn rounds(&mut self) -> Result<()> {
        let syncs = self.step.is_multiple_of(SYNC_INTERVAL);
        if syncs {
            self.finish()?;
        }
        let revised = self.revise_control_points()?;
        let grown = self.grow()?;
        if syncs || revised || grown || self.chooses() {
            self.list_dynamic()?;
        }
        Ok(())
    }

    /// A round of density control, where one is due; says whether it was.
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

    /// A round of adding and removing control points, where one is due; says whether it changed
    /// something. It reads the statistics before growth clears them.
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

    /// Whether soft motion has just ended.
    fn chooses(&self) -> bool {
        let steps = self.settings.steps;
        self.selection
            .as_ref()
            .is_some_and(|s| s.is_soft(self.step - 1, steps) && !s.is_soft(self.step, steps))
    }

    /// Lists which Gaussians move, and finds what they follow.
    pub(super) fn list_dynamic(&mut self) -> Result<()> {
        if let (Some(motion), Some(selection)) = (&mut self.motion, &self.selection) {
            let logits = selection.download(&mut self.stream, self.gaussians.len)?;
            let least = selection.least(self.step, self.settings.steps);
            motion.set_dynamic(&mut self.stream, &logits, least, &self.gaussians)?;
        }
        Ok(())
    }
}

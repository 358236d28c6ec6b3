//! The constants of dense optical flow.

use crate::{Error, Result};

/// How dense optical flow is searched and refined; `Default` is tuned for quality on video.
///
/// Luminance is in [0, 1]; distances are in pixels of the current pyramid level.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FlowSettings {
    /// The pyramid halves until the next level's shorter side would be less than this.
    pub coarsest_side: u32,
    /// At the coarsest level every whole-pixel displacement up to this far along each axis is
    /// matched; at most [`MAX_START_RADIUS`](Self::MAX_START_RADIUS).
    pub start_radius: u32,
    /// At the coarsest level, the cost of a difference of one pixel between the displacements of
    /// neighbouring pixels, in bits of the census transform.
    pub start_small_step: u32,
    /// At the coarsest level, the cost of any greater difference, in bits of the census transform.
    pub start_large_step: u32,
    /// Gauss–Newton steps of each patch after its best candidate is chosen.
    pub search_steps: u32,
    /// Number of rounds in which patches then propagate their displacement to their neighbours.
    pub propagations: u32,
    /// Number of times that a level's energy is linearised about the flow and solved.
    pub warps: u32,
    /// Red–black relaxation sweeps per linearisation.
    pub sweeps: u32,
    /// Over-relaxation, in (0, 2).
    pub relaxation: f32,
    /// Weight of brightness constancy.
    pub brightness: f32,
    /// Weight of gradient constancy.
    pub gradient: f32,
    /// Weight of smoothness, which penalises all differences between neighbours.
    pub smoothness: f32,
    /// Weight of smoothness at the finest level if there it penalises only the difference from a flow that is
    /// affine around each pixel, such as that of a slanted surface; 0 to penalise all differences there too.
    pub affine_smoothness: f32,
    /// Luminance gradient per pixel at which smoothness has fallen to 1/e.
    pub edge: f32,
    /// Gradients below this count as noise when the data terms are normalised.
    pub noise: f32,
    /// Displacements, in pixels, below which the penalties turn from absolute to quadratic.
    pub kink: f32,
}

impl Default for FlowSettings {
    fn default() -> Self {
        FlowSettings {
            coarsest_side: 12,
            start_radius: 4,
            start_small_step: 3,
            start_large_step: 20,
            search_steps: 8,
            propagations: 4,
            warps: 3,
            sweeps: 10,
            relaxation: 1.8,
            brightness: 0.2,
            gradient: 1.0,
            smoothness: 0.3,
            affine_smoothness: 0.0,
            edge: 0.08,
            noise: 0.012,
            kink: 0.05,
        }
    }
}

impl FlowSettings {
    /// The largest start radius: the costs of its window must fit a workgroup's shared memory.
    pub const MAX_START_RADIUS: u32 = 16;

    /// Whether smoothness at the finest level penalises only the difference from a locally affine flow.
    pub(crate) fn is_affine(&self, level: usize) -> bool {
        level == 0 && self.affine_smoothness > 0.0
    }

    /// Weight of smoothness at a level of the pyramid, 0 being the finest.
    pub(crate) fn smoothness_at(&self, level: usize) -> f32 {
        if self.is_affine(level) { self.affine_smoothness } else { self.smoothness }
    }

    /// Checks that all values are valid.
    ///
    /// # Errors
    /// [`Error::Input`] that names the first invalid value.
    pub fn check(&self) -> Result<()> {
        let positive = [
            ("edge", self.edge),
            ("noise", self.noise),
            ("kink", self.kink),
            ("smoothness", self.smoothness),
        ];
        let weights = [
            ("brightness", self.brightness),
            ("gradient", self.gradient),
            ("affine_smoothness", self.affine_smoothness),
        ];
        let wrong = positive
            .into_iter()
            .find(|(_, value)| !(value.is_finite() && *value > 0.0))
            .or_else(|| weights.into_iter().find(|(_, v)| !(v.is_finite() && *v >= 0.0)));
        if let Some((name, value)) = wrong {
            return Err(Error::Input(format!("flow setting {name} = {value}: too small or NaN")));
        }
        if !(self.relaxation > 0.0 && self.relaxation < 2.0) {
            let value = self.relaxation;
            return Err(Error::Input(format!("flow setting relaxation = {value}: not in (0, 2)")));
        }
        if self.start_radius > Self::MAX_START_RADIUS {
            let (value, most) = (self.start_radius, Self::MAX_START_RADIUS);
            return Err(Error::Input(format!(
                "flow setting start_radius = {value}: at most {most}; lower coarsest_side instead \
                 for larger displacements"
            )));
        }
        Ok(())
    }
}

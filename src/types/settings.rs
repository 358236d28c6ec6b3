//! The constants of blending.

/// The constants of projection and blending; a scene's file carries them, so that every renderer
/// blends as the trainer did. The defaults are gsplat's.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RenderSettings {
    /// Splats whose centre is nearer than this are culled.
    pub near: f32,
    /// Added to both diagonal entries of the 2D covariance, pixels².
    pub dilation: f32,
    /// A splat contributes nothing to a pixel where its α is below this.
    pub alpha_cut: f32,
    /// α is capped here; above the cap no gradient reaches opacity or shape.
    pub alpha_cap: f32,
    /// Blending stops *before* the splat that would bring the transmittance to this or below.
    pub transmittance_stop: f32,
    /// The Jacobian is evaluated at tangents clamped to this many half fields of view.
    pub tangent_clamp: f32,
}

impl Default for RenderSettings {
    fn default() -> Self {
        RenderSettings {
            near: 0.01,
            dilation: 0.3,
            alpha_cut: 1.0 / 255.0,
            alpha_cap: 0.999,
            transmittance_stop: 1e-4,
            tangent_clamp: 1.3,
        }
    }
}

//! The 4D scene and its files.
//!
//! The scene's own file is safetensors ([`mod@file`]), plain or [`compact`]. Exchange formats: 3DGS
//! PLY, plain and compressed ([`ply`]), SPZ ([`spz`]), which can hold the motion too, and [`splat`]
//! are read and written. glTF ([`glb`]), [`splatv`], whose motion is a fit, and [`html`], a web
//! page that plays the scene, are written only. [`sog`] is read only. [`Format`] determines the
//! format from a file name.

#[cfg(feature = "files")]
mod axes;
#[cfg(feature = "files")]
pub mod compact;
#[cfg(feature = "files")]
mod compressed_ply;
#[cfg(feature = "files")]
pub mod file;
#[cfg(feature = "files")]
mod format;
#[cfg(feature = "files")]
pub mod glb;
#[cfg(feature = "files")]
pub mod html;
#[cfg(feature = "files")]
mod open;
#[cfg(feature = "files")]
mod packing;
#[cfg(feature = "files")]
pub mod ply;
#[cfg(feature = "files")]
pub mod sog;
#[cfg(feature = "files")]
pub mod splat;
#[cfg(feature = "files")]
pub mod splatv;
#[cfg(feature = "files")]
pub mod spz;

#[cfg(feature = "files")]
pub use format::Format;
#[cfg(feature = "files")]
pub use open::Opened;
#[cfg(feature = "files")]
use open::without_bad;

use crate::types::range::{self, Check};
use crate::types::{Camera, ControlPoints, DeformNet, Gaussians, RenderSettings};

/// A camera and its time: of the input, or of a path around the scene.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SceneCamera {
    /// Time in [0, 1].
    pub time: f64,
    /// The camera.
    pub camera: Camera,
}

/// The error for a scene with both paths and a network.
const TWICE_MOVED: &str = "control points are moved by their paths or by a network, not by both";

/// A 4D scene: all data needed to render it at any time.
#[derive(Clone, Debug, PartialEq)]
pub struct Scene {
    /// The Gaussians in the canonical frame.
    pub gaussians: Gaussians,
    /// The control points that dynamic Gaussians follow; empty in a static scene.
    pub control_points: ControlPoints,
    /// The deformation network that moves control points without paths; `None` in a static scene
    /// and if the control points have paths.
    pub network: Option<DeformNet>,
    /// The constants of projection and blending that the scene was trained with.
    pub settings: RenderSettings,
    /// Number of control points that a dynamic Gaussian follows.
    pub neighbours: u32,
    /// The trajectory of the input cameras, in order of time; empty if unknown.
    pub cameras: Vec<SceneCamera>,
    /// Background colour, RGB in [0, 1].
    pub background: [f32; 3],
    /// The up direction in the world frame, of unit length; −y if no camera is known.
    pub up: [f32; 3],
    /// The report of the run that made the scene, as JSON. It exists only with the feature `files`,
    /// so struct literals should end with `..Scene::default()`.
    #[cfg(feature = "files")]
    pub report: serde_json::Value,
}

impl Default for Scene {
    fn default() -> Self {
        Scene {
            gaussians: Gaussians::default(),
            control_points: ControlPoints::default(),
            network: None,
            settings: RenderSettings::default(),
            neighbours: 4,
            cameras: Vec::new(),
            background: [0.0; 3],
            up: [0.0, -1.0, 0.0],
            #[cfg(feature = "files")]
            report: serde_json::Value::Null,
        }
    }
}

impl Scene {
    /// A static scene of some Gaussians.
    pub fn of(gaussians: Gaussians) -> Scene {
        Scene { gaussians, ..Scene::default() }
    }

    /// Scales the whole scene, camera positions included, by `factor`, so that rendered images stay
    /// the same.
    ///
    /// # Panics
    /// When a network moves the scene and the factor is no power of two.
    #[cfg(feature = "reconstruct")]
    pub(crate) fn enlarge(&mut self, factor: f64) {
        if let Some(network) = &mut self.network {
            let octaves = factor.log2();
            assert!(octaves.fract() == 0.0, "a network is enlarged by powers of two");
            network.enlarge(octaves as i32);
        }
        let (by, logarithm) = (factor as f32, factor.ln() as f32);
        for position in
            self.gaussians.positions.iter_mut().chain(&mut self.control_points.positions)
        {
            position.iter_mut().for_each(|v| *v *= by);
        }
        self.gaussians.log_scales.iter_mut().flatten().for_each(|v| *v += logarithm);
        self.control_points.log_radii.iter_mut().for_each(|v| *v += logarithm);
        for motion in &mut self.control_points.paths {
            motion[..3].iter_mut().for_each(|v| *v *= by);
        }
        self.cameras.iter_mut().for_each(|at| at.camera.view_from_world.translation *= factor);
        self.settings.near *= by;
    }

    /// Whether the scene is dynamic.
    pub fn moves(&self) -> bool {
        let moved = self.network.is_some() || !self.control_points.paths.is_empty();
        moved && self.gaussians.is_dynamic()
    }

    /// Checks that every number is in its range, so that readers accept the scene's file; see
    /// [`crate::types::range`]. The arrays must have consistent lengths.
    ///
    /// # Errors
    /// A description of the violation.
    pub fn check(&self) -> Check {
        for i in 0..self.gaussians.len() {
            self.gaussians.check(i).map_err(|what| format!("Gaussian {i}: {what}"))?;
        }
        self.control_points.check()?;
        if self.network.is_some() && !self.control_points.paths.is_empty() {
            return Err(TWICE_MOVED.into());
        }
        self.network.as_ref().map_or(Ok(()), |network| network.check())?;
        self.settings.check()?;
        for (i, known) in self.cameras.iter().enumerate() {
            let checked = known.camera.check().and_then(|()| range::time(known.time));
            checked.map_err(|what| format!("camera {i}: {what}"))?;
        }
        Ok(())
    }

    /// Sets [`Self::up`] to the normalised mean of the cameras' up axes. Without cameras, or if the
    /// axes cancel out, it stays unchanged.
    pub fn set_up_from_cameras(&mut self) {
        let mean: glam::DVec3 = self
            .cameras
            .iter()
            .map(|c| c.camera.view_from_world.inverse().rotation * glam::DVec3::NEG_Y)
            .sum();
        if mean.length() > 1e-3 * self.cameras.len().max(1) as f64 {
            self.up = mean.normalize().as_vec3().to_array();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Projected splats stay the same, so rendered images do too.
    #[cfg(feature = "reconstruct")]
    #[test]
    fn an_enlarged_scene_is_larger_in_all_its_lengths() {
        let mut scene = Scene::of(Gaussians {
            positions: vec![[1.0, -2.0, 3.0]],
            log_scales: vec![[-1.0, 0.0, 1.0]],
            rotations: vec![[0.8, 0.6, 0.0, 0.0]],
            opacity_logits: vec![0.5],
            sh_degree: 0,
            sh: vec![[0.1; 3]],
            motion_logits: vec![1.0],
        });
        scene.control_points = ControlPoints {
            positions: vec![[0.5, 0.0, 1.0]],
            log_radii: vec![-2.0],
            paths: vec![[0.1, 0.2, 0.3, 0.0, 0.4, 0.5, 0.6, 0.7]; 2],
        };
        let pose = crate::types::Pose {
            rotation: glam::DQuat::from_rotation_x(0.3),
            translation: glam::DVec3::X,
        };
        let intrinsics = crate::types::Intrinsics::centred(100.0, 64, 48);
        let camera = Camera { intrinsics, view_from_world: pose };
        scene.cameras = vec![SceneCamera { time: 0.0, camera }];
        let small = scene.clone();
        scene.enlarge(1000.0);
        assert_eq!(scene.gaussians.positions, [[1000.0, -2000.0, 3000.0]]);
        let grown = (scene.gaussians.log_scales[0][0] + 1.0).exp();
        assert!((grown / 1000.0 - 1.0).abs() < 1e-6, "{grown}");
        assert_eq!(scene.control_points.positions, [[500.0, 0.0, 1000.0]]);
        assert!((scene.control_points.log_radii[0] + 2.0 - 1000f32.ln()).abs() < 1e-6);
        assert_eq!(scene.control_points.paths[1], [100.0, 200.0, 300.0, 0.0, 0.4, 0.5, 0.6, 0.7]);
        let at = scene.cameras[0].camera.view_from_world;
        assert_eq!((at.rotation, at.translation), (pose.rotation, 1000.0 * pose.translation));
        assert_eq!(scene.settings.near, 1000.0 * small.settings.near);
        assert_eq!(scene.gaussians.rotations, small.gaussians.rotations);
        assert_eq!(scene.check(), Ok(()));
    }

    #[test]
    fn a_scene_with_a_number_out_of_range_is_named() {
        let gaussians = Gaussians {
            positions: vec![[0.0; 3]; 2],
            log_scales: vec![[-1.0; 3]; 2],
            rotations: vec![[1.0, 0.0, 0.0, 0.0]; 2],
            opacity_logits: vec![0.0; 2],
            sh_degree: 0,
            sh: vec![[0.0; 3]; 2],
            motion_logits: Vec::new(),
        };
        let good = Scene::of(gaussians);
        assert_eq!(good.check(), Ok(()));
        let mut bad = good.clone();
        bad.gaussians.log_scales[1][2] = f32::NAN;
        let what = bad.check().unwrap_err();
        assert!(what.contains("Gaussian 1") && what.contains("scale"), "{what}");
        let mut bad = good;
        bad.control_points = ControlPoints {
            positions: vec![[f32::INFINITY, 0.0, 0.0]],
            log_radii: vec![0.0],
            paths: vec![],
        };
        assert!(bad.check().unwrap_err().contains("control point 0"));
    }
}

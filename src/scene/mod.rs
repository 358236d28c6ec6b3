//! The 4D scene and its files.
//!
//! The scene's own file is safetensors ([`mod@file`]), plain or [`compact`]. What others write and read: 3DGS PLY, plain and
//! compressed ([`ply`]), SPZ ([`spz`]), which holds the motion too, and [`splat`]; glTF ([`glb`])
//! and [`splatv`], whose motion is a fit, are written only, as is [`html`], a page that plays the scene; [`sog`] is read
//! only. [`Format`] tells them apart by name.

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

/// A camera of the input at its time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SceneCamera {
    /// In [0, 1].
    pub time: f64,
    /// The camera.
    pub camera: Camera,
}

/// Why a scene with paths and a network is refused.
const TWICE_MOVED: &str = "control points are moved by their paths or by a network, not by both";

/// A scene: everything that rendering it at any time needs.
#[derive(Clone, Debug, PartialEq)]
pub struct Scene {
    /// The Gaussians in the canonical frame.
    pub gaussians: Gaussians,
    /// What moves the dynamic ones; empty in a static scene.
    pub control_points: ControlPoints,
    /// What moves control points without paths; `None` in a static scene and where they have paths.
    pub network: Option<DeformNet>,
    /// The constants that the scene was trained with.
    pub settings: RenderSettings,
    /// Number of control points that a dynamic Gaussian follows.
    pub neighbours: u32,
    /// The input's trajectory, in order of time; empty where none is known.
    pub cameras: Vec<SceneCamera>,
    /// RGB behind everything.
    pub background: [f32; 3],
    /// The world's direction that is up in the pictures, of unit length; where no camera is known,
    /// −y.
    pub up: [f32; 3],
    /// How the scene came to be: the run's report, any JSON. (Feature `files`: where a scene is
    /// written out field by field, end with `..Scene::default()`.)
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

    /// Makes everything so many times as large, cameras and their distances too, so that the pictures stay
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

    /// Whether something moves.
    pub fn moves(&self) -> bool {
        let moved = self.network.is_some() || !self.control_points.paths.is_empty();
        moved && self.gaussians.is_dynamic()
    }

    /// That every number is in its range, so that a reader of the scene's file takes it; see
    /// [`crate::types::range`]. Arrays must be as long as they should be.
    ///
    /// # Errors
    /// What is wrong, in words.
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

    /// Sets [`Self::up`] from the cameras: the mean of their upward axes. Without cameras, or where
    /// these cancel out, it stays.
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

    /// The pictures stay the same: what is rendered depends on nothing else.
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

//! The 4D scene and its files.
//!
//! The scene's own file is safetensors ([`mod@file`]); static scenes exchange as 3DGS PLY ([`ply`]).

mod compressed_ply;
pub mod file;
pub mod ply;

use std::path::Path;

use serde_json::Value;

use crate::types::{Camera, ControlPoints, DeformNet, Gaussians, RenderSettings};
use crate::{Error, Result};

/// A camera of the input at its time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SceneCamera {
    /// In [0, 1].
    pub time: f64,
    /// The camera.
    pub camera: Camera,
}

/// A scene: everything that rendering it at any time needs.
#[derive(Clone, Debug, PartialEq)]
pub struct Scene {
    /// The Gaussians in the canonical frame.
    pub gaussians: Gaussians,
    /// What moves the dynamic ones; empty in a static scene.
    pub control_points: ControlPoints,
    /// What moves the control points; `None` in a static scene.
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
    /// How the scene came to be: the run's report, any JSON.
    pub report: Value,
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
            report: Value::Null,
        }
    }
}

/// A scene as read, and what was left out.
#[derive(Clone, Debug)]
pub struct Opened {
    /// The scene.
    pub scene: Scene,
    /// Number of Gaussians left out because they held NaN or infinite values.
    pub dropped: usize,
}

impl Scene {
    /// A static scene of some Gaussians.
    pub fn of(gaussians: Gaussians) -> Scene {
        Scene { gaussians, ..Scene::default() }
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

    /// Opens a scene's file or a 3DGS PLY; which of the two shows in the bytes. With `drop_bad`,
    /// Gaussians that hold NaN or infinite values are left out and counted; else they are an error
    /// that counts them.
    pub fn open(path: impl AsRef<Path>, drop_bad: bool) -> Result<Opened> {
        let path = path.as_ref();
        let bytes = crate::io::read(path)?;
        if !crate::io::ply::is_ply(&bytes) {
            return file::parse(path, &bytes, drop_bad);
        }
        let (gaussians, dropped) = ply::parse(path, &bytes, drop_bad)?;
        Ok(Opened { scene: Scene::of(gaussians), dropped })
    }

    /// Writes the scene's file by rename; see [`mod@file`].
    pub fn save(&self, path: impl AsRef<Path>) -> Result<()> {
        file::write(path.as_ref(), self)
    }
}

/// Leaves out the Gaussians that hold a value that is not finite, or fails with their count.
fn without_bad(path: &Path, gaussians: &mut Gaussians, drop_bad: bool) -> Result<usize> {
    let per = gaussians.sh.len() / gaussians.len().max(1);
    let finite = |values: &[f32]| values.iter().all(|v| v.is_finite());
    let good: Vec<bool> = (0..gaussians.len())
        .map(|i| {
            finite(&gaussians.positions[i])
                && finite(&gaussians.log_scales[i])
                && finite(&gaussians.rotations[i])
                && gaussians.opacity_logits[i].is_finite()
                && gaussians.sh[i * per..(i + 1) * per].iter().all(|row| finite(row))
                && gaussians.motion_logits.get(i).is_none_or(|m| m.is_finite())
        })
        .collect();
    let bad = good.iter().filter(|good| !**good).count();
    if bad == 0 {
        return Ok(0);
    }
    if !drop_bad {
        let first = good.iter().position(|good| !good).unwrap_or(0);
        return Err(Error::format(
            path,
            format!(
                "{bad} of {} Gaussians hold NaN or infinite values (the first is number {first}); \
                 --drop-bad leaves them out",
                good.len()
            ),
        ));
    }
    fn keep<T>(rows: &mut Vec<T>, good: &[bool], per: usize) {
        let mut row = 0;
        rows.retain(|_| {
            row += 1;
            good[(row - 1) / per]
        });
    }
    keep(&mut gaussians.positions, &good, 1);
    keep(&mut gaussians.log_scales, &good, 1);
    keep(&mut gaussians.rotations, &good, 1);
    keep(&mut gaussians.opacity_logits, &good, 1);
    keep(&mut gaussians.sh, &good, per.max(1));
    keep(&mut gaussians.motion_logits, &good, 1);
    Ok(bad)
}

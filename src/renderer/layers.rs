//! Per-pixel layers besides colour: the motion mask, normals, and optical flow to another frame.
//!
//! Each is a value per Gaussian, blended with the weights of the last rendered image.

use glam::{DQuat, DVec2, DVec3};

use super::{FrameResources, Renderer};
use crate::types::{Camera, Image};
use crate::{Error, Result};

/// Pixels with a smaller alpha have no value in a layer; the same threshold as for
/// [`Rendered::mean_depth`](super::Rendered::mean_depth).
const LEAST_ALPHA: f32 = 1e-3;

impl Renderer {
    /// The last image of [`render`](Self::render) with a value per Gaussian in place of its colour:
    /// Σ α · T · value (three channels), and alpha. Values may be any finite numbers. It costs one
    /// blending pass.
    ///
    /// # Errors
    /// [`Error::Shape`] if the number of values differs from the number of Gaussians;
    /// [`Error::Input`] before the first rendered image; [`Error::OutOfMemory`], or a failed
    /// submission.
    pub fn repaint(&mut self, values: &[[f32; 3]]) -> Result<Image> {
        let n = self.gaussians.len;
        if values.len() != n {
            let expected = n.to_string();
            return Err(Error::Shape {
                op: "repaint",
                arg: "values",
                expected,
                actual: values.len(),
            });
        }
        let capacity = self.gaussians.capacity();
        let Some(FrameResources { frame, painted, .. }) = &mut self.resources else {
            return Err(Error::Input("nothing was rendered that could be painted anew".into()));
        };
        if painted.is_none() {
            let colours = self.device.buffer("values to paint", capacity)?;
            *painted = Some((colours, frame.plan().pixels(&self.device)?));
        }
        let (colours, pixels) = painted.as_mut().expect("made above");
        let mut rows: Vec<[f32; 4]> = values.iter().map(|&[x, y, z]| [x, y, z, 0.0]).collect();
        rows.resize(capacity, [0.0; 4]);
        self.stream.upload(colours, &rows)?;
        let mut recorder = self.stream.record()?;
        frame.blend(&mut recorder, Some(colours.view()), pixels.views_mut())?;
        self.stream.submit(recorder)?;
        let (width, height) = (pixels.width, pixels.height);
        let rgba = self.stream.download(&pixels.rgba)?.into_flattened();
        Ok(Image { width, height, channels: 4, pixels: rgba })
    }

    /// The part of each pixel's alpha in the last rendered image that comes from dynamic Gaussians,
    /// between 0 and alpha; one channel.
    ///
    /// # Errors
    /// As for [`repaint`](Self::repaint).
    pub fn moving(&mut self) -> Result<Image> {
        let moves = |i: usize| self.motion_logits.get(i).is_some_and(|logit| *logit > 0.0);
        let values: Vec<[f32; 3]> =
            (0..self.gaussians.len).map(|i| [f32::from(u8::from(moves(i))), 0.0, 0.0]).collect();
        let painted = self.repaint(&values)?;
        let pixels = painted.pixels.chunks_exact(4).map(|p| p[0]).collect();
        Ok(Image { channels: 1, pixels, ..painted })
    }

    /// Normals of the last rendered image, of `camera` at `time`: unit vectors in the camera's
    /// frame (x right, y down, z forward) that point toward the camera; 0 in empty pixels. Three
    /// channels. A Gaussian's normal is its shortest axis; a pixel's normal is the normalised blend
    /// of these.
    ///
    /// # Errors
    /// As for [`repaint`](Self::repaint) and [`posed`](Self::posed).
    pub fn normals(&mut self, camera: &Camera, time: f64) -> Result<Image> {
        let posed = self.posed(time)?;
        let view_from_world = camera.view_from_world;
        let values: Vec<[f32; 3]> = (posed.positions.iter().zip(&posed.rotations))
            .zip(&posed.log_scales)
            .map(|((position, rotation), scales)| {
                let axis = shortest_axis(scales);
                let [w, x, y, z] = rotation.map(f64::from);
                let turn = DQuat::from_xyzw(x, y, z, w);
                if !(turn.length_squared().is_finite() && turn.length_squared() > 0.0) {
                    return [0.0; 3];
                }
                let normal = view_from_world.rotation * (turn.normalize() * axis);
                let place = view_from_world.apply(wide(*position));
                let normal = if normal.dot(place) > 0.0 { -normal } else { normal };
                finite(normal)
            })
            .collect();
        let painted = self.repaint(&values)?;
        let mut out = Image::new(painted.width, painted.height, 3);
        for (out, p) in out.pixels.chunks_exact_mut(3).zip(painted.pixels.chunks_exact(4)) {
            if p[3] > LEAST_ALPHA {
                let sum = wide([p[0], p[1], p[2]]);
                out.copy_from_slice(&finite(sum.normalize_or_zero()));
            }
        }
        Ok(out)
    }

    /// Optical flow from the last rendered image (`seen`, of camera and time `from`) to another
    /// camera at another time: the displacement of each pixel in pixels, x right and y down, two
    /// channels. It is NaN in empty pixels, and where the point lies behind the other camera.
    ///
    /// A pixel's surface point is taken at the mean depth, and moves by the blended motion of the
    /// pixel's Gaussians. Occlusion in the other image is not tested.
    ///
    /// # Errors
    /// As for [`repaint`](Self::repaint) and [`posed`](Self::posed); [`Error::Shape`] if the size
    /// of `seen` differs.
    pub fn flow(
        &mut self,
        seen: &super::Rendered,
        (camera, time): (&Camera, f64),
        (to_camera, to_time): (&Camera, f64),
    ) -> Result<Image> {
        let values: Vec<[f32; 3]> = match self.motion.is_some() && time != to_time {
            true => {
                let (here, there) = (self.posed(time)?, self.posed(to_time)?);
                let pairs = here.positions.iter().zip(&there.positions);
                pairs.map(|(a, b)| finite(wide(*b) - wide(*a))).collect()
            }
            false => vec![[0.0; 3]; self.gaussians.len],
        };
        let painted = self.repaint(&values)?;
        let (width, height) = (painted.width, painted.height);
        if seen.depth.pixels.len() != width as usize * height as usize {
            let (expected, actual) = (format!("{width}×{height}"), seen.depth.pixels.len());
            return Err(Error::Shape { op: "flow", arg: "seen", expected, actual });
        }
        let world_from_view = camera.view_from_world.inverse();
        let mut flow = Image::new(width, height, 2);
        flow.pixels.fill(f32::NAN);
        let pixels = flow.pixels.chunks_exact_mut(2).zip(painted.pixels.chunks_exact(4));
        for (i, (out, p)) in pixels.enumerate() {
            let alpha = p[3];
            if alpha <= LEAST_ALPHA {
                continue;
            }
            let (x, y) = (i % width as usize, i / width as usize);
            let pixel = DVec2::new(x as f64 + 0.5, y as f64 + 0.5);
            let depth = f64::from(seen.depth.pixels[i] / alpha);
            let motion = wide([p[0], p[1], p[2]]) / f64::from(alpha);
            let here = world_from_view.apply(camera.intrinsics.ray(pixel) * depth);
            let there = to_camera.view_from_world.apply(here + motion);
            if there.z > 0.0 {
                let displaced = to_camera.intrinsics.project(there) - pixel;
                (out[0], out[1]) = (displaced.x as f32, displaced.y as f32);
            }
        }
        Ok(flow)
    }
}

fn wide(v: [f32; 3]) -> DVec3 {
    DVec3::from_array(v.map(f64::from))
}

/// The vector as f32, zero if it is not finite: one such value would spread to every pixel of the
/// splat.
fn finite(v: DVec3) -> [f32; 3] {
    if v.is_finite() { v.to_array().map(|v| v as f32) } else { [0.0; 3] }
}

/// The axis along which a Gaussian is thinnest.
fn shortest_axis(log_scales: &[f32]) -> DVec3 {
    let axes = [DVec3::X, DVec3::Y, DVec3::Z].into_iter().zip(log_scales);
    axes.min_by(|a, b| a.1.total_cmp(b.1)).map_or(DVec3::Z, |(axis, _)| axis)
}

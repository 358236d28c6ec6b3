//! Queries of a scene: the surface at a pixel, the control points and the bounding box.

use super::{Renderer, moved};
use crate::gpu::View;
use crate::ops::render::{RenderScratch, TILE};
use crate::types::{Camera, ControlPoints, range};
use crate::{Error, Result};
use bytemuck::Pod;
use glam::{DVec2, DVec3};

/// The surface that a pixel shows.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Hit {
    /// Index of the Gaussian with which the accumulated opacity, front to back, reaches half of the
    /// pixel's alpha.
    pub gaussian: usize,
    /// Depth (camera z) of that Gaussian's centre.
    pub depth: f64,
    /// The point at that depth on the ray through the pixel's centre, world frame.
    pub point: DVec3,
    /// The Gaussian's blending weight in the pixel: α · T.
    pub weight: f64,
    /// The pixel's alpha.
    pub alpha: f64,
}

/// A projected splat.
struct Splat {
    gaussian: usize,
    /// Mean x, mean y, depth, opacity.
    mean: [f32; 4],
    /// The conic's triangular factor (a, b, e); the fourth value is not used here.
    conic: [f32; 4],
}

impl Renderer {
    /// The surface that `camera` sees at a pixel at `time`; `None` where alpha is 0. Renders a
    /// frame, reads back the splats of one tile, and waits.
    ///
    /// # Errors
    /// [`Error::Input`] for a pixel outside the image; else as for [`render`](Self::render).
    pub fn hit(&mut self, camera: &Camera, time: f64, pixel: [u32; 2]) -> Result<Option<Hit>> {
        let k = camera.intrinsics;
        let [x, y] = pixel;
        if x >= k.width || y >= k.height {
            let (width, height) = (k.width, k.height);
            return Err(Error::Input(format!("pixel ({x}, {y}) of {width}×{height}")));
        }
        self.draw(camera, time)?;
        let tile = (y / TILE * k.width.div_ceil(TILE) + x / TILE) as usize;
        let splats = self.splats_of(tile)?;
        let (centre, settings) = ([x, y].map(|v| f64::from(v) + 0.5), self.settings);
        let mut shares = Vec::new();
        let mut transmittance = 1.0;
        for Splat { gaussian, mean, conic } in splats {
            let [mx, my, depth, opacity] = mean.map(f64::from);
            let [a, b, e, _] = conic.map(f64::from);
            let (dx, dy) = (centre[0] - mx, centre[1] - my);
            let power = (a * dx + b * dy).powi(2) + (e * dy).powi(2);
            let alpha = (opacity * (-power).exp()).min(f64::from(settings.alpha_cap));
            // The blending kernel also skips NaN and alphas below the cut.
            if power.is_nan() || alpha < f64::from(settings.alpha_cut) {
                continue;
            }
            let behind = transmittance * (1.0 - alpha);
            if behind <= f64::from(settings.transmittance_stop) {
                break;
            }
            shares.push((gaussian, depth, alpha * transmittance));
            transmittance = behind;
        }
        let alpha = 1.0 - transmittance;
        let mut sum = 0.0;
        let surface = shares.into_iter().find(|(_, _, weight)| {
            sum += weight;
            sum >= 0.5 * alpha
        });
        Ok(surface.map(|(gaussian, depth, weight)| {
            let ray = k.ray(DVec2::from_array(centre));
            let point = camera.view_from_world.inverse().apply(ray * depth);
            Hit { gaussian, depth, point, weight, alpha }
        }))
    }

    /// The last frame's splats of a tile, front to back.
    fn splats_of(&mut self, tile: usize) -> Result<Vec<Splat>> {
        let [begin, end] = self.read_rows(|s| s.ranges.view(), &[tile])?[0];
        let places: Vec<usize> = (begin as usize..end as usize).collect();
        let emitted = self.read_rows(|s| s.emitted_from_sorted.view(), &places)?;
        let emitted: Vec<usize> = emitted.into_iter().map(|at| at as usize).collect();
        let splats = self.read_rows(|s| s.splat_from_emitted.view(), &emitted)?;
        let splats: Vec<usize> = splats.into_iter().map(|at| at as usize).collect();
        let means = self.read_rows(|s| s.means.view(), &splats)?;
        let conics = self.read_rows(|s| s.conics.view(), &splats)?;
        let rows = splats.into_iter().zip(means).zip(conics);
        Ok(rows.map(|((gaussian, mean), conic)| Splat { gaussian, mean, conic }).collect())
    }

    /// Reads the rows with these indices of an array of the last frame.
    fn read_rows<T: Pod>(
        &mut self,
        array: impl Fn(&RenderScratch) -> View<'_, T>,
        rows: &[usize],
    ) -> Result<Vec<T>> {
        let resources = self.resources.as_ref().expect("a frame was drawn");
        let mut gathered = self.device.buffer::<T>("rows asked for", rows.len())?;
        let mut recorder = self.stream.record()?;
        let all = array(&resources.frame.scratch);
        for (to, &from) in rows.iter().enumerate() {
            recorder.copy(all.range(from..from + 1), gathered.range_mut(to..to + 1));
        }
        self.stream.submit(recorder)?;
        self.stream.download(&gathered)
    }

    /// World positions of the control points at `time` in [0, 1], in the scene's order. `None` for
    /// an absent one, whose added opacity logit is nearer to [`ControlPoints::ABSENT`] than to 0.
    /// Empty in a static scene. Waits.
    ///
    /// # Errors
    /// [`Error::Input`] for a time out of [range]; [`Error::OutOfMemory`], or a
    /// failed submission.
    pub fn control_points(&mut self, time: f64) -> Result<Vec<Option<DVec3>>> {
        range::moment(time).map_err(Error::Input)?;
        let Renderer { stream, gaussians, motion: Some(motion), .. } = self else {
            return Ok(Vec::new());
        };
        let mut recorder = stream.record()?;
        motion.forward(&mut recorder, &gaussians.views(), &[time as f32], None)?;
        stream.submit(recorder)?;
        let transforms = stream.download(&motion.transforms)?;
        let nodes = stream.download(&motion.nodes)?;
        let place = |(node, transform): (&[f32], &[[f32; 4]])| {
            let [x, y, z, added] = transform[0];
            let at = |k: usize, moved: f32| f64::from(node[k]) + f64::from(moved);
            (added > 0.5 * ControlPoints::ABSENT).then(|| DVec3::new(at(0, x), at(1, y), at(2, z)))
        };
        Ok(nodes.chunks_exact(3).zip(transforms.chunks_exact(2)).map(place).collect())
    }

    /// The axis-aligned bounding box of all Gaussians at `time` in [0, 1], as lower and upper
    /// corner in the world frame: each centre is extended by `sigmas` times the Gaussian's largest
    /// standard deviation. `None` in an empty scene. Gaussians that are not finite are ignored.
    /// Waits.
    ///
    /// # Errors
    /// [`Error::Input`] for a time out of [range]; [`Error::OutOfMemory`], or a
    /// failed submission.
    pub fn bounds(&mut self, time: f64, sigmas: f64) -> Result<Option<[DVec3; 2]>> {
        range::moment(time).map_err(Error::Input)?;
        let n = self.gaussians.len;
        let mut centres = self.device.readback::<f32>(3 * n)?;
        let mut recorder = self.stream.record()?;
        let Renderer { gaussians, motion, half, tuning, .. } = self;
        let motion = motion.as_mut();
        let views = moved(gaussians, half, motion, tuning, &mut recorder, time)?;
        recorder.read_back(views.positions, &centres);
        let ticket = self.stream.submit(recorder)?;
        self.stream.wait(ticket)?;
        let scales = self.stream.download(&self.gaussians.log_scales)?;
        let mut bounds: Option<[DVec3; 2]> = None;
        for (centre, scale) in centres.read()?.chunks_exact(3).zip(scales.chunks_exact(3)) {
            let centre = DVec3::new(centre[0].into(), centre[1].into(), centre[2].into());
            let largest = scale.iter().fold(f64::NEG_INFINITY, |most, &s| most.max(s.into()));
            let reach = DVec3::splat(sigmas * largest.exp());
            if !(centre.is_finite() && reach.is_finite()) {
                continue;
            }
            let [low, high] = bounds.unwrap_or([centre - reach, centre + reach]);
            bounds = Some([low.min(centre - reach), high.max(centre + reach)]);
        }
        Ok(bounds)
    }
}

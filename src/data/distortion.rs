//! Lens distortion, removed once when an image is loaded.
//!
//! Everything after the loader works on pinhole images. The pinhole keeps the lens's focal lengths,
//! principal point and image size, so that the intrinsics a user knows stay what they are; corners
//! that the lens did not see are marked in a validity mask instead of cropping the image.

use glam::DVec2;
use rayon::prelude::*;

use crate::types::range::{self, Check};
use crate::types::{Image, Intrinsics};

/// Brown–Conrady distortion as OpenCV, COLMAP and nerfstudio write it: with r² = x² + y² in the
/// plane of unit depth, the radial factor is 1 + k1 r² + k2 r⁴ + k3 r⁶ + k4 r⁸, and p1, p2 are
/// tangential.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Distortion {
    /// k1 … k4.
    pub radial: [f64; 4],
    /// p1, p2.
    pub tangential: [f64; 2],
}

/// Least share of a picture that undistortion must leave.
const LEAST_LEFT: f64 = 0.1;
/// Places along each side of a picture at which [`Distortion::check`] looks.
const CHECKED: u32 = 33;

impl Distortion {
    /// That this is a lens's distortion of a picture with these intrinsics: no two directions share
    /// a pixel that [`undistort`](Self::undistort) takes, and it finds a source for a tenth of the
    /// pixels at least.
    ///
    /// # Errors
    /// What is wrong, in words.
    pub fn check(&self, intrinsics: &Intrinsics) -> Check {
        if self.is_none() {
            return Ok(());
        }
        let size = DVec2::new(f64::from(intrinsics.width), f64::from(intrinsics.height));
        let fold = self.fold(reach(intrinsics, size));
        let named = || format!("the distortion k {:?}, p {:?}", self.radial, self.tangential);
        let mut left = 0;
        for i in 0..CHECKED * CHECKED {
            let share = DVec2::new(f64::from(i % CHECKED), f64::from(i / CHECKED));
            let pixel = size * share / f64::from(CHECKED - 1);
            let plane = intrinsics.ray(pixel).truncate();
            let source = intrinsics.project(self.distort(plane).extend(1.0));
            let inside = source.cmpge(DVec2::ZERO).all() && source.cmple(size).all();
            if !(inside && plane.length_squared() <= fold) {
                continue;
            }
            range::wanted(self.turns_over(plane) > 0.0, || {
                format!("{} cannot be undone: at pixel {pixel} it folds the picture over", named())
            })?;
            left += 1;
        }
        let share = f64::from(left) / f64::from(CHECKED * CHECKED);
        range::wanted(share >= LEAST_LEFT, || {
            format!("{} leaves only {:.1} % of the picture", named(), 100.0 * share)
        })
    }

    /// The determinant of [`distort`](Self::distort)'s derivative: below zero it mirrors.
    fn turns_over(&self, p: DVec2) -> f64 {
        let [k1, k2, k3, k4] = self.radial;
        let [p1, p2] = self.tangential;
        let r2 = p.length_squared();
        let factor = 1.0 + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * k4)));
        let slope = k1 + r2 * (2.0 * k2 + r2 * (3.0 * k3 + r2 * 4.0 * k4));
        let xx = factor + 2.0 * p.x * p.x * slope + 2.0 * p1 * p.y + 6.0 * p2 * p.x;
        let yy = factor + 2.0 * p.y * p.y * slope + 6.0 * p1 * p.y + 2.0 * p2 * p.x;
        let xy = 2.0 * p.x * p.y * slope + 2.0 * p1 * p.x + 2.0 * p2 * p.y;
        xx * yy - xy * xy
    }

    /// Whether every coefficient is zero.
    pub fn is_none(&self) -> bool {
        self.radial == [0.0; 4] && self.tangential == [0.0; 2]
    }

    /// Where the lens puts the point that a pinhole puts at `p`, both in the plane of unit depth.
    pub fn distort(&self, p: DVec2) -> DVec2 {
        let [k1, k2, k3, k4] = self.radial;
        let [p1, p2] = self.tangential;
        let r2 = p.length_squared();
        let factor = 1.0 + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * k4)));
        let tangential = DVec2::new(
            2.0 * p1 * p.x * p.y + p2 * (r2 + 2.0 * p.x * p.x),
            p1 * (r2 + 2.0 * p.y * p.y) + 2.0 * p2 * p.x * p.y,
        );
        p * factor + tangential
    }

    /// The squared radius from which on the polynomial folds back: beyond it, it no longer describes
    /// the lens, and two directions share a pixel. At most `limit`.
    fn fold(&self, limit: f64) -> f64 {
        let [k1, k2, k3, k4] = self.radial;
        let rising = |r2: f64| {
            1.0 + r2 * (3.0 * k1 + r2 * (5.0 * k2 + r2 * (7.0 * k3 + r2 * 9.0 * k4))) > 0.0
        };
        const STEPS: u32 = 1024;
        (1..=STEPS)
            .map(|i| limit * f64::from(i) / f64::from(STEPS))
            .find(|&r2| !rising(r2))
            .unwrap_or(limit)
    }

    /// Resamples what the lens saw to what a pinhole of the same intrinsics sees, bilinearly.
    /// The second image (one channel) is 1 where a pixel's source lies inside the picture and 0
    /// elsewhere; `None` where that is everywhere.
    pub fn undistort(&self, image: &Image, intrinsics: &Intrinsics) -> (Image, Option<Image>) {
        let (width, height) = (image.width as usize, image.height as usize);
        let channels = image.channels as usize;
        let size = DVec2::new(width as f64, height as f64);
        let fold = self.fold(reach(intrinsics, size));
        let mut out = Image::new(image.width, image.height, image.channels);
        let mut valid = Image::new(image.width, image.height, 1);
        out.pixels
            .par_chunks_mut((width * channels).max(1))
            .zip(valid.pixels.par_chunks_mut(width.max(1)))
            .enumerate()
            .for_each(|(y, (row, valid))| {
                for x in 0..width {
                    let pixel = DVec2::new(x as f64 + 0.5, y as f64 + 0.5);
                    let plane = intrinsics.ray(pixel).truncate();
                    if plane.length_squared() > fold {
                        continue;
                    }
                    let source = intrinsics.project(self.distort(plane).extend(1.0));
                    let values = &mut row[x * channels..(x + 1) * channels];
                    if sample(image, source, values) {
                        valid[x] = 1.0;
                    }
                }
            });
        let whole = valid.pixels.iter().all(|&v| v == 1.0);
        (out, (!whole).then_some(valid))
    }
}

/// The largest squared radius, in the plane of unit depth, of a pinhole's picture of some size.
fn reach(intrinsics: &Intrinsics, size: DVec2) -> f64 {
    [(0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (1.0, 1.0)]
        .map(|(x, y)| DVec2::new(x, y) * size)
        .map(|corner| intrinsics.ray(corner).truncate().length_squared())
        .into_iter()
        .fold(0.0, f64::max)
}

/// Samples bilinearly at a pixel position (centres at +0.5); the outermost half pixel repeats the
/// edge. False, with nothing written, where the position lies outside the picture.
fn sample(image: &Image, at: DVec2, out: &mut [f32]) -> bool {
    let (width, height) = (image.width as f64, image.height as f64);
    if !(at.x >= 0.0 && at.y >= 0.0 && at.x <= width && at.y <= height) {
        return false;
    }
    let x = (at.x - 0.5).clamp(0.0, width - 1.0);
    let y = (at.y - 0.5).clamp(0.0, height - 1.0);
    let (x0, y0) = (x.floor(), y.floor());
    let (fx, fy) = ((x - x0) as f32, (y - y0) as f32);
    let (x0, y0) = (x0 as u32, y0 as u32);
    let (x1, y1) = ((x0 + 1).min(image.width - 1), (y0 + 1).min(image.height - 1));
    let (a, b) = (image.at(x0, y0), image.at(x1, y0));
    let (c, d) = (image.at(x0, y1), image.at(x1, y1));
    for (i, value) in out.iter_mut().enumerate() {
        let upper = a[i] + (b[i] - a[i]) * fx;
        let lower = c[i] + (d[i] - c[i]) * fx;
        *value = upper + (lower - upper) * fy;
    }
    true
}

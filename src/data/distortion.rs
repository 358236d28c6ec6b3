//! Lens distortion: the mapping from ideal pinhole directions to those of a lens.

use glam::{DMat2, DVec2};
use serde::{Deserialize, Serialize};

use crate::types::Intrinsics;
use crate::types::range::{self, Check};

/// Brown–Conrady distortion as OpenCV, COLMAP and nerfstudio write it: with r² = x² + y² in the
/// plane of unit depth, the radial factor is 1 + k1 r² + k2 r⁴ + k3 r⁶ + k4 r⁸, and p1, p2 are
/// tangential.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Distortion {
    /// Radial coefficients k1 … k4.
    pub radial: [f64; 4],
    /// Tangential coefficients p1, p2.
    pub tangential: [f64; 2],
}

/// Minimum share of an image that must remain after undistortion.
const LEAST_LEFT: f64 = 0.1;
/// Number of sample positions along each side of an image for [`Distortion::check`].
const CHECKED: u32 = 33;

impl Distortion {
    /// Checks that the distortion is valid for an image with these intrinsics: no two directions share a
    /// pixel that [`Lens::undistort`](super::Lens::undistort) samples, and it finds a source for at least a
    /// tenth of the pixels.
    ///
    /// # Errors
    /// A message that says what is wrong.
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
                format!("{} cannot be undone: at pixel {pixel} it folds the image over", named())
            })?;
            left += 1;
        }
        let share = f64::from(left) / f64::from(CHECKED * CHECKED);
        range::wanted(share >= LEAST_LEFT, || {
            format!("{} leaves only {:.1} % of the image", named(), 100.0 * share)
        })
    }

    /// The determinant of [`distort`](Self::distort)'s Jacobian; negative where the mapping is mirrored.
    fn turns_over(&self, p: DVec2) -> f64 {
        self.slopes(p).determinant()
    }

    /// The Jacobian of [`distort`](Self::distort).
    fn slopes(&self, p: DVec2) -> DMat2 {
        let [k1, k2, k3, k4] = self.radial;
        let [p1, p2] = self.tangential;
        let r2 = p.length_squared();
        let factor = 1.0 + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * k4)));
        let slope = k1 + r2 * (2.0 * k2 + r2 * (3.0 * k3 + r2 * 4.0 * k4));
        let xx = factor + 2.0 * p.x * p.x * slope + 2.0 * p1 * p.y + 6.0 * p2 * p.x;
        let yy = factor + 2.0 * p.y * p.y * slope + 6.0 * p1 * p.y + 2.0 * p2 * p.x;
        let xy = 2.0 * p.x * p.y * slope + 2.0 * p1 * p.x + 2.0 * p2 * p.y;
        DMat2::from_cols(DVec2::new(xx, xy), DVec2::new(xy, yy))
    }

    /// Whether every coefficient is zero.
    pub fn is_none(&self) -> bool {
        self.radial == [0.0; 4] && self.tangential == [0.0; 2]
    }

    /// Maps an ideal pinhole position `p` to its distorted position, both in the plane of unit depth.
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

    /// Squared radius at which the radial polynomial stops increasing; beyond it, two directions share a
    /// pixel and the polynomial no longer describes the lens. At most `limit`.
    pub(super) fn fold(&self, limit: f64) -> f64 {
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

    /// Maps a distorted position `m` to its ideal pinhole position, both in the plane of unit depth: the
    /// inverse of [`distort`](Self::distort), by Newton's method. `None` where the lens has no image or
    /// where the mapping folds over.
    pub fn undistort(&self, m: DVec2) -> Option<DVec2> {
        let mut p = m;
        for _ in 0..30 {
            let off = self.distort(p) - m;
            if off.length() <= 1e-14 * (1.0 + m.length()) {
                break;
            }
            let slopes = self.slopes(p);
            let determinant = slopes.determinant();
            if !(determinant > 0.0 && p.is_finite()) {
                return None;
            }
            p -= slopes.inverse() * off;
        }
        let solved = (self.distort(p) - m).length() <= 1e-10 * (1.0 + m.length());
        let upright = self.turns_over(p) > 0.0;
        (solved && upright && p.length_squared() <= self.fold(p.length_squared())).then_some(p)
    }
}

/// Largest squared radius, in the plane of unit depth, of a pinhole image of some size.
pub(super) fn reach(intrinsics: &Intrinsics, size: DVec2) -> f64 {
    [(0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (1.0, 1.0)]
        .map(|(x, y)| DVec2::new(x, y) * size)
        .map(|corner| intrinsics.ray(corner).truncate().length_squared())
        .into_iter()
        .fold(0.0, f64::max)
}

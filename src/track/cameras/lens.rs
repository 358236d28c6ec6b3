//! Estimation of the lens distortion from the static tracks.

use glam::DVec2;

use super::adjustment::POINTS;
use super::{Cameras, Focal, Standpoint};
use crate::Result;
use crate::data::{Distortion, Lens};
use crate::geometry::bundle::{self, adjust};
use crate::observe::PointTrack;

/// Maximum displacement, as a share of the image width, up to which a lens counts as a pinhole.
const LEAST: f64 = 1.5e-3;
/// Number of its standard deviations that k1 must exceed. The errors of tracks are correlated but the normal
/// equations treat them as independent, so the computed deviations are several times too small.
const SURE: f64 = 15.0;
/// Maximum difference between k1 from each half of the tracks and k1 from all of them, relative to the
/// latter.
const AGREES: f64 = 0.75;
/// Number of passes of triangulation and adjustment.
const PASSES: usize = 2;

impl Cameras {
    /// Estimates the lens that fits the static tracks better than a pinhole, and the cameras with it. `None`
    /// if the clip does not determine one. Depths in the returned `anchors` are along undistorted rays.
    ///
    /// k1 is adjusted together with poses, depths and focal length. The lens is accepted if k1 displaces
    /// pixels visibly, exceeds its own uncertainty, and is similar in the first and in the second half of the
    /// tracks. Effects of movers, rolling shutter and wrong poses differ between the halves.
    ///
    /// # Errors
    /// Those of the adjustment.
    pub fn lens(
        &self,
        tracks: &[PointTrack],
        weights: &[f64],
        focal: &Focal,
    ) -> Result<Option<(Lens, Cameras)>> {
        if self.standpoint != Standpoint::Moves {
            return Ok(None);
        }
        let mut found = self.clone();
        let mut report = found.adjust_with_lens(tracks, weights, focal)?;
        for _ in 1..PASSES {
            found.measure_depths(tracks, weights);
            report = found.adjust_with_lens(tracks, weights, focal)?;
        }
        let k = found.intrinsics;
        let (x, y) = (k.cx.max(f64::from(k.width) - k.cx), k.cy.max(f64::from(k.height) - k.cy));
        let corner = (x / k.fx).hypot(y / k.fy);
        let moved = found.k1.abs() * corner.powi(3) * k.fx / f64::from(k.width);
        let sure = found.k1.abs() > SURE * report.k1_std;
        if !(moved > LEAST && sure) {
            return Ok(None);
        }
        let middle = self.poses.len() / 2;
        for early in [true, false] {
            let part: Vec<f64> = tracks
                .iter()
                .zip(weights)
                .map(|(track, weight)| {
                    let mean = (track.first() + track.end()) / 2;
                    if (mean <= middle) == early { *weight } else { 0.0 }
                })
                .collect();
            let mut alone = Cameras { k1: found.k1, ..found.clone() };
            alone.adjust_with_lens(tracks, &part, &Focal { held: true, ..focal.clone() })?;
            if (alone.k1 - found.k1).abs() > AGREES * found.k1.abs() {
                return Ok(None);
            }
        }
        let lens = found.current_lens();
        found.intrinsics = lens.full_pinhole();
        found.k1 = 0.0;
        Ok(Some((lens, found)))
    }

    /// Triangulates all weighted tracks after undistortion with the current lens.
    fn measure_depths(&mut self, tracks: &[PointTrack], weights: &[f64]) {
        let lens = self.current_lens();
        let undistorted: Vec<PointTrack> = tracks
            .iter()
            .map(|track| {
                let pixel = |p: &DVec2| lens.undistort_pixel(&lens.intrinsics, *p).unwrap_or(*p);
                PointTrack { pixels: track.pixels.iter().map(pixel).collect(), ..track.clone() }
            })
            .collect();
        let posed = vec![true; self.poses.len()];
        self.triangulate(&undistorted, weights, &posed, true);
    }

    fn current_lens(&self) -> Lens {
        let radial = [self.k1, 0.0, 0.0, 0.0];
        let distortion = Distortion { radial, ..Default::default() };
        Lens { intrinsics: self.intrinsics, distortion }
    }

    /// Adjusts all parameters, including k1.
    fn adjust_with_lens(
        &mut self,
        tracks: &[PointTrack],
        weights: &[f64],
        focal: &Focal,
    ) -> Result<bundle::Report> {
        let posed = vec![true; self.poses.len()];
        let (mut problem, chosen) = self.problem(tracks, weights, &posed, POINTS);
        let options = bundle::Options { distortion: true, ..self.options(focal.mode(), 4) };
        let report = adjust(&mut problem, &options)?;
        self.take(problem, &chosen, &posed);
        Ok(report)
    }
}

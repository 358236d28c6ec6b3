//! The distortion of the lens, as far as the static tracks show it.

use glam::DVec2;

use super::adjustment::POINTS;
use super::{Cameras, Focal, Standpoint};
use crate::Result;
use crate::data::{Distortion, Lens};
use crate::geometry::bundle::{self, adjust};
use crate::observe::PointTrack;

/// A lens that moves no pixel by more than this share of the picture's width is a pinhole.
const LEAST: f64 = 1.5e-3;
/// k1 is believed from so many of its standard deviations on. Errors of tracks hang together, and the
/// normal equations take them to be independent: told deviations are several times too small.
const SURE: f64 = 15.0;
/// The parts of a clip that each show k1 for themselves may differ from the whole by this share of it.
const AGREES: f64 = 0.75;
/// Times that points are triangulated and everything is adjusted.
const PASSES: usize = 2;

impl Cameras {
    /// The lens with which the static tracks agree better than with a pinhole, and the cameras with it; none
    /// where the clip does not show one. Depths in `anchors` are along undistorted rays then.
    ///
    /// k1 is adjusted together with poses, depths and focal length. It has to move pixels by what can be
    /// seen, to stand out from its own uncertainty, and to be much the same in the first and in the second
    /// half of the tracks: movers, rolling shutter and wrong poses are not.
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

    /// Triangulates all tracks that count, as the lens has them.
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

    /// Adjusts everything, k1 among it.
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

//! Triangulation of the static tracks and bundle adjustment of all frames that have a pose.

use std::collections::HashMap;

use glam::DVec2;
use rayon::prelude::*;

use super::focal::ASSUMED;
use super::{Anchor, Cameras, DEVIATION, Focal, Kept, Standpoint, information};
use crate::Result;
use crate::geometry::bundle::{
    self, FocalMode, Observation, Point, PoseDeviation, Problem, adjust,
    focal_deviation_of_regions, pose_deviations,
};
use crate::geometry::triangulate::inverse_depth;
use crate::observe::PointTrack;
use crate::track::FocalSource;

/// Relative standard deviation of a focal length that is neither given nor measured.
const ASSUMED_DEVIATION: f64 = 0.25;
/// Lower bound of the scale of the residuals, in standard deviations of an observation.
const DEVIATION_FLOOR: f64 = 0.5;
/// Maximum number of points in the last adjustment.
pub(super) const POINTS: usize = 4000;

impl Cameras {
    /// Adjusts poses, structure and focal length to the static tracks.
    ///
    /// # Errors
    /// No track has enough weight, or the adjustment diverged.
    pub fn adjust(&mut self, tracks: &[PointTrack], weights: &[f64], focal: &Focal) -> Result<()> {
        let posed = vec![true; self.poses.len()];
        self.triangulate(tracks, weights, &posed, true);
        let report = self.solve(tracks, weights, &posed, focal.mode(), POINTS, 4)?;
        if !focal.held {
            self.focal_std = report.focal_std.min(focal.deviation);
            if report.focal_released {
                // The errors of neighbouring tracks are alike.
                let (problem, _) = self.problem(tracks, weights, &posed, POINTS);
                self.focal_std =
                    focal_deviation_of_regions(&problem, &self.options(focal.mode(), 1))?;
                self.focal_source = FocalSource::Measured;
            }
        }
        self.inlier_share = report.inlier_ratio;
        self.rms = report.inlier_rmse;
        Ok(())
    }

    /// Triangulates static tracks that are seen by frames with poses; with `afresh` also those that have a
    /// depth already. Three views have to agree, which excludes points of movers that the masks missed. For a
    /// camera that rotates in place all points are put at infinity.
    pub(super) fn triangulate(
        &mut self,
        tracks: &[PointTrack],
        weights: &[f64],
        posed: &[bool],
        afresh: bool,
    ) {
        if self.standpoint == Standpoint::Turns {
            return self.put_far(tracks, weights);
        }
        let width = f64::from(self.intrinsics.width);
        let tolerance = 1.5 * self.strictness.factor() * (width / 320.0).max(1.0);
        let found: Vec<Option<Anchor>> = tracks
            .par_iter()
            .enumerate()
            .map(|(i, track)| {
                let known = self.anchors[i];
                if weights[i] <= 0.05 || (known.is_some() && !afresh) {
                    return known;
                }
                let seen: Vec<usize> =
                    (0..track.frames.len()).filter(|&k| posed[track.frames[k]]).collect();
                if seen.len() < 3 {
                    return known;
                }
                let frame = known.map_or(track.frames[seen[0]], |a| a.frame);
                let pixel = track.at(frame)?;
                let reference = self.poses[frame].inverse();
                let views: Vec<_> = seen
                    .iter()
                    .map(|&k| (track.frames[k], k))
                    .filter(|(f, _)| *f != frame)
                    .map(|(f, k)| {
                        let weight = information(track.deviation_at(k));
                        (self.poses[f] * reference, track.pixels[k], weight)
                    })
                    .collect();
                let d = inverse_depth(&self.intrinsics, pixel, &views, tolerance)?;
                // Without parallax a depth is noise that would bias the next pose.
                let certain = d.deviation < 0.5 * d.value.max(1e-9) || d.deviation < 1e-3;
                (d.rmse < tolerance && (certain || afresh))
                    .then_some(Anchor { frame, inverse_depth: d.value })
            })
            .collect();
        self.anchors = found;
    }

    /// Runs one bundle adjustment over the frames with poses, on up to `most` tracks that cover all frames
    /// and image regions evenly.
    pub(super) fn solve(
        &mut self,
        tracks: &[PointTrack],
        weights: &[f64],
        posed: &[bool],
        focal: FocalMode,
        most: usize,
        rounds: usize,
    ) -> Result<bundle::Report> {
        let (mut problem, chosen) = self.problem(tracks, weights, posed, most);
        let options = self.options(focal, rounds);
        let report = adjust(&mut problem, &options)?;
        self.take(problem, &chosen, posed);
        Ok(report)
    }

    /// Copies the result of an adjusted problem to the frames with poses and to the chosen tracks.
    pub(super) fn take(&mut self, problem: Problem, chosen: &[usize], posed: &[bool]) {
        for (f, pose) in (0..posed.len()).filter(|&f| posed[f]).zip(&problem.poses) {
            self.poses[f] = *pose;
        }
        for (point, &i) in problem.points.iter().zip(chosen) {
            if let Some(anchor) = &mut self.anchors[i] {
                anchor.inverse_depth = point.inverse_depth;
            }
        }
        (self.intrinsics, self.k1) = (problem.intrinsics, problem.k1);
    }

    /// The adjustment problem over the frames with poses and up to `most` tracks that cover all frames and
    /// image regions evenly, and the indices of these tracks.
    pub(super) fn problem(
        &self,
        tracks: &[PointTrack],
        weights: &[f64],
        posed: &[bool],
        most: usize,
    ) -> (Problem, Vec<usize>) {
        let places: Vec<usize> = (0..posed.len()).filter(|&f| posed[f]).collect();
        let mut place_of = vec![usize::MAX; posed.len()];
        places.iter().enumerate().for_each(|(place, &f)| place_of[f] = place);
        let chosen = self.choose(tracks, weights, posed, most);
        let mut problem = Problem {
            intrinsics: self.intrinsics,
            k1: self.k1,
            poses: places.iter().map(|&f| self.poses[f]).collect(),
            fixed: places.iter().map(|_| self.kept == Kept::Poses).collect(),
            points: Vec::with_capacity(chosen.len()),
            observations: Vec::new(),
        };
        if let Some(first) = problem.fixed.first_mut() {
            *first = true;
        }
        for &i in &chosen {
            let track = &tracks[i];
            let Some(Anchor { frame, inverse_depth }) = self.anchors[i] else { continue };
            let Some(anchored) = track.place(frame) else { continue };
            let point = problem.points.len();
            problem.points.push(Point {
                frame: place_of[frame],
                pixel: track.pixels[anchored],
                inverse_depth,
                prior: None,
            });
            for (k, &f) in track.frames.iter().enumerate() {
                if posed[f] && f != frame {
                    let since = track.deviation_between(anchored, k);
                    problem.observations.push(Observation {
                        point,
                        frame: place_of[f],
                        pixel: track.pixels[k],
                        weight: weights[i],
                        deviation: DEVIATION.hypot(f64::from(since)),
                    });
                }
            }
        }
        (problem, chosen)
    }

    /// The options of the adjustment.
    pub(super) fn options(&self, focal: FocalMode, rounds: usize) -> bundle::Options {
        let side = f64::from(self.intrinsics.width.max(self.intrinsics.height));
        bundle::Options {
            focal,
            depths: self.have_parallax(),
            rotations: self.kept != Kept::Rotations,
            focal_prior: match self.focal_source {
                FocalSource::Assumed => Some((ASSUMED * side, ASSUMED_DEVIATION)),
                _ => self.focal_prior,
            },
            scale_floor: DEVIATION_FLOOR,
            rounds,
            ..Default::default()
        }
    }

    /// Standard deviations of the poses from the static tracks, per frame. `None` for a fixed camera, for one
    /// that rotates in place (the accuracy of its rotations is limited by its own translation, which is not
    /// modelled), and for supplied poses that are kept.
    pub fn deviations(&self, tracks: &[PointTrack], weights: &[f64]) -> Vec<Option<PoseDeviation>> {
        if !self.have_parallax() || self.kept == Kept::Poses {
            return vec![None; self.poses.len()];
        }
        let (problem, _) = self.problem(tracks, weights, &vec![true; self.poses.len()], POINTS);
        let mode = match self.focal_source {
            FocalSource::Given => FocalMode::Fixed,
            _ => FocalMode::Free,
        };
        // A problem without observations gives no deviations.
        let found = pose_deviations(&problem, &self.options(mode, 1));
        found.unwrap_or_else(|_| vec![None; self.poses.len()])
    }

    /// Chooses tracks with a depth that are seen in at least two posed frames besides their first. Long
    /// tracks come first, until each cell of each frame has its share.
    fn choose(
        &self,
        tracks: &[PointTrack],
        weights: &[f64],
        posed: &[bool],
        most: usize,
    ) -> Vec<usize> {
        const COLUMNS: usize = 12;
        const ROWS: usize = 8;
        let (w, h) = (f64::from(self.intrinsics.width), f64::from(self.intrinsics.height));
        let cell = |p: DVec2| {
            let x = (p.x / w * COLUMNS as f64).clamp(0.0, COLUMNS as f64 - 1.0) as usize;
            let y = (p.y / h * ROWS as f64).clamp(0.0, ROWS as f64 - 1.0) as usize;
            y * COLUMNS + x
        };
        let views = |t: &PointTrack| t.frames.iter().filter(|f| posed[**f]).count() - 1;
        let mut order: Vec<(usize, usize)> = (0..tracks.len())
            .filter(|&i| weights[i] > 0.05 && self.anchors[i].is_some_and(|a| posed[a.frame]))
            .map(|i| (views(&tracks[i]), i))
            .filter(|(views, _)| *views >= 2)
            .collect();
        order.sort_by_key(|(views, i)| (std::cmp::Reverse(*views), *i));
        let frames = posed.iter().filter(|p| **p).count();
        let mean_views =
            order.iter().map(|o| o.0 + 1).sum::<usize>() as f64 / order.len().max(1) as f64;
        let share = (most as f64 * mean_views / (frames * COLUMNS * ROWS) as f64).ceil().max(2.0);
        let mut counts: HashMap<(usize, usize), usize> = HashMap::new();
        let mut chosen = Vec::new();
        for (views, i) in order {
            let track = &tracks[i];
            let cells: Vec<_> = (track.frames.iter().zip(&track.pixels))
                .filter(|(f, _)| posed[**f])
                .map(|(f, pixel)| (*f, cell(*pixel)))
                .collect();
            let open =
                cells.iter().filter(|c| (counts.get(c).copied().unwrap_or(0) as f64) < share);
            if 2 * open.count() > views {
                cells.into_iter().for_each(|c| *counts.entry(c).or_default() += 1);
                chosen.push(i);
                if chosen.len() == most {
                    break;
                }
            }
        }
        chosen.sort_unstable();
        chosen
    }
}

#[cfg(test)]
mod tests {
    use glam::DVec2;

    use super::super::super::sliding::*;

    use crate::observe::PointTrack;

    fn track(pixels: Vec<DVec2>) -> PointTrack {
        PointTrack::followed(0, pixels.clone(), vec![0.1; pixels.len()])
    }

    #[test]
    fn static_tracks_get_their_depth() {
        let mut cameras = cameras(STEP);
        let wall =
            |x: f64| track((0..5).map(|f| DVec2::new(x, 20.0) + wall() * f as f64).collect());
        let down = |x: f64| {
            track((0..5).map(|f| DVec2::new(x, 9.0) + DVec2::new(-2.0, 4.0) * f as f64).collect())
        };
        let tracks = [wall(40.0), wall(30.0), down(50.0), wall(50.0)];
        cameras.anchors = vec![None; 4];
        cameras.triangulate(&tracks, &[1.0, 1.0, 1.0, 0.0], &[true; FRAMES], true);
        for i in [0, 1] {
            let point = cameras.point(&tracks, i).unwrap();
            assert!((point.z - WALL).abs() < 1e-6, "{point}");
        }
        assert!(cameras.anchors[2].is_none(), "it leaves its epipolar lines");
        assert!(cameras.anchors[3].is_none(), "it moves, says the mask");
    }
}

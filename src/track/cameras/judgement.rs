//! Measures how well cameras explain the observations.

use glam::DVec2;
use rayon::prelude::*;

use super::{Anchor, Cameras, DEVIATION, information};
use crate::geometry::bundle;
use crate::observe::PointTrack;
use crate::track::quantile;

/// The reprojection of a track's point in a frame.
struct View {
    /// Inverse of the pixel's variance along each axis.
    known: f64,
    /// Vector from the observed to the predicted pixel.
    off: DVec2,
    /// Derivative of the predicted pixel with respect to the inverse depth.
    per_inverse_depth: DVec2,
}

/// The uncertainty of a track's point.
#[derive(Clone, Copy, Debug)]
pub(in crate::track) struct Certainty {
    /// Standard deviation of its depth relative to the depth, computed from the deviations of the track's
    /// pixels.
    pub deviation: f64,
    /// Root mean square of the coordinates of its residuals, in units of the pixels' deviations.
    pub residual: f64,
}

/// Lower bound of the scale of the residuals, pixels.
const SCALE_FLOOR: f64 = 0.1;
/// Squared residual, in deviations, at which an observation is half explained.
const EXPLAINS: f64 = 9.0;

/// Explained share of a frame's observations below which its pose is doubtful.
const DOUBTFUL: f64 = 0.25;

/// Maximum weight of a track that is ignored.
const COUNTS: f64 = 0.05;

/// The explained share of all observations of the tracks, from that of each track.
pub(super) fn explained_by(tracks: &[PointTrack], weights: &[f64], shares: &[f64]) -> f64 {
    let (mut explained, mut seen) = (0.0, 0.0);
    for ((track, weight), share) in tracks.iter().zip(weights).zip(shares) {
        if *weight > COUNTS {
            let views = weight * (track.pixels.len() - 1) as f64;
            explained += views * share;
            seen += views;
        }
    }
    if seen > 0.0 { explained / seen } else { 0.0 }
}

impl Cameras {
    /// Measures how well the static tracks of a fixed camera stay in place, in analogy to an adjustment for a
    /// moving camera: a static point should be at the same pixel in every frame.
    pub fn measure_fixed(&mut self, tracks: &[PointTrack], weights: &[f64]) {
        // Displacement and weight of each observation after a track's first.
        let residuals: Vec<(DVec2, f64)> = tracks
            .iter()
            .zip(weights)
            .filter(|(_, weight)| **weight > COUNTS)
            .flat_map(|(track, weight)| {
                (1..track.pixels.len()).map(move |k| {
                    let known = information(track.deviation_at(k));
                    (track.pixels[k] - track.pixels[0], weight * known)
                })
            })
            .collect();
        let coordinates = residuals.iter().flat_map(|(r, _)| [r.x.abs(), r.y.abs()]).collect();
        let limit = bundle::Options::default().kernel_width
            * (1.4826 * quantile(coordinates, 0.5)).max(SCALE_FLOOR);
        let (mut inliers, mut sum, mut total) = (0usize, 0.0, 0.0);
        for (residual, weight) in residuals.iter().filter(|(r, _)| r.length() <= limit) {
            inliers += 1;
            sum += weight * residual.length_squared();
            total += weight;
        }
        self.inlier_share = inliers as f64 / residuals.len().max(1) as f64;
        self.rms = if total > 0.0 { (sum / total).sqrt() } else { 0.0 };
    }

    /// The uncertainty of the depth of a track's point. `None` without a depth, or if the point is behind a
    /// camera.
    pub fn certainty(&self, tracks: &[PointTrack], i: usize) -> Option<Certainty> {
        let (mut information, mut squares, mut views) = (0.0, 0.0, 0.0);
        for view in self.reprojected(tracks, i)? {
            let View { known, off, per_inverse_depth } = view?;
            information += known * per_inverse_depth.length_squared();
            squares += known * off.length_squared();
            views += 1.0;
        }
        let inverse_depth = self.anchors[i]?.inverse_depth;
        (information > 0.0).then(|| Certainty {
            deviation: (inverse_depth * information.sqrt()).recip(),
            residual: (0.5 * squares / views).sqrt(),
        })
    }

    /// The share of the observations of static tracks that the cameras explain. An observation at its
    /// predicted pixel counts fully; one far from it, or without a depth, does not count. Of two solutions
    /// the better one has the larger share.
    pub fn explained(&self, tracks: &[PointTrack], weights: &[f64]) -> f64 {
        explained_by(tracks, weights, &self.shares(tracks, weights))
    }

    /// Frames in which less than a quarter of the observations of static tracks is explained.
    pub(super) fn frames_in_doubt(&self, tracks: &[PointTrack], weights: &[f64]) -> Vec<usize> {
        let mut sums = vec![(0.0, 0.0); self.poses.len()];
        for (i, track) in tracks.iter().enumerate().filter(|(i, _)| weights[*i] > COUNTS) {
            let Some(frame) = self.anchors[i].map(|anchor| anchor.frame) else { continue };
            let others = track.frames.iter().copied().filter(|f| *f != frame);
            for (f, view) in others.zip(self.reprojected(tracks, i).into_iter().flatten()) {
                let near =
                    |view: View| 1.0 / (1.0 + view.known * view.off.length_squared() / EXPLAINS);
                sums[f].0 += weights[i] * view.map_or(0.0, near);
                sums[f].1 += weights[i];
            }
        }
        let doubtful = |(_, (explained, seen)): &(usize, (f64, f64))| *explained < DOUBTFUL * seen;
        sums.into_iter().enumerate().filter(doubtful).map(|(f, _)| f).collect()
    }

    /// The explained share of the observations of each track; 0 for ignored tracks.
    pub(super) fn shares(&self, tracks: &[PointTrack], weights: &[f64]) -> Vec<f64> {
        // The adjustment has changed the cameras but only the points that it used, so all points are
        // triangulated again.
        let mut cameras = self.clone();
        cameras.triangulate(tracks, weights, &vec![true; self.poses.len()], true);
        let of_track = |i: usize| {
            let near = |view: View| 1.0 / (1.0 + view.known * view.off.length_squared() / EXPLAINS);
            let views = cameras.reprojected(tracks, i).filter(|_| weights[i] > COUNTS);
            let explained: f64 = views.map_or(0.0, |views| views.flatten().map(near).sum());
            explained / (tracks[i].pixels.len() - 1).max(1) as f64
        };
        (0..tracks.len()).into_par_iter().map(of_track).collect()
    }

    /// The reprojections of a track's point in the frames that see it, except the one in which it is
    /// anchored; `None` in a frame where the point is behind the camera.
    fn reprojected<'a>(
        &'a self,
        tracks: &'a [PointTrack],
        i: usize,
    ) -> Option<impl Iterator<Item = Option<View>> + 'a> {
        let near = |anchor: &Anchor| anchor.inverse_depth > 1e-9 || !self.have_parallax();
        let Anchor { frame, inverse_depth } = self.anchors[i].filter(near)?;
        let track = &tracks[i];
        let anchored = track.place(frame)?;
        let pixel = track.pixels[anchored];
        let anchor_from_world = self.poses[frame].inverse();
        let others = track.frames.iter().enumerate().filter(move |(_, f)| **f != frame);
        Some(others.map(move |(k, &f)| {
            let relative = self.poses[f] * anchor_from_world;
            let found = bundle::project(&self.intrinsics, &relative, pixel, inverse_depth);
            let (seen, jacobian) = found?;
            let since = track.deviation_between(anchored, k);
            Some(View {
                known: DEVIATION.hypot(f64::from(since)).powi(-2),
                off: seen - track.pixels[k],
                per_inverse_depth: jacobian.inverse_depth,
            })
        }))
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
    fn a_fixed_cameras_tracks_are_measured() {
        let at = |i: usize| DVec2::new(3.0 * i as f64, 2.0 * i as f64);
        // Nine tracks deviate by 0.1 px, one moves away.
        let mut tracks: Vec<PointTrack> = (1..10)
            .map(|i| track(vec![at(i), at(i) + DVec2::new(0.1, 0.0), at(i) - DVec2::new(0.0, 0.1)]))
            .collect();
        tracks.push(track(vec![at(3), at(3) + DVec2::new(5.0, 0.0), at(3) + DVec2::new(9.0, 0.0)]));
        let mut cameras = cameras(0.0);
        cameras.measure_fixed(&tracks, &[1.0; 10]);
        assert!((cameras.inlier_share - 0.9).abs() < 1e-9, "{}", cameras.inlier_share);
        assert!((cameras.rms - 0.1).abs() < 1e-9, "{}", cameras.rms);
        // A mover without weight has no influence.
        let weights: Vec<f64> = (0..10).map(|i| f64::from(i < 9)).collect();
        cameras.measure_fixed(&tracks, &weights);
        assert_eq!(cameras.inlier_share, 1.0);
        // Without a static track nothing agrees.
        cameras.measure_fixed(&tracks, &[0.0; 10]);
        assert_eq!((cameras.inlier_share, cameras.rms), (0.0, 0.0));
    }

    #[test]
    fn the_better_of_two_solutions_explains_more() {
        let wall =
            |x: f64| track((0..FRAMES).map(|f| DVec2::new(x, 20.0) + wall() * f as f64).collect());
        let tracks: Vec<PointTrack> = (0..20).map(|i| wall(20.0 + 2.0 * f64::from(i))).collect();
        let weights = vec![1.0; tracks.len()];
        let mut right = cameras(STEP);
        right.anchors = vec![None; tracks.len()];
        assert!((right.explained(&tracks, &weights) - 1.0).abs() < 1e-6);
        // One camera has an error of half a pixel.
        let mut wrong = right.clone();
        wrong.poses[3].translation.y += 0.5 * WALL / FOCAL;
        let explained = wrong.explained(&tracks, &weights);
        assert!(explained > 0.3 && explained < 0.95, "{explained}");
        // A track without weight does not count; without weighted tracks the share is 0.
        let mut weights = weights;
        let mut tracks = tracks;
        tracks.push(track((0..FRAMES).map(|f| DVec2::new(9.0, 5.0 + 3.0 * f as f64)).collect()));
        weights.push(0.0);
        right.anchors.push(None);
        assert!((right.explained(&tracks, &weights) - 1.0).abs() < 1e-6);
        weights[20] = 1.0;
        assert!(right.explained(&tracks, &weights) < 0.97);
        assert_eq!(right.explained(&tracks, &[0.0; 21]), 0.0);
    }
}

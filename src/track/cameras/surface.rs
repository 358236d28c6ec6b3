//! Tracks whose depth continues the surface around them.
//!
//! The patch around a track at the edge of a surface contains two depths, and flow is smoothed across the
//! edge. Such a track errs along its epipolar lines. The adjustment explains the error by a wrong depth, so
//! its residuals do not show it and no robust kernel rejects it; but all these errors together bias the
//! cameras, above all the focal length. They do show as depths that differ from those of the neighbours.

use glam::DVec2;
use nalgebra::{Matrix3, Vector3};
use rayon::prelude::*;

use super::Cameras;
use crate::observe::{PointTrack, TrackOptions};
use crate::track::quantile;

/// Radius of the surroundings of a track, in spacings of the tracks.
const RADIUS: f64 = 3.2;
/// Minimum number of neighbours to judge a track by.
const LEAST: usize = 6;
/// Share of the judged tracks that are kept.
const SHARE: f64 = 0.4;
/// Minimum number of tracks of each frame that have to remain.
const PER_FRAME: usize = 50;
/// Relative standard deviation of a depth apart from its uncertainty: the relief of a surface.
const RELIEF: f64 = 0.003;
/// Steps of reweighting of a plane, and the width of its kernel in standard deviations.
const STEPS: usize = 6;
const KERNEL: f64 = 2.5;

/// A static point that a frame sees.
struct Seen {
    track: usize,
    pixel: DVec2,
    inverse_depth: f64,
    deviation: f64,
}

impl Cameras {
    /// The weights of the tracks, 0 for those that depart more than most from the surface around them, in
    /// relation to their depth. Tracks with few neighbours are not judged. All tracks keep their weight where
    /// some frame would be left with too few.
    pub(super) fn on_surfaces(&self, tracks: &[PointTrack], weights: &[f64]) -> Vec<f64> {
        let departures = self.departures(tracks, weights);
        let limit = quantile(departures.iter().flatten().copied().collect(), SHARE);
        let keeps = |(weight, off): (&f64, &Option<f64>)| match off {
            Some(off) if *off > limit => 0.0,
            _ => *weight,
        };
        let kept: Vec<f64> = weights.iter().zip(&departures).map(keeps).collect();
        let counts = |weights: &[f64]| {
            let mut counts = vec![0; self.poses.len()];
            for (i, track) in tracks.iter().enumerate() {
                if weights[i] > 0.05 && self.anchors[i].is_some() {
                    track.frames.iter().for_each(|f| counts[*f] += 1);
                }
            }
            counts
        };
        let few = |(left, all): (usize, usize)| left < PER_FRAME.min(all);
        match counts(&kept).into_iter().zip(counts(weights)).any(few) {
            true => weights.to_vec(),
            false => kept,
        }
    }

    /// How far each static track's inverse depth departs from the surface around it in the frame in which it
    /// is anchored, relative to the inverse depth; `None` where that is not known.
    fn departures(&self, tracks: &[PointTrack], weights: &[f64]) -> Vec<Option<f64>> {
        let k = &self.intrinsics;
        let size = (k.width as usize, k.height as usize);
        let radius = RADIUS * TrackOptions::for_size(size.0, size.1).spacing as f64;
        let mut anchored = vec![Vec::new(); self.poses.len()];
        for (i, anchor) in self.anchors.iter().enumerate() {
            if let Some(anchor) = anchor.filter(|_| weights[i] > 0.05) {
                anchored[anchor.frame].push(i);
            }
        }
        let of_frame = |frame: usize| -> Vec<(usize, f64)> {
            if anchored[frame].is_empty() {
                return Vec::new();
            }
            let seen = self.seen_in(frame, tracks, weights);
            let departs = |&track: &usize| {
                let own = seen.iter().find(|s| s.track == track)?;
                let is_near = |s: &&Seen| {
                    s.track != own.track && s.pixel.distance_squared(own.pixel) < radius * radius
                };
                let near: Vec<&Seen> = seen.iter().filter(is_near).collect();
                let expected = surface(&near, own.pixel)?;
                Some((track, (own.inverse_depth - expected).abs() / own.inverse_depth))
            };
            anchored[frame].iter().filter_map(departs).collect()
        };
        let found: Vec<Vec<(usize, f64)>> =
            (0..self.poses.len()).into_par_iter().map(of_frame).collect();
        let mut departures = vec![None; tracks.len()];
        found.into_iter().flatten().for_each(|(track, off)| departures[track] = Some(off));
        departures
    }

    /// The static points that a frame sees, with their inverse depths in it.
    fn seen_in(&self, frame: usize, tracks: &[PointTrack], weights: &[f64]) -> Vec<Seen> {
        let seen = |track: usize| {
            let pixel = tracks[track].at(frame).filter(|_| weights[track] > 0.05)?;
            let z = self.poses[frame].apply(self.point(tracks, track)?).z;
            let deviation = self.certainty(tracks, track)?.deviation.hypot(RELIEF) / z;
            let inverse_depth = z.recip();
            (z > 0.0).then_some(Seen { track, pixel, inverse_depth, deviation })
        };
        (0..tracks.len()).filter_map(seen).collect()
    }
}

/// The inverse depth at a pixel of the plane through the points around it; `None` where they are too few.
///
/// The inverse depth of a plane is affine in the pixel. The fit starts from the median and is robust, so that
/// where two surfaces meet it is that of most points.
fn surface(near: &[&Seen], pixel: DVec2) -> Option<f64> {
    if near.len() < LEAST {
        return None;
    }
    let median = quantile(near.iter().map(|s| s.inverse_depth).collect(), 0.5);
    let mut plane = Vector3::new(median, 0.0, 0.0);
    for _ in 0..STEPS {
        let (mut normal, mut right) = (Matrix3::zeros(), Vector3::zeros());
        for s in near {
            let from = s.pixel - pixel;
            let row = Vector3::new(1.0, from.x, from.y);
            let residual = (s.inverse_depth - plane.dot(&row)) / (KERNEL * s.deviation);
            // The kernel of Geman and McClure.
            let weight = (s.deviation * (1.0 + residual * residual)).powi(-2);
            normal += weight * row * row.transpose();
            right += weight * s.inverse_depth * row;
        }
        plane = normal.cholesky()?.solve(&right);
    }
    plane.x.is_finite().then_some(plane.x)
}

#[cfg(test)]
mod tests {
    use glam::DVec2;

    use super::super::super::sliding::*;
    use super::super::Anchor;
    use super::*;

    /// Tracks on a grid, all anchored in the first frame on the wall.
    fn grid() -> (Cameras, Vec<PointTrack>) {
        let mut cameras = cameras(STEP);
        let tracks: Vec<PointTrack> = (0..180)
            .map(|i| DVec2::new(f64::from(i % 15), f64::from(i / 15)) * 2.0 + 4.0)
            .map(|first| {
                let pixels: Vec<_> = (0..FRAMES).map(|f| first + wall() * f as f64).collect();
                PointTrack::followed(0, pixels, vec![0.05; FRAMES])
            })
            .collect();
        cameras.anchors =
            vec![Some(Anchor { frame: 0, inverse_depth: WALL.recip() }); tracks.len()];
        (cameras, tracks)
    }

    #[test]
    fn tracks_off_their_surface_lose_their_weight() {
        let (mut cameras, tracks) = grid();
        let off = [20, 47, 96, 110];
        for i in off {
            cameras.anchors[i].as_mut().unwrap().inverse_depth *= 1.05;
        }
        let weights = vec![1.0; tracks.len()];
        let departures = cameras.departures(&tracks, &weights);
        for (i, departure) in departures.iter().enumerate() {
            let departure = departure.unwrap();
            let expected = if off.contains(&i) { 0.05 / 1.05 } else { 0.0 };
            assert!((departure - expected).abs() < 2e-3, "{i}: {departure}");
        }
        let kept = cameras.on_surfaces(&tracks, &weights);
        assert!(off.iter().all(|i| kept[*i] == 0.0));
        let left = kept.iter().filter(|w| **w > 0.0).count() as f64 / tracks.len() as f64;
        assert!((left - SHARE).abs() < 0.05, "{left}");
    }

    #[test]
    fn few_tracks_are_not_judged() {
        let (cameras, mut tracks) = grid();
        // A frame would be left with too few.
        tracks.truncate(60);
        let few = Cameras { anchors: cameras.anchors[..60].to_vec(), ..cameras.clone() };
        assert_eq!(few.on_surfaces(&tracks, &[0.5; 60]), vec![0.5; 60]);
        // Without neighbours there is no surface.
        tracks.truncate(LEAST);
        let few = Cameras { anchors: cameras.anchors[..LEAST].to_vec(), ..cameras };
        assert_eq!(few.departures(&tracks, &[1.0; LEAST]), vec![None; LEAST]);
    }
}

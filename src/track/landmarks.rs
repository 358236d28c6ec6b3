//! Observations of static points: how well they agree with the cameras, and the triangulated points.

use glam::{DVec2, DVec3};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::cameras::{Cameras, DEVIATION, information};
use super::{Track, masks, quantile};
use crate::geometry::bundle::project;
use crate::geometry::triangulate::inverse_depth;
use crate::observe::PointTrack;
use crate::types::{Intrinsics, Pose};

/// The uncertainty of one frame's camera.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct FrameQuality {
    /// Number of observations in this frame of static points that are tracked through three frames or more.
    pub observations: usize,
    /// Number of these that agree with the cameras: they are within three robust standard deviations of the
    /// predicted pixel.
    pub inliers: usize,
    /// Root mean square reprojection error of the agreeing observations, pixels. The first observation of
    /// each track is excluded because the point is triangulated from that pixel. None if there are no such
    /// observations.
    pub rms: Option<f64>,
    /// Standard deviation of the camera's rotation, degrees: the root mean square angle of its error. 0 in
    /// the first frame, which is the reference of all others. None if it was not measured: for a camera that
    /// is fixed or rotates in place, for supplied poses, and where the static points do not determine it.
    pub rotation_std_deg: Option<f64>,
    /// Standard deviation of the camera's position, in the world's unit, with that unit held fixed: the root
    /// mean square distance of its error. It is 0 or none in the same cases as `rotation_std_deg`.
    pub position_std: Option<f64>,
}

/// A triangulated static point and its observations.
#[derive(Clone, Debug, PartialEq)]
pub struct Landmark {
    /// Position in the world.
    pub position: DVec3,
    /// Frame and pixel of each observation, in the order of the frames; at least three. Pixel coordinates
    /// have their origin at the image's corner.
    pub observations: Vec<(usize, DVec2)>,
    /// Mean reprojection error of the observations, pixels.
    pub error: f64,
}

/// Weight above which a track counts as static.
const STATIC: f64 = 0.5;
/// Number of robust standard deviations within which an observation agrees.
const AGREES: f64 = 3.0;
/// Lower bound of the scale of the residuals, in units of an observation's own standard deviation.
const SCALE_FLOOR: f64 = 0.5;
/// Maximum relative standard deviation of a landmark's depth.
const MOST_UNCERTAIN: f64 = 0.2;
/// Minimum number of frames that a point is triangulated from.
const LEAST: usize = 3;

/// The fit of a static track to the cameras.
struct Fit {
    /// Index of the track.
    track: usize,
    /// Inverse depth in the track's first frame.
    inverse_depth: f64,
    /// Standard deviation of the depth, relative to it.
    deviation: f64,
    /// Reprojection error of each pixel of the track, in pixels and in units of its own standard deviation;
    /// infinite if the point is behind the camera. 0 for the first pixel, from which the point is
    /// triangulated.
    off: Vec<(f64, f64)>,
}

/// Fits the static tracks that are long enough to the cameras. Also returns the number of deviations within
/// which an observation agrees.
fn fits(
    intrinsics: &Intrinsics,
    poses: &[Pose],
    tracks: &[PointTrack],
    weights: &[f64],
) -> (Vec<Fit>, f64) {
    let huber = 1.5 * (f64::from(intrinsics.width) / 320.0).max(1.0);
    let fits: Vec<Fit> = (0..tracks.len())
        .into_par_iter()
        .filter(|&i| weights[i] > STATIC && tracks[i].pixels.len() >= LEAST)
        .map(|i| {
            let track = &tracks[i];
            let reference = poses[track.first()].inverse();
            let relative = |k: usize| poses[track.frames[k]] * reference;
            let views: Vec<(Pose, DVec2, f64)> = (1..track.pixels.len())
                .map(|k| (relative(k), track.pixels[k], information(track.deviation_at(k))))
                .collect();
            let found = inverse_depth(intrinsics, track.pixels[0], &views, huber);
            let d = found.map_or(0.0, |found| found.value);
            let behind = (f64::INFINITY, f64::INFINITY);
            let off = |(k, (pose, pixel, _)): (usize, &(Pose, DVec2, f64))| {
                if found.is_none() {
                    return behind;
                }
                project(intrinsics, pose, track.pixels[0], d).map_or(behind, |(seen, _)| {
                    let length = seen.distance(*pixel);
                    (length, length / DEVIATION.hypot(f64::from(track.deviation_at(k + 1))))
                })
            };
            Fit {
                track: i,
                inverse_depth: d,
                // The views are weighted relative to an observation with an error of `DEVIATION` pixels.
                deviation: found.map_or(f64::INFINITY, |found| DEVIATION * found.deviation / d),
                off: [(0.0, 0.0)].into_iter().chain(views.iter().enumerate().map(off)).collect(),
            }
        })
        .collect();
    // The median of a length in two dimensions is 1.1774 times a coordinate's standard deviation.
    let lengths = fits.iter().flat_map(|fit| fit.off[1..].iter().map(|off| off.1)).collect();
    let scale = (quantile(lengths, 0.5) / 1.1774).max(SCALE_FLOOR);
    (fits, AGREES * scale)
}

/// The uncertainty of the cameras of all frames.
pub(super) fn by_frame(
    cameras: &Cameras,
    tracks: &[PointTrack],
    weights: &[f64],
) -> Vec<FrameQuality> {
    let (fits, limit) = fits(&cameras.intrinsics, &cameras.poses, tracks, weights);
    let mut found: Vec<FrameQuality> = cameras
        .deviations(tracks, weights)
        .iter()
        .map(|known| FrameQuality {
            observations: 0,
            inliers: 0,
            rms: None,
            rotation_std_deg: known.map(|known| known.rotation.to_degrees()),
            position_std: known.map(|known| known.position),
        })
        .collect();
    let mut sums = vec![(0.0, 0usize); found.len()];
    for fit in &fits {
        let frames = &tracks[fit.track].frames;
        let agrees = |off: &(f64, f64)| off.1 <= limit;
        let agreeing = fit.off[1..].iter().filter(|off| agrees(off)).count();
        for (k, off) in fit.off.iter().enumerate() {
            let frame = &mut found[frames[k]];
            frame.observations += 1;
            // The point lies exactly on its first pixel, so that pixel counts as agreeing if most others do.
            let inlier = if k > 0 { agrees(off) } else { 2 * agreeing >= fit.off.len() - 1 };
            frame.inliers += usize::from(inlier);
            if inlier && k > 0 {
                let (sum, count) = &mut sums[frames[k]];
                *sum += off.0 * off.0;
                *count += 1;
            }
        }
    }
    for (frame, (sum, count)) in found.iter_mut().zip(sums) {
        frame.rms = (count > 0).then(|| (sum / count as f64).sqrt());
    }
    found
}

impl Track {
    /// The static points of `tracks` that the cameras triangulate, each with the observations that agree with
    /// it. Empty for a camera that does not change its position.
    pub fn landmarks(&self) -> Vec<Landmark> {
        let weights = masks::static_weights(&self.tracks, &self.masks);
        landmarks(&self.intrinsics, &self.view_from_world, &self.tracks, &weights)
    }
}

fn landmarks(
    intrinsics: &Intrinsics,
    poses: &[Pose],
    tracks: &[PointTrack],
    weights: &[f64],
) -> Vec<Landmark> {
    let (fits, limit) = fits(intrinsics, poses, tracks, weights);
    let landmark = |fit: &Fit| {
        let track = &tracks[fit.track];
        let known = fit.inverse_depth > 0.0 && fit.deviation < MOST_UNCERTAIN;
        let kept: Vec<usize> = (0..fit.off.len()).filter(|&k| fit.off[k].1 <= limit).collect();
        let error = kept.iter().map(|&k| fit.off[k].0).sum::<f64>() / kept.len() as f64;
        let position = poses[track.first()]
            .inverse()
            .apply(intrinsics.ray(track.pixels[0]) / fit.inverse_depth);
        (known && kept.len() >= LEAST && position.is_finite()).then(|| Landmark {
            position,
            observations: kept.iter().map(|&k| (track.frames[k], track.pixels[k])).collect(),
            error,
        })
    };
    fits.iter().filter_map(landmark).collect()
}

#[cfg(test)]
mod tests {
    use super::super::cameras::Standpoint;
    use super::super::sliding::*;
    use super::*;

    /// Points of the wall, tracked from the first frame to the last.
    fn wall_tracks() -> Vec<PointTrack> {
        let at = |i: usize| DVec2::new(14.0 + 2.0 * i as f64, 6.0 + i as f64);
        let track = |i: usize| {
            let pixels = (0..FRAMES).map(|f| at(i) + wall() * f as f64).collect();
            PointTrack::followed(0, pixels, vec![0.1; FRAMES])
        };
        (0..24).map(track).collect()
    }

    #[test]
    fn landmarks_are_where_the_wall_is() {
        let cameras = cameras(STEP);
        let mut tracks = wall_tracks();
        // One track slips in a frame, one moves down, one is too short, one counts as moving.
        tracks[0].pixels[3].y += 2.0;
        tracks[1].pixels.iter_mut().enumerate().for_each(|(f, pixel)| pixel.y += 1.5 * f as f64);
        tracks[2] = tracks[2].places(0..2);
        let mut weights = vec![1.0; tracks.len()];
        weights[3] = 0.2;
        let found = landmarks(&cameras.intrinsics, &cameras.poses, &tracks, &weights);
        assert_eq!(found.len(), 21);
        for Landmark { position, observations, error } in &found[1..] {
            assert!((position.z - WALL).abs() < 1e-6, "{position}");
            assert!(observations.len() == FRAMES && *error < 1e-6, "{error}");
        }
        // With Huber's kernel the slip still influences the depth a little.
        assert!((found[0].position.z / WALL - 1.0).abs() < 0.02, "{}", found[0].position);
        let frames: Vec<usize> = found[0].observations.iter().map(|seen| seen.0).collect();
        assert_eq!(frames, [0, 1, 2, 4, 5], "without the frame in which it slips");
    }

    #[test]
    fn a_camera_that_is_off_shows_in_its_frame() {
        let tracks = wall_tracks();
        let weights = vec![1.0; tracks.len()];
        let mut cameras = cameras(STEP);
        cameras.anchors = vec![None; tracks.len()];
        let found = by_frame(&cameras, &tracks, &weights);
        assert!(found.iter().all(|f| (f.observations, f.inliers) == (24, 24)), "{found:?}");
        assert!(found[0].rms.is_none() && found[1].rms.unwrap() < 1e-6);
        assert_eq!(found[1].position_std, None, "nothing was adjusted");
        cameras.poses[4].translation.y += 2.0 * WALL / FOCAL;
        let found = by_frame(&cameras, &tracks, &weights);
        assert!(found[4].inliers == 0 && found[4].rms.is_none(), "{found:?}");
        assert_eq!((found[3].inliers, found[5].inliers), (24, 24));
    }

    #[test]
    fn a_fixed_camera_sees_no_landmarks_but_what_stays() {
        let mut cameras = cameras(0.0);
        cameras.standpoint = Standpoint::Fixed;
        let still = |i: usize| {
            let pixels = vec![DVec2::new(9.0 + i as f64, 9.0); FRAMES];
            PointTrack::followed(0, pixels, vec![0.1; FRAMES])
        };
        let tracks: Vec<PointTrack> = (0..9).map(still).collect();
        let weights = vec![1.0; tracks.len()];
        assert!(landmarks(&cameras.intrinsics, &cameras.poses, &tracks, &weights).is_empty());
        let found = by_frame(&cameras, &tracks, &weights);
        assert!(found.iter().all(|frame| frame.inliers == 9), "{found:?}");
        assert!(found.iter().all(|frame| frame.rotation_std_deg.is_none()));
    }
}

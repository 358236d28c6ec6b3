//! What the frames saw of static points: how far that agrees with the cameras, and the points
//! themselves.

use glam::{DVec2, DVec3};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::cameras::{Cameras, DEVIATION, information};
use super::{Track, masks, quantile};
use crate::geometry::bundle::project;
use crate::geometry::triangulate::inverse_depth;
use crate::observe::PointTrack;
use crate::types::{Intrinsics, Pose};

/// How well one frame's camera is known.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct FrameQuality {
    /// How often the frame sees a static point that is followed through three frames or more.
    pub observations: usize,
    /// How many of these agree with the cameras: within three robust standard deviations of where the
    /// point should be.
    pub inliers: usize,
    /// Root mean square reprojection error of those, pixels; the frame that a point is first seen in, from
    /// where it is followed, counts among the others only. None without any.
    pub rms: Option<f64>,
    /// Standard deviation of the camera's rotation, degrees: the root mean square angle that it is off by.
    /// 0 in the first frame, which all others are measured from. None where it was not measured: of a camera
    /// that is fixed or turns in place, of supplied poses, and where the static points do not determine it.
    pub rotation_std_deg: Option<f64>,
    /// Standard deviation of the camera's place, in the world's unit, which is held: the root mean square
    /// distance that it is off by. 0 and none as the rotation's.
    pub position_std: Option<f64>,
}

/// A static point that was triangulated, and where the frames saw it.
#[derive(Clone, Debug, PartialEq)]
pub struct Landmark {
    /// In the world.
    pub position: DVec3,
    /// Frame and pixel, the picture's corner at 0, in the order of the frames; three or more.
    pub observations: Vec<(usize, DVec2)>,
    /// Mean reprojection error of these, pixels.
    pub error: f64,
}

/// A track with more weight than this is static.
const STATIC: f64 = 0.5;
/// Observations agree within this many robust standard deviations.
const AGREES: f64 = 3.0;
/// The scale of residuals is not taken below so many of an observation's own deviations.
const SCALE_FLOOR: f64 = 0.5;
/// A landmark's depth has no larger relative standard deviation.
const MOST_UNCERTAIN: f64 = 0.2;
/// Least number of frames that a point is triangulated from.
const LEAST: usize = 3;

/// A static track against the cameras.
struct Fit {
    /// Index of the track.
    track: usize,
    /// In the track's first frame.
    inverse_depth: f64,
    /// Of the depth, relative to it.
    deviation: f64,
    /// By pixel of the track, how far it is from where it should be: pixels, and in units of its own
    /// deviation; infinite behind the camera. 0 for the first, which the point lies on.
    off: Vec<(f64, f64)>,
}

/// Static tracks that are long enough against cameras, and within how many deviations they agree.
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
                // Views weigh as much as they know beside one that is off by so many pixels.
                deviation: found.map_or(f64::INFINITY, |found| DEVIATION * found.deviation / d),
                off: [(0.0, 0.0)].into_iter().chain(views.iter().enumerate().map(off)).collect(),
            }
        })
        .collect();
    // Of a length in two dimensions the median is 1.1774 of a coordinate's standard deviation.
    let lengths = fits.iter().flat_map(|fit| fit.off[1..].iter().map(|off| off.1)).collect();
    let scale = (quantile(lengths, 0.5) / 1.1774).max(SCALE_FLOOR);
    (fits, AGREES * scale)
}

/// How well the cameras of all frames are known.
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
            // The point lies on its first pixel, which so agrees if most others do.
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
    /// The static points of `tracks` that the cameras triangulate, each with the observations that agree
    /// with it. None of a camera that stays in its place.
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

    /// Points of the wall, followed from the first frame to the last.
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
        // One slips in a frame, one goes down, one is too short, one is said to move.
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
        // Huber's kernel lets the slip pull at the depth a little.
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

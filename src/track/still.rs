//! Detection of fixed cameras and of cameras that move without parallax.

use glam::DVec2;

use super::cameras::Strictness;
use super::quantile;
use crate::geometry::ransac::RansacOptions;
use crate::geometry::two_view::{TwoView, TwoViewOptions, two_view};
use crate::observe::{NeighbourFlow, PointTrack};
use crate::types::{Image, Intrinsics};
use crate::{Error, Result};

/// The prior weight of a track as static, before movers are known. The filmed subject moves and is usually
/// near the middle of the image; the static world surrounds it.
pub(super) fn border_prior(track: &PointTrack, size: (usize, usize)) -> f64 {
    prior_at(track.pixels[track.pixels.len() / 2], size)
}

fn prior_at(pixel: DVec2, size: (usize, usize)) -> f64 {
    let (w, h) = (size.0 as f64, size.1 as f64);
    let x = (pixel.x / w).min(1.0 - pixel.x / w);
    let y = pixel.y / h;
    // The lower border is excluded: people and cars are cut off there as often as floors.
    let inside = x.min(y).clamp(0.0, 0.25) / 0.25;
    1.0 - 0.85 * inside
}

/// Minimum share of the prior weight that the static pixels of a trusted frame have.
const TRUSTED: f64 = 0.4;

/// Per frame, whether the mask calls the surroundings static. If it calls the middle static instead, the
/// camera's pose has followed a mover, and the mask is inverted. If hardly any frame passes, the prior itself
/// is wrong, and all frames are trusted.
pub(super) fn trusted(masks: &[Image]) -> Vec<bool> {
    let verdicts: Vec<bool> = masks
        .iter()
        .map(|mask| {
            let size = (mask.width as usize, mask.height as usize);
            let (mut rests, mut all) = (0.0, 0.0);
            for (i, p) in mask.pixels.iter().enumerate().step_by(5) {
                let pixel = DVec2::new((i % size.0) as f64, (i / size.0) as f64);
                let prior = prior_at(pixel, size);
                all += prior;
                rests += prior * f64::from(1.0 - p);
            }
            rests >= TRUSTED * all
        })
        .collect();
    let enough = 4 * verdicts.iter().filter(|v| **v).count() >= verdicts.len();
    if enough { verdicts } else { vec![true; masks.len()] }
}

/// Maximum displacement of a static track of a fixed camera, pixels at a width of 320.
const STAYS: f64 = 0.5;
/// Minimum share (by weight) of tracks that stay in place for a fixed camera.
const STAYING_SHARE: f64 = 0.3;
/// Minimum share of the cells of an 8×6 grid that contain a track that stays in place.
const STAYING_CELLS: f64 = 0.3;

/// Whether the camera is fixed: many tracks, spread over the image, are at the same position after half of
/// the clip. With a moving camera only distant points stay in place, for a short time.
pub(super) fn is_fixed(tracks: &[PointTrack], weights: &[f64], flow: &NeighbourFlow) -> bool {
    let limit = STAYS * (flow.width as f64 / 320.0).max(1.0);
    let span = (flow.frames / 2).max(1);
    let mut verdicts = Vec::new();
    for start in [0, (flow.frames - 1 - span) / 2, flow.frames - 1 - span] {
        let end = start + span;
        let (mut stays, mut all) = (0.0, 0.0);
        let mut cells = [false; 48];
        let both =
            tracks.iter().zip(weights).filter_map(|(t, w)| Some((t.at(start)?, t.at(end)?, w)));
        let mut count = 0;
        for (a, b, weight) in both {
            all += weight;
            count += 1;
            if (b - a).length() < limit {
                stays += weight;
                let x = (a.x / flow.width as f64 * 8.0).clamp(0.0, 7.0) as usize;
                let y = (a.y / flow.height as f64 * 6.0).clamp(0.0, 5.0) as usize;
                cells[y * 8 + x] = true;
            }
        }
        let spread = cells.iter().filter(|c| **c).count() as f64 / 48.0;
        verdicts.push(count >= 20 && stays >= STAYING_SHARE * all && spread >= STAYING_CELLS);
    }
    verdicts.iter().all(|v| *v)
}

/// Pixels of the tracks that exist in both frames, with their weights and indices.
pub(super) struct Shared {
    pub tracks: Vec<usize>,
    pub a: Vec<DVec2>,
    pub b: Vec<DVec2>,
    pub weights: Vec<f64>,
}

/// The tracks that two frames share, at most about `most`, sampled evenly.
pub(super) fn shared(
    tracks: &[PointTrack],
    weights: &[f64],
    (a, b): (usize, usize),
    most: usize,
) -> Shared {
    let all: Vec<usize> = (0..tracks.len())
        .filter(|&i| weights[i] > 0.05 && tracks[i].at(a).is_some() && tracks[i].at(b).is_some())
        .collect();
    let stride = all.len().div_ceil(most.max(1)).max(1);
    let picked: Vec<usize> = all.into_iter().step_by(stride).collect();
    Shared {
        a: picked.iter().filter_map(|&i| tracks[i].at(a)).collect(),
        b: picked.iter().filter_map(|&i| tracks[i].at(b)).collect(),
        weights: picked.iter().map(|&i| weights[i]).collect(),
        tracks: picked,
    }
}

/// The relative pose of two frames for given intrinsics; `strictness` scales the threshold of outliers.
pub(super) fn relate(
    shared: &Shared,
    k: &Intrinsics,
    seed: u64,
    strictness: Strictness,
) -> Result<TwoView> {
    let threshold = strictness.factor() * (f64::from(k.width) / 320.0).max(0.7);
    let options = TwoViewOptions {
        ransac: RansacOptions { threshold, max_iterations: 1000, seed, ..Default::default() },
        ..Default::default()
    };
    two_view(&shared.a, &shared.b, Some(&shared.weights), k, k, &options)
}

/// Refuses a clip whose camera only zooms.
pub(super) fn refuse_zoom(
    tracks: &[PointTrack],
    weights: &[f64],
    flow: &NeighbourFlow,
) -> Result<()> {
    let n = flow.frames;
    let gap = (n - 1).min((n / 3).max(1));
    let pairs: Vec<Shared> = [0, (n - 1 - gap) / 2, n - 1 - gap]
        .iter()
        .map(|&a| shared(tracks, weights, (a, a + gap), 400))
        .filter(|s| s.tracks.len() >= 30)
        .collect();
    match !pairs.is_empty() && pairs.iter().all(zooms) {
        true => Err(no_parallax("the camera only zooms")),
        false => Ok(()),
    }
}

pub(super) fn no_parallax(what: &str) -> Error {
    Error::Input(format!(
        "no parallax: {what}, so depth and position cannot be told from this video; film while \
         walking or moving the camera sideways, or take a longer part of the video"
    ))
}

/// Whether a scaling about one point explains the pixels. Walking straight into a scene with depth does not
/// look like that.
fn zooms(pair: &Shared) -> bool {
    // b = s·a + t by least squares, iteratively reweighted by the residuals.
    let mut weights = pair.weights.clone();
    let mut scale = 1.0;
    let mut residuals = Vec::new();
    for _ in 0..5 {
        let total: f64 = weights.iter().sum();
        let mean = |points: &[DVec2]| {
            points.iter().zip(&weights).map(|(p, w)| *p * *w).sum::<DVec2>() / total
        };
        let (ma, mb) = (mean(&pair.a), mean(&pair.b));
        let (mut upper, mut lower) = (0.0, 0.0);
        for i in 0..weights.len() {
            let (a, b) = (pair.a[i] - ma, pair.b[i] - mb);
            upper += weights[i] * a.dot(b);
            lower += weights[i] * a.length_squared();
        }
        scale = upper / lower.max(1e-9);
        let shift = mb - ma * scale;
        residuals =
            (0..weights.len()).map(|i| (pair.b[i] - pair.a[i] * scale - shift).length()).collect();
        let typical = quantile(residuals.clone(), 0.5).max(0.1);
        for i in 0..weights.len() {
            let z = residuals[i] / (2.0 * typical);
            weights[i] = pair.weights[i] / (1.0 + z * z).powi(2);
        }
    }
    (scale - 1.0).abs() > 0.02 && quantile(residuals, 0.7) < 0.5
}

#[cfg(test)]
mod tests {
    use super::super::sliding::*;
    use super::*;
    use crate::observe::{TrackOptions, follow};

    fn tracks(forward: impl Fn(usize, DVec2) -> DVec2) -> (NeighbourFlow, Vec<PointTrack>) {
        let flow = flow(forward);
        let tracks = follow(&flow, &TrackOptions { spacing: 3, confidence: 0.3 });
        (flow, tracks)
    }

    #[test]
    fn a_tripod_is_told_from_a_camera_that_moves() {
        let fixed = |forward: &dyn Fn(usize, DVec2) -> DVec2| {
            let (flow, tracks) = tracks(forward);
            is_fixed(&tracks, &vec![1.0; tracks.len()], &flow)
        };
        let middle = |p: DVec2| within(p, (16.0, 10.0), (48.0, 30.0));
        assert!(fixed(&|_, _| DVec2::ZERO));
        assert!(fixed(&|_, p| if middle(p) { DVec2::new(3.0, 0.0) } else { DVec2::ZERO }));
        assert!(!fixed(&|_, _| wall()));
        // Tracks that stay in one part of the image only, such as a reflection or a distant window, do not
        // make a tripod.
        assert!(!fixed(&|_, p| if within(p, (0.0, 0.0), (16.0, 10.0)) {
            DVec2::ZERO
        } else {
            wall()
        }));
    }

    #[test]
    fn a_scaling_about_a_point_is_a_zoom() {
        let zoomed = |scale: f64, bend: f64| {
            let a: Vec<DVec2> = (0..400).map(|i| centre(i * 6)).collect();
            let b = a
                .iter()
                .map(|p| (*p - DVec2::new(30.0, 20.0)) * (scale + bend * (0.3 * p.x).sin()))
                .collect();
            zooms(&Shared { tracks: (0..400).collect(), weights: vec![1.0; 400], a, b })
        };
        assert!(zoomed(1.1, 0.0));
        assert!(!zoomed(1.0, 0.0), "nothing grows");
        assert!(!zoomed(1.1, 0.08), "near things grow faster");
    }

    #[test]
    fn masks_that_call_the_surroundings_moving_are_not_trusted() {
        let middle = map(|p| f32::from(u8::from(within(p, (16.0, 10.0), (48.0, 30.0)))));
        let around = Image { pixels: middle.pixels.iter().map(|m| 1.0 - m).collect(), ..middle };
        assert_eq!(trusted(&[middle.clone(), around.clone()]), [true, false]);
        assert_eq!(trusted(&[around.clone(), around]), [true, true], "the prior is what fails");
    }
}

//! The initial focal length of the cameras.

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::Strictness;
use crate::geometry::bundle::FocalMode;
use crate::geometry::focal::{FocalPair, estimate_focal};
use crate::geometry::ransac::RansacOptions;
use crate::geometry::two_view::fundamental_ransac;
use crate::observe::PointTrack;
use crate::track::still::shared;
use crate::track::{FocalSource, Guess, Options};
use crate::types::Intrinsics;

/// An initial focal length, and how it may be adjusted.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(in crate::track) struct Focal {
    pub intrinsics: Intrinsics,
    pub source: FocalSource,
    pub deviation: f64,
    /// Whether it was given and is not to be adjusted.
    pub held: bool,
    /// Prior of the adjustment: a focal length in pixels and its relative standard deviation.
    pub prior: Option<(f64, f64)>,
}

/// Default focal length, as a multiple of the longer side: phones film at 0.75 to 1.1, and video
/// stabilisation crops.
pub(super) const ASSUMED: f64 = 1.0;

/// Lower bound of the relative standard deviation of a network's focal length.
const FINEST: f64 = 0.001;
/// Relative standard deviation below which the adjustment releases the focal length.
const MEASURABLE: f64 = 0.05;

impl Focal {
    /// A focal length that is known and not adjusted.
    pub fn known(intrinsics: Intrinsics) -> Focal {
        let source = FocalSource::Given;
        Focal { intrinsics, source, deviation: 0.0, held: true, prior: None }
    }

    /// The adjustment mode of the focal length.
    pub fn mode(&self) -> FocalMode {
        if self.held { FocalMode::Fixed } else { FocalMode::Gated(MEASURABLE) }
    }

    /// The given focal length, else the one that a network estimated.
    pub fn of_guess(options: &Options, guess: &Guess, (width, height): (usize, usize)) -> Focal {
        let (w, h) = (width as u32, height as u32);
        Focal::given(options, (w, h)).unwrap_or(Focal {
            intrinsics: Intrinsics::centred(guess.focal, w, h),
            source: FocalSource::Measured,
            deviation: guess.focal_deviation,
            held: false,
            prior: Some((guess.focal, guess.focal_deviation.max(FINEST))),
        })
    }

    /// The given focal length, if any.
    fn given(options: &Options, (w, h): (u32, u32)) -> Option<Focal> {
        let given = options.intrinsics.or(options.focal.map(|f| Intrinsics::centred(f, w, h)));
        given.map(|intrinsics| {
            let held = !options.refined.focal;
            let deviation = if held { 0.0 } else { f64::INFINITY };
            Focal { intrinsics, source: FocalSource::Given, deviation, held, prior: None }
        })
    }

    /// The given focal length, else an estimate from image pairs, else the default. `strictness` scales the
    /// threshold of outliers.
    pub fn choose(
        options: &Options,
        (width, height): (usize, usize),
        frames: usize,
        tracks: &[PointTrack],
        weights: &[f64],
        strictness: Strictness,
    ) -> Focal {
        let (w, h) = (width as u32, height as u32);
        if let Some(given) = Focal::given(options, (w, h)) {
            return given;
        }
        let n = frames;
        let gaps = [n / 8, n / 5, n / 3].map(|g| g.clamp(1, n - 1));
        let ends: Vec<(usize, usize)> = gaps
            .iter()
            .flat_map(|&gap| (0..n - gap).step_by(gap).map(move |a| (a, a + gap)))
            .collect();
        let threshold = strictness.factor() * (f64::from(w) / 320.0).max(0.7);
        let ransac = RansacOptions { threshold, seed: options.seed, ..Default::default() };
        let pairs: Vec<FocalPair> = ends
            .par_iter()
            .filter_map(|&pair| {
                let s = shared(tracks, weights, pair, 500);
                let pixels: Vec<_> = s.a.into_iter().zip(s.b).collect();
                let found = fundamental_ransac(&pixels, &ransac)?;
                let inliers: Vec<_> = found.inliers.iter().map(|&i| pixels[i]).collect();
                (inliers.len() >= 50)
                    .then_some(FocalPair { fundamental: found.model, pixels: inliers })
            })
            .collect();
        let side = f64::from(w.max(h));
        let estimate = estimate_focal(&pairs, w, h, &Default::default()).ok();
        match estimate.filter(|e| e.observable) {
            Some(e) => Focal {
                intrinsics: Intrinsics::centred(e.focal, w, h),
                source: FocalSource::Measured,
                deviation: e.relative_std,
                held: false,
                prior: None,
            },
            None => Focal {
                intrinsics: Intrinsics::centred(ASSUMED * side, w, h),
                source: FocalSource::Assumed,
                deviation: f64::INFINITY,
                held: false,
                prior: None,
            },
        }
    }
}

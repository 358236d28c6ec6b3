//! The focal length that cameras begin with.

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

/// The focal length to begin with, and what may be done with it.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(in crate::track) struct Focal {
    pub intrinsics: Intrinsics,
    pub source: FocalSource,
    pub deviation: f64,
    /// It was given and is not to be adjusted.
    pub held: bool,
    /// What the adjustment weighs beside the tracks: a focal length and its relative standard deviation.
    pub prior: Option<(f64, f64)>,
}

/// A focal length that nobody tells, as a multiple of the longer side: phones film at 0.75 to 1.1,
/// and video stabilisation crops.
pub(super) const ASSUMED: f64 = 1.0;

/// What a network tells of the focal length is never taken to be finer, relative.
const FINEST: f64 = 0.001;
/// The adjustment measures the focal length if it can to this relative standard deviation.
const MEASURABLE: f64 = 0.05;

impl Focal {
    /// How it is adjusted.
    pub fn mode(&self) -> FocalMode {
        if self.held { FocalMode::Fixed } else { FocalMode::Gated(MEASURABLE) }
    }

    /// What was given; else what a network tells.
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

    /// What was given.
    fn given(options: &Options, (w, h): (u32, u32)) -> Option<Focal> {
        let given = options.intrinsics.or(options.focal.map(|f| Intrinsics::centred(f, w, h)));
        given.map(|intrinsics| {
            let held = !options.refined.focal;
            let deviation = if held { 0.0 } else { f64::INFINITY };
            Focal { intrinsics, source: FocalSource::Given, deviation, held, prior: None }
        })
    }

    /// What was given; else what image pairs tell; else a common value. `strictness` scales the threshold
    /// of outliers.
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

//! Search for the fastest settings within an error budget.

use super::{Shot, error, knobs, race, settings};
use crate::bench::job::Pace;
use crate::bench::truth;
use crate::gpu::Device;
use crate::report::{Choice, ImageError};
use crate::scene::Scene;
use crate::types::Tuning;
use crate::{Error, Result};

/// The search uses this fraction of the budget, since the error of another view may be larger.
const MARGIN: f64 = 0.6;
/// A change must save at least this fraction of the time.
const LEAST_GAIN: f64 = 0.01;

/// The measure of an image's error.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum ErrorMeasure {
    /// The root of the mean square over all pixels and channels.
    #[default]
    Rmse,
    /// The largest difference of a channel. Where rounding decides whether a splat contributes to a
    /// pixel, exact settings differ from the oracle by up to the α cut, too.
    Max,
}

impl ErrorMeasure {
    /// The value of this measure for an image.
    pub fn of(self, error: &ImageError) -> f64 {
        match self {
            ErrorMeasure::Rmse => error.rmse,
            ErrorMeasure::Max => error.max,
        }
    }

    /// The name used in reports.
    pub fn name(self) -> &'static str {
        match self {
            ErrorMeasure::Rmse => "rmse",
            ErrorMeasure::Max => "max",
        }
    }
}

/// An error budget for images.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Budget {
    /// Colours are in [0, 1].
    pub error: f64,
    /// The error measure.
    pub measure: ErrorMeasure,
}

/// The fastest settings whose error stays within the budget, found on all shots but the last, and
/// their speed and error on the last, which the search does not use.
///
/// Each knob alone is set as far as the error stays within a fraction of the budget, and is timed
/// against the most accurate settings. The knobs that save time are then combined, the one that
/// saves most first, each as far as the total error allows, and a change is kept if it is faster
/// again. It counts as faster if more than three samples in four are. `say` is called with every
/// change kept.
///
/// # Errors
/// [`Error::Input`] for fewer than two shots or a budget that is no positive number; a scene that
/// does not fit the device.
pub fn choose(
    device: &Device,
    name: &str,
    scene: &Scene,
    shots: &[Shot],
    budget: Budget,
    pace: Pace,
    say: &mut dyn FnMut(&str) -> Result<()>,
) -> Result<(Tuning, Choice)> {
    let Some((unseen, searched)) = shots.split_last().filter(|(_, rest)| !rest.is_empty()) else {
        return Err(Error::Input("a budget needs two views at least: one is kept to test".into()));
    };
    if !(budget.error > 0.0 && budget.error.is_finite()) {
        return Err(Error::Input(format!(
            "an error budget of {}: it must be above 0",
            budget.error
        )));
    }
    let truths: Vec<Vec<f64>> = searched.iter().map(|shot| truth::image(scene, shot)).collect();
    let on = (searched, truths.as_slice());
    let knobs = knobs(scene);
    let allowed = |tuning: &Tuning| -> Result<bool> {
        let error = error(device, scene, tuning, on)?;
        Ok(budget.measure.of(&error) <= MARGIN * budget.error)
    };
    // The fraction of the time that `to` saves, if that is more than noise.
    let gain = |from: &Tuning, to: &Tuning| -> Result<Option<f64>> {
        let ratios = race(device, [(scene, from), (scene, to)], searched, pace)?.ratio;
        let won = ratios.quantile(0.75) < 1.0 && ratios.median() < 1.0 - LEAST_GAIN;
        Ok(won.then(|| ratios.median()))
    };
    let exact = Tuning::default();
    let mut useful = Vec::new();
    for knob in &knobs {
        let mut furthest = None;
        for position in 0..knob.positions.len() {
            if !allowed(&knob.turn(&exact, position))? {
                break;
            }
            furthest = Some(position);
        }
        let Some(furthest) = furthest else { continue };
        if let Some(ratio) = gain(&exact, &knob.turn(&exact, furthest))? {
            useful.push((ratio, knob, furthest));
        }
    }
    useful.sort_by(|a, b| a.0.total_cmp(&b.0));
    let mut tuning = exact;
    for (_, knob, furthest) in useful {
        for position in (0..=furthest).rev() {
            let turned = knob.turn(&tuning, position);
            if !allowed(&turned)? {
                continue;
            }
            if gain(&tuning, &turned)?.is_some() {
                say(&format!("{} {}", knob.name, knob.positions[position].0))?;
                tuning = turned;
            }
            break;
        }
    }
    let (unseen, truths) = ([*unseen], [truth::image(scene, unseen)]);
    let on = (unseen.as_slice(), truths.as_slice());
    let error = error(device, scene, &tuning, on)?;
    let ratios = race(device, [(scene, &exact), (scene, &tuning)], &unseen, pace)?.ratio;
    let choice = Choice {
        scene: name.to_owned(),
        budget: budget.error,
        measure: budget.measure.name().to_owned(),
        settings: settings(&tuning),
        time_ratio: ratios.median(),
        met: budget.measure.of(&error) <= budget.error,
        error,
        views: searched.len(),
    };
    Ok((tuning, choice))
}

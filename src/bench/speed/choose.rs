//! The fastest settings within an error.

use super::{Shot, error, evaluate, knobs, settings, time};
use crate::bench::job::Pace;
use crate::bench::truth;
use crate::gpu::Device;
use crate::report::{Choice, ImageError};
use crate::scene::Scene;
use crate::types::Tuning;
use crate::{Error, Result};

/// The search stays below this share of the budget, since another view may err more.
const MARGIN: f64 = 0.6;
/// A step must save this share of the time to be taken: less is noise.
const LEAST_GAIN: f64 = 0.01;

/// What of an image's error is budgeted.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum ErrorMeasure {
    /// The root of the mean square over all pixels and channels.
    #[default]
    Rmse,
    /// The largest difference of a channel. Where rounding decides whether a splat counts in a
    /// pixel, exact settings too differ from the oracle by up to the α cut.
    Max,
}

impl ErrorMeasure {
    /// Of an image.
    pub fn of(self, error: &ImageError) -> f64 {
        match self {
            ErrorMeasure::Rmse => error.rmse,
            ErrorMeasure::Max => error.max,
        }
    }

    /// In a report.
    pub fn name(self) -> &'static str {
        match self {
            ErrorMeasure::Rmse => "rmse",
            ErrorMeasure::Max => "max",
        }
    }
}

/// An error that an image may have.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Budget {
    /// Colours are in [0, 1].
    pub error: f64,
    /// Of what kind.
    pub measure: ErrorMeasure,
}

/// The fastest settings whose error stays within the budget, found on all shots but the last, and
/// what they do on the last, which the search has not seen.
///
/// Starting from the most accurate settings, the knob is turned one position on whose turn saves
/// most time and keeps the error within a share of the budget; until none does. `say` hears of every
/// turn.
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
    // The next position of each knob; the end of its positions where it cannot go further.
    let mut next = vec![0; knobs.len()];
    let mut tuning = Tuning::default();
    let mut best = time(device, scene, &tuning, searched, pace)?.0.median();
    loop {
        let mut taken: Option<(usize, f64)> = None;
        for (i, knob) in knobs.iter().enumerate() {
            if next[i] == knob.positions.len() {
                continue;
            }
            let turned = knob.turn(&tuning, next[i]);
            let error = error(device, scene, &turned, on)?;
            if budget.measure.of(&error) > MARGIN * budget.error {
                // Further positions err more, and so do all with more given up elsewhere.
                next[i] = knob.positions.len();
                continue;
            }
            let (spread, _) = time(device, scene, &turned, searched, pace)?;
            // Where more than a quarter of the samples are slower than before, noise speaks.
            let taking = if spread.quartiles()[1] < best { spread.median() } else { best };
            if taken.is_none_or(|(_, least)| taking < least) {
                taken = Some((i, taking));
            }
        }
        // A position that saves nothing may hide one behind it that does: step over it.
        let Some((i, taking)) = taken else { break };
        if taking < best * (1.0 - LEAST_GAIN) {
            tuning = knobs[i].turn(&tuning, next[i]);
            best = taking;
            say(&format!("{} {}", knobs[i].name, knobs[i].positions[next[i]].0))?;
            next[i] += 1;
        } else {
            for (i, knob) in knobs.iter().enumerate() {
                next[i] = (next[i] + 1).min(knob.positions.len());
            }
        }
    }
    let (unseen, truths) = ([*unseen], [truth::image(scene, unseen)]);
    let on = (unseen.as_slice(), truths.as_slice());
    let (exact, _, _) = evaluate(device, scene, &Tuning::default(), on, pace)?;
    let (fast, _, error) = evaluate(device, scene, &tuning, on, pace)?;
    let choice = Choice {
        scene: name.to_owned(),
        budget: budget.error,
        measure: budget.measure.name().to_owned(),
        settings: settings(&tuning),
        time_ratio: fast.median() / exact.median().max(f64::MIN_POSITIVE),
        met: budget.measure.of(&error) <= budget.error,
        error,
        views: searched.len(),
    };
    Ok((tuning, choice))
}

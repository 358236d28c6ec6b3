//! Training settings from keyword arguments.

use crate::error::out_of_range;
use pyo3::exceptions::{PyTypeError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::PyDict;
use splat4d::train::{AdaptiveSettings, GrowthSettings, TrainSettings};

/// The settings for keyword arguments. Settings that are not given have their default for the number of
/// steps.
pub fn of(keywords: Option<&Bound<'_, PyDict>>, gaussians: usize) -> PyResult<TrainSettings> {
    let steps = match keywords.map(|keywords| keywords.get_item("steps")).transpose()?.flatten() {
        Some(value) => value.extract()?,
        None => TrainSettings::default().steps,
    };
    let mut settings = TrainSettings::of_steps(steps);
    for (name, value) in keywords.into_iter().flatten() {
        set(&mut settings, &name.extract::<String>()?, &value)?;
    }
    if settings.growth.is_none() {
        settings.max_gaussians = gaussians;
    }
    Ok(settings)
}

fn set(settings: &mut TrainSettings, name: &str, value: &Bound<'_, PyAny>) -> PyResult<()> {
    let rates = &mut settings.rates;
    match name {
        "steps" => {}
        "growth" => settings.growth = growth(value, settings.steps)?,
        "max_gaussians" => settings.max_gaussians = value.extract()?,
        "sh_degree" => {
            settings.sh_degree = value.extract()?;
            if settings.sh_degree > 3 {
                let what = format!("sh_degree: expected 0 to 3, got {}", settings.sh_degree);
                return Err(PyValueError::new_err(what));
            }
        }
        "sh_interval" => settings.sh_interval = value.extract()?,
        "ssim_share" => settings.ssim_share = between(name, value, 1.0)? as f32,
        "background" => settings.background = value.extract()?,
        "seed" => settings.seed = value.extract()?,
        "position_rate" => rates.position = between(name, value, f64::MAX)?,
        "position_rate_last" => rates.position_last = between(name, value, f64::MAX)?,
        "log_scale_rate" => rates.log_scale = between(name, value, f64::MAX)?,
        "rotation_rate" => rates.rotation = between(name, value, f64::MAX)?,
        "opacity_rate" => rates.opacity = between(name, value, f64::MAX)?,
        "sh0_rate" => rates.sh0 = between(name, value, f64::MAX)?,
        "sh_rest_rate" => rates.sh_rest = between(name, value, f64::MAX)?,
        "rigidity_weight" => settings.motion.arap_weight = between(name, value, f64::MAX)?,
        _ => return Err(PyTypeError::new_err(format!("a trainer has no setting {name:?}"))),
    }
    Ok(())
}

fn growth(value: &Bound<'_, PyAny>, steps: u32) -> PyResult<Option<GrowthSettings>> {
    match value.extract::<Option<String>>()?.as_deref() {
        None => Ok(None),
        Some("mcmc") => Ok(Some(GrowthSettings::default())),
        Some("adaptive") => Ok(Some(GrowthSettings::Adaptive(AdaptiveSettings::scaled_to(steps)))),
        Some(other) => {
            let what = format!("growth: expected \"mcmc\", \"adaptive\" or None, got {other:?}");
            Err(PyValueError::new_err(what))
        }
    }
}

fn between(name: &str, value: &Bound<'_, PyAny>, most: f64) -> PyResult<f64> {
    let number: f64 = value.extract()?;
    match (0.0..=most).contains(&number) {
        true => Ok(number),
        false => Err(out_of_range(format!("{name} is {number:?}: 0 to {most:?} expected"))),
    }
}

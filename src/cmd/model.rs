//! The model report: the modelling choices of a scene, the measurement behind each, and what it saves.

use serde::Serialize;
use splat4d::scene::Scene;
use splat4d::track::{FocalSource, Track};
use splat4d::train::SequenceSettings;
use splat4d::types::{ControlPoints, Image};

use super::common::thousands;
use super::info::dynamic_share;

/// One modelling choice.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Choice {
    /// Subject of the choice.
    pub what: &'static str,
    /// The chosen alternative.
    pub chosen: String,
    /// The measurement or the setting that determined it.
    pub because: String,
    /// Saving; `None` where the more expensive alternative was chosen.
    pub saves: Option<String>,
}

impl Choice {
    /// A choice without a saving.
    pub fn new(
        what: &'static str,
        chosen: impl Into<String>,
        because: impl Into<String>,
    ) -> Choice {
        Choice { what, chosen: chosen.into(), because: because.into(), saves: None }
    }

    fn saving(self, saves: impl Into<String>) -> Choice {
        Choice { saves: Some(saves.into()), ..self }
    }
}

/// The choices as text lines.
pub fn lines(choices: &[Choice]) -> String {
    let line = |choice: &Choice| {
        let Choice { what, chosen, because, saves } = choice;
        let saves = saves.as_ref().map_or(String::new(), |saves| format!("; saves {saves}"));
        format!("  {what}: {chosen} ({because}{saves})")
    };
    let lines: Vec<String> = choices.iter().map(line).collect();
    format!("model:\n{}", lines.join("\n"))
}

/// The choices of a reconstruction; `scene.report` is the report of the training.
pub fn of_clip(scene: &Scene, track: &Track, settings: &SequenceSettings) -> Vec<Choice> {
    let mut choices = vec![poses(track), focal_length(track), lens(track), exposure(track)];
    choices.extend(motion(scene, track, settings));
    if scene.moves() {
        choices.push(movers_distance(track));
    }
    choices.push(gaussians(scene, settings));
    choices.push(aside(track.view_from_world.len(), settings));
    let degree = scene.gaussians.sh_degree;
    let colours = format!("spherical harmonics of degree {degree}");
    choices.push(Choice::new("colours by direction", colours, "--sh-degree or --quality"));
    choices
}

fn poses(track: &Track) -> Choice {
    let (quality, frames) = (&track.quality, track.view_from_world.len());
    if quality.tripod {
        let because = format!(
            "the camera stands still: {:.0} % of the observations of still points stay within {:.2} px",
            100.0 * quality.inlier_share,
            quality.reprojection_rms
        );
        let saves = format!("{} poses", frames.saturating_sub(1));
        return Choice::new("poses", "one for all frames", because).saving(saves);
    }
    if quality.turns {
        let because = format!(
            "the camera turns in place: rotations leave {:.2} px of {:.0} % of the observations of still \
             points",
            quality.reprojection_rms,
            100.0 * quality.inlier_share
        );
        let chosen = format!("a rotation for each of {frames} frames");
        return Choice::new("poses", chosen, because)
            .saving("places of the camera, depth of the still");
    }
    let because = format!(
        "the camera moves: rays to a still point differ by up to {:.1}° (median)",
        quality.parallax_deg
    );
    Choice::new("poses", format!("one for each of {frames} frames"), because)
}

fn focal_length(track: &Track) -> Choice {
    let chosen = format!("{:.1} px", track.intrinsics.fx);
    let because = match track.quality.focal_source {
        FocalSource::Given => "given".into(),
        FocalSource::Measured => {
            format!("the clip shows it to ± {:.2} %", 100.0 * track.quality.focal_std)
        }
        FocalSource::Assumed => "a common value: the clip does not show it".into(),
    };
    Choice::new("focal length", chosen, because)
}

fn lens(track: &Track) -> Choice {
    match &track.lens {
        Some(lens) => {
            let chosen = format!("k1 {:+.4}, frames undistorted", lens.distortion.radial[0]);
            let because = "static points agree better so, in both halves of the clip";
            Choice::new("lens", chosen, because)
        }
        None => {
            let because = "no distortion shows, or none is looked for";
            Choice::new("lens", "a pinhole", because).saving("k1 and resampled frames")
        }
    }
}

fn exposure(track: &Track) -> Choice {
    let gains = track.exposure.gains.iter().flatten();
    let range = gains.fold([f32::INFINITY, 0.0], |r, gain| [r[0].min(*gain), r[1].max(*gain)]);
    if track.exposure.is_constant() {
        let because = "no frame is 2 % brighter or darker than the others";
        return Choice::new("exposure", "one for all frames", because)
            .saving("three gains for each frame");
    }
    let percent = range.map(|gain| 100.0 * (gain - 1.0));
    let because = format!("encoded values change by {:+.0} to {:+.0} %", percent[0], percent[1]);
    Choice::new("exposure", "three gains for each frame", because)
}

fn motion(scene: &Scene, track: &Track, settings: &SequenceSettings) -> Vec<Choice> {
    const NONE: &str = "none: no control points, no network";
    let moving = 100.0 * track.quality.dynamic_share;
    if !scene.moves() {
        let nothing = track.quality.dynamic_share < settings.least_dynamic_share;
        let because = match nothing {
            true => format!(
                "nothing moves but the camera: {moving:.2} % of the pixels do, and motion is modelled \
                 from {:.2} % on",
                100.0 * settings.least_dynamic_share
            ),
            false => {
                format!("{moving:.1} % of the pixels seem to move, but none could be followed")
            }
        };
        return vec![Choice::new("motion", NONE, because).saving("its stage of the training")];
    }
    let points = &scene.control_points;
    let share = 100.0 * dynamic_share(scene);
    let motion = Choice::new(
        "motion",
        format!("{share:.1} % of the Gaussians follow control points"),
        format!("{moving:.1} % of the pixels move"),
    )
    .saving(format!("moving the other {:.1} % of the Gaussians", 100.0 - share));
    let count = Choice::new(
        "control points",
        points.len().to_string(),
        format!(
            "{} added in training where the loss pulled hardest, {} removed that nothing followed",
            scene.report["control_points_added"], scene.report["control_points_removed"]
        ),
    );
    let count = match settings.control_points.checked_sub(points.len()) {
        None | Some(0) => count,
        Some(spared) => count.saving(format!("{spared} of at most {}", settings.control_points)),
    };
    let (keys, frames) = (points.keys(), track.view_from_world.len());
    let keys = match keys < frames {
        true => {
            let because = format!("{} steps are too few for one for each frame", settings.steps);
            let saves = format!("{} of {frames} for each control point", frames - keys);
            Choice::new("key times of a path", keys.to_string(), because).saving(saves)
        }
        false => Choice::new("key times of a path", keys.to_string(), "one for each frame"),
    };
    let windows = scene.report["windows"].as_u64().unwrap_or(1);
    match windows {
        1 => vec![motion, windows_of(windows, frames), count, keys, lifespans(points)],
        // All movers appear and disappear with their window.
        _ => vec![motion, windows_of(windows, frames), count, keys],
    }
}

/// The choice of the number of frame windows; each window has separate dynamic Gaussians.
fn windows_of(windows: u64, frames: usize) -> Choice {
    match windows {
        1 => Choice::new("windows", "one", "what moves looks alike throughout, or nearly so")
            .saving("Gaussians of its own for each stretch of the clip"),
        _ => Choice::new(
            "windows",
            format!("{windows}, of {} frames each", frames as u64 / windows),
            "the look of what moves changes within a few frames",
        ),
    }
}

fn lifespans(points: &ControlPoints) -> Choice {
    let fades = |point: usize| {
        (0..points.keys()).any(|key| points.paths[key * points.len() + point][3] < 0.0)
    };
    let passing = (0..points.len()).filter(|point| fades(*point)).count();
    let because = match passing {
        0 => "all that moves is there in all frames",
        _ => "what they move comes or goes during the clip",
    };
    let chosen = format!("of {passing} of {} control points", points.len());
    Choice::new("lifespans", chosen, because)
}

/// Depth confidence above which a mover's depth has a measured scale; see `Track::depth_confidence`.
const KNOWN_SCALE: f32 = 0.3;

fn movers_distance(track: &Track) -> Choice {
    let on_movers = |(owners, confidence): (&Image, &Image)| -> Vec<f32> {
        let pixels = owners.pixels.iter().zip(&confidence.pixels);
        pixels.filter(|(owner, _)| **owner > 0.0).map(|(_, confidence)| *confidence).collect()
    };
    let confidences: Vec<f32> =
        track.owners.iter().zip(&track.depth_confidence).flat_map(on_movers).collect();
    if confidences.is_empty() {
        let chosen = "one depth for each region of the mask and frame";
        return Choice::new("distance of what moves", chosen, "no object could be followed");
    }
    let known = confidences.iter().filter(|confidence| **confidence > KNOWN_SCALE).count();
    let because = format!(
        "its scale is measured for {:.0} % of the moving pixels and only bounded for the others",
        100.0 * known as f64 / confidences.len() as f64
    );
    let chosen = match track.movers.len() {
        1 => "a shape and a path for the one object".into(),
        count => format!("a shape and a path for each of {count} objects"),
    };
    Choice::new("distance of what moves", chosen, because)
}

fn gaussians(scene: &Scene, settings: &SequenceSettings) -> Choice {
    let (count, most) = (scene.gaussians.len(), settings.max_gaussians);
    let chosen = format!("{} of at most {}", thousands(count), thousands(most));
    if count >= most {
        return Choice::new("Gaussians", chosen, "growth reached the limit");
    }
    let because = format!("growth had come so far after {} steps", settings.steps);
    Choice::new("Gaussians", chosen, because).saving(thousands(most - count))
}

fn aside(frames: usize, settings: &SequenceSettings) -> Choice {
    let pictures = settings.pictures_aside(frames);
    let because = format!("{} for each frame in a round of training", settings.aside);
    Choice::new("offset views", pictures.to_string(), because)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_tells_what_was_chosen_why_and_what_it_saves() {
        let costly = Choice::new("poses", "one for each of 9 frames", "the camera moves");
        let sparing = Choice::new("motion", "none", "nothing moves").saving("a stage");
        assert_eq!(
            lines(&[costly, sparing]),
            "model:\n  poses: one for each of 9 frames (the camera moves)\n  \
             motion: none (nothing moves; saves a stage)"
        );
    }
}

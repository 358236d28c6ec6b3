//! Comparison of the device's results on a fuzz scene with the oracle's.

use super::FuzzScene;
use crate::check::rounding::gradient_limits;
use crate::check::scene::{
    Backward, Forward, Frame, all_finite, contested, random_gradient, widen,
};
use crate::error::Result;
use crate::gpu::{Device, Stream};
use crate::oracle::linear::{max_abs, normalise};
use crate::oracle::project_backward::{SplatGradient, project_backward};
use crate::oracle::raster::Pixels;
use crate::oracle::render::{self, Rendered};
use crate::oracle::view::{Cloud, View};
use crate::oracle::{Real, sh};
use crate::types::RenderSettings;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// A pixel that depends on a decision within this relative distance of its threshold is not
/// compared.
const BAND: f64 = 1e-3;
/// Error limit of image and gradients relative to the largest value, as in the cases of the render
/// family.
const IMAGE: f64 = 1e-5;
const GRADIENT: f64 = 1e-4;
/// Factor by which a result's error may exceed its sensitivity, or the error of the oracle in f32.
const SLACK: f64 = 32.0;
/// Factor for the propagation of rounding limits from the splats' gradients to the Gaussians'
/// gradients.
const REACH: f64 = 4.0;
/// Number of result kinds that are images; the others are gradients.
const PICTURES: usize = 2;
/// Products of values beyond this overflow f32.
const LARGE: f64 = 1e18;

/// The results of a scene, by kind, flattened.
struct Answers<R> {
    kinds: Vec<(&'static str, Vec<R>)>,
    drawn: Vec<bool>,
}

/// A description of the error of the device's results; `None` if they are correct.
///
/// # Errors
/// A failed Vulkan call.
pub fn judge(device: &Device, stream: &mut Stream, scene: &FuzzScene) -> Result<Option<String>> {
    let settings = RenderSettings::default();
    let (width, height) = (scene.camera.intrinsics.width, scene.camera.intrinsics.height);
    let cloud = Cloud::<f64>::new(&scene.gaussians);
    let view = View::<f64>::new(&scene.camera);
    let rendered = render::forward(&cloud, &view, &settings);
    let skip = contested(&rendered.splats, &settings, width, height, BAND);
    let mut rng = ChaCha8Rng::seed_from_u64(scene.seed);
    let gradient = random_gradient(&mut rng, &skip);

    let tiles = (width.div_ceil(16) * height.div_ceil(16)) as usize;
    let capacity = scene.gaussians.len() * tiles;
    let mut frame =
        Frame::new(device, stream, &scene.gaussians, &scene.camera, capacity, settings)?;
    let forward = frame.forward(stream)?;
    let backward = frame.backward(stream, &gradient)?;
    if !all_finite(&forward, Some(&backward)) {
        return Ok(Some("not finite".to_owned()));
    }

    let truth = answers(&cloud, &view, &settings, &rendered, &widen(&gradient), &skip);
    let tame =
        |answers: &Answers<f64>| answers.kinds.iter().flat_map(|(_, v)| v).all(|v| v.abs() < LARGE);
    if !tame(&truth) {
        return Ok(None);
    }
    let single_cloud = Cloud::<f32>::new(&scene.gaussians);
    let single_view = View::<f32>::new(&scene.camera);
    let single = render::forward(&single_cloud, &single_view, &settings);
    let single = answers(&single_cloud, &single_view, &settings, &single, &gradient, &skip);
    let mut others = vec![single.wide()];
    for _ in 0..3 {
        let moved = nudged(&cloud, &mut rng);
        let again = render::forward(&moved, &view, &settings);
        others.push(answers(&moved, &view, &settings, &again, &widen(&gradient), &skip));
    }
    // If one ulp decides which Gaussians are drawn, or if values leave the range of f32, only
    // finiteness is required.
    if others.iter().any(|other| other.drawn != truth.drawn || !tame(other)) {
        return Ok(None);
    }
    let limits = gradient_limits(
        &rendered.splats,
        &rendered.bins,
        &settings,
        width,
        height,
        &widen(&gradient),
    );
    let mut rounding = [0.0f64; 6];
    for _ in 0..4 {
        // The backward pass of projection is linear, so limits with random signs are propagated to
        // estimate errors.
        let signed: Vec<_> = limits.iter().map(|limit| signed(limit, &mut rng)).collect();
        let (by, by_view) = project_backward(&cloud, &view, &settings, &rendered.splats, &signed);
        for (reach, values) in rounding.iter_mut().zip(gradients(by, by_view.twist)) {
            *reach = values.1.iter().fold(*reach, |most, v| v.abs().max(most));
        }
    }
    let device = device_answers(&forward, &backward, &skip);
    Ok(worst(&device, &truth, &others, &rounding, colour_is_undecided(&cloud, &view, &truth.drawn)))
}

/// Whether a colour lies so close to 0, where it is clamped and its gradient vanishes, that
/// rounding decides.
fn colour_is_undecided(cloud: &Cloud<f64>, view: &View<f64>, drawn: &[bool]) -> bool {
    (0..cloud.len()).filter(|&i| drawn[i]).any(|i| {
        let sight = normalise(view.sight(cloud.positions[i]));
        let Some((_, direction)) = sight else { return false };
        let coefficients = cloud.sh_of(i);
        let size = coefficients.iter().map(|&row| max_abs(row)).fold(1.0, f64::max);
        sh::colour(coefficients, direction).iter().any(|c| c.abs() < 1e-5 * size)
    })
}

/// The limits with a random sign per component.
fn signed(limit: &SplatGradient<f64>, rng: &mut ChaCha8Rng) -> SplatGradient<f64> {
    let mut turn = |v: f64| if rng.random() { v } else { -v };
    SplatGradient {
        mean: limit.mean.map(&mut turn),
        covariance: limit.covariance.map(&mut turn),
        opacity: turn(limit.opacity),
        depth: turn(limit.depth),
        colour: limit.colour.map(&mut turn),
    }
}

fn worst(
    device: &Answers<f64>,
    truth: &Answers<f64>,
    others: &[Answers<f64>],
    rounding: &[f64; 6],
    only_pictures: bool,
) -> Option<String> {
    if device.drawn != truth.drawn {
        return Some(format!("draws {:?} for {:?}", device.drawn, truth.drawn));
    }
    let farthest =
        |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0f64, f64::max);
    let kinds = if only_pictures { PICTURES } else { truth.kinds.len() };
    for (k, (kind, exact)) in truth.kinds.iter().enumerate().take(kinds) {
        let largest = exact.iter().fold(0.0f64, |m, v| m.max(v.abs()));
        let share = match k.checked_sub(PICTURES) {
            None => IMAGE * largest.max(1.0),
            Some(k) => GRADIENT * largest + REACH * rounding[k],
        };
        let moves = others.iter().map(|o| farthest(&o.kinds[k].1, exact)).fold(0.0, f64::max);
        let limit = share + SLACK * moves + 1e-30;
        let off = farthest(&device.kinds[k].1, exact);
        if off > limit {
            return Some(format!("{kind} is off by {off:.3e}, at most {limit:.3e} is allowed"));
        }
    }
    None
}

/// The scene with every number perturbed by about one ulp.
fn nudged(cloud: &Cloud<f64>, rng: &mut ChaCha8Rng) -> Cloud<f64> {
    let mut out = cloud.clone();
    let mut nudge = |v: &mut f64| *v *= 1.0 + rng.random_range(-1.2e-7..1.2e-7);
    out.positions.as_flattened_mut().iter_mut().for_each(&mut nudge);
    out.log_scales.as_flattened_mut().iter_mut().for_each(&mut nudge);
    out.rotations.as_flattened_mut().iter_mut().for_each(&mut nudge);
    out.opacity_logits.iter_mut().for_each(&mut nudge);
    out.sh.as_flattened_mut().iter_mut().for_each(&mut nudge);
    out
}

/// Image (in pixels without a close decision), depth, and all gradients.
fn answers<R: Real>(
    cloud: &Cloud<R>,
    view: &View<R>,
    settings: &RenderSettings,
    rendered: &Rendered<R>,
    gradient: &Pixels<R>,
    skip: &[bool],
) -> Answers<R> {
    let (by, by_view, _) = render::backward(cloud, view, settings, rendered, gradient);
    let kept = || (0..skip.len()).filter(|&i| !skip[i]);
    let p = &rendered.pixels;
    let rgba = kept().flat_map(|i| [p.rgb[i][0], p.rgb[i][1], p.rgb[i][2], p.alpha[i]]);
    let pictures = [("image", rgba.collect()), ("depth", kept().map(|i| p.depth[i]).collect())];
    Answers {
        kinds: pictures.into_iter().chain(gradients(by, by_view.twist)).collect(),
        drawn: rendered.splats.iter().map(Option::is_some).collect(),
    }
}

/// The gradients, by kind.
fn gradients<R: Real>(by: Cloud<R>, twist: [R; 6]) -> [(&'static str, Vec<R>); 6] {
    [
        ("gradient by position", by.positions.concat()),
        ("gradient by log-scale", by.log_scales.concat()),
        ("gradient by rotation", by.rotations.concat()),
        ("gradient by opacity", by.opacity_logits),
        ("gradient by sh", by.sh.concat()),
        ("gradient by pose", twist.to_vec()),
    ]
}

impl Answers<f32> {
    fn wide(self) -> Answers<f64> {
        let wide = |v: Vec<f32>| v.into_iter().map(f64::from).collect();
        Answers {
            kinds: self.kinds.into_iter().map(|(kind, v)| (kind, wide(v))).collect(),
            drawn: self.drawn,
        }
    }
}

fn device_answers(forward: &Forward, backward: &Backward, skip: &[bool]) -> Answers<f64> {
    let kept = || (0..skip.len()).filter(|&i| !skip[i]);
    let g = &backward.gaussians;
    Answers {
        kinds: vec![
            ("image", kept().flat_map(|i| forward.rgba[i]).collect()),
            ("depth", kept().map(|i| forward.depth[i]).collect()),
            ("gradient by position", g.positions.concat()),
            ("gradient by log-scale", g.log_scales.concat()),
            ("gradient by rotation", g.rotations.concat()),
            ("gradient by opacity", g.opacity_logits.clone()),
            ("gradient by sh", g.sh.concat()),
            ("gradient by pose", backward.pose.clone()),
        ],
        drawn: forward.visible.iter().map(|&v| v != 0).collect(),
    }
    .wide()
}

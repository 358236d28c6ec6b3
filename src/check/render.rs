//! Check cases of the whole renderer, forward and backward, on ordinary scenes and on hard inputs:
//! every result must be finite and close to the oracle's.

use super::scene::{
    Backward, Forward, Frame, UPRIGHT, all_finite, compare_gradients, contested, join, one,
    plain_camera, random, random_gradient, skew_camera, widen,
};
use super::{Bound, Case, Harness};
use crate::error::{Error, Result};
use crate::gpu::Limits;
use crate::oracle::raster::Pixels;
use crate::oracle::render::{self, Rendered};
use crate::oracle::view::{Cloud, View, perturbed};
use crate::types::{Camera, Gaussians, Intrinsics, Pose, RenderSettings};
use glam::{DQuat, DVec3};

const fn case(id: &'static str, run: fn(&mut Harness) -> Result<()>) -> Case {
    Case { id, run }
}

/// The op's cases.
pub const CASES: &[Case] = &[
    case("render/scene", scene),
    case("render/central_differences", central_differences),
    case("render/near_behind_and_at_the_camera", near_behind_and_at_the_camera),
    case("render/needles", needles),
    case("render/covering_and_sub_pixel", covering_and_sub_pixel),
    case("render/scales", scales),
    case("render/opacities", opacities),
    case("render/opacity_slopes", opacity_slopes),
    case("render/quaternions", quaternions),
    case("render/non_finite", non_finite),
    case("render/non_finite_cameras", non_finite_cameras),
    case("render/layers_of_equal_depth", layers_of_equal_depth),
    case("render/fields_of_view", fields_of_view),
    case("render/far_from_the_origin", far_from_the_origin),
    case("render/no_splats", no_splats),
    case("render/many_tiles", many_tiles),
];

/// The results of a frame on the device and of the oracle.
struct Run {
    forward: Forward,
    backward: Backward,
    exact: Rendered<f64>,
    single: Rendered<f32>,
    gradient: Pixels<f32>,
}

/// Renders and differentiates on the device and in the oracle. The image's gradient is set to zero
/// at pixels that depend on a decision (cut, cap, stop) closer than `band` to its threshold.
fn run(harness: &mut Harness, scene: &Gaussians, camera: &Camera, band: f64) -> Result<Run> {
    let settings = RenderSettings::default();
    let (device, stream) = (harness.device.clone(), &mut harness.stream);
    let mut frame = Frame::new(&device, stream, scene, camera, 1 << 16, settings)?;
    let forward = frame.forward(stream)?;
    let exact = render::forward(&Cloud::<f64>::new(scene), &View::new(camera), &settings);
    let single = render::forward(&Cloud::<f32>::new(scene), &View::new(camera), &settings);
    let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
    let skip = contested(&exact.splats, &settings, width, height, band);
    let gradient = random_gradient(&mut harness.rng, &skip);
    let backward = frame.backward(stream, &gradient)?;
    Ok(Run { forward, backward, exact, single, gradient })
}

/// Checks that the results are finite, that as many Gaussians are drawn as by the oracle, and that
/// the image is within `tolerance` of the oracle's.
fn agree(
    harness: &mut Harness,
    what: &str,
    scene: &Gaussians,
    camera: &Camera,
    tolerance: f64,
) -> Result<Run> {
    let run = run(harness, scene, camera, (10.0 * tolerance).clamp(1e-5, 0.1))?;
    harness.holds(&format!("{what}: finite"), all_finite(&run.forward, Some(&run.backward)));
    let drawn = run.exact.splats.iter().flatten().count() as u32;
    harness.exact(&format!("{what}: drawn"), &[run.forward.counts[0]], &[drawn]);
    image(harness, what, &run, camera, tolerance);
    Ok(run)
}

fn image(harness: &mut Harness, what: &str, run: &Run, camera: &Camera, tolerance: f64) {
    let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
    let settings = RenderSettings::default();
    let (exact, single) = (&run.exact, &run.single.pixels);
    let band = (10.0 * tolerance).clamp(1e-5, 0.1);
    let skip = contested(&exact.splats, &settings, width, height, band);
    let kept: Vec<usize> = (0..skip.len()).filter(|&i| !skip[i]).collect();
    let device: Vec<f32> = kept.iter().flat_map(|&i| run.forward.rgba[i]).collect();
    let truth: Vec<f64> = kept
        .iter()
        .flat_map(|&i| {
            let ([r, g, b], a) = (exact.pixels.rgb[i], exact.pixels.alpha[i]);
            [r, g, b, a]
        })
        .collect();
    let twin: Vec<f32> = kept
        .iter()
        .flat_map(|&i| {
            let ([r, g, b], a) = (single.rgb[i], single.alpha[i]);
            [r, g, b, a]
        })
        .collect();
    let bound = Bound { absolute: tolerance, relative: tolerance };
    harness.close(&format!("{what}: image"), &device, &truth, Some(&twin), bound);
}

/// All gradients, through all kernels.
fn scene(harness: &mut Harness) -> Result<()> {
    let camera = skew_camera(75, 53);
    for (degree, count) in [(0, 200), (3, 600)] {
        let what = format!("degree {degree}");
        let scene = random(&mut harness.rng, count, degree, &camera);
        // The errors of blending, 1e-6, and of projection: means have errors of 2e-4 pixels close
        // to the camera, where splats are large.
        let run = agree(harness, &what, &scene, &camera, 3e-6)?;
        let settings = RenderSettings::default();
        let (cloud, view) = (Cloud::new(&scene), View::new(&camera));
        let wide = widen(&run.gradient);
        let (exact, exact_view, _) = render::backward(&cloud, &view, &settings, &run.exact, &wide);
        let (single, single_view, _) = render::backward(
            &Cloud::<f32>::new(&scene),
            &View::new(&camera),
            &settings,
            &run.single,
            &run.gradient,
        );
        // Differences in blending, divided by 1 - alpha, have errors of up to 1e-4 of the largest;
        // the case raster/scenes checks each with its own limit.
        compare_gradients(
            harness,
            &what,
            &run.backward,
            (&exact, &exact_view.twist),
            (&single, &single_view.twist),
            1e-4,
            1e-4,
        );
    }
    Ok(())
}

/// The device's gradients against differences of the oracle's image, with thresholds so low that no
/// decision causes a visible step.
fn central_differences(harness: &mut Harness) -> Result<()> {
    const STEP: f64 = 1e-6;
    let settings = RenderSettings {
        alpha_cut: 1e-12,
        alpha_cap: 0.95,
        transmittance_stop: 0.0,
        ..RenderSettings::default()
    };
    let camera = skew_camera(37, 21);
    let scene = random(&mut harness.rng, 8, 1, &camera);
    let (device, stream) = (harness.device.clone(), &mut harness.stream);
    let mut frame = Frame::new(&device, stream, &scene, &camera, 1 << 10, settings)?;
    frame.forward(stream)?;
    // The function has a kink at pixels whose alpha is capped.
    let exact = render::forward(&Cloud::<f64>::new(&scene), &View::new(&camera), &settings);
    let kinks = contested(&exact.splats, &settings, 37, 21, 1e-3);
    let gradient = random_gradient(&mut harness.rng, &kinks);
    let out = frame.backward(stream, &gradient)?;
    let wide = widen(&gradient);
    let value = |cloud: &Cloud<f64>, camera: &Camera| -> f64 {
        let p = render::forward(cloud, &View::new(camera), &settings).pixels;
        let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
        dot(p.rgb.as_flattened(), wide.rgb.as_flattened())
            + dot(&p.alpha, &wide.alpha)
            + dot(&p.depth, &wide.depth)
    };
    let cloud = Cloud::<f64>::new(&scene);
    let numeric = |change: &dyn Fn(&mut Cloud<f64>, f64)| {
        let at = |h: f64| {
            let mut moved = cloud.clone();
            change(&mut moved, h);
            value(&moved, &camera)
        };
        (at(STEP) - at(-STEP)) / (2.0 * STEP)
    };
    let g = &out.gaussians;
    let (mut analytic, mut truth) = (Vec::new(), Vec::new());
    for i in 0..scene.len() {
        for k in 0..3 {
            analytic.extend([g.positions[i][k], g.log_scales[i][k], g.sh[4 * i + 1][k]]);
            truth.push(numeric(&|c, h| c.positions[i][k] += h));
            truth.push(numeric(&|c, h| c.log_scales[i][k] += h));
            truth.push(numeric(&|c, h| c.sh[4 * i + 1][k] += h));
        }
        for k in 0..4 {
            analytic.push(g.rotations[i][k]);
            truth.push(numeric(&|c, h| c.rotations[i][k] += h));
        }
        analytic.push(g.opacity_logits[i]);
        truth.push(numeric(&|c, h| c.opacity_logits[i] += h));
    }
    for k in 0..6 {
        let at = |h: f64| {
            let mut twist = [0.0; 6];
            twist[k] = h;
            value(&cloud, &perturbed(&camera, twist))
        };
        analytic.push(out.pose[k]);
        truth.push((at(STEP) - at(-STEP)) / (2.0 * STEP));
    }
    let largest = truth.iter().fold(0.0f64, |m, v| m.max(v.abs()));
    let bound = Bound { absolute: 2e-6 * largest, relative: 1e-4 };
    harness.close("every gradient", &analytic, &truth, None, bound);
    Ok(())
}

/// The camera of the single-Gaussian cases, at the origin.
fn small() -> Camera {
    plain_camera(40.0, 33, 17)
}

fn near_behind_and_at_the_camera(harness: &mut Harness) -> Result<()> {
    for z in [-1.0, 0.0, 0.009_999, 0.01, 0.010_001, 0.02] {
        let scene = one([0.0, 0.0, z], [-7.0; 3], UPRIGHT, 2.0);
        let run = agree(harness, &format!("z = {z}"), &scene, &small(), 2e-6)?;
        let expected = u32::from(z > 0.01);
        harness.exact(&format!("z = {z}: drawn"), &[run.forward.counts[0]], &[expected]);
    }
    Ok(())
}

fn needles(harness: &mut Harness) -> Result<()> {
    let needle = [(1e3_f32).ln(), (1e-3_f32).ln(), (1e-3_f32).ln()];
    for k in 0..8 {
        let angle = k as f32 * 0.35;
        let rotation = [(angle / 2.0).cos(), 0.0, 0.0, (angle / 2.0).sin()];
        let scene = one([0.05, 0.02, 2.0], needle, rotation, 3.0);
        // A needle 4e4 pixels long and as wide as the dilation.
        let run = agree(harness, &format!("angle {angle}"), &scene, &small(), 1e-5)?;
        let lit = run.forward.rgba.iter().filter(|p| p[3] > 0.3).count();
        harness.holds(&format!("angle {angle}: seen"), lit >= 10);
        // A needle across a large image: rounding of 1e-7 in the direction, times the distance,
        // moves its ends by 1e-4 pixels.
        let wide = plain_camera(900.0, 1000, 600);
        let run = agree(harness, &format!("angle {angle}, wide"), &scene, &wide, 2e-4)?;
        let lit = run.forward.rgba.iter().filter(|p| p[3] > 0.3).count();
        harness.holds(&format!("angle {angle}, wide: seen"), lit >= 600);
    }
    Ok(())
}

fn covering_and_sub_pixel(harness: &mut Harness) -> Result<()> {
    let camera = plain_camera(40.0, 100, 70);
    let cover = one([0.0, 0.0, 2.0], [3.0; 3], UPRIGHT, 1.0);
    let run = agree(harness, "covering", &cover, &camera, 2e-6)?;
    harness.exact("tiles", &run.forward.tile_counts, &[7 * 5]);
    let speck = one([0.0125, 0.0125, 2.0], [-12.0; 3], UPRIGHT, 1.0);
    let run = agree(harness, "sub-pixel", &speck, &camera, 2e-6)?;
    let lit = run.forward.rgba.iter().filter(|p| p[3] > 0.0).count();
    harness.holds("sub-pixel: seen", (1..=12).contains(&lit));
    Ok(())
}

fn scales(harness: &mut Harness) -> Result<()> {
    for exponent in -20..=20 {
        let s = 10.0_f32.powi(exponent).ln();
        let scene = one([0.1, -0.05, 2.0], [s; 3], [0.3, 0.5, -0.2, 0.7], 2.0);
        agree(harness, &format!("1e{exponent}"), &scene, &small(), 2e-6)?;
    }
    // A Gaussian 1e20 times as long as wide may be culled in f32, since the determinant relative to
    // the length's fourth power underflows; exp(89) overflows f32.
    for scale in [[-46.0, 0.0, 46.0], [89.0; 3], [-120.0; 3]] {
        let run = run(harness, &one([0.1, -0.05, 2.0], scale, UPRIGHT, 2.0), &small(), 1e-3)?;
        let finite = all_finite(&run.forward, Some(&run.backward));
        harness.holds(&format!("{scale:?}: finite"), finite);
    }
    Ok(())
}

fn opacities(harness: &mut Harness) -> Result<()> {
    let at_cut = (1.0_f32 / 254.0).ln();
    for (logit, drawn) in [
        (40.0, Some(1)),
        (-40.0, Some(0)),
        (100.0, Some(1)),
        (-100.0, Some(0)),
        (f32::INFINITY, Some(0)),
        (f32::NEG_INFINITY, Some(0)),
        (f32::NAN, Some(0)),
        // Opacity exactly at the cut: drawn with a zero extent or culled, never NaN.
        (at_cut, None),
    ] {
        let scene = one([0.0, 0.0, 2.0], [-1.0; 3], UPRIGHT, logit);
        let what = format!("logit {logit}");
        if let Some(drawn) = drawn {
            let run = agree(harness, &what, &scene, &small(), 2e-6)?;
            harness.exact(&format!("{what}: drawn"), &[run.forward.counts[0]], &[drawn]);
        } else {
            let run = run(harness, &scene, &small(), 1e-3)?;
            harness.holds(&what, all_finite(&run.forward, Some(&run.backward)));
        }
    }
    Ok(())
}

/// The opacity gradient up to logits at which 1 - opacity is zero in f32.
fn opacity_slopes(harness: &mut Harness) -> Result<()> {
    for logit in [-5.0, -2.0, 0.0, 3.0, 6.0, 8.0, 10.0, 12.0, 14.0, 16.0, 30.0, 40.0] {
        let scene = one([0.0, 0.0, 2.0], [-1.0; 3], UPRIGHT, logit);
        let run = run(harness, &scene, &small(), 1e-4)?;
        let gradient = widen(&run.gradient);
        let (settings, view) = (RenderSettings::default(), View::new(&small()));
        let by = render::backward(&Cloud::new(&scene), &view, &settings, &run.exact, &gradient).0;
        let device = &run.backward.gaussians.opacity_logits;
        // A difference in blending, divided by 1 - alpha of down to 1e-3; the gradient is zero
        // where the slope underflows f32.
        let bound = Bound { absolute: 1e-37, relative: 2e-4 };
        let what = format!("logit {logit}");
        harness.close(&what, device, &by.opacity_logits, None, bound);
    }
    Ok(())
}

fn quaternions(harness: &mut Harness) -> Result<()> {
    let scales = [-1.0, -2.0, -3.0];
    let unit = [0.6, 0.0, 0.0, 0.8];
    let reference =
        agree(harness, "length 1", &one([0.0, 0.0, 2.0], scales, unit, 1.0), &small(), 2e-6)?;
    let reference: Vec<f64> =
        reference.forward.rgba.as_flattened().iter().map(|&v| f64::from(v)).collect();
    for length in [1e-6_f32, 1e-3, 7.0, 1e20, 1e30] {
        let scene = one([0.0, 0.0, 2.0], scales, unit.map(|v| v * length), 1.0);
        let what = format!("length {length}");
        let run = agree(harness, &what, &scene, &small(), 2e-6)?;
        let bound = Bound { absolute: 2e-6, relative: 0.0 };
        let image = run.forward.rgba.as_flattened();
        harness.close(&format!("{what}: as of length 1"), image, &reference, None, bound);
    }
    for q in [
        [0.0; 4],
        [1e-11, 0.0, 0.0, 0.0],
        [f32::NAN, 0.0, 0.0, 1.0],
        [0.0, 0.0, 1.0, f32::NAN],
        [f32::INFINITY; 4],
        [1.0, f32::NEG_INFINITY, 0.0, 0.0],
    ] {
        let scene = one([0.0, 0.0, 2.0], scales, q, 1.0);
        let run = agree(harness, &format!("{q:?}"), &scene, &small(), 2e-6)?;
        harness.exact(&format!("{q:?}: culled"), &[run.forward.counts[0]], &[0]);
    }
    Ok(())
}

/// One non-finite parameter culls its Gaussian and leaves the others and their gradients unchanged.
fn non_finite(harness: &mut Harness) -> Result<()> {
    let good = one([0.1, 0.0, 2.0], [-1.0; 3], UPRIGHT, 1.0);
    let alone = agree(harness, "good alone", &good, &small(), 2e-6)?.forward;
    for bad in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
        for field in 0..5 {
            let mut g = good.clone();
            match field {
                0 => g.positions[0][1] = bad,
                1 => g.log_scales[0][2] = bad,
                2 => g.rotations[0][3] = bad,
                3 => g.opacity_logits[0] = bad,
                _ => g.sh[0][1] = bad,
            }
            let what = format!("field {field} {bad}");
            let run = agree(harness, &what, &join(&[g, good.clone()]), &small(), 2e-6)?;
            harness.exact(&format!("{what}: image"), &run.forward.rgba, &alone.rgba);
            let zero = run.backward.gaussians.positions[0] == [0.0; 3];
            harness.holds(&format!("{what}: no gradient"), zero);
        }
    }
    let far = one([1e38, 0.0, 2.0], [-1.0; 3], UPRIGHT, 1.0);
    agree(harness, "position 1e38", &far, &small(), 2e-6)?;
    Ok(())
}

/// A camera with non-finite parameters gives an empty image.
fn non_finite_cameras(harness: &mut Harness) -> Result<()> {
    let scene = join(&[
        one([0.1, 0.0, 2.0], [-1.0; 3], UPRIGHT, 1.0),
        one([-0.4, 0.2, 3.0], [-2.0, 0.0, -1.0], [0.3, 0.5, -0.2, 0.7], 3.0),
    ]);
    for bad in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY, 1e300] {
        for field in 0..6 {
            let mut camera = small();
            let pose = &mut camera.view_from_world;
            match field {
                0 => camera.intrinsics.fx = bad,
                1 => camera.intrinsics.cx = bad,
                2 => camera.intrinsics.cy = bad,
                3 => pose.translation.x = bad,
                4 => pose.translation.z = bad,
                _ => pose.rotation = DQuat::from_xyzw(bad, 0.0, 0.0, 1.0),
            }
            let what = format!("field {field} {bad}");
            let run = run(harness, &scene, &camera, 1e-3)?;
            harness.exact(&format!("{what}: drawn"), &[run.forward.counts[0]], &[0]);
            let finite = all_finite(&run.forward, Some(&run.backward));
            harness.holds(&format!("{what}: finite"), finite);
            let black = run.forward.rgba.as_flattened().iter().all(|&v| v == 0.0);
            harness.holds(&format!("{what}: nothing seen"), black);
        }
    }
    Ok(())
}

fn layers_of_equal_depth(harness: &mut Harness) -> Result<()> {
    let camera = plain_camera(40.0, 17, 3);
    let mut all = join(&vec![one([0.0, 0.0, 2.0], [0.0; 3], UPRIGHT, -4.0); 4000]);
    for (i, sh) in all.sh.iter_mut().enumerate() {
        *sh = [i as f32 * 1e-4, 0.0, 0.0];
    }
    let run = agree(harness, "4000 layers", &all, &camera, 2e-6)?;
    let ascending: Vec<u32> = (0..4000).collect();
    harness.exact("ties break by index", &run.forward.splat_from_rank, &ascending);
    let stop = RenderSettings::default().transmittance_stop;
    let left = 1.0 - run.forward.rgba[8][3];
    harness.holds("stops in front of the stop", left > stop && left < 1.1 * stop);
    Ok(())
}

/// Extreme focal lengths and principal points far outside of the image.
fn fields_of_view(harness: &mut Harness) -> Result<()> {
    let scene = one([0.3, 0.1, 2.0], [-1.0; 3], [0.3, 0.5, -0.2, 0.7], 1.0);
    for focal in [1e-3, 1.0, 1e3, 1e6] {
        for shift in [-1e3, -10.0, 0.0, 10.0, 1e3] {
            let mut camera = plain_camera(focal, 33, 17);
            camera.intrinsics.cx += shift;
            // A mean at a distance of 1e5 pixels is accurate to 1e-2.
            let tolerance = if focal > 1e5 { 1e-4 } else { 1e-5 };
            let what = format!("focal {focal} shift {shift}");
            agree(harness, &what, &scene, &camera, tolerance)?;
        }
    }
    Ok(())
}

/// Camera and scene are far from the origin; their translations cancel.
fn far_from_the_origin(harness: &mut Harness) -> Result<()> {
    let scene = one([1e6, -1e6, 1e6 + 16.0], [1.0; 3], UPRIGHT, 1.0);
    let offset = DVec3::new(1e6, -1e6, 1e6);
    let camera = Camera {
        intrinsics: Intrinsics::centred(40.0, 33, 17),
        view_from_world: Pose::new(DQuat::IDENTITY, -offset),
    };
    let run = agree(harness, "upright", &scene, &camera, 2e-6)?;
    harness.holds("seen", run.forward.rgba[8 * 33 + 16][3] > 0.7);
    // A rotated camera: without subtracting its centre first, products of 1e6 would round by 0.06.
    let rotation = DQuat::from_euler(glam::EulerRot::XYZ, 0.3, -0.4, 0.2);
    let offset = offset + DVec3::new(0.013, -0.021, 0.008);
    let turned = Pose { rotation, translation: rotation * -offset };
    let camera = Camera { view_from_world: turned, ..camera };
    let run = agree(harness, "turned", &scene, &camera, 2e-6)?;
    harness.exact("turned: drawn", &[run.forward.counts[0]], &[1]);
    Ok(())
}

/// Gaussians across all tiles, near the right end, and in the middle; the right end is at 4000
/// pixels per unit of `far`.
fn strip(far: f32) -> Gaussians {
    join(&[
        one([0.0, 0.0, 2.0], [20.0, -3.0, -3.0], UPRIGHT, 0.0),
        one([far, 0.0, 4.0], [0.0; 3], UPRIGHT, 1.0),
        one([0.3, 0.0, 3.0], [-2.0; 3], UPRIGHT, 2.0),
    ])
}

/// A folded grid of 2001 tiles; and 65,538 tiles, which give an image if it fits a binding, else
/// the documented error.
fn many_tiles(harness: &mut Harness) -> Result<()> {
    let device = harness.device.with_limits(Limits { groups: 100, ..*harness.device.limits() });
    let stream = std::mem::replace(&mut harness.stream, device.stream()?);
    let device = std::mem::replace(&mut harness.device, device);
    let camera = plain_camera(1000.0, 16 * 2000 + 9, 1);
    let run = agree(harness, "folded", &strip(63.0), &camera, 1e-3)?;
    harness.exact("folded: the wide one's tiles", &run.forward.tile_counts[..1], &[2001]);
    (harness.device, harness.stream) = (device, stream);

    let (width, height) = (16 * 32_768 + 1, 17);
    let camera = plain_camera(1000.0, width, height);
    match forward_alone(harness, &strip(1048.0), &camera) {
        Ok(forward) => {
            harness.exact("the wide one's tiles", &forward.tile_counts[..1], &[2 * 32_769]);
            // Half opaque at mid-height, with a standard deviation of 25 pixels.
            let dimmest = forward.rgba.iter().fold(1.0f32, |least, p| p[3].min(least));
            harness.holds("every pixel is seen", dimmest > 0.45);
            let right = forward.rgba[(8 * width + width / 2 + 262_000) as usize][3];
            harness.holds("the one at the right end is seen", right > 0.8);
        }
        Err(Error::RangeLimit { .. } | Error::OutOfMemory { .. }) => {
            harness.holds("the documented error", true);
        }
        Err(error) => return Err(error),
    }
    Ok(())
}

fn forward_alone(harness: &mut Harness, scene: &Gaussians, camera: &Camera) -> Result<Forward> {
    let (device, settings) = (harness.device.clone(), RenderSettings::default());
    let stream = &mut harness.stream;
    Frame::new(&device, stream, scene, camera, 1 << 18, settings)?.forward(stream)
}

fn no_splats(harness: &mut Harness) -> Result<()> {
    let culled = one([0.0, 0.0, -1.0], [-1.0; 3], UPRIGHT, 1.0);
    for (what, scene) in [("no Gaussians", Gaussians::default()), ("all culled", culled)] {
        let run = agree(harness, what, &scene, &small(), 0.0)?;
        let black = run.forward.rgba.as_flattened().iter().chain(&run.forward.depth);
        harness.holds(&format!("{what}: nothing seen"), black.copied().all(|v| v == 0.0));
        harness.exact(&format!("{what}: pose"), &run.backward.pose, &[0.0; 6]);
        harness.exact(&format!("{what}: counts"), &run.forward.counts, &[0, 0]);
    }
    Ok(())
}

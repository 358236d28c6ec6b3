//! Check cases of blending and its gradients; the reference uses the splats and tile lists that the
//! device itself has made.

use super::rounding::gradient_limits;
use super::scene::{
    Forward, Frame, UPRIGHT, as_f32, contested, flip_ranges, join, one, plain_camera, random,
    random_gradient, skew_camera, widen,
};
use super::{Bound, Case, Harness};
use crate::error::Result;
use crate::ops::render::Render;
use crate::oracle::project_backward::SplatGradient;
use crate::oracle::raster;
use crate::types::{Camera, Gaussians, RasterKind, RenderSettings};
use rand::RngExt;

/// The family's cases.
pub const CASES: &[Case] = &[
    Case { id: "raster/scenes", run: scenes },
    Case { id: "raster/image_sizes", run: image_sizes },
    Case { id: "raster/shared_memory", run: shared_memory },
    Case { id: "raster/layers", run: layers },
    Case { id: "raster/blending_constants", run: blending_constants },
    Case { id: "raster/decisions", run: decisions },
    Case { id: "raster/overflow", run: overflow },
    Case { id: "raster/determinism", run: determinism },
];

/// Relative tolerance of decisions: rounding in a power of up to 6 and in a product of hundreds of
/// transmittances.
const BAND: f64 = 2e-5;

fn compare(
    harness: &mut Harness,
    what: &str,
    scene: &Gaussians,
    camera: &Camera,
    capacity: usize,
    settings: RenderSettings,
) -> Result<Forward> {
    compare_blended(harness, what, scene, camera, capacity, (settings, |render| render))
}

/// Renders, differentiates a random linear function of the image, and compares image and gradients.
fn compare_blended(
    harness: &mut Harness,
    what: &str,
    scene: &Gaussians,
    camera: &Camera,
    capacity: usize,
    (settings, variant): (RenderSettings, fn(Render) -> Render),
) -> Result<Forward> {
    let device = harness.device.clone();
    let stream = &mut harness.stream;
    let mut frame = Frame::new(&device, stream, scene, camera, capacity, settings)?;
    frame.inner.plan = variant(frame.inner.plan.clone());
    let out = frame.forward(stream)?;
    let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
    let (splats, bins) = (out.splats(), out.bins(width, height));
    let single_splats = as_f32(&splats);
    let contested = contested(&splats, &settings, width, height, BAND);
    let left_out = contested.iter().filter(|&&c| c).count();
    harness.holds(
        &format!("{what}: few pixels are undecided"),
        left_out * 20 <= contested.len().max(20),
    );
    let exact = raster::forward(&splats, &bins, &settings, width, height);
    let single = raster::forward(&single_splats, &bins, &settings, width, height);

    let clear: Vec<usize> = (0..contested.len()).filter(|&i| !contested[i]).collect();
    let depths = splats.iter().flatten().map(|s| s.depth).fold(1.0, f64::max);
    let rgba: Vec<f32> = clear.iter().flat_map(|&i| out.rgba[i]).collect();
    let flat = |rgb: [f64; 3], alpha: f64| [rgb[0], rgb[1], rgb[2], alpha];
    let exact_rgba: Vec<f64> =
        clear.iter().flat_map(|&i| flat(exact.rgb[i], exact.alpha[i])).collect();
    let single_rgba: Vec<f32> = clear
        .iter()
        .flat_map(|&i| flat(single.rgb[i].map(f64::from), f64::from(single.alpha[i])))
        .map(|v| v as f32)
        .collect();
    // Rounding of the power (4e-7 at a power of 5.5) and of the exponential, averaged over the
    // splats of a pixel; measured 8e-7 at most, as for the oracle in f32.
    let bound = Bound { absolute: 2e-6, relative: 2e-6 };
    harness.close(&format!("{what}: rgba"), &rgba, &exact_rgba, Some(&single_rgba), bound);
    let depth: Vec<f32> = clear.iter().map(|&i| out.depth[i]).collect();
    let exact_depth: Vec<f64> = clear.iter().map(|&i| exact.depth[i]).collect();
    let single_depth: Vec<f32> = clear.iter().map(|&i| single.depth[i]).collect();
    let bound = Bound { absolute: 2e-6 * depths, relative: 2e-6 };
    harness.close(&format!("{what}: depth"), &depth, &exact_depth, Some(&single_depth), bound);

    let gradient = random_gradient(&mut harness.rng, &contested);
    let device = frame.backward(&mut harness.stream, &gradient)?.splats;
    let wide = widen(&gradient);
    let exact = raster::backward(&splats, &bins, &settings, width, height, &exact, &wide);
    let single =
        raster::backward(&single_splats, &bins, &settings, width, height, &single, &gradient);
    let limits = gradient_limits(&splats, &bins, &settings, width, height, &wide);
    compare_gradients(harness, what, &device, &exact, &single, &limits);
    Ok(out)
}

type Rows<R> = fn(&SplatGradient<R>) -> Vec<R>;

fn compare_gradients(
    harness: &mut Harness,
    what: &str,
    device: &[SplatGradient<f32>],
    exact: &[SplatGradient<f64>],
    single: &[SplatGradient<f32>],
    limits: &[SplatGradient<f64>],
) {
    let parts: [(&str, Rows<f32>, Rows<f64>); 5] = [
        ("mean", |g| g.mean.into(), |g| g.mean.into()),
        ("covariance", |g| g.covariance.into(), |g| g.covariance.into()),
        ("opacity", |g| vec![g.opacity], |g| vec![g.opacity]),
        ("depth", |g| vec![g.depth], |g| vec![g.depth]),
        ("colour", |g| g.colour.into(), |g| g.colour.into()),
    ];
    for (name, of_f32, of_f64) in parts {
        let device: Vec<f32> = device.iter().flat_map(of_f32).collect();
        let exact: Vec<f64> = exact.iter().flat_map(of_f64).collect();
        let single: Vec<f32> = single.iter().flat_map(of_f32).collect();
        // Values below the smallest normal f32 may be flushed to zero.
        let limits: Vec<f64> = limits.iter().flat_map(of_f64).map(|limit| limit + 1e-30).collect();
        let output = format!("{what}: by {name}");
        harness.within(&output, &device, &exact, Some(&single), &limits);
    }
}

fn scenes(harness: &mut Harness) -> Result<()> {
    let camera = skew_camera(83, 59);
    for count in [0, 1, 31, 300, 2500] {
        let scene = random(&mut harness.rng, count, 0, &camera);
        let what = format!("{count} Gaussians");
        compare(harness, &what, &scene, &camera, 1 << 14, RenderSettings::default())?;
    }
    Ok(())
}

/// The shared-memory variant: full batches, partial and empty ones; images with partial tiles; and
/// its backward pass, which starts where each pixel stopped.
fn shared_memory(harness: &mut Harness) -> Result<()> {
    let shared: fn(Render) -> Render = |render| render.with_raster(RasterKind::Shared);
    let how = (RenderSettings::default(), shared);
    let camera = skew_camera(83, 59);
    for count in [0, 1, 31, 300, 2500] {
        let scene = random(&mut harness.rng, count, 0, &camera);
        let what = format!("{count} Gaussians");
        let out = compare_blended(harness, &what, &scene, &camera, 1 << 14, how)?;
        let longest = out.ranges.iter().map(|[begin, end]| end - begin).max();
        if count == 2500 {
            harness.holds("a tile takes more than a batch", longest > Some(256));
        }
    }
    for (width, height) in [(1, 1), (17, 3), (33, 16)] {
        let camera = plain_camera(20.0, width, height);
        let parts: Vec<_> = (0..40)
            .map(|_| {
                let mut random = |r: f32| harness.rng.random_range(-r..r);
                one([random(2.0), random(0.3), 3.0 + random(1.0)], [-1.0; 3], UPRIGHT, random(3.0))
            })
            .collect();
        let what = format!("{width}×{height}");
        compare_blended(harness, &what, &join(&parts), &camera, 1 << 14, how)?;
    }
    Ok(())
}

fn image_sizes(harness: &mut Harness) -> Result<()> {
    for (width, height) in [(1, 1), (17, 3), (16, 16), (3, 33), (4097, 2)] {
        let camera = plain_camera(20.0, width, height);
        let parts: Vec<_> = (0..40)
            .map(|_| {
                let mut random = |r: f32| harness.rng.random_range(-r..r);
                one([random(2.0), random(0.3), 3.0 + random(1.0)], [-1.0; 3], UPRIGHT, random(3.0))
            })
            .collect();
        let what = format!("{width}×{height}");
        compare(harness, &what, &join(&parts), &camera, 1 << 14, RenderSettings::default())?;
    }
    Ok(())
}

/// Thousands of splats on every pixel: batches, early termination, and list entries that no pixel
/// blends.
fn layers(harness: &mut Harness) -> Result<()> {
    let camera = plain_camera(40.0, 37, 21);
    for (what, logit) in [("opaque", 0.0), ("faint", -4.0)] {
        let parts: Vec<_> = (0..3000)
            .map(|i| {
                let mut part = one([0.0, 0.0, 2.0 + 1e-3 * i as f32], [0.0; 3], UPRIGHT, logit);
                part.sh[0] = std::array::from_fn(|_| harness.rng.random_range(-1.0..1.0));
                part
            })
            .collect();
        let out =
            compare(harness, what, &join(&parts), &camera, 1 << 15, RenderSettings::default())?;
        let stop = RenderSettings::default().transmittance_stop;
        let opaque = out.rgba.iter().all(|p| 1.0 - p[3] > stop && 1.0 - p[3] < 2.5 * stop);
        harness.holds(&format!("{what}: stops in front of the stop"), opaque);
    }
    Ok(())
}

/// Values of α cut, α cap and transmittance stop other than the defaults.
fn blending_constants(harness: &mut Harness) -> Result<()> {
    let camera = skew_camera(61, 47);
    let scene = random(&mut harness.rng, 400, 0, &camera);
    let defaults = RenderSettings::default();
    for (what, settings) in [
        ("cut 1e-6", RenderSettings { alpha_cut: 1e-6, ..defaults }),
        ("cut 0.2", RenderSettings { alpha_cut: 0.2, ..defaults }),
        ("cap 0.6", RenderSettings { alpha_cap: 0.6, ..defaults }),
        ("no stop", RenderSettings { transmittance_stop: 0.0, ..defaults }),
        ("stop 0.3", RenderSettings { transmittance_stop: 0.3, ..defaults }),
        ("no dilation", RenderSettings { dilation: 0.0, ..defaults }),
    ] {
        compare(harness, what, &scene, &camera, 1 << 14, settings)?;
    }
    Ok(())
}

/// Splats so wide that alpha crosses the cut, or the transmittance crosses the stop, with a very
/// small slope. Pixels far from the crossing must match the oracle. In the remaining pixels the
/// decision may differ: the error must not exceed the effect of the decision, and not all of these
/// pixels may differ.
fn decisions(harness: &mut Harness) -> Result<()> {
    let camera = plain_camera(40.0, 83, 59);
    let settings = RenderSettings::default();
    let logit = |opacity: f64| (opacity / (1.0 - opacity)).ln() as f32;
    let cut = f64::from(settings.alpha_cut);
    let mut jitter = |size: f64| 1.0 + harness.rng.random_range(-size..size);
    let wide =
        |z: f32, size: f32, opacity: f64| one([0.02, 0.01, z], [size; 3], UPRIGHT, logit(opacity));
    // The value varies by 1e-4 over the image; and by 5e-6, since 1 - alpha amplifies it a
    // hundredfold.
    let faint: Vec<_> = (0..40)
        .map(|i| wide(2.0 + 0.01 * i as f32, 4.5, cut * (1.0 + 1e-4 * jitter(1.0))))
        .collect();
    let opaque: Vec<_> = (0..2)
        .map(|i| wide(2.0 + i as f32, 6.5, 0.99 * (1.0 + 2e-6 * jitter(1.0))))
        .chain([wide(4.0, 4.5, 0.9), wide(5.0, 4.5, 0.9)])
        .collect();
    for (what, parts) in [("alpha cut", faint), ("stop", opaque)] {
        let device = harness.device.clone();
        let scene = join(&parts);
        let mut frame =
            Frame::new(&device, &mut harness.stream, &scene, &camera, 1 << 14, settings)?;
        let out = frame.forward(&mut harness.stream)?;
        let (splats, bins) = (out.splats(), out.bins(83, 59));
        let exact = raster::forward(&splats, &bins, &settings, 83, 59);
        let flip_ranges = flip_ranges(&splats, &settings, 83, 59, BAND);
        let brightest = splats.iter().flatten().flat_map(|s| s.colour).fold(1.0f64, f64::max);
        let limits: Vec<f64> =
            flip_ranges.iter().flat_map(|flip_range| [2e-6 + flip_range * brightest; 4]).collect();
        let truth: Vec<f64> = (0..exact.alpha.len())
            .flat_map(|i| [exact.rgb[i][0], exact.rgb[i][1], exact.rgb[i][2], exact.alpha[i]])
            .collect();
        let rgba = out.rgba.as_flattened();
        harness.within(&format!("{what}: rgba"), rgba, &truth, None, &limits);
        let undecided = flip_ranges.iter().filter(|&&flip_range| flip_range > 0.0).count();
        harness.holds(
            &format!("{what}: {undecided} pixels are undecided"),
            undecided > 10 && undecided < 4000,
        );
        let flips = (0..flip_ranges.len())
            .filter(|&i| (f64::from(out.rgba[i][3]) - exact.alpha[i]).abs() > 2e-6)
            .count();
        harness.holds(&format!("{what}: {flips} of {undecided} flip"), 2 * flips <= undecided);
    }
    Ok(())
}

/// Image and gradients of the splats that fit, when the capacity is exceeded.
fn overflow(harness: &mut Harness) -> Result<()> {
    let camera = skew_camera(83, 59);
    let scene = random(&mut harness.rng, 1500, 0, &camera);
    for capacity in [0, 1, 500] {
        let what = format!("room for {capacity}");
        let out = compare(harness, &what, &scene, &camera, capacity, RenderSettings::default())?;
        harness.holds(&format!("{what}: overflows"), out.counts[1] as usize > capacity);
    }
    Ok(())
}

/// Repeated runs give the same bits.
fn determinism(harness: &mut Harness) -> Result<()> {
    let camera = skew_camera(97, 71);
    let scene = random(&mut harness.rng, 3000, 1, &camera);
    let device = harness.device.clone();
    let stream = &mut harness.stream;
    let gradient = random_gradient(&mut harness.rng, &vec![false; 97 * 71]);
    let mut runs = Vec::new();
    for _ in 0..3 {
        let settings = RenderSettings::default();
        let mut frame = Frame::new(&device, stream, &scene, &camera, 1 << 15, settings)?;
        let forward = frame.forward(stream)?;
        let backward = frame.backward(stream, &gradient)?;
        let bits = |v: &[f32]| v.iter().map(|x| x.to_bits()).collect::<Vec<u32>>();
        let g = &backward.gaussians;
        runs.push([
            bits(forward.rgba.as_flattened()),
            bits(&forward.depth),
            bits(g.positions.as_flattened()),
            bits(g.log_scales.as_flattened()),
            bits(g.rotations.as_flattened()),
            bits(&g.opacity_logits),
            bits(g.sh.as_flattened()),
            bits(&backward.pose),
        ]);
    }
    harness.holds("something was rendered", runs[0][0].iter().any(|&word| word != 0));
    for run in &runs[1..] {
        for (again, first) in run.iter().zip(&runs[0]) {
            harness.exact("again", again, first);
        }
    }
    Ok(())
}

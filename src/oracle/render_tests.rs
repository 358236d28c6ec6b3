//! The renderer's gradients against central differences, and its image against gsplat's.

use super::project::project;
use super::project_backward::{SplatGradient, project_backward};
use super::raster::Pixels;
use super::render;
use super::tiles::{power, whitened};
use super::view::{Cloud, View, perturbed};
use crate::types::{Camera, Gaussians, Intrinsics, Pose, RenderSettings, sh_coefficients};
use glam::{DQuat, DVec3};
use rand::{RngExt, SeedableRng};

#[path = "../../tests/support/data.rs"]
mod data;

/// Cuts so low that their steps vanish among rounding errors: differences across them would not
/// converge.
const SMOOTH: RenderSettings = RenderSettings {
    near: 0.01,
    dilation: 0.3,
    alpha_cut: 1e-12,
    alpha_cap: 0.95,
    transmittance_stop: 0.0,
    tangent_clamp: 1.3,
};

fn camera() -> Camera {
    Camera {
        intrinsics: Intrinsics { fx: 30.0, fy: 34.0, cx: 17.3, cy: 9.1, width: 37, height: 21 },
        view_from_world: Pose::new(
            DQuat::from_euler(glam::EulerRot::XYZ, 0.3, -0.4, 0.2),
            DVec3::new(0.2, -0.3, 0.5),
        ),
    }
}

/// Gaussians before [`camera`], some beside its field of view, where the tangents are clamped.
fn cloud(count: usize, degree: u32, seed: u64) -> Cloud<f64> {
    let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(seed);
    let world_from_view = camera().view_from_world.inverse();
    let mut cloud = Cloud { sh_degree: degree, ..Cloud::default() };
    for index in 0..count {
        let spread = if index % 3 == 0 { 1.8 } else { 0.6 };
        let z = rng.random_range(1.5..5.0);
        let at = DVec3::new(
            z * rng.random_range(-spread..spread),
            z * rng.random_range(-spread..spread) * 0.5,
            z,
        );
        cloud.positions.push(world_from_view.apply(at).to_array());
        let size = if index % 3 == 0 { 0.3 } else { -1.2 };
        cloud.log_scales.push(std::array::from_fn(|_| size + rng.random_range(-1.0..0.5)));
        cloud.rotations.push(std::array::from_fn(|_| rng.random_range(-1.5..1.5)));
        cloud.opacity_logits.push(rng.random_range(-2.0..4.5));
        for _ in 0..sh_coefficients(degree) {
            cloud.sh.push(std::array::from_fn(|_| rng.random_range(-0.6..0.6)));
        }
    }
    cloud
}

/// Checks every gradient of a scalar function of the Gaussians and the camera.
fn check(
    cloud: &Cloud<f64>,
    camera: &Camera,
    value: &dyn Fn(&Cloud<f64>, &View<f64>) -> f64,
    gradient: &(Cloud<f64>, super::project_backward::ViewGradient<f64>),
    tolerance: f64,
) {
    const STEP: f64 = 1e-6;
    let view = View::new(camera);
    let close = |what: &str, analytic: f64, at: &dyn Fn(f64) -> f64| {
        let numeric = (at(STEP) - at(-STEP)) / (2.0 * STEP);
        let error = (analytic - numeric).abs();
        assert!(
            error <= tolerance * (1.0 + numeric.abs()),
            "{what}: analytic {analytic}, numeric {numeric}"
        );
    };
    let moved = |change: &dyn Fn(&mut Cloud<f64>)| {
        let mut cloud = cloud.clone();
        change(&mut cloud);
        value(&cloud, &view)
    };
    let (to, to_view) = gradient;
    for i in 0..cloud.len() {
        for k in 0..3 {
            close(&format!("position {i} {k}"), to.positions[i][k], &|h| {
                moved(&|c| c.positions[i][k] += h)
            });
            close(&format!("log scale {i} {k}"), to.log_scales[i][k], &|h| {
                moved(&|c| c.log_scales[i][k] += h)
            });
        }
        for k in 0..4 {
            close(&format!("rotation {i} {k}"), to.rotations[i][k], &|h| {
                moved(&|c| c.rotations[i][k] += h)
            });
        }
        close(&format!("opacity {i}"), to.opacity_logits[i], &|h| {
            moved(&|c| c.opacity_logits[i] += h)
        });
    }
    for i in 0..cloud.sh.len() {
        for k in 0..3 {
            close(&format!("sh {i} {k}"), to.sh[i][k], &|h| moved(&|c| c.sh[i][k] += h));
        }
    }
    for k in 0..6 {
        close(&format!("twist {k}"), to_view.twist[k], &|h| {
            let mut twist = [0.0; 6];
            twist[k] = h;
            value(cloud, &View::new(&perturbed(camera, twist)))
        });
    }
    for k in 0..2 {
        let seen = |change: &dyn Fn(&mut View<f64>)| {
            let mut view = view.clone();
            change(&mut view);
            value(cloud, &view)
        };
        close(&format!("focal {k}"), to_view.focal[k], &|h| seen(&|v| v.focal[k] += h));
        close(&format!("centre {k}"), to_view.centre[k], &|h| seen(&|v| v.centre[k] += h));
    }
}

/// A loss: linear in what a splat shows, the conic by its powers at some offsets.
struct Weights {
    plain: SplatGradient<f64>,
    /// Weight and offset.
    powers: [(f64, f64, f64); 3],
}

impl Weights {
    /// The power falls as the covariance grows: by the square of the whitened offset.
    fn gradient(&self, conic: [f64; 3]) -> SplatGradient<f64> {
        let mut covariance = [0.0; 3];
        for &(v, dx, dy) in &self.powers {
            let [h, k] = whitened(conic, dx, dy);
            covariance = super::linear::sub(covariance, [v * h * h, v * h * k, v * k * k]);
        }
        SplatGradient { covariance, ..self.plain }
    }
}

#[test]
fn projection_gradient_matches_central_differences() {
    for degree in 0..=3 {
        let (cloud, camera) = (cloud(24, degree, 11), camera());
        let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(5);
        let mut random = || rng.random_range(-1.0..1.0);
        let weights: Vec<Weights> = (0..cloud.len())
            .map(|_| Weights {
                plain: SplatGradient {
                    mean: std::array::from_fn(|_| random()),
                    covariance: [0.0; 3],
                    opacity: random(),
                    depth: random(),
                    colour: std::array::from_fn(|_| random()),
                },
                powers: std::array::from_fn(|_| (random(), random() * 3.0, random() * 3.0)),
            })
            .collect();
        let value = |cloud: &Cloud<f64>, view: &View<f64>| {
            project(cloud, view, &SMOOTH)
                .iter()
                .zip(&weights)
                .filter_map(|(splat, w)| splat.as_ref().map(|s| (s, w)))
                .map(|(s, w)| {
                    let powers = w.powers.iter().map(|(v, dx, dy)| v * power(s.conic, *dx, *dy));
                    super::linear::dot(s.mean, w.plain.mean)
                        + powers.sum::<f64>()
                        + s.opacity * w.plain.opacity
                        + s.depth * w.plain.depth
                        + super::linear::dot(s.colour, w.plain.colour)
                })
                .sum()
        };
        let view = View::new(&camera);
        let splats = project(&cloud, &view, &SMOOTH);
        let drawn = splats.iter().flatten().count();
        assert!(drawn > 15, "only {drawn} drawn");
        let gradients: Vec<_> = splats
            .iter()
            .zip(&weights)
            .map(|(s, w)| s.as_ref().map_or(w.plain, |s| w.gradient(s.conic)))
            .collect();
        let gradient = project_backward(&cloud, &view, &SMOOTH, &splats, &gradients);
        check(&cloud, &camera, &value, &gradient, 1e-6);
    }
}

/// Some of the Gaussians used above lie where the tangent is clamped, along x and along y.
#[test]
fn clamped_tangents_are_exercised() {
    let (cloud, view) = (cloud(24, 0, 11), View::new(&camera()));
    let mut clamped = [0; 2];
    let splats = project(&cloud, &view, &SMOOTH);
    for index in (0..cloud.len()).filter(|&i| splats[i].is_some()) {
        let geometry = super::project::geometry(&cloud, index, &view, &SMOOTH).unwrap();
        for k in 0..2 {
            clamped[k] += usize::from(geometry.clamped[k]);
        }
    }
    assert!(clamped[0] > 0 && clamped[1] > 0, "{clamped:?}");
}

#[test]
fn render_gradient_matches_central_differences() {
    let (cloud, camera) = (cloud(9, 1, 23), camera());
    let view = View::new(&camera);
    let count = (view.width * view.height) as usize;
    let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(6);
    let mut random = || rng.random_range(-1.0..1.0);
    let weights = Pixels {
        rgb: (0..count).map(|_| std::array::from_fn(|_| random())).collect(),
        alpha: (0..count).map(|_| random()).collect(),
        depth: (0..count).map(|_| random()).collect(),
    };
    let value = |cloud: &Cloud<f64>, view: &View<f64>| {
        let pixels = render::forward(cloud, view, &SMOOTH).pixels;
        (0..count)
            .map(|i| {
                super::linear::dot(pixels.rgb[i], weights.rgb[i])
                    + pixels.alpha[i] * weights.alpha[i]
                    + pixels.depth[i] * weights.depth[i]
            })
            .sum()
    };
    let rendered = render::forward(&cloud, &view, &SMOOTH);
    assert!(rendered.bins.tiles.len() > 20);
    let (gaussians, to_view, _) = render::backward(&cloud, &view, &SMOOTH, &rendered, &weights);
    check(&cloud, &camera, &value, &(gaussians, to_view), 2e-5);
}

/// f32 gives the same gradients as f64 but for rounding.
#[test]
fn f32_gradient_agrees_with_f64() {
    let wide = cloud(40, 3, 31);
    let host = Gaussians {
        positions: wide.positions.iter().map(|v| v.map(|x| x as f32)).collect(),
        log_scales: wide.log_scales.iter().map(|v| v.map(|x| x as f32)).collect(),
        rotations: wide.rotations.iter().map(|v| v.map(|x| x as f32)).collect(),
        opacity_logits: wide.opacity_logits.iter().map(|&x| x as f32).collect(),
        sh_degree: 3,
        sh: wide.sh.iter().map(|v| v.map(|x| x as f32)).collect(),
        motion_logits: Vec::new(),
    };
    fn run<R: super::Real>(host: &Gaussians) -> (Pixels<R>, Cloud<R>) {
        let (cloud, view) = (Cloud::<R>::new(host), View::<R>::new(&camera()));
        let settings = RenderSettings { alpha_cut: 1e-6, ..SMOOTH };
        let rendered = render::forward(&cloud, &view, &settings);
        let count = rendered.pixels.alpha.len();
        let gradient = Pixels {
            rgb: vec![[R::of(0.3), R::of(-0.8), R::of(0.5)]; count],
            alpha: vec![R::of(0.2); count],
            depth: vec![R::of(-0.1); count],
        };
        let gaussians = render::backward(&cloud, &view, &settings, &rendered, &gradient).0;
        (rendered.pixels, gaussians)
    }
    let (image, gradient) = run::<f64>(&host);
    let (image32, gradient32) = run::<f32>(&host);
    for (a, b) in image.rgb.iter().flatten().zip(image32.rgb.iter().flatten()) {
        assert!((a - f64::from(*b)).abs() < 2e-5, "{a} {b}");
    }
    let largest = gradient.positions.iter().flatten().fold(0.0_f64, |m, x| m.max(x.abs()));
    for (a, b) in gradient.positions.iter().flatten().zip(gradient32.positions.iter().flatten()) {
        assert!((a - f64::from(*b)).abs() < 1e-4 * largest, "{a} {b}");
    }
}

/// Without tiles: every pixel blends every splat by (depth, index). Tiles may only leave out what
/// contributes nothing.
#[test]
fn tiles_change_nothing() {
    let settings = RenderSettings::default();
    let (mut cloud, view) = (cloud(60, 0, 41), View::new(&camera()));
    cloud.log_scales.iter_mut().flatten().for_each(|s| *s -= 1.5);
    let rendered = render::forward(&cloud, &view, &settings);
    let drawn = rendered.bins.splat_from_rank.len();
    let pairs = rendered.bins.tiles.len();
    assert!(drawn > 20 && pairs < drawn * 3, "{drawn} splats, {pairs} pairs of 6 tiles each");
    let mut order: Vec<_> = rendered.splats.iter().flatten().collect();
    order.sort_by(|a, b| a.depth.total_cmp(&b.depth));
    for y in 0..view.height {
        for x in 0..view.width {
            let (mut left, mut rgb, mut depth) = (1.0_f64, [0.0; 3], 0.0);
            for s in &order {
                let (dx, dy) = (f64::from(x) + 0.5 - s.mean[0], f64::from(y) + 0.5 - s.mean[1]);
                let power = power(s.conic, dx, dy);
                let alpha = (s.opacity * (-power).exp()).min(f64::from(settings.alpha_cap));
                if alpha < f64::from(settings.alpha_cut) {
                    continue;
                }
                if left * (1.0 - alpha) <= f64::from(settings.transmittance_stop) {
                    break;
                }
                for c in 0..3 {
                    rgb[c] += left * alpha * s.colour[c];
                }
                depth += left * alpha * s.depth;
                left *= 1.0 - alpha;
            }
            let at = (y * view.width + x) as usize;
            assert!((rendered.pixels.alpha[at] - (1.0 - left)).abs() < 1e-12, "{x} {y}");
            assert!((rendered.pixels.depth[at] - depth).abs() < 1e-12);
            for c in 0..3 {
                assert!((rendered.pixels.rgb[at][c] - rgb[c]).abs() < 1e-12);
            }
        }
    }
}

/// gsplat's own image of four splats; the data's README says with which camera and constants.
#[test]
fn agrees_with_gsplat() {
    let Some(path) = data::shared_data("brush_ref/tiny_case.safetensors") else { return };
    let bytes = std::fs::read(path).unwrap();
    let file = safetensors::SafeTensors::deserialize(&bytes).unwrap();
    let floats = |name: &str| -> Vec<f32> {
        let data = file.tensor(name).unwrap().data().to_vec();
        data.chunks_exact(4).map(|b| f32::from_le_bytes(b.try_into().unwrap())).collect()
    };
    let threes = |name: &str| -> Vec<[f32; 3]> {
        floats(name).chunks_exact(3).map(|c| c.try_into().unwrap()).collect()
    };
    let gaussians = Gaussians {
        positions: threes("means"),
        log_scales: threes("scales"),
        rotations: floats("quats").chunks_exact(4).map(|c| c.try_into().unwrap()).collect(),
        opacity_logits: floats("opacities"),
        sh_degree: 3,
        sh: threes("coeffs"),
        motion_logits: Vec::new(),
    };
    let camera = Camera {
        intrinsics: Intrinsics { fx: 61.5, fy: 61.5, cx: 61.5, cy: 41.0, width: 123, height: 82 },
        view_from_world: Pose::new(DQuat::IDENTITY, -DVec3::new(0.123, 0.456, -8.0)),
    };
    let pixels = render::forward(
        &Cloud::<f64>::new(&gaussians),
        &View::new(&camera),
        &RenderSettings::default(),
    )
    .pixels;
    let expected = floats("out_img");
    let mut worst = 0.0_f64;
    for (i, row) in expected.chunks_exact(4).enumerate() {
        let [r, g, b] = pixels.rgb[i];
        for (ours, &theirs) in [r, g, b, pixels.alpha[i]].into_iter().zip(row) {
            let theirs = f64::from(theirs);
            let error = (ours - theirs).abs();
            worst = worst.max(error);
            assert!(error <= 1e-5 + 0.01 * theirs.abs(), "pixel {i}: {ours} {theirs}");
        }
    }
    println!("largest difference from gsplat: {worst:.2e}");
    assert!(expected.iter().any(|&v| v > 0.1), "the reference shows nothing");
}

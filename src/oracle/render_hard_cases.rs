//! Tests of hard inputs: every result is finite, in f32 and in f64.

use super::Real;
use super::raster::Pixels;
use super::render;
use super::view::{Cloud, View};
use crate::types::{Camera, Gaussians, Intrinsics, Pose, RenderSettings};
use glam::{DQuat, DVec3};

fn camera(focal: f64, width: u32, height: u32) -> Camera {
    Camera {
        intrinsics: Intrinsics::centred(focal, width, height),
        view_from_world: Pose::IDENTITY,
    }
}

fn one(position: [f32; 3], log_scale: [f32; 3], rotation: [f32; 4], logit: f32) -> Gaussians {
    Gaussians {
        positions: vec![position],
        log_scales: vec![log_scale],
        rotations: vec![rotation],
        opacity_logits: vec![logit],
        sh_degree: 0,
        sh: vec![[0.4, 0.1, -0.2]],
        motion_logits: Vec::new(),
    }
}

fn join(parts: &[Gaussians]) -> Gaussians {
    let mut all = Gaussians::default();
    for part in parts {
        all.positions.extend(&part.positions);
        all.log_scales.extend(&part.log_scales);
        all.rotations.extend(&part.rotations);
        all.opacity_logits.extend(&part.opacity_logits);
        all.sh.extend(&part.sh);
    }
    all
}

const UPRIGHT: [f32; 4] = [1.0, 0.0, 0.0, 0.0];

/// Renders and differentiates; everything that comes out must be finite. Returns the image and the
/// number of Gaussians drawn.
fn run<R: Real>(gaussians: &Gaussians, camera: &Camera) -> (Pixels<R>, usize) {
    let settings = RenderSettings::default();
    let (cloud, view) = (Cloud::<R>::new(gaussians), View::<R>::new(camera));
    let rendered = render::forward(&cloud, &view, &settings);
    let count = rendered.pixels.alpha.len();
    let gradient = Pixels {
        rgb: vec![[R::of(0.5), R::of(-1.0), R::of(0.25)]; count],
        alpha: vec![R::of(0.3); count],
        depth: vec![R::of(0.1); count],
    };
    let (to, to_view, to_splats) = render::backward(&cloud, &view, &settings, &rendered, &gradient);
    let all = rendered.pixels.rgb.iter().flatten().chain(&rendered.pixels.alpha);
    let all = all.chain(&rendered.pixels.depth).chain(to.positions.iter().flatten());
    let all = all.chain(to.log_scales.iter().flatten()).chain(to.rotations.iter().flatten());
    let all = all.chain(&to.opacity_logits).chain(to.sh.iter().flatten()).chain(&to_view.twist);
    for value in all.chain(to_splats.iter().flat_map(|g| g.covariance.iter().chain(&g.mean))) {
        assert!(value.is_finite(), "{value:?} in {gaussians:?}");
    }
    let drawn = rendered.splats.iter().flatten().count();
    (rendered.pixels, drawn)
}

/// In both precisions; the images agree where rounding cannot matter more than `tolerance`.
fn both(gaussians: &Gaussians, camera: &Camera, tolerance: f64) -> (Pixels<f64>, usize) {
    let (exact, drawn) = run::<f64>(gaussians, camera);
    let (single, drawn_single) = run::<f32>(gaussians, camera);
    assert_eq!(drawn, drawn_single, "{gaussians:?}");
    for (a, b) in exact.alpha.iter().zip(&single.alpha) {
        assert!((a - f64::from(*b)).abs() <= tolerance, "{a} {b} in {gaussians:?}");
    }
    (exact, drawn)
}

#[test]
fn near_behind_and_at_the_camera() {
    let camera = camera(40.0, 33, 17);
    for z in [-1.0, 0.0, 0.009_999, 0.01] {
        assert_eq!(both(&one([0.0, 0.0, z], [-3.0; 3], UPRIGHT, 2.0), &camera, 0.0).1, 0);
    }
    let (image, drawn) = both(&one([0.0, 0.0, 0.010_001], [-7.0; 3], UPRIGHT, 2.0), &camera, 1e-4);
    assert_eq!(drawn, 1);
    assert!(image.alpha[8 * 33 + 16] > 0.8);
}

#[test]
fn scales_from_tiny_to_huge() {
    let camera = camera(40.0, 33, 17);
    for exponent in -20..=20 {
        let s = 10.0_f32.powi(exponent).ln();
        let gaussians = one([0.1, -0.05, 2.0], [s; 3], [0.3, 0.5, -0.2, 0.7], 2.0);
        let (image, drawn) = both(&gaussians, &camera, 1e-4);
        assert_eq!(drawn, 1, "scale 1e{exponent}");
        assert!(image.alpha.iter().any(|&a| a > 0.1), "scale 1e{exponent}");
    }
    let mixed = one([0.1, -0.05, 2.0], [-46.0, 0.0, 46.0], [0.3, 0.5, -0.2, 0.7], 2.0);
    // 1e20 times as long as wide: f64 draws it; f32 may cull it, since the determinant relative to
    // the length's fourth power is below the least f32.
    assert_eq!(run::<f64>(&mixed, &camera).1, 1);
    run::<f32>(&mixed, &camera);
    // exp(89) is no f32.
    assert_eq!(run::<f32>(&one([0.0, 0.0, 2.0], [89.0; 3], UPRIGHT, 2.0), &camera).1, 0);
}

#[test]
fn needles() {
    let camera = camera(40.0, 33, 17);
    let needle = [(1e3_f32).ln(), (1e-3_f32).ln(), (1e-3_f32).ln()];
    for k in 0..8 {
        let angle = k as f32 * 0.35;
        let rotation = [(angle / 2.0).cos(), 0.0, 0.0, (angle / 2.0).sin()];
        let gaussians = one([0.05, 0.02, 2.0], needle, rotation, 3.0);
        // A needle of 4e4 pixels' length and of the dilation's width: an error of 1e-7 in the
        // conic's direction, times the distance, leaves this much.
        let (image, drawn) = both(&gaussians, &camera, 2e-3);
        assert_eq!(drawn, 1);
        assert!(image.alpha.iter().filter(|&&a| a > 0.3).count() >= 10, "angle {angle}");
    }
}

#[test]
fn opacities_at_both_ends() {
    let camera = camera(40.0, 33, 17);
    let (image, _) = both(&one([0.0, 0.0, 2.0], [-1.0; 3], UPRIGHT, 40.0), &camera, 1e-5);
    let cap = f64::from(RenderSettings::default().alpha_cap);
    let most = image.alpha.iter().fold(0.0_f64, |m, &a| m.max(a));
    assert!((most - cap).abs() < 1e-9);
    assert_eq!(both(&one([0.0, 0.0, 2.0], [-1.0; 3], UPRIGHT, -40.0), &camera, 0.0).1, 0);
    // Opacity exactly at the cut: drawn with a zero extent or culled, never NaN.
    let at_cut = (1.0_f32 / 254.0).ln();
    run::<f32>(&one([0.0, 0.0, 2.0], [-1.0; 3], UPRIGHT, at_cut), &camera);
}

#[test]
fn quaternions() {
    let camera = camera(40.0, 33, 17);
    let scales = [-1.0, -2.0, -3.0];
    let reference = both(&one([0.0, 0.0, 2.0], scales, [0.6, 0.0, 0.0, 0.8], 1.0), &camera, 1e-5);
    for length in [1e-6_f32, 1e-3, 7.0, 1e20, 1e30] {
        let q = [0.6 * length, 0.0, 0.0, 0.8 * length];
        let (image, drawn) = both(&one([0.0, 0.0, 2.0], scales, q, 1.0), &camera, 1e-5);
        assert_eq!(drawn, 1, "length {length}");
        for (a, b) in image.alpha.iter().zip(&reference.0.alpha) {
            assert!((a - b).abs() < 1e-5);
        }
    }
    for q in [[0.0; 4], [1e-11, 0.0, 0.0, 0.0], [f32::NAN, 0.0, 0.0, 1.0], [f32::INFINITY; 4]] {
        assert_eq!(both(&one([0.0, 0.0, 2.0], scales, q, 1.0), &camera, 0.0).1, 0);
    }
}

/// One non-finite parameter culls its Gaussian and leaves the others unchanged.
#[test]
fn non_finite_numbers() {
    let camera = camera(40.0, 33, 17);
    let good = one([0.1, 0.0, 2.0], [-1.0; 3], UPRIGHT, 1.0);
    let expected = both(&good, &camera, 1e-5).0;
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
            let (image, drawn) = both(&join(&[g, good.clone()]), &camera, 1e-5);
            assert_eq!(drawn, 1, "field {field} {bad}");
            assert_eq!(image, expected);
        }
    }
    let far = one([1e38, 0.0, 2.0], [-1.0; 3], UPRIGHT, 1.0);
    assert_eq!(both(&far, &camera, 0.0).1, 0);
}

#[test]
fn thousands_of_layers_and_equal_depths() {
    let camera = camera(40.0, 17, 3);
    let layer = one([0.0, 0.0, 2.0], [0.0; 3], UPRIGHT, -4.0);
    let mut all = join(&vec![layer; 4000]);
    for (i, sh) in all.sh.iter_mut().enumerate() {
        *sh = [i as f32 * 1e-4, 0.0, 0.0];
    }
    let (cloud, view) = (Cloud::<f64>::new(&all), View::new(&camera));
    let bins = render::forward(&cloud, &view, &RenderSettings::default()).bins;
    assert!(bins.splat_from_rank.windows(2).all(|w| w[0] < w[1]), "ties break by index");
    let (image, drawn) = both(&all, &camera, 1e-4);
    assert_eq!(drawn, 4000);
    let stop = f64::from(RenderSettings::default().transmittance_stop);
    assert!(image.alpha[8] < 1.0 - stop && image.alpha[8] > 1.0 - stop * 1.1);
}

#[test]
fn images_of_odd_sizes() {
    let gaussians = one([0.0, 0.0, 2.0], [-1.5; 3], UPRIGHT, 1.0);
    for (width, height) in [(1, 1), (17, 3), (16, 16), (4097, 1)] {
        let (image, drawn) = both(&gaussians, &camera(30.0, width, height), 1e-5);
        assert_eq!(drawn, 1);
        assert_eq!(image.alpha.len(), (width * height) as usize);
    }
    let none = both(&Gaussians::default(), &camera(30.0, 17, 3), 0.0);
    assert!(none.1 == 0 && none.0.alpha.iter().all(|&a| a == 0.0));
}

#[test]
fn extreme_fields_of_view_and_off_centre_principal_points() {
    let gaussians = one([0.3, 0.1, 2.0], [-1.0; 3], [0.3, 0.5, -0.2, 0.7], 1.0);
    for focal in [1e-3, 1.0, 1e3, 1e6] {
        for shift in [-1e3, -10.0, 0.0, 10.0, 1e3] {
            let mut camera = camera(focal, 33, 17);
            camera.intrinsics.cx += shift;
            run::<f32>(&gaussians, &camera);
            run::<f64>(&gaussians, &camera);
        }
    }
}

#[test]
fn far_from_the_origin() {
    let offset = DVec3::new(1e6, -1e6, 1e6);
    let gaussians = one([1e6, -1e6, 1e6 + 16.0], [1.0; 3], UPRIGHT, 1.0);
    let camera = Camera {
        intrinsics: Intrinsics::centred(40.0, 33, 17),
        view_from_world: Pose::new(DQuat::IDENTITY, -offset),
    };
    let (image, drawn) = both(&gaussians, &camera, 1e-4);
    assert_eq!(drawn, 1);
    assert!(image.alpha[8 * 33 + 16] > 0.7);
}

/// Covers every tile; and one so small that only the dilation shows it.
#[test]
fn covering_and_sub_pixel() {
    let camera = camera(40.0, 100, 70);
    let cover = both(&one([0.0, 0.0, 2.0], [3.0; 3], UPRIGHT, 1.0), &camera, 1e-5).0;
    assert!(cover.alpha.iter().all(|&a| a > 0.5));
    let speck = both(&one([0.0125, 0.0125, 2.0], [-12.0; 3], UPRIGHT, 1.0), &camera, 1e-5).0;
    let lit = speck.alpha.iter().filter(|&&a| a > 0.0).count();
    assert!((1..=12).contains(&lit), "{lit}");
}

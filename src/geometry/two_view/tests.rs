use super::*;
use crate::geometry::se3::{angle_between, exp_so3};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

#[derive(Clone, Copy)]
struct Make {
    n: usize,
    outliers: f64,
    sigma: f64,
    plane: bool,
    pose: Pose,
}

fn camera() -> Intrinsics {
    Intrinsics::centred(450.0, 640, 360)
}

fn truth() -> Pose {
    Pose::new(exp_so3(DVec3::new(0.03, -0.08, 0.05)), DVec3::new(0.5, 0.1, -0.2))
}

fn general() -> Make {
    Make { n: 400, outliers: 0.0, sigma: 0.3, plane: false, pose: truth() }
}

fn pairs(make: Make) -> (Vec<DVec2>, Vec<DVec2>) {
    let mut rng = ChaCha8Rng::seed_from_u64(21);
    let k = camera();
    let normal = |rng: &mut ChaCha8Rng| {
        let (u, v): (f64, f64) = (rng.random_range(1e-12..1.0), rng.random());
        (-2.0 * u.ln()).sqrt() * (std::f64::consts::TAU * v).cos()
    };
    (0..make.n)
        .map(|i| {
            let a = DVec2::new(rng.random_range(0.0..640.0), rng.random_range(0.0..360.0));
            let ray = k.ray(a);
            let depth = if make.plane {
                5.0 / (1.0 + 0.5 * ray.x - 0.3 * ray.y)
            } else {
                rng.random_range(2.0..10.0)
            };
            let mut b = k.project(make.pose.apply(ray * depth));
            if (i as f64) < make.outliers * make.n as f64 {
                b = DVec2::new(rng.random_range(0.0..640.0), rng.random_range(0.0..360.0));
            }
            (a, b + DVec2::new(normal(&mut rng), normal(&mut rng)) * make.sigma)
        })
        .unzip()
}

fn run(make: Make) -> Result<TwoView> {
    let (a, b) = pairs(make);
    two_view(&a, &b, None, &camera(), &camera(), &TwoViewOptions::default())
}

fn errors(found: &TwoView, truth: &Pose) -> (f64, f64) {
    (
        angle_between(found.b_from_a.rotation, truth.rotation).to_degrees(),
        found.b_from_a.translation.angle_between(truth.translation).to_degrees(),
    )
}

#[test]
fn a_scene_with_depth_under_outliers() {
    for outliers in [0.0, 0.3, 0.6] {
        let found = run(Make { outliers, ..general() }).unwrap();
        assert_eq!(found.motion, Motion::General);
        let (rotation, translation) = errors(&found, &truth());
        assert!(rotation < 0.2 && translation < 1.5, "{outliers}: {rotation} {translation}");
        assert!((found.b_from_a.translation.length() - 1.0).abs() < 1e-12);
        assert!(found.parallax_px > 5.0 && found.parallax_deg > 1.0 && found.rmse < 0.5);
        let right = found.inliers[240..].iter().filter(|x| **x).count();
        assert!(right > 145, "{right} of 160");
    }
}

#[test]
fn a_plane_is_told_and_its_pose_found() {
    let found = run(Make { plane: true, outliers: 0.2, ..general() }).unwrap();
    assert_eq!(found.motion, Motion::Planar);
    let (rotation, translation) = errors(&found, &truth());
    assert!(rotation < 1.0 && translation < 6.0, "{rotation} {translation}");
}

#[test]
fn a_turn_and_a_tripod_are_told() {
    let turn = Pose::new(truth().rotation, DVec3::ZERO);
    let found = run(Make { pose: turn, outliers: 0.3, ..general() }).unwrap();
    assert_eq!(found.motion, Motion::PureRotation);
    assert!(errors(&found, &turn).0 < 0.05);
    assert_eq!(found.b_from_a.translation, DVec3::ZERO);
    assert!(found.parallax_px < 1.0);
    // Movers on less than half of the pixels do not affect a static camera.
    let found = run(Make { pose: Pose::IDENTITY, outliers: 0.4, sigma: 0.1, ..general() }).unwrap();
    assert_eq!(found.motion, Motion::Static);
    assert_eq!(found.b_from_a, Pose::IDENTITY);
    assert!(found.inliers[160..].iter().all(|x| *x));
}

#[test]
fn forward_motion_works_too() {
    let pose = Pose::new(exp_so3(DVec3::new(0.0, 0.01, 0.0)), DVec3::new(0.0, 0.02, -0.6));
    let found = run(Make { pose, outliers: 0.3, ..general() }).unwrap();
    let (rotation, translation) = errors(&found, &pose);
    assert!(rotation < 0.2 && translation < 2.0, "{rotation} {translation}");
}

#[test]
fn noise_alone_and_too_few_pairs_fail_in_words() {
    let message = run(Make { outliers: 1.0, ..general() }).unwrap_err().to_string();
    assert!(message.contains("may not overlap"), "{message}");
    for n in [0, 3, 7] {
        let message = run(Make { n, ..general() }).unwrap_err().to_string();
        assert!(message.contains("usable pixel pairs"), "{message}");
    }
    let k = camera();
    let nan = vec![DVec2::NAN; 20];
    assert!(two_view(&nan, &nan, None, &k, &k, &Default::default()).is_err());
    assert!(two_view(&nan, &nan[1..], None, &k, &k, &Default::default()).is_err());
    let line: Vec<_> = (0..20).map(|i| DVec2::splat(i as f64 * 9.0)).collect();
    let moved: Vec<_> = line.iter().map(|p| *p * 1.1).collect();
    if let Ok(found) = two_view(&line, &moved, None, &k, &k, &Default::default()) {
        assert!(found.b_from_a.rotation.is_finite() && found.b_from_a.translation.is_finite());
    }
}

#[test]
fn the_fundamental_matrix_is_found_under_outliers() {
    let (a, b) = pairs(Make { outliers: 0.3, ..general() });
    let pairs: Vec<_> = a.into_iter().zip(b).collect();
    let found = fundamental_ransac(&pairs, &RansacOptions::default()).unwrap();
    let e = essential_from_pose(&truth());
    let f = fundamental_from_essential(&e, &camera(), &camera());
    let good: Vec<f64> =
        found.inliers.iter().map(|&i| sampson_squared(&f, pairs[i].0, pairs[i].1)).collect();
    assert!(found.inliers.len() > 250);
    assert!(median(good) < 0.25, "inliers obey the true matrix");
}

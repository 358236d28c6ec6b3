//! What is drawn, and from where.

use crate::stage::{HEIGHT, WIDTH};
use splat4d::scene::Scene;
use splat4d::types::{Camera, Gaussians, Intrinsics, Pose};

/// Splats on the unit ball around the origin, each in the colour of where it is.
pub fn ball(count: usize) -> Scene {
    // Evenly over the height, by the golden angle around it.
    let at = |i: usize| {
        let (y, angle) = (2.0 * (i as f32 + 0.5) / count as f32 - 1.0, 2.399_963 * i as f32);
        let radius = (1.0 - y * y).sqrt();
        [radius * angle.cos(), y, radius * angle.sin()]
    };
    // They overlap a little, however many there are.
    let log_scale = (1.2 / (count as f32).sqrt()).ln();
    Scene::of(Gaussians {
        positions: (0..count).map(at).collect(),
        log_scales: vec![[log_scale; 3]; count],
        rotations: vec![[1.0, 0.0, 0.0, 0.0]; count],
        opacity_logits: vec![1.0; count],
        sh: (0..count).map(at).collect(),
        ..Gaussians::default()
    })
}

/// The camera of a frame: the ball turns, comes and goes, to the right of the triangle and over its
/// edge.
pub fn camera(frame: u32) -> Camera {
    let t = f64::from(frame) / 60.0;
    let half = 0.4 * t;
    let mut view_from_world = Pose::IDENTITY;
    view_from_world.rotation.y = half.sin();
    view_from_world.rotation.w = half.cos();
    view_from_world.translation.x = 0.9 + 0.2 * (1.7 * t).sin();
    view_from_world.translation.z = 3.0 + 0.4 * t.sin();
    let intrinsics = Intrinsics::centred(f64::from(HEIGHT), WIDTH, HEIGHT);
    Camera { intrinsics, view_from_world }
}

//! The scene and the cameras.

use crate::stage::{HEIGHT, WIDTH};
use splat4d::scene::Scene;
use splat4d::types::{Camera, Gaussians, Intrinsics, Pose};

/// Splats on the unit sphere around the origin, each coloured by its position.
pub fn ball(count: usize) -> Scene {
    // Positions are evenly spaced in height and turn by the golden angle from one to the next.
    let at = |i: usize| {
        let (y, angle) = (2.0 * (i as f32 + 0.5) / count as f32 - 1.0, 2.399_963 * i as f32);
        let radius = (1.0 - y * y).sqrt();
        [radius * angle.cos(), y, radius * angle.sin()]
    };
    // The splats overlap a little, for any count.
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

/// The camera of a frame. In the image the ball turns, approaches and recedes; it lies to the right of the
/// triangle and overlaps its corner.
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

//! Test scene: a camera that slides along x in front of a wall, with movers added by the tests, in numbers
//! that can be checked by hand.

use glam::{DQuat, DVec2, DVec3};

use super::Stage;
use super::cameras::Cameras;
use super::observer::{Progress, Work};
use crate::observe::{NeighbourFlow, SuppliedFlow, observe_flow};
use crate::types::{Image, Intrinsics, Pose};

pub(super) const WIDTH: u32 = 64;
pub(super) const HEIGHT: u32 = 40;
pub(super) const FRAMES: usize = 6;
pub(super) const FOCAL: f64 = 80.0;
/// Displacement of the camera from frame to frame.
pub(super) const STEP: f64 = 0.1;
/// Distance of the wall: its pixels move by FOCAL · STEP / WALL = 2 to the left.
pub(super) const WALL: f64 = 4.0;

/// Cameras of a sliding clip; with a step of 0, of a fixed camera.
pub(super) fn cameras(step: f64) -> Cameras {
    let pose = |i: usize| Pose::new(DQuat::IDENTITY, DVec3::new(-step * i as f64, 0.0, 0.0));
    Cameras::known(Intrinsics::centred(FOCAL, WIDTH, HEIGHT), (0..FRAMES).map(pose).collect())
}

/// Flow of all frames: `forward(frame, pixel)` is the displacement of a pixel from a frame to the next. Each
/// backward vector is minus the forward one at the same pixel, which is exact wherever flow is uniform.
pub(super) fn flow(forward: impl Fn(usize, DVec2) -> DVec2) -> NeighbourFlow {
    let field = |frame: usize, sign: f64| {
        let mut out = Image::new(WIDTH, HEIGHT, 2);
        for (i, v) in out.pixels.chunks_exact_mut(2).enumerate() {
            let moved = sign * forward(frame, centre(i));
            v.copy_from_slice(&[moved.x as f32, moved.y as f32]);
        }
        out
    };
    let both = |sign| (0..FRAMES - 1).map(|frame| field(frame, sign)).collect();
    let mut source = SuppliedFlow::new(both(1.0), both(-1.0)).unwrap();
    observe_flow(&frames(), &mut source, &mut |_| Ok(())).unwrap()
}

/// The wall's displacement in the image from frame to frame.
pub(super) fn wall() -> DVec2 {
    DVec2::new(-FOCAL * STEP / WALL, 0.0)
}

/// The centre of a pixel.
pub(super) fn centre(i: usize) -> DVec2 {
    let (x, y) = (i % WIDTH as usize, i / WIDTH as usize);
    DVec2::new(x as f64 + 0.5, y as f64 + 0.5)
}

/// Images without content.
pub(super) fn frames() -> Vec<Image> {
    vec![Image::new(WIDTH, HEIGHT, 3); FRAMES]
}

/// The frames of the sliding camera for a painted wall.
pub(super) fn painted() -> Vec<Image> {
    (0..FRAMES)
        .map(|frame| {
            let mut image = Image::new(WIDTH, HEIGHT, 3);
            for (i, out) in image.pixels.chunks_exact_mut(3).enumerate() {
                let at = centre(i) - wall() * frame as f64;
                let wave = (0.8 * at.x + 0.2 * at.y).sin() * (0.6 * at.y).cos();
                out.fill((0.5 + 0.3 * wave) as f32);
            }
            image
        })
        .collect()
}

/// A one-channel image from a function of the pixel.
pub(super) fn map(value: impl Fn(DVec2) -> f32) -> Image {
    let pixels = (0..(WIDTH * HEIGHT) as usize).map(|i| value(centre(i))).collect();
    Image { width: WIDTH, height: HEIGHT, channels: 1, pixels }
}

/// Whether a pixel lies in the rectangle between two opposite corners.
pub(super) fn within(p: DVec2, low: (f64, f64), high: (f64, f64)) -> bool {
    p.x >= low.0 && p.y >= low.1 && p.x < high.0 && p.y < high.1
}

/// Runs `work` with an observer that saves nothing.
pub(super) fn working<T>(work: impl FnOnce(&mut Work) -> T) -> T {
    let mut nothing = |_: Stage, _: f64| Ok(());
    let mut progress = Progress(&mut nothing);
    work(&mut Work::new(&mut progress))
}

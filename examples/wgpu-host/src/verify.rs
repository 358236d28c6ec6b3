//! Checks every pixel of the host's frame.

use crate::Result;
use crate::stage::{BACKGROUND, CORNERS, Stage, TRIANGLE, WIDTH};
use splat4d::gpu::{Device, Request, Selector};
use splat4d::renderer::Renderer;
use splat4d::scene::Scene;
use splat4d::types::Camera;
use std::fmt;

/// Renders the scene on a separate device that the engine creates, and compares the host's pixels with it.
pub struct Judge {
    reference: Renderer,
}

/// Number of correct pixels of each kind.
#[derive(Default)]
pub struct Tally {
    splats: usize,
    over_triangle: usize,
    triangle: usize,
    background: usize,
}

impl fmt::Display for Tally {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "{} pixels of splats equal in every bit, {} of them over the triangle; {} of the \
             triangle alone, {} of the background",
            self.splats, self.over_triangle, self.triangle, self.background
        )
    }
}

/// Allowed difference of a blended pixel, in 8-bit levels: one for rounding, one for the precision of the
/// driver's blending.
const MOST_LEVELS: f32 = 2.0;

impl Judge {
    /// Creates the reference renderer on wgpu's physical device, which it selects by name.
    pub fn new(adapter: &wgpu::Adapter, scene: &Scene) -> Result<Judge> {
        let selector = Selector::Name(adapter.get_info().name);
        let device = Device::open(&Request { selector, ..Request::default() })?;
        Ok(Judge { reference: Renderer::new(&device, scene)? })
    }

    /// Fails if a pixel of the host's last frame is wrong, or if the frame has too few pixels of a kind
    /// that is to be tested.
    pub fn check(&mut self, stage: &Stage, camera: &Camera) -> Result<Tally> {
        let expected = self.reference.render(camera, 0.0)?.rgba.pixels;
        let splats = stage.read(stage.splats())?;
        let splats: &[[f32; 4]] = bytemuck::try_cast_slice(&splats).expect("texels of floats");
        let frame = stage.read(stage.frame())?;
        let mut tally = Tally::default();
        for (i, (expected, actual)) in expected.chunks_exact(4).zip(splats).enumerate() {
            let (x, y) = (i as u32 % WIDTH, i as u32 / WIDTH);
            if !expected.iter().zip(actual).all(|(a, b)| a.to_bits() == b.to_bits()) {
                return Err(format!(
                    "splats at ({x}, {y}): {actual:?} in wgpu's texture, {expected:?} by the \
                     engine's own device"
                )
                .into());
            }
            let shown = &frame[4 * i..4 * i + 4];
            let cover = cover(x, y);
            let fits = |below: [u8; 4]| {
                (0..4).all(|k| {
                    let splat = actual[k].clamp(0.0, 1.0) * 255.0;
                    let blended = splat + (1.0 - actual[3].clamp(0.0, 1.0)) * f32::from(below[k]);
                    let most = if actual[3] == 0.0 { 0.0 } else { MOST_LEVELS };
                    (f32::from(shown[k]) - blended.min(255.0)).abs() <= most
                })
            };
            let fits = match cover {
                Cover::Inside => fits(TRIANGLE),
                Cover::Outside => fits(BACKGROUND),
                Cover::Edge => fits(TRIANGLE) || fits(BACKGROUND),
            };
            if !fits {
                return Err(format!(
                    "frame at ({x}, {y}): {shown:?} with splats {actual:?} over {cover:?} of the \
                     triangle"
                )
                .into());
            }
            match (actual[3] > 0.0, cover) {
                (true, Cover::Inside) => {
                    tally.over_triangle += 1;
                    tally.splats += 1;
                }
                (true, _) => tally.splats += 1,
                (false, Cover::Inside) => tally.triangle += 1,
                (false, Cover::Outside) => tally.background += 1,
                (false, Cover::Edge) => {}
            }
        }
        let Tally { over_triangle, triangle, background, .. } = tally;
        if [over_triangle, triangle, background].iter().any(|&pixels| pixels < 500) {
            return Err(format!("the image shows too little of what it tests: {tally}").into());
        }
        Ok(tally)
    }
}

#[derive(Clone, Copy, Debug)]
enum Cover {
    Inside,
    Outside,
    /// Too close to an edge to decide.
    Edge,
}

/// Whether the triangle covers a pixel's centre.
fn cover(x: u32, y: u32) -> Cover {
    let (x, y) = (f64::from(x) + 0.5, f64::from(y) + 0.5);
    let corners = CORNERS.map(|corner| corner.map(f64::from));
    // Signed distances from the edges; all have the same sign inside.
    let distances = [0, 1, 2].map(|k| {
        let ([ax, ay], [bx, by]) = (corners[k], corners[(k + 1) % 3]);
        let (dx, dy) = (bx - ax, by - ay);
        (dx * (y - ay) - dy * (x - ax)) / dx.hypot(dy)
    });
    if distances.iter().any(|distance| distance.abs() < 1.0 / 64.0) {
        return Cover::Edge;
    }
    match distances.map(|distance| distance > 0.0) {
        [true, true, true] | [false, false, false] => Cover::Inside,
        _ => Cover::Outside,
    }
}

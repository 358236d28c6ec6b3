//! A compute kernel of the program's own behind the renderer's, in one submission.
//!
//! ```sh
//! cargo run --release --example custom_kernel -- fog.png
//! ```
//!
//! `kernel!` declares the interface of `fog.comp`, compiled to `fog.spv`
//! (`cargo run --release -p tools -- build`). The recorder sees that the kernel reads what the renderer has written,
//! and puts the barrier between them. The result is compared with the same arithmetic on the host.

use splat4d::data::write_png;
use splat4d::gpu::{Device, Groups, Request};
use splat4d::renderer::{Renderer, Target};
use splat4d::scene::Scene;
use splat4d::types::{Camera, Gaussians, Image, Intrinsics, Pose};

splat4d::kernel! {
    /// Exponential fog over a rendered image.
    pub struct Fog("example/fog") from include_bytes!("fog.spv"), workgroup: [64, 1, 1],
    params: FogParams {
        /// Number of pixels.
        count: u32,
        /// Extinction per unit of depth.
        density: f32,
        /// The fog's colour.
        red: f32,
        /// The fog's colour.
        green: f32,
        /// The fog's colour.
        blue: f32,
    },
    args: FogArgs {
        /// Premultiplied colour and alpha, by pixel.
        rgba: Read<[f32; 4]>,
        /// Sum of α · T · z, by pixel.
        depth: Read<f32>,
        /// Colour, opaque.
        fogged: Write<[f32; 4]>,
    }
}

const WIDTH: u32 = 320;
const HEIGHT: u32 = 240;

fn main() -> splat4d::Result<()> {
    let Some(output) = std::env::args().nth(1) else {
        return Err(splat4d::Error::Input("usage: custom_kernel IMAGE.png".into()));
    };
    let device = Device::open(&Request::default())?;
    let mut renderer = Renderer::new(&device, &Scene::of(row_of_balls()))?;
    let camera = Camera {
        intrinsics: Intrinsics {
            fx: 260.0,
            fy: 260.0,
            cx: 160.0,
            cy: 120.0,
            width: WIDTH,
            height: HEIGHT,
        },
        view_from_world: Pose::IDENTITY,
    };
    let count = (WIDTH * HEIGHT) as usize;
    let params = FogParams { count: count as u32, density: 0.15, red: 0.7, green: 0.75, blue: 0.8 };
    let groups = Groups::linear(count, 64, device.limits())?;
    let mut fogged = device.buffer::<[f32; 4]>("fogged", count)?;
    let mut stream = device.stream()?;
    loop {
        let mut recorder = stream.record()?;
        let frame = renderer.record(&mut recorder, &camera, 0.0, Target::default())?;
        let pixels = renderer.pixels().expect("a frame was recorded");
        let (rgba, depth) = (pixels.rgba.view(), pixels.depth.view());
        let args = FogArgs { rgba, depth, fogged: fogged.view_mut() };
        recorder.dispatch::<Fog>(groups, params, args)?;
        let ticket = stream.submit(recorder)?;
        stream.wait(ticket)?;
        // The first frame may have more (splat, tile) pairs than the capacity; the next record has more.
        if renderer.retire(frame)?.is_whole() {
            break;
        }
    }
    let result = stream.download(&fogged)?;

    let pixels = renderer.pixels().expect("a frame was recorded");
    let (rgba, depth) = (stream.download(&pixels.rgba)?, stream.download(&pixels.depth)?);
    let error = (0..count).flat_map(|i| {
        let expected = fog(rgba[i], depth[i], &params);
        (0..4).map(move |c| expected[c]).zip(result[i]).map(|(a, b)| (a - b).abs())
    });
    let error = error.fold(0.0, f32::max);
    println!("largest difference from the host's arithmetic: {error:e}");
    if error > 1e-5 {
        return Err(splat4d::Error::Failed(format!("the kernel is off by {error:e}")));
    }
    let pixels = result.iter().flat_map(|&[r, g, b, _]| [r, g, b]).collect();
    write_png(&output, &Image { width: WIDTH, height: HEIGHT, channels: 3, pixels })
}

/// `fog.comp` on the host.
fn fog([r, g, b, a]: [f32; 4], depth: f32, params: &FogParams) -> [f32; 4] {
    let z = if a > 0.0 { depth / a } else { 0.0 };
    let clear = (-params.density * z).exp();
    let through = |colour: f32, fog: f32| colour * clear + fog * (1.0 - a * clear);
    [through(r, params.red), through(g, params.green), through(b, params.blue), 1.0]
}

/// Eight balls in a row, from near to far.
fn row_of_balls() -> Gaussians {
    let mut gaussians = Gaussians::default();
    for i in 0..8 {
        let far = 2.0 + 1.5 * i as f32;
        gaussians.positions.push([0.35 * far - 1.6, 0.1 * far - 0.4, far]);
        gaussians.log_scales.push([-1.6; 3]);
        gaussians.rotations.push([1.0, 0.0, 0.0, 0.0]);
        gaussians.opacity_logits.push(4.0);
        gaussians.sh.push([1.2, 0.2 * i as f32 - 0.8, -1.0]);
    }
    gaussians
}

//! Fits Gaussians to one image with a loss of the program's own.
//!
//! ```sh
//! cargo run --release --example own_loss -- fitted.png fitted.ply
//! ```
//!
//! The engine renders and differentiates; the loss is computed here, on the host: the mean Huber distance
//! to a target image, which counts outliers linearly. A host that keeps images on the device writes the
//! gradient there instead and uploads nothing.

use splat4d::data::write_png;
use splat4d::gpu::{Device, Request};
use splat4d::scene::ply;
use splat4d::train::own_loss::OwnGradients;
use splat4d::train::{SceneOptimiser, TrainSettings};
use splat4d::types::{Camera, Gaussians, Image, Intrinsics, Pose};

const SIZE: u32 = 128;
const STEPS: u32 = 300;
/// Half-width of the quadratic part of the loss, in units of colour.
const HUBER: f32 = 0.1;

fn main() -> splat4d::Result<()> {
    let mut arguments = std::env::args().skip(1);
    let (Some(image), Some(gaussians)) = (arguments.next(), arguments.next()) else {
        return Err(splat4d::Error::Input("usage: own_loss IMAGE.png GAUSSIANS.ply".into()));
    };
    let target = target();
    let camera = Camera {
        intrinsics: Intrinsics {
            fx: 128.0,
            fy: 128.0,
            cx: 64.0,
            cy: 64.0,
            width: SIZE,
            height: SIZE,
        },
        view_from_world: Pose::IDENTITY,
    };
    let device = Device::open(&Request::default())?;
    let settings = TrainSettings { steps: STEPS, ..Default::default() };
    // The scene's extent, one unit here, scales the learning rate of the positions.
    let mut scene = SceneOptimiser::new(&device, &start(), None, 1.0, settings)?;
    let mut stream = device.stream()?;
    let mut step = 0;
    while step < STEPS {
        let mut recorder = stream.record()?;
        let pass = scene.forward(&mut recorder, &camera, 0.0)?;
        stream.submit(recorder)?;
        let rendered = stream.download(&scene.pixels(&pass)?.rgba)?;

        let (loss, gradient) = huber(&rendered, &target);
        let gradient = device.upload("gradient of the Huber loss", &gradient)?;
        let mut recorder = stream.record()?;
        let by = OwnGradients { rgba: gradient.view(), depth: None };
        let pass = scene.backward(&mut recorder, pass, by)?;
        let pass = scene.update(&mut recorder, pass)?;
        let ticket = stream.submit(recorder)?;
        stream.wait(ticket)?;
        // False: the frame had more (splat, tile) pairs than the capacity. The optimiser has more
        // capacity now, and the step is repeated.
        if scene.conclude(pass)? {
            if step % 50 == 0 {
                println!("step {step}: loss {loss:.5}");
            }
            step += 1;
        }
    }
    let mut recorder = stream.record()?;
    let pass = scene.forward(&mut recorder, &camera, 0.0)?;
    let ticket = stream.submit(recorder)?;
    stream.wait(ticket)?;
    let rendered = stream.download(&scene.pixels(&pass)?.rgba)?;
    scene.conclude(pass)?;
    println!("after {STEPS} steps: loss {:.5}", huber(&rendered, &target).0);
    let pixels = rendered.iter().flat_map(|&[r, g, b, _]| [r, g, b]).collect();
    write_png(&image, &Image { width: SIZE, height: SIZE, channels: 3, pixels })?;
    ply::write(&gaussians, &scene.gaussians()?)
}

/// The loss, and its gradient with respect to the premultiplied colour and alpha of each pixel. Alpha has
/// none: the background is black.
fn huber(rendered: &[[f32; 4]], target: &[[f32; 3]]) -> (f32, Vec<[f32; 4]>) {
    let weight = 1.0 / (3 * target.len()) as f32;
    let mut loss = 0.0;
    let gradient = rendered.iter().zip(target).map(|(rendered, target)| {
        let mut by_rgba = [0.0; 4];
        for c in 0..3 {
            let difference = rendered[c] - target[c];
            let inside = difference.clamp(-HUBER, HUBER);
            loss += weight * inside * (difference - 0.5 * inside);
            by_rgba[c] = weight * inside;
        }
        by_rgba
    });
    let gradient = gradient.collect();
    (loss, gradient)
}

/// Concentric rings, in colours that change with the angle.
fn target() -> Vec<[f32; 3]> {
    let pixel = |i: u32| {
        let [x, y] = [i % SIZE, i / SIZE].map(|v| (v as f32 + 0.5) / 64.0 - 1.0);
        let ring = 0.5 + 0.5 * (12.0 * x.hypot(y)).cos();
        let angle = y.atan2(x);
        [0.0, 2.1, 4.2].map(|phase| ring * (0.5 + 0.5 * (angle + phase).sin()))
    };
    (0..SIZE * SIZE).map(pixel).collect()
}

/// A grid of 32 × 32 grey Gaussians, one unit in front of the camera, that fills its view.
fn start() -> Gaussians {
    let count = 32 * 32;
    let position = |i: usize| [i % 32, i / 32].map(|v| (v as f32 + 0.5) / 32.0 - 0.5);
    Gaussians {
        positions: (0..count).map(|i| [position(i)[0], position(i)[1], 1.0]).collect(),
        log_scales: vec![[-4.2; 3]; count],
        rotations: vec![[1.0, 0.0, 0.0, 0.0]; count],
        opacity_logits: vec![0.0; count],
        sh_degree: 0,
        sh: vec![[0.0; 3]; count],
        motion_logits: Vec::new(),
    }
}

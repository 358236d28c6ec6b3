//! The renderer against a published engine's image and against the oracle.

mod common;

use glam::{DQuat, DVec3};
use safetensors::SafeTensors;
use splat4d::gpu::{Device, Stream};
use splat4d::ops::gaussians::GaussianBuffers;
use splat4d::ops::render::Render;
use splat4d::types::{Camera, Gaussians, Intrinsics, Pose, RenderSettings};
use std::path::PathBuf;

fn shared(path: &str) -> Option<PathBuf> {
    let base = std::env::var_os("SPLAT4D_DATA")
        .map(PathBuf::from)
        .unwrap_or_else(|| PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../shared/data"));
    let path = base.join(path);
    if !path.exists() {
        println!("SKIPPED (no ../shared/data): {}", path.display());
        return None;
    }
    Some(path)
}

fn render(device: &Device, gaussians: &Gaussians, camera: &Camera) -> (Vec<[f32; 4]>, Vec<f32>) {
    let mut stream: Stream = device.stream().unwrap();
    let buffers = GaussianBuffers::from_host(&mut stream, gaussians).unwrap();
    let k = camera.intrinsics;
    let render = Render::plan(
        device,
        gaussians.len(),
        1 << 16,
        k.width,
        k.height,
        RenderSettings::default(),
    )
    .unwrap();
    let mut scratch = render.scratch(device).unwrap();
    let mut pixels = render.pixels(device).unwrap();
    let mut recorder = stream.record().unwrap();
    render.forward(&mut recorder, camera, buffers.views(), &mut scratch, &mut pixels).unwrap();
    stream.submit(recorder).unwrap();
    let counts = scratch.counts(&mut stream).unwrap();
    assert!(counts.intersections <= 1 << 16);
    (stream.download(&pixels.rgba).unwrap(), stream.download(&pixels.depth).unwrap())
}

#[test]
fn tiny_case_matches_gsplat() {
    let Some(path) = shared("brush_ref/tiny_case.safetensors") else { return };
    let bytes = std::fs::read(path).unwrap();
    let tensors = SafeTensors::deserialize(&bytes).unwrap();
    let floats = |name: &str| -> Vec<f32> {
        let tensor = tensors.tensor(name).unwrap();
        bytemuck::pod_collect_to_vec(tensor.data())
    };
    println!("{:?}", tensors.names());
    let rows3 = |flat: Vec<f32>| -> Vec<[f32; 3]> { bytemuck::cast_slice(&flat).to_vec() };
    let gaussians = Gaussians {
        positions: rows3(floats("means")),
        log_scales: rows3(floats("scales")),
        rotations: bytemuck::cast_slice(&floats("quats")).to_vec(),
        opacity_logits: floats("opacities"),
        sh_degree: 3,
        sh: rows3(floats("coeffs")),
        motion_logits: Vec::new(),
    };
    let image = tensors.tensor("out_img").unwrap();
    let (height, width) = (image.shape()[0] as u32, image.shape()[1] as u32);
    let camera = Camera {
        intrinsics: Intrinsics { fx: 61.5, fy: 61.5, cx: 61.5, cy: 41.0, width, height },
        view_from_world: Pose::new(DQuat::IDENTITY, -DVec3::new(0.123, 0.456, -8.0)),
    };
    let device = common::device();
    let (rgba, _) = render(&device, &gaussians, &camera);
    let mut worst: f32 = 0.0;
    for (ours, theirs) in rgba.as_flattened().iter().zip(floats("out_img")) {
        let difference = (ours - theirs).abs();
        worst = worst.max(difference);
        assert!(difference <= 1e-5 + 0.01 * theirs.abs(), "{ours} for {theirs}");
    }
    println!("largest difference {worst:e}");
    common::assert_valid(&device);
}

#[test]
fn cases() {
    common::run("render");
}

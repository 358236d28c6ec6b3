//! The renderer against a published engine's image and against the oracle.

mod common;

use glam::{DQuat, DVec3};
use safetensors::SafeTensors;
use splat4d::gpu::{Device, Stream};
use splat4d::ops::gaussians::GaussianBuffers;
use splat4d::ops::render::Render;
use splat4d::types::{Camera, Gaussians, Intrinsics, Pose, RenderSettings};

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
    let mut frame = render.frame(device).unwrap();
    let mut recorder = stream.record().unwrap();
    frame.forward(&mut recorder, camera, buffers.views(), Default::default()).unwrap();
    stream.submit(recorder).unwrap();
    let counts = frame.counts(&mut stream).unwrap();
    assert!(counts.intersections <= 1 << 16);
    (stream.download(&frame.pixels.rgba).unwrap(), stream.download(&frame.pixels.depth).unwrap())
}

#[test]
fn tiny_case_matches_gsplat() {
    let Some(path) = common::shared_data("brush_ref/tiny_case.safetensors") else { return };
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
fn images_that_cannot_be_are_refused() {
    let device = common::device();
    let settings = RenderSettings::default();
    for (width, height) in [(0, 10), (10, 0), (16 * 0xffff + 1, 1), (1, u32::MAX)] {
        let error = Render::plan(&device, 1, 1, width, height, settings).err().unwrap();
        assert_eq!(error.to_string(), format!("cannot render an image of {width}×{height} pixels"));
    }
}

#[test]
fn what_does_not_fit_is_named() {
    let device = common::device();
    let mut stream = device.stream().unwrap();
    let settings = RenderSettings::default();
    let plan = |n, m, width| Render::plan(&device, n, m, width, 20, settings).unwrap();
    let one = Gaussians {
        positions: vec![[0.0, 0.0, 2.0]],
        log_scales: vec![[-1.0; 3]],
        rotations: vec![[1.0, 0.0, 0.0, 0.0]],
        opacity_logits: vec![1.0],
        sh_degree: 0,
        sh: vec![[0.0; 3]],
        motion_logits: Vec::new(),
    };
    let gaussians = GaussianBuffers::from_host(&mut stream, &one).unwrap();
    let mut error = |render: &Render, pixels: &Render, width| {
        let camera = Camera {
            intrinsics: Intrinsics::centred(20.0, width, 20),
            view_from_world: Pose::IDENTITY,
        };
        let mut frame = render.frame(&device).unwrap();
        let mut pixels = pixels.pixels(&device).unwrap();
        let recorder = &mut stream.record().unwrap();
        frame
            .forward(recorder, &camera, gaussians.views(), pixels.views_mut())
            .map_err(|error| error.to_string())
    };
    let good = plan(1, 64, 30);
    assert_eq!(error(&good, &good, 30), Ok(()));
    assert_eq!(
        error(&good, &good, 31).unwrap_err(),
        "the renderer was planned for 30×20 pixels, the camera has 31×20"
    );
    assert_eq!(
        error(&plan(0, 64, 30), &good, 30).unwrap_err(),
        "render: gaussians has 1 elements, expected at most 0"
    );
    assert_eq!(
        error(&good, &plan(1, 64, 29), 30).unwrap_err(),
        "render: rgba has 580 elements, expected at least 600"
    );
}

common::cases! { "render":
    scene, central_differences, near_behind_and_at_the_camera, needles, covering_and_sub_pixel,
    scales, opacities, opacity_slopes, quaternions, non_finite, non_finite_cameras,
    layers_of_equal_depth, fields_of_view, far_from_the_origin, no_splats, many_tiles,
}

/// A frame rendered stage by stage has the same bits as a whole render; lists are in depth order; and
/// splats that the host supplies are blended like the engine's.
#[test]
fn stages_on_their_own_are_a_frame() {
    let device = common::device();
    let stream = &mut device.stream().unwrap();
    let n = 300usize;
    let at = |i: usize, k: usize| ((i * 7919 + k * 104_729) % 1000) as f32 / 500.0 - 1.0;
    let scene = Gaussians {
        positions: (0..n).map(|i| [at(i, 1), at(i, 2), 3.0 + at(i, 3)]).collect(),
        log_scales: vec![[-2.5; 3]; n],
        rotations: vec![[1.0, 0.0, 0.0, 0.0]; n],
        opacity_logits: (0..n).map(|i| at(i, 4)).collect(),
        sh: (0..n).map(|i| [at(i, 5), at(i, 6), at(i, 7)]).collect(),
        ..Gaussians::default()
    };
    let (width, height) = (70, 50);
    let intrinsics = Intrinsics { fx: 70.0, fy: 70.0, cx: 35.0, cy: 25.0, width, height };
    let camera = Camera { intrinsics, view_from_world: Pose::IDENTITY };
    let whole = render(&device, &scene, &camera);
    assert!(whole.0.iter().any(|pixel| pixel[3] > 0.5), "the picture is not empty");

    let gaussians = GaussianBuffers::from_host(stream, &scene).unwrap();
    let op = Render::plan(&device, n, 1 << 14, width, height, Default::default()).unwrap();
    let mut frame = op.frame(&device).unwrap();
    let mut recorder = stream.record().unwrap();
    frame.project(&mut recorder, &camera, gaussians.views()).unwrap();
    stream.submit(recorder).unwrap();
    // Another frame without a projection: the host supplies the splats.
    let mut other = op.frame(&device).unwrap();
    let mut recorder = stream.record().unwrap();
    let (from, to) = (frame.splats(), other.splats_mut());
    recorder.copy(from.means, to.means);
    recorder.copy(from.conics, to.conics);
    recorder.copy(from.colours, to.colours);
    recorder.copy(from.rectangles, to.rectangles);
    recorder.copy(from.tile_counts, to.tile_counts);
    recorder.copy(from.visible, to.visible);
    stream.submit(recorder).unwrap();
    for frame in [&mut frame, &mut other] {
        let mut recorder = stream.record().unwrap();
        frame.bin(&mut recorder, n).unwrap();
        frame.blend(&mut recorder, None, Default::default()).unwrap();
        stream.submit(recorder).unwrap();
        assert_eq!(stream.download(&frame.pixels.rgba).unwrap(), whole.0);
        assert_eq!(stream.download(&frame.pixels.depth).unwrap(), whole.1);
    }

    let mut read = |from: splat4d::gpu::View<'_, u32>| {
        let mut to = device.buffer::<u32>("words", from.len()).unwrap();
        let mut recorder = stream.record().unwrap();
        recorder.copy(from, to.view_mut());
        stream.submit(recorder).unwrap();
        stream.download(&to).unwrap()
    };
    let lists = frame.tile_lists();
    let splat_from_emitted = read(lists.splat_from_emitted);
    let emitted_from_sorted = read(lists.emitted_from_sorted);
    let counts = read(frame.splats().tile_counts);
    let mut ranges = device.buffer("ranges", lists.ranges.len()).unwrap();
    let mut means = device.buffer("means", n).unwrap();
    let mut recorder = stream.record().unwrap();
    recorder.copy(lists.ranges, ranges.view_mut());
    recorder.copy(frame.splats().means, means.view_mut());
    stream.submit(recorder).unwrap();
    let (ranges, means) = (stream.download(&ranges).unwrap(), stream.download(&means).unwrap());
    assert_eq!(ranges.len(), 5 * 4);
    let mut seen = vec![0u32; n];
    for [from, to] in ranges {
        let on_tile = &emitted_from_sorted[from as usize..to as usize];
        let on_tile: Vec<usize> =
            on_tile.iter().map(|&at| splat_from_emitted[at as usize] as usize).collect();
        assert!(on_tile.is_sorted_by(|&a, &b| means[a][2] <= means[b][2]), "front to back");
        on_tile.iter().for_each(|&splat| seen[splat] += 1);
    }
    assert_eq!(seen, counts);
    let error = frame.bin(&mut stream.record().unwrap(), n + 1).unwrap_err().to_string();
    assert!(error.contains("expected at most 300"), "{error}");
    common::assert_valid(&device);
}

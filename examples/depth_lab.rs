use splat4d::data::synth::{self, SynthOptions};
use splat4d::eval::{mask_iou, psnr};
use splat4d::geometry::sim3::align_cameras;
use splat4d::gpu::Device;
use splat4d::observe::EngineFlow;
use splat4d::renderer::Renderer;
use splat4d::scene::Scene;
use splat4d::track::{Options, track};
use splat4d::train::{Phase, Sequence, SequenceSettings, fit_sequence};
use splat4d::types::{Camera, FlowSettings, Image, SH_C0};
use std::time::Instant;

fn stacked(masks: &[Image]) -> Image {
    let mut all = masks[0].clone();
    all.height *= masks.len() as u32;
    all.pixels = masks.iter().flat_map(|m| m.pixels.iter().map(|m| m.round())).collect();
    all
}

fn motion_only(scene: &Scene) -> Scene {
    let mut scene = scene.clone();
    let g = &mut scene.gaussians;
    g.sh_degree = 0;
    g.sh = (0..g.positions.len())
        .map(|i| {
            [(if g.motion_logits.get(i).is_some_and(|&m| m > 0.0) { 0.5 } else { -0.5 }) / SH_C0; 3]
        })
        .collect();
    scene
}

fn main() {
    let args: Vec<String> = std::env::args().collect();
    let get = |k: &str, d: &str| -> String {
        args.iter()
            .find_map(|a| a.strip_prefix(&format!("{k}=")).map(str::to_owned))
            .unwrap_or(d.into())
    };
    let num = |k: &str, d: &str| get(k, d).parse::<f64>().unwrap();
    let options = SynthOptions {
        frames: num("frames", "12") as usize,
        width: num("width", "240") as u32,
        height: num("height", "136") as u32,
        seed: num("seed", "1") as u64,
    };
    let name = get("clip", "rigid");
    let clip = synth::clip(&name, &options).unwrap();
    let device = Device::open(&splat4d::gpu::Request::software()).unwrap();
    let mut given = Options::default();
    let bad = get("bad", "");
    if !bad.is_empty() {
        // Truth with wrong area in every third frame: a false box, and half the mover missing.
        let mut masks = clip.masks.clone();
        for (i, m) in masks.iter_mut().enumerate() {
            let (w, h) = (m.width, m.height);
            for y in 0..h {
                for x in 0..w {
                    let at = (y * w + x) as usize;
                    if i % 3 == 0 && x > w * 5 / 8 && x < w * 7 / 8 && y > h / 8 && y < h / 2 {
                        m.pixels[at] = 1.0;
                    }
                    if i % 3 == 1 && bad == "both" && y > h / 2 {
                        m.pixels[at] = 0.0;
                    }
                }
            }
        }
        given.masks = Some(masks);
        given.poses = Some(clip.view_from_world.clone());
        given.intrinsics = Some(clip.intrinsics);
    }
    let t = Instant::now();
    let mut source = EngineFlow::new(&device, &clip.frames, &FlowSettings::default()).unwrap();
    let found = track(&clip.frames, &given, &mut source, &mut |_, _| Ok(())).unwrap();
    println!(
        "{name}: tracked in {:.0} s, dynamic {:.3}, mask IoU {:.3}",
        t.elapsed().as_secs_f64(),
        found.quality.dynamic_share,
        mask_iou(&stacked(&found.masks), &stacked(&clip.masks)).unwrap()
    );
    for variant in get("variants", "off,on").split(',') {
        let mut s = SequenceSettings {
            static_steps: num("static", "150") as u32,
            control_steps: num("control", "80") as u32,
            steps: num("steps", "400") as u32,
            max_gaussians: num("gaussians", "12000") as usize,
            control_points: num("points", "64") as usize,
            ..SequenceSettings::default()
        };
        s.train_selection = variant.contains("on");
        let sequence = Sequence { frames: &clip.frames, times: &clip.times, track: &found };
        let t = Instant::now();
        let mut joint = None;
        let scene = fit_sequence(&device, sequence, &s, &mut |p, _, _| {
            if p == Phase::Joint && joint.is_none() {
                joint = Some(Instant::now());
            }
            Ok(())
        })
        .unwrap();
        let joint = joint.map_or(0.0, |j| j.elapsed().as_secs_f64());
        let mut r = Renderer::new(&device, &scene).unwrap();
        let input: f64 = clip
            .frames
            .iter()
            .zip(&scene.cameras)
            .map(|(f, at)| psnr(&r.render(&at.camera, at.time).unwrap().over([0.0; 3]), f).unwrap())
            .sum::<f64>()
            / clip.frames.len() as f64;
        let ours: Vec<_> =
            scene.cameras.iter().map(|c| c.camera.view_from_world.inverse()).collect();
        let theirs: Vec<_> = clip.view_from_world.iter().map(|p| p.inverse()).collect();
        let sim = align_cameras(&ours, &theirs, true).unwrap().reference_from_estimate.inverse();
        let ratio = scene.cameras[0].camera.intrinsics.fx / clip.intrinsics.fx;
        let (mut held, mut n) = (0.0, 0);
        for h in &clip.held_out {
            for ((c, f), &time) in h.cameras.iter().zip(&h.frames).zip(&clip.times) {
                let pose = sim.apply_pose(&c.view_from_world.inverse()).inverse();
                let mut k = c.intrinsics;
                k.fx *= ratio;
                k.fy *= ratio;
                let pic = r
                    .render(&Camera { intrinsics: k, view_from_world: pose }, time)
                    .unwrap()
                    .over([0.0; 3]);
                held += psnr(&pic, f).unwrap();
                n += 1;
            }
        }
        let masks: Vec<Image> = if scene.gaussians.is_dynamic() {
            let mut m = Renderer::new(&device, &motion_only(&scene)).unwrap();
            scene
                .cameras
                .iter()
                .map(|at| {
                    let rgba = m.render(&at.camera, at.time).unwrap().rgba;
                    Image {
                        pixels: rgba.pixels.iter().step_by(4).copied().collect(),
                        channels: 1,
                        ..rgba
                    }
                })
                .collect()
        } else {
            clip.masks.clone()
        };
        let iou = mask_iou(&stacked(&masks), &stacked(&clip.masks)).unwrap();
        let dynamic = scene.gaussians.motion_logits.iter().filter(|m| **m > 0.0).count();
        println!(
            "{name} {variant}: input {input:.2} held-out {:.2} dB, mask IoU {iou:.3}, {} Gaussians {dynamic} dynamic, {} nodes {}, {:.0} s (joint {joint:.0} s)",
            held / n as f64,
            scene.gaussians.positions.len(),
            scene.control_points.len(),
            scene.report,
            t.elapsed().as_secs_f64()
        );
    }
}

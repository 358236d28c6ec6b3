//! The main job on small synthetic clips: frames in, a scene out, held against the exact truth.

mod common;

use splat4d::data::synth::{self, SynthOptions};
use splat4d::eval::{Align, compare_trajectories, mask_iou, psnr};
use splat4d::gpu::Device;
use splat4d::observe::EngineFlow;
use splat4d::renderer::Renderer;
use splat4d::scene::Scene;
use splat4d::track::{Options, Track, track};
use splat4d::train::{Phase, Sequence, SequenceSettings, fit_sequence};
use splat4d::types::{FlowSettings, Image};

struct Outcome {
    clip: synth::Clip,
    track: Track,
    scene: Scene,
    device: Device,
}

/// Half the size and half the frames of the default clip, and few steps: minutes on two cores.
fn reconstruct(name: &str) -> Outcome {
    let options = SynthOptions { frames: 12, width: 240, height: 136, seed: 1 };
    let clip = synth::clip(name, &options).unwrap();
    let device = common::device();
    let mut source = EngineFlow::new(&device, &clip.frames, &FlowSettings::default()).unwrap();
    let found = track(&clip.frames, &Options::default(), &mut source, &mut |_, _| Ok(())).unwrap();
    let settings = SequenceSettings {
        static_steps: 150,
        control_steps: 80,
        steps: 300,
        max_gaussians: 12_000,
        control_points: 64,
        ..SequenceSettings::default()
    };
    let sequence = Sequence { frames: &clip.frames, times: &clip.times, track: &found };
    let scene =
        fit_sequence(&device, sequence, &settings, None, &mut |_: Phase, _, _| Ok(())).unwrap();
    Outcome { clip, track: found, scene, device }
}

fn psnr_on_input(outcome: &Outcome) -> f64 {
    let mut renderer = Renderer::new(&outcome.device, &outcome.scene).unwrap();
    let frames = outcome.clip.frames.iter().zip(&outcome.scene.cameras);
    let sum: f64 = frames
        .map(|(frame, at)| {
            let picture = renderer.render(&at.camera, at.time).unwrap().over([0.0; 3]);
            psnr(&picture, frame).unwrap()
        })
        .sum();
    sum / outcome.clip.frames.len() as f64
}

fn stacked(masks: &[Image]) -> Image {
    let mut all = masks[0].clone();
    all.height *= masks.len() as u32;
    all.pixels = masks.iter().flat_map(|mask| mask.pixels.iter().map(|m| m.round())).collect();
    all
}

#[test]
fn rigid_is_reconstructed_from_its_frames_alone() {
    let outcome = reconstruct("rigid");
    let world_from_view =
        |poses: &[splat4d::types::Pose]| poses.iter().map(|p| p.inverse()).collect::<Vec<_>>();
    let errors = compare_trajectories(
        &world_from_view(&outcome.track.view_from_world),
        &world_from_view(&outcome.clip.view_from_world),
        Align::Sim3,
    )
    .unwrap();
    let ate = errors.ate_relative;
    let iou = mask_iou(&stacked(&outcome.track.masks), &stacked(&outcome.clip.masks)).unwrap();
    let psnr = psnr_on_input(&outcome);
    println!("ATE {:.2} % of the path, mask IoU {iou:.2}, {psnr:.2} dB", 100.0 * ate);
    assert!(ate <= 0.05, "ATE {ate} of the path");
    assert!(iou >= 0.6, "mask IoU {iou}");
    assert!(psnr >= 21.0, "{psnr} dB on the input");
    assert!(outcome.scene.gaussians.is_dynamic() && !outcome.scene.control_points.is_empty());
    assert!(outcome.scene.network.is_some());
    common::assert_valid(&outcome.device);
}

#[test]
fn still_gets_no_control_points() {
    let outcome = reconstruct("still");
    let psnr = psnr_on_input(&outcome);
    println!("{psnr:.2} dB, {:?}", outcome.track.quality);
    assert!(outcome.scene.control_points.is_empty() && outcome.scene.network.is_none());
    assert!(!outcome.scene.gaussians.is_dynamic());
    assert!(psnr >= 21.0, "{psnr} dB on the input");
    common::assert_valid(&outcome.device);
}

#[test]
fn tripod_is_recognised() {
    let options = SynthOptions { frames: 8, width: 240, height: 136, seed: 2 };
    let clip = synth::clip("tripod", &options).unwrap();
    let device = common::device();
    let mut source = EngineFlow::new(&device, &clip.frames, &FlowSettings::default()).unwrap();
    let found = track(&clip.frames, &Options::default(), &mut source, &mut |_, _| Ok(())).unwrap();
    assert!(found.quality.tripod, "{:?}", found.quality);
    assert!(found.view_from_world.iter().all(|pose| *pose == found.view_from_world[0]));
    let iou = mask_iou(&stacked(&found.masks), &stacked(&clip.masks)).unwrap();
    println!("mask IoU {iou:.2}");
    assert!(iou >= 0.6, "mask IoU {iou}");
    common::assert_valid(&device);
}

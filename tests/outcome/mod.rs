//! Reconstruction of a clip with ground truth, and the metrics of the result.
#![allow(dead_code, reason = "each test binary uses its own part")]

use splat4d::data::synth;
use splat4d::eval::{Align, compare_trajectories, mask_iou, masked_psnr, psnr};
use splat4d::geometry::sim3::align_cameras;
use splat4d::gpu::Device;
use splat4d::observe::EngineFlow;
use splat4d::renderer::Renderer;
use splat4d::scene::Scene;
use splat4d::track::{Options, Track, track};
use splat4d::train::{Phase, Sequence, SequenceSettings, fit_sequence};
use splat4d::types::{Camera, FlowSettings, Image, Pose};

/// The result of reconstructing a clip.
pub struct Outcome {
    pub clip: synth::Clip,
    pub track: Track,
    pub scene: Scene,
    pub device: Device,
}

/// Mean PSNR over the held-out views, dB.
pub struct HeldOut {
    pub whole: f64,
    /// Inside movers; NaN if nothing moves.
    pub movers: f64,
    /// PSNR of the input frame of the same time, which a reconstruction without depth would show.
    pub copied: f64,
}

/// Tracks a clip with the optical flow that the engine computes.
pub fn tracked(device: &Device, frames: &[Image], options: &Options) -> splat4d::Result<Track> {
    let mut source = EngineFlow::new(device, frames, &FlowSettings::default())?;
    track(frames, options, &mut source, &mut |_, _| Ok(()))
}

/// Reconstructs a clip with few steps.
pub fn reconstruct(
    device: Device,
    clip: synth::Clip,
    options: &Options,
    settings: &SequenceSettings,
) -> Outcome {
    let track = tracked(&device, &clip.frames, options).unwrap();
    let sequence = Sequence { frames: &clip.frames, times: &clip.times, track: &track };
    let scene =
        fit_sequence(&device, sequence, settings, None, &mut |_: Phase, _, _| Ok(())).unwrap();
    Outcome { clip, track, scene, device }
}

impl Outcome {
    /// Mean PSNR on the input frames, dB.
    pub fn psnr_on_input(&self) -> f64 {
        let mut renderer = Renderer::new(&self.device, &self.scene).unwrap();
        let frames = self.clip.frames.iter().zip(&self.scene.cameras);
        let sum: f64 = frames
            .map(|(frame, at)| {
                let picture = renderer.render(&at.camera, at.time).unwrap().over([0.0; 3]);
                psnr(&picture, frame).unwrap()
            })
            .sum();
        sum / self.clip.frames.len() as f64
    }

    /// Metrics of renders from the clip's held-out cameras, transformed into the scene's world frame.
    pub fn held_out(&self) -> HeldOut {
        let Outcome { clip, scene, device, .. } = self;
        let ours: Vec<Pose> =
            scene.cameras.iter().map(|at| at.camera.view_from_world.inverse()).collect();
        let theirs = world_from_view(&clip.view_from_world);
        let truth_from_scene = align_cameras(&ours, &theirs, true).unwrap().reference_from_estimate;
        let scene_from_truth = truth_from_scene.inverse();
        let mut renderer = Renderer::new(device, scene).unwrap();
        let (mut whole, mut copied, mut movers) = (vec![], vec![], vec![]);
        for held_out in &clip.held_out {
            for (k, &frame) in held_out.times.iter().enumerate() {
                let camera = &held_out.cameras[k];
                let pose = scene_from_truth.apply_pose(&camera.view_from_world.inverse());
                let camera = Camera { view_from_world: pose.inverse(), ..*camera };
                let time = scene.cameras[frame].time;
                let picture = renderer.render(&camera, time).unwrap().over(scene.background);
                let (truth, mask) = (&held_out.frames[k], &held_out.masks[k]);
                whole.push(psnr(&picture, truth).unwrap());
                copied.push(psnr(&clip.frames[frame], truth).unwrap());
                if mask.pixels.iter().filter(|moves| **moves > 0.5).count() * 200
                    > mask.pixels.len()
                {
                    movers.push(masked_psnr(&picture, truth, mask).unwrap());
                }
            }
        }
        let mean = |values: &[f64]| values.iter().sum::<f64>() / values.len() as f64;
        HeldOut { whole: mean(&whole), movers: mean(&movers), copied: mean(&copied) }
    }

    /// Absolute trajectory error (ATE) of the cameras, relative to the path's length.
    pub fn ate(&self) -> f64 {
        ate(&self.track, &self.clip)
    }

    /// Intersection over union of the estimated and the true masks, over all frames together.
    pub fn mask_iou(&self) -> f64 {
        mask_iou(&stacked(&self.track.masks), &stacked(&self.clip.masks)).unwrap()
    }
}

/// Absolute trajectory error (ATE) of the cameras, relative to the path's length.
pub fn ate(track: &Track, clip: &synth::Clip) -> f64 {
    let ours = world_from_view(&track.view_from_world);
    let theirs = world_from_view(&clip.view_from_world);
    compare_trajectories(&ours, &theirs, Align::Sim3).unwrap().ate_relative
}

pub fn world_from_view(poses: &[Pose]) -> Vec<Pose> {
    poses.iter().map(Pose::inverse).collect()
}

pub fn stacked(masks: &[Image]) -> Image {
    let mut all = masks[0].clone();
    all.height *= masks.len() as u32;
    all.pixels = masks.iter().flat_map(|mask| mask.pixels.iter().map(|m| m.round())).collect();
    all
}

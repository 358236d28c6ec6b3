//! Training on the device.

mod common;

use splat4d::data::{Dataset, Resize};
use splat4d::eval;
use splat4d::gpu::Device;
use splat4d::renderer::Renderer;
use splat4d::scene::Scene;
use splat4d::train::{GrowthSettings, TrainSettings, Trainer, TrainingView, seed_from_points};
use splat4d::types::Gaussians;
use std::time::Instant;

fn fox() -> Option<Dataset> {
    let path = common::shared_data("fox270")?;
    Some(Dataset::open(path).unwrap())
}

fn views(dataset: &Dataset, indices: &[usize], size: Resize) -> Vec<TrainingView> {
    let views = dataset.load(indices, size).unwrap();
    views
        .into_iter()
        .map(|view| TrainingView {
            camera: view.camera,
            time: view.time,
            image: view.image,
            weights: view.valid,
            disparity: None,
        })
        .collect()
}

fn mean_psnr(device: &Device, gaussians: Gaussians, views: &[TrainingView]) -> f64 {
    let mut renderer = Renderer::new(device, &Scene::of(gaussians)).unwrap();
    let psnr = |view: &TrainingView| {
        let image = renderer.render(&view.camera, view.time).unwrap().over([0.0; 3]);
        eval::psnr(&image, &view.image).unwrap()
    };
    views.iter().map(psnr).sum::<f64>() / views.len() as f64
}

#[test]
fn a_hundred_steps_twice_give_the_same_bits_and_a_better_image() {
    let Some(dataset) = fox() else { return };
    let device = common::device();
    let mut points = dataset.points.clone();
    points.retain(|p| p.position.iter().all(|x| x.is_finite()));
    let seeds = seed_from_points(&points[..2000], 1);
    let views = views(&dataset, &[1, 9, 17], Resize::Longest(120));
    let before = mean_psnr(&device, seeds.clone(), &views);
    let run = || {
        let settings = TrainSettings {
            steps: 100,
            sh_interval: 50,
            sh_degree: 1,
            max_gaussians: 2500,
            growth: Some(GrowthSettings { from: 20, every: 20, ..Default::default() }),
            ..Default::default()
        };
        let mut trainer = Trainer::new(&device, &views, &seeds, None, settings).unwrap();
        for _ in 0..100 {
            trainer.step().unwrap();
        }
        trainer.gaussians().unwrap()
    };
    let (first, second) = (run(), run());
    assert_eq!(first, second);
    let after = mean_psnr(&device, first, &views);
    println!("PSNR {before:.2} dB before, {after:.2} dB after");
    assert!(after > before + 3.0, "{before} dB before, {after} dB after");
    common::assert_valid(&device);
}

/// The figure that other engines are compared by; run it alone, in release:
/// `cargo test --release --test training -- --ignored --nocapture fox270`
#[test]
#[ignore = "minutes long: a measurement"]
fn fox270_reaches_its_figure() {
    let Some(dataset) = fox() else { return };
    let device = common::device();
    let (train, test) = dataset.split(8);
    let training = views(&dataset, &train, Resize::Keep);
    let held_out = views(&dataset, &test, Resize::Keep);
    let seeds = seed_from_points(&dataset.points, 3);
    let settings = TrainSettings {
        steps: 1000,
        max_gaussians: seeds.len(),
        growth: None,
        ..Default::default()
    };
    let mut trainer = Trainer::new(&device, &training, &seeds, None, settings).unwrap();
    let started = Instant::now();
    for step in 0..1000 {
        trainer.step().unwrap();
        if step % 100 == 99 {
            let ms = started.elapsed().as_secs_f64() * 1e3 / f64::from(step + 1);
            println!("step {}: {ms:.0} ms a step, {:?}", step + 1, trainer.loss().unwrap());
        }
    }
    let gaussians = trainer.gaussians().unwrap();
    let ms = started.elapsed().as_secs_f64();
    let psnr = mean_psnr(&device, gaussians, &held_out);
    println!(
        "{} pictures, {} held out: {psnr:.2} dB, {ms:.0} ms a step",
        training.len(),
        held_out.len()
    );
    assert!(psnr >= 21.0, "{psnr} dB");
}

//! Check cases of the determinism of training. Every case runs twice, and these train two hundred
//! steps with all training kernels: growth, relocation and, in the dynamic scenes, the network or
//! the paths.

use super::{Case, Harness};
use crate::data::Point;
use crate::error::Result;
use crate::geometry::look_at;
use crate::train::{
    GrowthSettings, McmcSettings, MotionStart, TrainSettings, Trainer, TrainingView,
    seed_from_points,
};
use crate::types::{Camera, ControlPoints, DeformNet, Image, Intrinsics, NetShape};
use glam::DVec3;
use rand::RngExt;

/// The family's cases.
pub const CASES: &[Case] = &[
    Case { id: "determinism/static_training", run: |h| train(h, Moved::Not) },
    Case { id: "determinism/dynamic_training", run: |h| train(h, Moved::Network) },
    Case { id: "determinism/path_training", run: |h| train(h, Moved::Paths) },
];

/// The motion model of a case.
#[derive(Clone, Copy, PartialEq)]
enum Moved {
    Not,
    Network,
    Paths,
}

const STEPS: u32 = 200;
const SIZE: (u32, u32) = (40, 28);

/// Four training views around the origin, with images of stripes that shift with time.
fn views() -> Vec<TrainingView> {
    let view = |i: usize| {
        let (angle, time) = (0.5 * i as f64, i as f64 / 3.0);
        let centre = DVec3::new(4.0 * angle.sin(), -0.5, -4.0 * angle.cos());
        let mut image = Image::new(SIZE.0, SIZE.1, 3);
        for y in 0..SIZE.1 {
            for x in 0..SIZE.0 {
                let wave = (0.5 * f64::from(x) + time).sin() * (0.4 * f64::from(y)).cos();
                let shades = [0.5 + 0.4 * wave, 0.6 - 0.3 * wave, 0.3 + 0.1 * time];
                image.at_mut(x, y).copy_from_slice(&shades.map(|v| v as f32));
            }
        }
        TrainingView {
            camera: Camera {
                intrinsics: Intrinsics::centred(45.0, SIZE.0, SIZE.1),
                view_from_world: look_at(centre, DVec3::ZERO, DVec3::NEG_Y),
            },
            time,
            image,
            weights: None,
            disparity: None,
            mask: None,
            every: 1,
        }
    };
    (0..4).map(view).collect()
}

fn train(h: &mut Harness, by: Moved) -> Result<()> {
    let points: Vec<Point> = (0..300)
        .map(|_| Point {
            position: std::array::from_fn(|_| h.rng.random_range(-1.0f32..1.0)),
            colour: std::array::from_fn(|_| h.rng.random_range(0.0f32..1.0)),
        })
        .collect();
    let mut seeds = seed_from_points(&points, 1);
    let start = (by != Moved::Not).then(|| {
        seeds.motion_logits = (0..seeds.len()).map(|i| [-2.0, 2.0][i % 2]).collect();
        let shape = NetShape {
            depth: 3,
            width: 32,
            skip: 1,
            position_frequencies: 4,
            time_frequencies: 4,
            ..NetShape::PAPER
        };
        let positions: Vec<[f32; 3]> = points.iter().step_by(20).map(|p| p.position).collect();
        let log_radii = vec![-1.0; positions.len()];
        MotionStart {
            points: ControlPoints {
                paths: match by {
                    Moved::Paths => vec![[0.0; 8]; 4 * positions.len()],
                    _ => Vec::new(),
                },
                positions,
                log_radii,
            },
            network: (by == Moved::Network).then(|| DeformNet::random(shape, 5)),
            neighbours: 3,
        }
    });
    let settings = TrainSettings {
        steps: STEPS,
        sh_degree: 1,
        sh_interval: 60,
        max_gaussians: 400,
        growth: Some(GrowthSettings::Mcmc(McmcSettings {
            from: 40,
            every: 40,
            ..Default::default()
        })),
        ..Default::default()
    };
    let views = views();
    let mut trainer = Trainer::new(&h.device, &views, &seeds, start.as_ref(), settings)?;
    trainer.step()?;
    let before = trainer.loss()?.map(|loss| loss.l1);
    for _ in 1..STEPS {
        trainer.step()?;
    }
    let after = trainer.loss()?.map(|loss| loss.l1);
    let better = before.zip(after).is_some_and(|(before, after)| after < 0.8 * before);
    h.holds("training makes the images better", better);
    let found = trainer.gaussians()?;
    h.holds("it grew", found.len() > seeds.len());
    h.note(found.positions.as_flattened());
    h.note(found.log_scales.as_flattened());
    h.note(found.rotations.as_flattened());
    h.note(&found.opacity_logits);
    h.note(found.sh.as_flattened());
    h.note(&found.motion_logits);
    let mut moved = false;
    if let Some((points, network)) = trainer.motion()? {
        moved = start
            .is_some_and(|start| start.network != network || start.points.paths != points.paths);
        h.note(points.positions.as_flattened());
        h.note(&points.log_radii);
        h.note(points.paths.as_flattened());
        h.note(&network.map(|network| network.parameters).unwrap_or_default());
    }
    h.holds("what moves them was trained", moved == (by != Moved::Not));
    Ok(())
}

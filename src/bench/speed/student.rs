//! Networks of other widths that are fitted to a scene's motion, on the engine's own kernels.

use crate::bench::scenes::rng;
use crate::gpu::Device;
use crate::ops::adam::{Adam, AdamArgs};
use crate::ops::mlp::Network;
use crate::oracle::mlp;
use crate::scene::Scene;
use crate::types::{AdamSettings, DeformNet, NetShape};
use crate::{Error, Result};
use rand::RngExt;

/// Times of one step of the fit.
const TIMES: usize = 4;
/// Learning rate at the first step and, log-linearly, at the last.
const RATES: [f64; 2] = [4e-3, 2e-4];

/// A network of `shape` whose motions of the scene's control points come close to those of the
/// scene's own network, in the mean square over times in [0, 1].
pub(super) fn fit(
    device: &Device,
    scene: &Scene,
    shape: NetShape,
    steps: u32,
    seed: u64,
) -> Result<DeformNet> {
    let teacher = scene
        .network
        .as_ref()
        .ok_or_else(|| Error::Input("a scene without a network has no motion to fit".into()))?;
    let nodes = scene.control_points.positions.as_flattened();
    let rows = scene.control_points.len() * TIMES;
    let student = DeformNet::random(shape, seed);
    let (plan, mut adam) = (Network::plan(device, &shape)?, Adam::new(device)?);
    let mut scratch = plan.scratch(device, rows)?;
    let count = student.parameters.len();
    let mut parameters = device.upload("student parameters", &student.parameters)?;
    let node_buffer = device.upload("student nodes", nodes)?;
    let mut times = device.buffer::<f32>("student times", TIMES)?;
    let mut transforms = device.buffer::<[f32; 4]>("student transforms", 2 * rows)?;
    let mut by_transform = device.buffer::<[f32; 4]>("student errors", 2 * rows)?;
    let mut gradients = device.buffer::<f32>("student gradients", count)?;
    let mut first = device.upload("student first moments", &vec![0.0f32; count])?;
    let mut second = device.upload("student second moments", &vec![0.0f32; count])?;
    let (mut rng, mut stream) = (rng(seed ^ 0x57), device.stream()?);
    for step in 1..=steps {
        let drawn: [f32; TIMES] = std::array::from_fn(|_| rng.random_range(0.0f32..1.0));
        stream.upload(&mut times, &drawn)?;
        let mut recorder = stream.record()?;
        plan.forward(
            &mut recorder,
            parameters.view(),
            node_buffer.view(),
            times.view(),
            transforms.view_mut(),
            &mut scratch,
        )?;
        stream.submit(recorder)?;
        let got = stream.download(&transforms)?;
        let queries: Vec<[f32; 4]> = drawn
            .iter()
            .flat_map(|&t| nodes.chunks_exact(3).map(move |p| [p[0], p[1], p[2], t]))
            .collect();
        let outputs = mlp::forward(&teacher.shape, &teacher.parameters, &queries).outputs;
        let wanted = outputs.into_iter().flat_map(|output| {
            let t = mlp::transform(output);
            [[t[0], t[1], t[2], t[3]], [t[4], t[5], t[6], t[7]]]
        });
        let weight = 1.0 / rows as f32;
        let errors: Vec<[f32; 4]> = got
            .iter()
            .zip(wanted)
            .map(|(got, wanted)| std::array::from_fn(|c| weight * (got[c] - wanted[c])))
            .collect();
        stream.upload(&mut by_transform, &errors)?;
        let share = f64::from(step) / f64::from(steps);
        let rate = (RATES[0].ln() * (1.0 - share) + RATES[1].ln() * share).exp();
        let mut recorder = stream.record()?;
        plan.backward(
            &mut recorder,
            parameters.view(),
            by_transform.view(),
            gradients.view_mut(),
            false,
            &mut scratch,
        )?;
        let settings = AdamSettings { rate, step, ..AdamSettings::default() };
        let args = AdamArgs {
            gradients: gradients.view(),
            parameters: parameters.view_mut(),
            first: first.view_mut(),
            second: second.view_mut(),
            visible: None,
        };
        adam.record(&mut recorder, &settings, args)?;
        stream.submit(recorder)?;
    }
    Ok(DeformNet { shape, parameters: stream.download(&parameters)? })
}

//! The deformation network's start: fitted to known trajectories.

use crate::Result;
use crate::gpu::{Device, Stream};
use crate::ops::adam::{Adam, AdamArgs};
use crate::ops::mlp::Network;
use crate::types::{AdamSettings, ControlPoints, DeformNet};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// Times in one step of the fit.
const BATCH: usize = 4;

/// Fits the network's translations to those of the control points: `targets[point][time]`, from the
/// canonical position, at `times`. Gives the root mean square error left.
///
/// # Errors
/// Out of memory, or a failed submission.
pub fn fit_translations(
    device: &Device,
    network: &mut DeformNet,
    points: &ControlPoints,
    times: &[f64],
    targets: &[Vec<[f32; 3]>],
    steps: u32,
    seed: u64,
    progress: &mut dyn FnMut(u32) -> Result<()>,
) -> Result<f64> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut stream: Stream = device.stream()?;
    let nodes = points.len();
    let rows = nodes * BATCH;
    let plan = Network::new(&network.shape)?;
    let adam = Adam::new(device)?;
    let mut scratch = plan.scratch(device, rows)?;
    let positions = device.upload("control points", points.positions.as_flattened())?;
    let mut parameters = device.upload("network parameters", &network.parameters)?;
    let zeros = vec![0.0f32; network.parameters.len()];
    let mut gradients = device.upload("network gradients", &zeros)?;
    let mut first = device.upload("first moments", &zeros)?;
    let mut second = device.upload("second moments", &zeros)?;
    let mut batch_times = device.buffer::<f32>("times", BATCH)?;
    let mut transforms = device.buffer::<[f32; 4]>("transforms", 2 * rows)?;
    let mut by_transforms = device.buffer::<[f32; 4]>("transform gradients", 2 * rows)?;
    let mut error = 0.0;
    for step in 0..steps {
        let chosen: [usize; BATCH] = std::array::from_fn(|_| rng.random_range(0..times.len()));
        let mut recorder = stream.record()?;
        recorder.update(batch_times.view_mut(), &chosen.map(|t| times[t] as f32))?;
        plan.forward(
            &mut recorder,
            parameters.view(),
            positions.view(),
            batch_times.view(),
            transforms.view_mut(),
            &mut scratch,
        )?;
        stream.submit(recorder)?;
        let got = stream.download(&transforms)?;
        let mut gradient = vec![[0.0f32; 4]; 2 * rows];
        let mut sum = 0.0f64;
        for (b, &time) in chosen.iter().enumerate() {
            for node in 0..nodes {
                let row = 2 * (b * nodes + node);
                for k in 0..3 {
                    let difference = got[row][k] - targets[node][time][k];
                    sum += f64::from(difference * difference);
                    gradient[row][k] = 2.0 * difference / rows as f32;
                }
            }
        }
        // A running mean: single batches differ with the times they drew.
        let mean = sum / rows as f64;
        error = if step == 0 { mean } else { 0.95 * error + 0.05 * mean };
        stream.upload(&mut by_transforms, &gradient)?;
        let mut recorder = stream.record()?;
        plan.backward(
            &mut recorder,
            parameters.view(),
            by_transforms.view(),
            gradients.view_mut(),
            false,
            &mut scratch,
        )?;
        let rate = super::settings::exponential(2e-3, 1e-4, step, steps);
        adam.record(
            &mut recorder,
            &AdamSettings { rate, step: step + 1, ..AdamSettings::default() },
            AdamArgs {
                gradients: gradients.view(),
                parameters: parameters.view_mut(),
                first: first.view_mut(),
                second: second.view_mut(),
                visible: None,
            },
        )?;
        stream.submit(recorder)?;
        progress(step + 1)?;
    }
    network.parameters = stream.download(&parameters)?;
    Ok(error.sqrt())
}

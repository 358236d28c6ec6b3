//! Check cases of the control points' paths.

use super::{Bound, Case, Harness};
use crate::error::Result;
use crate::ops::path;
use crate::oracle;
use rand::RngExt;

/// The family's cases.
pub const CASES: &[Case] = &[
    Case { id: "path/random", run: random },
    Case { id: "path/few_keys", run: few_keys },
    Case { id: "path/ends", run: ends },
];

/// Five times the measured error of 2.4e-6 at 25 keys. The position between keys is a rounded
/// product; the oracle in f32 has the same error.
const BOUND: Bound = Bound { absolute: 1.2e-5, relative: 1e-6 };

/// Evaluates paths at some times and compares values and gradients.
fn compare(h: &mut Harness, nodes: usize, keys: usize, times: &[f32]) -> Result<()> {
    let mut row = || -> [f32; 8] { std::array::from_fn(|_| h.rng.random_range(-1.0f32..1.0)) };
    let paths: Vec<[f32; 8]> = (0..nodes * keys).map(|_| row()).collect();
    let given: Vec<[f32; 8]> = (0..nodes * times.len()).map(|_| row()).collect();
    let halves =
        |rows: &[[f32; 8]]| -> Vec<[f32; 4]> { rows.as_flattened().as_chunks().0.to_vec() };

    let device = h.device.clone();
    let on_device = device.upload("paths", paths.as_flattened())?;
    let at = device.upload("times", times)?;
    let by_motion = device.upload("motion gradients", &halves(&given))?;
    let mut moved = h.output::<[f32; 4]>("moved", 2 * given.len())?;
    let mut by_path = h.output::<f32>("path gradients", 8 * paths.len())?;
    let mut recorder = h.stream.record()?;
    path::evaluate(&mut recorder, nodes, on_device.view(), at.view(), moved.view_mut())?;
    path::gather(&mut recorder, nodes, at.view(), by_motion.view(), by_path.view_mut())?;
    h.stream.submit(recorder)?;
    let (moved, by_path) = (h.read(&moved)?.concat(), h.read(&by_path)?);

    let wide = |rows: &[[f32; 8]]| -> Vec<[f64; 8]> {
        rows.iter().map(|row| row.map(f64::from)).collect()
    };
    let seconds: Vec<f64> = times.iter().map(|&t| f64::from(t)).collect();
    let truth = oracle::path::evaluate(&wide(&paths), nodes, &seconds);
    let twin = oracle::path::evaluate(&paths, nodes, times);
    h.close("moved", &moved, truth.as_flattened(), Some(twin.as_flattened()), BOUND);
    let by_truth = oracle::path::gather(&wide(&given), nodes, &seconds, keys);
    let by_twin = oracle::path::gather(&given, nodes, times, keys);
    let (truth, twin) = (by_truth.as_flattened(), by_twin.as_flattened());
    h.close("gradients", &by_path, truth, Some(twin), BOUND);
    Ok(())
}

fn random(h: &mut Harness) -> Result<()> {
    let times: Vec<f32> = (0..5).map(|_| h.rng.random_range(0.0f32..1.0)).collect();
    compare(h, 67, 25, &times)
}

/// One key gives no motion; with two and three keys the end keys are repeated.
fn few_keys(h: &mut Harness) -> Result<()> {
    (1..=4).try_for_each(|keys| compare(h, 3, keys, &[0.0, 0.2, 0.5, 0.75, 1.0]))
}

/// Times at the ends, beyond them, and on keys, where rounding may select either segment.
fn ends(h: &mut Harness) -> Result<()> {
    compare(h, 5, 12, &[-3.0, -0.0, 1e-7, 3.0 / 11.0, 7.0 / 11.0, 1.0 - 6e-8, 1.0, 9.0])
}

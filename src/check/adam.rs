//! Check cases of the Adam optimiser.

use super::{Bound, Case, Harness};
use crate::error::Result;
use crate::ops::adam::{Adam, AdamArgs, gate};
use crate::oracle::{Real, adam};
use crate::types::AdamSettings;
use rand::RngExt;

/// The family's cases.
pub const CASES: &[Case] = &[
    Case { id: "adam/steps", run: steps },
    Case { id: "adam/visible", run: visible },
    Case { id: "adam/gate", run: gated },
    Case { id: "adam/hard", run: hard },
];

/// Runs the same steps on the device and in the oracle, and compares after the last one.
/// Gradients: `gradients[step]`.
fn compare(
    h: &mut Harness,
    start: &[f32],
    gradients: &[Vec<f32>],
    mask: Option<(usize, &[u32])>,
    rate: f64,
    bound: Bound,
) -> Result<()> {
    let n = start.len();
    let mut adam = Adam::new(&h.device)?;
    let zeros = h.device.upload("zeros", &vec![0.0f32; n])?;
    let source = h.device.upload("start", start)?;
    let mask_buffer = match mask {
        Some((_, mask)) => Some(h.device.upload("visible", mask)?),
        None => None,
    };
    let mut parameters = h.output::<f32>("parameters", n)?;
    let mut first = h.output::<f32>("first moments", n)?;
    let mut second = h.output::<f32>("second moments", n)?;
    let mut recorder = h.stream.record()?;
    recorder.copy(source.view(), parameters.view_mut());
    recorder.copy(zeros.view(), first.view_mut());
    recorder.copy(zeros.view(), second.view_mut());
    for (index, values) in gradients.iter().enumerate() {
        let values = h.device.upload("gradients", values)?;
        let row = mask.map_or(1, |(row, _)| row);
        adam.record(
            &mut recorder,
            &AdamSettings { rate, step: index as u32 + 1, ..AdamSettings::default() },
            AdamArgs {
                gradients: values.view(),
                parameters: parameters.view_mut(),
                first: first.view_mut(),
                second: second.view_mut(),
                visible: mask_buffer.as_ref().map(|mask| (row, mask.view())),
            },
        )?;
    }
    h.stream.submit(recorder)?;
    let (truth, broken) = oracle::<f64>(start, gradients, mask, rate);
    let (twin, _) = oracle::<f32>(start, gradients, mask, rate);
    let counted = adam.broken(&mut h.stream)?;
    h.exact("broken gradients", &[counted], &[broken]);
    let device = [h.read(&parameters)?, h.read(&first)?, h.read(&second)?];
    for (i, name) in ["parameters", "first moments", "second moments"].iter().enumerate() {
        // Moments hardly cancel between steps of one sign; parameters do.
        let bound = if i == 0 { bound } else { Bound { absolute: 1e-6, relative: 1e-5 } };
        h.close(name, &device[i], &truth[i], Some(&twin[i]), bound);
    }
    Ok(())
}

fn oracle<R: Real>(
    start: &[f32],
    gradients: &[Vec<f32>],
    mask: Option<(usize, &[u32])>,
    rate: f64,
) -> ([Vec<R>; 3], u64) {
    let real = |values: &[f32]| -> Vec<R> { values.iter().map(|&v| R::of(f64::from(v))).collect() };
    let mut parameters = real(start);
    let (mut first, mut second) = (vec![R::zero(); start.len()], vec![R::zero(); start.len()]);
    let mut broken = 0;
    for (index, values) in gradients.iter().enumerate() {
        let settings = AdamSettings { rate, step: index as u32 + 1, ..AdamSettings::default() };
        broken += adam::step(
            &settings,
            mask.map_or(1, |(row, _)| row),
            mask.map(|(_, mask)| mask),
            &real(values),
            &mut parameters,
            &mut first,
            &mut second,
        );
    }
    ([parameters, first, second], broken)
}

fn random(h: &mut Harness, n: usize) -> Vec<f32> {
    (0..n).map(|_| h.rng.random_range(-1.0f32..1.0)).collect()
}

fn steps(h: &mut Harness) -> Result<()> {
    for n in [0, 1, 62, 63, 64, 65, 5000] {
        let start = random(h, n);
        let gradients: Vec<_> = (0..10).map(|_| random(h, n)).collect();
        // Measured 1.9e-7: ten steps of 1e-2 on numbers up to 1.
        compare(h, &start, &gradients, None, 1e-2, Bound { absolute: 1e-6, relative: 0.0 })?;
    }
    Ok(())
}

fn visible(h: &mut Harness) -> Result<()> {
    let bound = Bound { absolute: 1e-6, relative: 0.0 };
    for row in [1, 2, 3, 4, 5, 7, 9, 15, 21, 45] {
        let start = random(h, 101 * row);
        let gradients: Vec<_> = (0..3).map(|_| random(h, 101 * row)).collect();
        let mask: Vec<u32> = (0..101).map(|i| u32::from(i % 3 == 1)).collect();
        compare(h, &start, &gradients, Some((row, &mask)), 1e-2, bound)?;
    }
    // One row that holds all values.
    for (row, visible) in [1, 2, 3, 1001].into_iter().flat_map(|row| [(row, 0), (row, 1)]) {
        let start = random(h, row);
        let gradients = [random(h, row)];
        compare(h, &start, &gradients, Some((row, &[visible])), 1e-2, bound)?;
    }
    Ok(())
}

/// Zero, tiny, huge and non-finite gradients.
fn hard(h: &mut Harness) -> Result<()> {
    let values = vec![
        0.0,
        -0.0,
        1e-18,
        -1e-12,
        1e18,
        3e38,
        -3e38,
        f32::NAN,
        f32::INFINITY,
        f32::NEG_INFINITY,
        1.0,
    ];
    let gradients = vec![values.clone(), vec![0.5; values.len()]];
    let bound = Bound { absolute: 1e-6, relative: 1e-6 };
    let start = vec![1.0; values.len()];
    compare(h, &start, &gradients, None, 1e-2, bound)?;
    // Rows that are not updated do not count.
    let seen: Vec<u32> = (0..values.len() as u32).map(|i| i % 2).collect();
    compare(h, &start, &gradients, Some((1, &seen)), 1e-2, bound)
}

fn gated(h: &mut Harness) -> Result<()> {
    for n in [1usize, 63, 64, 65, 1000] {
        let trainable: Vec<u32> = (0..n).map(|_| h.rng.random_range(0..2)).collect();
        let trainable_buffer = h.device.upload("trainable", &trainable)?;
        for fits in [0u32, 1] {
            let fits_buffer = h.device.upload("fits", &[fits])?;
            let mut out = h.output::<u32>("gate", n)?;
            let mut recorder = h.stream.record()?;
            gate(&mut recorder, fits_buffer.view(), trainable_buffer.view(), out.view_mut())?;
            h.stream.submit(recorder)?;
            let truth: Vec<u32> = trainable.iter().map(|t| t & fits).collect();
            let device = h.read(&out)?;
            h.exact(&format!("{n} rows, fits {fits}"), &device, &truth);
        }
    }
    Ok(())
}

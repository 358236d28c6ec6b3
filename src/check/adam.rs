//! Check cases of the Adam optimiser.

use super::{Bound, Case, Guarded, Harness, Workload};
use crate::error::Result;
use crate::gpu::{Buffer, Recorder};
use crate::ops::adam::{Adam, AdamArgs, gate};
use crate::oracle::{Real, adam};
use crate::types::{AdamSettings, Work};
use rand::RngExt;

/// The family's cases.
pub const CASES: &[Case] = &[
    Case { id: "adam/steps", run: steps },
    Case { id: "adam/visible", run: visible },
    Case { id: "adam/gate", run: gated },
    Case { id: "adam/hard", run: hard },
];

/// The bound of the parameters after ten steps of 1e-2 on numbers up to 1. Measured 1.9e-7.
pub(crate) const BOUND: Bound = Bound { absolute: 1e-6, relative: 0.0 };

/// Steps of Adam, one for each of `gradients`.
pub(crate) struct AdamWorkload {
    start: Vec<f32>,
    gradients: Vec<Vec<f32>>,
    /// The length of a row, and whether each row is visible.
    mask: Option<(usize, Vec<u32>)>,
    rate: f64,
    /// Of the parameters.
    bound: Bound,
    op: Adam,
    source: Buffer<f32>,
    zeros: Buffer<f32>,
    mask_buffer: Option<Buffer<u32>>,
    gradient_buffers: Vec<Buffer<f32>>,
    parameters: Guarded<f32>,
    first: Guarded<f32>,
    second: Guarded<f32>,
}

impl AdamWorkload {
    /// Uploads parameters, gradients and visibility.
    pub(crate) fn new(
        h: &mut Harness,
        start: &[f32],
        gradients: &[Vec<f32>],
        mask: Option<(usize, &[u32])>,
        rate: f64,
        bound: Bound,
    ) -> Result<AdamWorkload> {
        let n = start.len();
        let upload = |values: &Vec<f32>| h.device.upload("gradients", values);
        Ok(AdamWorkload {
            op: Adam::new(&h.device)?,
            source: h.device.upload("start", start)?,
            zeros: h.device.upload("zeros", &vec![0.0f32; n])?,
            mask_buffer: mask.map(|(_, mask)| h.device.upload("visible", mask)).transpose()?,
            gradient_buffers: gradients.iter().map(upload).collect::<Result<_>>()?,
            parameters: h.output("parameters", n)?,
            first: h.output("first moments", n)?,
            second: h.output("second moments", n)?,
            start: start.to_vec(),
            gradients: gradients.to_vec(),
            mask: mask.map(|(row, mask)| (row, mask.to_vec())),
            rate,
            bound,
        })
    }

    fn settings(&self, index: usize) -> AdamSettings {
        AdamSettings { rate: self.rate, step: index as u32 + 1, ..AdamSettings::default() }
    }

    /// Parameters, first and second moments after the last step, and the number of broken gradients.
    fn oracle<R: Real>(&self) -> ([Vec<R>; 3], u64) {
        let real =
            |values: &[f32]| -> Vec<R> { values.iter().map(|&v| R::of(f64::from(v))).collect() };
        let mut parameters = real(&self.start);
        let (mut first, mut second) =
            (vec![R::zero(); self.start.len()], vec![R::zero(); self.start.len()]);
        let mut broken = 0;
        for (index, values) in self.gradients.iter().enumerate() {
            broken += adam::step(
                &self.settings(index),
                self.mask.as_ref().map_or(1, |(row, _)| *row),
                self.mask.as_ref().map(|(_, mask)| mask.as_slice()),
                &real(values),
                &mut parameters,
                &mut first,
                &mut second,
            );
        }
        ([parameters, first, second], broken)
    }
}

impl Workload for AdamWorkload {
    fn record_before(&mut self, recorder: &mut Recorder) -> Result<()> {
        recorder.copy(self.source.view(), self.parameters.view_mut());
        recorder.copy(self.zeros.view(), self.first.view_mut());
        recorder.copy(self.zeros.view(), self.second.view_mut());
        Ok(())
    }

    fn record(&mut self, recorder: &mut Recorder) -> Result<()> {
        let row = self.mask.as_ref().map_or(1, |(row, _)| *row);
        for index in 0..self.gradients.len() {
            let settings = self.settings(index);
            let args = AdamArgs {
                gradients: self.gradient_buffers[index].view(),
                parameters: self.parameters.view_mut(),
                first: self.first.view_mut(),
                second: self.second.view_mut(),
                visible: self.mask_buffer.as_ref().map(|mask| (row, mask.view())),
            };
            self.op.record(recorder, &settings, args)?;
        }
        Ok(())
    }

    fn compare(&self, h: &mut Harness) -> Result<()> {
        let (truth, broken) = self.oracle::<f64>();
        let (twin, _) = self.oracle::<f32>();
        let counted = self.op.broken(&mut h.stream)?;
        h.exact("broken gradients", &[counted], &[broken]);
        let device = [h.read(&self.parameters)?, h.read(&self.first)?, h.read(&self.second)?];
        // Moments hardly cancel between steps of one sign; parameters do.
        let moments = Bound { absolute: 1e-6, relative: 1e-5 };
        let bounds = [self.bound, moments, moments];
        for (i, name) in ["parameters", "first moments", "second moments"].iter().enumerate() {
            h.close(name, &device[i], &truth[i], Some(&twin[i]), bounds[i]);
        }
        Ok(())
    }

    /// Each step reads four arrays and writes three; multiplications, additions, a root and a quotient.
    fn work(&self) -> Work {
        let values = (self.gradients.len() * self.start.len()) as u64;
        Work { bytes: 28 * values, operations: 14 * values }
    }
}

fn compare(
    h: &mut Harness,
    start: &[f32],
    gradients: &[Vec<f32>],
    mask: Option<(usize, &[u32])>,
    rate: f64,
    bound: Bound,
) -> Result<()> {
    let mut workload = AdamWorkload::new(h, start, gradients, mask, rate, bound)?;
    h.execute(&mut workload)
}

fn random(h: &mut Harness, n: usize) -> Vec<f32> {
    (0..n).map(|_| h.rng.random_range(-1.0f32..1.0)).collect()
}

fn steps(h: &mut Harness) -> Result<()> {
    for n in [0, 1, 62, 63, 64, 65, 5000] {
        let start = random(h, n);
        let gradients: Vec<_> = (0..10).map(|_| random(h, n)).collect();
        compare(h, &start, &gradients, None, 1e-2, BOUND)?;
    }
    Ok(())
}

fn visible(h: &mut Harness) -> Result<()> {
    for row in [1, 2, 3, 4, 5, 7, 9, 15, 21, 45] {
        let start = random(h, 101 * row);
        let gradients: Vec<_> = (0..3).map(|_| random(h, 101 * row)).collect();
        let mask: Vec<u32> = (0..101).map(|i| u32::from(i % 3 == 1)).collect();
        compare(h, &start, &gradients, Some((row, &mask)), 1e-2, BOUND)?;
    }
    // One row that holds all values.
    for (row, visible) in [1, 2, 3, 1001].into_iter().flat_map(|row| [(row, 0), (row, 1)]) {
        let start = random(h, row);
        let gradients = [random(h, row)];
        compare(h, &start, &gradients, Some((row, &[visible])), 1e-2, BOUND)?;
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

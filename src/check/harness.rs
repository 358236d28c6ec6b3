//! What a case works with: inputs by seed, guarded outputs, comparisons.

use crate::error::{Error, Result};
use crate::gpu::{Buffer, Device, Stream, ViewMut};
use bytemuck::Pod;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

/// Bytes of guard words on each side of an output; every device's alignment divides it.
const GUARD_BYTES: usize = 256;
/// Poison and guard: a quiet NaN as a float, and no count or index.
const POISON: u32 = 0xffff_ffff;

/// How far an output may lie from the truth: `absolute + relative · |truth|`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Bound {
    /// In the output's unit.
    pub absolute: f64,
    /// As a share of the truth.
    pub relative: f64,
}

/// One output held against the truth.
#[derive(Clone, Debug)]
pub struct Finding {
    /// What was compared.
    pub output: String,
    /// How many values.
    pub count: usize,
    /// Largest difference from the oracle in f64.
    pub worst_absolute: f64,
    /// Largest difference as a share of the truth.
    pub worst_relative: f64,
    /// Largest difference as a share of the bound: above 1 fails.
    pub worst_of_bound: f64,
    /// Where the largest share lies.
    pub worst_at: usize,
    /// The same share for the oracle in f32, where it was given.
    pub oracle_f32_of_bound: Option<f64>,
    /// Whether all values stay within the bound.
    pub passed: bool,
}

/// An output buffer between guard words, poisoned.
pub struct Guarded<T> {
    buffer: Buffer<T>,
    guard: usize,
    len: usize,
}

impl<T: Pod> Guarded<T> {
    /// The part between the guards, for a dispatch.
    pub fn view_mut(&mut self) -> ViewMut<'_, T> {
        self.buffer.range_mut(self.guard..self.guard + self.len)
    }
}

/// A case's workplace.
pub struct Harness {
    /// The device under test.
    pub device: Device,
    /// A stream on it.
    pub stream: Stream,
    /// Random numbers that the seed decides.
    pub rng: ChaCha8Rng,
    findings: Vec<Finding>,
}

impl Harness {
    pub(super) fn new(device: &Device, seed: u64) -> Result<Harness> {
        Ok(Harness {
            device: device.clone(),
            stream: device.stream()?,
            rng: ChaCha8Rng::seed_from_u64(seed),
            findings: Vec::new(),
        })
    }

    pub(super) fn into_findings(self) -> Vec<Finding> {
        self.findings
    }

    /// A poisoned output of `len` elements between guard words.
    ///
    /// # Errors
    /// Out of memory, or a failed submission.
    pub fn output<T: Pod>(&mut self, label: &str, len: usize) -> Result<Guarded<T>> {
        let guard = GUARD_BYTES.div_ceil(size_of::<T>());
        let mut buffer = self.device.buffer::<T>(label, len + 2 * guard)?;
        let mut recorder = self.stream.record()?;
        recorder.fill(buffer.view_mut(), POISON);
        self.stream.submit(recorder)?;
        Ok(Guarded { buffer, guard, len })
    }

    /// An output's content after the run; fails when a guard word changed.
    ///
    /// # Errors
    /// [`Error::Failed`] naming the buffer, or a failed submission.
    pub fn read<T: Pod>(&mut self, output: &Guarded<T>) -> Result<Vec<T>> {
        let all = self.stream.download(&output.buffer)?;
        let (before, rest) = all.split_at(output.guard);
        let (inner, after) = rest.split_at(output.len);
        let intact =
            |guard: &[T]| bytemuck::cast_slice::<T, u8>(guard).iter().all(|&byte| byte == 0xff);
        if !intact(before) || !intact(after) {
            return Err(Error::Failed(format!(
                "{}: a kernel wrote outside of the buffer",
                output.buffer.label()
            )));
        }
        Ok(inner.to_vec())
    }

    /// Holds integers (or anything with equality) against the truth.
    pub fn exact<T: PartialEq>(&mut self, output: &str, device: &[T], truth: &[T]) {
        let wrong = (0..device.len().max(truth.len())).find(|&i| device.get(i) != truth.get(i));
        let worst = if wrong.is_some() { f64::INFINITY } else { 0.0 };
        self.findings.push(Finding {
            output: output.to_owned(),
            count: truth.len(),
            worst_absolute: worst,
            worst_relative: worst,
            worst_of_bound: worst,
            worst_at: wrong.unwrap_or(0),
            oracle_f32_of_bound: None,
            passed: wrong.is_none(),
        });
    }

    /// Holds floats against the oracle in f64, with the oracle in f32 beside it where given.
    pub fn close(
        &mut self,
        output: &str,
        device: &[f32],
        truth: &[f64],
        oracle_f32: Option<&[f32]>,
        bound: Bound,
    ) {
        let mut finding = compare(output, device, truth, bound);
        finding.oracle_f32_of_bound =
            oracle_f32.map(|twin| compare(output, twin, truth, bound).worst_of_bound);
        self.findings.push(finding);
    }

    /// Notes whether something holds that is no comparison of numbers.
    pub fn holds(&mut self, what: &str, holds: bool) {
        self.exact(what, &[holds], &[true]);
    }
}

fn compare(output: &str, values: &[f32], truth: &[f64], bound: Bound) -> Finding {
    let mut finding = Finding {
        output: output.to_owned(),
        count: truth.len(),
        worst_absolute: 0.0,
        worst_relative: 0.0,
        worst_of_bound: if values.len() == truth.len() { 0.0 } else { f64::INFINITY },
        worst_at: 0,
        oracle_f32_of_bound: None,
        passed: false,
    };
    for (at, (&value, &truth)) in values.iter().zip(truth).enumerate() {
        let difference = (f64::from(value) - truth).abs();
        // NaN must fail, and so must one infinity against another number.
        let difference = if f64::from(value) == truth { 0.0 } else { difference };
        let difference = if difference.is_nan() { f64::INFINITY } else { difference };
        let share = difference / (bound.absolute + bound.relative * truth.abs());
        let share = if difference == 0.0 { 0.0 } else { share };
        finding.worst_absolute = finding.worst_absolute.max(difference);
        finding.worst_relative = finding.worst_relative.max(difference / truth.abs().max(1e-300));
        if share > finding.worst_of_bound {
            finding.worst_of_bound = share;
            finding.worst_at = at;
        }
    }
    finding.passed = finding.worst_of_bound <= 1.0;
    finding
}

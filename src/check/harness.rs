//! The harness of a case: seeded inputs, guarded outputs and comparisons.

use super::Workload;
use super::finding::{self, Bound, Finding};
use crate::error::{Error, Result};
use crate::gpu::{Buffer, Device, Stream, View, ViewMut};
use bytemuck::{NoUninit, Pod};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use std::fmt::Debug;
use std::hash::{DefaultHasher, Hasher};

/// Bytes of guard words on each side of an output; every device's alignment divides it.
const GUARD_BYTES: usize = 256;
/// The poison and guard word: a quiet NaN as a float, and not a valid count or index.
const POISON: u32 = 0xffff_ffff;

/// A poisoned output buffer between guard words.
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

/// The environment of a running case.
pub struct Harness {
    /// The device under test.
    pub device: Device,
    /// A stream on it.
    pub stream: Stream,
    /// Random number generator, initialised from the seed.
    pub rng: ChaCha8Rng,
    findings: Vec<Finding>,
    digest: DefaultHasher,
}

impl Harness {
    pub(crate) fn new(device: &Device, seed: u64) -> Result<Harness> {
        Ok(Harness {
            device: device.clone(),
            stream: device.stream()?,
            rng: ChaCha8Rng::seed_from_u64(seed),
            findings: Vec::new(),
            digest: DefaultHasher::new(),
        })
    }

    /// The findings, and a digest of all bits that the device returned.
    pub(crate) fn finish(self) -> (Vec<Finding>, u64) {
        (self.findings, self.digest.finish())
    }

    /// Runs a workload once and compares its outputs.
    ///
    /// # Errors
    /// Those of the workload, or a failed submission.
    pub fn execute(&mut self, workload: &mut impl Workload) -> Result<()> {
        let mut recorder = self.stream.record()?;
        workload.record_before(&mut recorder)?;
        workload.record_inputs(&mut recorder)?;
        workload.record(&mut recorder)?;
        self.stream.submit(recorder)?;
        workload.compare(self)
    }

    /// As [`execute`](Self::execute); the findings name the input.
    pub(super) fn execute_on(&mut self, input: &str, workload: &mut impl Workload) -> Result<()> {
        let first = self.findings.len();
        let ended = self.execute(workload);
        for finding in &mut self.findings[first..] {
            finding.output = format!("{input}: {}", finding.output);
        }
        ended
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

    /// Reads an output after the run; fails if a guard word changed.
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

    /// Reads a buffer that an op owns.
    ///
    /// # Errors
    /// Out of memory, or a failed submission.
    pub fn read_view<T: Pod>(&mut self, view: View<'_, T>) -> Result<Vec<T>> {
        let mut copy = self.device.buffer::<T>("values of an op", view.len())?;
        let mut recorder = self.stream.record()?;
        recorder.copy(view, copy.view_mut());
        self.stream.submit(recorder)?;
        self.stream.download(&copy)
    }

    /// Adds a device result to the digest that must be equal, bit for bit, when the case runs
    /// again. Values that are compared through the harness are added automatically.
    pub fn note<T: NoUninit>(&mut self, answer: &[T]) {
        self.digest.write_usize(answer.len());
        self.digest.write(bytemuck::cast_slice(answer));
    }

    /// Compares integers (or other types with equality) with the true values.
    pub fn exact<T: PartialEq + NoUninit + Debug>(
        &mut self,
        output: &str,
        device: &[T],
        truth: &[T],
    ) {
        self.note(device);
        self.findings.push(finding::exact(output, device, truth));
    }

    /// Compares floats with the oracle in f64, and reports the error of the oracle in f32 if given.
    pub fn close(
        &mut self,
        output: &str,
        device: &[f32],
        truth: &[f64],
        oracle_f32: Option<&[f32]>,
        bound: Bound,
    ) {
        self.note(device);
        let finding = finding::close(output, device, truth, bound);
        let twin = oracle_f32.map(|twin| finding::close(output, twin, truth, bound));
        self.findings.push(beside(finding, twin));
    }

    /// [`close`](Self::close) with an individual error limit per value.
    pub fn within(
        &mut self,
        output: &str,
        device: &[f32],
        truth: &[f64],
        oracle_f32: Option<&[f32]>,
        limits: &[f64],
    ) {
        self.note(device);
        let finding = finding::within(output, device, truth, limits);
        let twin = oracle_f32.map(|twin| finding::within(output, twin, truth, limits));
        self.findings.push(beside(finding, twin));
    }

    /// Records a condition that is not a numerical comparison.
    pub fn holds(&mut self, what: &str, holds: bool) {
        self.exact(what, &[holds], &[true]);
    }
}

/// Adds the error of the oracle in f32 to the device's finding.
fn beside(mut device: Finding, twin: Option<Finding>) -> Finding {
    device.oracle_f32_absolute = twin.as_ref().map(|twin| twin.worst_absolute);
    device.oracle_f32_of_bound = twin.map(|twin| twin.worst_of_bound);
    device
}

//! What a case works with: inputs by seed, guarded outputs, comparisons.

use super::finding::{self, Bound, Finding};
use crate::error::{Error, Result};
use crate::gpu::{Buffer, Device, Stream, ViewMut};
use bytemuck::{NoUninit, Pod};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use std::hash::{DefaultHasher, Hasher};

/// Bytes of guard words on each side of an output; every device's alignment divides it.
const GUARD_BYTES: usize = 256;
/// Poison and guard: a quiet NaN as a float, and no count or index.
const POISON: u32 = 0xffff_ffff;

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
    digest: DefaultHasher,
}

impl Harness {
    pub(super) fn new(device: &Device, seed: u64) -> Result<Harness> {
        Ok(Harness {
            device: device.clone(),
            stream: device.stream()?,
            rng: ChaCha8Rng::seed_from_u64(seed),
            findings: Vec::new(),
            digest: DefaultHasher::new(),
        })
    }

    /// What was found, and a digest of every bit that the device answered.
    pub(super) fn finish(self) -> (Vec<Finding>, u64) {
        (self.findings, self.digest.finish())
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

    /// Adds the device's answer to what must be the same, bit for bit, when the case runs again.
    /// What is compared through the harness is noted already.
    pub fn note<T: NoUninit>(&mut self, answer: &[T]) {
        self.digest.write_usize(answer.len());
        self.digest.write(bytemuck::cast_slice(answer));
    }

    /// Holds integers (or anything with equality) against the truth.
    pub fn exact<T: PartialEq + NoUninit>(&mut self, output: &str, device: &[T], truth: &[T]) {
        self.note(device);
        self.findings.push(finding::exact(output, device, truth));
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
        self.note(device);
        let finding = finding::close(output, device, truth, bound);
        let twin = oracle_f32.map(|twin| finding::close(output, twin, truth, bound));
        self.findings.push(beside(finding, twin));
    }

    /// [`close`](Self::close) with a limit for each value: what rounding may do to that one.
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

    /// Notes whether something holds that is no comparison of numbers.
    pub fn holds(&mut self, what: &str, holds: bool) {
        self.exact(what, &[holds], &[true]);
    }
}

/// The device's finding with the error of the oracle in f32 beside it.
fn beside(mut device: Finding, twin: Option<Finding>) -> Finding {
    device.oracle_f32_absolute = twin.as_ref().map(|twin| twin.worst_absolute);
    device.oracle_f32_of_bound = twin.map(|twin| twin.worst_of_bound);
    device
}

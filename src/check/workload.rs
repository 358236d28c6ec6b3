//! An op on given inputs, as the cases compare it and the benchmarks time it.

use super::Harness;
use crate::error::Result;
use crate::gpu::Recorder;
use crate::types::Work;

/// A pass of an op that has gradients.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(crate) enum Pass {
    /// From inputs to outputs.
    Forward,
    /// From the gradients of the outputs to those of the inputs.
    Backward,
}

/// An op with its inputs and outputs on the device. It is declared once: a case runs it on hard inputs, a
/// benchmark on large ones.
pub trait Workload {
    /// Records what the op needs before its first run, such as the forward pass of a backward one.
    ///
    /// # Errors
    /// As for recording the ops.
    fn record_before(&mut self, _: &mut Recorder) -> Result<()> {
        Ok(())
    }

    /// Records what restores the inputs that the op changes in place. It runs before each run and is not
    /// timed.
    ///
    /// # Errors
    /// As for recording a copy.
    fn record_inputs(&mut self, _: &mut Recorder) -> Result<()> {
        Ok(())
    }

    /// Records the op.
    ///
    /// # Errors
    /// As for recording the op.
    fn record(&mut self, recorder: &mut Recorder) -> Result<()>;

    /// Compares the outputs of the first run with the oracle.
    ///
    /// # Errors
    /// As for reading an output back.
    fn compare(&self, h: &mut Harness) -> Result<()>;

    /// Data volume and arithmetic of one run of the op.
    fn work(&self) -> Work;
}

//! The host's command buffers and semaphores.

use crate::gpu::{Device, KernelTime, Recorder, Stream, Ticket, Work};
use crate::vk::SemaphorePoint;
use crate::{Error, Result};
use ash::vk;
use ash::vk::Handle;

/// What a recording into a host's command buffer needs while the device works on it. Drop it when
/// the device is done, or when the command buffer will never be submitted.
#[must_use = "dropping it tells that the device is done with the commands"]
pub struct Guard {
    device: Device,
    /// Taken when it is dropped.
    work: Option<Work>,
    profile: Option<Vec<&'static str>>,
}

impl Recorder {
    /// Records into a host's command buffer, from where the host is in it; the host goes on with it
    /// after [`finish`](Self::finish), and submits it. See [the contract](crate::embed#barriers).
    ///
    /// Binds compute pipelines, descriptor sets and push constants of its own: the host binds its own
    /// anew. A recorder that is dropped without `finish`, also by a call that fails, leaves the
    /// commands recorded so far and frees what they use: the host must reset or free the command
    /// buffer.
    ///
    /// # Errors
    /// [`Error::Input`] for a null handle; else a failed Vulkan call.
    ///
    /// # Safety
    /// - The command buffer is of this device, of a pool for a family with compute, primary (or a
    ///   secondary one outside of render passes), begun, outside of a render pass, and nobody else
    ///   records into it until `finish`.
    /// - It is submitted once at most for each recording, or its submissions do not overlap.
    /// - The [`Guard`] that `finish` gives, and every buffer of the host's that was recorded, live
    ///   until the device is done with the command buffer or the host has reset it. Buffers, scratch
    ///   and plans of the engine's own may be dropped earlier: the guard keeps what they hold.
    /// - Command buffers that use the same buffers or scratch go to one queue in the order in which
    ///   they were recorded, or are ordered by the host's semaphores.
    pub unsafe fn over(device: &Device, commands: vk::CommandBuffer) -> Result<Recorder> {
        if commands.is_null() {
            return Err(Error::Input("the host's command buffer is a null handle".into()));
        }
        let mut work = device.take_spare();
        work.slot.begin_over(commands)?;
        Ok(Recorder::of(device, work, false))
    }

    /// Ends a recording into a host's command buffer; what the host records next sees what was
    /// written.
    ///
    /// # Errors
    /// [`Error::Input`] for a recording of a [`Stream`], which submits it, and where a fill or a copy
    /// named memory of another device.
    pub fn finish(self) -> Result<Guard> {
        let (device, mut work, profile) = self.into_parts()?;
        if !work.slot.is_over() {
            return Err(Error::Input("a stream's recording ends with `Stream::submit`".into()));
        }
        work.slot.host_barrier();
        Ok(Guard { device, work: Some(work), profile })
    }
}

impl Guard {
    /// How long each dispatch took, where the recording was profiled; the device must be done with
    /// it.
    ///
    /// # Errors
    /// [`Error::Input`] where it was not profiled; a failed Vulkan call where the device is not done.
    pub fn times(&self) -> Result<Vec<KernelTime>> {
        let (Some(names), Some(work)) = (&self.profile, &self.work) else {
            return Err(Error::Input("the recording was not profiled".into()));
        };
        let ticks = work.slot.try_timestamps()?;
        Ok(KernelTime::between(names, &ticks, self.device.limits().timestamp_period))
    }
}

impl Drop for Guard {
    fn drop(&mut self) {
        if let Some(work) = self.work.take() {
            self.device.give_spare(work);
        }
    }
}

impl Stream {
    /// Submits a recording that begins when the host's semaphores have reached the values of `waits`
    /// and brings them to those of `signals` when it is done.
    ///
    /// # Errors
    /// [`Error::Input`] for a null handle; else as for [`submit`](Self::submit).
    ///
    /// # Safety
    /// The semaphores are timeline semaphores of this device and live until the submission is done;
    /// what is waited for comes (else waiting for the ticket, and dropping the stream, never end);
    /// and each value signalled is above all that the semaphore had or gets from submissions pending.
    pub unsafe fn submit_between(
        &mut self,
        recorder: Recorder,
        waits: &[SemaphorePoint],
        signals: &[SemaphorePoint],
    ) -> Result<Ticket> {
        if waits.iter().chain(signals).any(|point| point.semaphore.is_null()) {
            return Err(Error::Input("a semaphore of the host's is a null handle".into()));
        }
        self.submit_with(recorder, waits, signals)
    }

    /// The timeline semaphore that counts the submissions, for a host's own to wait for:
    /// [`Ticket::value`] says what to wait for. It lives as long as the stream.
    pub fn semaphore(&self) -> vk::Semaphore {
        self.timeline().semaphore()
    }
}

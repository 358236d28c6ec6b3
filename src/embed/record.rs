//! Recording into the host's command buffers, and the host's semaphores.

use crate::gpu::{Device, KernelTime, Recorder, Stream, Ticket, Work};
use crate::vk::SemaphorePoint;
use crate::{Error, Result};
use ash::vk;
use ash::vk::Handle;

/// The guard of a recording into a host's command buffer: it keeps the recorded resources alive.
/// Drop it when the device is done with the commands, or when the command buffer will never be
/// submitted.
#[must_use = "dropping it tells that the device is done with the commands"]
pub struct Guard {
    device: Device,
    /// `Some` until the guard is dropped.
    work: Option<Work>,
    profile: Option<Vec<&'static str>>,
}

impl Recorder {
    /// A recorder that appends to a host's command buffer. After [`finish`](Self::finish) the host
    /// may record more, and submits the buffer. See [the contract](crate::embed#barriers).
    ///
    /// The recorder binds its own compute pipelines, descriptor sets and push constants; the host
    /// must rebind its own afterwards. If the recorder is dropped without `finish`, also because a
    /// call fails, the commands recorded so far remain in the buffer but their resources are freed:
    /// the host must reset or free the command buffer.
    ///
    /// # Errors
    /// [`Error::Input`] for a null handle; else a failed Vulkan call.
    ///
    /// # Safety
    /// - The command buffer belongs to this device and comes from a pool of a family with compute.
    ///   It is primary, or secondary for use outside render passes. It is in the recording state,
    ///   outside of a render pass. No other code records into it until `finish`.
    /// - It is submitted at most once for each recording, or its submissions do not overlap.
    /// - The [`Guard`] that `finish` returns, and every recorded buffer of the host, live until the
    ///   device is done with the command buffer or the host has reset it. The engine's own buffers,
    ///   scratch and plans may be dropped earlier: the guard keeps their memory alive.
    /// - Command buffers that use the same buffers or scratch go to one queue in the order in which
    ///   they were recorded, or semaphores of the host order them.
    pub unsafe fn over(device: &Device, commands: vk::CommandBuffer) -> Result<Recorder> {
        if commands.is_null() {
            return Err(Error::Input("the host's command buffer is a null handle".into()));
        }
        let mut work = device.take_spare();
        work.slot.begin_over(commands)?;
        Ok(Recorder::of(device, work, false))
    }

    /// Ends a recording into a host's command buffer. Commands that the host records afterwards see
    /// its writes.
    ///
    /// # Errors
    /// [`Error::Input`] for a recording of a [`Stream`], which must be submitted instead, and if a
    /// fill or a copy used memory of another device.
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
    /// The device time of each dispatch of a profiled recording. The device must be done with the
    /// commands.
    ///
    /// # Errors
    /// [`Error::Input`] if the recording was not profiled; a failed Vulkan call if the device is
    /// not done.
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
    /// Submits a recording that begins when the host's semaphores have reached the values of
    /// `waits`, and that signals the values of `signals` when it is done.
    ///
    /// # Errors
    /// [`Error::Input`] for a null handle; else as for [`submit`](Self::submit).
    ///
    /// # Safety
    /// The semaphores are timeline semaphores of this device and live until the submission is done;
    /// the values of `waits` are reached eventually (else waiting for the ticket, and dropping the
    /// stream, block forever); and each signalled value is greater than the semaphore's value and
    /// than all values that pending submissions signal.
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

    /// The timeline semaphore that counts the submissions, so that the host's submissions can wait
    /// for [`Ticket::value`]. It lives as long as the stream.
    pub fn semaphore(&self) -> vk::Semaphore {
        self.timeline().semaphore()
    }
}

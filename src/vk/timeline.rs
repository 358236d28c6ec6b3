//! The timeline semaphore of a stream, and submission to the queue.

use super::command::CommandSlot;
use super::device::Context;
use super::vk_error;
use crate::error::Result;
use ash::vk;
use std::sync::Arc;

/// A value of a host's timeline semaphore.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SemaphorePoint {
    /// A timeline semaphore of the device.
    pub semaphore: vk::Semaphore,
    /// The value to wait for, or to signal.
    pub value: u64,
}

/// A timeline semaphore whose values count a stream's submissions.
pub(crate) struct Timeline {
    raw: vk::Semaphore,
    context: Arc<Context>,
}

impl Timeline {
    pub(crate) fn new(context: &Arc<Context>) -> Result<Timeline> {
        let mut kind = vk::SemaphoreTypeCreateInfo::default()
            .semaphore_type(vk::SemaphoreType::TIMELINE)
            .initial_value(0);
        let info = vk::SemaphoreCreateInfo::default().push_next(&mut kind);
        // SAFETY: the device is alive.
        let raw = unsafe { context.raw.create_semaphore(&info, None) }
            .map_err(vk_error("vkCreateSemaphore"))?;
        Ok(Timeline { raw, context: context.clone() })
    }

    /// Submits recorded commands to the queue; the timeline reaches `value` when they are done. The
    /// commands begin after all `waits` are reached; the `signals` are signalled together with the
    /// timeline.
    pub(crate) fn submit(
        &self,
        slot: &mut CommandSlot,
        value: u64,
        waits: &[SemaphorePoint],
        signals: &[SemaphorePoint],
    ) -> Result<()> {
        let info = |point: &SemaphorePoint| {
            vk::SemaphoreSubmitInfo::default()
                .semaphore(point.semaphore)
                .value(point.value)
                .stage_mask(vk::PipelineStageFlags2::ALL_COMMANDS)
        };
        let own = SemaphorePoint { semaphore: self.raw, value };
        slot.waits.clear();
        slot.waits.extend(waits.iter().map(info));
        slot.signals.clear();
        slot.signals.extend(signals.iter().chain([&own]).map(info));
        let commands = [vk::CommandBufferSubmitInfo::default().command_buffer(slot.buffer)];
        let submit = [vk::SubmitInfo2::default()
            .command_buffer_infos(&commands)
            .wait_semaphore_infos(&slot.waits)
            .signal_semaphore_infos(&slot.signals)];
        self.context.queue.with(|queue| {
            // SAFETY: `with` gives exclusive use of the queue for the call; the stream keeps what
            // the commands use alive until the timeline reaches `value`; a host's semaphores live
            // as long as `Stream::submit_between` requires.
            unsafe { self.context.raw.queue_submit2(queue, &submit, vk::Fence::null()) }
                .map_err(vk_error("vkQueueSubmit2"))
        })
    }

    /// The semaphore, for a host to wait for.
    pub(crate) fn semaphore(&self) -> vk::Semaphore {
        self.raw
    }

    /// The value reached so far.
    pub(crate) fn reached(&self) -> Result<u64> {
        // SAFETY: the semaphore is alive.
        unsafe { self.context.raw.get_semaphore_counter_value(self.raw) }
            .map_err(vk_error("vkGetSemaphoreCounterValue"))
    }

    /// Blocks until `value` is reached. It does not spin, since that would take a core from a
    /// software driver.
    pub(crate) fn wait(&self, value: u64) -> Result<()> {
        let semaphores = [self.raw];
        let values = [value];
        let info = vk::SemaphoreWaitInfo::default().semaphores(&semaphores).values(&values);
        // SAFETY: the semaphore is alive.
        unsafe { self.context.raw.wait_semaphores(&info, u64::MAX) }
            .map_err(vk_error("vkWaitSemaphores"))
    }
}

impl Drop for Timeline {
    fn drop(&mut self) {
        // SAFETY: the stream waits for its last submission before it drops the timeline.
        unsafe { self.context.raw.destroy_semaphore(self.raw, None) };
    }
}

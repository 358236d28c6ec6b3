//! The timeline semaphore and the queue behind a stream.

use super::command::CommandSlot;
use super::device::Context;
use super::vk_error;
use crate::error::Result;
use ash::vk;
use std::sync::Arc;

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

    /// Hands recorded commands to the queue; the timeline reaches `value` when they are done.
    pub(crate) fn submit(&self, slot: &CommandSlot, value: u64) -> Result<()> {
        let commands = [vk::CommandBufferSubmitInfo::default().command_buffer(slot.buffer)];
        let signals = [vk::SemaphoreSubmitInfo::default()
            .semaphore(self.raw)
            .value(value)
            .stage_mask(vk::PipelineStageFlags2::ALL_COMMANDS)];
        let submit = [vk::SubmitInfo2::default()
            .command_buffer_infos(&commands)
            .signal_semaphore_infos(&signals)];
        let queue = self.context.queue.lock().expect("no holder panics");
        // SAFETY: the lock gives exclusive use of the queue; what the commands use is kept alive by
        // the stream until the timeline passes `value`.
        unsafe { self.context.raw.queue_submit2(*queue, &submit, vk::Fence::null()) }
            .map_err(vk_error("vkQueueSubmit2"))
    }

    /// The value reached so far.
    pub(crate) fn reached(&self) -> Result<u64> {
        // SAFETY: the semaphore is alive.
        unsafe { self.context.raw.get_semaphore_counter_value(self.raw) }
            .map_err(vk_error("vkGetSemaphoreCounterValue"))
    }

    /// Blocks (a spinning wait would take a core from a software driver) until `value` is reached.
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

//! Command buffers with their descriptor pools and timestamp queries.

use super::buffer::RawBuffer;
use super::device::Context;
use super::foreign::HostImage;
use super::pipeline::Pipeline;
use super::vk_error;
use crate::error::Result;
use ash::vk;
use std::sync::Arc;

const SETS_PER_POOL: u32 = 256;
const DESCRIPTORS_PER_SET: u32 = 16;
const TIMESTAMPS: u32 = 2048;
/// The queries for the start and the end of a metered recording; they follow those of `timestamp`.
const SPAN: [u32; 2] = [TIMESTAMPS, TIMESTAMPS + 1];

/// A part of a buffer bound to a kernel; opaque outside the crate.
#[derive(Clone)]
pub struct BoundRange {
    pub(crate) buffer: Arc<RawBuffer>,
    pub(crate) offset: u64,
    pub(crate) bytes: u64,
}

/// A command buffer with the descriptor and query pools of its recording; recycled once the device
/// is done.
pub(crate) struct CommandSlot {
    pub(super) buffer: vk::CommandBuffer,
    /// Null if the command buffers belong to a host.
    pool: vk::CommandPool,
    descriptor_pools: Vec<vk::DescriptorPool>,
    current_pool: usize,
    queries: vk::QueryPool,
    timestamps: u32,
    /// Whether this recording has reset the queries.
    queries_reset: bool,
    /// Scratch lists, kept to reuse their memory: the bindings of a dispatch, the waits and signals
    /// of a submission.
    infos: Vec<vk::DescriptorBufferInfo>,
    pub(super) waits: Vec<vk::SemaphoreSubmitInfo<'static>>,
    pub(super) signals: Vec<vk::SemaphoreSubmitInfo<'static>>,
    context: Arc<Context>,
}

impl CommandSlot {
    /// A slot for command buffers of a host.
    pub(crate) fn without_buffer(context: &Arc<Context>) -> CommandSlot {
        CommandSlot {
            buffer: vk::CommandBuffer::null(),
            pool: vk::CommandPool::null(),
            descriptor_pools: Vec::new(),
            current_pool: 0,
            queries: vk::QueryPool::null(),
            timestamps: 0,
            queries_reset: false,
            infos: Vec::new(),
            waits: Vec::new(),
            signals: Vec::new(),
            context: context.clone(),
        }
    }

    pub(crate) fn new(context: &Arc<Context>) -> Result<CommandSlot> {
        let device = &context.raw;
        let mut slot = CommandSlot::without_buffer(context);
        let info = vk::CommandPoolCreateInfo::default().queue_family_index(context.family);
        // SAFETY: here and below the device is alive and the infos point at locals.
        slot.pool = unsafe { device.create_command_pool(&info, None) }
            .map_err(vk_error("vkCreateCommandPool"))?;
        let info = vk::CommandBufferAllocateInfo::default()
            .command_pool(slot.pool)
            .level(vk::CommandBufferLevel::PRIMARY)
            .command_buffer_count(1);
        // SAFETY: as above.
        slot.buffer = unsafe { device.allocate_command_buffers(&info) }
            .map_err(vk_error("vkAllocateCommandBuffers"))?[0];
        context.count_object();
        Ok(slot)
    }

    /// Starts a recording and resets the pools of the previous one.
    pub(crate) fn begin(&mut self) -> Result<()> {
        let device = &self.context.raw;
        let info = vk::CommandBufferBeginInfo::default()
            .flags(vk::CommandBufferUsageFlags::ONE_TIME_SUBMIT);
        // SAFETY: the device is done with the slot's last submission, and `&mut` excludes others.
        unsafe {
            device
                .reset_command_pool(self.pool, vk::CommandPoolResetFlags::empty())
                .map_err(vk_error("vkResetCommandPool"))?;
            device
                .begin_command_buffer(self.buffer, &info)
                .map_err(vk_error("vkBeginCommandBuffer"))?;
        }
        self.reuse()
    }

    /// Starts a recording into a host's command buffer, which the host has begun and will end.
    pub(crate) fn begin_over(&mut self, buffer: vk::CommandBuffer) -> Result<()> {
        self.buffer = buffer;
        self.reuse()?;
        self.host_barrier();
        Ok(())
    }

    /// Whether it records into a host's command buffers.
    pub(crate) fn is_over(&self) -> bool {
        self.pool == vk::CommandPool::null()
    }

    /// Resets the pools that the previous recording used.
    fn reuse(&mut self) -> Result<()> {
        for &pool in &self.descriptor_pools {
            // SAFETY: the device is done with the slot's last recording, and `&mut` excludes others.
            unsafe {
                self.context.raw.reset_descriptor_pool(pool, vk::DescriptorPoolResetFlags::empty())
            }
            .map_err(vk_error("vkResetDescriptorPool"))?;
        }
        self.current_pool = 0;
        self.timestamps = 0;
        self.queries_reset = false;
        Ok(())
    }

    pub(crate) fn end(&mut self) -> Result<()> {
        // SAFETY: `begin` was called; `&mut` excludes others.
        unsafe { self.context.raw.end_command_buffer(self.buffer) }
            .map_err(vk_error("vkEndCommandBuffer"))
    }

    /// Binds pipeline, buffers and parameters of the next dispatch.
    pub(crate) fn bind(
        &mut self,
        pipeline: &Pipeline,
        ranges: &[BoundRange],
        params: &[u8],
    ) -> Result<()> {
        if !ranges.is_empty() {
            let set = self.descriptor_set(pipeline.set_layout)?;
            self.infos.clear();
            self.infos.extend(ranges.iter().map(|range| vk::DescriptorBufferInfo {
                buffer: range.buffer.raw,
                offset: range.offset,
                range: range.bytes,
            }));
            let device = &self.context.raw;
            // SAFETY: the template reads as many infos as the kernel has bindings, which is
            // `ranges.len()`; the set is fresh.
            unsafe {
                device.update_descriptor_set_with_template(
                    set,
                    pipeline.template,
                    self.infos.as_ptr().cast(),
                );
                device.cmd_bind_descriptor_sets(
                    self.buffer,
                    vk::PipelineBindPoint::COMPUTE,
                    pipeline.layout,
                    0,
                    &[set],
                    &[],
                );
            }
        }
        let device = &self.context.raw;
        // SAFETY: recording; the recorder keeps the pipeline alive until the submission retires.
        unsafe {
            device.cmd_bind_pipeline(self.buffer, vk::PipelineBindPoint::COMPUTE, pipeline.raw);
            if !params.is_empty() {
                device.cmd_push_constants(
                    self.buffer,
                    pipeline.layout,
                    vk::ShaderStageFlags::COMPUTE,
                    0,
                    params,
                );
            }
        }
        Ok(())
    }

    pub(crate) fn dispatch(&mut self, groups: [u32; 3]) {
        // SAFETY: recording, after `bind`.
        unsafe { self.context.raw.cmd_dispatch(self.buffer, groups[0], groups[1], groups[2]) };
    }

    pub(crate) fn dispatch_indirect(&mut self, arguments: &RawBuffer, offset: u64) {
        // SAFETY: recording, after `bind`; the recorder checked that three words lie at `offset`.
        unsafe { self.context.raw.cmd_dispatch_indirect(self.buffer, arguments.raw, offset) };
    }

    /// A barrier: all earlier commands finish, and their writes are visible to all later commands.
    pub(crate) fn barrier(&mut self) {
        let stages = vk::PipelineStageFlags2::COMPUTE_SHADER
            | vk::PipelineStageFlags2::ALL_TRANSFER
            | vk::PipelineStageFlags2::DRAW_INDIRECT;
        let barriers = [vk::MemoryBarrier2::default()
            .src_stage_mask(stages)
            .src_access_mask(vk::AccessFlags2::SHADER_WRITE | vk::AccessFlags2::TRANSFER_WRITE)
            .dst_stage_mask(stages | vk::PipelineStageFlags2::HOST)
            .dst_access_mask(
                vk::AccessFlags2::SHADER_READ
                    | vk::AccessFlags2::SHADER_WRITE
                    | vk::AccessFlags2::TRANSFER_READ
                    | vk::AccessFlags2::TRANSFER_WRITE
                    | vk::AccessFlags2::INDIRECT_COMMAND_READ
                    | vk::AccessFlags2::HOST_READ,
            )];
        let info = vk::DependencyInfo::default().memory_barriers(&barriers);
        // SAFETY: recording.
        unsafe { self.context.raw.cmd_pipeline_barrier2(self.buffer, &info) };
    }

    /// A barrier between the host's commands and the engine's, over all stages: everything recorded
    /// before finishes and is visible to everything recorded after.
    pub(crate) fn host_barrier(&mut self) {
        let barriers = [vk::MemoryBarrier2::default()
            .src_stage_mask(vk::PipelineStageFlags2::ALL_COMMANDS)
            .src_access_mask(vk::AccessFlags2::MEMORY_WRITE)
            .dst_stage_mask(vk::PipelineStageFlags2::ALL_COMMANDS | vk::PipelineStageFlags2::HOST)
            .dst_access_mask(
                vk::AccessFlags2::MEMORY_READ
                    | vk::AccessFlags2::MEMORY_WRITE
                    | vk::AccessFlags2::HOST_READ,
            )];
        let info = vk::DependencyInfo::default().memory_barriers(&barriers);
        // SAFETY: recording.
        unsafe { self.context.raw.cmd_pipeline_barrier2(self.buffer, &info) };
    }

    pub(crate) fn fill(&mut self, range: &BoundRange, word: u32) {
        // SAFETY: recording; ranges lie within their buffers and are multiples of four bytes.
        unsafe {
            self.context.raw.cmd_fill_buffer(
                self.buffer,
                range.buffer.raw,
                range.offset,
                range.bytes,
                word,
            )
        };
    }

    pub(crate) fn copy(&mut self, from: &BoundRange, to: &BoundRange) {
        let region = [vk::BufferCopy {
            src_offset: from.offset,
            dst_offset: to.offset,
            size: from.bytes.min(to.bytes),
        }];
        // SAFETY: recording; ranges lie within their buffers, and the recorder excludes overlap.
        unsafe {
            self.context.raw.cmd_copy_buffer(self.buffer, from.buffer.raw, to.buffer.raw, &region)
        };
    }

    /// Copies rows of texels, without gaps, into a host's image.
    pub(crate) fn copy_to_image(&mut self, from: &BoundRange, to: &HostImage, size: [u32; 2]) {
        let region = [vk::BufferImageCopy::default()
            .buffer_offset(from.offset)
            .image_subresource(
                vk::ImageSubresourceLayers::default()
                    .aspect_mask(vk::ImageAspectFlags::COLOR)
                    .mip_level(to.mip_level)
                    .base_array_layer(to.array_layer)
                    .layer_count(1),
            )
            .image_offset(vk::Offset3D { x: to.offset[0] as i32, y: to.offset[1] as i32, z: 0 })
            .image_extent(vk::Extent3D { width: size[0], height: size[1], depth: 1 })];
        // SAFETY: recording; the range holds all texels; the image satisfies the contract of
        // `Recorder::copy_to_image`.
        unsafe {
            self.context.raw.cmd_copy_buffer_to_image(
                self.buffer,
                from.buffer.raw,
                to.image,
                to.layout,
                &region,
            )
        };
    }

    /// Writes data that is stored inside the command buffer (64 KiB at most).
    pub(crate) fn update(&mut self, to: &BoundRange, bytes: &[u8]) {
        // SAFETY: recording; the recorder checked size and alignment.
        unsafe { self.context.raw.cmd_update_buffer(self.buffer, to.buffer.raw, to.offset, bytes) };
    }

    /// Writes a timestamp after all earlier commands; returns false when no query is left.
    pub(crate) fn timestamp(&mut self) -> Result<bool> {
        if self.timestamps == TIMESTAMPS {
            return Ok(false);
        }
        self.stamp(self.timestamps)?;
        self.timestamps += 1;
        Ok(true)
    }

    /// Marks the start (0) or the end (1) of the span that [`read_span`](Self::read_span) measures.
    pub(crate) fn span(&mut self, end: usize) -> Result<()> {
        self.stamp(SPAN[end])
    }

    fn stamp(&mut self, query: u32) -> Result<()> {
        let device = &self.context.raw;
        if self.queries == vk::QueryPool::null() {
            let info = vk::QueryPoolCreateInfo::default()
                .query_type(vk::QueryType::TIMESTAMP)
                .query_count(TIMESTAMPS + SPAN.len() as u32);
            // SAFETY: the device is alive.
            self.queries = unsafe { device.create_query_pool(&info, None) }
                .map_err(vk_error("vkCreateQueryPool"))?;
            self.context.count_object();
        }
        // SAFETY: recording, outside of any render pass; the query was not written yet.
        unsafe {
            if !self.queries_reset {
                let count = TIMESTAMPS + SPAN.len() as u32;
                device.cmd_reset_query_pool(self.buffer, self.queries, 0, count);
                self.queries_reset = true;
            }
            device.cmd_write_timestamp2(
                self.buffer,
                vk::PipelineStageFlags2::ALL_COMMANDS,
                self.queries,
                query,
            );
        }
        Ok(())
    }

    /// The timestamps written, in ticks. Call it only after the submission is done.
    pub(crate) fn read_timestamps(&self) -> Result<Vec<u64>> {
        let mut ticks = vec![0u64; self.timestamps as usize];
        self.read_queries(0, &mut ticks, vk::QueryResultFlags::WAIT)?;
        Ok(ticks)
    }

    /// The timestamps written, or an error if the device is not done. It does not wait, since a
    /// host may never submit the commands.
    pub(crate) fn try_timestamps(&self) -> Result<Vec<u64>> {
        let mut ticks = vec![0u64; self.timestamps as usize];
        self.read_queries(0, &mut ticks, vk::QueryResultFlags::empty())?;
        Ok(ticks)
    }

    /// Ticks between the two marks of the span. Call it only after the submission is done.
    pub(crate) fn read_span(&self) -> Result<u64> {
        let mut ticks = [0u64; 2];
        self.read_queries(SPAN[0], &mut ticks, vk::QueryResultFlags::WAIT)?;
        Ok(ticks[1].wrapping_sub(ticks[0]))
    }

    fn read_queries(
        &self,
        first: u32,
        ticks: &mut [u64],
        flags: vk::QueryResultFlags,
    ) -> Result<()> {
        if ticks.is_empty() {
            return Ok(());
        }
        let flags = vk::QueryResultFlags::TYPE_64 | flags;
        // SAFETY: the pool is alive and the queries were written.
        unsafe { self.context.raw.get_query_pool_results(self.queries, first, ticks, flags) }
            .map_err(vk_error("vkGetQueryPoolResults"))
    }

    fn descriptor_set(&mut self, layout: vk::DescriptorSetLayout) -> Result<vk::DescriptorSet> {
        let device = &self.context.raw;
        let layouts = [layout];
        loop {
            if let Some(&pool) = self.descriptor_pools.get(self.current_pool) {
                let info = vk::DescriptorSetAllocateInfo::default()
                    .descriptor_pool(pool)
                    .set_layouts(&layouts);
                let mut set = vk::DescriptorSet::null();
                // Called without `ash`'s wrapper, which allocates a vector.
                let allocate = device.fp_v1_0().allocate_descriptor_sets;
                // SAFETY: `&mut` gives exclusive use of the pool; the output has capacity for one
                // set.
                match unsafe { allocate(device.handle(), &info, &mut set) } {
                    vk::Result::SUCCESS => return Ok(set),
                    vk::Result::ERROR_OUT_OF_POOL_MEMORY | vk::Result::ERROR_FRAGMENTED_POOL => {
                        self.current_pool += 1;
                    }
                    result => return Err(vk_error("vkAllocateDescriptorSets")(result)),
                }
            } else {
                let sizes = [vk::DescriptorPoolSize::default()
                    .ty(vk::DescriptorType::STORAGE_BUFFER)
                    .descriptor_count(SETS_PER_POOL * DESCRIPTORS_PER_SET)];
                let info = vk::DescriptorPoolCreateInfo::default()
                    .max_sets(SETS_PER_POOL)
                    .pool_sizes(&sizes);
                // SAFETY: the device is alive.
                let pool = unsafe { device.create_descriptor_pool(&info, None) }
                    .map_err(vk_error("vkCreateDescriptorPool"))?;
                self.descriptor_pools.push(pool);
                self.context.count_object();
            }
        }
    }
}

impl Drop for CommandSlot {
    fn drop(&mut self) {
        let device = &self.context.raw;
        // SAFETY: the stream drops a slot only after the device is done with it.
        unsafe {
            for &pool in &self.descriptor_pools {
                device.destroy_descriptor_pool(pool, None);
            }
            device.destroy_query_pool(self.queries, None);
            device.destroy_command_pool(self.pool, None);
        }
    }
}

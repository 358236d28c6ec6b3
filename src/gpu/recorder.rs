//! Records dispatches and copies and inserts the memory barriers between them.

use super::buffer::{Buffer, Readback, View, ViewMut};
use super::device::Device;
use super::kernel::{Access, Constants, Groups, Kernel};
use crate::error::{Error, Result};
use crate::vk::{BoundRange, CommandSlot, HostImage, Pipeline, RawBuffer};
use bytemuck::Pod;
use std::sync::Arc;

/// Records dispatches and copies into one command buffer.
///
/// The recorder tracks the ranges that were read and written since the last barrier. It inserts one
/// global memory barrier before work that reads or writes a written range, or writes a range that
/// was read.
pub struct Recorder {
    pub(super) device: Device,
    pub(super) work: Work,
    /// Names of the kernels between the timestamps; `None` unless profiling.
    pub(super) profile: Option<Vec<&'static str>>,
    /// Whether the device's meter counts this recording.
    pub(super) metered: bool,
    /// The first error of a method that returns no `Result`; submitting returns it.
    pub(super) failed: Option<Error>,
}

/// A command buffer, references that keep the resources it uses alive, and scratch lists for
/// recording. It is recycled when the device is done, so that repeated recordings allocate nothing.
pub(crate) struct Work {
    pub(crate) slot: CommandSlot,
    buffers: Vec<Arc<RawBuffer>>,
    pipelines: Vec<Arc<Pipeline>>,
    /// Ranges accessed since the last barrier.
    touched: Vec<Touched>,
    /// Bound ranges of the dispatch being recorded.
    ranges: Vec<BoundRange>,
}

impl Work {
    pub(crate) fn new(slot: CommandSlot) -> Work {
        let (buffers, pipelines, touched, ranges) = Default::default();
        Work { slot, buffers, pipelines, touched, ranges }
    }

    /// Drops the references to the resources of the recording; the device must be done with it.
    pub(crate) fn clear(&mut self) {
        self.buffers.clear();
        self.pipelines.clear();
        self.touched.clear();
        self.ranges.clear();
    }

    /// The last kernel recorded.
    pub(super) fn last_kernel(&self) -> Option<&'static str> {
        self.pipelines.last().map(|pipeline| pipeline.name)
    }
}

struct Touched {
    buffer: u64,
    start: u64,
    end: u64,
    written: bool,
}

/// Vulkan's limit for data inside a command buffer.
const UPDATE_BYTES: usize = 65_536;

impl Recorder {
    pub(super) fn new(device: &Device, mut work: Work, metered: bool) -> Result<Recorder> {
        work.slot.begin()?;
        if metered {
            work.slot.span(0)?;
        }
        Ok(Recorder::of(device, work, metered))
    }

    /// A recorder for a command buffer that is already in the recording state.
    pub(crate) fn of(device: &Device, work: Work, metered: bool) -> Recorder {
        Recorder { device: device.clone(), work, profile: None, metered, failed: None }
    }

    /// The parts of a finished recording into a host's command buffer, or the error of the
    /// recording.
    pub(crate) fn into_parts(self) -> Result<(Device, Work, Option<Vec<&'static str>>)> {
        match self.failed {
            Some(error) => Err(error),
            None => Ok((self.device, self.work, self.profile)),
        }
    }

    /// Whether the range belongs to this device; if not, marks the recording as failed.
    fn owns(&mut self, range: &BoundRange, op: &'static str) -> bool {
        let owned = self.device.owns(&range.buffer);
        if !owned && self.failed.is_none() {
            self.failed = Some(foreign_buffer(op, &range.buffer.label));
        }
        owned
    }

    /// The device that the work is recorded for.
    pub fn device(&self) -> &Device {
        &self.device
    }

    /// Writes a timestamp around every dispatch from here on;
    /// [`Stream::times`](super::Stream::times) returns the times.
    ///
    /// # Errors
    /// A failed Vulkan call.
    pub fn profile(&mut self) -> Result<()> {
        if self.device.limits().timestamp_period > 0.0 && self.work.slot.timestamp()? {
            self.profile = Some(Vec::new());
        }
        Ok(())
    }

    /// Records one dispatch of a kernel without specialisation constants. An empty grid records
    /// nothing.
    ///
    /// # Errors
    /// [`Error::RangeLimit`] for a binding larger than the device allows, or a failed Vulkan call.
    pub fn dispatch<K: Kernel<Constants = ()>>(
        &mut self,
        groups: Groups,
        params: K::Params,
        args: K::Args<'_>,
    ) -> Result<()> {
        self.dispatch_specialised::<K>((), groups, params, args)
    }

    /// [`dispatch`](Self::dispatch) of a kernel with specialisation constants.
    ///
    /// ```
    /// use splat4d::gpu::{Groups, Recorder};
    /// use splat4d::kernels::deform::{Nearest, NearestArgs, NearestConstants, NearestParams};
    ///
    /// fn three(recorder: &mut Recorder, params: NearestParams, args: NearestArgs) -> splat4d::Result<()> {
    ///     let constants = NearestConstants { k: 3 };
    ///     recorder.dispatch_specialised::<Nearest>(constants, Groups([1, 1, 1]), params, args)
    /// }
    /// ```
    ///
    /// A kernel with constants needs them:
    ///
    /// ```compile_fail
    /// use splat4d::gpu::{Groups, Recorder};
    /// use splat4d::kernels::deform::{Nearest, NearestArgs, NearestParams};
    ///
    /// fn some(recorder: &mut Recorder, params: NearestParams, args: NearestArgs) -> splat4d::Result<()> {
    ///     recorder.dispatch::<Nearest>(Groups([1, 1, 1]), params, args)
    /// }
    /// ```
    ///
    /// and one without takes none:
    ///
    /// ```compile_fail
    /// use splat4d::gpu::{Groups, Recorder};
    /// use splat4d::kernels::deform::{Keys, KeysArgs, KeysParams, NearestConstants};
    ///
    /// fn keys(recorder: &mut Recorder, params: KeysParams, args: KeysArgs) -> splat4d::Result<()> {
    ///     let constants = NearestConstants { k: 3 };
    ///     recorder.dispatch_specialised::<Keys>(constants, Groups([1, 1, 1]), params, args)
    /// }
    /// ```
    ///
    /// # Errors
    /// As for `dispatch`.
    pub fn dispatch_specialised<K: Kernel>(
        &mut self,
        constants: K::Constants,
        groups: Groups,
        params: K::Params,
        args: K::Args<'_>,
    ) -> Result<()> {
        if groups.is_empty() {
            return Ok(());
        }
        if self.prepare::<K>(constants, &params, &args, None)? {
            self.work.slot.dispatch(groups.0);
            self.finish_dispatch(K::NAME)?;
        }
        Ok(())
    }

    /// Records one dispatch of a kernel without specialisation constants, whose grid the device reads
    /// from three words at `arguments[at..]`.
    ///
    /// # Errors
    /// [`Error::Shape`] when fewer than three words are left at `at`; else as for `dispatch`.
    pub fn dispatch_indirect<K: Kernel<Constants = ()>>(
        &mut self,
        arguments: &Buffer<u32>,
        at: usize,
        params: K::Params,
        args: K::Args<'_>,
    ) -> Result<()> {
        self.dispatch_indirect_specialised::<K>((), arguments, at, params, args)
    }

    /// [`dispatch_indirect`](Self::dispatch_indirect) of a kernel with specialisation constants.
    ///
    /// # Errors
    /// As for `dispatch_indirect`.
    pub fn dispatch_indirect_specialised<K: Kernel>(
        &mut self,
        constants: K::Constants,
        arguments: &Buffer<u32>,
        at: usize,
        params: K::Params,
        args: K::Args<'_>,
    ) -> Result<()> {
        if at + 3 > arguments.len() {
            return Err(Error::Shape {
                op: K::NAME,
                arg: "arguments",
                expected: format!("at least {}", at + 3),
                actual: arguments.len(),
            });
        }
        let range = arguments.range(at..at + 3).bound();
        if !range.buffer.is_indirect() {
            return Err(Error::Input(format!(
                "{}: the grid lies in {}, a host's buffer without the usage INDIRECT_BUFFER",
                K::NAME,
                arguments.label()
            )));
        }
        if self.prepare::<K>(constants, &params, &args, Some(&range))? {
            self.work.slot.dispatch_indirect(&range.buffer, range.offset);
            self.finish_dispatch(K::NAME)?;
        }
        Ok(())
    }

    /// Fills a buffer with one word.
    pub fn fill<T: Pod>(&mut self, to: ViewMut<'_, T>, word: u32) {
        if to.is_empty() {
            return;
        }
        let range = to.bound();
        if !self.owns(&range, "fill") || self.device.is_rehearsing() {
            return;
        }
        self.touch([(&range, true)]);
        self.work.slot.fill(&range, word);
        self.work.buffers.push(range.buffer);
    }

    /// Copies between buffers. If the lengths differ, the recording has failed and submitting it
    /// returns [`Error::Shape`].
    pub fn copy<T: Pod>(&mut self, from: View<'_, T>, to: ViewMut<'_, T>) {
        if self.is_of_one_length("copy", from.len(), to.len()) {
            self.copy_ranges(&from.bound(), &to.bound());
        }
    }

    /// Copies to host memory. If the lengths differ, the recording has failed, as for
    /// [`copy`](Self::copy).
    pub fn read_back<T: Pod>(&mut self, from: View<'_, T>, to: &Readback<T>) {
        if self.is_of_one_length("read back", from.len(), to.len()) {
            self.copy_ranges(&from.bound(), &to.bound());
        }
    }

    /// Whether both lengths are equal and not zero; if they differ, marks the recording as failed.
    fn is_of_one_length(&mut self, op: &'static str, from: usize, to: usize) -> bool {
        if from != to && self.failed.is_none() {
            let expected = format!("{from}, as many as are copied");
            self.failed = Some(Error::Shape { op, arg: "the target", expected, actual: to });
        }
        from == to && from > 0
    }

    pub(super) fn copy_ranges(&mut self, from: &BoundRange, to: &BoundRange) {
        if !(self.owns(from, "copy") && self.owns(to, "copy")) || self.device.is_rehearsing() {
            return;
        }
        self.touch([(from, false), (to, true)]);
        self.work.slot.copy(from, to);
        self.work.buffers.extend([from.buffer.clone(), to.buffer.clone()]);
    }

    /// Copies rows of texels into a host's image.
    pub(crate) fn copy_picture(&mut self, from: &BoundRange, to: &HostImage, size: [u32; 2]) {
        if !self.owns(from, "copy to image") {
            return;
        }
        self.touch([(from, false)]);
        self.work.slot.copy_to_image(from, to, size);
        self.work.buffers.push(from.buffer.clone());
    }

    /// Writes data of at most 64 KiB from the host, in order with the rest of the recording. Larger
    /// data needs [`Stream::upload`](super::Stream::upload).
    ///
    /// # Errors
    /// [`Error::Shape`] when it is too long for `to` or for a command buffer.
    pub fn update<T: Pod>(&mut self, to: ViewMut<'_, T>, data: &[T]) -> Result<()> {
        let bytes: &[u8] = bytemuck::cast_slice(data);
        if data.len() > to.len() || bytes.len() > UPDATE_BYTES || !bytes.len().is_multiple_of(4) {
            return Err(Error::Shape {
                op: "update",
                arg: "data",
                expected: format!("at most {} (64 KiB, whole words)", to.len()),
                actual: data.len(),
            });
        }
        if bytes.is_empty() {
            return Ok(());
        }
        let range = to.bound();
        if !self.owns(&range, "update") {
            return Err(foreign_buffer("update", &range.buffer.label));
        }
        if self.device.is_rehearsing() {
            return Ok(());
        }
        self.touch([(&range, true)]);
        self.work.slot.update(&range, bytes);
        self.work.buffers.push(range.buffer);
        Ok(())
    }

    /// Checks the bindings and binds them. Returns false in a rehearsal, which dispatches nothing.
    fn prepare<K: Kernel>(
        &mut self,
        constants: K::Constants,
        params: &K::Params,
        args: &K::Args<'_>,
        arguments: Option<&BoundRange>,
    ) -> Result<bool> {
        let Work { slot, buffers, pipelines, touched, ranges } = &mut self.work;
        ranges.clear();
        K::bind(args, ranges);
        let limits = self.device.limits();
        if let Some(range) =
            ranges.iter().chain(arguments).find(|range| !self.device.owns(&range.buffer))
        {
            return Err(foreign_buffer(K::NAME, &range.buffer.label));
        }
        for (range, binding) in ranges.iter().zip(K::BINDINGS) {
            if range.bytes > limits.storage_range {
                return Err(Error::RangeLimit {
                    label: format!("{}.{} ({})", K::NAME, binding.name, range.buffer.label),
                    bytes: range.bytes,
                    limit: limits.storage_range,
                });
            }
            if !range.offset.is_multiple_of(limits.storage_alignment) {
                return Err(Error::Shape {
                    op: K::NAME,
                    arg: binding.name,
                    expected: format!("a multiple of {} bytes as offset", limits.storage_alignment),
                    actual: range.offset as usize,
                });
            }
        }
        if self.device.is_rehearsing() {
            return Ok(false);
        }
        let constants = constants.words();
        let pipeline = self.device.pipeline::<K>(constants.as_ref())?;
        self.device.trace(K::NAME, constants.as_ref());
        let bound = ranges
            .iter()
            .zip(K::BINDINGS)
            .map(|(range, binding)| (range, binding.access != Access::Read));
        touch(touched, slot, bound.chain(arguments.map(|range| (range, false))));
        slot.bind(&pipeline, ranges, bytemuck::bytes_of(params))?;
        buffers.extend(arguments.map(|range| range.buffer.clone()));
        buffers.extend(ranges.drain(..).map(|range| range.buffer));
        pipelines.push(pipeline);
        Ok(true)
    }

    fn finish_dispatch(&mut self, name: &'static str) -> Result<()> {
        if let Some(names) = &mut self.profile
            && self.work.slot.timestamp()?
        {
            names.push(name);
        }
        Ok(())
    }

    /// Tracks the access to one or two ranges; `true` means written.
    pub(super) fn touch<const N: usize>(&mut self, touches: [(&BoundRange, bool); N]) {
        touch(&mut self.work.touched, &mut self.work.slot, touches.into_iter());
    }
}

/// The error for a buffer of one device in a recording of another.
fn foreign_buffer(op: &'static str, label: &str) -> Error {
    Error::Input(format!("{op}: {label} was made on another device than the recording is for"))
}

/// Tracks the accesses of the next command, after a barrier if they conflict with earlier ones.
fn touch<'a>(
    touched: &mut Vec<Touched>,
    slot: &mut CommandSlot,
    touches: impl Iterator<Item = (&'a BoundRange, bool)> + Clone,
) {
    let conflict = |before: &Touched| {
        touches.clone().any(|(range, written)| {
            before.buffer == range.buffer.id()
                && (before.written || written)
                && before.start < range.offset + range.bytes
                && range.offset < before.end
        })
    };
    if touched.iter().any(conflict) {
        slot.barrier();
        touched.clear();
    }
    touched.extend(touches.map(|(range, written)| Touched {
        buffer: range.buffer.id(),
        start: range.offset,
        end: range.offset + range.bytes,
        written,
    }));
}

//! Recording work, with barriers where they are needed.

use super::buffer::{Buffer, Readback, View, ViewMut};
use super::device::Device;
use super::kernel::{Access, Groups, Kernel};
use crate::error::{Error, Result};
use crate::vk::{BoundRange, CommandSlot, Pipeline, RawBuffer};
use bytemuck::Pod;
use std::sync::Arc;

/// Records dispatches and copies into one command buffer.
///
/// The recorder knows which ranges were read and written since the last barrier; work that touches
/// what another has written, or writes what another has read, gets one global memory barrier first.
pub struct Recorder {
    pub(super) device: Device,
    pub(super) slot: CommandSlot,
    pub(super) buffers: Vec<Arc<RawBuffer>>,
    pub(super) pipelines: Vec<Arc<Pipeline>>,
    /// Kernels between the timestamps, when profiling.
    pub(super) profile: Option<Vec<&'static str>>,
    /// Whether the device's meter counts it.
    pub(super) metered: bool,
    touched: Vec<Touched>,
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
    pub(super) fn new(device: &Device, mut slot: CommandSlot, metered: bool) -> Result<Recorder> {
        slot.begin()?;
        if metered {
            slot.span(0)?;
        }
        Ok(Recorder {
            device: device.clone(),
            slot,
            buffers: Vec::new(),
            pipelines: Vec::new(),
            profile: None,
            metered,
            touched: Vec::new(),
        })
    }

    /// The device that the work is recorded for.
    pub fn device(&self) -> &Device {
        &self.device
    }

    /// Takes a timestamp around every dispatch from here on; the ticket gives the times.
    ///
    /// # Errors
    /// A failed Vulkan call.
    pub fn profile(&mut self) -> Result<()> {
        if self.device.limits().timestamp_period > 0.0 && self.slot.timestamp()? {
            self.profile = Some(Vec::new());
        }
        Ok(())
    }

    /// Records one dispatch. An empty grid records nothing.
    ///
    /// # Errors
    /// [`Error::RangeLimit`] for a binding larger than the device allows, or a failed Vulkan call.
    pub fn dispatch<K: Kernel>(
        &mut self,
        groups: Groups,
        params: K::Params,
        args: K::Args<'_>,
    ) -> Result<()> {
        self.dispatch_specialised::<K>(&[], groups, params, args)
    }

    /// [`dispatch`](Self::dispatch) with values for the specialisation constants 0, 1, …
    ///
    /// # Errors
    /// As for `dispatch`.
    pub fn dispatch_specialised<K: Kernel>(
        &mut self,
        specialisation: &[u32],
        groups: Groups,
        params: K::Params,
        args: K::Args<'_>,
    ) -> Result<()> {
        if groups.is_empty() {
            return Ok(());
        }
        self.prepare::<K>(specialisation, &params, &args, None)?;
        self.slot.dispatch(groups.0);
        self.finish_dispatch(K::NAME)
    }

    /// Records one dispatch whose grid the device reads from three words at `arguments[at..]`.
    ///
    /// # Errors
    /// [`Error::Shape`] when fewer than three words are left at `at`; else as for `dispatch`.
    pub fn dispatch_indirect<K: Kernel>(
        &mut self,
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
        self.prepare::<K>(&[], &params, &args, Some(&range))?;
        self.slot.dispatch_indirect(&range.buffer, range.offset);
        self.finish_dispatch(K::NAME)
    }

    /// Fills a buffer with one word.
    pub fn fill<T: Pod>(&mut self, to: ViewMut<'_, T>, word: u32) {
        if to.is_empty() {
            return;
        }
        let range = to.bound();
        self.touch(&[(&range, true)]);
        self.slot.fill(&range, word);
        self.buffers.push(range.buffer);
    }

    /// Copies between buffers; the shorter of the two decides how much.
    pub fn copy<T: Pod>(&mut self, from: View<'_, T>, to: ViewMut<'_, T>) {
        if from.is_empty() || to.is_empty() {
            return;
        }
        let (from, to) = (from.bound(), to.bound());
        self.copy_ranges(&from, &to);
    }

    /// Copies to host memory; the shorter of the two decides how much.
    pub fn read_back<T: Pod>(&mut self, from: View<'_, T>, to: &Readback<T>) {
        if !from.is_empty() {
            self.copy_ranges(&from.bound(), &to.bound());
        }
    }

    pub(super) fn copy_ranges(&mut self, from: &BoundRange, to: &BoundRange) {
        self.touch(&[(from, false), (to, true)]);
        self.slot.copy(from, to);
        self.buffers.extend([from.buffer.clone(), to.buffer.clone()]);
    }

    /// Writes a little data (64 KiB at most) from the host, in order with the rest of the
    /// recording; larger data goes through [`Stream::upload`](super::Stream::upload).
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
        self.touch(&[(&range, true)]);
        self.slot.update(&range, bytes);
        self.buffers.push(range.buffer);
        Ok(())
    }

    fn prepare<K: Kernel>(
        &mut self,
        specialisation: &[u32],
        params: &K::Params,
        args: &K::Args<'_>,
        arguments: Option<&BoundRange>,
    ) -> Result<()> {
        let pipeline = self.device.pipeline::<K>(specialisation)?;
        let ranges = K::bound(args);
        let limits = *self.device.limits();
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
        let mut touches: Vec<_> = ranges
            .iter()
            .zip(K::BINDINGS)
            .map(|(range, binding)| (range, binding.access != Access::Read))
            .collect();
        touches.extend(arguments.map(|range| (range, false)));
        self.touch(&touches);
        self.slot.bind(&pipeline, &ranges, bytemuck::bytes_of(params))?;
        self.buffers.extend(arguments.map(|range| range.buffer.clone()));
        self.buffers.extend(ranges.into_iter().map(|range| range.buffer));
        self.pipelines.push(pipeline);
        Ok(())
    }

    fn finish_dispatch(&mut self, name: &'static str) -> Result<()> {
        if let Some(names) = &mut self.profile
            && self.slot.timestamp()?
        {
            names.push(name);
        }
        Ok(())
    }

    /// Notes what comes next, with a barrier first where it conflicts with what came before.
    fn touch(&mut self, touches: &[(&BoundRange, bool)]) {
        let conflict = |touched: &Touched| {
            touches.iter().any(|(range, written)| {
                touched.buffer == range.buffer.id()
                    && (touched.written || *written)
                    && touched.start < range.offset + range.bytes
                    && range.offset < touched.end
            })
        };
        if self.touched.iter().any(conflict) {
            self.slot.barrier();
            self.touched.clear();
        }
        self.touched.extend(touches.iter().map(|(range, written)| Touched {
            buffer: range.buffer.id(),
            start: range.offset,
            end: range.offset + range.bytes,
            written: *written,
        }));
    }
}

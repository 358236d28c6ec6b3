//! Submissions in order, and what becomes of them.

use super::buffer::Buffer;
use super::device::Device;
use super::recorder::Recorder;
use crate::error::{Error, Result};
use crate::vk::{BoundRange, CommandSlot, Pipeline, RawBuffer, Residence, Timeline};
use bytemuck::Pod;
use std::collections::VecDeque;
use std::sync::Arc;

/// Submissions to the device's queue, one after the other, counted by a timeline semaphore.
///
/// Dropping a stream waits for what it has submitted.
pub struct Stream {
    device: Device,
    timeline: Timeline,
    submitted: u64,
    in_flight: VecDeque<InFlight>,
    idle: Vec<CommandSlot>,
    /// Reused for downloads, grown as needed.
    readback: Option<Arc<RawBuffer>>,
}

struct InFlight {
    value: u64,
    slot: CommandSlot,
    profile: Option<Vec<&'static str>>,
    metered: bool,
    last_kernel: Option<&'static str>,
    _buffers: Vec<Arc<RawBuffer>>,
    _pipelines: Vec<Arc<Pipeline>>,
}

/// A submission, to wait for.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Ticket(u64);

/// How long a dispatch took on the device.
#[derive(Clone, Copy, Debug)]
pub struct KernelTime {
    /// The kernel.
    pub kernel: &'static str,
    /// Nanoseconds from the end of what came before to its own end.
    pub nanoseconds: f64,
}

impl Stream {
    pub(super) fn new(device: &Device) -> Result<Stream> {
        Ok(Stream {
            timeline: Timeline::new(&device.inner.context)?,
            device: device.clone(),
            submitted: 0,
            in_flight: VecDeque::new(),
            idle: Vec::new(),
            readback: None,
        })
    }

    /// The device.
    pub fn device(&self) -> &Device {
        &self.device
    }

    /// Starts a recording.
    ///
    /// # Errors
    /// A failed Vulkan call.
    pub fn record(&mut self) -> Result<Recorder> {
        let metered = self.device.is_metered();
        self.recorder(metered)
    }

    fn recorder(&mut self, metered: bool) -> Result<Recorder> {
        self.collect()?;
        let slot = match self.idle.pop() {
            Some(slot) => slot,
            None => CommandSlot::new(&self.device.inner.context)?,
        };
        Recorder::new(&self.device, slot, metered)
    }

    /// Submits a recording; it runs after everything submitted before on this stream.
    ///
    /// # Errors
    /// A failed Vulkan call.
    pub fn submit(&mut self, mut recorder: Recorder) -> Result<Ticket> {
        // Submissions of one queue may overlap: this orders them, and lets the host read.
        recorder.slot.barrier();
        if recorder.metered {
            recorder.slot.span(1)?;
        }
        recorder.slot.end()?;
        let value = self.submitted + 1;
        let last_kernel = recorder.pipelines.last().map(|pipeline| pipeline.name);
        self.timeline
            .submit(&recorder.slot, value)
            .map_err(|error| name_lost(error, last_kernel))?;
        self.submitted = value;
        self.in_flight.push_back(InFlight {
            value,
            slot: recorder.slot,
            profile: recorder.profile,
            metered: recorder.metered,
            last_kernel,
            _buffers: recorder.buffers,
            _pipelines: recorder.pipelines,
        });
        Ok(Ticket(value))
    }

    /// Waits for a submission and everything before it.
    ///
    /// # Errors
    /// [`Error::DeviceLost`], or another failed Vulkan call.
    pub fn wait(&mut self, ticket: Ticket) -> Result<()> {
        let kernel = self.in_flight.front().and_then(|work| work.last_kernel);
        self.timeline.wait(ticket.0).map_err(|error| name_lost(error, kernel))?;
        self.collect()
    }

    /// Waits for a profiled submission and gives the time of each of its dispatches, in order.
    ///
    /// # Errors
    /// As for [`wait`](Self::wait); [`Error::Input`] when the submission was not profiled or has
    /// retired already.
    pub fn times(&mut self, ticket: Ticket) -> Result<Vec<KernelTime>> {
        self.timeline.wait(ticket.0)?;
        let work = self.in_flight.iter().find(|work| work.value == ticket.0);
        let (Some(work), period) = (work, self.device.limits().timestamp_period) else {
            return Err(Error::Input("the submission's times are gone: ask before waiting".into()));
        };
        let Some(names) = &work.profile else {
            return Err(Error::Input("the submission was not profiled".into()));
        };
        let ticks = work.slot.read_timestamps()?;
        let times = names.iter().zip(ticks.windows(2)).map(|(kernel, pair)| KernelTime {
            kernel,
            nanoseconds: pair[1].wrapping_sub(pair[0]) as f64 * f64::from(period),
        });
        let times = times.collect();
        self.collect()?;
        Ok(times)
    }

    /// Writes a buffer from its start. Waits until the host's memory is free again.
    ///
    /// # Errors
    /// [`Error::Shape`] when there is more data than room, [`Error::OutOfMemory`], or a failed
    /// submission.
    pub fn upload<T: Pod>(&mut self, buffer: &mut Buffer<T>, data: &[T]) -> Result<()> {
        if data.len() > buffer.len() {
            return Err(Error::Shape {
                op: "upload",
                arg: "data",
                expected: format!("at most {} for {}", buffer.len(), buffer.label()),
                actual: data.len(),
            });
        }
        if data.is_empty() {
            return Ok(());
        }
        let bytes: &[u8] = bytemuck::cast_slice(data);
        let context = &self.device.inner.context;
        let staging = RawBuffer::new(context, bytes.len() as u64, Residence::Upload, "staging")?;
        staging.write(bytes);
        let from = BoundRange { buffer: Arc::new(staging), offset: 0, bytes: bytes.len() as u64 };
        let mut recorder = self.recorder(false)?;
        recorder.copy_ranges(&from, &buffer.view_mut().bound());
        let ticket = self.submit(recorder)?;
        self.wait(ticket)
    }

    /// Waits for everything submitted so far and reads a buffer.
    ///
    /// # Errors
    /// [`Error::OutOfMemory`], or a failed submission.
    pub fn download<T: Pod>(&mut self, buffer: &Buffer<T>) -> Result<Vec<T>> {
        let mut data = vec![T::zeroed(); buffer.len()];
        if data.is_empty() {
            return Ok(data);
        }
        let from = buffer.view().bound();
        let readback = match self.readback.take() {
            Some(readback) if readback.bytes >= from.bytes => readback,
            _ => Arc::new(RawBuffer::new(
                &self.device.inner.context,
                from.bytes,
                Residence::Readback,
                "readback",
            )?),
        };
        let to = BoundRange { buffer: readback.clone(), offset: 0, bytes: from.bytes };
        let mut recorder = self.recorder(false)?;
        recorder.copy_ranges(&from, &to);
        let ticket = self.submit(recorder)?;
        self.wait(ticket)?;
        readback.read(bytemuck::cast_slice_mut(&mut data));
        self.readback = Some(readback);
        Ok(data)
    }

    /// Lets go of what finished submissions held.
    fn collect(&mut self) -> Result<()> {
        let kernel = self.in_flight.front().and_then(|work| work.last_kernel);
        let reached = self.timeline.reached().map_err(|error| name_lost(error, kernel))?;
        while self.in_flight.front().is_some_and(|work| work.value <= reached) {
            let Some(work) = self.in_flight.pop_front() else { break };
            if work.metered {
                self.device.add_to_meter(work.slot.read_span()?);
            }
            self.idle.push(work.slot);
        }
        Ok(())
    }
}

impl Drop for Stream {
    fn drop(&mut self) {
        // A lost device cannot be waited for, and has nothing left to protect.
        let _ = self.timeline.wait(self.submitted);
    }
}

/// Puts the kernel's name into a device-lost error.
fn name_lost(error: Error, kernel: Option<&'static str>) -> Error {
    match error {
        Error::DeviceLost { .. } => {
            Error::DeviceLost { last_kernel: kernel.unwrap_or("none").to_owned() }
        }
        other => other,
    }
}

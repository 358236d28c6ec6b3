//! Ordered submissions, waiting for them, and transfers between host and device.

use super::buffer::{Buffer, View, ViewMut};
use super::device::Device;
use super::meter::Detail;
use super::recorder::{Recorder, Work};
use crate::error::{Error, Result};
use crate::vk::{BoundRange, CommandSlot, RawBuffer, Residence, SemaphorePoint, Timeline};
use bytemuck::Pod;
use std::collections::VecDeque;
use std::sync::Arc;

/// An ordered sequence of submissions to the device's queue, counted by a timeline semaphore.
///
/// Dropping a stream waits for what it has submitted.
pub struct Stream {
    device: Device,
    timeline: Timeline,
    submitted: u64,
    in_flight: VecDeque<InFlight>,
    idle: Vec<Work>,
    /// Readback memory for downloads; reused, and replaced by a larger one when needed.
    readback: Option<Arc<RawBuffer>>,
}

struct InFlight {
    value: u64,
    work: Work,
    profile: Option<Vec<&'static str>>,
    metered: bool,
}

/// A handle of a submission, to wait for it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Ticket(u64);

impl Ticket {
    /// The value that the stream's timeline semaphore reaches when the submission is done.
    pub fn value(&self) -> u64 {
        self.0
    }
}

/// The device time of a dispatch.
#[derive(Clone, Copy, Debug)]
pub struct KernelTime {
    /// The kernel.
    pub kernel: &'static str,
    /// Nanoseconds from the end of the preceding work to the end of this dispatch.
    pub nanoseconds: f64,
}

impl KernelTime {
    /// The times of dispatches, from the timestamps before, between and after them; `period` is
    /// nanoseconds per tick.
    pub(crate) fn between(names: &[&'static str], ticks: &[u64], period: f32) -> Vec<KernelTime> {
        let time = |(kernel, pair): (&&'static str, &[u64])| KernelTime {
            kernel,
            nanoseconds: pair[1].wrapping_sub(pair[0]) as f64 * f64::from(period),
        };
        names.iter().zip(ticks.windows(2)).map(time).collect()
    }
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
        let metered = self.device.metered();
        let mut recorder = self.recorder(metered.is_some())?;
        if metered == Some(Detail::Dispatches) {
            recorder.profile()?;
        }
        Ok(recorder)
    }

    fn recorder(&mut self, metered: bool) -> Result<Recorder> {
        self.collect()?;
        let work = match self.idle.pop() {
            Some(work) => work,
            None => Work::new(CommandSlot::new(&self.device.inner.context)?),
        };
        Recorder::new(&self.device, work, metered)
    }

    /// Submits a recording. It runs after all earlier submissions of this stream.
    ///
    /// # Errors
    /// [`Error::Input`] for a recording of another device or of a host's command buffer, and where a
    /// fill or a copy named memory of another device; [`Error::Shape`] where the two sides of a copy
    /// differ in length; else a failed Vulkan call.
    pub fn submit(&mut self, recorder: Recorder) -> Result<Ticket> {
        self.submit_with(recorder, &[], &[])
    }

    /// [`submit`](Self::submit) with a host's semaphores to wait for before and to signal after.
    pub(crate) fn submit_with(
        &mut self,
        mut recorder: Recorder,
        waits: &[SemaphorePoint],
        signals: &[SemaphorePoint],
    ) -> Result<Ticket> {
        if let Some(error) = recorder.failed.take() {
            return Err(error);
        }
        if !Arc::ptr_eq(&recorder.device.inner.ledger, &self.device.inner.ledger) {
            return Err(Error::Input(
                "a recording was submitted to another device's stream".into(),
            ));
        }
        let slot = &mut recorder.work.slot;
        if slot.is_over() {
            let what = "a recording over a host's command buffer ends with `finish`; the host \
                        submits it";
            return Err(Error::Input(what.into()));
        }
        // Submissions to one queue may overlap: this barrier orders them and makes writes visible
        // to the host.
        slot.barrier();
        if recorder.metered {
            slot.span(1)?;
        }
        slot.end()?;
        let value = self.submitted + 1;
        let last_kernel = recorder.work.last_kernel();
        self.timeline
            .submit(&mut recorder.work.slot, value, waits, signals)
            .map_err(|error| name_lost(error, last_kernel))?;
        self.submitted = value;
        let Recorder { work, profile, metered, .. } = recorder;
        self.in_flight.push_back(InFlight { value, work, profile, metered });
        Ok(Ticket(value))
    }

    /// Waits for a submission and everything before it.
    ///
    /// # Errors
    /// [`Error::DeviceLost`], or another failed Vulkan call.
    pub fn wait(&mut self, ticket: Ticket) -> Result<()> {
        self.wait_for(ticket)?;
        self.collect()
    }

    fn wait_for(&self, ticket: Ticket) -> Result<()> {
        self.timeline.wait(ticket.0).map_err(|error| name_lost(error, self.first_in_flight()))
    }

    /// The last kernel of the oldest submission that is still in flight.
    fn first_in_flight(&self) -> Option<&'static str> {
        self.in_flight.front().and_then(|flight| flight.work.last_kernel())
    }

    /// Waits for a profiled submission and returns the time of each of its dispatches, in order.
    ///
    /// # Errors
    /// As for [`wait`](Self::wait); [`Error::Input`] when the submission was not profiled or has
    /// retired already.
    pub fn times(&mut self, ticket: Ticket) -> Result<Vec<KernelTime>> {
        self.wait_for(ticket)?;
        let flight = self.in_flight.iter().find(|flight| flight.value == ticket.0);
        let (Some(flight), period) = (flight, self.device.limits().timestamp_period) else {
            return Err(Error::Input("the submission's times are gone: ask before waiting".into()));
        };
        let Some(names) = &flight.profile else {
            return Err(Error::Input("the submission was not profiled".into()));
        };
        let ticks = flight.work.slot.read_timestamps()?;
        let times = KernelTime::between(names, &ticks, period);
        self.collect()?;
        Ok(times)
    }

    /// Writes `data` to the start of a buffer. Waits until the transfer has finished.
    ///
    /// # Errors
    /// [`Error::Shape`] when `data` is longer than the buffer, [`Error::OutOfMemory`], or a failed
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
        self.upload_to(buffer.view_mut(), data)
    }

    /// Writes `data` to the start of a part of a buffer. Waits until the transfer has finished.
    ///
    /// # Errors
    /// As for [`upload`](Self::upload).
    pub fn upload_to<T: Pod>(&mut self, to: ViewMut<'_, T>, data: &[T]) -> Result<()> {
        if data.len() > to.len() {
            let (expected, actual) = (format!("at most {}", to.len()), data.len());
            return Err(Error::Shape { op: "upload", arg: "data", expected, actual });
        }
        if data.is_empty() {
            return Ok(());
        }
        let bytes: &[u8] = bytemuck::cast_slice(data);
        let size = bytes.len() as u64;
        let staging = self.device.raw_buffer(size, Residence::Upload, "staging")?;
        staging.write(bytes);
        let from = BoundRange { buffer: Arc::new(staging), offset: 0, bytes: size };
        let mut recorder = self.recorder(false)?;
        recorder.copy_ranges(&from, &to.bound());
        let ticket = self.submit(recorder)?;
        self.wait(ticket)
    }

    /// Waits for everything submitted so far and reads a buffer.
    ///
    /// # Errors
    /// [`Error::OutOfMemory`], or a failed submission.
    pub fn download<T: Pod>(&mut self, buffer: &Buffer<T>) -> Result<Vec<T>> {
        self.download_from(buffer.view())
    }

    /// Waits for everything submitted so far and reads a part of a buffer.
    ///
    /// # Errors
    /// As for [`download`](Self::download).
    pub fn download_from<T: Pod>(&mut self, from: View<'_, T>) -> Result<Vec<T>> {
        let mut data = vec![T::zeroed(); from.len()];
        if data.is_empty() {
            return Ok(data);
        }
        let from = from.bound();
        let readback = self.readback_of(from.bytes)?;
        let to = BoundRange { buffer: readback.clone(), offset: 0, bytes: from.bytes };
        let mut recorder = self.recorder(false)?;
        recorder.copy_ranges(&from, &to);
        let ticket = self.submit(recorder)?;
        self.wait(ticket)?;
        readback.read(bytemuck::cast_slice_mut(&mut data));
        self.readback = Some(readback);
        Ok(data)
    }

    /// Readback memory of at least `bytes` bytes. A smaller one from before is dropped first.
    fn readback_of(&mut self, bytes: u64) -> Result<Arc<RawBuffer>> {
        match self.readback.take().filter(|readback| readback.bytes >= bytes) {
            Some(readback) => Ok(readback),
            None => Ok(Arc::new(self.device.raw_buffer(bytes, Residence::Readback, "readback")?)),
        }
    }

    /// Allocates the readback memory that a download of the buffer needs, and keeps it.
    pub(crate) fn prepare_download<T: Pod>(&mut self, buffer: &Buffer<T>) -> Result<()> {
        self.readback = Some(self.readback_of(buffer.view().bound().bytes)?);
        Ok(())
    }

    /// Releases the resources of finished submissions and adds their times to the meter.
    fn collect(&mut self) -> Result<()> {
        let kernel = self.first_in_flight();
        let reached = self.timeline.reached().map_err(|error| name_lost(error, kernel))?;
        while self.in_flight.front().is_some_and(|flight| flight.value <= reached) {
            let Some(mut flight) = self.in_flight.pop_front() else { break };
            if flight.metered {
                let kernels = match &flight.profile {
                    Some(names) => {
                        let ticks = flight.work.slot.read_timestamps()?;
                        KernelTime::between(names, &ticks, self.device.limits().timestamp_period)
                    }
                    None => Vec::new(),
                };
                self.device.add_to_meter(flight.work.slot.read_span()?, kernels);
            }
            flight.work.clear();
            self.idle.push(flight.work);
        }
        Ok(())
    }

    /// The submission with this [`Ticket::value`]; `None` if no such submission was made.
    #[cfg(feature = "capi")]
    pub(crate) fn ticket(&self, value: u64) -> Option<Ticket> {
        (1..=self.submitted).contains(&value).then_some(Ticket(value))
    }

    /// The timeline semaphore of the stream.
    pub(crate) fn timeline(&self) -> &Timeline {
        &self.timeline
    }
}

impl Drop for Stream {
    fn drop(&mut self) {
        // A lost device cannot be waited for, and has nothing left to protect.
        let _ = self.timeline.wait(self.submitted);
    }
}

/// Adds the kernel's name to a device-lost error.
fn name_lost(error: Error, kernel: Option<&'static str>) -> Error {
    match error {
        Error::DeviceLost { .. } => {
            Error::DeviceLost { last_kernel: kernel.unwrap_or("none").to_owned() }
        }
        other => other,
    }
}

//! Verification and timing of one benchmark row.

use std::cell::RefCell;
use std::rc::Rc;
use std::time::{Duration, Instant};

use super::verify::Check;
use crate::check::{Harness, Workload};
use crate::gpu::{Detail, Device, Meter, Recorder, Stream};
use crate::report::{Accuracy, Clock, Place, Row, Spread, Work};
use crate::{Error, Result};

/// A benchmark row to measure.
pub struct Entry {
    /// `family/what`.
    pub id: &'static str,
    /// The size of its input, as text.
    pub size: String,
    /// Uploads the input, executes once and compares; the number is the seed.
    pub prepare: Prepare,
}

/// See [`Entry::prepare`].
pub type Prepare = Box<dyn Fn(&Device, u64) -> Result<Job> + Send + Sync>;

/// Work that was executed once and compared with the oracle, and that can be executed again.
pub struct Job {
    /// The error of the first execution against the oracle.
    pub accuracy: Accuracy,
    /// Bytes and operations of one execution.
    pub work: Work,
    /// The processor that runs it.
    pub place: Place,
    /// Restores the input if an execution changes it; not timed.
    pub reset: Option<Box<dyn FnMut() -> Result<()>>>,
    /// Executes and waits. Returns nanoseconds if it measures its own time.
    pub execute: Box<dyn FnMut() -> Result<Option<f64>>>,
}

/// The times of one execution.
pub(super) struct Sample {
    /// Nanoseconds measured by the job itself.
    own: Option<f64>,
    /// Nanoseconds by the host's clock.
    pub(super) wall: f64,
    /// The device's measurement, if it has timestamps.
    pub(super) meter: Option<Meter>,
}

/// The amount of measurement.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pace {
    /// Samples are taken until their sum reaches this duration, and there are at least `least` of
    /// them.
    pub total: Duration,
    /// Minimum number of samples; later comparisons need at least five.
    pub least: usize,
    /// Maximum number of samples.
    pub most: usize,
}

impl Pace {
    /// The pace of a full report.
    pub const FULL: Pace = Pace { total: Duration::from_millis(700), least: 7, most: 60 };
    /// The pace of a quick run.
    pub const QUICK: Pace = Pace { total: Duration::from_millis(60), least: 5, most: 20 };
}

impl Entry {
    /// An entry; `prepare` must not depend on the state that other entries leave.
    pub fn new(
        id: &'static str,
        size: impl Into<String>,
        prepare: impl Fn(&Device, u64) -> Result<Job> + Send + Sync + 'static,
    ) -> Entry {
        Entry { id, size: size.into(), prepare: Box::new(prepare) }
    }

    /// Whether `id, size` contains the text.
    pub fn matches(&self, filter: Option<&str>) -> bool {
        filter.is_none_or(|filter| format!("{}, {}", self.id, self.size).contains(filter))
    }
}

impl Job {
    /// A job that submits the same recording each time.
    pub fn recorded(
        device: &Device,
        accuracy: Accuracy,
        work: Work,
        mut record: impl FnMut(&mut Recorder) -> Result<()> + 'static,
    ) -> Result<Job> {
        let mut stream = device.stream()?;
        Ok(Job {
            accuracy,
            work,
            place: Place::Device,
            reset: None,
            execute: Box::new(move || {
                run(&mut stream, &mut record)?;
                Ok(None)
            }),
        })
    }

    /// A workload of the check cases: executed once and compared as a case does, then submitted again
    /// and again.
    pub(super) fn of<W: Workload + 'static>(
        device: &Device,
        seed: u64,
        prepare: impl FnOnce(&mut Harness) -> Result<W>,
    ) -> Result<Job> {
        let mut harness = Harness::new(device, seed)?;
        let mut workload = prepare(&mut harness)?;
        harness.execute(&mut workload)?;
        let accuracy = Check::of(&harness.finish().0).accuracy();
        let work = workload.work();
        let (mut inputs, mut stream) = (device.stream()?, device.stream()?);
        let shared = Rc::new(RefCell::new(workload));
        let timed = shared.clone();
        Ok(Job {
            accuracy,
            work,
            place: Place::Device,
            reset: Some(Box::new(move || {
                run(&mut inputs, |recorder| shared.borrow_mut().record_inputs(recorder))
            })),
            execute: Box::new(move || {
                run(&mut stream, |recorder| timed.borrow_mut().record(recorder))?;
                Ok(None)
            }),
        })
    }

    /// A job on the CPU.
    pub fn on_processor(
        accuracy: Accuracy,
        work: Work,
        mut execute: impl FnMut() + 'static,
    ) -> Job {
        Job {
            accuracy,
            work,
            place: Place::Processor,
            reset: None,
            execute: Box::new(move || {
                execute();
                Ok(None)
            }),
        }
    }

    /// Executes once and waits. Returns nanoseconds, and the clock that measured them.
    ///
    /// # Errors
    /// A failed submission.
    pub fn sample(&mut self, device: &Device) -> Result<(f64, Clock)> {
        let sample = self.metered(device, Detail::Submissions)?;
        Ok(match (sample.own, sample.meter) {
            (Some(own), _) => (own, Clock::Device),
            (None, Some(meter)) => (meter.nanoseconds, Clock::Device),
            _ => (sample.wall, Clock::Host),
        })
    }

    /// Executes once under the device's meter.
    pub(super) fn metered(&mut self, device: &Device, detail: Detail) -> Result<Sample> {
        if let Some(reset) = &mut self.reset {
            reset()?;
        }
        if self.place == Place::Device {
            device.start_meter(detail);
        }
        let begun = Instant::now();
        let own = (self.execute)();
        let wall = begun.elapsed().as_nanos() as f64;
        let meter = device.stop_meter();
        Ok(Sample { own: own?, wall, meter })
    }

    /// Warms up and takes samples.
    ///
    /// # Errors
    /// A failed submission.
    pub fn time(&mut self, device: &Device, pace: Pace) -> Result<(Spread, Clock)> {
        // The first execution compiles pipelines and touches memory, the second fills caches.
        for _ in 0..2 {
            self.sample(device)?;
        }
        let (mut samples, mut clock) = (Vec::new(), Clock::Host);
        let begun = Instant::now();
        while samples.len() < pace.least.max(1)
            || (begun.elapsed() < pace.total && samples.len() < pace.most)
        {
            let (sample, read) = self.sample(device)?;
            samples.push(sample);
            clock = read;
        }
        let spread = Spread::new(samples)
            .ok_or_else(|| Error::Failed("the device's timestamps make no sense".into()))?;
        Ok((spread, clock))
    }
}

/// Submits a recording and waits for it.
fn run(stream: &mut Stream, record: impl FnOnce(&mut Recorder) -> Result<()>) -> Result<()> {
    let mut recorder = stream.record()?;
    record(&mut recorder)?;
    let ticket = stream.submit(recorder)?;
    stream.wait(ticket)
}

/// Verifies an entry and, if that passed, times it. An entry that cannot run gives a row without
/// speed and with the reason.
///
/// # Errors
/// [`Error::DeviceLost`]: nothing more can be measured.
pub fn measure(device: &Device, entry: &Entry, pace: Pace, seed: u64) -> Result<Row> {
    let missed = |place: Place, accuracy: Accuracy| {
        Row::missed(entry.id, entry.size.clone(), place, accuracy)
    };
    let broken = |error: Error| match error {
        Error::DeviceLost { .. } => Err(error),
        other => {
            let (of_bound, error) = (f64::INFINITY, f64::INFINITY);
            let accuracy = Accuracy { of_bound, error, output: other.to_string() };
            Ok(missed(Place::Device, accuracy))
        }
    };
    let mut job = match (entry.prepare)(device, seed) {
        Ok(job) => job,
        Err(error) => return broken(error),
    };
    if !job.accuracy.passed() {
        return Ok(missed(job.place, job.accuracy));
    }
    match job.time(device, pace) {
        Ok((time, clock)) => {
            let on = (job.place, clock);
            Ok(Row::timed(entry.id, entry.size.clone(), on, job.accuracy, job.work, time))
        }
        Err(error) => broken(error),
    }
}

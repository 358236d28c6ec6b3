//! How one row is verified and timed.

use std::time::{Duration, Instant};

use crate::gpu::{Detail, Device, Meter, Recorder};
use crate::report::{Accuracy, Clock, Place, Row, Spread, Work};
use crate::{Error, Result};

/// A row that can be measured.
pub struct Entry {
    /// `family/what`.
    pub id: &'static str,
    /// The size of its input, in words.
    pub size: String,
    /// Uploads the input, executes once, compares. The number is a seed.
    pub prepare: Prepare,
}

/// See [`Entry::prepare`].
pub type Prepare = Box<dyn Fn(&Device, u64) -> Result<Job> + Send + Sync>;

/// Something that was executed once, compared with the oracle, and can be executed again.
pub struct Job {
    /// How far the first execution lay from the oracle.
    pub accuracy: Accuracy,
    /// What one execution does.
    pub work: Work,
    /// Where it does that.
    pub place: Place,
    /// Puts the input back where an execution changes it; not timed.
    pub reset: Option<Box<dyn FnMut() -> Result<()>>>,
    /// Executes and waits. Gives nanoseconds where it has measured itself.
    pub execute: Box<dyn FnMut() -> Result<Option<f64>>>,
}

/// What one execution took.
pub(super) struct Sample {
    /// Nanoseconds by its own measure.
    own: Option<f64>,
    /// Nanoseconds by the host's clock.
    pub(super) wall: f64,
    /// What the device says, where it can.
    pub(super) meter: Option<Meter>,
}

/// How long to measure.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pace {
    /// Samples are taken until they add up to this …
    pub total: Duration,
    /// … and there are so many; fewer than five forbid a comparison later.
    pub least: usize,
    /// Never more than so many.
    pub most: usize,
}

impl Pace {
    /// For a report.
    pub const FULL: Pace = Pace { total: Duration::from_millis(700), least: 7, most: 60 };
    /// For a glance.
    pub const QUICK: Pace = Pace { total: Duration::from_millis(60), least: 5, most: 20 };
}

impl Entry {
    /// An entry; `prepare` must not depend on what other entries leave behind.
    pub fn new(
        id: &'static str,
        size: impl Into<String>,
        prepare: impl Fn(&Device, u64) -> Result<Job> + Send + Sync + 'static,
    ) -> Entry {
        Entry { id, size: size.into(), prepare: Box::new(prepare) }
    }

    /// Whether `id, size` holds the text.
    pub fn matches(&self, filter: Option<&str>) -> bool {
        filter.is_none_or(|filter| format!("{}, {}", self.id, self.size).contains(filter))
    }
}

impl Job {
    /// Work that one recording does, the same each time.
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
                let mut recorder = stream.record()?;
                record(&mut recorder)?;
                let ticket = stream.submit(recorder)?;
                stream.wait(ticket)?;
                Ok(None)
            }),
        })
    }

    /// Work on the processor.
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

    /// Executes once and waits: nanoseconds, and what they were read from.
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

/// Verifies an entry and, where it passed, times it. One that cannot run is a row without speed that
/// says why.
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

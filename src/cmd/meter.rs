//! Progress on stderr, with rate and remaining time: a bar on a terminal, else an occasional line.

use std::time::{Duration, Instant};

use indicatif::{ProgressBar, ProgressStyle};

use super::common::say;

/// Interval between lines where stderr is not a terminal.
const LINE_INTERVAL: Duration = Duration::from_secs(10);

/// Progress of some work.
pub struct Meter {
    bar: ProgressBar,
    what: &'static str,
    unit: &'static str,
    total: u64,
    first: u64,
    done: u64,
    message: String,
    started: Instant,
    said: Instant,
}

impl Meter {
    /// Progress of work with `total` units, `first` of which are done already.
    pub fn new(what: &'static str, unit: &'static str, total: u64, first: u64) -> Meter {
        let bar = ProgressBar::new(total).with_position(first).with_prefix(what);
        let template = "{prefix} [{bar:30}] {pos}/{len} {per_sec}, {eta} left {msg}";
        bar.set_style(
            ProgressStyle::with_template(template).expect("a valid template").progress_chars("=> "),
        );
        bar.reset_eta();
        let now = Instant::now();
        let message = String::new();
        Meter { bar, what, unit, total, first, done: first, message, started: now, said: now }
    }

    /// Sets the number of completed units.
    pub fn set(&mut self, done: u64) {
        self.done = done;
        self.bar.set_position(done);
        if self.bar.is_hidden() && self.said.elapsed() >= LINE_INTERVAL {
            self.said = Instant::now();
            say(&self.line());
        }
    }

    /// Adds one completed unit.
    pub fn advance(&mut self) {
        self.set(self.done + 1);
    }

    /// Sets the message beside the numbers.
    pub fn message(&mut self, message: String) {
        self.bar.set_message(message.clone());
        self.message = message;
    }

    fn line(&self) -> String {
        let seconds = self.started.elapsed().as_secs_f64();
        let rate = (self.done - self.first) as f64 / seconds.max(1e-9);
        let left = (self.total.saturating_sub(self.done)) as f64 / rate.max(1e-9);
        let Meter { what, unit, total, done, message, .. } = self;
        let left = indicatif::HumanDuration(Duration::from_secs_f64(left.min(1e9)));
        format!("{what}: {done}/{total} {unit}, {rate:.1}/s, {left} left {message}")
    }
}

impl Drop for Meter {
    fn drop(&mut self) {
        self.bar.finish_and_clear();
    }
}

//! Counts the memory of buffers.

use std::sync::Mutex;
use std::sync::atomic::{AtomicU64, Ordering};

/// The bytes of all live buffers, their peak, and the largest buffer.
#[derive(Default)]
pub(crate) struct Ledger {
    now: AtomicU64,
    peak: AtomicU64,
    /// Bytes and label of the largest buffer so far.
    largest: Mutex<(u64, String)>,
}

impl Ledger {
    /// Counts a new buffer.
    pub(super) fn add(&self, bytes: u64, label: &str) {
        self.add_bytes(bytes);
        let mut largest = self.largest.lock().expect("no holder panics");
        if bytes > largest.0 {
            *largest = (bytes, label.to_owned());
        }
    }

    /// Counts further bytes without a label, for copies of buffers already counted.
    pub(crate) fn add_bytes(&self, bytes: u64) {
        // The sum saturates: a rehearsal may count more bytes than any machine has.
        let add = |now: u64| Some(now.saturating_add(bytes));
        let before = self.now.fetch_update(Ordering::Relaxed, Ordering::Relaxed, add);
        let now = before.unwrap_or_else(|before| before).saturating_add(bytes);
        self.peak.fetch_max(now, Ordering::Relaxed);
    }

    /// Removes a dropped buffer from the count.
    pub(super) fn remove(&self, bytes: u64) {
        let subtract = |now: u64| Some(now.saturating_sub(bytes));
        let _ = self.now.fetch_update(Ordering::Relaxed, Ordering::Relaxed, subtract);
    }

    /// Bytes of all live buffers now, and their peak.
    pub(crate) fn bytes(&self) -> (u64, u64) {
        (self.now.load(Ordering::Relaxed), self.peak.load(Ordering::Relaxed))
    }

    /// Resets the peak to the current bytes and returns them.
    pub(crate) fn restart_peak(&self) -> u64 {
        let now = self.now.load(Ordering::Relaxed);
        self.peak.store(now, Ordering::Relaxed);
        now
    }

    /// Bytes and label of the largest buffer so far.
    pub(crate) fn largest(&self) -> (u64, String) {
        self.largest.lock().expect("no holder panics").clone()
    }
}

//! How much memory buffers take.

use std::sync::Mutex;
use std::sync::atomic::{AtomicU64, Ordering};

/// Adds up the buffers that are alive.
#[derive(Default)]
pub(crate) struct Ledger {
    now: AtomicU64,
    peak: AtomicU64,
    /// Bytes of the largest one that there ever was, and its name.
    largest: Mutex<(u64, String)>,
}

impl Ledger {
    /// One more buffer.
    pub(super) fn add(&self, bytes: u64, label: &str) {
        self.add_bytes(bytes);
        let mut largest = self.largest.lock().expect("no holder panics");
        if bytes > largest.0 {
            *largest = (bytes, label.to_owned());
        }
    }

    /// Bytes of buffers that are as others.
    pub(crate) fn add_bytes(&self, bytes: u64) {
        // A rehearsal may count more than any machine has.
        let add = |now: u64| Some(now.saturating_add(bytes));
        let before = self.now.fetch_update(Ordering::Relaxed, Ordering::Relaxed, add);
        let now = before.unwrap_or_else(|before| before).saturating_add(bytes);
        self.peak.fetch_max(now, Ordering::Relaxed);
    }

    /// One less.
    pub(super) fn remove(&self, bytes: u64) {
        let subtract = |now: u64| Some(now.saturating_sub(bytes));
        let _ = self.now.fetch_update(Ordering::Relaxed, Ordering::Relaxed, subtract);
    }

    /// Bytes now, and at most so far.
    pub(crate) fn bytes(&self) -> (u64, u64) {
        (self.now.load(Ordering::Relaxed), self.peak.load(Ordering::Relaxed))
    }

    /// Forgets the peak, and gives the bytes that there are now.
    pub(crate) fn restart_peak(&self) -> u64 {
        let now = self.now.load(Ordering::Relaxed);
        self.peak.store(now, Ordering::Relaxed);
        now
    }

    /// Bytes of the largest buffer that there ever was, and its name.
    pub(crate) fn largest(&self) -> (u64, String) {
        self.largest.lock().expect("no holder panics").clone()
    }
}

//! Work tried out without memory, to know what it will take before it begins.
//!
//! A rehearsal runs the very code that makes the buffers and records the dispatches, on a device whose
//! buffers have no memory: nothing about sizes is written down twice.

use super::device::Device;
use crate::{Error, Result};

/// What some work takes of a device's memory.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Footprint {
    /// Bytes of all buffers alive at one time, at most, those for transfers among them.
    pub bytes: u64,
    /// The largest buffer.
    pub largest: String,
    /// Its bytes.
    pub largest_bytes: u64,
}

impl Footprint {
    /// That the device has so much memory left.
    ///
    /// # Errors
    /// [`Error::TooLarge`].
    pub fn fits(&self, device: &Device) -> Result<()> {
        let free = device.free_memory();
        if self.bytes <= free {
            return Ok(());
        }
        Err(Error::TooLarge {
            bytes: self.bytes,
            free,
            largest: self.largest.clone(),
            largest_bytes: self.largest_bytes,
        })
    }
}

/// A device on which nothing is done but counting.
pub(crate) struct Rehearsal {
    device: Device,
}

impl Rehearsal {
    /// Runs some work on a device that only counts, and gives what it would have taken.
    ///
    /// # Errors
    /// [`Error::RangeLimit`] for a binding larger than the device allows, and whatever `work` returns.
    pub(crate) fn of(
        device: &Device,
        work: impl FnOnce(&Rehearsal) -> Result<()>,
    ) -> Result<Footprint> {
        let rehearsal = Rehearsal { device: device.rehearsing() };
        work(&rehearsal)?;
        let ledger = &rehearsal.device.inner.ledger;
        let (largest_bytes, largest) = ledger.largest();
        Ok(Footprint { bytes: ledger.bytes().1, largest, largest_bytes })
    }

    /// The device to work on.
    pub(crate) fn device(&self) -> &Device {
        &self.device
    }

    /// Runs something once whose buffers stay, and counts them `times` times.
    pub(crate) fn repeat<T>(
        &self,
        times: usize,
        work: impl FnOnce(&Device) -> Result<T>,
    ) -> Result<T> {
        let before = self.device.memory().0;
        let made = work(&self.device)?;
        let each = self.device.memory().0 - before;
        let more = each.saturating_mul(times.saturating_sub(1) as u64);
        self.device.inner.ledger.add_bytes(more);
        Ok(made)
    }
}

/// The largest size whose footprint fits on a device; 0 where not even 1 does. `footprint` must grow
/// with the size.
pub fn most_that_fits(device: &Device, footprint: impl Fn(usize) -> Result<Footprint>) -> usize {
    let fits = |size: usize| footprint(size).is_ok_and(|taken| taken.fits(device).is_ok());
    if !fits(1) {
        return 0;
    }
    let (mut fitting, mut beyond) = (1usize, 2usize);
    while fits(beyond) {
        (fitting, beyond) = (beyond, beyond.saturating_mul(2));
        if fitting == beyond {
            return fitting;
        }
    }
    // To a thousandth: what else runs on the device moves the limit by more.
    while beyond - fitting > 1 + fitting / 1000 {
        let middle = fitting + (beyond - fitting) / 2;
        match fits(middle) {
            true => fitting = middle,
            false => beyond = middle,
        }
    }
    fitting
}

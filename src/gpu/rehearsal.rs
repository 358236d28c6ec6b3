//! Rehearsals: work run without memory, to measure its memory footprint before it begins.
//!
//! A rehearsal runs the same code that creates the buffers and records the dispatches, on a device
//! whose buffers have no memory. No buffer size is therefore computed in a second place.

use super::device::Device;
use crate::{Error, Result};

/// The device memory that some work needs.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Footprint {
    /// Peak of the bytes of all live buffers, transfer buffers included.
    pub bytes: u64,
    /// Label of the largest buffer.
    pub largest: String,
    /// Bytes of the largest buffer.
    pub largest_bytes: u64,
}

impl Footprint {
    /// Checks that the device has this much memory left.
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

/// A device that only counts buffers.
pub(crate) struct Rehearsal {
    device: Device,
}

impl Rehearsal {
    /// Runs `work` on a device that only counts, and returns the memory that the work would need.
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

    /// The device that only counts.
    pub(crate) fn device(&self) -> &Device {
        &self.device
    }

    /// Runs `work` once and counts the buffers that it leaves alive `times` times.
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

/// The largest size whose footprint fits on a device; 0 if not even size 1 fits. `footprint` must
/// grow with the size.
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
    // A precision of 1/1000 is enough: other programs on the device change the limit by more.
    while beyond - fitting > 1 + fitting / 1000 {
        let middle = fitting + (beyond - fitting) / 2;
        match fits(middle) {
            true => fitting = middle,
            false => beyond = middle,
        }
    }
    fitting
}

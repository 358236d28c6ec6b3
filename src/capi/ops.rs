//! Ops on buffers: scan and sort.

use super::call::{
    Outcome, call, claim, destroy, exclusive, give, grows, read, shape, shared, splat4d_result,
};
use super::device::{device_of, splat4d_device};
use super::memory::{check_apart, splat4d_buffer};
use super::record::splat4d_recorder;
use crate::ops::scan::{Scan, ScanArgs, ScanScratch};
use crate::ops::sort::{RadixSort, SortArgs, SortScratch};

/// A plan for exclusive prefix sums, with its scratch memory.
pub struct splat4d_scan {
    scan: Scan,
    scratch: ScanScratch,
}

/// The buffers of one scan; elements are 32-bit words.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct splat4d_scan_buffers {
    /// sizeof(splat4d_scan_buffers).
    pub struct_size: usize,
    /// Holds the number of values; what exceeds the capacity is left out.
    pub count: *const splat4d_buffer,
    /// Index of the word that holds the number.
    pub count_at: u64,
    /// The values; as long as the capacity.
    pub values: *const splat4d_buffer,
    /// Receives `prefix[i] = values[0] + ... + values[i - 1]`, modulo 2^32; elements from the
    /// number of values on stay unchanged.
    pub prefix: *mut splat4d_buffer,
    /// Receives the sum of all values.
    pub total: *mut splat4d_buffer,
    /// Index of the word that receives the sum.
    pub total_at: u64,
}
grows!(splat4d_scan_buffers, total_at: u64);

/// A plan for a stable sort of key-payload pairs, with its scratch memory.
pub struct splat4d_sort {
    sort: RadixSort,
    scratch: SortScratch,
}

/// The buffers of one sort; elements are 32-bit words. The input stays unchanged.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct splat4d_sort_buffers {
    /// sizeof(splat4d_sort_buffers).
    pub struct_size: usize,
    /// Holds the number of pairs; what exceeds the capacity is left out.
    pub count: *const splat4d_buffer,
    /// Index of the word that holds the number.
    pub count_at: u64,
    /// The keys; as long as the capacity.
    pub keys: *const splat4d_buffer,
    /// The payload of each key; as long as the capacity.
    pub payload: *const splat4d_buffer,
    /// Receives the sorted keys; elements from the number of pairs on stay unchanged.
    pub sorted_keys: *mut splat4d_buffer,
    /// Receives the payload in the order of the sorted keys.
    pub sorted_payload: *mut splat4d_buffer,
}
grows!(splat4d_sort_buffers, sorted_payload: *mut splat4d_buffer);

/// Plans scans of at most `capacity` values. `scan` gets a handle, to be destroyed.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn splat4d_scan_create(
    device: *const splat4d_device,
    capacity: usize,
    scan: *mut *mut splat4d_scan,
) -> splat4d_result {
    // SAFETY: guaranteed by the host.
    call(|| unsafe {
        claim("scan", scan)?;
        let device = device_of(device)?;
        let plan = Scan::plan(device, capacity)?;
        give(scan, splat4d_scan { scan: plan, scratch: plan.scratch(device)? });
        Ok(())
    })
}

/// Records a scan. The dispatches: scan/single for a small capacity, else indirect/arguments,
/// scan/reduce, scan/spine, scan/downsweep.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn splat4d_scan_record(
    scan: *mut splat4d_scan,
    recorder: *mut splat4d_recorder,
    buffers: *const splat4d_scan_buffers,
) -> splat4d_result {
    // SAFETY: guaranteed by the host.
    call(|| unsafe {
        let splat4d_scan { scan, scratch } = exclusive("scan", scan)?;
        let recorder = &mut exclusive("recorder", recorder)?.recorder;
        let b = read("buffers", buffers)?;
        let reads = [("count", b.count), ("values", b.values)];
        check_apart("scan", &reads, &[("prefix", b.prefix), ("total", b.total)])?;
        let args = ScanArgs {
            count: shared("count", b.count)?.words.view(),
            count_at: word("count_at", b.count_at)?,
            values: shared("values", b.values)?.words.view(),
            prefix: exclusive("prefix", b.prefix)?.words.view_mut(),
            total: exclusive("total", b.total)?.words.view_mut(),
            total_at: word("total_at", b.total_at)?,
        };
        Ok(scan.record(recorder, args, scratch)?)
    })
}

/// Destroys the handle; null is allowed.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn splat4d_scan_destroy(scan: *mut splat4d_scan) {
    // SAFETY: guaranteed by the host.
    unsafe { destroy(scan) };
}

/// Plans sorts of at most `capacity` pairs by the key bits from `first_bit` up to, but excluding,
/// `end_bit`: 0 and 32 for all bits. Other bits are ignored; pairs with equal bits keep their
/// order. `sort` gets a handle, to be destroyed.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn splat4d_sort_create(
    device: *const splat4d_device,
    capacity: usize,
    first_bit: u32,
    end_bit: u32,
    sort: *mut *mut splat4d_sort,
) -> splat4d_result {
    // SAFETY: guaranteed by the host.
    call(|| unsafe {
        claim("sort", sort)?;
        let device = device_of(device)?;
        let plan = RadixSort::plan(device, capacity, first_bit..end_bit)?;
        let scratch = plan.scratch(device)?;
        give(sort, splat4d_sort { sort: plan, scratch });
        Ok(())
    })
}

/// Records a sort. The dispatches: sort/plan; for each pass of up to 8 bits sort/count, those of
/// splat4d_scan_record, sort/scatter.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn splat4d_sort_record(
    sort: *mut splat4d_sort,
    recorder: *mut splat4d_recorder,
    buffers: *const splat4d_sort_buffers,
) -> splat4d_result {
    // SAFETY: guaranteed by the host.
    call(|| unsafe {
        let splat4d_sort { sort, scratch } = exclusive("sort", sort)?;
        let recorder = &mut exclusive("recorder", recorder)?.recorder;
        let b = read("buffers", buffers)?;
        let reads = [("count", b.count), ("keys", b.keys), ("payload", b.payload)];
        let writes = [("sorted_keys", b.sorted_keys), ("sorted_payload", b.sorted_payload)];
        check_apart("sort", &reads, &writes)?;
        let args = SortArgs {
            count: shared("count", b.count)?.words.view(),
            count_at: word("count_at", b.count_at)?,
            keys: shared("keys", b.keys)?.words.view(),
            payload: shared("payload", b.payload)?.words.view(),
            sorted_keys: exclusive("sorted_keys", b.sorted_keys)?.words.view_mut(),
            sorted_payload: exclusive("sorted_payload", b.sorted_payload)?.words.view_mut(),
        };
        Ok(sort.record(recorder, args, scratch)?)
    })
}

/// Destroys the handle; null is allowed.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn splat4d_sort_destroy(sort: *mut splat4d_sort) {
    // SAFETY: guaranteed by the host.
    unsafe { destroy(sort) };
}

/// Checks a word index, which the device stores in 32 bits.
fn word(what: &str, at: u64) -> Outcome<usize> {
    let fits = u32::try_from(at).ok().filter(|at| *at < u32::MAX);
    fits.map(|at| at as usize).ok_or_else(|| shape(format!("{what} is {at}: no buffer is so long")))
}

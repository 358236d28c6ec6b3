//! Typed device buffers and views of them.

use super::device::Device;
use crate::error::{Error, Result};
use crate::vk::{BoundRange, RawBuffer, Residence};
use bytemuck::Pod;
use std::marker::PhantomData;
use std::ops::Range;
use std::sync::Arc;

/// Elements of `T` in device memory; lengths and offsets count elements.
pub struct Buffer<T> {
    raw: Arc<RawBuffer>,
    len: usize,
    element: PhantomData<T>,
}

/// A read-only view of a part of a buffer.
#[derive(Clone, Copy)]
pub struct View<'a, T> {
    raw: &'a Arc<RawBuffer>,
    start: usize,
    len: usize,
    element: PhantomData<T>,
}

/// A writable view of a part of a buffer. It borrows the buffer exclusively, so that a dispatch
/// cannot bind memory that it writes a second time.
pub struct ViewMut<'a, T> {
    raw: &'a Arc<RawBuffer>,
    start: usize,
    len: usize,
    element: PhantomData<&'a mut T>,
}

impl<T: Pod> Buffer<T> {
    pub(super) fn new(device: &Device, label: &str, len: usize) -> Result<Buffer<T>> {
        let bytes = (len as u64).saturating_mul(size_of::<T>() as u64);
        let raw = device.raw_buffer(bytes, Residence::Device, label)?;
        Ok(Buffer { raw: Arc::new(raw), len, element: PhantomData })
    }

    /// A typed buffer over a host's buffer or imported memory.
    pub(crate) fn of_raw(raw: RawBuffer, len: usize) -> Buffer<T> {
        Buffer { raw: Arc::new(raw), len, element: PhantomData }
    }

    pub(crate) fn raw(&self) -> &RawBuffer {
        &self.raw
    }

    /// Number of elements.
    pub fn len(&self) -> usize {
        self.len
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// The label given at creation.
    pub fn label(&self) -> &str {
        &self.raw.label
    }

    /// The whole buffer, to read.
    pub fn view(&self) -> View<'_, T> {
        View { raw: &self.raw, start: 0, len: self.len, element: PhantomData }
    }

    /// The whole buffer, to write.
    pub fn view_mut(&mut self) -> ViewMut<'_, T> {
        ViewMut { raw: &self.raw, start: 0, len: self.len, element: PhantomData }
    }

    /// The whole buffer reinterpreted as elements of type `U` (as many as fit), to read.
    #[cfg(feature = "capi")]
    pub(crate) fn view_as<U: Pod>(&self) -> View<'_, U> {
        let len = self.len * size_of::<T>() / size_of::<U>();
        View { raw: &self.raw, start: 0, len, element: PhantomData }
    }

    /// The whole buffer reinterpreted as elements of type `U` (as many as fit), to write.
    #[cfg(feature = "capi")]
    pub(crate) fn view_mut_as<U: Pod>(&mut self) -> ViewMut<'_, U> {
        let len = self.len * size_of::<T>() / size_of::<U>();
        ViewMut { raw: &self.raw, start: 0, len, element: PhantomData }
    }

    /// A part of it, to read.
    ///
    /// # Panics
    /// When the range reaches past the end.
    pub fn range(&self, range: Range<usize>) -> View<'_, T> {
        assert!(range.start <= range.end && range.end <= self.len, "{}: {range:?}", self.label());
        View { raw: &self.raw, start: range.start, len: range.len(), element: PhantomData }
    }

    /// A part of it, to write.
    ///
    /// # Panics
    /// When the range reaches past the end.
    pub fn range_mut(&mut self, range: Range<usize>) -> ViewMut<'_, T> {
        assert!(range.start <= range.end && range.end <= self.len, "{}: {range:?}", self.label());
        ViewMut { raw: &self.raw, start: range.start, len: range.len(), element: PhantomData }
    }
}

/// Memory that the device copies into and the host reads, to fetch results without stalling the
/// stream: record [`Recorder::read_back`](super::Recorder::read_back), wait for the ticket, then
/// [`read`](Self::read).
///
/// A recording shares this memory until the device is known to be done with it: until
/// [`Stream::wait`](super::Stream::wait) for its submission or a later one, or until the guard of a
/// host's command buffer is dropped. Reading earlier is an error.
pub struct Readback<T> {
    raw: Arc<RawBuffer>,
    len: usize,
    element: PhantomData<T>,
}

impl<T: Pod> Readback<T> {
    pub(super) fn new(device: &Device, len: usize) -> Result<Readback<T>> {
        let bytes = (len * size_of::<T>()) as u64;
        let raw = device.raw_buffer(bytes, Residence::Readback, "readback")?;
        Ok(Readback { raw: Arc::new(raw), len, element: PhantomData })
    }

    /// The data that the device has copied; undefined before the first copy.
    ///
    /// # Errors
    /// [`Error::Input`] while a recording still references this memory.
    pub fn read(&mut self) -> Result<Vec<T>> {
        let mut data = vec![T::zeroed(); self.len];
        self.read_into(&mut data)?;
        Ok(data)
    }

    /// [`read`](Self::read) into an existing slice.
    ///
    /// # Errors
    /// As for [`read`](Self::read); [`Error::Shape`] where the lengths differ.
    pub fn read_into(&mut self, data: &mut [T]) -> Result<()> {
        if data.len() != self.len {
            let (expected, actual) = (self.len.to_string(), data.len());
            return Err(Error::Shape { op: "readback", arg: "data", expected, actual });
        }
        // No recording references the memory any more, so nothing can write it.
        let Some(raw) = Arc::get_mut(&mut self.raw) else {
            let what = "a readback was read before the device was known to be done with it: wait for \
                        its submission, or drop the guard of the host's recording, first";
            return Err(Error::Input(what.into()));
        };
        raw.read(bytemuck::cast_slice_mut(data));
        Ok(())
    }

    /// Number of elements.
    pub fn len(&self) -> usize {
        self.len
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    pub(super) fn bound(&self) -> BoundRange {
        bound::<T>(&self.raw, 0, self.len)
    }
}

impl<'a, const N: usize> View<'a, [f32; N]> {
    /// The same memory as plain floats.
    pub fn floats(self) -> View<'a, f32> {
        View { raw: self.raw, start: self.start * N, len: self.len * N, element: PhantomData }
    }
}

impl<'a, const N: usize> ViewMut<'a, [f32; N]> {
    /// The same memory as plain floats.
    pub fn floats(self) -> ViewMut<'a, f32> {
        ViewMut { raw: self.raw, start: self.start * N, len: self.len * N, element: PhantomData }
    }
}

fn bound<T>(raw: &Arc<RawBuffer>, start: usize, len: usize) -> BoundRange {
    let element = size_of::<T>() as u64;
    // Vulkan forbids bindings of zero bytes and offsets at the end of the buffer. Every buffer has
    // at least 4 bytes.
    let (offset, bytes) = match len {
        0 => (0, 4),
        _ => (start as u64 * element, (len as u64 * element).max(4)),
    };
    BoundRange { buffer: raw.clone(), offset: raw.start + offset, bytes }
}

impl<'a, T> View<'a, T> {
    /// A part of it.
    ///
    /// # Panics
    /// When the range reaches past the end.
    pub fn range(self, range: Range<usize>) -> View<'a, T> {
        assert!(range.start <= range.end && range.end <= self.len, "a view: {range:?}");
        View { start: self.start + range.start, len: range.len(), ..self }
    }

    /// Number of elements.
    pub fn len(&self) -> usize {
        self.len
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    pub(crate) fn bound(&self) -> BoundRange {
        bound::<T>(self.raw, self.start, self.len)
    }
}

impl<'a, T> ViewMut<'a, T> {
    /// Number of elements.
    pub fn len(&self) -> usize {
        self.len
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// The same view with a shorter lifetime.
    pub fn reborrow(&mut self) -> ViewMut<'_, T> {
        ViewMut { raw: self.raw, start: self.start, len: self.len, element: PhantomData }
    }

    /// A part of it.
    ///
    /// # Panics
    /// When the range reaches past the end.
    pub fn range(self, range: Range<usize>) -> ViewMut<'a, T> {
        assert!(range.start <= range.end && range.end <= self.len, "a view: {range:?}");
        ViewMut { start: self.start + range.start, len: range.len(), ..self }
    }

    /// The same part, to read.
    pub fn as_view(&self) -> View<'_, T> {
        View { raw: self.raw, start: self.start, len: self.len, element: PhantomData }
    }

    pub(crate) fn bound(&self) -> BoundRange {
        bound::<T>(self.raw, self.start, self.len)
    }
}

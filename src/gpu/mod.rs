//! The safe layer over Vulkan: devices, typed buffers, kernels, recorder, stream.
//!
//! A [`Device`] makes [`Buffer`]s and a [`Stream`]. Work is recorded with a [`Recorder`], which
//! inserts a barrier where a dispatch conflicts with an earlier one (read after write, write after
//! read, write after write). The stream submits the recording, and its timeline semaphore shows
//! when the submission has finished. The stream keeps every resource that a submission uses alive
//! until then.
//!
//! ```no_run
//! use splat4d::gpu::{Device, Request};
//! # fn main() -> splat4d::Result<()> {
//! let device = Device::open(&Request::default())?;
//! let mut stream = device.stream()?;
//! let numbers = device.upload("numbers", &[1u32, 2, 3])?;
//! assert_eq!(stream.download(&numbers)?, [1, 2, 3]);
//! # Ok(())
//! # }
//! ```

mod buffer;
mod device;
mod kernel;
mod meter;
mod profile;
mod recorder;
mod rehearsal;
mod stream;

pub use buffer::{Buffer, Readback, View, ViewMut};
pub use device::{Device, Dispatched, Request, Selector};
pub(crate) use kernel::kernel;
pub use kernel::{
    Access, Argument, Binding, ConstantInfo, ConstantValue, Constants, Groups, Kernel, KernelInfo,
    ParamInfo, Read, ReadVec3, ReadVec4, ReadWrite, ReadWriteVec3, ReadWriteVec4, Several, Write,
    WriteVec3, WriteVec4,
};
pub use meter::{Detail, Meter};
pub use profile::Profile;
pub use recorder::Recorder;
pub(crate) use recorder::Work;
pub(crate) use rehearsal::Rehearsal;
pub use rehearsal::{Footprint, most_that_fits};
pub use stream::{KernelTime, Stream, Ticket};

pub use crate::vk::{DeviceInfo, DeviceKind, Limits};

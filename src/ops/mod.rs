//! Operations: algorithms that consist of several kernel dispatches.
//!
//! There are three kinds:
//!
//! - An op that keeps nothing from one recording to the next ([`scan`], [`sort`], [`loss`], [`mlp`],
//!   [`flow`]) is a plan. `plan` fixes the sizes, `scratch` allocates the intermediate buffers, and
//!   `record` (or `forward` and `backward`) takes both. [`render`] joins plan, intermediate buffers and
//!   image in a [`Frame`](render::Frame).
//! - An op that keeps something on the device (the lists of [`neighbours`], [`deform`] and [`arap`], the
//!   moved Gaussians of [`motion`], the draws and counts of [`density`] and [`adam`]) owns its buffers.
//!   `new` allocates them for a capacity, and the methods that record take the rest.
//! - A single dispatch without intermediate buffers ([`path`], [`mask`], [`texel`]) is a function.
//!
//! What takes a [`Recorder`](crate::gpu::Recorder) records dispatches; it never allocates, submits or
//! waits. Its documentation lists the dispatches in order; a profiled recording reports one time for
//! each.

pub mod adam;
pub mod arap;
pub mod deform;
pub mod density;
pub mod flow;
pub mod gaussians;
pub mod half;
pub mod loss;
pub mod mask;
pub mod mlp;
pub mod motion;
pub mod neighbours;
pub mod path;
pub mod render;
pub mod scan;
pub mod sort;
pub mod texel;

use crate::gpu::Device;
use crate::{Error, Result};

/// Checks that a buffer of `len` elements of `size` bytes can be counted in 32 bits, as kernels count.
fn countable(device: &Device, label: &str, len: usize, size: u64) -> Result<()> {
    if u32::try_from(len).is_ok() {
        return Ok(());
    }
    let bytes = (len as u64).saturating_mul(size);
    let limit = device.limits().storage_range.min(size * u64::from(u32::MAX));
    Err(Error::RangeLimit { label: label.into(), bytes, limit })
}

/// Checks that every argument is long enough; each is given as (name, elements needed, elements
/// present).
fn at_least(op: &'static str, shapes: &[(&'static str, usize, usize)]) -> Result<()> {
    match shapes.iter().find(|(_, needed, actual)| actual < needed) {
        None => Ok(()),
        Some(&(arg, needed, actual)) => {
            Err(Error::Shape { op, arg, expected: format!("at least {needed}"), actual })
        }
    }
}

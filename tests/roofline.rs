//! The kernels that measure a device's peak bandwidth and arithmetic throughput.

mod common;

common::cases! { "roofline": copy, fma }

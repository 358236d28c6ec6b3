//! Rendered motion against motion masks, on the device.

mod common;

common::cases! { "mask", folded to 20: paint, compare, vote, blend }

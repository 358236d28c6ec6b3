//! Indirect dispatch grids from counts on the device, compared with the host's.

mod common;

common::cases! { "indirect": arguments }

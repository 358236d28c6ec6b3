//! Projection on the device.

mod common;

// 47 blocks of Gaussians, with a limit of 40 workgroups along an axis.
common::cases! { "project", folded to 40: forward, degrees, halves, decisions, backward }

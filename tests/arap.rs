//! The as-rigid-as-possible energy against its oracle.

mod common;

common::cases! { "arap", folded to 40: random, central_differences, rigid, degenerate, scales }

//! The paths of control points against their oracle.

mod common;

common::cases! { "path", folded to 40: random, few_keys, ends }

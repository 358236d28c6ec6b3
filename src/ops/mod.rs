//! Algorithms of several dispatches: plan, scratch, record.

pub mod mlp;

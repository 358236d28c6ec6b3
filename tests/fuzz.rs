//! A short fuzz run, and scenes that failed before.

mod common;

common::cases! { "fuzz": random, regressions }

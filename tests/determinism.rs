//! Two runs of two hundred training steps give the same bits.

mod common;

common::cases! { "determinism": static_training, dynamic_training, path_training }

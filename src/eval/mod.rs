//! How good a result is: camera trajectories against a reference.

mod trajectory;

pub use trajectory::{Align, Statistics, TrajectoryErrors, compare_trajectories, match_by_time};

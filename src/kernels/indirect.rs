//! Dispatch grids computed from counts in device buffers.

use crate::gpu::{Recorder, View, ViewMut, kernel};
use crate::{Result, gpu::Groups};

kernel! {
    /// Turns a count on the device into the grid of a dispatch over that many items.
    pub struct Arguments("indirect/arguments"), workgroup: [1, 1, 1],
    params: ArgumentsParams {
        /// Index of the count in `count`.
        count_at: u32,
        /// Capacity; the count is clamped to it.
        capacity: u32,
        /// Number of items per workgroup.
        per_group: u32,
        /// Largest number of workgroups along one axis; a larger grid is folded.
        group_limit: u32,
        /// Index in `arguments` of the first of the three words.
        arguments_at: u32,
    },
    args: ArgumentsArgs {
        /// Holds the count.
        count: Read<u32>,
        /// Receives the grid.
        arguments: Write<u32>,
    }
}

/// Records [`Arguments`]: writes the grid for `count[count_at]` items (at most `capacity`), `per_group`
/// per workgroup, to `arguments[arguments_at..]`.
///
/// # Errors
/// As for [`Recorder::dispatch`].
pub fn record_arguments(
    recorder: &mut Recorder,
    count: View<'_, u32>,
    count_at: usize,
    capacity: usize,
    per_group: u32,
    arguments: ViewMut<'_, u32>,
    arguments_at: usize,
) -> Result<()> {
    let params = ArgumentsParams {
        count_at: count_at as u32,
        capacity: capacity as u32,
        per_group,
        group_limit: recorder.device().limits().groups,
        arguments_at: arguments_at as u32,
    };
    recorder.dispatch::<Arguments>(Groups([1, 1, 1]), params, ArgumentsArgs { count, arguments })
}

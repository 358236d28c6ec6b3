//! Check cases of indirect dispatch arguments from counts on the device.

use super::{Case, Harness};
use crate::error::Result;
use crate::gpu::Groups;
use crate::kernels::indirect;
use rand::RngExt;

/// The family's cases.
pub const CASES: &[Case] = &[Case { id: "indirect/arguments", run: arguments }];

/// Word offset of the grid in its buffer; the surrounding words must stay unchanged.
const ARGUMENTS_AT: usize = 2;
const POISON: u32 = 0xffff_ffff;

/// One test setting: the count is written on the device; the host sets capacity and workgroup size.
struct Setting {
    count: u32,
    capacity: u32,
    per_group: u32,
}

/// The grid on the device equals the grid that the host would dispatch, on both sides of every
/// threshold:
/// no items, a full group, the limit of one axis, the capacity.
fn arguments(harness: &mut Harness) -> Result<()> {
    let limit = harness.device.limits().groups;
    let mut settings = Vec::new();
    for per_group in [1u32, 64, 256] {
        let axis = limit.saturating_mul(per_group);
        for count in [0, 1, per_group - 1, per_group, per_group + 1, axis - 1, axis] {
            settings.push(Setting { count, capacity: u32::MAX, per_group });
        }
        for count in [axis.saturating_add(1), axis.saturating_mul(2).saturating_add(1)] {
            settings.push(Setting { count, capacity: i32::MAX as u32, per_group });
        }
        settings.push(Setting { count: u32::MAX, capacity: 1000, per_group });
        settings.push(Setting { count: 1000, capacity: 0, per_group });
    }
    for _ in 0..32 {
        // Counts of every magnitude; uniform ones would all be large.
        let count = harness.rng.random::<u32>() >> harness.rng.random_range(0..32u32);
        let per_group = harness.rng.random_range(1..=256u32);
        let capacity = harness.rng.random::<u32>() >> harness.rng.random_range(0..32u32);
        settings.push(Setting { count, capacity, per_group });
    }

    for Setting { count, capacity, per_group } in settings {
        let items = count.min(capacity) as usize;
        let Ok(expected) = Groups::linear(items, per_group, harness.device.limits()) else {
            continue;
        };
        let counts = harness.device.upload("count", &[POISON, count, POISON])?;
        let mut grid = harness.output::<u32>("arguments", ARGUMENTS_AT + 3 + 1)?;
        let mut recorder = harness.stream.record()?;
        indirect::record_arguments(
            &mut recorder,
            counts.view(),
            1,
            capacity as usize,
            per_group,
            grid.view_mut(),
            ARGUMENTS_AT,
        )?;
        harness.stream.submit(recorder)?;
        let got = harness.read(&grid)?;
        let [x, y, z] = expected.0;
        let what = format!("{count} items, at most {capacity}, {per_group} a group");
        harness.exact(&what, &got, &[POISON, POISON, x, y, z, POISON]);
    }
    Ok(())
}

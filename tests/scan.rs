//! Prefix sums on the device.

mod common;

use splat4d::gpu::{Buffer, Device, Profile, Request};
use splat4d::ops::scan::{Scan, ScanArgs};

// Grids of 80 blocks, with a limit of 9 workgroups along an axis.
common::cases! { "scan", folded to 9: sizes, wraps, count_below_capacity }

fn args<'a>(
    count: &'a Buffer<u32>,
    values: &'a Buffer<u32>,
    prefix: &'a mut Buffer<u32>,
    total: &'a mut Buffer<u32>,
) -> ScanArgs<'a> {
    ScanArgs {
        count: count.view(),
        count_at: 0,
        values: values.view(),
        prefix: prefix.view_mut(),
        total: total.view_mut(),
        total_at: 0,
    }
}

/// One workgroup scans 10,000 values under the profile of software drivers, four dispatches do under that
/// of GPUs.
#[test]
fn the_profile_decides_on_the_dispatches() {
    let pipelines = |profile| {
        let request = Request { profile: Some(profile), ..Request::software() };
        let device = Device::open(&request).unwrap();
        let mut stream = device.stream().unwrap();
        let op = Scan::plan(&device, 10_000).unwrap();
        let mut scratch = op.scratch(&device).unwrap();
        let count = device.upload("count", &[10_000u32]).unwrap();
        let values = device.upload("values", &[1u32; 10_000]).unwrap();
        let mut prefix = device.buffer::<u32>("prefix", 10_000).unwrap();
        let mut total = device.buffer::<u32>("total", 1).unwrap();
        let mut recorder = stream.record().unwrap();
        let args = args(&count, &values, &mut prefix, &mut total);
        op.record(&mut recorder, args, &mut scratch).unwrap();
        stream.submit(recorder).unwrap();
        assert_eq!(stream.download(&prefix).unwrap(), (0..10_000).collect::<Vec<_>>());
        device.pipelines()
    };
    assert_eq!(
        Profile::ALL.map(|profile| (profile.name(), pipelines(profile))),
        [("gpu", 4), ("software", 1)]
    );
}

#[test]
fn buffers_that_are_too_short_are_named() {
    let device = common::device();
    let mut stream = device.stream().unwrap();
    let op = Scan::plan(&device, 100).unwrap();
    let mut scratch = op.scratch(&device).unwrap();
    let count = device.upload("count", &[100u32]).unwrap();
    let values = device.buffer::<u32>("values", 100).unwrap();
    let mut prefix = device.buffer::<u32>("prefix", 99).unwrap();
    let mut total = device.buffer::<u32>("total", 1).unwrap();
    let args = args(&count, &values, &mut prefix, &mut total);
    let error = op.record(&mut stream.record().unwrap(), args, &mut scratch).unwrap_err();
    assert_eq!(error.to_string(), "scan: prefix has 99 elements, expected at least 100");
}

//! Tests of devices, buffers, recorders and streams.

mod common;

use splat4d::Error;
use splat4d::gpu::{Detail, Device, DeviceKind, Groups, Profile, Request, Selector};
use splat4d::kernels::indirect;

#[test]
fn buffers_of_every_length_come_back() {
    let device = common::device();
    let mut stream = device.stream().unwrap();
    for len in [0usize, 1, 3, 255, 256, 257, 100_000] {
        let data: Vec<u32> = (0..len as u32).map(|i| i.wrapping_mul(2_654_435_761)).collect();
        let buffer = device.upload("data", &data).unwrap();
        assert_eq!(stream.download(&buffer).unwrap(), data, "length {len}");
    }
    common::assert_valid(&device);
}

#[test]
fn work_that_conflicts_runs_in_order() {
    let device = common::device();
    let mut stream = device.stream().unwrap();
    let mut a = device.buffer::<u32>("a", 1000).unwrap();
    let mut b = device.buffer::<u32>("b", 1000).unwrap();
    let mut recorder = stream.record().unwrap();
    for word in 0..50 {
        recorder.fill(a.view_mut(), word);
        recorder.copy(a.view(), b.view_mut());
        recorder.update(a.range_mut(0..2), &[word + 100, word + 200]).unwrap();
        recorder.copy(a.range(0..2), b.range_mut(8..10));
    }
    stream.submit(recorder).unwrap();
    let got = stream.download(&b).unwrap();
    assert_eq!(&got[..11], [49, 49, 49, 49, 49, 49, 49, 49, 149, 249, 49]);
    common::assert_valid(&device);
}

#[test]
fn copies_between_different_lengths_are_errors() {
    let device = common::device();
    let mut stream = device.stream().unwrap();
    let source = device.upload("source", &[1u32, 2, 3]).unwrap();
    for len in [0usize, 2, 4] {
        let mut target = device.buffer::<u32>("target", len).unwrap();
        let mut recorder = stream.record().unwrap();
        recorder.copy(source.view(), target.view_mut());
        let error = stream.submit(recorder).unwrap_err();
        assert!(matches!(error, Error::Shape { op: "copy", .. }), "{error}");
        assert!(error.to_string().contains(&format!("{len} elements, expected 3")), "{error}");

        let readback = device.readback::<u32>(len).unwrap();
        let mut recorder = stream.record().unwrap();
        recorder.read_back(source.view(), &readback);
        let error = stream.submit(recorder).unwrap_err();
        assert!(matches!(error, Error::Shape { op: "read back", .. }), "{error}");
    }
    let mut nothing = device.buffer::<u32>("nothing", 0).unwrap();
    let mut recorder = stream.record().unwrap();
    recorder.copy(source.range(3..3), nothing.view_mut());
    stream.submit(recorder).unwrap();
    common::assert_valid(&device);
}

#[test]
fn a_readback_is_read_when_the_device_is_done_and_not_before() {
    let device = common::device();
    let (mut stream, mut other) = (device.stream().unwrap(), device.stream().unwrap());
    let source = device.upload("source", &[1u32, 2, 3]).unwrap();
    let mut readback = device.readback::<u32>(3).unwrap();
    let early = |readback: &mut splat4d::gpu::Readback<u32>| {
        let error = readback.read().unwrap_err();
        assert!(matches!(error, Error::Input(_)), "{error}");
        assert!(error.to_string().contains("before the device was known to be done"), "{error}");
    };
    for round in 0..3 {
        // The readback is in flight: recorded, submitted, and waited for on another stream only.
        let mut recorder = stream.record().unwrap();
        recorder.read_back(source.view(), &readback);
        early(&mut readback);
        let ticket = stream.submit(recorder).unwrap();
        early(&mut readback);
        let recorder = other.record().unwrap();
        let unrelated = other.submit(recorder).unwrap();
        other.wait(unrelated).unwrap();
        early(&mut readback);
        match round {
            0 => stream.wait(ticket).unwrap(),
            // Waiting for later work on the stream also completes the readback.
            1 => drop(stream.download(&source).unwrap()),
            _ => {
                stream = device.stream().unwrap();
            }
        }
        assert_eq!(readback.read().unwrap(), [1, 2, 3]);
        let (mut all, mut few) = ([0; 3], [0; 2]);
        readback.read_into(&mut all).unwrap();
        assert_eq!(all, [1, 2, 3]);
        assert!(matches!(readback.read_into(&mut few), Err(Error::Shape { .. })));
    }
    // With two streams, each must be waited for.
    let mut first = stream.record().unwrap();
    first.read_back(source.view(), &readback);
    let first = stream.submit(first).unwrap();
    let mut second = other.record().unwrap();
    second.read_back(source.view(), &readback);
    let second = other.submit(second).unwrap();
    stream.wait(first).unwrap();
    early(&mut readback);
    other.wait(second).unwrap();
    assert_eq!(readback.read().unwrap(), [1, 2, 3]);
    // A discarded recording keeps no resources.
    let mut recorder = stream.record().unwrap();
    recorder.read_back(source.view(), &readback);
    drop(recorder);
    assert_eq!(readback.read().unwrap(), [1, 2, 3]);
    common::assert_valid(&device);
}

#[test]
fn a_buffer_outlives_its_owner_while_in_flight() {
    let device = common::device();
    let mut stream = device.stream().unwrap();
    let mut target = device.buffer::<u32>("target", 1 << 16).unwrap();
    let source = device.upload("source", &vec![7u32; 1 << 16]).unwrap();
    let mut recorder = stream.record().unwrap();
    recorder.copy(source.view(), target.view_mut());
    drop(source);
    stream.submit(recorder).unwrap();
    assert_eq!(stream.download(&target).unwrap(), vec![7u32; 1 << 16]);
    drop(stream);
    let (now, peak) = device.memory();
    assert_eq!(now, 4 << 16, "only the target is left");
    assert!(peak > now);
    common::assert_valid(&device);
}

#[test]
fn grids_come_from_counts_on_the_device() {
    let device = common::device();
    let mut stream = device.stream().unwrap();
    for (count, expected) in [
        (0u32, [0, 1, 1]),
        (1, [1, 1, 1]),
        (256, [1, 1, 1]),
        (257, [2, 1, 1]),
        (256 * 65_535, [65_535, 1, 1]),
        (256 * 65_535 + 1, [65_535, 2, 1]),
        (u32::MAX, [65_535, 123, 1]),
    ] {
        let counts = device.upload("count", &[9, count]).unwrap();
        let mut grid = device.buffer::<u32>("grid", 4).unwrap();
        let mut recorder = stream.record().unwrap();
        let capacity = 2_000_000_000;
        indirect::record_arguments(
            &mut recorder,
            counts.view(),
            1,
            capacity,
            256,
            grid.view_mut(),
            1,
        )
        .unwrap();
        stream.submit(recorder).unwrap();
        let grid = &stream.download(&grid).unwrap()[1..];
        let capped = (count as usize).min(capacity);
        let expected = if count == u32::MAX {
            Groups::linear(capped, 256, device.limits()).unwrap().0
        } else {
            expected
        };
        assert_eq!(grid, expected, "count {count}");
    }
    common::assert_valid(&device);
}

#[test]
fn a_grid_past_the_limit_folds() {
    let mut limits = *common::device().limits();
    limits.groups = 4;
    assert_eq!(Groups::linear(0, 64, &limits).unwrap().0, [0, 1, 1]);
    assert_eq!(Groups::linear(256, 64, &limits).unwrap().0, [4, 1, 1]);
    assert_eq!(Groups::linear(257, 64, &limits).unwrap().0, [4, 2, 1]);
    assert!(Groups::linear(64 * 16 + 1, 64, &limits).is_err());
}

#[test]
fn a_profile_is_that_of_the_kind_of_device_unless_requested() {
    let device = common::device();
    assert_eq!(*device.profile(), Profile::of(device.info().kind));
    assert_eq!(Profile::of(DeviceKind::Software), Profile::SOFTWARE);
    for kind in [DeviceKind::Discrete, DeviceKind::Integrated, DeviceKind::Virtual] {
        assert_eq!(Profile::of(kind), Profile::GPU);
    }
    for profile in Profile::ALL {
        let request = Request { profile: Some(profile), ..Request::software() };
        let device = Device::open(&request).unwrap();
        assert_eq!(*device.profile(), profile);
        assert_eq!(*device.with_limits(*device.limits()).profile(), profile);
    }
}

#[test]
fn kernels_run_with_every_subgroup_size_that_they_can_require() {
    let device = common::device();
    let sizes = device.subgroup_sizes();
    assert!(sizes.iter().all(|size| size.is_power_of_two() && *size >= 4), "{sizes:?}");
    let grid_of = |device: &Device| {
        let mut stream = device.stream().unwrap();
        let counts = device.upload("count", &[1000u32]).unwrap();
        let mut grid = device.buffer::<u32>("grid", 3).unwrap();
        let mut recorder = stream.record().unwrap();
        indirect::record_arguments(&mut recorder, counts.view(), 0, 1000, 10, grid.view_mut(), 0)
            .unwrap();
        stream.submit(recorder).unwrap();
        stream.download(&grid).unwrap()
    };
    let expected = [100, 1, 1];
    assert_eq!(grid_of(&device), expected);
    for (i, &size) in sizes.iter().enumerate() {
        let device = device.with_subgroup_size(size).unwrap();
        assert_eq!(device.subgroup_size(), size);
        assert_eq!(device.with_profile(*device.profile()).subgroup_size(), size);
        assert_eq!(grid_of(&device), expected);
        assert_eq!(device.pipelines(), 2 + i, "a pipeline for each size");
        assert_eq!(grid_of(&device), expected);
        assert_eq!(device.pipelines(), 2 + i, "compiled once");
    }
    assert_eq!(device.subgroup_size(), device.info().subgroup_size);
    let error = device.with_subgroup_size(3).err().expect("no power of two").to_string();
    assert!(error.contains("subgroups of 3"), "{error}");
    common::assert_valid(&device);
}

#[test]
fn a_binding_beyond_the_limit_is_named() {
    let mut limits = *common::device().limits();
    limits.storage_range = 1024;
    let device = Device::open(&Request { limits: Some(limits), ..Request::software() }).unwrap();
    let mut stream = device.stream().unwrap();
    let counts = device.buffer::<u32>("too many counts", 1000).unwrap();
    let mut grid = device.buffer::<u32>("grid", 3).unwrap();
    let mut recorder = stream.record().unwrap();
    let error =
        indirect::record_arguments(&mut recorder, counts.view(), 0, 1, 1, grid.view_mut(), 0)
            .unwrap_err();
    assert!(matches!(error, Error::RangeLimit { bytes: 4000, limit: 1024, .. }));
    assert!(error.to_string().contains("too many counts"), "{error}");
}

#[test]
fn times_come_per_dispatch() {
    let device = common::device();
    if device.limits().timestamp_period == 0.0 {
        println!("SKIPPED (no timestamps): {}", device.info().name);
        return;
    }
    let mut stream = device.stream().unwrap();
    let counts = device.upload("count", &[5u32]).unwrap();
    let mut grid = device.buffer::<u32>("grid", 3).unwrap();
    let mut recorder = stream.record().unwrap();
    recorder.profile().unwrap();
    for _ in 0..3 {
        indirect::record_arguments(&mut recorder, counts.view(), 0, 9, 1, grid.view_mut(), 0)
            .unwrap();
    }
    let ticket = stream.submit(recorder).unwrap();
    let times = stream.times(ticket).unwrap();
    assert_eq!(times.len(), 3);
    assert!(times.iter().all(|t| t.kernel == "indirect/arguments" && t.nanoseconds >= 0.0));
    assert!(stream.times(ticket).is_err(), "a retired submission has no times");
}

#[test]
fn the_meter_adds_up_work_and_leaves_transfers_out() {
    let device = common::device();
    assert!(device.stop_meter().is_none(), "it was never started");
    if !device.start_meter(Detail::Submissions) {
        println!("SKIPPED (no timestamps): {}", device.info().name);
        return;
    }
    let mut stream = device.stream().unwrap();
    let counts = device.upload("count", &vec![5u32; 1 << 20]).unwrap();
    stream.download(&counts).unwrap();
    let transfers = device.stop_meter().unwrap().nanoseconds;
    assert_eq!(transfers, 0.0, "transfers do not count");
    assert!(device.start_meter(Detail::Submissions));
    let mut grid = device.buffer::<u32>("grid", 3).unwrap();
    let begun = std::time::Instant::now();
    for _ in 0..3 {
        let mut recorder = stream.record().unwrap();
        // A profile of the same recording has separate timestamps; the meter works beside it.
        recorder.profile().unwrap();
        indirect::record_arguments(&mut recorder, counts.view(), 0, 9, 1, grid.view_mut(), 0)
            .unwrap();
        let ticket = stream.submit(recorder).unwrap();
        assert_eq!(stream.times(ticket).unwrap().len(), 1);
    }
    let wall = begun.elapsed().as_nanos() as f64;
    let metered = device.stop_meter().unwrap();
    assert!(metered.nanoseconds > 0.0 && metered.nanoseconds <= wall, "{metered:?} of {wall} ns");
    assert_eq!(metered.kernels.len(), 3, "those that were profiled");
    common::assert_valid(&device);
}

#[test]
fn a_device_that_does_not_exist_lists_those_that_do() {
    let request = Request { selector: Selector::Name("no such card".into()), ..Request::default() };
    let error = Device::open(&request).err().expect("no such card exists").to_string();
    assert!(error.contains("there are: 0 "), "{error}");
}

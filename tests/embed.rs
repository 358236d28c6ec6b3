//! The three levels of embedding, on a device that the host owns.

mod common;
mod host;

use host::{Host, camera, gaussians};
use splat4d::embed::ash::vk;
use splat4d::embed::{
    FeatureLinks, Features, Guard, HostBuffer, HostDevice, HostImage, Requirements, SemaphorePoint,
};
use splat4d::gpu::{Buffer, Device, Recorder, Stream, Ticket};
use splat4d::ops::gaussians::GaussianBuffers;
use splat4d::ops::loss::{Loss, LossArgs, LossSettings, Reference};
use splat4d::ops::render::{self, FrameGradients, Render};
use splat4d::ops::texel::{self, Packing};
use splat4d::oracle::texel as oracle;
use splat4d::renderer::{Frame, Renderer, Target};
use splat4d::scene::Scene;
use splat4d::train::Trainer;
use splat4d::types::Image;
use splat4d::{Error, Result, kernels};
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

/// Adopts the host's device.
fn adopt(host: &Host) -> Device {
    // SAFETY: the handles belong together and live as long as the test, which uses the queue from
    // one thread at a time.
    unsafe { Device::adopt(host.lend()) }.unwrap()
}

#[test]
fn what_a_device_lacks_is_named_before_it_is_made() {
    let host = Host::new();
    let needed = Requirements::query();
    assert_eq!(host.lacking(&needed), Vec::<String>::new());
    let greedy = Requirements {
        shared_memory: 1 << 30,
        storage_buffers: 1 << 30,
        workgroup_invocations: 1 << 30,
        ..needed
    };
    let lacking = host.lacking(&greedy);
    assert_eq!(lacking.len(), 3, "{lacking:?}");
    assert!(lacking.iter().any(|what| what.contains("bytes of shared memory")), "{lacking:?}");
    let newer = Requirements { api_version: vk::make_api_version(0, 9, 0, 0), ..needed };
    assert_eq!(host.lacking(&newer).len(), 1);
    for kernel in kernels::ALL {
        assert!(kernel.workgroup.iter().product::<u32>() <= needed.workgroup_invocations);
        assert!(kernel.bindings.len() as u32 <= needed.storage_buffers, "{}", kernel.name);
        let params: usize = kernel.params.iter().map(|param| param.size).sum();
        assert!(params as u32 <= needed.push_constants, "{}", kernel.name);
    }
}

#[test]
fn features_are_read_from_what_a_device_was_made_with() {
    let mut timeline =
        vk::PhysicalDeviceTimelineSemaphoreFeatures::default().timeline_semaphore(true);
    let mut scalar =
        vk::PhysicalDeviceScalarBlockLayoutFeatures::default().scalar_block_layout(true);
    let mut sync = vk::PhysicalDeviceSynchronization2Features::default().synchronization2(true);
    let mut size = vk::PhysicalDeviceSubgroupSizeControlFeatures::default()
        .subgroup_size_control(true)
        .compute_full_subgroups(true);
    let create = vk::DeviceCreateInfo::default()
        .push_next(&mut timeline)
        .push_next(&mut scalar)
        .push_next(&mut sync)
        .push_next(&mut size);
    // SAFETY: the chain consists of local structures.
    assert_eq!(unsafe { Features::enabled_by(&create) }, Features::ALL);
    let none = vk::DeviceCreateInfo::default();
    // SAFETY: there is no chain.
    assert_eq!(unsafe { Features::enabled_by(&none) }, Features::default());
    assert_eq!(Features::default().lacking(&Features::ALL).len(), 5);
}

/// A library that creates the device has begun the `pNext` chain. Its structures must stay, and no
/// structure may occur twice, which Vulkan forbids.
#[test]
fn features_are_turned_on_in_any_chain() {
    let kinds = |create: &vk::DeviceCreateInfo<'_>| {
        let mut next = create.p_next.cast::<vk::BaseInStructure<'_>>();
        let mut kinds = Vec::new();
        while !next.is_null() {
            // SAFETY: the chains below consist of local structures.
            unsafe {
                kinds.push((*next).s_type);
                next = (*next).p_next;
            }
        }
        kinds
    };
    // SAFETY: here and below the chains consist of local structures, each written by one reference at a
    // time.
    unsafe {
        let (mut create, mut links) = (vk::DeviceCreateInfo::default(), FeatureLinks::default());
        Features::ALL.enable_in(&mut create, &mut links);
        assert_eq!(Features::enabled_by(&create), Features::ALL);
        assert_eq!(kinds(&create).len(), 4);

        let mut size =
            vk::PhysicalDeviceSubgroupSizeControlFeatures::default().subgroup_size_control(true);
        let mut other = vk::PhysicalDeviceMaintenance4Features::default().maintenance4(true);
        let mut timeline = vk::PhysicalDeviceTimelineSemaphoreFeatures::default();
        let (mut create, mut links) = (
            vk::DeviceCreateInfo::default()
                .push_next(&mut size)
                .push_next(&mut other)
                .push_next(&mut timeline),
            FeatureLinks::default(),
        );
        let enabled = Features::enabled_by(&create);
        assert_eq!(enabled, Features { subgroup_size_control: true, ..Features::default() });
        Features::ALL.enable_in(&mut create, &mut links);
        assert_eq!(Features::enabled_by(&create), Features::ALL);
        let kinds = kinds(&create);
        assert_eq!(kinds.len(), 5, "{kinds:?}");
        assert!(kinds.iter().enumerate().all(|(k, kind)| !kinds[..k].contains(kind)), "{kinds:?}");
        assert_eq!(other.maintenance4, vk::TRUE);
    }
    // SAFETY: as above.
    unsafe {
        let mut vulkan12 = vk::PhysicalDeviceVulkan12Features::default().shader_int8(true);
        let mut vulkan13 = vk::PhysicalDeviceVulkan13Features::default();
        let (mut create, mut links) = (
            vk::DeviceCreateInfo::default().push_next(&mut vulkan12).push_next(&mut vulkan13),
            FeatureLinks::default(),
        );
        let some = Features { synchronization2: false, ..Features::ALL };
        some.enable_in(&mut create, &mut links);
        assert_eq!(Features::enabled_by(&create), some);
        assert_eq!(kinds(&create).len(), 2);
        assert_eq!((vulkan12.shader_int8, vulkan13.synchronization2), (vk::TRUE, vk::FALSE));
    }
}

/// Checks that adopting fails and that `on_drop` tells the host that its device is unused.
#[track_caller]
fn refused(host: &Host, change: impl FnOnce(&mut HostDevice)) -> Error {
    let dropped = Arc::new(AtomicUsize::new(0));
    let mut lent = host.lend();
    let counter = dropped.clone();
    lent.on_drop = Some(Box::new(move || {
        counter.fetch_add(1, Ordering::SeqCst);
    }));
    change(&mut lent);
    // SAFETY: the only violation is one that the function promises to detect.
    let error = unsafe { Device::adopt(lent) }.err().expect("it must be refused");
    assert_eq!(dropped.load(Ordering::SeqCst), 1, "{error}");
    error
}

#[test]
fn bad_devices_are_refused_by_name() {
    let host = Host::new();
    for (name, error) in [
        ("instance", refused(&host, |lent| lent.instance = vk::Instance::null())),
        ("physical device", refused(&host, |l| l.physical_device = vk::PhysicalDevice::null())),
        ("device", refused(&host, |lent| lent.device = vk::Device::null())),
        ("queue", refused(&host, |lent| lent.queue = vk::Queue::null())),
    ] {
        let text = error.to_string();
        assert!(matches!(error, Error::Input(_)) && text.contains(name), "{name}: {text}");
    }
    let family = refused(&host, |lent| lent.queue_family = 77).to_string();
    assert!(family.contains("queue family 77"), "{family}");
    let feature = refused(&host, |lent| lent.features.synchronization2 = false);
    assert!(matches!(feature, Error::Unsupported { .. }));
    assert!(feature.to_string().contains("synchronization2"), "{feature}");
    let nothing = refused(&host, |lent| lent.features = Features::default()).to_string();
    assert!(nothing.contains("timelineSemaphore, scalarBlockLayout"), "{nothing}");
}

#[test]
fn a_device_made_without_a_feature_is_refused() {
    let host = Host::with(Features { timeline_semaphore: false, ..Features::ALL });
    let error = refused(&host, |_| ()).to_string();
    assert!(error.contains("timelineSemaphore") && error.contains("VkDeviceCreateInfo"), "{error}");
}

#[test]
fn the_host_is_told_once_when_everything_is_gone() {
    let host = Host::new();
    let dropped = Arc::new(AtomicUsize::new(0));
    let (mut lent, counter) = (host.lend(), dropped.clone());
    lent.on_drop = Some(Box::new(move || {
        counter.fetch_add(1, Ordering::SeqCst);
    }));
    // SAFETY: as for `adopt`.
    let device = unsafe { Device::adopt(lent) }.unwrap();
    assert!(device.is_adopted() && !common::device().is_adopted());
    let mut stream = device.stream().unwrap();
    let buffer = device.upload("numbers", &[1u32, 2, 3]).unwrap();
    let clone = device.clone();
    drop(device);
    assert_eq!(stream.download(&buffer).unwrap(), [1, 2, 3]);
    drop(stream);
    drop(clone);
    assert_eq!(dropped.load(Ordering::SeqCst), 0, "a buffer is left");
    drop(buffer);
    assert_eq!(dropped.load(Ordering::SeqCst), 1);
    // The host's device is still alive.
    // SAFETY: nothing is in flight.
    unsafe { host.device.device_wait_idle() }.unwrap();
}

#[test]
fn submissions_take_the_hosts_lock() {
    let host = Host::new();
    let taken = Arc::new(AtomicUsize::new(0));
    let (mut lent, counter) = (host.lend(), taken.clone());
    lent.queue_lock = Some(Box::new(move |work| {
        counter.fetch_add(1, Ordering::SeqCst);
        work();
    }));
    // SAFETY: as for `adopt`.
    let device = unsafe { Device::adopt(lent) }.unwrap();
    device.upload("numbers", &[1u32]).unwrap();
    assert_eq!(taken.load(Ordering::SeqCst), 1);
    let mut lent = host.lend();
    lent.queue_lock = Some(Box::new(|_| ()));
    // SAFETY: as for `adopt`.
    let device = unsafe { Device::adopt(lent) }.unwrap();
    let error = device.upload("numbers", &[1u32]).err().unwrap().to_string();
    assert!(error.contains("lock did not run"), "{error}");
}

/// Renders on a device that the engine creates.
fn reference(scene: &Scene, time: f64) -> (Vec<f32>, Vec<f32>) {
    let device = common::device();
    let camera = camera(70, 50);
    let rendered = Renderer::new(&device, scene).unwrap().render(&camera, time).unwrap();
    (rendered.rgba.pixels, rendered.depth.pixels)
}

#[test]
fn an_adopted_device_gives_the_same_bits() {
    let host = Host::new();
    let scene = Scene::of(gaussians(400));
    let expected = reference(&scene, 0.0);
    let rendered =
        Renderer::new(&adopt(&host), &scene).unwrap().render(&camera(70, 50), 0.0).unwrap();
    assert_eq!((rendered.rgba.pixels, rendered.depth.pixels), expected);
    assert!(expected.0.iter().any(|v| *v > 0.2), "the picture is not empty");
}

#[test]
fn frames_are_drawn_in_the_hosts_command_buffer_into_its_buffer() {
    let host = Host::new();
    let device = adopt(&host);
    let scene = Scene::of(gaussians(400));
    let expected = reference(&scene, 0.0);
    let (pixels, start) = (70 * 50usize, 4096);
    let picture = host.buffer(start + 16 * pixels as u64);
    let depth_buffer = host.buffer(4 * pixels as u64);
    let semaphore = host.semaphore();
    let commands = host.commands();
    {
        let part = HostBuffer { offset: start, bytes: 16 * pixels as u64, ..picture.whole() };
        // SAFETY: the buffers outlive this block, at whose end the device has finished.
        let (mut rgba, mut depth) = unsafe {
            let depth = depth_buffer.whole();
            (
                Buffer::<[f32; 4]>::adopt(&device, "the host's picture", part, None).unwrap(),
                Buffer::<f32>::adopt(&device, "the host's depth", depth, None).unwrap(),
            )
        };
        assert_eq!((rgba.len(), depth.len()), (pixels, pixels));
        let mut renderer = Renderer::new(&device, &scene).unwrap();
        host.begin(commands);
        // The host's earlier writes are ordered before the engine's commands: all of them must be
        // overwritten.
        // SAFETY: the command buffer is recording, and the range is within the buffers.
        unsafe {
            let (from, all) = (picture.buffer, vk::WHOLE_SIZE);
            host.device.cmd_fill_buffer(commands, from, 0, all, 0x7fc0_0000);
        }
        // SAFETY: the command buffer was begun above and is submitted below; the guard outlives the wait.
        let mut recorder = unsafe { Recorder::over(&device, commands) }.unwrap();
        recorder.profile().unwrap();
        let target =
            Target { rgba: Some(rgba.view_mut()), depth: Some(depth.view_mut()), mask: None };
        let frame = renderer.record(&mut recorder, &camera(70, 50), 0.0, target).unwrap();
        let guard = recorder.finish().unwrap();
        host.submit(commands, semaphore, 1);
        host.wait(semaphore, 1);
        let times = guard.times().unwrap();
        assert!(times.iter().any(|time| time.kernel == "raster/forward"), "{times:?}");
        drop(guard);
        assert!(renderer.retire(frame).unwrap().is_whole());
    }
    assert_eq!(picture.floats(start, 4 * pixels), expected.0);
    assert_eq!(depth_buffer.floats(0, pixels), expected.1);
    assert!(picture.floats(0, 8).iter().all(|v| v.is_nan()), "the host's part before stays");
    drop(device);
    host.free(picture);
    host.free(depth_buffer);
    host.destroy_semaphore(semaphore);
}

/// Renderer, scratch and device may be dropped while commands that use them are in flight.
#[test]
fn a_guard_keeps_what_its_commands_use() {
    let host = Host::new();
    let dropped = Arc::new(AtomicUsize::new(0));
    let (mut lent, counter) = (host.lend(), dropped.clone());
    lent.on_drop = Some(Box::new(move || {
        counter.fetch_add(1, Ordering::SeqCst);
    }));
    let semaphore = host.semaphore();
    let commands = host.commands();
    let guard = {
        // SAFETY: as for `adopt`.
        let device = unsafe { Device::adopt(lent) }.unwrap();
        let mut renderer = Renderer::new(&device, &Scene::of(gaussians(100))).unwrap();
        host.begin(commands);
        // SAFETY: the command buffer has begun and is submitted once; the guard outlives the wait.
        let mut recorder = unsafe { Recorder::over(&device, commands) }.unwrap();
        let frame = renderer.record(&mut recorder, &camera(70, 50), 0.0, Target::default());
        let _never_retired = frame.unwrap();
        recorder.finish().unwrap()
    };
    host.submit(commands, semaphore, 1);
    host.wait(semaphore, 1);
    assert_eq!(dropped.load(Ordering::SeqCst), 0, "the guard is left");
    drop(guard);
    assert_eq!(dropped.load(Ordering::SeqCst), 1);
    host.destroy_semaphore(semaphore);
}

/// The image is copied as floats, and converted to eight bits as for a window.
#[test]
fn a_picture_goes_into_the_hosts_image() {
    let host = Host::new();
    let device = adopt(&host);
    let scene = Scene::of(gaussians(300));
    let expected = reference(&scene, 0.0).0;
    let semaphore = host.semaphore();
    let commands = host.commands();
    let back = [host.buffer(16 * 70 * 50), host.buffer(4 * 70 * 50)];
    let formats = [vk::Format::R32G32B32A32_SFLOAT, vk::Format::B8G8R8A8_SRGB];
    let info = vk::ImageCreateInfo::default()
        .image_type(vk::ImageType::TYPE_2D)
        .extent(vk::Extent3D { width: 80, height: 60, depth: 1 })
        .mip_levels(1)
        .array_layers(1)
        .samples(vk::SampleCountFlags::TYPE_1)
        .usage(vk::ImageUsageFlags::TRANSFER_DST | vk::ImageUsageFlags::TRANSFER_SRC);
    let range = vk::ImageSubresourceRange::default()
        .aspect_mask(vk::ImageAspectFlags::COLOR)
        .level_count(1)
        .layer_count(1);
    // SAFETY: valid Vulkan usage.
    let images = formats.map(|format| unsafe {
        let image = host.device.create_image(&info.format(format), None).unwrap();
        let needs = host.device.get_image_memory_requirements(image);
        let memory = host.allocate(needs, vk::MemoryPropertyFlags::empty());
        host.device.bind_image_memory(image, memory, 0).unwrap();
        (image, memory)
    });
    let mut renderer = Renderer::new(&device, &scene).unwrap();
    let mut texels = device.buffer::<u32>("texels", 70 * 50).unwrap();
    host.begin(commands);
    let transition = |from, to| {
        let barriers = images.map(|(image, _)| {
            vk::ImageMemoryBarrier2::default()
                .src_stage_mask(vk::PipelineStageFlags2::ALL_COMMANDS)
                .src_access_mask(vk::AccessFlags2::MEMORY_WRITE)
                .dst_stage_mask(vk::PipelineStageFlags2::ALL_COMMANDS)
                .dst_access_mask(vk::AccessFlags2::MEMORY_READ | vk::AccessFlags2::MEMORY_WRITE)
                .old_layout(from)
                .new_layout(to)
                .src_queue_family_index(vk::QUEUE_FAMILY_IGNORED)
                .dst_queue_family_index(vk::QUEUE_FAMILY_IGNORED)
                .image(image)
                .subresource_range(range)
        });
        let info = vk::DependencyInfo::default().image_memory_barriers(&barriers);
        // SAFETY: the command buffer is recording.
        unsafe { host.device.cmd_pipeline_barrier2(commands, &info) };
    };
    let (undefined, written, read) = (
        vk::ImageLayout::UNDEFINED,
        vk::ImageLayout::TRANSFER_DST_OPTIMAL,
        vk::ImageLayout::TRANSFER_SRC_OPTIMAL,
    );
    transition(undefined, written);
    // SAFETY: the command buffer was begun above and is submitted below; the guard outlives the wait.
    let mut recorder = unsafe { Recorder::over(&device, commands) }.unwrap();
    let frame = renderer.record(&mut recorder, &camera(70, 50), 0.0, Target::default()).unwrap();
    let to = images.map(|(image, _)| HostImage {
        image,
        layout: written,
        mip_level: 0,
        array_layer: 0,
        offset: [7, 5],
    });
    let rgba = renderer.pixels().unwrap().rgba.view();
    let packing = Packing { background: [0.2, 0.4, 0.6, 1.0], blue_first: true };
    texel::unorm8(&mut recorder, rgba, &packing, texels.view_mut()).unwrap();
    // SAFETY: the images belong to this device, are large enough, and are in that layout.
    unsafe {
        let null = HostImage { image: vk::Image::null(), ..to[0] };
        assert!(recorder.copy_to_image(rgba, &null, 70, 50).is_err());
        let unwritable = HostImage { layout: undefined, ..to[0] };
        assert!(recorder.copy_to_image(rgba, &unwritable, 70, 50).is_err());
        assert!(recorder.copy_to_image(rgba, &to[0], 71, 50).is_err());
        recorder.copy_to_image(rgba, &to[0], 70, 50).unwrap();
        recorder.copy_to_image(texels.view(), &to[1], 70, 50).unwrap();
    }
    let guard = recorder.finish().unwrap();
    transition(written, read);
    let region = [vk::BufferImageCopy::default()
        .image_subresource(
            vk::ImageSubresourceLayers::default()
                .aspect_mask(vk::ImageAspectFlags::COLOR)
                .layer_count(1),
        )
        .image_offset(vk::Offset3D { x: 7, y: 5, z: 0 })
        .image_extent(vk::Extent3D { width: 70, height: 50, depth: 1 })];
    for ((image, _), back) in images.iter().zip(&back) {
        // SAFETY: the command buffer is recording, and the range is within the buffers.
        unsafe {
            host.device.cmd_copy_image_to_buffer(commands, *image, read, back.buffer, &region);
        }
    }
    host.submit(commands, semaphore, 1);
    host.wait(semaphore, 1);
    drop(guard);
    assert!(renderer.retire(frame).unwrap().is_whole());
    assert_eq!(back[0].floats(0, 4 * 70 * 50), expected);
    let bytes = back[1].floats(0, 70 * 50).into_iter().map(|word| word.to_bits().to_le_bytes());
    for (at, ([b, g, r, a], pixel)) in bytes.zip(expected.chunks_exact(4)).enumerate() {
        let pixel = std::array::from_fn(|k| f64::from(pixel[k]));
        let exact = oracle::over(pixel, packing.background.map(f64::from)).map(oracle::level);
        let near = |(byte, exact): (&u8, f64)| (f64::from(*byte) - exact).abs() <= 0.5001;
        assert!([r, g, b, a].iter().zip(exact).all(near), "{at}: {:?}, {exact:?}", [r, g, b, a]);
    }
    drop((renderer, texels, device));
    for (image, memory) in images {
        // SAFETY: the device no longer uses them.
        unsafe {
            host.device.destroy_image(image, None);
            host.device.free_memory(memory, None);
        }
    }
    for back in back {
        host.free(back);
    }
    host.destroy_semaphore(semaphore);
}

#[test]
fn submissions_wait_for_the_hosts_semaphores_and_signal_them() {
    let host = Host::new();
    let (start, done) = (host.semaphore(), host.semaphore());
    {
        let device = adopt(&host);
        let mut stream = device.stream().unwrap();
        let mut buffer = device.buffer::<u32>("filled", 64).unwrap();
        let mut recorder = stream.record().unwrap();
        recorder.fill(buffer.view_mut(), 5);
        let waits = [SemaphorePoint { semaphore: start, value: 3 }];
        let signals = [SemaphorePoint { semaphore: done, value: 9 }];
        // SAFETY: the semaphores live until the end, and the value that is waited for is signalled below.
        let ticket = unsafe { stream.submit_between(recorder, &waits, &signals) }.unwrap();
        // SAFETY: the semaphores are alive.
        unsafe {
            assert_eq!(host.device.get_semaphore_counter_value(done).unwrap(), 0);
            let own = stream.semaphore();
            assert!(host.device.get_semaphore_counter_value(own).unwrap() < ticket.value());
            let info = vk::SemaphoreSignalInfo::default().semaphore(start).value(3);
            host.device.signal_semaphore(&info).unwrap();
        }
        host.wait(done, 9);
        host.wait(stream.semaphore(), ticket.value());
        assert_eq!(stream.download(&buffer).unwrap(), [5; 64]);
        let recorder = stream.record().unwrap();
        let null = [SemaphorePoint { semaphore: vk::Semaphore::null(), value: 1 }];
        // SAFETY: the null handle is refused.
        assert!(unsafe { stream.submit_between(recorder, &null, &[]) }.is_err());
    }
    host.destroy_semaphore(start);
    host.destroy_semaphore(done);
}

#[test]
fn bad_buffers_are_refused_by_name() {
    let host = Host::new();
    let device = adopt(&host);
    let lent = host.buffer(4096);
    let whole = lent.whole();
    let refuse = |change: HostBuffer| -> String {
        let told = Arc::new(AtomicUsize::new(0));
        let counter = told.clone();
        let on_drop: Box<dyn FnOnce() + Send + Sync> = Box::new(move || {
            counter.fetch_add(1, Ordering::SeqCst);
        });
        // SAFETY: the only violation is one that the function promises to detect.
        let adopted =
            unsafe { Buffer::<[f32; 4]>::adopt(&device, "scores", change, Some(on_drop)) };
        let error = adopted.err().expect("it must be refused");
        assert!(matches!(error, Error::Input(_)));
        assert_eq!(told.load(Ordering::SeqCst), 1, "{error}");
        error.to_string()
    };
    let without = vk::BufferUsageFlags::TRANSFER_SRC | vk::BufferUsageFlags::TRANSFER_DST;
    for (change, says) in [
        (HostBuffer { buffer: vk::Buffer::null(), ..whole }, "null"),
        (HostBuffer { usage: without, ..whole }, "without the usage STORAGE_BUFFER"),
        (HostBuffer { bytes: 1 << 30, ..whole }, "the whole has"),
        (HostBuffer { offset: 4096, ..whole }, "the whole has"),
        (HostBuffer { offset: u64::MAX - 4095, ..whole }, "the whole has"),
        (HostBuffer { offset: 2, ..whole }, "not a multiple of"),
        (HostBuffer { bytes: 24, ..whole }, "whole elements of 16"),
        (HostBuffer { bytes: 0, ..whole }, "whole words, and some"),
    ] {
        let error = refuse(change);
        assert!(error.contains(says) && error.contains("scores"), "{says}: {error}");
    }
    // SAFETY: the part lies within the buffer, and the device finishes before the buffer is freed.
    let part = unsafe {
        let part = HostBuffer { offset: 256, bytes: 64, ..whole };
        Buffer::<u32>::adopt(&device, "grid", part, None)
    };
    let mut part = part.unwrap();
    let handle = part.handle();
    assert_eq!((handle.buffer, handle.offset, handle.bytes), (lent.buffer, 256, 64));
    // Indirect arguments need a separate buffer usage flag.
    let mut stream = device.stream().unwrap();
    let count = device.upload("count", &[5u32]).unwrap();
    let (mut sums, mut values) =
        (device.buffer("sums", 8).unwrap(), device.buffer("values", 8).unwrap());
    let mut recorder = stream.record().unwrap();
    recorder.fill(values.view_mut(), 1);
    let refused = recorder.dispatch_indirect::<kernels::scan::Reduce>(
        &part,
        0,
        kernels::scan::ReduceParams { count_at: 0, capacity: 8 },
        kernels::scan::ReduceArgs {
            count: count.view(),
            values: values.view(),
            sums: sums.view_mut(),
        },
    );
    assert!(refused.unwrap_err().to_string().contains("INDIRECT_BUFFER"));
    recorder.fill(part.view_mut(), 77);
    stream.submit(recorder).unwrap();
    assert_eq!(stream.download(&part).unwrap(), [77; 16]);
    drop((part, count, sums, values, stream, device));
    host.free(lent);
}

/// One device exports memory, another imports it and writes to it, and the first reads the result.
#[cfg(unix)]
#[test]
fn exported_memory_is_shared() {
    use splat4d::embed::ImportedMemory;
    let (owner, host) = (Host::new(), Host::new());
    if !owner.external_memory_fd {
        println!("SKIPPED (no VK_KHR_external_memory_fd)");
        return;
    }
    let device = adopt(&host);
    let exported = owner.export(8192);
    let memory = |offset| ImportedMemory {
        fd: exported.fd.try_clone().unwrap(),
        allocation_bytes: exported.bytes,
        memory_type: exported.memory_type,
        offset,
    };
    // SAFETY: the memory is an opaque export of the same physical device and driver, and one device uses
    // it at a time.
    let import = |memory| unsafe { Buffer::<u32>::import_fd(&device, "shared", memory, 8) };
    for (wrong, says) in [
        (ImportedMemory { offset: 8192, ..memory(0) }, "the allocation has 8192"),
        (ImportedMemory { offset: 2, ..memory(0) }, "not a multiple of"),
        (ImportedMemory { memory_type: 32, ..memory(0) }, "memory type 32 does not exist"),
    ] {
        let error = import(wrong).err().expect("it must be refused").to_string();
        assert!(error.contains(says), "{says}: {error}");
    }
    let mut shared = import(memory(4096)).unwrap();
    let mut stream = device.stream().unwrap();
    let mut recorder = stream.record().unwrap();
    recorder.fill(shared.view_mut(), 77);
    stream.submit(recorder).unwrap();
    assert_eq!(stream.download(&shared).unwrap(), [77; 8]);
    drop((shared, stream, device));
    // SAFETY: the memory is mapped and at least that long, and nothing writes to it any more; the device
    // no longer uses it when it is freed.
    unsafe {
        let words = std::slice::from_raw_parts(exported.mapped.cast::<u32>(), 2048);
        assert!(words.iter().enumerate().all(|(i, w)| *w == 77 * u32::from(i / 8 == 128)));
        owner.device.free_memory(exported.memory, None);
    }
}

#[cfg(unix)]
#[test]
fn memory_is_not_imported_without_the_extension() {
    use splat4d::embed::ImportedMemory;
    let host = Host::new();
    // SAFETY: as for `adopt`.
    let device =
        unsafe { Device::adopt(HostDevice { external_memory_fd: false, ..host.lend() }) }.unwrap();
    let memory = ImportedMemory {
        fd: std::fs::File::open("/dev/null").unwrap().into(),
        allocation_bytes: 4096,
        memory_type: 0,
        offset: 0,
    };
    // SAFETY: the import is refused before the descriptor is used, since the host has not enabled the
    // extension.
    let refused = unsafe { Buffer::<u32>::import_fd(&device, "shared", memory, 8) };
    let error = refused.err().unwrap();
    assert!(matches!(error, Error::Unsupported { .. }), "{error}");
    assert!(error.to_string().contains("VK_KHR_external_memory_fd"), "{error}");
}

#[test]
fn recordings_end_where_they_belong() {
    let host = Host::new();
    let device = adopt(&host);
    let mut stream = device.stream().unwrap();
    // SAFETY: the null handle is refused.
    let null = unsafe { Recorder::over(&device, vk::CommandBuffer::null()) };
    assert!(null.err().unwrap().to_string().contains("null"));
    assert!(stream.record().unwrap().finish().is_err());
    let commands = host.commands();
    host.begin(commands);
    // SAFETY: the command buffer has begun and is never submitted.
    let recorder = unsafe { Recorder::over(&device, commands) }.unwrap();
    assert!(stream.submit(recorder).err().unwrap().to_string().contains("finish"));
    // SAFETY: the command buffer is never submitted.
    unsafe { host.device.end_command_buffer(commands) }.unwrap();
    let scene = Scene::of(gaussians(5));
    let [mut renderer, mut other] = [(); 2].map(|()| Renderer::new(&device, &scene).unwrap());
    let mut recorder = stream.record().unwrap();
    let target = Target::default();
    let frame = renderer.record(&mut recorder, &camera(8, 8), 0.0, target).unwrap();
    let ticket = stream.submit(recorder).unwrap();
    stream.wait(ticket).unwrap();
    assert!(other.retire(frame).unwrap_err().to_string().contains("another renderer"));
}

#[test]
fn memory_of_another_device_is_refused() {
    let (host, own) = (Host::new(), common::device());
    let device = adopt(&host);
    let mut foreign_buffer = own.buffer::<u32>("foreign", 8).unwrap();
    let mut mine = device.buffer::<u32>("mine", 8).unwrap();
    let mut stream = device.stream().unwrap();
    let mut recorder = stream.record().unwrap();
    recorder.fill(foreign_buffer.view_mut(), 1);
    let error = stream.submit(recorder).err().unwrap().to_string();
    assert!(error.contains("foreign was made on another device"), "{error}");
    let mut recorder = stream.record().unwrap();
    recorder.copy(mine.view(), foreign_buffer.view_mut());
    assert!(stream.submit(recorder).is_err());
    let mut recorder = stream.record().unwrap();
    assert!(recorder.update(foreign_buffer.view_mut(), &[1]).is_err());
    let wrong = kernels::scan::ReduceArgs {
        count: foreign_buffer.view(),
        values: foreign_buffer.view(),
        sums: mine.view_mut(),
    };
    let params = kernels::scan::ReduceParams { count_at: 0, capacity: 8 };
    let groups = splat4d::gpu::Groups([1, 1, 1]);
    assert!(recorder.dispatch::<kernels::scan::Reduce>(groups, params, wrong).is_err());
    assert!(own.stream().unwrap().submit(recorder).is_err());
    common::assert_valid(&own);
}

#[test]
fn threads_record_at_once_on_one_device() {
    let host = Host::new();
    let scene = Scene::of(gaussians(200));
    let expected = reference(&scene, 0.0);
    let mut lent = host.lend();
    let lock = Arc::new(std::sync::Mutex::new(()));
    let shared = lock.clone();
    lent.queue_lock = Some(Box::new(move |work| {
        let _held = shared.lock().unwrap();
        work();
    }));
    // SAFETY: as for `adopt`, and every use of the queue holds the lock.
    let device = unsafe { Device::adopt(lent) }.unwrap();
    std::thread::scope(|scope| {
        for _ in 0..4 {
            scope.spawn(|| {
                let mut renderer = Renderer::new(&device, &scene).unwrap();
                for _ in 0..5 {
                    let rendered = renderer.render(&camera(70, 50), 0.0).unwrap();
                    assert_eq!((rendered.rgba.pixels, rendered.depth.pixels), expected);
                }
            });
        }
    });
}

#[test]
fn what_goes_to_other_threads_says_so() {
    fn send<T: Send>() {}
    fn share<T: Send + Sync>() {}
    share::<Device>();
    share::<Buffer<f32>>();
    share::<Render>();
    share::<render::Frame<FrameGradients>>();
    share::<Scene>();
    share::<Ticket>();
    share::<Error>();
    send::<Recorder>();
    send::<Stream>();
    send::<Guard>();
    send::<Frame>();
    send::<Renderer>();
    send::<Trainer>();
}

/// Two scenes and two devices at once, dropped in the least favourable order.
#[test]
fn several_scenes_on_several_devices() -> Result<()> {
    let (host, own) = (Host::new(), common::device());
    let device = adopt(&host);
    let scenes = [Scene::of(gaussians(100)), Scene::of(gaussians(250))];
    let mut all = Vec::new();
    for device in [&device, &own] {
        for scene in &scenes {
            all.push(Renderer::new(device, scene)?);
        }
    }
    drop(device);
    let pictures = all
        .iter_mut()
        .map(|renderer| Ok(renderer.render(&camera(70, 50), 0.0)?.rgba.pixels))
        .collect::<Result<Vec<_>>>()?;
    assert_eq!(pictures[0], pictures[2]);
    assert_eq!(pictures[1], pictures[3]);
    assert_ne!(pictures[0], pictures[1]);
    all.swap(0, 3);
    drop(all);
    common::assert_valid(&own);
    Ok(())
}

/// The order of dispatches that the documentation of the ops lists, by which hosts assign timestamps.
#[test]
fn dispatches_come_in_the_documented_order() -> Result<()> {
    // The single-pass scan, which every device uses for few values.
    const SCAN: [&str; 1] = ["scan/single"];
    let sort = |bits: u32| {
        let mut all = vec!["sort/plan"];
        for _ in 0..bits.div_ceil(8) {
            all.push("sort/count");
            all.extend(SCAN);
            all.push("sort/scatter");
        }
        all
    };
    let device = common::device();
    let mut stream = device.stream()?;
    let scene = gaussians(50);
    let camera = camera(70, 50);
    let buffers = GaussianBuffers::from_host(&mut stream, &scene)?;
    let render = Render::plan(&device, 50, 1 << 14, 70, 50, Default::default())?;
    let mut frame = render.differentiable(&device)?;
    let mut gradients = GaussianBuffers::new(&device, 50, 0)?;
    let mut recorder = stream.record()?;
    recorder.profile()?;
    let views = buffers.views();
    frame.forward(&mut recorder, &camera, views, Default::default())?;
    frame.backward(&mut recorder, views, Default::default(), &mut gradients, true)?;
    let ticket = stream.submit(recorder)?;
    let found: Vec<_> = stream.times(ticket)?.into_iter().map(|time| time.kernel).collect();
    let reference = Reference::new(&device, &Image::new(70, 50, 3), None)?;
    let loss = Loss::plan(&device, 70, 50);
    let mut scratch = loss.scratch(&device)?;
    let render::Frame { pixels, gradients: by, .. } = &mut frame;
    let how = LossSettings::default();
    let mut recorder = stream.record()?;
    recorder.profile()?;
    let args = LossArgs {
        rendered: pixels,
        reference: &reference,
        disparity: None,
        gradients: &mut by.pixels,
    };
    loss.record(&mut recorder, &how, args, &mut scratch)?;
    let ticket = stream.submit(recorder)?;
    let losses: Vec<_> = stream.times(ticket)?.into_iter().map(|time| time.kernel).collect();
    let expected = ["columns", "ssim", "ssim", "ssim", "total", "gradient", "total"];
    assert_eq!(losses, expected.map(|stem| format!("loss/{stem}")));
    // 5 × 4 tiles, and one past the end.
    let expected = [
        vec!["project/forward"],
        SCAN.to_vec(),
        vec!["bin/compact"],
        sort(31),
        vec!["bin/counts"],
        SCAN.to_vec(),
        vec!["bin/emit", "bin/fits"],
        sort(5),
        vec!["indirect/arguments", "bin/ranges", "raster/forward"],
        vec!["raster/backward_narrow", "raster/gather", "project/backward", "project/pose"],
    ];
    assert_eq!(found, expected.concat());
    common::assert_valid(&device);
    Ok(())
}

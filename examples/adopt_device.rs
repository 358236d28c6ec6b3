//! Renders on a Vulkan device that the program made itself, into a command buffer of its own.
//!
//! ```sh
//! cargo run --release --example adopt_device -- adopted.png
//! ```
//!
//! This is the whole contract on plain `ash`: what the engine needs of a device, how it is lent, how the
//! engine records into the program's command buffer, and when the recording's resources are free again.
//! `examples/wgpu-host` is the same with wgpu, a window's texture and drawing of its own.

use splat4d::data::write_png;
use splat4d::embed::ash::{self, vk};
use splat4d::embed::{Features, HostDevice, Requirements};
use splat4d::gpu::{Device, Recorder};
use splat4d::renderer::{Renderer, Target};
use splat4d::scene::Scene;
use splat4d::types::{Camera, Gaussians, Intrinsics, Pose};
use std::error::Error;

fn main() -> Result<(), Box<dyn Error>> {
    let output = std::env::args().nth(1).ok_or("usage: adopt_device IMAGE.png")?;
    // SAFETY: the loader is the system's, and lives until the end of the program.
    let entry = unsafe { ash::Entry::load() }?;
    let application = vk::ApplicationInfo::default().api_version(vk::API_VERSION_1_3);
    let info = vk::InstanceCreateInfo::default().application_info(&application);
    // SAFETY: what `info` points at lives.
    let instance = unsafe { entry.create_instance(&info, None) }?;
    let done = render(&entry, &instance, &output);
    // SAFETY: `render` has destroyed everything that it made from the instance.
    unsafe { instance.destroy_instance(None) };
    done
}

fn render(
    entry: &ash::Entry,
    instance: &ash::Instance,
    output: &str,
) -> Result<(), Box<dyn Error>> {
    let get_instance_proc_addr = entry.static_fn().get_instance_proc_addr;
    // The first device that has all that the engine needs.
    let needed = Requirements::query();
    let mut chosen = None;
    // SAFETY: the instance lives.
    for physical_device in unsafe { instance.enumerate_physical_devices() }? {
        // SAFETY: the three belong together.
        let lacking =
            unsafe { needed.lacking(get_instance_proc_addr, instance.handle(), physical_device) }?;
        match lacking.is_empty() {
            true => chosen = chosen.or(Some(physical_device)),
            false => println!("a device lacks {}", lacking.join(", ")),
        }
    }
    let physical_device = chosen.ok_or("no Vulkan device has what the engine needs")?;
    // SAFETY: the physical device is the instance's.
    let families = unsafe { instance.get_physical_device_queue_family_properties(physical_device) };
    let queue_family = families
        .iter()
        .position(|family| family.queue_flags.contains(vk::QueueFlags::COMPUTE))
        .ok_or("the device has no queue for compute")? as u32;

    let (mut vulkan12, mut vulkan13) = Default::default();
    Features::ALL.enable(&mut vulkan12, &mut vulkan13);
    let queues = [vk::DeviceQueueCreateInfo::default()
        .queue_family_index(queue_family)
        .queue_priorities(&[1.0])];
    let create = vk::DeviceCreateInfo::default()
        .queue_create_infos(&queues)
        .push_next(&mut vulkan12)
        .push_next(&mut vulkan13);
    // SAFETY: the chain lives; the features are the device's, as `lacking` has checked.
    let (device, queue, features) = unsafe {
        let device = instance.create_device(physical_device, &create, None)?;
        let queue = device.get_device_queue(queue_family, 0);
        (device, queue, Features::enabled_by(&create))
    };
    let lent = HostDevice {
        get_instance_proc_addr,
        instance: instance.handle(),
        physical_device,
        device: device.handle(),
        queue,
        queue_family,
        features,
        external_memory_fd: false,
        queue_lock: None,
        on_drop: None,
    };
    let done = draw(&device, queue, lent, output);
    // SAFETY: `draw` has dropped the engine and destroyed its own objects.
    unsafe { device.destroy_device(None) };
    done
}

/// One frame, recorded by the engine into a command buffer of the program's.
fn draw(
    device: &ash::Device,
    queue: vk::Queue,
    lent: HostDevice,
    output: &str,
) -> Result<(), Box<dyn Error>> {
    let info = vk::CommandPoolCreateInfo::default().queue_family_index(lent.queue_family);
    // SAFETY: the handles belong together and outlive the engine, which is dropped in this function; this
    // thread alone uses the queue.
    let engine = unsafe { Device::adopt(lent) }?;
    println!("device: {}", engine.info().name);
    let scene = Scene::of(ball());
    let mut renderer = Renderer::new(&engine, &scene)?;
    let camera = Camera {
        intrinsics: Intrinsics {
            fx: 400.0,
            fy: 400.0,
            cx: 200.0,
            cy: 150.0,
            width: 400,
            height: 300,
        },
        view_from_world: Pose::IDENTITY,
    };
    // A frame of unknown size: the (splat, tile) pairs are counted first, so that the first one fits.
    let pairs = renderer.count(&camera, 0.0)?;
    renderer.reserve(usize::try_from(pairs)?);

    // SAFETY: plain Vulkan on the program's device; the pool is destroyed after the queue is idle.
    unsafe {
        let pool = device.create_command_pool(&info, None)?;
        let info =
            vk::CommandBufferAllocateInfo::default().command_pool(pool).command_buffer_count(1);
        let commands = device.allocate_command_buffers(&info)?[0];
        device.begin_command_buffer(commands, &vk::CommandBufferBeginInfo::default())?;
        let mut recorder = Recorder::over(&engine, commands)?;
        let frame = renderer.record(&mut recorder, &camera, 0.0, Target::default())?;
        // The guard keeps alive what the commands use.
        let guard = recorder.finish()?;
        device.end_command_buffer(commands)?;
        let buffers = [commands];
        let submit = [vk::SubmitInfo::default().command_buffers(&buffers)];
        device.queue_submit(queue, &submit, vk::Fence::null())?;
        device.queue_wait_idle(queue)?;
        drop(guard);
        let drawn = renderer.retire(frame)?;
        println!("every splat was drawn: {}", drawn.is_whole());
        device.destroy_command_pool(pool, None);
    }
    let pixels = renderer.pixels().ok_or("nothing was drawn")?;
    let rgba = engine.stream()?.download(&pixels.rgba)?;
    let image = splat4d::types::Image {
        width: 400,
        height: 300,
        channels: 3,
        pixels: rgba.iter().flat_map(|&[r, g, b, a]| [r, g, b].map(|v| v + 1.0 - a)).collect(),
    };
    Ok(write_png(output, &image)?)
}

/// 3,000 Gaussians on a unit ball three units in front of the camera, coloured by position.
fn ball() -> Gaussians {
    let count = 3000;
    let on_ball = |i: usize| {
        let (y, angle) = (2.0 * i as f32 / count as f32 - 1.0, 2.4 * i as f32);
        [(1.0 - y * y).sqrt() * angle.cos(), y, (1.0 - y * y).sqrt() * angle.sin()]
    };
    Gaussians {
        positions: (0..count).map(on_ball).map(|[x, y, z]| [x, y, z + 3.0]).collect(),
        log_scales: vec![[-3.0; 3]; count],
        rotations: vec![[1.0, 0.0, 0.0, 0.0]; count],
        opacity_logits: vec![2.0; count],
        sh: (0..count).map(on_ball).collect(),
        ..Gaussians::default()
    }
}

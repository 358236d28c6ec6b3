//! Creates a wgpu device with the features that the engine needs, and lends it to the engine.

use crate::Result;
use splat4d::embed::ash::{ext, vk};
use splat4d::embed::{FeatureLinks, Features, HostDevice, Requirements};
use std::ops::Deref;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use wgpu::hal::api::Vulkan;
use wgpu::hal::vulkan::CreateInstanceCallback;

/// The host's device, and the engine on it.
pub struct Gpu {
    pub device: wgpu::Device,
    pub queue: wgpu::Queue,
    pub engine: splat4d::gpu::Device,
    /// Guards the queue, which wgpu and the engine share. Held during every use of the queue.
    pub turn: Arc<Mutex<()>>,
    /// Set when the engine has released the device (`HostDevice::on_drop`).
    pub given_back: Arc<AtomicBool>,
}

/// Creates the wgpu instance. With validation it is created through wgpu-hal with `VK_EXT_debug_utils` added:
/// wgpu's debug flag would enable that extension too, but would also embed the shader source in the SPIR-V,
/// with a source language that older validation layers report.
pub fn instance(validation: bool) -> Result<wgpu::Instance> {
    if !validation {
        return Ok(wgpu::Instance::new(wgpu::InstanceDescriptor {
            backends: wgpu::Backends::VULKAN,
            flags: wgpu::InstanceFlags::empty(),
            ..wgpu::InstanceDescriptor::new_without_display_handle()
        }));
    }
    let descriptor = wgpu::hal::InstanceDescriptor {
        name: "wgpu-host",
        flags: wgpu::InstanceFlags::VALIDATION,
        memory_budget_thresholds: Default::default(),
        backend_options: Default::default(),
        telemetry: None,
        display: None,
    };
    let callback: Box<CreateInstanceCallback<'_>> =
        Box::new(|arguments| arguments.extensions.push(ext::debug_utils::NAME));
    // SAFETY: the callback only adds an extension; a missing extension is an error.
    let hal =
        unsafe { wgpu::hal::vulkan::Instance::init_with_callback(&descriptor, Some(callback)) };
    // SAFETY: the instance was created above.
    Ok(unsafe { wgpu::Instance::from_hal::<Vulkan>(hal?) })
}

pub fn adapter(instance: &wgpu::Instance) -> Result<wgpu::Adapter> {
    let options = wgpu::RequestAdapterOptions::default();
    let adapter = pollster::block_on(instance.request_adapter(&options));
    adapter.map_err(|error| format!("wgpu finds no Vulkan device: {error}").into())
}

/// The wgpu-hal adapter behind a wgpu adapter.
///
/// # Safety
/// As for [`wgpu::Adapter::as_hal`].
pub unsafe fn vulkan(
    adapter: &wgpu::Adapter,
) -> Result<impl Deref<Target = wgpu::hal::vulkan::Adapter>> {
    // SAFETY: the caller guarantees it.
    unsafe { adapter.as_hal::<Vulkan>() }.ok_or_else(|| "the adapter is not Vulkan's".into())
}

impl Gpu {
    /// Creates the device as wgpu would, with the engine's features added, and lends it to the engine.
    pub fn open(adapter: &wgpu::Adapter) -> Result<Gpu> {
        let (features, limits) = (wgpu::Features::empty(), wgpu::Limits::default());
        let hints = wgpu::MemoryHints::default();
        // SAFETY: the guard is dropped before the adapter, and nothing is destroyed through it.
        let hal = unsafe { vulkan(adapter) }?;
        let shared = hal.shared_instance();
        let (raw, physical) = (shared.raw_instance(), hal.raw_physical_device());
        let loader = shared.entry().static_fn().get_instance_proc_addr;
        let needed = Requirements::query();
        // SAFETY: the handles belong together and are alive.
        let lacking = unsafe { needed.lacking(loader, raw.handle(), physical) }?;
        if !lacking.is_empty() {
            let name = adapter.get_info().name;
            return Err(
                format!("{name} cannot run splat4d: it lacks {}", lacking.join(", ")).into()
            );
        }

        // One queue family for wgpu's graphics and the engine's compute kernels.
        let wanted = vk::QueueFlags::GRAPHICS | needed.queue_flags;
        // SAFETY: a plain query.
        let families = unsafe { raw.get_physical_device_queue_family_properties(physical) };
        let family = families
            .iter()
            .position(|family| family.queue_flags.contains(wanted))
            .ok_or("no queue family both draws and computes")? as u32;
        let queues = [vk::DeviceQueueCreateInfo::default()
            .queue_family_index(family)
            .queue_priorities(&[1.0])];
        // The extensions and features that wgpu needs; the engine's features go into the same chain.
        let extensions = hal.required_device_extensions(features);
        let names: Vec<_> = extensions.iter().map(|name| name.as_ptr()).collect();
        let mut of_wgpu = hal.physical_device_features(&extensions, features);
        let mut links = FeatureLinks::default();
        let mut create = of_wgpu.add_to_device_create(
            vk::DeviceCreateInfo::default()
                .queue_create_infos(&queues)
                .enabled_extension_names(&names),
        );
        // SAFETY: the chain consists of the structures of `of_wgpu`, which this function owns.
        unsafe { needed.features.enable_in(&mut create, &mut links) };
        // SAFETY: as above.
        let enabled = unsafe { Features::enabled_by(&create) };
        // SAFETY: everything that `create` points to is alive, and wgpu and the engine only request
        // extensions and features that the device supports.
        let handle = unsafe { raw.create_device(physical, &create, None) }?;
        // SAFETY: the device was created from this adapter with the extensions and features that the adapter
        // requires; wgpu-hal owns it from here on.
        let open = unsafe {
            hal.device_from_raw(handle, None, &extensions, features, &limits, &hints, family, 0)
        }?;
        let descriptor = wgpu::DeviceDescriptor {
            label: Some("host"),
            required_features: features,
            required_limits: limits,
            memory_hints: hints,
            ..Default::default()
        };
        // SAFETY: the device was opened above with the same features and limits.
        let (device, queue) = unsafe { adapter.create_device_from_hal(open, &descriptor) }?;

        let turn = Arc::new(Mutex::new(()));
        let given_back = Arc::new(AtomicBool::new(false));
        let (of_engine, told, kept) = (turn.clone(), given_back.clone(), device.clone());
        // SAFETY: the guard is dropped before the device, and nothing is destroyed through it.
        let hal = unsafe { device.as_hal::<Vulkan>() }.ok_or("the device is not Vulkan's")?;
        let host = HostDevice {
            get_instance_proc_addr: loader,
            instance: raw.handle(),
            physical_device: physical,
            device: hal.raw_device().handle(),
            queue: hal.raw_queue(),
            queue_family: hal.queue_family_index(),
            features: enabled,
            external_memory_fd: false,
            queue_lock: Some(Box::new(move |work| {
                let _turn = of_engine.lock().unwrap();
                work();
            })),
            // Keeps wgpu's device, and with it the instance and the loader, alive while the engine uses them.
            on_drop: Some(Box::new(move || {
                told.store(true, Ordering::SeqCst);
                drop(kept);
            })),
        };
        // SAFETY: the handles belong together; instance and device are Vulkan 1.3 and were created with the
        // features stated; `on_drop` keeps them alive; every use of the queue locks `turn`.
        let engine = unsafe { splat4d::gpu::Device::adopt(host) }?;
        drop(hal);
        Ok(Gpu { device, queue, engine, turn, given_back })
    }
}

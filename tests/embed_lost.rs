//! A device that is lost during work: every call reports it, and nothing hangs or panics, whatever is
//! dropped and in whatever order.
//!
//! Software drivers never lose a device. The host therefore lends a loader whose device executes all
//! calls, but from some moment on returns the results that Vulkan specifies for a lost device.

mod host;

use host::{Host, camera, gaussians};
use splat4d::embed::SemaphorePoint;
use splat4d::embed::ash::{self, vk};
use splat4d::gpu::{Device, Recorder};
use splat4d::renderer::{Renderer, Target};
use splat4d::scene::Scene;
use splat4d::train::own_loss::OwnGradients;
use splat4d::train::{SceneOptimiser, TrainSettings, Trainer, TrainingView};
use splat4d::types::Image;
use splat4d::{Error, Result};
use std::cell::{Cell, RefCell};
use std::ffi::{CStr, c_char, c_void};
use std::mem::transmute;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

/// The real loader and device behind the lent loader.
struct Real {
    instance_loader: vk::PFN_vkGetInstanceProcAddr,
    device_loader: vk::PFN_vkGetDeviceProcAddr,
    device: ash::Device,
}

// State of the test on this thread; a test makes all its calls on one thread.
thread_local! {
    static REAL: RefCell<Option<Real>> = const { RefCell::new(None) };
    static LOST: Cell<bool> = const { Cell::new(false) };
}

fn real<R>(call: impl FnOnce(&Real) -> R) -> R {
    REAL.with_borrow(|real| call(real.as_ref().expect("adopted on this thread")))
}

fn lost_or(result: vk::Result) -> vk::Result {
    if LOST.get() { vk::Result::ERROR_DEVICE_LOST } else { result }
}

/// # Safety
/// As for the Vulkan function of that name, here and below.
unsafe extern "system" fn queue_submit2(
    queue: vk::Queue,
    count: u32,
    submits: *const vk::SubmitInfo2<'_>,
    fence: vk::Fence,
) -> vk::Result {
    if LOST.get() {
        return vk::Result::ERROR_DEVICE_LOST;
    }
    // SAFETY: guaranteed by the caller, here and below.
    real(|real| unsafe { (real.device.fp_v1_3().queue_submit2)(queue, count, submits, fence) })
}

/// Really waits, since the objects that are destroyed afterwards must not be in use.
unsafe extern "system" fn wait_semaphores(
    device: vk::Device,
    info: *const vk::SemaphoreWaitInfo<'_>,
    timeout: u64,
) -> vk::Result {
    // SAFETY: as above.
    lost_or(real(|real| unsafe { (real.device.fp_v1_2().wait_semaphores)(device, info, timeout) }))
}

unsafe extern "system" fn get_semaphore_counter_value(
    device: vk::Device,
    semaphore: vk::Semaphore,
    value: *mut u64,
) -> vk::Result {
    // SAFETY: as above.
    lost_or(real(|real| unsafe {
        (real.device.fp_v1_2().get_semaphore_counter_value)(device, semaphore, value)
    }))
}

unsafe extern "system" fn get_query_pool_results(
    device: vk::Device,
    pool: vk::QueryPool,
    first: u32,
    count: u32,
    bytes: usize,
    data: *mut c_void,
    stride: vk::DeviceSize,
    flags: vk::QueryResultFlags,
) -> vk::Result {
    if LOST.get() {
        return vk::Result::ERROR_DEVICE_LOST;
    }
    // SAFETY: as above.
    real(|real| unsafe {
        let get = real.device.fp_v1_0().get_query_pool_results;
        get(device, pool, first, count, bytes, data, stride, flags)
    })
}

unsafe extern "system" fn get_device_proc_addr(
    device: vk::Device,
    name: *const c_char,
) -> vk::PFN_vkVoidFunction {
    // SAFETY: `name` is a C string, as Vulkan requires; function pointers are returned as pointers to
    // functions without arguments.
    unsafe {
        match CStr::from_ptr(name).to_bytes() {
            b"vkQueueSubmit2" => {
                transmute::<vk::PFN_vkQueueSubmit2, vk::PFN_vkVoidFunction>(queue_submit2)
            }
            b"vkWaitSemaphores" => {
                transmute::<vk::PFN_vkWaitSemaphores, vk::PFN_vkVoidFunction>(wait_semaphores)
            }
            b"vkGetSemaphoreCounterValue" => transmute::<
                vk::PFN_vkGetSemaphoreCounterValue,
                vk::PFN_vkVoidFunction,
            >(get_semaphore_counter_value),
            b"vkGetQueryPoolResults" => transmute::<
                vk::PFN_vkGetQueryPoolResults,
                vk::PFN_vkVoidFunction,
            >(get_query_pool_results),
            _ => real(|real| (real.device_loader)(device, name)),
        }
    }
}

unsafe extern "system" fn get_instance_proc_addr(
    instance: vk::Instance,
    name: *const c_char,
) -> vk::PFN_vkVoidFunction {
    // SAFETY: as above.
    unsafe {
        match CStr::from_ptr(name).to_bytes() {
            b"vkGetDeviceProcAddr" => transmute::<
                vk::PFN_vkGetDeviceProcAddr,
                vk::PFN_vkVoidFunction,
            >(get_device_proc_addr),
            _ => real(|real| (real.instance_loader)(instance, name)),
        }
    }
}

/// Adopts the host's device, which is not lost yet. Also returns the number of times that the device was
/// given back to the host.
fn adopt(host: &Host) -> (Device, Arc<AtomicUsize>) {
    REAL.set(Some(Real {
        instance_loader: host.entry.static_fn().get_instance_proc_addr,
        device_loader: host.instance.fp_v1_0().get_device_proc_addr,
        device: host.device.clone(),
    }));
    LOST.set(false);
    let returned = Arc::new(AtomicUsize::new(0));
    let counter = returned.clone();
    let mut lent = host.lend();
    lent.get_instance_proc_addr = get_instance_proc_addr;
    lent.on_drop = Some(Box::new(move || {
        counter.fetch_add(1, Ordering::SeqCst);
    }));
    // SAFETY: the handles belong together and live as long as the test, on one thread.
    (unsafe { Device::adopt(lent) }.unwrap(), returned)
}

/// Checks that the result is a lost-device error, and returns the kernel that it names.
#[track_caller]
fn lost<T>(result: Result<T>) -> String {
    match result.err().expect("the device is lost") {
        Error::DeviceLost { last_kernel } => last_kernel,
        other => panic!("{other}"),
    }
}

#[test]
fn a_stream_says_so_from_then_on() {
    let host = Host::new();
    let (device, returned) = adopt(&host);
    let semaphore = host.semaphore();
    let mut renderer = Renderer::new(&device, &Scene::of(gaussians(50))).unwrap();
    let mut stream = device.stream().unwrap();
    let mut buffer = device.upload("numbers", &[1u32; 8]).unwrap();
    let mut recorder = stream.record().unwrap();
    recorder.profile().unwrap();
    let frame = renderer.record(&mut recorder, &camera(30, 20), 0.0, Target::default()).unwrap();
    let under_way = stream.submit(recorder).unwrap();
    let [before, between] = [(); 2].map(|()| stream.record().unwrap());

    LOST.set(true);
    assert_eq!(lost(stream.wait(under_way)), "raster/forward");
    assert_eq!(lost(stream.times(under_way)), "raster/forward");
    lost(stream.record());
    lost(stream.submit(before));
    let signals = [SemaphorePoint { semaphore, value: 1 }];
    // SAFETY: the semaphore lives until the end.
    lost(unsafe { stream.submit_between(between, &[], &signals) });
    lost(stream.upload(&mut buffer, &[2; 8]));
    lost(stream.download(&buffer));
    lost(device.upload("more", &[3u32]));
    // The frame is useless, but retiring it does no harm.
    let _ = renderer.retire(frame);
    lost(renderer.render(&camera(30, 20), 0.0));
    lost(Renderer::new(&device, &Scene::of(gaussians(5))));
    drop((device, buffer, stream));
    assert_eq!(returned.load(Ordering::SeqCst), 0, "the renderer is left");
    drop(renderer);
    assert_eq!(returned.load(Ordering::SeqCst), 1);
    host.destroy_semaphore(semaphore);
}

#[test]
fn lost_at_the_submission() {
    let host = Host::new();
    let (device, returned) = adopt(&host);
    let mut renderer = Renderer::new(&device, &Scene::of(gaussians(50))).unwrap();
    let mut stream = device.stream().unwrap();
    let mut recorder = stream.record().unwrap();
    let target = Target::default();
    let frame = renderer.record(&mut recorder, &camera(30, 20), 0.0, target).unwrap();
    LOST.set(true);
    assert_eq!(lost(stream.submit(recorder)), "raster/forward");
    drop((renderer, device, stream));
    assert_eq!(returned.load(Ordering::SeqCst), 0, "the frame is left");
    drop(frame);
    assert_eq!(returned.load(Ordering::SeqCst), 1);
}

/// A failed submission of the host's commands is the host's to handle; the guard releases what the engine
/// keeps for it.
#[test]
fn lost_in_the_hosts_command_buffer() {
    let host = Host::new();
    let (device, returned) = adopt(&host);
    let mut renderer = Renderer::new(&device, &Scene::of(gaussians(50))).unwrap();
    let commands = host.commands();
    host.begin(commands);
    LOST.set(true);
    // SAFETY: the command buffer has begun and is never submitted.
    let mut recorder = unsafe { Recorder::over(&device, commands) }.unwrap();
    recorder.profile().unwrap();
    let target = Target::default();
    let frame = renderer.record(&mut recorder, &camera(30, 20), 0.0, target).unwrap();
    let guard = recorder.finish().unwrap();
    lost(guard.times());
    // SAFETY: the command buffer is never submitted.
    unsafe { host.device.end_command_buffer(commands) }.unwrap();
    drop((device, frame, renderer));
    assert_eq!(returned.load(Ordering::SeqCst), 0, "the guard is left");
    drop(guard);
    assert_eq!(returned.load(Ordering::SeqCst), 1);
}

#[test]
fn a_trainer_says_so_from_then_on() {
    let host = Host::new();
    let (device, returned) = adopt(&host);
    let settings =
        TrainSettings { growth: None, max_gaussians: 50, sh_degree: 0, ..TrainSettings::default() };
    let view = TrainingView {
        camera: camera(30, 20),
        time: 0.0,
        image: Image::new(30, 20, 3),
        weights: None,
        disparity: None,
        mask: None,
        every: 1,
    };
    let start = gaussians(50);
    let mut trainer = Trainer::new(&device, &[view], &start, None, settings.clone()).unwrap();
    let mut own = SceneOptimiser::new(&device, &start, None, 1.0, settings).unwrap();
    let mut stream = device.stream().unwrap();
    let by_rgba = device.upload("by rgba", &[[1.0f32; 4]; 30 * 20]).unwrap();
    trainer.step().unwrap();
    let mut recorder = stream.record().unwrap();
    let pass = own.forward(&mut recorder, &camera(30, 20), 0.0).unwrap();
    stream.submit(recorder).unwrap();
    let mut recorder = stream.record().unwrap();

    LOST.set(true);
    let by = OwnGradients { rgba: by_rgba.view(), depth: None };
    let pass = own.backward(&mut recorder, pass, by).unwrap();
    let pass = own.update(&mut recorder, pass).unwrap();
    lost(stream.submit(recorder));
    // The step has no known result, so either outcome is accepted.
    let _ = own.conclude(pass);
    lost(own.gaussians());
    for _ in 0..3 {
        lost(trainer.step());
    }
    lost(trainer.loss());
    lost(trainer.gaussians());
    drop((stream, by_rgba, trainer, device));
    assert_eq!(returned.load(Ordering::SeqCst), 0, "a trainer is left");
    drop(own);
    assert_eq!(returned.load(Ordering::SeqCst), 1);
}

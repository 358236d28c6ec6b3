//! Frames in a host's command buffer allocate nothing, neither on the heap nor on the device, and nothing
//! is left at the end. This binary has a single test, since it counts every allocation of the process.

mod host;

use host::{Host, camera, gaussians};
use splat4d::gpu::{Buffer, Device, Recorder};
use splat4d::renderer::{Renderer, Target};
use splat4d::scene::Scene;
use splat4d::types::ControlPoints;
use std::alloc::{GlobalAlloc, Layout, System};
use std::sync::atomic::{AtomicU64, Ordering};

struct Counting;

static ALLOCATIONS: AtomicU64 = AtomicU64::new(0);

// SAFETY: every call is forwarded to the system's allocator; only a counter is added.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        ALLOCATIONS.fetch_add(1, Ordering::Relaxed);
        // SAFETY: the caller's guarantees hold for the forwarded call, here and below.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, at: *mut u8, layout: Layout) {
        // SAFETY: as above.
        unsafe { System.dealloc(at, layout) }
    }

    unsafe fn realloc(&self, at: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        ALLOCATIONS.fetch_add(1, Ordering::Relaxed);
        // SAFETY: as above.
        unsafe { System.realloc(at, layout, size) }
    }
}

#[global_allocator]
static GLOBAL: Counting = Counting;

const FRAMES: u64 = 1000;
/// Number of frames in flight.
const IN_FLIGHT: usize = 3;

/// A scene whose Gaussians move.
fn moving() -> Scene {
    let mut gaussians = gaussians(150);
    gaussians.motion_logits = (0..150).map(|i| if i % 2 == 0 { 3.0 } else { -3.0 }).collect();
    Scene {
        control_points: ControlPoints {
            positions: gaussians.positions[..8].to_vec(),
            log_radii: vec![0.0; 8],
            paths: vec![[0.0; 8]; 24],
        },
        ..Scene::of(gaussians)
    }
}

#[test]
fn a_thousand_frames_allocate_nothing_after_the_tenth() {
    let host = Host::new();
    let scene = moving();
    let picture = host.buffer(16 * 64 * 48);
    let semaphore = host.semaphore();
    let commands: Vec<_> = (0..IN_FLIGHT).map(|_| host.commands()).collect();
    let mut longest = std::time::Duration::ZERO;
    {
        // SAFETY: the handles belong together; one thread uses the queue.
        let device = unsafe { Device::adopt(host.lend()) }.unwrap();
        // SAFETY: the buffer outlives the block, at whose end the device has finished.
        let adopted =
            unsafe { Buffer::<[f32; 4]>::adopt(&device, "picture", picture.whole(), None) };
        let mut rgba = adopted.unwrap();
        let mut renderer = Renderer::new(&device, &scene).unwrap();
        let mut under_way = std::collections::VecDeque::with_capacity(IN_FLIGHT + 1);
        let (mut heap, mut made, mut bytes) = (0, 0, 0);
        for frame in 1..=FRAMES {
            if under_way.len() == IN_FLIGHT {
                host.wait(semaphore, frame - IN_FLIGHT as u64);
                let (guard, drawn) = under_way.pop_front().unwrap();
                drop(guard);
                assert!(renderer.retire(drawn).unwrap().is_whole());
            }
            let mut camera = camera(64, 48);
            camera.view_from_world.translation.x = (frame as f64 / 50.0).sin() / 4.0;
            let commands = commands[frame as usize % IN_FLIGHT];
            host.begin(commands);
            let begun = std::time::Instant::now();
            // SAFETY: the command buffer has begun and is submitted once below, to a single queue in
            // order; the guard outlives the wait.
            let mut recorder = unsafe { Recorder::over(&device, commands) }.unwrap();
            let target = Target { rgba: Some(rgba.view_mut()), ..Target::default() };
            let time = frame as f64 / FRAMES as f64;
            let drawn = renderer.record(&mut recorder, &camera, time, target).unwrap();
            let guard = recorder.finish().unwrap();
            if frame > 10 {
                longest = longest.max(begun.elapsed());
            }
            host.submit(commands, semaphore, frame);
            under_way.push_back((guard, drawn));
            if frame == 10 {
                heap = ALLOCATIONS.load(Ordering::Relaxed);
                (made, bytes) = (device.allocations(), device.memory().0);
            }
        }
        let heap = ALLOCATIONS.load(Ordering::Relaxed) - heap;
        host.wait(semaphore, FRAMES);
        assert_eq!(heap, 0, "allocations on the heap");
        assert_eq!(device.allocations(), made, "made on the device");
        assert_eq!(device.memory().0, bytes, "bytes on the device");
        // The recordings release everything; only the renderer and the buffer still hold resources.
        for (guard, drawn) in under_way {
            drop(guard);
            assert!(renderer.retire(drawn).unwrap().is_whole());
        }
        drop(renderer);
        assert_eq!(device.memory().0, 0, "left on the device");
    }
    println!("the longest recording of a frame took {longest:?}");
    assert!(picture.floats(0, 4 * 64 * 48).iter().any(|v| *v > 0.1), "the picture is not empty");
    host.free(picture);
    host.destroy_semaphore(semaphore);
    // When the host is dropped, the validation layer reports objects that were not destroyed.
}

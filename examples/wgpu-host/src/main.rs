//! A wgpu host: this program creates a wgpu device, lends it to splat4d, draws splats and a triangle in each
//! frame from a moving camera, and compares every pixel with its expected value.
//!
//! `cargo run --release -p wgpu-host -- --output frame.png`

mod gpu;
mod messages;
mod pace;
mod scene;
mod stage;
mod verify;

use clap::Parser;
use splat4d::renderer::Renderer;
use splat4d::scene::Scene;
use stage::Stage;
use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::atomic::{AtomicBool, Ordering};
use verify::Judge;

type Result<T> = std::result::Result<T, Box<dyn std::error::Error>>;

/// Draws splats on a wgpu device, together with a triangle drawn by wgpu, and checks every pixel.
///
/// The device is the one that wgpu prefers; VK_DRIVER_FILES selects the available drivers.
/// The exit code is 1 if a pixel is wrong or the validation layer has reported anything.
#[derive(Parser)]
#[command(after_help = "Example: wgpu-host --validation --output frame.png")]
struct Arguments {
    /// Write the last frame as PNG
    #[arg(long, value_name = "FILE")]
    output: Option<PathBuf>,
    /// Run under the Khronos validation layer, with synchronization validation; any message fails
    #[arg(long)]
    validation: bool,
    /// Number of frames to draw at the given rate, with each call timed
    #[arg(long, value_name = "N", default_value_t = 120)]
    frames: u32,
    /// Frames per second
    #[arg(long, value_name = "HZ", default_value_t = 60, value_parser = clap::value_parser!(u32).range(1..))]
    rate: u32,
    /// Number of splats on the ball
    #[arg(long, value_name = "N", default_value_t = 3000, value_parser = clap::value_parser!(u32).range(1..))]
    splats: u32,
}

/// Number of views whose pixels are checked before the timed frames.
const VIEWS: u32 = 4;

fn main() -> ExitCode {
    match run(&Arguments::parse()) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("wgpu-host: {error}");
            ExitCode::FAILURE
        }
    }
}

fn run(arguments: &Arguments) -> Result<()> {
    let instance = gpu::instance(arguments.validation)?;
    let adapter = gpu::adapter(&instance)?;
    // Listens until everything else is destroyed, the device included: leaks are reported at its destruction.
    let messages = match arguments.validation {
        true => Some(messages::Messages::listen(&instance, &adapter)?),
        false => None,
    };
    let drawn = draw(arguments, adapter);
    let said = messages.map(messages::Messages::finish).unwrap_or_default();
    drawn?;
    match said.is_empty() {
        true => Ok(()),
        false => Err(format!("the validation layer complains:\n{}", said.join("\n")).into()),
    }
}

/// Checks some views while another thread repeatedly loads the scene and renders it: its submissions and
/// wgpu's alternate on the shared queue.
fn views(stage: &mut Stage, judge: &mut Judge, scene: &Scene) -> Result<()> {
    let engine = stage.engine().clone();
    let enough = AtomicBool::new(false);
    std::thread::scope(|threads| {
        let loader = threads.spawn(|| -> splat4d::Result<usize> {
            for round in 1.. {
                Renderer::new(&engine, scene)?.render(&scene::camera(0), 0.0)?;
                if enough.load(Ordering::SeqCst) {
                    return Ok(round);
                }
            }
            unreachable!("it goes on until it is enough")
        });
        let checked = (0..VIEWS).try_for_each(|view| {
            let camera = scene::camera(view * 30);
            stage.draw_whole(&camera)?;
            println!("view {view}: {}", judge.check(stage, &camera)?);
            Ok(())
        });
        enough.store(true, Ordering::SeqCst);
        let rounds = loader.join().map_err(|_| "the loading thread panicked")?;
        checked.and_then(|()| {
            println!("another thread loaded the scene {} times meanwhile", rounds?);
            Ok(())
        })
    })
}

fn draw(arguments: &Arguments, adapter: wgpu::Adapter) -> Result<()> {
    let scene = scene::ball(arguments.splats as usize);
    let gpu = gpu::Gpu::open(&adapter)?;
    let given_back = gpu.given_back.clone();
    println!("{}: {} splats", adapter.get_info().name, scene.gaussians.len());
    let mut judge = Judge::new(&adapter, &scene)?;
    let mut stage = Stage::new(gpu, &scene)?;
    views(&mut stage, &mut judge, &scene)?;
    if arguments.frames > 0 {
        print!("{}", pace::run(&mut stage, arguments.frames, arguments.rate)?);
        let last = scene::camera(arguments.frames - 1);
        println!("last frame: {}", judge.check(&stage, &last)?);
    }
    if let Some(path) = &arguments.output {
        let bytes = stage.read(stage.frame())?;
        let image = image::RgbaImage::from_raw(stage::WIDTH, stage::HEIGHT, bytes)
            .expect("four bytes a pixel");
        image.save(path).map_err(|error| format!("cannot write {}: {error}", path.display()))?;
    }
    drop(stage);
    match given_back.load(Ordering::SeqCst) {
        true => Ok(()),
        false => Err("everything of the engine's is dropped, and yet it keeps the device".into()),
    }
}

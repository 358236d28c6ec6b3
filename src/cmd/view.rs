//! `splat4d view`: shows a scene in the browser.

use std::net::{IpAddr, Ipv4Addr};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use clap::Args;
use serde_json::json;
use splat4d::camera_path::initial_view;
use splat4d::data::{Clip, images, video};
use splat4d::io::check_memory;
use splat4d::renderer::RenderScale;
use splat4d::scene::{Opened, Scene};
use splat4d::types::Tuning;
use splat4d::view::{Options, Pictures, Server, Show};
use splat4d::{Error, Result};

use super::common::{Answer, Common, foresee, print_json, say, thousands};
use super::{interrupt, tuning, values};

/// The image size that memory is predicted for: the usual one on most screens.
const USUAL_SIZE: (u32, u32) = (1920, 1080);
/// Host memory per pixel of an image and its intermediate data, bytes.
const BYTES_A_PIXEL: u64 = 64;
/// Maximum number of video frames beside a scene whose report does not list its frames.
const MOST_FRAMES: usize = 600;
/// Polling interval for Ctrl-C.
const LOOK: Duration = Duration::from_millis(50);

const AFTER_HELP: &str = "\
Open the address that it prints in a browser. Drag to orbit, with the right button or Shift to pan, turn
the wheel to come closer; W A S D Q E fly. `?` on the page lists the keys. Ctrl-C ends it.

Only this machine reaches it. With --host the machines that reach that address do, too, and the page's
address then holds a random token; what is sent is not encrypted.

--frames shows the input beside the scene: of a video (read through ffmpeg) the frames that the scene was
made of, of a folder all images. Where there are as many as the scene has cameras, each belongs to one;
else their times run evenly from 0 to 1. Of a video that the scene does not tell of, at most 600 are taken.

Example:
  splat4d view scene.safetensors
  splat4d view scene.safetensors --frames video.mp4 --port 9000

JSON, once it serves: url, port, host, gaussians, dropped, cameras, frames, device, predicted_bytes (of
device memory). What goes wrong later stands on stderr.";

/// Show a scene file or a 3DGS PLY in the browser
#[derive(Args)]
#[command(after_help = AFTER_HELP)]
pub struct ViewArgs {
    /// A scene file or a 3DGS PLY
    #[arg(value_name = "SCENE|PLY")]
    scene: PathBuf,
    /// The port to listen on, or the next free one if it is in use
    #[arg(long, value_name = "N", default_value_t = 8090,
          value_parser = values::whole::<u16>(1..=65_535))]
    port: u16,
    /// The address to listen on
    #[arg(long, value_name = "ADDRESS", default_value_t = IpAddr::V4(Ipv4Addr::LOCALHOST),
          value_parser = values::host)]
    host: IpAddr,
    /// The input's video or a folder of its images, to show beside the scene
    #[arg(long, value_name = "VIDEO|DIR")]
    frames: Option<PathBuf>,
    /// Exit after this many seconds
    #[arg(long, value_name = "SECONDS", value_parser = values::number(0.01..=values::MOST_SECONDS))]
    seconds: Option<f64>,
    /// Skip Gaussians with NaN, infinite or out-of-range values
    #[arg(long)]
    drop_bad: bool,
    /// Settings that trade accuracy for speed, as `bench --error-budget` writes them
    #[arg(long, value_name = "FILE")]
    settings: Option<PathBuf>,
}

/// Runs the command.
pub fn run(args: &ViewArgs, common: &Common) -> Result<Answer> {
    let tuning = tuning::read(args.settings.as_deref())?;
    let Opened { scene, dropped } = Scene::open(&args.scene, args.drop_bad)?;
    if dropped > 0 {
        say(&format!(
            "note: left out {} Gaussians that are not finite or out of range",
            thousands(dropped)
        ));
    }
    let pictures = args.frames.as_deref().map(|input| pictures(input, &scene)).transpose()?;
    let device = common.open_device()?;
    let predicted_bytes = foreseen(&device, &scene, &tuning)?;
    let (gaussians, cameras) = (scene.gaussians.len(), scene.cameras.len());
    let count = pictures.as_ref().map_or(0, Pictures::len);
    let (start, distance) = initial_view(&scene);
    let name = args.scene.file_name().unwrap_or_default().to_string_lossy().into_owned();
    let show = Show { name, scene, tuning, start, distance, pictures };
    interrupt::check()?;
    let server = Server::start(&device, show, &Options { host: args.host, port: args.port })?;
    if server.port() != args.port {
        say(&format!("note: port {} is in use, {} is taken", args.port, server.port()));
    }
    if !args.host.is_loopback() {
        say("note: other machines reach this; whoever has the address sees the scene");
    }
    let json = json!({
        "url": server.url(),
        "port": server.port(),
        "host": args.host.to_string(),
        "gaussians": gaussians,
        "dropped": dropped,
        "cameras": cameras,
        "frames": count,
        "device": device.info().name,
        "predicted_bytes": predicted_bytes,
    });
    if common.json {
        // The reader waits for the URL; a missing reader does not end the server.
        let _ = print_json(&json);
    } else {
        say(&format!("{} Gaussians at {}", thousands(gaussians), server.url()));
    }
    let begun = Instant::now();
    let is_over = || args.seconds.is_some_and(|most| begun.elapsed().as_secs_f64() >= most);
    while server.is_serving() && !interrupt::requested() && !is_over() {
        std::thread::sleep(LOOK);
    }
    server.stop()?;
    Ok(Answer { json, text: String::new() })
}

/// The images of a video or a folder. Each file is checked, so that invalid images are reported now.
fn pictures(input: &Path, scene: &Scene) -> Result<Pictures> {
    if std::fs::metadata(input).map_err(Error::io(input))?.is_file() {
        if images::has_image_extension(input) {
            let what = "is one image; --frames takes the video, or a folder of its frames";
            return Err(Error::format(input, what));
        }
        let total = video::extent(input)?.frames;
        say(&format!("reading {}", input.display()));
        return Pictures::of_video(input, &numbers(scene, total), &interrupt::check);
    }
    let files = Clip::files(input)?;
    if files.is_empty() {
        let what = "holds no images; --frames takes the video, or a folder of its frames";
        return Err(Error::format(input, what));
    }
    for file in &files {
        interrupt::check()?;
        images::dimensions(file, images::Orientation::Upright)?;
    }
    Ok(Pictures::files(files))
}

/// Numbers of the video frames that belong beside a scene: those that it was made of, by its report, one
/// for each of its cameras; else an even selection.
fn numbers(scene: &Scene, total: usize) -> Vec<usize> {
    let names = scene.report["frame_names"].as_array().into_iter().flatten();
    let own: Option<Vec<usize>> = names.map(|name| name.as_str()?.parse().ok()).collect();
    let fits = |own: &Vec<usize>| {
        own.len() == scene.cameras.len()
            && own.is_sorted_by(|a, b| a < b)
            && own.last().is_some_and(|last| *last < total)
    };
    own.filter(fits).unwrap_or_else(|| {
        let count = total.min(MOST_FRAMES);
        (0..count).map(|i| i * total.saturating_sub(1) / (count - 1).max(1)).collect()
    })
}

/// Predicted device memory; an error where the scene does not fit.
fn foreseen(device: &splat4d::gpu::Device, scene: &Scene, tuning: &Tuning) -> Result<u64> {
    let (width, height) = USUAL_SIZE;
    check_memory(
        u64::from(width) * u64::from(height) * BYTES_A_PIXEL,
        &format!("an image of {width}×{height}"),
    )?;
    // Motion masks, flow and normals are drawn by a second pass.
    let scale = RenderScale { repainted: true, ..RenderScale::new(scene, USUAL_SIZE, tuning) };
    foresee(
        device,
        &format!("showing {} Gaussians", thousands(scale.gaussians)),
        scale.footprint(device),
        || scale.most_gaussians(device),
        "leave Gaussians out",
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use splat4d::scene::SceneCamera;
    use splat4d::types::{Camera, Gaussians, Intrinsics, Pose};

    #[test]
    fn a_videos_frames_are_those_that_the_scene_was_made_of() {
        let intrinsics = Intrinsics::centred(8.0, 8, 8);
        let camera = Camera { intrinsics, view_from_world: Pose::IDENTITY };
        let scene = |names: serde_json::Value| Scene {
            cameras: vec![SceneCamera { time: 0.0, camera }; 3],
            report: json!({ "frame_names": names }),
            ..Scene::of(Gaussians::default())
        };
        assert_eq!(numbers(&scene(json!(["00002", "00004", "00006"])), 9), [2, 4, 6]);
        let all: Vec<usize> = (0..6).collect();
        for other in [json!(["00002", "00004", "00006"]), json!(["a", "b", "c"]), json!(["00001"])]
        {
            assert_eq!(numbers(&scene(other), 6), all);
        }
        let some = numbers(&Scene::of(Gaussians::default()), 100_000);
        assert_eq!((some.len(), some[0], some[599]), (MOST_FRAMES, 0, 99_999));
        assert!(some.is_sorted_by(|a, b| a < b));
        assert_eq!(numbers(&scene(json!([])), 1), [0]);
    }
}

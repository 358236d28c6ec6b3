//! Evaluates a scene on views of its first camera at the times of other frames. This is the test of clips
//! recorded by a row of cameras, each frame from another camera, where the first camera's own pose is the
//! only known test pose. Nothing is aligned or fitted.

use std::path::{Path, PathBuf};

use serde_json::{Map, Value};
use splat4d::data::images::{Orientation, decode_rgb, dimensions, list};
use splat4d::observe::onnx::LpipsNetwork;
use splat4d::renderer::Renderer;
use splat4d::scene::{Scene, SceneCamera};
use splat4d::types::{Camera, Intrinsics};
use splat4d::{Error, Result};

use super::common::{Common, say};
use super::eval::EvalArgs;
use super::held_out::{self, Comparisons, Judge, Shot};
use super::interrupt;
use super::known::lens_of;
use super::meter::Meter;

/// Name of the result rows for these images.
const DISTANCE: &str = "first_camera";

/// Maximum relative difference of two images' proportions, because sides are rounded to whole pixels.
const PROPORTIONS: f64 = 0.02;

/// Whether the reference is a folder of such images, by option or by their names.
pub fn is_meant(args: &EvalArgs) -> Result<bool> {
    if args.first_camera {
        return Ok(true);
    }
    if !args.reference.is_dir() {
        return Ok(false);
    }
    let names = list(&args.reference)?;
    Ok(!names.is_empty() && names.iter().all(|file| is_named(file)))
}

/// Evaluates them.
pub fn measure(
    scene: &Scene,
    args: &EvalArgs,
    lpips: Option<&mut LpipsNetwork>,
    common: &Common,
) -> Result<Map<String, Value>> {
    let folder = &args.reference;
    let pictures = pictures(scene, folder)?;
    let names: Vec<String> = pictures.iter().map(|(file, _)| name(file)).collect();
    let comparisons = args.comparisons(&names, std::slice::from_ref(folder))?;
    let first = scene.cameras[0].camera;
    let lens = lens_of(&scene.report)?;
    let device = common.open_device()?;
    let mut renderer = Renderer::new(&device, scene)?;
    let mut judge = Judge {
        renderer: &mut renderer,
        background: scene.background,
        fit: args.fit_poses,
        comparisons: comparisons.as_ref(),
        lpips,
    };
    let mut meter = Meter::new("first camera", "images", pictures.len() as u64, 0);
    let mut judged = Vec::with_capacity(pictures.len());
    for (index, (file, at)) in pictures.iter().enumerate() {
        interrupt::check()?;
        let intrinsics = seen_as(&first.intrinsics, file)?;
        let truth = decode_rgb(file, scene.background, Orientation::Stored)?;
        let shot = Shot {
            name: names[index].clone(),
            distance: DISTANCE.into(),
            camera: Camera { intrinsics, ..first },
            time: at.time,
            truth: match &lens {
                // With 8 bits, like the rendered image that it is compared with.
                Some(lens) => held_out::eight_bits(
                    lens.resized(truth.width, truth.height).undistort(&truth, &intrinsics).0,
                ),
                None => truth,
            },
            movers: None,
            covisible: None,
        };
        judged.push(judge.judge(index, &shot)?);
        meter.advance();
    }
    comparisons.map_or(Ok(()), Comparisons::finish)?;
    Ok(held_out::keys(&judged))
}

/// The images of a folder with the scene's cameras at their frames. The first camera's own frame is an
/// input and is excluded.
fn pictures<'a>(scene: &'a Scene, folder: &Path) -> Result<Vec<(PathBuf, &'a SceneCamera)>> {
    if scene.cameras.is_empty() {
        let what = "the scene knows no input cameras; its first one is what is measured from here";
        return Err(Error::Input(what.into()));
    }
    let frames = frame_numbers(scene);
    let (mut found, mut absent) = (Vec::new(), 0);
    for file in list(folder)? {
        let frame = match view_and_frame(&file) {
            Some((0, frame)) => Some(frame),
            // An image of another camera.
            Some(_) => continue,
            None => last_number(&stem(&file)),
        };
        let Some(frame) = frame else {
            let what =
                "has no number in its name; v000_t003.png is frame 3 as the first camera sees it";
            return Err(Error::format(file, what));
        };
        match frames.iter().position(|number| *number == frame) {
            Some(0) => {}
            Some(index) => found.push((file, &scene.cameras[index])),
            None => absent += 1,
        }
    }
    if found.is_empty() {
        let what = "holds no image whose number is that of a frame of the scene, after the first";
        return Err(Error::format(folder, what));
    }
    if absent > 0 {
        say(&format!("note: the scene has no frame for {absent} of the images"));
    }
    Ok(found)
}

/// The number of each of the scene's frames: the last one in its name, or its index.
fn frame_numbers(scene: &Scene) -> Vec<u64> {
    let named: Option<Vec<u64>> = scene.report["frame_names"]
        .as_array()
        .and_then(|names| names.iter().map(|name| last_number(name.as_str()?)).collect());
    match named {
        Some(numbers) if numbers.len() == scene.cameras.len() => numbers,
        _ => (0..scene.cameras.len() as u64).collect(),
    }
}

/// The camera at the size of another image.
fn seen_as(k: &Intrinsics, file: &Path) -> Result<Intrinsics> {
    let (width, height) = dimensions(file, Orientation::Stored)?;
    let (ours, theirs) =
        (f64::from(k.width) / f64::from(k.height), f64::from(width) / f64::from(height));
    if (ours / theirs - 1.0).abs() > PROPORTIONS {
        let what = format!(
            "is {width}×{height}, the scene's first camera {}×{}: other proportions, so that it is not \
             the same image at another size",
            k.width, k.height
        );
        return Err(Error::format(file, what));
    }
    Ok(k.fitted(width, height))
}

fn stem(file: &Path) -> String {
    file.file_stem().unwrap_or_default().to_string_lossy().into_owned()
}

fn name(file: &Path) -> String {
    file.file_name().unwrap_or_default().to_string_lossy().into_owned()
}

/// Whether an image's name contains the camera and the frame.
pub fn is_named(file: &Path) -> bool {
    view_and_frame(file).is_some()
}

/// `(0, 3)` of `v000_t003.png`.
fn view_and_frame(file: &Path) -> Option<(u64, u64)> {
    let stem = stem(file);
    let (view, frame) = stem.strip_prefix('v')?.split_once("_t")?;
    let digits = |text: &str| {
        let all = !text.is_empty() && text.bytes().all(|b| b.is_ascii_digit());
        all.then(|| text.parse().ok()).flatten()
    };
    Some((digits(view)?, digits(frame)?))
}

/// The last run of digits in a name.
fn last_number(name: &str) -> Option<u64> {
    let end = name.rfind(|c: char| c.is_ascii_digit())? + 1;
    let start = name[..end].rfind(|c: char| !c.is_ascii_digit());
    // The character before the digits may have several bytes.
    let start = start.map_or(0, |at| at + name[at..].chars().next().map_or(1, char::len_utf8));
    name[start..end].parse().ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_tell_frames() {
        let of = |name: &str| view_and_frame(Path::new(name));
        assert_eq!(of("a/v000_t011.png"), Some((0, 11)));
        assert_eq!(of("v2_t3.jpg"), Some((2, 3)));
        for name in ["v_t3.png", "v0_t.png", "v0t3.png", "frame_t3.png", "v0_t3b.png", "v-1_t3.png"]
        {
            assert_eq!(of(name), None, "{name}");
        }
        assert_eq!(last_number("frame_012b"), Some(12));
        assert_eq!(last_number("é7"), Some(7));
        assert_eq!(last_number("frame"), None);
    }
}

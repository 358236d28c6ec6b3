//! Writes a clip to a folder in standard formats.

use std::fs;
use std::path::Path;

use rayon::prelude::*;

use super::{Clip, HELD_OUT_EVERY};
use crate::data::trajectory::{self, TimedPose};
use crate::data::transforms::{self, TimedCamera};
use crate::data::{exr, flo, intrinsics, tracks, write_mask, write_png, write_png_16};
use crate::error::{Error, Result};
use crate::io;
use crate::types::Image;

/// Flow value that readers of `.flo` interpret as unknown: beyond 1e9.
const UNKNOWN_FLOW: f32 = 1e10;

/// Writes a clip to a new or empty folder. `frames` and `truth` appear by rename, in a new folder both at
/// once:
///
/// ```text
/// frames/0000.png …               8-bit RGB; 16-bit for coded clips
/// truth/intrinsics.json           pixels
/// truth/poses.txt                 TUM, camera to world, metres; the time is the frame's index
/// truth/transforms.json           nerfstudio: the frames with their cameras and times in [0, 1]
/// truth/depth/0000.exr …          z, metres
/// truth/flow_forward/0000.flo …   from frame i to i + 1, pixels; none for the last frame
/// truth/flow_backward/0001.flo …  from frame i to i − 1, pixels; none for the first frame
/// truth/visible_forward/0000.png, truth/visible_backward/0001.png …
///                                 white where the flow ends at a visible point
/// truth/masks/0000.png …          white on movers
/// truth/tracks.npz                point tracks (see [`tracks`](crate::data::tracks))
/// truth/held_out/1/0000.png …, truth/held_out/2/0000.png …, truth/held_out/3/0000.png …
///                                 views offset by 8, 18 and 30 % of the median depth, every second time;
///                                 numbered like the frame
/// truth/held_out/masks/1/0000.png …
///                                 white on movers
/// truth/held_out/covisible/1/0000.png …
///                                 white where some frame shows the static point, and on movers
/// truth/held_out/transforms.json  all of these cameras
/// ```
///
/// # Errors
/// Those of [`check_new_folder`](crate::io::check_new_folder); [`Error::Io`] when writing fails.
pub fn write(clip: &Clip, folder: impl AsRef<Path>) -> Result<()> {
    io::write_folder(folder.as_ref(), &["truth", "frames"], |whole| contents(clip, whole))
}

fn contents(clip: &Clip, folder: &Path) -> Result<()> {
    let truth = folder.join("truth");
    series(&folder.join("frames"), "png", (0, 1), &clip.frames, |path, i| match clip.coded {
        true => write_png_16(path, i),
        false => write_png(path, i),
    })?;
    series(&truth.join("depth"), "exr", (0, 1), &clip.depth, |path, i| exr::write_depth(path, i))?;
    series(&truth.join("masks"), "png", (0, 1), &clip.masks, |path, i| write_mask(path, i))?;
    for (name, first, flows, visible) in [
        ("forward", 0, &clip.flow_forward, &clip.visible_forward),
        ("backward", 1, &clip.flow_backward, &clip.visible_backward),
    ] {
        let to = truth.join(format!("flow_{name}"));
        series(&to, "flo", (first, 1), flows, |path, flow| {
            let known = |v: &f32| if v.is_nan() { UNKNOWN_FLOW } else { *v };
            let pixels = flow.pixels.iter().map(known).collect();
            flo::write(path, &Image { pixels, ..*flow })
        })?;
        let to = truth.join(format!("visible_{name}"));
        series(&to, "png", (first, 1), visible, |path, i| write_mask(path, i))?;
    }
    tracks::write(truth.join("tracks.npz"), &clip.tracks)?;
    intrinsics::write(truth.join("intrinsics.json"), &clip.intrinsics)?;
    let poses: Vec<TimedPose> = clip
        .view_from_world
        .iter()
        .enumerate()
        .map(|(i, pose)| TimedPose { time: i as f64, world_from_view: pose.inverse() })
        .collect();
    trajectory::write(truth.join("poses.txt"), &poses)?;
    let number = |i: usize| format!("{i:04}.png");
    let cameras: Vec<TimedCamera> = (0..clip.frames.len())
        .map(|i| TimedCamera { time: clip.times[i], camera: clip.camera(i) })
        .collect();
    let files: Vec<String> =
        (0..cameras.len()).map(|i| format!("../frames/{}", number(i))).collect();
    transforms::write(truth.join("transforms.json"), &cameras, &files, None)?;

    let held_out = truth.join("held_out");
    let (mut cameras, mut files) = (Vec::new(), Vec::new());
    for (name, view) in (1..).map(|k: usize| k.to_string()).zip(&clip.held_out) {
        let each = (0, HELD_OUT_EVERY);
        series(&held_out.join(&name), "png", each, &view.frames, |path, i| write_png(path, i))?;
        for (kind, images) in [("masks", &view.masks), ("covisible", &view.covisible)] {
            let to = held_out.join(kind).join(&name);
            series(&to, "png", each, images, |path, i| write_mask(path, i))?;
        }
        for (camera, frame) in view.cameras.iter().zip(&view.times) {
            cameras.push(TimedCamera { time: clip.times[*frame], camera: *camera });
            files.push(format!("{name}/{}", number(*frame)));
        }
    }
    transforms::write(held_out.join("transforms.json"), &cameras, &files, None)
}

/// Writes images to a new folder, numbered from the first with a stride.
fn series(
    folder: &Path,
    extension: &str,
    (first, every): (usize, usize),
    images: &[Image],
    write: impl Fn(&Path, &Image) -> Result<()> + Sync,
) -> Result<()> {
    fs::create_dir_all(folder).map_err(Error::io(folder))?;
    images.par_iter().enumerate().try_for_each(|(i, image)| {
        write(&folder.join(format!("{:04}.{extension}", first + i * every)), image)
    })
}

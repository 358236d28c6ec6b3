//! What the user already has of a clip: poses, masks, depth, flow, brought to the frames taken.

use std::path::{Path, PathBuf};

use splat4d::data::{Clip, exr, flo, images, intrinsics, read_mask, trajectory, transforms};
use splat4d::observe::SuppliedFlow;
use splat4d::types::{Image, Intrinsics, Pose};
use splat4d::{Error, Result};

/// One thing for each frame taken, from a list for the frames taken or for all frames of the clip.
pub fn for_frames<T>(
    all: Vec<T>,
    frames: usize,
    every: usize,
    path: &Path,
    what: &str,
) -> Result<Vec<T>> {
    let count = all.len();
    if count == frames {
        return Ok(all);
    }
    let chosen: Vec<T> = all.into_iter().step_by(every).take(frames).collect();
    if chosen.len() == frames && count > frames {
        return Ok(chosen);
    }
    Err(Error::format(
        path,
        format!(
            "holds {count} {what}, and {frames} frames are taken; give one for each frame taken, \
             or one for each frame of the clip"
        ),
    ))
}

/// Poses (`view_from_world`) of a TUM trajectory or a `transforms.json`.
pub fn poses(path: &Path) -> Result<Vec<Pose>> {
    if path.extension().is_some_and(|e| e == "json") {
        let cameras = transforms::read_cameras(path)?;
        return Ok(cameras.iter().map(|c| c.camera.view_from_world).collect());
    }
    let poses = trajectory::read(path, None)?;
    Ok(poses.iter().map(|p| p.world_from_view.inverse()).collect())
}

/// Intrinsics of a file, at the size of the frames.
pub fn intrinsics(path: &Path, clip: &Clip) -> Result<Intrinsics> {
    let given = intrinsics::read(path)?;
    let aspect = |width: u32, height: u32| f64::from(width) / f64::from(height);
    let ratio = aspect(given.width, given.height) / aspect(clip.width, clip.height);
    // A resized frame's sides are whole pixels.
    if (ratio - 1.0).abs() > 2.0 / f64::from(clip.width.min(clip.height)) {
        let (width, height) = clip.original;
        return Err(Error::format(
            path,
            format!(
                "is of {}×{} pixels, and the frames, {width}×{height}, have other proportions",
                given.width, given.height
            ),
        ));
    }
    Ok(given.resized(clip.width, clip.height))
}

/// Motion masks of a folder of images.
pub fn masks(folder: &Path, width: u32, height: u32) -> Result<Vec<Image>> {
    let files = images::list(folder)?;
    files.iter().map(|file| Ok(nearest(&read_mask(file)?, width, height))).collect()
}

/// Depth maps of a folder of EXR files.
pub fn depth(folder: &Path, width: u32, height: u32) -> Result<Vec<Image>> {
    let files = files(folder, "exr")?;
    files.iter().map(|file| Ok(nearest(&exr::read_depth(file)?, width, height))).collect()
}

/// Optical flow of a folder, as `synth` lays it out or as [`SuppliedFlow::open`] reads it.
pub fn flow(folder: &Path) -> Result<SuppliedFlow> {
    let both = ["flow_forward", "flow_backward"].map(|name| folder.join(name));
    if !both.iter().all(|inner| inner.is_dir()) {
        return SuppliedFlow::open(folder);
    }
    let read = |inner: &Path| -> Result<Vec<Image>> {
        files(inner, "flo")?.iter().map(flo::read).collect()
    };
    SuppliedFlow::new(read(&both[0])?, read(&both[1])?)
}

/// The files with an extension, in the natural order of their names.
fn files(folder: &Path, extension: &str) -> Result<Vec<PathBuf>> {
    let mut files = Vec::new();
    for entry in std::fs::read_dir(folder).map_err(Error::io(folder))? {
        let path = entry.map_err(Error::io(folder))?.path();
        if path.extension().is_some_and(|e| e.eq_ignore_ascii_case(extension)) {
            files.push(path);
        }
    }
    files.sort_by(|a, b| images::natural(&a.to_string_lossy(), &b.to_string_lossy()));
    Ok(files)
}

/// Another size without mixing values: depths on both sides of an edge have no meaningful mean.
fn nearest(image: &Image, width: u32, height: u32) -> Image {
    if (image.width, image.height) == (width, height) {
        return image.clone();
    }
    let mut out = Image::new(width, height, image.channels);
    let place = |i: u32, new: u32, old: u32| {
        (((f64::from(i) + 0.5) * f64::from(old) / f64::from(new)) as u32).min(old - 1)
    };
    for y in 0..height {
        for x in 0..width {
            let from = (place(x, width, image.width), place(y, height, image.height));
            out.at_mut(x, y).copy_from_slice(image.at(from.0, from.1));
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lists_for_all_frames_or_for_those_taken() {
        let path = Path::new("poses.txt");
        let take = |count: usize, frames: usize, every: usize| {
            for_frames((0..count).collect(), frames, every, path, "poses")
        };
        assert_eq!(take(4, 4, 3).unwrap(), [0, 1, 2, 3]);
        assert_eq!(take(10, 4, 3).unwrap(), [0, 3, 6, 9]);
        assert_eq!(take(24, 4, 2).unwrap(), [0, 2, 4, 6]);
        let message = take(3, 4, 1).unwrap_err().to_string();
        assert!(message.contains("3 poses") && message.contains("4 frames"), "{message}");
    }

    #[test]
    fn resizing_does_not_mix() {
        let image = Image { width: 2, height: 1, channels: 1, pixels: vec![1.0, 9.0] };
        assert_eq!(nearest(&image, 4, 2).pixels, [1.0, 1.0, 9.0, 9.0, 1.0, 1.0, 9.0, 9.0]);
        assert_eq!(nearest(&image, 1, 1).pixels.len(), 1);
    }
}

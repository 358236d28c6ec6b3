//! MonST3R's output folder: `pred_traj.txt` (time, translation, quaternion in the order w, x, y, z; camera
//! to world), `pred_intrinsics.txt` (the nine numbers of each frame's matrix, in pixels of the network's
//! working size), `frame_0000.npy`, … (depth), `dynamic_mask_0.png`, … (white on movers).

use std::path::{Path, PathBuf};

use super::images;
use super::trajectory::{self, QuaternionOrder, TimedPose};
use crate::io;
use crate::types::Intrinsics;
use crate::{Error, Result};

/// The file that identifies such a folder.
const POSES: &str = "pred_traj.txt";

/// Whether a folder is an output folder of MonST3R.
pub fn is_output(folder: &Path) -> bool {
    folder.join(POSES).is_file()
}

/// The camera poses, one per frame.
pub fn poses(folder: &Path) -> Result<Vec<TimedPose>> {
    trajectory::read(folder.join(POSES), Some(QuaternionOrder::Wxyz))
}

/// Intrinsics per frame; `None` where the file is missing. The image size is twice the principal point,
/// which is the image centre.
///
/// # Errors
/// [`Error::Io`]; [`Error::Format`] with the line.
pub fn intrinsics(folder: &Path) -> Result<Option<Vec<Intrinsics>>> {
    let path = folder.join("pred_intrinsics.txt");
    if !path.is_file() {
        return Ok(None);
    }
    let text = io::read_text(&path)?;
    let mut found = Vec::new();
    for (i, line) in text.lines().enumerate().filter(|(_, line)| !line.trim().is_empty()) {
        let bad = |what: String| Error::format(&path, format!("line {}: {what}", i + 1));
        let numbers: Vec<Option<f64>> =
            line.split_ascii_whitespace().map(|word| word.parse().ok()).collect();
        let [Some(fx), _, Some(cx), _, Some(fy), Some(cy), _, _, _] = numbers[..] else {
            return Err(bad("the nine numbers of a 3×3 matrix expected".into()));
        };
        let (width, height) = ((2.0 * cx).round() as usize, (2.0 * cy).round() as usize);
        let (width, height) = images::sides(width, height)
            .ok_or_else(|| bad(format!("a principal point of ({cx:?}, {cy:?}) makes no sense")))?;
        let k = Intrinsics { fx, fy, cx, cy, width, height };
        k.check().map_err(bad)?;
        found.push(k);
    }
    Ok(Some(found))
}

/// The depth maps (`.npy`), in frame order.
pub fn depth(folder: &Path) -> Result<Vec<PathBuf>> {
    list(folder, "frame_", "npy")
}

/// The motion masks, in frame order.
pub fn masks(folder: &Path) -> Result<Vec<PathBuf>> {
    list(folder, "dynamic_mask_", "png")
}

fn list(folder: &Path, prefix: &str, extension: &str) -> Result<Vec<PathBuf>> {
    let mut found = Vec::new();
    for entry in std::fs::read_dir(folder).map_err(Error::io(folder))? {
        let path = entry.map_err(Error::io(folder))?.path();
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        if name.starts_with(prefix) && path.extension().is_some_and(|e| e == extension) {
            found.push(path);
        }
    }
    found.sort_by(|a, b| images::natural(&a.to_string_lossy(), &b.to_string_lossy()));
    Ok(found)
}

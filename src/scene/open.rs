//! Opening a scene of any readable format, and saving a scene.

use super::{Format, Scene, file, ply, sog, splat, spz};
use crate::types::Gaussians;
use crate::{Error, Result};
use std::path::Path;

/// A scene read from a file, and the number of Gaussians left out.
#[derive(Clone, Debug)]
pub struct Opened {
    /// The scene.
    pub scene: Scene,
    /// Number of Gaussians left out because they held NaN, infinite or out-of-range values
    /// ([`Gaussians::check`]).
    pub dropped: usize,
}

impl Scene {
    /// Opens a scene file, or Gaussians of another format: 3DGS PLY, plain or compressed, SPZ, SOG
    /// (a `.sog` or a folder's `meta.json`), `.splat`. The format is detected from the content;
    /// `.splat`, which has no header, and `meta.json` are recognised by their names. With
    /// `drop_bad`, Gaussians with NaN, infinite or out-of-range values ([`Gaussians::check`]) are
    /// left out and counted; without it, they are an error that states their number.
    pub fn open(path: impl AsRef<Path>, drop_bad: bool) -> Result<Opened> {
        let path = path.as_ref();
        let bytes = crate::io::read(path)?;
        let still = |(gaussians, dropped)| Opened { scene: Scene::of(gaussians), dropped };
        if crate::io::ply::is_ply(&bytes) {
            return ply::parse(path, &bytes, drop_bad).map(still);
        }
        if spz::is_spz(&bytes) {
            return spz::parse(path, &bytes, drop_bad);
        }
        let is_meta = path.file_name().is_some_and(|name| name == "meta.json");
        if sog::is_archive(&bytes) || is_meta {
            return sog::parse(path, &bytes, drop_bad).map(still);
        }
        if Format::of(path) == Some(Format::Splat) {
            return splat::parse(path, &bytes, drop_bad).map(still);
        }
        file::parse(path, &bytes, drop_bad)
    }

    /// Writes the scene file, atomically by rename; see [`mod@file`].
    pub fn save(&self, path: impl AsRef<Path>) -> Result<()> {
        file::write(path.as_ref(), self)
    }
}

/// Removes the Gaussians with non-finite or out-of-range values, or fails with their number.
pub(super) fn without_bad(path: &Path, gaussians: &mut Gaussians, drop_bad: bool) -> Result<usize> {
    let per = gaussians.sh.len() / gaussians.len().max(1);
    let good: Vec<bool> = (0..gaussians.len()).map(|i| gaussians.check(i).is_ok()).collect();
    let bad = good.iter().filter(|good| !**good).count();
    if bad == 0 {
        return Ok(0);
    }
    if !drop_bad {
        let first = good.iter().position(|good| !good).unwrap_or(0);
        let what = gaussians.check(first).err().unwrap_or_default();
        return Err(Error::format(
            path,
            format!(
                "{bad} of {} Gaussians hold NaN, infinite or out-of-range values (the first is \
                 number {first}: {what}); drop_bad leaves them out",
                good.len()
            ),
        ));
    }
    fn keep<T>(rows: &mut Vec<T>, good: &[bool], per: usize) {
        let mut row = 0;
        rows.retain(|_| {
            row += 1;
            good[(row - 1) / per]
        });
    }
    keep(&mut gaussians.positions, &good, 1);
    keep(&mut gaussians.log_scales, &good, 1);
    keep(&mut gaussians.rotations, &good, 1);
    keep(&mut gaussians.opacity_logits, &good, 1);
    keep(&mut gaussians.sh, &good, per.max(1));
    keep(&mut gaussians.motion_logits, &good, 1);
    Ok(bad)
}

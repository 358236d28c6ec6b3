//! The extension of an SPZ file that holds a scene's motion.
//!
//! The payload is: a `u32` with the version of the payload, 1; a `u32` with the number of dynamic
//! Gaussians, which are the last ones of the file; a `u64` with the unpacked size in bytes; and a
//! zstd stream. The stream unpacks to a native scene file ([`mod@crate::scene::file`]) in its
//! compact form. It holds the dynamic Gaussians in the same order, in the canonical frame; of
//! these, position, rotation, opacity and motion are used. It also holds the scene's control
//! points, their paths or the network, cameras and settings.

use std::path::Path;

use super::EFFORT;
use crate::io::Bytes;
use crate::scene::{Opened, Scene, compact, file, packing, without_bad};
use crate::types::Gaussians;
use crate::{Error, Result};

/// The type of the extension: the vendor number `S4`, and 1.
pub const MOTION: u32 = 0x5334_0001;
/// The payload's version.
const VERSION: u32 = 1;
/// The motion logit of a static Gaussian.
const STILL: f32 = -10.0;

/// The Gaussians to write, with the dynamic ones last, and the record of the extension.
pub(super) fn split(scene: &Scene, posed: &Gaussians) -> Result<(Gaussians, Vec<u8>)> {
    file::check_lengths(posed)?;
    let (g, n) = (&scene.gaussians, scene.gaussians.len());
    if posed.len() != n {
        let expected = n.to_string();
        return Err(Error::Shape { op: "spz", arg: "posed", expected, actual: posed.len() });
    }
    let moves = |i: &u32| g.motion_logits.get(*i as usize).is_some_and(|m| *m > 0.0);
    let (movers, still): (Vec<u32>, Vec<u32>) = (0..n as u32).partition(moves);
    // The order of the compact form.
    let places: Vec<[f32; 3]> = movers.iter().map(|&i| g.positions[i as usize]).collect();
    let along = packing::morton_order(&places);
    let movers: Vec<u32> = along.into_iter().map(|k| movers[k as usize]).collect();
    let mut moving = packing::picked(g, &movers);
    // The file itself holds the colours.
    moving.sh_degree = 0;
    moving.sh = vec![[0.0; 3]; movers.len()];
    let motion = Scene { gaussians: moving, ..scene.clone() };
    let bytes = compact::encoded(&motion)?;
    let packed = zstd::bulk::compress(&bytes, EFFORT)
        .map_err(|e| Error::Failed(format!("compressing failed: {e}")))?;
    let too_large =
        || Error::Input("the scene's motion is too large for an extension of SPZ".into());
    let length = u32::try_from(16 + packed.len()).map_err(|_| too_large())?;
    let mut record = Vec::new();
    for word in [MOTION, length, VERSION, movers.len() as u32] {
        record.extend(word.to_le_bytes());
    }
    record.extend((bytes.len() as u64).to_le_bytes());
    record.extend(packed);
    let posed = Gaussians { motion_logits: Vec::new(), ..posed.clone() };
    Ok((packing::picked(&posed, &[still, movers].concat()), record))
}

/// Restores the scene from a file's Gaussians and the payload of the extension.
pub(super) fn restored(
    path: &Path,
    mut gaussians: Gaussians,
    payload: &[u8],
    drop_bad: bool,
) -> Result<Opened> {
    let bad = |what: String| Error::format(path, what);
    let mut at = Bytes::new(path, payload);
    let version = at.u32("the motion's version")?;
    if version != VERSION {
        return Err(bad(format!(
            "holds motion of version {version}; this splat4d reads version {VERSION}. Update splat4d"
        )));
    }
    let movers = at.u32("the number that move")? as usize;
    let size = at.u64("the motion's size")?;
    packing::check_room(path, size, payload.len())?;
    let packed = at.take(at.left(), "the motion")?;
    let bytes = zstd::bulk::decompress(packed, size as usize)
        .map_err(|e| packing::unpacking(path, "its motion", &e))?;
    let mut scene = file::parse(path, &bytes, false)?.scene;
    let first = gaussians.len().checked_sub(movers).filter(|_| scene.gaussians.len() == movers);
    let first = first.ok_or_else(|| {
        let (moving, all) = (scene.gaussians.len(), gaussians.len());
        bad(format!("holds the motion of {moving} Gaussians, says {movers}, and has {all}"))
    })?;
    let moving = &scene.gaussians;
    if moving.motion_logits.len() != movers {
        return Err(bad("holds motion without saying which Gaussians move".into()));
    }
    gaussians.positions[first..].copy_from_slice(&moving.positions);
    gaussians.rotations[first..].copy_from_slice(&moving.rotations);
    gaussians.opacity_logits[first..].copy_from_slice(&moving.opacity_logits);
    gaussians.motion_logits = vec![STILL; first];
    gaussians.motion_logits.extend(&moving.motion_logits);
    let dropped = without_bad(path, &mut gaussians, drop_bad)?;
    scene.gaussians = gaussians;
    Ok(Opened { scene, dropped })
}

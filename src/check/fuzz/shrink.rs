//! Minimises a failing scene: it removes Gaussians and simplifies numbers as long as the scene
//! still fails.

use super::{FuzzScene, judge};
use crate::error::Result;
use crate::gpu::{Device, Stream};
use crate::types::{Gaussians, Intrinsics, Pose, sh_coefficients};

/// Maximum number of scenes tried.
const TRIALS: usize = 2000;

/// The smallest scene found that still fails, and the description of its failure.
///
/// # Errors
/// A failed Vulkan call; a scene that does not fail.
pub fn shrink(
    device: &Device,
    stream: &mut Stream,
    scene: FuzzScene,
) -> Result<(FuzzScene, String)> {
    let Some(mut what) = judge(device, stream, &scene)? else {
        return Err(crate::Error::Failed("the scene fails once, and then no more".into()));
    };
    let (mut best, mut trials) = (scene, 0);
    loop {
        let mut smaller = None;
        for candidate in candidates(&best) {
            trials += 1;
            if trials > TRIALS {
                return Ok((best, what));
            }
            if let Some(wrong) = judge(device, stream, &candidate)? {
                smaller = Some((candidate, wrong));
                break;
            }
        }
        match smaller {
            Some((candidate, wrong)) => (best, what) = (candidate, wrong),
            None => return Ok((best, what)),
        }
    }
}

/// All scenes that are one step simpler, the largest steps first.
fn candidates(scene: &FuzzScene) -> Vec<FuzzScene> {
    let mut out = Vec::new();
    let g = &scene.gaussians;
    let mut with = |change: &dyn Fn(&mut FuzzScene)| {
        let mut next = scene.clone();
        change(&mut next);
        out.push(next);
    };
    for i in 0..g.len() {
        with(&|s| remove(&mut s.gaussians, i));
    }
    if g.sh_degree > 0 {
        with(&|s| lower(&mut s.gaussians));
    }
    let k = scene.camera.intrinsics;
    if (k.width, k.height) != (1, 1) {
        for (width, height) in [(1, 1), (k.width.div_ceil(2), k.height.div_ceil(2))] {
            with(&|s| s.camera.intrinsics = Intrinsics { width, height, ..k });
        }
    }
    let plain = Intrinsics::centred(20.0, k.width, k.height);
    if k != plain {
        with(&|s| s.camera.intrinsics = plain);
    }
    if scene.camera.view_from_world != Pose::IDENTITY {
        with(&|s| s.camera.view_from_world = Pose::IDENTITY);
    }
    for i in 0..g.len() {
        if g.positions[i] != [0.0, 0.0, 2.0] {
            with(&|s| s.gaussians.positions[i] = [0.0, 0.0, 2.0]);
        }
        if g.log_scales[i] != [-1.0; 3] {
            with(&|s| s.gaussians.log_scales[i] = [-1.0; 3]);
        }
        if g.rotations[i] != [1.0, 0.0, 0.0, 0.0] {
            with(&|s| s.gaussians.rotations[i] = [1.0, 0.0, 0.0, 0.0]);
        }
        if g.opacity_logits[i] != 1.0 {
            with(&|s| s.gaussians.opacity_logits[i] = 1.0);
        }
        for c in 0..3 {
            if g.log_scales[i][c] != -1.0 {
                with(&|s| s.gaussians.log_scales[i][c] = -1.0);
            }
            if g.positions[i][c] != [0.0, 0.0, 2.0][c] {
                with(&|s| s.gaussians.positions[i][c] = [0.0, 0.0, 2.0][c]);
            }
        }
        for c in 0..4 {
            if g.rotations[i][c] != 0.0 {
                with(&|s| s.gaussians.rotations[i][c] = 0.0);
            }
        }
    }
    for row in 0..g.sh.len() {
        if g.sh[row] != [0.0; 3] {
            with(&|s| s.gaussians.sh[row] = [0.0; 3]);
        }
    }
    out
}

fn remove(g: &mut Gaussians, i: usize) {
    let rows = sh_coefficients(g.sh_degree);
    g.positions.remove(i);
    g.log_scales.remove(i);
    g.rotations.remove(i);
    g.opacity_logits.remove(i);
    g.sh.drain(i * rows..(i + 1) * rows);
}

fn lower(g: &mut Gaussians) {
    let (rows, fewer) = (sh_coefficients(g.sh_degree), sh_coefficients(g.sh_degree - 1));
    g.sh = g.sh.chunks(rows).flat_map(|row| row[..fewer].to_vec()).collect();
    g.sh_degree -= 1;
}

//! Scenes for the tests of exports, and PlayCanvas' splat-transform, an independent program that reads
//! and writes the formats. `tools/setup.sh test` installs it beside the build directory. Its SPZ code is
//! the format's reference library.

// Each test binary uses its own part.
#![allow(dead_code)]

use std::path::{Path, PathBuf};
use std::process::Command;

use splat4d::scene::{Scene, SceneCamera};
use splat4d::types::{Camera, ControlPoints, Gaussians, Intrinsics, Pose, sh_coefficients};

/// A deterministic pseudo-random number in [0, 1) from two indices.
fn noise(i: usize, k: usize) -> f32 {
    let mut x = (i as u64).wrapping_mul(0x9e37_79b9_7f4a_7c15)
        ^ (k as u64).wrapping_mul(0xd1b5_4a32_d192_ed03);
    x = (x ^ x >> 29).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    (x >> 40) as f32 / (1 << 24) as f32
}

/// Gaussians in front of a camera at the origin, on a slightly perturbed grid, so that none is close to
/// another.
pub fn cloud(sh_degree: u32) -> Gaussians {
    let n = 700;
    let bands = sh_coefficients(sh_degree);
    let place = |i: usize| {
        let cell = [i % 10, i / 10 % 10, i / 100];
        let offset = [-0.9, -0.9, 2.5];
        std::array::from_fn(|c| 0.2 * cell[c] as f32 + 0.1 * noise(i, c) + offset[c])
    };
    Gaussians {
        positions: (0..n).map(place).collect(),
        log_scales: (0..n).map(|i| std::array::from_fn(|c| -3.5 + noise(i, 3 + c))).collect(),
        rotations: (0..n).map(|i| std::array::from_fn(|c| noise(i, 6 + c) - 0.4)).collect(),
        opacity_logits: (0..n).map(|i| 6.0 * noise(i, 10) - 2.0).collect(),
        sh_degree,
        sh: (0..n * bands)
            .map(|i| {
                let size = if i % bands == 0 { 2.4 } else { 0.6 };
                std::array::from_fn(|c| size * (noise(i, 11 + c) - 0.5))
            })
            .collect(),
        motion_logits: Vec::new(),
    }
}

/// The Gaussians of [`cloud`], of which a third moves along control points' paths.
pub fn moving(sh_degree: u32) -> Scene {
    let mut gaussians = cloud(sh_degree);
    gaussians.motion_logits =
        (0..gaussians.len()).map(|i| if i % 3 == 0 { 4.0 } else { -4.0 }).collect();
    let (nodes, keys) = (12, 6);
    let path = |key: usize, node: usize| -> [f32; 8] {
        let phase = key as f32 * 0.9 + node as f32;
        let turn = 0.1 * key as f32;
        let fade = if node == 5 && key < 2 { ControlPoints::ABSENT } else { 0.0 };
        [0.1 * key as f32, 0.1 * phase.sin(), 0.05 * phase.cos(), fade, 0.0, turn, 0.0, -turn]
    };
    let intrinsics = Intrinsics::centred(100.0, 96, 72);
    let camera = Camera { intrinsics, view_from_world: Pose::IDENTITY };
    Scene {
        control_points: ControlPoints {
            positions: (0..nodes)
                .map(|i| [noise(i, 30) * 2.0 - 1.0, noise(i, 31) * 2.0 - 1.0, 2.5 + noise(i, 32)])
                .collect(),
            log_radii: vec![-1.0; nodes],
            paths: (0..keys * nodes).map(|i| path(i / nodes, i % nodes)).collect(),
        },
        cameras: (0..5).map(|i| SceneCamera { time: f64::from(i) / 4.0, camera }).collect(),
        ..Scene::of(gaussians)
    }
}

/// Converts a file with splat-transform.
#[track_caller]
pub fn transformed(input: &Path, output: &Path, options: &[&str]) -> PathBuf {
    let beside = Path::new(env!("CARGO_TARGET_TMPDIR")).parent().unwrap();
    let script = beside.join("splats/node_modules/@playcanvas/splat-transform/bin/cli.mjs");
    assert!(script.exists(), "{}; tools/setup.sh test installs it", script.display());
    let done = Command::new("node")
        .arg(script)
        .args(["-q", "-w", "-g", "cpu"])
        .args(options)
        .args([input, output])
        .output()
        .expect("node runs; tools/setup.sh test installs it");
    let said = String::from_utf8_lossy(&done.stderr);
    assert!(done.status.success() && output.exists(), "{}: {said}", input.display());
    output.to_path_buf()
}

/// Largest differences between the same Gaussians in two files, by attribute.
#[derive(Debug, Default)]
pub struct Apart {
    pub position: f32,
    pub log_scale: f32,
    /// 1 − |q · p| for unit quaternions q and p.
    pub rotation: f32,
    pub opacity: f32,
    pub colour: f32,
    pub harmonic: f32,
}

/// Compares two sets of Gaussians in any order: each is matched with the nearest of the other set, and
/// each match must be unique.
#[track_caller]
pub fn apart(ours: &Gaussians, others: &Gaussians) -> Apart {
    assert_eq!((ours.len(), ours.sh_degree), (others.len(), others.sh_degree));
    let bands = sh_coefficients(ours.sh_degree);
    let mut taken = vec![false; others.len()];
    let mut apart = Apart::default();
    for (i, p) in ours.positions.iter().enumerate() {
        let distance = |q: &[f32; 3]| (0..3).map(|c| (p[c] - q[c]).powi(2)).sum::<f32>().sqrt();
        let nearest = |a: &usize, b: &usize| {
            distance(&others.positions[*a]).total_cmp(&distance(&others.positions[*b]))
        };
        let j = (0..others.len()).min_by(nearest).unwrap();
        assert!(!std::mem::replace(&mut taken[j], true), "{i} has no partner of its own");
        let worst = |a: &[f32], b: &[f32], to: &mut f32| {
            a.iter().zip(b).for_each(|(a, b)| *to = to.max((a - b).abs()));
        };
        worst(p, &others.positions[j], &mut apart.position);
        worst(&ours.log_scales[i], &others.log_scales[j], &mut apart.log_scale);
        let unit = |q: [f32; 4]| {
            let length = q.iter().map(|v| v * v).sum::<f32>().sqrt();
            q.map(|v| v / length)
        };
        let (q, r) = (unit(ours.rotations[i]), unit(others.rotations[j]));
        let dot: f32 = q.iter().zip(&r).map(|(a, b)| a * b).sum();
        apart.rotation = apart.rotation.max(1.0 - dot.abs());
        let opacity = |logit: f32| 1.0 / (1.0 + (-logit).exp());
        let found = [ours.opacity_logits[i], others.opacity_logits[j]].map(opacity);
        apart.opacity = apart.opacity.max((found[0] - found[1]).abs());
        let (a, b) = (&ours.sh[i * bands..][..bands], &others.sh[j * bands..][..bands]);
        worst(&a[0], &b[0], &mut apart.colour);
        worst(a[1..].as_flattened(), b[1..].as_flattened(), &mut apart.harmonic);
    }
    apart
}

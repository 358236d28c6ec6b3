//! Scenes for the tests of exports, and the programs of the formats in `tools/splats`, which `tools/setup.sh test`
//! installs beside the build directory: PlayCanvas' splat-transform, which reads and writes the formats, its SPZ
//! code the format's reference library, and Khronos' glTF validator.

// Each test binary uses its own part.
#![allow(dead_code)]

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use serde_json::Value;
use splat4d::scene::{Scene, SceneCamera};
use splat4d::types::{Camera, ControlPoints, Gaussians, Intrinsics, Pose, SH_C0, sh_coefficients};

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

/// The folder of the installed packages, which must be those of the lock file.
#[track_caller]
fn packages() -> PathBuf {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).parent().unwrap().join("splats");
    let lock = |folder: &Path| fs::read(folder.join("package-lock.json")).ok();
    let wanted = lock(&Path::new(env!("CARGO_MANIFEST_DIR")).join("tools/splats"));
    assert!(
        wanted.is_some() && lock(&folder) == wanted,
        "{} does not hold the packages of tools/splats/package-lock.json; tools/setup.sh test installs them",
        folder.display()
    );
    folder.join("node_modules")
}

/// What Khronos' validator reports of a glTF file.
#[track_caller]
pub fn validated(path: &Path) -> Value {
    let script = "const [, module, file] = process.argv; \
                  require(module).validateBytes(new Uint8Array(require('fs').readFileSync(file))) \
                  .then((report) => console.log(JSON.stringify(report)));";
    let done = Command::new("node")
        .args(["-e", script])
        .args([&packages().join("gltf-validator"), path])
        .output()
        .expect("node runs; tools/setup.sh test installs it");
    let said = String::from_utf8_lossy(&done.stderr);
    assert!(done.status.success(), "{}: {said}", path.display());
    serde_json::from_slice(&done.stdout).unwrap()
}

/// Converts a file with splat-transform.
#[track_caller]
pub fn transformed(input: &Path, output: &Path, options: &[&str]) -> PathBuf {
    let done = Command::new("node")
        .arg(packages().join("@playcanvas/splat-transform/bin/cli.mjs"))
        .args(["-q", "-w", "-g", "cpu"])
        .args(options)
        .args([input, output])
        .output()
        .expect("node runs; tools/setup.sh test installs it");
    let said = String::from_utf8_lossy(&done.stderr);
    assert!(done.status.success() && output.exists(), "{}: {said}", input.display());
    output.to_path_buf()
}

/// The JSON and the binary chunk of a `.glb`.
pub fn glb(path: &Path) -> (Value, Vec<u8>) {
    let bytes = fs::read(path).unwrap();
    let word = |at: usize| u32::from_le_bytes(bytes[at..at + 4].try_into().unwrap()) as usize;
    assert_eq!((&bytes[..4], word(4), word(8)), (&b"glTF"[..], 2, bytes.len()));
    let (json, length) = (&bytes[20..20 + word(12)], word(12));
    assert_eq!((&bytes[16..20], &bytes[24 + length..28 + length]), (&b"JSON"[..], &b"BIN\0"[..]));
    assert_eq!(word(20 + length), bytes.len() - 28 - length);
    (serde_json::from_slice(json).unwrap(), bytes[28 + length..].to_vec())
}

/// Name of glTF's extension for an SPZ.
pub const SPZ_IN_GLB: &str = "KHR_gaussian_splatting_compression_spz_2";

/// The SPZ in a `.glb`.
pub fn spz_in_glb<'a>(json: &Value, binary: &'a [u8]) -> &'a [u8] {
    let splatting =
        &json["meshes"][0]["primitives"][0]["extensions"]["KHR_gaussian_splatting"]["extensions"];
    let view = &json["bufferViews"][splatting[SPZ_IN_GLB]["bufferView"].as_u64().unwrap() as usize];
    assert!(view["byteOffset"].is_null());
    &binary[..view["byteLength"].as_u64().unwrap() as usize]
}

/// The attributes of a `.glb` by name: the number of components of each, and its values.
pub fn attributes(path: &Path) -> BTreeMap<String, (usize, Vec<f32>)> {
    let (json, binary) = glb(path);
    assert_eq!(json["extensionsUsed"], serde_json::json!(["KHR_gaussian_splatting"]));
    let primitive = &json["meshes"][0]["primitives"][0];
    let splatting = &primitive["extensions"]["KHR_gaussian_splatting"];
    assert_eq!((&splatting["kernel"], &primitive["mode"]), (&"ellipse".into(), &0.into()));
    assert_eq!(splatting["colorSpace"], "srgb_rec709_display");
    let of = |(name, index): (&String, &Value)| {
        let accessor = &json["accessors"][index.as_u64().unwrap() as usize];
        let view = &json["bufferViews"][accessor["bufferView"].as_u64().unwrap() as usize];
        let number = |key: &str| view[key].as_u64().unwrap() as usize;
        let data = &binary[number("byteOffset")..][..number("byteLength")];
        let values = match accessor["componentType"].as_u64() {
            Some(5126) => data.as_chunks().0.iter().map(|b| f32::from_le_bytes(*b)).collect(),
            Some(5121) => data.iter().map(|b| f32::from(*b) / 255.0).collect::<Vec<f32>>(),
            other => panic!("{other:?}"),
        };
        let parts = match accessor["type"].as_str().unwrap() {
            "SCALAR" => 1,
            kind => kind[3..].parse().unwrap(),
        };
        assert_eq!(values.len(), parts * accessor["count"].as_u64().unwrap() as usize);
        (name.clone(), (parts, values))
    };
    primitive["attributes"].as_object().unwrap().iter().map(of).collect()
}

/// A `.splatv` file, read as splaTV's shader reads its texture.
pub struct SplatV {
    /// The cameras that it lists.
    pub cameras: Value,
    texture: Vec<u8>,
}

impl SplatV {
    /// Reads a file.
    pub fn read(path: &Path) -> SplatV {
        let bytes = fs::read(path).unwrap();
        let word = |at: usize| u32::from_le_bytes(bytes[at..at + 4].try_into().unwrap());
        assert_eq!(word(0), 0x674b);
        let text = &bytes[8..8 + word(4) as usize];
        let chunks: Value = serde_json::from_slice(text).unwrap();
        let chunk = &chunks[0];
        assert_eq!((&chunk["type"], &chunk["texwidth"]), (&"splat".into(), &4096.into()));
        let texture = bytes[8 + text.len()..].to_vec();
        assert_eq!(chunk["size"], texture.len());
        SplatV { cameras: chunk["cameras"].clone(), texture }
    }

    /// The Gaussians at a time, and the share of its opacity that each then has.
    pub fn at(&self, time: f64) -> (Gaussians, Vec<f64>) {
        let (mut g, mut shares) = (Gaussians::default(), Vec::new());
        for splat in self.texture.chunks_exact(64).filter(|splat| splat.iter().any(|b| *b != 0)) {
            let float = |c: usize| f32::from_le_bytes(splat[4 * c..4 * c + 4].try_into().unwrap());
            let half = |at: usize| half::f16::from_le_bytes([splat[at], splat[at + 1]]).to_f64();
            let t = time - half(60);
            g.positions.push(std::array::from_fn(|c| {
                let of = |power: usize| half(32 + 2 * (3 * (power - 1) + c));
                (f64::from(float(c)) + of(1) * t + of(2) * t * t + of(3) * t * t * t) as f32
            }));
            let rotation = |c: usize| (half(12 + 2 * c) + t * half(52 + 2 * c)) as f32;
            g.rotations.push(std::array::from_fn(rotation));
            g.log_scales.push(std::array::from_fn(|c| half(20 + 2 * c).ln() as f32));
            let byte = |c: usize| f32::from(splat[28 + c]) / 255.0;
            g.sh.push(std::array::from_fn(|c| (byte(c) - 0.5) / SH_C0));
            let share = (-(t / half(62)).powi(2)).exp();
            let opacity = (f64::from(byte(3)) * share).clamp(1e-6, 1.0 - 1e-6);
            g.opacity_logits.push((opacity / (1.0 - opacity)).ln() as f32);
            shares.push(share);
        }
        (g, shares)
    }
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

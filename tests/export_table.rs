//! What each format of `export` takes in bytes and seconds, and how near its pictures are to the scene's: each
//! file is read back and rendered by the engine, a page by Chromium.

#![cfg(feature = "cli")]

#[path = "support/browser.rs"]
mod browser;
#[path = "support/player.rs"]
mod player;
#[path = "support/program.rs"]
mod program;
#[path = "support/splats.rs"]
mod splats;
mod support;

use std::fs;
use std::path::{Path, PathBuf};

use glam::{DQuat, DVec3};
use splat4d::eval::psnr;
use splat4d::gpu::{Device, Request, Selector};
use splat4d::renderer::Renderer;
use splat4d::scene::{Scene, SceneCamera};
use splat4d::types::{Camera, Gaussians, Image, Intrinsics, Pose};
use splats::{SplatV, attributes, glb, moving, spz_in_glb};
use support::shared;

/// A format: the name of the file, and the options that it takes for any scene. Of a format without motion the
/// moment is asked for beside these.
struct Row {
    name: &'static str,
    options: &'static str,
    moves: bool,
    /// Smallest allowed PSNR of a scene with harmonics that moves, and of one that stands still, dB.
    least: [f64; 2],
}

const fn row(name: &'static str, options: &'static str, moves: bool, least: [f64; 2]) -> Row {
    Row { name, options, moves, least }
}

const ROWS: [Row; 11] = [
    row("a.safetensors", "", true, [90.0, 90.0]),
    row("compact.safetensors", "--compact", true, [40.0, 40.0]),
    row("v4.spz", "", true, [30.0, 30.0]),
    row("a.splatv", "--drop bands", true, [15.0, 35.0]),
    row("a.ply", "", false, [90.0, 90.0]),
    row("a.glb", "", false, [80.0, 80.0]),
    row("b.compressed.ply", "", false, [30.0, 30.0]),
    row("v3.spz", "--spz-version 3", false, [30.0, 30.0]),
    row("spz.glb", "--spz", false, [30.0, 30.0]),
    row("a.splat", "--drop bands", false, [20.0, 35.0]),
    row("page.html", "", true, [35.0, 35.0]),
];

/// A row as measured.
struct Measured {
    bytes: u64,
    seconds: f64,
    /// PSNR of each view against the scene, dB.
    psnr: Vec<f64>,
}

/// The views in which pictures are compared: of the scene's cameras the first, the middle and the last, or one
/// that sees the whole scene.
fn views(scene: &Scene) -> Vec<SceneCamera> {
    let all = &scene.cameras;
    if !all.is_empty() {
        return [0, all.len() / 2, all.len() - 1].map(|i| all[i]).to_vec();
    }
    let positions = &scene.gaussians.positions;
    let fold = |with: fn(f32, f32) -> f32| {
        DVec3::from(
            [0, 1, 2].map(|c| f64::from(positions.iter().map(|p| p[c]).reduce(with).unwrap())),
        )
    };
    let (low, high) = (fold(f32::min), fold(f32::max));
    let centre = low.midpoint(high) - 1.2 * (high - low).length() * DVec3::Z;
    let view_from_world = Pose { rotation: DQuat::IDENTITY, translation: -centre };
    let camera = Camera { intrinsics: Intrinsics::centred(500.0, 320, 240), view_from_world };
    vec![SceneCamera { time: 0.0, camera }]
}

/// The Gaussians of a `.glb` of this crate.
fn of_glb(path: &Path) -> Gaussians {
    let all = attributes(path);
    let of = |name: &str| &all[name].1;
    let rows = |name: &str| of(name).as_chunks::<3>().0.to_vec();
    let own = |name: &str| format!("KHR_gaussian_splatting:{name}");
    let degree = (1..4).rev().find(|d| all.contains_key(&own(&format!("SH_DEGREE_{d}_COEF_0"))));
    let count = of(&own("OPACITY")).len();
    // Left, up and front to right, down and front: a half turn about the axis that looks to the front.
    let place = |[x, y, z]: [f32; 3]| [-x, -y, z];
    let mut g = Gaussians {
        positions: rows("POSITION").into_iter().map(place).collect(),
        log_scales: rows(&own("SCALE")).into_iter().map(|s| s.map(f32::ln)).collect(),
        rotations: (of(&own("ROTATION")).as_chunks::<4>().0.iter())
            .map(|[x, y, z, w]| [*w, -x, -y, *z])
            .collect(),
        opacity_logits: of(&own("OPACITY"))
            .iter()
            .map(|o| o.clamp(1e-7, 1.0 - 1e-7))
            .map(|o| (o / (1.0 - o)).ln())
            .collect(),
        sh_degree: degree.unwrap_or(0),
        ..Gaussians::default()
    };
    let mut bands = Vec::new();
    for degree in 0..=g.sh_degree as usize {
        for n in 0..2 * degree + 1 {
            // Under that half turn a harmonic of order m changes its sign with that of (−1)^m.
            let odd = (n + degree) % 2 == 1;
            let rows = rows(&own(&format!("SH_DEGREE_{degree}_COEF_{n}")));
            bands
                .push(rows.into_iter().map(move |h| if odd { h.map(|v| -v) } else { h }).collect());
        }
    }
    let bands: Vec<Vec<[f32; 3]>> = bands;
    g.sh = (0..count).flat_map(|i| bands.iter().map(move |band| band[i])).collect();
    g
}

/// Exports a scene file and compares its pictures.
fn measured(folder: &Path, file: &Path, scene: &Scene, device: &Device, row: &Row) -> Measured {
    let list = views(scene);
    let mut renderer = Renderer::new(device, scene).unwrap();
    let mut truth =
        |view: &SceneCamera| player::truth(&mut renderer, scene, &view.camera, view.time);
    let pair = |truth: &Image, pixels: Image| psnr(truth, &pixels).unwrap().min(100.0);
    let output = folder.join(row.name);
    let export = |options: &str| {
        let words = format!("export {} -o {} {options}", file.display(), output.display());
        program::json(folder, &words)
    };
    let shown = |scene: &Scene, view: &SceneCamera| {
        player::truth(&mut Renderer::new(device, scene).unwrap(), scene, &view.camera, view.time)
    };
    if !row.moves {
        // One moment each, from its view.
        let mut all = Measured { bytes: 0, seconds: 0.0, psnr: Vec::new() };
        for view in &list {
            let time = if scene.moves() { format!("--time {}", view.time) } else { String::new() };
            let told = export(&format!("{} {time}", row.options));
            (all.bytes, all.seconds) =
                (told["written_bytes"].as_u64().unwrap(), told["seconds"].as_f64().unwrap());
            let gaussians = match row.name {
                "a.glb" => of_glb(&output),
                "spz.glb" => {
                    let (json, binary) = glb(&output);
                    let inside = folder.join("inside.spz");
                    fs::write(&inside, spz_in_glb(&json, &binary)).unwrap();
                    Scene::open(&inside, false).unwrap().scene.gaussians
                }
                _ => Scene::open(&output, false).unwrap().scene.gaussians,
            };
            let still = Scene { background: scene.background, ..Scene::of(gaussians) };
            all.psnr.push(pair(&truth(view), shown(&still, view)));
        }
        return all;
    }
    let told = export(row.options);
    let pictures: Vec<Image> = match row.name {
        "page.html" => {
            let mut page = player::opened(&output, 800, 600);
            let mut shot = |view: &SceneCamera| {
                let k = view.camera.intrinsics;
                player::shot(&mut page, Some(&view.camera), view.time, k.width, k.height)
            };
            list.iter().map(&mut shot).collect()
        }
        "a.splatv" => {
            let file = SplatV::read(&output);
            let at = |view: &SceneCamera| Scene {
                background: scene.background,
                ..Scene::of(file.at(view.time).0)
            };
            list.iter().map(|view| shown(&at(view), view)).collect()
        }
        _ => {
            let back = Scene {
                background: scene.background,
                ..Scene::open(&output, false).unwrap().scene
            };
            list.iter().map(|view| shown(&back, view)).collect()
        }
    };
    Measured {
        bytes: told["written_bytes"].as_u64().unwrap(),
        seconds: told["seconds"].as_f64().unwrap(),
        psnr: list
            .iter()
            .zip(pictures)
            .map(|(view, picture)| pair(&truth(view), picture))
            .collect(),
    }
}

/// Prints the table of a scene, and holds each row against its bound.
fn table(file: &Path) {
    let selector = Selector::from("software");
    let device = Device::open(&Request { selector, ..Request::default() }).unwrap();
    let folder = tempfile::tempdir().unwrap();
    let scene = Scene::open(file, false).unwrap().scene;
    println!("{}, {} Gaussians", file.display(), scene.gaussians.len());
    println!("| file | bytes | seconds | PSNR, mean | worst |");
    let mut short = Vec::new();
    for row in &ROWS {
        let found = measured(folder.path(), file, &scene, &device, row);
        let mean = found.psnr.iter().sum::<f64>() / found.psnr.len() as f64;
        let worst = found.psnr.iter().copied().fold(f64::INFINITY, f64::min);
        let Measured { bytes, seconds, .. } = found;
        println!("| {} | {bytes} | {seconds:.2} | {mean:.2} | {worst:.2} |", row.name);
        let least = row.least[usize::from(!scene.moves())];
        if worst < least {
            short.push(format!("{}: {worst:.2} dB, at least {least} is wanted", row.name));
        }
    }
    assert!(short.is_empty(), "{short:#?}");
}

#[test]
fn every_format_looks_like_the_scene() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("scene.safetensors");
    moving(1).save(&file).unwrap();
    table(&file);
}

/// The table of a scene of 152,746 Gaussians, and of the one that `SPLAT4D_SCENE` names.
#[test]
#[ignore = "measures large scenes"]
fn every_format_of_large_scenes() {
    let biker = shared("splats_playcanvas").map(|set| set.join("biker.compressed.ply"));
    let own = std::env::var_os("SPLAT4D_SCENE").map(PathBuf::from);
    biker.into_iter().chain(own).for_each(|file| table(&file));
}

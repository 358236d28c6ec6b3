//! `track --models` with networks whose outputs are exact on the frames of `synth --coded`, whose colours
//! encode the ground truth: the whole pipeline from frames through networks to cameras, depth and masks,
//! compared with the truth.
//!
//! `tools/setup.sh test` installs the ONNX Runtime beside the build directory; without it the tests fail.

#![cfg(all(feature = "cli", unix))]

#[path = "support/program.rs"]
mod program;
#[path = "support/runtime.rs"]
mod runtime;
mod support;

use std::path::Path;

use program::json;
use serde_json::Value;
use splat4d::data::{exr, read_mask, trajectory};
use splat4d::eval::{Align, compare_trajectories};
use splat4d::geometry::sim3::align_poses;
use splat4d::types::Pose;

const FRAMES: usize = 12;
/// Landscape, portrait, square, and with odd sides.
const SIZES: [&str; 4] = ["320x180", "180x320", "240x240", "319x179"];
/// Allowed relative error of depth.
const DEPTH: f64 = 0.005;
/// Networks by the sections of `models.toml`.
const ALL: [&str; 6] =
    ["depth", "flow", "mask_encoder", "mask_decoder", "pointmap_encoder", "pointmap_decoder"];

/// Errors of the result against the truth.
#[derive(Debug)]
struct Errors {
    /// Root mean square distance of the camera centres after alignment, relative to the length of their
    /// path.
    path: f64,
    /// Median relative error of depth, of the static scene (`still`) and of movers (`moves`).
    still: f64,
    moves: f64,
    /// Intersection over union of the masks of all frames.
    masks: f64,
    notes: String,
    /// The quantities that come from a network, with the network's file.
    told: Vec<String>,
}

/// Makes a folder with a coded clip of a size and `models` with some of the networks. Also returns the
/// option that names the runtime.
fn prepared(size: &str, frames: usize, networks: &[&str]) -> (tempfile::TempDir, String) {
    let folder = tempfile::tempdir().unwrap();
    let models = folder.path().join("models");
    std::fs::create_dir(&models).unwrap();
    let mut list = String::new();
    for name in networks {
        let file = format!("coded_{name}.onnx");
        let source = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/models").join(&file);
        std::fs::copy(source, models.join(&file)).unwrap();
        list += &format!("[{name}]\nfile = \"{file}\"\n");
    }
    std::fs::write(models.join("models.toml"), list).unwrap();
    let synth = format!("synth rigid -o clip --coded --frames {frames} --size {size} --seed 3");
    json(folder.path(), &synth);
    let library = runtime::library().map(|file| format!(" --onnxruntime {}", file.display()));
    (folder, library.unwrap_or_default())
}

/// The quantities that come from networks according to a report, with the networks' files.
fn told(report: &Value) -> Vec<String> {
    let of = report["sources"].as_object().unwrap().iter();
    let network = |(what, of): (&String, &Value)| {
        let from = of["from"].as_str().unwrap_or_default();
        (of["source"] == "network").then(|| format!("{what} {from}"))
    };
    of.filter_map(network).collect()
}

/// Tracks a coded clip of a size with some of the networks.
fn tracked(size: &str, networks: &[&str]) -> Errors {
    let (folder, library) = prepared(size, FRAMES, networks);
    let at = |name: &str| folder.path().join(name);
    let track = format!("track clip/frames -o out --models models{library}");
    let report = json(folder.path(), &track);
    let page = std::fs::read_to_string(at("out/report.html")).unwrap();
    assert!(page.contains("Where it is from"), "{size}");
    let poses = |file: &str| -> Vec<Pose> {
        let timed = trajectory::read(at(file), None).unwrap();
        timed.iter().map(|timed| timed.world_from_view).collect()
    };
    let (found, truth) = (poses("out/poses.txt"), poses("clip/truth/poses.txt"));
    let scale = align_poses(&found, &truth, true).unwrap().reference_from_estimate.scale;
    let (mut depth, mut both, mut either) = ([Vec::new(), Vec::new()], 0, 0);
    for frame in 0..FRAMES {
        let map = |kind: &str| exr::read_depth(at(kind).join(format!("{frame:04}.exr"))).unwrap();
        let mask = |kind: &str| read_mask(at(kind).join(format!("{frame:04}.png"))).unwrap();
        let (told, true_depth) = (map("out/depth"), map("clip/truth/depth"));
        let (masked, moving) = (mask("out/masks"), mask("clip/truth/masks"));
        for i in 0..told.pixels.len() {
            let (masked, moves) = (masked.pixels[i] > 0.5, moving.pixels[i] > 0.5);
            both += usize::from(moves && masked);
            either += usize::from(moves || masked);
            let z = scale * f64::from(told.pixels[i]);
            depth[usize::from(moves)].push((z / f64::from(true_depth.pixels[i]) - 1.0).abs());
        }
    }
    let [still, moves] = depth.map(|mut errors| {
        errors.sort_by(f64::total_cmp);
        errors[errors.len() / 2]
    });
    Errors {
        path: compare_trajectories(&found, &truth, Align::Sim3).unwrap().ate_relative,
        still,
        moves,
        masks: both as f64 / either as f64,
        notes: report["notes"].to_string(),
        told: told(&report),
    }
}

/// Checks that exact networks give exact cameras, masks and depth.
fn are_right(size: &str) {
    let found = tracked(size, &ALL);
    println!("{size}: {found:?}");
    assert!(found.path <= 0.002 && found.masks >= 0.95, "{size}: {found:?}");
    assert!(found.still <= DEPTH && found.moves <= DEPTH, "{size}: {found:?}");
    let told = ["cameras begin with the pointmaps of coded_pointmap_decoder.onnx", "in 12 of 12"];
    assert!(told.iter().all(|what| found.notes.contains(what)), "{size}: {found:?}");
    let told = [
        "cameras coded_pointmap_decoder.onnx",
        "depth coded_depth.onnx",
        "flow coded_flow.onnx",
        "masks coded_mask_decoder.onnx",
        "pointmaps coded_pointmap_decoder.onnx",
    ];
    assert_eq!(found.told, told, "{size}");
}

#[test]
fn networks_that_are_right_give_what_is_right() {
    ["160x96", "96x160"].into_iter().for_each(are_right);
}

#[test]
#[ignore = "takes two minutes"]
fn networks_that_are_right_give_what_is_right_at_the_usual_size() {
    SIZES.into_iter().for_each(are_right);
}

#[test]
fn each_network_is_taken_by_itself() {
    for networks in [&ALL[..1], &ALL[1..2], &ALL[2..4], &ALL[4..]] {
        let found = tracked("160x96", networks);
        println!("{networks:?}: {found:?}");
        assert!(found.path <= 0.01, "{networks:?}: {found:?}");
        assert!(found.masks >= 0.85, "{networks:?}: {found:?}");
        let none_else = |told: &String| {
            networks.iter().any(|name| told.ends_with(&format!("coded_{name}.onnx")))
        };
        assert!(
            found.told.iter().all(none_else) && !found.told.is_empty(),
            "{networks:?}: {found:?}"
        );
    }
}

/// `ablate` accepts networks as `track` does.
#[test]
fn what_components_are_worth_is_measured_with_networks() {
    let (folder, library) = prepared("96x54", 5, &ALL);
    let arguments = "ablate clip --only motion --steps 20 --max-gaussians 200 --models models";
    let found = json(folder.path(), &format!("{arguments}{library}"));
    assert_eq!(told(&found).len(), 5, "{}", found["sources"]);
    assert!(found["networks"].as_str().unwrap().starts_with("files with the checksums"));
    for row in found["rows"].as_array().unwrap() {
        assert_eq!((row["runs"].as_array().unwrap().len(), &row["failed"]), (1, &Value::Null));
    }
}

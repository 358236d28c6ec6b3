//! Networks whose answers are exact, on frames of synthetic clips that say in their colours what is true: the whole way
//! from frames through networks to cameras, depth and masks, held against the truth.
//!
//! `tools/setup.sh test` installs the runtime beside the build; where it is absent the tests fail.

#[path = "support/runtime.rs"]
mod runtime;

use std::path::Path;

use runtime::library;
use splat4d::data::synth::{self, Clip, SynthOptions};
use splat4d::geometry::sim3::align_poses;
use splat4d::observe::onnx::{Models, Runtime, RuntimeOptions};
use splat4d::track::{Options, Track, track};
use splat4d::types::Pose;

/// Landscape, portrait, square, odd.
const SIZES: [(u32, u32); 4] = [(160, 96), (96, 160), (128, 128), (161, 95)];

/// The models that a list names, opened.
fn models(list: &str) -> Models {
    let folder = tempfile::tempdir().unwrap();
    let source = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/models");
    for entry in std::fs::read_dir(source).unwrap() {
        let entry = entry.unwrap();
        if entry.file_name().to_string_lossy().starts_with("coded_") {
            std::fs::copy(entry.path(), folder.path().join(entry.file_name())).unwrap();
        }
    }
    std::fs::write(folder.path().join("models.toml"), list).unwrap();
    let options = RuntimeOptions { library: library(), threads: 1, ..RuntimeOptions::default() };
    let runtime = Runtime::load(&options)
        .unwrap_or_else(|error| panic!("{error}; tools/setup.sh test installs it"));
    Models::open(&runtime, folder.path()).unwrap()
}

fn clip((width, height): (u32, u32)) -> Clip {
    synth::coded_clip("rigid", &SynthOptions { frames: 12, width, height, seed: 3 }).unwrap()
}

/// How far what was found is from the truth.
#[derive(Debug)]
struct Errors {
    /// Root mean square distance of the cameras' centres after alignment over the length of their path.
    path: f64,
    /// Of depth, relative: the median and the 90th percentile, of what stands still and of what moves.
    still: [f64; 2],
    moves: [f64; 2],
    /// Intersection over union of the masks of all frames.
    masks: f64,
}

fn errors(clip: &Clip, found: &Track) -> Errors {
    let [estimate, truth] = [&found.view_from_world, &clip.view_from_world]
        .map(|poses| poses.iter().map(Pose::inverse).collect::<Vec<_>>());
    let aligned = align_poses(&estimate, &truth, true).unwrap();
    let length: f64 =
        truth.windows(2).map(|pair| pair[0].translation.distance(pair[1].translation)).sum();
    let scale = aligned.reference_from_estimate.scale;
    let (mut depth, mut both, mut either) = ([Vec::new(), Vec::new()], 0, 0);
    for frame in 0..clip.frames.len() {
        for (i, true_z) in clip.depth[frame].pixels.iter().enumerate() {
            let (moves, masked) =
                (clip.masks[frame].pixels[i] > 0.5, found.masks[frame].pixels[i] > 0.5);
            both += usize::from(moves && masked);
            either += usize::from(moves || masked);
            let z = scale * f64::from(found.depth[frame].pixels[i]);
            depth[usize::from(moves)].push((z / f64::from(*true_z) - 1.0).abs());
        }
    }
    let [still, moves] = depth.map(|mut errors| {
        errors.sort_by(f64::total_cmp);
        [errors.len() / 2, errors.len() * 9 / 10].map(|k| errors[k])
    });
    Errors { path: aligned.rmse / length, still, moves, masks: both as f64 / either as f64 }
}

#[test]
fn depth_and_flow_of_networks_that_are_right_give_cameras_and_depth_that_are_right() {
    let list = "[depth]\nfile = \"coded_depth.onnx\"\n[flow]\nfile = \"coded_flow.onnx\"\n";
    let mut models = models(list);
    for size in SIZES {
        let clip = clip(size);
        let told = models.depth.as_mut().unwrap().clip(&clip.frames, &mut |_| Ok(())).unwrap();
        let options = Options { estimated_depth: Some(told), ..Options::default() };
        let mut flow = models.flow.as_mut().unwrap().source(&clip.frames);
        let found = track(&clip.frames, &options, &mut flow, &mut |_, _| Ok(())).unwrap();
        let errors = errors(&clip, &found);
        println!("{size:?}: {errors:?}");
        assert!(errors.path <= 0.002 && errors.masks >= 0.95, "{size:?}: {errors:?}");
        assert!(errors.still[0] <= 0.02 && errors.moves[0] <= 0.02, "{size:?}: {errors:?}");
    }
}

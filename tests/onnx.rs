//! Networks in the ONNX Runtime: small models whose outputs are exact, and invalid models and lists.
//!
//! `tools/setup.sh test` installs the runtime beside the build directory; without it the tests fail.

#[path = "support/runtime.rs"]
mod runtime;
mod support;

use std::path::Path;

use glam::DVec2;
use runtime::library;
use splat4d::data::{Clip, ClipOptions, Resize};
use splat4d::observe::onnx::{LpipsNetwork, Models, Runtime, RuntimeOptions};
use splat4d::observe::pointmaps::PointmapSource;
use splat4d::observe::{EstimatedKind, FlowSource, MaskQuery, Prompt};
use splat4d::types::Image;
use support::{message, picture, says};

/// The runtime that `tools/setup.sh` installs, else the one that the library finds.
fn runtime() -> Runtime {
    let options = RuntimeOptions { library: library(), threads: 1, ..RuntimeOptions::default() };
    Runtime::load(&options)
        .unwrap_or_else(|error| panic!("{error}; tools/setup.sh test installs it"))
}

/// A folder with the small models and a list.
fn folder(list: &str) -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    let models = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/models");
    for name in
        ["depth", "bare", "flow", "features", "mask_encoder", "mask_decoder", "mask_decoder_small"]
    {
        let name = format!("{name}.onnx");
        std::fs::copy(models.join(&name), folder.path().join(&name)).unwrap();
    }
    std::fs::write(folder.path().join("models.toml"), list).unwrap();
    folder
}

const BOTH: &str = "[depth]\nfile = \"depth.onnx\"\n[flow]\nfile = \"flow.onnx\"\n";

/// Landscape, portrait, square, with odd sides, and tiny.
const SIZES: [(u32, u32); 5] = [(56, 28), (29, 51), (32, 32), (37, 23), (3, 2)];

/// The model's keypoints are the red channel, its descriptors the mean colours of cells of 4×4 pixels.
#[test]
fn a_network_for_features_tells_points_and_what_describes_them() {
    let folder = folder("[features]\nfile = \"features.onnx\"\n");
    let mut models = Models::open(&runtime(), folder.path()).unwrap();
    let network = models.features.as_mut().unwrap();
    let points = [(9, 5, 0.9), (21, 6, 0.5), (13, 17, 0.7), (27, 2, 0.04)];
    let mut drawn = picture(40, 24, 3);
    for pixel in drawn.pixels.chunks_exact_mut(3) {
        pixel.copy_from_slice(&[0.0, 0.2 * pixel[1], 0.3 + 0.2 * pixel[2]]);
    }
    for (x, y, likely) in points {
        drawn.at_mut(x, y)[0] = likely;
    }
    // A point between two pixels: the parabola through 0, 0.7 and 0.35 has its peak a sixth of a pixel
    // further.
    drawn.at_mut(14, 17)[0] = 0.35;
    for (width, height) in [(40, 24), (37, 23)] {
        let mut frame = Image::new(width, height, 3);
        for (x, y) in (0..height).flat_map(|y| (0..width).map(move |x| (x, y))) {
            frame.at_mut(x, y).copy_from_slice(drawn.at(x, y));
        }
        let found = network.features(&frame).unwrap();
        let sixth = 1.0 / 6.0;
        let mut places = [(9.5, 5.5), (13.5 + sixth, 17.5), (21.5, 6.5)].map(DVec2::from).to_vec();
        // Points are sorted by their score weighted with reliability, highest first.
        let mut seen = found.pixels.clone();
        [&mut places, &mut seen]
            .into_iter()
            .for_each(|all| all.sort_by(|a, b| a.x.total_cmp(&b.x)));
        assert_eq!(seen.len(), places.len(), "what is hardly likely is no point: {seen:?}");
        for (told, place) in seen.iter().zip(&places) {
            assert!(told.distance(*place) < 1e-6, "{width}×{height}: {told} for {place}");
        }
        assert_eq!(found.descriptors.len(), 3 * found.pixels.len());
        let cell = |column: u32, row: u32, channel: usize| {
            let within = (0..4).flat_map(|y| (0..4).map(move |x| (4 * column + x, 4 * row + y)));
            let at = |(x, y): (u32, u32)| frame.at(x.min(width - 1), y.min(height - 1))[channel];
            within.map(at).sum::<f32>() / 16.0
        };
        for (pixel, told) in found.pixels.iter().zip(found.descriptors.chunks_exact(3)) {
            let at = *pixel / 4.0 - 0.5;
            let (column, row) = (at.x.floor(), at.y.floor());
            let (u, v) = ((at.x - column) as f32, (at.y - row) as f32);
            let (column, row) = (column as u32, row as u32);
            let mean = |c: usize| {
                let upper = (1.0 - u) * cell(column, row, c) + u * cell(column + 1, row, c);
                let lower = (1.0 - u) * cell(column, row + 1, c) + u * cell(column + 1, row + 1, c);
                (1.0 - v) * upper + v * lower
            };
            let values = [0, 1, 2].map(mean);
            let length = values.iter().map(|v| v * v).sum::<f32>().sqrt();
            for (told, value) in told.iter().zip(values) {
                assert!((told - value / length).abs() < 1e-5, "{width}×{height} at {pixel}");
            }
        }
    }
    let error = network.features(&Image::new(8, 8, 1)).unwrap_err();
    says(&error.to_string(), &["RGB"]);
}

#[test]
fn a_depth_network_is_asked_pixel_by_pixel() {
    let folder = folder(BOTH);
    let mut models = Models::open(&runtime(), folder.path()).unwrap();
    let network = models.depth.as_mut().unwrap();
    for (width, height) in SIZES {
        let frames = [picture(width, height, 1), picture(width, height, 2)];
        let mut shares = Vec::new();
        let found = network.clip(&frames, &mut |share| {
            shares.push(share);
            Ok(())
        });
        let found = found.unwrap();
        assert_eq!((found.kind, shares), (EstimatedKind::ShiftedInverse, vec![0.5, 1.0]));
        for (map, frame) in found.maps.iter().zip(&frames) {
            assert_eq!((map.width, map.height, map.channels), (width, height, 1));
            for (told, colour) in map.pixels.iter().zip(frame.pixels.chunks_exact(3)) {
                assert!((told - (0.5 + 2.0 * colour[0])).abs() < 1e-6, "{width}×{height}");
            }
        }
    }
}

#[test]
fn a_flow_network_is_asked_both_ways() {
    let folder = folder(BOTH);
    let mut models = Models::open(&runtime(), folder.path()).unwrap();
    for (width, height) in SIZES {
        let frames = [picture(width, height, 1), picture(width, height, 2)];
        let network = models.flow.as_mut().unwrap();
        let pair = network.source(&frames).pair(0).unwrap();
        let [here, there] = &frames;
        let confidence = pair.forward_confidence.unwrap();
        for i in 0..here.pixels.len() / 3 {
            for c in 0..2 {
                let expected = 8.0 * (there.pixels[3 * i + c] - here.pixels[3 * i + c]);
                let (forward, backward) =
                    (pair.forward.pixels[2 * i + c], pair.backward.pixels[2 * i + c]);
                assert!(
                    (forward - expected).abs() < 1e-5,
                    "{width}×{height}: {forward} {expected}"
                );
                assert!((backward + expected).abs() < 1e-5, "{width}×{height}: {backward}");
            }
            assert!((confidence.pixels[i] - here.pixels[3 * i + 2]).abs() < 1e-6);
        }
        let missing = network.source(&frames).pair(1);
        says(&message(missing), &["flow from frame 1", "has 2 frames"]);
    }
}

#[test]
fn pictures_are_held_against_each_other() {
    let models = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/models");
    let runtime = runtime();
    let mut network = LpipsNetwork::open(&runtime, &models.join("lpips.onnx")).unwrap();
    assert_eq!(network.contract().net, "squared difference");
    for (width, height) in SIZES {
        let [mut first, second] = [1, 2].map(|seed| picture(width, height, seed));
        assert_eq!(network.distance(&first, &first).unwrap(), 0.0);
        // A render may exceed an image's value range.
        first.pixels[0] = 3.0;
        let squared = first.pixels.iter().zip(&second.pixels).map(|(a, b)| {
            let difference = f64::from(a.clamp(0.0, 1.0) - b);
            4.0 * difference * difference
        });
        let expected = squared.sum::<f64>() / first.pixels.len() as f64;
        let told = network.distance(&first, &second).unwrap();
        assert!((told - expected).abs() < 1e-6 * expected, "{width}×{height}: {told} {expected}");
    }
    let uneven = network.distance(&Image::new(4, 4, 3), &Image::new(4, 5, 3));
    says(&message(uneven), &["images of one size", "from 4×4 to 4×5"]);
    let mut nothing = Image::new(4, 4, 3);
    nothing.pixels[5] = f32::NAN;
    says(&message(network.distance(&nothing, &Image::new(4, 4, 3))), &["`distance` is NaN"]);
    let depth = LpipsNetwork::open(&runtime, &models.join("depth.onnx"));
    says(&message(depth.map(drop)), &["is listed for lpips, and computes depth"]);
}

/// The contract of `bare.onnx`, for the list.
fn contract(more: &str) -> String {
    let contract = "[depth.contract]\nkind = \"depth\"\nversion = 1\ninput = \"image\"\n\
                    output = \"inverse\"\nholds = \"depth\"\n";
    format!("[depth]\nfile = \"bare.onnx\"\n{contract}{more}\n")
}

#[test]
fn a_picture_is_made_by_the_contract() {
    let rule = "picture = { multiple = 8, shorter = 16, white = 255.0, mean = [127.5, 0, 0], \
                deviation = [127.5, 1, 1] }";
    let folder = folder(&contract(rule));
    let mut models = Models::open(&runtime(), folder.path()).unwrap();
    let network = models.depth.as_mut().unwrap();
    assert_eq!(network.contract().holds, EstimatedKind::Depth);
    // An image of one colour, which scaling does not change; the network gets red 0.75 as 0.5.
    let mut frame = Image::new(41, 30, 3);
    frame.pixels.chunks_exact_mut(3).for_each(|colour| colour[0] = 0.75);
    let map = network.depth(&frame).unwrap();
    assert_eq!((map.width, map.height), (41, 30));
    assert!(map.pixels.iter().all(|told| (told - 1.5).abs() < 1e-5), "{}", map.pixels[0]);
}

#[test]
fn what_is_wrong_is_told() {
    let runtime = runtime();
    let cases: [(&str, &[&str]); 14] = [
        ("", &["models.toml", "names no model"]),
        ("[depth", &["models.toml"]),
        (
            "[gaze]\nfile = \"depth.onnx\"",
            &["models.toml", "`gaze`", "expected one of `depth`, `flow`"],
        ),
        ("[depth]\nfile = \"../depth.onnx\"", &["names ../depth.onnx", "not within its folder"]),
        ("[depth]\nfile = \"/depth.onnx\"", &["names /depth.onnx", "not within its folder"]),
        ("[depth]\nfile = \"gone.onnx\"", &["gone.onnx"]),
        ("[depth]\nfile = \"models.toml\"", &["models.toml", "the ONNX Runtime refuses it"]),
        ("[depth]\nfile = \"bare.onnx\"", &["bare.onnx", "does not say what it is"]),
        ("[depth]\nfile = \"flow.onnx\"", &["is listed for depth, and computes flow"]),
        (&contract("more = 1"), &["models.toml", "more"]),
        (&contract("").replace("version = 1", "version = 7"), &["version 7", "version 1"]),
        (
            &contract("").replace("\"image\"", "\"picture\""),
            &["names an input `picture`", "1 × 3 × height × width", "has `image`"],
        ),
        (&contract("").replace("\"inverse\"", "\"depth\""), &["output `depth`", "has `inverse`"]),
        (&contract("picture = { multiple = 0 }"), &["multiples of 0"]),
    ];
    for (list, parts) in cases {
        let folder = folder(list);
        says(&message(Models::open(&runtime, folder.path()).map(drop)), parts);
    }
    let nothing = tempfile::tempdir().unwrap();
    says(&message(Models::open(&runtime, nothing.path()).map(drop)), &["models.toml"]);
    // A flow model has another number of inputs and channels than this contract allows.
    let list = contract("").replace("bare.onnx", "flow.onnx");
    let folder = folder(&list);
    // The contract in the model takes precedence over the list's.
    says(
        &message(Models::open(&runtime, folder.path()).map(drop)),
        &["is listed for depth, and computes flow"],
    );
}

/// A list of a mask encoder for images of a size, and of a decoder.
fn masks_of((width, height): (u32, u32), decoder: &str) -> String {
    format!(
        "[mask_encoder]\nfile = \"mask_encoder.onnx\"\n[mask_encoder.contract]\nkind = \"mask_encoder\"\n\
         version = 1\ninput = \"image\"\noutputs = [\"features\"]\npicture.size = [{width}, {height}]\n\
         [mask_decoder]\nfile = \"{decoder}.onnx\"\n[mask_decoder.contract]\nkind = \"mask_decoder\"\n\
         version = 1\nfeatures = [\"features\"]\npoints = \"points\"\nlabels = \"labels\"\n\
         mask_input = \"mask_input\"\nhas_mask = \"has_mask\"\nmasks = \"masks\"\nscores = \"scores\"\n"
    )
}

/// Two points on an object and one beside it, without an initial mask.
fn query() -> MaskQuery {
    let prompts = [(0.5, 1.25, true), (2.0, 0.5, true), (1.5, 1.5, false)];
    let prompt = |(x, y, inside)| Prompt { pixel: DVec2::new(x, y), inside };
    MaskQuery { prompts: prompts.map(prompt).into(), before: None }
}

#[test]
fn a_mask_network_is_asked_pixel_by_pixel() {
    let runtime = runtime();
    for (width, height) in SIZES {
        let folder = folder(&masks_of((width, height), "mask_decoder"));
        let mut models = Models::open(&runtime, folder.path()).unwrap();
        let network = models.masks.as_mut().unwrap();
        let frame = picture(width, height, 1);
        let red = || frame.pixels.chunks_exact(3).map(|colour| colour[0]);
        let mut before = Image::new(width, height, 1);
        before.pixels = red().map(|red| 4.0 - 6.0 * red).collect();
        let begun = MaskQuery { before: Some(before.clone()), ..query() };
        let found = network.ask(&frame, &[query(), begun]).unwrap();
        assert_eq!(found.len(), 2);
        for (k, masks) in found.iter().enumerate() {
            // Scores from the points' coordinates, and whether there was an initial mask.
            let scores: Vec<f32> = masks.iter().map(|mask| mask.score).collect();
            assert_eq!(scores, [2.5, 1.75, k as f32], "{width}×{height}");
            for mask in masks {
                assert_eq!(
                    (mask.odds.width, mask.odds.height, mask.odds.channels),
                    (width, height, 1)
                );
            }
            for (i, red) in red().enumerate() {
                let odds = 20.0 * (red - 0.5);
                let third = if k == 1 { before.pixels[i] - 3.0 } else { -3.0 };
                for (mask, expected) in masks.iter().zip([odds, -odds, third]) {
                    let told = mask.odds.pixels[i];
                    assert!((told - expected).abs() < 1e-4, "{width}×{height}: {told} {expected}");
                }
            }
        }
    }
}

#[test]
fn a_mask_network_has_pictures_and_masks_of_sizes_of_its_own() {
    let folder = folder(&masks_of((64, 40), "mask_decoder_small"));
    let mut models = Models::open(&runtime(), folder.path()).unwrap();
    let network = models.masks.as_mut().unwrap();
    // An image of one colour, which scaling does not change; the initial mask increases from row to row.
    let (width, height) = (32, 60);
    let mut frame = Image::new(width, height, 3);
    frame.pixels.chunks_exact_mut(3).for_each(|colour| colour[0] = 0.75);
    let mut before = Image::new(width, height, 1);
    for y in 0..height {
        (0..width).for_each(|x| before.at_mut(x, y)[0] = y as f32 + 0.5);
    }
    let begun = MaskQuery { before: Some(before), ..query() };
    let found = network.ask(&frame, &[begun]).unwrap();
    let [first, against, level] = &found[0][..] else { panic!("{} masks", found[0].len()) };
    // Points are in pixels of the network's input, which is twice as wide and two thirds as high.
    assert!((first.score - 5.0).abs() < 1e-5 && (against.score - 1.75 * 2.0 / 3.0).abs() < 1e-5);
    for y in 0..height {
        // A row of the mask is 7.5 rows of the frame; beyond the centre of the outermost row the mask is
        // constant.
        let row = (y as f32 + 0.5).clamp(3.75, 56.25);
        for (mask, expected) in [(first, 5.0 + row), (against, -5.0 - row), (level, row - 3.0)] {
            let told = mask.odds.at(width / 2, y)[0];
            assert!((told - expected).abs() < 1e-3, "{y}: {told} {expected}");
        }
    }
}

#[test]
fn what_is_wrong_about_a_mask_network_is_told() {
    let runtime = runtime();
    let both = masks_of((8, 8), "mask_decoder");
    let (encoder, decoder) = both.split_at(both.find("[mask_decoder]").unwrap());
    let named = |from: &str, to: &str| both.replace(from, to);
    let cases: [(String, &[&str]); 9] = [
        (encoder.into(), &["models.toml", "has `mask_encoder` without `mask_decoder`"]),
        (decoder.into(), &["models.toml", "has `mask_decoder` without `mask_encoder`"]),
        (
            named("picture.size = [8, 8]", "picture.multiple = 1"),
            &["mask_encoder.onnx", "which `size`"],
        ),
        (named("[8, 8]", "[8, 0]"), &["mask_encoder.onnx", "images of 8×0"]),
        (
            format!("[mask_encoder]\nfile = \"flow.onnx\"\n{decoder}"),
            &["flow.onnx", "is listed for mask_encoder, and computes flow"],
        ),
        (
            format!("{encoder}[mask_decoder]\nfile = \"depth.onnx\"\n"),
            &["depth.onnx", "is listed for mask_decoder, and computes depth"],
        ),
        (
            named("outputs = [\"features\"]", "outputs = [\"features\", \"features\"]"),
            &["mask_decoder.onnx", "takes 1 features", "gives 2", "export both together"],
        ),
        (
            named("points = \"points\"", "points = \"labels\""),
            &["input `labels` is 1 × ?", "1 × prompts × 2"],
        ),
        (
            named("masks = \"masks\"", "masks = \"scores\""),
            &["output `scores` is 1 × 3", "1 × masks × height × width"],
        ),
    ];
    for (list, parts) in cases {
        let folder = folder(&list);
        says(&message(Models::open(&runtime, folder.path()).map(drop)), parts);
    }
    let ask = |list: &str, frame: &Image, query: MaskQuery| {
        let folder = folder(list);
        let mut models = Models::open(&runtime, folder.path()).unwrap();
        message(models.masks.as_mut().unwrap().ask(frame, &[query]))
    };
    let frame = picture(8, 8, 1);
    let small = masks_of((8, 8), "mask_decoder_small");
    let as_masks =
        |output: &str| small.replace("masks = \"masks\"", &format!("masks = \"{output}\""));
    says(
        &ask(&as_masks("coarse"), &frame, query()),
        &["mask_decoder_small.onnx", "`coarse` came out as [1, 1, 1, 1]", "16×8"],
    );
    says(&ask(&as_masks("first"), &frame, query()), &["`scores` came out as [1, 3], for 1 masks"]);
    let mut broken = frame.clone();
    broken.pixels[4] = f32::NAN;
    says(
        &ask(&both, &broken, query()),
        &["mask_encoder.onnx", "`features` is not finite at 1 of 192"],
    );
    let unknown = Image { pixels: vec![f32::INFINITY; 64], ..Image::new(8, 8, 1) };
    let begun = MaskQuery { before: Some(unknown), ..query() };
    says(&ask(&both, &frame, begun), &["mask_decoder.onnx", "`masks` is not finite at 64 of 192"]);
    let uneven = MaskQuery { before: Some(Image::new(8, 7, 1)), ..query() };
    says(&ask(&both, &frame, uneven), &["to begin with is 8×7", "the frame is 8×8"]);
    let nothing = MaskQuery { prompts: Vec::new(), before: None };
    says(&ask(&both, &frame, nothing), &["without points"]);
    says(&ask(&both, &Image::new(8, 8, 1), query()), &["RGB", "1 channels"]);
}

#[test]
fn frames_that_no_network_takes_are_refused() {
    let folder = folder(BOTH);
    let mut models = Models::open(&runtime(), folder.path()).unwrap();
    let grey = Image::new(4, 4, 1);
    let depth = models.depth.as_mut().unwrap();
    says(&message(depth.depth(&grey).map(drop)), &["RGB", "1 channels"]);
    let flow = models.flow.as_mut().unwrap();
    let uneven = flow.flow(&Image::new(4, 4, 3), &Image::new(4, 5, 3));
    says(&message(uneven.map(drop)), &["from 4×4 to 4×5"]);
    let mut broken = Image::new(8, 8, 3);
    broken.pixels[3] = f32::NAN;
    let flow = flow.flow(&broken, &Image::new(8, 8, 3));
    says(&message(flow.map(drop)), &["`flow` is not finite at 1 of 128 values", "8×8"]);
}

#[test]
fn a_file_that_is_no_runtime_is_refused() {
    let folder = folder(BOTH);
    let library = folder.path().join("libonnxruntime.so");
    std::fs::write(&library, "no library").unwrap();
    // A separate process, which has not loaded another runtime before.
    let output = std::process::Command::new(env!("CARGO_BIN_EXE_splat4d"))
        .args(["track", ".", "-o", "x", "--models", ".", "--onnxruntime"])
        .arg(&library)
        .current_dir(&folder)
        .output()
        .unwrap();
    assert_eq!(output.status.code(), Some(1));
    let told = String::from_utf8_lossy(&output.stderr);
    says(&told, &["no ONNX Runtime", "libonnxruntime.so", "pip install onnxruntime", "1.17"]);
}

/// Peak resident memory of this process, MiB.
fn peak() -> f64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"));
    let kib = line.and_then(|line| line.split_whitespace().next()?.parse::<f64>().ok());
    kib.map_or(f64::NAN, |kib| kib / 1024.0)
}

/// Runs a function several times; returns the median wall-clock time without the first run, seconds, and
/// the last result.
fn timed<T>(mut run: impl FnMut(usize) -> T) -> (f64, T) {
    let mut last = run(0);
    let mut seconds: Vec<f64> = (1..4)
        .map(|k| {
            let began = std::time::Instant::now();
            last = run(k);
            began.elapsed().as_secs_f64()
        })
        .collect();
    seconds.sort_by(f64::total_cmp);
    (seconds[1], last)
}

/// Time and memory of the user's networks. Their outputs for the first frames are written as raw f32
/// beside the frames, for comparison with the upstream code.
#[test]
#[ignore = "measures the networks of the folder SPLAT4D_MODELS on the pictures of the folder SPLAT4D_FRAMES, five or more"]
fn networks_of_a_folder_are_measured() {
    let [models, folder] =
        ["SPLAT4D_MODELS", "SPLAT4D_FRAMES"].map(|name| std::env::var(name).expect(name));
    let options = RuntimeOptions { library: library(), threads: 2, ..RuntimeOptions::default() };
    let runtime = Runtime::load(&options).unwrap();
    let options = ClipOptions { size: Resize::Keep, ..ClipOptions::default() };
    let clip = Clip::open(&folder, &options).unwrap();
    let frames: Vec<Image> = clip.frames.into_iter().map(|frame| frame.image).collect();
    let write = |name: &str, image: &Image| {
        let bytes: Vec<u8> = image.pixels.iter().flat_map(|v| v.to_le_bytes()).collect();
        std::fs::write(Path::new(&folder).join(format!("{name}.f32")), bytes).unwrap();
    };
    let told = |what: &str, seconds: f64| {
        println!(
            "{what}, {}×{}: {seconds:.2} s, {:.0} MiB at most",
            clip.width,
            clip.height,
            peak()
        );
    };
    let before = peak();
    let mut models = Models::open(&runtime, Path::new(&models)).unwrap();
    println!(
        "{} frames; {before:.0} MiB before the networks, {:.0} with them",
        frames.len(),
        peak()
    );
    if let Some(network) = &mut models.depth {
        let (seconds, map) = timed(|_| network.depth(&frames[0]).unwrap());
        told("depth of a frame", seconds);
        write("depth", &map);
    }
    if let Some(network) = &mut models.flow {
        let (seconds, (flow, _)) = timed(|_| network.flow(&frames[0], &frames[1]).unwrap());
        told("flow of a pair, one way", seconds);
        write("flow", &flow);
    }
    if let Some(network) = &mut models.features {
        let (seconds, _) = timed(|_| network.features(&frames[0]).unwrap());
        told("features of a frame", seconds);
    }
    if let Some(network) = &mut models.masks {
        let middle = DVec2::new(0.4 * f64::from(clip.width), 0.5 * f64::from(clip.height));
        let prompts = vec![Prompt { pixel: middle, inside: true }];
        let query = MaskQuery { prompts, before: None };
        let (seconds, masks) =
            timed(|_| network.ask(&frames[0], std::slice::from_ref(&query)).unwrap());
        told("masks of a frame, one thing", seconds);
        masks[0].iter().enumerate().for_each(|(k, mask)| write(&format!("mask_{k}"), &mask.odds));
        let eight = vec![query; 8];
        let (seconds, _) = timed(|_| network.ask(&frames[0], &eight).unwrap());
        told("masks of a frame, eight things", seconds);
    }
    if let Some(network) = &mut models.pointmaps {
        let mut source = network.source(&frames).unwrap();
        // Each pair has one frame that is not encoded yet.
        let (seconds, _) = timed(|k| source.pair(k, k + 1).unwrap());
        told("pointmaps of a pair, with one frame encoded", seconds);
        let (seconds, maps) = timed(|_| source.pair(0, 1).unwrap());
        told("pointmaps of a pair, both encoded before", seconds);
        for k in 0..2 {
            write(&format!("points_{k}"), &maps.points[k]);
            write(&format!("confidence_{k}"), &maps.confidence[k]);
        }
    }
}

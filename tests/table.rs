//! `splat4d table` on miniature data sets in the layout of the real ones, and on the real ones if they
//! are present.

#![cfg(feature = "cli")]

mod common;
#[path = "support/program.rs"]
mod program;
#[path = "support/python.rs"]
mod python;
#[path = "support/runtime.rs"]
mod runtime;
mod support;

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use glam::DVec3;
use program::{fails, json, run, stderr};
use serde_json::{Value, json as object};
use splat4d::data::{Dataset, Resize, images, transforms};
use splat4d::renderer::Renderer;
use splat4d::scene::Scene;
use splat4d::types::Camera;
use support::says;
use tempfile::TempDir;

/// Runs `table` with its options and with those of the commands that make scenes.
#[track_caller]
fn table(folder: &Path, options: &str, making: &str) -> Value {
    let output = run(folder, &format!("table {options} --json --device software -- {making}"));
    assert!(output.status.success(), "{options}: {}", stderr(&output));
    serde_json::from_slice(&output.stdout).unwrap()
}

/// Makes a clip of a few small frames, with its true cameras.
fn clip(folder: &Path, frames: usize) {
    json(folder, &format!("synth rigid -o clip --frames {frames} --size 96x54 --seed 1"));
}

/// Means of scikit-image's metrics over some cases of `tests/support/by_skimage.py`, by name.
fn by_skimage(cases: Vec<Value>) -> impl Fn(&str) -> f64 {
    let probe = "import skimage.metrics";
    let found = python::answer("evo", probe, "by_skimage.py", &object!(cases));
    let found = found.as_array().unwrap().clone();
    assert!(!cases.is_empty() && found.len() == cases.len());
    move |key| found.iter().map(|of| of[key].as_f64().unwrap()).sum::<f64>() / found.len() as f64
}

/// Cases from the images that `eval` has written; masks, if given, have the same order.
fn sheets(pictures: &Path, masks: Option<&Path>) -> Vec<Value> {
    let files = |folder: &Path| images::list(folder).unwrap();
    let mut cases: Vec<Value> =
        files(pictures).into_iter().map(|file| object!({ "sheet": file })).collect();
    if let Some(masks) = masks.map(files) {
        assert_eq!(masks.len(), cases.len());
        cases.iter_mut().zip(masks).for_each(|(case, mask)| case["mask"] = object!(mask));
    }
    cases
}

/// Checks that metrics of a table's row agree with other values within 1e-4.
#[track_caller]
fn equal(row: &Value, theirs: impl Fn(&str) -> f64, keys: &[(&str, &str)]) {
    for (key, of) in keys {
        let ours = row["figures"][key].as_f64().unwrap_or_else(|| panic!("{key}: {row}"));
        let theirs = theirs(of);
        println!("{key}: {ours}, scikit-image has {theirs}");
        assert!((ours - theirs).abs() < 1e-4, "{key}: {ours}, scikit-image has {theirs}");
    }
}

const OF_PICTURES: [(&str, &str); 2] = [("psnr", "psnr"), ("ssim", "ssim")];

/// The value of the line of `table.csv` that begins with `start`.
fn line(csv: &str, start: &str) -> f64 {
    let found = csv.lines().find_map(|line| line.strip_prefix(start));
    let found = found.unwrap_or_else(|| panic!("no line {start} in {csv}"));
    found.split(',').next().unwrap().parse().unwrap()
}

#[test]
fn nvidia_from_frames_to_a_table() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    clip(folder.path(), 6);
    // Frame t is from camera t; images of the same size from elsewhere stand in for the first camera's
    // images.
    for scene in ["set/Balloon9/images", "set/Balloon9/gt", "set/Balloon9/masks"] {
        fs::create_dir_all(at(scene)).unwrap();
    }
    for i in 0..6 {
        let frame = at("clip/frames").join(format!("{i:04}.png"));
        fs::copy(&frame, at("set/Balloon9/images").join(format!("{i:03}.png"))).unwrap();
        fs::copy(&frame, at("set/Balloon9/gt").join(format!("v000_t{i:03}.png"))).unwrap();
    }
    // A second scene whose frames are not images.
    for name in ["set/Broken/images", "set/Broken/gt"] {
        fs::create_dir_all(at(name)).unwrap();
    }
    for i in 0..2 {
        let frame = at("clip/frames").join("0000.png");
        fs::copy(&frame, at("set/Broken/images").join(format!("{i:03}.png"))).unwrap();
        fs::copy(&frame, at("set/Broken/gt").join(format!("v000_t{i:03}.png"))).unwrap();
    }
    let library = runtime::library().expect("an ONNX Runtime; tools/setup.sh test installs it");
    let model = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/models/lpips.onnx");
    let networks = format!("--lpips {} --onnxruntime {}", model.display(), library.display());
    let making = "--steps 20 --max-gaussians 600";
    let all = format!("table nvidia set -o out {networks} --json --device software -- {making}");
    let output = run(folder.path(), &all);
    assert_eq!(output.status.code(), Some(1), "{}", stderr(&output));
    let found: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!((&found["failed"], &found["mean"]["psnr"]), (&1.into(), &Value::Null));
    assert!(found["rows"][1]["failed"].is_string(), "{found}");
    assert!(found["published"].as_array().unwrap().len() > 10);

    // The metrics are those of the images: frame 0 is an input.
    let row = &found["rows"][0];
    assert_eq!((row["scene"].as_str(), &row["failed"]), (Some("Balloon9"), &Value::Null));
    let figure = |key: &str| row["figures"][key].as_f64().unwrap_or_else(|| panic!("{key}: {row}"));
    let pictures = at("out/Balloon9/pictures");
    assert_eq!(fs::read_dir(&pictures).unwrap().count(), 5);
    equal(row, by_skimage(sheets(&pictures, None)), &OF_PICTURES);
    let csv = fs::read_to_string(at("out/table.csv")).unwrap();
    assert_eq!(line(&csv, "scene,splat4d,Balloon9,psnr,"), figure("psnr"));
    assert!((0.0..4.0).contains(&figure("lpips")) && figure("fps") > 0.0);
    assert!(figure("pose_minutes") > 0.0 && figure("train_minutes") > 0.0);
    assert_eq!(figure("minutes"), figure("pose_minutes") + figure("train_minutes"));
    let bytes = fs::metadata(at("out/Balloon9/scene.safetensors")).unwrap().len();
    assert_eq!(figure("storage_mb"), bytes as f64 / 1e6);
    let page = fs::read_to_string(at("out/index.html")).unwrap();
    says(
        &page,
        &["Balloon9", "SplineGS", "features of squared difference", "1 of 2 scenes failed"],
    );
    says(&fs::read_to_string(at("out/table.tex")).unwrap(), &["\\begin{tabular}", "MoSca"]);

    // A second run on the scene that did not fail does no work, and gives the same table.
    let before = fs::metadata(at("out/Balloon9/scene.safetensors")).unwrap().modified().unwrap();
    let again = format!(
        "table nvidia set -o out --scenes Balloon9 {networks} --device software -- {making}"
    );
    let output = run(folder.path(), &again);
    assert!(output.status.success(), "{}", stderr(&output));
    let after = fs::metadata(at("out/Balloon9/scene.safetensors")).unwrap().modified().unwrap();
    assert_eq!(before, after);
}

#[test]
fn dnerf_from_both_splits_to_a_table() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    clip(folder.path(), 8);
    let truth = at("clip/truth/transforms.json");
    let cameras = transforms::read_cameras(&truth).unwrap();
    fs::create_dir_all(at("set/cup")).unwrap();
    for (split, parity) in [("train", 0), ("test", 1)] {
        let chosen: Vec<usize> = (0..8).filter(|i| i % 2 == parity).collect();
        let files: Vec<String> =
            chosen.iter().map(|i| format!("../../clip/frames/{i:04}.png")).collect();
        let of: Vec<_> = chosen.iter().map(|&i| cameras[i]).collect();
        let file = at("set/cup").join(format!("transforms_{split}.json"));
        transforms::write(file, &of, &files, None).unwrap();
    }
    let found = table(
        folder.path(),
        "dnerf set/cup -o out --size 48",
        "--steps 30 --random-points 200 --control-points 8",
    );
    let row = &found["rows"][0];
    assert_eq!(row["scene"], "cup", "the folder itself is the scene: {found}");
    let psnr = row["figures"]["psnr"].as_f64().unwrap();
    let eval = fs::read_to_string(at("out/cup/eval.json")).unwrap();
    let eval: Value = serde_json::from_str(&eval).unwrap();
    assert_eq!(eval["answer"]["per_frame"].as_array().unwrap().len(), 4, "the test split");
    assert_eq!(eval["answer"]["psnr"], psnr);
    assert_eq!(fs::read_dir(at("out/cup/pictures")).unwrap().count(), 4);
    // These metrics are of images before rounding to 8 bits; files contain rounded ones.
    let device = common::device();
    let scene = Scene::open(at("out/cup/scene.safetensors"), false).unwrap().scene;
    let set = Dataset::open(at("set/cup")).unwrap();
    let mut renderer = Renderer::new(&device, &scene).unwrap();
    let mut cases = Vec::new();
    for (i, view) in set.load(&set.split(0).1, Resize::Longest(48)).unwrap().iter().enumerate() {
        let picture = renderer.render(&view.camera, view.time).unwrap().over(set.background);
        let files = ["truth", "picture"].map(|name| at(&format!("{name}{i}")));
        for (file, image) in files.iter().zip([&view.image, &picture]) {
            let bytes: Vec<u8> = image.pixels.iter().flat_map(|v| v.to_le_bytes()).collect();
            fs::write(file, bytes).unwrap();
        }
        let shape = [picture.height, picture.width, 3];
        cases.push(object!({ "truth": files[0], "picture": files[1], "shape": shape }));
    }
    equal(row, by_skimage(cases), &OF_PICTURES);
    assert_eq!(found["mean"]["psnr"], psnr);
    assert_eq!(row["figures"]["pose_minutes"], Value::Null, "poses are given");
    let caption = found["caption"].to_string();
    says(&caption, &["48 pixels", "--steps 30", "given poses"]);
    // With other options the scene is made anew.
    let other = table(
        folder.path(),
        "dnerf set/cup -o out --size 48",
        "--steps 40 --random-points 200 --control-points 8",
    );
    assert_ne!(other["rows"][0]["figures"]["psnr"], psnr);
}

/// A `.cam` file of Sintel: the tag, the intrinsics, and the matrix from world to camera.
fn write_cam(file: &Path, camera: &Camera) {
    let k = &camera.intrinsics;
    let mut bytes = 202021.25f32.to_le_bytes().to_vec();
    let mut push = |values: &[f64]| values.iter().for_each(|v| bytes.extend(v.to_le_bytes()));
    push(&[k.fx, 0.0, k.cx, 0.0, k.fy, k.cy, 0.0, 0.0, 1.0]);
    let (r, t) = (camera.view_from_world.rotation_matrix(), camera.view_from_world.translation);
    for i in 0..3 {
        push(&[r.x_axis[i], r.y_axis[i], r.z_axis[i], t[i]]);
    }
    fs::write(file, bytes).unwrap();
}

fn sintel() -> TempDir {
    let folder = tempfile::tempdir().unwrap();
    clip(folder.path(), 8);
    let at = |name: &str| folder.path().join("set/training").join(name);
    let cameras =
        transforms::read_cameras(&folder.path().join("clip/truth/transforms.json")).unwrap();
    for sequence in ["alley_2", "unknown_1"] {
        fs::create_dir_all(at("final").join(sequence)).unwrap();
        fs::create_dir_all(at("camdata_left").join(sequence)).unwrap();
        for (i, timed) in cameras.iter().enumerate() {
            let frame = folder.path().join("clip/frames").join(format!("{i:04}.png"));
            let number = i + 1;
            let name = format!("final/{sequence}/frame_{number:04}.png");
            fs::copy(frame, at(&name)).unwrap();
            let name = format!("camdata_left/{sequence}/frame_{number:04}.cam");
            write_cam(&at(&name), &timed.camera);
        }
    }
    folder
}

#[test]
fn sintel_poses_to_a_table() {
    let folder = sintel();
    let found = table(folder.path(), "sintel-pose set -o out", "");
    // One of the table's sequences is present; sequences that are not in the table are left out.
    let rows = found["rows"].as_array().unwrap();
    assert_eq!(rows.len(), 1);
    assert_eq!(rows[0]["scene"], "alley_2");
    // The same metrics by evo, from the written trajectory and the set's cameras.
    let at = |name: &str| folder.path().join(name);
    let case = object!({
        "name": "alley_2", "timed": false, "align": "sim3", "align_first": 0,
        "estimate": at("out/alley_2/tracked/poses.txt"), "estimate_format": "tum",
        "reference": at("set/training/camdata_left/alley_2"), "reference_format": "sintel",
        "rpe_delta": 1.0, "rpe_unit": "frames", "rpe_tolerance": 0.1, "rpe_all_pairs": true,
        "rpe_along_reference": false,
    });
    let theirs = python::answer("evo", "import evo.main_rpe", "by_evo.py", &object!([case]));
    assert_eq!(theirs[0]["poses"], 8);
    for (key, of) in [("ate", "ape_trans"), ("rpe_trans", "rpe_trans"), ("rpe_rot", "rpe_rot_deg")]
    {
        let ours = rows[0]["figures"][key].as_f64().unwrap_or_else(|| panic!("{key}: {found}"));
        let theirs = theirs[0][of]["rmse"].as_f64().unwrap();
        println!("{key}: {ours}, evo has {theirs}");
        assert!((ours - theirs).abs() < 1e-9 && theirs > 0.0, "{key}: {ours}, evo has {theirs}");
    }
    says(&found["caption"].to_string(), &["1 of the 14 sequences"]);
}

#[test]
fn what_is_no_data_set_or_option_is_told() {
    let folder = tempfile::tempdir().unwrap();
    fs::create_dir(folder.path().join("set")).unwrap();
    says(&fails(folder.path(), 1, "table nvidia missing -o out"), &["missing"]);
    for (protocol, needed) in [
        ("nvidia", "v000_t001.png"),
        ("dnerf", "transforms_test.json"),
        ("dynerf-mono", "poses_bounds.npy"),
        ("sintel-pose", "camdata_left/alley_2"),
    ] {
        let said = fails(folder.path(), 1, &format!("table {protocol} set -o out"));
        says(&said, &["set", "holds no scene of this table", needed]);
    }
    for output in ["set", "set/out", "."] {
        let said = fails(&folder.path().join("set"), 1, &format!("table dnerf . -o ../{output}"));
        match output {
            "." => says(&said, &["holds no scene"]),
            _ => says(&said, &["lies in the data set", "name a place outside"]),
        }
    }
    says(&fails(folder.path(), 2, "table magic set -o out"), &["magic", "sintel-pose"]);
    let cup = folder.path().join("set/cup");
    fs::create_dir(&cup).unwrap();
    for split in ["train", "test"] {
        fs::write(cup.join(format!("transforms_{split}.json")), "{}").unwrap();
    }
    says(
        &fails(folder.path(), 1, "table dnerf set -o out --scenes mug"),
        &["mug", "no such scene", "cup"],
    );
    says(
        &fails(folder.path(), 1, "table dnerf set -o out -- --magic 3"),
        &["options after --", "train", "--magic"],
    );
    says(&fails(folder.path(), 1, "table dnerf set -o out --lpips gone.onnx"), &["gone.onnx"]);
}

/// A set in the layout of Nerfies: a camera in the format's JSON, an image and a time for each name.
struct Rig {
    root: PathBuf,
    metadata: Value,
    train: Vec<String>,
    test: Vec<String>,
}

impl Rig {
    fn add(&mut self, id: &str, moment: usize, camera: &Camera, picture: &Path, trained: bool) {
        let k = &camera.intrinsics;
        let r = camera.view_from_world.rotation_matrix();
        let rows: Vec<Vec<f64>> =
            (0..3).map(|i| vec![r.x_axis[i], r.y_axis[i], r.z_axis[i]]).collect();
        let file = object!({
            "orientation": rows,
            "position": camera.view_from_world.inverse().translation.to_array(),
            "focal_length": k.fx, "principal_point": [k.cx, k.cy], "skew": 0.0,
            "pixel_aspect_ratio": k.fy / k.fx, "radial_distortion": [0.0, 0.0, 0.0],
            "tangential_distortion": [0.0, 0.0], "image_size": [k.width, k.height],
        });
        fs::write(self.root.join(format!("camera/{id}.json")), file.to_string()).unwrap();
        fs::copy(picture, self.root.join(format!("rgb/1x/{id}.png"))).unwrap();
        self.metadata[id] = object!({ "time_id": moment, "warp_id": moment, "camera_id": 0 });
        if trained { self.train.push(id.into()) } else { self.test.push(id.into()) }
    }
}

/// Writes a clip and its held-out cameras as a set with a validation rig.
fn rig(folder: &Path) {
    clip(folder, 8);
    let root = folder.join("set/broom9");
    for part in ["camera", "rgb/1x", "covisible/1x/val"] {
        fs::create_dir_all(root.join(part)).unwrap();
    }
    let mut rig = Rig { root, metadata: object!({}), train: vec![], test: vec![] };
    let truth = folder.join("clip/truth");
    let cameras = transforms::read_cameras(&truth.join("transforms.json")).unwrap();
    for (i, timed) in cameras.iter().enumerate() {
        let picture = folder.join(format!("clip/frames/{i:04}.png"));
        rig.add(&format!("left_{i:06}"), i, &timed.camera, &picture, true);
    }
    let held_out = Dataset::open(truth.join("held_out/transforms.json")).unwrap();
    for (i, frame) in held_out.frames.iter().enumerate() {
        let moment = (frame.time * 7.0).round() as usize;
        let id = format!("right_{i:06}");
        rig.add(&id, moment, &frame.camera, &frame.path, false);
        // DyCheck's covisibility masks: `held_out/covisible/K/0000.png` belongs to `held_out/K/0000.png`.
        let below = frame.path.strip_prefix(truth.join("held_out")).unwrap();
        let mask = truth.join("held_out/covisible").join(below);
        fs::copy(mask, rig.root.join(format!("covisible/1x/val/{id}.png"))).unwrap();
    }
    let Rig { root, metadata, train, test } = rig;
    let ids: Vec<&String> = train.iter().chain(&test).collect();
    let dataset = object!({ "count": ids.len(), "num_exemplars": train.len(), "ids": ids,
        "train_ids": train, "val_ids": test });
    let scene = object!({ "scale": 1.0, "center": [0.0, 0.0, 0.0], "near": 0.1, "far": 9.0 });
    for (name, value) in
        [("metadata.json", metadata), ("dataset.json", dataset), ("scene.json", scene)]
    {
        fs::write(root.join(name), value.to_string()).unwrap();
    }
}

#[test]
fn hypernerf_without_its_poses_to_a_table() {
    let folder = tempfile::tempdir().unwrap();
    rig(folder.path());
    let making = "--steps 20 --max-gaussians 600";
    let found = table(folder.path(), "hypernerf-vrig set -o out", making);
    assert_eq!(found["rows"][0]["scene"], "broom9", "{found}");
    // The same scene, evaluated with the same cameras and images from the clip's ground truth.
    let eval = json(folder.path(), "eval out/broom9/scene.safetensors clip/truth");
    let figures = &found["rows"][0]["figures"];
    for key in ["psnr", "ssim"] {
        let (ours, of) = (figures[key].as_f64().unwrap(), eval[key].as_f64().unwrap());
        assert!((ours - of).abs() < 1e-4, "{key}: {ours} {of}");
    }
    assert!(figures["pose_minutes"].is_number() && found["mean"]["psnr"] == figures["psnr"]);
    says(&found["caption"].to_string(), &["without their poses", "similarity", "broom2"]);
    let at = |name: &str| folder.path().join("out/broom9").join(name);
    let masks = at("clip/truth/held_out/covisible/test");
    let theirs = by_skimage(sheets(&at("pictures"), Some(&masks)));
    equal(&found["rows"][0], &theirs, &OF_PICTURES);

    // With DyCheck's protocol the same scene is also evaluated on covisible pixels. The existing scene is
    // kept.
    let made = fs::metadata(at("scene.safetensors")).unwrap().modified().unwrap();
    let found = table(folder.path(), "dycheck set -o out", making);
    assert_eq!(fs::metadata(at("scene.safetensors")).unwrap().modified().unwrap(), made);
    equal(&found["rows"][0], &theirs, &OF_PICTURES);
    let masked = [("covisible_psnr", "masked_psnr"), ("covisible_ssim", "masked_ssim")];
    equal(&found["rows"][0], &theirs, &masked);
    says(&found["caption"].to_string(), &["`covisible`", "saw as well"]);
}

/// A row of `poses_bounds.npy`: the matrix with the axes down, right, backwards, the centre, and height,
/// width and focal length; then the depth bounds.
fn bounds_row(camera: &Camera) -> Vec<f64> {
    let world_from_view = camera.view_from_world.inverse();
    let axes = world_from_view.rotation_matrix();
    let k = &camera.intrinsics;
    let last = DVec3::new(f64::from(k.height), f64::from(k.width), k.fx);
    let columns = [axes.y_axis, axes.x_axis, -axes.z_axis, world_from_view.translation, last];
    (0..3).flat_map(|r| columns.map(|column| column[r])).chain([0.5, 20.0]).collect()
}

/// Writes a video as in DyNeRF: H.264, 30 frames per second.
fn film(video: &Path, frames: &[PathBuf]) {
    let folder = tempfile::tempdir().unwrap();
    for (i, frame) in frames.iter().enumerate() {
        fs::copy(frame, folder.path().join(format!("{i:03}.png"))).unwrap();
    }
    let status = Command::new("ffmpeg")
        .args(["-nostdin", "-v", "error", "-framerate", "30", "-i"])
        .arg(folder.path().join("%03d.png"))
        .args(["-c:v", "libx264", "-crf", "4", "-pix_fmt", "yuv420p"])
        .arg(video)
        .status()
        .expect("ffmpeg; tools/setup.sh installs it");
    assert!(status.success());
}

/// Writes a clip of a fixed camera, and of cameras beside it at the same times, as a scene of DyNeRF; the
/// first camera's depth goes to `depth`. Returns the focal length.
fn standing(folder: &Path) -> f64 {
    json(folder, "synth tripod -o clip --frames 15 --size 96x54 --seed 1");
    let truth = folder.join("clip/truth");
    let root = folder.join("set/steak");
    for part in [&root, &folder.join("depth")] {
        fs::create_dir_all(part).unwrap();
    }
    // Other cameras take every second frame.
    let frames = |of: &Path| -> Vec<PathBuf> {
        (0..15).step_by(2).map(|i| of.join(format!("{i:04}.png"))).collect()
    };
    for i in 0..8 {
        let from = truth.join(format!("depth/{:04}.exr", 2 * i));
        fs::copy(from, folder.join(format!("depth/{i:04}.exr"))).unwrap();
    }
    let first = transforms::read_cameras(&truth.join("transforms.json")).unwrap()[0].camera;
    let mut values = bounds_row(&first);
    film(&root.join("cam00.mp4"), &frames(&folder.join("clip/frames")));
    let held_out = Dataset::open(truth.join("held_out/transforms.json")).unwrap();
    for (k, name) in [(1, "cam01"), (2, "cam05"), (3, "cam06")] {
        let pictures = truth.join(format!("held_out/{k}"));
        let seen = held_out.frames.iter().find(|frame| frame.path.starts_with(&pictures)).unwrap();
        values.extend(bounds_row(&seen.camera));
        match name {
            // A camera whose frames were extracted.
            "cam06" => {
                fs::create_dir_all(root.join("cam06/images")).unwrap();
                for (i, frame) in frames(&pictures).iter().enumerate() {
                    fs::copy(frame, root.join(format!("cam06/images/{i:04}.png"))).unwrap();
                }
            }
            _ => film(&root.join(name).with_extension("mp4"), &frames(&pictures)),
        }
    }
    let mut head = String::from("{'descr': '<f8', 'fortran_order': False, 'shape': (4, 17), }");
    // The header is padded to a multiple of 64 bytes, ten of which are magic, version and length.
    head += &" ".repeat(64 * (head.len() + 11).div_ceil(64) - 11 - head.len());
    head.push('\n');
    let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
    bytes.extend((head.len() as u16).to_le_bytes());
    bytes.extend(head.bytes());
    values.iter().for_each(|value| bytes.extend(value.to_le_bytes()));
    fs::write(root.join("poses_bounds.npy"), bytes).unwrap();
    first.intrinsics.fx
}

#[test]
fn dynerf_by_one_camera_to_a_table() {
    let folder = tempfile::tempdir().unwrap();
    let focal = standing(folder.path());
    let at = |name: &str| folder.path().join("out/steak").join(name);
    // Images of a static camera do not determine depth.
    let making = format!("--steps 60 --max-gaussians 1500 --depth depth --focal {focal}");
    let found = table(folder.path(), "dynerf-mono set -o out", &making);
    let row = &found["rows"][0];
    assert_eq!(row["scene"], "steak", "{found}");
    equal(row, by_skimage(sheets(&at("pictures"), None)), &OF_PICTURES);
    assert_eq!(row["figures"]["minutes"].as_f64().map(|minutes| minutes > 0.0), Some(true));
    let caption = found["caption"].to_string();
    says(&caption, &["Trained on cam00, tested with cam05, cam06.", "fitted to test images"]);
    let published = found["published"].as_array().unwrap();
    assert!(published.iter().any(|row| row["figures"]["psnr"] == 19.6));
    let kept: Value = serde_json::from_str(&fs::read_to_string(at("eval.json")).unwrap()).unwrap();
    let eval = &kept["answer"];
    let rows = eval["held_out"].as_array().unwrap().iter();
    let rows: Vec<_> = rows.map(|row| (&row["distance"], &row["pictures"])).collect();
    let cameras =
        [("cam05", 8), ("cam06", 8), ("all", 16)].map(|(of, count)| (object!(of), object!(count)));
    assert!(rows.iter().map(|(a, b)| (*a, *b)).eq(cameras.iter().map(|(a, b)| (a, b))), "{rows:?}");

    // The scale determined by the test images is that of the true depth.
    fs::create_dir(at("clip/truth/depth")).unwrap();
    for entry in fs::read_dir(folder.path().join("depth")).unwrap() {
        let entry = entry.unwrap();
        fs::copy(entry.path(), at("clip/truth/depth").join(entry.file_name())).unwrap();
    }
    let told = json(folder.path(), "eval out/steak/scene.safetensors out/steak/clip/truth");
    assert_eq!((&eval["scale_by"], &told["scale_by"]), (&object!("pictures"), &object!("depth")));
    let ratio = eval["scale"].as_f64().unwrap() / told["scale"].as_f64().unwrap();
    assert!((ratio - 1.0).abs() < 0.02, "{ratio}");

    // Other cameras and another size are laid out anew, without any files of the old ones.
    let options =
        "dynerf-mono set/steak -o out --train-camera cam06 --test-cameras cam01 --size 64";
    let found = table(folder.path(), options, "--steps 5 --max-gaussians 600");
    says(&found["caption"].to_string(), &["Trained on cam06, tested with cam01.", "64 pixels"]);
    let tests = Dataset::open(at("clip/truth/held_out/transforms.json")).unwrap();
    assert_eq!((tests.frames.len(), tests.frames[0].camera.intrinsics.width), (8, 64));
    assert!(!at("clip/truth/depth").exists() && !at("clip/truth/held_out/cam05").exists());
    assert_eq!(images::list(&at("clip/frames")).unwrap().len(), 8);

    // Options that the set does not support or that the protocol fixes.
    for (options, said) in [
        ("dynerf-mono set -o out --test-cameras cam07", ["cam07 (--test-cameras)", "cam00, cam01"]),
        ("dynerf-mono set -o out --train-camera cam7", ["cam7 (--train-camera)", "cam05, cam06"]),
        ("dynerf-mono set -o out --train-camera cam05", ["cam05 is trained on", "takes others"]),
        ("dycheck set -o out --train-camera cam05", ["--train-camera", "dynerf-mono alone"]),
    ] {
        says(&fails(folder.path(), 1, &format!("table {options}")), &said);
    }
    // A folder that another program wrote is not overwritten.
    let marker = at("clip/source.json");
    fs::remove_file(&marker).unwrap();
    let output = run(folder.path(), "table dynerf-mono set -o out --device software");
    assert_eq!(output.status.code(), Some(1));
    says(&stderr(&output), &["steak/clip is not empty"]);
}

//! `splat4d table` on miniature data sets in the layout of the real ones, and on real ones where they are.

#![cfg(feature = "cli")]

#[path = "support/program.rs"]
mod program;
#[path = "support/runtime.rs"]
mod runtime;
mod support;

use std::fs;
use std::path::{Path, PathBuf};

use program::{fails, json, run, stderr};
use serde_json::{Value, json as object};
use splat4d::data::images::{Orientation, decode_rgb};
use splat4d::data::{Dataset, transforms};
use splat4d::types::{Camera, Image};
use support::says;
use tempfile::TempDir;

/// A table, by the options of the command and those of the commands that make scenes.
#[track_caller]
fn table(folder: &Path, options: &str, making: &str) -> Value {
    let output = run(folder, &format!("table {options} --json --device software -- {making}"));
    assert!(output.status.success(), "{options}: {}", stderr(&output));
    serde_json::from_slice(&output.stdout).unwrap()
}

/// A clip of few small frames, with its true cameras.
fn clip(folder: &Path, frames: usize) {
    json(folder, &format!("synth rigid -o clip --frames {frames} --size 96x54 --seed 1"));
}

/// PSNR over the pictures that `eval` shows, truth and render side by side, each of them by itself.
fn psnr_of_pictures(folder: &Path) -> f64 {
    let mut files: Vec<_> = fs::read_dir(folder).unwrap().map(|e| e.unwrap().path()).collect();
    files.sort();
    let of = |file: &PathBuf| {
        let sheet: Image = decode_rgb(file, [0.0; 3], Orientation::Stored).unwrap();
        let third = sheet.width / 3;
        let (mut sum, mut count) = (0.0, 0.0);
        for y in 0..sheet.height {
            for x in 0..third {
                for c in 0..3 {
                    let [a, b] = [x, x + third].map(|x| f64::from(sheet.at(x, y)[c]));
                    sum += (a - b) * (a - b);
                    count += 1.0;
                }
            }
        }
        -10.0 * f64::log10(sum / count)
    };
    files.iter().map(of).sum::<f64>() / files.len() as f64
}

/// The value of a line of `table.csv` that begins with this.
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
    // Frame t from camera t, and as the first camera's pictures some others of the same size.
    for scene in ["set/Balloon9/images", "set/Balloon9/gt", "set/Balloon9/masks"] {
        fs::create_dir_all(at(scene)).unwrap();
    }
    for i in 0..6 {
        let frame = at("clip/frames").join(format!("{i:04}.png"));
        fs::copy(&frame, at("set/Balloon9/images").join(format!("{i:03}.png"))).unwrap();
        fs::copy(&frame, at("set/Balloon9/gt").join(format!("v000_t{i:03}.png"))).unwrap();
    }
    // A second scene whose frames are none.
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

    // The figures are those of the pictures, counted here by themselves: frame 0 is an input.
    let row = &found["rows"][0];
    assert_eq!((row["scene"].as_str(), &row["failed"]), (Some("Balloon9"), &Value::Null));
    let figure = |key: &str| row["figures"][key].as_f64().unwrap_or_else(|| panic!("{key}: {row}"));
    let pictures = at("out/Balloon9/pictures");
    assert_eq!(fs::read_dir(&pictures).unwrap().count(), 5);
    let expected = psnr_of_pictures(&pictures);
    assert!((figure("psnr") - expected).abs() < 1e-4, "{} {expected}", figure("psnr"));
    let csv = fs::read_to_string(at("out/table.csv")).unwrap();
    assert_eq!(line(&csv, "scene,splat4d,Balloon9,psnr,"), figure("psnr"));
    assert!((0.0..4.0).contains(&figure("lpips")) && figure("fps") > 0.0);
    assert!(figure("pose_minutes") > 0.0 && figure("train_minutes") > 0.0);
    let bytes = fs::metadata(at("out/Balloon9/scene.safetensors")).unwrap().len();
    assert_eq!(figure("storage_mb"), bytes as f64 / 1e6);
    let page = fs::read_to_string(at("out/index.html")).unwrap();
    says(
        &page,
        &["Balloon9", "SplineGS", "features of squared difference", "1 of 2 scenes failed"],
    );
    says(&fs::read_to_string(at("out/table.tex")).unwrap(), &["\\begin{tabular}", "MoSca"]);

    // Again, of the scene that did not fail: nothing is done, and the table is the same.
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
    assert_eq!(found["mean"]["psnr"], psnr);
    assert_eq!(row["figures"]["pose_minutes"], Value::Null, "poses are given");
    let caption = found["caption"].to_string();
    says(&caption, &["48 pixels", "--steps 30", "given poses"]);
    // Other options make it anew.
    let other = table(
        folder.path(),
        "dnerf set/cup -o out --size 48",
        "--steps 40 --random-points 200 --control-points 8",
    );
    assert_ne!(other["rows"][0]["figures"]["psnr"], psnr);
}

/// A `.cam` file of Sintel: the tag, intrinsics, and world to camera.
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
    // Of the table's sequences one is there; others are no part of it.
    let rows = found["rows"].as_array().unwrap();
    assert_eq!(rows.len(), 1);
    assert_eq!(rows[0]["scene"], "alley_2");
    let figures = &rows[0]["figures"];
    let reference = "set/training/camdata_left/alley_2";
    let eval = json(
        folder.path(),
        &format!("eval out/alley_2/tracked/poses.txt {reference} --align sim3 --rpe-all-pairs"),
    );
    for (key, of) in
        [("ate", "ate_rmse"), ("rpe_trans", "rpe_trans_rmse"), ("rpe_rot", "rpe_rot_deg_rmse")]
    {
        assert!(figures[key].is_number(), "{key}: {found}");
        assert_eq!(figures[key], eval[of], "{key}");
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

/// A set in the layout of Nerfies: a camera of the format's JSON, a picture and a moment for each name.
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

/// A clip and its held-out cameras as a set with a validation rig.
fn rig(folder: &Path) {
    clip(folder, 8);
    let root = folder.join("set/broom9");
    for part in ["camera", "rgb/1x"] {
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
        rig.add(&format!("right_{i:06}"), moment, &frame.camera, &frame.path, false);
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
    // The same scene, measured by the same cameras and pictures as the clip's own truth has them.
    let eval = json(folder.path(), "eval out/broom9/scene.safetensors clip/truth");
    let figures = &found["rows"][0]["figures"];
    for key in ["psnr", "ssim"] {
        let (ours, of) = (figures[key].as_f64().unwrap(), eval[key].as_f64().unwrap());
        assert!((ours - of).abs() < 1e-4, "{key}: {ours} {of}");
    }
    assert!(figures["pose_minutes"].is_number() && found["mean"]["psnr"] == figures["psnr"]);
    says(&found["caption"].to_string(), &["without their poses", "similarity", "broom2"]);
}

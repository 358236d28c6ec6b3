//! Datasets in the layouts of public data sets, written here from known cameras and points. An image
//! shows three points, drawn at the pixels given by the format's projection formulas; the camera that is
//! read must project them to the same pixels.

#[cfg(feature = "cli")]
#[path = "support/program.rs"]
mod program;
mod support;

use std::fs;
use std::io::{Cursor, Write};
use std::path::{Path, PathBuf};

use glam::{DVec2, DVec3};
use serde_json::{Value, json};
use splat4d::data::layout::{self, Layout};
use splat4d::data::{
    Clip, ClipOptions, Dataset, Resize, View, cam, davis, depth, dpt, flo, nerfies, poses_bounds,
    read_mask, sintel, tracks, video, write_png,
};
use splat4d::types::{Image, Tracks};
use support::{damage, message, picture, says, shared};
use zip::write::{SimpleFileOptions, ZipWriter};

// ---------------------------------------------------------------------------------------------
// The scene
// ---------------------------------------------------------------------------------------------

/// A red, a green and a blue point in the world.
const POINTS: [DVec3; 3] =
    [DVec3::new(2.3, 3.1, 8.0), DVec3::new(-0.7, 0.8, 8.4), DVec3::new(2.0, 0.6, 7.8)];

/// A camera as its three axes and its centre.
#[derive(Clone, Copy)]
struct Eye {
    right: DVec3,
    down: DVec3,
    forward: DVec3,
    centre: DVec3,
}

impl Eye {
    /// Camera `i` of a row, slightly rotated about each axis.
    fn new(i: usize) -> Eye {
        let centre = DVec3::new(0.5 * i as f64 - 0.4, 2.0 + 0.1 * i as f64, 3.0 - 0.2 * i as f64);
        let forward = (DVec3::new(0.8, 1.9, 8.0) - centre).normalize();
        let down = DVec3::new(0.05, 1.0, 0.02 * i as f64);
        let right = down.cross(forward).normalize();
        Eye { right, down: forward.cross(right), forward, centre }
    }

    /// A point's projection onto the plane of unit depth.
    fn plane(&self, point: DVec3) -> DVec2 {
        let to = point - self.centre;
        DVec2::new(self.right.dot(to), self.down.dot(to)) / self.forward.dot(to)
    }
}

/// Draws each point in its own colour channel, as a spot around a pixel.
fn spots(width: u32, height: u32, at: [DVec2; 3]) -> Image {
    let mut image = Image::new(width, height, 3);
    for y in 0..height {
        for x in 0..width {
            let pixel = DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5);
            for (value, at) in image.at_mut(x, y).iter_mut().zip(at) {
                *value = (-0.5 * (pixel - at).length_squared()).exp() as f32;
            }
        }
    }
    image
}

/// Checks that a view's camera projects the points, given in its frame, to where its image shows them.
#[track_caller]
fn shows(view: &View, points: [DVec3; 3]) {
    for (c, point) in points.into_iter().enumerate() {
        let (mut sum, mut weight) = (DVec2::ZERO, 0.0);
        for y in 0..view.image.height {
            for x in 0..view.image.width {
                let value = f64::from(view.image.at(x, y)[c]);
                sum += value * DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5);
                weight += value;
            }
        }
        let here = view.camera.view_from_world.apply(point);
        let off = view.camera.intrinsics.project(here) - sum / weight;
        assert!(here.z > 0.0 && off.length() < 0.1, "{}: point {c} is off by {off}", view.name);
    }
}

fn write(path: &Path, text: impl AsRef<[u8]>) {
    fs::create_dir_all(path.parent().unwrap()).unwrap();
    fs::write(path, text).unwrap();
}

fn draw(path: &Path, image: &Image) {
    fs::create_dir_all(path.parent().unwrap()).unwrap();
    write_png(path, image).unwrap();
}

/// A `.npy` file with the given element type, shape and bytes.
fn npy(kind: &str, shape: &str, values: &[u8]) -> Vec<u8> {
    let header = format!("{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}");
    let header = format!("{header:<117}\n");
    let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
    bytes.extend((header.len() as u16).to_le_bytes());
    bytes.extend(header.as_bytes());
    bytes.extend(values);
    bytes
}

fn doubles(shape: &str, values: &[f64]) -> Vec<u8> {
    npy("<f8", shape, &values.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>())
}

fn floats(shape: &str, values: &[f32]) -> Vec<u8> {
    npy("<f4", shape, &values.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>())
}

fn all(set: &Dataset) -> Vec<View> {
    let indices: Vec<usize> = (0..set.frames.len()).collect();
    set.load(&indices, Resize::Keep).unwrap()
}

fn names(set: &Dataset, indices: &[usize]) -> Vec<String> {
    indices.iter().map(|&i| set.frames[i].name.clone()).collect()
}

fn files_of(clip: &Clip) -> Vec<&str> {
    clip.frames.iter().map(|frame| frame.name.as_str()).collect()
}

// ---------------------------------------------------------------------------------------------
// Nerfies, HyperNeRF, DyCheck
// ---------------------------------------------------------------------------------------------

const CENTER: DVec3 = DVec3::new(0.5, 2.0, 6.0);
const SCALE: f64 = 0.25;
const FOCAL: f64 = 130.0;
const ASPECT: f64 = 1.04;
const PRINCIPAL: [f64; 2] = [83.0, 58.0];
const SIZE: (u32, u32) = (160, 120);

fn in_scene() -> [DVec3; 3] {
    POINTS.map(|point| (point - CENTER) * SCALE)
}

/// Distortion coefficients k1, k2, k3 and p1, p2.
type Bend = ([f64; 3], [f64; 2]);
const STRAIGHT: Bend = ([0.0; 3], [0.0; 2]);
const BENT: Bend = ([-0.3, 0.1, -0.02], [0.03, -0.02]);

fn camera_json(eye: &Eye, (k, p): Bend) -> Value {
    let rows = [eye.right, eye.down, eye.forward].map(|axis| axis.to_array());
    json!({
        "orientation": rows, "position": eye.centre.to_array(), "focal_length": FOCAL,
        "principal_point": PRINCIPAL, "skew": 0.0, "pixel_aspect_ratio": ASPECT,
        "radial_distortion": k, "tangential": p, "image_size": [SIZE.0, SIZE.1],
    })
}

/// The pixel at which `rgb/1x` shows a point.
fn nerfies_pixel(eye: &Eye, ([k1, k2, k3], [p1, p2]): Bend, point: DVec3) -> DVec2 {
    let DVec2 { x, y } = eye.plane(point);
    let r2 = x * x + y * y;
    let radial = 1.0 + k1 * r2 + k2 * r2 * r2 + k3 * r2 * r2 * r2;
    let bent = DVec2::new(
        x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
        y * radial + 2.0 * p2 * x * y + p1 * (r2 + 2.0 * y * y),
    );
    DVec2::new(FOCAL * bent.x + PRINCIPAL[0], FOCAL * ASPECT * bent.y + PRINCIPAL[1])
}

/// Writes a camera and its images at the given fractions of the full size.
fn nerfies_frame(root: &Path, id: &str, eye: &Eye, bend: Bend, factors: &[u32]) {
    write(&root.join(format!("camera/{id}.json")), camera_json(eye, bend).to_string());
    for &factor in factors {
        let at = POINTS.map(|point| nerfies_pixel(eye, bend, point) / f64::from(factor));
        let image = spots(SIZE.0 / factor, SIZE.1 / factor, at);
        draw(&root.join(format!("rgb/{factor}x/{id}.png")), &image);
    }
}

fn scene_json(root: &Path) {
    let scene =
        json!({ "scale": SCALE, "center": CENTER.to_array(), "near": 0.1, "far": 2.0 }).to_string();
    write(&root.join("scene.json"), scene);
}

/// A rig of two cameras at four times, as in HyperNeRF's `vrig` sets: the left one is for training.
fn vrig(root: &Path) {
    scene_json(root);
    let (mut metadata, mut train, mut val) = (json!({}), vec![], vec![]);
    for moment in 0..4usize {
        for (camera, side) in ["left1", "right1"].into_iter().enumerate() {
            let id = format!("{side}_{moment:06}");
            nerfies_frame(root, &id, &Eye::new(2 * moment + camera), BENT, &[1, 2, 4]);
            // Times begin at 3 and are not evenly spaced.
            let number = 3 + moment * moment;
            metadata[&id] = json!({ "time_id": number, "warp_id": 99, "camera_id": camera });
            if camera == 0 { train.push(id) } else { val.push(id) }
        }
    }
    let ids: Vec<&String> = train.iter().chain(&val).collect();
    let dataset = json!({
        "count": 8, "num_exemplars": 4, "ids": ids, "train_ids": train, "val_ids": val,
    });
    write(&root.join("dataset.json"), dataset.to_string());
    write(&root.join("metadata.json"), metadata.to_string());
    let cloud: Vec<f32> = POINTS.iter().flat_map(|p| p.as_vec3().to_array()).collect();
    write(&root.join("points.npy"), floats("(3, 3)", &cloud));
}

#[test]
fn hypernerf_rig() {
    let root = tempfile::tempdir().unwrap();
    let root = root.path();
    vrig(root);
    let set = Dataset::open(root).unwrap();
    let (train, test) = set.split(8);
    assert_eq!(names(&set, &train), [0, 1, 2, 3].map(|i| format!("left1_{i:06}")));
    assert_eq!(names(&set, &test), [0, 1, 2, 3].map(|i| format!("right1_{i:06}")));
    let times: Vec<f64> = set.frames.iter().map(|frame| frame.time).collect();
    let one = [0.0, 1.0 / 9.0, 4.0 / 9.0, 1.0];
    assert!(set.timed && times == [one, one].concat(), "{times:?}");
    assert_eq!(set.background, [0.0; 3]);
    says(&set.notes[0], &["rgb/2x", "1x, 2x, 4x"]);
    // The distortion moves points by far more than `shows` allows.
    for eye in (0..8).map(Eye::new) {
        let at = |bend: Bend| POINTS.map(|point| nerfies_pixel(&eye, bend, point));
        let moved = at(BENT).into_iter().zip(at(STRAIGHT)).map(|(a, b)| a.distance(b));
        assert!(moved.fold(0.0, f64::max) > 0.5);
    }
    for view in all(&set) {
        assert_eq!((view.image.width, view.image.height), (80, 60));
        shows(&view, in_scene());
    }
    for (point, known) in set.points.iter().zip(in_scene()) {
        assert!((glam::Vec3::from(point.position).as_dvec3() - known).length() < 1e-6);
    }
    // Other images of the set, selected by their folder, also at a smaller size.
    for (factor, width) in [(1, 160), (4, 40)] {
        let set = Dataset::open(root.join(format!("rgb/{factor}x"))).unwrap();
        let view = set.frames[3].load([0.0; 3], Resize::Keep).unwrap();
        assert_eq!((view.image.width, set.frames.len()), (width, 8));
        shows(&view, in_scene());
        shows(&set.frames[3].load([0.0; 3], Resize::Longest(80)).unwrap(), in_scene());
    }
    // As a clip: the training images of one camera, in order of time.
    let clip = Clip::open(root, &ClipOptions::default()).unwrap();
    assert_eq!(files_of(&clip), [0, 1, 2, 3].map(|i| format!("left1_{i:06}")));
    assert_eq!((clip.width, clip.height), (80, 60));
}

#[test]
fn hypernerf_interpolation() {
    let root = tempfile::tempdir().unwrap();
    let root = root.path();
    scene_json(root);
    let ids: Vec<String> = (0..11).map(|i| format!("{i:06}")).collect();
    let mut metadata = json!({});
    for (i, id) in ids.iter().enumerate() {
        nerfies_frame(root, id, &Eye::new(i), STRAIGHT, &[4]);
        // Older sets have no `time_id`.
        metadata[id] = json!({ "warp_id": i, "appearance_id": i, "camera_id": 0 });
    }
    write(&root.join("metadata.json"), metadata.to_string());
    let dataset = json!({ "ids": ids, "train_ids": ids, "val_ids": [] });
    write(&root.join("dataset.json"), dataset.to_string());
    let set = Dataset::open(root).unwrap();
    let (train, test) = set.split(8);
    // Frame 10 lies beyond the last training image.
    assert_eq!(names(&set, &train), ["000000", "000004", "000008"]);
    assert_eq!(names(&set, &test), ["000002", "000006"]);
    assert_eq!(set.frames[3].time, 0.25);
    says(&set.notes[0], &["val_ids", "3 of 11", "2 midway"]);
    all(&set).iter().for_each(|view| shows(view, in_scene()));
    // Missing images are skipped and reported.
    fs::remove_file(root.join("rgb/4x/000006.png")).unwrap();
    let set = Dataset::open(root).unwrap();
    says(&set.notes[1], &["skipped 1 of 5", "000006"]);
}

/// A DyCheck capture: one moving camera, and two static test cameras, at half size.
fn dycheck(root: &Path) {
    scene_json(root);
    let mut splits = [("train", vec![]), ("val", vec![])];
    for (i, (camera, moment)) in
        [(0, 0), (0, 1), (0, 2), (0, 3), (1, 1), (2, 3)].into_iter().enumerate()
    {
        let id = format!("{camera}_{moment:05}");
        nerfies_frame(root, &id, &Eye::new(i), STRAIGHT, &[1, 2]);
        splits[usize::from(camera > 0)].1.push((id, camera, moment));
    }
    for (name, listed) in &splits {
        let split = json!({
            "frame_names": listed.iter().map(|l| &l.0).collect::<Vec<_>>(),
            "camera_ids": listed.iter().map(|l| l.1).collect::<Vec<_>>(),
            "time_ids": listed.iter().map(|l| l.2).collect::<Vec<_>>(),
        });
        write(&root.join(format!("splits/{name}.json")), split.to_string());
    }
    write(&root.join("dataset.json"), r#"{"ids": [], "train_ids": [], "val_ids": []}"#);
    write(&root.join("extra.json"), r#"{"factor": 2, "fps": 15.0}"#);
    // An image with a hole where the depth camera measured nothing, and a mask of 0 and 255.
    let path = root.join("rgb/2x/1_00001.png");
    let mut holed = image::open(&path).unwrap().into_rgba8();
    (0..80).for_each(|x| holed.put_pixel(x, 0, image::Rgba([255, 255, 255, 0])));
    holed.save(&path).unwrap();
    let mut mask = Image { pixels: vec![1.0; 80 * 60], ..Image::new(80, 60, 1) };
    (0..60).for_each(|y| mask.at_mut(5, y)[0] = 0.0);
    draw(&root.join("covisible/2x/val/1_00001.png"), &mask);
    let z: Vec<f32> = (0..12).map(|i| i as f32).collect();
    write(&root.join("depth/2x/0_00000.npy"), floats("(3, 4, 1)", &z));
}

#[test]
fn dycheck_iphone() {
    let root = tempfile::tempdir().unwrap();
    let root = root.path();
    dycheck(root);
    let set = Dataset::open(root).unwrap();
    let (train, test) = set.split(8);
    assert_eq!((train.len(), names(&set, &test)), (4, vec!["1_00001".into(), "2_00003".into()]));
    let times: Vec<f64> = set.frames.iter().map(|frame| frame.time).collect();
    assert_eq!(times, [0.0, 1.0 / 3.0, 2.0 / 3.0, 1.0, 1.0 / 3.0, 1.0]);
    let views = all(&set);
    views.iter().filter(|view| view.name != "1_00001").for_each(|view| shows(view, in_scene()));
    // Transparent pixels are not background here: they are excluded.
    assert!(!set.alpha && set.background == [0.0; 3]);
    let valid = views[4].valid.as_ref().unwrap();
    let counted = valid.pixels.iter().filter(|v| **v == 1.0).count();
    assert_eq!((valid.at(7, 0)[0], counted), (0.0, 80 * 59));
    assert!(views[3].valid.is_none());
    let mask = set.frames[4].load_covisible(Resize::Keep).unwrap().unwrap();
    assert_eq!((mask.at(5, 9)[0], mask.at(6, 9)[0]), (0.0, 1.0));
    let small = set.frames[4].load_covisible(Resize::Width(40)).unwrap().unwrap();
    assert_eq!((small.width, small.at(2, 9)[0], small.at(9, 9)[0]), (40, 0.0, 1.0));
    assert!(set.frames[0].load_covisible(Resize::Keep).unwrap().is_none());
    let scene = nerfies::read_scene(&root.join("scene.json")).unwrap();
    assert_eq!((scene.near, scene.far, scene.scale), (0.1, 2.0, SCALE));
    let depth = nerfies::read_depth(&root.join("depth/2x/0_00000.npy"), &scene).unwrap();
    assert_eq!((depth.width, depth.pixels[0], depth.pixels[5]), (4, 0.0, 1.25));
    // The moving camera alone is a clip.
    let clip = Clip::open(root, &ClipOptions::default()).unwrap();
    assert_eq!(files_of(&clip), ["0_00000", "0_00001", "0_00002", "0_00003"]);
    // A mask of another size is reported.
    draw(&root.join("covisible/2x/val/1_00001.png"), &picture(40, 30, 0));
    says(&message(set.frames[4].load_covisible(Resize::Keep)), &["40×30", "1_00001", "80×60"]);
}

/// The mask of unmeasured pixels is undistorted like the image.
#[test]
fn transparent_pixels_are_undistorted() {
    let root = tempfile::tempdir().unwrap();
    let root = root.path();
    vrig(root);
    let path = root.join("rgb/1x/left1_000000.png");
    let hole = nerfies_pixel(&Eye::new(0), BENT, POINTS[0]);
    let mut holed = image::open(&path).unwrap().into_rgba8();
    for (x, y, pixel) in holed.enumerate_pixels_mut() {
        let here = DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5);
        pixel.0[3] = if here.distance(hole) < 5.0 { 0 } else { 255 };
    }
    holed.save(&path).unwrap();
    let set = Dataset::open(root.join("rgb/1x")).unwrap();
    let mut view = set.frames[0].load([0.0; 3], Resize::Keep).unwrap();
    let valid = view.valid.take().unwrap();
    let around = |pixel: DVec2| {
        let (mut sum, mut count) = (DVec2::ZERO, 0.0);
        for (i, _) in valid.pixels.iter().enumerate().filter(|(_, v)| **v == 0.0) {
            let i = i as u32;
            sum += DVec2::new(f64::from(i % valid.width), f64::from(i / valid.width)) + 0.5;
            count += 1.0;
        }
        assert!(count > 60.0 && count < 200.0, "{count}");
        pixel.distance(sum / count)
    };
    let point = view.camera.view_from_world.apply(in_scene()[0]);
    let straight = view.camera.intrinsics.project(point);
    assert!(around(straight) < 0.3 && around(hole) > 0.6);
}

/// The commands on such a capture: training and held-out images, and the metrics of covisible pixels.
#[cfg(feature = "cli")]
#[test]
fn dycheck_by_the_commands() {
    let root = tempfile::tempdir().unwrap();
    let root = root.path();
    dycheck(&root.join("set"));
    let train = "train set -o a.safetensors --steps 2 --random-points 60 --sh-degree 0 --size 40";
    let report = program::json(root, train);
    assert_eq!((&report["images"], &report["held_out"]), (&json!(4), &json!(2)));
    assert!(report["control_points"].as_u64() > Some(0), "the images have times");
    // One of the two test images has no mask.
    let found = program::json(root, "eval a.safetensors set --size 40");
    assert_eq!(found["per_frame"].as_array().unwrap().len(), 2);
    assert!(found["psnr"].is_f64() && found["psnr_covisible"].is_null());
    let whole = Image { pixels: vec![1.0; 80 * 60], ..Image::new(80, 60, 1) };
    draw(&root.join("set/covisible/2x/val/2_00003.png"), &whole);
    let found = program::json(root, "eval a.safetensors set --size 40");
    assert!(found["psnr_covisible"].is_f64() && found["ssim_covisible"].is_f64());
    draw(&root.join("set/covisible/2x/val/1_00001.png"), &whole);
    let all = program::json(root, "eval a.safetensors set --size 40");
    let of = |key: &str| all[key].as_f64().unwrap();
    assert!(
        (of("psnr") - of("psnr_covisible")).abs() < 1e-9,
        "all that was measured counts in both"
    );
}

#[test]
fn bad_nerfies_sets_are_told() {
    let root = tempfile::tempdir().unwrap();
    let root = root.path();
    vrig(root);
    let told = |file: &str, change: &dyn Fn(&mut Value), parts: &[&str]| {
        let path = root.join(file);
        let original = fs::read(&path).unwrap();
        let mut value: Value = serde_json::from_slice(&original).unwrap();
        change(&mut value);
        fs::write(&path, value.to_string()).unwrap();
        let said = message(Dataset::open(root));
        says(&said, &[file.rsplit('/').next().unwrap()]);
        says(&said, parts);
        fs::write(&path, original).unwrap();
    };
    let camera = "camera/right1_000002.json";
    told(camera, &|v| v["orientation"][1][1] = json!(2.0), &["orientation", "rigid"]);
    told(camera, &|v| v["orientation"] = json!([[1, 0, 0]]), &["orientation", "3×3"]);
    told(camera, &|v| v["skew"] = json!(3.0), &["skew", "undistort"]);
    told(camera, &|v| v["focal_length"] = json!("wide"), &["focal_length", "missing"]);
    told(camera, &|v| v["position"] = json!([1e300, 0, 0]), &["position", "origin"]);
    told(camera, &|v| v["image_size"] = json!([0, 60]), &["image_size", "makes no sense"]);
    told(camera, &|v| v["radial_distortion"] = json!([1, 2]), &["radial_distortion", "3 numbers"]);
    told("scene.json", &|v| v["scale"] = json!(0.0), &["`scale` = 0.0"]);
    told("scene.json", &|v| v["center"] = json!([1, 2]), &["center", "3 numbers"]);
    told("metadata.json", &|v| v["left1_000001"] = json!({}), &["left1_000001", "warp_id"]);
    told("metadata.json", &|v| *v = json!({}), &["no entry for left1_000000"]);
    told("dataset.json", &|v| v["train_ids"] = json!([[]]), &["train_ids", "names"]);
    let other = |v: &mut Value| v["image_size"] = json!([160, 160]);
    let path = root.join(camera);
    let original = fs::read(&path).unwrap();
    let mut value: Value = serde_json::from_slice(&original).unwrap();
    other(&mut value);
    fs::write(&path, value.to_string()).unwrap();
    says(&message(Dataset::open(root)), &["right1_000002.png", "80×60", "160×160"]);
    fs::write(&path, &original).unwrap();
    write(&root.join("points.npy"), doubles("(4,)", &[0.0; 4]));
    says(&message(Dataset::open(root)), &["points.npy", "points × 3"]);
    fs::remove_file(root.join("points.npy")).unwrap();
    let scene = nerfies::read_scene(&root.join("scene.json")).unwrap();
    damage(&original, &path, true, |path| nerfies::read_camera(path, &scene).is_ok());
    fs::remove_dir_all(root.join("rgb/2x")).unwrap();
    write(&root.join("extra.json"), r#"{"factor": 2}"#);
    says(&message(Dataset::open(root)), &["extra.json", "`factor` = 2", "1x, 4x"]);
    fs::remove_file(&path).unwrap();
    fs::remove_file(root.join("extra.json")).unwrap();
    says(&message(Dataset::open(root)), &["right1_000002.json"]);
    fs::remove_dir_all(root.join("rgb")).unwrap();
    fs::create_dir(root.join("rgb")).unwrap();
    says(&message(Dataset::open(root)), &["rgb", "1x, 2x, 4x"]);
}

// ---------------------------------------------------------------------------------------------
// LLFF, DyNeRF, NVIDIA dynamic scenes
// ---------------------------------------------------------------------------------------------

/// A row of `poses_bounds.npy`: the matrix with the axes down, right, backwards, the centre, and height,
/// width and focal length; then the depth bounds.
fn row(eye: &Eye) -> Vec<f64> {
    let columns = [
        eye.down,
        eye.right,
        -eye.forward,
        eye.centre,
        DVec3::new(f64::from(SIZE.1), f64::from(SIZE.0), FOCAL),
    ];
    let matrix = (0..3).flat_map(|r| columns.map(|column| column[r]));
    matrix.chain([2.0, 20.0]).collect()
}

fn rows(root: &Path, count: usize) {
    let values: Vec<f64> = (0..count).flat_map(|i| row(&Eye::new(i))).collect();
    write(&root.join("poses_bounds.npy"), doubles(&format!("({count}, 17)"), &values));
}

/// The image of camera `i`, at a fraction of its size.
fn seen(i: usize, factor: u32) -> Image {
    let middle = DVec2::new(f64::from(SIZE.0), f64::from(SIZE.1)) / 2.0;
    let at = POINTS.map(|point| (FOCAL * Eye::new(i).plane(point) + middle) / f64::from(factor));
    spots(SIZE.0 / factor, SIZE.1 / factor, at)
}

#[test]
fn llff() {
    let root = tempfile::tempdir().unwrap();
    let root = root.path();
    rows(root, 10);
    for i in 0..10 {
        draw(&root.join(format!("images/IMG_{i}.png")), &seen(i, 1));
        draw(&root.join(format!("images_4/image{i:03}.png")), &seen(i, 4));
    }
    let set = Dataset::open(root).unwrap();
    assert!(!set.timed && set.test.is_none() && set.notes.is_empty());
    assert_eq!(set.split(8).1, [0, 8]);
    all(&set).iter().for_each(|view| shows(view, POINTS));
    let small = Dataset::open(root.join("images_4")).unwrap();
    assert_eq!(small.frames[9].camera.intrinsics.width, 40);
    all(&small).iter().for_each(|view| shows(view, POINTS));
    let read = poses_bounds::read_rows(&root.join("poses_bounds.npy")).unwrap();
    assert_eq!((read.len(), read[3].bounds), (10, [2.0, 20.0]));

    fs::remove_file(root.join("images/IMG_7.png")).unwrap();
    says(&message(Dataset::open(root)), &["images", "9 images", "10 cameras"]);
}

/// Frames that the cameras of a row took in turn, and the images of all of them, in NSFF's layout of
/// NVIDIA's scenes.
#[test]
fn nvidia_in_turn() {
    let root = tempfile::tempdir().unwrap();
    let root = root.path();
    const CAMERAS: usize = 3;
    let frames: Vec<f64> = (0..5).flat_map(|i| row(&Eye::new(i % CAMERAS))).collect();
    write(&root.join("poses_bounds.npy"), doubles("(5, 17)", &frames));
    for i in 0..5 {
        draw(&root.join(format!("images/{i:05}.png")), &seen(i % CAMERAS, 1));
        for c in 0..CAMERAS {
            draw(&root.join(format!("mv_images/{i:05}/cam{:02}.png", c + 1)), &seen(c, 2));
        }
    }
    let set = Dataset::open(root).unwrap();
    let (train, test) = set.split(8);
    assert_eq!((train.len(), test.len()), (5, 5 * (CAMERAS - 1)));
    assert_eq!(
        names(&set, &test[..4]),
        ["00000/cam02", "00000/cam03", "00001/cam01", "00001/cam03"]
    );
    assert!(set.timed && set.frames[2].time == 0.5 && set.frames[test[4]].time == 0.5);
    all(&set).iter().for_each(|view| shows(view, POINTS));
    let clip = Clip::open(root, &ClipOptions::default()).unwrap();
    assert_eq!(files_of(&clip), ["00000", "00001", "00002", "00003", "00004"]);
    (2..9).for_each(|c| draw(&root.join(format!("mv_images/00003/cam1{c}.png")), &seen(0, 2)));
    says(&message(Dataset::open(root)), &["00003", "10 images", "5 rows"]);
}

/// The real scene, 12 cameras in a row at 12 times: its two camera files agree.
#[test]
fn balloon1_by_poses_bounds() {
    let Some(path) = shared("nvidia_balloon1") else { return };
    let by_transforms = Dataset::open(&path).unwrap();
    let root = tempfile::tempdir().unwrap();
    let root = root.path();
    fs::copy(path.join("poses_bounds.npy"), root.join("poses_bounds.npy")).unwrap();
    fs::create_dir_all(root.join("motion_masks")).unwrap();
    fs::create_dir_all(root.join("images")).unwrap();
    for i in 0..12 {
        let name = format!("images/{i:03}.png");
        fs::copy(path.join(&name), root.join(&name)).unwrap();
    }
    let set = Dataset::open(root).unwrap();
    assert_eq!(set.frames.len(), 12);
    assert!(set.timed && set.frames[11].time == 1.0);
    says(&set.notes[0], &["motion_masks", "times"]);
    for (ours, theirs) in set.frames.iter().zip(&by_transforms.frames) {
        let (a, b) = (ours.camera, theirs.camera);
        assert!((a.centre() - b.centre()).length() < 1e-6);
        assert!(a.view_from_world.rotation.dot(b.view_from_world.rotation).abs() > 1.0 - 1e-9);
        assert!((a.intrinsics.fx - b.intrinsics.fx).abs() < 1e-3);
        assert_eq!((a.intrinsics.cx, a.intrinsics.cy), (480.0, 270.0));
    }
    // The commands hold out the first camera's images at other times, which have a separate folder.
    assert!(path.join("gt_cam000/v000_t001.png").is_file());
}

#[test]
fn bad_poses_bounds_are_told() {
    let root = tempfile::tempdir().unwrap();
    let root = root.path();
    draw(&root.join("images/0.png"), &seen(0, 1));
    let file = root.join("poses_bounds.npy");
    let told = |change: &dyn Fn(&mut Vec<f64>), parts: &[&str]| {
        let mut values = row(&Eye::new(0));
        change(&mut values);
        write(&file, doubles("(1, 17)", &values));
        let said = message(Dataset::open(root));
        says(&said, &["poses_bounds.npy", "row 0"]);
        says(&said, parts);
    };
    told(&|v| v[0] = 5.0, &["rigid"]);
    told(&|v| [0, 5, 10].iter().for_each(|i| v[*i] *= -1.0), &["mirrors"]);
    told(&|v| v[3] = f64::INFINITY, &["place"]);
    told(&|v| v[4] = 60.5, &["160.0×60.5"]);
    told(&|v| v[14] = 0.0, &["focal length"]);
    told(&|v| v[16] = f64::NAN, &["bounds"]);
    write(&file, doubles("(1, 15)", &[0.0; 15]));
    says(&message(Dataset::open(root)), &["[1, 15]", "cameras × 17"]);
    write(&file, doubles("(0, 17)", &[]));
    says(&message(Dataset::open(root)), &["holds no cameras"]);
    let good = doubles("(1, 17)", &row(&Eye::new(0)));
    damage(&good, &file, true, |file| poses_bounds::read_rows(file).is_ok());
}

/// Writes a camera's video whose frames are equal except for a bar that grows with time.
fn film(path: &Path, i: usize, frames: usize) {
    let folder = tempfile::tempdir().unwrap();
    for t in 0..frames {
        let mut image = seen(i, 1);
        (0..SIZE.0).for_each(|x| {
            let value = if (x as usize) < 10 * t { 1.0 } else { 0.0 };
            (0..8).for_each(|y| image.at_mut(x, y).fill(value));
        });
        draw(&folder.path().join(format!("{t:03}.png")), &image);
    }
    let status = std::process::Command::new("ffmpeg")
        .args(["-nostdin", "-v", "error", "-y", "-framerate", "30", "-i"])
        .arg(folder.path().join("%03d.png"))
        .args(["-c:v", "libx264", "-crf", "4", "-pix_fmt", "yuv444p"])
        .arg(path)
        .status()
        .unwrap();
    assert!(status.success());
}

/// The frame number from the bar's length: ten pixels per frame.
fn moment(view: &View) -> usize {
    let white = (0..SIZE.0).filter(|x| view.image.at(*x, 4)[0] > 0.5).count();
    (white + 5) / 10
}

/// Checks the spots' positions with the bar removed.
fn shows_below(view: &View) {
    let mut view = view.clone();
    let width = view.image.width;
    (0..width).for_each(|x| (0..12).for_each(|y| view.image.at_mut(x, y).fill(0.0)));
    // Removes compression artefacts in dark regions.
    view.image.pixels.iter_mut().for_each(|v| *v = if *v < 0.1 { 0.0 } else { *v });
    shows(&view, POINTS);
}

#[test]
fn dynerf_videos_and_folders() {
    if std::process::Command::new("ffmpeg").arg("-version").output().is_err() {
        println!("SKIPPED (no ffmpeg): DyNeRF's videos");
        return;
    }
    let root = tempfile::tempdir().unwrap();
    let root = root.path();
    rows(root, 3);
    film(&root.join("cam00.mp4"), 0, 6);
    film(&root.join("cam05.mp4"), 1, 5);
    for t in 0..6 {
        draw(&root.join(format!("cam11/images/{t:04}.png")), &seen(2, 2));
    }
    // Extracted frames take precedence over their video.
    fs::copy(root.join("cam00.mp4"), root.join("cam11.mp4")).unwrap();
    let extent = video::extent(&root.join("cam00.mp4")).unwrap();
    assert_eq!((extent.size, extent.frames), (SIZE, 6));
    let set = Dataset::open(root).unwrap();
    let (train, test) = set.split(8);
    assert_eq!((train.len(), test.len()), (11, 6));
    assert_eq!(
        names(&set, &[0, 4, 5, 11]),
        ["cam05/0000", "cam05/0004", "cam11/0000", "cam00/0000"]
    );
    assert_eq!((set.frames[4].time, set.frames[5].time, set.frames[16].time), (0.8, 0.0, 1.0));
    // Indices that are mixed, out of order and repeated.
    let views = set.load(&[3, 14, 7, 1, 14, 11], Resize::Keep).unwrap();
    let moments: Vec<usize> = [0, 1, 3, 4, 5].map(|i| moment(&views[i])).to_vec();
    assert_eq!(moments, [3, 3, 1, 3, 0]);
    assert_eq!(views[2].name, "cam11/0002");
    [0, 1, 3].iter().for_each(|i| shows_below(&views[*i]));
    shows(&views[2], POINTS);
    let one = set.frames[16].load([0.0; 3], Resize::Width(80)).unwrap();
    assert_eq!((one.image.width, one.name.as_str()), (80, "cam00/0005"));
    // Several cameras are not a clip.
    says(&message(Clip::open(root, &ClipOptions::default())), &["several cameras", "one camera"]);

    says(
        &message(video::frames(&root.join("cam05.mp4"), &[4, 5], &mut |_, _| Ok(()))),
        &["cam05.mp4", "no frame 5"],
    );
    fs::remove_dir_all(root.join("cam11")).unwrap();
    fs::remove_file(root.join("cam11.mp4")).unwrap();
    says(&message(Dataset::open(root)), &["poses_bounds.npy", "3 cameras", "2 videos"]);
    write(&root.join("cam11.mp4"), b"no video");
    says(&message(Dataset::open(root)), &["cam11.mp4", "ffprobe"]);
    fs::remove_file(root.join("cam11.mp4")).unwrap();
    fs::create_dir(root.join("cam11")).unwrap();
    says(&message(Dataset::open(root)), &["cam11", "no images"]);
    draw(&root.join("cam11/0.png"), &picture(60, 60, 0));
    says(&message(Dataset::open(root)), &["60×60", "160×120"]);
}

// ---------------------------------------------------------------------------------------------
// MPI Sintel
// ---------------------------------------------------------------------------------------------

const TAG: f32 = 202_021.25;

fn cam_bytes(eye: &Eye, focal: f64) -> Vec<u8> {
    // Pixel centres have integer coordinates in this format.
    let k = [focal, 0.0, PRINCIPAL[0] - 0.5, 0.0, focal, PRINCIPAL[1] - 0.5, 0.0, 0.0, 1.0];
    let rows = [eye.right, eye.down, eye.forward];
    let m = rows.iter().flat_map(|r| [r.x, r.y, r.z, -r.dot(eye.centre)]);
    let numbers = k.into_iter().chain(m).flat_map(f64::to_le_bytes);
    TAG.to_le_bytes().into_iter().chain(numbers).collect()
}

fn dpt_bytes(width: i32, height: i32, values: &[f32]) -> Vec<u8> {
    let mut bytes = TAG.to_le_bytes().to_vec();
    bytes.extend(width.to_le_bytes().into_iter().chain(height.to_le_bytes()));
    bytes.extend(values.iter().flat_map(|v| v.to_le_bytes()));
    bytes
}

#[test]
fn sintel_sequences() {
    let root = tempfile::tempdir().unwrap();
    let root = root.path().join("training");
    for i in 0..4 {
        let (eye, focal) = (Eye::new(i), FOCAL + 10.0 * i as f64);
        let at = POINTS.map(|point| focal * eye.plane(point) + DVec2::from(PRINCIPAL));
        for pass in ["clean", "final"] {
            let name = format!("{pass}/alley_2/frame_{:04}.png", i + 1);
            draw(&root.join(name), &spots(SIZE.0, SIZE.1, at));
        }
        let name =
            |what: &str, end: &str| root.join(format!("{what}/alley_2/frame_{:04}.{end}", i + 1));
        write(&name("camdata_left", "cam"), cam_bytes(&eye, focal));
        write(&name("depth", "dpt"), dpt_bytes(2, 2, &[1.0, 2.5, 0.0, 1e20]));
        if i < 3 {
            let flow = Image { pixels: vec![1.0, -2.0], ..Image::new(1, 1, 2) };
            fs::create_dir_all(root.join("flow/alley_2")).unwrap();
            flo::write(name("flow", "flo"), &flow).unwrap();
        }
    }
    let pictures = root.join("final/alley_2");
    assert_eq!(
        layout::find(&pictures).unwrap(),
        Layout::Sintel(pictures.clone(), root.join("camdata_left/alley_2"))
    );
    let set = Dataset::open(&pictures).unwrap();
    assert!(set.timed && set.test.is_none() && set.frames[2].time == 2.0 / 3.0);
    assert_eq!(set.frames[3].camera.intrinsics.fx, 160.0);
    all(&set).iter().for_each(|view| shows(view, POINTS));
    let stored =
        depth::read(sintel::depth_of(&pictures).unwrap().join("frame_0001.dpt"), 1.0).unwrap();
    assert_eq!(stored.pixels, [1.0, 2.5, 0.0, f32::INFINITY]);
    let flow = sintel::flow_of(&pictures).unwrap().join("frame_0003.flo");
    assert_eq!(flo::read(flow).unwrap().pixels, [1.0, -2.0]);
    assert!(sintel::SEQUENCES.contains(&"alley_2"));
    // As a clip, it is a folder of images.
    assert_eq!(Clip::open(&pictures, &ClipOptions::default()).unwrap().frames.len(), 4);
    // The whole data set is not a single sequence.
    for folder in [&root, &root.join("final"), &root.join("..")] {
        says(&message(Dataset::open(folder)), &["several sequences", "final/alley_2"]);
    }
    let camera = root.join("camdata_left/alley_2/frame_0002.cam");
    let good = fs::read(&camera).unwrap();
    damage(&good, &camera, true, |path| cam::read(path).is_ok());
    write(&camera, &good[..100]);
    says(&message(Dataset::open(&pictures)), &["frame_0002.cam", "172 bytes"]);
    write(&camera, cam_bytes(&Eye::new(1), 1.0));
    says(&message(Dataset::open(&pictures)), &["frame_0002.cam", "87.5°"]);
    fs::remove_file(&camera).unwrap();
    says(&message(Dataset::open(&pictures)), &["camdata_left", "no frame_0002.cam"]);
}

#[test]
fn bad_dpt_files_are_told() {
    let root = tempfile::tempdir().unwrap();
    let file = root.path().join("a.dpt");
    let told = |bytes: &[u8], part: &str| {
        write(&file, bytes);
        says(&message(dpt::read(&file)), &["a.dpt", part]);
    };
    told(b"PIEX", "its tag is another");
    told(&dpt_bytes(-1, 2, &[1.0]), "a size of -1×2");
    told(&dpt_bytes(2, 2, &[1.0]), "2×2 pixels take 16 bytes, 4 follow");
    told(&dpt_bytes(40_000, 40_000, &[1.0]), "6400000000 bytes");
    damage(&dpt_bytes(3, 2, &[1.0; 6]), &file, true, |file| dpt::read(file).is_ok());
}

// ---------------------------------------------------------------------------------------------
// DAVIS, TAP-Vid
// ---------------------------------------------------------------------------------------------

/// A palette PNG, as DAVIS 2017 stores object labels: 0 is the background.
fn palette_png(path: &Path, width: u32, labels: &[u8]) {
    fn chunk(out: &mut Vec<u8>, kind: &[u8], data: &[u8]) {
        out.extend((data.len() as u32).to_be_bytes());
        let body = [kind, data].concat();
        out.extend(&body);
        out.extend(crc32fast::hash(&body).to_be_bytes());
    }
    let height = labels.len() as u32 / width;
    let mut rows = Vec::new();
    labels.chunks(width as usize).for_each(|row| rows.extend([&[0], row].concat()));
    let mut stream = flate2::write::ZlibEncoder::new(Vec::new(), flate2::Compression::fast());
    stream.write_all(&rows).unwrap();
    let stream = stream.finish().unwrap();
    let mut out = b"\x89PNG\r\n\x1a\n".to_vec();
    let size = [width.to_be_bytes(), height.to_be_bytes()].concat();
    chunk(&mut out, b"IHDR", &[&size[..], &[8, 3, 0, 0, 0]].concat());
    chunk(&mut out, b"PLTE", &[0, 0, 0, 128, 0, 0, 0, 128, 0, 128, 128, 0, 0, 0, 128]);
    chunk(&mut out, b"IDAT", &stream);
    chunk(&mut out, b"IEND", &[]);
    write(path, out);
}

#[test]
fn davis_clips() {
    let root = tempfile::tempdir().unwrap();
    let root = root.path();
    for i in 0..3u32 {
        draw(&root.join(format!("JPEGImages/480p/camel/{i:05}.png")), &picture(8, 6, i));
        let labels = [0, 1, 2, 3, 4, 0, 0, 1];
        palette_png(&root.join(format!("Annotations/480p/camel/{i:05}.png")), 4, &labels);
    }
    let mask = read_mask(davis::masks(root, "camel").join("00002.png")).unwrap();
    assert_eq!(mask.pixels, [0.0, 1.0, 1.0, 1.0, 1.0, 0.0, 0.0, 1.0]);
    assert_eq!(davis::names(root).unwrap(), ["camel"]);
    let clip = Clip::open(root, &ClipOptions::default()).unwrap();
    assert_eq!(files_of(&clip), ["00000", "00001", "00002"]);
    says(&message(Dataset::open(root)), &["DAVIS", "no cameras", "as motion masks"]);
    fs::create_dir(root.join("JPEGImages/480p/bear")).unwrap();
    let said = message(Clip::open(root, &ClipOptions::default()));
    says(&said, &["2 clips of DAVIS", "480p/bear"]);
    // One label alone, stored as the numbers 0 and 1.
    let binary = root.join("JPEGImages/binary.png");
    image::GrayImage::from_raw(3, 1, vec![0, 1, 0]).unwrap().save(&binary).unwrap();
    assert_eq!(read_mask(binary).unwrap().pixels, [0.0, 1.0, 0.0]);
    fs::remove_dir_all(root.join("JPEGImages/480p")).unwrap();
    says(&message(Clip::open(root, &ClipOptions::default())), &["JPEGImages", "no clips"]);
    fs::create_dir_all(root.join("JPEGImages/480p/bear")).unwrap();
    says(&message(Clip::open(root, &ClipOptions::default())), &["no images"]);
}

#[test]
fn davis16_camel() {
    let Some(root) = shared("davis16_camel") else { return };
    assert_eq!(davis::names(&root).unwrap(), ["camel"]);
    let options =
        ClipOptions { max_frames: Some(3), size: Resize::Width(160), ..Default::default() };
    let clip = Clip::open(&root, &options).unwrap();
    assert_eq!((files_of(&clip), clip.total), (vec!["00000", "00001", "00002"], Some(90)));
    let mask = read_mask(davis::masks(&root, "camel").join("00000.png")).unwrap();
    let share = mask.pixels.iter().sum::<f32>() / mask.pixels.len() as f32;
    assert_eq!((mask.width, mask.height), (854, 480));
    assert!(share > 0.05 && share < 0.3, "{share}");
}

/// An entry of TAP-Vid's pickle, as NumPy's `savez` writes it.
fn tap_vid(path: &Path, points: &str, video: Option<&str>) {
    let mut archive = ZipWriter::new(Cursor::new(Vec::new()));
    let mut add = |name: &str, bytes: Vec<u8>| {
        archive.start_file(format!("{name}.npy"), SimpleFileOptions::default()).unwrap();
        archive.write_all(&bytes).unwrap();
    };
    add("points", floats(points, &[0.0, 0.0, 0.5, 0.25, 1.0, 1.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6]));
    add("occluded", npy("|b1", "(2, 3)", &[1, 0, 0, 0, 0, 1]));
    if let Some(shape) = video {
        add("video", npy("|u1", shape, &[7; 3 * 4 * 8 * 3]));
    }
    write(path, archive.finish().unwrap().into_inner());
}

#[test]
fn tap_vid_entries() {
    let root = tempfile::tempdir().unwrap();
    let file = root.path().join("camel.npz");
    tap_vid(&file, "(2, 3, 2)", Some("(3, 4, 8, 3)"));
    let Tracks { size, points } = tracks::read(&file).unwrap();
    assert_eq!((size, points.len()), (Some((8, 4)), 2));
    assert_eq!(points[0].seen, [false, true, true]);
    assert_eq!(points[0].pixels[2], DVec2::new(8.0, 4.0));
    assert_eq!(points[0].query, (1, DVec2::new(4.0, 1.0)));
    assert_eq!(points[1].query.0, 0);
    let told = |points: &str, video: Option<&str>, part: &str| {
        tap_vid(&file, points, video);
        says(&message(tracks::read(&file)), &["camel.npz", part]);
    };
    told("(2, 3, 2)", None, "no `video`");
    told("(2, 3, 2)", Some("(3, 4, 8)"), "no `video`");
    told("(12,)", Some("(3, 4, 8, 3)"), "[12]");
    told("(3, 2, 2)", Some("(3, 4, 8, 3)"), "visibilities");
    write(&file, b"\x80\x04\x95");
    says(&message(tracks::read(&file)), &["camel.npz", "is a pickle", "np.savez"]);
    tap_vid(&file, "(2, 3, 2)", Some("(3, 4, 8, 3)"));
    let good = fs::read(&file).unwrap();
    damage(&good, &file, true, |file| tracks::read(file).is_ok());
}

// ---------------------------------------------------------------------------------------------
// D-NeRF, and how kinds are told apart
// ---------------------------------------------------------------------------------------------

/// The same set at 400² and at 800² pixels: `camera_angle_x` holds for both.
#[test]
fn dnerf_at_two_sizes() {
    for side in [400u32, 800] {
        let root = tempfile::tempdir().unwrap();
        let root = root.path();
        let angle = 2.0 * (0.5f64 / 1.388_888_8).atan();
        for (split, moments) in [("train", [0usize, 1, 2]), ("test", [5, 6, 7])] {
            let mut frames = vec![];
            for i in moments {
                let eye = Eye::new(i);
                // OpenGL's axes: y up, z backwards.
                let columns = [eye.right, -eye.down, -eye.forward, eye.centre];
                let mut matrix: Vec<Vec<f64>> =
                    (0..3).map(|r| columns.iter().map(|column| column[r]).collect()).collect();
                matrix.push(vec![0.0, 0.0, 0.0, 1.0]);
                frames.push(json!({
                    "file_path": format!("./{split}/r_{i:03}"), "rotation": 0.3,
                    "time": i as f64 / 7.0, "transform_matrix": matrix,
                }));
                let focal = 1.388_888_8 * f64::from(side);
                let middle = DVec2::splat(f64::from(side) / 2.0);
                let at = POINTS.map(|point| focal * eye.plane(point) + middle);
                draw(&root.join(format!("{split}/r_{i:03}.png")), &spots(side, side, at));
            }
            let json = json!({ "camera_angle_x": angle, "frames": frames });
            write(&root.join(format!("transforms_{split}.json")), json.to_string());
        }
        let set = Dataset::open(root).unwrap();
        let focal = set.frames[0].camera.intrinsics.fx;
        assert!((focal - 1.388_888_8 * f64::from(side)).abs() < 1e-9, "{focal}");
        assert_eq!(set.split(8).1, [3, 4, 5]);
        assert!(set.timed && (set.frames[4].time - 6.0 / 7.0).abs() < 1e-12);
        all(&set).iter().for_each(|view| shows(view, POINTS));
    }
}

#[test]
fn kinds_are_told_apart() {
    let root = tempfile::tempdir().unwrap();
    let root = root.path();
    let kind = |path: &Path| layout::find(path).unwrap();
    let said = message(layout::find(root));
    let looked_for = [
        "transforms.json",
        "transforms_train.json",
        "scene.json",
        "dataset.json",
        "poses_bounds.npy",
        "sparse/0",
        "camdata_left",
        "reconstruct",
    ];
    says(&said, &looked_for);
    // From the least to the most specific file: the later one takes precedence.
    let here = || root.to_path_buf();
    write(&root.join("poses_bounds.npy"), b"");
    assert_eq!(kind(root), Layout::PosesBounds(here(), None));
    write(&root.join("sparse/0/cameras.txt"), b"");
    assert_eq!(kind(root), Layout::Colmap(here(), root.join("sparse/0")));
    write(&root.join("cam00.mp4"), b"");
    assert_eq!(kind(root), Layout::PosesBounds(here(), None));
    scene_json(root);
    write(&root.join("dataset.json"), b"{}");
    fs::create_dir_all(root.join("camera")).unwrap();
    fs::create_dir_all(root.join("rgb/8x")).unwrap();
    assert_eq!(kind(root), Layout::Nerfies(here(), None));
    assert_eq!(kind(&root.join("rgb/8x")), Layout::Nerfies(here(), Some(root.join("rgb/8x"))));
    write(&root.join("transforms_train.json"), b"");
    assert_eq!(kind(root), Layout::Split(here()));
    let file: PathBuf = root.join("transforms.json");
    write(&file, b"");
    assert_eq!(kind(root), Layout::Transforms(file.clone()));
    assert_eq!(kind(&file), Layout::Transforms(file.clone()));
}

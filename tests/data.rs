//! Readers and writers of what comes from outside, on real sets, on small ones made here, and on
//! damaged ones.

use std::fs;
use std::io::Write;
use std::path::{Path, PathBuf};

use glam::{DQuat, DVec2, DVec3};
use splat4d::data::{
    Clip, ClipOptions, Dataset, Distortion, Resize, colmap, exif, exr, flo, images, intrinsics,
    read_mask, trajectory, transforms, video, write_mask, write_png,
};
use splat4d::eval::psnr;
use splat4d::io::write_atomically;
use splat4d::types::{Camera, Image, Intrinsics, Pose};
use splat4d::{Error, Result};

/// A folder of the shared data; `None`, said loudly, where it is not there.
fn shared(name: &str) -> Option<PathBuf> {
    let root = match std::env::var_os("SPLAT4D_DATA") {
        Some(root) => PathBuf::from(root),
        None => Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data"),
    };
    let path = root.join(name);
    if path.exists() {
        return Some(path);
    }
    eprintln!("SKIPPED (no ../shared/data): {name}");
    None
}

fn message<T>(result: Result<T>) -> String {
    match result {
        Ok(_) => panic!("an error was expected"),
        Err(error) => error.to_string(),
    }
}

#[track_caller]
fn says(message: &str, parts: &[&str]) {
    for part in parts {
        assert!(message.contains(part), "`{part}` is not in: {message}");
    }
}

fn picture(width: u32, height: u32, seed: u32) -> Image {
    let mut image = Image::new(width, height, 3);
    for y in 0..height {
        for x in 0..width {
            let v = |f: f32| {
                0.5 + 0.45 * ((x as f32 + seed as f32) * f).sin() * (y as f32 * 0.7 * f).cos()
            };
            image.at_mut(x, y).copy_from_slice(&[v(0.11), v(0.17), v(0.23)]);
        }
    }
    image
}

/// A small generator for mutations.
struct Dice(u64);

impl Dice {
    fn roll(&mut self, n: usize) -> usize {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963);
        (self.0 >> 33) as usize % n
    }
}

/// Writes damaged copies of a file over `target` and calls `read` on each: prefixes, which must
/// fail if `prefixes_fail`, and copies with a few bytes changed, which only must not panic.
fn damage(original: &[u8], target: &Path, prefixes_fail: bool, read: impl Fn(&Path) -> bool) {
    let mut dice = Dice(7);
    let step = (original.len() / 97).max(1);
    for length in (0..original.len()).step_by(step).chain([original.len() - 1]) {
        fs::write(target, &original[..length]).unwrap();
        let fine = read(target);
        assert!(!(fine && prefixes_fail), "{} read at {length} bytes", target.display());
    }
    for _ in 0..150 {
        let mut bytes = original.to_vec();
        for _ in 0..1 + dice.roll(4) {
            // Headers are short and matter most.
            let within = if dice.roll(2) == 0 { bytes.len().min(256) } else { bytes.len() };
            let at = dice.roll(within);
            bytes[at] = [0, 1, 0x7f, 0x80, 0xff, dice.roll(256) as u8][dice.roll(6)];
        }
        fs::write(target, &bytes).unwrap();
        read(target);
    }
}

// ---------------------------------------------------------------------------------------------
// Real sets
// ---------------------------------------------------------------------------------------------

/// Median over points of the colour difference to the pixel where the camera sees them.
fn colour_error(set: &Dataset, frame: usize, bend: impl Fn(&mut Camera)) -> (f64, usize) {
    let mut view = set.frames[frame].load([1.0; 3], Resize::Keep).unwrap();
    bend(&mut view.camera);
    let mut errors = Vec::new();
    for point in &set.points {
        let p = view.camera.view_from_world.apply(DVec3::from(point.position.map(f64::from)));
        let pixel = view.camera.intrinsics.project(p);
        let inside = pixel.x >= 0.0
            && pixel.y >= 0.0
            && pixel.x < f64::from(view.image.width)
            && pixel.y < f64::from(view.image.height);
        if p.z > 0.0 && inside {
            let seen = view.image.at(pixel.x as u32, pixel.y as u32);
            let error: f32 =
                seen.iter().zip(point.colour).map(|(a, b)| (a - b).abs()).sum::<f32>() / 3.0;
            errors.push(f64::from(error));
        }
    }
    errors.sort_by(f64::total_cmp);
    (errors[errors.len() / 2], errors.len())
}

#[test]
fn fox270_colmap() {
    let Some(path) = shared("fox270") else { return };
    let set = Dataset::open(&path).unwrap();
    let here = fs::read_dir(path.join("images")).unwrap().count();
    assert_eq!(set.frames.len(), here);
    assert_eq!(set.points.len(), 20_000);
    assert!(set.test.is_none() && !set.timed);
    assert_eq!(set.notes.len(), 1, "{:?}", set.notes);
    says(&set.notes[0], &["skipped", "do not exist"]);
    assert!(set.frames.windows(2).all(|w| w[0].name < w[1].name));
    assert!(set.frames.windows(2).all(|w| w[0].time < w[1].time));
    // Poses, intrinsics and points belong together only if every convention is right.
    // One pixel off in any direction fits worse.
    let (error, seen) = colour_error(&set, 5, |_| {});
    assert!(seen > 10_000 && error < 0.09, "{error} over {seen}");
    for (x, y) in [(1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0)] {
        let (moved, _) = colour_error(&set, 5, |camera| {
            camera.intrinsics.cx += x;
            camera.intrinsics.cy += y;
        });
        assert!(error < 0.95 * moved, "{error} and {moved} at {x}, {y}");
    }
    let (train, test) = set.split(8);
    assert_eq!(test, (0..here).step_by(8).collect::<Vec<_>>());
    assert_eq!(train.len() + test.len(), here);
    assert!(set.split(0).1.is_empty());
    let views = set.load(&test[..2], Resize::Width(135)).unwrap();
    assert_eq!((views[1].image.width, views[1].image.height), (135, 240));
    assert_eq!(views[1].camera.intrinsics.fx, set.frames[8].camera.intrinsics.fx / 2.0);
    assert_eq!(views[1].name, set.frames[8].name);
}

#[test]
fn ingp_fox_transforms_and_undistortion() {
    let Some(path) = shared("ingp_fox") else { return };
    let set = Dataset::open(&path).unwrap();
    assert_eq!(set.frames.len(), 43);
    assert_eq!(set.notes.len(), 1);
    says(&set.notes[0], &["skipped 24 of 67"]);
    let frame = &set.frames[4];
    assert_eq!(frame.distortion.radial, [0.0578421, -0.0805099, 0.0, 0.0]);
    let view = frame.load(set.background, Resize::Longest(480)).unwrap();
    assert_eq!((view.image.width, view.image.height), (270, 480));
    assert_eq!(view.camera.intrinsics.fx, 1375.52 / 4.0);
    // The same photos, undistorted by another program: where both have the frame, resample ours to
    // that program's pinhole and compare.
    let Some(other) = shared("fox270") else { return };
    let other = Dataset::open(&other).unwrap();
    let stem = |name: &str| Path::new(name).file_stem().unwrap().to_owned();
    let (ours, theirs) = set
        .frames
        .iter()
        .find_map(|f| Some((f, other.frames.iter().find(|o| stem(&o.name) == stem(&f.name))?)))
        .unwrap();
    let ours = ours.load(set.background, Resize::Longest(480)).unwrap();
    let theirs = theirs.load(set.background, Resize::Keep).unwrap();
    let (k, target) = (ours.camera.intrinsics, theirs.camera.intrinsics);
    let mut moved = theirs.image.clone();
    let mut valid = Image::new(270, 480, 1);
    for y in 0..480 {
        for x in 0..270 {
            let ray = target.ray(DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5));
            let at = k.project(ray) - DVec2::splat(0.5);
            let (x0, y0) = (at.x.floor(), at.y.floor());
            if x0 < 1.0 || y0 < 1.0 || x0 > 267.0 || y0 > 477.0 {
                continue;
            }
            let (fx, fy) = ((at.x - x0) as f32, (at.y - y0) as f32);
            let (x0, y0) = (x0 as u32, y0 as u32);
            for c in 0..3 {
                let p = |dx, dy| ours.image.at(x0 + dx, y0 + dy)[c];
                let upper = p(0, 0) * (1.0 - fx) + p(1, 0) * fx;
                let lower = p(0, 1) * (1.0 - fx) + p(1, 1) * fx;
                moved.at_mut(x, y)[c] = upper * (1.0 - fy) + lower * fy;
            }
            valid.at_mut(x, y)[0] = 1.0;
        }
    }
    let value = splat4d::eval::masked_psnr(&moved, &theirs.image, &valid).unwrap();
    assert!(value > 30.0, "{value} dB");
}

#[test]
fn standup_dnerf() {
    let Some(path) = shared("dnerf_400/standup") else { return };
    let set = Dataset::open(&path).unwrap();
    assert_eq!(set.frames.len(), 170);
    assert!(set.timed && set.notes.is_empty(), "{:?}", set.notes);
    let (train, test) = set.split(8);
    assert_eq!((train.len(), test.len()), (150, 20));
    assert_eq!(test, (150..170).collect::<Vec<_>>());
    let k = set.frames[0].camera.intrinsics;
    assert!((k.fx - 555.5555).abs() < 1e-3 && k.fx == k.fy && k.cx == 200.0, "{k:?}");
    assert_eq!((set.frames[0].time, set.frames[149].time), (0.0, 1.0));
    let view = set.frames[0].load(set.background, Resize::To(200, 200)).unwrap();
    assert_eq!(view.image.at(0, 0), [1.0, 1.0, 1.0]);
    assert!(view.image.pixels.iter().any(|&v| v < 0.2));
    assert!((view.camera.intrinsics.fx - 277.7778).abs() < 1e-3);
    // The figure stands around the origin, which therefore is before the camera and in the middle;
    // the world's z points up: a higher point is higher in the picture (smaller y).
    let camera = set.frames[150].camera;
    let origin = camera.view_from_world.apply(DVec3::ZERO);
    assert!((origin.z - 4.03).abs() < 0.1, "{origin}");
    let pixel = camera.intrinsics.project(origin);
    assert!((pixel - DVec2::splat(200.0)).length() < 20.0, "{pixel}");
    let above = camera.view_from_world.apply(DVec3::Z);
    assert!(camera.intrinsics.project(above).y < pixel.y - 40.0);
}

#[test]
fn balloon1_times_and_shared_split() {
    let Some(path) = shared("nvidia_balloon1") else { return };
    let set = Dataset::open(&path).unwrap();
    assert_eq!(set.frames.len(), 12);
    assert!(set.timed && set.test.is_none());
    says(&set.notes[0], &["12 of 12 test images are training images"]);
    assert!((set.frames[11].time - 0.055).abs() < 1e-12);
    let view = set.frames[0].load(set.background, Resize::Longest(480)).unwrap();
    assert_eq!((view.image.width, view.image.height), (480, 270));
    // k1 < 0 draws the picture inwards: a pinhole of the same focal length loses its corners'
    // surroundings and every pixel has a source.
    assert!(view.valid.is_none());
    assert!((view.camera.intrinsics.fx - 920.684_284_9 / 2.0).abs() < 1e-6);
}

#[test]
fn a_file_of_the_set_can_be_named() {
    let Some(path) = shared("nvidia_balloon1/transforms_train.json") else { return };
    assert_eq!(Dataset::open(path).unwrap().frames.len(), 12);
}

#[test]
fn damaged_colmap_files_fail_cleanly() {
    let Some(path) = shared("fox270") else { return };
    let folder = tempfile::tempdir().unwrap();
    let names = ["cameras.bin", "images.bin", "points3D.bin"];
    for name in names {
        fs::copy(path.join("sparse/0").join(name), folder.path().join(name)).unwrap();
    }
    assert!(colmap::read_model(folder.path()).is_ok());
    for name in names {
        let file = folder.path().join(name);
        let original = fs::read(&file).unwrap();
        damage(&original, &file, true, |_| colmap::read_model(folder.path()).is_ok());
        fs::write(&file, &original).unwrap();
    }
}

// ---------------------------------------------------------------------------------------------
// Made here: COLMAP
// ---------------------------------------------------------------------------------------------

/// (id, model's number, model's name, parameters) for every supported model.
fn lenses() -> Vec<(u32, i32, &'static str, Vec<f64>)> {
    vec![
        (1, 0, "SIMPLE_PINHOLE", vec![50.0, 20.0, 15.0]),
        (2, 1, "PINHOLE", vec![50.0, 51.0, 20.0, 15.0]),
        (3, 2, "SIMPLE_RADIAL", vec![50.0, 20.0, 15.0, 0.1]),
        (4, 3, "RADIAL", vec![50.0, 20.0, 15.0, 0.1, -0.02]),
        (7, 4, "OPENCV", vec![50.0, 51.0, 20.0, 15.0, 0.1, -0.02, 0.003, -0.004]),
    ]
}

fn write_colmap(folder: &Path, binary: bool) {
    let (mut cameras, mut images, mut points) = (Vec::new(), Vec::new(), Vec::new());
    if binary {
        cameras.extend(5u64.to_le_bytes());
        for (id, model, _, parameters) in lenses() {
            cameras.extend(id.to_le_bytes());
            cameras.extend(model.to_le_bytes());
            cameras.extend(40u64.to_le_bytes());
            cameras.extend(30u64.to_le_bytes());
            parameters.iter().for_each(|p| cameras.extend(p.to_le_bytes()));
        }
        images.extend(6u64.to_le_bytes());
        for (i, camera) in [7u32, 1, 2, 3, 4, 1].into_iter().enumerate() {
            images.extend((i as u32 + 1).to_le_bytes());
            for v in [0.5, 0.5, -0.5, 0.5, 1.0, 2.0, i as f64] {
                images.extend(f64::to_le_bytes(v));
            }
            images.extend(camera.to_le_bytes());
            images.extend(format!("im {}.png\0", 12 - i).bytes());
            images.extend(1u64.to_le_bytes());
            images.extend([0; 24]);
        }
        points.extend(1u64.to_le_bytes());
        points.extend(9u64.to_le_bytes());
        for v in [1.0, 2.0, 3.0] {
            points.extend(f64::to_le_bytes(v));
        }
        points.extend([255, 0, 51]);
        points.extend(0.5f64.to_le_bytes());
        points.extend(1u64.to_le_bytes());
        points.extend([0; 8]);
    } else {
        writeln!(cameras, "# Camera list with one line of data per camera:").unwrap();
        for (id, _, name, parameters) in lenses() {
            write!(cameras, "{id} {name} 40 30").unwrap();
            parameters.iter().for_each(|p| write!(cameras, " {p}").unwrap());
            writeln!(cameras).unwrap();
        }
        writeln!(images, "# Image list\n# with comments").unwrap();
        for (i, camera) in [7, 1, 2, 3, 4, 1].into_iter().enumerate() {
            let n = i + 1;
            writeln!(images, "{n} 0.5 0.5 -0.5 0.5 1 2 {i} {camera} im {}.png", 12 - i).unwrap();
            // Without observations the second line is there and empty.
            writeln!(images, "{}", if i % 2 == 0 { "" } else { "1.5 2.5 -1" }).unwrap();
        }
        writeln!(points, "# 3D point list\n9 1 2 3 255 0 51 0.5 1 0").unwrap();
    }
    let ending = if binary { "bin" } else { "txt" };
    fs::create_dir_all(folder).unwrap();
    for (stem, bytes) in [("cameras", cameras), ("images", images), ("points3D", points)] {
        fs::write(folder.join(format!("{stem}.{ending}")), bytes).unwrap();
    }
}

#[test]
fn colmap_text_and_binary_agree() {
    let root = tempfile::tempdir().unwrap();
    let (text, binary) = (root.path().join("t"), root.path().join("b"));
    write_colmap(&text, false);
    write_colmap(&binary, true);
    let (t, b) = (colmap::read_model(&text).unwrap(), colmap::read_model(&binary).unwrap());
    assert_eq!((&t.lenses, &t.images, &t.points), (&b.lenses, &b.images, &b.points));
    assert_eq!(b.lenses.len(), 5);
    let opencv = b.lenses[&7];
    assert_eq!((opencv.intrinsics.fx, opencv.intrinsics.fy), (50.0, 51.0));
    assert_eq!(opencv.distortion.radial, [0.1, -0.02, 0.0, 0.0]);
    assert_eq!(opencv.distortion.tangential, [0.003, -0.004]);
    assert_eq!(b.images[0].name, "im 12.png");
    let pose = b.images[1].view_from_world;
    assert_eq!(pose.rotation, DQuat::from_xyzw(0.5, -0.5, 0.5, 0.5));
    assert_eq!(pose.translation, DVec3::new(1.0, 2.0, 1.0));
    assert_eq!(b.points[0].colour, [1.0, 0.0, 0.2]);
}

#[test]
fn colmap_in_the_folder_itself_and_at_half_size() {
    let root = tempfile::tempdir().unwrap();
    write_colmap(root.path(), false);
    for i in [8, 10, 12] {
        write_png(root.path().join(format!("im {i}.png")), &picture(20, 15, i)).unwrap();
    }
    let set = Dataset::open(root.path()).unwrap();
    // Natural order, and half the size that the cameras were calibrated at.
    let names: Vec<_> = set.frames.iter().map(|f| f.name.as_str()).collect();
    assert_eq!(names, ["im 8.png", "im 10.png", "im 12.png"]);
    assert_eq!(set.frames[1].camera.intrinsics.cx, 10.0);
    says(&set.notes[0], &["skipped 3 of 6"]);
    assert_eq!(set.load(&[0, 1, 2], Resize::Keep).unwrap().len(), 3);

    write_png(root.path().join("im 7.png"), &picture(30, 15, 0)).unwrap();
    says(&message(Dataset::open(root.path())), &["im 7.png", "30×15", "40×30"]);
    fs::write(root.path().join("im 7.png"), b"no picture").unwrap();
    says(&message(Dataset::open(root.path())), &["im 7.png", "cannot be read as an image"]);

    let text = "1 FULL_OPENCV 40 30 50 51 20 15 0 0 0 0 0 0 0 0\n";
    fs::write(root.path().join("cameras.txt"), text).unwrap();
    says(&message(Dataset::open(root.path())), &["camera 1", "FULL_OPENCV", "image_undistorter"]);
}

#[test]
fn folders_of_no_known_kind_are_named() {
    let root = tempfile::tempdir().unwrap();
    says(&message(Dataset::open(root.path())), &["transforms.json", "COLMAP", "reconstruct"]);
    let absent = root.path().join("absent");
    assert!(matches!(Dataset::open(absent), Err(Error::Io { .. })));
    let film = root.path().join("film.mp4");
    fs::write(&film, b"x").unwrap();
    says(&message(Dataset::open(film)), &["film.mp4", "reconstruct"]);
}

// ---------------------------------------------------------------------------------------------
// Made here: transforms.json, distortion
// ---------------------------------------------------------------------------------------------

fn some_camera(i: u32) -> Camera {
    let rotation = DQuat::from_euler(glam::EulerRot::YXZ, 0.3 * f64::from(i), -0.2, 0.1);
    Camera {
        intrinsics: Intrinsics { fx: 55.0, fy: 54.0, cx: 19.5, cy: 16.0, width: 40, height: 30 },
        view_from_world: Pose::new(rotation, DVec3::new(1.0, -2.0, 3.0 + f64::from(i))),
    }
}

#[test]
fn transforms_round_trip() {
    let root = tempfile::tempdir().unwrap();
    let file = root.path().join("transforms.json");
    let time = |i: u32| f64::from(i) / 4.0;
    let cameras: Vec<_> =
        (0..5).map(|i| transforms::TimedCamera { time: time(i), camera: some_camera(i) }).collect();
    let files: Vec<_> = (0..5).map(|i| format!("images/{i:03}.png")).collect();
    transforms::write(&file, &cameras, &files).unwrap();
    assert!(transforms::write(&file, &cameras, &files[1..]).is_err());
    for (a, b) in transforms::read_cameras(&file).unwrap().iter().zip(&cameras) {
        assert_eq!((a.time, a.camera.intrinsics), (b.time, b.camera.intrinsics));
        let (p, q) = (a.camera.view_from_world, b.camera.view_from_world);
        assert!((p.translation - q.translation).length() < 1e-12);
        assert!(p.rotation.dot(q.rotation).abs() > 1.0 - 1e-12);
    }
    says(&message(Dataset::open(root.path())), &["none of the images"]);
    for name in &files[1..] {
        write_png(root.path().join(name), &picture(40, 30, 1)).unwrap();
    }
    let set = Dataset::open(root.path()).unwrap();
    assert_eq!(set.frames.iter().map(|f| f.time).collect::<Vec<_>>(), [0.25, 0.5, 0.75, 1.0]);
    says(&set.notes[0], &["skipped 1 of 5"]);
}

const IDENTITY: &str = "[[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]";

/// Opens a `transforms.json` of a text beside a picture `a.jpg` of 40×30.
fn transforms_of(text: &str) -> Result<Dataset> {
    let root = tempfile::tempdir().unwrap();
    write_png(root.path().join("a.png"), &picture(40, 30, 1)).unwrap();
    write_png(root.path().join("b.png"), &picture(40, 30, 2)).unwrap();
    let cloud = "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\n\
        property float z\nproperty uchar red\nproperty uchar green\nproperty uchar blue\n\
        end_header\n1 2 3 255 0 51\nnan 0 0 0 0 0\n";
    fs::write(root.path().join("cloud.ply"), cloud).unwrap();
    fs::write(root.path().join("transforms.json"), text.replace("IDENTITY", IDENTITY)).unwrap();
    Dataset::open(root.path())
}

#[test]
fn transforms_fields() {
    // From OpenGL's axes to OpenCV's: the identity looks along −z with y up.
    let set = transforms_of(
        r#"{"camera_angle_x": 0.8, "k1": 0.1, "ply_file_path": "cloud.ply", "frames": [
            {"file_path": "./a", "transform_matrix": IDENTITY},
            {"file_path": "b.png", "transform_matrix": [[2,0,0,5],[0,2,0,6],[0,0,2,7]],
             "fl_x": 77, "fl_y": 78, "cx": 1, "cy": 2, "k1": 0, "w": 80, "h": 60}]}"#,
    )
    .unwrap();
    let [a, b] = [&set.frames[0], &set.frames[1]];
    assert!((a.camera.intrinsics.fx - 20.0 / 0.4f64.tan()).abs() < 1e-12);
    assert_eq!(a.camera.intrinsics.fx, a.camera.intrinsics.fy);
    assert_eq!((a.camera.intrinsics.cx, a.distortion.radial[0]), (20.0, 0.1));
    let seen = a.camera.view_from_world.apply(DVec3::new(1.0, 2.0, -3.0));
    assert!((seen - DVec3::new(1.0, -2.0, 3.0)).length() < 1e-12);
    // The frame's own fields win; its picture has half the size that they are of.
    assert_eq!((b.camera.intrinsics.fx, b.camera.intrinsics.fy), (38.5, 39.0));
    assert!(b.distortion.is_none());
    assert!((b.camera.centre() - DVec3::new(5.0, 6.0, 7.0)).length() < 1e-12);
    assert_eq!(set.points.len(), 1);
    let colour = set.points[0].colour;
    assert!(colour.iter().zip([1.0, 0.0, 0.2]).all(|(a, b)| (a - b).abs() < 1e-6), "{colour:?}");
    assert!(!set.timed);
    assert_eq!((a.time, b.time), (0.0, 1.0));
}

#[test]
fn transforms_times_beyond_one_are_mapped() {
    let set = transforms_of(
        r#"{"fl_x": 50, "frames": [
            {"file_path": "a.png", "time": 10, "transform_matrix": IDENTITY},
            {"file_path": "b.png", "time": 30, "transform_matrix": IDENTITY}]}"#,
    )
    .unwrap();
    assert_eq!((set.frames[0].time, set.frames[1].time), (0.0, 1.0));
    says(&set.notes[0], &["times from 10 to 30"]);
}

#[test]
fn bad_transforms_are_told() {
    let one = |top: &str, frame: &str| {
        format!(
            r#"{{{top} "frames": [{{"file_path": "a.png", "transform_matrix": IDENTITY {frame}}}]}}"#
        )
    };
    let cases = [
        ("{".to_string(), vec!["not valid JSON", "line 1"]),
        ("[]".into(), vec!["not an object"]),
        (r#"{"fl_x": 5}"#.into(), vec!["frames"]),
        (one("", ""), vec!["a.png", "fl_x", "camera_angle_x"]),
        (one(r#""fl_x": "wide","#, ""), vec!["fl_x", "not a number"]),
        (one(r#""fl_x": -5,"#, ""), vec!["focal", "make no sense"]),
        (one(r#""fl_x": 5, "is_fisheye": true,"#, ""), vec!["fisheye", "undistort"]),
        (one(r#""fl_x": 5, "camera_model": "EQUIRECTANGULAR","#, ""), vec!["EQUIRECTANGULAR"]),
        (one(r#""fl_x": 5, "w": 0,"#, ""), vec!["`w` = 0"]),
        (one(r#""fl_x": 5, "w": 1e300,"#, ""), vec!["`w` = "]),
        (one(r#""fl_x": 5,"#, r#", "time": "noon""#), vec!["frame 0", "time"]),
        (
            one(r#""fl_x": 5,"#, "").replace("IDENTITY", "[[1,0,0,0],[0,3,0,0],[0,0,1,0]]"),
            vec!["frame 0 (a.png)", "not a rigid transform"],
        ),
        (one(r#""fl_x": 5,"#, "").replace("IDENTITY", "[[1,0]]"), vec!["transform_matrix"]),
        (
            r#"{"fl_x": 50, "frames": [
                {"file_path": "a.png", "time": 0, "transform_matrix": IDENTITY},
                {"file_path": "b.png", "transform_matrix": IDENTITY}]}"#
                .into(),
            vec!["frame 1 has no `time`"],
        ),
        (r#"{"fl_x": 5, "frames": []}"#.into(), vec!["none of the images"]),
    ];
    for (text, parts) in cases {
        let mut all = vec!["transforms.json"];
        all.extend(parts);
        says(&message(transforms_of(&text)), &all);
    }
}

#[test]
fn damaged_transforms_do_not_panic() {
    let Some(path) = shared("ingp_fox/transforms.json") else { return };
    let folder = tempfile::tempdir().unwrap();
    let original = fs::read(path).unwrap();
    let original = &original[..original.len().min(6_000)];
    damage(original, &folder.path().join("transforms.json"), true, |path| {
        transforms::read_cameras(path).is_ok()
    });
}

#[test]
fn undistortion_undoes_the_lens() {
    // A picture that is a smooth function of the direction, as a bent lens sees it.
    let k = Intrinsics { fx: 90.0, fy: 95.0, cx: 62.0, cy: 45.0, width: 120, height: 90 };
    let lens = Distortion { radial: [0.08, -0.03, 0.01, 0.0], tangential: [0.004, -0.003] };
    let colour = |d: DVec2| (0.5 + 0.4 * (6.0 * d.x).sin() * (5.0 * d.y).cos()) as f32;
    let mut bent = Image::new(120, 90, 1);
    let mut straight = bent.clone();
    for y in 0..90 {
        for x in 0..120 {
            let d = k.ray(DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5)).truncate();
            straight.at_mut(x, y)[0] = colour(d);
            // The direction that the lens brings to this pixel, by fixed-point iteration.
            let mut u = d;
            for _ in 0..60 {
                u += d - lens.distort(u);
            }
            assert!((lens.distort(u) - d).length() < 1e-10);
            bent.at_mut(x, y)[0] = colour(u);
        }
    }
    let (found, valid) = lens.undistort(&bent, &k);
    let valid = valid.expect("k1 > 0 pushes corners out of the picture");
    assert_eq!(valid.at(60, 45), [1.0]);
    assert_eq!(valid.at(0, 0), [0.0]);
    let mut worst = 0.0f32;
    for (i, _) in valid.pixels.iter().enumerate().filter(|(_, v)| **v == 1.0) {
        let (x, y) = (i as u32 % 120, i as u32 / 120);
        let d = k.ray(DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5)).truncate();
        let source = k.project(lens.distort(d).extend(1.0));
        // The outermost half pixel of the source repeats its edge.
        let inner = |v: f64, side: f64| v > 0.5 && v < side - 0.5;
        if inner(source.x, 120.0) && inner(source.y, 90.0) {
            worst = worst.max((found.pixels[i] - straight.pixels[i]).abs());
        }
    }
    // Bilinear sampling errs by h²/8 · |f''|, here (1/90)²/8 · 0.4 · (6² + 5²) ≈ 3.8e-4.
    assert!(worst < 5e-4, "{worst}");
    // Beyond the fold of a strong negative polynomial nothing is real.
    let fold = Distortion { radial: [-1.5, 0.0, 0.0, 0.0], tangential: [0.0; 2] };
    let (_, valid) = fold.undistort(&bent, &k);
    assert_eq!(valid.unwrap().at(119, 89), [0.0]);
}

// ---------------------------------------------------------------------------------------------
// Clips
// ---------------------------------------------------------------------------------------------

#[test]
fn clip_of_a_folder() {
    let root = tempfile::tempdir().unwrap();
    let options = ClipOptions::default();
    assert!(matches!(Clip::open(root.path().join("no"), &options), Err(Error::Io { .. })));
    says(&message(Clip::open(root.path(), &options)), &["holds no images"]);
    let frames = root.path().join("frames");
    write_png(frames.join("f10.png"), &picture(40, 30, 10)).unwrap();
    fs::write(frames.join("readme.txt"), "no picture").unwrap();
    says(&message(Clip::open(root.path(), &options)), &["one frame only"]);
    says(&message(Clip::open(frames.join("f10.png"), &options)), &["one frame only"]);
    for i in [2, 9, 11] {
        write_png(frames.join(format!("f{i}.png")), &picture(40, 30, i)).unwrap();
    }
    let names = |clip: &Clip| clip.frames.iter().map(|f| f.name.clone()).collect::<Vec<_>>();
    let clip = Clip::open(root.path(), &options).unwrap();
    assert_eq!(names(&clip), ["f2", "f9", "f10", "f11"]);
    assert_eq!((clip.width, clip.height, clip.focal), (40, 30, None));
    assert_eq!(clip.frames[3].time, 1.0);
    let exact = psnr(&clip.frames[0].image, &picture(40, 30, 2)).unwrap();
    assert!(exact > 50.0, "{exact}");
    let some = ClipOptions { every: 2, size: Resize::Width(20), ..options };
    let clip = Clip::open(&frames, &some).unwrap();
    assert_eq!((names(&clip).join(" "), clip.height), ("f2 f10".into(), 15));
    let two = ClipOptions { max_frames: Some(2), ..options };
    assert_eq!(names(&Clip::open(&frames, &two).unwrap()), ["f2", "f9"]);
    says(&message(Clip::open(&frames, &ClipOptions { every: 9, ..options })), &["one frame only"]);
    assert!(Clip::open(&frames, &ClipOptions { every: 0, ..options }).is_err());

    fs::write(frames.join("f3.png"), b"\x89PNG\r\n\x1a\nbroken").unwrap();
    says(&message(Clip::open(&frames, &options)), &["f3.png", "--skip-bad"]);
    let clip = Clip::open(&frames, &ClipOptions { skip_bad: true, ..options }).unwrap();
    assert_eq!(clip.frames.len(), 4);
    says(&clip.notes[0], &["skipped 1 of 5", "f3.png"]);

    write_png(frames.join("f3.png"), &picture(40, 31, 3)).unwrap();
    says(&message(Clip::open(&frames, &options)), &["f3.png", "40×31", "f2.png", "40×30"]);
}

#[test]
fn clip_of_a_video() {
    let Some(path) = shared("cotracker_videos/apple.mp4") else { return };
    let options = ClipOptions { every: 10, size: Resize::Width(324), ..ClipOptions::default() };
    let none = std::ffi::OsStr::new("no-such-program");
    let text = message(video::decode_with(none, none, &path, &options));
    says(&text, &["apple.mp4", "ffmpeg", "apt-get install ffmpeg", "extract the frames"]);
    if std::process::Command::new("ffmpeg").arg("-version").output().is_err() {
        eprintln!("SKIPPED (no ffmpeg): decoding a video");
        return;
    }
    let clip = Clip::open(&path, &options).unwrap();
    assert_eq!((clip.frames.len(), clip.width, clip.height), (5, 324, 180));
    assert_eq!(clip.frames[1].name, "00010");
    assert!(clip.rate.is_some_and(|rate| rate > 0.5 && rate < 10.0), "{:?}", clip.rate);
    assert!(clip.frames.iter().all(|f| f.image.pixels.iter().any(|&v| v > 0.3)));
    let three = ClipOptions { max_frames: Some(3), ..options };
    assert_eq!(Clip::open(&path, &three).unwrap().frames.len(), 3);
    let folder = tempfile::tempdir().unwrap();
    let broken = folder.path().join("broken.mp4");
    fs::write(&broken, b"no video").unwrap();
    says(&message(Clip::open(&broken, &options)), &["broken.mp4", "ffmpeg cannot read"]);
}

#[test]
fn exif_focal_length() {
    use ::exif::experimental::Writer;
    use ::exif::{Field, In, Rational, Tag, Value};
    let folder = tempfile::tempdir().unwrap();
    let with = |name: &str, fields: &[Field]| {
        let mut jpeg = std::io::Cursor::new(Vec::new());
        let grey = ::image::RgbImage::new(400, 300);
        grey.write_to(&mut jpeg, ::image::ImageFormat::Jpeg).unwrap();
        let mut tiff = std::io::Cursor::new(Vec::new());
        let mut writer = Writer::new();
        fields.iter().for_each(|f| writer.push_field(f));
        writer.write(&mut tiff, false).unwrap();
        let (jpeg, tiff) = (jpeg.into_inner(), tiff.into_inner());
        let mut file = jpeg[..2].to_vec();
        file.extend([0xff, 0xe1]);
        file.extend((tiff.len() as u16 + 8).to_be_bytes());
        file.extend(b"Exif\0\0");
        file.extend(tiff);
        file.extend(&jpeg[2..]);
        let path = folder.path().join(name);
        fs::write(&path, file).unwrap();
        path
    };
    let field = |tag, value| Field { tag, ifd_num: In::PRIMARY, value };
    let ratio = |num, denom| Value::Rational(vec![Rational { num, denom }]);
    let film = with("film.jpg", &[field(Tag::FocalLengthIn35mmFilm, Value::Short(vec![26]))]);
    // The diagonal is 500 pixels here and 43.27 mm there.
    let focal = exif::focal(&film, 400, 300).unwrap();
    assert!((focal - 26.0 / 43.2666 * 500.0).abs() < 0.01, "{focal}");
    let sensor = with(
        "sensor.jpg",
        &[
            field(Tag::FocalLength, ratio(50, 10)),
            field(Tag::FocalPlaneXResolution, ratio(5080, 1)),
            field(Tag::FocalPlaneResolutionUnit, Value::Short(vec![2])),
            field(Tag::PixelXDimension, Value::Long(vec![800])),
        ],
    );
    // 5 mm at 200 pixels a millimetre, of a picture twice as wide.
    assert_eq!(exif::focal(&sensor, 400, 300), Some(500.0));
    let zero = with("zero.jpg", &[field(Tag::FocalLength, ratio(1, 0))]);
    assert_eq!(exif::focal(&zero, 400, 300), None);
    assert_eq!(exif::focal(&folder.path().join("absent.jpg"), 400, 300), None);

    fs::remove_file(sensor).unwrap();
    fs::remove_file(&zero).unwrap();
    fs::copy(&film, folder.path().join("second.jpg")).unwrap();
    let half = ClipOptions { size: Resize::Width(200), ..ClipOptions::default() };
    let clip = Clip::open(folder.path(), &half).unwrap();
    assert!((clip.focal.unwrap() - focal / 2.0).abs() < 1e-9);

    // A picture held upright: EXIF turns it, and the clip shows it so.
    let turned = tempfile::tempdir().unwrap();
    for name in ["1.jpg", "2.jpg"] {
        let path = with(name, &[field(Tag::Orientation, Value::Short(vec![6]))]);
        fs::rename(&path, turned.path().join(name)).unwrap();
    }
    let clip = Clip::open(turned.path(), &ClipOptions::default()).unwrap();
    assert_eq!((clip.width, clip.height), (300, 400));
}

// ---------------------------------------------------------------------------------------------
// Small files
// ---------------------------------------------------------------------------------------------

#[test]
fn natural_order() {
    let mut names = ["b1", "a10", "a2", "a02", "a", "a2b", "a1x2"];
    names.sort_by(|a, b| images::natural(a, b));
    assert_eq!(names, ["a", "a1x2", "a02", "a2", "a2b", "a10", "b1"]);
}

#[test]
fn sizes() {
    assert_eq!(Resize::Longest(100).target(400, 300), (100, 75));
    assert_eq!(Resize::Longest(500).target(400, 300), (400, 300));
    assert_eq!(Resize::Width(200).target(400, 301), (200, 151));
    assert_eq!(Resize::Width(1).target(4000, 3), (1, 1));
    assert_eq!(Resize::To(0, 7).target(4, 3), (1, 7));
    // Halving keeps means: each result is an average, so a flat image stays flat.
    let mut flat = Image::new(64, 48, 3);
    flat.pixels.fill(0.37);
    let half = images::resize(&flat, 32, 24);
    assert!(half.pixels.iter().all(|v| (v - 0.37).abs() < 1e-5));
}

#[test]
fn alpha_lies_over_the_background() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.png");
    let pixels = vec![1.0, 0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.2];
    write_png(&path, &Image { width: 3, height: 1, channels: 4, pixels }).unwrap();
    let image = images::decode_rgb(&path, [0.0, 0.5, 1.0], images::Orientation::Stored).unwrap();
    assert_eq!(image.at(0, 0), [1.0, 0.0, 0.0]);
    assert_eq!(image.at(1, 0), [0.0, 0.5, 1.0]);
    let third = image.at(2, 0);
    assert!(third.iter().zip([0.0, 0.6, 0.8]).all(|(a, b)| (a - b).abs() < 1e-6), "{third:?}");
}

#[test]
fn png_and_masks() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.png");
    let values = [0.0, 1.0, 0.5, -3.0, 7.0, f32::NAN];
    let image = Image { width: 2, height: 1, channels: 3, pixels: values.to_vec() };
    write_png(&path, &image).unwrap();
    let back = images::decode_rgb(&path, [0.0; 3], images::Orientation::Stored).unwrap();
    assert_eq!(back.pixels, [0.0, 1.0, 128.0 / 255.0, 0.0, 1.0, 0.0]);
    let mask = Image { width: 3, height: 1, channels: 1, pixels: vec![1.0, 0.0, 0.7] };
    write_mask(&path, &mask).unwrap();
    assert_eq!(read_mask(&path).unwrap().pixels, [1.0, 0.0, 1.0]);
    assert!(write_png(&path, &Image::new(2, 2, 2)).is_err());
    let Some(path) = shared("davis16_camel/Annotations/480p/camel/00000.png") else { return };
    let mask = read_mask(path).unwrap();
    let share = mask.pixels.iter().sum::<f32>() / mask.pixels.len() as f32;
    assert!((mask.width, mask.height) == (854, 480) && (0.05..0.5).contains(&share), "{share}");
}

#[test]
fn trajectories() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("poses.txt");
    let poses: Vec<_> = (0..4)
        .map(|i| trajectory::TimedPose {
            time: 1.0 / 3.0 + f64::from(i),
            world_from_view: some_camera(i).view_from_world,
        })
        .collect();
    trajectory::write(&path, &poses).unwrap();
    for (a, b) in trajectory::read(&path, None).unwrap().iter().zip(&poses) {
        assert_eq!(
            (a.time, a.world_from_view.translation),
            (b.time, b.world_from_view.translation)
        );
        assert!(a.world_from_view.rotation.dot(b.world_from_view.rotation) > 1.0 - 1e-14);
    }
    let read = |text: &str, order| {
        fs::write(&path, text).unwrap();
        trajectory::read(&path, order)
    };
    let half = std::f64::consts::FRAC_1_SQRT_2;
    let turn_z = DQuat::from_rotation_z(std::f64::consts::FRAC_PI_2);
    let second = |r: Result<Vec<trajectory::TimedPose>>| r.unwrap()[1].world_from_view.rotation;
    // (w, x, y, z), told by the identity at the start, by a comment, by the caller.
    let text = format!("0 0 0 0 1 0 0 0\n1 0 0 0 {half} 0 0 {half}\n");
    assert!(second(read(&text, None)).dot(turn_z) > 1.0 - 1e-12);
    let text = format!("# t x y z qw qx qy qz\n0 0 0 0 0 1 0 0\n1,0,0,0,{half},0,0,{half}\n");
    assert!(second(read(&text, None)).dot(turn_z) > 1.0 - 1e-12);
    let text = format!("0 0 0 0 0 0 0 1\n1 0 0 0 0 0 {half} {half}\n");
    assert!(second(read(&text, None)).dot(turn_z) > 1.0 - 1e-12);
    let order = Some(trajectory::QuaternionOrder::Wxyz);
    assert!(second(read(&text, order)).dot(turn_z) < 0.9);
    // Seven columns, and KITTI's twelve.
    let seven = read("1 2 3 0 0 0 1\n4 5 6 0 0 0 1\n", None).unwrap();
    assert_eq!((seven[1].time, seven[1].world_from_view.translation.y), (1.0, 5.0));
    let kitti = read("0 -1 0 7 1 0 0 8 0 0 1 9\n", None).unwrap();
    assert!(kitti[0].world_from_view.rotation.dot(turn_z) > 1.0 - 1e-12);
    assert_eq!(kitti[0].world_from_view.translation, DVec3::new(7.0, 8.0, 9.0));
    for bad in [
        "",
        "# only words\n",
        "1 2 3\n",
        "0 0 0 0 0 0 0 x\n",
        "0 0 0 0 0 0 0 0\n",
        "0 0 0 nan 0 0 0 1\n",
        "0 0 0 0 0 0 0 1\n1 2\n",
    ] {
        says(&message(read(bad, None)), &["poses.txt"]);
    }
    let Some(real) = shared("evo_traj/freiburg1_xyz-groundtruth.txt") else { return };
    let real = trajectory::read(real, None).unwrap();
    assert!(real.len() > 1000 && real.windows(2).all(|w| w[0].time < w[1].time));
}

#[test]
fn flow_files() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.flo");
    let mut flow = Image::new(5, 3, 2);
    flow.pixels.iter_mut().enumerate().for_each(|(i, v)| *v = i as f32 * 0.7 - 3.0);
    flo::write(&path, &flow).unwrap();
    assert_eq!(flo::read(&path).unwrap(), flow);
    assert!(flo::write(&path, &Image::new(5, 3, 3)).is_err());
    let original = fs::read(&path).unwrap();
    assert_eq!(&original[..4], b"PIEH");
    damage(&original, &path, true, |path| flo::read(path).is_ok());
}

#[test]
fn exr_files() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.exr");
    let mut depth = Image::new(7, 5, 1);
    depth.pixels.iter_mut().enumerate().for_each(|(i, v)| *v = 0.1 + i as f32 * 1e3);
    depth.pixels[3] = f32::INFINITY;
    exr::write_depth(&path, &depth).unwrap();
    assert_eq!(exr::read_depth(&path).unwrap(), depth);
    says(&message(exr::read_rgba(&path)), &["no channels R, G, B", "Z"]);
    let mut colour = Image::new(6, 4, 4);
    colour.pixels.iter_mut().enumerate().for_each(|(i, v)| *v = i as f32 * 0.01 - 0.2);
    exr::write_rgba(&path, &colour).unwrap();
    assert_eq!(exr::read_rgba(&path).unwrap(), colour);
    assert!(exr::write_depth(&path, &colour).is_err());
    fs::write(&path, b"no exr").unwrap();
    says(&message(exr::read_depth(&path)), &["a.exr", "not a readable EXR"]);
    exr::write_depth(&path, &depth).unwrap();
    let original = fs::read(&path).unwrap();
    damage(&original, &path, true, |path| exr::read_depth(path).is_ok());
}

#[test]
fn intrinsics_files() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("k.json");
    let k = some_camera(0).intrinsics;
    intrinsics::write(&path, &k).unwrap();
    assert_eq!(intrinsics::read(&path).unwrap(), k);
    fs::write(&path, r#"{"focal": 50, "w": 40, "h": 30}"#).unwrap();
    assert_eq!(intrinsics::read(&path).unwrap(), Intrinsics::centred(50.0, 40, 30));
    for (text, part) in [
        (r#"{"w": 40, "h": 30}"#, "`fx` is missing"),
        (r#"{"fx": 0, "w": 40, "h": 30}"#, "`fx` = 0"),
        (r#"{"fx": "x", "w": 40, "h": 30}"#, "`fx` is not a number"),
        (r#"{"fx": 5, "w": 40}"#, "`height` is missing"),
        ("[1]", "`fx` is missing"),
    ] {
        fs::write(&path, text).unwrap();
        says(&message(intrinsics::read(&path)), &["k.json", part]);
    }
}

#[test]
fn writing_leaves_nothing_half_written() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("new/folder/a.txt");
    write_atomically(&path, |sink| sink.write_all(b"old")).unwrap();
    let failed = write_atomically(&path, |sink| {
        sink.write_all(&[b'x'; 1 << 20])?;
        Err(std::io::Error::from(std::io::ErrorKind::StorageFull))
    });
    says(&message(failed), &["a.txt"]);
    assert_eq!(fs::read(&path).unwrap(), b"old");
    assert_eq!(fs::read_dir(path.parent().unwrap()).unwrap().count(), 1);
    says(&message(write_atomically(folder.path(), |_| Ok(()))), &["is a folder"]);
    #[cfg(target_os = "linux")]
    {
        use std::os::unix::fs::PermissionsExt;
        let usual = folder.path().join("usual");
        fs::write(&usual, "").unwrap();
        let mode = |path: &Path| fs::metadata(path).unwrap().permissions().mode();
        assert_eq!(mode(&path), mode(&usual));
        // A full disk, and that a device is not replaced by a file.
        use std::os::unix::fs::FileTypeExt;
        let full = write_atomically("/dev/full", |sink| sink.write_all(b"x"));
        says(&message(full), &["/dev/full", "No space left"]);
        assert!(fs::metadata("/dev/full").unwrap().file_type().is_char_device());
    }
}

//! Datasets with known cameras: real ones, small ones written here, and damaged ones.

mod support;

use std::fs;
use std::io::Write;
use std::path::Path;

use glam::{DQuat, DVec2, DVec3};
use splat4d::data::{Dataset, Resize, colmap, transforms, write_png};
use splat4d::types::{Camera, Image};
use splat4d::{Error, Result};
use support::{damage, message, picture, says, shared, some_camera};

// ---------------------------------------------------------------------------------------------
// Real sets
// ---------------------------------------------------------------------------------------------

/// Median difference between a point's colour and that of the pixel where the camera sees it; also the
/// number of points.
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
    // Poses, intrinsics and points agree only if every convention is right. A shift of one pixel in any
    // direction must fit worse.
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
    // The same images, undistorted by another program: for frames in both sets, ours is resampled to that
    // program's pinhole camera and compared.
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
    // The object is around the origin, which is therefore in front of the camera and near the image
    // centre; the world's z axis points up: a higher point is higher in the image (smaller y).
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
    // k1 < 0 pulls the image inwards: a pinhole camera of the same focal length crops the corners, and
    // every pixel has a source.
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

/// (camera id, model number, model name, parameters) for every supported lens model.
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
            // Without observations the second line is empty.
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
    fs::write(root.path().join("im 7.png"), b"no image").unwrap();
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

#[test]
fn transforms_round_trip() {
    let root = tempfile::tempdir().unwrap();
    let file = root.path().join("transforms.json");
    let time = |i: u32| f64::from(i) / 4.0;
    let cameras: Vec<_> =
        (0..5).map(|i| transforms::TimedCamera { time: time(i), camera: some_camera(i) }).collect();
    let files: Vec<_> = (0..5).map(|i| format!("images/{i:03}.png")).collect();
    transforms::write(&file, &cameras, &files, None).unwrap();
    assert!(transforms::write(&file, &cameras, &files[1..], None).is_err());
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

/// Opens a `transforms.json` with this text, beside an image `a.jpg` of 40×30.
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
    // Conversion from OpenGL's axes to OpenCV's: the identity looks along −z with y up.
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
    // The frame's fields take precedence; its image has half the size that they refer to.
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

//! Every number from outside is checked to be finite and in range before it is used (`types::range`):
//! readers with wild numbers in each place, commands, and the library's public functions.

#![cfg(feature = "cli")]

mod common;
mod support;
#[path = "support/wild.rs"]
mod wild;

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};

use glam::{DQuat, DVec3, Vec3};
use splat4d::data::trajectory::{self, TimedPose};
use splat4d::data::transforms::{self, TimedCamera};
use splat4d::data::{Dataset, Distortion, Point, colmap, exr, flo, intrinsics, points, write_png};
use splat4d::geometry::look_at;
use splat4d::renderer::Renderer;
use splat4d::scene::{Scene, SceneCamera, ply};
use splat4d::train::{TrainSettings, Trainer, TrainingView, random_points, seed_from_points};
use splat4d::types::range::{self, Check};
use splat4d::types::{
    Camera, ControlPoints, DeformNet, Gaussians, Image, Intrinsics, NetShape, Pose, Tuning,
};
use splat4d::{Error, Result};
use support::{compressed, message, picture, says, shared, some_camera};
use wild::WILD;

// ---------------------------------------------------------------------------------------------
// The rule
// ---------------------------------------------------------------------------------------------

/// A number in a file.
#[derive(Clone, Copy, Debug)]
enum Number {
    /// A text number: offset and length in bytes.
    Text(usize, usize),
    F32(usize),
    F64(usize),
    U32(usize),
    U64(usize),
}

impl Number {
    /// The file with this number replaced; `None` if the type cannot express the new one.
    fn replaced(self, bytes: &[u8], by: &str) -> Option<Vec<u8>> {
        let mut out = bytes.to_vec();
        let float: f64 = by.parse().unwrap();
        let mut put = |at: usize, value: &[u8]| out[at..at + value.len()].copy_from_slice(value);
        match self {
            Number::Text(at, length) => {
                out.splice(at..at + length, by.bytes());
            }
            Number::F32(at) => put(at, &(float as f32).to_le_bytes()),
            Number::F64(at) => put(at, &float.to_le_bytes()),
            Number::U32(at) => put(at, &by.parse::<u32>().ok()?.to_le_bytes()),
            Number::U64(at) => put(at, &by.parse::<u64>().ok()?.to_le_bytes()),
        }
        Some(out)
    }
}

/// All numbers in a text.
fn in_text(bytes: &[u8]) -> Vec<Number> {
    let mut found = Vec::new();
    let mut at = 0;
    while at < bytes.len() {
        let is = |b: &u8| b.is_ascii_digit() || matches!(b, b'.' | b'-' | b'+' | b'e' | b'E');
        let length = bytes[at..].iter().take_while(|b| is(b)).count();
        let word = std::str::from_utf8(&bytes[at..at + length]).unwrap();
        if word.parse::<f64>().is_ok() {
            found.push(Number::Text(at, length));
        }
        at += length.max(1);
    }
    found
}

/// Every `step`-th f32 from byte `from` on.
fn floats(bytes: &[u8], from: usize, step: usize) -> Vec<Number> {
    (from..bytes.len() - 3).step_by(4 * step).map(Number::F32).collect()
}

/// The byte offset of a PLY's values.
fn body(bytes: &[u8]) -> usize {
    bytes.windows(11).position(|w| w == b"end_header\n").unwrap() + 11
}

/// A reader, a valid file, and the checks of the result.
struct Source {
    /// The file in which numbers are replaced.
    file: &'static str,
    /// Writes the valid files into a folder.
    write: fn(&Path),
    numbers: fn(&[u8]) -> Vec<Number>,
    /// Reads the folder, and checks all results against the ranges.
    read: fn(&Path) -> Result<Check>,
    /// Names of the places; every message contains one of them.
    places: &'static [&'static str],
}

fn cameras(count: u32) -> Vec<TimedCamera> {
    let camera = |i| TimedCamera { time: f64::from(i) / f64::from(count), camera: some_camera(i) };
    (0..count).map(camera).collect()
}

fn usable_points(points: &[Point]) -> Check {
    points.iter().try_for_each(|p| {
        range::place(Vec3::from(p.position).as_dvec3())?;
        range::colour(p.colour)
    })
}

fn usable_set(set: &Dataset) -> Check {
    for frame in &set.frames {
        frame.camera.check()?;
        frame.distortion.check(&frame.camera.intrinsics)?;
        range::time(frame.time)?;
    }
    usable_points(&set.points)
}

fn usable_scene(scene: &Scene) -> Check {
    let g = &scene.gaussians;
    (0..g.len()).try_for_each(|i| g.check(i))?;
    scene.control_points.check()?;
    scene.network.as_ref().map_or(Ok(()), DeformNet::check)?;
    scene.settings.check()?;
    range::colour(scene.background)?;
    range::unit(DVec3::from(scene.up.map(f64::from)))?;
    for SceneCamera { time, camera } in &scene.cameras {
        camera.check()?;
        range::time(*time)?;
    }
    match scene.neighbours <= 16 {
        true => Ok(()),
        false => Err(format!("{} neighbours", scene.neighbours)),
    }
}

fn gaussians(n: usize) -> Gaussians {
    let wave = |i: usize, k: usize| ((i * 7 + k * 3) as f32 * 0.37).sin();
    Gaussians {
        positions: (0..n).map(|i| [wave(i, 0), wave(i, 1), wave(i, 2) + 4.0]).collect(),
        log_scales: (0..n).map(|i| [wave(i, 3) - 3.0; 3]).collect(),
        rotations: (0..n).map(|i| [1.0, wave(i, 4), 0.1, 0.2]).collect(),
        opacity_logits: (0..n).map(|i| wave(i, 5)).collect(),
        sh_degree: 1,
        sh: (0..4 * n).map(|i| [wave(i, 6), wave(i, 7), wave(i, 8)]).collect(),
        motion_logits: (0..n).map(|i| wave(i, 9)).collect(),
    }
}

fn scene() -> Scene {
    let mut scene = Scene::of(gaussians(3));
    scene.control_points = ControlPoints {
        positions: vec![[0.1, 0.2, 0.3]; 2],
        log_radii: vec![-1.0; 2],
        paths: vec![],
    };
    let shape = NetShape {
        depth: 1,
        width: 16,
        skip: 9,
        position_frequencies: 1,
        time_frequencies: 1,
        ..NetShape::PAPER
    };
    scene.network = Some(DeformNet::random(shape, 1));
    scene.neighbours = 2;
    let camera = |i| SceneCamera { time: f64::from(i) / 2.0, camera: some_camera(i) };
    scene.cameras = (0..2).map(camera).collect();
    scene
}

fn colmap_text(folder: &Path) {
    let cameras = "# a comment\n1 PINHOLE 40 30 50 51 20 15\n2 OPENCV 40 30 50 51 20 15 0.1 -0.02 \
                   0.003 -0.004\n";
    let images = "1 0.5 0.5 -0.5 0.5 1 2 3 1 a.png\n1.5 2.5 -1\n2 1 0 0 0 1 2 4 2 b.png\n\n";
    let points = "9 1 2 3 255 0 51 0.5 1 0\n10 4 5 6 1 2 3 0.5 1 0\n";
    for (stem, text) in [("cameras", cameras), ("images", images), ("points3D", points)] {
        fs::write(folder.join(format!("{stem}.txt")), text).unwrap();
    }
}

fn colmap_binary(folder: &Path) {
    let (mut cameras, mut images, mut points) = (Vec::new(), Vec::new(), Vec::new());
    cameras.extend(1u64.to_le_bytes());
    [1u32, 4].iter().for_each(|v| cameras.extend(v.to_le_bytes()));
    [40u64, 30].iter().for_each(|v| cameras.extend(v.to_le_bytes()));
    [50.0f64, 51.0, 20.0, 15.0, 0.1, -0.02, 0.003, -0.004]
        .iter()
        .for_each(|v| cameras.extend(v.to_le_bytes()));
    images.extend(1u64.to_le_bytes());
    images.extend(1u32.to_le_bytes());
    [0.5f64, 0.5, -0.5, 0.5, 1.0, 2.0, 3.0].iter().for_each(|v| images.extend(v.to_le_bytes()));
    images.extend(1u32.to_le_bytes());
    images.extend(b"a.png\0");
    images.extend(0u64.to_le_bytes());
    points.extend(1u64.to_le_bytes());
    points.extend(9u64.to_le_bytes());
    [1.0f64, 2.0, 3.0].iter().for_each(|v| points.extend(v.to_le_bytes()));
    points.extend([255, 0, 51]);
    points.extend(0.5f64.to_le_bytes());
    points.extend(0u64.to_le_bytes());
    for (stem, bytes) in [("cameras", cameras), ("images", images), ("points3D", points)] {
        fs::write(folder.join(format!("{stem}.bin")), bytes).unwrap();
    }
}

fn read_colmap(folder: &Path) -> Result<Check> {
    let model = colmap::read_model(folder)?;
    let lenses = || {
        model.lenses.values().try_for_each(|lens| {
            lens.intrinsics.check()?;
            lens.distortion.check(&lens.intrinsics)
        })
    };
    let images = || model.images.iter().try_for_each(|image| image.view_from_world.check());
    Ok(lenses().and_then(|()| images()).and_then(|()| usable_points(&model.points)))
}

fn dataset(folder: &Path) {
    let names = ["a.png", "b.png"];
    for (i, name) in (0..).zip(names) {
        write_png(folder.join(name), &picture(40, 30, i)).unwrap();
    }
    let text = r#"{"camera_angle_x": 0.7, "w": 40, "h": 30, "cx": 20.5, "cy": 14.5, "k1": 0.1,
        "k2": -0.01, "k3": 0.001, "k4": 0.0001, "p1": 0.01, "p2": -0.01, "ply_file_path": "cloud.ply",
        "frames": [
        {"file_path": "a.png", "time": 0, "transform_matrix":
            [[1,0,0,2],[0,1,0,3],[0,0,1,4],[0,0,0,1]]},
        {"file_path": "b.png", "time": 0.5, "fl_x": 50, "fl_y": 51, "transform_matrix":
            [[0,-2,0,2],[2,0,0,3],[0,0,2,4],[0,0,0,1]]}]}"#;
    fs::write(folder.join("transforms.json"), text).unwrap();
    fs::write(folder.join("cloud.ply"), CLOUD).unwrap();
}

const CLOUD: &str = "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\n\
    property float z\nproperty float red\nproperty float green\nproperty float blue\nend_header\n\
    1 2 3 0.5 0.25 1\n4 5 6 0.1 0.2 0.3\n";

const SOURCES: &[Source] = &[
    Source {
        file: "transforms.json",
        write: dataset,
        numbers: in_text,
        read: |folder| Dataset::open(folder).map(|set| usable_set(&set)),
        places: &["frame ", "camera of ", "line ", "none of the images"],
    },
    Source {
        file: "path.json",
        write: |folder| {
            let files: Vec<String> = (0..3).map(|i| format!("{i}.png")).collect();
            transforms::write(folder.join("path.json"), &cameras(3), &files, None).unwrap();
        },
        numbers: in_text,
        read: |folder| {
            let cameras = transforms::read_cameras(&folder.join("path.json"))?;
            let check =
                |shot: &TimedCamera| shot.camera.check().and_then(|()| range::time(shot.time));
            Ok(cameras.iter().try_for_each(check))
        },
        places: &["frame ", "camera of ", "line "],
    },
    Source {
        file: "transforms_test.json",
        write: |folder| {
            let files: Vec<String> = (0..4).map(|i| format!("{i}.png")).collect();
            for (i, file) in (0..).zip(&files) {
                write_png(folder.join(file), &picture(40, 30, i)).unwrap();
            }
            let write = |name: &str, range: std::ops::Range<usize>| {
                let all = cameras(4);
                transforms::write(folder.join(name), &all[range.clone()], &files[range], None)
                    .unwrap();
            };
            write("transforms_train.json", 0..3);
            write("transforms_test.json", 3..4);
        },
        numbers: in_text,
        read: |folder| Dataset::open(folder).map(|set| usable_set(&set)),
        places: &["frame ", "camera of ", "line "],
    },
    Source {
        file: "cloud.ply",
        write: dataset,
        numbers: in_text,
        read: |folder| {
            points::read_ply(&folder.join("cloud.ply")).map(|(points, _)| usable_points(&points))
        },
        places: &["header line", "vertex ", "byte "],
    },
    Source {
        file: "tum.txt",
        write: |folder| fs::write(folder.join("tum.txt"), TUM).unwrap(),
        numbers: in_text,
        read: |folder| read_trajectory(&folder.join("tum.txt")),
        places: &["line "],
    },
    Source {
        file: "seven.txt",
        write: |folder| {
            fs::write(folder.join("seven.txt"), "1 2 3 0 0 0 1\n4 5 6 0.5 0.5 0.5 0.5\n").unwrap();
        },
        numbers: in_text,
        read: |folder| read_trajectory(&folder.join("seven.txt")),
        places: &["line "],
    },
    Source {
        file: "kitti.txt",
        write: |folder| {
            let text = "1 0 0 1 0 1 0 2 0 0 1 3\n0 -1 0 7 1 0 0 8 0 0 1 9\n";
            fs::write(folder.join("kitti.txt"), text).unwrap();
        },
        numbers: in_text,
        read: |folder| read_trajectory(&folder.join("kitti.txt")),
        places: &["line "],
    },
    Source {
        file: "cameras.txt",
        write: colmap_text,
        numbers: in_text,
        read: read_colmap,
        places: &["camera ", "line "],
    },
    Source {
        file: "images.txt",
        write: colmap_text,
        numbers: in_text,
        read: read_colmap,
        places: &["image ", "line "],
    },
    Source {
        file: "points3D.txt",
        write: colmap_text,
        numbers: in_text,
        read: read_colmap,
        places: &["line "],
    },
    Source {
        file: "cameras.bin",
        write: colmap_binary,
        numbers: |_| {
            let ids = [8, 12].map(Number::U32);
            let sizes = [0, 16, 24].map(Number::U64);
            ids.into_iter().chain(sizes).chain((0..8).map(|i| Number::F64(32 + 8 * i))).collect()
        },
        read: read_colmap,
        places: &["camera ", "byte "],
    },
    Source {
        file: "images.bin",
        write: colmap_binary,
        numbers: |bytes| {
            let poses = (0..7).map(|i| Number::F64(12 + 8 * i));
            let counts = [0, bytes.len() - 8].map(Number::U64);
            poses.chain(counts).chain([8, 68].map(Number::U32)).collect()
        },
        read: read_colmap,
        places: &["image ", "byte "],
    },
    Source {
        file: "points3D.bin",
        write: colmap_binary,
        numbers: |_| {
            let place = [16, 24, 32, 43].map(Number::F64);
            place.into_iter().chain([0, 8, 51].map(Number::U64)).collect()
        },
        read: read_colmap,
        places: &["byte "],
    },
    Source {
        file: "intrinsics.json",
        write: |folder| {
            intrinsics::write(folder.join("intrinsics.json"), &some_camera(0).intrinsics).unwrap();
        },
        numbers: in_text,
        read: |folder| intrinsics::read(folder.join("intrinsics.json")).map(|k| k.check()),
        places: &["`", "line ", " along ", "image "],
    },
    Source {
        file: "splats.ply",
        write: |folder| ply::write(folder.join("splats.ply"), &gaussians(3)).unwrap(),
        numbers: |bytes| {
            let header = in_text(&bytes[..body(bytes)]);
            header.into_iter().chain(floats(bytes, body(bytes), 1)).collect()
        },
        read: |folder| {
            Scene::open(folder.join("splats.ply"), false).map(|o| usable_scene(&o.scene))
        },
        places: &["header line", "number ", "byte ", "f_rest", "`"],
    },
    Source {
        file: "splats.compressed.ply",
        write: |folder| {
            let bytes = compressed(3, [2047 << 21, 511 << 10, 1023, 0x80ff_00ff], &[7; 9]);
            fs::write(folder.join("splats.compressed.ply"), bytes).unwrap();
        },
        numbers: |bytes| {
            let header = in_text(&bytes[..body(bytes)]);
            let bounds = (0..18).map(|i| Number::F32(body(bytes) + 4 * i));
            header.into_iter().chain(bounds).collect()
        },
        read: |folder| {
            let opened = Scene::open(folder.join("splats.compressed.ply"), false)?;
            Ok(usable_scene(&opened.scene))
        },
        places: &["header line", "number ", "byte ", "f_rest", "`", "vertices"],
    },
    Source {
        file: "scene.safetensors",
        write: |folder| scene().save(folder.join("scene.safetensors")).unwrap(),
        numbers: |bytes| {
            let header = 8 + u64::from_le_bytes(bytes[..8].try_into().unwrap()) as usize;
            // Two cameras of 14 f64 each: a time, 6 and 7 numbers; all other values are f32.
            let cameras = 2 * 14;
            let wide = (0..cameras).map(|i| Number::F64(header + 8 * i));
            let narrow = floats(bytes, header + 8 * cameras, 3);
            let text = in_text(&bytes[8..header]);
            let text = text.into_iter().map(|number| match number {
                Number::Text(at, length) => Number::Text(at + 8, length),
                other => other,
            });
            text.chain(wide).chain(narrow).collect()
        },
        read: |folder| {
            let opened = Scene::open(folder.join("scene.safetensors"), false)?;
            Ok(usable_scene(&opened.scene))
        },
        places: &[
            "camera ",
            "number ",
            "metadata",
            "control point",
            "network",
            "gaussians.",
            "cameras.",
            "control_points.",
            "not a splat4d scene",
            "header",
            "version",
        ],
    },
    Source {
        file: "flow.flo",
        write: |folder| {
            let pixels = (0..24).map(|i| i as f32 * 0.5 - 3.0).collect();
            let flow = Image { width: 4, height: 3, channels: 2, pixels };
            flo::write(folder.join("flow.flo"), &flow).unwrap();
        },
        numbers: |bytes| {
            let sizes = [4, 8].map(Number::U32);
            sizes.into_iter().chain(floats(bytes, 0, 1)).collect()
        },
        read: |folder| {
            let flow = flo::read(folder.join("flow.flo"))?;
            let wrong = flow.pixels.chunks_exact(2).find(|v| {
                !(v.iter().all(|v| v.abs() <= range::FLOW) || v.iter().all(|v| v.is_nan()))
            });
            Ok(wrong.map_or(Ok(()), |v| Err(format!("a vector {v:?}"))))
        },
        places: &["size", "vectors", "tag"],
    },
    Source {
        file: "settings.json",
        write: |folder| {
            let text = r#"{"sh_degree": 2, "alpha_cut": 0.02, "transmittance_stop": 0.01,
                "depth_bits": 16, "neighbours": 3}"#;
            fs::write(folder.join("settings.json"), text).unwrap();
        },
        numbers: in_text,
        read: |folder| {
            let path = folder.join("settings.json");
            let value = splat4d::io::read_json(&path)?;
            let bad = |what: String| Error::format(&path, format!("settings: {what}"));
            let tuning: Tuning = serde_json::from_value(value).map_err(|e| bad(e.to_string()))?;
            tuning.check().map_err(|e| bad(e.to_string()))?;
            let shares = [tuning.alpha_cut, tuning.transmittance_stop];
            let fine = shares.iter().flatten().all(|v| *v > 0.0 && *v < 1.0);
            Ok(if fine { Ok(()) } else { Err(format!("{tuning:?}")) })
        },
        places: &["settings", "line "],
    },
];

const TUM: &str = "# timestamp tx ty tz qx qy qz qw\n1305031102.1758 1.3405 0.6266 1.6575 0.6574 \
    0.6126 -0.2949 -0.3248\n1305031103 1 2 3 0 0 0 1\n";

fn read_trajectory(path: &Path) -> Result<Check> {
    let poses = trajectory::read(path, None)?;
    Ok(poses.iter().try_for_each(|pose| {
        range::timestamp(pose.time)?;
        pose.world_from_view.check()
    }))
}

/// A safetensors file begins with the length of its header.
fn with_length(file: &str, before: usize, mut bytes: Vec<u8>, number: Number) -> Vec<u8> {
    if let (true, Number::Text(..)) = (file.ends_with(".safetensors"), number) {
        let length = u64::from_le_bytes(bytes[..8].try_into().unwrap());
        let length = length + bytes.len() as u64 - before as u64;
        bytes[..8].copy_from_slice(&length.to_le_bytes());
    }
    bytes
}

#[test]
fn every_number_of_a_file_is_in_range_or_an_error() {
    for source in SOURCES {
        let folder = tempfile::tempdir().unwrap();
        (source.write)(folder.path());
        let path = folder.path().join(source.file);
        let good = fs::read(&path).unwrap();
        (source.read)(folder.path()).unwrap().unwrap();
        let numbers = (source.numbers)(&good);
        assert!(numbers.len() > 4, "{}: {} numbers", source.file, numbers.len());
        let (mut tried, mut refused) = (0, 0);
        for &number in &numbers {
            for wild in WILD {
                let Some(bytes) = number.replaced(&good, wild) else { continue };
                fs::write(&path, with_length(source.file, good.len(), bytes, number)).unwrap();
                tried += 1;
                let place = || format!("{}: {wild} at {number:?}", source.file);
                match (source.read)(folder.path()) {
                    Ok(checked) => checked.unwrap_or_else(|what| panic!("{}: {what}", place())),
                    Err(error) => {
                        refused += 1;
                        let said = error.to_string();
                        // A wild image name is reported with the path of the image.
                        let named = said.contains(&folder.path().display().to_string());
                        assert!(named, "{}: {said}", place());
                        let placed = source.places.iter().any(|place| said.contains(place));
                        assert!(placed, "{}: {said}", place());
                        assert!(said.len() < 600 + path.as_os_str().len(), "{}", place());
                    }
                }
            }
        }
        println!("{}: {refused} of {tried} refused", source.file);
        assert!(refused > 0, "{}: nothing is refused", source.file);
    }
}

/// The file is compressed, so its numbers cannot be replaced in place.
#[test]
fn what_is_no_depth_is_unknown() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("depth.exr");
    let wild: Vec<f32> = WILD.iter().map(|text| text.parse().unwrap()).collect();
    let depth = Image { width: wild.len() as u32, height: 1, channels: 1, pixels: wild };
    exr::write_depth(&path, &depth).unwrap();
    let inf = f32::INFINITY;
    let expected = [
        [0.0, 0.0, 0.0, 0.0, 1e10, inf, inf, inf, inf, 0.0],
        [0.0, inf, 0.0, 65536.0, 1e9, 4294967295.0, 4294967296.0, inf, inf, inf],
    ]
    .concat();
    assert_eq!(exr::read_depth(&path).unwrap().pixels, expected);
}

// ---------------------------------------------------------------------------------------------
// Files that were taken for good
// ---------------------------------------------------------------------------------------------

/// Opens a `transforms.json` of one frame with these fields at the top, and this matrix.
fn frame(top: &str, matrix: &str) -> Result<Dataset> {
    let folder = tempfile::tempdir().unwrap();
    write_png(folder.path().join("a.png"), &picture(40, 30, 1)).unwrap();
    let text =
        format!(r#"{{{top}, "frames": [{{"file_path": "a.png", "transform_matrix": {matrix}}}]}}"#);
    fs::write(folder.path().join("transforms.json"), text).unwrap();
    Dataset::open(folder.path())
}

const IDENTITY: &str = "[[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]";

#[test]
fn cameras_that_are_none_are_refused_with_their_frame() {
    let of_matrix = |matrix: &str| message(frame(r#""fl_x": 50"#, matrix));
    let here = ["transforms.json", "frame 0 (a.png)", "transform_matrix"];
    says(&of_matrix("[[0,0,0,0],[0,0,0,0],[0,0,0,0],[0,0,0,0]]"), &here);
    for far in ["1e19", "1e38", "1e300", "-1e13"] {
        says(&of_matrix(&IDENTITY.replacen(",0]", &format!(",{far}]"), 1)), &here);
        says(&of_matrix(&IDENTITY.replacen("[1,", &format!("[{far},"), 1)), &here);
    }
    for angle in ["0", "-0.5", "3.2", "1e300"] {
        let said = message(frame(&format!(r#""camera_angle_x": {angle}"#), IDENTITY));
        says(&said, &["transforms.json", "a.png", "camera_angle_x", "between 0 and π"]);
    }
    // An angle is ignored if a focal length is given.
    frame(r#""camera_angle_x": 0, "fl_x": 50"#, IDENTITY).unwrap();
    for focal in ["0.5", "1e9", "1e300"] {
        let said = message(frame(&format!(r#""fl_x": {focal}"#), IDENTITY));
        says(&said, &["transforms.json", "camera of a.png", "focal length"]);
    }
}

#[test]
fn lenses_that_leave_nothing_are_refused_when_the_set_is_opened() {
    for (bend, part) in [
        (r#""k1": 1e10"#, "10000000000.0"),
        (r#""k1": -1e10"#, "10000000000.0"),
        (r#""k4": 1e300"#, "1e300"),
        (r#""p1": 1e10"#, "leaves only"),
        (r#""p2": 3"#, "folds"),
        (r#""k1": 1000"#, "leaves only"),
    ] {
        let said = message(frame(&format!(r#""fl_x": 50, {bend}"#), IDENTITY));
        says(&said, &["transforms.json", "camera of a.png", "distortion", part]);
    }
    // Lenses of all kinds, including real ones.
    let k = Intrinsics::centred(50.0, 100, 60);
    for radial in [[-0.3, 0.1, 0.0, 0.0], [0.3, 0.0, 0.0, 0.0], [0.0578, -0.0805, 0.0, 0.0]] {
        Distortion { radial, tangential: [1e-3, -2e-3] }.check(&k).unwrap();
    }
}

#[test]
fn matrices_with_shear_are_no_poses() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("kitti.txt");
    let read = |text: &str| {
        fs::write(&path, text).unwrap();
        trajectory::read(&path, None)
    };
    let good = "1 0 0 1 0 1 0 2 0 0 1 3\n";
    for bad in
        ["1 0.5 0 1 0 1 0 2 0 0 1 3\n", "0 0 0 0 0 0 0 0 0 0 0 0\n", "2 0 0 1 0 2 0 2 0 0 2 3\n"]
    {
        says(&message(read(&format!("{good}{bad}"))), &["kitti.txt", "line 2", "rigid"]);
    }
    says(&message(read("0 1e19 0 0 0 0 0 1\n")), &["line 1", "1e19"]);
    says(&message(read("0 1e300 0 0 0 0 0 1\n")), &["line 1", "1e300"]);
}

#[test]
fn colmap_images_without_blank_lines_are_all_there() {
    let folder = tempfile::tempdir().unwrap();
    colmap_text(folder.path());
    let model = |images: &str| {
        fs::write(folder.path().join("images.txt"), images).unwrap();
        colmap::read_model(folder.path())
    };
    let line = |n: u32, name: &str| format!("{n} 1 0 0 0 1 2 {n} 1 {name}\n");
    let names = ["a.png", "b c.png", "0003", "d 4 5.png"];
    let bare: String = (1..).zip(names).map(|(n, name)| line(n, name)).collect();
    let blank = bare.replace('\n', "\n\n");
    let observed = bare.replace('\n', "\n1.5 2.5 -1 3 4 17\n");
    for text in [bare, blank, observed] {
        let read = model(&text).unwrap();
        let found: Vec<&str> = read.images.iter().map(|image| image.name.as_str()).collect();
        assert_eq!(found, names, "{text}");
        assert_eq!(read.images[3].view_from_world.translation.z, 4.0);
    }
    // A line that is neither observations nor an image.
    let torn = format!("{}1.5 2.5\n{}", line(1, "a.png"), line(2, "b.png"));
    says(&message(model(&torn)), &["images.txt", "line 2"]);
}

#[test]
fn points_out_of_reach_are_left_out_and_counted() {
    let folder = tempfile::tempdir().unwrap();
    colmap_text(folder.path());
    for (i, name) in (0..).zip(["a.png", "b.png"]) {
        write_png(folder.path().join(name), &picture(40, 30, i)).unwrap();
    }
    let points = "1 1 2 3 0 0 0 1\n2 1e19 0 0 0 0 0 1\n3 0 nan 0 0 0 0 1\n4 0 1e300 0 0 0 0 1\n";
    fs::write(folder.path().join("points3D.txt"), points).unwrap();
    let set = Dataset::open(folder.path()).unwrap();
    assert_eq!(set.points.len(), 1);
    says(&set.notes.join("\n"), &["left out 3 of 4 points"]);
    let cloud = folder.path().join("cloud.ply");
    fs::write(&cloud, CLOUD.replace("0.5 0.25 1", "128 64 255")).unwrap();
    says(&message(points::read_ply(&cloud)), &["cloud.ply", "vertex 0", "128"]);
}

#[test]
fn packed_words_are_whole_numbers() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.ply");
    let good = compressed(3, [1, 2, 3, 4], &[7; 9]);
    let end = body(&good);
    let header = std::str::from_utf8(&good[..end]).unwrap();
    for (from, to, named) in [
        ("uint packed_position", "float packed_position", "packed_"),
        ("uint packed_color", "int packed_color", "packed_"),
        ("uchar f_rest_3", "char f_rest_3", "f_rest_"),
    ] {
        let mut bytes = header.replace(from, to).into_bytes();
        bytes.extend(&good[end..]);
        fs::write(&path, bytes).unwrap();
        says(&message(Scene::open(&path, false)), &["a.ply", named, "type"]);
    }
}

/// Messages quote what was read in a few printable characters.
#[test]
fn what_is_quoted_cannot_flood_or_steer_a_terminal() {
    let folder = tempfile::tempdir().unwrap();
    let long = format!("\u{1b}[2J\u{1b}]0;title\u{7}{}", "x".repeat(1 << 20));
    let json = serde_json::to_string(&long).unwrap();
    let write = |name: &str, text: String| {
        let path = folder.path().join(name);
        fs::write(&path, text).unwrap();
        path
    };
    let held = |said: String| {
        assert!(said.len() < 1000 && !said.chars().any(char::is_control), "{} bytes", said.len());
    };
    let ply = write("a.ply", format!("ply\nformat ascii 1.0\n{long}\nend_header\n"));
    held(message(Scene::open(ply, false)));
    let ply = format!(
        "ply\nformat ascii 1.0\nelement {long} 9\nproperty int a\nelement vertex 1\n\
                       property float x\nproperty float y\nproperty float z\nend_header\n1 2\n"
    );
    held(message(points::read_ply(&write("b.ply", ply))));
    let frame = format!(r#"{{"fl_x": 5, "w": 9, "h": 9, "frames": [{{"file_path": {json}}}]}}"#);
    held(message(transforms::read_cameras(&write("a.json", frame))));
    let frame =
        format!(r#"{{"camera_model": {json}, "frames": [{{"transform_matrix": {IDENTITY}}}]}}"#);
    held(message(transforms::read_cameras(&write("b.json", frame))));
    colmap_text(folder.path());
    let flat = long.replace(' ', "");
    write("images.txt", format!("1 9 0 0 0 0 0 0 1 {flat}\n"));
    held(message(colmap::read_model(folder.path())));
    write("cameras.txt", format!("1 {flat} 40 30 50\n"));
    held(message(colmap::read_model(folder.path())));
}

/// Values of real files are accepted.
#[test]
fn real_data_is_in_range() {
    for name in ["fox270", "ingp_fox", "dnerf_400/standup", "nvidia_balloon1"] {
        let Some(path) = shared(name) else { continue };
        let set = Dataset::open(&path).unwrap();
        usable_set(&set).unwrap_or_else(|what| panic!("{name}: {what}"));
        assert!(!set.notes.iter().any(|note| note.contains("left out")), "{:?}", set.notes);
    }
    if let Some(path) = shared("splats_playcanvas/biker.compressed.ply") {
        usable_scene(&Scene::open(path, false).unwrap().scene).unwrap();
    }
}

// ---------------------------------------------------------------------------------------------
// The library's own doors
// ---------------------------------------------------------------------------------------------

fn wild_cameras(good: Camera) -> Vec<Camera> {
    let k = good.intrinsics;
    let mut all = Vec::new();
    for v in [0.0, -1.0, 1e19, 1e300, f64::NAN, f64::INFINITY] {
        all.push(Camera { intrinsics: Intrinsics { fx: v, ..k }, ..good });
        if v.abs() > 1.0 || v.is_nan() {
            all.push(Camera { intrinsics: Intrinsics { cy: v, ..k }, ..good });
            let translation = DVec3::new(0.0, v, 0.0);
            all.push(Camera { view_from_world: Pose { translation, ..Pose::IDENTITY }, ..good });
        }
        let rotation = DQuat::from_xyzw(0.0, 0.0, v, v);
        all.push(Camera { view_from_world: Pose { rotation, ..Pose::IDENTITY }, ..good });
    }
    all.push(Camera { intrinsics: Intrinsics { width: 0, ..k }, ..good });
    all.push(Camera { intrinsics: Intrinsics { height: u32::MAX, ..k }, ..good });
    all
}

#[test]
fn renderer_and_trainer_refuse_wild_numbers() {
    let device = common::device();
    let static_ones = Gaussians { motion_logits: Vec::new(), ..gaussians(9) };
    let good =
        Camera { intrinsics: Intrinsics::centred(30.0, 32, 24), view_from_world: Pose::IDENTITY };
    let input = |result: Result<()>, what: &str| match result {
        Err(Error::Input(said)) => assert!(said.len() < 400, "{what}: {said}"),
        other => panic!("{what}: {other:?}"),
    };
    let mut renderer = Renderer::new(&device, &Scene::of(static_ones.clone())).unwrap();
    for camera in wild_cameras(good) {
        input(renderer.render(&camera, 0.0).map(drop), &format!("{camera:?}"));
    }
    for time in [f64::NAN, f64::INFINITY, 1e19] {
        input(renderer.render(&good, time).map(drop), &time.to_string());
        input(renderer.bounds(time, 1.0).map(drop), &time.to_string());
    }
    // Gaussians that are not finite or far too large are skipped; the others are drawn.
    let mut some_bad = static_ones.clone();
    for (i, wild) in [f32::NAN, f32::INFINITY, 1e19, 1e38].into_iter().enumerate() {
        some_bad.positions[i][1] = wild;
        some_bad.sh[4 * (i + 4)][0] = wild;
    }
    let mut renderer = Renderer::new(&device, &Scene::of(some_bad.clone())).unwrap();
    let picture = renderer.render(&good, 0.0).unwrap();
    assert!(picture.rgba.pixels.iter().all(|v| v.is_finite()));
    assert!(picture.rgba.pixels.iter().any(|v| *v > 0.0));
    let mut wild = Scene::of(static_ones.clone());
    wild.settings.near = f32::NAN;
    input(Renderer::new(&device, &wild).map(drop), "near");
    let mut wild = scene();
    wild.control_points.log_radii[1] = f32::INFINITY;
    input(Renderer::new(&device, &wild).map(drop), "radius");
    let mut wild = scene();
    wild.network.as_mut().unwrap().parameters[3] = f32::NAN;
    input(Renderer::new(&device, &wild).map(drop), "network");

    let view = |camera: Camera| TrainingView {
        camera,
        time: 0.0,
        image: support::picture(32, 24, 1),
        weights: None,
        disparity: None,
        mask: None,
        every: 1,
    };
    let train = |views: &[TrainingView], gaussians: &Gaussians| {
        Trainer::new(&device, views, gaussians, None, TrainSettings::of_steps(5)).map(drop)
    };
    train(&[view(good)], &static_ones).unwrap();
    for camera in wild_cameras(good) {
        input(train(&[view(good), view(camera)], &static_ones), &format!("{camera:?}"));
    }
    input(train(&[view(good)], &some_bad), "Gaussians");
    let late = TrainingView { time: f64::NAN, ..view(good) };
    input(train(&[late], &static_ones), "time");
    let mut disparity = Image::new(32, 24, 2);
    disparity.pixels[7] = f32::INFINITY;
    let known = TrainingView { disparity: Some(disparity), ..view(good) };
    input(train(&[known], &static_ones), "disparity");
    // Seeds are made from wild points, and refused by the training.
    let point = |x: f32| Point { position: [x, 0.0, 4.0], colour: [0.5; 3] };
    let wild = seed_from_points(&[point(0.0), point(f32::NAN), point(1e38), point(1.0)], 0);
    input(train(&[view(good)], &wild), "seeds");
    assert_eq!(random_points(&wild_cameras(good), 10, 0).len(), 10);
    common::assert_valid(&device);
}

// ---------------------------------------------------------------------------------------------
// Commands
// ---------------------------------------------------------------------------------------------

fn run(folder: &Path, arguments: &str) -> Output {
    Command::new(env!("CARGO_BIN_EXE_splat4d"))
        .current_dir(folder)
        .args(arguments.split_whitespace())
        .args(["--device", &std::env::var("SPLAT4D_DEVICE").unwrap_or("software".into())])
        .stdin(Stdio::null())
        .output()
        .unwrap()
}

/// Runs a command that must fail with a job's exit code, and returns its message; nothing may be written.
#[track_caller]
fn fails(folder: &Path, arguments: &str) -> String {
    fails_with(1, folder, arguments)
}

/// As [`fails`], with another exit code.
#[track_caller]
fn fails_with(code: i32, folder: &Path, arguments: &str) -> String {
    let list = || -> Vec<PathBuf> {
        let mut all: Vec<_> =
            fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path()).collect();
        all.sort();
        all
    };
    let before = list();
    let output = run(folder, arguments);
    let said = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(code), "{arguments}: {said}");
    let mut errors = said.lines().filter(|line| line.starts_with("error: "));
    let error = errors.next().unwrap_or_else(|| panic!("{arguments}: {said}")).to_owned();
    assert!(error.len() < 1000 && errors.next().is_none(), "{arguments}: {said}");
    assert_eq!(list(), before, "{arguments} leaves nothing behind");
    error
}

#[track_caller]
fn works(folder: &Path, arguments: &str) {
    let output = run(folder, arguments);
    assert!(output.status.success(), "{arguments}: {}", String::from_utf8_lossy(&output.stderr));
}

/// Writes a dataset around the point `middle`, with distances between cameras scaled by `unit`.
fn small_set(folder: &Path, middle: DVec3, unit: f64) {
    let names: Vec<String> = (0..4).map(|i| format!("{i}.png")).collect();
    for (i, name) in (0..).zip(&names) {
        write_png(folder.join(name), &picture(24, 16, i)).unwrap();
    }
    let camera = |i: i32| TimedCamera {
        time: f64::from(i) / 3.0,
        camera: Camera {
            intrinsics: Intrinsics::centred(20.0, 24, 16),
            view_from_world: look_at(
                middle + DVec3::new(f64::from(i) - 1.5, 0.2, -4.0) * unit,
                middle,
                DVec3::NEG_Y,
            ),
        },
    };
    let cameras: Vec<TimedCamera> = (0..4).map(camera).collect();
    transforms::write(folder.join("transforms.json"), &cameras, &names, None).unwrap();
}

#[test]
fn trainings_end_with_scenes_that_open() {
    for (middle, unit) in [
        (DVec3::splat(1e6), 1.0),
        (DVec3::new(3.2e8, 5.6e9, 1e5), 1e3),
        (DVec3::ZERO, 1e-6),
        (DVec3::ZERO, 1e3),
        (DVec3::splat(9e10), 1e10),
    ] {
        let folder = tempfile::tempdir().unwrap();
        fs::create_dir(folder.path().join("set")).unwrap();
        small_set(&folder.path().join("set"), middle, unit);
        works(folder.path(), "train set -o x.safetensors --steps 4 --random-points 60 --static");
        let scene = Scene::open(folder.path().join("x.safetensors"), false).unwrap().scene;
        usable_scene(&scene).unwrap_or_else(|what| panic!("{middle}, {unit}: {what}"));
    }
}

#[test]
fn trainings_on_wild_numbers_do_not_begin() {
    let folder = tempfile::tempdir().unwrap();
    let set = folder.path().join("set");
    fs::create_dir(&set).unwrap();
    small_set(&set, DVec3::ZERO, 1.0);
    let file = set.join("transforms.json");
    let good: serde_json::Value = serde_json::from_slice(&fs::read(&file).unwrap()).unwrap();
    let train = |change: &dyn Fn(&mut serde_json::Value)| {
        let mut text = good.clone();
        change(&mut text);
        fs::write(&file, text.to_string()).unwrap();
        fails(folder.path(), "train set -o x --steps 2 --random-points 40")
    };
    // Frame 0 is held out.
    for held in [0, 1] {
        for (row, column) in [(0, 3), (1, 1)] {
            for wild in [1e19, 1e38, 1e300] {
                let said = train(&|set| {
                    set["frames"][held]["transform_matrix"][row][column] = wild.into();
                });
                says(&said, &["transforms.json", &format!("frame {held}"), "transform_matrix"]);
            }
        }
        let said = train(&|set| {
            set["frames"][held]["transform_matrix"] = serde_json::json!(vec![[0; 4]; 4])
        });
        says(&said, &["transforms.json", &format!("frame {held}"), "rigid"]);
        let said = train(&|set| {
            set["camera_model"] = "OPENCV".into();
            set["frames"][held]["k1"] = 1e10.into();
        });
        says(&said, &["transforms.json", &format!("camera of {held}.png"), "distortion", "1000"]);
    }
}

#[test]
fn paths_of_cameras_that_are_none_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    ply::write(folder.path().join("a.ply"), &gaussians(9)).unwrap();
    let write = |frames: &str| {
        let text = format!(r#"{{"fl_x": 20, "w": 24, "h": 16, "frames": [{frames}]}}"#);
        fs::write(folder.path().join("path.json"), text).unwrap();
        fails(folder.path(), "render a.ply -o views --path path.json")
    };
    let frame = |matrix: &str| format!(r#"{{"transform_matrix": {matrix}}}"#);
    says(&write(""), &["path.json", "empty"]);
    let zero = "[[0,0,0,0],[0,0,0,0],[0,0,0,0],[0,0,0,0]]";
    says(&write(&format!("{}, {}", frame(IDENTITY), frame(zero))), &["frame 1", "rigid"]);
    let huge = IDENTITY.replace('1', "1e300");
    says(&write(&frame(&huge)), &["frame 0", "rigid"]);
    says(&fails(folder.path(), "render a.ply -o views --focal 1"), &["camera 0", "focal length"]);
    let said = fails_with(2, folder.path(), "render a.ply -o views --focal 1e300");
    says(&said, &["--focal", "from 1 to"]);
}

#[test]
fn a_scene_of_one_gaussian_is_seen() {
    let folder = tempfile::tempdir().unwrap();
    for log_scale in [-3.0, -12.0, 2.0] {
        let one = Gaussians {
            log_scales: vec![[log_scale; 3]],
            opacity_logits: vec![4.0],
            positions: vec![[3.0, -2.0, 1.0]],
            sh: vec![[1.5; 3]],
            sh_degree: 0,
            motion_logits: Vec::new(),
            rotations: vec![[1.0, 0.0, 0.0, 0.0]],
        };
        ply::write(folder.path().join("one.ply"), &one).unwrap();
        works(folder.path(), "render one.ply -o views --frames 2 --size 48x27 --exr");
        let picture = exr::read_rgba(folder.path().join("views/0001.exr")).unwrap();
        assert!(picture.at(24, 13)[3] > 0.5, "{log_scale}: {:?}", picture.at(24, 13));
        let shown = picture.pixels.iter().skip(3).step_by(4).filter(|a| **a > 0.1).count();
        assert!((30..1200).contains(&shown), "{log_scale}: {shown} pixels");
    }
}

#[test]
fn clips_with_wild_cameras_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    fs::create_dir(folder.path().join("clip")).unwrap();
    for i in 0..3 {
        write_png(folder.path().join(format!("clip/{i}.png")), &picture(48, 32, 3 * i)).unwrap();
    }
    let said = fails(folder.path(), "reconstruct clip -o x --focal 1");
    says(&said, &["--focal", "focal length"]);
    let said = fails_with(2, folder.path(), "reconstruct clip -o x --focal 1e300");
    says(&said, &["--focal", "from 1 to"]);
    let poses: Vec<TimedPose> = (0..3)
        .map(|i| TimedPose { time: i.into(), world_from_view: some_camera(i).view_from_world })
        .collect();
    let file = folder.path().join("poses.txt");
    trajectory::write(&file, &poses).unwrap();
    let text = fs::read_to_string(&file).unwrap();
    for wild in ["1e19", "1e300"] {
        let line = text.lines().nth(2).unwrap();
        let mut words: Vec<&str> = line.split(' ').collect();
        words[2] = wild;
        fs::write(&file, text.replace(line, &words.join(" "))).unwrap();
        let said = fails(folder.path(), "reconstruct clip -o x --poses poses.txt");
        says(&said, &["poses.txt", "line 3", wild]);
    }
}

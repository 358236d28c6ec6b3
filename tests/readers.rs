//! Robustness of every reader against real files that are truncated and changed. No reader may panic,
//! hang, or allocate more memory than stated, and an error must name the file.

mod support;

use std::alloc::{GlobalAlloc, Layout, System};
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};

use glam::{DQuat, DVec2, DVec3};
use splat4d::Result;
use splat4d::check::fuzz::{draw, file};
use splat4d::data::trajectory::{self, TimedPose};
use splat4d::data::transforms::{self, TimedCamera};
use splat4d::data::{
    colmap, dpt, exr, flo, images, intrinsics, nerfies, poses_bounds, tracks, write_png,
};
use splat4d::io::{Identity, read_state, write_state};
use splat4d::scene::{Format, Scene, SceneCamera, compact, ply, sog, splat, spz};
use splat4d::types::{
    ControlPoints, DeformNet, Gaussians, Image, NetShape, PointPath, Pose, Tracks,
};
use support::{Dice, compressed, picture, some_camera};

/// An allocator that counts allocated bytes.
struct Counting;

static NOW: AtomicUsize = AtomicUsize::new(0);
static PEAK: AtomicUsize = AtomicUsize::new(0);

fn add(bytes: usize) {
    let now = NOW.fetch_add(bytes, Ordering::Relaxed) + bytes;
    PEAK.fetch_max(now, Ordering::Relaxed);
}

// SAFETY: every call is forwarded to the system's allocator.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        add(layout.size());
        // SAFETY: the caller keeps `alloc`'s contract, which is the same as the system allocator's.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        NOW.fetch_sub(layout.size(), Ordering::Relaxed);
        // SAFETY: as above.
        unsafe { System.dealloc(pointer, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

/// Bytes that any read may allocate: decoder tables, threads, messages.
const FLOOR: usize = 8 << 20;
/// Multiple of its size that reading an uncompressed file may allocate: numbers from text, and copies.
const PLAIN: usize = 40;
/// Bytes that reading a compressed image may allocate: 64 MiB unpacked, whatever the file's size
/// (`io::check_unpacked`), as bytes and as floats, and copies.
const PACKED: usize = 10 * (64 << 20);

struct Reader {
    name: &'static str,
    write: fn(&Path),
    read: fn(&Path) -> Result<()>,
    /// Largest number of bytes that reading may allocate, for a file size in bytes.
    most: fn(usize) -> usize,
    /// Whether any strict prefix is an error.
    prefixes_fail: bool,
}

fn plain(size: usize) -> usize {
    FLOOR + PLAIN * size
}

fn packed(_: usize) -> usize {
    FLOOR + PACKED
}

fn gaussians(sh_degree: u32) -> Gaussians {
    let n = 40;
    let wave = |i: usize, k: usize| ((i * 7 + k * 3) as f32 * 0.37).sin();
    Gaussians {
        positions: (0..n).map(|i| [wave(i, 0), wave(i, 1), wave(i, 2)]).collect(),
        log_scales: (0..n).map(|i| [wave(i, 3) - 3.0; 3]).collect(),
        rotations: (0..n).map(|i| [1.0, wave(i, 4), 0.1, 0.2]).collect(),
        opacity_logits: (0..n).map(|i| wave(i, 5)).collect(),
        sh_degree,
        sh: (0..n * ((sh_degree + 1) * (sh_degree + 1)) as usize)
            .map(|i| [wave(i, 6), wave(i, 7), wave(i, 8)])
            .collect(),
        motion_logits: (0..n).map(|i| wave(i, 9)).collect(),
    }
}

fn scene() -> Scene {
    let mut scene = Scene::of(gaussians(2));
    scene.control_points = ControlPoints {
        positions: vec![[0.1, 0.2, 0.3]; 5],
        log_radii: vec![-1.0; 5],
        paths: vec![],
    };
    let shape = NetShape {
        depth: 2,
        width: 16,
        skip: 0,
        position_frequencies: 1,
        time_frequencies: 1,
        ..NetShape::PAPER
    };
    scene.network = Some(DeformNet::random(shape, 1));
    scene.neighbours = 3;
    scene.cameras =
        (0..3).map(|i| SceneCamera { time: f64::from(i) / 2.0, camera: some_camera(i) }).collect();
    scene
}

fn point_paths() -> Tracks {
    let point = |i: usize| PointPath {
        query: (i % 7, DVec2::new(i as f64, 3.5)),
        pixels: (0..7).map(|t| DVec2::new((i * t) as f64 * 0.3, 3.5)).collect(),
        seen: (0..7).map(|t| !(i + t).is_multiple_of(3)).collect(),
    };
    Tracks { size: Some((64, 48)), points: (0..50).map(point).collect() }
}

fn poses() -> Vec<TimedPose> {
    (0..20)
        .map(|i| TimedPose {
            time: f64::from(i),
            world_from_view: Pose::new(
                DQuat::from_rotation_y(0.1 * f64::from(i)),
                DVec3::new(f64::from(i), 0.5, -1.0),
            ),
        })
        .collect()
}

fn ramp(width: u32, height: u32, channels: u32) -> Image {
    let mut image = Image::new(width, height, channels);
    for (i, value) in image.pixels.iter_mut().enumerate() {
        *value = 1.0 + (i % 97) as f32 * 0.25;
    }
    image
}

/// A SOG of 60 Gaussians with spherical harmonics of degree 1.
fn bundle() -> Vec<u8> {
    let book: Vec<f32> = (0..256).map(|i| -5.0 + 0.02 * i as f32).collect();
    let part = |files: &[&str]| serde_json::json!({ "codebook": book, "files": files });
    let mut harmonics = part(&["shN_centroids.webp", "shN_labels.webp"]);
    (harmonics["count"], harmonics["bands"]) = (70.into(), 1.into());
    let meta = serde_json::json!({
        "version": 2,
        "count": 60,
        "means": { "mins": [-1, -1, 0], "maxs": [1, 1, 2], "files": ["means_l.webp", "means_u.webp"] },
        "scales": part(&["scales.webp"]),
        "quats": { "files": ["quats.webp"] },
        "sh0": part(&["sh0.webp"]),
        "shN": harmonics,
    });
    let mut archive = zip::ZipWriter::new(std::io::Cursor::new(Vec::new()));
    let mut add = |name: &str, bytes: &[u8]| {
        archive.start_file(name, zip::write::SimpleFileOptions::default()).unwrap();
        std::io::Write::write_all(&mut archive, bytes).unwrap();
    };
    add("meta.json", meta.to_string().as_bytes());
    for name in ["means_l", "means_u", "scales", "quats", "sh0", "shN_centroids", "shN_labels"] {
        let (width, height) = if name == "shN_centroids" { (64 * 3, 2) } else { (8, 8) };
        let mut picture = image::RgbaImage::new(width, height);
        for (i, pixel) in picture.pixels_mut().enumerate() {
            let i = i as u8;
            pixel.0 = match name {
                "shN_labels" => [i % 64, 0, 0, 255],
                "quats" => [i, i.wrapping_mul(3), 128, 252 + i % 4],
                _ => [i.wrapping_mul(37), i.wrapping_mul(11), i, 200],
            };
        }
        let mut bytes = std::io::Cursor::new(Vec::new());
        picture.write_to(&mut bytes, image::ImageFormat::WebP).unwrap();
        add(&format!("{name}.webp"), bytes.get_ref());
    }
    archive.finish().unwrap().into_inner()
}

const READERS: &[Reader] = &[
    Reader {
        name: "scene.safetensors",
        write: |path| scene().save(path).unwrap(),
        read: |path| Scene::open(path, false).map(drop),
        most: plain,
        prefixes_fail: true,
    },
    Reader {
        name: "splats.ply",
        write: |path| ply::write(path, &gaussians(3)).unwrap(),
        read: |path| ply::read(path, true).map(drop),
        most: plain,
        prefixes_fail: true,
    },
    Reader {
        name: "splats.compressed.ply",
        write: |path| {
            let bytes = compressed(300, [2047 << 21, 511 << 10, 1023, 0x80ff_00ff], &[7; 9]);
            fs::write(path, bytes).unwrap();
        },
        read: |path| ply::read(path, true).map(drop),
        most: plain,
        prefixes_fail: true,
    },
    Reader {
        name: "compact.safetensors",
        write: |path| compact::write(path, &scene()).unwrap(),
        read: |path| Scene::open(path, false).map(drop),
        most: packed,
        prefixes_fail: true,
    },
    Reader {
        name: "splats.splat",
        write: |path| assert_eq!(Format::Splat.write(path, &gaussians(0)).unwrap(), 40),
        read: |path| splat::read(path, false).map(drop),
        most: plain,
        prefixes_fail: false,
    },
    Reader {
        name: "old.spz",
        write: |path| assert_eq!(spz::write(path, &gaussians(2), spz::Version::V3).unwrap(), 40),
        read: |path| Scene::open(path, true).map(drop),
        most: packed,
        prefixes_fail: true,
    },
    Reader {
        name: "splats.spz",
        write: |path| assert_eq!(spz::write(path, &gaussians(3), spz::Version::V4).unwrap(), 40),
        read: |path| Scene::open(path, true).map(drop),
        most: packed,
        prefixes_fail: true,
    },
    Reader {
        name: "moving.spz",
        write: |path| {
            let scene = scene();
            assert_eq!(spz::write_moving(path, &scene, &scene.gaussians).unwrap(), 40);
        },
        read: |path| Scene::open(path, true).map(drop),
        most: packed,
        prefixes_fail: true,
    },
    Reader {
        name: "splats.sog",
        write: |path| fs::write(path, bundle()).unwrap(),
        read: |path| sog::read(path, true).map(drop),
        most: packed,
        prefixes_fail: true,
    },
    Reader {
        name: "fuzzed.json",
        write: |path| fs::write(path, file::text(&draw(3, 5))).unwrap(),
        read: |path| file::read(path).map(drop),
        most: plain,
        prefixes_fail: false,
    },
    Reader {
        name: "checkpoint",
        write: |path| write_state(path, "training", &Identity::new(), &gaussians(1)).unwrap(),
        read: |path| read_state::<Gaussians>(path, "training", &Identity::new()).map(drop),
        most: plain,
        prefixes_fail: true,
    },
    Reader {
        name: "transforms.json",
        write: |path| {
            let cameras: Vec<TimedCamera> = (0..6)
                .map(|i| TimedCamera { time: f64::from(i) / 5.0, camera: some_camera(i) })
                .collect();
            let files: Vec<String> = (0..6).map(|i| format!("{i}.png")).collect();
            transforms::write(path, &cameras, &files, None).unwrap();
        },
        read: |path| transforms::read_cameras(path).map(drop),
        most: plain,
        prefixes_fail: false,
    },
    Reader {
        name: "intrinsics.json",
        write: |path| intrinsics::write(path, &some_camera(0).intrinsics).unwrap(),
        read: |path| intrinsics::read(path).map(drop),
        most: plain,
        prefixes_fail: false,
    },
    Reader {
        name: "poses.txt",
        write: |path| trajectory::write(path, &poses()).unwrap(),
        read: |path| trajectory::read(path, None).map(drop),
        most: plain,
        prefixes_fail: false,
    },
    Reader {
        name: "flow.flo",
        write: |path| flo::write(path, &ramp(31, 17, 2)).unwrap(),
        read: |path| flo::read(path).map(drop),
        most: plain,
        prefixes_fail: true,
    },
    Reader {
        name: "tracks.npz",
        write: |path| tracks::write(path, &point_paths()).unwrap(),
        read: |path| tracks::read(path).map(drop),
        most: packed,
        prefixes_fail: true,
    },
    Reader {
        name: "depth.exr",
        write: |path| exr::write_depth(path, &ramp(33, 20, 1)).unwrap(),
        read: |path| exr::read_depth(path).map(drop),
        most: packed,
        prefixes_fail: true,
    },
    Reader {
        name: "colour.exr",
        write: |path| exr::write_rgba(path, &ramp(20, 33, 4)).unwrap(),
        read: |path| exr::read_rgba(path).map(drop),
        most: packed,
        prefixes_fail: true,
    },
    Reader {
        name: "picture.png",
        write: |path| write_png(path, &picture(24, 18, 1)).unwrap(),
        read: |path| images::decode_rgb(path, [0.0; 3], images::Orientation::Upright).map(drop),
        most: packed,
        prefixes_fail: false,
    },
    Reader {
        name: "poses_bounds.npy",
        write: |path| {
            let row = [
                [0.0, 1.0, 0.0, 0.5, 30.0],
                [1.0, 0.0, 0.0, 1.5, 40.0],
                [0.0, 0.0, -1.0, 2.5, 50.0],
            ];
            let row: Vec<f64> = row.concat().into_iter().chain([1.0, 9.0]).collect();
            let header = "{'descr': '<f8', 'fortran_order': False, 'shape': (20, 17), }";
            let mut bytes = b"\x93NUMPY\x01\x00\x76\x00".to_vec();
            bytes.extend(format!("{header:<117}\n").bytes());
            (0..20).for_each(|_| row.iter().for_each(|v| bytes.extend(v.to_le_bytes())));
            fs::write(path, bytes).unwrap();
        },
        read: |path| poses_bounds::read_rows(path).map(drop),
        most: plain,
        prefixes_fail: true,
    },
    Reader {
        name: "nerfies.json",
        write: |path| {
            let camera = r#"{"orientation": [[1, 0, 0], [0, 1, 0], [0, 0, 1]], "position": [1.5, 2, 3],
                "focal_length": 55.5, "principal_point": [20, 15], "image_size": [40, 30],
                "radial_distortion": [0.01, 0, 0], "tangential": [0, 0.001]}"#;
            fs::write(path, camera).unwrap();
        },
        read: |path| {
            let (center, scale) = (DVec3::new(1.0, 2.0, 3.0), 0.1);
            nerfies::read_camera(path, &nerfies::Scene { center, scale, near: 0.1, far: 1.0 })
                .map(drop)
        },
        most: plain,
        prefixes_fail: true,
    },
    Reader {
        name: "depth.dpt",
        write: |path| {
            let mut bytes =
                [202_021.25f32.to_le_bytes(), 9i32.to_le_bytes(), 7i32.to_le_bytes()].concat();
            (0..63).for_each(|i| bytes.extend((i as f32).to_le_bytes()));
            fs::write(path, bytes).unwrap();
        },
        read: |path| dpt::read(path).map(drop),
        most: plain,
        prefixes_fail: true,
    },
    Reader {
        name: "mask.png",
        write: |path| images::write_mask(path, &ramp(16, 16, 1)).unwrap(),
        read: |path| images::read_mask(path).map(drop),
        most: packed,
        prefixes_fail: false,
    },
];

/// Reads a file, and checks the allocated bytes against the bound.
fn attempt(reader: &Reader, path: &Path, size: usize) -> bool {
    let before = NOW.load(Ordering::Relaxed);
    PEAK.store(before, Ordering::Relaxed);
    let result = (reader.read)(path);
    let took = PEAK.load(Ordering::Relaxed).saturating_sub(before);
    let most = (reader.most)(size);
    assert!(took <= most, "{}: {took} bytes for a file of {size}, {most} allowed", reader.name);
    if let Err(error) = &result {
        let said = error.to_string();
        assert!(said.contains(reader.name), "the file is not named: {said}");
    }
    result.is_ok()
}

/// A mutated copy: a few bytes changed, numbers made huge, parts doubled, cut out and swapped.
fn mutated(original: &[u8], dice: &mut Dice) -> Vec<u8> {
    let mut bytes = original.to_vec();
    for _ in 0..1 + dice.roll(4) {
        // Headers are short and matter most.
        let within = if dice.roll(2) == 0 { bytes.len().min(512) } else { bytes.len() };
        let at = dice.roll(within.max(1));
        match dice.roll(8) {
            0..=3 => bytes[at] = [0, 1, 0x7f, 0x80, 0xff, dice.roll(256) as u8][dice.roll(6)],
            4 => {
                let word = [0u32, 1, 0x7fff_ffff, 0xffff_ffff, 0x4000_0000][dice.roll(5)];
                let end = (at + 4).min(bytes.len());
                bytes[at..end].copy_from_slice(&word.to_le_bytes()[..end - at]);
            }
            5 => {
                let digits = [&b"9"[..], b"-", b"99999999999999999999", b"1e999", b"NaN", b"\0"];
                let chosen = digits[dice.roll(digits.len())];
                bytes.splice(at..at, chosen.iter().copied());
            }
            6 => {
                let end = (at + 1 + dice.roll(64)).min(bytes.len());
                let part = bytes[at..end].to_vec();
                bytes.splice(at..at, part);
            }
            _ => {
                let end = (at + 1 + dice.roll(64)).min(bytes.len());
                bytes.drain(at..end);
            }
        }
        if bytes.is_empty() {
            bytes.push(0);
        }
    }
    bytes
}

#[test]
fn damaged_files_are_refused_cheaply() {
    let folder = tempfile::tempdir().unwrap();
    for (number, reader) in READERS.iter().enumerate() {
        let path: PathBuf = folder.path().join(reader.name);
        (reader.write)(&path);
        let original = fs::read(&path).unwrap();
        assert!(attempt(reader, &path, original.len()), "{}: the whole file", reader.name);
        let step = (original.len() / 200).max(1);
        for length in (0..original.len()).step_by(step) {
            fs::write(&path, &original[..length]).unwrap();
            let fine = attempt(reader, &path, length);
            assert!(!(fine && reader.prefixes_fail), "{} of {length} bytes", reader.name);
        }
        let mut dice = Dice(number as u64 + 1);
        let mut refused = 0;
        for _ in 0..1500 {
            let bytes = mutated(&original, &mut dice);
            fs::write(&path, &bytes).unwrap();
            refused += usize::from(!attempt(reader, &path, bytes.len()));
        }
        println!("{}: {refused} of 1500 mutations refused", reader.name);
        assert!(refused > 0, "{}: damage must show somewhere", reader.name);
    }
    colmap_models(folder.path());
}

/// A model is three files; each is damaged in turn.
fn colmap_models(folder: &Path) {
    let Some(fox) = support::shared("fox270") else { return };
    let Some(model) = [fox.join("sparse/0"), fox.join("sparse"), fox.clone()]
        .into_iter()
        .find(|folder| folder.join("cameras.bin").exists() || folder.join("cameras.txt").exists())
    else {
        panic!("fox270 has a COLMAP model");
    };
    let copy = folder.join("model");
    fs::create_dir(&copy).unwrap();
    let files: Vec<PathBuf> = fs::read_dir(&model).unwrap().map(|e| e.unwrap().path()).collect();
    for file in files.iter().filter(|file| file.is_file()) {
        fs::copy(file, copy.join(file.file_name().unwrap())).unwrap();
    }
    let size: u64 = files.iter().filter_map(|f| fs::metadata(f).ok()).map(|m| m.len()).sum();
    for stem in ["cameras", "images"] {
        let path = ["bin", "txt"]
            .map(|extension| copy.join(format!("{stem}.{extension}")))
            .into_iter()
            .find(|path| path.exists())
            .unwrap();
        let original = fs::read(&path).unwrap();
        let mut dice = Dice(99);
        for _ in 0..60 {
            fs::write(&path, mutated(&original, &mut dice)).unwrap();
            let before = NOW.load(Ordering::Relaxed);
            PEAK.store(before, Ordering::Relaxed);
            let _ = colmap::read_model(&copy);
            let took = PEAK.load(Ordering::Relaxed).saturating_sub(before);
            assert!(took <= plain(size as usize), "{stem}: {took} bytes for {size}");
        }
        fs::write(&path, &original).unwrap();
    }
}

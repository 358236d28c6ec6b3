//! The scene file and 3DGS PLY: round trips, variants that other programs write, and damage.

mod common;
mod support;

use std::fs;
use std::path::Path;

use glam::{DQuat, DVec3};
use serde_json::{Value, json};
use splat4d::scene::{Scene, SceneCamera, ply};
use splat4d::types::{
    Camera, ControlPoints, DeformNet, Gaussians, Intrinsics, NetShape, Pose, RenderSettings,
    sh_coefficients,
};
use support::{Dice, compressed, message, says};

/// A different value at each call.
struct Numbers(f32);

impl Numbers {
    fn next(&mut self) -> f32 {
        self.0 += 0.377;
        (self.0 * 1.7).sin() * 3.0
    }
    fn row<const N: usize>(&mut self) -> [f32; N] {
        std::array::from_fn(|_| self.next())
    }
    fn rows<const N: usize>(&mut self, n: usize) -> Vec<[f32; N]> {
        (0..n).map(|_| self.row()).collect()
    }
}

fn gaussians(n: usize, sh_degree: u32) -> Gaussians {
    let mut numbers = Numbers(sh_degree as f32);
    Gaussians {
        positions: numbers.rows(n),
        log_scales: numbers.rows(n),
        rotations: numbers.rows(n),
        opacity_logits: numbers.rows::<1>(n).concat(),
        sh_degree,
        sh: numbers.rows(n * sh_coefficients(sh_degree)),
        motion_logits: Vec::new(),
    }
}

fn dynamic_scene() -> Scene {
    let mut numbers = Numbers(9.0);
    let shape = NetShape {
        depth: 3,
        width: 16,
        skip: 1,
        position_frequencies: 2,
        time_frequencies: 1,
        ..NetShape::PAPER
    };
    let mut g = gaussians(7, 2);
    g.motion_logits = numbers.rows::<1>(7).concat();
    let camera = |i: u32| SceneCamera {
        time: f64::from(i) / 3.0,
        camera: Camera {
            intrinsics: Intrinsics {
                fx: 300.25,
                fy: 301.5,
                cx: 160.1,
                cy: 90.3,
                width: 320,
                height: 180,
            },
            view_from_world: Pose::new(
                DQuat::from_rotation_y(0.3 * f64::from(i)),
                DVec3::new(1.0 / 3.0, f64::from(i), 1e-9),
            ),
        },
    };
    let parameters = (0..shape.parameters()).map(|_| numbers.next()).collect();
    Scene {
        gaussians: g,
        control_points: ControlPoints {
            positions: numbers.rows(5),
            log_radii: numbers.rows::<1>(5).concat(),
            paths: vec![],
        },
        network: Some(DeformNet { shape, parameters }),
        settings: RenderSettings { near: 0.2, alpha_cap: 0.99, ..RenderSettings::default() },
        neighbours: 3,
        cameras: (0..4).map(camera).collect(),
        background: [0.1, 0.2, 1.0],
        up: [0.0, 0.6, 0.8],
        report: json!({ "psnr": 23.5, "note": "é \"quoted\"", "list": [1, 2, null] }),
    }
}

// ---------------------------------------------------------------------------------------------
// The scene's file
// ---------------------------------------------------------------------------------------------

#[test]
fn scene_round_trips_exactly() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.safetensors");
    let empty = Scene::default();
    let still = Scene::of(gaussians(3, 0));
    for scene in [dynamic_scene(), on_paths(), still, empty] {
        scene.save(&path).unwrap();
        let opened = Scene::open(&path, false).unwrap();
        assert_eq!(opened.scene, scene);
        assert_eq!(opened.dropped, 0);
        let first = fs::read(&path).unwrap();
        scene.save(&path).unwrap();
        assert_eq!(fs::read(&path).unwrap(), first, "the same scene gives the same bytes");
    }
}

/// The dynamic scene, with control points that move along paths with three key times.
fn on_paths() -> Scene {
    let mut scene = dynamic_scene();
    scene.network = None;
    scene.control_points.paths =
        (0..15).map(|i| std::array::from_fn(|k| (i * 8 + k) as f32 / 77.0)).collect();
    scene
}

#[test]
fn paths_are_read_and_refused_as_they_should() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.safetensors");
    let scene = on_paths();
    assert_eq!(scene.control_points.keys(), 3);
    assert!(scene.moves() && scene.check().is_ok());
    scene.save(&path).unwrap();
    let bytes = fs::read(&path).unwrap();
    let file = safetensors::SafeTensors::deserialize(&bytes).unwrap();
    assert_eq!(file.tensor("control_points.path").unwrap().shape(), [3, 5, 8]);

    let mut uneven = scene.clone();
    uneven.control_points.paths.pop();
    says(&message(uneven.save(&path)), &["control_points.paths"]);
    says(&uneven.check().unwrap_err(), &["14 motions", "5 control points"]);
    let mut wild = scene.clone();
    wild.control_points.paths[7][2] = f32::NAN;
    says(&wild.check().unwrap_err(), &["control point 2", "motion on its path"]);
    wild.save(&path).unwrap();
    says(&message(Scene::open(&path, false)), &["control_points.path", "1 NaN"]);
    let both = Scene { network: dynamic_scene().network, ..scene };
    says(&both.check().unwrap_err(), &["not by both"]);
    both.save(&path).unwrap();
    says(&message(Scene::open(&path, false)), &["not by both"]);
}

#[test]
fn scene_is_plain_safetensors() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.safetensors");
    let scene = dynamic_scene();
    scene.save(&path).unwrap();
    let bytes = fs::read(&path).unwrap();
    let file = safetensors::SafeTensors::deserialize(&bytes).unwrap();
    assert_eq!(file.tensor("gaussians.sh").unwrap().shape(), [7, 9, 3]);
    assert_eq!(file.tensor("cameras.view_from_world").unwrap().shape(), [4, 7]);
    // Inputs: 3·(1 + 2·2) + 1 + 2·1 = 18; layer 2 gets them again.
    assert_eq!(file.tensor("network.2.weight").unwrap().shape(), [16, 34]);
    assert_eq!(file.tensor("network.3.bias").unwrap().shape(), [7]);
    let x = file.tensor("gaussians.position").unwrap().data()[..4].try_into().unwrap();
    assert_eq!(f32::from_le_bytes(x), scene.gaussians.positions[0][0]);
    let base = bytes.len() - file.iter().map(|(_, t)| t.data().len()).sum::<usize>();
    for (name, tensor) in file.iter() {
        let at = tensor.data().as_ptr() as usize - bytes.as_ptr() as usize - base;
        assert_eq!(at % (tensor.dtype().bitsize() / 8), 0, "{name} is not aligned");
    }
    assert_eq!(base % 8, 0);
}

#[test]
fn parts_that_do_not_belong_together_are_not_written() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.safetensors");
    let mut scene = dynamic_scene();
    scene.gaussians.rotations.pop();
    says(&message(scene.save(&path)), &["rotations", "6", "7"]);
    let mut scene = dynamic_scene();
    scene.network.as_mut().unwrap().parameters.pop();
    says(&message(scene.save(&path)), &["network.parameters"]);
    says(&message(ply::write(&path, &Gaussians { sh_degree: 3, ..gaussians(2, 1) })), &["sh"]);
    assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 0);
}

/// Writes a scene with its header changed.
fn with_header(path: &Path, change: impl Fn(&mut Value)) {
    dynamic_scene().save(path).unwrap();
    let bytes = fs::read(path).unwrap();
    let length = u64::from_le_bytes(bytes[..8].try_into().unwrap()) as usize;
    let mut header: Value = serde_json::from_slice(&bytes[8..8 + length]).unwrap();
    change(&mut header);
    let header = header.to_string();
    let mut out = (header.len() as u64).to_le_bytes().to_vec();
    out.extend(header.bytes());
    out.extend(&bytes[8 + length..]);
    fs::write(path, out).unwrap();
}

#[test]
fn other_versions_and_other_files_are_told() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.safetensors");
    let changed = |change: &dyn Fn(&mut Value)| {
        with_header(&path, change);
        message(Scene::open(&path, true))
    };
    let newer = changed(&|h| h["__metadata__"]["version"] = json!("4"));
    says(&newer, &["a.safetensors", "newer splat4d (format version 4)", "up to version 3"]);
    // A newer version may differ in everything else.
    let newer = changed(&|h| {
        h["__metadata__"]["version"] = json!("7");
        h["gaussians.position"]["dtype"] = json!("F6");
    });
    says(&newer, &["format version 7"]);
    says(&changed(&|h| h["__metadata__"]["version"] = json!("x")), &["no version"]);
    says(&changed(&|h| h["__metadata__"]["format"] = json!("pt")), &["not a splat4d scene"]);
    says(
        &changed(&|h| drop(h.as_object_mut().unwrap().remove("__metadata__"))),
        &["not a splat4d"],
    );
    says(&changed(&|h| h["__metadata__"]["settings"] = json!("{}")), &["settings", "near"]);
    says(&changed(&|h| h["__metadata__"]["neighbours"] = json!("-1")), &["neighbours"]);
    says(&changed(&|h| h["__metadata__"]["up"] = json!("[1, 2]")), &["up", "three numbers"]);
    says(&changed(&|h| h["gaussians.sh"]["shape"] = json!([7, 27])), &["gaussians.sh", "27"]);
    says(&changed(&|h| h["gaussians.rotation"]["shape"] = json!([4, 7])), &["[4, 7]", "[7, 4]"]);
    let net = |key: &str, value: u64| {
        let mut net = json!({
            "depth": 3, "width": 16, "skip": 1, "position_frequencies": 2, "time_frequencies": 1
        });
        net[key] = json!(value);
        changed(&|h| h["__metadata__"]["network"] = json!(net.to_string()))
    };
    says(&net("depth", 4_000_000_000), &["depth"]);
    says(&net("skip", u64::from(u32::MAX)), &["skip"]);
    says(&net("depth", 9), &["network."]);
    let rename = |h: &mut Value| {
        let tensor = h.as_object_mut().unwrap().remove("control_points.log_radius").unwrap();
        h["x"] = tensor;
    };
    says(&changed(&rename), &["lacks the tensor control_points.log_radius"]);
    // Harmless additions of a later version are ignored.
    with_header(&path, |h| h["__metadata__"]["later"] = json!("more"));
    assert!(Scene::open(&path, false).is_ok());

    fs::write(&path, b"hello, this is no scene").unwrap();
    says(&message(Scene::open(&path, false)), &["neither"]);
    fs::write(&path, b"").unwrap();
    says(&message(Scene::open(&path, false)), &["cut off"]);
    says(&message(Scene::open(folder.path().join("absent"), false)), &["absent"]);
    says(&message(Scene::open(folder.path(), false)), &["is a folder"]);
}

#[test]
fn not_a_number_in_a_scene() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.safetensors");
    let mut scene = dynamic_scene();
    scene.gaussians.positions[2][1] = f32::NAN;
    scene.gaussians.sh[9 * 4 + 8][2] = f32::INFINITY;
    scene.gaussians.motion_logits[4] = f32::NAN;
    scene.save(&path).unwrap();
    says(&message(Scene::open(&path, false)), &["2 of 7", "NaN", "drop_bad"]);
    let opened = Scene::open(&path, true).unwrap();
    assert_eq!((opened.dropped, opened.scene.gaussians.len()), (2, 5));
    let (left, all) = (&opened.scene.gaussians, &scene.gaussians);
    for (i, j) in [0, 1, 3, 5, 6].into_iter().enumerate() {
        assert_eq!(left.positions[i], all.positions[j]);
        assert_eq!(left.motion_logits[i], all.motion_logits[j]);
        assert_eq!(left.sh[9 * i..9 * i + 9], all.sh[9 * j..9 * j + 9]);
    }
    // Bad values in parts that all Gaussians share cannot be left out.
    let mut scene = dynamic_scene();
    scene.network.as_mut().unwrap().parameters[3] = f32::NAN;
    scene.save(&path).unwrap();
    says(&message(Scene::open(&path, true)), &["network.0.weight", "1 NaN"]);
}

/// Every strict prefix fails; files with some bytes changed do not panic.
fn damage(path: &Path, rounds: usize) {
    let original = fs::read(path).unwrap();
    for length in (0..original.len()).step_by((original.len() / 300).max(1)) {
        fs::write(path, &original[..length]).unwrap();
        // ASCII ends in white space that is not needed.
        if original[length..].trim_ascii().is_empty() {
            continue;
        }
        assert!(Scene::open(path, true).is_err(), "{length} of {} bytes", original.len());
    }
    let mut dice = Dice(11);
    for _ in 0..rounds {
        let mut bytes = original.clone();
        for _ in 0..1 + dice.roll(3) {
            let within = if dice.roll(3) > 0 { bytes.len().min(2048) } else { bytes.len() };
            let at = dice.roll(within);
            bytes[at] = match dice.roll(3) {
                0 => b'0' + dice.roll(10) as u8,
                1 => [0, 0xff, b'"', b'}', b' ', b'-'][dice.roll(6)],
                _ => dice.roll(256) as u8,
            };
        }
        fs::write(path, &bytes).unwrap();
        let drop_bad = dice.roll(2) == 0;
        // Only checks that the call returns: a file with a changed float may be valid.
        let _ = Scene::open(path, drop_bad);
    }
}

#[test]
fn damaged_scenes_fail_cleanly() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.safetensors");
    dynamic_scene().save(&path).unwrap();
    damage(&path, 800);
    dynamic_scene().save(&path).unwrap();
    let whole = fs::read(&path).unwrap();
    fs::write(&path, &whole[..whole.len() - 1]).unwrap();
    says(&message(Scene::open(&path, false)), &["a.safetensors", "cut off"]);
}

#[test]
fn up_is_the_cameras_mean() {
    let mut scene = dynamic_scene();
    scene.set_up_from_cameras();
    // The cameras rotate about y only.
    assert_eq!(scene.up, [0.0, -1.0, 0.0]);
    scene.cameras.clear();
    scene.up = [1.0, 0.0, 0.0];
    scene.set_up_from_cameras();
    assert_eq!(scene.up, [1.0, 0.0, 0.0]);
}

// ---------------------------------------------------------------------------------------------
// PLY
// ---------------------------------------------------------------------------------------------

#[test]
fn ply_round_trips_exactly() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.ply");
    for degree in 0..=3 {
        for n in [0, 1, 5] {
            let g = gaussians(n, degree);
            ply::write(&path, &g).unwrap();
            assert_eq!(ply::read(&path, false).unwrap(), (g.clone(), 0));
            assert_eq!(Scene::open(&path, false).unwrap().scene.gaussians, g);
        }
    }
}

#[test]
fn ply_is_laid_out_as_3dgs_does() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.ply");
    let g = gaussians(2, 1);
    ply::write(&path, &g).unwrap();
    let bytes = fs::read(&path).unwrap();
    let end = bytes.windows(11).position(|w| w == b"end_header\n").unwrap() + 11;
    let header = std::str::from_utf8(&bytes[..end]).unwrap();
    let names: Vec<_> = header.lines().filter_map(|l| l.strip_prefix("property float ")).collect();
    assert_eq!(
        names.join(" "),
        "x y z nx ny nz f_dc_0 f_dc_1 f_dc_2 f_rest_0 f_rest_1 f_rest_2 f_rest_3 f_rest_4 f_rest_5 \
         f_rest_6 f_rest_7 f_rest_8 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3"
    );
    let row = |i: usize| -> Vec<f32> {
        let bytes = &bytes[end + 4 * names.len() * i..][..4 * names.len()];
        bytes.as_chunks().0.iter().map(|b| f32::from_le_bytes(*b)).collect()
    };
    assert_eq!(bytes.len(), end + 2 * 4 * names.len());
    // Channel-major: red of bands 1 to 3, then green, then blue.
    let rest: Vec<f32> =
        (0..3).flat_map(|c| (1..4).map(move |k| (c, k))).map(|(c, k)| g.sh[4 + k][c]).collect();
    assert_eq!(row(1)[9..18], rest);
    assert_eq!(row(1)[..3], g.positions[1]);
    assert_eq!(row(1)[22..26], g.rotations[1]);
}

/// Names and values of a degree-0 Gaussian in an unusual order, with unknown properties among them.
const ODD: [(&str, f64); 16] = [
    ("rot_3", 4.0),
    ("opacity", -0.5),
    ("f_dc_2", 0.75),
    ("f_dc_0", 0.25),
    ("f_dc_1", 0.5),
    ("z", 30.0),
    ("x", 10.0),
    ("y", 20.0),
    ("rot_0", 1.0),
    ("rot_1", 2.0),
    ("rot_2", 3.0),
    ("stranger", 77.0),
    ("scale_2", -3.0),
    ("scale_1", -2.0),
    ("scale_0", -1.0),
    ("id", 9.0),
];

fn odd_ply(format: &str, rows: usize) -> Vec<u8> {
    let mut out = format!("ply\nformat {format} 1.0\ncomment by hand\nelement camera 2\n");
    out += "property uchar a\nproperty list uchar int b\nelement vertex ";
    out += &format!("{rows}\n");
    for (name, _) in ODD {
        let kind = match name {
            "x" => "double",
            "stranger" => "ushort",
            "id" => "list uchar short",
            "rot_0" => "int",
            _ => "float32",
        };
        out += &format!("property {kind} {name}\n");
    }
    out += "end_header\n";
    let mut out = out.into_bytes();
    let ascii = format == "ascii";
    let little = format == "binary_little_endian";
    let mut put = |bytes: &[u8], text: String| {
        if ascii {
            out.extend(text.bytes());
        } else if little {
            out.extend(bytes);
        } else {
            out.extend(bytes.iter().rev());
        }
    };
    for _ in 0..2 {
        put(&[5], "5 ".into());
        put(&[1], "1 ".into());
        put(&6i32.to_le_bytes(), "-6\n".into());
    }
    for _ in 0..rows {
        for (name, value) in ODD {
            let text = format!("{value} ");
            match name {
                "x" => put(&value.to_le_bytes(), text),
                "stranger" => put(&(value as u16).to_le_bytes(), text),
                "rot_0" => put(&(value as i32).to_le_bytes(), text),
                "id" => {
                    put(&[2], "2 ".into());
                    put(&8i16.to_le_bytes(), "8 ".into());
                    put(&8i16.to_le_bytes(), "8\n".into());
                }
                _ => put(&(value as f32).to_le_bytes(), text),
            }
        }
    }
    out
}

#[test]
fn ply_of_other_programs() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.ply");
    for format in ["ascii", "binary_little_endian", "binary_big_endian"] {
        fs::write(&path, odd_ply(format, 3)).unwrap();
        let (g, dropped) = ply::read(&path, false).unwrap();
        assert_eq!((g.len(), dropped, g.sh_degree), (3, 0, 0), "{format}");
        assert_eq!(g.positions[2], [10.0, 20.0, 30.0], "{format}");
        assert_eq!(g.rotations[2], [1.0, 2.0, 3.0, 4.0], "{format}");
        assert_eq!(g.log_scales[1], [-1.0, -2.0, -3.0], "{format}");
        assert_eq!(g.sh[2], [0.25, 0.5, 0.75], "{format}");
        assert_eq!(g.opacity_logits, [-0.5; 3], "{format}");
        damage(&path, 300);
    }
    // Lines may end with CRLF.
    let text = String::from_utf8(odd_ply("ascii", 2)).unwrap().replace('\n', "\r\n");
    fs::write(&path, text).unwrap();
    assert_eq!(ply::read(&path, false).unwrap().0.len(), 2);
}

#[test]
fn truncated_ply_names_the_vertex() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.ply");
    ply::write(&path, &gaussians(10, 3)).unwrap();
    let bytes = fs::read(&path).unwrap();
    // 62 floats per vertex; the last two and a half vertices are cut off.
    fs::write(&path, &bytes[..bytes.len() - 620]).unwrap();
    let end = format!("byte {}", bytes.len() - 620);
    says(&message(Scene::open(&path, true)), &["a.ply", "truncated", "vertex 7 of 10", &end]);
    fs::write(&path, &bytes[..100]).unwrap();
    says(&message(Scene::open(&path, true)), &["truncated", "no end_header"]);
    ply::write(&path, &gaussians(10, 3)).unwrap();
    damage(&path, 800);
}

#[test]
fn announced_sizes_do_not_take_memory() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.ply");
    for count in ["18446744073709551615", "9999999999999", "99999999999999999999999", "-1"] {
        for format in ["ascii", "binary_little_endian"] {
            let text = String::from_utf8_lossy(&odd_ply(format, 0))
                .replace("element vertex 0", &format!("element vertex {count}"));
            fs::write(&path, text).unwrap();
            assert!(ply::read(&path, false).is_err());
        }
    }
    // Elements without properties take no bytes, whatever their count.
    let bytes = String::from_utf8(odd_ply("ascii", 1)).unwrap();
    let bytes =
        bytes.replace("element camera 2", "element nothing 18446744073709551615\nelement camera 2");
    fs::write(&path, bytes).unwrap();
    assert_eq!(ply::read(&path, false).unwrap().0.len(), 1);
}

#[test]
fn ply_that_is_something_else_is_told() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.ply");
    let header = |properties: &str| {
        let names = properties.split(' ').map(|p| format!("property float {p}\n"));
        let head = "ply\nformat ascii 1.0\nelement vertex 0\n";
        fs::write(&path, format!("{head}{}end_header\n", names.collect::<String>())).unwrap();
        message(ply::read(&path, false))
    };
    says(&header("x y z red green blue"), &["point cloud"]);
    says(&header("packed_position"), &["compressed PLY", "no element `chunk`"]);
    says(&header("x y z"), &["not a 3DGS PLY", "`opacity`"]);
    let all = "x y z opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3 f_dc_0 f_dc_1 f_dc_2";
    says(&header(&format!("{all} f_rest_0")), &["1 f_rest_*"]);
    says(&header(&format!("{all} f_rest_0").replace("rot_2", "rot_9")), &["f_rest"]);
    let nine = (1..10).map(|i| format!("f_rest_{i}")).collect::<Vec<_>>().join(" ");
    says(&header(&format!("{all} {nine}")), &["no `f_rest_0`"]);
    fs::write(&path, "ply\nformat ascii 1.0\nelement face 0\nend_header\n").unwrap();
    says(&message(ply::read(&path, false)), &["no element `vertex`"]);
    fs::write(&path, "ply\nformat ascii 1.0\nproperty float x\nend_header\n").unwrap();
    says(&message(ply::read(&path, false)), &["header line 3"]);
    fs::write(&path, "ply\nelement vertex 0\nend_header\n").unwrap();
    says(&message(ply::read(&path, false)), &["no format"]);
}

#[test]
fn a_compressed_ply_unfolds() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.ply");
    // The largest value, the smallest, and the closest to the middle in 11 bits.
    let position = 2047 << 21 | 1023;
    // w is largest; x = 1/√2 · (1023/1023 − 0.5) · 2 = 1/√2, y = z ≈ 0.
    let rotation = 1023 << 20 | 511 << 10 | 512;
    let words = [position, rotation, position, 0xff80_00ffu32];
    fs::write(&path, compressed(300, words, &[0, 255, 128, 0, 0, 0, 255, 255, 255])).unwrap();
    let g = Scene::open(&path, false).unwrap().scene.gaussians;
    assert_eq!((g.len(), g.sh_degree), (300, 1));
    let near = |a: &[f32], b: &[f32]| a.iter().zip(b).all(|(a, b)| (a - b).abs() < 2e-3);
    assert!(near(&g.positions[0], &[1.0, 0.0, 0.5]), "{:?}", g.positions[0]);
    assert!(near(&g.positions[256], &[1.0, 0.0, 1.5]), "the second chunk's bounds");
    assert!(near(&g.log_scales[0], &[-2.0, -5.0, -2.0]), "{:?}", g.log_scales[0]);
    let half = std::f32::consts::FRAC_1_SQRT_2;
    assert!(near(&g.rotations[0], &[half, half, 0.0, 0.0]), "{:?}", g.rotations[0]);
    let c0 = splat4d::types::SH_C0;
    assert!(near(&g.sh[0], &[0.5 / c0, (2.0 * 128.0 / 255.0 - 0.5) / c0, -0.5 / c0]));
    assert!(near(&g.sh[1], &[-4.0, -4.0, 4.0]), "channel-major: {:?}", g.sh[1]);
    assert!(near(&g.sh[2], &[4.0, -4.0, 4.0]), "{:?}", g.sh[2]);
    assert!(g.opacity_logits[0].is_finite() && g.opacity_logits[0] > 5.0);
}

#[test]
fn a_broken_compressed_ply_is_told() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.ply");
    let whole = compressed(300, [0; 4], &[]);
    for end in [whole.len() - 1, whole.len() - 16 * 300 - 1] {
        fs::write(&path, &whole[..end]).unwrap();
        says(&message(ply::read(&path, false)), &["truncated"]);
    }
    let text = String::from_utf8_lossy(&whole).into_owned();
    let head = &text[..text.find("end_header").unwrap()];
    for (from, to, what) in [
        ("element chunk 2", "element chunk 1", "300 vertices in 1 chunks"),
        ("float min_scale_y", "float min_scale_w", "no number `min_scale_y`"),
        ("uint packed_scale", "list uchar uint packed_scale", "no number `packed_scale`"),
    ] {
        let mut bytes = head.replace(from, to).into_bytes();
        bytes.extend(&whole[head.len()..]);
        fs::write(&path, bytes).unwrap();
        says(&message(ply::read(&path, false)), &[what]);
    }
    fs::write(&path, compressed(3, [0; 4], &[1, 2])).unwrap();
    says(&message(ply::read(&path, false)), &["2 f_rest_*"]);
}

/// 152,746 Gaussians, the same model as in a file of another format.
#[test]
fn biker_unfolds() {
    let Some(path) = common::shared_data("splats_playcanvas/biker.compressed.ply") else { return };
    let g = Scene::open(&path, false).unwrap().scene.gaussians;
    assert_eq!((g.len(), g.sh_degree), (152_746, 0));
    assert!(g.rotations.iter().all(|q| (q.iter().map(|c| c * c).sum::<f32>() - 1.0).abs() < 1e-3));
}

#[test]
fn not_a_number_in_a_ply() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.ply");
    let mut g = gaussians(6, 1);
    g.opacity_logits[1] = f32::NAN;
    g.sh[4 * 5 + 3][0] = f32::NEG_INFINITY;
    ply::write(&path, &g).unwrap();
    says(&message(Scene::open(&path, false)), &["a.ply", "2 of 6", "NaN", "drop_bad"]);
    let opened = Scene::open(&path, true).unwrap();
    assert_eq!((opened.dropped, opened.scene.gaussians.len()), (2, 4));
    assert_eq!(opened.scene.gaussians.positions[1], g.positions[2]);
    assert_eq!(opened.scene.gaussians.sh[4..8], g.sh[8..12]);
}

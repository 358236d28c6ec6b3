//! Scenes in other programs' formats: written here and read by splat-transform, written by it and read
//! here, and converted through the command line.

#[path = "support/program.rs"]
mod program;
#[path = "support/splats.rs"]
mod splats;
mod support;

use std::fs;
use std::path::Path;

use program::{fails, json, run, stderr};
use splat4d::gpu::{Device, Request, Selector};
use splat4d::renderer::Renderer;
use splat4d::scene::{Format, Scene, ply, spz};
use splat4d::types::Gaussians;
use splats::{
    Apart, SPZ_IN_GLB, SplatV, apart, attributes, cloud, glb, moving, spz_in_glb, transformed,
    validated,
};
use support::{says, shared};

fn open(path: &Path) -> Gaussians {
    Scene::open(path, false).unwrap().scene.gaussians
}

fn device() -> Device {
    let selector = Selector::from("software");
    Device::open(&Request { selector, ..Request::default() }).unwrap()
}

/// Checks that Gaussians differ by no more than a format's quantisation steps.
#[track_caller]
fn within(name: &str, found: &Apart, most: &Apart) {
    println!("{name}: {found:?}");
    let pairs = [
        (found.position, most.position),
        (found.log_scale, most.log_scale),
        (found.rotation, most.rotation),
        (found.opacity, most.opacity),
        (found.colour, most.colour),
        (found.harmonic, most.harmonic),
    ];
    assert!(pairs.iter().all(|(found, most)| found <= most), "{name}: {found:?}, allowed {most:?}");
}

/// Bounds of compressed PLY: one step of 11 bits within a chunk of the cloud, and of 8 bits over the
/// cloud's range of colours.
const OF_COMPRESSED: Apart = Apart {
    position: 1.2e-3,
    log_scale: 1.0e-3,
    rotation: 2e-6,
    opacity: 0.0021,
    colour: 0.006,
    harmonic: 0.017,
};
/// Bounds of SPZ: scales in sixteenths, colours in 8 bits over ±3.3, spherical harmonics in 4 bits.
const OF_SPZ: Apart = Apart {
    position: 1.0e-3,
    log_scale: 0.0313,
    rotation: 2e-6,
    opacity: 0.0021,
    colour: 0.0132,
    harmonic: 0.067,
};
/// Bounds of `.splat`: quaternions in 8 bits per component; everything else is f32.
const OF_SPLAT: Apart = Apart {
    position: 0.0,
    log_scale: 1e-5,
    rotation: 2e-4,
    opacity: 0.0021,
    colour: 0.0071,
    harmonic: 0.0,
};

/// Bounds of SOG: positions in 16 bits, rotations in 8 bits per component, opacities in 8 bits, rounded
/// down; scales, colours and spherical harmonics from codebooks and a palette that were fitted to the
/// scene.
const OF_SOG: Apart = Apart {
    position: 1e-4,
    log_scale: 0.01,
    rotation: 1.2e-4,
    opacity: 0.004,
    colour: 0.02,
    harmonic: 0.02,
};

#[test]
fn another_program_reads_what_is_written() {
    let folder = tempfile::tempdir().unwrap();
    let formats = [
        (Format::Ply, 3, "a.ply", Apart { rotation: 1e-6, ..Apart::default() }),
        (Format::CompressedPly, 3, "b.compressed.ply", OF_COMPRESSED),
        (Format::CompressedPly, 0, "c.compressed.ply", OF_COMPRESSED),
        (Format::Splat, 0, "d.splat", OF_SPLAT),
        (Format::Spz(spz::Version::V3), 2, "e.spz", OF_SPZ),
        (Format::Spz(spz::Version::V4), 3, "f.spz", OF_SPZ),
        (Format::Spz(spz::Version::V4), 0, "g.spz", OF_SPZ),
    ];
    for (format, degree, name, most) in formats {
        let (written, g) = (folder.path().join(name), cloud(degree));
        assert_eq!(Format::of(&written).map(Format::extension), Some(format.extension()));
        assert_eq!(format.write(&written, &g).unwrap(), g.len());
        assert_eq!(format.encode(&g).unwrap().0, fs::read(&written).unwrap(), "{name}");
        within(&format!("{name} here"), &apart(&g, &open(&written)), &most);
        let theirs = transformed(&written, &folder.path().join(format!("{name}.back.ply")), &[]);
        let theirs = open(&theirs);
        // The other program leaves out spherical harmonics that are all 0.
        assert_eq!(theirs.sh_degree, degree);
        within(&format!("{name} there"), &apart(&g, &theirs), &most);
    }
}

#[test]
fn what_another_program_writes_is_read() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let g = cloud(3);
    ply::write(at("a.ply"), &g).unwrap();
    fs::create_dir(at("sog")).unwrap();
    for (name, options, most) in [
        ("b.compressed.ply", &[][..], OF_COMPRESSED),
        ("c.spz", &["--spz-version", "3"][..], OF_SPZ),
        ("d.spz", &["--spz-version", "4"][..], OF_SPZ),
    ] {
        let theirs = transformed(&at("a.ply"), &at(name), options);
        within(name, &apart(&g, &open(&theirs)), &most);
    }
    // A palette stores spherical harmonics that occur many times exactly.
    let mut g = g;
    let few: Vec<[f32; 3]> = g.sh[..8 * 16].to_vec();
    for (i, rows) in g.sh.chunks_exact_mut(16).enumerate() {
        rows[1..].copy_from_slice(&few[i % 8 * 16 + 1..][..15]);
    }
    ply::write(at("few.ply"), &g).unwrap();
    for name in ["e.sog", "sog/meta.json"] {
        let theirs = transformed(&at("few.ply"), &at(name), &[]);
        within(name, &apart(&g, &open(&theirs)), &OF_SOG);
    }
}

#[test]
fn one_scene_in_two_formats_agrees() {
    let Some(set) = shared("splats_playcanvas") else { return };
    let (ply, spz) = (open(&set.join("biker.compressed.ply")), open(&set.join("biker.spz")));
    assert_eq!(ply.len(), spz.len());
    // The bounds of the Gaussians in the two files agree along each axis.
    let bounds = |g: &Gaussians| {
        let fold = |with: fn(f32, f32) -> f32, c: usize| {
            g.positions.iter().map(|p| p[c]).reduce(with).unwrap()
        };
        [0, 1, 2].map(|c| [fold(f32::min, c), fold(f32::max, c)])
    };
    for (a, b) in bounds(&ply).as_flattened().iter().zip(bounds(&spz).as_flattened()) {
        assert!((a - b).abs() < 2e-3, "{a} {b}");
    }
    let mean = |g: &Gaussians| {
        let n = g.len() as f32;
        let opacity = g.opacity_logits.iter().map(|o| 1.0 / (1.0 + (-o).exp())).sum::<f32>() / n;
        let scale = g.log_scales.as_flattened().iter().sum::<f32>() / n;
        let colour = g.sh.as_flattened().iter().sum::<f32>() / n;
        [opacity, scale, colour]
    };
    for (a, b) in mean(&ply).into_iter().zip(mean(&spz)) {
        assert!((a - b).abs() < 0.01 * a.abs().max(1.0), "{a} {b}");
    }
    // Both give the same render.
    let device = device();
    let [low, high] = [0, 1].map(|end| bounds(&ply).map(|b| f64::from(b[end])));
    let centre = glam::DVec3::from_array(low).midpoint(glam::DVec3::from_array(high));
    let back = 1.2 * (glam::DVec3::from_array(high) - glam::DVec3::from_array(low)).length();
    let camera = splat4d::types::Camera {
        intrinsics: splat4d::types::Intrinsics::centred(500.0, 320, 240),
        view_from_world: splat4d::types::Pose {
            rotation: glam::DQuat::IDENTITY,
            translation: -(centre - back * glam::DVec3::Z),
        },
    };
    let [a, b] = [ply, spz].map(|g| {
        let mut renderer = Renderer::new(&device, &Scene::of(g)).unwrap();
        renderer.render(&camera, 0.0).unwrap().over([0.0; 3])
    });
    let psnr = splat4d::eval::psnr(&a, &b).unwrap();
    println!("biker in two formats: {psnr:.2} dB");
    assert!(a.pixels.iter().any(|v| *v > 0.1), "something is seen");
    assert!(psnr > 35.0, "{psnr}");
}

#[test]
fn an_spz_holds_the_motion() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let scene = moving(1);
    scene.save(at("scene.safetensors")).unwrap();
    let answer = json(folder.path(), "export scene.safetensors -o moving.spz");
    assert_eq!(answer["left_out"], serde_json::json!([]));
    assert_eq!(answer["gaussians"], 700);
    let back = Scene::open(at("moving.spz"), false).unwrap().scene;
    assert!(back.moves());
    assert_eq!(back.cameras, scene.cameras);
    assert_eq!(back.control_points.positions, scene.control_points.positions);
    let paths = [&back, &scene].map(|scene| scene.control_points.paths.as_flattened());
    assert_eq!(paths[0].len(), paths[1].len());
    // Paths are stored as half floats.
    assert!(paths[0].iter().zip(paths[1]).all(|(a, b)| (a - b).abs() <= 5e-4 * b.abs()));
    let device = device();
    let mut ours = Renderer::new(&device, &scene).unwrap();
    let mut theirs = Renderer::new(&device, &back).unwrap();
    for time in [0.0, 0.35, 1.0] {
        let camera = scene.cameras[0].camera;
        let a = ours.render(&camera, time).unwrap().over([0.0; 3]);
        let b = theirs.render(&camera, time).unwrap().over([0.0; 3]);
        let psnr = splat4d::eval::psnr(&a, &b).unwrap();
        println!("motion in SPZ at {time}: {psnr:.2} dB");
        assert!(psnr > 30.0, "{psnr}");
        let still = ours.posed(time).unwrap();
        // A fading changes the logits, so opacities close to 1 differ more.
        let most = Apart { position: 2e-3, rotation: 1e-3, opacity: 0.02, ..OF_SPZ };
        within("posed", &apart(&still, &theirs.posed(time).unwrap()), &most);
    }
    // Other programs see the scene at the given time.
    json(folder.path(), "export scene.safetensors -o late.spz --time 0.9");
    assert!(Scene::open(at("late.spz"), false).unwrap().scene.moves());
    let seen = open(&transformed(&at("late.spz"), &at("seen.ply"), &[]));
    within("the moment", &apart(&ours.posed(0.9).unwrap(), &seen), &OF_SPZ);
}

#[test]
fn moments_and_sequences_are_those_of_the_scene() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let scene = moving(0);
    scene.save(at("scene.safetensors")).unwrap();
    let device = device();
    let mut renderer = Renderer::new(&device, &scene).unwrap();
    let answer = json(folder.path(), "export scene.safetensors -o a.ply --time 0.4");
    assert_eq!(
        (&answer["frames"], &answer["left_out"]),
        (&1.into(), &serde_json::json!(["motion"]))
    );
    let posed = renderer.posed(0.4).unwrap();
    assert_eq!(open(&at("a.ply")), posed);
    assert_ne!(posed.positions, scene.gaussians.positions);
    // Posed Gaussians give the render of the scene at that time.
    let camera = scene.cameras[0].camera;
    let moved = renderer.render(&camera, 0.4).unwrap();
    let still = Renderer::new(&device, &Scene::of(posed)).unwrap().render(&camera, 0.0).unwrap();
    let pairs = moved.rgba.pixels.iter().zip(&still.rgba.pixels);
    assert!(pairs.map(|(a, b)| (a - b).abs()).fold(0.0, f32::max) < 1e-5);

    let sequence = "export scene.safetensors --sequence";
    let answer = json(folder.path(), &format!("{sequence} -o frames --as compressed.ply"));
    assert_eq!(answer["frames"], 5, "the times of the cameras");
    for (i, time) in [0.0, 0.25, 0.5, 0.75, 1.0].into_iter().enumerate() {
        let frame = open(&at(&format!("frames/frame{i:04}.compressed.ply")));
        within("frame", &apart(&renderer.posed(time).unwrap(), &frame), &OF_COMPRESSED);
    }
    assert_eq!(fs::read_dir(at("frames")).unwrap().count(), 5);
    let answer = json(folder.path(), &format!("{sequence} -o frames.zip --frames 3"));
    assert_eq!(answer["times"], serde_json::json!([0.0, 1.0]));
    let mut archive = zip::ZipArchive::new(fs::File::open(at("frames.zip")).unwrap()).unwrap();
    assert_eq!(archive.len(), 3);
    let mut bytes = Vec::new();
    let mut entry = archive.by_name("frame0001.ply").unwrap();
    std::io::Read::read_to_end(&mut entry, &mut bytes).unwrap();
    fs::write(at("middle.ply"), bytes).unwrap();
    assert_eq!(open(&at("middle.ply")), renderer.posed(0.5).unwrap());
}

#[test]
fn what_a_format_does_not_hold_is_said() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    moving(1).save(at("scene.safetensors")).unwrap();
    ply::write(at("still.ply"), &cloud(1)).unwrap();
    let refused = |words: &str, parts: &[&str]| {
        let said = fails(folder.path(), 1, &format!("export {words} --device software"));
        says(&said, parts);
    };
    refused("scene.safetensors -o a.ply", &[".ply does not hold the scene's motion", "--time"]);
    refused("scene.safetensors -o a.splat", &["motion", "--drop bands"]);
    refused("still.ply -o a.splat", &[".splat does not hold colours", "--drop bands"]);
    refused("scene.safetensors -o a.spz --spz-version 3", &["motion"]);
    refused("still.ply -o a.obj", &["no ending of a format", ".spz"]);
    refused("still.ply -o a.zip", &["--sequence"]);
    refused("still.ply -o a.ply --sequence --frames 2", &["one file"]);
    refused("still.ply -o frames --sequence", &["--frames"]);
    refused("still.ply -o still.ply", &["is read by this command"]);
    let allowed = "export scene.safetensors -o a.splat --drop motion,bands --device software";
    let output = run(folder.path(), allowed);
    assert!(output.status.success(), "{}", stderr(&output));
    says(&stderr(&output), &["motion left out", "bands left out"]);
    assert_eq!(open(&at("a.splat")).len(), 700);
}

#[test]
fn hostile_files_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.spz");
    let (good, _) = Format::Spz(spz::Version::V4).encode(&cloud(0)).unwrap();
    let refused = |bytes: &[u8], parts: &[&str]| {
        fs::write(&path, bytes).unwrap();
        let said = support::message(Scene::open(&path, false));
        says(&said, parts);
        says(&said, &["a.spz"]);
    };
    let with = |at: usize, word: &[u8]| {
        let mut bytes = good.clone();
        bytes[at..at + word.len()].copy_from_slice(word);
        bytes
    };
    refused(&with(4, &[9]), &["version 9"]);
    refused(&with(8, &[0xff; 4]), &["points"]);
    refused(&with(8, &0x7fff_ffffu32.to_le_bytes()), &["announces"]);
    refused(&with(12, &[4]), &["degree 4"]);
    refused(&with(13, &[31]), &["31 bits"]);
    refused(&with(15, &[2]), &["streams"]);
    refused(&with(16, &[1, 0, 0, 0]), &["in the header"]);
    refused(&with(16, &[0xff; 4]), &["truncated"]);
    refused(&with(32, &[0xff; 8]), &["truncated"]);
    refused(&with(40, &[1]), &["stream of"]);
    refused(&[&good[..], b"more"].concat(), &["behind its last stream"]);
    // A decompression bomb: a stream that unpacks to more than the Gaussians need.
    let bomb = zstd::bulk::compress(&vec![0; 1 << 26], 1).unwrap();
    let mut bytes = good[..32 + 80].to_vec();
    bytes[32..40].copy_from_slice(&(bomb.len() as u64).to_le_bytes());
    bytes.extend(&bomb);
    refused(&bytes, &["cannot be unpacked"]);
    // The gzip version: a truncated stream, and far too much data after the arrays.
    let (old, _) = Format::Spz(spz::Version::V3).encode(&cloud(0)).unwrap();
    refused(&old[..old.len() - 4], &["cannot be unpacked"]);
    let mut plain = Vec::new();
    std::io::Read::read_to_end(&mut flate2::read::GzDecoder::new(&old[..]), &mut plain).unwrap();
    plain.resize(plain.len() + (64 << 20), 0);
    let mut gzip = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
    std::io::Write::write_all(&mut gzip, &plain).unwrap();
    refused(&gzip.finish().unwrap(), &["more behind its arrays"]);
    let path = folder.path().join("a.splat");
    fs::write(&path, [0; 33]).unwrap();
    says(&support::message(Scene::open(&path, false)), &["a.splat", "33 bytes"]);
}

/// Converts an sRGB value to linear light.
fn linear(value: f32) -> f32 {
    if value <= 0.04045 { value / 12.92 } else { ((value + 0.055) / 1.055).powf(2.4) }
}

/// Smallest difference of two quaternions (x, y, z, w) as orientations of an ellipsoid: half a turn about
/// any axis gives the same ellipsoid.
fn turned(a: &[f32], b: &[f32]) -> f32 {
    // The other program does not normalise quaternions.
    let quaternion = |q: &[f32]| glam::Quat::from_slice(q).normalize();
    let halves =
        [[0.0, 0.0, 0.0, 1.0], [1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]];
    let dot = |half: &[f32; 4]| quaternion(a).dot(quaternion(b) * quaternion(half)).abs();
    1.0 - halves.iter().map(dot).fold(0.0, f32::max)
}

/// Checks that Khronos' validator objects only to what the extension adds, which it does not know.
#[track_caller]
fn is_valid_gltf(path: &Path) {
    let report = validated(path);
    let messages = report["issues"]["messages"].as_array().unwrap();
    assert!(!messages.is_empty() && report["issues"]["truncated"] == false, "{report}");
    for message in messages {
        let pointer = message["pointer"].as_str().unwrap();
        let known = match message["code"].as_str().unwrap() {
            "UNSUPPORTED_EXTENSION" => pointer.starts_with("/extensionsUsed"),
            "MESH_PRIMITIVE_INVALID_ATTRIBUTE" => pointer.contains("/KHR_gaussian_splatting:"),
            "UNUSED_OBJECT" => pointer == "/bufferViews/0",
            _ => false,
        };
        assert!(known, "{message}");
    }
}

/// Another program writes the same glTF attributes for the same Gaussians.
#[test]
fn gltf_is_as_another_program_writes_it() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let g = cloud(3);
    ply::write(at("a.ply"), &g).unwrap();
    json(folder.path(), "export a.ply -o ours.glb");
    is_valid_gltf(&at("ours.glb"));
    let ours = attributes(&at("ours.glb"));
    let theirs = attributes(&transformed(&at("a.ply"), &at("theirs.glb"), &[]));
    assert_eq!(ours.len(), 5 + 16);
    assert_eq!(ours.keys().collect::<Vec<_>>(), theirs.keys().collect::<Vec<_>>());
    // Each program may write its own order.
    let key = |of: &(usize, Vec<f32>)| {
        let mut order: Vec<usize> = (0..g.len()).collect();
        order.sort_by(|&a, &b| of.1[3 * a].total_cmp(&of.1[3 * b]));
        order
    };
    let (order, other) = (key(&ours["POSITION"]), key(&theirs["POSITION"]));
    for (name, (parts, values)) in &ours {
        let mut worst = 0.0f32;
        for (&i, &j) in order.iter().zip(&other) {
            let (a, b) = (&values[parts * i..][..*parts], &theirs[name].1[parts * j..][..*parts]);
            if name.ends_with("ROTATION") {
                worst = worst.max(turned(a, b));
                continue;
            }
            for (c, (a, b)) in a.iter().zip(b).enumerate() {
                // The other program writes point colours in sRGB; glTF requires linear values.
                let b = if name == "COLOR_0" && c < 3 { linear(*b) } else { *b };
                worst = worst.max((a - b).abs());
            }
        }
        println!("{name}: {worst}");
        // Point colours have 8 bits; the other program quantises them before the transfer function.
        let most = if name == "COLOR_0" { 2.0 / 255.0 } else { 1e-5 };
        assert!(worst <= most, "{name}: {worst}");
    }
}

/// The SPZ in a `.glb` is read by the format's reference library; what stands around it is as the extension
/// says.
#[test]
fn gltf_holds_an_spz() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let g = cloud(2);
    ply::write(at("a.ply"), &g).unwrap();
    let answer = json(folder.path(), "export a.ply -o a.glb --spz");
    assert_eq!((&answer["format"], &answer["gaussians"]), (&"glb".into(), &700.into()));
    is_valid_gltf(&at("a.glb"));
    let (json, binary) = glb(&at("a.glb"));
    let names = serde_json::json!(["KHR_gaussian_splatting", SPZ_IN_GLB]);
    assert_eq!((&json["extensionsUsed"], &json["extensionsRequired"]), (&names, &names));
    let accessors = json["accessors"].as_array().unwrap();
    assert_eq!(accessors.len(), 5 + 9);
    assert!(accessors.iter().all(|a| a["count"] == 700 && a["bufferView"].is_null()));
    let spz = spz_in_glb(&json, &binary);
    fs::write(at("b.spz"), spz).unwrap();
    // Of a quaternion, x, y and z have 8 bits each: together they are off by √3 / 255 at most, and w, which
    // follows from them, by the root of twice that where it is 0.
    let most = Apart { rotation: 0.0068, ..OF_SPZ };
    let here = open(&at("b.spz"));
    within("in glTF, here", &apart(&g, &here), &most);
    let there = open(&transformed(&at("b.spz"), &at("b.ply"), &[]));
    within("in glTF, there", &apart(&g, &there), &most);
    // Bounds are those of the unpacked positions, on glTF's axes: left, up, front.
    let bound = |name: &str, sign: f32, fold: fn(f32, f32) -> f32| {
        let x = here.positions.iter().map(|p| -p[0]).reduce(fold).unwrap();
        let told = json["accessors"][0][name][0].as_f64().unwrap();
        assert!((told - f64::from(x)).abs() < 1e-6 && sign * x > 0.5, "{told} {x}");
    };
    bound("min", -1.0, f32::min);
    bound("max", 1.0, f32::max);
    let said = fails(folder.path(), 1, "export a.ply -o a.spz --spz");
    says(&said, &["a.spz", "no .glb", "--spz"]);
}

/// Opacities of exactly 0 and 1 have infinite logits.
#[test]
fn a_ply_with_infinite_logits_is_read() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.ply");
    let mut g = cloud(0);
    (g.opacity_logits[0], g.opacity_logits[1]) = (f32::NEG_INFINITY, f32::INFINITY);
    ply::write(&path, &g).unwrap();
    let read = open(&path);
    assert!(read.opacity_logits.iter().all(|logit| logit.is_finite()));
    within(
        "infinite logits",
        &apart(&g, &read),
        &Apart { opacity: 0.0011, rotation: 1e-6, ..Apart::default() },
    );
    // Other values that are not finite are still refused.
    g.opacity_logits[2] = f32::NAN;
    ply::write(&path, &g).unwrap();
    says(&support::message(Scene::open(&path, false)), &["a.ply", "1 of"]);
}

#[test]
fn a_splatv_moves_as_the_scene() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let mut scene = moving(0);
    // Without the opacity offset (component 3), which the format does not have.
    scene.control_points.paths.iter_mut().for_each(|motion| motion[3] = 0.0);
    scene.save(at("scene.safetensors")).unwrap();
    let answer = json(folder.path(), "export scene.safetensors -o a.splatv");
    let fit = &answer["fit"];
    println!("{fit}");
    assert_eq!(fit["moving"], 234);
    assert!(fit["position_rmse"].as_f64() < Some(0.2 * fit["position_spread"].as_f64().unwrap()));
    let file = SplatV::read(&at("a.splatv"));
    assert_eq!(file.cameras.as_array().unwrap().len(), 5);
    let device = device();
    let mut renderer = Renderer::new(&device, &scene).unwrap();
    let worst = fit["position_worst"].as_f64().unwrap();
    for time in [0.1, 0.5, 0.9] {
        let posed = renderer.posed(time).unwrap();
        let mut left: Vec<[f32; 3]> = posed.positions.clone();
        let (shown, presence) = file.at(time);
        assert_eq!(shown.len(), 700);
        for (place, presence) in shown.positions.iter().zip(presence) {
            let distance = |p: &[f32; 3]| -> f64 {
                (0..3).map(|c| f64::from(p[c] - place[c]).powi(2)).sum::<f64>().sqrt()
            };
            let nearest = (0..left.len())
                .min_by(|a, b| distance(&left[*a]).total_cmp(&distance(&left[*b])))
                .unwrap();
            let far = distance(&left.swap_remove(nearest));
            assert!(far < 1.5 * worst + 2e-3, "{far} at {time}, the fit says {worst}");
            assert!(presence > 0.999);
        }
    }
}

#[test]
fn the_compact_scene_is_small_and_looks_the_same() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    for degree in [1, 3] {
        let mut scene = moving(degree);
        scene.report = serde_json::json!({ "psnr_input": 30.0 });
        scene.save(at("scene.safetensors")).unwrap();
        let answer = json(folder.path(), "export scene.safetensors -o small.safetensors --compact");
        let compact = &answer["compact"];
        println!("degree {degree}: {compact}");
        let plain = fs::metadata(at("scene.safetensors")).unwrap().len();
        assert_eq!(compact["plain_bytes"], plain);
        assert!(fs::metadata(at("small.safetensors")).unwrap().len() * 3 < plain);
        assert!(compact["psnr_lost"].as_f64() < Some(0.1) && compact["views"] == 5);
        assert!(compact["share"].as_f64() <= Some(0.25), "degree {degree}: {compact}");
        let back = Scene::open(at("small.safetensors"), false).unwrap().scene;
        assert!(back.moves() && back.cameras == scene.cameras && back.report == scene.report);
        let most = Apart {
            position: 4.5e-4,
            log_scale: 0.016,
            rotation: 1e-4,
            opacity: 0.0021,
            colour: 0.0071,
            harmonic: 0.0079,
        };
        within("compact", &apart(&scene.gaussians, &back.gaussians), &most);
        let info = json(folder.path(), "info small.safetensors");
        assert_eq!((&info["gaussians"], &info["path_keys"]), (&700.into(), &6.into()));
    }
    // The canonical positions of moving Gaussians may be far away.
    let mut far = moving(1);
    far.control_points.positions.iter_mut().for_each(|place| place[0] += 100.0);
    far.control_points.paths.iter_mut().for_each(|motion| motion[0] -= 100.0);
    let g = &mut far.gaussians;
    let moves = g.motion_logits.iter().map(|logit| *logit > 0.0);
    g.positions.iter_mut().zip(moves).filter(|(_, m)| *m).for_each(|(place, _)| place[0] += 100.0);
    far.save(at("far.safetensors")).unwrap();
    let answer = json(folder.path(), "export far.safetensors -o small.safetensors --compact");
    println!("far: {}", answer["compact"]);
    assert!(answer["compact"]["psnr"].as_f64() > Some(45.0));
    // Bands that are all 0 are left out, whatever the degree of the Gaussians.
    let mut g = cloud(2);
    g.sh.chunks_exact_mut(9).for_each(|rows| rows[1..].fill([0.0; 3]));
    Scene::of(g).save(at("flat.safetensors")).unwrap();
    json(folder.path(), "export flat.safetensors -o small.safetensors --compact");
    assert_eq!(open(&at("small.safetensors")).sh_degree, 0);
}

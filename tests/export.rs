//! Scenes in the formats of others: written here and read by splat-transform, written by it and read
//! here, and through the command line.

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
use splats::{Apart, apart, cloud, moving, transformed};
use support::{says, shared};

fn open(path: &Path) -> Gaussians {
    Scene::open(path, false).unwrap().scene.gaussians
}

fn device() -> Device {
    let selector = Selector::from("software");
    Device::open(&Request { selector, ..Request::default() }).unwrap()
}

/// That Gaussians differ by no more than a format's steps.
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

/// A step of 11 bits in a chunk of the cloud, and of 8 bits in colours whose range is that of the cloud.
const OF_COMPRESSED: Apart = Apart {
    position: 1.0e-3,
    log_scale: 1.0e-3,
    rotation: 2e-6,
    opacity: 0.0021,
    colour: 0.006,
    harmonic: 0.017,
};
/// Scales in sixteenths, colours in 8 bits over ±3.3, harmonics in 4 bits.
const OF_SPZ: Apart = Apart {
    position: 1.0e-3,
    log_scale: 0.0313,
    rotation: 2e-6,
    opacity: 0.0021,
    colour: 0.0132,
    harmonic: 0.0626,
};
/// Quaternions in 8 bits a part; f32 else.
const OF_SPLAT: Apart = Apart {
    position: 0.0,
    log_scale: 1e-5,
    rotation: 2e-4,
    opacity: 0.0021,
    colour: 0.0071,
    harmonic: 0.0,
};

#[test]
fn another_program_reads_what_is_written() {
    let folder = tempfile::tempdir().unwrap();
    let formats = [
        (Format::Ply, 3, "a.ply", Apart::default()),
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
        // Harmonics that are all 0 they leave out.
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
    for (name, options, most) in [
        ("b.compressed.ply", &[][..], OF_COMPRESSED),
        ("c.spz", &["--spz-version", "3"][..], OF_SPZ),
        ("d.spz", &["--spz-version", "4"][..], OF_SPZ),
    ] {
        let theirs = transformed(&at("a.ply"), &at(name), options);
        within(name, &apart(&g, &open(&theirs)), &most);
    }
}

#[test]
fn one_scene_in_two_formats_agrees() {
    let Some(set) = shared("splats_playcanvas") else { return };
    let (ply, spz) = (open(&set.join("biker.compressed.ply")), open(&set.join("biker.spz")));
    assert_eq!(ply.len(), spz.len());
    // Sorted along x alone, the one is close to the other.
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
    // And both make the same picture.
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
    assert_eq!(back.control_points, scene.control_points);
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
        within("posed", &apart(&still, &theirs.posed(time).unwrap()), &Apart { ..OF_SPZ });
    }
    // Others see the moment.
    let seen = open(&transformed(&at("moving.spz"), &at("seen.ply"), &[]));
    within("the moment", &apart(&ours.posed(0.0).unwrap(), &seen), &OF_SPZ);
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
    // Posed Gaussians make the picture of the scene at that time.
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
    // A bomb: a stream that unpacks to more than the Gaussians need.
    let bomb = zstd::bulk::compress(&vec![0; 1 << 26], 1).unwrap();
    let mut bytes = good[..32 + 80].to_vec();
    bytes[32..40].copy_from_slice(&(bomb.len() as u64).to_le_bytes());
    bytes.extend(&bomb);
    refused(&bytes, &["cannot be unpacked"]);
    // In gzip: no end, and far too much behind the arrays.
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

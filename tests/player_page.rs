//! The page that `export -o FILE.html` writes, in a real browser: its images are compared with the
//! renderer's. Needs Chromium (Debian: chromium), which draws with its bundled SwiftShader.

#![cfg(feature = "cli")]

#[path = "support/browser.rs"]
mod browser;
mod common;
#[path = "support/player.rs"]
mod player;
#[path = "support/program.rs"]
mod program;
#[path = "support/splats.rs"]
mod splats;
mod support;

use std::fs;
use std::path::{Path, PathBuf};

use browser::Browser;
use glam::{DQuat, DVec3};
use player::{opened, shot, truth};
use serde_json::{Value, json};
use splat4d::data::images::{Orientation, decode_rgb};
use splat4d::eval::psnr;
use splat4d::renderer::Renderer;
use splat4d::scene::html::{self, Opening};
use splat4d::scene::{Scene, SceneCamera};
use splat4d::types::{
    Camera, ControlPoints, DeformNet, Gaussians, Image, Intrinsics, NetShape, Pose,
};

/// Smallest allowed PSNR of the page's images against the renderer's, dB.
const LEAST_PSNR: f64 = 35.0;
const TIMES: [f64; 3] = [0.0, 0.37, 1.0];

/// Cameras around the cloud; the first has its principal point off the image centre.
fn cameras() -> Vec<SceneCamera> {
    let camera = |i: usize| {
        let aside = 0.12 * i as f64;
        let (cx, cy) = if i == 0 { (150.0, 126.5) } else { (160.0, 120.0) };
        let intrinsics = Intrinsics { fx: 300.0, fy: 310.0, cx, cy, width: 320, height: 240 };
        let rotation = DQuat::from_rotation_y(0.3 * aside) * DQuat::from_rotation_z(0.2 * aside);
        let view_from_world = Pose::new(rotation, DVec3::new(-aside, 0.05 * aside, 0.1));
        SceneCamera { time: i as f64 / 7.0, camera: Camera { intrinsics, view_from_world } }
    };
    (0..8).map(camera).collect()
}

/// A scene that moves along paths, with view-dependent colours.
fn on_paths() -> Scene {
    Scene { cameras: cameras(), background: [0.2, 0.4, 0.7], neighbours: 5, ..splats::moving(3) }
}

/// A scene that is moved by a network.
fn by_network() -> Scene {
    let shape = NetShape {
        depth: 2,
        width: 32,
        skip: 2,
        position_frequencies: 2,
        time_frequencies: 1,
        position_octave: 0,
    };
    let mut network = DeformNet::random(shape, 11);
    // A new network's head produces almost no motion.
    let head = shape.parameters() - 33 * NetShape::OUTPUTS;
    network.parameters[head..].iter_mut().for_each(|weight| *weight *= 3e3);
    let moving = splats::moving(0);
    let control_points = ControlPoints { paths: Vec::new(), ..moving.control_points.clone() };
    Scene { network: Some(network), control_points, cameras: cameras(), ..moving }
}

/// A static scene without cameras.
fn still() -> Scene {
    Scene::of(splats::cloud(1))
}

/// Exports a scene's page; returns its path and the program's result.
fn exported(folder: &Path, name: &str, scene: &Scene) -> (PathBuf, Value) {
    scene.save(folder.join(format!("{name}.safetensors"))).unwrap();
    let told = program::json(folder, &format!("export {name}.safetensors -o {name}.html"));
    (folder.join(format!("{name}.html")), told)
}

/// Waits until drawing has finished. Input is handled before a frame's callbacks, and drawing is done in
/// such a callback.
#[track_caller]
fn settle(page: &mut Browser) {
    page.evaluate(
        "(async () => { const frame = () => new Promise((r) => requestAnimationFrame(r)); \
         const rest = () => new Promise((r) => setTimeout(r, 200)); let before; \
         do { before = splat4d.frames; await rest(); await frame(); await frame(); } \
         while (splat4d.frames !== before); })()",
    );
}

#[test]
fn the_page_shows_what_the_renderer_gives() {
    let device = common::device();
    let folder = tempfile::tempdir().unwrap();
    let scenes = [("paths", on_paths()), ("network", by_network()), ("still", still())];
    for (name, scene) in &scenes {
        let (file, told) = exported(folder.path(), name, scene);
        assert_eq!(told["compact"]["baked"], json!(scene.network.is_some()), "{told}");
        assert_eq!(told["written_bytes"], json!(fs::metadata(&file).unwrap().len()));
        let mut renderer = Renderer::new(&device, scene).unwrap();
        let mut page = opened(&file, 800, 600);
        let list = cameras();
        let (mut first, mut pictures) = (None, Vec::new());
        for (i, time) in TIMES.into_iter().enumerate() {
            let camera = &list[3 * i].camera;
            let ours = truth(&mut renderer, scene, camera, time);
            let theirs = shot(&mut page, Some(camera), time, 320, 240);
            let near = psnr(&ours, &theirs).unwrap();
            println!("{name} at {time}: {near:.2} dB");
            assert!(near >= LEAST_PSNR, "{name} at {time}: {near} dB");
            // The same camera at another time must give another image, so that the comparison tests
            // motion.
            let at_first = truth(&mut renderer, scene, camera, 0.0);
            let moved = psnr(&ours, &at_first).unwrap();
            assert!(i == 0 || !scene.moves() || moved < LEAST_PSNR - 5.0, "{moved} dB");
            first.get_or_insert(theirs.clone());
            pictures.push(theirs);
        }
        assert!(page.said.is_empty(), "{name}: {:#?}", page.said);
    }
    common::assert_valid(&device);
}

#[test]
fn the_page_begins_at_the_first_camera_and_shows_what_a_shot_gives() {
    let device = common::device();
    let folder = tempfile::tempdir().unwrap();
    let scene = on_paths();
    let (file, _) = exported(folder.path(), "scene", &scene);
    let mut renderer = Renderer::new(&device, &scene).unwrap();
    let mut page = opened(&file, 640, 480);
    page.evaluate("document.getElementById('play').click()");
    set_time(&mut page, 0.5);
    settle(&mut page);
    let first = scene.cameras[0].camera;
    let ours = truth(&mut renderer, &scene, &first, 0.5);
    let theirs = shot(&mut page, None, 0.5, 320, 240);
    assert!(psnr(&ours, &theirs).unwrap() >= LEAST_PSNR);
    settle(&mut page);
    // A screenshot of the window, cropped to the image.
    let box_of = page.evaluate(
        "(() => { const b = document.getElementById('picture').getBoundingClientRect(); \
         return [b.width, b.height]; })()",
    );
    let [width, height] = [0, 1].map(|k| box_of[k].as_f64().unwrap() as u32);
    let window = folder.path().join("window.png");
    fs::write(&window, page.screenshot()).unwrap();
    let screen = decode_rgb(&window, [0.0; 3], Orientation::Stored).unwrap();
    let rows = screen.pixels[..(width * height * 3) as usize].to_vec();
    let screen = Image { width, height, channels: 3, pixels: rows };
    let ours = truth(&mut renderer, &scene, &shown(&first, width, height), 0.5);
    let near = psnr(&ours, &screen).unwrap();
    println!("the window: {near:.2} dB");
    assert!(near >= LEAST_PSNR, "{near} dB");
    assert!(page.said.is_empty(), "{:#?}", page.said);
}

/// The camera for another image size that still shows everything.
fn shown(camera: &Camera, width: u32, height: u32) -> Camera {
    let k = camera.intrinsics;
    let scale =
        (f64::from(width) / f64::from(k.width)).min(f64::from(height) / f64::from(k.height));
    let centre =
        |side: u32, old: u32, c: f64| f64::from(side) / 2.0 + (c - f64::from(old) / 2.0) * scale;
    let intrinsics = Intrinsics {
        fx: k.fx * scale,
        fy: k.fy * scale,
        cx: centre(width, k.width, k.cx),
        cy: centre(height, k.height, k.cy),
        width,
        height,
    };
    Camera { intrinsics, ..*camera }
}

#[track_caller]
fn set_time(page: &mut Browser, time: f64) {
    page.evaluate(&format!(
        "(() => {{ const s = document.getElementById('time'); s.value = {time}; \
         s.dispatchEvent(new Event('input')); }})()"
    ));
}

#[track_caller]
fn time_of(page: &mut Browser) -> f64 {
    page.evaluate("Number(document.getElementById('time').value)").as_f64().unwrap()
}

#[test]
fn mouse_touch_and_keys_move_camera_and_time() {
    let folder = tempfile::tempdir().unwrap();
    let (file, _) = exported(folder.path(), "scene", &on_paths());
    let mut page = opened(&file, 800, 600);
    // Playback starts automatically.
    page.wait_for("Number(document.getElementById('time').value) > 0.02");
    page.evaluate("document.getElementById('picture').focus()");
    page.key(" ", 32, " ", 10);
    let stands = time_of(&mut page);
    settle(&mut page);
    assert_eq!(time_of(&mut page), stands, "Space pauses");
    page.key(".", 190, ".", 10);
    assert!((time_of(&mut page) - stands - 0.01).abs() < 0.0015 || stands > 0.98, "a step");
    set_time(&mut page, 0.0);
    let look = |page: &mut Browser| {
        settle(page);
        shot(page, None, 0.5, 160, 120)
    };
    let before = look(&mut page);
    assert!(psnr(&before, &look(&mut page)).unwrap() > 60.0, "nothing moves by itself");
    let apart = |a: &Image, b: &Image| psnr(a, b).unwrap() < 30.0;
    page.drag([400.0, 200.0], [480.0, 230.0]);
    let dragged = look(&mut page);
    assert!(apart(&before, &dragged), "a drag orbits");
    page.key("Home", 36, "", 10);
    assert!(psnr(&before, &look(&mut page)).unwrap() > 60.0, "Home begins again");
    // Long enough for several frames in a slow browser.
    page.key("ArrowLeft", 37, "", 1500);
    assert!(apart(&before, &look(&mut page)), "an arrow orbits");
    page.key("Home", 36, "", 10);
    let wheel = json!({ "type": "mouseWheel", "x": 400, "y": 200, "deltaX": 0, "deltaY": -300 });
    page.call("Input.dispatchMouseEvent", wheel);
    assert!(apart(&before, &look(&mut page)), "the wheel comes closer");
    page.evaluate("document.getElementById('reset').click()");
    // Spreading two fingers zooms in.
    let touch = |page: &mut Browser, kind: &str, points: &[[f64; 2]]| {
        let points: Vec<Value> = (points.iter().enumerate())
            .map(|(id, [x, y])| json!({ "x": x, "y": y, "id": id }))
            .collect();
        page.call("Input.dispatchTouchEvent", json!({ "type": kind, "touchPoints": points }));
    };
    touch(&mut page, "touchStart", &[[380.0, 200.0], [420.0, 200.0]]);
    touch(&mut page, "touchMove", &[[340.0, 200.0], [460.0, 200.0]]);
    touch(&mut page, "touchEnd", &[]);
    assert!(apart(&before, &look(&mut page)), "two fingers come closer");
    page.key("?", 191, "?", 10);
    page.wait_for("document.getElementById('keys-help').open");
    page.key("Escape", 27, "", 10);
    page.wait_for("!document.getElementById('keys-help').open");
    for width in [360, 1280] {
        assert_eq!(page.overflow(width), 0, "at {width} pixels");
    }
    assert!(page.said.is_empty(), "{:#?}", page.said);
}

#[test]
fn what_a_scene_does_not_have_is_not_offered() {
    let folder = tempfile::tempdir().unwrap();
    for (name, scene) in [("still", still()), ("empty", Scene::default())] {
        let (file, _) = exported(folder.path(), name, &scene);
        let mut page = opened(&file, 360, 640);
        settle(&mut page);
        let seen = "[...document.querySelectorAll('.moving')].some((part) => !part.hidden)";
        assert_eq!(page.evaluate(seen), json!(false), "{name}");
        assert_eq!(page.evaluate("document.getElementById('message').textContent"), json!(""));
        assert_eq!(page.overflow(360), 0);
        assert!(page.said.is_empty(), "{name}: {:#?}", page.said);
    }
}

#[test]
fn a_network_is_baked_before_a_page_is_written() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("page.html");
    let scene = by_network();
    let opening =
        Opening { title: "scene".into(), start: scene.cameras[0].camera, distance: 3.0, time: 0.0 };
    let told = html::write(&file, &scene, &opening).unwrap_err().to_string();
    assert!(told.contains("network") && !file.exists(), "{told}");
    // For a static scene the network does not matter.
    let still = Scene { gaussians: splats::cloud(0), ..scene };
    html::write(&file, &still, &opening).unwrap();
    let page = fs::read_to_string(&file).unwrap();
    assert!(page.starts_with("<!doctype html>") && page.ends_with("</html>\n"));
}

/// Gaussians in random order, which compress worse than a scene's, with view-dependent colours; a third
/// moves, with as many control points and key times as in a clip.
fn large(count: usize) -> Scene {
    let moving = splats::moving(1);
    let small = &moving.gaussians;
    let mut g = Gaussians { sh_degree: 1, ..Gaussians::default() };
    for i in 0..count {
        // Each attribute is taken from another Gaussian, so that no two Gaussians are equal.
        let at = |k: usize| (i * (2 * k + 1) + i / small.len() * (k + 1)) % small.len();
        let shift = (i / small.len()) as f32 * 0.013;
        g.positions.push([0, 1, 2].map(|c| small.positions[at(c)][c] + shift));
        g.log_scales.push([0, 1, 2].map(|c| small.log_scales[at(3 + c)][c]));
        g.rotations.push([0, 1, 2, 3].map(|c| small.rotations[at(6 + c)][c]));
        g.opacity_logits.push(small.opacity_logits[at(10)]);
        g.sh.extend((0..4).map(|b| [0, 1, 2].map(|c| small.sh[4 * at(11 + 3 * b + c) + b][c])));
        g.motion_logits.push(small.motion_logits[at(30)]);
    }
    let points = &moving.control_points;
    let spread = |i: usize| points.positions[i % points.len()].map(|v| v + 0.001 * i as f32);
    let control_points = ControlPoints {
        positions: (0..240).map(spread).collect(),
        log_radii: vec![-1.0; 240],
        paths: (0..240 * 40).map(|i| points.paths[(7 * i) % points.paths.len()]).collect(),
    };
    Scene { gaussians: g, control_points, cameras: cameras(), ..moving }
}

#[test]
fn a_page_stays_within_its_size() {
    let folder = tempfile::tempdir().unwrap();
    let (file, told) = exported(folder.path(), "large", &large(40_000));
    let size = fs::metadata(&file).unwrap().len();
    println!("40,000 Gaussians: {size} bytes, {}", told["compact"]);
    assert!(size <= 3_000_000, "{size} bytes");
}

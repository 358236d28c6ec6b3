//! The viewer's page in a real browser, and its latency. Needs Chromium (Debian: chromium).

#![cfg(feature = "cli")]

#[path = "support/browser.rs"]
mod browser;
mod common;
#[path = "support/viewer.rs"]
mod viewer;

use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Command, Stdio};
use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use browser::Browser;
use glam::DVec3;
use serde_json::{Value, json};
use splat4d::data::images::{Orientation, decode_rgb};
use splat4d::data::transforms::read_cameras;
use splat4d::renderer::Renderer;
use splat4d::types::{Camera, Image};
use splat4d::view::protocol::{Layer, Request};
use viewer::{
    Client, JPEG_PSNR, camera, inputs, of_one_channel, psnr, request, rounded, scene, serve,
};

/// Waits until the page shows the complete image of its camera and time, and no request is pending.
#[track_caller]
fn settle(page: &mut Browser) {
    page.wait_for("document.getElementById('picture').getAttribute('aria-busy') === 'false'");
}

/// JavaScript for the RGBA pixels of a canvas, read from a copy, so that the browser does not warn about
/// frequent reads.
fn pixels_of(canvas: &str) -> String {
    format!(
        "(() => {{ const c = document.getElementById('{canvas}'); \
         const copy = new OffscreenCanvas(c.width, c.height); \
         const context = copy.getContext('2d', {{ willReadFrequently: true }}); \
         context.drawImage(c, 0, 0); \
         return context.getImageData(0, 0, c.width, c.height).data; }})()"
    )
}

/// The image on the canvas, and its request.
#[track_caller]
fn shown(page: &mut Browser) -> (Image, Request) {
    settle(page);
    let told = page.evaluate(&format!(
        "(() => {{ const c = document.getElementById('picture'); const d = {}; let text = ''; \
         for (let i = 0; i < d.length; i += 4) text += String.fromCharCode(d[i], d[i + 1], d[i + 2]); \
         return {{ width: c.width, height: c.height, pixels: btoa(text), \
                   asked: {{ ...c.shown.asked, id: c.shown.header.id }} }}; }})()",
        pixels_of("picture")
    ));
    let text = told["pixels"].as_str().unwrap();
    let bytes = STANDARD.decode(text).unwrap();
    let image = Image {
        width: told["width"].as_u64().unwrap() as u32,
        height: told["height"].as_u64().unwrap() as u32,
        channels: 3,
        pixels: bytes.into_iter().map(|v| f32::from(v) / 255.0).collect(),
    };
    (image, serde_json::from_value(told["asked"].clone()).unwrap())
}

/// Checks that the canvas shows the renderer's image for the same camera and time; returns the camera and
/// the time.
#[track_caller]
fn is_right(page: &mut Browser, truth: &mut Renderer, background: [f32; 3]) -> (Camera, f64) {
    let (image, asked) = shown(page);
    let (camera, time) = asked.checked().unwrap();
    let rendered = truth.render(&camera, time).unwrap().over(background);
    let near = psnr(&image, &rendered);
    assert!(near > JPEG_PSNR, "{near} dB: {asked:?}");
    assert!(rendered.pixels.iter().any(|v| (v - background[0]).abs() > 0.3), "something is seen");
    (camera, time)
}

#[track_caller]
fn is_silent(page: &Browser) {
    assert!(page.said.is_empty(), "the console: {:#?}", page.said);
}

fn away(a: &Camera, b: &Camera) -> f64 {
    let turned = a.view_from_world.rotation.angle_between(b.view_from_world.rotation);
    a.centre().distance(b.centre()) + turned
}

#[test]
fn the_page_shows_what_the_renderer_gives() {
    let device = common::device();
    let scene = scene(600);
    let folder = tempfile::tempdir().unwrap();
    let server = serve(&device, scene.clone(), Some(inputs(folder.path(), 6)));
    let mut truth = Renderer::new(&device, &scene).unwrap();
    let mut page = Browser::open(server.url(), 1280, 800);
    page.wait_for("document.getElementById('picture').shown");
    let (first, time) = is_right(&mut page, &mut truth, scene.background);
    assert!(away(&first, &scene.cameras[0].camera) < 1e-6 && time == 0.0);
    // Drag: the camera orbits its pivot.
    let pivot = |camera: &Camera| camera.view_from_world.inverse().apply(DVec3::Z * 4.0);
    page.drag([500.0, 250.0], [600.0, 280.0]);
    let (dragged, _) = is_right(&mut page, &mut truth, scene.background);
    assert!(away(&first, &dragged) > 0.1, "it has moved");
    assert!(pivot(&first).distance(pivot(&dragged)) < 1e-6, "about what it looks at");
    // A drag to the right moves the camera left.
    let side = first.view_from_world.rotation * (dragged.centre() - first.centre());
    assert!(side.x < -0.1, "{side}");
    // Zoom in.
    page.call(
        "Input.dispatchMouseEvent",
        json!({ "type": "mouseWheel", "x": 500, "y": 250, "deltaX": 0, "deltaY": -240 }),
    );
    let (closer, _) = is_right(&mut page, &mut truth, scene.background);
    assert!(pivot(&dragged).distance(closer.centre()) < 3.5, "closer");
    // Scrub the time slider.
    let slider = page.evaluate(
        "(() => { const b = document.getElementById('time').getBoundingClientRect(); \
         return [b.left, b.width, b.top + b.height / 2]; })()",
    );
    let [left, width, y] = [0, 1, 2].map(|k| slider[k].as_f64().unwrap());
    page.drag([left + 8.0, y], [left + 0.75 * width, y]);
    let (_, time) = is_right(&mut page, &mut truth, scene.background);
    assert!((time - 0.75).abs() < 0.03, "{time}");
    // Layers, points and frusta.
    page.evaluate("document.getElementById('show-cameras').click()");
    page.evaluate("document.getElementById('show-points').click()");
    settle(&mut page);
    let painted = format!("{}.some((v) => v > 0)", pixels_of("overlay"));
    assert_eq!(page.evaluate(&painted), json!(true), "something is drawn over the picture");
    page.evaluate(
        "(() => { const l = document.getElementById('layer'); l.value = 'alpha'; \
         l.dispatchEvent(new Event('change')); })()",
    );
    let (image, asked) = shown(&mut page);
    assert_eq!(asked.layer, Layer::Alpha);
    let (view, time) = asked.checked().unwrap();
    let rgba = truth.render(&view, time).unwrap().rgba;
    let alpha = of_one_channel(&rgba, |p| p[3]);
    assert!(psnr(&of_one_channel(&image, |p| p[0]), &alpha) > JPEG_PSNR);
    // Side by side with the input.
    page.evaluate("document.getElementById('show-input').click()");
    page.wait_for("document.getElementById('input-name').textContent === 'Input 5 of 6'");
    let red = page.evaluate(&format!("{}[40]", pixels_of("input")));
    assert!((red.as_f64().unwrap() - 255.0 * 4.0 / 6.0).abs() < 4.0, "{red}");
    // Jump to an input camera.
    page.evaluate("document.getElementById('next').click()");
    page.evaluate("document.getElementById('layer').value = 'colour'");
    page.evaluate("document.getElementById('next').click()");
    let (jumped, time) = is_right(&mut page, &mut truth, scene.background);
    assert!(away(&jumped, &scene.cameras[2].camera) < 1e-6 && (time - 0.4).abs() < 1e-9);
    // Playback, and pausing.
    page.evaluate("document.getElementById('play').click()");
    page.wait_for("document.getElementById('picture').shown.asked.time > 0.5");
    page.evaluate("document.getElementById('play').click()");
    is_right(&mut page, &mut truth, scene.background);
    is_silent(&page);
    server.stop().unwrap();
}

#[test]
fn pan_look_click_loop_and_speed() {
    let device = common::device();
    let scene = scene(600);
    let server = serve(&device, scene.clone(), None);
    let mut truth = Renderer::new(&device, &scene).unwrap();
    let mut page = Browser::open(server.url(), 800, 700);
    page.wait_for("document.getElementById('picture').shown");
    let (first, _) = is_right(&mut page, &mut truth, scene.background);
    let turned = |a: &Camera, b: &Camera| {
        a.view_from_world.rotation.angle_between(b.view_from_world.rotation)
    };
    // The right button pans: to the side, without turning.
    page.mouse("mousePressed", 300.0, 150.0, "right");
    page.mouse("mouseMoved", 400.0, 150.0, "right");
    page.mouse("mouseReleased", 400.0, 150.0, "right");
    let (panned, _) = is_right(&mut page, &mut truth, scene.background);
    let side = first.view_from_world.rotation * (panned.centre() - first.centre());
    assert!(side.x < -0.1 && side.y.abs() < 1e-6 && side.z.abs() < 1e-6, "{side}");
    assert!(turned(&first, &panned) < 1e-6);
    // Looking around turns in place.
    page.evaluate("document.getElementById('drag').value = 'look'");
    page.drag([300.0, 150.0], [360.0, 150.0]);
    let (looked, _) = is_right(&mut page, &mut truth, scene.background);
    assert!(looked.centre().distance(panned.centre()) < 1e-6 && turned(&looked, &panned) > 0.05);
    // A click on an input camera jumps to it.
    page.evaluate("document.getElementById('drag').value = 'orbit'");
    page.evaluate("document.getElementById('reset').click()");
    page.evaluate("document.getElementById('show-cameras').click()");
    for _ in 0..2 {
        let wheel = json!({ "type": "mouseWheel", "x": 300, "y": 150, "deltaX": 0, "deltaY": 300 });
        page.call("Input.dispatchMouseEvent", wheel);
    }
    let (back, _) = is_right(&mut page, &mut truth, scene.background);
    let seen = back.view_from_world.apply(scene.cameras[4].camera.centre());
    let k = back.intrinsics;
    let at = page.evaluate(&format!(
        "(() => {{ const b = document.getElementById('picture').getBoundingClientRect(); \
         return [b.left + {} * b.width, b.top + {} * b.height]; }})()",
        (k.fx * seen.x / seen.z + k.cx) / f64::from(k.width),
        (k.fy * seen.y / seen.z + k.cy) / f64::from(k.height),
    ));
    let [x, y] = [0, 1].map(|c| at[c].as_f64().unwrap());
    page.mouse("mousePressed", x, y, "left");
    page.mouse("mouseReleased", x, y, "left");
    let (jumped, time) = is_right(&mut page, &mut truth, scene.background);
    assert!(away(&jumped, &scene.cameras[4].camera) < 1e-6 && (time - 0.8).abs() < 1e-9);
    // While the camera moves, images have a lower quality than when it rests. The page says what it shows.
    page.evaluate(
        "globalThis.qualities = []; const c = document.getElementById('picture'); let of = c.shown; \
         Object.defineProperty(c, 'shown', { get: () => of, \
         set: (v) => { of = v; qualities.push(v.asked.quality); } }); 0",
    );
    page.drag([300.0, 150.0], [360.0, 160.0]);
    is_right(&mut page, &mut truth, scene.background);
    let qualities: Vec<u8> = serde_json::from_value(page.evaluate("qualities")).unwrap();
    // A slow machine may pause within the drag, so that images at rest are among those of the drag.
    let (still, during) = qualities.split_last().unwrap();
    let low = during.iter().filter(|q| *q < still).count();
    assert!(low > 0 && during.iter().all(|q| q <= still), "{qualities:?}");
    let text = |page: &mut Browser, id: &str| {
        let told = page.evaluate(&format!("document.getElementById('{id}').textContent"));
        told.as_str().unwrap().to_owned()
    };
    assert_eq!(text(&mut page, "gaussians"), "600 Gaussians");
    let size = page
        .evaluate("[c.width, c.height].join('×') === document.getElementById('size').textContent");
    assert_eq!(size, json!(true));
    let milliseconds = text(&mut page, "milliseconds");
    assert!(
        milliseconds
            .strip_suffix(" ms")
            .is_some_and(|ms| ms.parse::<f64>().is_ok_and(|ms| ms > 0.0))
    );
    // Without the loop, playing ends at the end, sooner at a higher speed.
    let mut plays = |speed: &str| {
        let took = page.evaluate(&format!(
            "(async () => {{ const [play, time, loop, speed] = ['play', 'time', 'loop', 'speed'] \
             .map((id) => document.getElementById(id)); loop.checked = false; speed.value = '{speed}'; \
             time.value = 0; time.dispatchEvent(new Event('input')); \
             const begun = performance.now(); play.click(); \
             while (play.textContent !== 'Play') await new Promise(requestAnimationFrame); \
             return time.value === '1' ? performance.now() - begun : -1; }})()",
        ));
        took.as_f64().unwrap()
    };
    let (slow, fast) = (plays("0.25"), plays("4"));
    // 6 frames at 24 a second.
    assert!(slow >= 950.0 && fast > 0.0 && fast < 0.5 * slow, "{slow} ms, {fast} ms");
    // With the loop it begins again.
    page.evaluate("document.getElementById('loop').checked = true");
    page.evaluate("document.getElementById('play').click()");
    page.wait_for("document.getElementById('picture').shown.asked.time > 0.6");
    page.wait_for("document.getElementById('picture').shown.asked.time < 0.5");
    page.evaluate("document.getElementById('play').click()");
    is_silent(&page);
    server.stop().unwrap();
}

#[test]
fn a_recorded_path_is_one_that_render_takes() {
    let device = common::device();
    let scene = scene(100);
    let server = serve(&device, scene.clone(), None);
    let folder = tempfile::tempdir().unwrap();
    let mut page = Browser::open(server.url(), 800, 700);
    let downloads = json!({ "behavior": "allow", "downloadPath": folder.path().to_str().unwrap() });
    page.call("Browser.setDownloadBehavior", downloads);
    page.wait_for("document.getElementById('picture').shown");
    let (_, first) = shown(&mut page);
    page.evaluate("document.getElementById('add-key').click()");
    page.evaluate("document.getElementById('next').click()");
    page.drag([300.0, 150.0], [360.0, 140.0]);
    let (_, second) = shown(&mut page);
    page.evaluate("document.getElementById('add-key').click()");
    page.evaluate("document.getElementById('path-length').value = 5");
    page.evaluate("document.getElementById('save-path').click()");
    let file = folder.path().join("transforms.json");
    let waited = |path: &Path| {
        let begun = Instant::now();
        while !path.exists() && begun.elapsed() < Duration::from_secs(20) {
            std::thread::sleep(Duration::from_millis(20));
        }
        std::thread::sleep(Duration::from_millis(200));
    };
    waited(&file);
    let path = read_cameras(&file).unwrap();
    assert_eq!(path.len(), 5);
    for (at, asked) in [(0, first), (4, second)] {
        let (camera, time) = asked.checked().unwrap();
        assert!(
            away(&path[at].camera, &camera) < 1e-6 && (path[at].time - time).abs() < 1e-9,
            "{at}"
        );
        let (a, b) = (path[at].camera.intrinsics, camera.intrinsics);
        assert!((a.fx - b.fx).abs() < 1e-9 && (a.width, a.height) == (b.width, b.height));
    }
    let middle = path[2].camera.centre();
    let [a, b] = [path[0].camera.centre(), path[4].camera.centre()];
    assert!(middle.distance(0.5 * (a + b)) < 1e-6, "two keys make a straight line");
    // A screenshot is exact.
    page.evaluate("document.getElementById('screenshot').click()");
    let file = folder.path().join("splat4d.png");
    waited(&file);
    let shot = decode_rgb(&file, [0.0; 3], Orientation::Stored).unwrap();
    let (camera, time) = second.checked().unwrap();
    let rendered = Renderer::new(&device, &scene).unwrap().render(&camera, time).unwrap();
    assert_eq!(rounded(&shot), rounded(&rendered.over(scene.background)));
    is_silent(&page);
}

#[test]
fn the_page_works_by_keys_alone() {
    let device = common::device();
    let scene = scene(300);
    let server = serve(&device, scene.clone(), None);
    let mut truth = Renderer::new(&device, &scene).unwrap();
    let mut page = Browser::open(server.url(), 1000, 700);
    page.wait_for("document.getElementById('picture').shown");
    let (first, _) = is_right(&mut page, &mut truth, scene.background);
    let focused = "document.activeElement.id";
    page.key("Tab", 9, "", 20);
    assert_eq!(page.evaluate(focused), json!("picture"), "the scene comes first");
    let ring = page.evaluate("getComputedStyle(document.activeElement).outlineStyle");
    assert_eq!(ring, json!("solid"), "focus is seen");
    page.key("ArrowRight", 39, "", 300);
    let (turned, _) = is_right(&mut page, &mut truth, scene.background);
    assert!(away(&first, &turned) > 0.02, "orbit");
    page.key("w", 87, "w", 300);
    let (flown, _) = is_right(&mut page, &mut truth, scene.background);
    let forward = turned.view_from_world.apply(flown.centre());
    assert!(forward.z > 0.1 && forward.truncate().length() < 1e-6, "fly: {forward}");
    page.key("Home", 36, "", 20);
    let (home, _) = is_right(&mut page, &mut truth, scene.background);
    assert!(away(&home, &first) < 1e-9);
    page.key("]", 221, "]", 20);
    let (jumped, time) = is_right(&mut page, &mut truth, scene.background);
    assert!(away(&jumped, &scene.cameras[1].camera) < 1e-6 && (time - 0.2).abs() < 1e-9);
    page.key("2", 50, "2", 20);
    assert_eq!(shown(&mut page).1.layer, Layer::Depth);
    page.key("1", 49, "1", 20);
    page.key(" ", 32, " ", 20);
    page.wait_for("document.getElementById('picture').shown.asked.time > 0.5");
    page.key(" ", 32, " ", 20);
    is_right(&mut page, &mut truth, scene.background);
    page.key("k", 75, "k", 20);
    page.wait_for("document.getElementById('keys').options[0].textContent.startsWith('1: time')");
    page.key("?", 191, "?", 20);
    page.wait_for("document.getElementById('keys-help').open");
    page.key("Escape", 27, "", 20);
    page.wait_for("!document.getElementById('keys-help').open");
    // Every control can be focused, and has a name.
    let unnamed = page.evaluate(
        "[...document.querySelectorAll('button, select, input')].filter((e) => \
         !(e.textContent.trim() || e.getAttribute('aria-label') || e.labels?.[0]?.textContent.trim()) \
         || e.tagName !== 'BUTTON' && !e.labels?.[0]?.textContent.trim()).map((e) => e.id)",
    );
    assert_eq!(unnamed, json!([]), "controls without a label");
    let mut reached = std::collections::BTreeSet::new();
    for _ in 0..40 {
        page.key("Tab", 9, "", 5);
        reached.insert(page.evaluate(focused).as_str().unwrap_or_default().to_owned());
    }
    for id in [
        "play",
        "time",
        "loop",
        "speed",
        "layer",
        "show-cameras",
        "drag",
        "cameras",
        "add-key",
        "save-path",
        "screenshot",
        "help",
    ] {
        assert!(reached.contains(id), "Tab does not reach {id}: {reached:?}");
    }
    is_silent(&page);
}

#[test]
fn the_page_fits_a_phone_and_fingers() {
    let device = common::device();
    let scene = scene(300);
    let server = serve(&device, scene.clone(), None);
    let mut truth = Renderer::new(&device, &scene).unwrap();
    let mut page = Browser::open(server.url(), 360, 640);
    page.call(
        "Emulation.setTouchEmulationEnabled",
        json!({ "enabled": true, "maxTouchPoints": 2 }),
    );
    page.wait_for("document.getElementById('picture').shown");
    let overflow = "[document.documentElement.scrollWidth, \
        ...[...document.querySelectorAll('button, select, input, label')].map((e) => \
        Math.ceil(e.getBoundingClientRect().right))].filter((x) => x > 360)";
    assert_eq!(page.evaluate(overflow), json!([]), "nothing is wider than the screen");
    let (first, _) = is_right(&mut page, &mut truth, scene.background);
    let touch = |page: &mut Browser, kind: &str, places: &[[f64; 2]]| {
        let points: Vec<Value> = places
            .iter()
            .enumerate()
            .map(|(id, place)| json!({ "x": place[0], "y": place[1], "id": id }))
            .collect();
        page.call("Input.dispatchTouchEvent", json!({ "type": kind, "touchPoints": points }));
    };
    touch(&mut page, "touchStart", &[[100.0, 150.0]]);
    touch(&mut page, "touchMove", &[[140.0, 150.0]]);
    touch(&mut page, "touchMove", &[[180.0, 160.0]]);
    touch(&mut page, "touchEnd", &[]);
    let (turned, _) = is_right(&mut page, &mut truth, scene.background);
    assert!(away(&first, &turned) > 0.1, "one finger orbits");
    // Spreading two fingers zooms in.
    touch(&mut page, "touchStart", &[[150.0, 150.0], [200.0, 150.0]]);
    touch(&mut page, "touchMove", &[[130.0, 150.0], [220.0, 150.0]]);
    touch(&mut page, "touchMove", &[[100.0, 150.0], [250.0, 150.0]]);
    touch(&mut page, "touchEnd", &[]);
    let (closer, _) = is_right(&mut page, &mut truth, scene.background);
    let gone = turned.view_from_world.apply(closer.centre());
    assert!(gone.z > 1.0, "{gone}");
    is_silent(&page);
}

/// Measures the latency from a drag to the new image on the canvas: the median and the 95th percentile.
/// Run with `cargo test --release --test view_page -- --ignored --nocapture`.
#[test]
#[ignore = "a measurement"]
fn from_a_drag_to_the_new_picture() {
    let device = common::device();
    let server = serve(&device, scene(20_000), None);
    let mut page = Browser::open(server.url(), 1000, 800);
    page.wait_for("document.getElementById('picture').shown");
    page.evaluate(
        "(() => { const s = document.getElementById('stage'); \
         s.style.cssText = 'flex:none;width:480px;height:270px'; })()",
    );
    settle(&mut page);
    // The time from a pointer event to the drawing of the first image that it requested, and to the
    // complete image. The canvas is observed through the properties that the page sets after drawing.
    let measured = page.evaluate(
        "(async () => { \
           const p = document.getElementById('picture'); const out = []; \
           const box = p.getBoundingClientRect(); \
           const sent = (type, x) => p.dispatchEvent(new PointerEvent(type, { pointerId: 1, \
             clientX: box.left + x, clientY: box.top + 100, button: 0, buttons: 1, bubbles: true })); \
           p.setPointerCapture = () => {}; \
           for (let i = 0; i < 100; i++) { \
             sent('pointerdown', 200); \
             const before = p.shown; const begun = performance.now(); \
             sent('pointermove', 200 + (i % 2 ? 6 : -6)); \
             while (p.shown === before) await new Promise((r) => { const c = new MessageChannel(); \
               c.port1.onmessage = r; c.port2.postMessage(0); }); \
             out.push([performance.now() - begun, p.shown.header.width, p.shown.header.milliseconds]); \
             sent('pointerup', 200); \
             await new Promise((r) => setTimeout(r, 400)); \
           } return out; })()",
    );
    let rows = measured.as_array().unwrap();
    let column = |k: usize| {
        let mut values: Vec<f64> = rows.iter().map(|row| row[k].as_f64().unwrap()).collect();
        values.sort_by(f64::total_cmp);
        values
    };
    let (times, widths, renders) = (column(0), column(1), column(2));
    let (_, whole) = shown(&mut page);
    assert_eq!((whole.camera.width, whole.camera.height), (480, 270));
    println!(
        "{}: 20,000 Gaussians, from a drag to the new picture: median {:.1} ms, 95 % {:.1} ms, most \
         {:.1} ms; of it rendering {:.1} ms in the median; width {} to {} of 480",
        device.info().name,
        times[50],
        times[95],
        times[99],
        renders[50],
        widths[0],
        widths[99]
    );
    is_silent(&page);
}

/// Resident memory of a process, bytes.
#[cfg(target_os = "linux")]
fn resident(process: u32) -> u64 {
    let status = std::fs::read_to_string(format!("/proc/{process}/status")).unwrap();
    let line = status.lines().find(|line| line.starts_with("VmRSS:")).unwrap();
    line.split_whitespace().nth(1).unwrap().parse::<u64>().unwrap() << 10
}

/// Eight clients at once for a minute and a half, each with different sizes and cameras; every tenth
/// image of each is compared with the renderer's. Prints the program's memory over time.
#[cfg(target_os = "linux")]
#[test]
#[ignore = "takes a minute and a half"]
fn eight_clients_for_a_minute() {
    const CLIENTS: usize = 8;
    const SECONDS: u64 = 90;
    let device = common::device();
    let scene = scene(20_000);
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("scene.safetensors");
    scene.save(&file).unwrap();
    let mut program = Command::new(env!("CARGO_BIN_EXE_splat4d"));
    program.arg("view").arg(&file).args(["--json", "--device", "software"]);
    let mut child = program.stdin(Stdio::null()).stdout(Stdio::piped()).spawn().unwrap();
    let mut line = String::new();
    BufReader::new(child.stdout.take().unwrap()).read_line(&mut line).unwrap();
    let told: Value = serde_json::from_str(&line).unwrap();
    let port = told["port"].as_u64().unwrap() as u16;
    let view = |client: usize, turn: u64| {
        let (width, height) = [(480, 270), (320, 180), (240, 135)][turn as usize % 3];
        camera(width, height, 0.05 * client as f64 + 0.01 * (turn % 7) as f64)
    };
    // One renderer for all clients, so that the program gets the machine's processors.
    let truth = Mutex::new(Renderer::new(&device, &scene).unwrap());
    let (pictures, checked) = (AtomicUsize::new(0), AtomicUsize::new(0));
    let begun = Instant::now();
    let goes_on = || begun.elapsed() < Duration::from_secs(SECONDS);
    let mut memory = Vec::new();
    std::thread::scope(|threads| {
        for index in 0..CLIENTS {
            let (scene, truth, pictures, checked) = (&scene, &truth, &pictures, &checked);
            let (view, goes_on) = (&view, &goes_on);
            threads.spawn(move || {
                let mut client = Client::open(port, "socket").unwrap();
                let mut turn = 0;
                while goes_on() {
                    turn += 1;
                    let time = (turn % 11) as f64 / 10.0;
                    client.ask(&request(turn, view(index, turn), time));
                    let (header, _, picture) = client.picture();
                    assert_eq!((header.id, header.time), (turn, time), "client {index}");
                    pictures.fetch_add(1, Ordering::Relaxed);
                    if turn % 10 == 0 {
                        let rendered = truth.lock().unwrap().render(&view(index, turn), time);
                        assert_eq!(picture, rounded(&rendered.unwrap().over(scene.background)));
                        checked.fetch_add(1, Ordering::Relaxed);
                    }
                }
            });
        }
        while goes_on() {
            std::thread::sleep(Duration::from_secs(5));
            memory.push(resident(child.id()));
        }
    });
    child.kill().unwrap();
    child.wait().unwrap();
    let mebibytes: Vec<u64> = memory.iter().map(|bytes| bytes >> 20).collect();
    println!(
        "{} pictures, {} held against the renderer's, all right; the program's resident MiB every 5 s: \
         {mebibytes:?}",
        pictures.into_inner(),
        checked.into_inner()
    );
    let (early, late) = (memory[memory.len() / 3], memory[memory.len() - 1]);
    assert!(late < early + (16 << 20), "memory grows: {mebibytes:?} MiB");
}

/// Screenshots of the page, wide and narrow, for people to look at, in the folder that `SPLAT4D_SHOTS`
/// names.
#[test]
#[ignore = "writes pictures for people"]
fn the_page_as_it_looks() {
    let folder = std::env::var("SPLAT4D_SHOTS").expect("SPLAT4D_SHOTS names a folder");
    let device = common::device();
    let pictures = tempfile::tempdir().unwrap();
    let scene = scene(4000);
    let server = serve(&device, scene, Some(inputs(pictures.path(), 6)));
    for (name, width, height, scheme, besides) in [
        ("wide", 1280, 800, "light", true),
        ("dark", 1280, 800, "dark", false),
        ("narrow", 360, 740, "light", false),
        ("narrow_dark", 360, 740, "dark", true),
    ] {
        let mut page = Browser::open(server.url(), width, height);
        let features = json!([{ "name": "prefers-color-scheme", "value": scheme }]);
        page.call("Emulation.setEmulatedMedia", json!({ "features": features }));
        page.wait_for("document.getElementById('picture').shown");
        if besides {
            for id in ["show-cameras", "show-points", "show-input"] {
                page.evaluate(&format!("document.getElementById('{id}').click()"));
            }
            page.key("Tab", 9, "", 20);
        }
        settle(&mut page);
        let save = |page: &mut Browser, name: &str| {
            std::fs::write(Path::new(&folder).join(format!("{name}.png")), page.screenshot())
                .unwrap();
        };
        save(&mut page, name);
        if width < 600 {
            page.evaluate("scrollTo(0, 9999)");
            save(&mut page, &format!("{name}_end"));
        } else {
            page.evaluate("document.getElementById('help').click()");
            save(&mut page, &format!("{name}_help"));
        }
    }
}

//! The viewer's server: its responses, and the requests that it refuses.

#![cfg(feature = "cli")]

mod common;
#[path = "support/viewer.rs"]
mod viewer;

use std::io::{BufRead, BufReader, Write};
use std::net::{TcpListener, TcpStream};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use serde_json::{Value, json};
use splat4d::data::shades;
use splat4d::renderer::Renderer;
use splat4d::view::protocol::{Format, Layer, Request};
use splat4d::view::{MOST_CLIENTS, Options, Pictures, Server};
use viewer::{
    Client, JPEG_PSNR, Sent, camera, get, http, inputs, of_one_channel, psnr, request, rounded,
    scene, serve, show,
};

#[test]
fn pictures_are_those_of_the_renderer() {
    let device = common::device();
    let scene = scene(400);
    let server = serve(&device, scene.clone(), None);
    let mut client = Client::new(&server);
    let mut truth = Renderer::new(&device, &scene).unwrap();
    // Two sizes in alternation, each at two times.
    let mut colours = Vec::new();
    for (id, (size, time)) in
        [((96, 54), 0.0), ((61, 47), 1.0), ((96, 54), 1.0), ((61, 47), 0.0)].into_iter().enumerate()
    {
        let view = camera(size.0, size.1, 0.1 * id as f64);
        let rendered = truth.render(&view, time).unwrap();
        let mut asked = request(id as u64, view, time);
        client.ask(&asked);
        let (header, points, colour) = client.picture();
        assert_eq!((header.id, header.width, header.height), (id as u64, size.0, size.1));
        assert_eq!((header.gaussians, points.len(), header.range), (400, 0, None));
        assert!(header.milliseconds > 0.0);
        assert_eq!(colour, rounded(&rendered.over(scene.background)), "exact as PNG");
        asked.layer = Layer::Alpha;
        client.ask(&asked);
        assert_eq!(client.picture().2, rounded(&of_one_channel(&rendered.rgba, |p| p[3])));
        asked.layer = Layer::Depth;
        client.ask(&asked);
        let (header, _, nearness) = client.picture();
        let [near, far] = header.range.unwrap();
        assert!(2.0 < near && near < far && far < 7.0, "{near} {far}");
        for (shade, depth) in nearness.pixels.iter().zip(rendered.mean_depth().pixels) {
            let expected = match depth > 0.0 {
                true => {
                    let share = (1.0 / depth - 1.0 / far) / (1.0 / near - 1.0 / far);
                    0.1 + 0.9 * share.clamp(0.0, 1.0)
                }
                false => 0.0,
            };
            assert!((shade - expected).abs() < 0.01, "{shade} {expected}");
        }
        asked.layer = Layer::Colour;
        (asked.format, asked.quality) = (Format::Jpeg, 92);
        client.ask(&asked);
        let near = psnr(&client.picture().2, &rendered.over(scene.background));
        assert!(near > JPEG_PSNR, "{near} dB");
        colours.push(colour);
    }
    assert!(psnr(&colours[0], &colours[2]) < 30.0, "time and place change the picture");
    server.stop().unwrap();
    common::assert_valid(&device);
}

#[test]
fn what_moves_is_white_and_control_points_are_told() {
    let device = common::device();
    let scene = scene(400);
    let server = serve(&device, scene.clone(), None);
    let mut client = Client::new(&server);
    let view = camera(80, 50, 0.0);
    let mut asked = Request { layer: Layer::Motion, points: true, ..request(1, view, 1.0) };
    client.ask(&asked);
    let (header, points, mask) = client.picture();
    // The moving Gaussians alone have at least the alpha that they have behind static ones.
    let mut moving = scene.clone();
    for (logit, motion) in
        moving.gaussians.opacity_logits.iter_mut().zip(&scene.gaussians.motion_logits)
    {
        *logit = if *motion > 0.0 { *logit } else { -20.0 };
    }
    let alone = Renderer::new(&device, &moving).unwrap().render(&view, 1.0).unwrap();
    let (mut some, mut most) = (0.0, 0.0f32);
    for (share, alone) in mask.pixels.iter().zip(alone.rgba.pixels.chunks_exact(4)) {
        assert!(*share <= alone[3] + 0.01, "{share} {}", alone[3]);
        some += share;
        most = most.max(*share);
    }
    assert!(some > 20.0 && most > 0.5, "{some} {most}");
    assert_eq!((header.points, points.len()), (5, 5));
    for (i, [x, y, z, is_there]) in points.into_iter().enumerate() {
        assert_eq!(is_there, if i == 4 { 0.0 } else { 1.0 });
        let [px, py, pz] = scene.control_points.positions[i];
        let expected = if i == 4 { [0.0; 3] } else { [px + 1.0, py - 0.3, pz] };
        for (a, b) in [x, y, z].into_iter().zip(expected) {
            assert!((a - b).abs() < 1e-5, "{i}: {x} {y} {z}");
        }
    }
    // A static scene has neither layer.
    let still = splat4d::scene::Scene { control_points: Default::default(), ..scene };
    let server = serve(&device, still, None);
    let mut client = Client::new(&server);
    asked.id = 2;
    client.ask(&asked);
    let (header, _, mask) = client.picture();
    assert!(header.points == 0 && mask.pixels.iter().all(|v| *v == 0.0));
    common::assert_valid(&device);
}

#[test]
fn flow_and_normals_are_those_of_the_renderer() {
    let device = common::device();
    let scene = scene(400);
    let server = serve(&device, scene.clone(), None);
    let mut client = Client::new(&server);
    let mut truth = Renderer::new(&device, &scene).unwrap();
    let view = camera(80, 50, 0.1);
    // With six input frames the next one is 0.2 later; after the last there is none.
    for (id, time, to, sign) in [(1, 0.3, 0.3 + 0.2, 1.0), (2, 1.0, 1.0 - 0.2, -1.0)] {
        client.ask(&Request { layer: Layer::Flow, ..request(id, view, time) });
        let (header, _, shown) = client.picture();
        let [none, most] = header.range.unwrap();
        let seen = truth.render(&view, time).unwrap();
        let mut flow = truth.flow(&seen, (&view, time), (&view, to)).unwrap();
        flow.pixels.iter_mut().for_each(|v| *v *= sign);
        let longest = shades::lengths(&flow).pixels.into_iter().filter(|v| v.is_finite());
        let longest = longest.fold(0.0, f32::max);
        assert!(none == 0.0 && (most / 2.5..most * 4.0).contains(&longest), "{most} {longest}");
        assert_eq!(shown, rounded(&shades::flow(&flow, most.into())));
        // The motion is to the right and a little up: red dominates.
        let sums = (0..3).map(|c| shown.pixels.iter().skip(c).step_by(3).sum::<f32>());
        let [red, green, blue]: [f32; 3] = sums.collect::<Vec<_>>().try_into().unwrap();
        assert!(red > green + 1.0 && red > blue + 1.0, "{red} {green} {blue}");
        client.ask(&Request { layer: Layer::Normal, ..request(id, view, time) });
        let (header, _, shown) = client.picture();
        truth.render(&view, time).unwrap();
        let normals = truth.normals(&view, time).unwrap();
        assert_eq!((header.range, &shown), (None, &rounded(&shades::normals(&normals))));
        assert!(shown.pixels.iter().any(|v| *v > 0.9), "something is seen");
    }
    common::assert_valid(&device);
}

#[test]
fn the_newest_camera_wins() {
    let device = common::device();
    let scene = scene(4000);
    let server = serve(&device, scene.clone(), None);
    let mut client = Client::new(&server);
    let last = 60;
    let requests = (1..=last).map(|id| request(id, camera(640, 360, 0.01 * id as f64), 0.5));
    client.ask_at_once(requests);
    let mut ids = Vec::new();
    let newest = loop {
        let (header, _, picture) = client.picture();
        ids.push(header.id);
        if header.id == last {
            break picture;
        }
    };
    assert!(ids.is_sorted() && ids.len() < last as usize / 2, "{ids:?}");
    let mut truth = Renderer::new(&device, &scene).unwrap();
    let rendered = truth.render(&camera(640, 360, 0.01 * last as f64), 0.5).unwrap();
    assert_eq!(newest, rounded(&rendered.over(scene.background)));
}

#[test]
fn other_names_and_other_pages_are_refused() {
    let device = common::device();
    let server = serve(&device, scene(30), None);
    let port = server.port();
    let own = format!("Host: 127.0.0.1:{port}");
    let (status, page) = get(port, "/");
    assert_eq!(status, 200, "{page}");
    let lower = page.to_lowercase();
    for header in
        ["content-security-policy: default-src 'none'", "nosniff", "no-referrer", "no-store"]
    {
        assert!(lower.contains(header), "{header}: {page}");
    }
    assert!(page.contains("<canvas id=\"picture\""));
    for host in
        ["evil.example", "evil.example:80", "127.0.0.1", "127.0.0.1:1", "localhost.evil.example:80"]
    {
        for path in ["/", "/scene.json", "/socket", "/pictures/0"] {
            let (status, text) =
                http(port, &[&format!("GET {path} HTTP/1.1"), &format!("Host: {host}")]);
            assert!(status == 403 && !text.contains("gaussians"), "{host}{path}: {text}");
        }
    }
    let upgrade = |origin: &str| {
        let origin = format!("Origin: {origin}");
        let lines = [
            "GET /socket HTTP/1.1",
            &own,
            "Connection: Upgrade",
            "Upgrade: websocket",
            "Sec-WebSocket-Version: 13",
            "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==",
            &origin,
        ];
        let mut stream = TcpStream::connect(("127.0.0.1", port)).unwrap();
        stream.write_all((lines.join("\r\n") + "\r\n\r\n").as_bytes()).unwrap();
        let mut first = String::new();
        BufReader::new(stream).read_line(&mut first).unwrap();
        first
    };
    for origin in ["http://evil.example", "null", "http://127.0.0.1", "https://127.0.0.1"] {
        assert!(upgrade(origin).contains(" 403 "), "{origin}");
    }
    assert!(upgrade(&format!("http://127.0.0.1:{port}")).contains(" 101 "));
    // File paths, other methods and incomplete requests are refused.
    for path in [
        "/etc/passwd",
        "/../../etc/passwd",
        "/%2e%2e/%2e%2e/etc/passwd",
        "//etc/passwd",
        "/pictures/../main.js",
        "/pictures/0",
        "/pictures/-1",
        "/pictures/99999999999999999999999",
        "/pictures/%2fetc%2fpasswd",
        "/src/main.rs",
        "/page/main.js",
    ] {
        assert_eq!(get(port, path).0, 404, "{path}");
    }
    assert_eq!(http(port, &["POST / HTTP/1.1", &own, "Content-Length: 0"]).0, 405);
    assert_eq!(http(port, &["GET / HTTP/1.1"]).0, 400, "without a Host");
    assert_eq!(http(port, &["nonsense"]).0, 400);
    let long = format!("X: {}", "a".repeat(100_000));
    assert!([400, 431, 0].contains(&http(port, &["GET / HTTP/1.1", &own, &long]).0));
    assert_eq!(get(port, "/scene.json").0, 200, "it goes on");
}

#[test]
fn an_address_that_others_reach_needs_its_token() {
    let device = common::device();
    let options = Options { host: [0, 0, 0, 0].into(), port: 0 };
    let server = Server::start(&device, show(scene(30), None), &options).unwrap();
    let port = server.port();
    let base = server.url().strip_prefix(&format!("http://127.0.0.1:{port}")).unwrap().to_owned();
    let token = base.trim_matches('/').to_owned();
    assert!(token.len() == 32 && base == format!("/{token}/"), "{base}");
    for path in ["", "main.js", "scene.json"] {
        assert_eq!(get(port, &format!("{base}{path}")).0, 200, "{path}");
        assert_eq!(get(port, &format!("/{path}")).0, 403, "{path}");
        let wrong = format!("/{}/{path}", "0".repeat(32));
        assert_eq!(get(port, &wrong).0, 403, "{path}");
    }
    assert!(Client::open(port, "socket").is_err());
    let mut client = Client::open(port, &format!("{token}/socket")).unwrap();
    client.ask(&request(1, camera(20, 20, 0.0), 0.0));
    client.picture();
    let status =
        http(port, &[&format!("GET {base} HTTP/1.1"), &format!("Host: evil.example:{port}")]).0;
    assert_eq!(status, 403, "a name that resolves to this machine");
}

#[test]
fn what_is_too_large_or_rubbish_harms_nobody() {
    let device = common::device();
    let server = serve(&device, scene(60), None);
    let mut other = Client::new(&server);
    let mut works = |id: u64| {
        other.ask(&request(id, camera(32, 20, 0.0), 0.0));
        assert_eq!(other.picture().0.id, id);
    };
    let mut client = Client::new(&server);
    for (width, height) in [(100_000, 100_000), (4097, 1), (4096, 4096), (0, 10)] {
        let mut asked = request(7, camera(32, 20, 0.0), 0.0);
        (asked.camera.width, asked.camera.height) = (width, height);
        client.ask(&asked);
        let refusal = client.refusal();
        assert_eq!(refusal.id, Some(7), "{refusal:?}");
        assert!(refusal.error.contains(&width.to_string()), "{refusal:?}");
    }
    // A refused request is not garbage: the client stays connected.
    client.ask(&request(8, camera(32, 20, 0.0), 0.0));
    assert_eq!(client.picture().0.id, 8);
    for text in ["", "{}", "null", "[1e999]", "{\"id\":-1}", "\u{0}", "nonsense"] {
        client.say(text);
        let refusal = client.refusal();
        assert!(refusal.id.is_none() && refusal.error.contains("no request"), "{refusal:?}");
    }
    works(1);
    // Endless garbage closes the connection; so do overlong messages and invalid frames.
    let mut rubbish = Client::new(&server);
    let cut = (0..100).any(|_| rubbish.0.send(tungstenite::Message::text("x")).is_err())
        || (0..100).any(|_| matches!(rubbish.hear(), Sent::Closed(_)));
    assert!(cut);
    let mut long = Client::new(&server);
    let _ = long.0.send(tungstenite::Message::text("x".repeat(1 << 20)));
    assert!(matches!(long.hear(), Sent::Closed(_)));
    let mut broken = Client::new(&server);
    broken.0.get_mut().write_all(&[0xff; 4096]).unwrap();
    assert!(matches!(broken.hear(), Sent::Closed(_)));
    works(2);
    // Idle connections take at most the available slots, and release them.
    let idle: Vec<TcpStream> =
        (0..20).map(|_| TcpStream::connect(("127.0.0.1", server.port())).unwrap()).collect();
    assert_eq!(get(server.port(), "/").0, 200);
    drop(idle);
    works(3);
    common::assert_valid(&device);
}

#[test]
fn a_slow_reader_keeps_nobody_waiting() {
    let device = common::device();
    let server = serve(&device, scene(300), None);
    let mut slow = Client::new(&server);
    let mut quick = Client::new(&server);
    // Far more responses than the socket buffers hold, and the client reads none.
    for id in 0..60 {
        slow.ask(&request(id, camera(1024, 576, 0.002 * id as f64), 0.0));
        quick.ask(&request(id, camera(40, 30, 0.0), 0.0));
        assert_eq!(quick.picture().0.id, id);
    }
    let mut ids = Vec::new();
    while ids.last() != Some(&59) {
        ids.push(slow.picture().0.id);
    }
    assert!(ids.is_sorted() && ids.len() < 60, "{ids:?}");
}

#[test]
fn every_client_is_served_with_its_own_picture_and_one_too_many_is_not() {
    let device = common::device();
    let scene = scene(200);
    let server = serve(&device, scene.clone(), None);
    let mut clients: Vec<Client> = (0..MOST_CLIENTS).map(|_| Client::new(&server)).collect();
    let view = |i: usize| camera(40 + i as u32, 30, 0.02 * i as f64);
    for (i, client) in clients.iter_mut().enumerate() {
        client.ask(&request(i as u64, view(i), 0.5));
    }
    let mut truth = Renderer::new(&device, &scene).unwrap();
    for (i, client) in clients.iter_mut().enumerate() {
        let (header, _, picture) = client.picture();
        assert_eq!(header.id, i as u64);
        let rendered = truth.render(&view(i), 0.5).unwrap();
        assert_eq!(picture, rounded(&rendered.over(scene.background)));
    }
    assert_eq!(server.clients(), MOST_CLIENTS);
    assert!(matches!(Client::new(&server).hear(), Sent::Closed(1008)));
    drop(clients.pop());
    let begun = Instant::now();
    while server.clients() == MOST_CLIENTS && begun.elapsed() < Duration::from_secs(20) {
        std::thread::sleep(Duration::from_millis(10));
    }
    let mut next = Client::new(&server);
    next.ask(&request(99, view(0), 0.5));
    assert_eq!(next.picture().0.id, 99);
    server.stop().unwrap();
    assert!(matches!(next.hear(), Sent::Closed(_)), "the end is told");
}

#[test]
fn the_input_is_shown_by_number() {
    let device = common::device();
    let folder = tempfile::tempdir().unwrap();
    inputs(folder.path(), 3);
    std::fs::write(folder.path().join("broken.png"), "nothing").unwrap();
    let files = ["0.png", "1.png", "2.png", "broken.png"].map(|name| folder.path().join(name));
    let server = serve(&device, scene(30), Some(Pictures::files(files.into())));
    let description: Value = {
        let (_, text) = get(server.port(), "/scene.json");
        serde_json::from_str(text.split_once("\r\n\r\n").unwrap().1).unwrap()
    };
    assert_eq!(
        (&description["pictures"], &description["cameras"].as_array().unwrap().len()),
        (&json!(4), &6)
    );
    let (status, text) = get(server.port(), "/pictures/2");
    assert!(status == 200 && text.contains("image/jpeg"), "{text}");
    let (status, text) = get(server.port(), "/pictures/3");
    assert!(status == 500 && !text.contains("broken"), "no path is told: {text}");
    assert_eq!(get(server.port(), "/pictures/4").0, 404);
}

fn program(arguments: &[&str]) -> Command {
    let device = std::env::var("SPLAT4D_DEVICE").unwrap_or("software".into());
    let mut command = Command::new(env!("CARGO_BIN_EXE_splat4d"));
    command.arg("view").args(arguments).args(["--json", "--device", &device]);
    command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
    command
}

#[cfg(unix)]
#[test]
fn the_command_tells_its_address_takes_the_next_port_and_ends_by_ctrl_c() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("scene.safetensors");
    scene(50).save(&file).unwrap();
    let file = file.to_str().unwrap();
    let taken = TcpListener::bind("127.0.0.1:0").unwrap();
    let port = taken.local_addr().unwrap().port();
    let mut child = program(&[file, "--port", &port.to_string()]).spawn().unwrap();
    let mut stdout = BufReader::new(child.stdout.take().unwrap());
    let mut line = String::new();
    stdout.read_line(&mut line).unwrap();
    let told: Value = serde_json::from_str(&line).unwrap();
    let own = told["port"].as_u64().unwrap() as u16;
    assert!(own > port || port > 65_000, "{told}");
    assert_eq!(told["url"], format!("http://127.0.0.1:{own}/"));
    assert_eq!(
        (&told["gaussians"], &told["cameras"], &told["frames"]),
        (&json!(50), &json!(6), &json!(0))
    );
    assert_eq!(get(own, "/").0, 200);
    let mut client = Client::open(own, "socket").unwrap();
    client.ask(&request(3, camera(30, 20, 0.0), 0.5));
    assert_eq!(client.picture().0.id, 3);
    let id = child.id().to_string();
    assert!(Command::new("kill").args(["-s", "INT", &id]).status().unwrap().success());
    let output = child.wait_with_output().unwrap();
    let said = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(0), "{said}");
    assert!(said.contains(&format!("port {port} is in use, {own} is taken")), "{said}");
    let mut rest = String::new();
    stdout.read_line(&mut rest).unwrap();
    assert_eq!(rest, "", "one object");
    // The program ends by itself, and refuses files that cannot be shown.
    let ended = program(&[file, "--seconds", "0.1"]).output().unwrap();
    assert!(ended.status.success());
    let missing = program(&["missing.safetensors"]).output().unwrap();
    assert_eq!(missing.status.code(), Some(1));
    assert!(String::from_utf8_lossy(&missing.stdout).contains("error"));
    let empty = folder.path().join("empty");
    std::fs::create_dir(&empty).unwrap();
    let none = program(&[file, "--frames", empty.to_str().unwrap()]).output().unwrap();
    assert_eq!(none.status.code(), Some(1));
    let help =
        Command::new(env!("CARGO_BIN_EXE_splat4d")).args(["view", "--help"]).output().unwrap();
    let help = String::from_utf8(help.stdout).unwrap();
    told.as_object().unwrap().keys().for_each(|key| assert!(help.contains(key.as_str()), "{key}"));
}

/// Makes a video of six frames, each redder than the one before; needs ffmpeg.
fn video(folder: &std::path::Path) -> std::path::PathBuf {
    inputs(folder, 6);
    let file = folder.join("input.mp4");
    let made = Command::new("ffmpeg")
        .args(["-nostdin", "-v", "error", "-i"])
        .arg(folder.join("%d.png"))
        .args(["-c:v", "libx264", "-pix_fmt", "yuv444p", "-qp", "4"])
        .arg(&file)
        .status();
    assert!(made.expect("this test needs ffmpeg (Debian: ffmpeg)").success());
    file
}

#[test]
fn the_input_is_shown_from_its_video() {
    let device = common::device();
    let folder = tempfile::tempdir().unwrap();
    let file = video(folder.path());
    let pictures = Pictures::of_video(&file, &[1, 3, 4], &|| Ok(())).unwrap();
    assert_eq!(pictures.len(), 3);
    for (i, number) in [1, 3, 4].into_iter().enumerate() {
        let jpeg = pictures.jpeg(i).unwrap().unwrap();
        let picture = image::load_from_memory(&jpeg).unwrap().into_rgb8();
        assert_eq!(picture.dimensions(), (96, 54));
        let [red, green, _] = picture.get_pixel(48, 27).0.map(f64::from);
        assert!(
            (red - 255.0 * f64::from(number) / 6.0).abs() < 6.0 && green < 8.0,
            "{red} {green}"
        );
    }
    assert!(pictures.jpeg(3).unwrap().is_none());
    let server = serve(&device, scene(30), Some(pictures));
    assert_eq!(get(server.port(), "/pictures/2").0, 200);
    assert_eq!(get(server.port(), "/pictures/3").0, 404);
    // With the program: a scene that was made from every other frame, and one without that information.
    let mut made = scene(30);
    made.cameras.truncate(3);
    made.report = json!({ "frame_names": ["00000", "00002", "00004"] });
    for (scene, count) in [(made, 3), (scene(30), 6)] {
        scene.save(folder.path().join("scene.safetensors")).unwrap();
        let output = Command::new(env!("CARGO_BIN_EXE_splat4d"))
            .current_dir(folder.path())
            .args(["view", "scene.safetensors", "--frames", "input.mp4", "--seconds", "0.1"])
            .args(["--json", "--device", "software"])
            .output()
            .unwrap();
        let told: Value = serde_json::from_slice(&output.stdout).unwrap();
        assert_eq!(told["frames"], count, "{}", String::from_utf8_lossy(&output.stderr));
    }
    // A file that is not a video is an error.
    for (name, what) in [("0.png", "one image"), ("scene.safetensors", "video")] {
        let output = Command::new(env!("CARGO_BIN_EXE_splat4d"))
            .current_dir(folder.path())
            .args(["view", "scene.safetensors", "--frames", name, "--device", "software"])
            .output()
            .unwrap();
        let said = String::from_utf8(output.stderr).unwrap();
        assert!(output.status.code() == Some(1) && said.contains(what), "{said}");
    }
}

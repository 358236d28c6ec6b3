//! The live page of a running training. Needs Chromium (Debian: chromium).

#![cfg(feature = "cli")]

#[path = "support/browser.rs"]
mod browser;
#[path = "support/program.rs"]
mod program;
mod support;
#[path = "support/viewer.rs"]
mod viewer;

use std::collections::BTreeSet;
use std::fs;
use std::io::{BufRead, BufReader, Read};
use std::net::TcpListener;
use std::path::Path;
use std::process::{Child, Stdio};
use std::sync::mpsc::{Receiver, channel};
use std::time::Duration;

use browser::Browser;
use serde_json::{Value, json};
use splat4d::view::MOST_LIVE_PIXELS;
use splat4d::view::protocol::{Description, Status};
use viewer::{Client, Sent, camera, get, request};

/// Arguments that make a dataset, and arguments of a training that is long enough to be watched.
const DATASET: &str = "synth rigid -o clip --frames 8 --size 96x54 --seed 3";
const TRAINING: &str = "train clip/truth --steps 500 --random-points 700 --control-points 12 \
                        --sh-degree 1";

/// The running program.
struct Work {
    child: Child,
    port: u16,
    lines: Receiver<String>,
    /// The lines on stderr up to the address.
    said: Vec<String>,
}

impl Work {
    /// Starts the program, and waits for the address.
    fn begin(folder: &Path, arguments: &str) -> Work {
        let child = program::program()
            .current_dir(folder)
            .args(arguments.split_whitespace())
            .args(["--json", "--device", "software"])
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        let (sender, lines) = channel();
        let mut work = Work { child, port: 0, lines, said: Vec::new() };
        let stderr = work.child.stderr.take().unwrap();
        // All lines are read, so that the program never blocks on its stderr.
        std::thread::spawn(move || {
            BufReader::new(stderr).lines().map_while(Result::ok).for_each(|line| {
                let _ = sender.send(line);
            });
        });
        while work.port == 0 {
            let line =
                work.lines.recv_timeout(Duration::from_secs(60)).expect("an address is said");
            if let Some((_, port)) = line.split_once("http://127.0.0.1:") {
                work.port = port.trim_end_matches('/').parse().unwrap();
            }
            work.said.push(line);
        }
        work
    }

    fn url(&self) -> String {
        format!("http://127.0.0.1:{}/", self.port)
    }

    fn is_at_work(&mut self) -> bool {
        self.child.try_wait().unwrap().is_none()
    }

    /// Waits for the program, which must succeed; returns its JSON.
    #[track_caller]
    fn end(mut self) -> Value {
        let mut told = String::new();
        self.child.stdout.take().unwrap().read_to_string(&mut told).unwrap();
        let status = self.child.wait().unwrap();
        let said: Vec<String> = self.lines.iter().collect();
        assert_eq!(status.code(), Some(0), "{said:?}");
        serde_json::from_str(&told).unwrap()
    }
}

impl Drop for Work {
    fn drop(&mut self) {
        // The program has ended already unless the test has failed.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Mean difference between the input image that the page shows and a file, over channels in [0, 255].
#[track_caller]
fn input_from(page: &mut Browser, file: &Path) -> f64 {
    let told = page.evaluate(
        "(() => { const c = document.getElementById('input'); \
         const copy = new OffscreenCanvas(c.width, c.height); \
         const context = copy.getContext('2d', { willReadFrequently: true }); \
         context.drawImage(c, 0, 0); \
         return [...context.getImageData(0, 0, c.width, c.height).data]; })()",
    );
    let shown: Vec<f64> = serde_json::from_value(told).unwrap();
    let filmed = image::open(file).unwrap().into_rgba8().into_raw();
    assert_eq!(shown.len(), filmed.len());
    let apart = shown.iter().zip(&filmed).map(|(a, b)| (a - f64::from(*b)).abs());
    apart.sum::<f64>() / shown.len() as f64
}

/// A port that was free a moment ago.
fn free_port() -> u16 {
    TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port()
}

/// A checksum of the image on the canvas.
fn sum(page: &mut Browser) -> f64 {
    let sum = page.evaluate(
        "(() => { const c = document.getElementById('picture'); \
         const copy = new OffscreenCanvas(c.width, c.height); \
         const context = copy.getContext('2d', { willReadFrequently: true }); \
         context.drawImage(c, 0, 0); \
         return context.getImageData(0, 0, c.width, c.height).data.reduce((a, v, i) => \
         i % 4 < 3 ? (a * 31 + v) % 1000003 : a, 0); })()",
    );
    sum.as_f64().unwrap()
}

const STAGE: &str = "document.getElementById('work-stage').textContent";
const PICTURE: &str = "document.getElementById('picture')";

#[test]
fn the_page_follows_a_training_and_changes_nothing_of_it() {
    let folder = tempfile::tempdir().unwrap();
    program::json(folder.path(), DATASET);
    program::json(folder.path(), &format!("{TRAINING} -o alone.safetensors"));
    let arguments = format!("{TRAINING} -o seen.safetensors --view {}", free_port());
    let mut work = Work::begin(folder.path(), &arguments);
    let mut page = Browser::open(&work.url(), 1280, 800);
    page.wait_for("!document.getElementById('work').hidden");
    page.wait_for(&format!("/^training(, warm-up)?: \\d+ of \\d+ steps/.test({STAGE})"));
    page.wait_for(&format!("{PICTURE}.shown"));
    let stage = page.evaluate(STAGE);
    let first = sum(&mut page);
    page.wait_for(&format!("{STAGE} !== {stage}"));
    // The image changes without user input, from the same camera.
    let asked = page.evaluate(&format!("{PICTURE}.shown.asked.camera"));
    for _ in 0..400 {
        if sum(&mut page) != first {
            break;
        }
        std::thread::sleep(Duration::from_millis(50));
    }
    assert!(sum(&mut page) != first && work.is_at_work(), "the scene grows while it is trained");
    let same = "['fx', 'cx', 'view_from_world'].map((k) => c[k])";
    let now = page.evaluate(&format!("((c) => {same})({PICTURE}.shown.asked.camera)"));
    let [fx, cx, view] = ["fx", "cx", "view_from_world"].map(|key| asked[key].clone());
    assert_eq!(now[2], view, "{now} {fx} {cx}");
    // The page shows curves, and the controls of any scene.
    page.wait_for("document.querySelector('#psnr-curve path')?.getAttribute('d').includes('L')");
    page.wait_for("document.querySelectorAll('#loss-curve path').length === 2");
    let text = page.evaluate("document.getElementById('count-text').textContent");
    assert_eq!(text, json!("700"));
    assert_eq!(page.evaluate("document.getElementById('cameras').options.length"), json!(8));
    // The input beside the scene, at the time of the scene.
    page.evaluate("document.getElementById('show-input').click()");
    page.wait_for("document.getElementById('input-name').textContent === 'Input 1 of 8'");
    let file = |number: usize| folder.path().join(format!("clip/frames/{number:04}.png"));
    let (first, last) = (input_from(&mut page, &file(0)), input_from(&mut page, &file(7)));
    assert!(first < 6.0 && last > 3.0 * first, "{first} from the first, {last} from the last");
    page.evaluate("document.getElementById('next').click()");
    page.wait_for("document.getElementById('input-name').textContent === 'Input 2 of 8'");
    page.drag([500.0, 400.0], [560.0, 400.0]);
    page.wait_for(&format!(
        "{PICTURE}.shown.asked.camera.view_from_world.some((v, i) => v !== {view}[i])"
    ));
    // The page reports the end, and the last image stays.
    page.wait_for(&format!("{STAGE}.startsWith('The work is done')"));
    let report = work.end();
    assert!(report["psnr_input"].is_number());
    // The prediction holds the page.
    let [foreseen, taken] =
        ["predicted_bytes", "peak_bytes"].map(|key| report[key].as_u64().unwrap());
    assert!(taken <= foreseen, "{taken} bytes taken of {foreseen}");
    std::thread::sleep(Duration::from_secs(1));
    assert!(page.evaluate(STAGE).as_str().unwrap().starts_with("The work is done"));
    let painted = page.evaluate(&format!("{PICTURE}.width * {PICTURE}.height > 1000"));
    assert!(painted == json!(true) && sum(&mut page) != 0.0, "the last picture stays");
    assert!(page.said.is_empty(), "the console: {:#?}", page.said);
    let [alone, seen] = ["alone", "seen"]
        .map(|name| fs::read(folder.path().join(format!("{name}.safetensors"))).unwrap());
    assert!(alone == seen, "looking on has changed the scene");
}

#[test]
fn a_reconstruction_tells_its_stages() {
    let folder = tempfile::tempdir().unwrap();
    program::json(folder.path(), "synth rigid -o clip --frames 8 --size 96x54 --seed 3");
    let taken = TcpListener::bind("127.0.0.1:0").unwrap();
    let port = taken.local_addr().unwrap().port();
    let arguments = format!(
        "reconstruct clip/frames -o scene.safetensors --steps 150 --max-gaussians 900 \
         --control-points 12 --view {port}"
    );
    let work = Work::begin(folder.path(), &arguments);
    let note = format!("port {port} is in use, {} is taken", work.port);
    assert!(work.said.iter().any(|line| line.contains(&note)), "{:?}", work.said);
    // Before a scene exists, none is shown.
    let (status, text) = get(work.port, "/scene.json");
    let body = text.split_once("\r\n\r\n").unwrap().1;
    let described: Description = serde_json::from_str(body).unwrap();
    assert!(status == 200 && described.live && described.cameras.is_empty(), "{text}");
    assert_eq!((described.pictures, get(work.port, "/pictures/0").0), (0, 404), "{text}");
    let mut client = Client::open(work.port, "socket").unwrap();
    client.ask(&request(1, camera(64, 36, 0.0), 0.0));
    let mut stages = BTreeSet::new();
    let (mut refused, mut pictures, mut last) = (0, 0, Status::default());
    loop {
        match client.hear() {
            Sent::Told(status) => {
                stages.insert(status.stage.clone());
                if status.scenes > last.scenes {
                    let (_, text) = get(work.port, "/scene.json");
                    let body = text.split_once("\r\n\r\n").unwrap().1;
                    let described: Description = serde_json::from_str(body).unwrap();
                    assert_eq!((described.cameras.len(), described.pictures), (8, 8));
                    client.ask(&request(1 + status.scenes, camera(64, 36, 0.0), 0.5));
                }
                assert!(status.done <= status.of && status.scenes >= last.scenes, "{status:?}");
                last = status;
            }
            Sent::Refused(refusal) => {
                assert!(refusal.error.contains("no scene yet"), "{refusal:?}");
                refused += 1;
            }
            Sent::Picture(header, ..) => {
                assert!(header.gaussians > 0);
                pictures += 1;
            }
            Sent::Closed(code) => {
                assert_eq!(code, 1001, "going away");
                break;
            }
        }
    }
    assert_eq!(refused, 1);
    assert!(pictures >= 1, "of the finished scene at least");
    for stage in ["tracking, cameras", "training, static", "training, joint", "evaluating"] {
        assert!(stages.contains(stage), "{stages:?}");
    }
    assert!(last.end.unwrap().starts_with("The work is done"));
    assert!(last.curves.len() >= 2 && last.curves.is_sorted_by_key(|point| point.step));
    work.end();
}

#[test]
fn hostile_clients_do_not_stop_a_training() {
    let folder = tempfile::tempdir().unwrap();
    program::json(folder.path(), DATASET);
    program::json(folder.path(), &format!("{TRAINING} -o alone.safetensors"));
    let arguments = format!("{TRAINING} -o seen.safetensors --view={}", free_port());
    let mut work = Work::begin(folder.path(), &arguments);
    // Endless requests for the largest images without reading the responses, requests above the size
    // limit, and garbage.
    let mut clients: Vec<Client> =
        (0..3).map(|_| Client::open(work.port, "socket").unwrap()).collect();
    let mut id = 0;
    while work.is_at_work() {
        id += 1;
        let (most, large) = (camera(1280, 720, 0.0), camera(1920, 1080, 0.0));
        assert_eq!(1280 * 720, MOST_LIVE_PIXELS);
        let messages = [
            serde_json::to_string(&request(id, most, 0.5)).unwrap(),
            serde_json::to_string(&request(id, large, 0.5)).unwrap(),
            "{\"status\": 1}".to_owned(),
        ];
        for (client, message) in clients.iter_mut().zip(messages) {
            // A disconnected client reconnects.
            if client.0.send(tungstenite::Message::text(message)).is_err()
                && let Ok(again) = Client::open(work.port, "socket")
            {
                *client = again;
            }
        }
        std::thread::sleep(Duration::from_millis(4));
    }
    work.end();
    let [alone, seen] = ["alone", "seen"]
        .map(|name| fs::read(folder.path().join(format!("{name}.safetensors"))).unwrap());
    assert!(alone == seen, "clients have changed the scene");
}

/// Screenshots of the page during and after a training, for people to look at, in the folder that
/// `SPLAT4D_SHOTS` names.
#[test]
#[ignore = "writes pictures for people"]
fn the_page_as_it_looks() {
    let shots = std::env::var("SPLAT4D_SHOTS").expect("SPLAT4D_SHOTS names a folder");
    let folder = tempfile::tempdir().unwrap();
    program::json(folder.path(), "synth rigid -o clip --frames 12 --size 320x180 --seed 3");
    let arguments = format!(
        "reconstruct clip/frames -o scene.safetensors --steps 600 --report {shots}/reconstruct \
         --view {}",
        free_port()
    );
    let work = Work::begin(folder.path(), &arguments);
    let mut pages = [("wide", 1280, 800), ("narrow", 360, 740)]
        .map(|(name, width, height)| (name, Browser::open(&work.url(), width, height)));
    let shoot = |pages: &mut [(&str, Browser)], what: &str| {
        for (name, page) in pages {
            fs::write(format!("{shots}/live_{what}_{name}.png"), page.screenshot()).unwrap();
        }
    };
    pages[0].1.wait_for(&format!("{STAGE}.startsWith('tracking')"));
    shoot(&mut pages, "tracking");
    for (_, page) in &mut pages {
        let begun = std::time::Instant::now();
        while page.evaluate(&format!("Boolean({PICTURE}.shown)")) != json!(true) {
            assert!(begun.elapsed() < Duration::from_secs(300));
            std::thread::sleep(Duration::from_millis(100));
        }
    }
    std::thread::sleep(Duration::from_secs(20));
    shoot(&mut pages, "training");
    for (_, page) in &mut pages {
        let begun = std::time::Instant::now();
        let ended = format!("{STAGE}.startsWith('The work is done')");
        while page.evaluate(&ended) != json!(true) {
            assert!(begun.elapsed() < Duration::from_secs(500));
            std::thread::sleep(Duration::from_millis(200));
        }
    }
    shoot(&mut pages, "end");
    work.end();
    program::json(
        folder.path(),
        &format!(
            "train clip/truth -o trained.safetensors --steps 600 --random-points 3000 --report {shots}/train"
        ),
    );
    for (command, width, height) in [
        ("reconstruct", 1280, 2400),
        ("reconstruct", 360, 2400),
        ("train", 1280, 2400),
        ("train", 360, 2400),
    ] {
        let report = Path::new(&shots).join(command).join("report.html");
        let mut page = Browser::open_file(&report, width, height);
        std::thread::sleep(Duration::from_millis(500));
        fs::write(format!("{shots}/{command}_{width}.png"), page.screenshot()).unwrap();
        assert!(page.said.is_empty(), "{:?}", page.said);
    }
}

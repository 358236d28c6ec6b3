//! A scene for the viewer, and clients of the viewer's server.

// Each test binary uses its own part.
#![allow(dead_code)]

use std::io::{Read, Write};
use std::net::TcpStream;
use std::path::Path;
use std::time::Duration;

use glam::{DQuat, DVec3};
use splat4d::data::write_png;
use splat4d::gpu::Device;
use splat4d::scene::{Scene, SceneCamera};
use splat4d::types::{Camera, ControlPoints, Gaussians, Image, Intrinsics, Pose, Tuning};
use splat4d::view::protocol::{Format, Header, Layer, Refusal, Request, Status, Told};
use splat4d::view::{Options, Pictures, Server, Show};
use tungstenite::{Message, WebSocket};

/// Smallest allowed PSNR of a JPEG that the page shows, against the exact image, dB.
pub const JPEG_PSNR: f64 = 30.0;

/// A cloud in front of the cameras, of which every third Gaussian moves to the right and a little up.
pub fn scene(count: usize) -> Scene {
    let noise = |i: usize, k: u32| {
        let x = (i as u32).wrapping_mul(2_654_435_761).wrapping_add(k.wrapping_mul(40_503));
        let x = (x ^ x >> 15).wrapping_mul(2_246_822_519);
        (x ^ x >> 13) as f32 / u32::MAX as f32 * 2.0 - 1.0
    };
    let spread = 120.0 / (count as f32);
    let gaussians = Gaussians {
        positions: (0..count)
            .map(|i| [1.8 * noise(i, 1), noise(i, 2), 4.0 + noise(i, 3)])
            .collect(),
        log_scales: (0..count)
            .map(|i| {
                std::array::from_fn(|k| spread.cbrt().ln() - 2.0 + 0.3 * noise(i, 4 + k as u32))
            })
            .collect(),
        rotations: (0..count).map(|i| [1.0, noise(i, 7), noise(i, 8), noise(i, 9)]).collect(),
        opacity_logits: (0..count).map(|i| 1.0 + noise(i, 10)).collect(),
        sh_degree: 0,
        sh: (0..count).map(|i| std::array::from_fn(|k| 1.5 * noise(i, 11 + k as u32))).collect(),
        motion_logits: (0..count).map(|i| if i % 3 == 0 { 3.0 } else { -3.0 }).collect(),
    };
    let nodes = 5;
    let still = [0.0; 8];
    let moved = [1.0, -0.3, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0];
    let gone = [0.0, 0.0, 0.0, ControlPoints::ABSENT, 0.0, 0.0, 0.0, 0.0];
    let path =
        |key: usize| (0..nodes).map(move |i| if i == 4 { gone } else { [still, moved][key] });
    let control_points = ControlPoints {
        positions: (0..nodes).map(|i| [i as f32 * 0.8 - 1.6, 0.1 * i as f32, 4.0]).collect(),
        log_radii: vec![0.0; nodes],
        paths: path(0).chain(path(1)).collect(),
    };
    let cameras = (0..6).map(|i| SceneCamera {
        time: f64::from(i) / 5.0,
        camera: camera(96, 54, f64::from(i) * 0.1 - 0.25),
    });
    Scene {
        control_points,
        cameras: cameras.collect(),
        background: [0.1, 0.2, 0.3],
        ..Scene::of(gaussians)
    }
}

/// A camera offset from the origin by `aside` that looks along z, slightly rotated.
pub fn camera(width: u32, height: u32, aside: f64) -> Camera {
    Camera {
        intrinsics: Intrinsics::centred(0.9 * f64::from(width), width, height),
        view_from_world: Pose::new(
            DQuat::from_rotation_y(0.3 * aside),
            DVec3::new(-aside, 0.0, 0.0),
        ),
    }
}

/// Starts a server on any free port of this machine.
pub fn serve(device: &Device, scene: Scene, pictures: Option<Pictures>) -> Server {
    let options = Options { port: 0, ..Options::default() };
    Server::start(device, show(scene, pictures), &options).unwrap()
}

pub fn show(scene: Scene, pictures: Option<Pictures>) -> Show {
    let start = scene.cameras[0].camera;
    let name = "a scene".into();
    Show { name, scene, tuning: Tuning::default(), start, distance: 4.0, pictures }
}

pub fn request(id: u64, camera: Camera, time: f64) -> Request {
    Request {
        id,
        time,
        layer: Layer::Colour,
        format: Format::Png,
        quality: 90,
        points: false,
        camera: camera.into(),
    }
}

/// A message from the server.
#[derive(Debug)]
pub enum Sent {
    Picture(Header, Vec<[f32; 4]>, Image),
    Refused(Refusal),
    Told(Status),
    Closed(u16),
}

/// A WebSocket client.
pub struct Client(pub WebSocket<TcpStream>);

impl Client {
    pub fn new(server: &Server) -> Client {
        Client::open(server.port(), "socket").unwrap()
    }

    pub fn open(port: u16, path: &str) -> Result<Client, String> {
        let stream = TcpStream::connect(("127.0.0.1", port)).map_err(|e| e.to_string())?;
        stream.set_read_timeout(Some(Duration::from_secs(60))).unwrap();
        let url = format!("ws://127.0.0.1:{port}/{path}");
        let opened = tungstenite::client(url, stream).map_err(|e| e.to_string())?;
        Ok(Client(opened.0))
    }

    pub fn ask(&mut self, request: &Request) {
        self.say(&serde_json::to_string(request).unwrap());
    }

    /// Sends several requests in one write: a server that is rendering receives all of them before it is
    /// done, however this thread is scheduled.
    pub fn ask_at_once(&mut self, requests: impl IntoIterator<Item = Request>) {
        for request in requests {
            let text = serde_json::to_string(&request).unwrap();
            self.0.write(Message::text(text)).unwrap();
        }
        self.0.flush().unwrap();
    }

    pub fn say(&mut self, text: &str) {
        self.0.send(Message::text(text)).unwrap();
    }

    /// The next message that is not a ping.
    #[track_caller]
    pub fn hear(&mut self) -> Sent {
        loop {
            match self.0.read() {
                Ok(Message::Binary(bytes)) => return unpacked(&bytes),
                Ok(Message::Text(text)) => {
                    return match serde_json::from_str::<Told>(&text) {
                        Ok(told) => Sent::Told(told.status),
                        Err(_) => Sent::Refused(serde_json::from_str(&text).unwrap()),
                    };
                }
                Ok(Message::Close(frame)) => {
                    return Sent::Closed(frame.map_or(1005, |frame| frame.code.into()));
                }
                Ok(_) => {}
                // The connection ended without a close frame.
                Err(_) => return Sent::Closed(1006),
            }
        }
    }

    #[track_caller]
    pub fn picture(&mut self) -> (Header, Vec<[f32; 4]>, Image) {
        match self.hear() {
            Sent::Picture(header, points, image) => (header, points, image),
            other => panic!("an image was expected: {other:?}"),
        }
    }

    #[track_caller]
    pub fn refusal(&mut self) -> Refusal {
        match self.hear() {
            Sent::Refused(refusal) => refusal,
            other => panic!("a refusal was expected: {other:?}"),
        }
    }
}

fn unpacked(bytes: &[u8]) -> Sent {
    let length = u32::from_le_bytes(bytes[..4].try_into().unwrap()) as usize;
    let header: Header = serde_json::from_slice(&bytes[4..4 + length]).unwrap();
    let (points, file) = bytes[4 + length..].split_at(16 * header.points);
    let value = |b: &[u8]| f32::from_le_bytes(b.try_into().unwrap());
    let point = |row: &[u8]| std::array::from_fn(|k| value(&row[4 * k..4 * k + 4]));
    let points = points.chunks_exact(16).map(point).collect();
    Sent::Picture(header, points, decoded(file))
}

/// Decodes an image file to RGB or grey in [0, 1].
pub fn decoded(file: &[u8]) -> Image {
    let decoded = image::load_from_memory(file).unwrap();
    let (width, height) = (decoded.width(), decoded.height());
    let channels = u32::from(decoded.color().channel_count());
    let bytes = decoded.into_bytes();
    let pixels = bytes.into_iter().map(|v| f32::from(v) / 255.0).collect();
    Image { width, height, channels, pixels }
}

/// The image rounded to 8 bits, as the server sends it.
pub fn rounded(image: &Image) -> Image {
    let pixels =
        image.pixels.iter().map(|v| f32::from((v * 255.0).round() as u8) / 255.0).collect();
    Image { pixels, ..*image }
}

pub fn psnr(a: &Image, b: &Image) -> f64 {
    assert_eq!((a.width, a.height, a.channels), (b.width, b.height, b.channels));
    let squares = a.pixels.iter().zip(&b.pixels).map(|(a, b)| f64::from(a - b).powi(2));
    -10.0 * (squares.sum::<f64>() / a.pixels.len() as f64).log10()
}

/// Sends an HTTP request of these lines; returns the status and the rest of the response.
pub fn http(port: u16, lines: &[&str]) -> (u16, String) {
    let mut stream = TcpStream::connect(("127.0.0.1", port)).unwrap();
    stream.set_read_timeout(Some(Duration::from_secs(60))).unwrap();
    stream.write_all((lines.join("\r\n") + "\r\n\r\n").as_bytes()).unwrap();
    let mut answer = Vec::new();
    let _ = stream.read_to_end(&mut answer);
    let text = String::from_utf8_lossy(&answer).into_owned();
    let status = text.split(' ').nth(1).and_then(|code| code.parse().ok()).unwrap_or(0);
    (status, text)
}

/// Sends a plain GET with the server's own `Host`.
pub fn get(port: u16, path: &str) -> (u16, String) {
    http(port, &[&format!("GET {path} HTTP/1.1"), &format!("Host: 127.0.0.1:{port}")])
}

/// Input images, one per camera, each of a single colour.
pub fn inputs(folder: &Path, count: usize) -> Pictures {
    let file = |i: usize| {
        let mut picture = Image::new(96, 54, 3);
        picture.pixels.chunks_exact_mut(3).for_each(|p| p[0] = i as f32 / count as f32);
        let path = folder.join(format!("{i}.png"));
        write_png(&path, &picture).unwrap();
        path
    };
    Pictures::files((0..count).map(file).collect())
}

pub fn of_one_channel(image: &Image, value: impl Fn(&[f32]) -> f32) -> Image {
    let pixels = image.pixels.chunks_exact(image.channels as usize).map(value).collect();
    Image { channels: 1, pixels, ..*image }
}

//! `--view` of commands that train: a page in the browser that shows the training while it runs.

use std::net::{IpAddr, Ipv4Addr};
use std::path::Path;
use std::time::{Duration, Instant};

use clap::Args;
use splat4d::Result;
use splat4d::gpu::Device;
use splat4d::scene::{Scene, SceneCamera};
use splat4d::types::Tuning;
use splat4d::view::protocol::Progressed;
use splat4d::view::{self, Options, Server, Show};

use super::common::say;
use super::{path, values};

/// Port of `--view` without a value.
const USUAL_PORT: &str = "8090";
/// Maximum time at the end for sending an image of the finished scene to open pages.
const FAREWELL: Duration = Duration::from_millis(1500);
/// Interval at which this is checked.
const LOOK: Duration = Duration::from_millis(20);

/// Options of commands with a live view.
#[derive(Args)]
pub struct LiveArgs {
    /// Show the work in the browser while it runs, at the printed address: its stage, the curves and the
    /// growing scene; on this port [default: 8090], or the next free one
    #[arg(long, value_name = "PORT", num_args = 0..=1, default_missing_value = USUAL_PORT,
          value_parser = values::port)]
    view: Option<u16>,
    /// The address that --view listens on
    #[arg(long, value_name = "ADDRESS", requires = "view", value_parser = values::host)]
    host: Option<IpAddr>,
}

impl LiveArgs {
    /// Starts the live view on a device, if it is requested; `name` is shown on the page.
    pub fn start(&self, device: &Device, name: &str, tuning: Tuning) -> Result<Option<Live>> {
        let Some(port) = self.view else { return Ok(None) };
        let host = self.host.unwrap_or(Ipv4Addr::LOCALHOST.into());
        let (server, live) = Server::live(device, name, &Options { host, port })?;
        if server.port() != port {
            say(&format!("note: port {port} is in use, {} is taken", server.port()));
        }
        if !host.is_loopback() {
            say("note: other machines reach this; whoever has the address sees the scene");
        }
        say(&format!("the work is shown at {}", server.url()));
        Ok(Some(Live {
            server: Some(server),
            live,
            name: name.to_owned(),
            tuning,
            cameras: Vec::new(),
        }))
    }
}

/// The live view of a training. If it is dropped before [`finish`](Self::finish), the page reports that the
/// work was stopped.
pub struct Live {
    server: Option<Server>,
    live: view::Live,
    name: String,
    tuning: Tuning,
    /// Cameras for scenes without cameras.
    cameras: Vec<SceneCamera>,
}

impl Live {
    /// Sets the cameras for scenes without cameras.
    pub fn set_cameras(&mut self, cameras: Vec<SceneCamera>) {
        self.cameras = cameras;
    }

    /// Reports a stage without known progress.
    pub fn stage(&self, stage: &str) {
        self.live.progress(stage, 0, 0, "");
    }

    /// Reports the progress of a stage in percent.
    pub fn percent(&self, stage: &str, done: u64) {
        self.live.progress(stage, done, 100, "%");
    }

    /// Reports the progress of a stage in steps.
    pub fn steps(&self, stage: &str, done: u32, of: u32) {
        self.live.progress(stage, done.into(), of.into(), "steps");
    }

    /// Reports a point of the curves.
    pub fn measured(&self, point: Progressed) {
        self.live.measured(point);
    }

    /// Whether a page is open.
    pub fn is_seen(&self) -> bool {
        self.live.has_clients()
    }

    /// Whether the scene is to be shown now.
    pub fn wants_scene(&self) -> bool {
        self.live.wants_scene()
    }

    /// Shows a copy of the current scene.
    pub fn scene(&self, mut scene: Scene) {
        if scene.cameras.is_empty() {
            scene.cameras.clone_from(&self.cameras);
            scene.set_up_from_cameras();
        }
        let (start, distance) = path::start(&scene);
        let (name, tuning) = (self.name.clone(), self.tuning);
        let show = Show { name, scene, tuning, start, distance, pictures: None };
        // An error of the page must not end the work.
        if let Err(error) = self.live.hand_over(show) {
            say(&format!("note: the page shows no scene: {error}"));
        }
    }

    /// Shows the finished scene on the open pages.
    pub fn finished_scene(&self, scene: &Scene) {
        if self.is_seen() {
            self.scene(scene.clone());
        }
    }

    /// Reports that the work is done; the page keeps its last image.
    pub fn finish(mut self) {
        self.live.end("The work is done; the scene is in its file.");
        let begun = Instant::now();
        while self.live.is_awaited() && begun.elapsed() < FAREWELL {
            std::thread::sleep(LOOK);
        }
        self.stop();
    }

    fn stop(&mut self) {
        // Errors of the page do not affect the work.
        if let Some(Err(error)) = self.server.take().map(Server::stop) {
            say(&format!("note: the page ended before the work: {error}"));
        }
    }
}

impl Drop for Live {
    fn drop(&mut self) {
        if self.server.is_some() {
            self.live.end("The work was stopped before it was done.");
            self.stop();
        }
    }
}

/// Name of the input at a path, without its folder.
pub fn name_of(input: &Path) -> String {
    input.file_name().unwrap_or(input.as_os_str()).to_string_lossy().into_owned()
}

//! `--view` of commands that train: the page in the browser while they work.

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

/// What `--view` alone stands for.
const USUAL_PORT: &str = "8090";
/// Pages that are open at the end get a picture of the finished scene, within this time.
const FAREWELL: Duration = Duration::from_millis(1500);
/// How often it is looked whether they have it.
const LOOK: Duration = Duration::from_millis(20);

/// The flags of commands that show their work.
#[derive(Args)]
pub struct LiveArgs {
    /// Show the work in the browser while it runs, at the address that is said: its stage, the curves and
    /// the scene as it grows; on a port [default: 8090], or where that is in use the next free one
    #[arg(long, value_name = "PORT", num_args = 0..=1, default_missing_value = USUAL_PORT,
          value_parser = values::port)]
    view: Option<u16>,
    /// The address that --view listens on
    #[arg(long, value_name = "ADDRESS", requires = "view", value_parser = values::host)]
    host: Option<IpAddr>,
}

impl LiveArgs {
    /// Begins to show work on a device, where that is asked for; `name` is what the page calls it.
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

/// The page of the work at hand. Dropped before it is [finished](Self::finish), it says that the work was
/// stopped.
pub struct Live {
    server: Option<Server>,
    live: view::Live,
    name: String,
    tuning: Tuning,
    /// Of scenes that come without.
    cameras: Vec<SceneCamera>,
}

impl Live {
    /// Gives the cameras of scenes that come without.
    pub fn set_cameras(&mut self, cameras: Vec<SceneCamera>) {
        self.cameras = cameras;
    }

    /// A stage begins of which it is not known how far it is.
    pub fn stage(&self, stage: &str) {
        self.live.progress(stage, 0, 0, "");
    }

    /// So much of a stage is done, in hundredths.
    pub fn percent(&self, stage: &str, done: u64) {
        self.live.progress(stage, done, 100, "%");
    }

    /// So many of a stage's steps are done.
    pub fn steps(&self, stage: &str, done: u32, of: u32) {
        self.live.progress(stage, done.into(), of.into(), "steps");
    }

    /// A point of the curves.
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

    /// Shows the scene as it is.
    pub fn scene(&self, mut scene: Scene) {
        if scene.cameras.is_empty() {
            scene.cameras.clone_from(&self.cameras);
            scene.set_up_from_cameras();
        }
        let (start, distance) = path::start(&scene);
        let (name, tuning) = (self.name.clone(), self.tuning);
        let show = Show { name, scene, tuning, start, distance, pictures: None };
        // The work is worth more than its page.
        if let Err(error) = self.live.hand_over(show) {
            say(&format!("note: the page shows no scene: {error}"));
        }
    }

    /// Shows the finished scene to the pages that are open.
    pub fn finished_scene(&self, scene: &Scene) {
        if self.is_seen() {
            self.scene(scene.clone());
        }
    }

    /// The work is done: the page says so and keeps its picture.
    pub fn finish(mut self) {
        self.live.end("The work is done; the scene is in its file.");
        let begun = Instant::now();
        while self.live.is_awaited() && begun.elapsed() < FAREWELL {
            std::thread::sleep(LOOK);
        }
        self.stop();
    }

    fn stop(&mut self) {
        // Why pictures could not be made is nothing that the work depends on.
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

/// What the input at a path is called, without the folder where it lies.
pub fn name_of(input: &Path) -> String {
    input.file_name().unwrap_or(input.as_os_str()).to_string_lossy().into_owned()
}

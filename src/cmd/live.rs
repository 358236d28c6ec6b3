//! `--view` of commands that train: a page in the browser that shows the training while it runs.

use std::net::{IpAddr, Ipv4Addr};
use std::path::Path;
use std::time::{Duration, Instant};

use clap::Args;
use splat4d::Result;
use splat4d::camera_path::initial_view;
use splat4d::gpu::{Device, Footprint};
use splat4d::renderer::RenderScale;
use splat4d::scene::{Scene, SceneCamera};
use splat4d::train::TrainingScale;
use splat4d::types::{Image, Tuning};
use splat4d::view::protocol::Progressed;
use splat4d::view::{self, Options, Pictures, Server, Show};

use super::common::{foresee, say, training};
use super::values;

/// Port of `--view` without a value.
const USUAL_PORT: &str = "8090";
/// Maximum time at the end for sending an image of the finished scene to open pages.
const FAREWELL: Duration = Duration::from_millis(1500);
/// Interval at which this is checked.
const LOOK: Duration = Duration::from_millis(20);
/// Image size for which the page's memory is predicted: the largest that it makes.
const LARGEST: (u32, u32) = (1280, 720);

/// Options of commands with a live view.
#[derive(Args)]
pub struct LiveArgs {
    /// Show the work in the browser while it runs, at the printed address: its stage, the curves, and the
    /// growing scene beside the input; on this port [default: 8090], or the next free one
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
            pictures: None,
        }))
    }

    /// Prints and returns the predicted device memory of a training and of its page, if it is requested; an
    /// error where both do not fit, which says to change what `turn` names.
    pub fn foresee(
        &self,
        device: &Device,
        scale: &TrainingScale,
        tuning: &Tuning,
        turn: &str,
    ) -> Result<Foreseen> {
        let (what, alone) = (training(scale), scale.footprint(device));
        if self.view.is_none() {
            let most = || scale.most_gaussians(device);
            return foresee(device, &what, alone, most, turn).map(Foreseen::from);
        }
        let page = RenderScale {
            gaussians: scale.reached(),
            sh_degree: scale.settings.sh_degree,
            motion: scale.motion,
            size: LARGEST,
            intersections: 0,
            tuning: *tuning,
            repainted: true,
        };
        let mut training_bytes = 0;
        let both = alone.and_then(|training| {
            let page = page.footprint(device)?;
            training_bytes = training.bytes;
            let bytes = training.bytes + page.bytes;
            let larger = if page.largest_bytes > training.largest_bytes { page } else { training };
            Ok(Footprint { bytes, ..larger })
        });
        let turn = format!("{turn}, or leave out --view");
        let with_page = foresee(device, &format!("{what} with a page"), both, || 0, &turn)?;
        Ok(Foreseen { alone: training_bytes, with_page })
    }
}

/// Predicted device memory, bytes.
#[derive(Clone, Copy)]
pub struct Foreseen {
    /// Of the work alone: the scene keeps this, since a page must change nothing of it.
    pub alone: u64,
    /// Of the work and its page, if it has one.
    pub with_page: u64,
}

impl From<u64> for Foreseen {
    /// The prediction for work without a page.
    fn from(bytes: u64) -> Foreseen {
        Foreseen { alone: bytes, with_page: bytes }
    }
}

impl Foreseen {
    /// The prediction for two parts of the work, one after the other.
    pub fn max(self, other: Foreseen) -> Foreseen {
        Foreseen {
            alone: self.alone.max(other.alone),
            with_page: self.with_page.max(other.with_page),
        }
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
    /// The input images, in the order of the scene's cameras.
    pictures: Option<Pictures>,
}

impl Live {
    /// Sets the cameras for scenes without cameras.
    pub fn set_cameras(&mut self, cameras: Vec<SceneCamera>) {
        self.cameras = cameras;
    }

    /// Sets the input images that are shown beside the scene, in the order of the scene's cameras.
    pub fn set_pictures<'a>(&mut self, images: impl IntoIterator<Item = &'a Image>) {
        // An error of the page must not end the work.
        match Pictures::of_images(images) {
            Ok(pictures) => self.pictures = Some(pictures),
            Err(error) => say(&format!("note: the page shows no input: {error}")),
        }
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
        let (start, distance) = initial_view(&scene);
        let (name, tuning) = (self.name.clone(), self.tuning);
        let pictures = self.pictures.clone();
        let show = Show { name, scene, tuning, start, distance, pictures };
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

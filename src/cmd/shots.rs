//! The views that `render` renders: cameras and times, in order.

use std::ffi::OsString;
use std::path::PathBuf;

use clap::Args;
use clap::builder::{OsStringValueParser, TypedValueParser};
use splat4d::camera_path::{CameraPath, PathShape};
use splat4d::data::transforms::{self, TimedCamera};
use splat4d::scene::{Scene, SceneCamera};
use splat4d::types::Intrinsics;
use splat4d::{Error, Result};

use super::common::thousands;
use super::values::{self, MOST_PICTURES, Times};

/// Default number of views of a path.
const PATH_FRAMES: usize = 60;

/// Source of the cameras.
#[derive(Clone, Debug, PartialEq)]
pub enum ViewPath {
    Input,
    Shape(PathShape),
    File(PathBuf),
}

impl From<OsString> for ViewPath {
    fn from(text: OsString) -> ViewPath {
        match text.to_str() {
            Some("input") => ViewPath::Input,
            name => match name.and_then(PathShape::named) {
                Some(shape) => ViewPath::Shape(shape),
                None => ViewPath::File(text.into()),
            },
        }
    }
}

/// Options that select cameras and times.
#[derive(Args)]
pub struct ShotArgs {
    /// The camera path
    #[arg(long, value_name = "input|orbit|spiral|dolly|bullet|FILE",
          value_parser = OsStringValueParser::new().map(ViewPath::from))]
    path: Option<ViewPath>,
    /// Times in [0, 1], such as 0,0.5,1; or an integer above 1 for that many evenly spaced times
    #[arg(long, value_name = "TIMES", value_parser = values::times)]
    times: Option<Times>,
    /// Number of views of a path other than the input's or a file's [default: 60, or the number of times]
    #[arg(long, value_name = "N", value_parser = values::whole::<usize>(1..=values::MOST_PICTURES))]
    frames: Option<usize>,
    /// Size of the images; the camera's whole field of view stays visible
    #[arg(long, value_name = "WxH", value_parser = values::size)]
    size: Option<(u32, u32)>,
    /// Focal length in pixels of the rendered size, instead of the camera's
    #[arg(long, value_name = "PIXELS",
          value_parser = values::number(1.0..=values::MOST_FOCAL))]
    focal: Option<f64>,
}

impl ShotArgs {
    /// The file that the cameras are read from.
    pub fn file(&self) -> Option<&PathBuf> {
        match &self.path {
            Some(ViewPath::File(file)) => Some(file),
            _ => None,
        }
    }
}

/// The views to render, in order. Only the cameras of a file are stored, because there may be many views.
pub struct Shots<'a> {
    cameras: Cameras<'a>,
    times: Option<Times>,
    size: Option<(u32, u32)>,
    focal: Option<f64>,
}

enum Cameras<'a> {
    Listed(Vec<SceneCamera>),
    Path(CameraPath<'a>),
}

impl Cameras<'_> {
    fn len(&self) -> usize {
        match self {
            Cameras::Listed(cameras) => cameras.len(),
            Cameras::Path(path) => path.len(),
        }
    }
}

impl<'a> Shots<'a> {
    /// The views that the options select.
    pub fn of(args: &ShotArgs, scene: &'a Scene) -> Result<Shots<'a>> {
        let frames = |shape: PathShape| match (args.frames, &args.times) {
            (Some(frames), _) => frames,
            (None, Some(times)) if times.len() > 1 && shape != PathShape::Bullet => times.len(),
            _ => PATH_FRAMES,
        };
        let default = match scene.cameras.is_empty() {
            true => ViewPath::Shape(PathShape::Orbit),
            false => ViewPath::Input,
        };
        let cameras = match args.path.as_ref().unwrap_or(&default) {
            ViewPath::Input => Cameras::Listed(input(scene)?),
            ViewPath::Shape(shape) => Cameras::Path(CameraPath::new(scene, *shape, frames(*shape))),
            ViewPath::File(file) => {
                let listed = transforms::read_cameras(file)?.into_iter();
                let known = |TimedCamera { time, camera }| SceneCamera { time, camera };
                Cameras::Listed(listed.map(known).collect())
            }
        };
        let shots =
            Shots { cameras, times: args.times.clone(), size: args.size, focal: args.focal };
        for i in 0..shots.cameras.len() {
            shots.at(i).camera.check().map_err(|what| {
                Error::Input(format!("camera {i} of the path cannot be rendered from: {what}"))
            })?;
        }
        match shots.len() as u64 {
            0..=MOST_PICTURES => Ok(shots),
            count => Err(Error::Input(format!(
                "{} cameras, each at {} times, are {} images; at most {} are rendered at once: \
                 give fewer --times or --frames",
                thousands(shots.cameras.len()),
                thousands(shots.times.as_ref().map_or(1, Times::len)),
                thousands(count as usize),
                thousands(MOST_PICTURES as usize)
            ))),
        }
    }

    /// Number of views.
    pub fn len(&self) -> usize {
        let cameras = self.cameras.len();
        match self.times.as_ref().map(Times::len) {
            // With as many times as cameras, one time per camera.
            Some(times) if times != cameras || self.has_fixed_time() => {
                cameras.saturating_mul(times)
            }
            _ => cameras,
        }
    }

    /// Whether a whole path is rendered at one time.
    fn has_fixed_time(&self) -> bool {
        matches!(&self.cameras, Cameras::Path(path) if path.has_fixed_time())
    }

    /// A view; see the command's help.
    pub fn at(&self, index: usize) -> SceneCamera {
        let camera = index % self.cameras.len();
        let mut shot = match &self.cameras {
            Cameras::Listed(cameras) => cameras[camera],
            Cameras::Path(path) => path.at(camera),
        };
        if let Some(times) = &self.times {
            let one_each = times.len() == self.cameras.len() && !self.has_fixed_time();
            let time = times.at(if one_each { index } else { index / self.cameras.len() });
            shot.time = time;
            if let Cameras::Path(path) = &self.cameras
                && self.has_fixed_time()
            {
                shot = path.at_time(camera, time);
            }
        }
        let k = &mut shot.camera.intrinsics;
        if let Some((width, height)) = self.size {
            *k = k.fitted(width, height);
        }
        if let Some(focal) = self.focal {
            (k.fx, k.fy) = (focal, focal);
        }
        shot
    }

    /// The intrinsics of the largest image.
    pub fn largest(&self) -> Option<Intrinsics> {
        let sizes = (0..self.cameras.len()).map(|i| self.at(i).camera.intrinsics);
        sizes.max_by_key(|k| u64::from(k.width) * u64::from(k.height))
    }
}

/// The input's cameras with their times.
fn input(scene: &Scene) -> Result<Vec<SceneCamera>> {
    if scene.cameras.is_empty() {
        return Err(Error::Input(
            "the scene knows no input cameras; render it with --path orbit, or along a \
             transforms.json"
                .into(),
        ));
    }
    Ok(scene.cameras.clone())
}

#[cfg(test)]
mod tests {
    use super::*;
    use splat4d::types::Pose;

    #[test]
    fn times_replace_those_of_the_path() {
        let camera = |i: u32| SceneCamera {
            time: 0.9,
            camera: splat4d::types::Camera {
                intrinsics: Intrinsics::centred(10.0 + f64::from(i), 8, 8),
                view_from_world: Pose::IDENTITY,
            },
        };
        let path = [camera(0), camera(1)];
        let found = |times: &[f64], path: &[SceneCamera]| -> Vec<(u32, f64)> {
            let shots = Shots {
                cameras: Cameras::Listed(path.to_vec()),
                times: Some(Times::List(times.to_vec())),
                size: None,
                focal: None,
            };
            let shots = (0..shots.len()).map(|i| shots.at(i));
            shots.map(|s| (s.camera.intrinsics.fx as u32 - 10, s.time)).collect()
        };
        assert_eq!(found(&[0.0, 1.0], &path), [(0, 0.0), (1, 1.0)]);
        assert_eq!(found(&[0.5], &path), [(0, 0.5), (1, 0.5)]);
        assert_eq!(found(&[0.0, 0.5, 1.0], &path[1..]), [(1, 0.0), (1, 0.5), (1, 1.0)]);
        let each = [(0, 0.0), (1, 0.0), (0, 0.5), (1, 0.5), (0, 1.0), (1, 1.0)];
        assert_eq!(found(&[0.0, 0.5, 1.0], &path), each);
        assert_eq!(found(&[0.5], &[]), []);
    }

    #[test]
    fn the_input_path_needs_cameras() {
        assert!(input(&Scene::default()).is_err());
    }

    #[test]
    fn a_bullet_stands_at_each_time() {
        let scene = Scene::default();
        let found = |times: Option<Times>| -> Vec<f64> {
            let cameras = Cameras::Path(CameraPath::new(&scene, PathShape::Bullet, 2));
            let shots = Shots { cameras, times, size: None, focal: None };
            (0..shots.len()).map(|i| shots.at(i).time).collect()
        };
        assert_eq!(found(None), [0.5, 0.5]);
        assert_eq!(found(Some(Times::List(vec![0.2]))), [0.2, 0.2]);
        assert_eq!(found(Some(Times::Evenly(2))), [0.0, 0.0, 1.0, 1.0]);
    }
}

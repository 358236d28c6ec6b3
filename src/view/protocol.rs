//! The messages between the page and the server.
//!
//! A client sends [`Request`]s as JSON text messages. For each image it receives one binary message:
//!
//! | bytes | what |
//! |---|---|
//! | 4 | length of the header, u32, little endian |
//! | … | the header: [`Header`] as JSON |
//! | 16 · `points` | control points: x, y, z in the world and 1 if present, else 0; f32, little endian |
//! | … | the image, a JPEG or PNG file |
//!
//! A rejected request is answered by a text message, [`Refusal`] as JSON. A request that is overtaken by a
//! newer one of the same client is not answered. While a training is in progress, text messages also report
//! its status unrequested: [`Told`] as JSON, a few times a second.

use glam::{DQuat, DVec3};
use serde::{Deserialize, Serialize};

use super::{MOST_PIXELS, MOST_SIDE};
use crate::scene::SceneCamera;
use crate::types::{Camera, Intrinsics, Pose, range};

/// The layer of the scene that an image shows.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Layer {
    /// Colour over the scene's background.
    Colour,
    /// Inverse depth: white at the near end of [`Header::range`], black at its far end and in empty pixels.
    Depth,
    /// Opacity: white where it is 1.
    Alpha,
    /// Share of the movers in the pixel: white where it is 1.
    Motion,
    /// Image motion with a static camera until one input frame later (at the end: since one frame before),
    /// in pixels: the direction as hue, the length as saturation, which is full at the far end of
    /// [`Header::range`]; static pixels are white, empty ones grey.
    Flow,
    /// Normals in the camera frame: right is red, down is green, away from the camera is blue, from -1 to
    /// 1; empty pixels are black.
    Normal,
}

/// Encoding of an image.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Format {
    /// JPEG: small.
    #[default]
    Jpeg,
    /// PNG: lossless, with 8 bits.
    Png,
}

/// A camera in JSON.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct View {
    /// Focal length along x, pixels.
    pub fx: f64,
    /// Focal length along y, pixels.
    pub fy: f64,
    /// Distance of the principal point from the left edge, pixels.
    pub cx: f64,
    /// Distance of the principal point from the upper edge, pixels.
    pub cy: f64,
    /// Width, pixels.
    pub width: u32,
    /// Height, pixels.
    pub height: u32,
    /// Rotation (w, x, y, z) and translation, with OpenCV's axes.
    pub view_from_world: [f64; 7],
}

impl From<Camera> for View {
    fn from(camera: Camera) -> View {
        let Intrinsics { fx, fy, cx, cy, width, height } = camera.intrinsics;
        let Pose { rotation: q, translation: t } = camera.view_from_world;
        let view_from_world = [q.w, q.x, q.y, q.z, t.x, t.y, t.z];
        View { fx, fy, cx, cy, width, height, view_from_world }
    }
}

impl From<View> for Camera {
    fn from(view: View) -> Camera {
        let View { fx, fy, cx, cy, width, height, view_from_world } = view;
        let [w, x, y, z, tx, ty, tz] = view_from_world;
        Camera {
            intrinsics: Intrinsics { fx, fy, cx, cy, width, height },
            view_from_world: Pose {
                rotation: DQuat::from_xyzw(x, y, z, w),
                translation: DVec3::new(tx, ty, tz),
            },
        }
    }
}

/// A client's request for an image.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Request {
    /// Identifier, repeated in the answer.
    pub id: u64,
    /// Time in [0, 1].
    pub time: f64,
    /// Layer to render.
    pub layer: Layer,
    /// Encoding of the image.
    #[serde(default)]
    pub format: Format,
    /// A JPEG's quality, 1 to 100.
    #[serde(default = "usual_quality")]
    pub quality: u8,
    /// Whether to send the control points' positions.
    #[serde(default)]
    pub points: bool,
    /// Camera to render from.
    pub camera: View,
}

fn usual_quality() -> u8 {
    90
}

impl Request {
    /// The camera and the time, if they are valid.
    ///
    /// # Errors
    /// A message: there are more pixels than [`MOST_SIDE`] or [`MOST_PIXELS`], or numbers outside of [range].
    pub fn checked(&self) -> Result<(Camera, f64), String> {
        let View { width, height, .. } = self.camera;
        let pixels = u64::from(width) * u64::from(height);
        if width > MOST_SIDE || height > MOST_SIDE || pixels > MOST_PIXELS {
            return Err(format!(
                "an image of {width}×{height} was asked for; at most {MOST_SIDE} pixels a side and \
                 {MOST_PIXELS} in all are made"
            ));
        }
        if !(1..=100).contains(&self.quality) {
            return Err(format!("quality {} is not in [1, 100]", self.quality));
        }
        range::time(self.time)?;
        let camera = Camera::from(self.camera);
        camera.check()?;
        let Pose { rotation, translation } = camera.view_from_world;
        Ok((Camera { view_from_world: Pose::new(rotation, translation), ..camera }, self.time))
    }
}

/// Header of an image message.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Header {
    /// The request's identifier.
    pub id: u64,
    /// Width of the image, pixels.
    pub width: u32,
    /// Height of the image, pixels.
    pub height: u32,
    /// The request's time.
    pub time: f64,
    /// The request's layer.
    pub layer: Layer,
    /// The request's encoding.
    pub format: Format,
    /// Rendering time, without encoding, milliseconds.
    pub milliseconds: f64,
    /// Number of Gaussians in the scene.
    pub gaussians: usize,
    /// For depth: the depths of white and of black, if any pixel is not empty. For flow: the lengths of
    /// white and of full saturation, pixels.
    pub range: Option<[f32; 2]>,
    /// Number of control points that follow.
    pub points: usize,
}

/// Reason why a request was rejected.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Refusal {
    /// The request's identifier, where it could be parsed.
    pub id: Option<u64>,
    /// Error message.
    pub error: String,
}

/// A text message that reports the status of a training.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Told {
    /// The status.
    pub status: Status,
}

/// Progress of the work that makes the scene.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Status {
    /// The current stage, in a word or two.
    pub stage: String,
    /// Units done.
    pub done: u64,
    /// Total number of units; 0 where unknown.
    pub of: u64,
    /// Name of the unit: `steps`, `%`.
    pub unit: String,
    /// Number of Gaussians, once there is a scene.
    pub gaussians: Option<usize>,
    /// Number of scenes handed over; with each, `scene.json` and the images change.
    pub scenes: u64,
    /// Measurements of the training, thinned.
    pub curves: Vec<Progressed>,
    /// How the work ended, if it has ended.
    pub end: Option<String>,
}

/// A point of a training's curves.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Progressed {
    /// Number of steps done, over all stages.
    pub step: u32,
    /// Number of Gaussians.
    pub gaussians: usize,
    /// Weighted mean absolute difference of one image.
    pub l1: f64,
    /// Weighted mean SSIM of the same image.
    pub ssim: f64,
    /// PSNR of the same image in dB, where known.
    pub psnr: Option<f64>,
}

/// Description of the scene that the page receives before the first image: `scene.json`.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Description {
    /// Name of the scene.
    pub name: String,
    /// The rendering device.
    pub device: String,
    /// Number of Gaussians.
    pub gaussians: usize,
    /// Whether the scene is dynamic.
    pub moves: bool,
    /// Number of control points.
    pub control_points: usize,
    /// Up direction in the world.
    pub up: [f32; 3],
    /// Initial camera of the viewer.
    pub start: View,
    /// Distance from it to the point that it looks at.
    pub distance: f64,
    /// The input cameras, in the order of time.
    pub cameras: Vec<TimedView>,
    /// Number of input images.
    pub pictures: usize,
    /// [`MOST_SIDE`].
    pub most_side: u32,
    /// [`MOST_PIXELS`], or [`MOST_LIVE_PIXELS`](super::MOST_LIVE_PIXELS) while a training is in progress.
    pub most_pixels: u64,
    /// Whether the scene is being trained; then it exists once [`Status::scenes`] is not 0.
    pub live: bool,
}

/// An input camera.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct TimedView {
    /// Time in [0, 1].
    pub time: f64,
    /// The camera.
    pub camera: View,
}

impl From<&SceneCamera> for TimedView {
    fn from(known: &SceneCamera) -> TimedView {
        TimedView { time: known.time, camera: known.camera.into() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn good() -> Request {
        let intrinsics = Intrinsics::centred(100.0, 64, 48);
        let camera = Camera { intrinsics, view_from_world: Pose::IDENTITY };
        Request {
            id: 3,
            time: 0.5,
            layer: Layer::Depth,
            format: Format::Jpeg,
            quality: 80,
            points: false,
            camera: camera.into(),
        }
    }

    #[test]
    fn a_request_comes_back_from_json_as_it_was() {
        let text = serde_json::to_string(&good()).unwrap();
        assert_eq!(serde_json::from_str::<Request>(&text).unwrap(), good());
        let (camera, time) = good().checked().unwrap();
        assert_eq!((View::from(camera), time), (good().camera, 0.5));
    }

    #[test]
    fn what_cannot_be_rendered_is_refused() {
        let with = |change: &dyn Fn(&mut Request)| {
            let mut request = good();
            change(&mut request);
            request.checked().unwrap_err()
        };
        let large = with(&|r| (r.camera.width, r.camera.height) = (100_000, 100_000));
        assert!(large.contains("100000×100000") && large.contains("4096"), "{large}");
        assert!(with(&|r| (r.camera.width, r.camera.height) = (4096, 4096)).contains("in all"));
        assert!(with(&|r| r.camera.width = 0).contains("width"));
        assert!(with(&|r| r.camera.fx = f64::NAN).contains("focal length"));
        assert!(with(&|r| r.camera.view_from_world = [0.0; 7]).contains("rotation"));
        assert!(with(&|r| r.camera.view_from_world[5] = 1e300).contains("translation"));
        assert!(with(&|r| r.time = 1.5).contains("time"));
        assert!(with(&|r| r.quality = 0).contains("quality"));
    }
}

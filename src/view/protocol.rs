//! What the page and the server say to each other.
//!
//! A client sends [`Request`]s as JSON in text messages. For each picture it gets one binary message:
//!
//! | bytes | what |
//! |---|---|
//! | 4 | length of the header, u32, little endian |
//! | … | the header: [`Header`] as JSON |
//! | 16 · `points` | control points: x, y, z in the world and 1 where it is there, else 0; f32, little endian |
//! | … | the picture, a JPEG or PNG file |
//!
//! A request that is refused is answered by a text message, [`Refusal`] as JSON. A request that a newer one
//! of the same client overtakes is not answered. Of a training under way text messages tell, too, how far it
//! is, unasked: [`Told`] as JSON, the newest a few times a second.

use glam::{DQuat, DVec3};
use serde::{Deserialize, Serialize};

use super::{MOST_PIXELS, MOST_SIDE};
use crate::scene::SceneCamera;
use crate::types::{Camera, Intrinsics, Pose, range};

/// What of the scene a picture shows.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Layer {
    /// Colour over the scene's background.
    Colour,
    /// Inverse depth: white at the near end of [`Header::range`], black at its far end and where nothing is.
    Depth,
    /// Opacity: white where it is 1.
    Alpha,
    /// The share that comes from what moves: white where it is 1.
    Motion,
    /// Motion within a fixed picture until one input frame later (at the end: since one before), in pixels: the
    /// direction as hue, the length as saturation, which is full at the far end of [`Header::range`]; white
    /// where nothing moves, grey where nothing is.
    Flow,
    /// Normals in the camera's axes: right is red, down is green, away is blue, from -1 to 1; black where
    /// nothing is.
    Normal,
}

/// How a picture is packed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Format {
    /// Small.
    #[default]
    Jpeg,
    /// Exact, in 8 bits.
    Png,
}

/// A camera as JSON has it.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct View {
    /// Focal length along x, pixels.
    pub fx: f64,
    /// Focal length along y, pixels.
    pub fy: f64,
    /// Principal point from the left edge, pixels.
    pub cx: f64,
    /// Principal point from the upper edge, pixels.
    pub cy: f64,
    /// Width, pixels.
    pub width: u32,
    /// Height, pixels.
    pub height: u32,
    /// Rotation (w, x, y, z) and translation, OpenCV's axes.
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

/// A picture that a client asks for.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Request {
    /// Comes back with the answer.
    pub id: u64,
    /// In [0, 1].
    pub time: f64,
    /// What to show.
    pub layer: Layer,
    /// How to pack it.
    #[serde(default)]
    pub format: Format,
    /// A JPEG's quality, 1 to 100.
    #[serde(default = "usual_quality")]
    pub quality: u8,
    /// Whether to tell where the control points are.
    #[serde(default)]
    pub points: bool,
    /// From where.
    pub camera: View,
}

fn usual_quality() -> u8 {
    90
}

impl Request {
    /// The camera and the time, where they may be asked for.
    ///
    /// # Errors
    /// What is wrong, in words: more pixels than [`MOST_SIDE`] or [`MOST_PIXELS`], or numbers out of [range].
    pub fn checked(&self) -> Result<(Camera, f64), String> {
        let View { width, height, .. } = self.camera;
        let pixels = u64::from(width) * u64::from(height);
        if width > MOST_SIDE || height > MOST_SIDE || pixels > MOST_PIXELS {
            return Err(format!(
                "a picture of {width}×{height} was asked for; at most {MOST_SIDE} pixels a side and \
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

/// What stands before a picture.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Header {
    /// The request's.
    pub id: u64,
    /// Of the picture.
    pub width: u32,
    /// Of the picture.
    pub height: u32,
    /// The request's.
    pub time: f64,
    /// The request's.
    pub layer: Layer,
    /// The request's.
    pub format: Format,
    /// What rendering took; packing not counted.
    pub milliseconds: f64,
    /// How many Gaussians the scene has.
    pub gaussians: usize,
    /// Depths of white and of black, where depth is shown and something is there; of flow, the lengths of
    /// white and of full colour, pixels.
    pub range: Option<[f32; 2]>,
    /// How many control points follow.
    pub points: usize,
}

/// Why there is no picture.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Refusal {
    /// The request's, where it could be read.
    pub id: Option<u64>,
    /// In words.
    pub error: String,
}

/// A text message that tells how far a training is.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Told {
    /// How far it is.
    pub status: Status,
}

/// How far the work is that makes the scene.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Status {
    /// What is being done, in a word or two.
    pub stage: String,
    /// So much of it is done.
    pub done: u64,
    /// Of so much; 0 where that is not known.
    pub of: u64,
    /// Of what: `steps`, `%`.
    pub unit: String,
    /// How many Gaussians the scene has, once there is one.
    pub gaussians: Option<usize>,
    /// So many scenes have been handed over: with each, `scene.json` and the pictures are new.
    pub scenes: u64,
    /// What was measured on the way, thinned.
    pub curves: Vec<Progressed>,
    /// How the work ended, where it has.
    pub end: Option<String>,
}

/// A point of the curves of a training.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Progressed {
    /// Steps done, of all stages.
    pub step: u32,
    /// Number of Gaussians.
    pub gaussians: usize,
    /// Weighted mean of the absolute differences of one picture.
    pub l1: f64,
    /// Its weighted mean of SSIM.
    pub ssim: f64,
    /// Its PSNR, dB, where it is known.
    pub psnr: Option<f64>,
}

/// What the page is told of the scene before the first picture: `scene.json`.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Description {
    /// What to call it.
    pub name: String,
    /// The device that renders.
    pub device: String,
    /// How many there are.
    pub gaussians: usize,
    /// Whether something moves.
    pub moves: bool,
    /// How many there are.
    pub control_points: usize,
    /// The world's direction that is up.
    pub up: [f32; 3],
    /// Where the viewer begins.
    pub start: View,
    /// From there to what it looks at.
    pub distance: f64,
    /// The input's, in order of time.
    pub cameras: Vec<TimedView>,
    /// How many pictures of the input there are.
    pub pictures: usize,
    /// [`MOST_SIDE`].
    pub most_side: u32,
    /// [`MOST_PIXELS`], or of a training under way [`MOST_LIVE_PIXELS`](super::MOST_LIVE_PIXELS).
    pub most_pixels: u64,
    /// Whether the scene is being trained; then it is there once [`Status::scenes`] is not 0.
    pub live: bool,
}

/// An input camera.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct TimedView {
    /// In [0, 1].
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

//! Renders a scene on the device from any camera at any time.
//!
//! [`Renderer::render`] renders a frame, waits for it and returns the image. A host with its own
//! frame loop calls [`Renderer::record`] to render into its own command buffer and buffers:
//!
//! ```no_run
//! use splat4d::embed::ash::vk;
//! use splat4d::gpu::{Buffer, Device, Recorder};
//! use splat4d::renderer::{Renderer, Target};
//! use splat4d::types::Camera;
//!
//! /// Draws one frame; `commands` is in the recording state.
//! ///
//! /// # Safety
//! /// As for [`Recorder::over`].
//! unsafe fn draw(
//!     device: &Device,
//!     commands: vk::CommandBuffer,
//!     renderer: &mut Renderer,
//!     camera: &Camera,
//!     picture: &mut Buffer<[f32; 4]>,
//! ) -> splat4d::Result<()> {
//!     let mut recorder = unsafe { Recorder::over(device, commands) }?;
//!     let target = Target { rgba: Some(picture.view_mut()), ..Target::default() };
//!     let frame = renderer.record(&mut recorder, camera, 0.5, target)?;
//!     let guard = recorder.finish()?;
//!     // … the host records more, submits, and continues with other frames. When the device is
//!     // done:
//!     drop(guard);
//!     if !renderer.retire(frame)?.is_whole() {
//!         // The farthest splats of that frame were left out; the next `record` allocates more.
//!     }
//!     Ok(())
//! }
//! ```

mod edit;
mod layers;
mod query;
mod rendered;
mod scale;

pub use query::Hit;
pub use rendered::Rendered;
pub use scale::RenderScale;

use crate::gpu::{Buffer, Device, Readback, Recorder, Rehearsal, Stream, ViewMut};
use crate::ops::gaussians::{GaussianBuffers, GaussianViews};
use crate::ops::half::{HalfHarmonics, HalfShapes};
use crate::ops::motion::Motion;
use crate::ops::render::{self, FrameCounts, PixelBuffers, PixelViews, Render};
use crate::scene::Scene;
use crate::types::{Camera, DeformNet, Gaussians, Image, RenderSettings, Tuning, range};
use crate::{Error, Result};
use std::sync::Arc;

/// A renderer of one scene. Successive images of the same size cost no allocation.
pub struct Renderer {
    device: Device,
    stream: Stream,
    gaussians: GaussianBuffers,
    motion: Option<Motion>,
    /// Motion logits, one per Gaussian; empty in a static scene.
    motion_logits: Vec<f32>,
    settings: RenderSettings,
    tuning: Tuning,
    half: Half,
    resources: Option<FrameResources>,
    /// Minimum capacity, in (splat, tile) pairs, of the next frame resources.
    capacity: usize,
    /// Readback buffers for frame counts that no frame uses at present.
    idle: Vec<Readback<u32>>,
    /// Identifies the frames of this renderer.
    identity: Arc<()>,
}

/// 16-bit copies of the attributes, if the tuning asks for them.
struct Half {
    harmonics: Option<HalfHarmonics>,
    shapes: Option<HalfShapes>,
}

impl Half {
    /// Allocates capacity for `count` Gaussians.
    fn capacity(device: &Device, count: usize, sh_degree: u32, tuning: &Tuning) -> Result<Half> {
        let harmonics = || HalfHarmonics::new(device, count, sh_degree);
        let shapes = || HalfShapes::new(device, count);
        Ok(Half {
            harmonics: tuning.half_sh.then(harmonics).transpose()?,
            shapes: tuning.half_shapes.then(shapes).transpose()?,
        })
    }

    fn new(device: &Device, gaussians: &Gaussians, tuning: &Tuning) -> Result<Half> {
        let harmonics = || HalfHarmonics::from_host(device, gaussians);
        let shapes = || HalfShapes::from_host(device, gaussians);
        Ok(Half {
            harmonics: tuning.half_sh.then(harmonics).transpose()?,
            shapes: tuning.half_shapes.then(shapes).transpose()?,
        })
    }

    fn is_used(&self) -> bool {
        self.harmonics.is_some() || self.shapes.is_some()
    }
}

/// The buffers and plans for images of one size.
struct FrameResources {
    frame: render::Frame,
    /// Per-Gaussian colours that mark the dynamic Gaussians, and the image blended from them.
    moving: Option<(Buffer<[f32; 4]>, PixelBuffers)>,
    /// Per-Gaussian values in place of colours, and the image blended from them.
    painted: Option<(Buffer<[f32; 4]>, PixelBuffers)>,
}

/// The output buffers of a frame: views of buffers of the device, the host's included, one element
/// per pixel, row-major. An output that is `None` goes to the renderer's own
/// [`pixels`](Renderer::pixels).
#[derive(Default)]
pub struct Target<'a> {
    /// Premultiplied RGB without background, and alpha.
    pub rgba: Option<ViewMut<'a, [f32; 4]>>,
    /// Σ α · T · z; the mean depth is this divided by alpha.
    pub depth: Option<ViewMut<'a, f32>>,
    /// The motion mask. Red is the part of alpha that comes from dynamic Gaussians; green and blue
    /// are 0; alpha equals that of `rgba`. It costs a second blending pass.
    pub mask: Option<ViewMut<'a, [f32; 4]>>,
}

/// A recorded frame. [Retire](Renderer::retire) it when the device is done with it.
#[must_use = "`retire` tells whether all of it was drawn"]
pub struct Frame {
    counts: Readback<u32>,
    capacity: usize,
    of: Arc<()>,
}

/// The result of a frame that the device has rendered.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Drawn {
    /// Numbers of visible splats and of intersections.
    pub counts: FrameCounts,
    /// Capacity for (splat, tile) pairs when the frame was recorded.
    pub capacity: usize,
}

impl Drawn {
    /// Whether every splat was rendered; if not, the farthest ones were left out.
    pub fn is_whole(&self) -> bool {
        self.counts.intersections <= self.capacity
    }
}

impl Renderer {
    /// Uploads a scene to a device.
    ///
    /// # Errors
    /// [`Error::OutOfMemory`]; [`Error::Shape`] for a scene whose arrays differ in length;
    /// [`Error::Input`] for settings, control points or a network out of [range]. Gaussians that
    /// are not finite are not rendered.
    pub fn new(device: &Device, scene: &Scene) -> Result<Renderer> {
        Renderer::tuned(device, scene, &Tuning::default())
    }

    /// Uploads a scene to a device, to be rendered with the given trade-offs of accuracy for speed.
    ///
    /// # Errors
    /// As for [`new`](Self::new); [`Error::Input`] for settings out of range.
    pub fn tuned(device: &Device, scene: &Scene, tuning: &Tuning) -> Result<Renderer> {
        let mut renderer = Renderer::with_capacity(device, scene, tuning, scene.gaussians.len())?;
        renderer.half = Half::new(device, &scene.gaussians, tuning)?;
        Ok(renderer)
    }

    /// A renderer with capacity for `capacity` Gaussians, of which the scene may hold fewer. 16-bit
    /// copies are not made yet.
    fn with_capacity(
        device: &Device,
        scene: &Scene,
        tuning: &Tuning,
        capacity: usize,
    ) -> Result<Renderer> {
        tuning.check()?;
        let network = scene.network.as_ref();
        (scene.settings.check())
            .and_then(|()| scene.control_points.check())
            .and_then(|()| network.map_or(Ok(()), DeformNet::check))
            .map_err(|what| Error::Input(format!("the scene cannot be rendered: {what}")))?;
        let mut stream = device.stream()?;
        let mut gaussians = GaussianBuffers::new(device, capacity, scene.gaussians.sh_degree)?;
        gaussians.upload(&mut stream, &scene.gaussians)?;
        let motion = match scene.moves() {
            true => {
                let points = &scene.control_points;
                let most = tuning.neighbours.unwrap_or(scene.neighbours).min(scene.neighbours);
                let k = (most as usize).min(points.len());
                let mut motion = Motion::new(&mut stream, points, network, k, capacity, 1)?;
                motion.set_dynamic(&mut stream, &scene.gaussians.motion_logits, 0.0)?;
                let mut recorder = stream.record()?;
                motion.refresh(&mut recorder, gaussians.views().positions)?;
                stream.submit(recorder)?;
                Some(motion)
            }
            false => None,
        };
        let half = Half { harmonics: None, shapes: None };
        let mut motion_logits = Vec::new();
        if motion.is_some() {
            motion_logits.clone_from(&scene.gaussians.motion_logits);
            motion_logits.resize(scene.gaussians.len(), f32::NEG_INFINITY);
        }
        Ok(Renderer {
            device: device.clone(),
            stream,
            gaussians,
            motion,
            motion_logits,
            settings: tuning.apply(scene.settings),
            tuning: *tuning,
            half,
            resources: None,
            capacity: 0,
            idle: Vec::new(),
            identity: Arc::new(()),
        })
    }

    /// The device.
    pub fn device(&self) -> &Device {
        &self.device
    }

    /// Number of Gaussians.
    pub fn len(&self) -> usize {
        self.gaussians.len
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.gaussians.len == 0
    }

    /// The pixel buffers of the last frame; outputs that went into a [`Target`] are not in them.
    /// `None` before the first frame. Do not keep references to their content: the next frame
    /// overwrites it.
    pub fn pixels(&self) -> Option<&PixelBuffers> {
        self.resources.as_ref().map(|resources| &resources.frame.pixels)
    }

    /// Renders the scene as `camera` sees it at `time` in [0, 1], and waits for it.
    ///
    /// # Errors
    /// [`Error::Input`] for a camera or a time out of [range];
    /// [`Error::OutOfMemory`], [`Error::RangeLimit`] for more intersections than a binding holds, or a
    /// failed submission.
    pub fn render(&mut self, camera: &Camera, time: f64) -> Result<Rendered> {
        let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
        self.draw(camera, time)?;
        let pixels = &self.resources.as_ref().expect("just drawn").frame.pixels;
        let rgba = self.stream.download(&pixels.rgba)?.into_flattened();
        let depth = self.stream.download(&pixels.depth)?;
        Ok(Rendered {
            rgba: Image { width, height, channels: 4, pixels: rgba },
            depth: Image { width, height, channels: 1, pixels: depth },
        })
    }

    /// Renders into the renderer's own pixels and waits, with enough capacity for all (splat, tile)
    /// pairs. The pairs of the first image of a size are counted before its frame resources are
    /// allocated.
    fn draw(&mut self, camera: &Camera, time: f64) -> Result<()> {
        if !self.has_resources(camera) {
            let pairs = self.count(camera, time)?;
            self.reserve(usize::try_from(pairs).unwrap_or(usize::MAX));
        }
        loop {
            let mut recorder = self.stream.record()?;
            let frame = self.record(&mut recorder, camera, time, Target::default())?;
            let ticket = self.stream.submit(recorder)?;
            self.stream.wait(ticket)?;
            if self.retire(frame)?.is_whole() {
                return Ok(());
            }
        }
    }

    /// Records the rendering of the scene as `camera` sees it at `time` in [0, 1]. Successive
    /// frames of the same size allocate nothing, if each is [retired](Self::retire).
    ///
    /// The dispatches, in order: in a moving scene those of
    /// [`Motion::forward`](crate::ops::motion::Motion::forward); those of
    /// [`Frame::forward`](crate::ops::render::Frame::forward); with a mask one more blending
    /// dispatch.
    ///
    /// # Errors
    /// [`Error::OutOfMemory`]; [`Error::RangeLimit`] for more intersections than a binding holds;
    /// [`Error::Shape`] if a view of the target is too short; [`Error::Input`] for a recorder of
    /// another device, or a camera or a time out of [range].
    pub fn record(
        &mut self,
        recorder: &mut Recorder,
        camera: &Camera,
        time: f64,
        target: Target<'_>,
    ) -> Result<Frame> {
        camera.check().and_then(|()| range::moment(time)).map_err(Error::Input)?;
        let is_large_enough = |resources: &FrameResources| {
            resources.frame.plan().intersection_capacity() >= self.capacity
        };
        if !self.has_resources(camera) || !self.resources.as_ref().is_some_and(is_large_enough) {
            self.make_resources(camera)?;
        }
        if target.mask.is_some() {
            self.plan_mask()?;
        }
        let counts = match self.idle.pop() {
            Some(readback) => readback,
            None => self.device.readback(2)?,
        };
        let Renderer { gaussians, motion, half, tuning, resources, identity, .. } = self;
        let FrameResources { frame, moving, .. } = resources.as_mut().expect("planned above");
        let views = moved(gaussians, half, motion.as_mut(), tuning, recorder, time)?;
        let out = PixelViews { rgba: target.rgba, depth: target.depth, last: None };
        frame.forward(recorder, camera, views, out)?;
        if let (Some(mask), Some((colours, painted))) = (target.mask, moving) {
            let out = PixelViews { rgba: Some(mask), ..painted.views_mut() };
            frame.blend(recorder, Some(colours.view()), out)?;
        }
        recorder.read_back(frame.device_counts(), &counts);
        let capacity = frame.plan().intersection_capacity();
        Ok(Frame { counts, capacity, of: identity.clone() })
    }

    /// Retires a frame that the device is known to be done with: after [`Stream::wait`] for its
    /// submission, or after the guard of the host's recording is dropped. If the (splat, tile)
    /// pairs of the frame exceeded the capacity, the next [`record`](Self::record) allocates more.
    ///
    /// # Errors
    /// [`Error::Input`] for a frame of another renderer, and if the frame is not done yet;
    /// [`Error::Failed`] for a frame that was never submitted, if its counts reveal that.
    pub fn retire(&mut self, frame: Frame) -> Result<Drawn> {
        let Frame { mut counts, capacity, of } = frame;
        if !Arc::ptr_eq(&self.identity, &of) {
            return Err(Error::Input("the frame is of another renderer".into()));
        }
        let mut words = [0; 2];
        counts.read_into(&mut words)?;
        let drawn = Drawn { counts: FrameCounts::from_device(words), capacity };
        self.idle.push(counts);
        if drawn.counts.visible > self.gaussians.capacity() {
            let what = "a frame was retired that the device has not drawn: its recording was not submitted";
            return Err(Error::Failed(what.into()));
        }
        if !drawn.is_whole() {
            let needed = drawn.counts.intersections;
            self.capacity = self.capacity.max(needed + needed / 4);
        }
        Ok(drawn)
    }

    /// Requests capacity for `intersections` (splat, tile) pairs from the next frame on, so that no
    /// frame with at most that many pairs has to be rendered again.
    pub fn reserve(&mut self, intersections: usize) {
        self.capacity = self.capacity.max(intersections);
    }

    /// The number of (splat, tile) pairs in the image of `camera` at `time`. Projects the Gaussians
    /// but does not blend, and needs no memory for the pairs.
    ///
    /// # Errors
    /// As for [`render`](Self::render).
    pub fn count(&mut self, camera: &Camera, time: f64) -> Result<u64> {
        camera.check().and_then(|()| range::moment(time)).map_err(Error::Input)?;
        if !self.has_resources(camera) {
            self.make_resources(camera)?;
        }
        let mut recorder = self.stream.record()?;
        let Renderer { stream, gaussians, motion, half, tuning, resources, .. } = self;
        let frame = &mut resources.as_mut().expect("made above").frame;
        let views = moved(gaussians, half, motion.as_mut(), tuning, &mut recorder, time)?;
        let len = views.len;
        frame.project(&mut recorder, camera, views)?;
        stream.submit(recorder)?;
        let counts = stream.download(&frame.scratch.tile_counts)?;
        Ok(counts[..len].iter().map(|&count| u64::from(count)).sum())
    }

    /// The Gaussians at `time` in [0, 1], with the motion applied to position, rotation and
    /// opacity. The result is static: it has no motion logits.
    ///
    /// # Errors
    /// [`Error::Input`] for a time out of [range]; a failed submission.
    pub fn posed(&mut self, time: f64) -> Result<Gaussians> {
        range::moment(time).map_err(Error::Input)?;
        let mut posed = self.gaussians.download(&mut self.stream)?;
        if let Some(motion) = &mut self.motion {
            let mut recorder = self.stream.record()?;
            motion.forward(&mut recorder, &self.gaussians.views(), &[time as f32], None)?;
            self.stream.submit(recorder)?;
            motion.download_moved(&mut self.stream, &mut posed)?;
        }
        Ok(posed)
    }

    /// The motions of the control points at `time` in [0, 1], in the layout of
    /// [`ControlPoints::paths`](crate::types::ControlPoints::paths); empty in a static scene.
    ///
    /// # Errors
    /// As for [`posed`](Self::posed).
    pub fn motions(&mut self, time: f64) -> Result<Vec<[f32; 8]>> {
        range::moment(time).map_err(Error::Input)?;
        let Some(motion) = &mut self.motion else { return Ok(Vec::new()) };
        let mut recorder = self.stream.record()?;
        motion.forward(&mut recorder, &self.gaussians.views(), &[time as f32], None)?;
        self.stream.submit(recorder)?;
        let halves = self.stream.download(&motion.transforms)?;
        let rows = halves.as_flattened().as_chunks::<8>().0.iter();
        Ok(rows
            .map(|row| std::array::from_fn(|c| if c == 4 { row[c] - 1.0 } else { row[c] }))
            .collect())
    }

    /// Whether frame resources of sufficient capacity exist for the camera's image size.
    fn has_resources(&self, camera: &Camera) -> bool {
        let k = camera.intrinsics;
        self.pixels().is_some_and(|pixels| (pixels.width, pixels.height) == (k.width, k.height))
    }

    /// Allocates the frame resources for a camera's image size. Free memory is checked first if the
    /// capacity is larger than usual, since systems can promise more memory than they have.
    fn make_resources(&mut self, camera: &Camera) -> Result<()> {
        let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
        self.resources = None;
        if self.capacity > 0 && !self.device.is_rehearsing() {
            let foreseen = Rehearsal::of(&self.device, |rehearsal| {
                self.plan(rehearsal.device(), width, height).map(drop)
            });
            foreseen?.fits(&self.device)?;
        }
        self.resources = Some(self.plan(&self.device, width, height)?);
        Ok(())
    }

    fn plan(&self, device: &Device, width: u32, height: u32) -> Result<FrameResources> {
        let gaussians = self.gaussians.capacity();
        let capacity = usual_capacity(self.gaussians.len).max(self.capacity);
        let render = Render::plan(device, gaussians, capacity, width, height, self.settings)?
            .with_depth_bits(device, self.tuning.depth_bits)?
            .with_raster(self.tuning.raster);
        Ok(FrameResources { frame: render.frame(device)?, moving: None, painted: None })
    }

    /// Allocates the buffers for a mask, if they do not exist.
    fn plan_mask(&mut self) -> Result<()> {
        let resources = self.resources.as_mut().expect("planned before");
        if resources.moving.is_some() {
            return Ok(());
        }
        let red = |logit: &f32| [if *logit > 0.0 { 1.0 } else { 0.0 }, 0.0, 0.0, 0.0];
        let mut colours: Vec<[f32; 4]> = self.motion_logits.iter().map(red).collect();
        colours.resize(self.gaussians.capacity(), [0.0; 4]);
        let colours = self.device.upload("what moves", &colours)?;
        resources.moving = Some((colours, resources.frame.plan().pixels(&self.device)?));
        Ok(())
    }
}

/// The initial capacity for (splat, tile) pairs.
fn usual_capacity(gaussians: usize) -> usize {
    gaussians.saturating_mul(4).max(1 << 14)
}

/// Records the motion of the Gaussians to `time`, and returns views of the result.
fn moved<'a>(
    gaussians: &'a GaussianBuffers,
    half: &'a Half,
    motion: Option<&'a mut Motion>,
    tuning: &Tuning,
    recorder: &mut Recorder,
    time: f64,
) -> Result<GaussianViews<'a>> {
    let canonical = gaussians.views();
    let mut views = canonical;
    if let Some(half) = &half.shapes {
        views = half.replace(views);
    }
    if let Some(half) = &half.harmonics {
        views = half.replace(views);
    }
    if let Some(motion) = motion {
        motion.forward(recorder, &canonical, &[time as f32], None)?;
        views = motion.moved(views);
    }
    Ok(views.at_degree(tuning.sh_degree))
}

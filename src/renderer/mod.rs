//! A scene on the device, rendered from any camera at any time.
//!
//! [`Renderer::render`] does all of it and gives the picture. A host that draws records instead, into
//! its own command buffer and its own buffers:
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
//!     // … the host records on, submits, goes on with other frames; when the device is done:
//!     drop(guard);
//!     if !renderer.retire(frame)?.is_whole() {
//!         // The farthest splats of that frame had no room; the next record makes it.
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
use crate::ops::render::{FrameCounts, PixelBuffers, PixelViews, Render, RenderScratch};
use crate::scene::Scene;
use crate::types::{Camera, DeformNet, Gaussians, Image, RenderSettings, Tuning, range};
use crate::{Error, Result};
use std::sync::Arc;

/// Renders one scene. Images of one size after the other cost no allocation.
pub struct Renderer {
    device: Device,
    stream: Stream,
    gaussians: GaussianBuffers,
    motion: Option<Motion>,
    /// One for each Gaussian where the scene moves, else empty.
    motion_logits: Vec<f32>,
    settings: RenderSettings,
    tuning: Tuning,
    half: Half,
    resources: Option<FrameResources>,
    /// Intersections that the next studio has room for at least.
    capacity: usize,
    /// Counts that no frame waits for.
    idle: Vec<Readback<u32>>,
    /// Tells its frames from those of others.
    identity: Arc<()>,
}

/// Attributes in 16 bits, where the tuning asks for them.
struct Half {
    harmonics: Option<HalfHarmonics>,
    shapes: Option<HalfShapes>,
}

impl Half {
    /// Room for so many Gaussians.
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

/// What pictures of one size need.
struct FrameResources {
    render: Render,
    scratch: RenderScratch,
    pixels: PixelBuffers,
    /// Colours that tell what moves, and the picture of them.
    moving: Option<(Buffer<[f32; 4]>, PixelBuffers)>,
    /// Values of the Gaussians in place of their colours, and the picture of them.
    painted: Option<(Buffer<[f32; 4]>, PixelBuffers)>,
}

/// Where a frame goes: parts of buffers of the device, a host's too. What is `None` stays in the
/// renderer's own [`pixels`](Renderer::pixels).
#[derive(Default)]
pub struct Target<'a> {
    /// Premultiplied colour without background, and alpha.
    pub rgba: Option<ViewMut<'a, [f32; 4]>>,
    /// Σ α · T · z: divide by alpha for the mean depth.
    pub depth: Option<ViewMut<'a, f32>>,
    /// In red, how much of alpha comes from what moves; green and blue are 0; alpha as in `rgba`.
    /// Costs another pass of blending.
    pub mask: Option<ViewMut<'a, [f32; 4]>>,
}

/// A recorded frame, to be [retired](Renderer::retire) when the device is done with it.
#[must_use = "`retire` tells whether all of it was drawn"]
pub struct Frame {
    counts: Readback<u32>,
    capacity: usize,
    of: Arc<()>,
}

/// What became of a frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Drawn {
    /// What it held.
    pub counts: FrameCounts,
    /// (splat, tile) pairs that there was room for.
    pub capacity: usize,
}

impl Drawn {
    /// Whether every splat was drawn; else the farthest were left out.
    pub fn is_whole(&self) -> bool {
        self.counts.intersections <= self.capacity
    }
}

impl Renderer {
    /// Puts a scene on a device.
    ///
    /// # Errors
    /// [`Error::OutOfMemory`], a scene whose arrays do not fit together, or [`Error::Input`] for
    /// settings, control points or a network out of [range]. Gaussians that are
    /// not finite are not drawn.
    pub fn new(device: &Device, scene: &Scene) -> Result<Renderer> {
        Renderer::tuned(device, scene, &Tuning::default())
    }

    /// Puts a scene on a device, to be rendered with some accuracy given up for speed.
    ///
    /// # Errors
    /// As for [`new`](Self::new); [`Error::Input`] for settings out of range.
    pub fn tuned(device: &Device, scene: &Scene, tuning: &Tuning) -> Result<Renderer> {
        let mut renderer = Renderer::with_capacity(device, scene, tuning, scene.gaussians.len())?;
        renderer.half = Half::new(device, &scene.gaussians, tuning)?;
        Ok(renderer)
    }

    /// With room for so many Gaussians, not all of which need be there, and none of them in 16 bits
    /// yet.
    fn with_capacity(device: &Device, scene: &Scene, tuning: &Tuning, capacity: usize) -> Result<Renderer> {
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

    /// The picture of the last frame as far as it did not go into a [`Target`]; none before the
    /// first. Keep clones of nothing: the next frame writes it anew.
    pub fn pixels(&self) -> Option<&PixelBuffers> {
        self.resources.as_ref().map(|resources| &resources.pixels)
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
        let resources = self.resources.as_ref().expect("just drawn");
        let rgba = self.stream.download(&resources.pixels.rgba)?.into_flattened();
        let depth = self.stream.download(&resources.pixels.depth)?;
        Ok(Rendered {
            rgba: Image { width, height, channels: 4, pixels: rgba },
            depth: Image { width, height, channels: 1, pixels: depth },
        })
    }

    /// Renders into the renderer's own pixels and waits, with as much room as it takes. The pairs of
    /// the first picture of a size are counted before any room is made.
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

    /// Records the scene as `camera` sees it at `time` in [0, 1]. Frames of one size after the other
    /// allocate nothing, as long as each is [retired](Self::retire).
    ///
    /// The dispatches, in order: where the scene moves those of
    /// [`Motion::forward`](crate::ops::motion::Motion::forward); those of
    /// [`Render::forward`](crate::ops::render::Render::forward); for a mask one of blending more.
    ///
    /// # Errors
    /// [`Error::OutOfMemory`]; [`Error::RangeLimit`] for more intersections than a binding holds;
    /// [`Error::Shape`] where a part of the target is too short; [`Error::Input`] for a recorder of
    /// another device, or a camera or a time out of [range].
    pub fn record(
        &mut self,
        recorder: &mut Recorder,
        camera: &Camera,
        time: f64,
        target: Target<'_>,
    ) -> Result<Frame> {
        camera.check().and_then(|()| range::moment(time)).map_err(Error::Input)?;
        let is_large_enough = |resources: &FrameResources| resources.render.intersection_capacity() >= self.capacity;
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
        let FrameResources { render, scratch, pixels, moving, .. } =
            resources.as_mut().expect("planned above");
        let views = moved(gaussians, half, motion.as_mut(), tuning, recorder, time)?;
        let mut own = pixels.views_mut();
        if let Some(rgba) = target.rgba {
            own.rgba = rgba;
        }
        if let Some(depth) = target.depth {
            own.depth = depth;
        }
        render.forward_into(recorder, camera, views, scratch, own)?;
        if let (Some(mask), Some((colours, painted))) = (target.mask, moving) {
            let pixels = PixelViews { rgba: mask, ..painted.views_mut() };
            render.blend_into(recorder, colours.view(), scratch, pixels)?;
        }
        recorder.read_back(scratch.device_counts(), &counts);
        Ok(Frame { counts, capacity: render.intersection_capacity(), of: identity.clone() })
    }

    /// Takes back a frame with which the device is known to be done: after
    /// [`Stream::wait`] for its submission, or when the guard of the host's recording is dropped. Makes
    /// more room where it did not fit: the next [`record`](Self::record) allocates then.
    ///
    /// # Errors
    /// [`Error::Input`] for a frame of another renderer, and earlier than that; [`Error::Failed`] for one
    /// that was never submitted, where its counts tell.
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

    /// Makes room for so many (splat, tile) pairs at the next picture, so that none of at most as many
    /// has to be drawn again.
    pub fn reserve(&mut self, intersections: usize) {
        self.capacity = self.capacity.max(intersections);
    }

    /// How many (splat, tile) pairs the picture of `camera` at `time` has. Takes the projection of the
    /// Gaussians, not the picture, and no room for the pairs.
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
        let FrameResources { render, scratch, .. } = resources.as_mut().expect("made above");
        let views = moved(gaussians, half, motion.as_mut(), tuning, &mut recorder, time)?;
        let len = views.len;
        render.project(&mut recorder, camera, views, scratch)?;
        stream.submit(recorder)?;
        let counts = stream.download(&scratch.tile_counts)?;
        Ok(counts[..len].iter().map(|&count| u64::from(count)).sum())
    }

    /// The Gaussians as they are at `time` in [0, 1]: those that move in their places, turned, and as
    /// opaque as they are then. Nothing of motion is left in them.
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

    /// The motions of the control points at `time` in [0, 1], as
    /// [`ControlPoints::paths`](crate::types::ControlPoints::paths) holds them; none
    /// where nothing moves.
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

    /// Whether there is a studio for pictures of a camera's size.
    fn has_resources(&self, camera: &Camera) -> bool {
        let k = camera.intrinsics;
        self.pixels().is_some_and(|pixels| (pixels.width, pixels.height) == (k.width, k.height))
    }

    /// Makes what pictures of a camera's size need. Room for more pairs than usual is asked for only where there
    /// is memory for it: systems promise more than they have.
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
        Ok(FrameResources {
            scratch: render.scratch(device)?,
            pixels: render.pixels(device)?,
            moving: None,
            painted: None,
            render,
        })
    }

    /// Makes what a mask needs, where it is not there.
    fn plan_mask(&mut self) -> Result<()> {
        let resources = self.resources.as_mut().expect("planned before");
        if resources.moving.is_some() {
            return Ok(());
        }
        let red = |logit: &f32| [if *logit > 0.0 { 1.0 } else { 0.0 }, 0.0, 0.0, 0.0];
        let mut colours: Vec<[f32; 4]> = self.motion_logits.iter().map(red).collect();
        colours.resize(self.gaussians.capacity(), [0.0; 4]);
        let colours = self.device.upload("what moves", &colours)?;
        resources.moving = Some((colours, resources.render.pixels(&self.device)?));
        Ok(())
    }
}

/// (splat, tile) pairs that there is room for at first.
fn usual_capacity(gaussians: usize) -> usize {
    gaussians.saturating_mul(4).max(1 << 14)
}

/// Records where the Gaussians are at a time, and gives them.
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

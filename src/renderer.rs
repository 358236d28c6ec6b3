//! A scene on the device, rendered from any camera at any time.

use crate::Result;
use crate::gpu::{Device, Stream};
use crate::ops::gaussians::GaussianBuffers;
use crate::ops::half::{HalfHarmonics, HalfShapes};
use crate::ops::motion::Motion;
use crate::ops::render::{PixelBuffers, Render, RenderScratch};
use crate::scene::Scene;
use crate::types::{Camera, Image, RenderSettings, Tuning};

/// An image as the device blended it.
#[derive(Clone, Debug)]
pub struct Rendered {
    /// Premultiplied colour without background, and alpha: 4 channels.
    pub rgba: Image,
    /// Σ α · T · z: divide by alpha for the mean depth.
    pub depth: Image,
}

impl Rendered {
    /// Colour over a background: 3 channels.
    pub fn over(&self, background: [f32; 3]) -> Image {
        let mut image = Image::new(self.rgba.width, self.rgba.height, 3);
        let pixels = self.rgba.pixels.chunks_exact(4);
        for (out, rgba) in image.pixels.chunks_exact_mut(3).zip(pixels) {
            for k in 0..3 {
                out[k] = rgba[k] + (1.0 - rgba[3]) * background[k];
            }
        }
        image
    }

    /// Mean depth where something is there, 0 elsewhere.
    pub fn mean_depth(&self) -> Image {
        let mut image = self.depth.clone();
        for (depth, rgba) in image.pixels.iter_mut().zip(self.rgba.pixels.chunks_exact(4)) {
            *depth = if rgba[3] > 1e-3 { *depth / rgba[3] } else { 0.0 };
        }
        image
    }
}

/// Renders one scene. Images of one size after the other cost no allocation.
pub struct Renderer {
    device: Device,
    stream: Stream,
    gaussians: GaussianBuffers,
    motion: Option<Motion>,
    settings: RenderSettings,
    tuning: Tuning,
    half_harmonics: Option<HalfHarmonics>,
    half_shapes: Option<HalfShapes>,
    studio: Option<Studio>,
}

struct Studio {
    render: Render,
    scratch: RenderScratch,
    pixels: PixelBuffers,
}

impl Renderer {
    /// Puts a scene on a device.
    ///
    /// # Errors
    /// [`Error::OutOfMemory`](crate::Error::OutOfMemory), or a scene whose arrays do not fit
    /// together.
    pub fn new(device: &Device, scene: &Scene) -> Result<Renderer> {
        Renderer::tuned(device, scene, &Tuning::default())
    }

    /// Puts a scene on a device, to be rendered with some accuracy given up for speed.
    ///
    /// # Errors
    /// As for [`new`](Self::new); [`Error::Input`](crate::Error::Input) for settings out of range.
    pub fn tuned(device: &Device, scene: &Scene, tuning: &Tuning) -> Result<Renderer> {
        tuning.check()?;
        let mut stream = device.stream()?;
        let gaussians = GaussianBuffers::from_host(&mut stream, &scene.gaussians)?;
        let motion = match &scene.network {
            Some(network) if scene.gaussians.is_dynamic() => {
                let points = &scene.control_points;
                let most = tuning.neighbours.unwrap_or(scene.neighbours).min(scene.neighbours);
                let k = (most as usize).min(points.len());
                let count = scene.gaussians.len();
                let mut motion = Motion::new(&mut stream, points, network, k, count, 1)?;
                motion.set_dynamic(&mut stream, &scene.gaussians.motion_logits, 0.0)?;
                let mut recorder = stream.record()?;
                motion.refresh(&mut recorder, gaussians.views().positions)?;
                stream.submit(recorder)?;
                Some(motion)
            }
            _ => None,
        };
        let half_harmonics = tuning
            .half_sh
            .then(|| HalfHarmonics::from_host(device, &scene.gaussians))
            .transpose()?;
        let half_shapes = tuning
            .half_shapes
            .then(|| HalfShapes::from_host(device, &scene.gaussians))
            .transpose()?;
        Ok(Renderer {
            device: device.clone(),
            stream,
            gaussians,
            motion,
            settings: tuning.apply(scene.settings),
            tuning: *tuning,
            half_harmonics,
            half_shapes,
            studio: None,
        })
    }

    /// Renders the scene as `camera` sees it at `time` in [0, 1], and waits for it.
    ///
    /// # Errors
    /// [`Error::OutOfMemory`](crate::Error::OutOfMemory),
    /// [`Error::RangeLimit`](crate::Error::RangeLimit) for more intersections than a binding holds,
    /// or a failed submission.
    pub fn render(&mut self, camera: &Camera, time: f64) -> Result<Rendered> {
        let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
        let mut room = match &self.studio {
            Some(studio) if (studio.pixels.width, studio.pixels.height) == (width, height) => None,
            _ => Some((4 * self.gaussians.len).max(1 << 14)),
        };
        loop {
            if let Some(room) = room {
                self.studio = None;
                self.studio = Some(self.plan(width, height, room)?);
            }
            let studio = self.studio.as_mut().expect("planned above");
            let mut recorder = self.stream.record()?;
            let mut views = self.gaussians.views();
            if let Some(motion) = &mut self.motion {
                motion.forward(&mut recorder, &views, &[time as f32], None)?;
            }
            if let Some(half) = &self.half_shapes {
                views = half.replace(views);
            }
            if let Some(half) = &self.half_harmonics {
                views = half.replace(views);
            }
            if let Some(motion) = &self.motion {
                views = motion.moved(views);
            }
            views = views.at_degree(self.tuning.sh_degree);
            let Studio { render, scratch, pixels } = studio;
            render.forward(&mut recorder, camera, views, scratch, pixels)?;
            self.stream.submit(recorder)?;
            let counts = scratch.counts(&mut self.stream)?;
            if counts.intersections > render.intersection_capacity() {
                room = Some(counts.intersections + counts.intersections / 4);
                continue;
            }
            let rgba = self.stream.download(&pixels.rgba)?.into_flattened();
            let depth = self.stream.download(&pixels.depth)?;
            return Ok(Rendered {
                rgba: Image { width, height, channels: 4, pixels: rgba },
                depth: Image { width, height, channels: 1, pixels: depth },
            });
        }
    }

    fn plan(&self, width: u32, height: u32, room: usize) -> Result<Studio> {
        let gaussians = self.gaussians.len;
        let render = Render::plan(&self.device, gaussians, room, width, height, self.settings)?
            .with_depth_bits(&self.device, self.tuning.depth_bits)?
            .with_raster(self.tuning.raster);
        Ok(Studio {
            scratch: render.scratch(&self.device)?,
            pixels: render.pixels(&self.device)?,
            render,
        })
    }
}

//! A scene rendered forward and backward, with all intermediate buffers.

use crate::Result;
use crate::gpu::{Device, KernelTime, Recorder, Stream};
use crate::ops::gaussians::GaussianBuffers;
use crate::ops::render::{self, FrameCounts, FrameGradients, Render};
use crate::oracle::bin::Bins;
use crate::oracle::project::Splat;
use crate::oracle::tiles::{TileRect, grid};
use crate::types::{Camera, Gaussians, RenderSettings};

pub(super) struct Frame {
    inner: render::Frame<FrameGradients>,
    camera: Camera,
    gaussians: GaussianBuffers,
    gradients: GaussianBuffers,
    pub(super) counts: FrameCounts,
    stream: Stream,
}

/// The splats and tile lists of the device, in the oracle's types.
pub(super) struct Listed {
    pub(super) splats: Vec<Option<Splat<f64>>>,
    pub(super) bins: Bins,
    /// Tile and splat of each intersection, as emitted.
    pub(super) emitted: [Vec<u32>; 2],
    pub(super) tile_counts: Vec<u32>,
    pub(super) visible: Vec<u32>,
}

impl Frame {
    /// Renders once, with capacity for all intersections.
    pub(super) fn new(
        device: &Device,
        scene: &Gaussians,
        camera: &Camera,
        settings: RenderSettings,
    ) -> Result<Frame> {
        let mut stream = device.stream()?;
        let gaussians = GaussianBuffers::from_host(&mut stream, scene)?;
        let (n, k) = (scene.len(), camera.intrinsics);
        let mut capacity = 4 * n + 1024;
        loop {
            let render = Render::plan(device, n, capacity, k.width, k.height, settings)?;
            let mut inner = render.differentiable(device)?;
            let mut recorder = stream.record()?;
            inner.forward(&mut recorder, camera, gaussians.views(), Default::default())?;
            stream.submit(recorder)?;
            let counts = inner.counts(&mut stream)?;
            if counts.intersections <= capacity {
                let gradients = GaussianBuffers::new(device, n, scene.sh_degree)?;
                return Ok(Frame { inner, camera: *camera, gaussians, gradients, counts, stream });
            }
            capacity = counts.intersections;
        }
    }

    /// Renders, and returns the time of each dispatch; empty without timestamps.
    pub(super) fn profile_forward(&mut self) -> Result<Vec<KernelTime>> {
        let mut recorder = self.stream.record()?;
        recorder.profile()?;
        let views = self.gaussians.views();
        self.inner.forward(&mut recorder, &self.camera, views, Default::default())?;
        self.finish(recorder)
    }

    fn finish(&mut self, recorder: Recorder) -> Result<Vec<KernelTime>> {
        let timed = self.stream.device().limits().timestamp_period > 0.0;
        let ticket = self.stream.submit(recorder)?;
        match timed {
            true => self.stream.times(ticket),
            false => self.stream.wait(ticket).map(|()| Vec::new()),
        }
    }

    /// Sets the gradient with respect to the image that
    /// [`profile_backward`](Self::profile_backward) starts from.
    pub(super) fn set_gradient(&mut self, rgba: &[[f32; 4]], depth: &[f32]) -> Result<()> {
        let by_pixel = &mut self.inner.gradients.pixels;
        self.stream.upload(&mut by_pixel.rgba, rgba)?;
        self.stream.upload(&mut by_pixel.depth, depth)
    }

    /// Differentiates the last frame, the pose included, and returns the time of each dispatch.
    pub(super) fn profile_backward(&mut self) -> Result<Vec<KernelTime>> {
        let mut recorder = self.stream.record()?;
        recorder.profile()?;
        let (views, by) = (self.gaussians.views(), Default::default());
        self.inner.backward(&mut recorder, views, by, &mut self.gradients, true)?;
        self.finish(recorder)
    }

    /// The gradients of the last backward pass.
    pub(super) fn gradients(&mut self) -> Result<Gaussians> {
        self.gradients.download(&mut self.stream)
    }

    /// Width and height of the image, pixels.
    pub(super) fn size(&self) -> [u32; 2] {
        [self.inner.pixels.width, self.inner.pixels.height]
    }

    /// The last frame's image.
    pub(super) fn image(&mut self) -> Result<Vec<[f32; 4]>> {
        self.stream.download(&self.inner.pixels.rgba)
    }

    /// Number of (pixel, splat) pairs that blending visits, from the index at which each pixel
    /// stopped.
    pub(super) fn blended(&mut self) -> Result<u64> {
        let last = self.stream.download(&self.inner.pixels.last)?;
        Ok(last.iter().map(|&l| u64::from(l)).sum())
    }

    /// The device's splats and tile lists of the last frame.
    pub(super) fn listed(&mut self) -> Result<Listed> {
        let size = self.size();
        let (s, stream) = (&self.inner.scratch, &mut self.stream);
        let (n, m) = (self.gaussians.len, self.counts.intersections);
        let cut = |mut words: Vec<u32>, len: usize| {
            words.truncate(len);
            words
        };
        let (means, conics) = (stream.download(&s.means)?, stream.download(&s.conics)?);
        let colours = stream.download(&s.colours)?;
        let rectangles = stream.download(&s.rectangles)?;
        let tile_counts = cut(stream.download(&s.tile_counts)?, n);
        let visible = cut(stream.download(&s.visible)?, n);
        let tiles = cut(stream.download(&s.tiles)?, m);
        let owners = cut(stream.download(&s.splat_from_emitted)?, m);
        let sorted = cut(stream.download(&s.sorted_tiles)?, m);
        let intersections = cut(stream.download(&s.emitted_from_sorted)?, m);
        let wide = f64::from;
        let splats = (0..n)
            .map(|i| {
                (visible[i] != 0).then(|| Splat {
                    mean: [wide(means[i][0]), wide(means[i][1])],
                    conic: [wide(conics[i][0]), wide(conics[i][1]), wide(conics[i][2])],
                    opacity: wide(means[i][3]),
                    depth: wide(means[i][2]),
                    colour: std::array::from_fn(|c| wide(colours[i][c])),
                    rect: TileRect {
                        min: [rectangles[i][0] & 0xffff, rectangles[i][0] >> 16],
                        max: [rectangles[i][1] & 0xffff, rectangles[i][1] >> 16],
                    },
                    tile_count: tile_counts[i],
                })
            })
            .collect();
        let bins = Bins {
            grid: grid(size[0], size[1]),
            splat_from_rank: cut(stream.download(&s.splat_from_rank)?, self.counts.visible),
            emitted_from_rank: cut(stream.download(&s.emitted_from_rank)?, self.counts.visible),
            splat_from_sorted: intersections.iter().map(|&at| owners[at as usize]).collect(),
            tiles: sorted,
            ranges: stream.download(&s.ranges)?,
        };
        Ok(Listed { splats, bins, emitted: [tiles, owners], tile_counts, visible })
    }
}

/// Nanoseconds of the dispatches that `which` selects; `None` if nothing was timed.
pub(super) fn sum(times: &[KernelTime], which: impl Fn(&str) -> bool) -> Option<f64> {
    let chosen = times.iter().filter(|time| which(time.kernel));
    (!times.is_empty()).then(|| chosen.map(|time| time.nanoseconds).sum())
}

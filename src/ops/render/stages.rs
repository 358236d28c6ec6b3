//! Access to the separate stages of a frame and to the data between them.

use super::Frame;
use crate::gpu::{View, ViewMut};

/// Splats: the results of the projection, in the Gaussians' order.
///
/// ```no_run
/// use splat4d::gpu::Device;
/// use splat4d::ops::gaussians::GaussianBuffers;
/// use splat4d::ops::render::Render;
/// use splat4d::types::{Camera, Gaussians};
/// # fn list(device: &Device, scene: &Gaussians, camera: &Camera) -> splat4d::Result<()> {
/// let mut stream = device.stream()?;
/// let gaussians = GaussianBuffers::from_host(&mut stream, scene)?;
/// let (n, k) = (gaussians.len, camera.intrinsics);
/// let render = Render::plan(device, n, 1 << 20, k.width, k.height, Default::default())?;
/// let mut frame = render.frame(device)?;
/// let mut means = device.buffer("my means", n)?;
/// let mut recorder = stream.record()?;
/// frame.project(&mut recorder, camera, gaussians.views())?;
/// recorder.copy(frame.splats().means, means.view_mut());
/// frame.bin(&mut recorder, n)?;
/// let mut ranges = device.buffer("my ranges", frame.tile_lists().ranges.len())?;
/// recorder.copy(frame.tile_lists().ranges, ranges.view_mut());
/// stream.submit(recorder)?;
/// let (means, ranges) = (stream.download(&means)?, stream.download(&ranges)?);
/// # Ok(())
/// # }
/// ```
pub struct SplatViews<'a> {
    /// Mean x and y in pixels, depth, opacity.
    pub means: View<'a, [f32; 4]>,
    /// The factored conic (a, b, e) and the cut. At an offset (x, y) in pixels from the mean, α is the
    /// opacity times exp(−(a x + b y)² − (e y)²). The fourth value is the exponent's magnitude at which
    /// α falls to `alpha_cut`.
    pub conics: View<'a, [f32; 4]>,
    /// Red, green, blue, unused.
    pub colours: View<'a, [f32; 4]>,
    /// The rectangle of tiles: the first tile and the one past the last, x in the lower half of a word,
    /// y in the upper.
    pub rectangles: View<'a, [u32; 2]>,
    /// Number of the rectangle's tiles that the splat overlaps. It is 0 for culled Gaussians, whose
    /// other entries are undefined.
    pub tile_counts: View<'a, u32>,
    /// 1 for a Gaussian that is not culled, else 0.
    pub visible: View<'a, u32>,
}

/// Writable views of the splats, for a host application that projects them itself.
pub struct SplatViewsMut<'a> {
    /// As [`SplatViews::means`].
    pub means: ViewMut<'a, [f32; 4]>,
    /// As [`SplatViews::conics`].
    pub conics: ViewMut<'a, [f32; 4]>,
    /// As [`SplatViews::colours`].
    pub colours: ViewMut<'a, [f32; 4]>,
    /// As [`SplatViews::rectangles`].
    pub rectangles: ViewMut<'a, [u32; 2]>,
    /// As [`SplatViews::tile_counts`].
    pub tile_counts: ViewMut<'a, u32>,
    /// As [`SplatViews::visible`].
    pub visible: ViewMut<'a, u32>,
}

/// The splats on each tile, front to back.
pub struct TileLists<'a> {
    /// For each tile, row by row: the begin and end of its range in `emitted_from_sorted`.
    pub ranges: View<'a, [u32; 2]>,
    /// The index of each intersection in the order in which they were emitted, which is by splat.
    pub emitted_from_sorted: View<'a, u32>,
    /// The index of the splat of each emitted intersection.
    pub splat_from_emitted: View<'a, u32>,
}

impl<G> Frame<G> {
    /// The results of the last [`project`](Self::project).
    pub fn splats(&self) -> SplatViews<'_> {
        SplatViews {
            means: self.scratch.means.view(),
            conics: self.scratch.conics.view(),
            colours: self.scratch.colours.view(),
            rectangles: self.scratch.rectangles.view(),
            tile_counts: self.scratch.tile_counts.view(),
            visible: self.scratch.visible.view(),
        }
    }

    /// The splats that [`bin`](Self::bin) and [`blend`](Self::blend) read, for a host application to write.
    pub fn splats_mut(&mut self) -> SplatViewsMut<'_> {
        SplatViewsMut {
            means: self.scratch.means.view_mut(),
            conics: self.scratch.conics.view_mut(),
            colours: self.scratch.colours.view_mut(),
            rectangles: self.scratch.rectangles.view_mut(),
            tile_counts: self.scratch.tile_counts.view_mut(),
            visible: self.scratch.visible.view_mut(),
        }
    }

    /// The results of the last [`bin`](Self::bin).
    pub fn tile_lists(&self) -> TileLists<'_> {
        TileLists {
            ranges: self.scratch.ranges.view(),
            emitted_from_sorted: self.scratch.emitted_from_sorted.view(),
            splat_from_emitted: self.scratch.splat_from_emitted.view(),
        }
    }
}

//! Tracks of points through a clip.

use glam::DVec2;
#[cfg(feature = "files")]
use serde::Serialize;

/// Tracks of points through a clip.
#[derive(Clone, Debug, Default, PartialEq)]
#[cfg_attr(feature = "files", derive(Serialize))]
pub struct Tracks {
    /// Width and height of the frames that the pixel positions refer to; `None` if the file does
    /// not state them.
    pub size: Option<(u32, u32)>,
    /// The tracks; all have the same number of frames.
    pub points: Vec<PointPath>,
}

/// The track of one point.
#[derive(Clone, Debug, Default, PartialEq)]
#[cfg_attr(feature = "files", derive(Serialize))]
pub struct PointPath {
    /// The frame and the pixel position of the query.
    pub query: (usize, DVec2),
    /// Pixel position in each frame, with pixel centres at +0.5; not finite where it is unknown.
    pub pixels: Vec<DVec2>,
    /// Whether the point is visible in each frame.
    pub seen: Vec<bool>,
}

impl Tracks {
    /// Number of frames of the tracks.
    pub fn frames(&self) -> usize {
        self.points.first().map_or(0, |point| point.pixels.len())
    }

    /// The tracks rescaled to frames of another size.
    pub fn resized(mut self, (width, height): (u32, u32)) -> Tracks {
        if let Some((w, h)) = self.size.replace((width, height)) {
            let scale =
                DVec2::new(f64::from(width) / f64::from(w), f64::from(height) / f64::from(h));
            for point in &mut self.points {
                point.query.1 *= scale;
                point.pixels.iter_mut().for_each(|pixel| *pixel *= scale);
            }
        }
        self
    }
}

//! Points through a clip.

use glam::DVec2;
#[cfg(feature = "files")]
use serde::Serialize;

/// Points through a clip.
#[derive(Clone, Debug, Default, PartialEq)]
#[cfg_attr(feature = "files", derive(Serialize))]
pub struct Tracks {
    /// Width and height of the frames that the pixels belong to; `None` where a file does not say.
    pub size: Option<(u32, u32)>,
    /// The points; all are told for the same number of frames.
    pub points: Vec<PointPath>,
}

/// A point through a clip.
#[derive(Clone, Debug, Default, PartialEq)]
#[cfg_attr(feature = "files", derive(Serialize))]
pub struct PointPath {
    /// The frame and the pixel that it was asked for in.
    pub query: (usize, DVec2),
    /// Where it is in each frame, pixels with centres at +0.5; not finite where it is not known.
    pub pixels: Vec<DVec2>,
    /// Whether it is seen there.
    pub seen: Vec<bool>,
}

impl Tracks {
    /// How many frames the points are told for.
    pub fn frames(&self) -> usize {
        self.points.first().map_or(0, |point| point.pixels.len())
    }

    /// For pictures of another size.
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

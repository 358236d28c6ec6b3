//! Points followed over many frames by chaining the flow of neighbouring ones.

use glam::DVec2;
use serde::{Deserialize, Serialize};

use super::flow::NeighbourFlow;

/// A point followed from frame to frame without a gap.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct PointTrack {
    /// The frame it begins in.
    pub first: usize,
    /// Its pixel in that frame and in those that follow.
    pub pixels: Vec<DVec2>,
    /// Confidence of each step, in (0, 1]; the first is 1.
    pub confidence: Vec<f32>,
}

impl PointTrack {
    /// The pixel in a frame; none outside of the track's life.
    pub fn at(&self, frame: usize) -> Option<DVec2> {
        frame.checked_sub(self.first).and_then(|k| self.pixels.get(k)).copied()
    }

    /// One past the last frame it lives in.
    pub fn end(&self) -> usize {
        self.first + self.pixels.len()
    }
}

/// How densely points are followed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TrackOptions {
    /// Distance of the points when they start, pixels.
    pub spacing: usize,
    /// A step with less confidence ends a track.
    pub confidence: f32,
}

impl TrackOptions {
    /// About 2,000 points in a frame: a spacing of 5 px at 320×180.
    pub fn for_size(width: usize, height: usize) -> TrackOptions {
        let spacing = ((width * height) as f64 / 2200.0).sqrt().round().max(2.0) as usize;
        TrackOptions { spacing, confidence: 0.3 }
    }
}

/// Follows a grid of points through a clip. Where a track has ended or left, a new one starts, so
/// that every frame is covered as far as its flow is to be believed. Tracks of a single frame are
/// left out.
pub fn follow(flow: &NeighbourFlow, options: &TrackOptions) -> Vec<PointTrack> {
    let spacing = options.spacing.max(1);
    let (columns, rows) = (flow.width.div_ceil(spacing), flow.height.div_ceil(spacing));
    let cell = |p: DVec2| {
        let column = (p.x as usize / spacing).min(columns - 1);
        (p.y as usize / spacing).min(rows - 1) * columns + column
    };
    let mut done: Vec<PointTrack> = Vec::new();
    let mut alive: Vec<PointTrack> = Vec::new();
    for frame in 0..flow.frames {
        let mut taken = vec![false; columns * rows];
        // The older of two tracks in one cell goes on: it sees more of the motion.
        let (mut kept, mut crowded) = (Vec::new(), Vec::new());
        for track in alive {
            let c = cell(track.pixels[track.pixels.len() - 1]);
            let place = if taken[c] { &mut crowded } else { &mut kept };
            taken[c] = true;
            place.push(track);
        }
        done.extend(crowded);
        alive = kept;
        if frame + 1 == flow.frames {
            break;
        }
        for c in (0..taken.len()).filter(|c| !taken[*c]) {
            let corner = DVec2::new((c % columns) as f64, (c / columns) as f64);
            let pixel = (corner + 0.5) * spacing as f64;
            if pixel.x < flow.width as f64 && pixel.y < flow.height as f64 {
                alive.push(PointTrack { first: frame, pixels: vec![pixel], confidence: vec![1.0] });
            }
        }
        let mut going = Vec::with_capacity(alive.len());
        for mut track in alive {
            let here = track.pixels[track.pixels.len() - 1];
            match flow.step(frame, true, here) {
                Some(next) if next.confidence >= options.confidence => {
                    track.pixels.push(next.pixel);
                    track.confidence.push(next.confidence);
                    going.push(track);
                }
                _ => done.push(track),
            }
        }
        alive = going;
    }
    done.extend(alive);
    done.retain(|t| t.pixels.len() > 1);
    done.sort_by(|a, b| {
        let key = |t: &PointTrack| (t.first, t.pixels[0].y, t.pixels[0].x);
        let (a, b) = (key(a), key(b));
        a.0.cmp(&b.0).then(a.1.total_cmp(&b.1)).then(a.2.total_cmp(&b.2))
    });
    done
}

//! Point tracks, made by chaining the flow of neighbouring frames.

use glam::DVec2;
use serde::{Deserialize, Serialize};

use super::flow::NeighbourFlow;
use crate::types::Tracks;

/// A point and the frames that see it; at least one.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct PointTrack {
    /// The frames that see the point, ascending. Frames in which it is occluded or was not found are left
    /// out.
    pub frames: Vec<usize>,
    /// Its position in each of these frames, pixels.
    pub pixels: Vec<DVec2>,
    /// Accumulated standard deviation of each position along each axis relative to the first, which counts
    /// as exact, pixels. It grows as the point is followed.
    pub deviation: Vec<f32>,
    /// Independent standard deviation of each position along each axis, pixels. It does not accumulate; set
    /// for points that are detected in each image anew.
    pub noise: f32,
}

/// Standard deviation of one step of externally supplied tracks along each axis, pixels.
const STEP_DEVIATION: f32 = 0.2;

impl PointTrack {
    /// A track without gaps that begins at frame `first`.
    pub fn followed(first: usize, pixels: Vec<DVec2>, deviation: Vec<f32>) -> PointTrack {
        PointTrack {
            frames: (first..first + pixels.len()).collect(),
            pixels,
            deviation,
            noise: 0.0,
        }
    }

    /// The first frame that sees it.
    pub fn first(&self) -> usize {
        self.frames[0]
    }

    /// One past the last frame that sees it.
    pub fn end(&self) -> usize {
        self.frames[self.frames.len() - 1] + 1
    }

    /// Index of a frame within the track.
    pub fn place(&self, frame: usize) -> Option<usize> {
        // Without a gap before it, the index follows from the frame number.
        let k = frame.checked_sub(self.first())?;
        match self.frames.get(k) == Some(&frame) {
            true => Some(k),
            false => self.frames.binary_search(&frame).ok(),
        }
    }

    /// The position in a frame, pixels; `None` where the point is not seen.
    pub fn at(&self, frame: usize) -> Option<DVec2> {
        self.place(frame).map(|k| self.pixels[k])
    }

    /// Standard deviation of the position at index `k` of the track relative to the first.
    pub(crate) fn deviation_at(&self, k: usize) -> f32 {
        self.deviation[k].hypot(std::f32::consts::SQRT_2 * self.noise)
    }

    /// Standard deviation of the position at index `k` relative to the one at index `exact`.
    pub(crate) fn deviation_between(&self, exact: usize, k: usize) -> f32 {
        let [exact, other] = [exact, k].map(|k| self.deviation[k]);
        let added = (other * other - exact * exact).abs().sqrt();
        added.hypot(std::f32::consts::SQRT_2 * self.noise)
    }

    /// The sub-track of a range of indices; its first position counts as exact.
    pub fn places(&self, places: std::ops::Range<usize>) -> PointTrack {
        // Independent noise is not part of the accumulated deviation.
        let added = |k: usize| {
            let [exact, other] = [places.start, k].map(|k| self.deviation[k]);
            (other * other - exact * exact).abs().sqrt()
        };
        PointTrack {
            frames: self.frames[places.clone()].to_vec(),
            pixels: self.pixels[places.clone()].to_vec(),
            deviation: places.clone().map(added).collect(),
            noise: self.noise,
        }
    }

    /// The runs without a gap, as ranges of indices.
    pub fn runs(&self) -> impl Iterator<Item = std::ops::Range<usize>> {
        let mut start = 0;
        self.frames.chunk_by(|a, b| a + 1 == *b).map(move |run| {
            start += run.len();
            start - run.len()..start
        })
    }
}

/// Density of point tracks.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TrackOptions {
    /// Distance between new points, pixels.
    pub spacing: usize,
    /// Minimum confidence of a step; a less confident step ends the track.
    pub confidence: f32,
}

impl Default for TrackOptions {
    /// The options for images of 320×180.
    fn default() -> Self {
        TrackOptions::for_size(320, 180)
    }
}

impl TrackOptions {
    /// About 2,000 points in a frame: a spacing of 5 px at 320×180.
    pub fn for_size(width: usize, height: usize) -> TrackOptions {
        let spacing = ((width * height) as f64 / 2200.0).sqrt().round().max(2.0) as usize;
        TrackOptions { spacing, confidence: 0.3 }
    }
}

/// Tracks a grid of points through a clip. Where tracks have ended or left the image, new ones start, so
/// that every frame is covered where its flow has confidence. Tracks of a single frame are left out.
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
        // Of two tracks in one cell the older one is kept, because it sees more of the motion.
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
                alive.push(PointTrack::followed(frame, vec![pixel], vec![0.0]));
            }
        }
        let mut going = Vec::with_capacity(alive.len());
        for mut track in alive {
            let here = track.pixels[track.pixels.len() - 1];
            match flow.step(frame, true, here) {
                Some(next) if next.confidence >= options.confidence => {
                    track.frames.push(frame + 1);
                    track.pixels.push(next.pixel);
                    let before = track.deviation[track.deviation.len() - 1];
                    track.deviation.push(before.hypot(flow.deviation(frame) / next.confidence));
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
        let key = |t: &PointTrack| (t.first(), t.pixels[0].y, t.pixels[0].x);
        let (a, b) = (key(a), key(b));
        a.0.cmp(&b.0).then(a.1.total_cmp(&b.1)).then(a.2.total_cmp(&b.2))
    });
    done
}

/// Tracks from externally supplied points within images of a size; points seen in fewer than two frames are
/// left out. Their deviation is assumed to grow as in a chain of flow.
pub(crate) fn supplied_tracks(tracks: &Tracks, size: DVec2) -> Vec<PointTrack> {
    let inside = |at: DVec2| at.cmpge(DVec2::ZERO).all() && at.cmplt(size).all();
    let whole = tracks.points.iter().map(|point| {
        let places = point.pixels.iter().zip(&point.seen).enumerate();
        let seen = places.filter(|(_, (pixel, seen))| **seen && inside(**pixel));
        let (frames, pixels): (Vec<usize>, Vec<DVec2>) = seen.map(|(f, (p, _))| (f, *p)).unzip();
        let since = |frame: &usize| STEP_DEVIATION * ((frame - frames[0]) as f32).sqrt();
        let deviation = frames.iter().map(since).collect();
        PointTrack { frames, pixels, deviation, noise: 0.0 }
    });
    whole.filter(|track| track.frames.len() > 1).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::observe::{SuppliedFlow, observe_flow};
    use crate::types::{Image, PointPath};

    const SIZE: (u32, u32) = (40, 20);

    #[test]
    fn supplied_points_are_taken_where_they_are_seen() {
        let x = [3.0, 5.0, 7.0, 9.0, f64::NAN, 13.0, 60.0, 17.0, 19.0];
        let point = PointPath {
            query: (0, DVec2::new(3.0, 4.0)),
            pixels: x.map(|x| DVec2::new(x, 4.0)).to_vec(),
            seen: vec![true, true, true, false, true, true, true, true, true],
        };
        let once = PointPath { seen: (0..9).map(|f| f == 7).collect(), ..point.clone() };
        let tracks = Tracks { size: Some(SIZE), points: vec![point, once] };
        let found = supplied_tracks(&tracks, DVec2::new(40.0, 20.0));
        let [track] = &found[..] else { panic!("one is seen in two frames: {found:?}") };
        assert_eq!(track.frames, [0, 1, 2, 5, 7, 8]);
        let x: Vec<f64> = track.pixels.iter().map(|p| p.x).collect();
        assert_eq!(x, [3.0, 5.0, 7.0, 13.0, 17.0, 19.0]);
        assert_eq!((track.first(), track.end()), (0, 9));
        for (frame, x) in [(1, Some(5.0)), (3, None), (5, Some(13.0)), (8, Some(19.0)), (9, None)] {
            assert_eq!(track.at(frame).map(|p| p.x), x, "{frame}");
        }
        assert_eq!(track.runs().collect::<Vec<_>>(), [0..3, 3..4, 4..6]);
        assert!(track.deviation.is_sorted() && track.deviation[0] == 0.0);
        let part = track.places(2..5);
        assert_eq!((&part.frames[..], part.deviation[0]), (&[2, 5, 7][..], 0.0));
    }

    /// Four frames in which everything moves by (4, 1), except for one vector.
    fn flow(odd: Option<(usize, [f32; 2])>) -> NeighbourFlow {
        let field = |v: [f32; 2]| {
            let pixels = (0..SIZE.0 * SIZE.1).flat_map(|_| v).collect();
            Image { width: SIZE.0, height: SIZE.1, channels: 2, pixels }
        };
        let mut forward = vec![field([4.0, 1.0]); 3];
        if let Some((at, v)) = odd {
            forward[1].pixels[2 * at..2 * at + 2].copy_from_slice(&v);
        }
        let mut source = SuppliedFlow::new(forward, vec![field([-4.0, -1.0]); 3]).unwrap();
        let frames = vec![Image::new(SIZE.0, SIZE.1, 3); 4];
        observe_flow(&frames, &mut source, &mut |_| Ok(())).unwrap()
    }

    #[test]
    fn a_grid_follows_an_even_flow_and_is_refilled() {
        let tracks = follow(&flow(None), &TrackOptions { spacing: 4, ..Default::default() });
        for track in &tracks {
            assert!(track.pixels.len() > 1 && track.end() <= 4);
            for (k, pixel) in track.pixels.iter().enumerate() {
                let moved = *pixel - track.pixels[0] - DVec2::new(4.0, 1.0) * k as f64;
                assert!(moved.length() < 1e-6, "{track:?}");
                assert!((0.0..=40.0).contains(&pixel.x) && (0.0..=20.0).contains(&pixel.y));
            }
            assert!(track.deviation.windows(2).all(|d| d[0] < d[1]) && track.deviation[0] == 0.0);
            assert_eq!(track.at(track.end()), None);
        }
        // The grid of the first frame has ten by five points. The last column leaves in the first step and
        // is not tracked, all others are: those in the lowest row stay inside for one step.
        let begin = |frame: usize| tracks.iter().filter(|t| t.first() == frame).count();
        assert_eq!(begin(0), 9 * 5);
        // The area that the flow uncovers on the left is filled with new points, in the first column.
        let fresh: Vec<_> = tracks.iter().filter(|t| t.first() == 1).collect();
        assert!(fresh.iter().filter(|t| t.pixels[0].x == 2.0).count() >= 4, "{fresh:?}");
        let whole = tracks.iter().filter(|t| t.first() == 0 && t.end() == 4).count();
        // In three steps, 7 columns of 10 stay inside, and all rows at 2, 6, 10, 14 and 18 but the last.
        assert_eq!(whole, 7 * 4);
    }

    #[test]
    fn a_step_that_cannot_be_believed_ends_a_track() {
        // The point (6, 6) of the first frame is at (10, 7) in the second, between the pixels of rows 6 and
        // 7 and columns 9 and 10: all four would have to be wrong.
        let spacing = TrackOptions { spacing: 4, ..Default::default() };
        let at = |y: usize, x: usize| y * SIZE.0 as usize + x;
        let life = |flow: &NeighbourFlow| {
            let start = DVec2::new(6.0, 6.0);
            let tracks = follow(flow, &spacing);
            tracks.iter().find(|t| t.first() == 0 && t.pixels[0] == start).unwrap().pixels.len()
        };
        assert_eq!(life(&flow(None)), 4);
        // One wrong vector of four lowers the confidence to three quarters, which is enough.
        assert!(life(&flow(Some((at(6, 9), [-9.0, 0.0])))) > 2);
        let strict = TrackOptions { confidence: 0.9, ..spacing };
        let tracks = follow(&flow(Some((at(6, 9), [-9.0, 0.0]))), &strict);
        let ended = tracks.iter().find(|t| t.first() == 0 && t.pixels[0] == DVec2::new(6.0, 6.0));
        assert_eq!(ended.unwrap().pixels.len(), 2);
    }
}

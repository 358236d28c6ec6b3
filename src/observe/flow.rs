//! Dense optical flow of a clip from any source, with a confidence per pixel.

use std::path::{Path, PathBuf};

use glam::DVec2;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::data::{Lens, flow};
use crate::types::{Image, Intrinsics};
use crate::{Error, Result};

/// Flow between two frames in both directions. Vectors are images of two channels (u, v) in pixels:
/// the point seen at pixel p of the first frame is at p + (u, v) in the second. Confidences are
/// images of one channel in [0, 1], or absent.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct FlowPair {
    /// From the first frame to the second.
    pub forward: Image,
    /// From the second frame to the first.
    pub backward: Image,
    /// The source's own confidence in `forward`, where it gives one.
    pub forward_confidence: Option<Image>,
    /// The source's own confidence in `backward`, where it gives one.
    pub backward_confidence: Option<Image>,
}

/// A source of optical flow between neighbouring frames of a clip.
pub trait FlowSource {
    /// The flow between frame `first` and frame `first + 1`.
    ///
    /// # Errors
    /// Whatever keeps the source from answering.
    fn pair(&mut self, first: usize) -> Result<FlowPair>;

    /// Whether a pair takes long enough to compute that it is checkpointed for a run that resumes this one.
    fn is_costly(&self) -> bool {
        true
    }

    /// Called in place of [`pair`](FlowSource::pair) for a pair that an earlier run has checkpointed. The
    /// result of the next pair must be the same as if this source had computed this one.
    fn known(&mut self, _first: usize, _pair: &FlowPair) {}
}

/// A frame and the next one.
///
/// # Errors
/// The clip ends before the second frame.
pub(super) fn neighbours(frames: &[Image], first: usize) -> Result<(&Image, &Image)> {
    frames.get(first).zip(frames.get(first + 1)).ok_or_else(|| {
        let what =
            format!("flow from frame {first} to the next: the clip has {} frames", frames.len());
        Error::Input(what)
    })
}

/// Flow from files, or exact flow of a synthetic clip.
#[derive(Clone, Debug, Serialize)]
pub struct SuppliedFlow {
    forward: Vec<Image>,
    backward: Vec<Image>,
}

impl SuppliedFlow {
    /// Flow from images in memory: `forward[i]` leads from frame i to i + 1, `backward[i]` from i + 1 to i.
    /// Both lists hold one image less than there are frames.
    ///
    /// # Errors
    /// Lists of different length, or an image that does not have two channels.
    pub fn new(forward: Vec<Image>, backward: Vec<Image>) -> Result<SuppliedFlow> {
        if forward.len() != backward.len() {
            return Err(Error::Shape {
                op: "supplied flow",
                arg: "backward",
                expected: format!("{} fields, one for each forward field", forward.len()),
                actual: backward.len(),
            });
        }
        if let Some(bad) = forward.iter().chain(&backward).find(|f| f.channels != 2) {
            return Err(Error::Shape {
                op: "supplied flow",
                arg: "channels",
                expected: "2".into(),
                actual: bad.channels as usize,
            });
        }
        Ok(SuppliedFlow { forward, backward })
    }

    /// Number of pairs: one less than the number of frames.
    pub fn pairs(&self) -> usize {
        self.forward.len()
    }

    /// The flow from a frame on, which becomes frame 0.
    pub fn from_frame(mut self, first: usize) -> SuppliedFlow {
        for fields in [&mut self.forward, &mut self.backward] {
            fields.drain(..first.min(fields.len()));
        }
        self
    }

    /// Opens a folder of flow files. All files have the first of the [`flow::EXTENSIONS`] that occurs. The
    /// forward and backward files are those whose names begin with `forward` and `backward`, or those in
    /// folders of these names, in natural order.
    ///
    /// # Errors
    /// A folder that cannot be read, no such files, numbers of files that differ, a damaged file.
    pub fn open(folder: impl AsRef<Path>) -> Result<SuppliedFlow> {
        let folder = folder.as_ref();
        let [forward, backward] = ["forward", "backward"].map(|direction| {
            let inner = folder.join(direction);
            let (place, prefix) =
                if inner.is_dir() { (inner.as_path(), "") } else { (folder, direction) };
            let mut found = Vec::new();
            for entry in std::fs::read_dir(place).map_err(Error::io(place))? {
                let path = entry.map_err(Error::io(place))?.path();
                if path.file_name().unwrap_or_default().to_string_lossy().starts_with(prefix) {
                    found.push(path);
                }
            }
            let of = |extension: &&str| -> Vec<PathBuf> {
                let named = |path: &&PathBuf| path.extension().is_some_and(|e| e == *extension);
                found.iter().filter(named).cloned().collect()
            };
            let mut files =
                flow::EXTENSIONS.iter().map(of).find(|files| !files.is_empty()).unwrap_or_default();
            // Sorted by the digits of the name, then by the name, so that 10 follows 9.
            files.sort_by_cached_key(|path| {
                let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
                let digits: String = name.chars().filter(char::is_ascii_digit).collect();
                (digits.parse::<u64>().unwrap_or(u64::MAX), name)
            });
            files.par_iter().map(flow::read).collect::<Result<Vec<_>>>()
        });
        let (forward, backward) = (forward?, backward?);
        if forward.is_empty() || forward.len() != backward.len() {
            return Err(Error::format(
                folder,
                format!(
                    "holds {} forward and {} backward fields; a clip of n frames needs n − 1 of \
                     each, named forward* and backward*, as .flo, .npy, .npz or KITTI's .png",
                    forward.len(),
                    backward.len()
                ),
            ));
        }
        SuppliedFlow::new(forward, backward)
    }
}

impl FlowSource for SuppliedFlow {
    fn pair(&mut self, first: usize) -> Result<FlowPair> {
        let (Some(forward), Some(backward)) = (self.forward.get(first), self.backward.get(first))
        else {
            return Err(Error::Input(format!(
                "the supplied flow has {} fields each way, frame {first} → {} is not among them; \
                 supply one field less than there are frames",
                self.forward.len(),
                first + 1
            )));
        };
        Ok(FlowPair {
            forward: forward.clone(),
            backward: backward.clone(),
            forward_confidence: None,
            backward_confidence: None,
        })
    }

    fn is_costly(&self) -> bool {
        false
    }
}

/// The flow between all neighbouring frames of a clip, with a confidence per pixel that includes the
/// forward–backward check.
#[derive(Clone, Debug)]
pub struct NeighbourFlow {
    /// Width of the frames.
    pub width: usize,
    /// Height of the frames.
    pub height: usize,
    /// Number of frames, n.
    pub frames: usize,
    forward: Vec<Field>,
    backward: Vec<Field>,
    /// Per pair, standard deviation of confident flow along each axis, pixels.
    deviation: Vec<f32>,
}

/// One direction of one pair: (u, v, confidence) per pixel.
#[derive(Clone, Debug)]
struct Field(Vec<[f32; 3]>);

/// Forward–backward disagreement at which the confidence is halved: this many pixels plus a share of the
/// vector's length.
const DISAGREEMENT: (f32, f32) = (0.5, 0.02);

/// Lower and upper bound of the standard deviation of confident flow along each axis, pixels.
const DEVIATION: (f32, f32) = (0.01, 0.2);
/// Upper bound of that deviation, as a multiple of the median disagreement of both directions. The engine's
/// own flow has a median disagreement of at least 0.045 px and an error of about 0.2 px; a smaller
/// deviation is used only for flow with a far smaller disagreement.
const OFF_BY_DISAGREEMENT: f32 = 10.0;
/// Flow with less confidence is not used to estimate the deviation.
const CONFIDENT: f32 = 0.3;

/// Computes the flow of all neighbouring pairs of a clip from a source.
///
/// # Errors
/// Those of the source, of `progress` (called with the share done), or flow of another size than
/// the frames.
pub fn observe_flow(
    frames: &[Image],
    source: &mut dyn FlowSource,
    progress: &mut dyn FnMut(f64) -> Result<()>,
) -> Result<NeighbourFlow> {
    let mut out = NeighbourFlow::begin(frames)?;
    for i in 0..frames.len() - 1 {
        out.push(&source.pair(i)?)?;
        progress((i + 1) as f64 / (frames.len() - 1) as f64)?;
    }
    Ok(out)
}

impl NeighbourFlow {
    /// An empty flow for a clip, to which pairs are added.
    pub(crate) fn begin(frames: &[Image]) -> Result<NeighbourFlow> {
        let Some(first) = frames.first() else {
            return Err(Error::Input("a clip without frames has no flow".into()));
        };
        Ok(NeighbourFlow {
            width: first.width as usize,
            height: first.height as usize,
            frames: frames.len(),
            forward: Vec::new(),
            backward: Vec::new(),
            deviation: Vec::new(),
        })
    }

    /// Appends the next pair.
    pub(crate) fn push(&mut self, pair: &FlowPair) -> Result<()> {
        let (i, width, height) = (self.forward.len(), self.width as u32, self.height as u32);
        for (field, channels) in [(Some(&pair.forward), 2), (Some(&pair.backward), 2)]
            .into_iter()
            .chain([(pair.forward_confidence.as_ref(), 1), (pair.backward_confidence.as_ref(), 1)])
        {
            let Some(field) = field else { continue };
            if (field.width, field.height, field.channels) != (width, height, channels) {
                return Err(Error::Input(format!(
                    "the flow between frames {i} and {} is {}×{} with {} channels, the frames are \
                     {width}×{height}; supply flow at the size of the frames",
                    i + 1,
                    field.width,
                    field.height,
                    field.channels
                )));
            }
        }
        let own = pair.forward_confidence.as_ref();
        let (forward, off) = checked(&pair.forward, &pair.backward, own);
        let own = pair.backward_confidence.as_ref();
        self.backward.push(checked(&pair.backward, &pair.forward, own).0);
        self.deviation.push(deviation(&forward, &off));
        self.forward.push(forward);
        Ok(())
    }

    /// The flow between undistorted images: those of a pinhole camera in place of the lens.
    pub(crate) fn undistorted(&self, lens: &Lens, pinhole: &Intrinsics) -> NeighbourFlow {
        let (width, height) = (self.width as u32, self.height as u32);
        let undistorted = |Field(values): &Field| {
            let pixels = values.as_flattened().to_vec();
            let field = Image { width, height, channels: 3, pixels };
            let field = lens.undistort_flow(&field, pinhole);
            let known = |v: &[f32; 3]| if v[2].is_nan() { [0.0; 3] } else { *v };
            Field(field.pixels.as_chunks().0.iter().map(known).collect())
        };
        let all = |fields: &[Field]| fields.iter().map(undistorted).collect();
        let (forward, backward) = (all(&self.forward), all(&self.backward));
        NeighbourFlow { forward, backward, deviation: self.deviation.clone(), ..*self }
    }
}

/// A flow field with its forward–backward confidence, and the distance in pixels between each pixel and
/// where the two directions lead back to; infinite where that is unknown.
fn checked(there: &Image, back: &Image, own: Option<&Image>) -> (Field, Vec<f32>) {
    let (w, h) = (there.width as usize, there.height as usize);
    let back: Vec<[f32; 3]> = back.pixels.chunks_exact(2).map(|v| [v[0], v[1], 1.0]).collect();
    let (values, off) = (0..w * h)
        .into_par_iter()
        .map(|i| {
            let (u, v) = (there.pixels[2 * i], there.pixels[2 * i + 1]);
            let at = DVec2::new((i % w) as f64 + 0.5, (i / w) as f64 + 0.5);
            if !(u.is_finite() && v.is_finite()) {
                return ([0.0; 3], f32::INFINITY);
            }
            let to = at + DVec2::new(f64::from(u), f64::from(v));
            let Some(b) = sample(&back, w, h, to).filter(|b| b[0].is_finite() && b[1].is_finite())
            else {
                return ([u, v, 0.0], f32::INFINITY);
            };
            let off = (u + b[0]).hypot(v + b[1]);
            let tolerance = DISAGREEMENT.0 + DISAGREEMENT.1 * u.hypot(v);
            let agreement = (-std::f32::consts::LN_2 * (off / tolerance).powi(2)).exp();
            let own = own.map_or(1.0, |c| c.pixels[i].clamp(0.0, 1.0));
            let confidence = agreement * own;
            ([u, v, if confidence > 0.05 { confidence } else { 0.0 }], off)
        })
        .collect::<(Vec<_>, Vec<_>)>();
    (Field(values), off)
}

/// Standard deviation of a pair's confident flow, estimated from the disagreement of its directions.
fn deviation(Field(values): &Field, off: &[f32]) -> f32 {
    let believed = values.iter().zip(off).filter(|(v, _)| v[2] >= CONFIDENT);
    let mut off: Vec<f32> = believed.map(|(_, off)| *off).collect();
    if off.is_empty() {
        return DEVIATION.1;
    }
    let middle = off.len() / 2;
    let (_, median, _) = off.select_nth_unstable_by(middle, f32::total_cmp);
    (OFF_BY_DISAGREEMENT * *median).clamp(DEVIATION.0, DEVIATION.1)
}

/// Bilinear sample; `None` more than half a pixel beyond the centres of the outermost pixels.
fn sample(field: &[[f32; 3]], w: usize, h: usize, at: DVec2) -> Option<[f32; 3]> {
    if !(at.x >= 0.0 && at.y >= 0.0 && at.x <= w as f64 && at.y <= h as f64) {
        return None;
    }
    let x = (at.x - 0.5).clamp(0.0, (w - 1) as f64);
    let y = (at.y - 0.5).clamp(0.0, (h - 1) as f64);
    let (i, j) = (x as usize, y as usize);
    let (fx, fy) = ((x - i as f64) as f32, (y - j as f64) as f32);
    let (i1, j1) = ((i + 1).min(w - 1), (j + 1).min(h - 1));
    let (a, b) = (field[j * w + i], field[j * w + i1]);
    let (c, d) = (field[j1 * w + i], field[j1 * w + i1]);
    Some(std::array::from_fn(|k| {
        let top = a[k] + (b[k] - a[k]) * fx;
        let bottom = c[k] + (d[k] - c[k]) * fx;
        top + (bottom - top) * fy
    }))
}

/// Position of a pixel of one frame in another, with its confidence.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Chain {
    /// Pixel in the other frame.
    pub pixel: DVec2,
    /// Product of the confidences along the chain, in (0, 1].
    pub confidence: f32,
}

impl NeighbourFlow {
    /// Follows a pixel of frame `from` to the next frame or the previous one; `None` where it leaves the
    /// image or the flow has no confidence.
    ///
    /// # Panics
    /// When there is no such frame or neighbour.
    pub fn step(&self, from: usize, forward: bool, pixel: DVec2) -> Option<Chain> {
        let field = if forward { &self.forward[from] } else { &self.backward[from - 1] };
        let [u, v, confidence] = sample(&field.0, self.width, self.height, pixel)?;
        let pixel = pixel + DVec2::new(f64::from(u), f64::from(v));
        let inside = pixel.x >= 0.0
            && pixel.y >= 0.0
            && pixel.x <= self.width as f64
            && pixel.y <= self.height as f64;
        (inside && confidence > 0.0).then_some(Chain { pixel, confidence })
    }

    /// Follows a pixel of frame `from` through up to `reach` frames in each direction and calls `seen` with
    /// each frame and position.
    pub fn follow(
        &self,
        from: usize,
        pixel: DVec2,
        reach: usize,
        mut seen: impl FnMut(usize, Chain),
    ) {
        for forward in [true, false] {
            let mut here = Chain { pixel, confidence: 1.0 };
            let mut frame = from;
            for _ in 0..reach {
                if frame == if forward { self.frames - 1 } else { 0 } {
                    break;
                }
                let Some(next) = self.step(frame, forward, here.pixel) else { break };
                frame = if forward { frame + 1 } else { frame - 1 };
                here = Chain { pixel: next.pixel, confidence: here.confidence * next.confidence };
                if here.confidence < 0.05 {
                    break;
                }
                seen(frame, here);
            }
        }
    }

    /// Standard deviation of confident flow along each axis from a frame to the next, pixels.
    pub(super) fn deviation(&self, from: usize) -> f32 {
        self.deviation[from]
    }

    /// The flow at a pixel's centre: (u, v, confidence), forward from `frame`, or backward.
    pub fn at(&self, frame: usize, forward: bool, index: usize) -> [f32; 3] {
        if forward { self.forward[frame].0[index] } else { self.backward[frame - 1].0[index] }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn field(pixels: Vec<f32>) -> Image {
        Image { width: 8, height: 1, channels: 2, pixels }
    }

    #[test]
    fn confidence_falls_with_disagreement() {
        // Everything moves 1 px to the right; four of the eight pixels have a different backward flow.
        let there = field([1.0, 0.0].repeat(8));
        let mut back = field([-1.0, 0.0].repeat(8));
        let tolerance = DISAGREEMENT.0 + DISAGREEMENT.1;
        back.pixels[2 * 2] = -1.0 + tolerance;
        back.pixels[2 * 3] = -1.0 + 3.0 * tolerance;
        back.pixels[2 * 4] = f32::NAN;
        let (Field(values), _) = checked(&there, &back, None);
        let confidence: Vec<f32> = values.iter().map(|v| v[2]).collect();
        // The vector at pixel i is compared with the one at i + 1.
        assert_eq!(confidence[0], 1.0);
        assert!((confidence[1] - 0.5).abs() < 1e-5, "half at the tolerance: {confidence:?}");
        assert_eq!(confidence[2], 0.0, "2⁻⁹ counts as none");
        assert_eq!(confidence[3], 0.0, "a way back that is no number");
        assert_eq!(confidence[5], 1.0);
        assert_eq!(confidence[7], 0.0, "it leaves the image by more than half a pixel");

        let own = Image { width: 8, height: 1, channels: 1, pixels: vec![0.25; 8] };
        assert_eq!(checked(&there, &back, Some(&own)).0.0[0][2], 0.25);
        let lost = field([f32::NAN, 0.0].repeat(8));
        assert!(checked(&lost, &back, None).0.0.iter().all(|v| *v == [0.0; 3]));
    }

    #[test]
    fn flow_is_as_sure_as_its_directions_agree() {
        let pair = |off: f32| FlowPair {
            forward: field([1.0, 0.0].repeat(8)),
            backward: field([off - 1.0, 0.0].repeat(8)),
            forward_confidence: None,
            backward_confidence: None,
        };
        let mut flow = NeighbourFlow::begin(&vec![Image::new(8, 1, 3); 5]).unwrap();
        for off in [0.0, 0.01, 0.05, 20.0] {
            flow.push(&pair(off)).unwrap();
        }
        let told: Vec<f32> = (0..4).map(|from| flow.deviation(from)).collect();
        for (told, expected) in told.iter().zip([0.01, 0.1, 0.2, 0.2]) {
            assert!((told - expected).abs() < 1e-5, "{told} for {expected}");
        }
    }

    #[test]
    fn samples_are_bilinear_and_end_at_the_picture() {
        let ramp: Vec<[f32; 3]> = (0..6).map(|i| [(i % 3) as f32, (i / 3) as f32, 1.0]).collect();
        let at = |x: f64, y: f64| sample(&ramp, 3, 2, DVec2::new(x, y));
        assert_eq!(at(1.5, 0.5), Some([1.0, 0.0, 1.0]));
        assert_eq!(at(1.75, 1.0), Some([1.25, 0.5, 1.0]));
        assert_eq!(at(0.0, 0.0), Some([0.0, 0.0, 1.0]), "the outermost half pixel is level");
        assert_eq!(at(-0.01, 1.0), None);
        assert_eq!(at(1.0, 2.01), None);
    }

    #[test]
    fn chains_multiply_their_confidences() {
        let frames = vec![Image::new(8, 1, 3); 4];
        let own = Image { width: 8, height: 1, channels: 1, pixels: vec![0.5; 8] };
        let pair = FlowPair {
            forward: field([1.0, 0.0].repeat(8)),
            backward: field([-1.0, 0.0].repeat(8)),
            forward_confidence: Some(own.clone()),
            backward_confidence: Some(own),
        };
        let mut flow = NeighbourFlow::begin(&frames).unwrap();
        (0..3).for_each(|_| flow.push(&pair).unwrap());
        let mut seen = Vec::new();
        flow.follow(1, DVec2::new(3.5, 0.5), 2, |frame, chain| {
            seen.push((frame, chain.pixel.x, chain.confidence));
        });
        assert_eq!(seen, [(2, 4.5, 0.5), (3, 5.5, 0.25), (0, 2.5, 0.5)]);
    }
}

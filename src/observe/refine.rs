//! Drift correction for tracks: their points are located again in the images.
//!
//! A chain of flow accumulates the errors of its steps: at 320×180 it is about 0.2 pixels off after one
//! step and one pixel after thirty. Here, each point of a track is aligned with the patch around the
//! track's first point, by the method of Lucas and Kanade with an affine warp, a gain and an offset (Baker
//! and Matthews 2004) under a robust kernel. The step of the chain is the initial value and the prior, so
//! that along an edge and in areas without texture the point follows the chain.
//!
//! Where the patch is no longer found, the last patch that was found replaces it. Where that fails too, the
//! track follows the chain.

use glam::{DMat2, DVec2};
use nalgebra::{SMatrix, SVector};
use rayon::prelude::*;

use super::luminance::Luminance;
use super::{NeighbourFlow, PointTrack};
use crate::types::Image;

/// Half side of a patch, pixels. Larger patches contain surfaces at several depths, which move apart with
/// the camera: on rendered clips, cameras from 13-pixel patches had three times the error of those from
/// 7-pixel patches.
const RADIUS: i32 = 3;
const SIDE: usize = 2 * RADIUS as usize + 1;
/// Maximum number of alignment steps, and the change in pixels that ends them.
const STEPS: usize = 10;
const SETTLED: f64 = 0.01;
/// Prior standard deviations of the changes from frame to frame: patch shape, gain, offset.
const SHAPE: f64 = 0.03;
const GAIN: f64 = 0.05;
const OFFSET: f64 = 0.03;
/// The deformation of a patch is measured as the difference of the flow this many pixels to each side. Less
/// than the first value of `TURN` is noise of the flow, more than the second is the edge of a mover.
const TURN_REACH: f64 = 6.0;
const TURN: (f64, f64) = (0.08, 0.5);
/// Flow with less confidence is not used for the deformation.
const CONFIDENCE: f32 = 0.3;
/// Lower bound of a pixel's luminance noise.
const NOISE: f64 = 0.005;
/// Information of neighbouring pixels of the smoothed image, relative to independent pixels.
const INDEPENDENT: f64 = 0.3;
/// An alignment that deviates from the chain's step by more than this many standard deviations, or pixels,
/// has found a different point.
const FARTHEST: (f64, f64) = (4.0, 2.0);
/// Share of the patch's variance that may remain unexplained.
const UNEXPLAINED: f64 = 0.05;
/// Factor on the uncertainty of a step at which the patch was not found.
const LOST: f32 = 3.0;

/// Standard deviation of a step with unreliable flow, and the deviation below which a point counts as found
/// again, pixels.
const ASTRAY: f64 = 1.0;
const SURE: f32 = 0.2;

/// Aligns the points of tracks with the images that the flow was computed from; their deviations become
/// those of the alignment. A track is extended past its end as long as its point is found. Where the images
/// have no texture, points stay where they are.
pub fn refine(frames: &[Image], flow: &NeighbourFlow, tracks: &mut [PointTrack]) {
    let frames: Vec<Luminance> = frames.par_iter().map(Luminance::of).collect();
    tracks.par_iter_mut().for_each(|track| refine_track(&frames, flow, track));
}

fn refine_track(frames: &[Luminance], flow: &NeighbourFlow, track: &mut PointTrack) {
    let chain = track.clone();
    let Some(mut patch) = Patch::at(&frames[track.first()], chain.pixels[0]) else { return };
    let mut look = Look::START;
    // Index of the patch within the track, and the accumulated deviation there.
    let (mut anchor, mut base) = (0, 0.0f32);
    let mut held = true;
    let apart = |a: f32, b: f32| (a * a - b * b).max(0.0).sqrt();
    for k in 1..chain.pixels.len() {
        let frame = &frames[chain.frames[k]];
        let (before, known) = (track.pixels[k - 1], track.deviation[k - 1]);
        let start = before + (chain.pixels[k] - chain.pixels[k - 1]);
        let step = apart(chain.deviation[k], chain.deviation[k - 1]);
        let followed = chain.frames[k - 1] + 1 == chain.frames[k];
        let turn = match followed {
            true => turn(flow, chain.frames[k - 1], before),
            false => DMat2::IDENTITY,
        };
        look.shape = turn * look.shape;
        let prior = |since: f32| Prior { pixel: start, deviation: f64::from(since.hypot(step)) };
        let mut found = patch.find(frame, prior(apart(known, base)), &look);
        if found.is_none() && anchor != k - 1 {
            // The latest appearance may be closer to the current one.
            if let Some(last) = Patch::at(&frames[chain.frames[k - 1]], before) {
                (patch, anchor, base) = (last, k - 1, known);
                look = Look { shape: turn, ..Look::START };
                found = patch.find(frame, prior(0.0), &look);
            }
        }
        held = found.is_some();
        match found {
            Some(Found { pixel, look: now, deviation }) => {
                (track.pixels[k], look) = (pixel, now);
                track.deviation[k] = base.hypot(deviation as f32);
            }
            None => {
                track.pixels[k] = start;
                track.deviation[k] = known.hypot(LOST * step);
            }
        }
    }
    // The chain ends where the flow is unreliable; the images may still show the point.
    while held && track.end() < frames.len() {
        let frame = track.end() - 1;
        let [.., earlier, before] = track.pixels[..] else { return };
        let step = flow.step(frame, true, before);
        let pixel = step.map_or(before + (before - earlier), |step| step.pixel);
        let prior = Prior { pixel, deviation: ASTRAY };
        let Some(found) = patch.find(&frames[frame + 1], prior, &look) else { return };
        let deviation = base.hypot(found.deviation as f32);
        if deviation > SURE {
            return;
        }
        look = found.look;
        track.frames.push(frame + 1);
        track.pixels.push(found.pixel);
        track.deviation.push(deviation);
    }
}

/// Deformation of a pixel's neighbourhood to the next frame, from the flow.
fn turn(flow: &NeighbourFlow, frame: usize, pixel: DVec2) -> DMat2 {
    let to = |by: DVec2| flow.step(frame, true, pixel + by).filter(|s| s.confidence > CONFIDENCE);
    let along = |axis: DVec2| Some((to(axis)?.pixel - to(-axis)?.pixel) * (0.5 / TURN_REACH));
    let x = along(DVec2::new(TURN_REACH, 0.0));
    let Some((x, y)) = x.zip(along(DVec2::new(0.0, TURN_REACH))) else { return DMat2::IDENTITY };
    let change = DMat2::from_cols(x, y) - DMat2::IDENTITY;
    let size = change.x_axis.length().max(change.y_axis.length());
    if !(TURN.0..TURN.1).contains(&size) {
        return DMat2::IDENTITY;
    }
    DMat2::IDENTITY + change * ((size - TURN.0) / size)
}

/// Appearance of a patch in an image: `image(pixel + shape · x) = gain · patch(x) + offset`.
#[derive(Clone, Copy)]
struct Look {
    shape: DMat2,
    gain: f64,
    offset: f64,
}

impl Look {
    const START: Look = Look { shape: DMat2::IDENTITY, gain: 1.0, offset: 0.0 };
}

/// Expected position of a patch, and its standard deviation along each axis, pixels.
#[derive(Clone, Copy)]
struct Prior {
    pixel: DVec2,
    deviation: f64,
}

/// Result of locating a patch.
struct Found {
    pixel: DVec2,
    look: Look,
    deviation: f64,
}

/// The neighbourhood of a point.
struct Patch {
    /// Value and gradient, row by row.
    values: Vec<(f64, DVec2)>,
    variance: f64,
}

/// Offsets of a patch's pixels from its centre.
fn places() -> impl Iterator<Item = DVec2> {
    let at = |k: usize| f64::from(k as i32 - RADIUS);
    (0..SIDE * SIDE).map(move |i| DVec2::new(at(i % SIDE), at(i / SIDE)))
}

impl Patch {
    /// Takes a patch; `None` where it leaves the image.
    fn at(frame: &Luminance, pixel: DVec2) -> Option<Patch> {
        let values: Vec<_> =
            places().map(|x| frame.sample(pixel + x)).collect::<Option<Vec<_>>>()?;
        let n = values.len() as f64;
        let mean = values.iter().map(|v| v.0).sum::<f64>() / n;
        let variance = values.iter().map(|v| (v.0 - mean).powi(2)).sum::<f64>() / n;
        Some(Patch { values, variance })
    }

    /// Locates the patch in an image; `None` where it is not found near the expected position.
    fn find(&self, frame: &Luminance, prior: Prior, before: &Look) -> Option<Found> {
        let farthest = (FARTHEST.0 * prior.deviation).min(FARTHEST.1);
        let (mut pixel, mut look) = (prior.pixel, *before);
        // Starts with a large noise level, so that a large initial error is not rejected as an outlier.
        let mut noise = 4.0 * NOISE;
        for _ in 0..STEPS {
            let inverse = look.shape.inverse();
            let mut normal = SMatrix::<f64, 8, 8>::zeros();
            let mut right = SVector::<f64, 8>::zeros();
            let (mut squares, mut trusted, mut trust) = (0.0, 0.0, 0.0);
            let kernel = (2.0 * noise).powi(2);
            for (x, (value, slope)) in places().zip(&self.values) {
                let (seen, _) = frame.sample(pixel + look.shape * x)?;
                let residual = seen - look.gain * value - look.offset;
                let weight = (1.0 + residual * residual / kernel).powi(-2);
                squares += residual * residual;
                trusted += weight * residual * residual;
                trust += weight;
                // The image gradient, from the gradient of the patch.
                let g = inverse.transpose() * *slope * look.gain;
                let row = SVector::<f64, 8>::from([
                    g.x,
                    g.y,
                    g.x * x.x,
                    g.x * x.y,
                    g.y * x.x,
                    g.y * x.y,
                    -value,
                    -1.0,
                ]);
                normal += weight * row * row.transpose();
                right -= weight * residual * row;
            }
            noise = (trusted / trust.max(1e-9)).sqrt().max(NOISE);
            let information = INDEPENDENT / (noise * noise);
            normal *= information;
            right *= information;
            let (moved, shape) = (pixel - prior.pixel, look.shape - before.shape);
            let priors = [
                (moved.x, prior.deviation),
                (moved.y, prior.deviation),
                (shape.x_axis.x, SHAPE),
                (shape.y_axis.x, SHAPE),
                (shape.x_axis.y, SHAPE),
                (shape.y_axis.y, SHAPE),
                (look.gain - before.gain, GAIN),
                (look.offset - before.offset, OFFSET),
            ];
            for (k, (off, deviation)) in priors.into_iter().enumerate() {
                let known = f64::max(deviation, 1e-6).powi(-2);
                normal[(k, k)] += known;
                right[k] -= off * known;
            }
            let factors = normal.cholesky()?;
            let step = factors.solve(&right);
            pixel += DVec2::new(step[0], step[1]);
            look.shape += DMat2::from_cols_array(&[step[2], step[4], step[3], step[5]]);
            look.gain += step[6];
            look.offset += step[7];
            if (pixel - prior.pixel).length() > farthest || look.shape.determinant() < 0.2 {
                return None;
            }
            if step.rows(0, 2).norm() < SETTLED {
                let explained = look.gain.powi(2) * self.variance.max(NOISE * NOISE / UNEXPLAINED);
                if squares / self.values.len() as f64 > UNEXPLAINED * explained {
                    return None;
                }
                let covariance = factors.inverse();
                let variance = 0.5 * (covariance[(0, 0)] + covariance[(1, 1)]);
                return Some(Found { pixel, look, deviation: variance.max(0.0).sqrt() });
            }
        }
        None
    }
}

#[cfg(test)]
mod tests {
    use super::super::{SuppliedFlow, observe_flow};
    use super::*;

    const SIZE: (u32, u32) = (64, 48);
    const FRAMES: usize = 8;

    /// A pattern that rotates about the centre of the image, translates and brightens from frame to frame.
    fn place(frame: usize, first: DVec2) -> DVec2 {
        let middle = DVec2::new(32.0, 24.0);
        let turn = DMat2::from_angle(0.03 * frame as f64);
        middle + turn * (first - middle) + DVec2::new(0.37, -0.23) * frame as f64
    }

    fn pictures() -> Vec<Image> {
        let picture = |frame: usize| {
            let mut image = Image::new(SIZE.0, SIZE.1, 3);
            let origin = place(frame, DVec2::ZERO);
            let turn = DMat2::from_angle(-0.03 * frame as f64);
            for y in 0..SIZE.1 {
                for x in 0..SIZE.0 {
                    let p = turn * (DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5) - origin);
                    let wave = (0.9 * p.x + 0.3 * p.y).sin() * (0.7 * p.y - 0.2 * p.x).cos();
                    let value = (0.5 + 0.3 * wave) * (1.0 + 0.01 * frame as f64);
                    image.at_mut(x, y).fill(value as f32);
                }
            }
            image
        };
        (0..FRAMES).map(picture).collect()
    }

    /// Flow with the same error everywhere.
    fn flow(frames: &[Image], off: DVec2) -> NeighbourFlow {
        let field = |from: usize, to: usize, sign: f64| {
            let mut image = Image::new(SIZE.0, SIZE.1, 2);
            let turn = DMat2::from_angle(-0.03 * from as f64);
            for y in 0..SIZE.1 {
                for x in 0..SIZE.0 {
                    let p = DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5);
                    let first = turn * (p - place(from, DVec2::ZERO));
                    let v = place(to, first) - p + off * sign;
                    image.at_mut(x, y).copy_from_slice(&[v.x as f32, v.y as f32]);
                }
            }
            image
        };
        let forward = (1..FRAMES).map(|to| field(to - 1, to, 1.0)).collect();
        let backward = (1..FRAMES).map(|to| field(to, to - 1, -1.0)).collect();
        let mut source = SuppliedFlow::new(forward, backward).unwrap();
        observe_flow(frames, &mut source, &mut |_| Ok(())).unwrap()
    }

    /// The track of a pixel from flow alone.
    fn chained(flow: &NeighbourFlow, pixel: DVec2) -> PointTrack {
        let mut track = PointTrack::followed(0, vec![pixel], vec![0.0]);
        for k in 1..FRAMES {
            let next = flow.step(k - 1, true, track.pixels[k - 1]).unwrap();
            track.frames.push(k);
            track.pixels.push(next.pixel);
            track.deviation.push(0.2 * (k as f32).sqrt());
        }
        track
    }

    #[test]
    fn a_drifting_chain_is_brought_back() {
        let frames = pictures();
        let flow = flow(&frames, DVec2::new(0.15, -0.1));
        let first = DVec2::new(28.3, 21.6);
        let mut tracks = vec![chained(&flow, first)];
        let last = FRAMES - 1;
        let off = |track: &PointTrack| track.pixels[last].distance(place(last, first));
        let drift = off(&tracks[0]);
        assert!(drift > 1.0, "{drift}");
        refine(&frames, &flow, &mut tracks);
        assert!(off(&tracks[0]) < 0.05, "{}", off(&tracks[0]));
        assert!(tracks[0].deviation[last] < 0.1, "{:?}", tracks[0].deviation);
    }

    #[test]
    fn a_track_goes_on_where_flow_ends() {
        let frames = pictures();
        let flow = flow(&frames, DVec2::ZERO);
        let first = DVec2::new(28.3, 21.6);
        let mut tracks = vec![chained(&flow, first).places(0..4)];
        refine(&frames, &flow, &mut tracks);
        assert_eq!(tracks[0].end(), FRAMES);
        for (frame, pixel) in tracks[0].pixels.iter().enumerate() {
            assert!(pixel.distance(place(frame, first)) < 0.05, "{frame}: {pixel}");
        }
        // The track ends where the images no longer show the point.
        let mut ended = frames.clone();
        ended[6] = Image::new(SIZE.0, SIZE.1, 3);
        let mut tracks = vec![chained(&flow, first).places(0..4)];
        refine(&ended, &flow, &mut tracks);
        assert_eq!(tracks[0].end(), 6);
    }

    #[test]
    fn without_content_or_with_another_the_chain_is_followed() {
        let frames = pictures();
        let flow = flow(&frames, DVec2::ZERO);
        let chain = chained(&flow, DVec2::new(28.3, 21.6));
        let mut blank = vec![Image::new(SIZE.0, SIZE.1, 3); FRAMES];
        let mut tracks = vec![chain.clone()];
        refine(&blank, &flow, &mut tracks);
        for (a, b) in tracks[0].pixels.iter().zip(&chain.pixels) {
            assert!(a.distance(*b) < 1e-6, "{a} {b}");
        }
        // A patch seen in one frame only cannot be found again: the track stays on the flow, with a larger
        // deviation.
        blank[0] = frames[0].clone();
        let mut tracks = vec![chain.clone()];
        refine(&blank, &flow, &mut tracks);
        for (a, b) in tracks[0].pixels.iter().zip(&chain.pixels) {
            assert!(a.distance(*b) < 1e-6, "{a} {b}");
        }
        let last = FRAMES - 1;
        assert!(tracks[0].deviation[1] > chain.deviation[1], "{:?}", tracks[0].deviation);
        assert!(tracks[0].deviation[last].is_finite());
    }
}

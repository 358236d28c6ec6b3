//! A clip without its lens distortion, as a pinhole would have filmed it: frames, flow, tracks and supplied
//! data.

use glam::DVec2;

use super::cameras::Cameras;
use super::rounds::{Known, SoFar};
use super::{Options, binary};
use crate::data::Lens;
use crate::observe::{EstimatedDepth, NeighbourFlow, PointTrack};
use crate::types::{Image, Intrinsics};

/// A clip without its lens distortion.
pub(super) struct Undistorted {
    pub frames: Vec<Image>,
    pub flow: NeighbourFlow,
    /// The tracks that remain inside the undistorted image, in their original order.
    pub tracks: Vec<PointTrack>,
    pub options: Options,
    pub supplied: Option<Vec<Image>>,
}

impl Undistorted {
    /// Removes the distortion of `lens` from the inputs and from the state so far. `cameras` were estimated
    /// with that lens; the new state has the pinhole's cameras.
    pub fn new(
        known: Known,
        lens: &Lens,
        mut cameras: Cameras,
        so_far: SoFar,
    ) -> (Undistorted, SoFar) {
        let pinhole = cameras.intrinsics;
        let undistorted = |image: &Image| lens.undistort(image, &pinhole).0;
        let size = DVec2::new(f64::from(pinhole.width), f64::from(pinhole.height));
        let left = |track: &PointTrack| in_pinhole(track, lens, &pinhole, size);
        let kept: Vec<(usize, PointTrack)> = known
            .tracks
            .iter()
            .enumerate()
            .filter_map(|(i, track)| Some((i, left(track)?)))
            .collect();
        cameras.keep(&kept);
        let SoFar { mut focal, masks, weights, motions, guess, .. } = so_far;
        let zoom = pinhole.fx / lens.intrinsics.fx;
        if focal.held {
            focal.intrinsics = zoomed(&focal.intrinsics, zoom);
        } else {
            focal.intrinsics = pinhole;
        }
        let options = known.options;
        let options = Options {
            intrinsics: options.intrinsics.map(|k| zoomed(&k, zoom)),
            focal: options.focal.map(|focal| zoom * focal),
            depth: options
                .depth
                .as_ref()
                .map(|maps| maps.iter().map(|map| nearest(map, lens, &pinhole)).collect()),
            estimated_depth: options.estimated_depth.as_ref().map(|told| EstimatedDepth {
                maps: told.maps.iter().map(|map| nearest(map, lens, &pinhole)).collect(),
                kind: told.kind,
                confidence: told
                    .confidence
                    .as_ref()
                    .map(|maps| maps.iter().map(|map| nearest(map, lens, &pinhole)).collect()),
            }),
            // The supplied tracks are among the clip's tracks already, and undistorted with them.
            tracks: None,
            ..options.clone()
        };
        let so_far = SoFar {
            focal,
            cameras,
            masks: masks.iter().map(undistorted).collect(),
            weights: kept.iter().map(|(i, _)| weights[*i]).collect(),
            motions,
            guess,
        };
        let supplied = known
            .supplied
            .map(|masks| masks.iter().map(|mask| binary(&undistorted(mask))).collect());
        let clip = Undistorted {
            frames: known.frames.iter().map(undistorted).collect(),
            flow: known.flow.undistorted(lens, &pinhole),
            tracks: kept.into_iter().map(|(_, track)| track).collect(),
            options,
            supplied,
        };
        (clip, so_far)
    }

    pub fn known(&self) -> Known<'_> {
        Known {
            frames: &self.frames,
            options: &self.options,
            flow: &self.flow,
            tracks: &self.tracks,
            supplied: self.supplied.as_deref(),
        }
    }
}

fn zoomed(k: &Intrinsics, zoom: f64) -> Intrinsics {
    Intrinsics { fx: zoom * k.fx, fy: zoom * k.fy, ..*k }
}

/// The longest part of a track that is inside the pinhole's image; `None` if it is shorter than two frames.
fn in_pinhole(
    track: &PointTrack,
    lens: &Lens,
    pinhole: &Intrinsics,
    size: DVec2,
) -> Option<PointTrack> {
    let inside = |p: &DVec2| p.cmpge(DVec2::ZERO).all() && p.cmple(size).all();
    let pixels: Vec<Option<DVec2>> =
        track.pixels.iter().map(|p| lens.undistort_pixel(pinhole, *p).filter(inside)).collect();
    let mut longest = 0..0;
    let mut begin = 0;
    for k in 0..=pixels.len() {
        if k == pixels.len() || pixels[k].is_none() {
            if k - begin > longest.len() {
                longest = begin..k;
            }
            begin = k + 1;
        }
    }
    if longest.len() < 2 {
        return None;
    }
    let part = track.places(longest.clone());
    Some(PointTrack { pixels: pixels[longest].iter().flatten().copied().collect(), ..part })
}

/// Undistorts a map by nearest neighbour, for maps whose values must not be interpolated.
fn nearest(map: &Image, lens: &Lens, pinhole: &Intrinsics) -> Image {
    let mut out = Image::new(map.width, map.height, map.channels);
    for y in 0..map.height {
        for x in 0..map.width {
            let at =
                lens.distort_pixel(pinhole, DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5));
            let from = |v: f64, side: u32| (v.max(0.0) as u32).min(side - 1);
            let source = map.at(from(at.x, map.width), from(at.y, map.height));
            out.at_mut(x, y).copy_from_slice(source);
        }
    }
    out
}

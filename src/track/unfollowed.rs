//! Parts of movers on which no point could be tracked: for example an object that a tracked person holds and
//! waves, too fast or too uniform for flow.
//!
//! Such a part would get the depth of the nearest tracked point, which belongs to another object. It is
//! identified by its distance from all tracked points, and its boundary is placed at image edges.

use std::cmp::Reverse;
use std::collections::BinaryHeap;

use glam::DVec2;
use rayon::prelude::*;

use super::masks::regions;
use super::quantile;
use crate::types::Image;

/// Distance from every tracked point, in spacings of the points, beyond which a pixel is not tracked.
const FAR: f64 = 4.0;
/// Minimum median share, over the frames, of untracked pixels among the movers that have tracked points, for
/// these pixels to count as a separate part. On fully tracked movers the share is at most a fifth.
const LEAST_SHARE: f64 = 0.3;
/// Cost of a step from pixel to pixel, in addition to the change of colour (the sum over the channels).
const STEP: f32 = 0.05;

/// By frame and pixel, whether it belongs to an untracked part of a mover. `points` are the tracked points of
/// each frame, `spacing` is their initial spacing in pixels. A mask region without a tracked point counts if
/// more than half of it lies in the part in the previous or the next frame. `None` if there is no such part.
pub(super) fn find(
    frames: &[Image],
    masks: &[Image],
    points: &[Vec<DVec2>],
    spacing: f64,
) -> Option<Vec<Vec<bool>>> {
    let found: Vec<Vec<MaskRegion>> = masks
        .par_iter()
        .zip(points)
        .map(|(mask, points)| mask_regions(mask, points, FAR * spacing))
        .collect();
    let followed = |regions: &[MaskRegion]| {
        let of = |count: fn(&MaskRegion) -> usize| -> usize {
            regions.iter().filter(|region| !region.seeds.is_empty()).map(count).sum()
        };
        let all = of(|region| region.pixels.len());
        (all > 0).then(|| of(|region| region.far.len()) as f64 / all as f64)
    };
    let shares: Vec<f64> = found.iter().filter_map(|regions| followed(regions)).collect();
    if shares.is_empty() || quantile(shares, 0.5) < LEAST_SHARE {
        return None;
    }
    let parts = frames.par_iter().zip(&found).map(|(frame, regions)| {
        let mut part = vec![false; frame.width as usize * frame.height as usize];
        regions.iter().for_each(|region| region.spread(frame, &mut part));
        part
    });
    let mut parts: Vec<Vec<bool>> = parts.collect();
    let alone: Vec<Vec<&MaskRegion>> = found
        .iter()
        .enumerate()
        .map(|(frame, regions)| {
            let beside = [frame.checked_sub(1), Some(frame + 1)];
            let beside = beside.map(|other| other.and_then(|other| parts.get(other)));
            let in_part = |i: &&usize| beside.iter().flatten().any(|part| part[**i]);
            let goes_on = |region: &&MaskRegion| {
                let inside = region.pixels.iter().filter(in_part).count();
                region.seeds.is_empty() && 2 * inside > region.pixels.len()
            };
            regions.iter().filter(goes_on).collect()
        })
        .collect();
    for (part, regions) in parts.iter_mut().zip(alone) {
        regions.into_iter().flat_map(|region| &region.pixels).for_each(|i| part[*i] = true);
    }
    Some(parts)
}

/// A region of a mask.
struct MaskRegion {
    pixels: Vec<usize>,
    /// Pixels with a tracked point. Regions without one are handled by another rule.
    seeds: Vec<usize>,
    /// Pixels far from all tracked points.
    far: Vec<usize>,
}

fn mask_regions(mask: &Image, points: &[DVec2], far: f64) -> Vec<MaskRegion> {
    let (w, h) = (mask.width as usize, mask.height as usize);
    let mut seeded = vec![false; w * h];
    for p in points {
        let (x, y) = ((p.x.max(0.0) as usize).min(w - 1), (p.y.max(0.0) as usize).min(h - 1));
        seeded[y * w + x] = true;
    }
    let centre = |i: usize| DVec2::new((i % w) as f64 + 0.5, (i / w) as f64 + 0.5);
    let is_far = |i: &usize| points.iter().all(|p| p.distance_squared(centre(*i)) > far * far);
    regions(&mask.pixels, w, true)
        .into_iter()
        .map(|(pixels, _)| {
            let seeds = pixels.iter().copied().filter(|i| seeded[*i]).collect();
            let far = pixels.iter().copied().filter(is_far).collect();
            MaskRegion { pixels, seeds, far }
        })
        .collect()
}

impl MaskRegion {
    /// Marks the pixels that the far pixels reach at lower cost than the tracked points do. Marks none if
    /// there is no tracked point.
    fn spread(&self, frame: &Image, part: &mut [bool]) {
        if self.seeds.is_empty() {
            return;
        }
        let w = frame.width as usize;
        let colour = |i: usize| &frame.pixels[frame.channels as usize * i..][..3];
        let mut inside = vec![false; part.len()];
        self.pixels.iter().for_each(|i| inside[*i] = true);
        // Costs are not negative, so their bit patterns have the same order as their values.
        let mut queue: BinaryHeap<Reverse<(u32, usize, bool)>> = BinaryHeap::new();
        for (pixels, is_part) in [(&self.seeds, false), (&self.far, true)] {
            queue.extend(pixels.iter().map(|i| Reverse((0, *i, is_part))));
        }
        while let Some(Reverse((bits, i, is_part))) = queue.pop() {
            if !std::mem::take(&mut inside[i]) {
                continue;
            }
            part[i] = is_part;
            let x = i % w;
            let neighbours = [
                (x > 0).then(|| i - 1),
                (x + 1 < w).then_some(i + 1),
                i.checked_sub(w),
                (i + w < part.len()).then_some(i + w),
            ];
            for j in neighbours.into_iter().flatten().filter(|j| inside[*j]) {
                let change: f32 = colour(i).iter().zip(colour(j)).map(|(a, b)| (a - b).abs()).sum();
                let cost = f32::from_bits(bits) + STEP + change.clamp(0.0, 3.0);
                queue.push(Reverse((cost.to_bits(), j, is_part)));
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::sliding::*;
    use super::*;

    /// A mover, grey to the left of x = 40 and green to the right, with points on the part that `points`
    /// selects.
    fn scene(points: impl Fn(DVec2) -> bool) -> (Vec<Image>, Vec<Image>, Vec<Vec<DVec2>>) {
        let mut frame = Image::new(WIDTH, HEIGHT, 3);
        for (i, pixel) in frame.pixels.chunks_exact_mut(3).enumerate() {
            let green = centre(i).x > 40.0;
            pixel.copy_from_slice(if green { &[0.1, 0.8, 0.2] } else { &[0.4, 0.4, 0.4] });
        }
        let mask = map(|p| f32::from(u8::from(within(p, (8.0, 4.0), (60.0, 36.0)))));
        let points = (0..(WIDTH * HEIGHT) as usize)
            .map(centre)
            .filter(|p| p.x as u32 % 4 == 1 && p.y as u32 % 4 == 1)
            .filter(|p| within(*p, (8.0, 4.0), (60.0, 36.0)) && points(*p))
            .collect();
        (vec![frame; 3], vec![mask; 3], vec![points; 3])
    }

    #[test]
    fn a_part_without_points_ends_at_the_edge_in_the_picture() {
        // The points end well before the colour edge.
        let (frames, masks, points) = scene(|p| p.x < 34.0);
        let parts = find(&frames, &masks, &points, 2.0).expect("a part is not followed");
        for part in &parts {
            for (i, is_part) in part.iter().enumerate() {
                let p = centre(i);
                let inside = within(p, (8.0, 4.0), (60.0, 36.0));
                assert_eq!(*is_part, inside && p.x > 40.0, "{p}");
            }
        }
    }

    #[test]
    fn what_is_followed_has_no_such_part() {
        let (frames, masks, points) = scene(|_| true);
        assert!(find(&frames, &masks, &points, 2.0).is_none());
        // A sixth of the mover is too little.
        let (frames, masks, points) = scene(|p| p.x < 46.0);
        assert!(find(&frames, &masks, &points, 2.0).is_none());
        // Without any point nothing is known of the region, and another rule handles it.
        let (frames, masks, points) = scene(|_| false);
        assert!(find(&frames, &masks, &points, 2.0).is_none());
    }

    #[test]
    fn a_region_without_points_is_the_part_of_the_frames_around() {
        let (frames, mut masks, mut points) = scene(|p| p.x < 34.0);
        // In the middle frame only the green part remains, and a region elsewhere.
        masks[1] = map(|p| {
            let left = within(p, (42.0, 4.0), (60.0, 36.0)) || within(p, (0.0, 4.0), (6.0, 36.0));
            f32::from(u8::from(left))
        });
        points[1].clear();
        let parts = find(&frames, &masks, &points, 2.0).expect("a part is not followed");
        for (i, is_part) in parts[1].iter().enumerate() {
            let p = centre(i);
            assert_eq!(*is_part, within(p, (42.0, 4.0), (60.0, 36.0)), "{p}");
        }
    }
}

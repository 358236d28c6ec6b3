//! What a mover stands on or passes in front of: the static world around its lower end.

use glam::{DMat3, DVec2, DVec3};

use super::distance::Behind;
use super::quantile;

/// Maximum height of the lower edge above the lower hull, as a share of the object's height and at least in
/// pixels. Higher parts of the edge are seen between two feet.
const NOTCH: (f64, f64) = (0.03, 3.0);
/// Overhang of masks, pixels.
const OVERHANG: f64 = 1.0;
/// Extent of the region around a contact to which the plane of the ground is fitted: to each side in widths
/// of the object, up and down in its heights, and the minimum number of pixels.
const GROUND: (f64, f64) = (0.3, 0.4);
const GROUND_PIXELS: usize = 40;
/// Maximum relative difference of inverse depth of a pixel on the plane, and the minimum share of pixels on
/// it.
const ON_GROUND: (f64, f64) = (0.05, 0.6);
/// Weight of a pixel with filled-in depth; a measured pixel has a weight up to 0.5.
const UNMEASURED: f64 = 0.01;
/// Relative difference in inverse depth between the ground and the pixels next to a contact above which those
/// pixels hide the object's lower end.
const HIDES: f64 = 0.2;
/// Maximum difference of the logarithm of depth between the plane around a contact and the ground of the whole
/// clip.
const SAME_GROUND: f64 = 0.05;
/// Minimum change of the ground's inverse depth over the height of the image, relative to its value at the
/// contact.
const SLOPE: f64 = 0.7;

/// The contact of an object with static ground.
#[derive(Clone, Copy)]
pub(super) struct Contact {
    /// Depth of the ground.
    pub depth: f64,
    pub pixel: DVec2,
    /// Half of the object's width there, pixels.
    pub half_width: f64,
}

/// The surroundings of an object's lower end in a frame.
#[derive(Clone, Copy)]
pub(super) enum LowerEnd {
    /// Ground, at the point where the object would touch it.
    Touches(Contact),
    /// A wall or another upright surface at this depth: the object is in the air in front of it, or behind
    /// it.
    Wall(f64),
    /// The image border cuts the object off, above ground of this depth.
    CutOff(f64),
}

/// Determines the surroundings of an object's lower end; `None` if the lower end is hidden, or if the
/// surroundings are not a plane.
pub(super) fn lower_end(
    index: usize,
    owners: &[Option<u16>],
    behind: Behind<'_>,
    width: usize,
) -> Option<LowerEnd> {
    let height = owners.len() / width;
    let own = |i: usize| owners[i] == Some(index as u16);
    let mut lowest: Vec<(usize, usize)> = Vec::new();
    let (mut top, mut bottom) = (usize::MAX, 0);
    for x in 0..width {
        let mut column = (0..height).filter(|y| own(y * width + x));
        let Some(first) = column.next() else { continue };
        let last = column.next_back().unwrap_or(first);
        (top, bottom) = (top.min(first), bottom.max(last));
        lowest.push((x, last));
    }
    if lowest.len() < 3 {
        return None;
    }
    let ends = (lowest[0].0, lowest[lowest.len() - 1].0);
    let beside = (GROUND.0 * (ends.1 - ends.0) as f64) as usize;
    let up = ((GROUND.1 * (bottom - top) as f64) as usize).max(4);
    let columns = ends.0.saturating_sub(beside)..=(ends.1 + beside).min(width - 1);
    let rows = bottom.saturating_sub(up)..=(bottom + up).min(height - 1);
    let static_pixels = || {
        let row = |y: usize| columns.clone().map(move |x| (x, y));
        rows.clone().flat_map(row).filter(|(x, y)| owners[y * width + x].is_none())
    };
    // Ground is seen from above: its depth decreases from the horizon downwards.
    let is_ground = |plane: &DVec3| plane.y * height as f64 > SLOPE * plane.z;
    // Masks overhang by a pixel or two.
    if bottom + 3 >= height {
        lowest.retain(|at| at.1 + 3 >= height);
        let at = DVec2::new(lowest[lowest.len() / 2].0 as f64, height as f64 - 0.5);
        let ground = plane(static_pixels(), behind, width, at)?;
        return (ground.z > 0.0 && is_ground(&ground)).then(|| LowerEnd::CutOff(1.0 / ground.z));
    }
    let band = (0.06 * (bottom - top) as f64).max(2.0) as usize;
    let below = |(x, y): (usize, usize)| (y + 2) * width + x;
    lowest.retain(|at| at.1 + band >= bottom && owners[below(*at)].is_none());
    // The object stands on what is near the lower hull, not on what is visible between two feet or wheels.
    let edge = lowest.clone();
    let notch = (NOTCH.0 * (bottom - top) as f64).max(NOTCH.1);
    lowest.retain(|at| at.1 as f64 + notch >= lower_hull(&edge, at.0));
    let x = lowest.get(lowest.len() / 2)?.0;
    let y = lower_hull(&edge, x);
    let at = DVec2::new(x as f64, y + 0.5 - OVERHANG);
    let plane = plane(static_pixels(), behind, width, at)?;
    let (inverse, slope) = (plane.z, plane.y);
    // Something that hides the lower end is not at the depth of the ground.
    let seen = lowest.iter().map(|at| f64::from(behind.inverse[below(*at)]));
    let next_to_it = quantile(seen.collect(), 0.5);
    let agrees = (next_to_it / (inverse + slope * (1.5 + OVERHANG))).ln().abs() < HIDES;
    if inverse <= 0.0 || !agrees {
        return None;
    }
    // Around a mover the ground is often hidden, or a shadow moves on it. The plane of the whole clip is more
    // accurate than the one around the object, if both are the same ground.
    let of_clip = behind.ground.map(|ground| ground.dot((at + 0.5).extend(1.0)));
    let same = |of_clip: &f64| *of_clip > 0.0 && (of_clip / inverse).ln().abs() < SAME_GROUND;
    let depth = 1.0 / of_clip.filter(same).unwrap_or(inverse);
    Some(if is_ground(&plane) {
        let pixel = DVec2::new(x as f64 + 0.5, y + 0.5);
        let half_width = 0.5 * (ends.1 - ends.0 + 1) as f64;
        LowerEnd::Touches(Contact { depth, pixel, half_width })
    } else {
        LowerEnd::Wall(depth)
    })
}

/// The row at column `x` of the lower hull of an object's `lowest` pixels. Between two feet it is the line
/// from one to the other.
fn lower_hull(lowest: &[(usize, usize)], x: usize) -> f64 {
    let at = x as f64;
    let points = || lowest.iter().map(|(x, y)| DVec2::new(*x as f64, *y as f64));
    let here = points().filter(|p| p.x == at).map(|p| p.y);
    let left = || points().filter(|p| p.x < at);
    let between = left().flat_map(|a| {
        points().filter(|b| b.x > at).map(move |b| a.y + (b.y - a.y) * (at - a.x) / (b.x - a.x))
    });
    here.chain(between).fold(0.0, f64::max)
}

/// Fits the plane that most pixels of measured depth lie on; on a plane inverse depth is linear in the pixel.
/// Returns the slopes in x and y and the value at the pixel `at`. `None` for too few pixels, or if they do
/// not lie on one plane.
fn plane(
    pixels: impl Iterator<Item = (usize, usize)>,
    behind: Behind<'_>,
    width: usize,
    at: DVec2,
) -> Option<DVec3> {
    let samples: Vec<(DVec3, f64, f64)> = pixels
        .map(|(x, y)| {
            let i = y * width + x;
            let weight = (f64::from(behind.confidence[i]) - 0.5).max(UNMEASURED);
            let off = DVec2::new(x as f64, y as f64) - at;
            (off.extend(1.0), f64::from(behind.inverse[i]), weight)
        })
        .collect();
    if samples.len() < GROUND_PIXELS {
        return None;
    }
    let mut plane = DVec3::ZERO;
    let mut spread = f64::INFINITY;
    for _ in 0..10 {
        let (mut products, mut right) = (DMat3::ZERO, DVec3::ZERO);
        for (row, value, weight) in &samples {
            let off = (value - plane.dot(*row)) / spread;
            let weight = weight / (1.0 + off * off).powi(2);
            products += DMat3::from_cols(*row * row.x, *row * row.y, *row * row.z) * weight;
            right += *row * (weight * value);
        }
        plane = products.inverse() * right;
        if !plane.is_finite() {
            return None;
        }
        let off = samples.iter().map(|(row, value, _)| (value - plane.dot(*row)).abs()).collect();
        spread = (2.0 * quantile(off, 0.5)).max(1e-4 * plane.z.abs());
    }
    let total: f64 = samples.iter().map(|sample| sample.2).sum();
    let on = samples.iter().filter(|(row, value, _)| {
        let expected = plane.dot(*row);
        (value - expected).abs() < ON_GROUND.0 * expected
    });
    (on.map(|sample| sample.2).sum::<f64>() > ON_GROUND.1 * total).then_some(plane)
}

#[cfg(test)]
mod tests {
    use super::super::sliding::*;
    use super::*;
    use crate::types::Image;

    /// Ground seen by a camera above it, with some wrong measurements, and with hiding objects in places.
    fn ground(hides: impl Fn(DVec2) -> bool) -> (Image, Image) {
        let inverse = map(|p| match (p.x as usize * 7 + p.y as usize * 3) % 5 {
            _ if hides(p) => 1.4,
            0 => 0.9,
            _ => 0.1 + 0.02 * p.y as f32,
        });
        (inverse, map(|_| 0.9))
    }

    #[test]
    fn an_object_touches_the_ground_at_its_lower_end() {
        let (w, h) = (WIDTH as usize, HEIGHT as usize);
        let object = |bottom: f64| -> Vec<Option<u16>> {
            let on = |i| within(centre(i), (20.0, 8.0), (30.0, bottom));
            (0..w * h).map(|i| on(i).then_some(0)).collect()
        };
        let (inverse, confidence) = ground(|_| false);
        let behind =
            Behind { inverse: &inverse.pixels, confidence: &confidence.pixels, ground: None };
        let touches = |owners: &[Option<u16>]| match lower_end(0, owners, behind, w) {
            Some(LowerEnd::Touches(contact)) => contact,
            _ => panic!("it touches nothing"),
        };
        let unknown = |index: usize, owners: &[Option<u16>], behind: Behind<'_>| {
            lower_end(index, owners, behind, w).is_none()
        };
        let Contact { depth, pixel, half_width } = touches(&object(30.0));
        assert_eq!(half_width, 5.0);
        // The contact is at the lower edge of the row above the last row of the mask.
        assert!((1.0 / depth / (0.1 + 0.02 * 29.0) - 1.0).abs() < 0.01, "{depth}");
        assert_eq!(pixel.y, 29.5);
        let Some(LowerEnd::CutOff(at_edge)) = lower_end(0, &object(39.0), behind, w) else {
            panic!("it is cut off")
        };
        assert!((1.0 / at_edge / (0.1 + 0.02 * HEIGHT as f64) - 1.0).abs() < 0.02, "{at_edge}");
        assert!(unknown(1, &object(30.0), behind));
        // Between two feet the mask ends higher.
        let mut feet = object(30.0);
        for i in (0..w * h).filter(|i| within(centre(*i), (22.0, 26.0), (28.0, 30.0))) {
            feet[i] = None;
        }
        let contact = touches(&feet);
        assert!((contact.depth / depth - 1.0).abs() < 1e-6 && contact.pixel.y == 29.5);
        assert!(!(22.0..28.0).contains(&contact.pixel.x), "{}", contact.pixel.x);
        // A car's sill is two pixels above its wheels; the car stands on the line between these.
        let mut car = object(30.0);
        for i in (0..w * h).filter(|i| within(centre(*i), (21.0, 28.0), (29.0, 30.0))) {
            car[i] = None;
        }
        let contact = touches(&car);
        assert!((contact.depth / depth - 1.0).abs() < 1e-6 && contact.pixel.y == 29.5);
        assert!((21.0..29.0).contains(&contact.pixel.x), "{}", contact.pixel.x);
        // The ground of the whole clip is used if it is nearly the same.
        for (factor, used) in [(1.04, 1.04), (0.97, 0.97), (1.2, 1.0)] {
            let plane = DVec3::new(0.0, 0.02, 0.1) * factor;
            let Some(LowerEnd::Touches(contact)) =
                lower_end(0, &object(30.0), Behind { ground: Some(plane), ..behind }, w)
            else {
                panic!("it touches nothing")
            };
            assert!((depth / contact.depth / used - 1.0).abs() < 0.01, "{factor}");
        }
        // A box stands in front of the object's lower end.
        let (inverse, confidence) = ground(|p| within(p, (16.0, 29.0), (36.0, 40.0)));
        let behind =
            Behind { inverse: &inverse.pixels, confidence: &confidence.pixels, ground: None };
        assert!(unknown(0, &object(30.0), behind), "it is hidden");
        // A wall is not ground.
        let wall = map(|_| 0.5);
        let behind = Behind { inverse: &wall.pixels, confidence: &confidence.pixels, ground: None };
        let Some(LowerEnd::Wall(depth)) = lower_end(0, &object(30.0), behind, w) else {
            panic!("it is before a wall")
        };
        assert!((depth - 2.0).abs() < 1e-3, "{depth}");
    }

    #[test]
    fn the_lower_hull_goes_from_foot_to_foot() {
        let lowest = [(0, 10), (1, 10), (2, 4), (3, 3), (4, 8), (5, 6)];
        let hull: Vec<f64> = lowest.iter().map(|(x, _)| lower_hull(&lowest, *x)).collect();
        for (found, expected) in hull.iter().zip([10.0, 10.0, 28.0 / 3.0, 26.0 / 3.0, 8.0, 6.0]) {
            assert!((found - expected).abs() < 1e-9, "{hull:?}");
        }
    }
}

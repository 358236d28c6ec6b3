//! Measurements from the outline of a mover: its middle, and its distance up to one scale.
//!
//! An object of constant size covers a solid angle that falls with the square of its distance, from whichever
//! direction it is seen. The code uses solid angles, not pixels: a wide-angle lens images the same object
//! larger near the image border.

use super::contour::{Region, Side};
use super::disc::{Disc, disc};
use super::distance::Behind;
use super::quantile;
use crate::types::Intrinsics;
use glam::{DVec2, DVec3};

/// Distance from the image border within which an outline counts as cut off, pixels.
const EDGE: f64 = 2.0;
/// An outline is partly hidden if more than this share of its contour borders on another mover, or on static
/// objects in front of it.
const OPEN: f64 = 0.05;
/// Minimum area of an outline, pixels. Smaller outlines consist mostly of mask errors.
const LEAST: usize = 30;

/// Standard deviation of the logarithm of depth of an outline of constant shape; the mask limits it.
const SHARP: f64 = 0.015;
/// The same for an outline that changes its shape, or with too few observations to judge it.
const CHANGES: f64 = 0.1;
/// Minimum number of outlines from which the change of shape is measured.
const JUDGED: usize = 5;
/// Distance from the first to the last decile of a normal distribution, in standard deviations.
const NORMAL_SPREAD: f64 = 2.563;

/// An outline that is completely visible.
#[derive(Clone, Copy, Debug)]
pub(super) struct Outline {
    /// Pixel of the outline's middle.
    pub middle: DVec2,
    /// Depth (z) of its middle, in a unit that depends on the object's size.
    pub depth: f64,
    /// Logarithm of the ratio of length to width of the ellipse with the same second moments.
    pub slenderness: f64,
}

/// The outlines of an object, frame by frame.
pub(super) struct Outlines {
    /// `None` in frames in which the outline is not completely visible.
    pub frames: Vec<Option<Outline>>,
    /// Standard deviation of the logarithm of their depths.
    pub deviation: f64,
    /// What is seen of the object if it is a ball; `None` in frames that show too little of its contour.
    pub discs: Vec<Option<Disc>>,
}

impl Outlines {
    /// The outlines of the object `index`, from the owners of the pixels and the static world in each of its
    /// frames.
    pub fn new(
        index: u16,
        owners: &[Vec<Option<u16>>],
        behind: &[Behind<'_>],
        intrinsics: &Intrinsics,
    ) -> Outlines {
        let in_frame = |(owners, behind): (&Vec<Option<u16>>, &Behind<'_>)| {
            let region = Region::new(index, owners, behind.inverse, intrinsics.width as usize);
            (outline(&region, intrinsics), disc(&region, intrinsics))
        };
        let (frames, discs): (Vec<Option<Outline>>, _) =
            owners.iter().zip(behind).map(in_frame).unzip();
        Outlines { deviation: deviation(&frames), frames, discs }
    }

    /// Outlines that are never completely visible.
    #[cfg(test)]
    pub fn unknown(frames: usize) -> Outlines {
        Outlines { frames: vec![None; frames], deviation: CHANGES, discs: vec![None; frames] }
    }
}

/// The outline of an object's pixels in a frame; `None` if it is cut off, partly hidden or too small.
fn outline(region: &Region, intrinsics: &Intrinsics) -> Option<Outline> {
    let cut = |p: &DVec2| {
        let size = DVec2::new(f64::from(intrinsics.width), f64::from(intrinsics.height));
        p.min(size - *p).min_element() < EDGE
    };
    let count = |side: Side| {
        let sides = region.sides.iter().flatten();
        sides.filter(|s| **s == side).count() as f64
    };
    let (hidden, open) = (count(Side::Hidden), count(Side::Open));
    let whole = open <= OPEN * (open + hidden) && !region.centres.iter().any(cut);
    if region.pixels.len() < LEAST || !whole {
        return None;
    }
    // Each pixel's direction and its solid angle: its area over the product of the focal lengths, times the
    // cube of the cosine.
    let seen = || {
        region.centres.iter().map(|p| {
            let ray = intrinsics.ray(*p);
            let cosine = ray.length().recip();
            (ray * cosine, cosine.powi(3) / (intrinsics.fx * intrinsics.fy))
        })
    };
    let angle: f64 = seen().map(|(_, solid)| solid).sum();
    let middle = seen().map(|(ray, solid)| solid * ray).sum::<DVec3>().try_normalize()?;
    let (right, down) = middle.any_orthonormal_pair();
    let (mut xx, mut xy, mut yy) = (0.0, 0.0, 0.0);
    for (ray, solid) in seen() {
        let (x, y) = (right.dot(ray), down.dot(ray));
        (xx, xy, yy) = (xx + solid * x * x, xy + solid * x * y, yy + solid * y * y);
    }
    let (half, off) = (0.5 * (xx + yy), (0.5 * (xx - yy)).hypot(xy));
    Some(Outline {
        middle: intrinsics.project(middle),
        depth: middle.z / angle.sqrt(),
        slenderness: 0.5 * ((half + off) / (half - off).max(1e-12 * half)).ln(),
    })
}

/// Standard deviation of the logarithm of the depths from outlines. The apparent size of an object that
/// rotates or deforms varies, and its slenderness varies with it.
fn deviation(outlines: &[Option<Outline>]) -> f64 {
    let slenderness: Vec<f64> = outlines.iter().flatten().map(|o| o.slenderness).collect();
    if slenderness.len() < JUDGED {
        return CHANGES;
    }
    let spread = quantile(slenderness.clone(), 0.9) - quantile(slenderness, 0.1);
    (spread / NORMAL_SPREAD).hypot(SHARP).min(CHANGES)
}

#[cfg(test)]
mod tests {
    use super::*;

    const INTRINSICS: Intrinsics =
        Intrinsics { fx: 150.0, fy: 150.0, cx: 100.0, cy: 60.0, width: 200, height: 120 };

    /// The outline of object 3, in front of a far wall.
    fn outline_of(owners: &[Option<u16>]) -> Option<Outline> {
        outline(&Region::new(3, owners, &vec![0.1; owners.len()], 200), &INTRINSICS)
    }

    /// The pixels that show a ball.
    fn ball(centre: DVec3, radius: f64) -> Vec<Option<u16>> {
        let shows = |i: usize| {
            let pixel = DVec2::new((i % 200) as f64 + 0.5, (i / 200) as f64 + 0.5);
            let ray = INTRINSICS.ray(pixel).normalize();
            (centre - ray * ray.dot(centre)).length() < radius
        };
        (0..200 * 120).map(|i| shows(i).then_some(3)).collect()
    }

    #[test]
    fn a_ball_is_as_far_as_it_looks_small() {
        let at =
            [DVec3::new(0.0, 0.0, 2.0), DVec3::new(-1.9, 0.6, 4.0), DVec3::new(1.2, -0.5, 3.0)];
        let found = at.map(|centre| outline_of(&ball(centre, 0.3)).unwrap());
        for (centre, outline) in at.iter().zip(&found) {
            let unit = outline.depth * at[0].z / found[0].depth;
            assert!((unit / centre.z - 1.0).abs() < 0.02, "{centre}: {unit}");
            let off = outline.middle.distance(INTRINSICS.project(*centre));
            assert!(off < 0.5, "{centre}: {off}");
            assert!(outline.slenderness < 0.03, "{centre}: {}", outline.slenderness);
        }
    }

    #[test]
    fn what_is_cut_off_or_hidden_tells_nothing() {
        let whole = ball(DVec3::new(0.0, 0.0, 2.0), 0.3);
        assert!(outline_of(&whole).is_some());
        assert!(outline_of(&[None; 200 * 120]).is_none());
        assert!(outline_of(&ball(DVec3::new(0.0, 0.75, 2.0), 0.3)).is_none());
        let mut hidden = whole.clone();
        hidden.iter_mut().enumerate().filter(|(i, _)| i % 200 > 105).for_each(|(_, o)| {
            if o.is_some() {
                *o = Some(1);
            }
        });
        assert!(outline_of(&hidden).is_none());
        // A post stands directly beside the ball, in front of the wall.
        let behind: Vec<f32> =
            (0..200 * 120).map(|i| if i % 200 > 122 { 0.8 } else { 0.1 }).collect();
        let beside = outline(&Region::new(3, &whole, &behind, 200), &INTRINSICS);
        assert!(beside.is_none());
    }

    #[test]
    fn an_outline_that_changes_its_shape_tells_less() {
        let with = |slenderness| Some(Outline { middle: DVec2::ZERO, depth: 1.0, slenderness });
        let sharp: Vec<_> = (0..9).map(|k| with(0.3 + 0.001 * f64::from(k))).collect();
        assert!((deviation(&sharp) - SHARP).abs() < 0.001);
        let turning: Vec<_> = (0..9).map(|k| with(0.02 * f64::from(k))).collect();
        assert!((0.04..0.08).contains(&deviation(&turning)), "{}", deviation(&turning));
        let tumbling: Vec<_> = (0..9).map(|k| with(0.1 * f64::from(k))).collect();
        assert_eq!(deviation(&tumbling), CHANGES);
        assert_eq!(deviation(&sharp[..4]), CHANGES);
    }
}

//! The position of a ball relative to its radius, from its contour in one frame.
//!
//! The rays that touch a sphere form a circular cone about the ray to its centre. With m the direction of the axis
//! over the cosine of the cone's half angle, every such ray u, of length one, has u · m = 1. These equations are
//! linear, and a part of the contour is enough for them: a ball that the image border cuts off, or that something
//! hides in part, is located as well.

use glam::{DMat3, DVec2, DVec3};

use super::contour::{Region, Side};
use super::quantile;
use crate::types::Intrinsics;

/// Distance from the image border within which a contour is the border's, pixels.
const EDGE: f64 = 2.0;
/// Minimum number of sides of pixels on the contour.
const LEAST: usize = 20;
/// Width of the robust kernel, and the standard deviation of a side of the contour, pixels.
const SHARP: (f64, f64) = (1.0, 0.5);
/// Number of rounds of reweighting.
const ROUNDS: usize = 10;
/// Maximum standard deviation of the logarithm of the distance.
const CERTAIN: f64 = 0.05;
/// Maximum median distance of a circle's contour from the circle, as a share of its radius plus pixels.
const CIRCLE: (f64, f64) = (0.015, 0.25);

/// What is seen of an object in one frame if it is a ball.
#[derive(Clone, Copy, Debug)]
pub(super) struct Disc {
    /// The centre in the camera frame, in radii.
    pub centre: DVec3,
    /// Whether the contour is a circle.
    pub round: bool,
}

/// The disc of an object; `None` if too little of its contour is visible.
pub(super) fn disc(region: &Region, intrinsics: &Intrinsics) -> Option<Disc> {
    let size = DVec2::new(f64::from(intrinsics.width), f64::from(intrinsics.height));
    let sides = region.centres.iter().zip(&region.sides).flat_map(|(centre, sides)| {
        let across = [DVec2::NEG_X, DVec2::X, DVec2::NEG_Y, DVec2::Y];
        let hidden = sides.iter().zip(across).filter(|(side, _)| **side == Side::Hidden);
        hidden.map(|(_, across)| *centre + 0.5 * across)
    });
    let rays: Vec<DVec3> = sides
        .filter(|p| p.min(size - *p).min_element() > EDGE)
        .map(|p| intrinsics.ray(p).normalize())
        .collect();
    if rays.len() < LEAST {
        return None;
    }
    let mut weights = vec![1.0; rays.len()];
    let mut found = None;
    for _ in 0..ROUNDS {
        let (mut information, mut right) = (DMat3::ZERO, DVec3::ZERO);
        for (ray, weight) in rays.iter().zip(&weights) {
            information += DMat3::from_cols(*ray * ray.x, *ray * ray.y, *ray * ray.z) * *weight;
            right += *ray * *weight;
        }
        let inverse = information.inverse();
        let cone = Cone::of(inverse * right)?;
        // A ray that is off by an angle changes u · m by the tangent of the half angle times that angle.
        let pixel = cone.sine / cone.cosine / intrinsics.fx;
        let off: Vec<f64> =
            rays.iter().map(|ray| (ray.dot(cone.axis) / cone.cosine - 1.0) / pixel).collect();
        weights = off.iter().map(|off| (1.0 + (off / SHARP.0).powi(2)).recip()).collect();
        found = Some((cone, inverse, pixel, off));
    }
    let (cone, inverse, pixel, off) = found?;
    // The deviation of the logarithm of the distance, from independent errors of the sides.
    let deviation = {
        let length = cone.axis.dot(inverse * cone.axis).max(0.0).sqrt() * pixel * SHARP.1;
        // The half angle a has the cosine 1 / |m|, and the distance is 1 / sin a.
        length * cone.cosine.powi(3) / cone.sine.powi(2)
    };
    let radius = cone.sine * intrinsics.fx;
    let usual = quantile(off.iter().map(|off| off.abs()).collect(), 0.5);
    (deviation < CERTAIN).then_some(Disc {
        centre: cone.axis / cone.sine,
        round: usual < CIRCLE.0 * radius + CIRCLE.1,
    })
}

/// A circular cone around its axis, with the sine and the cosine of its half angle.
struct Cone {
    axis: DVec3,
    sine: f64,
    cosine: f64,
}

impl Cone {
    /// The cone from the direction of its axis over the cosine of its half angle.
    fn of(scaled: DVec3) -> Option<Cone> {
        let cosine = scaled.length_recip();
        let sine = (1.0 - cosine * cosine).sqrt();
        (sine > 0.0).then_some(Cone { axis: scaled * cosine, sine, cosine })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const INTRINSICS: Intrinsics =
        Intrinsics { fx: 150.0, fy: 150.0, cx: 100.0, cy: 60.0, width: 200, height: 120 };

    /// The region of the pixels that are `inside`.
    fn region(inside: impl Fn(DVec2) -> bool) -> Region {
        let owner = |i: usize| {
            let pixel = DVec2::new((i % 200) as f64 + 0.5, (i / 200) as f64 + 0.5);
            inside(pixel).then_some(3)
        };
        let owners: Vec<Option<u16>> = (0..200 * 120).map(owner).collect();
        Region::new(3, &owners, &vec![0.1; owners.len()], 200)
    }

    fn ball(centre: DVec3) -> impl Fn(DVec2) -> bool {
        move |pixel| {
            let ray = INTRINSICS.ray(pixel).normalize();
            (centre - ray * ray.dot(centre)).length() < 1.0
        }
    }

    #[test]
    fn a_ball_that_is_cut_off_is_located() {
        // In the middle, in a corner of a wide image, and cut off by its lower border.
        for centre in
            [DVec3::new(0.3, -0.2, 6.0), DVec3::new(3.4, 1.5, 6.0), DVec3::new(-1.0, 2.3, 6.0)]
        {
            let found = disc(&region(ball(centre)), &INTRINSICS).unwrap();
            assert!(found.round && found.centre.distance(centre) < 0.1, "{centre} {found:?}");
        }
    }

    #[test]
    fn a_box_is_no_disc_and_a_short_arc_tells_nothing() {
        let square = |p: DVec2| (p - DVec2::new(90.0, 60.0)).abs().max_element() < 22.0;
        assert!(!disc(&region(square), &INTRINSICS).unwrap().round);
        // Only the uppermost part of the ball is in the image.
        assert!(disc(&region(ball(DVec3::new(0.0, 3.2, 6.0))), &INTRINSICS).is_none());
        assert!(disc(&region(|_| false), &INTRINSICS).is_none());
    }
}

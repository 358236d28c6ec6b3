//! What the outline of a mover tells: its middle, and its distance up to one scale.
//!
//! A thing of one size covers a solid angle that falls with the square of its distance, whichever way it
//! is seen. Solid angles, not pixels: a wide lens draws the same thing larger near the picture's edge.

use crate::types::Intrinsics;
use glam::{DVec2, DVec3};

/// Nearer to the picture's edge an outline is cut off, pixels.
const EDGE: usize = 2;
/// An outline is hidden in part if more than this share of its contour borders on another mover.
const HIDDEN: f64 = 0.05;
/// Smaller ones are mostly the mask's own error, pixels.
const LEAST: usize = 30;

/// A whole outline.
#[derive(Clone, Copy, Debug)]
pub(super) struct Outline {
    /// Pixel of its middle.
    pub middle: DVec2,
    /// Depth (z) of its middle, in a unit of which the thing's size decides.
    pub depth: f64,
}

/// The outline of an object in a frame, whose pixels have their object in `owners`; none where it is
/// cut off or hidden in part.
pub(super) fn outline(
    index: usize,
    owners: &[Option<u16>],
    intrinsics: &Intrinsics,
) -> Option<Outline> {
    let (width, height) = (intrinsics.width as usize, intrinsics.height as usize);
    let own = Some(index as u16);
    let (mut pixels, mut angle, mut sum) = (0, 0.0, DVec3::ZERO);
    let (mut contour, mut shared) = (0.0, 0.0);
    for (i, _) in owners.iter().enumerate().filter(|(_, owner)| **owner == own) {
        let (x, y) = (i % width, i / width);
        if x.min(y) < EDGE || x + EDGE >= width || y + EDGE >= height {
            return None;
        }
        let ray = intrinsics.ray(DVec2::new(x as f64 + 0.5, y as f64 + 0.5));
        // Of a pixel: its area over the focal lengths, by the cube of the ray's cosine.
        let cosine = ray.length().recip();
        let solid = cosine.powi(3) / (intrinsics.fx * intrinsics.fy);
        (pixels, angle, sum) = (pixels + 1, angle + solid, sum + solid * cosine * ray);
        for next in [i - 1, i + 1, i - width, i + width] {
            if owners[next] != own {
                contour += 1.0;
                shared += f64::from(u8::from(owners[next].is_some()));
            }
        }
    }
    if pixels < LEAST || shared > HIDDEN * contour {
        return None;
    }
    let direction = sum.try_normalize()?;
    Some(Outline { middle: intrinsics.project(direction), depth: direction.z / angle.sqrt() })
}

#[cfg(test)]
mod tests {
    use super::*;

    const INTRINSICS: Intrinsics =
        Intrinsics { fx: 150.0, fy: 150.0, cx: 100.0, cy: 60.0, width: 200, height: 120 };

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
        let found = at.map(|centre| outline(3, &ball(centre, 0.3), &INTRINSICS).unwrap());
        for (centre, outline) in at.iter().zip(&found) {
            let unit = outline.depth * at[0].z / found[0].depth;
            assert!((unit / centre.z - 1.0).abs() < 0.02, "{centre}: {unit}");
            let off = outline.middle.distance(INTRINSICS.project(*centre));
            assert!(off < 0.5, "{centre}: {off}");
        }
    }

    #[test]
    fn what_is_cut_off_or_hidden_tells_nothing() {
        let whole = ball(DVec3::new(0.0, 0.0, 2.0), 0.3);
        assert!(outline(3, &whole, &INTRINSICS).is_some());
        assert!(outline(2, &whole, &INTRINSICS).is_none());
        let cut = ball(DVec3::new(0.0, 0.75, 2.0), 0.3);
        assert!(outline(3, &cut, &INTRINSICS).is_none());
        let mut hidden = whole;
        hidden.iter_mut().enumerate().filter(|(i, _)| i % 200 > 105).for_each(|(_, o)| {
            if o.is_some() {
                *o = Some(1);
            }
        });
        assert!(outline(3, &hidden, &INTRINSICS).is_none());
    }
}

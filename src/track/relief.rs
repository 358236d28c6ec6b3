//! The relief of a mover in one frame: the depth of every pixel relative to the depth of its middle.
//!
//! The prior for a compact object is a round surface: it bulges towards the camera like a membrane inflated
//! within the outline, and as a whole it faces the camera. If structure from motion gives points, the surface
//! passes through them, and between and beside them it follows the round shape. Single points that deviate
//! from their neighbours, such as reflections, are ignored. The structure as a whole is not corrected: its
//! errors are consistent with the errors of the motion that was estimated along with it, and only the two
//! together reproduce the images.

use glam::{DMat2, DVec2};

use super::contour::{Region, Side};
use super::quantile;
use crate::types::Intrinsics;

/// Height of the round surface relative to that of an inflated membrane. A factor of 2 turns a disc into a
/// ball, √2 turns a strip into a cylinder; most objects are flatter.
const ROUND: f64 = 1.2;
/// Smoothing length of the points, in units of the object's narrower half-width.
const SMOOTH: f64 = 0.05;
/// Deviation of a point, in units of the object's narrower half-width, at which its weight is reduced to a
/// quarter.
const STANDS_OUT: f64 = 0.1;
/// Minimum number of points that determine the relief.
const LEAST_POINTS: usize = 10;
/// Number of reweighting rounds for deviating points. The width of the kernel halves in each round.
const ROUNDS: i32 = 4;
/// The solver ends at this relative residual.
const SOLVED: f64 = 1e-3;

/// The logarithm of each pixel's depth relative to the object's middle. `points` are pixels of the object's
/// points, with the logarithms of their relative depths if structure from motion gives them. Without them,
/// the median point is as deep as the middle.
pub(super) fn relief(
    region: &Region,
    points: &[(DVec2, Option<f64>)],
    intrinsics: &Intrinsics,
) -> Vec<f64> {
    let Some(extent) = Extent::of(&region.centres) else { return vec![0.0; region.centres.len()] };
    let place = |p: DVec2| region.place(p, intrinsics.width as usize);
    let mut surface = round(region, &extent, intrinsics);
    let off: Vec<(usize, f64)> = points
        .iter()
        .filter_map(|(p, depth)| Some((place(*p), (*depth)?)))
        .map(|(place, depth)| (place, depth - surface[place]))
        .collect();
    if off.len() >= LEAST_POINTS {
        let correction = correction(region, &off, &extent, intrinsics);
        surface.iter_mut().zip(correction).for_each(|(z, c)| *z += c);
        return surface;
    }
    let seen: Vec<f64> = points.iter().map(|(p, _)| surface[place(*p)]).collect();
    let usual = quantile(if seen.is_empty() { surface.clone() } else { seen }, 0.5);
    surface.iter_mut().for_each(|z| *z -= usual);
    surface
}

/// The correction of a surface that makes it pass through points. `off` holds each point's index in the
/// region and its distance from the surface.
fn correction(
    region: &Region,
    off: &[(usize, f64)],
    extent: &Extent,
    intrinsics: &Intrinsics,
) -> Vec<f64> {
    let count = region.centres.len();
    let smooth = (SMOOTH * extent.narrow).max(1.0);
    let stiffness = smooth * smooth * off.len() as f64 / count as f64;
    let narrowest = STANDS_OUT * extent.narrow / intrinsics.fx;
    let usual = quantile(off.iter().map(|o| o.1).collect(), 0.5);
    let mut correction = vec![usual; count];
    for round in 0..ROUNDS {
        let width = narrowest * 2f64.powi(ROUNDS - 1 - round);
        let (mut weights, mut right) = (vec![0.0; count], vec![0.0; count]);
        for (place, off) in off {
            let stands_out = (off - correction[*place]) / width;
            let weight = 1.0 / (1.0 + stands_out * stands_out).powi(2);
            weights[*place] += weight;
            right[*place] += weight * off;
        }
        membrane(region, stiffness, |_| 0.0, &weights, &right, &mut correction);
    }
    correction
}

/// The round surface that faces the camera: the logarithm of the depth up to a constant.
fn round(region: &Region, extent: &Extent, intrinsics: &Intrinsics) -> Vec<f64> {
    let count = region.pixels.len();
    // Without a visible outline the curvature of the surface is unknown.
    let outlined = region.sides.iter().flatten().any(|side| *side == Side::Hidden);
    let mut height = vec![0.0; count];
    if outlined {
        let at_edge = |side: &Side| f64::from(u8::from(*side == Side::Hidden));
        membrane(region, 1.0, at_edge, &vec![0.0; count], &vec![1.0; count], &mut height);
    }
    // A flat card perpendicular to the ray has constant distance to first order, not constant depth.
    let ray = intrinsics.ray(extent.middle).truncate();
    let slope = -ray / ((1.0 + ray.length_squared()) * DVec2::new(intrinsics.fx, intrinsics.fy));
    // The tilt and the flatness of an elongated object are unknown: the more elongated it is, the more it is
    // modelled as an upright flat card.
    let compact = (extent.narrow / extent.long).powi(2);
    let surface = |(p, height): (&DVec2, &f64)| {
        let height = ROUND * height.max(0.0).sqrt() / intrinsics.fx;
        compact * (slope.dot(*p - extent.middle) - height)
    };
    region.centres.iter().zip(&height).map(surface).collect()
}

/// The middle and the size of a region.
struct Extent {
    middle: DVec2,
    /// Half of its length and of its width, pixels, as the semi-axes of an ellipse with the same moments.
    long: f64,
    narrow: f64,
}

impl Extent {
    fn of(pixels: &[DVec2]) -> Option<Extent> {
        let count = pixels.len() as f64;
        let middle = pixels.iter().sum::<DVec2>() / count;
        let mut moments = DMat2::ZERO;
        for off in pixels.iter().map(|p| *p - middle) {
            moments += DMat2::from_cols(off * off.x, off * off.y);
        }
        let [xx, xy, yy] =
            [moments.x_axis.x, moments.x_axis.y, moments.y_axis.y].map(|m| m / count);
        let axis = DVec2::from_angle(0.5 * f64::atan2(2.0 * xy, xx - yy));
        let variance =
            |axis: DVec2| axis.x * axis.x * xx + 2.0 * axis.x * axis.y * xy + axis.y * axis.y * yy;
        // A semi-axis of an ellipse is twice the standard deviation along it.
        let (long, narrow) =
            (2.0 * variance(axis).max(0.0).sqrt(), 2.0 * variance(axis.perp()).max(0.0).sqrt());
        (narrow > 0.5).then_some(Extent { middle, long, narrow })
    }
}

/// Solves for a membrane over the region: `stiffness` times the differences to the neighbours, plus `weights`
/// times the value, equals `right`. A side without a pixel of the region ties the membrane to zero with the
/// relative stiffness `at_edge`. The solver is conjugate gradients, with `sheet` as the initial value and the
/// result.
fn membrane(
    region: &Region,
    stiffness: f64,
    at_edge: impl Fn(&Side) -> f64,
    weights: &[f64],
    right: &[f64],
    sheet: &mut [f64],
) {
    let count = sheet.len();
    let diagonal: Vec<f64> = region
        .sides
        .iter()
        .zip(weights)
        .map(|(sides, weight)| {
            let ties = sides.iter().map(|side| match side {
                Side::Own(_) => 1.0,
                other => at_edge(other),
            });
            (weight + stiffness * ties.sum::<f64>()).max(1e-9)
        })
        .collect();
    let apply = |x: &[f64], out: &mut [f64]| {
        for (i, sides) in region.sides.iter().enumerate() {
            let mut sum = diagonal[i] * x[i];
            for side in sides {
                if let Side::Own(next) = side {
                    sum -= stiffness * x[*next];
                }
            }
            out[i] = sum;
        }
    };
    let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
    let mut product = vec![0.0; count];
    apply(sheet, &mut product);
    let mut rest: Vec<f64> = right.iter().zip(&product).map(|(b, a)| b - a).collect();
    let precondition =
        |rest: &[f64]| rest.iter().zip(&diagonal).map(|(r, d)| r / d).collect::<Vec<f64>>();
    let mut step = precondition(&rest);
    let mut energy = dot(&rest, &step);
    let scale: f64 = right.iter().zip(&diagonal).map(|(b, d)| b * b / d).sum();
    for _ in 0..4 * count {
        if energy <= SOLVED * SOLVED * scale {
            break;
        }
        apply(&step, &mut product);
        let length = energy / dot(&step, &product);
        sheet.iter_mut().zip(&step).for_each(|(x, s)| *x += length * s);
        rest.iter_mut().zip(&product).for_each(|(r, p)| *r -= length * p);
        let preconditioned = precondition(&rest);
        let next = dot(&rest, &preconditioned);
        let share = next / energy;
        step.iter_mut().zip(&preconditioned).for_each(|(s, p)| *s = p + share * *s);
        energy = next;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DVec3;

    const INTRINSICS: Intrinsics =
        Intrinsics { fx: 150.0, fy: 150.0, cx: 100.0, cy: 60.0, width: 200, height: 120 };
    const CENTRE: DVec3 = DVec3::new(0.9, -0.3, 3.0);
    const RADIUS: f64 = 0.5;

    /// The pixels that show an off-centre ball, and the logarithm of its surface's depth relative to its
    /// middle's.
    fn ball() -> (Region, Vec<f64>) {
        let depth = |i: usize| {
            let pixel = DVec2::new((i % 200) as f64 + 0.5, (i / 200) as f64 + 0.5);
            let ray = INTRINSICS.ray(pixel);
            let (a, b) = (ray.length_squared(), ray.dot(CENTRE));
            let root = b * b - a * (CENTRE.length_squared() - RADIUS * RADIUS);
            (root > 0.0).then(|| ((b - root.sqrt()) / (a * CENTRE.z)).ln())
        };
        let depths: Vec<Option<f64>> = (0..200 * 120).map(depth).collect();
        let owners: Vec<Option<u16>> = depths.iter().map(|d| d.map(|_| 3)).collect();
        let region = Region::new(3, &owners, &vec![0.1; owners.len()], 200);
        (region, depths.into_iter().flatten().collect())
    }

    /// Mean and standard deviation of a difference.
    fn off(a: &[f64], b: &[f64]) -> (f64, f64) {
        let off: Vec<f64> = a.iter().zip(b).map(|(a, b)| a - b).collect();
        let mean = off.iter().sum::<f64>() / off.len() as f64;
        let squares = off.iter().map(|o| (o - mean).powi(2)).sum::<f64>();
        (mean, (squares / off.len() as f64).sqrt())
    }

    #[test]
    fn what_nothing_is_known_of_is_round_and_faces_the_camera() {
        let (region, truth) = ball();
        let found = relief(&region, &[], &INTRINSICS);
        assert!(quantile(found.clone(), 0.5).abs() < 1e-9);
        let (flat, round) = (off(&vec![0.0; truth.len()], &truth).1, off(&found, &truth).1);
        assert!(round < 0.5 * flat, "{round} {flat}");
    }

    #[test]
    fn points_tell_the_relief_and_single_wrong_ones_do_not() {
        let (region, truth) = ball();
        // Every 23rd pixel is a point; every ninth of these is far off.
        let points: Vec<(DVec2, Option<f64>)> = (0..truth.len())
            .step_by(23)
            .enumerate()
            .map(|(k, i)| {
                let wrong = if k % 9 == 4 { 0.3 } else { 0.0 };
                (region.centres[i], Some(0.05 + truth[i] + wrong))
            })
            .collect();
        let found = relief(&region, &points, &INTRINSICS);
        let (mean, deviation) = off(&found, &truth);
        assert!((mean - 0.05).abs() < 0.005 && deviation < 0.012, "{mean} {deviation}");
    }

    #[test]
    fn a_surface_goes_on_behind_what_hides_it() {
        // The right half of the ball is hidden by a post in front of the wall: the surface does not bend back
        // at that edge.
        let (whole, truth) = ball();
        let mut owners = vec![None; 200 * 120];
        whole.pixels.iter().filter(|i| *i % 200 < 145).for_each(|i| owners[*i] = Some(3));
        let post: Vec<f32> =
            (0..200 * 120).map(|i| if i % 200 >= 145 { 0.8 } else { 0.1 }).collect();
        let wall = vec![0.1; 200 * 120];
        let [behind_post, before_wall] = [post, wall].map(|behind| {
            let region = Region::new(3, &owners, &behind, 200);
            relief(&region, &[], &INTRINSICS)
        });
        let half: Vec<f64> = (whole.pixels.iter().zip(&truth))
            .filter(|(i, _)| *i % 200 < 145)
            .map(|(_, depth)| *depth)
            .collect();
        let (hidden, cut) = (off(&behind_post, &half).1, off(&before_wall, &half).1);
        assert!(hidden < cut, "{hidden} {cut}");
        // A region without an outline is flat.
        let everywhere = Region::new(3, &[Some(3); 200 * 120], &[0.1; 200 * 120], 200);
        let flat = relief(&everywhere, &[], &INTRINSICS);
        assert!(flat.iter().all(|z| z.abs() < 0.01));
    }
}

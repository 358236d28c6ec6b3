//! Revision of the control points: they are added where the loss has large gradients, and removed where
//! no Gaussian follows them.
//!
//! The importance of a control point is the mean of its followers' squared gradients with respect to the
//! image position, weighted with their skinning weights (4D3R's g_k; the gradient in the image rather
//! than in space, so that the scene's scale does not matter). Where it is several times the median, the
//! motion is too coarse: a control point is added at the followers' weighted mean position. It inherits
//! its parent's path; with a network its motion follows from its position. A round runs on the host,
//! since rounds are rare and followers few.

use super::settings::ControlSettings;
use crate::types::ControlPoints;
use glam::{DQuat, DVec3, Vec3};

/// Sum of followers' weights below which a control point counts as not followed.
const LEAST_SUPPORT: f64 = 1e-3;
/// Smallest distance of a new control point from the others, in units of its parent's radius; nearer
/// ones would add nothing.
const LEAST_DISTANCE: f64 = 0.1;

/// The Gaussians that follow control points.
pub(super) struct Followers<'a> {
    /// Their centres in the canonical frame.
    pub(super) positions: &'a [[f32; 3]],
    /// Control points that each follows, the same number for each; missing ones are `u32::MAX`.
    pub(super) neighbours: &'a [u32],
    /// Mean norm of the gradient with respect to the image position.
    pub(super) pulls: &'a [f64],
}

/// The decision of a round.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Revision {
    /// Control points that are kept, in order.
    pub(super) kept: Vec<usize>,
    /// New control points: the parent's index, and the canonical position.
    pub(super) added: Vec<(usize, DVec3)>,
}

impl Revision {
    /// The control points after the round. A new one moves as if it were rigidly attached to its parent,
    /// whose radius and path it takes.
    pub(super) fn apply(&self, points: &ControlPoints) -> ControlPoints {
        let mut left = ControlPoints {
            positions: self.kept.iter().map(|&n| points.positions[n]).collect(),
            log_radii: self.kept.iter().map(|&n| points.log_radii[n]).collect(),
            paths: Vec::new(),
        };
        for &(parent, place) in &self.added {
            left.positions.push(place.as_vec3().to_array());
            left.log_radii.push(points.log_radii[parent]);
        }
        for key in points.paths.chunks_exact(points.len()) {
            left.paths.extend(self.kept.iter().map(|&n| key[n]));
            left.paths.extend(self.added.iter().map(|&(parent, place)| {
                let offset = place - Vec3::from(points.positions[parent]).as_dvec3();
                fixed_to(key[parent], offset)
            }));
        }
        left
    }
}

/// The motion of a control point that is rigidly attached, at an offset, to another one with the given
/// motion. It is absent when the other is.
fn fixed_to(motion: [f32; 8], offset: DVec3) -> [f32; 8] {
    let [x, y, z, .., w, i, j, k] = motion.map(f64::from);
    let rotation = DQuat::from_xyzw(i, j, k, 1.0 + w);
    let turned = match rotation.length() > 0.0 {
        true => rotation.normalize() * offset,
        false => offset,
    };
    let moved = (DVec3::new(x, y, z) + turned - offset).as_vec3();
    let [.., fade, w, i, j, k] = motion;
    [moved.x, moved.y, moved.z, fade, w, i, j, k]
}

/// Decides a round. At least as many control points are kept as a Gaussian follows.
pub(super) fn revise(
    points: &ControlPoints,
    followers: &Followers<'_>,
    settings: &ControlSettings,
) -> Revision {
    let count = points.len();
    let k = followers.neighbours.len() / followers.positions.len().max(1);
    let places: Vec<DVec3> = points.positions.iter().map(|p| Vec3::from(*p).as_dvec3()).collect();
    let radii: Vec<f64> = points.log_radii.iter().map(|r| f64::from(*r).exp()).collect();
    let (mut support, mut pull) = (vec![0.0; count], vec![0.0; count]);
    let mut centre = vec![DVec3::ZERO; count];
    for (row, position) in followers.positions.iter().enumerate() {
        let position = Vec3::from(*position).as_dvec3();
        let near = &followers.neighbours[k * row..k * (row + 1)];
        let squared = followers.pulls[row].powi(2);
        for (node, weight) in weights(position, near, &places, &radii) {
            support[node] += weight;
            pull[node] += weight * squared;
            centre[node] += weight * squared * position;
        }
    }
    let mut by_support: Vec<usize> = (0..count).collect();
    by_support.sort_by(|&a, &b| support[b].total_cmp(&support[a]).then(a.cmp(&b)));
    let supported = support.iter().filter(|s| **s > LEAST_SUPPORT).count();
    let mut kept = by_support[..supported.max(k.min(count))].to_vec();
    kept.sort_unstable();

    let importance = |node: usize| pull[node] / support[node];
    let mut candidates: Vec<usize> =
        kept.iter().copied().filter(|&n| support[n] > LEAST_SUPPORT && pull[n] > 0.0).collect();
    candidates.sort_by(|&a, &b| importance(b).total_cmp(&importance(a)).then(a.cmp(&b)));
    let median = candidates.get(candidates.len() / 2).map_or(f64::INFINITY, |&n| importance(n));
    let most = ((settings.share * count as f64).ceil() as usize)
        .min(settings.most.saturating_sub(kept.len()));
    let mut added: Vec<(usize, DVec3)> = Vec::new();
    for parent in candidates {
        if added.len() >= most || importance(parent) <= settings.above * median {
            break;
        }
        let place = centre[parent] / pull[parent];
        let least = LEAST_DISTANCE * radii[parent];
        let others = kept.iter().map(|&n| places[n]).chain(added.iter().map(|&(_, p)| p));
        if place.is_finite() && others.into_iter().all(|p| p.distance(place) > least) {
            added.push((parent, place));
        }
    }
    Revision { kept, added }
}

/// The normalised weights with which a position follows its neighbours, as in skinning.
fn weights<'a>(
    position: DVec3,
    near: &'a [u32],
    places: &[DVec3],
    radii: &[f64],
) -> impl Iterator<Item = (usize, f64)> + use<'a> {
    let exponents: Vec<f64> = near
        .iter()
        .map(|&node| match places.get(node as usize) {
            Some(place) => -0.5 * position.distance_squared(*place) / radii[node as usize].powi(2),
            None => f64::NEG_INFINITY,
        })
        .map(|e| if e.is_nan() { f64::NEG_INFINITY } else { e })
        .collect();
    let largest = exponents.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    let raw: Vec<f64> = exponents
        .iter()
        .map(|&e| if e > f64::NEG_INFINITY { (e - largest).exp() } else { 0.0 })
        .collect();
    let sum: f64 = raw.iter().sum();
    near.iter()
        .zip(raw)
        .filter(move |(_, w)| *w > 0.0 && sum > 0.0)
        .map(move |(&node, w)| (node as usize, w / sum))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Control points 1 apart on a line, with ten followers in each gap between neighbours, except
    /// beside the last two, which nothing is near.
    fn line() -> (ControlPoints, Vec<[f32; 3]>, Vec<u32>) {
        let points = ControlPoints {
            positions: (0..12).map(|i| [i as f32, 0.0, 0.0]).collect(),
            log_radii: vec![0.3f32.ln(); 12],
            paths: Vec::new(),
        };
        let positions: Vec<[f32; 3]> =
            (0..90).map(|i| [i as f32 / 10.0 + 0.05, 0.0, 0.0]).collect();
        let neighbours =
            positions.iter().flat_map(|p| [p[0].round() as u32, p[0].floor() as u32 + 2]).collect();
        (points, positions, neighbours)
    }

    const SETTINGS: ControlSettings =
        ControlSettings { every: 1, until: 1.0, most: 20, above: 4.0, share: 0.05 };

    #[test]
    fn pulled_ones_get_company_and_lonely_ones_go() {
        let (points, positions, neighbours) = line();
        // The gradients are large to the right of 4.
        let pull = |p: &[f32; 3]| if (4.2..4.5).contains(&p[0]) { 1.0 } else { 0.1 };
        let pulls: Vec<f64> = positions.iter().map(pull).collect();
        let followers = Followers { positions: &positions, neighbours: &neighbours, pulls: &pulls };
        let found = revise(&points, &followers, &SETTINGS);
        assert_eq!(found.kept, (0..11).collect::<Vec<_>>());
        let [(4, place)] = found.added[..] else { panic!("{found:?}") };
        assert!((4.2..4.5).contains(&place.x) && place.y == 0.0, "{place}");
        assert_eq!(found, revise(&points, &followers, &SETTINGS));
    }

    #[test]
    fn added_points_move_with_their_parents_and_are_absent_with_them() {
        // A quarter turn about z at the second key, and absent there.
        let half = std::f32::consts::FRAC_1_SQRT_2;
        let turned = [5.0, 0.0, 0.0, ControlPoints::ABSENT, half - 1.0, 0.0, 0.0, half];
        let points = ControlPoints {
            positions: vec![[1.0, 0.0, 0.0]],
            log_radii: vec![-1.0],
            paths: vec![[0.0; 8], turned],
        };
        let added = vec![(0, DVec3::new(1.5, 0.0, 0.0))];
        let after = Revision { kept: vec![0], added }.apply(&points);
        assert_eq!((after.positions[1], after.log_radii[1]), ([1.5, 0.0, 0.0], -1.0));
        assert_eq!(after.paths[1], [0.0; 8]);
        let [x, y, rest @ ..] = after.paths[3];
        // At first it is half a unit along x from its parent, after the turn half a unit along y.
        assert!((x - 4.5).abs() < 1e-6 && (y - 0.5).abs() < 1e-6, "{x}, {y}");
        assert_eq!(rest, turned[2..]);
    }

    #[test]
    fn even_pulls_full_houses_and_near_places_add_nothing() {
        let (points, positions, neighbours) = line();
        let even = vec![0.1; 90];
        let mut uneven = even.clone();
        uneven[43] = 30.0;
        let round = |pulls: &[f64], settings: &ControlSettings| {
            let positions = &positions;
            revise(&points, &Followers { positions, neighbours: &neighbours, pulls }, settings)
        };
        assert!(round(&even, &SETTINGS).added.is_empty());
        assert!(round(&vec![0.0; 90], &SETTINGS).added.is_empty());
        assert_eq!(round(&uneven, &SETTINGS).added.len(), 1);
        assert!(round(&uneven, &ControlSettings { most: 11, ..SETTINGS }).added.is_empty());
        let mut close = even.clone();
        // Its only follower with a large gradient lies 0.05 from the control point, a sixth of the
        // radius.
        close[40] = 30.0;
        let wide = ControlPoints { log_radii: vec![0.0; 12], ..points.clone() };
        let followers = Followers { positions: &positions, neighbours: &neighbours, pulls: &close };
        assert_eq!(round(&close, &SETTINGS).added.len(), 1);
        assert!(revise(&wide, &followers, &SETTINGS).added.is_empty());
    }

    #[test]
    fn as_many_stay_as_a_gaussian_follows() {
        let (points, ..) = line();
        let positions = [[3.0, 0.0, 0.0]];
        let neighbours = [3, 4, u32::MAX];
        let followers =
            Followers { positions: &positions, neighbours: &neighbours, pulls: &[f64::NAN] };
        let found = revise(&points, &followers, &SETTINGS);
        assert_eq!((found.kept, found.added), (vec![0, 3, 4], Vec::new()));
    }
}

//! Contact with the ground: an object that touches static ground in most frames is as far away as the ground
//! there.

use glam::DVec2;

use super::lower_end::{Contact, LowerEnd};
use super::objects::Object;
use super::path::{Estimate, Pull, bent};
use super::quantile;
use super::shape::Shape;

/// Minimum standard deviation of a contact's depth, as a logarithm.
const CONTACT: f64 = 0.03;
/// The same for a contact at the object's end, half of the object's width away from its middle. There the
/// depth relative to the middle is known only to this accuracy.
const CONTACT_ASIDE: f64 = 0.1;
/// Relative difference in depth within which a contact agrees with the path.
const AGREES: f64 = 0.1;
/// An object touches the ground if it has contacts in the first share of its frames (three at least) and the
/// second share of them agree with the path.
const TOUCHES: (f64, f64) = (0.25, 0.5);
/// Share of the conclusive frames in which an object may be in the air and still count as touching the
/// ground.
const IN_THE_AIR: f64 = 0.25;
/// The object's depth at its contact is the median depth of the tracked points within `BY_CONTACT` times half
/// of the object's width, and of `NEAR_CONTACT` nearest points at least. Fewer points may lie on the ground
/// that is visible between its wheels.
const BY_CONTACT: f64 = 0.3;
const NEAR_CONTACT: usize = 5;

/// The logarithm of the depth of an object's middle that follows from its contact with the ground, frame by
/// frame, where it has one.
pub(super) fn contacts(
    object: &Object,
    shape: &Shape,
    lower_ends: &[Option<LowerEnd>],
    middles: &[DVec2],
) -> Vec<Option<Estimate>> {
    let contact = |(k, end): (usize, &Option<LowerEnd>)| {
        let Some(LowerEnd::Touches(Contact { depth, pixel, half_width })) = end else {
            return None;
        };
        let near = object.tracks.iter().zip(&shape.frames[k].relative);
        let mut near: Vec<(f64, f64)> = near
            .filter_map(|(t, r)| Some((t.at(object.first + k)?.distance(*pixel), (*r)?)))
            .collect();
        near.sort_by(|a, b| a.0.total_cmp(&b.0));
        let within = near.partition_point(|(distance, _)| *distance < BY_CONTACT * half_width);
        near.truncate(within.max(NEAR_CONTACT));
        let relative = near.iter().map(|n| n.1).collect::<Vec<_>>();
        let relative = if near.is_empty() { 1.0 } else { quantile(relative, 0.5) };
        let aside = (pixel.x - middles[k].x) / half_width;
        let deviation = CONTACT.hypot(CONTACT_ASIDE * aside);
        Some(Estimate { value: (depth / relative).ln(), deviation })
    };
    lower_ends.iter().enumerate().map(contact).collect()
}

/// The path scaled and corrected so that it agrees with its contacts, and the resulting scale with its
/// standard deviation. Returns `None` if the contacts do not agree, or if the object is in the air too often:
/// `lower_ends` tells where it passes in front of a wall or is cut off by the image border.
pub(super) fn touched(
    path: &[f64],
    contacts: &[Option<Estimate>],
    lower_ends: &[Option<LowerEnd>],
    steps: &[f64],
) -> Option<(Vec<f64>, Estimate)> {
    let cut_off = lower_ends.iter().filter(|end| matches!(end, Some(LowerEnd::CutOff(_)))).count();
    let offsets: Vec<Estimate> = contacts
        .iter()
        .zip(path)
        .filter_map(|(c, p)| (*c).map(|c| Estimate { value: c.value - p, ..c }))
        .collect();
    if (offsets.len() as f64) < (TOUCHES.0 * (path.len() - cut_off) as f64).max(3.0) {
        return None;
    }
    // The start is the offset that most contacts agree with, weighted by their information.
    let agreeing = |o: &Estimate| {
        let near = offsets.iter().filter(|p| (p.value - o.value).abs() < 0.5 * AGREES);
        near.map(|p| p.deviation.powi(-2)).sum::<f64>()
    };
    let start = offsets.iter().max_by(|a, b| agreeing(a).total_cmp(&agreeing(b)))?.value;
    let first: Vec<f64> = path.iter().map(|p| p + start).collect();
    let bent = bent(path, &first, contacts, Pull { first_width: 1.0, power: 2 }, steps);
    let off = |(c, b): (&Option<Estimate>, &f64)| Some(((*c)?.value - b, (*c)?.deviation));
    let off: Vec<(f64, f64)> = contacts.iter().zip(&bent).filter_map(off).collect();
    let agree = off.iter().filter(|(off, _)| off.abs() < AGREES).count();
    // An object in the air is nearer than the ground that is visible below it, and it passes in front of
    // walls.
    let nearer = off.iter().filter(|(off, _)| *off <= -AGREES).count();
    let before = lower_ends
        .iter()
        .zip(&bent)
        .filter(|(end, b)| matches!(end, Some(LowerEnd::Wall(wall)) if wall.ln() > **b))
        .count();
    let all = offsets.len() as f64;
    let touches = agree >= 3
        && agree as f64 >= TOUCHES.1 * all
        && (nearer + before) as f64 <= IN_THE_AIR * (all + before as f64);
    let moved = bent.iter().zip(path).map(|(b, p)| b - p).sum::<f64>() / path.len() as f64;
    // Errors of neighbouring contacts are correlated, so averaging does not reduce the deviation.
    let of_deviation = off.iter().map(|(off, deviation)| off.abs() / deviation).collect();
    let deviation = CONTACT * (1.5 * quantile(of_deviation, 0.5)).max(1.0);
    touches.then_some((bent, Estimate { value: moved, deviation }))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn contacts_that_agree_bend_the_path_to_them() {
        // The path is correct up to scale; three contacts of ten belong to something else.
        let path: Vec<f64> = (0..10).map(|k| (1.0 + 0.02 * f64::from(k)).ln()).collect();
        let sure = |value: f64| Some(Estimate { value, deviation: CONTACT });
        let contacts: Vec<Option<Estimate>> = (0..10)
            .map(|k| match k {
                4 => None,
                2 | 5 | 8 => sure((7.0 + f64::from(k)).ln()),
                _ => sure(path[k as usize] + 3f64.ln()),
            })
            .collect();
        let steps = [0.002; 9];
        let (found, scale) = touched(&path, &contacts, &[None; 10], &steps).unwrap();
        for (logarithm, p) in found.iter().zip(&path) {
            assert!((logarithm - p - 3f64.ln()).abs() < 0.01, "{logarithm}");
        }
        assert!((scale.value - 3f64.ln()).abs() < 0.01 && scale.deviation == CONTACT, "{scale:?}");
        // Contacts with whatever happens to lie below the object do not agree.
        let below = |k: usize| sure((2.0 + k as f64).ln());
        assert!(
            touched(&path, &(0..10).map(below).collect::<Vec<_>>(), &[None; 10], &steps).is_none()
        );
        assert!(touched(&path, &[None; 10], &[None; 10], &steps).is_none());
        // Two contacts of ten can be chance.
        let few: Vec<_> = (0..10).map(|k| if k < 2 { contacts[k] } else { None }).collect();
        assert!(touched(&path, &few, &[None; 10], &steps).is_none());
        // Of two groups of contacts, the smaller one near the object's middle wins.
        let contacts: Vec<Option<Estimate>> = (0..10)
            .map(|k| match k {
                0..4 => sure(path[k] + 3f64.ln()),
                _ => Some(Estimate { value: path[k] + 3f64.ln() - 0.08, deviation: 0.1 }),
            })
            .collect();
        let (_, scale) = touched(&path, &contacts, &[None; 10], &steps).unwrap();
        assert!((scale.value - 3f64.ln()).abs() < 0.02, "{scale:?}");
    }

    #[test]
    fn what_is_in_the_air_touches_nothing() {
        // By chance, the ground that is visible below the object is as far away as a path that touches it
        // would be.
        let path = [0.0; 12];
        let steps = [0.002; 11];
        let at = |value: f64| Some(Estimate { value, deviation: CONTACT });
        let mut contacts = [None; 12];
        contacts[..6].fill(at(1.0));
        assert!(touched(&path, &contacts, &[None; 12], &steps).is_some());
        // In as many frames the object passes in front of a farther wall.
        let wall = |depth: f64| Some(LowerEnd::Wall(depth.exp()));
        let mut walls = [None; 12];
        walls[6..].fill(wall(1.3));
        assert!(touched(&path, &contacts, &walls, &steps).is_none());
        // A nearer wall hides the object.
        walls[6..].fill(wall(0.7));
        assert!(touched(&path, &contacts, &walls, &steps).is_some());
        // The object is seen in front of ground that is nearer.
        contacts[6..10].fill(at(0.7));
        assert!(touched(&path, &contacts, &[None; 12], &steps).is_none());
    }
}

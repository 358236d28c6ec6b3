//! The shadows that movers cast on the static world.
//!
//! The plates show where a frame is darker than it would be if nothing moved. Such a region is the shadow of
//! the mover next to it. It moves with the mover: under a distant light and on flat ground a shadow takes the
//! same steps as the object that casts it. So a shadow gets its own control points in the scaffold, on the
//! ground that it falls on.

use glam::{DMat3, DQuat, DVec2, DVec3};
use nalgebra::{Matrix3, SymmetricEigen};
use rayon::prelude::*;

use super::masks::regions;
use super::plate::{Evidence, MARGIN};
use super::scaffold::{Node, Scaffold, Surfaces};
use crate::types::{Image, Pose};

/// Half the side of the window in which a frame's brightness is compared with its plate's, pixels. Averaging
/// over the window removes the effect of texture that is misaligned by a pixel.
const WINDOW: i64 = 2;
/// Minimum share of the light that a shadow removes.
const LEAST_TAKEN: f32 = 0.1;
/// Minimum share of a shadow's pixels in which the plate's texture is visible through the shadow.
const CONFIRMED: f64 = 0.2;
/// Minimum area of a shadow, as a share of the image.
const LEAST_AREA: f64 = 1e-3;
/// Maximum distance between a shadow and the object that casts it, as a share of the image width.
const FARTHEST: f64 = 0.1;
/// Spacing of a shadow's control points, as a share of the image width, and the maximum number of them per
/// shadow.
const SPACING: f64 = 0.03;
const MOST_NODES: usize = 32;

/// The shadows of all frames, in the format of [`super::Track::shadows`]. The control points that carry them
/// are added to the scaffold.
pub(super) fn shadows(
    surfaces: &Surfaces<'_>,
    frames: &[Image],
    plates: &[Evidence],
    scaffold: &mut Scaffold,
) -> Vec<Image> {
    let objects = surfaces.movers.len();
    let mut shadows: Vec<Image> = (0..plates.len())
        .into_par_iter()
        .map(|f| {
            let (mask, owners) = (&surfaces.masks[f], &surfaces.owners[f]);
            of_frame(&frames[f], &plates[f], mask, owners, objects)
        })
        .collect();
    for caster in 1..=objects {
        let shadow = objects + caster;
        match nodes(surfaces, &shadows, scaffold, caster, shadow) {
            Some(nodes) => scaffold.nodes.extend(nodes),
            // A shadow without control points is removed.
            None => shadows.iter_mut().for_each(|image| {
                let own = image.pixels.chunks_exact_mut(2);
                own.filter(|pixel| pixel[1] == shadow as f32).for_each(|pixel| pixel.fill(0.0));
            }),
        }
    }
    shadows
}

/// The shadows in a frame, each assigned to the nearest object.
fn of_frame(
    frame: &Image,
    plate: &Evidence,
    mask: &Image,
    owners: &Image,
    objects: usize,
) -> Image {
    let taken = taken(frame, plate, mask);
    let shaded: Vec<f32> =
        taken.iter().map(|taken| f32::from(u8::from(*taken > LEAST_TAKEN))).collect();
    let mut out = Image::new(mask.width, mask.height, 2);
    let nearest = nearest_owners(owners);
    for (region, _) in regions(&shaded, mask.width as usize, true) {
        let caster = region.iter().filter_map(|i| nearest[*i]).min();
        let Some((distance, owner)) = caster else { continue };
        let beside = f64::from(distance) <= FARTHEST * f64::from(mask.width);
        let large = region.len() as f64 >= LEAST_AREA * shaded.len() as f64;
        let confirmed = region.iter().filter(|i| plate.shade[**i] > 0.0).count();
        if !beside || !large || (confirmed as f64) < CONFIRMED * region.len() as f64 {
            continue;
        }
        for i in region {
            out.pixels[2 * i] = taken[i];
            out.pixels[2 * i + 1] = (objects + owner) as f32;
        }
    }
    out
}

/// By pixel, the missing share of the plate's light; 0 on movers, beside them and where the plate is unknown.
fn taken(frame: &Image, plate: &Evidence, mask: &Image) -> Vec<f32> {
    let (width, height) = (i64::from(mask.width), i64::from(mask.height));
    let near_movers = mask.near(MARGIN);
    let stands = |i: usize| !near_movers[i] && plate.brightness[i].is_finite();
    let of = |i: usize| {
        if !stands(i) {
            return 0.0;
        }
        let (x, y) = (i as i64 % width, i as i64 / width);
        let (mut seen, mut expected) = (0.0, 0.0);
        for py in (y - WINDOW).max(0)..=(y + WINDOW).min(height - 1) {
            for px in (x - WINDOW).max(0)..=(x + WINDOW).min(width - 1) {
                let j = (py * width + px) as usize;
                if stands(j) {
                    seen += frame.pixels[3 * j..3 * j + 3].iter().sum::<f32>() / 3.0;
                    expected += plate.brightness[j];
                }
            }
        }
        if expected > 0.0 { (1.0 - seen / expected).clamp(0.0, 1.0) } else { 0.0 }
    };
    (0..mask.pixels.len()).map(of).collect()
}

/// By pixel, the number of steps to the nearest pixel of an object, and that object.
fn nearest_owners(owners: &Image) -> Vec<Option<(u32, usize)>> {
    let (width, count) = (owners.width as usize, owners.pixels.len());
    let mut nearest: Vec<Option<(u32, usize)>> =
        owners.pixels.iter().map(|owner| (*owner > 0.0).then_some((0, *owner as usize))).collect();
    let mut queue: Vec<usize> = (0..count).filter(|i| nearest[*i].is_some()).collect();
    let mut next = 0;
    while next < queue.len() {
        let i = queue[next];
        next += 1;
        let Some((distance, owner)) = nearest[i] else { continue };
        let x = i % width;
        let neighbours = [
            (x > 0).then(|| i - 1),
            (x + 1 < width).then_some(i + 1),
            i.checked_sub(width),
            (i + width < count).then_some(i + width),
        ];
        for j in neighbours.into_iter().flatten() {
            if nearest[j].is_none() {
                nearest[j] = Some((distance + 1, owner));
                queue.push(j);
            }
        }
    }
    nearest
}

/// Control points on the shadow of an object, which take the object's steps along the ground. `None` if the
/// object has no control points, or if too little of a shadow is visible.
fn nodes(
    surfaces: &Surfaces<'_>,
    shadows: &[Image],
    scaffold: &Scaffold,
    caster: usize,
    shadow: usize,
) -> Option<Vec<Node>> {
    let frames = shadows.len();
    let on: Vec<&Node> = scaffold.nodes.iter().filter(|node| node.owner == caster).collect();
    let first = on.iter().map(|node| node.alive.start).min()?;
    let alive = first..on.iter().map(|node| node.alive.end).max()?;
    let middle = |frame: usize| {
        let sum: DVec3 = on.iter().map(|node| node.world_from_node[frame].translation).sum();
        sum / on.len() as f64
    };
    let (width, height) = (surfaces.intrinsics.width, surfaces.intrinsics.height);
    let points: Vec<(usize, DVec3)> = (0..frames)
        .flat_map(|frame| {
            let own =
                (0..height).step_by(2).flat_map(|y| (0..width).step_by(2).map(move |x| (x, y)));
            own.filter(move |(x, y)| shadows[frame].at(*x, *y)[1] == shadow as f32).map(
                move |(x, y)| {
                    let pixel = DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5);
                    (frame, surfaces.lift(frame, pixel))
                },
            )
        })
        .collect();
    let least = LEAST_AREA * f64::from(width * height);
    if (points.len() as f64) < least {
        return None;
    }
    let up = normal(points.iter().map(|(_, point)| *point));
    let origin = middle(scaffold.canonical);
    let steps: Vec<DVec3> = (0..frames)
        .map(|frame| {
            let step = middle(frame) - origin;
            step - up * up.dot(step)
        })
        .collect();
    let mut places: Vec<(DVec3, f64)> = Vec::new();
    for (frame, point) in &points {
        let place = *point - steps[*frame];
        let spacing = SPACING * f64::from(width) * surfaces.pixel_size(*frame, *point);
        if places.iter().all(|(other, _)| other.distance(place) > spacing) {
            places.push((place, spacing));
        }
        if places.len() == MOST_NODES {
            break;
        }
    }
    let node = |(place, spacing): (DVec3, f64)| Node {
        owner: shadow,
        world_from_node: steps
            .iter()
            .map(|step| Pose { rotation: DQuat::IDENTITY, translation: place + *step })
            .collect(),
        spacing,
        alive: alive.clone(),
    };
    Some(places.into_iter().map(node).collect())
}

/// The direction of the smallest spread of the points.
fn normal(points: impl Iterator<Item = DVec3> + Clone) -> DVec3 {
    let count = points.clone().count().max(1) as f64;
    let mean = points.clone().sum::<DVec3>() / count;
    let mut spread = DMat3::ZERO;
    for off in points.map(|point| point - mean) {
        spread += DMat3::from_cols(off * off.x, off * off.y, off * off.z);
    }
    least(spread)
}

/// The unit eigenvector of the smallest eigenvalue of a symmetric matrix.
pub(super) fn least(spread: DMat3) -> DVec3 {
    let eigen = SymmetricEigen::new(Matrix3::from_column_slice(&spread.to_cols_array()));
    let v = eigen.eigenvectors.column(eigen.eigenvalues.imin());
    DVec3::new(v[0], v[1], v[2])
}

#[cfg(test)]
mod tests {
    use super::super::sliding::{self, FRAMES, HEIGHT, WALL, WIDTH, map, within};
    use super::super::{Mover, Sim3};
    use super::*;

    fn mover(p: DVec2) -> bool {
        within(p, (10.0, 5.0), (24.0, 20.0))
    }

    fn shadow(p: DVec2) -> bool {
        within(p, (10.0, 22.0), (30.0, 32.0))
    }

    /// A grey image.
    fn picture(brightness: impl Fn(DVec2) -> f32) -> Image {
        let pixels = map(brightness).pixels.iter().flat_map(|value| [*value; 3]).collect();
        Image { width: WIDTH, height: HEIGHT, channels: 3, pixels }
    }

    /// A uniform plate, whose texture is visible through the shadow.
    fn plate() -> Evidence {
        Evidence {
            odds: map(|_| 0.0).pixels,
            covered: vec![false; (WIDTH * HEIGHT) as usize],
            shade: map(|p| if shadow(p) { 0.4 } else { 0.0 }).pixels,
            brightness: map(|_| 0.5).pixels,
            hidden: map(|_| 0.0).pixels,
        }
    }

    fn flag(inside: bool) -> f32 {
        f32::from(u8::from(inside))
    }

    #[test]
    fn a_shadow_is_that_of_the_object_next_to_it() {
        let owners = map(|p| if mover(p) { 2.0 } else { flag(p.x > 60.0) });
        let mask = map(|p| flag(mover(p) || p.x > 60.0));
        // A small dark spot is not a shadow.
        let speck = |p: DVec2| within(p, (44.0, 34.0), (46.0, 35.0));
        let frame = picture(|p| if shadow(p) || speck(p) { 0.3 } else { 0.5 });
        let found = of_frame(&frame, &plate(), &mask, &owners, 3);
        for (i, pixel) in found.pixels.chunks_exact(2).enumerate() {
            let p = sliding::centre(i);
            let well_inside = within(p, (12.0, 24.0), (28.0, 30.0));
            let outside = !within(p, (9.0, 21.0), (31.0, 33.0));
            assert!(!well_inside || ((pixel[0] - 0.4).abs() < 1e-5 && pixel[1] == 5.0), "{p}");
            assert!(!outside || pixel == [0.0; 2], "{p}: {pixel:?}");
        }
        // No object is near enough to cast it.
        let far = map(|p| flag(p.x > 60.0));
        let found = of_frame(&frame, &plate(), &far, &far, 3);
        assert!(found.pixels.iter().all(|value| *value == 0.0));
        // The plate's texture is not visible: the region is a dark object.
        let nowhere = Evidence { shade: vec![0.0; plate().shade.len()], ..plate() };
        let found = of_frame(&frame, &nowhere, &mask, &owners, 3);
        assert!(found.pixels.iter().all(|value| *value == 0.0));
    }

    #[test]
    fn a_shadow_takes_the_steps_of_its_object_along_the_ground() {
        let cameras = sliding::cameras(0.0);
        let flow = sliding::flow(|_, _| DVec2::ZERO);
        let masks = vec![map(|p| flag(mover(p))); FRAMES];
        let depth = vec![map(|_| WALL as f32); FRAMES];
        let step = |f: usize| DVec3::new(0.1, 0.03, -0.2) * f as f64;
        let movers = [Mover { first: 0, world_from_object: vec![Sim3::IDENTITY; FRAMES] }];
        let surfaces = Surfaces {
            intrinsics: cameras.intrinsics,
            view_from_world: &cameras.poses,
            flow: &flow,
            masks: &masks,
            depth: &depth,
            owners: &masks,
            movers: &movers,
        };
        let pose = |f| Pose { rotation: DQuat::IDENTITY, translation: DVec3::Z * 3.0 + step(f) };
        let node = Node {
            owner: 1,
            world_from_node: (0..FRAMES).map(pose).collect(),
            spacing: 0.1,
            alive: 0..FRAMES,
        };
        let frames = vec![picture(|p| if shadow(p) { 0.3 } else { 0.5 }); FRAMES];
        let plates = vec![plate(); FRAMES];
        let mut scaffold = Scaffold { canonical: 2, nodes: vec![node] };
        let found = shadows(&surfaces, &frames, &plates, &mut scaffold);
        assert!(found.iter().all(|image| image.pixels.contains(&2.0)));
        assert!(scaffold.nodes.len() > 5);
        for node in scaffold.nodes.iter().skip(1) {
            assert_eq!(node.owner, 2);
            for (f, pose) in node.world_from_node.iter().enumerate() {
                let gone = pose.translation - node.world_from_node[0].translation;
                let along = DVec3::new(step(f).x, step(f).y, 0.0);
                assert!(gone.distance(along) < 1e-6, "{gone}");
            }
        }
        // Without a control point of its object no shadow is reported.
        let mut nothing = Scaffold { canonical: 2, nodes: Vec::new() };
        let found = shadows(&surfaces, &frames, &plates, &mut nothing);
        assert!(nothing.nodes.is_empty());
        assert!(found.iter().all(|image| image.pixels.iter().all(|value| *value == 0.0)));
        let mut same = scaffold.clone();
        shadows(&surfaces, &vec![picture(|_| 0.5); FRAMES], &plates, &mut same);
        assert_eq!(same, scaffold);
    }
}

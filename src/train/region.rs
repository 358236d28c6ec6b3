//! Random initial points where none are given: in the space that the cameras look at, and where images
//! show an object before an empty background, within its visual hull.

use glam::DVec3;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;

use super::views::TrainingView;
use crate::data::Point;
use crate::geometry::look_at_point;
use crate::types::{Camera, range};

/// Largest number of rounds, each of which tests as many random points as are wanted: the hull fills a
/// small part of the space.
const ROUNDS: u64 = 64;
/// Largest number of images in which a point is tested.
const PICTURES: usize = 64;
/// Share of the images that must show something at a point for it to be within the hull. A mover is
/// elsewhere about half of the time.
const WITHIN: f64 = 0.4;
/// Difference of a channel from the background above which a pixel shows something.
const SHOWS: f32 = 0.02;

/// `count` grey points, uniformly distributed over the cube that the cameras look at. Its centre is the
/// point nearest to the cameras' optical axes; half its side is a third of the cameras' mean distance
/// from that point (the objects of NeRF's and D-NeRF's synthetic scenes fill about that, seen from a
/// distance of 4). For cameras with parallel axes there is no such point: the cube then lies before the
/// cameras' mean centre, at a distance in proportion to their spread. Positions are in the world frame.
pub fn random_points(cameras: &[Camera], count: usize, seed: u64) -> Vec<Point> {
    let mean = |points: &mut dyn Iterator<Item = DVec3>| {
        points.sum::<DVec3>() / cameras.len().max(1) as f64
    };
    let middle = mean(&mut cameras.iter().map(Camera::centre));
    let seen = look_at_point(cameras).map(|point| {
        let sum: f64 = cameras.iter().map(|c| c.centre().distance(point)).sum();
        (point, sum / cameras.len() as f64)
    });
    // Cameras in one place have that place as their nearest point, and no cube around it.
    let seen = seen.filter(|(point, distance)| *distance > 1e-9 * point.length().max(1e-3));
    let (centre, distance) = match seen {
        Some(seen) => seen,
        None => {
            let axes = &mut cameras.iter().map(|c| c.view_from_world.inverse().rotation * DVec3::Z);
            let forward = mean(axes).try_normalize().unwrap_or(DVec3::Z);
            let spread = cameras.iter().map(|c| c.centre().distance(middle)).fold(0.0, f64::max);
            let distance = if spread > 1e-6 { 3.0 * spread } else { 3.0 };
            (middle + forward * distance, distance)
        }
    };
    let half = (distance / 3.0).clamp(f64::MIN_POSITIVE, f64::from(range::REACH));
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut inside = || DVec3::from_array(std::array::from_fn(|_| rng.random_range(-half..half)));
    (0..count)
        .map(|_| Point { position: (centre + inside()).as_vec3().to_array(), colour: [0.5; 3] })
        .collect()
}

/// `count` of the points of [`random_points`] that lie within the visual hull of a moving subject
/// (Laurentini 1994). A point is within the hull if enough of the images differ from `background` (RGB)
/// there; a share is required, since no point is visible in all images. Each point is in the world frame
/// and has the mean colour that the images show there. Where too few points lie within the hull, the
/// points that the largest shares of images show follow.
pub fn points_in_hull(
    views: &[TrainingView],
    background: [f32; 3],
    count: usize,
    seed: u64,
) -> Vec<Point> {
    let cameras: Vec<Camera> = views.iter().map(|view| view.camera).collect();
    let every = views.len().div_ceil(PICTURES).max(1);
    let looked_up: Vec<&TrainingView> = views.iter().step_by(every).collect();
    // Points within the hull in the order of their generation, then the others by their shares.
    let mut best: Vec<(f64, Point)> = Vec::new();
    for round in 0..ROUNDS {
        let seed = seed ^ (round << 32);
        let points = random_points(&cameras, count, seed).into_par_iter();
        best.par_extend(points.map(|point| shown(point, &looked_up, background)));
        // Sorting is stable.
        best.sort_by(|a, b| b.0.min(WITHIN).total_cmp(&a.0.min(WITHIN)));
        best.truncate(count);
        if best.last().is_none_or(|(share, _)| *share >= WITHIN) {
            break;
        }
    }
    best.into_iter().map(|(_, point)| point).collect()
}

/// The share of images that show something at a point, among those that contain its projection, and the
/// point with the mean colour there.
fn shown(point: Point, views: &[&TrainingView], background: [f32; 3]) -> (f64, Point) {
    let (mut inside, mut shown) = (0, 0);
    let mut colour = [0.0; 3];
    for view in views {
        let camera = &view.camera;
        let place = DVec3::from_array(point.position.map(f64::from));
        let seen = camera.view_from_world.apply(place);
        let pixel = camera.intrinsics.project(seen);
        let (width, height) = (view.image.width, view.image.height);
        let within = pixel.x >= 0.0
            && pixel.y >= 0.0
            && pixel.x < f64::from(width)
            && pixel.y < f64::from(height);
        if seen.z <= 0.0 || !within {
            continue;
        }
        inside += 1;
        let here = view.image.at(pixel.x as u32, pixel.y as u32);
        if (0..3).any(|k| (here[k] - background[k]).abs() > SHOWS) {
            shown += 1;
            (0..3).for_each(|k| colour[k] += here[k]);
        }
    }
    let share = f64::from(shown) / f64::from(inside.max(1));
    match shown {
        0 => (share, point),
        _ => (share, Point { colour: colour.map(|c| c / shown as f32), ..point }),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::look_at;
    use crate::types::{Image, Intrinsics};
    use glam::DVec2;

    #[test]
    fn points_lie_within_what_the_pictures_show() {
        // A red ball of radius 0.5 around (1, 2, 3), which is displaced in every third image.
        let centre = DVec3::new(1.0, 2.0, 3.0);
        let views: Vec<TrainingView> = (0..12)
            .map(|i| {
                let turn = f64::from(i) * 0.9;
                let from = centre + 4.0 * DVec3::new(turn.cos(), 0.3 * turn.sin(), turn.sin());
                let camera = Camera {
                    intrinsics: Intrinsics::centred(60.0, 64, 64),
                    view_from_world: look_at(from, centre, DVec3::NEG_Y),
                };
                let at = if i % 3 == 0 { centre + DVec3::Y } else { centre };
                let mut image = Image::new(64, 64, 3);
                for y in 0..64 {
                    for x in 0..64 {
                        let pixel = DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5);
                        let ray = camera.intrinsics.ray(pixel).normalize();
                        let to = camera.view_from_world.apply(at);
                        let hit = to.cross(ray).length() < 0.5;
                        let colour = if hit { [0.8, 0.1, 0.1] } else { [1.0; 3] };
                        image.at_mut(x, y).copy_from_slice(&colour);
                    }
                }
                let time = f64::from(i) / 11.0;
                TrainingView {
                    camera,
                    time,
                    image,
                    weights: None,
                    disparity: None,
                    mask: None,
                    every: 1,
                }
            })
            .collect();
        let points = points_in_hull(&views, [1.0; 3], 200, 7);
        assert_eq!(points.len(), 200);
        let off = |p: &Point| glam::Vec3::from(p.position).as_dvec3().distance(centre);
        // The cube extends to 1.35 along each axis; in a share of the images more than the ball is
        // visible.
        let mut offs: Vec<f64> = points.iter().map(off).collect();
        offs.sort_by(f64::total_cmp);
        assert!(offs[100] < 0.6 && offs[180] < 1.0, "{} {}", offs[100], offs[180]);
        assert!(points.iter().any(|p| off(p) > 0.4), "they fill it");
        let red = |p: &Point| (p.colour[0] - 0.8).abs() < 1e-4 && (p.colour[1] - 0.1).abs() < 1e-4;
        assert!(points.iter().all(red));
        assert_eq!(points, points_in_hull(&views, [1.0; 3], 200, 7));
        // Images that show nothing still give points.
        assert_eq!(points_in_hull(&views, [0.8, 0.1, 0.1], 20, 7).len(), 20);
    }

    #[test]
    fn points_lie_where_the_cameras_look() {
        let target = DVec3::new(10.0, 20.0, 30.0);
        let camera = |centre: DVec3| Camera {
            intrinsics: Intrinsics::centred(100.0, 64, 48),
            view_from_world: look_at(centre, target, DVec3::NEG_Y),
        };
        let around =
            [DVec3::X, DVec3::Z, DVec3::NEG_X].map(|side| camera(target + 6.0 * side)).to_vec();
        let points = random_points(&around, 500, 3);
        assert_eq!(points.len(), 500);
        let from = |p: &Point| glam::Vec3::from_array(p.position).as_dvec3() - target;
        assert!(points.iter().all(|p| from(p).abs().max_element() <= 2.0 + 1e-4));
        assert!(points.iter().any(|p| from(p).abs().max_element() > 1.8));
        assert_eq!(points, random_points(&around, 500, 3));
        assert_ne!(points, random_points(&around, 500, 4));
        // Cameras that turn in one place, and numbers that the file readers reject.
        let turning: Vec<Camera> = [DVec3::X, DVec3::Z, DVec3::NEG_X, DVec3::NEG_Z]
            .map(|side| Camera {
                view_from_world: look_at(target, target + side, DVec3::NEG_Y),
                ..around[0]
            })
            .to_vec();
        let points = random_points(&turning, 50, 3);
        assert!(points.iter().any(|p| from(p).length() > 0.5));
        for wild in [1e19, 1e300, f64::NAN, f64::INFINITY] {
            let mut cameras = around.clone();
            cameras[1].view_from_world.translation.x = wild;
            assert_eq!(random_points(&cameras, 50, 3).len(), 50);
        }
        // A single camera.
        let seen = random_points(&around[..1], 50, 0);
        let before = |p: &Point| {
            let p = glam::Vec3::from_array(p.position).as_dvec3();
            around[0].view_from_world.apply(p).z > 0.0
        };
        assert!(seen.iter().all(before));
    }
}

//! The ground: one plane for the whole clip.
//!
//! Ground is seen at a grazing angle and often has little texture. A single frame then measures its depth
//! badly: indistinct pixels take the depth of their surroundings, and the ground becomes a few wide steps.
//! Objects that stand or move on it get the wrong distance. All frames together determine the plane of the
//! ground and its evenness. The plane is used where a pixel's own measurement is no better than that
//! evenness.
//!
//! The plane is found by random samples of three points (RANSAC: Fischler and Bolles 1981) and fitted by
//! iteratively reweighted least squares.

use glam::{DMat3, DVec3};
use rand::SeedableRng;
use rand::seq::index::sample;
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;

use super::super::cameras::Cameras;
use super::super::plate::centre;
use super::super::quantile;
use super::super::residual::Seen;
use super::super::shade::least;
use crate::types::Pose;

/// Approximate maximum number of points, over all frames, that the plane is estimated from.
const POINTS: usize = 20_000;
/// Number of planes that are tried, and number of points that each is scored with.
const TRIES: usize = 800;
const JUDGES: usize = 2000;
/// Minimum cosine of the angle between the ground's normal and the cameras' mean upward axis.
const UPRIGHT: f64 = 0.8;
/// A point is on the plane if the logarithm of its depth differs by less than `ON_PLANE`. Points up to
/// `SHAPES` times as far off are used to fit the plane and its evenness.
const ON_PLANE: f64 = 0.03;
const SHAPES: f64 = 3.0;
/// Number of fitting rounds.
const ROUNDS: usize = 10;
/// Minimum share of all points that are on the plane. A point is behind the plane if its depth is larger by
/// more than the second number of `BEHIND`, as a logarithm; the number of these points must be less than the
/// first number times that of the points on the plane. A table, for example, is not ground.
const LEAST_SHARE: f64 = 0.1;
const BEHIND: (f64, f64) = (0.5, 0.1);
/// Evenness of ground, as the standard deviation of the logarithm of depth: its lower bound, and the value
/// above which the plane is not used.
const EVEN: (f64, f64) = (0.003, 0.05);
/// Maximum difference of the logarithm of depth between a pixel and the ground for the pixel to lie on the
/// ground.
const NEAR: f64 = 0.15;
/// Factor on the ground's deviation at pixels without a measurement.
const UNSEEN: f64 = 3.0;
/// Maximum number of fits to sweeps along the ground's normal, and the median change of the logarithm of depth
/// below which they end.
const LEVELLINGS: usize = 8;
const LEVEL: f64 = 0.001;

/// The planes parallel to the ground that are swept: from `LOWEST` to `HIGHEST` times the ground's inverse
/// depth, in relative steps of `LEVEL_STEP`.
const LOWEST: f64 = 0.8;
const HIGHEST: f64 = 1.25;
const LEVEL_STEP: f64 = 0.01;

/// The inverse depths of the planes parallel to the ground that are swept, relative to that of the ground.
pub(super) fn levels() -> Vec<f64> {
    let n = ((HIGHEST / LOWEST).ln() / LEVEL_STEP).ceil();
    (0..=n as usize).map(|l| LOWEST * (HIGHEST / LOWEST).powf(l as f64 / n)).collect()
}

/// A plane in the world.
#[derive(Clone, Copy, Debug)]
pub(in super::super) struct Ground {
    /// The unit normal of the plane, upwards.
    normal: DVec3,
    /// The dot product of the normal with every point of the plane.
    level: f64,
    /// The evenness: the standard deviation of the logarithm of the depth of the plane's points.
    deviation: f64,
}

/// A point of the static world, and the camera that saw it.
#[derive(Clone, Copy)]
struct Sight {
    centre: DVec3,
    point: DVec3,
}

impl Ground {
    /// Finds the plane that contains most measured points, of those whose normal is close to the cameras'
    /// upward axis. Returns `None` if it is not ground: too few points lie on it, too many behind it, or it
    /// is not even. `covered` marks the pixels of each frame that belong to movers.
    pub fn find(cameras: &Cameras, covered: &[Vec<bool>], seen: &[Seen]) -> Option<Ground> {
        let sights = sights(cameras, covered, seen);
        if sights.len() < 3 {
            return None;
        }
        let up = cameras.poses.iter().map(|pose| pose.rotation.conjugate() * DVec3::NEG_Y);
        let up = up.sum::<DVec3>().try_normalize()?;
        let mut rng = ChaCha8Rng::seed_from_u64(0);
        let mut through_three = || {
            let chosen = sample(&mut rng, sights.len(), 3);
            let [a, b, c] = [0, 1, 2].map(|k| sights[chosen.index(k)].point);
            let normal = (b - a).cross(c - a).try_normalize()?;
            let normal = normal * normal.dot(up).signum();
            let plane = Ground { normal, level: normal.dot(a), deviation: ON_PLANE };
            (normal.dot(up) > UPRIGHT).then_some(plane)
        };
        let planes: Vec<Ground> = (0..TRIES).filter_map(|_| through_three()).collect();
        let judges: Vec<Sight> =
            sights.iter().step_by(sights.len().div_ceil(JUDGES)).copied().collect();
        let counts: Vec<usize> = planes.par_iter().map(|plane| plane.on(&judges)).collect();
        let best = (0..planes.len()).max_by_key(|k| counts[*k])?;
        let plane = planes[best].fitted(&sights)?;
        plane.is_ground(&sights).then_some(plane)
    }

    /// Refits the plane to what `sweep` measures along its normal, until it no longer changes. A sweep along a
    /// tilted normal shows the ground with less tilt than it has, so one is not enough. `sweep` returns the
    /// numbers of some frames and the inverse depths of their ground.
    pub fn levelled(
        self,
        cameras: &Cameras,
        sweep: impl Fn(&Ground) -> Vec<(usize, Seen)>,
    ) -> Ground {
        let (mut ground, mut last) = (self, self);
        for _ in 0..LEVELLINGS {
            let measured = sweep(&ground);
            let per_frame = POINTS / measured.len().max(1);
            let sights: Vec<Sight> = measured
                .par_iter()
                .flat_map(|(frame, seen)| sights_of(cameras, *frame, |_| true, seen, per_frame))
                .collect();
            let Some(next) = ground.fitted(&sights) else { break };
            let changes = |sight| {
                let off = ground.off(sight)?;
                Some((next.off(sight)? - off, off - last.off(sight)?))
            };
            let changes: Vec<(f64, f64)> = sights.iter().filter_map(changes).collect();
            // Measured inverse depths tend to the levels of the sweep, so fits alternate about the ground.
            let alternates = changes.iter().map(|(now, before)| now * before).sum::<f64>() < 0.0;
            last = ground;
            ground = if alternates { ground.mean(&next) } else { next };
            if quantile(changes.iter().map(|(now, _)| now.abs()).collect(), 0.5) < LEVEL {
                break;
            }
        }
        ground
    }

    /// The plane halfway between two planes.
    fn mean(&self, other: &Ground) -> Ground {
        let length = (self.normal + other.normal).length();
        Ground {
            normal: (self.normal + other.normal) / length,
            level: (self.level + other.level) / length,
            deviation: 0.5 * (self.deviation + other.deviation),
        }
    }

    /// A known plane, for unit tests.
    #[cfg(test)]
    pub fn known(normal: DVec3, level: f64) -> Ground {
        Ground { normal, level, deviation: EVEN.0 }
    }

    /// The unit normal of the plane, upwards.
    pub fn normal(&self) -> DVec3 {
        self.normal
    }

    /// The plane in a camera: its inverse depth at a pixel is the dot product of this vector with the pixel's
    /// ray. `None` if the camera is not above the plane.
    pub fn from(&self, view_from_world: &Pose) -> Option<DVec3> {
        let height = self.normal.dot(view_from_world.inverse().translation) - self.level;
        (height > 0.0).then(|| view_from_world.rotation * -self.normal / height)
    }

    /// The number of points on the plane.
    fn on(&self, sights: &[Sight]) -> usize {
        let offs = sights.iter().filter_map(|sight| self.off(sight));
        offs.filter(|off| off.abs() < ON_PLANE).count()
    }

    /// The logarithm of the ratio of the plane's depth along the line of sight to the point's depth; `None`
    /// if the camera is not above the plane, or the line of sight does not meet it.
    fn off(&self, sight: &Sight) -> Option<f64> {
        let height = self.normal.dot(sight.centre) - self.level;
        let down = self.normal.dot(sight.centre - sight.point);
        (height > 0.0 && down > 0.0).then(|| (height / down).ln())
    }

    /// Refits the plane to the points near it, and measures its evenness. `None` if the fit fails.
    fn fitted(self, sights: &[Sight]) -> Option<Ground> {
        let mut plane = self;
        for _ in 0..ROUNDS {
            // A relative error of the depth gives a distance from the plane of that share of the camera's
            // height.
            let weight = |sight: &Sight| {
                let height = plane.normal.dot(sight.centre) - plane.level;
                let off = plane.off(sight).filter(|off| off.abs() < SHAPES * ON_PLANE)?;
                Some(kernel(off / plane.deviation) / height.powi(2))
            };
            let weights: Vec<f64> = sights.iter().map(|s| weight(s).unwrap_or(0.0)).collect();
            let total: f64 = weights.iter().sum();
            let weighted = || sights.iter().zip(&weights);
            let middle = weighted().map(|(s, w)| s.point * *w).sum::<DVec3>() / total;
            let mut spread = DMat3::ZERO;
            for (sight, weight) in weighted() {
                let off = sight.point - middle;
                spread += DMat3::from_cols(off * off.x, off * off.y, off * off.z) * *weight;
            }
            if !(middle.is_finite() && spread.is_finite()) {
                return None;
            }
            let normal = least(spread);
            let normal = normal * normal.dot(plane.normal).signum();
            plane = Ground { normal, level: normal.dot(middle), ..plane };
            let offs = sights.iter().filter_map(|sight| plane.off(sight)).map(f64::abs);
            let near = offs.filter(|off| *off < SHAPES * ON_PLANE).collect();
            // Standard deviation from the median absolute deviation of a normal distribution.
            plane.deviation = (1.48 * quantile(near, 0.5)).max(EVEN.0);
        }
        Some(plane)
    }

    fn is_ground(&self, sights: &[Sight]) -> bool {
        let on = self.on(sights) as f64;
        let offs = sights.iter().filter_map(|sight| self.off(sight));
        let behind = offs.filter(|off| *off < -BEHIND.1).count() as f64;
        on > LEAST_SHARE * sights.len() as f64 && behind < BEHIND.0 * on && self.deviation < EVEN.1
    }

    /// Combines the inverse depths of pixels on the ground with the plane, weighted by their deviations.
    pub fn settle(&self, cameras: &Cameras, covered: &[Vec<bool>], seen: &mut [Seen]) {
        let k = &cameras.intrinsics;
        let width = k.width as usize;
        seen.par_iter_mut().zip(covered).zip(&cameras.poses).for_each(|((seen, covered), pose)| {
            let Some(down) = self.from(pose) else { return };
            for i in (0..covered.len()).filter(|i| !covered[*i]) {
                let ground = down.dot(k.ray(centre(i, width)));
                let own = f64::from(seen.inverse_depth[i]);
                let off = (own / ground).ln();
                // This is also false if either is not positive.
                if off.abs() < NEAR {
                    self.settle_pixel(seen, i, ground, off);
                }
            }
        });
    }

    /// Combines one pixel with the plane. `ground` is the inverse depth of the ground; `off` is the logarithm
    /// of the ratio of the pixel's own inverse depth to it.
    fn settle_pixel(&self, seen: &mut Seen, i: usize, ground: f64, off: f64) {
        if seen.support[i] < 0.5 {
            seen.inverse_depth[i] = ground as f32;
            seen.deviation[i] = (UNSEEN * self.deviation * ground) as f32;
            (seen.support[i], seen.score[i]) = (1.0, 0.0);
            return;
        }
        let own = f64::from(seen.inverse_depth[i]);
        let of_own = (own / f64::from(seen.deviation[i])).powi(2);
        let of_ground = kernel(off / (SHAPES * self.deviation)) / self.deviation.powi(2);
        let value = (of_own * own + of_ground * ground) / (of_own + of_ground);
        if value.is_finite() {
            seen.inverse_depth[i] = value as f32;
            seen.deviation[i] = (value / (of_own + of_ground).sqrt()) as f32;
        }
    }
}

/// Weight of a residual in units of the width of Geman and McClure's kernel.
fn kernel(off: f64) -> f64 {
    (1.0 + off * off).powi(-2)
}

/// Measured points, sampled evenly over all frames.
fn sights(cameras: &Cameras, covered: &[Vec<bool>], seen: &[Seen]) -> Vec<Sight> {
    let most = (POINTS / seen.len().max(1)).max(100);
    let of_frame = |frame: usize| {
        let is_static = |i: usize| !covered[frame][i];
        sights_of(cameras, frame, is_static, &seen[frame], most)
    };
    (0..seen.len()).into_par_iter().flat_map(of_frame).collect()
}

/// At most about `most` measured points of a frame, at the pixels that `takes` accepts.
fn sights_of(
    cameras: &Cameras,
    frame: usize,
    takes: impl Fn(usize) -> bool,
    seen: &Seen,
    most: usize,
) -> Vec<Sight> {
    let k = &cameras.intrinsics;
    let world_from_view = cameras.poses[frame].inverse();
    let is_known = |i: &usize| takes(*i) && seen.support[*i] >= 0.5 && seen.inverse_depth[*i] > 0.0;
    let known: Vec<usize> = (0..seen.support.len()).filter(is_known).collect();
    let every = known.len().div_ceil(most).max(1);
    let sight = |i: &usize| {
        let view = k.ray(centre(*i, k.width as usize)) / f64::from(seen.inverse_depth[*i]);
        Sight { centre: world_from_view.translation, point: world_from_view.apply(view) }
    };
    known.iter().step_by(every).map(sight).collect()
}

#[cfg(test)]
mod tests {
    use super::super::super::sliding::{FRAMES, HEIGHT, STEP, WIDTH, cameras};
    use super::*;
    use crate::types::Intrinsics;

    /// Height of the cameras above the ground.
    const ABOVE: f64 = 0.5;
    const BACK: f64 = 6.0;
    const PIXELS: usize = (WIDTH * HEIGHT) as usize;

    /// A pixel's true inverse depth, and whether the pixel shows the ground. The ground extends to a wall at
    /// the back; a box stands on the left.
    fn truth(i: usize, k: &Intrinsics, slope: f64) -> (f64, bool) {
        let ray = k.ray(centre(i, WIDTH as usize));
        // y points down; `slope` tilts the ground along x.
        let ground = (ray.y - slope * ray.x) / ABOVE;
        let box_ = if ray.x < -0.2 && ray.y < 0.3 { 1.0 / 2.5 } else { 0.0 };
        let before = (1.0 / BACK).max(box_);
        (ground.max(before), ground > before)
    }

    /// Simulated measurements: two of three ground pixels are bad, in wide steps; some pixels have none.
    fn seen(slope: f64) -> Vec<Seen> {
        let k = cameras(STEP).intrinsics;
        let mut seen = Seen {
            inverse_depth: vec![0.0; PIXELS],
            deviation: vec![0.0; PIXELS],
            score: vec![0.0; PIXELS],
            support: vec![1.0; PIXELS],
        };
        for i in 0..PIXELS {
            let (d, ground) = truth(i, &k, slope);
            let step = 0.12 * (d.ln() / 0.12).round();
            let bad = ground && i % 3 > 0;
            let deviation = if bad { 0.2 } else { 0.002 };
            seen.inverse_depth[i] = if bad { step.exp() } else { d } as f32;
            seen.deviation[i] = deviation * seen.inverse_depth[i];
            if i % 11 == 0 {
                seen.support[i] = 0.0;
                seen.inverse_depth[i] = 1.1 * d as f32;
            }
        }
        vec![seen; FRAMES]
    }

    fn nothing_moves() -> Vec<Vec<bool>> {
        vec![vec![false; PIXELS]; FRAMES]
    }

    #[test]
    fn ground_is_found_and_what_is_badly_measured_settles_on_it() {
        // The cameras do not move, so their height above the ground is constant.
        let (cameras, covered) = (cameras(0.0), nothing_moves());
        for slope in [0.0, 0.2] {
            let mut seen = seen(slope);
            let ground = Ground::find(&cameras, &covered, &seen).unwrap();
            let expected = DVec3::new(slope, -1.0, 0.0);
            assert!(ground.normal.dot(expected.normalize()) > 0.9999, "{ground:?}");
            let level = -ABOVE / expected.length();
            assert!((ground.level / level - 1.0).abs() < 0.02, "{ground:?}, {level}");
            let before = seen[2].clone();
            ground.settle(&cameras, &covered, &mut seen);
            let off = |seen: &Seen, i: usize| {
                let (d, _) = truth(i, &cameras.intrinsics, slope);
                (f64::from(seen.inverse_depth[i]) / d).ln().abs()
            };
            let (mut bad, mut better) = (0.0, 0.0);
            for i in 0..PIXELS {
                let (d, on_ground) = truth(i, &cameras.intrinsics, slope);
                match (on_ground, i % 11 == 0) {
                    (true, true) => {
                        assert!(off(&seen[2], i) < 0.03 && seen[2].support[i] > 0.0);
                    }
                    (true, false) if i % 3 > 0 => {
                        bad += off(&before, i);
                        better += off(&seen[2], i);
                    }
                    // Well-measured pixels do not change, whether on the ground or not.
                    (_, false) => assert!(off(&seen[2], i) < 0.004, "{i}: {d}"),
                    (false, true) => {}
                }
            }
            assert!(better < 0.35 * bad, "{better}, before {bad}");
        }
    }

    #[test]
    fn a_wall_a_table_and_a_mover_are_no_ground() {
        let (cameras, mut covered) = (cameras(STEP), nothing_moves());
        let of = |d: &dyn Fn(usize) -> f64| {
            let mut all = seen(0.0);
            for seen in &mut all {
                seen.support.fill(1.0);
                for i in 0..PIXELS {
                    seen.inverse_depth[i] = d(i) as f32;
                }
            }
            all
        };
        let k = cameras.intrinsics;
        let wall = of(&|_| 0.25);
        assert!(Ground::find(&cameras, &covered, &wall).is_none(), "a wall");
        // Beside the table the wall behind and below it is visible.
        let table = |i: usize| {
            let ray = k.ray(centre(i, WIDTH as usize));
            if ray.x.abs() < 0.12 && ray.y > 0.0 { ray.y / ABOVE } else { 1.0 / BACK }
        };
        assert!(Ground::find(&cameras, &covered, &of(&table)).is_none(), "a table");
        assert!(Ground::find(&cameras, &covered, &seen(0.0)).is_some());
        covered.iter_mut().for_each(|covered| covered.fill(true));
        assert!(Ground::find(&cameras, &covered, &seen(0.0)).is_none(), "a mover");
        assert!(Ground::find(&cameras, &nothing_moves(), &of(&|_| 0.0)).is_none(), "nothing");
    }

    #[test]
    fn levelling_ends_at_the_ground() {
        let cameras = cameras(0.0);
        let right = Ground::known(DVec3::NEG_Y, -ABOVE);
        let tilted = Ground::known(DVec3::new(0.002, -1.0, 0.005).normalize(), -1.015 * ABOVE);
        let k = &cameras.intrinsics;
        let d = |ground: &Ground, i: usize| {
            ground.from(&cameras.poses[0]).unwrap().dot(k.ray(centre(i, WIDTH as usize)))
        };
        // A sweep finds a share of the ground's true offset; above one, it finds too much.
        for share in [0.5, 1.0, 1.9] {
            let sweep = |ground: &Ground| {
                let mut seen = seen(0.0).swap_remove(0);
                for i in 0..PIXELS {
                    let (now, truth) = (d(ground, i), d(&right, i));
                    seen.support[i] = f32::from(truth > 0.05 && now > 0.05);
                    seen.inverse_depth[i] = (now * (truth / now).powf(share)) as f32;
                }
                vec![(0, seen)]
            };
            let found = tilted.levelled(&cameras, sweep);
            assert!(found.normal.angle_between(right.normal) < 0.001, "{share}: {found:?}");
            assert!((found.level / right.level - 1.0).abs() < 0.002, "{share}: {found:?}");
        }
    }
}

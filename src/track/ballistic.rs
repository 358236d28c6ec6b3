//! The distance of objects that fly, from the parabolas of their paths.
//!
//! Only gravity accelerates an object in flight, and it is the same for all objects. So the paths of their centres of
//! mass are parabolas with a common second derivative. A camera that moves determines such a parabola in the world's
//! unit from the pixels of the object's middle alone (trajectory triangulation, Park et al., ECCV 2010, with a basis
//! of three functions). Of the object's observed depths only the change from each frame to the next is used: structure
//! from motion drifts, and so does the size of an outline.
//!
//! The centre of an object without a known structure, and of one whose structure does not show it, is the middle of its
//! outline. The points that are seen are no substitute: as the object turns they give way to others.
//!
//! An object that is thrown or bounces flies in a part of its frames. The longest part in which a parabola explains
//! its middles to a fraction of a pixel is used.

use std::ops::Range;

use glam::{DMat3, DVec2, DVec3};
use nalgebra::{Cholesky, DMatrix, DVector, Dyn};
use rayon::prelude::*;

use super::cameras::Cameras;
use super::path::Estimate;
use super::{pixel_gradients, quantile};

/// Minimum number of frames of a flight, and the minimum share of the frames with a known middle.
const LEAST: (usize, f64) = (8, 0.4);
/// Standard deviation of a middle, and the width of its robust kernel, pixels at a width of 320: if the object's
/// structure shows its centre, and if its outline alone does, which changes as it turns.
const MIDDLE: (f64, f64) = (0.3, 1.0);
/// Maximum distance of the middles from the parabola, in standard deviations: the median and the last decile.
const FITS: (f64, f64) = (1.33, 5.0);
/// Minimum downward acceleration of what flies, in standard deviations.
const FALLS: f64 = 4.0;
/// Minimum difference of the cost of a straight path to that of one that falls, per frame, of an object that is known
/// to fly by the acceleration of the others.
const EVIDENT: f64 = 0.5;
/// Maximum standard deviation of the logarithm of a distance that is used.
const LINEAR: f64 = 0.3;
/// Minimum standard deviation of the change of an observed depth from frame to frame, logarithm.
const LEAST_DRIFT: f64 = 0.01;
/// Distances from which a fit starts, in units of the static world's median depth.
const STARTS: [f64; 5] = [0.3, 0.5, 0.8, 1.2, 2.0];
/// Factor from the length of a part of the path to that of the next shorter one that is tried, and the share of the
/// length by which parts are shifted.
const PARTS: (f64, f64) = (0.9, 0.1);
/// Maximum number of steps of a fit, and the relative change of its cost at which it ends.
const STEPS: (usize, f64) = (60, 1e-7);
/// Unit of time in the equations, frames.
const UNIT: f64 = 10.0;

/// An object's middle in a frame in which it is known.
#[derive(Clone, Copy)]
pub(super) struct Middle {
    /// The frame of the clip.
    pub frame: usize,
    pub pixel: DVec2,
    /// Whether the object's structure gives the middle, or its outline alone.
    pub structured: bool,
    /// Logarithm of the depth, up to a constant.
    pub depth: f64,
    /// Standard deviation of the change of that logarithm since the middle before.
    pub drift: f64,
}

/// The path of an object.
#[derive(Clone)]
pub(super) struct Path {
    /// The frames of the clip in which the object exists.
    pub frames: Range<usize>,
    /// Its known middles, in the order of the frames.
    pub middles: Vec<Middle>,
}

/// The part of an object's path in which it flies.
pub(super) struct Flight {
    /// The frames of the clip. A flight that begins with the object's first known middle includes all frames before
    /// it, in which the object is seen only in part as it enters the image; likewise at the end.
    pub frames: Range<usize>,
    /// The depth of the object's middle in the world's unit, frame by frame.
    pub depths: Vec<f64>,
    /// Standard deviation of the logarithm of the depths as a whole.
    pub deviation: f64,
}

/// The flights of objects. `None` for an object that does not fly, or whose distance remains unknown.
pub(super) fn flights(paths: &[Path], cameras: &Cameras) -> Vec<Option<Flight>> {
    let size = (f64::from(cameras.intrinsics.width) / 320.0).max(1.0);
    let directions = match cameras.up() {
        Some(up) => vec![-up],
        None => vec![DVec3::X, DVec3::Y, DVec3::Z],
    };
    let world = World { cameras, directions, size };
    let sights: Vec<Vec<Sight>> = paths
        .iter()
        .map(|path| path.middles.iter().map(|middle| world.sight(middle)).collect())
        .collect();
    let falls = |fit: &Fit| world.gravity(fit).is_some_and(|g| g.value > FALLS * g.deviation);
    let flying = |object: usize, falls: &(dyn Fn(&Fit) -> bool + Sync)| {
        let (part, alone) = world.longest(&sights[object], falls)?;
        Some(Flying { object, sights: sights[object][part].to_vec(), alone })
    };
    let mut found: Vec<Flying> =
        (0..paths.len()).into_par_iter().filter_map(|object| flying(object, &falls)).collect();
    let mut out: Vec<Option<Flight>> = paths.iter().map(|_| None).collect();
    let Some(mut joint) = world.consistent(&mut found) else { return out };
    // What does not show alone that it falls may show it with the acceleration that the others show.
    let others: Vec<usize> =
        (0..paths.len()).filter(|i| found.iter().all(|known| known.object != *i)).collect();
    for object in others {
        let Some(candidate) = flying(object, &|_| true) else { continue };
        found.push(candidate);
        let added = world.joint(&found).filter(|joint| world.falls(&found, joint));
        match added {
            Some(added) => joint = added,
            None => drop(found.pop()),
        }
    }
    for (k, Flying { object, sights, .. }) in found.iter().enumerate() {
        out[*object] = world.flight(&paths[*object], sights, &joint, k);
    }
    out
}

/// The cameras, and the directions in which gravity may act: down, or all if the ground is not known.
struct World<'a> {
    cameras: &'a Cameras,
    directions: Vec<DVec3>,
    size: f64,
}

/// A middle, and the camera that saw it.
#[derive(Clone, Copy)]
struct Sight {
    middle: Middle,
    centre: DVec3,
    view_from_world: DMat3,
}

/// An object's position and velocity (per unit of time) in the middle of the time in which it is seen.
#[derive(Clone, Copy)]
struct Arc {
    time: f64,
    place: DVec3,
    velocity: DVec3,
}

/// An object that flies.
struct Flying {
    object: usize,
    /// Its middles during the flight.
    sights: Vec<Sight>,
    /// Its parabola without regard to other objects.
    alone: Fit,
}

/// The parabolas of some objects.
#[derive(Clone)]
struct Fit {
    arcs: Vec<Arc>,
    /// The common acceleration along each of the directions, per squared unit of time.
    acceleration: Vec<f64>,
    /// Of the places and velocities, object by object, then of the acceleration.
    information: Cholesky<f64, Dyn>,
    cost: f64,
}

impl World<'_> {
    fn sight(&self, middle: &Middle) -> Sight {
        let pose = &self.cameras.poses[middle.frame];
        Sight {
            middle: *middle,
            centre: pose.inverse().translation,
            view_from_world: pose.rotation_matrix(),
        }
    }

    /// The longest part of an object's path that a parabola explains which is as it should be, and that parabola.
    fn longest(
        &self,
        sights: &[Sight],
        as_it_should_be: &(dyn Fn(&Fit) -> bool + Sync),
    ) -> Option<(Range<usize>, Fit)> {
        let least = LEAST.0.max((LEAST.1 * sights.len() as f64).ceil() as usize);
        let mut length = sights.len();
        while length >= least {
            let step = ((PARTS.1 * length as f64) as usize).max(1);
            let explained = |k: usize| {
                let part = step * k..step * k + length;
                let own = &sights[part.clone()];
                let fit = self.alone(own).filter(|fit| self.fits(own, fit, 0));
                fit.filter(as_it_should_be).map(|fit| (part, fit))
            };
            let parts = 0..=(sights.len() - length) / step;
            if let Some(found) = parts.into_par_iter().find_map_first(explained) {
                return Some(found);
            }
            length = ((PARTS.0 * length as f64) as usize).min(length - 1);
        }
        None
    }

    /// The parabola of one object.
    fn alone(&self, sights: &[Sight]) -> Option<Fit> {
        let start = |distance: &f64| self.fitted(&[sights], self.lifted(sights, *distance));
        STARTS.iter().filter_map(start).min_by(|a, b| a.cost.total_cmp(&b.cost))
    }

    /// The parabolas of several objects with a common acceleration: the best fit of those that start from the
    /// acceleration of one of them.
    fn joint(&self, flying: &[Flying]) -> Option<Fit> {
        if let [single] = flying {
            return Some(single.alone.clone());
        }
        let seen: Vec<&[Sight]> = flying.iter().map(|flying| flying.sights.as_slice()).collect();
        let fit = |Flying { alone, .. }: &Flying| {
            let arcs = flying.iter().map(|flying| self.falling(flying, &alone.acceleration));
            self.fitted(&seen, (arcs.collect::<Option<_>>()?, alone.acceleration.clone()))
        };
        let fits: Vec<Fit> = flying.par_iter().filter_map(fit).collect();
        fits.into_iter().min_by(|a, b| a.cost.total_cmp(&b.cost))
    }

    /// The start of an object's parabola with a given acceleration: of its own parabola and those at several
    /// distances the one that explains its middles best with it.
    fn falling(&self, Flying { sights, alone, .. }: &Flying, acceleration: &[f64]) -> Option<Arc> {
        let lifted = STARTS.iter().map(|distance| self.lifted(sights, *distance).0[0]);
        let cost = |arc: Arc| {
            let (_, _, cost) = self.equations(&[sights], &[arc], acceleration)?;
            Some((cost, arc))
        };
        let arcs = lifted.chain([alone.arcs[0]]).filter_map(cost);
        arcs.min_by(|a, b| a.0.total_cmp(&b.0)).map(|(_, arc)| arc)
    }

    /// The parabolas of the objects that fall alike; the others are removed.
    fn consistent(&self, flying: &mut Vec<Flying>) -> Option<Fit> {
        while !flying.is_empty() {
            let joint = self.joint(flying);
            // What is most off, or without a common parabola what knows its own acceleration least.
            let doubt = |k: &usize| match &joint {
                Some(joint) => quantile(self.off(&flying[*k].sights, joint, *k), 0.5),
                None => self.gravity(&flying[*k].alone).map_or(f64::INFINITY, |g| g.relative()),
            };
            let worst = (0..flying.len()).max_by(|a, b| doubt(a).total_cmp(&doubt(b)))?;
            if let Some(joint) = joint.filter(|fit| self.fits(&flying[worst].sights, fit, worst)) {
                return Some(joint);
            }
            flying.remove(worst);
        }
        None
    }

    /// Whether the last object falls, if a fit with the others explains all middles: a straight path explains its
    /// middles clearly worse.
    fn falls(&self, flying: &[Flying], joint: &Fit) -> bool {
        let fits = |(k, flying): (usize, &Flying)| self.fits(&flying.sights, joint, k);
        let Some(last) = flying.last() else { return false };
        let straight = World { directions: Vec::new(), ..*self };
        let evident = EVIDENT * last.sights.len() as f64;
        let cost = self.cost(&last.sights, joint, flying.len() - 1);
        let is_worse = |fit: Fit| straight.cost(&last.sights, &fit, 0) > cost + evident;
        flying.iter().enumerate().all(fits) && straight.alone(&last.sights).is_none_or(is_worse)
    }

    /// The magnitude of the acceleration of a fit.
    fn gravity(&self, fit: &Fit) -> Option<Estimate> {
        let first = 6 * fit.arcs.len();
        let value = DVector::from_column_slice(&fit.acceleration);
        let size = value.norm();
        let sign = if self.directions.len() == 1 { value[0].signum() } else { 1.0 };
        let mut row = DVector::zeros(first + value.len());
        row.rows_mut(first, value.len()).copy_from(&(value / size));
        let variance = row.dot(&fit.information.solve(&row));
        (size > 0.0 && variance > 0.0)
            .then(|| Estimate { value: sign * size, deviation: variance.sqrt() })
    }

    /// A parabola through the middles at their relative depths, with the given median depth.
    fn lifted(&self, sights: &[Sight], distance: f64) -> (Vec<Arc>, Vec<f64>) {
        let time = middle_time(sights);
        let usual = quantile(sights.iter().map(|s| s.middle.depth).collect(), 0.5);
        let mut information = nalgebra::Matrix3::<f64>::zeros();
        let mut right = nalgebra::Matrix3::<f64>::zeros();
        for sight in sights {
            let depth = distance * (sight.middle.depth - usual).exp();
            let ray = self.cameras.intrinsics.ray(sight.middle.pixel) * depth;
            let place = sight.centre + sight.view_from_world.transpose() * ray;
            let row = nalgebra::Vector3::from(basis(sight.middle.frame, time));
            information += row * row.transpose();
            right += row * nalgebra::RowVector3::new(place.x, place.y, place.z);
        }
        let solved = information.try_inverse().map_or(right, |inverse| inverse * right);
        let row = |k: usize| DVec3::new(solved[(k, 0)], solved[(k, 1)], solved[(k, 2)]);
        let arc = Arc { time, place: row(0), velocity: row(1) };
        (vec![arc], self.directions.iter().map(|direction| direction.dot(row(2))).collect())
    }

    /// The least-squares parabolas with robust weights, from a start, by Levenberg and Marquardt's method.
    fn fitted(
        &self,
        seen: &[&[Sight]],
        (mut arcs, mut acceleration): (Vec<Arc>, Vec<f64>),
    ) -> Option<Fit> {
        let (mut information, mut right, mut cost) = self.equations(seen, &arcs, &acceleration)?;
        let mut damping = 1e-3;
        for _ in 0..STEPS.0 {
            let mut damped = information.clone();
            for k in 0..damped.nrows() {
                damped[(k, k)] *= 1.0 + damping;
            }
            let Some(step) = Cholesky::new(damped).map(|factor| factor.solve(&right)) else {
                damping *= 10.0;
                continue;
            };
            let vector = |k: usize| DVec3::new(step[k], step[k + 1], step[k + 2]);
            let moved: Vec<Arc> = arcs
                .iter()
                .enumerate()
                .map(|(i, arc)| Arc {
                    place: arc.place + vector(6 * i),
                    velocity: arc.velocity + vector(6 * i + 3),
                    ..*arc
                })
                .collect();
            let accelerated: Vec<f64> = acceleration
                .iter()
                .enumerate()
                .map(|(k, a)| a + step[6 * arcs.len() + k])
                .collect();
            match self.equations(seen, &moved, &accelerated) {
                Some(next) if next.2 <= cost => {
                    let change = cost - next.2;
                    (arcs, acceleration) = (moved, accelerated);
                    (information, right, cost) = next;
                    damping = (0.1 * damping).max(1e-12);
                    if change <= STEPS.1 * cost {
                        break;
                    }
                }
                _ => damping *= 10.0,
            }
            if damping > 1e8 {
                break;
            }
        }
        let information = Cholesky::new(information)?;
        Some(Fit { arcs, acceleration, information, cost })
    }

    /// The normal equations of a step, and the cost; `None` if a middle is behind its camera.
    fn equations(
        &self,
        seen: &[&[Sight]],
        arcs: &[Arc],
        acceleration: &[f64],
    ) -> Option<(DMatrix<f64>, DVector<f64>, f64)> {
        let first = 6 * arcs.len();
        let count = first + self.directions.len();
        let (mut information, mut right) = (DMatrix::zeros(count, count), DVector::zeros(count));
        let mut cost = 0.0;
        for (i, (sights, arc)) in seen.iter().zip(arcs).enumerate() {
            // The derivative with respect to the parameters, from that with respect to the point in the world.
            let row = |sight: &Sight, gradient: DVec3| -> Vec<(usize, f64)> {
                let [one, time, square] = basis(sight.middle.frame, arc.time);
                let along = |k: usize| gradient.dot(self.directions[k]) * square;
                let own = (0..3).map(|k| (6 * i + k, one * gradient[k]));
                let own = own.chain((0..3).map(|k| (6 * i + 3 + k, time * gradient[k])));
                own.chain((0..self.directions.len()).map(|k| (first + k, along(k)))).collect()
            };
            let mut add = |row: &[(usize, f64)], off: f64, weight: f64| {
                for (a, x) in row {
                    right[*a] += weight * off * x;
                    for (b, y) in row {
                        information[(*a, *b)] += weight * x * y;
                    }
                }
            };
            let mut before: Option<(Vec<(usize, f64)>, f64)> = None;
            for sight in *sights {
                let at = self.view(sight, arc, acceleration);
                if at.z <= 1e-3 {
                    return None;
                }
                let deviation = self.deviation(sight);
                let off = (sight.middle.pixel - self.cameras.intrinsics.project(at)) / deviation;
                let weight = (1.0 + off.length_squared()).recip();
                cost += off.length_squared().ln_1p();
                let world_from_view = sight.view_from_world.transpose();
                for (gradient, off) in
                    pixel_gradients(&self.cameras.intrinsics, at).into_iter().zip([off.x, off.y])
                {
                    add(&row(sight, world_from_view * gradient / deviation), off, weight);
                }
                let depth = at.z.ln() - sight.middle.depth;
                let change = row(sight, world_from_view.z_axis / at.z);
                if let Some((earlier, known)) = before {
                    let drift = sight.middle.drift.max(LEAST_DRIFT);
                    let off = (known - depth) / drift;
                    let both = change.iter().zip(&earlier);
                    let difference: Vec<(usize, f64)> =
                        both.map(|((k, x), (_, y))| (*k, (x - y) / drift)).collect();
                    add(&difference, off, (1.0 + off * off).recip());
                    cost += (off * off).ln_1p();
                }
                before = Some((change, depth));
            }
        }
        Some((information, right, cost))
    }

    /// Standard deviation of a middle, pixels.
    fn deviation(&self, sight: &Sight) -> f64 {
        self.size * if sight.middle.structured { MIDDLE.0 } else { MIDDLE.1 }
    }

    /// The object in the camera frame of a sight.
    fn view(&self, sight: &Sight, arc: &Arc, acceleration: &[f64]) -> DVec3 {
        let [_, time, square] = basis(sight.middle.frame, arc.time);
        sight.view_from_world * (self.place(arc, acceleration, [time, square]) - sight.centre)
    }

    /// The object in the world, from the factors of velocity and acceleration.
    fn place(&self, arc: &Arc, acceleration: &[f64], [time, square]: [f64; 2]) -> DVec3 {
        let fallen = self.directions.iter().zip(acceleration).map(|(d, a)| *d * *a).sum::<DVec3>();
        arc.place + arc.velocity * time + fallen * square
    }

    /// The distances of an object's middles from its parabola, in standard deviations.
    fn off(&self, sights: &[Sight], fit: &Fit, object: usize) -> Vec<f64> {
        let off = |sight: &Sight| {
            let at = self.view(sight, &fit.arcs[object], &fit.acceleration);
            let off = self.cameras.intrinsics.project(at).distance(sight.middle.pixel);
            off / self.deviation(sight)
        };
        sights.iter().map(off).collect()
    }

    /// The cost of an object's middles, without that of its depths.
    fn cost(&self, sights: &[Sight], fit: &Fit, object: usize) -> f64 {
        self.off(sights, fit, object).into_iter().map(|off| (off * off).ln_1p()).sum()
    }

    /// Whether the parabola explains an object's middles.
    fn fits(&self, sights: &[Sight], fit: &Fit, object: usize) -> bool {
        let off = self.off(sights, fit, object);
        quantile(off.clone(), 0.5) < FITS.0 && quantile(off, 0.9) < FITS.1
    }

    /// An object's flight; `None` if its distance is not known well enough.
    fn flight(&self, path: &Path, sights: &[Sight], fit: &Fit, object: usize) -> Option<Flight> {
        let arc = &fit.arcs[object];
        let frame = |middle: Option<&Middle>| middle.map(|middle| middle.frame);
        let (first, last) = (sights.first()?.middle.frame, sights.last()?.middle.frame);
        let enters = frame(path.middles.first()) == Some(first);
        let leaves = frame(path.middles.last()) == Some(last);
        let start = if enters { path.frames.start } else { first };
        let frames = start..if leaves { path.frames.end } else { last + 1 };
        let depth = |frame: usize| {
            let pose = &self.cameras.poses[frame];
            let [_, time, square] = basis(frame, arc.time);
            pose.apply(self.place(arc, &fit.acceleration, [time, square])).z
        };
        let depths: Vec<f64> = frames.clone().map(depth).collect();
        // The deviation of the logarithm of the depth in the middle of the flight.
        let middle = &sights[sights.len() / 2];
        let gradient =
            middle.view_from_world.transpose().z_axis / self.view(middle, arc, &fit.acceleration).z;
        let [one, time, square] = basis(middle.middle.frame, arc.time);
        let mut row = DVector::zeros(6 * fit.arcs.len() + self.directions.len());
        for k in 0..3 {
            row[6 * object + k] = one * gradient[k];
            row[6 * object + 3 + k] = time * gradient[k];
        }
        for (k, direction) in self.directions.iter().enumerate() {
            row[6 * fit.arcs.len() + k] = square * gradient.dot(*direction);
        }
        let deviation = row.dot(&fit.information.solve(&row)).sqrt();
        let known = deviation < LINEAR && depths.iter().all(|depth| *depth > 0.0);
        known.then_some(Flight { frames, depths, deviation })
    }
}

/// The factors of place, velocity and acceleration in a frame.
fn basis(frame: usize, time: f64) -> [f64; 3] {
    let time = (frame as f64 - time) / UNIT;
    [1.0, time, 0.5 * time * time]
}

/// The middle of the time in which an object is seen, frames.
fn middle_time(sights: &[Sight]) -> f64 {
    0.5 * (sights[0].middle.frame + sights[sights.len() - 1].middle.frame) as f64
}

#[cfg(test)]
mod tests {
    use super::super::stereo::Ground;
    use super::*;
    use crate::types::{Intrinsics, Pose};
    use glam::DQuat;

    const FRAMES: usize = 24;
    const GRAVITY: f64 = 0.002;

    /// A hand-held camera; y points down.
    fn cameras(ground: bool) -> Cameras {
        let wave = |t: f64, k: f64, phase: f64| (k * t + phase).sin();
        let pose = |t: f64| {
            let shake = DVec3::new(wave(t, 0.5, 0.3), wave(t, 0.7, 1.0), wave(t, 0.4, 2.0));
            let centre = DVec3::new(0.008 * t, 0.0, 0.004 * t) + 0.015 * shake;
            let rotation = DQuat::from_rotation_y(0.01 * wave(t, 0.3, 0.0));
            Pose::new(rotation, -(rotation * centre))
        };
        let poses = (0..FRAMES).map(|t| pose(t as f64)).collect();
        let mut cameras = Cameras::known(Intrinsics::centred(280.0, 320, 180), poses);
        cameras.ground = ground.then(|| Ground::known(DVec3::NEG_Y, -1.0));
        cameras
    }

    /// What is seen of an object at `place`, with noise, and with depths that drift by 5 % over the clip.
    fn path(cameras: &Cameras, phase: f64, place: impl Fn(f64) -> DVec3) -> Path {
        let middle = |frame: usize| {
            let t = frame as f64;
            let at = cameras.poses[frame].apply(place(t));
            let noise = DVec2::new((9.1 * t + phase).sin(), (5.3 * t + 2.0 * phase).cos());
            let pixel = cameras.intrinsics.project(at) + 0.15 * noise;
            Middle {
                frame,
                pixel,
                structured: true,
                depth: at.z.ln() + 0.7 + 0.05 * t / 24.0,
                drift: 0.005,
            }
        };
        Path { frames: 0..FRAMES, middles: (0..FRAMES).map(middle).collect() }
    }

    fn thrown(t: f64) -> DVec3 {
        let t = t - 11.0;
        DVec3::new(0.03 * t, 0.5 * GRAVITY * t * t - 0.25, 0.8 + 0.01 * t)
    }

    fn other(t: f64) -> DVec3 {
        let t = t - 9.0;
        DVec3::new(-0.02 * t + 0.1, 0.5 * GRAVITY * t * t - 0.2, 1.1 - 0.008 * t)
    }

    /// The largest error of a flight's depths, logarithm.
    fn error(flight: &Flight, cameras: &Cameras, place: impl Fn(f64) -> DVec3) -> f64 {
        let off = |(frame, depth): (usize, &f64)| {
            (depth / cameras.poses[frame].apply(place(frame as f64)).z).ln().abs()
        };
        flight.frames.clone().zip(&flight.depths).map(off).fold(0.0, f64::max)
    }

    #[test]
    fn a_parabola_tells_its_distance() {
        for ground in [true, false] {
            let cameras = cameras(ground);
            let paths = [path(&cameras, 0.0, thrown), path(&cameras, 1.0, other)];
            let found = flights(&paths, &cameras);
            let [a, b] = [&found[0], &found[1]].map(|flight| flight.as_ref().unwrap());
            assert!(error(a, &cameras, thrown) < 0.06, "{ground} {}", error(a, &cameras, thrown));
            assert!(error(b, &cameras, other) < 0.06, "{ground} {}", error(b, &cameras, other));
            assert_eq!(a.frames, 0..FRAMES);
            // The common gravity makes the distances better known.
            let alone = flights(&paths[..1], &cameras);
            let alone = alone[0].as_ref().unwrap();
            assert!(a.deviation < alone.deviation, "{} {}", a.deviation, alone.deviation);
        }
    }

    #[test]
    fn what_bounces_flies_until_then() {
        let cameras = cameras(true);
        let bounces = |t: f64| {
            let fallen = if t > 17.0 { thrown(17.0).y - 0.03 * (t - 17.0) } else { thrown(t).y };
            thrown(t).with_y(fallen)
        };
        let mut path = path(&cameras, 0.0, bounces);
        // In the first frames the object enters the image, and its middle is not known.
        path.middles.drain(..3);
        let found = flights(&[path], &cameras);
        let flight = found[0].as_ref().unwrap();
        assert_eq!(flight.frames.start, 0);
        assert!((16..20).contains(&flight.frames.end), "{:?}", flight.frames);
        assert!(error(flight, &cameras, bounces) < 0.1, "{}", error(flight, &cameras, bounces));
    }

    #[test]
    fn what_does_not_fall_like_the_others_does_not_fly() {
        let cameras = cameras(true);
        // A car drives straight on; a person gestures; a balloon sinks with a tenth of the acceleration.
        let drives = |t: f64| DVec3::new(0.03 * t - 0.4, 0.2, 0.9 - 0.01 * t);
        let gestures = |t: f64| DVec3::new(0.1 * (0.8 * t).sin(), 0.05 * (1.3 * t).cos(), 0.9);
        let sinks = |t: f64| {
            let t = t - 11.0;
            DVec3::new(-0.01 * t, 0.05 * GRAVITY * t * t, 0.9 - 0.01 * t)
        };
        let still = [path(&cameras, 0.0, drives), path(&cameras, 1.0, gestures)];
        assert!(flights(&still, &cameras).iter().all(Option::is_none));
        let paths = [path(&cameras, 0.0, thrown), path(&cameras, 1.0, sinks)];
        let found = flights(&paths, &cameras);
        let thrown_alone = found[0].as_ref().unwrap();
        assert!(error(thrown_alone, &cameras, thrown) < 0.1);
        assert!(found[1].as_ref().is_none_or(|f| error(f, &cameras, sinks) < 0.3));
        // However well it knows its own acceleration, it does not keep the others from flying.
        let mut paths =
            [thrown as fn(f64) -> DVec3, other, sinks].map(|at| path(&cameras, 0.0, at));
        for middle in &mut paths[2].middles {
            let at = cameras.poses[middle.frame].apply(sinks(middle.frame as f64));
            middle.pixel = cameras.intrinsics.project(at);
        }
        let found = flights(&paths, &cameras);
        for (flight, at) in found.iter().zip([thrown as fn(f64) -> DVec3, other]) {
            assert!(error(flight.as_ref().unwrap(), &cameras, at) < 0.1);
        }
        assert!(flights(&[], &cameras).is_empty());
    }

    #[test]
    fn what_is_seen_for_a_short_time_falls_like_the_others() {
        let cameras = cameras(true);
        let mut short = path(&cameras, 1.0, other);
        short.middles.retain(|middle| (4..13).contains(&middle.frame));
        let known = |flight: &Option<Flight>| flight.as_ref().map(|flight| flight.deviation);
        let alone = known(&flights(&[short.clone()], &cameras)[0]);
        let drives = |t: f64| DVec3::new(0.03 * t - 0.4, 0.2, 0.9 - 0.01 * t);
        let paths = [path(&cameras, 0.0, thrown), short, path(&cameras, 2.0, drives)];
        let found = flights(&paths, &cameras);
        let flight = found[1].as_ref().unwrap();
        assert!(alone.is_none_or(|alone| flight.deviation < alone), "{alone:?}");
        assert!(error(flight, &cameras, other) < 0.1, "{}", error(flight, &cameras, other));
        // A car that drives straight on stays what it is.
        assert!(found[2].is_none());
    }
}

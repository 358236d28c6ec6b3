//! One step of the scaffold's control points from a frame to its neighbour: the motions that explain the flow
//! of surface points while each control point's neighbourhood stays as rigid as possible. Also, the single
//! rigid motion that explains that flow best.

use glam::{DMat3, DQuat, DVec3};
use nalgebra::{Matrix6, Vector6};

use crate::geometry::se3::matrix3;
use crate::geometry::sim3::nearest_rotation;
use crate::types::Pose;

/// Maximum number of control points that a surface point follows.
const FOLLOWED: usize = 4;
/// Weight of a difference along the line of sight relative to one across it, because depth is inferred.
const ALONG: f64 = 0.1;
/// Weight of the neighbours' rotations in a control point's own. They determine what its edges leave
/// undetermined.
const COMMON: f64 = 0.1;
/// Error in pixels at which a surface point's weight is halved.
const ROBUST: f64 = 2.0;
const ITERATIONS: usize = 5;

/// A surface point in two neighbouring frames.
pub(super) struct Match {
    pub(super) owner: usize,
    pub(super) here: DVec3,
    pub(super) there: DVec3,
    /// Unit vector of the line of sight, along which `there` is poorly known.
    pub(super) sight: DVec3,
    /// Certainty divided by the square of the pixel size in the world.
    pub(super) weight: f64,
    /// Confidence times the number of pixels that the point stands for.
    pub(super) certainty: f64,
}

impl Match {
    /// The error in pixels if the point moves to `place`.
    pub(super) fn off(&self, place: DVec3) -> f64 {
        let off = place - self.there;
        (off.dot(self.weighed(off)).max(0.0) / self.certainty).sqrt()
    }

    /// A difference of positions, weighted.
    fn weighed(&self, difference: DVec3) -> DVec3 {
        self.weight * (difference - (1.0 - ALONG) * self.sight * self.sight.dot(difference))
    }
}

/// The rigid motion that explains some surface points best, from an initial guess, by Gauss-Newton steps with
/// Cauchy's weights.
pub(super) fn rigid(matches: &[Match], guess: Pose) -> Pose {
    let mut pose = guess;
    for _ in 0..10 {
        let middle =
            matches.iter().map(|m| pose.apply(m.here)).sum::<DVec3>() / matches.len().max(1) as f64;
        let mut a = Matrix6::<f64>::zeros();
        let mut b = Vector6::<f64>::zeros();
        for m in matches {
            let moved = pose.apply(m.here);
            let off = m.there - moved;
            let robust = 1.0 / (1.0 + (m.off(moved) / ROBUST).powi(2));
            // Rotating about the middle by ω moves the point by ω × arm.
            let arm = moved - middle;
            let columns: [DVec3; 6] = [
                DVec3::X.cross(arm),
                DVec3::Y.cross(arm),
                DVec3::Z.cross(arm),
                DVec3::X,
                DVec3::Y,
                DVec3::Z,
            ];
            for (i, &ci) in columns.iter().enumerate() {
                let w = robust * m.weighed(ci);
                b[i] += w.dot(off);
                for (j, &cj) in columns.iter().enumerate() {
                    a[(i, j)] += w.dot(cj);
                }
            }
        }
        let Some(step) = a.cholesky().map(|c| c.solve(&b)) else { break };
        let turn = DQuat::from_scaled_axis(DVec3::new(step[0], step[1], step[2]));
        let shift = DVec3::new(step[3], step[4], step[5]);
        pose = Pose {
            rotation: (turn * pose.rotation).normalize(),
            translation: turn * (pose.translation - middle) + middle + shift,
        };
    }
    pose
}

/// The control points that a point follows, with their weights.
pub(super) type Bound = Vec<(usize, f64)>;

/// The nearest control point and its nearest neighbours, with weights that sum to 1.
pub(super) fn followed(
    nearest: usize,
    neighbours: &[usize],
    radius: f64,
    distance: impl Fn(usize) -> f64,
) -> Bound {
    let mut near = neighbours.to_vec();
    near.sort_by(|&a, &b| distance(a).total_cmp(&distance(b)).then(a.cmp(&b)));
    near.truncate(FOLLOWED - 1);
    near.insert(0, nearest);
    let least = distance(nearest);
    let weight = |j: usize| (0.5 * (least.powi(2) - distance(j).powi(2)) / radius.powi(2)).exp();
    let sum: f64 = near.iter().map(|&j| weight(j)).sum();
    near.into_iter().map(|j| (j, weight(j) / sum)).collect()
}

/// One step of the control points from a frame to its neighbour.
pub(super) struct Step {
    pub(super) here: Vec<Pose>,
    /// Whether each control point's pose is to be solved for.
    pub(super) free: Vec<bool>,
    pub(super) neighbours: Vec<Vec<usize>>,
    pub(super) edge_weights: Vec<f64>,
    pub(super) matches: Vec<Match>,
    pub(super) bound: Vec<Bound>,
}

impl Step {
    /// Alternates between solving for positions and rotations, from an initial guess. Control points that are
    /// not free keep the guess.
    pub(super) fn solve(&self, guess: &[Pose]) -> Vec<Pose> {
        let count = self.here.len();
        let mut turns: Vec<DQuat> = (0..count)
            .map(|i| (guess[i].rotation * self.here[i].rotation.conjugate()).normalize())
            .collect();
        let mut places: Vec<DVec3> = guess.iter().map(|pose| pose.translation).collect();
        let mut robust = vec![1.0; self.matches.len()];
        for _ in 0..ITERATIONS {
            self.move_places(&turns, &mut places, &robust);
            robust = self.robust_weights(&turns, &places);
            turns = self.turned(&turns, &places, &robust);
        }
        self.move_places(&turns, &mut places, &robust);
        (0..count)
            .map(|i| match self.free[i] {
                true => Pose {
                    rotation: (turns[i] * self.here[i].rotation).normalize(),
                    translation: places[i],
                },
                false => guess[i],
            })
            .collect()
    }

    /// The position to which the control points move a surface point.
    pub(super) fn moved(&self, m: usize, turns: &[DQuat], places: &[DVec3]) -> DVec3 {
        let here = self.matches[m].here;
        let follow =
            |&(j, w): &(usize, f64)| w * (turns[j] * (here - self.here[j].translation) + places[j]);
        self.bound[m].iter().map(follow).sum()
    }

    /// Cauchy's weights of the matches.
    fn robust_weights(&self, turns: &[DQuat], places: &[DVec3]) -> Vec<f64> {
        (0..self.matches.len())
            .map(|m| {
                let off = self.matches[m].off(self.moved(m, turns, places));
                1.0 / (1.0 + (off / ROBUST).powi(2))
            })
            .collect()
    }

    /// Half the gradient of the energy with respect to the positions.
    fn gradient(&self, turns: &[DQuat], places: &[DVec3], robust: &[f64]) -> Vec<DVec3> {
        let mut gradient = vec![DVec3::ZERO; places.len()];
        for (m, point) in self.matches.iter().enumerate() {
            let off = robust[m] * point.weighed(self.moved(m, turns, places) - point.there);
            self.bound[m].iter().for_each(|&(j, w)| gradient[j] += w * off);
        }
        for (i, near) in self.neighbours.iter().enumerate() {
            for &j in near {
                let rest = turns[i] * (self.here[j].translation - self.here[i].translation);
                let off = self.edge_weights[i] * (places[j] - places[i] - rest);
                gradient[j] += off;
                gradient[i] -= off;
            }
        }
        gradient.iter_mut().zip(&self.free).filter(|(_, free)| !**free).for_each(|(g, _)| {
            *g = DVec3::ZERO;
        });
        gradient
    }

    /// The linear part of that gradient applied to a direction.
    fn curvature(&self, direction: &[DVec3], robust: &[f64]) -> Vec<DVec3> {
        let mut out = vec![DVec3::ZERO; direction.len()];
        for (m, point) in self.matches.iter().enumerate() {
            let sum: DVec3 = self.bound[m].iter().map(|&(j, w)| w * direction[j]).sum();
            let off = robust[m] * point.weighed(sum);
            self.bound[m].iter().for_each(|&(j, w)| out[j] += w * off);
        }
        for (i, near) in self.neighbours.iter().enumerate() {
            for &j in near {
                let off = self.edge_weights[i] * (direction[j] - direction[i]);
                out[j] += off;
                out[i] -= off;
            }
        }
        out.iter_mut().zip(&self.free).filter(|(_, free)| !**free).for_each(|(g, _)| {
            *g = DVec3::ZERO;
        });
        out
    }

    /// The inverse diagonal of the linear part.
    fn preconditioner(&self, robust: &[f64]) -> Vec<f64> {
        let mut diagonal = vec![0.0; self.here.len()];
        for (m, point) in self.matches.iter().enumerate() {
            self.bound[m]
                .iter()
                .for_each(|&(j, w)| diagonal[j] += w * w * robust[m] * point.weight);
        }
        for (i, near) in self.neighbours.iter().enumerate() {
            for &j in near {
                diagonal[i] += self.edge_weights[i];
                diagonal[j] += self.edge_weights[i];
            }
        }
        diagonal.iter().map(|d| if *d > 0.0 { 1.0 / d } else { 0.0 }).collect()
    }

    /// The best positions for given rotations, by conjugate gradients.
    fn move_places(&self, turns: &[DQuat], places: &mut [DVec3], robust: &[f64]) {
        const MOST: usize = 100;
        let inverse = self.preconditioner(robust);
        let dot = |a: &[DVec3], b: &[DVec3]| a.iter().zip(b).map(|(a, b)| a.dot(*b)).sum::<f64>();
        let scaled =
            |r: &[DVec3]| -> Vec<DVec3> { r.iter().zip(&inverse).map(|(r, d)| *r * *d).collect() };
        let mut residual: Vec<DVec3> =
            self.gradient(turns, places, robust).into_iter().map(|g| -g).collect();
        let mut direction = scaled(&residual);
        let mut size = dot(&residual, &direction);
        let enough = 1e-10 * size;
        for _ in 0..MOST {
            if size <= enough {
                break;
            }
            let bent = self.curvature(&direction, robust);
            let along = dot(&direction, &bent);
            if along <= 0.0 {
                break;
            }
            let length = size / along;
            places.iter_mut().zip(&direction).for_each(|(p, d)| *p += length * *d);
            residual.iter_mut().zip(&bent).for_each(|(r, b)| *r -= length * *b);
            let next = scaled(&residual);
            let before = std::mem::replace(&mut size, dot(&residual, &next));
            let share = size / before;
            direction.iter_mut().zip(&next).for_each(|(d, n)| *d = *n + share * *d);
        }
    }

    /// The best rotations for given positions.
    fn turned(&self, turns: &[DQuat], places: &[DVec3], robust: &[f64]) -> Vec<DQuat> {
        let outer = |a: DVec3, b: DVec3| DMat3::from_cols(a * b.x, a * b.y, a * b.z);
        let mut moments = vec![DMat3::ZERO; turns.len()];
        let mut sizes = vec![0.0; turns.len()];
        for (i, near) in self.neighbours.iter().enumerate() {
            for &j in near {
                let before = self.here[j].translation - self.here[i].translation;
                let after = places[j] - places[i];
                for k in [i, j] {
                    moments[k] += self.edge_weights[i] * outer(after, before);
                    sizes[k] += self.edge_weights[i] * before.length_squared();
                }
            }
        }
        for (m, point) in self.matches.iter().enumerate() {
            let moved = self.moved(m, turns, places);
            // The error along the line of sight is ignored.
            let off = point.there - moved;
            let off = off - point.sight * point.sight.dot(off);
            for &(j, w) in &self.bound[m] {
                let before = point.here - self.here[j].translation;
                let after = turns[j] * before + off;
                let weight = robust[m] * w * point.weight;
                moments[j] += weight * outer(after, before);
                sizes[j] += weight * before.length_squared();
            }
        }
        (0..turns.len())
            .map(|i| {
                if !self.free[i] {
                    return turns[i];
                }
                let near = &self.neighbours[i];
                let common: DMat3 = near
                    .iter()
                    .fold(DMat3::from_quat(turns[i]), |sum, &j| sum + DMat3::from_quat(turns[j]));
                let share = COMMON * sizes[i] / (near.len() + 1) as f64;
                let (rotation, _) = nearest_rotation(&matrix3(&(moments[i] + common * share)));
                rotation
            })
            .collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_turn_in_the_picture_is_found() {
        // Points of a square that rotates by a tenth of a radian about its middle and is shifted.
        let turn = DQuat::from_rotation_z(0.1);
        let (middle, shift) = (DVec3::new(0.1, 0.2, 2.0), DVec3::new(0.05, -0.02, 0.0));
        let matches: Vec<Match> = (0..100)
            .map(|i| {
                let arm = DVec3::new(f64::from(i % 10) - 4.5, f64::from(i / 10) - 4.5, 0.0) * 0.02;
                let wrong = if i % 9 == 0 { DVec3::new(0.3, 0.1, 0.0) } else { DVec3::ZERO };
                Match {
                    owner: 1,
                    here: middle + arm,
                    there: middle + turn * arm + shift + wrong,
                    sight: DVec3::Z,
                    weight: 1e4,
                    certainty: 1.0,
                }
            })
            .collect();
        let found = rigid(&matches, Pose::IDENTITY);
        assert!(found.rotation.angle_between(turn) < 2e-3, "{:?}", found.rotation);
        assert!((found.apply(middle) - middle - shift).length() < 1e-3);
    }
}

//! Joint optimisation of all poses, scale factors, depths and the focal length by iteratively reweighted
//! Gauss–Newton.

use glam::DVec3;
use nalgebra::{DMatrix, DVector};
use rayon::prelude::*;

use super::{CLOSE, Problem, State};
use crate::geometry::envelope::Envelope;
use crate::geometry::se3::{self, Twist, skew};
use crate::observe::pointmaps::quantile;
use crate::types::Pose;

/// Maximum number of steps.
const STEPS: usize = 60;
/// Relative decrease of the cost below which the optimisation ends.
const SETTLED: f64 = 1e-6;
/// The threshold of the robust cost is lowered again, at most `NARROWINGS` times, while the median
/// deviation falls below this share of its former value.
const NARROWER: f64 = 0.8;
const NARROWINGS: usize = 8;
/// Rounds of reweighting for each depth.
const ROUNDS: usize = 5;
/// Damping that fixes the unobservable global scale.
const DAMPING: f64 = 1e-8;
/// Maximum number of times that a step is halved when it does not lower the cost, because a linearised step
/// overshoots on rotations.
const HALVINGS: usize = 8;

/// A matrix over a frame's unknowns, lower triangle; the indices of the unknowns ascend.
struct Local {
    unknowns: Vec<usize>,
    matrix: DMatrix<f64>,
    right: DVector<f64>,
}

/// Index of each unknown: for each frame its pose and the factors of the pairs that end at it, and last the
/// focal length.
struct Places {
    /// First of six indices per frame; `None` for the first frame, which is fixed.
    poses: Vec<Option<usize>>,
    scales: Vec<usize>,
    focal: Option<usize>,
    count: usize,
}

impl Places {
    fn new(problem: &Problem) -> Places {
        let mut places = Places {
            poses: Vec::new(),
            scales: vec![0; problem.pairs.len()],
            focal: None,
            count: 0,
        };
        for (frame, told) in problem.told.iter().enumerate() {
            places.poses.push((frame > 0).then_some(places.count));
            places.count += if frame > 0 { 6 } else { 0 };
            for (e, _) in told {
                let [a, b] = problem.pairs[*e].frames;
                if a.max(b) == frame {
                    places.scales[*e] = places.count;
                    places.count += 1;
                }
            }
        }
        if !problem.held {
            places.focal = Some(places.count);
            places.count += 1;
        }
        places
    }

    /// All unknowns that the residuals of a frame's maps depend on.
    fn of_frame(&self, problem: &Problem, frame: usize) -> Vec<usize> {
        let mut unknowns: Vec<usize> = self.focal.into_iter().collect();
        for (e, k) in &problem.told[frame] {
            unknowns.push(self.scales[*e]);
            if *k == 1 {
                let poses = problem.pairs[*e].frames.into_iter().filter_map(|f| self.poses[f]);
                unknowns.extend(poses.flat_map(|first| first..first + 6));
            }
        }
        unknowns.sort_unstable();
        unknowns.dedup();
        unknowns
    }
}

/// A map's point at a grid point, multiplied by the pair's factor.
struct Seen {
    /// In the camera frame of the pair.
    in_pair: DVec3,
    /// In the camera frame of the frame.
    point: DVec3,
    /// Logarithm of the confidence.
    confidence: f64,
    /// Weight of the squared residual.
    weight: f64,
}

/// Huber's cost (1964, up to a factor) of a relative deviation, and the weight of the corresponding squared
/// residual.
fn robust(off: f64, close: f64) -> (f64, f64) {
    let cost = if off < close { 0.5 * off * off / close } else { off - 0.5 * close };
    (cost, 1.0 / off.max(close))
}

/// Collects in `seen` the points of all maps at one grid point of a frame, with robust weights for the
/// given inverse depth, and returns the weighted least-squares inverse depth; 0 where there is none.
fn weighed(
    problem: &Problem,
    state: &State,
    frame: usize,
    views: &[Pose],
    place: usize,
    inverse: f64,
    seen: &mut Vec<Option<Seen>>,
) -> f64 {
    let ray = problem.ray(place, state.focal);
    let (mut above, mut below) = (0.0, 0.0);
    seen.clear();
    for ((e, k), pose) in problem.told[frame].iter().zip(views) {
        let view = &problem.pairs[*e].views[*k];
        let confidence = view.weights[place];
        if confidence <= 0.0 || inverse <= 0.0 {
            seen.push(None);
            continue;
        }
        let in_pair = state.scales[*e].exp() * view.points[place];
        let point = pose.apply(in_pair);
        let weight = confidence * robust((inverse * point - ray).length(), state.close).1;
        above += weight * point.dot(ray);
        below += weight * point.length_squared();
        seen.push(Some(Seen { in_pair, point, confidence, weight }));
    }
    let inverse = above / below;
    if inverse > 0.0 && inverse.is_finite() { inverse } else { 0.0 }
}

/// The transforms of a frame's maps into its camera.
fn views(problem: &Problem, state: &State, frame: usize) -> Vec<Pose> {
    problem.told[frame].iter().map(|view| problem.view_from_pair(state, *view)).collect()
}

/// Sets all depths to their optimum for the current cameras and factors; returns the cost and the points'
/// deviations.
fn settle(problem: &Problem, state: &mut State) -> (f64, Vec<f64>) {
    let settled: Vec<(Vec<f64>, f64, Vec<f64>)> = (0..problem.told.len())
        .into_par_iter()
        .map(|frame| {
            let views = views(problem, state, frame);
            let (mut inverse, mut cost, mut offs) = (Vec::new(), 0.0, Vec::new());
            let mut seen = Vec::new();
            for place in 0..problem.offsets.len() {
                let mut told = state.inverse[frame][place];
                for _ in 0..ROUNDS {
                    told = weighed(problem, state, frame, &views, place, told, &mut seen);
                }
                let ray = problem.ray(place, state.focal);
                for Seen { point, confidence, .. } in seen.iter().flatten() {
                    let off = (told * *point - ray).length();
                    cost += confidence * robust(off, state.close).0;
                    offs.push(off);
                }
                inverse.push(told);
            }
            (inverse, cost, offs)
        })
        .collect();
    let (mut total, mut all) = (0.0, Vec::new());
    for (frame, (inverse, cost, offs)) in settled.into_iter().enumerate() {
        state.inverse[frame] = inverse;
        total += cost;
        all.extend(offs);
    }
    (total, all)
}

/// The normal equations of a frame's maps with its depths eliminated.
fn local(problem: &Problem, state: &State, places: &Places, frame: usize) -> Local {
    let unknowns = places.of_frame(problem, frame);
    let n = unknowns.len();
    let at = |unknown: usize| unknowns.binary_search(&unknown).unwrap_or(n);
    let told = &problem.told[frame];
    let views = views(problem, state, frame);
    let focal = places.focal.map(at);
    let frame_from_world = state.poses[frame].rotation_matrix();
    // Per view, the matrix columns of its unknowns: the frame's pose, the pair's pose, the factor.
    let columns: Vec<[Option<usize>; 3]> = told
        .iter()
        .map(|(e, k)| {
            let [first, second] = problem.pairs[*e].frames;
            let pose = |f: usize| places.poses[f].filter(|_| *k == 1).map(at);
            [pose(second), pose(first), Some(at(places.scales[*e]))]
        })
        .collect();
    let (mut matrix, mut right) = (DMatrix::zeros(n, n), DVector::zeros(n));
    let mut seen = Vec::new();
    for place in 0..problem.offsets.len() {
        let known = state.inverse[frame][place];
        let inverse = weighed(problem, state, frame, &views, place, known, &mut seen);
        if inverse <= 0.0 {
            continue;
        }
        let ray = problem.ray(place, state.focal);
        let (mut coupled, mut own) = (vec![0.0; n], 0.0);
        let mut jacobian: Vec<(usize, DVec3)> = Vec::with_capacity(14);
        for (((seen, pose), columns), (e, _)) in seen.iter().zip(&views).zip(&columns).zip(told) {
            let Some(Seen { in_pair, point, weight, .. }) = seen else { continue };
            jacobian.clear();
            let turned = pose.rotation_matrix();
            let world_from_pair = state.poses[problem.pairs[*e].frames[0]].inverse();
            let [frames, pairs, scale] = *columns;
            // A motion of one camera in the world has the opposite effect on the point as the same motion
            // of the other camera.
            let in_world = world_from_pair.apply(*in_pair);
            let turn = frame_from_world * -skew(in_world);
            for (first, sign) in [(frames, -1.0), (pairs, 1.0)] {
                let Some(first) = first else { continue };
                jacobian.extend((0..3).map(|c| (first + c, sign * frame_from_world.col(c))));
                jacobian.extend((0..3).map(|c| (first + 3 + c, sign * turn.col(c))));
            }
            jacobian.extend(scale.map(|column| (column, turned * *in_pair)));
            jacobian.iter_mut().for_each(|(_, moves)| *moves *= inverse);
            jacobian.extend(focal.map(|column| (column, DVec3::new(ray.x, ray.y, 0.0))));
            let residual = inverse * *point - ray;
            for (row, a) in &jacobian {
                right[*row] -= weight * a.dot(residual);
                coupled[*row] += weight * a.dot(*point);
                for (column, b) in &jacobian {
                    matrix[(*row, *column)] += weight * a.dot(*b);
                }
            }
            own += weight * point.length_squared();
        }
        eliminate(&mut matrix, &coupled, own);
    }
    Local { unknowns, matrix, right }
}

/// Eliminates an unknown from the lower triangle, given its coupling with the others and its diagonal
/// entry. Its right-hand side is 0, because an inverse depth is at the minimum of the cost.
fn eliminate(matrix: &mut DMatrix<f64>, coupled: &[f64], own: f64) {
    let n = coupled.len();
    let values = matrix.as_mut_slice();
    for column in 0..n {
        let factor = coupled[column] / own;
        if factor != 0.0 {
            // Columns are contiguous.
            let rows = &mut values[column * n + column..(column + 1) * n];
            rows.iter_mut().zip(&coupled[column..]).for_each(|(v, c)| *v -= factor * c);
        }
    }
}

/// The normal equations of all frames.
fn normal_equations(problem: &Problem, state: &State, places: &Places) -> (Envelope, DVector<f64>) {
    let locals: Vec<Local> = (0..problem.told.len())
        .into_par_iter()
        .map(|frame| local(problem, state, places, frame))
        .collect();
    let mut first: Vec<usize> = (0..places.count).collect();
    for Local { unknowns, .. } in &locals {
        for unknown in unknowns {
            first[*unknown] = first[*unknown].min(unknowns[0]);
        }
    }
    let mut all = Envelope::zeros(first);
    let mut right = DVector::zeros(places.count);
    for Local { unknowns, matrix, right: own } in &locals {
        for (i, row) in unknowns.iter().enumerate() {
            right[*row] += own[i];
            let values = all.row_mut(*row, unknowns[0]);
            for (j, column) in unknowns[..=i].iter().enumerate() {
                values[column - unknowns[0]] += matrix[(i, j)];
            }
        }
    }
    (all, right)
}

/// The state after a step.
fn moved(state: &State, places: &Places, step: &DVector<f64>) -> State {
    let mut moved = state.clone();
    for (pose, first) in moved.poses.iter_mut().zip(&places.poses) {
        if let Some(first) = first {
            let twist = Twist::from_iterator((0..6).map(|c| step[first + c]));
            // Poses are updated in the world, so that a rotation common to many cameras leaves their
            // relative poses unchanged.
            *pose = se3::retract(&pose.inverse(), &twist).inverse();
        }
    }
    moved.scales.iter_mut().zip(&places.scales).for_each(|(scale, place)| *scale += step[*place]);
    if let Some(place) = places.focal {
        moved.focal *= step[place].exp();
    }
    moved
}

/// Optimises an initial state; returns the median deviation of the points, relative to their depth.
pub(super) fn solve(problem: &Problem, state: &mut State) -> f64 {
    let places = Places::new(problem);
    let (_, offs) = settle(problem, state);
    let mut off = quantile(offs, 0.5);
    for _ in 0..NARROWINGS {
        // The cost is quadratic within the noise, so that steps are long, and linear beyond.
        state.close = off.clamp(CLOSE[0], CLOSE[1]);
        let found = descend(problem, state, &places);
        let narrower = found < NARROWER * off && found > CLOSE[0];
        off = found;
        if !narrower {
            break;
        }
    }
    off
}

/// Takes steps until the cost no longer falls; returns the median deviation of the points.
fn descend(problem: &Problem, state: &mut State, places: &Places) -> f64 {
    let (mut cost, mut offs) = settle(problem, state);
    for _ in 0..STEPS {
        let (mut equations, right) = normal_equations(problem, state, places);
        for row in 0..places.count {
            *equations.diagonal_mut(row) += DAMPING * equations.diagonal(row) + f64::MIN_POSITIVE;
        }
        let Some(factor) = equations.cholesky() else { break };
        let mut step = factor.solve(&right);
        let before = cost;
        for _ in 0..HALVINGS {
            let mut trial = moved(state, places, &step);
            let (found, off) = settle(problem, &mut trial);
            if found < cost {
                (*state, cost, offs) = (trial, found, off);
                break;
            }
            step *= 0.5;
        }
        if before - cost <= SETTLED * before {
            break;
        }
    }
    quantile(offs, 0.5)
}

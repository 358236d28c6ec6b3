//! The normal equations, reduced to the cameras.

use super::super::envelope::Envelope;
use super::residual::{Jacobian, focal_prior, kernel, project_through, relative};
use super::{Kernel, Observation, Options, Problem, counts};
use crate::geometry::se3::{Twist, retract};
use glam::DVec2;
use nalgebra::DVector;
use rayon::prelude::*;
use std::ops::Range;
use std::slice::from_ref;

/// Maximum number of parts in which the reduced system is accumulated; they are added in order, so that the
/// result is bit-identical for any number of threads.
const PARTS: usize = 8;
/// Minimum information (pixels² per unit of relative inverse depth²) of every depth, so that a point
/// without parallax keeps its depth instead of causing a division by zero.
const DEPTH_FLOOR: f64 = 1e-6;

/// Layout of the unknowns in the reduced system.
pub(super) struct Layout {
    /// First column of each frame's twist; `None` where it is fixed.
    column: Vec<Option<usize>>,
    /// Number of columns of a frame's twist: 6, or 3 with fixed rotations.
    width: usize,
    /// Column of log f.
    focal: Option<usize>,
    /// Column of k1.
    distortion: Option<usize>,
    /// Number of columns.
    pub(super) size: usize,
    /// First column that each column is coupled with.
    coupled: Vec<usize>,
    /// Whether inverse depths are unknown.
    depths: bool,
    /// The used observations of each point.
    by_point: Vec<Vec<usize>>,
}

impl Layout {
    pub(super) fn new(problem: &Problem, options: &Options, focal: bool) -> Layout {
        let none_fixed = !problem.fixed.iter().any(|f| *f);
        let width = if options.rotations { 6 } else { 3 };
        let mut size = 0;
        let column: Vec<Option<usize>> = problem
            .fixed
            .iter()
            .enumerate()
            .map(|(i, fixed)| {
                let held = *fixed || (none_fixed && i == 0);
                (!held).then(|| {
                    size += width;
                    size - width
                })
            })
            .collect();
        let focal = focal.then(|| {
            size += 1;
            size - 1
        });
        let distortion = options.distortion.then(|| {
            size += 1;
            size - 1
        });
        let mut by_point = vec![Vec::new(); problem.points.len()];
        for (i, o) in problem.observations.iter().enumerate() {
            if counts(problem, o) {
                by_point[o.point].push(i);
            }
        }
        // Unknowns that are coupled with all others come last, and their rows begin at the first column.
        let mut coupled = vec![0; size];
        column.iter().flatten().for_each(|&c| coupled[c..c + width].fill(c));
        for (point, members) in problem.points.iter().zip(&by_point) {
            let seen = || members.iter().map(|m| problem.observations[*m].frame);
            let frames = || seen().chain([point.frame]).filter_map(|frame| column[frame]);
            let Some(first) = frames().min() else { continue };
            for c in frames() {
                let first = first.min(coupled[c]);
                coupled[c..c + width].fill(first);
            }
        }
        let depths = options.depths;
        Layout { column, width, focal, distortion, size, coupled, depths, by_point }
    }

    /// The column of log f; `None` where it is kept.
    pub(super) fn focal(&self) -> Option<usize> {
        self.focal
    }

    /// The column of k1; `None` where it is kept.
    pub(super) fn distortion(&self) -> Option<usize> {
        self.distortion
    }

    /// The columns of a frame's twist, translation first and then the rotation unless rotations are fixed;
    /// `None` where the frame is fixed.
    pub(super) fn columns(&self, frame: usize) -> Option<Range<usize>> {
        self.column[frame].map(|first| first..first + self.width)
    }

    /// Applies a step. Inverse depths are clamped at 0, a point at infinity.
    pub(super) fn apply(&self, problem: &mut Problem, delta: &Step) {
        for (pose, column) in problem.poses.iter_mut().zip(&self.column) {
            if let Some(c) = *column {
                let mut twist = Twist::zeros();
                (0..self.width).for_each(|k| twist[k] = delta.camera[c + k]);
                *pose = retract(pose, &twist);
            }
        }
        if let Some(c) = self.focal {
            let factor = delta.camera[c].clamp(-1.0, 1.0).exp();
            problem.intrinsics.fx *= factor;
            problem.intrinsics.fy *= factor;
        }
        if let Some(c) = self.distortion {
            problem.k1 = (problem.k1 + delta.camera[c]).clamp(-1.0, 1.0);
        }
        if self.depths {
            for (point, d) in problem.points.iter_mut().zip(&delta.depth) {
                point.inverse_depth = (point.inverse_depth + d).max(0.0);
            }
        }
    }
}

/// A change of all unknowns.
pub(super) struct Step {
    camera: DVector<f64>,
    depth: Vec<f64>,
}

/// A point's row: information and gradient of its inverse depth, and its coupling with the cameras.
#[derive(Default)]
struct Row {
    information: f64,
    gradient: f64,
    /// The information with its lower bound, which damping scales.
    floor: f64,
    /// Coupling with the twists of frames, the focal length and the distortion.
    coupling: Coupling,
}

/// A sparse vector over the columns, stored as runs of consecutive columns.
#[derive(Default)]
struct Coupling {
    /// First column of each run, and the range of its entries in `values`.
    runs: Vec<(usize, Range<usize>)>,
    values: Vec<f64>,
}

impl Coupling {
    /// Sums blocks, each given by its first column, its entries and their number, in any order.
    fn sum(mut blocks: Vec<(usize, [f64; 6], usize)>) -> Coupling {
        blocks.sort_by_key(|block| block.0);
        let mut sum = Coupling::default();
        let mut last = None;
        for (column, values, width) in blocks {
            let end = sum.values.len();
            if last == Some(column) {
                let own = &mut sum.values[end - width..];
                own.iter_mut().zip(&values).for_each(|(sum, value)| *sum += value);
                continue;
            }
            match sum.runs.last_mut() {
                Some((first, run)) if *first + run.len() == column => run.end += width,
                _ => sum.runs.push((column, end..end + width)),
            }
            sum.values.extend(&values[..width]);
            last = Some(column);
        }
        sum
    }

    /// First column and entries of each run, in ascending order.
    fn runs(&self) -> impl Iterator<Item = (usize, &[f64])> {
        self.runs.iter().map(|(first, run)| (*first, &self.values[run.clone()]))
    }

    /// Dot product with a dense vector over the columns.
    fn dot(&self, all: &[f64]) -> f64 {
        let of_run = |(first, run): (usize, &[f64])| {
            run.iter().zip(&all[first..]).map(|(a, b)| a * b).sum::<f64>()
        };
        self.runs().map(of_run).sum()
    }

    /// Adds this vector, times `factor`, to a dense vector over the columns.
    fn add_to(&self, all: &mut [f64], factor: f64) {
        for (first, run) in self.runs() {
            all[first..].iter_mut().zip(run).for_each(|(sum, value)| *sum += factor * value);
        }
    }

    /// Adds the outer product of this vector with itself, times `factor`, to the lower triangle.
    fn add_square_to(&self, matrix: &mut Envelope, factor: f64) {
        for (place, (first, run)) in self.runs().enumerate() {
            for (row, value) in (first..).zip(run) {
                let scaled = factor * value;
                for (column, other) in self.runs().take(place + 1) {
                    // Within its own run, a row ends at the diagonal.
                    let sums = matrix.row_mut(row, column);
                    sums.iter_mut().zip(other).for_each(|(sum, value)| *sum += scaled * value);
                }
            }
        }
    }
}

/// What the rows of all points are made from.
struct System<'a> {
    problem: &'a Problem,
    layout: &'a Layout,
    kernel: Kernel,
    /// Width of the robust kernel, over the residuals' deviation.
    kernel_width: f64,
    /// Minimum information of an inverse depth.
    depth_floor: f64,
}

impl<'a> System<'a> {
    fn new(problem: &'a Problem, options: &Options, layout: &'a Layout, scale: f64) -> System<'a> {
        let typical = super::median_inverse_depth(problem).unwrap_or(1.0);
        System {
            problem,
            layout,
            kernel: options.kernel,
            kernel_width: options.kernel_width * scale,
            depth_floor: DEPTH_FLOOR / (typical * typical),
        }
    }

    /// An observation's residual in pixels, its weight with the robust kernel, and the derivatives of its
    /// projection; `None` where it is not projected.
    fn residual(&self, o: &Observation) -> Option<(DVec2, f64, Jacobian)> {
        let System { problem, kernel_width, .. } = *self;
        let point = &problem.points[o.point];
        let (u, jacobian) = project_through(
            &problem.intrinsics,
            problem.k1,
            &relative(problem, o),
            point.pixel,
            point.inverse_depth,
        )?;
        let r = u - o.pixel;
        let (variance, squared) = (o.deviation.powi(2), r.length_squared());
        let w = o.weight * kernel(self.kernel, squared / variance, kernel_width).1 / variance;
        Some((r, w, jacobian))
    }
}

/// Jᵀ W J and Jᵀ W r: the camera block, and a row for each point.
pub(super) struct NormalEquations {
    camera: Envelope,
    gradient: DVector<f64>,
    rows: Vec<Row>,
}

impl NormalEquations {
    pub(super) fn build(
        problem: &Problem,
        options: &Options,
        layout: &Layout,
        scale: f64,
    ) -> NormalEquations {
        let system = System::new(problem, options, layout, scale);
        let part = problem.points.len().div_ceil(PARTS).max(1);
        let parts: Vec<NormalEquations> = layout
            .by_point
            .par_chunks(part)
            .enumerate()
            .map(|(p, members)| {
                let mut sum = NormalEquations::empty(layout);
                for (k, members) in members.iter().enumerate() {
                    let row = sum.add_point(&system, p * part + k, members);
                    sum.rows.push(row);
                }
                sum
            })
            .collect();
        let mut total = NormalEquations::empty(layout);
        for part in parts {
            total.camera.add(1.0, &part.camera);
            total.gradient += part.gradient;
            total.rows.extend(part.rows);
        }
        if let (Some(c), Some((w, e))) = (layout.focal, focal_prior(problem, options, scale)) {
            *total.camera.diagonal_mut(c) += w;
            total.gradient[c] += w * e;
        }
        total
    }

    fn empty(layout: &Layout) -> NormalEquations {
        NormalEquations {
            camera: Envelope::zeros(layout.coupled.clone()),
            gradient: DVector::zeros(layout.size),
            rows: Vec::new(),
        }
    }

    /// Adds a point's observations to the camera block (lower triangle), and returns the point's row.
    fn add_point(&mut self, system: &System, index: usize, members: &[usize]) -> Row {
        let &System { problem, layout, .. } = system;
        let point = &problem.points[index];
        let mut row = Row::default();
        // All observations depend on the reference frame, the focal length and the distortion.
        let shared = [layout.column[point.frame], layout.focal, layout.distortion];
        let mut with_shared = [[0.0; 6]; 3];
        let mut blocks = Vec::with_capacity(members.len() + shared.len());
        for &m in members {
            let o = &problem.observations[m];
            let Some((r, w, jacobian)) = system.residual(o) else { continue };
            let twist = layout.width;
            let by_shared = [
                &jacobian.reference[..twist],
                from_ref(&jacobian.log_focal),
                from_ref(&jacobian.k1),
            ];
            let run = |column: Option<usize>, derivatives| Some((column?, derivatives));
            let runs = [
                run(layout.column[o.frame], &jacobian.target[..twist]),
                run(shared[0], by_shared[0]),
                run(shared[1], by_shared[1]),
                run(shared[2], by_shared[2]),
            ];
            for later in runs.into_iter().flatten() {
                let gradient = self.gradient.as_mut_slice()[later.0..].iter_mut();
                gradient.zip(later.1).for_each(|(sum, j)| *sum += w * j.dot(r));
                for earlier in runs.into_iter().flatten().filter(|run| run.0 <= later.0) {
                    self.add_block(w, later, earlier);
                }
            }
            if layout.depths {
                let jd = jacobian.inverse_depth;
                let with_depth = |derivative: &DVec2| w * derivative.dot(jd);
                row.information += with_depth(&jd);
                row.gradient += w * jd.dot(r);
                if let Some((column, derivatives)) = runs[0] {
                    let mut sums = [0.0; 6];
                    sums.iter_mut().zip(derivatives).for_each(|(sum, j)| *sum = with_depth(j));
                    blocks.push((column, sums, twist));
                }
                for (sums, derivatives) in with_shared.iter_mut().zip(by_shared) {
                    sums.iter_mut().zip(derivatives).for_each(|(sum, j)| *sum += with_depth(j));
                }
            }
        }
        if layout.depths {
            for ((column, sums), width) in
                shared.into_iter().zip(with_shared).zip([layout.width, 1, 1])
            {
                blocks.extend(column.map(|column| (column, sums, width)));
            }
            row.coupling = Coupling::sum(blocks);
        }
        if let Some(prior) = point.prior {
            row.information += prior.weight;
            row.gradient += prior.weight * (point.inverse_depth - prior.inverse_depth);
        }
        row.floor = system.depth_floor;
        row
    }

    /// Adds products of derivatives with respect to two runs of columns, each given by its first column;
    /// `later` is not before `earlier`.
    fn add_block(&mut self, w: f64, later: (usize, &[DVec2]), earlier: (usize, &[DVec2])) {
        for (row, derivative) in (later.0..).zip(later.1) {
            let scaled = w * *derivative;
            let sums = self.camera.row_mut(row, earlier.0).iter_mut();
            sums.zip(earlier.1).for_each(|(sum, j)| *sum += scaled.dot(*j));
        }
    }

    /// The damped Gauss–Newton step; `None` where the reduced system is not positive definite.
    pub(super) fn solve(&self, layout: &Layout, damping: f64) -> Option<Step> {
        let (mut reduced, mut right) = self.reduce(layout, damping);
        let largest = self.camera.largest_diagonal().max(1e-300);
        for k in 0..layout.size {
            *reduced.diagonal_mut(k) += damping * self.camera.diagonal(k) + 1e-12 * largest;
        }
        right.neg_mut();
        let camera = reduced.cholesky()?.solve(&right);
        if camera.iter().any(|v| !v.is_finite()) {
            return None;
        }
        let depth = if layout.depths {
            self.rows
                .iter()
                .map(|row| {
                    -(row.gradient + row.coupling.dot(camera.as_slice())) / row.damped(damping)
                })
                .collect()
        } else {
            Vec::new()
        };
        Some(Step { camera, depth })
    }

    /// Schur complement over the inverse depths (lower triangle) and the reduced gradient.
    fn reduce(&self, layout: &Layout, damping: f64) -> (Envelope, DVector<f64>) {
        let part = self.rows.len().div_ceil(PARTS).max(1);
        let parts: Vec<(Envelope, DVector<f64>)> = self
            .rows
            .par_chunks(part)
            .map(|rows| {
                let mut matrix = Envelope::zeros(layout.coupled.clone());
                let mut vector = DVector::zeros(layout.size);
                for row in rows {
                    let inverse = 1.0 / row.damped(damping);
                    row.coupling.add_square_to(&mut matrix, inverse);
                    row.coupling.add_to(vector.as_mut_slice(), inverse * row.gradient);
                }
                (matrix, vector)
            })
            .collect();
        let mut matrix = self.camera.clone();
        let mut vector = self.gradient.clone();
        for (m, v) in parts {
            matrix.add(-1.0, &m);
            vector -= v;
        }
        (matrix, vector)
    }

    /// Predicted decrease of the cost for a step that solves the damped equations: gᵀ(−δ) + λ δᵀDδ.
    pub(super) fn predicted_decrease(&self, step: &Step, damping: f64) -> f64 {
        let mut sum = 0.0;
        for k in 0..step.camera.len() {
            let d = step.camera[k];
            sum += -self.gradient[k] * d + damping * self.camera.diagonal(k) * d * d;
        }
        for (row, d) in self.rows.iter().zip(&step.depth) {
            sum += -row.gradient * d + (row.damped(damping) - row.information) * d * d;
        }
        sum
    }

    /// Information about a column's unknown that remains when all others are free, in pixels² over its
    /// unit's square.
    pub(super) fn information(&self, layout: &Layout, column: usize) -> Option<f64> {
        let variance = self.covariance_column(layout, column)?[column];
        (variance.is_finite() && variance > 0.0).then(|| 1.0 / variance)
    }

    /// A column of the inverse of the reduced system: covariances per unit of the residuals' variance, with
    /// all other unknowns free. `None` where the reduced system is not positive definite.
    pub(super) fn covariance_column(&self, layout: &Layout, column: usize) -> Option<DVector<f64>> {
        let (mut reduced, _) = self.reduce(layout, 0.0);
        let largest = self.camera.largest_diagonal().max(1e-300);
        for k in 0..layout.size {
            // The free scale is a null direction; it does not affect the focal length and the lens.
            *reduced.diagonal_mut(k) += 1e-10 * self.camera.diagonal(k) + 1e-14 * largest;
        }
        let mut unit = DVector::zeros(layout.size);
        unit[column] = 1.0;
        Some(reduced.cholesky()?.solve(&unit))
    }

    /// The change of a column's unknown that each point's residuals cause, with all other unknowns free, from
    /// the [`covariance_column`](Self::covariance_column) of that unknown. The changes sum to zero at a
    /// minimum without a prior.
    pub(super) fn influences(
        &self,
        problem: &Problem,
        options: &Options,
        layout: &Layout,
        scale: f64,
        by_all: &DVector<f64>,
    ) -> Vec<f64> {
        let system = System::new(problem, options, layout, scale);
        let of_point = |(index, members): (usize, &Vec<usize>)| {
            let (point, row) = (&problem.points[index], &self.rows[index]);
            // The derivative of a residual with respect to the depth, where the cameras move along
            // `by_all`, and so does the depth, to its best value.
            let by_depth = match layout.depths {
                true => row.coupling.dot(by_all.as_slice()) / row.damped(0.0),
                false => 0.0,
            };
            let mut influence = 0.0;
            for o in members.iter().map(|m| &problem.observations[*m]) {
                let Some((r, w, jacobian)) = system.residual(o) else { continue };
                let mut along = -by_depth * jacobian.inverse_depth;
                for (frame, by) in [(o.frame, jacobian.target), (point.frame, jacobian.reference)] {
                    for (column, by) in layout.columns(frame).into_iter().flatten().zip(by) {
                        along += by_all[column] * by;
                    }
                }
                for (column, by) in
                    [(layout.focal, jacobian.log_focal), (layout.distortion, jacobian.k1)]
                {
                    along += column.map_or(DVec2::ZERO, |column| by_all[column] * by);
                }
                influence -= w * along.dot(r);
            }
            influence
        };
        layout.by_point.par_iter().enumerate().map(of_point).collect()
    }

    /// The variance of each column with all other unknowns free, per unit of the residuals' variance, where
    /// the sum of the inverse depths' changes, weighted by `gauge`, is fixed at 0. `None` for a column
    /// whose information is less than `least` of its value with all other unknowns given.
    pub(super) fn variances(
        &self,
        layout: &Layout,
        gauge: &[f64],
        least: f64,
    ) -> Option<Vec<Option<f64>>> {
        let mut reduced = self.reduce(layout, 0.0).0.to_dense();
        // Fixing a sum of depths adds a rank-one term of infinite weight to their block. Reduced to the
        // cameras, it is again a rank-one term.
        let mut held = DVector::zeros(layout.size);
        let mut norm = 0.0;
        for (row, weight) in self.rows.iter().zip(gauge).filter(|(row, _)| row.information > 0.0) {
            let scaled = weight / row.damped(0.0);
            norm += weight * scaled;
            row.coupling.add_to(held.as_mut_slice(), scaled);
        }
        if norm > 0.0 {
            reduced.ger(1.0 / norm, &held, &held, 1.0);
        }
        let largest = self.camera.largest_diagonal().max(1e-300);
        let floor = |k: usize| 0.01 * least * self.camera.diagonal(k) + 1e-14 * largest;
        (0..layout.size).for_each(|k| reduced[(k, k)] += floor(k));
        let factor = reduced.cholesky()?.unpack();
        // With S = L Lᵀ, the diagonal of S⁻¹ consists of the squared norms of the columns of L⁻¹.
        let variance = |k: usize| {
            let mut column = vec![0.0; layout.size - k];
            column[0] = 1.0;
            for j in k..layout.size {
                let of = &factor.as_slice()[j * layout.size + j..(j + 1) * layout.size];
                let (solved, below) = column[j - k..].split_first_mut()?;
                *solved /= of[0];
                below.iter_mut().zip(&of[1..]).for_each(|(b, l)| *b -= *solved * l);
            }
            let variance: f64 = column.iter().map(|v| v * v).sum();
            let given = self.camera.diagonal(k);
            let known = given > 0.0 && variance.is_finite() && variance * given * least < 1.0;
            known.then_some(variance)
        };
        Some((0..layout.size).into_par_iter().map(variance).collect())
    }
}

impl Row {
    fn damped(&self, damping: f64) -> f64 {
        self.information * (1.0 + damping) + self.floor
    }
}

/// Median of σ_d / d over the observed points, with poses fixed.
pub(super) fn median_depth_deviation(problem: &Problem, options: &Options, scale: f64) -> f64 {
    let with_depths = Options { depths: true, ..*options };
    let layout = Layout::new(problem, &with_depths, false);
    let equations = NormalEquations::build(problem, &with_depths, &layout, scale);
    let mut deviations: Vec<f64> = (0..problem.points.len())
        .filter(|&i| !layout.by_point[i].is_empty())
        .map(|i| {
            let (information, d) = (equations.rows[i].information, problem.points[i].inverse_depth);
            if information > 0.0 && d > 0.0 {
                scale / (information.sqrt() * d)
            } else {
                f64::INFINITY
            }
        })
        .collect();
    if deviations.is_empty() {
        return f64::INFINITY;
    }
    let middle = deviations.len() / 2;
    *deviations.select_nth_unstable_by(middle, f64::total_cmp).1
}

#[cfg(test)]
mod tests {
    use glam::{DQuat, DVec3};
    use nalgebra::DMatrix;

    use super::super::{Point, project};
    use super::*;
    use crate::types::{Intrinsics, Pose};

    /// A camera that moves sideways; each frame has its own points, which the `span` frames after it see
    /// except for the third, all with an error of one pixel.
    fn sideways(frames: usize, span: usize) -> Problem {
        let intrinsics = Intrinsics::centred(300.0, 320, 240);
        let pose = |i: usize| {
            Pose::new(DQuat::from_rotation_y(0.02 * i as f64), DVec3::new(0.1 * i as f64, 0.0, 0.0))
        };
        let poses: Vec<Pose> = (0..frames).map(pose).collect();
        let (mut points, mut observations) = (Vec::new(), Vec::new());
        for frame in 0..frames {
            for k in 0..4 {
                let pixel = DVec2::new(60.0 + 50.0 * k as f64, 40.0 + 37.0 * k as f64);
                let inverse_depth = 0.2 + 0.1 * k as f64;
                for other in frame + 1..frames.min(frame + span) {
                    let relative = poses[other] * poses[frame].inverse();
                    let (seen, _) = project(&intrinsics, &relative, pixel, inverse_depth).unwrap();
                    let pixel = seen + DVec2::new(1.0, -0.5);
                    let observation = Observation {
                        point: points.len(),
                        frame: other,
                        pixel,
                        weight: 0.5,
                        deviation: 0.5,
                    };
                    observations.extend((other != frame + 3).then_some(observation));
                }
                points.push(Point { frame, pixel, inverse_depth, prior: None });
            }
        }
        let fixed = vec![false; frames];
        Problem { intrinsics, k1: -0.02, poses, fixed, points, observations }
    }

    /// Solves the dense damped normal equations, including all inverse depths, for the cameras.
    fn dense(problem: &Problem, layout: &Layout, damping: f64) -> DVector<f64> {
        let size = layout.size + problem.points.len();
        let mut matrix = DMatrix::zeros(size, size);
        let mut gradient = DVector::zeros(size);
        for o in &problem.observations {
            let point = &problem.points[o.point];
            let (pixel, d) = (point.pixel, point.inverse_depth);
            let relative = relative(problem, o);
            let (u, j) =
                project_through(&problem.intrinsics, problem.k1, &relative, pixel, d).unwrap();
            let mut row = vec![DVec2::ZERO; size];
            for (frame, by) in [(o.frame, j.target), (point.frame, j.reference)] {
                for (column, by) in layout.columns(frame).into_iter().flatten().zip(by) {
                    row[column] = by;
                }
            }
            row[layout.focal.unwrap()] = j.log_focal;
            row[layout.distortion.unwrap()] = j.k1;
            row[layout.size + o.point] = j.inverse_depth;
            let w = o.weight / o.deviation.powi(2);
            for a in 0..size {
                gradient[a] += w * row[a].dot(u - o.pixel);
                (0..size).for_each(|b| matrix[(a, b)] += w * row[a].dot(row[b]));
            }
        }
        let typical = super::super::median_inverse_depth(problem).unwrap();
        let cameras = matrix.diagonal().rows(0, layout.size).max();
        for k in 0..size {
            let floor = match k < layout.size {
                true => 1e-12 * cameras,
                false => DEPTH_FLOOR / (typical * typical),
            };
            matrix[(k, k)] += damping * matrix[(k, k)] + floor;
        }
        -matrix.cholesky().unwrap().solve(&gradient).rows(0, layout.size)
    }

    #[test]
    fn a_step_is_that_of_the_dense_normal_equations() {
        let problem = sideways(9, 6);
        for rotations in [true, false] {
            let options =
                Options { kernel: Kernel::None, distortion: true, rotations, ..Options::default() };
            let layout = Layout::new(&problem, &options, true);
            assert_eq!(layout.size, 2 + if rotations { 8 * 6 } else { 8 * 3 });
            let equations = NormalEquations::build(&problem, &options, &layout, 1.0);
            let expected = dense(&problem, &layout, 1e-2);
            let found = equations.solve(&layout, 1e-2).unwrap().camera;
            assert!(expected.amax() > 1e-4);
            assert!((found - &expected).amax() < 1e-9 * expected.amax());
        }
    }

    #[test]
    fn memory_grows_linearly_with_the_number_of_frames() {
        let entries = |frames| {
            let layout = Layout::new(&sideways(frames, 8), &Options::default(), true);
            let size = layout.size * (layout.size + 1) / 2;
            (layout.coupled.iter().enumerate().map(|(row, c)| row + 1 - c).sum::<usize>(), size)
        };
        let [few, many, more] = [50, 100, 150].map(entries);
        assert_eq!(more.0 - many.0, many.0 - few.0);
        assert!(many.0 < many.1 / 5, "{} of {}", many.0, many.1);
    }
}

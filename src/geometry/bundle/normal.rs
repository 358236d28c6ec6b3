//! The normal equations, reduced to the cameras.

use super::residual::{focal_prior, kernel, project_through, relative};
use super::{Options, Problem, counts};
use crate::geometry::se3::{Twist, retract};
use glam::DVec2;
use nalgebra::{DMatrix, DVector};
use rayon::prelude::*;
use std::ops::Range;

/// Columns that one observation touches at most: two poses, the focal length and the distortion.
const COLUMNS: usize = 14;
/// The reduced system is gathered in this many parts at the most, added in order: the same bits for
/// any number of threads.
const PARTS: usize = 8;
/// Information (pixels² per unit of relative inverse depth²) that every depth is taken to have, so
/// that a point without parallax stays where it is instead of dividing by nothing.
const DEPTH_FLOOR: f64 = 1e-6;

/// Which unknown stands where in the reduced system.
pub(super) struct Layout {
    /// First column of each frame's twist; none where it is held.
    column: Vec<Option<usize>>,
    /// Column of log f.
    focal: Option<usize>,
    /// Column of k1.
    distortion: Option<usize>,
    /// Number of columns.
    pub(super) size: usize,
    /// Are inverse depths unknown?
    depths: bool,
    /// Observations that count, by point.
    by_point: Vec<Vec<usize>>,
}

impl Layout {
    pub(super) fn new(problem: &Problem, options: &Options, focal: bool) -> Layout {
        let none_fixed = !problem.fixed.iter().any(|f| *f);
        let mut size = 0;
        let column = problem
            .fixed
            .iter()
            .enumerate()
            .map(|(i, fixed)| {
                let held = *fixed || (none_fixed && i == 0);
                (!held).then(|| {
                    size += 6;
                    size - 6
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
        Layout { column, focal, distortion, size, depths: options.depths, by_point }
    }

    /// The column of log f; none where it is kept.
    pub(super) fn focal(&self) -> Option<usize> {
        self.focal
    }

    /// The column of k1; none where it is kept.
    pub(super) fn distortion(&self) -> Option<usize> {
        self.distortion
    }

    /// The columns of a frame's twist, translation first; none where it is held.
    pub(super) fn columns(&self, frame: usize) -> Option<Range<usize>> {
        self.column[frame].map(|first| first..first + 6)
    }

    /// Takes a step. Inverse depths end at 0, a point at infinity, where they would turn negative.
    pub(super) fn apply(&self, problem: &mut Problem, delta: &Step) {
        for (pose, column) in problem.poses.iter_mut().zip(&self.column) {
            if let Some(c) = *column {
                *pose = retract(pose, &Twist::from_iterator((0..6).map(|k| delta.camera[c + k])));
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

/// One point's row: information and gradient of its inverse depth, and its coupling with cameras.
#[derive(Default)]
struct Row {
    information: f64,
    gradient: f64,
    /// Damping acts on this: the information, floored.
    floor: f64,
    /// (column, value) of the twists of frames, the focal length and the distortion.
    coupling: Vec<(usize, f64)>,
}

/// J^T W J and J^T W r: a dense camera block, and a sparse row for each point.
pub(super) struct NormalEquations {
    camera: DMatrix<f64>,
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
        let width = options.kernel_width * scale;
        let part = problem.points.len().div_ceil(PARTS).max(1);
        let typical = super::median_inverse_depth(problem).unwrap_or(1.0);
        let parts: Vec<NormalEquations> = layout
            .by_point
            .par_chunks(part)
            .enumerate()
            .map(|(p, members)| {
                let mut sum = NormalEquations::empty(layout.size);
                for (k, members) in members.iter().enumerate() {
                    let row = sum.add_point(
                        problem,
                        options,
                        layout,
                        width,
                        p * part + k,
                        members,
                        typical,
                    );
                    sum.rows.push(row);
                }
                sum
            })
            .collect();
        let mut total = NormalEquations::empty(layout.size);
        for part in parts {
            total.camera += part.camera;
            total.gradient += part.gradient;
            total.rows.extend(part.rows);
        }
        if let (Some(c), Some((w, e))) = (layout.focal, focal_prior(problem, options, scale)) {
            total.camera[(c, c)] += w;
            total.gradient[c] += w * e;
        }
        total
    }

    fn empty(size: usize) -> NormalEquations {
        NormalEquations {
            camera: DMatrix::zeros(size, size),
            gradient: DVector::zeros(size),
            rows: Vec::new(),
        }
    }

    /// Adds a point's observations to the camera block (lower triangle), and returns its row.
    fn add_point(
        &mut self,
        problem: &Problem,
        options: &Options,
        layout: &Layout,
        width: f64,
        index: usize,
        members: &[usize],
        typical: f64,
    ) -> Row {
        let point = &problem.points[index];
        let mut row = Row::default();
        for &m in members {
            let o = &problem.observations[m];
            let found = project_through(
                &problem.intrinsics,
                problem.k1,
                &relative(problem, o),
                point.pixel,
                point.inverse_depth,
            );
            let Some((u, jacobian)) = found else { continue };
            let r = u - o.pixel;
            let (variance, squared) = (o.deviation.powi(2), r.length_squared());
            let w = o.weight * kernel(options.kernel, squared / variance, width).1 / variance;
            let mut columns = [(0usize, DVec2::ZERO); COLUMNS];
            let mut used = 0;
            let mut push = |column: usize, derivative: DVec2| {
                columns[used] = (column, derivative);
                used += 1;
            };
            for (frame, derivatives) in
                [(o.frame, &jacobian.target), (point.frame, &jacobian.reference)]
            {
                if let Some(c) = layout.column[frame] {
                    (0..6).for_each(|k| push(c + k, derivatives[k]));
                }
            }
            if let Some(c) = layout.focal {
                push(c, jacobian.log_focal);
            }
            if let Some(c) = layout.distortion {
                push(c, jacobian.k1);
            }
            let columns = &columns[..used];
            for &(a, ja) in columns {
                self.gradient[a] += w * ja.dot(r);
                for &(b, jb) in columns {
                    if b <= a {
                        self.camera[(a, b)] += w * ja.dot(jb);
                    }
                }
            }
            if layout.depths {
                let jd = jacobian.inverse_depth;
                row.information += w * jd.length_squared();
                row.gradient += w * jd.dot(r);
                for &(a, ja) in columns {
                    let value = w * ja.dot(jd);
                    match row.coupling.iter_mut().find(|(c, _)| *c == a) {
                        Some((_, sum)) => *sum += value,
                        None => row.coupling.push((a, value)),
                    }
                }
            }
        }
        if let Some(prior) = point.prior {
            row.information += prior.weight;
            row.gradient += prior.weight * (point.inverse_depth - prior.inverse_depth);
        }
        row.floor = DEPTH_FLOOR / (typical * typical);
        row
    }

    /// The damped Gauss–Newton step; none where the reduced system is not positive definite.
    pub(super) fn solve(&self, layout: &Layout, damping: f64) -> Option<Step> {
        let (mut reduced, mut right) = self.reduce(layout, damping);
        let largest = self.camera.diagonal().max().max(1e-300);
        for k in 0..layout.size {
            reduced[(k, k)] += damping * self.camera[(k, k)] + 1e-12 * largest;
        }
        right.neg_mut();
        let camera =
            if layout.size == 0 { DVector::zeros(0) } else { reduced.cholesky()?.solve(&right) };
        if camera.iter().any(|v| !v.is_finite()) {
            return None;
        }
        let depth = if layout.depths {
            self.rows
                .iter()
                .map(|row| {
                    let coupled: f64 = row.coupling.iter().map(|&(c, v)| v * camera[c]).sum();
                    -(row.gradient + coupled) / row.damped(damping)
                })
                .collect()
        } else {
            Vec::new()
        };
        Some(Step { camera, depth })
    }

    /// Schur complement over the inverse depths (lower triangle) and the reduced gradient.
    fn reduce(&self, layout: &Layout, damping: f64) -> (DMatrix<f64>, DVector<f64>) {
        let part = self.rows.len().div_ceil(PARTS).max(1);
        let size = layout.size;
        let parts: Vec<(DMatrix<f64>, DVector<f64>)> = self
            .rows
            .par_chunks(part)
            .map(|rows| {
                let mut matrix = DMatrix::zeros(size, size);
                let mut vector = DVector::zeros(size);
                for row in rows {
                    let inverse = 1.0 / row.damped(damping);
                    for &(a, va) in &row.coupling {
                        let scaled = va * inverse;
                        vector[a] += scaled * row.gradient;
                        for &(b, vb) in &row.coupling {
                            if b <= a {
                                matrix[(a, b)] += scaled * vb;
                            }
                        }
                    }
                }
                (matrix, vector)
            })
            .collect();
        let mut matrix = self.camera.clone();
        let mut vector = self.gradient.clone();
        for (m, v) in parts {
            matrix -= m;
            vector -= v;
        }
        (matrix, vector)
    }

    /// How much the cost should fall by a step that solved the damped equations: gᵀ(−δ) + λ δᵀDδ.
    pub(super) fn predicted_decrease(&self, step: &Step, damping: f64) -> f64 {
        let mut sum = 0.0;
        for k in 0..step.camera.len() {
            let d = step.camera[k];
            sum += -self.gradient[k] * d + damping * self.camera[(k, k)] * d * d;
        }
        for (row, d) in self.rows.iter().zip(&step.depth) {
            sum += -row.gradient * d + (row.damped(damping) - row.information) * d * d;
        }
        sum
    }

    /// Information about the unknown of a column that remains when all others are free, in pixels² over its
    /// unit's square.
    pub(super) fn information(&self, layout: &Layout, column: usize) -> Option<f64> {
        let (mut reduced, _) = self.reduce(layout, 0.0);
        let largest = self.camera.diagonal().max().max(1e-300);
        for k in 0..layout.size {
            // The free scale is a null direction; it does not reach the focal length and the lens.
            reduced[(k, k)] += 1e-10 * self.camera[(k, k)] + 1e-14 * largest;
        }
        let mut unit = DVector::zeros(layout.size);
        unit[column] = 1.0;
        let variance = reduced.cholesky()?.solve(&unit)[column];
        (variance.is_finite() && variance > 0.0).then(|| 1.0 / variance)
    }

    /// The variance of each column with all else unknown, per unit of the residuals' variance, where the
    /// sum of the inverse depths' changes, weighted by `gauge`, is held at 0. None for a column whose
    /// information is less than `least` of what it would be with all else given.
    pub(super) fn variances(
        &self,
        layout: &Layout,
        gauge: &[f64],
        least: f64,
    ) -> Option<Vec<Option<f64>>> {
        let (mut reduced, _) = self.reduce(layout, 0.0);
        // Holding a sum of depths adds to their block a term of one rank and infinite weight. Reduced to the
        // cameras, that is a term of one rank, too.
        let mut held = DVector::zeros(layout.size);
        let mut norm = 0.0;
        for (row, weight) in self.rows.iter().zip(gauge).filter(|(row, _)| row.information > 0.0) {
            let scaled = weight / row.damped(0.0);
            norm += weight * scaled;
            row.coupling.iter().for_each(|(c, v)| held[*c] += scaled * v);
        }
        if norm > 0.0 {
            reduced.ger(1.0 / norm, &held, &held, 1.0);
        }
        let largest = self.camera.diagonal().max().max(1e-300);
        let floor = |k: usize| 0.01 * least * self.camera[(k, k)] + 1e-14 * largest;
        (0..layout.size).for_each(|k| reduced[(k, k)] += floor(k));
        let factor = reduced.cholesky()?.unpack();
        // With S = L Lᵀ the diagonal of S⁻¹ holds the squared lengths of the columns of L⁻¹.
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
            let given = self.camera[(k, k)];
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

/// Median of σ_d / d over the points that were observed, poses held.
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

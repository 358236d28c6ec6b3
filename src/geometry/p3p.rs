//! The perspective-three-point problem.

use super::polynomial::real_roots;
use crate::types::Pose;
use glam::{DMat3, DQuat, DVec3};

/// Sine of the smallest angle at which three points or rays are not considered collinear.
const COLLINEAR: f64 = 1e-7;

/// All poses `view_from_world` (at most four) that map three world points to three rays of the camera
/// frame, in front of the camera.
///
/// The three distances λ satisfy λ_i² + λ_j² − 2 λ_i λ_j cos θ_ij = |X_i − X_j|²: three quadrics. As in
/// Lambda Twist (Persson and Nordberg, ECCV 2018), a cubic gives one degenerate member of the pencil of two
/// homogeneous combinations, which splits into two planes; on each plane a quadratic remains. Newton's
/// method on the quadrics then refines the distances.
///
/// `rays` need not be normalised. The result is empty for collinear points, coincident rays and non-finite
/// input.
pub fn p3p(rays: &[DVec3; 3], points: &[DVec3; 3]) -> Vec<Pose> {
    let y = rays.map(|r| r.normalize_or_zero());
    let (d12, d13, d23) = (points[1] - points[0], points[2] - points[0], points[2] - points[1]);
    let area = d12.cross(d13).length();
    let longest2 = d12.length_squared().max(d13.length_squared()).max(d23.length_squared());
    let finite = points.iter().all(|p| p.is_finite()) && y.iter().all(|r| r.is_finite());
    if !finite || longest2 <= 0.0 || area <= COLLINEAR * longest2 {
        return Vec::new();
    }
    if [(0, 1), (0, 2), (1, 2)].iter().any(|&(i, j)| y[i].cross(y[j]).length() < COLLINEAR) {
        return Vec::new();
    }
    // In units of the longest side, all thresholds below are scale-free.
    let unit = longest2.sqrt();
    let quadrics = Quadrics {
        cosine: [y[0].dot(y[1]), y[0].dot(y[2]), y[1].dot(y[2])],
        side2: [
            d12.length_squared() / longest2,
            d13.length_squared() / longest2,
            d23.length_squared() / longest2,
        ],
    };
    let mut poses: Vec<Pose> = Vec::with_capacity(4);
    let mut found: Vec<DVec3> = Vec::with_capacity(4);
    for lambda in quadrics.distances() {
        let Some(lambda) = quadrics.polish(lambda) else { continue };
        // Two planes may share a solution.
        if found.iter().any(|f| (*f - lambda).length() < 1e-9 * lambda.length()) {
            continue;
        }
        found.push(lambda);
        let x: [DVec3; 3] = std::array::from_fn(|i| y[i] * (lambda[i] * unit));
        if let Some(pose) = absolute(points, &x) {
            poses.push(pose);
        }
    }
    poses
}

/// λ_i² + λ_j² − 2 c λ_i λ_j = s for the pairs (1,2), (1,3), (2,3).
struct Quadrics {
    cosine: [f64; 3],
    side2: [f64; 3],
}

const PAIRS: [(usize, usize); 3] = [(0, 1), (0, 2), (1, 2)];

impl Quadrics {
    fn matrix(&self, pair: usize) -> DMat3 {
        let (i, j) = PAIRS[pair];
        let mut m = DMat3::ZERO;
        m.col_mut(i)[i] = 1.0;
        m.col_mut(j)[j] = 1.0;
        m.col_mut(j)[i] = -self.cosine[pair];
        m.col_mut(i)[j] = -self.cosine[pair];
        m
    }

    /// Candidate distances, unpolished.
    fn distances(&self) -> Vec<DVec3> {
        let (m12, m13, m23) = (self.matrix(0), self.matrix(1), self.matrix(2));
        let [a12, a13, a23] = self.side2;
        // Homogeneous combinations, which vanish at every solution.
        let d1 = m12 * a23 - m23 * a12;
        let d2 = m13 * a23 - m23 * a13;
        let mut out = Vec::with_capacity(4);
        // det(d1 + γ d2) by interpolation, which is exact for a cubic.
        let roots = real_roots(&cubic_of_pencil(&d1, &d2));
        // Any real root gives all solutions; the one whose member splits best is used.
        let split = roots
            .iter()
            .filter_map(|&g| Planes::of(&(d1 + d2 * g)))
            .max_by(|a, b| a.clarity.total_cmp(&b.clarity));
        let Some(planes) = split else { return out };
        for normal in planes.normals {
            let (u, v) = normal.any_orthonormal_pair();
            // On the plane λ = α u + β v the whole pencil is one binary form; the larger member is better
            // conditioned.
            let form = |d: &DMat3| [u.dot(*d * u), u.dot(*d * v), v.dot(*d * v)];
            let (f1, f2) = (form(&d1), form(&d2));
            let size = |f: &[f64; 3]| f.iter().fold(0.0f64, |m, x| m.max(x.abs()));
            let [a, b, c] = if size(&f1) > size(&f2) { f1 } else { f2 };
            for (alpha, beta) in binary_roots(a, b, c) {
                let mut direction = u * alpha + v * beta;
                if direction.element_sum() < 0.0 {
                    direction = -direction;
                }
                if direction.min_element() <= 0.0 {
                    continue;
                }
                // The scale from the three quadrics together.
                let q = [0, 1, 2].map(|k| direction.dot(self.matrix(k) * direction));
                let scale2 = (a12 + a13 + a23) / (q[0] + q[1] + q[2]);
                if scale2.is_finite() && scale2 > 0.0 {
                    out.push(direction * scale2.sqrt());
                }
            }
        }
        out
    }

    fn residual(&self, l: DVec3) -> DVec3 {
        let value = |k: usize| {
            let (i, j) = PAIRS[k];
            l[i] * l[i] + l[j] * l[j] - 2.0 * self.cosine[k] * l[i] * l[j] - self.side2[k]
        };
        DVec3::new(value(0), value(1), value(2))
    }

    /// Refines by Newton's method; `None` where it does not converge to the quadrics with positive distances.
    fn polish(&self, mut l: DVec3) -> Option<DVec3> {
        let mut r = self.residual(l);
        for _ in 0..8 {
            if r.abs().max_element() < 1e-15 {
                break;
            }
            let mut jacobian = DMat3::ZERO;
            for k in 0..3 {
                let (i, j) = PAIRS[k];
                jacobian.col_mut(i)[k] = 2.0 * (l[i] - self.cosine[k] * l[j]);
                jacobian.col_mut(j)[k] = 2.0 * (l[j] - self.cosine[k] * l[i]);
            }
            // Singular on the danger cylinder, where two solutions coincide: keeps the current value.
            let step = jacobian.inverse() * r;
            if !step.is_finite() {
                break;
            }
            let next = l - step;
            let residual = self.residual(next);
            if residual.length() >= r.length() {
                break;
            }
            (l, r) = (next, residual);
        }
        let good = l.is_finite() && l.min_element() > 0.0 && r.abs().max_element() < 1e-6;
        good.then_some(l)
    }
}

/// Two planes through the origin, as a rank-2 quadric of mixed sign.
struct Planes {
    normals: [DVec3; 2],
    clarity: f64,
}

impl Planes {
    /// Splits λᵀ D λ = 0; `None` where D has no real planes.
    fn of(d: &DMat3) -> Option<Planes> {
        let eigen = super::se3::matrix3(d).symmetric_eigen();
        let mut order = [0, 1, 2];
        order.sort_by(|&a, &b| eigen.eigenvalues[a].total_cmp(&eigen.eigenvalues[b]));
        let (low, high) = (eigen.eigenvalues[order[0]], eigen.eigenvalues[order[2]]);
        let size = low.abs().max(high.abs());
        if size.is_nan() || size <= 0.0 || low > 0.0 || high < 0.0 {
            return None;
        }
        let column = |k: usize| {
            let c = eigen.eigenvectors.column(order[k]);
            DVec3::new(c[0], c[1], c[2])
        };
        let (p, q) = (column(2) * high.sqrt(), column(0) * (-low).sqrt());
        let normals = [(p - q).try_normalize()?, (p + q).try_normalize()?];
        Some(Planes { normals, clarity: high.min(-low) / size })
    }
}

/// The coefficients of det(a + γ b).
fn cubic_of_pencil(a: &DMat3, b: &DMat3) -> [f64; 4] {
    let mixed = |p: &DMat3, q: &DMat3| {
        // Derivative of det at p along q: each column replaced in turn.
        let det = |x: DVec3, y: DVec3, z: DVec3| x.dot(y.cross(z));
        det(q.x_axis, p.y_axis, p.z_axis)
            + det(p.x_axis, q.y_axis, p.z_axis)
            + det(p.x_axis, p.y_axis, q.z_axis)
    };
    [a.determinant(), mixed(a, b), mixed(b, a), b.determinant()]
}

/// Directions (α, β), up to sign, with a α² + 2 b αβ + c β² = 0.
fn binary_roots(a: f64, b: f64, c: f64) -> Vec<(f64, f64)> {
    let size = a.abs().max(b.abs()).max(c.abs());
    if size.is_nan() || size <= 0.0 {
        return Vec::new();
    }
    let discriminant = b * b - a * c;
    // A slightly negative discriminant is a double root with rounding error.
    if discriminant < -1e-10 * size * size {
        return Vec::new();
    }
    let q = -(b + discriminant.max(0.0).sqrt().copysign(b));
    if q == 0.0 {
        return vec![if a.abs() < c.abs() { (1.0, 0.0) } else { (0.0, 1.0) }];
    }
    vec![(q, a), (c, q)]
}

/// The rigid motion that maps three points to three others of a congruent triangle.
fn absolute(world: &[DVec3; 3], view: &[DVec3; 3]) -> Option<Pose> {
    let frame = |p: &[DVec3; 3]| {
        let x = (p[1] - p[0]).try_normalize()?;
        let z = x.cross(p[2] - p[0]).try_normalize()?;
        Some(DMat3::from_cols(x, z.cross(x), z))
    };
    let rotation = frame(view)? * frame(world)?.transpose();
    let rotation = DQuat::from_mat3(&rotation).normalize();
    // From the centroid, so that the points' errors have equal weight.
    let mean = |p: &[DVec3; 3]| (p[0] + p[1] + p[2]) / 3.0;
    let translation = mean(view) - rotation * mean(world);
    (rotation.is_finite() && translation.is_finite()).then_some(Pose { rotation, translation })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::se3::{angle_between, exp_so3};
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    fn random(rng: &mut ChaCha8Rng) -> DVec3 {
        DVec3::from_array(std::array::from_fn(|_| rng.random_range(-1.0..1.0)))
    }

    #[test]
    fn finds_the_true_pose_among_at_most_four_that_all_reproject() {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let (mut missed, trials) = (0, 20_000);
        for _ in 0..trials {
            let pose = Pose::new(exp_so3(random(&mut rng) * 3.0), random(&mut rng));
            let view: [DVec3; 3] =
                std::array::from_fn(|_| random(&mut rng) + DVec3::new(0.0, 0.0, 2.5));
            let world = view.map(|p| pose.inverse().apply(p));
            let rays = view.map(|p| p / p.z);
            let found = p3p(&rays, &world);
            assert!(found.len() <= 4);
            for f in &found {
                for k in 0..3 {
                    let angle = f.apply(world[k]).angle_between(rays[k]);
                    assert!(angle < 1e-6, "a solution off its ray by {angle}");
                }
            }
            let hit = found.iter().any(|f| {
                angle_between(f.rotation, pose.rotation) < 1e-5
                    && (f.translation - pose.translation).length() < 1e-5
            });
            missed += usize::from(!hit);
        }
        // Near-degenerate random triples may merge two roots, which is rare.
        assert!(missed <= trials / 2000, "missed {missed} of {trials}");
    }

    #[test]
    fn scale_of_the_world_does_not_matter() {
        let pose = Pose::new(exp_so3(DVec3::new(0.1, 0.2, 0.3)), DVec3::new(0.2, 0.1, -0.3));
        for scale in [1e-9, 1.0, 1e9] {
            let view =
                [DVec3::new(-0.5, 0.1, 2.0), DVec3::new(0.4, 0.5, 3.0), DVec3::new(0.2, -0.6, 2.5)];
            let world = view.map(|p| pose.inverse().apply(p) * scale);
            let found = p3p(&view, &world);
            assert!(
                found.iter().any(|f| angle_between(f.rotation, pose.rotation) < 1e-8),
                "scale {scale}: {found:?}"
            );
        }
    }

    #[test]
    fn degenerate_input_has_no_solution() {
        let rays = [DVec3::Z, DVec3::new(0.1, 0.0, 1.0), DVec3::new(0.0, 0.1, 1.0)];
        let line = [DVec3::ZERO, DVec3::X, DVec3::X * 2.0];
        assert!(p3p(&rays, &line).is_empty());
        assert!(p3p(&rays, &[DVec3::ONE; 3]).is_empty());
        let triangle = [DVec3::ZERO, DVec3::X, DVec3::Y];
        assert!(p3p(&[DVec3::Z; 3], &triangle).is_empty());
        assert!(p3p(&[DVec3::ZERO; 3], &triangle).is_empty());
        assert!(p3p(&rays, &[DVec3::NAN, DVec3::X, DVec3::Y]).is_empty());
    }
}

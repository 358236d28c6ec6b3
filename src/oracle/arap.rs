//! As-rigid-as-possible motion of the control points between two times.
//!
//! ```text
//! E = 1/M Σ_i Σ_j w_ij ‖ (b_j − b_i) − R_i (a_j − a_i) ‖²
//! ```
//!
//! with `a`, `b` the positions at the two times, `w_ij` the normalised weights
//! `exp(−‖p_j−p_i‖²/2ρ_i²)` of the canonical frame, and `R_i` the rotation that makes the inner sum
//! smallest (never a reflection). The derivative holds `R_i`: since it minimises the sum, that is
//! the true derivative wherever `R_i` is unique.
//!
//! Source: Sorkine and Alexa 2007; weights and means as SC-GS proposes, scaled to a mean.

use super::Real;
use super::deform::{NONE, weights};
use super::rotation::{add, apply, dot, scale, sub, transpose};
use nalgebra::Matrix3;

/// The edges of the energy: entries `i·k..(i+1)·k` are the neighbours of control point `i`.
#[derive(Clone, Debug, PartialEq)]
pub struct Edges<R> {
    /// Indices of the neighbours; [`NONE`] for an empty entry.
    pub neighbours: Vec<u32>,
    /// Weights of the edges; they sum to 1 for each control point with neighbours.
    pub weights: Vec<R>,
    /// Entries per control point.
    pub k: usize,
}

/// The edges in the canonical frame, from each control point's `k` nearest
/// ([`super::deform::nearest`] over the control points themselves; the entry of the point itself is
/// emptied). Neighbours after the first `always` are left out if their distance is `reach` or more.
pub fn edges<R: Real>(
    nodes: &[[R; 3]],
    log_radii: &[R],
    nearest: &[u32],
    k: usize,
    always: usize,
    reach: R,
) -> Edges<R> {
    let mut result =
        Edges { neighbours: Vec::with_capacity(nearest.len()), weights: Vec::new(), k };
    for (i, row) in nearest.chunks(k).enumerate() {
        let mut kept = 0;
        let row: Vec<u32> = row
            .iter()
            .map(|&j| {
                if j == NONE || j as usize == i {
                    return NONE;
                }
                let d = sub(nodes[j as usize], nodes[i]);
                kept += 1;
                if kept > always && dot(d, d) >= reach * reach { NONE } else { j }
            })
            .collect();
        // All edges of a control point use its own radius.
        let radii = vec![log_radii[i]; nodes.len()];
        let first = row.iter().position(|&j| j != NONE);
        let mut w = weights(nodes[i], nodes, &radii, &row);
        if let (Some(first), true) = (first, w.iter().all(|&w| w == R::zero())) {
            w[first] = R::one();
        }
        result.weights.extend(w);
        result.neighbours.extend(row);
    }
    result
}

/// The rotation `R`, by rows, for which `tr(Rᵀ S)` is largest: the best fit of `R a ≈ b` where
/// `S = Σ w b aᵀ`. The identity where `S` is zero or not finite.
///
/// The decomposition runs in f64 for every `R`, since the derivative treats the rotation as a
/// constant.
pub fn best_rotation<R: Real>(s: [[R; 3]; 3]) -> [[R; 3]; 3] {
    let s = Matrix3::from_fn(|r, c| s[r][c].f64());
    let largest = s.amax();
    let identity = Matrix3::identity();
    let rotation = if largest > 0.0 && s.iter().all(|v| v.is_finite()) {
        let svd = (s / largest).svd(true, true);
        match (svd.u, svd.v_t) {
            (Some(u), Some(v_t)) => {
                let mut flip = identity;
                let smallest = svd.singular_values.imin();
                flip[(smallest, smallest)] = (u.determinant() * v_t.determinant()).signum();
                u * flip * v_t
            }
            _ => identity,
        }
    } else {
        identity
    };
    std::array::from_fn(|r| std::array::from_fn(|c| R::of(rotation[(r, c)])))
}

/// The energy and its gradients with respect to the positions at both times.
#[derive(Clone, Debug, PartialEq)]
pub struct Arap<R> {
    /// The energy of each control point, divided by their number: the sum is `E`.
    pub energies: Vec<R>,
    /// Gradient of `E` with respect to `a`.
    pub by_a: Vec<[R; 3]>,
    /// Gradient of `E` with respect to `b`.
    pub by_b: Vec<[R; 3]>,
}

/// Energy and gradients between the positions `a` and `b`.
pub fn energy<R: Real>(edges: &Edges<R>, a: &[[R; 3]], b: &[[R; 3]]) -> Arap<R> {
    let count = R::of(a.len().max(1) as f64);
    let none = vec![[R::zero(); 3]; a.len()];
    let mut result = Arap { energies: vec![R::zero(); a.len()], by_a: none.clone(), by_b: none };
    for i in 0..a.len() {
        let row = i * edges.k..(i + 1) * edges.k;
        let listed = || {
            edges.neighbours[row.clone()]
                .iter()
                .zip(&edges.weights[row.clone()])
                .filter(|&(&j, _)| j != NONE)
                .map(|(&j, &w)| (j as usize, w))
        };
        let mut s = [[R::zero(); 3]; 3];
        for (j, w) in listed() {
            let (from, to) = (sub(a[j], a[i]), sub(b[j], b[i]));
            for r in 0..3 {
                for c in 0..3 {
                    s[r][c] += w * to[r] * from[c];
                }
            }
        }
        let rotation = best_rotation(s);
        for (j, w) in listed() {
            let residual = sub(sub(b[j], b[i]), apply(rotation, sub(a[j], a[i])));
            result.energies[i] += w * dot(residual, residual) / count;
            let g = scale(residual, R::of(2.0) * w / count);
            let back = apply(transpose(rotation), g);
            result.by_b[j] = add(result.by_b[j], g);
            result.by_b[i] = sub(result.by_b[i], g);
            result.by_a[j] = sub(result.by_a[j], back);
            result.by_a[i] = add(result.by_a[i], back);
        }
    }
    result
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::oracle::deform::nearest;
    use crate::oracle::rotation::{matrix, unit};
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    type Points = Vec<[f64; 3]>;

    fn cloud(seed: u64, count: usize) -> Points {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        (0..count).map(|_| std::array::from_fn(|_| rng.random_range(-1.0..1.0))).collect()
    }

    fn graph(nodes: &Points) -> Edges<f64> {
        let near = nearest(nodes, nodes, 6);
        edges(nodes, &vec![-0.5; nodes.len()], &near, 6, 3, 0.8)
    }

    #[test]
    fn gradients_agree_with_central_differences() {
        let (nodes, noise) = (cloud(1, 9), cloud(2, 9));
        let graph = graph(&nodes);
        let mut a = nodes.clone();
        let mut b: Points = (0..9).map(|i| add(nodes[i], scale(noise[i], 0.2))).collect();
        let result = energy(&graph, &a, &b);
        let total = |a: &Points, b: &Points| energy(&graph, a, b).energies.iter().sum::<f64>();
        for i in 0..9 {
            for c in 0..3 {
                let h = 1e-6;
                let start = b[i][c];
                b[i][c] = start + h;
                let up = total(&a, &b);
                b[i][c] = start - h;
                let down = total(&a, &b);
                b[i][c] = start;
                assert!(((up - down) / (2.0 * h) - result.by_b[i][c]).abs() < 1e-8);
                let start = a[i][c];
                a[i][c] = start + h;
                let up = total(&a, &b);
                a[i][c] = start - h;
                let down = total(&a, &b);
                a[i][c] = start;
                assert!(((up - down) / (2.0 * h) - result.by_a[i][c]).abs() < 1e-8);
            }
        }
    }

    #[test]
    fn rigid_motion_costs_nothing_and_a_mirror_costs() {
        let nodes = cloud(3, 20);
        let graph = graph(&nodes);
        let turn = matrix(unit([0.3f64, 0.9, -0.5, 0.1]).unwrap().0);
        let moved: Points = nodes.iter().map(|&p| add(apply(turn, p), [1.0, 2.0, 3.0])).collect();
        assert!(energy(&graph, &nodes, &moved).energies.iter().sum::<f64>() < 1e-25);
        let mirrored: Points = nodes.iter().map(|p| [-p[0], p[1], p[2]]).collect();
        assert!(energy(&graph, &nodes, &mirrored).energies.iter().sum::<f64>() > 1e-3);
    }

    #[test]
    fn edges_leave_out_self_and_far_ones_and_weigh_to_one() {
        let nodes: Points = (0..8).map(|i| [f64::from(i), 0.0, 0.0]).collect();
        let near = nearest(&nodes, &nodes, 5);
        let graph = edges(&nodes, &[0.0; 8], &near, 5, 2, 1.5);
        // Control point 0: its own entry is empty, 1 and 2 are always kept, 3 and 4 are too far.
        assert_eq!(graph.neighbours[..5], [NONE, 1, 2, NONE, NONE]);
        for row in graph.weights.chunks(5) {
            assert!((row.iter().sum::<f64>() - 1.0).abs() < 1e-12);
        }
        // A radius so small that every exponent is −∞: the nearest neighbour gets weight 1.
        let graph = edges(&[[0.0f32; 3], [1e15; 3]], &[-40.0; 2], &[0, 1, 1, 0], 2, 2, 1.0);
        assert_eq!(graph.weights, [0.0, 1.0, 0.0, 1.0]);
    }

    /// Collinear, coplanar, coincident: finite, and zero for a rigid motion.
    #[test]
    fn degenerate_neighbourhoods_are_finite() {
        let line: Points = (0..8).map(|i| [f64::from(i) * 0.1, 0.0, 0.0]).collect();
        let plane: Points = (0..9).map(|i| [f64::from(i % 3), f64::from(i / 3), 0.0]).collect();
        let same: Points = vec![[1.0; 3]; 6];
        let turn = matrix(unit([0.1f64, 0.9, -0.5, 0.4]).unwrap().0);
        for nodes in [line, plane, same] {
            let graph = graph(&nodes);
            let moved: Points = nodes.iter().map(|&p| apply(turn, p)).collect();
            let result = energy(&graph, &nodes, &moved);
            assert!(result.energies.iter().sum::<f64>() < 1e-24);
            let collapsed = energy(&graph, &nodes, &vec![[0.0; 3]; nodes.len()]);
            assert!(collapsed.by_a.iter().flatten().all(|v| v.is_finite()));
        }
        let lone = energy(&graph(&vec![[0.0; 3]]), &[[0.0; 3]], &[[1.0; 3]]);
        assert_eq!(lone.energies, [0.0]);
    }
}

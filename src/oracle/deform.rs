//! Linear blend skinning: dynamic Gaussians follow their nearest control points.
//!
//! With `w_k` the normalised weights `exp(−‖μ−p_k‖²/2ρ_k²)` over the K nearest control points `p_k`
//! and `(T_k, R_k)` their rigid motions,
//!
//! ```text
//! Δ  = Σ_k w_k (R_k(μ − p_k) + p_k + T_k) − μ
//! μ' = μ + m Δ
//! q' = r ⊗ q,   r = normalise(Σ_k w_k r_k), every r_k in the hemisphere of the heaviest one
//! o' = o + m min(f_h, 0),   h the heaviest one
//! ```
//!
//! `o` is the logit of the opacity and `f_k` the value that a control point adds to it: 0 while the
//! control point is present, and so low that its followers are invisible while it is absent. `f` is
//! given and has no gradient, and `m` gets none through it; the gradient with respect to `o` passes
//! unchanged. `m` is 1 (hard selection: the caller lists the dynamic Gaussians) or the sigmoid of
//! the motion logit (soft motion; the rotation is then blended towards none by `m`). The rigidity
//! term is `Σ_j (1 − m̂_j) ‖Δ_j‖²` with `m̂` the evidence of motion from the images, a constant;
//! with hard selection `m̂ = 1` for every listed Gaussian, so that the term is zero.
//!
//! The derivative is the *detached* one: weights carry gradient to the radii only, never to μ or
//! p, so `∂μ'/∂μ = I + m (Σ_k w_k R_k − I)`.
//!
//! Sources: SC-GS (Huang et al. 2024) for the scheme; log-sum-exp weights, hemisphere alignment and
//! the derivative are this project's.

use super::Real;
use super::rotation::{
    add, apply, apply_backward, conjugate, dot, identity, matrix, multiply, scale, sub, transpose,
    unit, unit_backward,
};

/// An empty entry in a list of neighbours.
pub const NONE: u32 = u32::MAX;

/// Logarithms of radii are clamped to ± this before use, so that `ρ^−2` stays a finite f32; beyond
/// it the gradient is zero.
pub const LARGEST_LOG_RADIUS: f64 = 40.0;

/// For each point the indices of the `k` nearest control points, nearest first, equal distances by
/// index; missing entries hold [`NONE`]. A control point whose squared distance is not finite is
/// not a neighbour, so a point that is not finite has none.
pub fn nearest<R: Real>(points: &[[R; 3]], nodes: &[[R; 3]], k: usize) -> Vec<u32> {
    let mut neighbours = Vec::with_capacity(points.len() * k);
    for &point in points {
        let mut order: Vec<(R, u32)> = (0..)
            .zip(nodes)
            .map(|(index, &node)| {
                let d = sub(point, node);
                (dot(d, d), index)
            })
            .filter(|(distance, _)| distance.is_finite())
            .collect();
        // Finite values always compare.
        order.sort_by(|a, b| a.partial_cmp(b).expect("finite"));
        neighbours.extend((0..k).map(|slot| order.get(slot).map_or(NONE, |&(_, index)| index)));
    }
    neighbours
}

/// The normalised skinning weights of one point over its neighbours; zero for [`NONE`]. If every
/// exponent is −∞ the nearest neighbour, which comes first, gets weight 1.
pub fn weights<R: Real>(
    point: [R; 3],
    nodes: &[[R; 3]],
    log_radii: &[R],
    neighbours: &[u32],
) -> Vec<R> {
    let exponents: Vec<R> = neighbours
        .iter()
        .map(|&node| {
            if node == NONE {
                return R::neg_infinity();
            }
            let d = sub(point, nodes[node as usize]);
            let exponent = R::of(-0.5) * dot(d, d) * inverse_square(log_radii[node as usize]);
            if exponent.is_nan() { R::neg_infinity() } else { exponent }
        })
        .collect();
    let largest = exponents.iter().copied().fold(R::neg_infinity(), R::max);
    if largest == R::neg_infinity() {
        let present = neighbours.first().is_some_and(|&node| node != NONE);
        return (0..neighbours.len())
            .map(|slot| if slot == 0 && present { R::one() } else { R::zero() })
            .collect();
    }
    let raw: Vec<R> = exponents.iter().map(|&e| (e - largest).exp()).collect();
    let sum: R = raw.iter().copied().sum();
    raw.into_iter().map(|w| w / sum).collect()
}

/// `ρ^−2` of a clamped log-radius; NaN stays NaN.
fn inverse_square<R: Real>(log_radius: R) -> R {
    let limit = R::of(LARGEST_LOG_RADIUS);
    if log_radius.is_nan() {
        return log_radius;
    }
    (R::of(-2.0) * log_radius.min(limit).max(-limit)).exp()
}

/// The inputs of skinning.
#[derive(Clone, Copy, Debug)]
pub struct Skin<'a, R> {
    /// Centres of all Gaussians in the canonical frame.
    pub positions: &'a [[R; 3]],
    /// Their quaternions, any norm; one without a direction counts as no rotation.
    pub rotations: &'a [[R; 4]],
    /// Logits of their opacities.
    pub opacity_logits: &'a [R],
    /// Their motion logits; read only when `soft`.
    pub motion_logits: &'a [R],
    /// The evidence of motion `m̂` in [0, 1] of each Gaussian; read only when `soft`.
    pub evidence: &'a [R],
    /// Indices of the dynamic Gaussians. All others keep position and rotation.
    pub gaussian_from_dynamic: &'a [u32],
    /// `k` neighbours for each entry of `gaussian_from_dynamic`, see [`nearest`].
    pub neighbours: &'a [u32],
    /// Neighbours per Gaussian.
    pub k: usize,
    /// Canonical positions of the control points.
    pub nodes: &'a [[R; 3]],
    /// Natural logarithms of their radii ρ.
    pub log_radii: &'a [R],
    /// Their motions: translation (3), the value added to the opacity logit, rotation (w, x, y, z)
    /// of any norm.
    pub transforms: &'a [[R; 8]],
    /// Whether motion is weighted by the sigmoid of the motion logit.
    pub soft: bool,
}

/// The results of skinning.
#[derive(Clone, Debug, PartialEq)]
pub struct Skinned<R> {
    /// μ' of every Gaussian.
    pub positions: Vec<[R; 3]>,
    /// q' of every Gaussian; as long as q was.
    pub rotations: Vec<[R; 4]>,
    /// o' of every Gaussian.
    pub opacity_logits: Vec<R>,
    /// `(1 − m̂) ‖Δ‖²` for each entry of `gaussian_from_dynamic`; zero unless `soft`.
    pub rigidity: Vec<R>,
}

/// The gradients of skinning.
#[derive(Clone, Debug, PartialEq)]
pub struct SkinGradients<R> {
    /// With respect to the canonical positions.
    pub positions: Vec<[R; 3]>,
    /// With respect to the canonical quaternions.
    pub rotations: Vec<[R; 4]>,
    /// With respect to the motion logits; zero unless `soft`.
    pub motion_logits: Vec<R>,
    /// With respect to the control points' motions, in the same layout; zero for the value added to
    /// opacities.
    pub transforms: Vec<[R; 8]>,
    /// With respect to the control points' log-radii.
    pub log_radii: Vec<R>,
}

/// One Gaussian's blend of its neighbours' motions.
struct Blend<R> {
    weights: Vec<R>,
    delta: [R; 3],
    /// The value added to the opacity logit.
    fade: R,
    /// Sum of the aligned rotations, before normalisation.
    sum: [R; 4],
    signs: Vec<R>,
    heaviest_is_present: bool,
}

fn rotation_of<R: Real>(transform: &[R; 8]) -> [R; 4] {
    [transform[4], transform[5], transform[6], transform[7]]
}

fn unit_or_identity<R: Real>(q: [R; 4]) -> [R; 4] {
    unit(q).map_or_else(identity, |(u, _)| u)
}

fn blend<R: Real>(skin: &Skin<R>, point: [R; 3], neighbours: &[u32]) -> Blend<R> {
    let weights = weights(point, skin.nodes, skin.log_radii, neighbours);
    let mut heaviest = 0;
    for slot in 1..neighbours.len() {
        if weights[slot] > weights[heaviest] {
            heaviest = slot;
        }
    }
    let unit_rotation = |slot: usize| match neighbours[slot] {
        NONE => identity(),
        node => unit_or_identity(rotation_of(&skin.transforms[node as usize])),
    };
    let mut result = Blend {
        delta: [R::zero(); 3],
        fade: match neighbours.get(heaviest) {
            Some(&node) if node != NONE => skin.transforms[node as usize][3],
            _ => R::zero(),
        },
        sum: [R::zero(); 4],
        signs: vec![R::one(); neighbours.len()],
        heaviest_is_present: neighbours.first().is_some_and(|&node| node != NONE),
        weights,
    };
    for (slot, &node) in neighbours.iter().enumerate() {
        if node == NONE {
            continue;
        }
        let transform = &skin.transforms[node as usize];
        let (r, w) = (unit_rotation(slot), result.weights[slot]);
        let offset = sub(point, skin.nodes[node as usize]);
        let moved =
            add(sub(apply(matrix(r), offset), offset), [transform[0], transform[1], transform[2]]);
        result.delta = add(result.delta, scale(moved, w));
        if dot(r, unit_rotation(heaviest)) < R::zero() {
            result.signs[slot] = -R::one();
        }
        for c in 0..4 {
            result.sum[c] += w * result.signs[slot] * r[c];
        }
    }
    result
}

fn sigmoid<R: Real>(x: R) -> R {
    R::one() / (R::one() + (-x).exp())
}

/// The rotation blended towards the identity by `m`, as needed for its derivative: the sign that
/// brings `blended` into the hemisphere of the identity, and the mixture before normalisation.
fn soften<R: Real>(blended: [R; 4], m: R) -> (R, [R; 4]) {
    let sign = if blended[0] < R::zero() { -R::one() } else { R::one() };
    let e = identity::<R>();
    (sign, std::array::from_fn(|c| (R::one() - m) * e[c] + m * sign * blended[c]))
}

/// Skinning.
pub fn forward<R: Real>(skin: &Skin<R>) -> Skinned<R> {
    let mut out = Skinned {
        positions: skin.positions.to_vec(),
        rotations: skin.rotations.to_vec(),
        opacity_logits: skin.opacity_logits.to_vec(),
        rigidity: vec![R::zero(); skin.gaussian_from_dynamic.len()],
    };
    for (row, &id) in skin.gaussian_from_dynamic.iter().enumerate() {
        let j = id as usize;
        let blend =
            blend(skin, skin.positions[j], &skin.neighbours[row * skin.k..(row + 1) * skin.k]);
        if !blend.heaviest_is_present {
            continue;
        }
        let mut r = unit_or_identity(blend.sum);
        let mut m = R::one();
        if skin.soft {
            m = sigmoid(skin.motion_logits[j]);
            r = unit_or_identity(soften(r, m).1);
            out.rigidity[row] = (R::one() - skin.evidence[j]) * dot(blend.delta, blend.delta);
        }
        if blend.fade < R::zero() {
            out.opacity_logits[j] += m * blend.fade;
        }
        out.positions[j] = add(skin.positions[j], scale(blend.delta, m));
        out.rotations[j] = match unit(skin.rotations[j]) {
            Some(_) => multiply(r, skin.rotations[j]),
            None => r,
        };
    }
    out
}

/// The detached derivative of [`forward`], for a loss with the given gradients at μ' and q', plus
/// `rigid_scale · Σ rigidity`.
pub fn backward<R: Real>(
    skin: &Skin<R>,
    position_gradients: &[[R; 3]],
    rotation_gradients: &[[R; 4]],
    rigid_scale: R,
) -> SkinGradients<R> {
    let zero = R::zero();
    let mut out = SkinGradients {
        positions: position_gradients.to_vec(),
        rotations: rotation_gradients.to_vec(),
        motion_logits: vec![zero; skin.positions.len()],
        transforms: vec![[zero; 8]; skin.nodes.len()],
        log_radii: vec![zero; skin.nodes.len()],
    };
    // With respect to the *unit* rotations; converted to the stored ones once, at the end.
    let mut unit_gradients = vec![[zero; 4]; skin.nodes.len()];
    for (row, &id) in skin.gaussian_from_dynamic.iter().enumerate() {
        let j = id as usize;
        let neighbours = &skin.neighbours[row * skin.k..(row + 1) * skin.k];
        let point = skin.positions[j];
        let blend = blend(skin, point, neighbours);
        if !blend.heaviest_is_present {
            continue;
        }
        let (by_position, by_rotation) = (position_gradients[j], rotation_gradients[j]);
        let blended = unit_or_identity(blend.sum);
        let m = if skin.soft { sigmoid(skin.motion_logits[j]) } else { R::one() };
        let (sign, mixture) = soften(blended, m);
        let r = if skin.soft { unit_or_identity(mixture) } else { blended };

        // q' = r ⊗ q is bilinear.
        let (q, q_is_real) = match unit(skin.rotations[j]) {
            Some(_) => (skin.rotations[j], true),
            None => (identity(), false),
        };
        out.rotations[j] = if q_is_real { multiply(conjugate(r), by_rotation) } else { [zero; 4] };
        let by_r = multiply(by_rotation, conjugate(q));
        let mut by_m = dot(by_position, blend.delta);
        let by_blended = if skin.soft {
            let by_mixture = unit_backward(mixture, by_r);
            let towards: [R; 4] = std::array::from_fn(|c| sign * blended[c] - identity::<R>()[c]);
            by_m += dot(by_mixture, towards);
            by_mixture.map(|g| g * m * sign)
        } else {
            by_r
        };
        let by_sum = unit_backward(blend.sum, by_blended);

        let mut by_delta = scale(by_position, m);
        if skin.soft {
            out.motion_logits[j] = by_m * m * sigmoid(-skin.motion_logits[j]);
            let stiff = R::of(2.0) * rigid_scale * (R::one() - skin.evidence[j]);
            by_delta = add(by_delta, scale(blend.delta, stiff));
        }

        let by_weight: Vec<R> = (0..neighbours.len())
            .map(|slot| {
                let node = neighbours[slot];
                if node == NONE {
                    return zero;
                }
                let transform = &skin.transforms[node as usize];
                let r = unit_or_identity(rotation_of(transform));
                let offset = sub(point, skin.nodes[node as usize]);
                let turned = apply(matrix(r), offset);
                let moved = add(sub(turned, offset), [transform[0], transform[1], transform[2]]);
                dot(by_delta, moved) + blend.signs[slot] * dot(by_sum, r)
            })
            .collect();
        // Since weights sum to 1, this equals by_weight minus its mean, without cancellation.
        let differences = |slot: usize| -> R {
            let of = |(&g, &w): (&R, &R)| w * (by_weight[slot] - g);
            by_weight.iter().zip(&blend.weights).map(of).sum()
        };
        for (slot, &node) in neighbours.iter().enumerate() {
            if node == NONE {
                continue;
            }
            let node = node as usize;
            let r = unit_or_identity(rotation_of(&skin.transforms[node]));
            let offset = sub(point, skin.nodes[node]);
            let w = blend.weights[slot];
            let back = apply(transpose(matrix(r)), by_delta);
            out.positions[j] = add(out.positions[j], scale(sub(back, by_delta), w));
            for c in 0..3 {
                out.transforms[node][c] += w * by_delta[c];
            }
            let by_turn = apply_backward(r, offset, by_delta);
            for c in 0..4 {
                unit_gradients[node][c] += w * (by_turn[c] + blend.signs[slot] * by_sum[c]);
            }
            // ∂ exponent / ∂ ln ρ = d²/ρ².
            let log_radius = skin.log_radii[node];
            if log_radius.abs() <= R::of(LARGEST_LOG_RADIUS) && w > zero {
                let exponent_slope = dot(offset, offset) * inverse_square(log_radius);
                if exponent_slope.is_finite() {
                    out.log_radii[node] += w * differences(slot) * exponent_slope;
                }
            }
        }
    }
    for (node, gradient) in unit_gradients.into_iter().enumerate() {
        let raw = unit_backward(rotation_of(&skin.transforms[node]), gradient);
        out.transforms[node][4..].copy_from_slice(&raw);
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    struct Scene {
        positions: Vec<[f64; 3]>,
        rotations: Vec<[f64; 4]>,
        opacity_logits: Vec<f64>,
        logits: Vec<f64>,
        evidence: Vec<f64>,
        ids: Vec<u32>,
        neighbours: Vec<u32>,
        nodes: Vec<[f64; 3]>,
        log_radii: Vec<f64>,
        transforms: Vec<[f64; 8]>,
        soft: bool,
    }

    const K: usize = 3;

    fn random<const N: usize>(rng: &mut ChaCha8Rng) -> [f64; N] {
        std::array::from_fn(|_| rng.random_range(-1.0..1.0))
    }

    fn scene(seed: u64, soft: bool) -> Scene {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let positions: Vec<[f64; 3]> = (0..12).map(|_| random(&mut rng)).collect();
        let nodes: Vec<[f64; 3]> = (0..5).map(|_| random(&mut rng)).collect();
        let ids: Vec<u32> = (0..12).filter(|j| j % 3 != 1).collect();
        let listed: Vec<_> = ids.iter().map(|&j| positions[j as usize]).collect();
        let neighbours = nearest(&listed, &nodes, K);
        Scene {
            rotations: (0..12).map(|_| random(&mut rng)).collect(),
            opacity_logits: (0..12).map(|_| 3.0 * random::<1>(&mut rng)[0]).collect(),
            logits: (0..12).map(|_| 3.0 * random::<1>(&mut rng)[0]).collect(),
            evidence: (0..12).map(|_| 0.5 + 0.5 * random::<1>(&mut rng)[0]).collect(),
            log_radii: (0..5).map(|_| -0.5 + 0.5 * random::<1>(&mut rng)[0]).collect(),
            transforms: (0..5).map(|_| random(&mut rng)).collect(),
            positions,
            ids,
            neighbours,
            nodes,
            soft,
        }
    }

    impl Scene {
        fn skin(&self) -> Skin<'_, f64> {
            Skin {
                positions: &self.positions,
                rotations: &self.rotations,
                opacity_logits: &self.opacity_logits,
                motion_logits: &self.logits,
                evidence: &self.evidence,
                gaussian_from_dynamic: &self.ids,
                neighbours: &self.neighbours,
                k: K,
                nodes: &self.nodes,
                log_radii: &self.log_radii,
                transforms: &self.transforms,
                soft: self.soft,
            }
        }
    }

    const RIGID: f64 = 0.3;

    fn loss(scene: &Scene, gp: &[[f64; 3]], gq: &[[f64; 4]]) -> f64 {
        let out = forward(&scene.skin());
        let position: f64 = out.positions.iter().zip(gp).map(|(&a, &b)| dot(a, b)).sum();
        let rotation: f64 = out.rotations.iter().zip(gq).map(|(&a, &b)| dot(a, b)).sum();
        position + rotation + RIGID * out.rigidity.iter().sum::<f64>()
    }

    /// Central difference over one number of the scene.
    fn slope(
        scene: &mut Scene,
        gp: &[[f64; 3]],
        gq: &[[f64; 4]],
        at: impl Fn(&mut Scene) -> &mut f64,
    ) -> f64 {
        let h = 1e-6;
        let start = *at(scene);
        *at(scene) = start + h;
        let up = loss(scene, gp, gq);
        *at(scene) = start - h;
        let down = loss(scene, gp, gq);
        *at(scene) = start;
        (up - down) / (2.0 * h)
    }

    #[track_caller]
    fn close(numeric: f64, analytic: f64) {
        assert!((numeric - analytic).abs() < 1e-7 * (1.0 + analytic.abs()), "{numeric} {analytic}");
    }

    #[test]
    fn gradients_agree_with_central_differences() {
        for soft in [false, true] {
            let mut s = scene(3, soft);
            let mut rng = ChaCha8Rng::seed_from_u64(4);
            let gp: Vec<[f64; 3]> = (0..12).map(|_| random(&mut rng)).collect();
            let gq: Vec<[f64; 4]> = (0..12).map(|_| random(&mut rng)).collect();
            let gradients = backward(&s.skin(), &gp, &gq, RIGID);
            for node in 0..s.nodes.len() {
                for c in [0, 1, 2, 4, 5, 6, 7] {
                    let numeric = slope(&mut s, &gp, &gq, |s| &mut s.transforms[node][c]);
                    close(numeric, gradients.transforms[node][c]);
                }
                let numeric = slope(&mut s, &gp, &gq, |s| &mut s.log_radii[node]);
                close(numeric, gradients.log_radii[node]);
            }
            for j in 0..s.positions.len() {
                for c in 0..4 {
                    let numeric = slope(&mut s, &gp, &gq, |s| &mut s.rotations[j][c]);
                    close(numeric, gradients.rotations[j][c]);
                }
                let numeric = slope(&mut s, &gp, &gq, |s| &mut s.logits[j]);
                close(numeric, gradients.motion_logits[j]);
            }
        }
    }

    /// The gradient with respect to the position is that of the blend with constant weights.
    #[test]
    fn the_gradient_by_position_holds_the_weights() {
        for soft in [false, true] {
            let s = scene(7, soft);
            let mut rng = ChaCha8Rng::seed_from_u64(8);
            let gp: Vec<[f64; 3]> = (0..12).map(|_| random(&mut rng)).collect();
            let gradients = backward(&s.skin(), &gp, &[[0.0; 4]; 12], RIGID);
            for (row, &id) in s.ids.iter().enumerate() {
                let j = id as usize;
                let near = &s.neighbours[row * K..(row + 1) * K];
                let w = weights(s.positions[j], &s.nodes, &s.log_radii, near);
                let held = |point: [f64; 3]| {
                    let mut moved = [0.0; 3];
                    for (slot, &node) in near.iter().enumerate() {
                        let t = &s.transforms[node as usize];
                        let r = unit([t[4], t[5], t[6], t[7]]).unwrap().0;
                        let p = s.nodes[node as usize];
                        let turned = add(apply(matrix(r), sub(point, p)), p);
                        moved = add(moved, scale(add(turned, [t[0], t[1], t[2]]), w[slot]));
                    }
                    let delta = sub(moved, point);
                    let (m, rigid) = match s.soft {
                        true => (
                            1.0 / (1.0 + (-s.logits[j]).exp()),
                            RIGID * (1.0 - s.evidence[j]) * dot(delta, delta),
                        ),
                        false => (1.0, 0.0),
                    };
                    dot(add(point, scale(delta, m)), gp[j]) + rigid
                };
                for c in 0..3 {
                    let h = 1e-6;
                    let (mut up, mut down) = (s.positions[j], s.positions[j]);
                    up[c] += h;
                    down[c] -= h;
                    close((held(up) - held(down)) / (2.0 * h), gradients.positions[j][c]);
                }
            }
            // A static Gaussian passes its gradient through.
            assert_eq!(gradients.positions[1], gp[1]);
        }
    }

    #[test]
    fn static_gaussians_stay_bit_for_bit_and_are_not_rigid() {
        let mut s = scene(1, false);
        s.rotations[1] = [f64::NAN; 4];
        s.positions[4] = [-0.0; 3];
        let out = forward(&s.skin());
        assert!(out.rotations[1].iter().all(|c| c.is_nan()));
        assert!(out.positions[4].iter().all(|c| c.to_bits() == (-0.0f64).to_bits()));
        assert_eq!(out.rigidity, vec![0.0; s.ids.len()]);
        assert_ne!(out.positions[0], s.positions[0]);
    }

    #[test]
    fn underflowing_weights_still_sum_to_one() {
        let nodes = [[0.0f32; 3], [1.0, 0.0, 0.0]];
        // Both exponents are far below what f32's exp can hold.
        let w = weights([100.0, 0.0, 0.0], &nodes, &[-4.0, -4.0], &[1, 0]);
        assert_eq!(w, [1.0, 0.0]);
        // Both exponents are −∞ in f32: the nearest gets weight 1.
        let w = weights([1e15, 0.0, 0.0], &nodes, &[-40.0, -40.0], &[1, 0]);
        assert_eq!(w, [1.0, 0.0]);
        let w = weights([1e15, 0.0, 0.0], &nodes, &[f32::NAN, f32::NAN], &[1, NONE]);
        assert_eq!(w, [1.0, 0.0]);
        assert_eq!(weights([f32::NAN; 3], &nodes, &[0.0; 2], &[NONE, NONE]), [0.0, 0.0]);
    }

    #[test]
    fn what_follows_an_absent_control_point_is_not_seen() {
        let mut s = scene(6, false);
        let heaviest = |s: &Scene, row: usize| {
            let near = &s.neighbours[row * K..(row + 1) * K];
            let point = s.positions[s.ids[row] as usize];
            let weights = weights(point, &s.nodes, &s.log_radii, near);
            near[(0..K).max_by(|&a, &b| weights[a].total_cmp(&weights[b])).unwrap()] as usize
        };
        let gone = heaviest(&s, 0);
        s.transforms.iter_mut().for_each(|t| t[3] = 0.4);
        s.transforms[gone][3] = -20.0;
        let out = forward(&s.skin());
        let mut faded = 0;
        for (row, &id) in s.ids.iter().enumerate() {
            let (follows, j) = (heaviest(&s, row) == gone, id as usize);
            faded += usize::from(follows);
            let fade = if follows { -20.0 } else { 0.0 };
            assert_eq!(out.opacity_logits[j], s.opacity_logits[j] + fade);
        }
        assert!(faded > 0 && faded < s.ids.len(), "{faded}");
        // A static Gaussian keeps its opacity; with soft motion, each fades in proportion to `m`.
        assert_eq!(out.opacity_logits[1], s.opacity_logits[1]);
        s.soft = true;
        let j = s.ids[0] as usize;
        let fade = forward(&s.skin()).opacity_logits[j] - s.opacity_logits[j];
        assert!((fade + 20.0 * sigmoid(s.logits[j])).abs() < 1e-12, "{fade}");
    }

    #[test]
    fn hard_geometry_gives_finite_motion() {
        let mut s = scene(2, false);
        // Coincident control points on top of a Gaussian; antipodal, zero and NaN rotations.
        s.nodes = vec![s.positions[0]; 5];
        s.transforms[0] = [0.1, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0];
        s.transforms[1] = [0.1, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0];
        s.transforms[2] = [0.1, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0];
        s.transforms[3][4] = f64::NAN;
        s.rotations[0] = [0.0; 4];
        s.rotations[2] = [f64::NAN; 4];
        let listed: Vec<_> = s.ids.iter().map(|&j| s.positions[j as usize]).collect();
        s.neighbours = nearest(&listed, &s.nodes, K);
        let out = forward(&s.skin());
        assert_eq!(out.rotations[0], [1.0, 0.0, 0.0, 0.0]);
        let gradients = backward(&s.skin(), &[[1.0; 3]; 12], &[[1.0; 4]; 12], 0.0);
        for &id in &s.ids {
            let j = id as usize;
            assert!(out.positions[j].iter().chain(&out.rotations[j]).all(|v| v.is_finite()));
            assert!(gradients.positions[j].iter().all(|v| v.is_finite()));
        }
        assert!(
            gradients
                .transforms
                .iter()
                .flatten()
                .chain(&gradients.log_radii)
                .all(|v| v.is_finite())
        );
        assert_eq!(gradients.rotations[0], [0.0; 4]);
    }

    #[test]
    fn fewer_nodes_than_neighbours_and_points_nowhere() {
        let nodes = [[0.0f64; 3], [2.0, 0.0, 0.0]];
        assert_eq!(nearest(&[[1.5, 0.0, 0.0]], &nodes, 4), [1, 0, NONE, NONE]);
        assert_eq!(nearest(&[[1.0, 0.0, 0.0]], &nodes, 1), [0]);
        assert_eq!(nearest(&[[f64::NAN; 3]], &nodes, 2), [NONE, NONE]);
        assert_eq!(nearest::<f64>(&[[0.0; 3]], &[], 2), [NONE, NONE]);
    }

    /// A rigid motion shared by all control points moves every dynamic Gaussian rigidly.
    #[test]
    fn a_common_rigid_motion_is_followed_exactly() {
        let mut s = scene(5, false);
        let r = unit([0.9, 0.1, -0.3, 0.2]).unwrap().0;
        let t = [0.3, -0.2, 0.5];
        for (node, transform) in s.transforms.iter_mut().enumerate() {
            let p = s.nodes[node];
            let d = add(sub(apply(matrix(r), p), p), t);
            // Opposite signs name one rotation.
            let sign = if node % 2 == 0 { 2.0 } else { -0.5 };
            *transform =
                [d[0], d[1], d[2], 0.0, r[0] * sign, r[1] * sign, r[2] * sign, r[3] * sign];
        }
        let out = forward(&s.skin());
        for &id in &s.ids {
            let j = id as usize;
            let want = add(apply(matrix(r), s.positions[j]), t);
            for c in 0..3 {
                assert!((out.positions[j][c] - want[c]).abs() < 1e-12);
            }
            let turned = multiply(r, s.rotations[j]);
            let cosine = dot(turned, out.rotations[j]) / dot(turned, turned);
            assert!((cosine.abs() - 1.0).abs() < 1e-12);
        }
    }
}

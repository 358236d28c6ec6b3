//! The photometric loss and its gradient with respect to the rendered pixels.
//!
//! `(1 − λ) · mean |x − y| + λ · mean (1 − SSIM(x, y))` over pixels and channels, where
//! `x = rgb + (1 − alpha) · background` is the rendered image and y the reference image; plus
//! optional terms for depth and alpha. With weights m every mean is `Σ m ℓ / Σ m`. The SSIM map is
//! computed from the whole images and weighted afterwards, so a pixel of weight 0 still contributes
//! to the windows of its neighbours.

use super::Real;
use super::linear::Vec3;
use super::raster::Pixels;
use super::ssim::ssim;

/// Binary cross entropy clamps alpha to at least this distance from 0 and 1.
pub const BCE_MARGIN: f64 = 1e-6;

/// The training image and further targets of the loss.
#[derive(Clone, Debug)]
pub struct Target<'a, R> {
    /// Width, pixels.
    pub width: u32,
    /// Height, pixels.
    pub height: u32,
    /// The reference image.
    pub rgb: &'a [Vec3<R>],
    /// The background colour, visible where alpha is below 1.
    pub background: Vec3<R>,
    /// A weight per pixel; `None` for 1 everywhere.
    pub weights: Option<&'a [R]>,
    /// λ, the weight of SSIM, in [0, 1].
    pub ssim_share: R,
    /// The optional depth term.
    pub depth: Option<DepthTerm<'a, R>>,
    /// The optional alpha term.
    pub alpha: Option<AlphaTerm<'a, R>>,
}

/// The depth quantity that is compared.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum DepthKind {
    /// Mean depth, `depth / alpha`.
    Linear,
    /// Mean disparity, `alpha / depth`.
    Inverse,
}

/// `scale · Σ m |d − target| / Σ m`.
#[derive(Clone, Copy, Debug)]
pub struct DepthTerm<'a, R> {
    /// The depth quantity d.
    pub kind: DepthKind,
    /// Target values of the same quantity; read only where the weight is above 0.
    pub target: &'a [R],
    /// m per pixel: 0 where the target is unknown.
    pub weights: &'a [R],
    /// The term's factor.
    pub scale: R,
    /// Pixels with a smaller alpha give neither loss nor gradient, since their depth is a quotient
    /// of two values near zero. It must be above 0.
    pub min_alpha: R,
}

/// The loss function of alpha.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum AlphaKind {
    /// |alpha − target|.
    L1,
    /// Binary cross entropy.
    CrossEntropy,
}

/// `scale · Σ m ℓ(alpha, target) / Σ m`.
#[derive(Clone, Copy, Debug)]
pub struct AlphaTerm<'a, R> {
    /// The loss function ℓ.
    pub kind: AlphaKind,
    /// Target alpha in [0, 1].
    pub target: &'a [R],
    /// m per pixel; `None` for 1 everywhere.
    pub weights: Option<&'a [R]>,
    /// The term's factor.
    pub scale: R,
}

/// The loss, its parts before their factors, and its gradient.
#[derive(Clone, Debug)]
pub struct Loss<R> {
    /// The total loss.
    pub value: R,
    /// mean |x − y|.
    pub l1: R,
    /// mean SSIM.
    pub ssim: R,
    /// The depth term, its factor included.
    pub depth: R,
    /// The alpha term, its factor included.
    pub alpha: R,
    /// The gradient with respect to the rendered pixels.
    pub gradient: Pixels<R>,
}

/// −1, 0 or 1.
fn sign<R: Real>(x: R) -> R {
    if x > R::zero() {
        R::one()
    } else if x < R::zero() {
        -R::one()
    } else {
        R::zero()
    }
}

/// Weights divided by their sum; zeros where the sum is 0.
fn shares<R: Real>(weights: Option<&[R]>, count: usize) -> Vec<R> {
    let weights = weights.map_or_else(|| vec![R::one(); count], <[R]>::to_vec);
    let total: R = weights.iter().copied().sum();
    if total <= R::zero() {
        return vec![R::zero(); count];
    }
    weights.into_iter().map(|w| w / total).collect()
}

/// The loss of `rendered` against `target`.
pub fn loss<R: Real>(rendered: &Pixels<R>, target: &Target<'_, R>) -> Loss<R> {
    let (width, height) = (target.width as usize, target.height as usize);
    let count = width * height;
    let mut out = Loss {
        value: R::zero(),
        l1: R::zero(),
        ssim: R::zero(),
        depth: R::zero(),
        alpha: R::zero(),
        gradient: Pixels::zeros(count),
    };
    let third = R::one() / R::of(3.0);
    let per_channel: Vec<R> =
        shares(target.weights, count).into_iter().map(|w| w * third).collect();
    let weighed: R = per_channel.iter().copied().sum::<R>() * R::of(3.0);
    for channel in 0..3 {
        let background = target.background[channel];
        let x: Vec<R> = (0..count)
            .map(|i| rendered.rgb[i][channel] + (R::one() - rendered.alpha[i]) * background)
            .collect();
        let y: Vec<R> = target.rgb.iter().map(|p| p[channel]).collect();
        let (map, to_ssim) = ssim(&x, &y, &per_channel, width, height);
        for i in 0..count {
            out.l1 += per_channel[i] * (x[i] - y[i]).abs();
            out.ssim += per_channel[i] * map[i];
            let to_x = (R::one() - target.ssim_share) * per_channel[i] * sign(x[i] - y[i])
                - target.ssim_share * to_ssim[i];
            out.gradient.rgb[i][channel] = to_x;
            out.gradient.alpha[i] -= to_x * background;
        }
    }
    if let Some(term) = &target.depth {
        depth(rendered, term, &mut out);
    }
    if let Some(term) = &target.alpha {
        alpha(rendered, term, &mut out);
    }
    out.value = (R::one() - target.ssim_share) * out.l1
        + target.ssim_share * (weighed - out.ssim)
        + out.depth
        + out.alpha;
    out
}

fn depth<R: Real>(rendered: &Pixels<R>, term: &DepthTerm<'_, R>, out: &mut Loss<R>) {
    let shares = shares(Some(term.weights), rendered.alpha.len());
    for (i, share) in shares.into_iter().enumerate() {
        let (a, d) = (rendered.alpha[i], rendered.depth[i]);
        // d is Σ weight · z with every z beyond the near plane, so it is above 0 wherever alpha is.
        if share == R::zero() || a < term.min_alpha || d <= R::zero() {
            continue;
        }
        let (value, by_alpha, by_depth) = match term.kind {
            DepthKind::Linear => (d / a, -d / (a * a), R::one() / a),
            DepthKind::Inverse => (a / d, R::one() / d, -a / (d * d)),
        };
        let difference = value - term.target[i];
        let slope = term.scale * share * sign(difference);
        out.depth += term.scale * share * difference.abs();
        out.gradient.alpha[i] += slope * by_alpha;
        out.gradient.depth[i] += slope * by_depth;
    }
}

fn alpha<R: Real>(rendered: &Pixels<R>, term: &AlphaTerm<'_, R>, out: &mut Loss<R>) {
    let shares = shares(term.weights, rendered.alpha.len());
    let margin = R::of(BCE_MARGIN);
    for (i, share) in shares.into_iter().enumerate() {
        let (a, y) = (rendered.alpha[i], term.target[i]);
        let (value, slope) = match term.kind {
            AlphaKind::L1 => ((a - y).abs(), sign(a - y)),
            AlphaKind::CrossEntropy => {
                let p = a.max(margin).min(R::one() - margin);
                let q = R::one() - p;
                // A clamped alpha is constant, so its gradient is zero.
                let slope = if p == a { (p - y) / (p * q) } else { R::zero() };
                (-(y * p.ln() + (R::one() - y) * q.ln()), slope)
            }
        };
        out.alpha += term.scale * share * value;
        out.gradient.alpha[i] += term.scale * share * slope;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{RngExt, SeedableRng};

    const WIDTH: u32 = 19;
    const HEIGHT: u32 = 7;
    const COUNT: usize = (WIDTH * HEIGHT) as usize;

    struct Scene {
        rendered: Pixels<f64>,
        photo: Vec<[f64; 3]>,
        weights: Vec<f64>,
        other: Vec<f64>,
    }

    fn scene() -> Scene {
        let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(7);
        let mut random = |low: f64, high: f64| rng.random_range(low..high);
        Scene {
            rendered: Pixels {
                rgb: (0..COUNT).map(|_| std::array::from_fn(|_| random(0.0, 0.8))).collect(),
                alpha: (0..COUNT).map(|_| random(0.05, 0.95)).collect(),
                depth: (0..COUNT).map(|_| random(0.5, 4.0)).collect(),
            },
            photo: (0..COUNT).map(|_| std::array::from_fn(|_| random(0.0, 1.0))).collect(),
            // Some pixels have weight zero.
            weights: (0..COUNT).map(|i| if i % 5 == 0 { 0.0 } else { random(0.0, 2.0) }).collect(),
            other: (0..COUNT).map(|_| random(0.0, 1.0)).collect(),
        }
    }

    fn target<'a>(s: &'a Scene, depth: DepthKind, alpha: AlphaKind) -> Target<'a, f64> {
        Target {
            width: WIDTH,
            height: HEIGHT,
            rgb: &s.photo,
            background: [0.2, 0.7, 0.4],
            weights: Some(&s.weights),
            ssim_share: 0.2,
            depth: Some(DepthTerm {
                kind: depth,
                target: &s.other,
                weights: &s.weights,
                scale: 0.3,
                min_alpha: 0.1,
            }),
            alpha: Some(AlphaTerm { kind: alpha, target: &s.other, weights: None, scale: 0.7 }),
        }
    }

    fn check(depth: DepthKind, alpha: AlphaKind) {
        let s = scene();
        let target = target(&s, depth, alpha);
        let gradient = loss(&s.rendered, &target).gradient;
        let numeric = |change: &dyn Fn(&mut Pixels<f64>, f64)| {
            let at = |h: f64| {
                let mut pixels = s.rendered.clone();
                change(&mut pixels, h);
                loss(&pixels, &target).value
            };
            (at(1e-6) - at(-1e-6)) / 2e-6
        };
        for i in 0..COUNT {
            for c in 0..3 {
                let n = numeric(&|p, h| p.rgb[i][c] += h);
                assert!((gradient.rgb[i][c] - n).abs() < 1e-8, "rgb {i} {c}");
            }
            let n = numeric(&|p, h| p.alpha[i] += h);
            assert!((gradient.alpha[i] - n).abs() < 1e-7, "alpha {i} {} {n}", gradient.alpha[i]);
            let n = numeric(&|p, h| p.depth[i] += h);
            assert!((gradient.depth[i] - n).abs() < 1e-8, "depth {i}");
        }
    }

    #[test]
    fn gradient_with_linear_depth_and_l1_alpha() {
        check(DepthKind::Linear, AlphaKind::L1);
    }

    #[test]
    fn gradient_with_inverse_depth_and_cross_entropy() {
        check(DepthKind::Inverse, AlphaKind::CrossEntropy);
    }

    #[test]
    fn equal_images_lose_nothing() {
        let s = scene();
        let mut target = target(&s, DepthKind::Linear, AlphaKind::L1);
        (target.depth, target.alpha) = (None, None);
        let composed: Vec<[f64; 3]> = (0..COUNT)
            .map(|i| {
                std::array::from_fn(|c| {
                    s.rendered.rgb[i][c] + (1.0 - s.rendered.alpha[i]) * target.background[c]
                })
            })
            .collect();
        target.rgb = &composed;
        let loss = loss(&s.rendered, &target);
        assert!(loss.value.abs() < 1e-12 && (loss.ssim - 1.0).abs() < 1e-12);
    }

    #[test]
    fn no_weight_no_loss() {
        let s = scene();
        let zeros = vec![0.0; COUNT];
        let mut target = target(&s, DepthKind::Linear, AlphaKind::L1);
        target.weights = Some(&zeros);
        (target.depth, target.alpha) = (None, None);
        let loss = loss(&s.rendered, &target);
        assert_eq!(loss.value, 0.0);
        assert!(loss.gradient.rgb.iter().flatten().all(|&g| g == 0.0));
    }
}

//! Structural similarity of one channel and its gradient (Wang et al. 2004): 11×11 Gaussian window
//! of σ = 1.5 normalised to sum 1, zeros outside the image, dynamic range 1.

use super::Real;

/// Taps of the window.
pub const WINDOW: usize = 11;
/// Standard deviation of the window, pixels.
pub const SIGMA: f64 = 1.5;
/// (0.01 · range)².
pub const C1: f64 = 1e-4;
/// (0.03 · range)².
pub const C2: f64 = 9e-4;

/// The window's taps along one axis; they sum to 1.
pub fn taps<R: Real>() -> [R; WINDOW] {
    let raw: [f64; WINDOW] = std::array::from_fn(|k| {
        let d = k as f64 - (WINDOW / 2) as f64;
        (-d * d / (2.0 * SIGMA * SIGMA)).exp()
    });
    let sum: f64 = raw.iter().sum();
    raw.map(|t| R::of(t / sum))
}

/// The window's mean around every pixel. The operation is its own adjoint: the window is symmetric
/// and what lies outside counts as zero.
pub fn blur<R: Real>(values: &[R], width: usize, height: usize) -> Vec<R> {
    let taps = taps::<R>();
    let half = (WINDOW / 2) as isize;
    let along = |source: &[R], x: usize, y: usize, horizontal: bool| {
        let mut sum = R::zero();
        for (k, &tap) in taps.iter().enumerate() {
            let shift = k as isize - half;
            let (sx, sy) = match horizontal {
                true => (x as isize + shift, y as isize),
                false => (x as isize, y as isize + shift),
            };
            if (0..width as isize).contains(&sx) && (0..height as isize).contains(&sy) {
                sum += tap * source[sy as usize * width + sx as usize];
            }
        }
        sum
    };
    let pass = |source: &[R], horizontal: bool| -> Vec<R> {
        (0..width * height).map(|i| along(source, i % width, i / width, horizontal)).collect()
    };
    pass(&pass(values, true), false)
}

/// The SSIM map between `x` and `y`, and the gradient of `Σ weights · map` with respect to `x`.
pub fn ssim<R: Real>(
    x: &[R],
    y: &[R],
    weights: &[R],
    width: usize,
    height: usize,
) -> (Vec<R>, Vec<R>) {
    let product = |a: &[R], b: &[R]| -> Vec<R> { a.iter().zip(b).map(|(&a, &b)| a * b).collect() };
    let blur = |v: &[R]| blur(v, width, height);
    let (mean_x, mean_y) = (blur(x), blur(y));
    let (xx, yy, xy) = (blur(&product(x, x)), blur(&product(y, y)), blur(&product(x, y)));
    let (c1, c2, two) = (R::of(C1), R::of(C2), R::of(2.0));

    let count = width * height;
    let mut map = vec![R::zero(); count];
    // Derivatives of the weighted sum with respect to the window's means of x, x² and xy.
    let [mut by_mean, mut by_xx, mut by_xy] = std::array::from_fn(|_| vec![R::zero(); count]);
    for i in 0..count {
        let (mx, my) = (mean_x[i], mean_y[i]);
        let (var_x, var_y, cov) = (xx[i] - mx * mx, yy[i] - my * my, xy[i] - mx * my);
        let (a1, a2) = (two * mx * my + c1, two * cov + c2);
        let (b1, b2) = (mx * mx + my * my + c1, var_x + var_y + c2);
        let s = a1 * a2 / (b1 * b2);
        map[i] = s;
        let w = weights[i];
        by_xx[i] = -w * s / b2;
        by_xy[i] = w * two * a1 / (b1 * b2);
        // The mean enters directly, and through the variance and the covariance.
        by_mean[i] = w * (two * my * a2 / (b1 * b2) - two * mx * s / b1)
            - two * mx * by_xx[i]
            - my * by_xy[i];
    }
    let (by_mean, by_xx, by_xy) = (blur(&by_mean), blur(&by_xx), blur(&by_xy));
    let gradient =
        (0..count).map(|i| by_mean[i] + two * x[i] * by_xx[i] + y[i] * by_xy[i]).collect();
    (map, gradient)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn noise(n: usize, seed: u64) -> Vec<f64> {
        let mut state = seed;
        (0..n)
            .map(|_| {
                state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
                (state >> 11) as f64 / (1u64 << 53) as f64
            })
            .collect()
    }

    #[test]
    fn equal_images_have_ssim_one_and_no_gradient() {
        let x = noise(17 * 13, 1);
        let (map, gradient) = ssim(&x, &x, &vec![1.0; x.len()], 17, 13);
        assert!(map.iter().all(|s| (s - 1.0).abs() < 1e-12));
        assert!(gradient.iter().all(|g| g.abs() < 1e-9));
    }

    /// Against the definition, computed with a plain 2D window at one pixel in a corner.
    #[test]
    fn map_is_the_definition() {
        let (width, height) = (9, 8);
        let (x, y) = (noise(72, 2), noise(72, 3));
        let (map, _) = ssim(&x, &y, &[1.0; 72], width, height);
        let (cx, cy) = (1_i32, 6_i32);
        let mut total = 0.0;
        let mut sums = [0.0; 5];
        for dy in -5..=5_i32 {
            for dx in -5..=5_i32 {
                let weight = (-f64::from(dx * dx + dy * dy) / 4.5).exp();
                total += weight;
                let (px, py) = (cx + dx, cy + dy);
                if (0..9).contains(&px) && (0..8).contains(&py) {
                    let at = (py * 9 + px) as usize;
                    let (a, b) = (x[at], y[at]);
                    for (sum, v) in sums.iter_mut().zip([a, b, a * a, b * b, a * b]) {
                        *sum += weight * v;
                    }
                }
            }
        }
        let [mx, my, xx, yy, xy] = sums.map(|s| s / total);
        let expected = (2.0 * mx * my + C1) * (2.0 * (xy - mx * my) + C2)
            / ((mx * mx + my * my + C1) * (xx - mx * mx + yy - my * my + C2));
        assert!((map[(cy * 9 + cx) as usize] - expected).abs() < 1e-12);
    }

    #[test]
    fn gradient_matches_central_differences() {
        let (width, height) = (14, 6);
        let (x, y, weights) = (noise(84, 4), noise(84, 5), noise(84, 6));
        let value = |x: &[f64]| -> f64 {
            ssim(x, &y, &weights, width, height).0.iter().zip(&weights).map(|(s, w)| s * w).sum()
        };
        let (_, gradient) = ssim(&x, &y, &weights, width, height);
        for i in 0..x.len() {
            let at = |h: f64| {
                let mut x = x.clone();
                x[i] += h;
                value(&x)
            };
            let numeric = (at(1e-5) - at(-1e-5)) / 2e-5;
            assert!((gradient[i] - numeric).abs() < 1e-7, "{i}: {} {numeric}", gradient[i]);
        }
    }
}

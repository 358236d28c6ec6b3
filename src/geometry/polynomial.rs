//! Real roots of polynomials of small degree.

/// The value at x of the polynomial with coefficient `coefficients[k]` of x^k.
pub fn evaluate(coefficients: &[f64], x: f64) -> f64 {
    coefficients.iter().rev().fold(0.0, |sum, &c| sum * x + c)
}

/// All real roots in ascending order of a polynomial with coefficient `coefficients[k]` of x^k.
///
/// Between adjacent roots of the derivative a polynomial is monotonic, so each sign change brackets exactly
/// one root; the derivative's roots are found recursively. The method cannot diverge. A double root (a
/// value at an extremum within rounding of zero) is reported once. Non-finite coefficients and the zero
/// polynomial give no roots.
pub fn real_roots(coefficients: &[f64]) -> Vec<f64> {
    if coefficients.iter().any(|c| !c.is_finite()) {
        return Vec::new();
    }
    let largest = coefficients.iter().fold(0.0f64, |m, c| m.max(c.abs()));
    if largest == 0.0 {
        return Vec::new();
    }
    let scaled: Vec<f64> = coefficients.iter().map(|c| c / largest).collect();
    // A leading coefficient below rounding would only add a spurious root.
    let degree = scaled.iter().rposition(|c| c.abs() > 1e-14).unwrap_or(0);
    roots_of(&scaled[..=degree])
}

fn roots_of(p: &[f64]) -> Vec<f64> {
    let degree = p.len() - 1;
    match degree {
        0 => return Vec::new(),
        1 => return vec![-p[0] / p[1]],
        2 => return quadratic(p[0], p[1], p[2]),
        _ => {}
    }
    let derivative: Vec<f64> = (1..p.len()).map(|k| k as f64 * p[k]).collect();
    let extrema = roots_of(&derivative);
    // Cauchy's bound on the modulus of every root.
    let bound = 1.0 + p[..degree].iter().fold(0.0f64, |m, c| m.max((c / p[degree]).abs()));
    let mut knots = Vec::with_capacity(extrema.len() + 2);
    knots.push(-bound);
    knots.extend(extrema.iter().copied().filter(|x| x.abs() < bound));
    knots.push(bound);
    let mut roots: Vec<f64> = Vec::with_capacity(degree);
    for pair in knots.windows(2) {
        let (fa, fb) = (evaluate(p, pair[0]), evaluate(p, pair[1]));
        if (fa < 0.0) != (fb < 0.0) {
            roots.push(bracketed(p, &derivative, pair[0], pair[1], fa < 0.0));
        }
    }
    for &x in &extrema {
        let size: f64 = p.iter().enumerate().map(|(k, c)| (c * x.powi(k as i32)).abs()).sum();
        let near = |r: &f64| (r - x).abs() <= 1e-6 * (1.0 + x.abs());
        if evaluate(p, x).abs() <= 1e-13 * size && !roots.iter().any(near) {
            roots.push(x);
        }
    }
    roots.sort_by(f64::total_cmp);
    roots
}

/// Newton's method, safeguarded by a bracket that bisection shrinks.
fn bracketed(p: &[f64], derivative: &[f64], mut a: f64, mut b: f64, rising: bool) -> f64 {
    let mut x = 0.5 * (a + b);
    for _ in 0..200 {
        let f = evaluate(p, x);
        if f == 0.0 {
            return x;
        }
        if (f < 0.0) == rising {
            a = x;
        } else {
            b = x;
        }
        let step = f / evaluate(derivative, x);
        let newton = x - step;
        let next = if newton > a && newton < b { newton } else { 0.5 * (a + b) };
        if (next - x).abs() <= 1e-16 * x.abs() || next == x {
            return next;
        }
        x = next;
    }
    x
}

/// Real roots of c + b x + a x², without cancellation.
fn quadratic(c: f64, b: f64, a: f64) -> Vec<f64> {
    let discriminant = b * b - 4.0 * a * c;
    if discriminant < 0.0 {
        return Vec::new();
    }
    let q = -0.5 * (b + discriminant.sqrt().copysign(b));
    if q == 0.0 {
        return vec![0.0];
    }
    let (x, y) = (q / a, c / q);
    if x == y { vec![x] } else { vec![x.min(y), x.max(y)] }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn from_roots(roots: &[f64]) -> Vec<f64> {
        roots.iter().fold(vec![1.0], |p, &r| {
            let mut out = vec![0.0; p.len() + 1];
            for (k, c) in p.iter().enumerate() {
                out[k + 1] += c;
                out[k] -= r * c;
            }
            out
        })
    }

    #[test]
    fn finds_what_a_polynomial_was_made_of() {
        for truth in [
            vec![2.0],
            vec![-3.0, 1.5],
            vec![-1.0, 0.0, 4.0],
            vec![-20.0, -3.0, -0.5, 0.1, 1.0, 2.0, 7.0, 9.0, 15.0, 30.0],
        ] {
            let found = real_roots(&from_roots(&truth));
            assert_eq!(found.len(), truth.len(), "{found:?}");
            for (f, t) in found.iter().zip(&truth) {
                assert!((f - t).abs() < 1e-6 * (1.0 + t.abs()), "{found:?} {truth:?}");
            }
        }
    }

    #[test]
    fn no_roots_double_roots_and_nonsense() {
        assert!(real_roots(&[1.0, 0.0, 1.0]).is_empty());
        assert!(real_roots(&[1.0, 0.0, 1.0, 0.0, 1.0]).is_empty());
        let double = real_roots(&from_roots(&[1.0, 1.0, -2.0]));
        assert!(double.iter().any(|r| (r - 1.0).abs() < 1e-6), "{double:?}");
        assert!(real_roots(&[]).is_empty());
        assert!(real_roots(&[0.0, 0.0]).is_empty());
        assert!(real_roots(&[5.0]).is_empty());
        assert!(real_roots(&[f64::NAN, 1.0]).is_empty());
        assert_eq!(real_roots(&[-4.0, 2.0, 0.0, 0.0]), vec![2.0]);
    }
}

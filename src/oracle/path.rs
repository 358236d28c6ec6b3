//! Paths of control points: values at evenly spaced times of [0, 1], interpolated by the cubic of
//! Catmull and Rom, which goes through them. Beyond the first and the last key these are repeated.
//!
//! Source: Catmull and Rom 1974, the uniform spline of tension ½.

use super::Real;

/// The four keys around a time, and their weights, which sum to 1.
pub fn keys<R: Real>(time: R, count: usize) -> [(usize, R); 4] {
    let last = count - 1;
    let time = time.max(R::zero()).min(R::one());
    let place = time * R::of(last as f64);
    let mut before = 0;
    while before + 1 < last && R::of((before + 1) as f64) <= place {
        before += 1;
    }
    let u = place - R::of(before as f64);
    let (u2, u3) = (u * u, u * u * u);
    let of = |a: f64, b: f64, c: f64, d: f64| {
        R::of(0.5) * (R::of(a) * u3 + R::of(b) * u2 + R::of(c) * u + R::of(d))
    };
    let weights = [
        of(-1.0, 2.0, -1.0, 0.0),
        of(3.0, -5.0, 0.0, 2.0),
        of(-3.0, 4.0, 1.0, 0.0),
        of(1.0, -1.0, 0.0, 0.0),
    ];
    std::array::from_fn(|slot| ((before + slot).saturating_sub(1).min(last), weights[slot]))
}

/// The motions `[time][node]` of `nodes` control points by their paths `[key][node]`: translation,
/// the value added to opacity logits, and rotation, which the path stores as the offset from `[1,
/// 0, 0, 0]`.
pub fn evaluate<R: Real>(paths: &[[R; 8]], nodes: usize, times: &[R]) -> Vec<[R; 8]> {
    let mut out = Vec::with_capacity(nodes * times.len());
    for &time in times {
        let keys = keys(time, paths.len() / nodes);
        for node in 0..nodes {
            let of = |c: usize| -> R {
                let sum: R = keys.iter().map(|&(key, w)| w * paths[key * nodes + node][c]).sum();
                if c == 4 { sum + R::one() } else { sum }
            };
            out.push(std::array::from_fn(of));
        }
    }
    out
}

/// The gradient with respect to the paths, for a loss whose gradient with respect to the motions is
/// given; zero for the value added to opacity logits, which is given.
pub fn gather<R: Real>(
    gradients: &[[R; 8]],
    nodes: usize,
    times: &[R],
    count: usize,
) -> Vec<[R; 8]> {
    let mut out = vec![[R::zero(); 8]; count * nodes];
    for (t, &time) in times.iter().enumerate() {
        for (key, weight) in keys(time, count) {
            for node in 0..nodes {
                for c in (0..8).filter(|&c| c != 3) {
                    out[key * nodes + node][c] += weight * gradients[t * nodes + node][c];
                }
            }
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn it_goes_through_the_keys_and_straight_lines_stay_straight() {
        for count in [1, 2, 3, 7] {
            for key in 0..count {
                let time = key as f64 / (count.max(2) - 1) as f64;
                let weight = |k: usize| {
                    let found = keys(time, count);
                    found.iter().filter(|(at, _)| *at == k).map(|(_, w)| w).sum::<f64>()
                };
                for other in 0..count {
                    assert!((weight(other) - f64::from(u8::from(other == key))).abs() < 1e-12);
                }
            }
        }
        // Where no key is repeated.
        for place in [1.0, 1.3, 2.5, 3.99] {
            let found = keys(place / 5.0, 6);
            let mean: f64 = found.iter().map(|&(key, w)| w * key as f64).sum();
            assert!((mean - place).abs() < 1e-12);
            assert!((found.iter().map(|(_, w)| w).sum::<f64>() - 1.0).abs() < 1e-12);
        }
    }

    #[test]
    fn the_gradient_is_the_transpose() {
        let (nodes, count, times) = (2, 5, [0.0, 0.31, 0.98]);
        let mut seed = 1u64;
        let mut draw = || -> [f64; 8] {
            std::array::from_fn(|c| {
                seed = seed.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
                if c == 3 { 0.0 } else { (seed >> 40) as f64 / f64::from(1 << 24) - 0.5 }
            })
        };
        let paths: Vec<[f64; 8]> = (0..nodes * count).map(|_| draw()).collect();
        let given: Vec<[f64; 8]> = (0..nodes * times.len()).map(|_| draw()).collect();
        let dot = |a: &[[f64; 8]], b: &[[f64; 8]]| -> f64 {
            a.as_flattened().iter().zip(b.as_flattened()).map(|(x, y)| x * y).sum()
        };
        let mut moved = evaluate(&paths, nodes, &times);
        moved.iter_mut().for_each(|motion| motion[4] -= 1.0);
        let forward = dot(&moved, &given);
        let backward = dot(&paths, &gather(&given, nodes, &times, count));
        assert!((forward - backward).abs() < 1e-12, "{forward} {backward}");
    }
}

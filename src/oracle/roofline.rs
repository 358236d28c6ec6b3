//! The arithmetic with which the peak rate of a device is measured.

use super::Real;

/// Independent chains of one seed.
const CHAINS: usize = 16;

/// For each seed the sum of sixteen chains: chain c starts at (c + 1) · seed, and each round takes x
/// to 0.75 · x + seed four times.
pub fn fma<R: Real>(seeds: &[R], rounds: u32) -> Vec<R> {
    let chain = |seed: R, c: usize| {
        let mut x = R::of((c + 1) as f64) * seed;
        for _ in 0..4 * rounds {
            x = R::of(0.75) * x + seed;
        }
        x
    };
    let sum = |seed: R| (0..CHAINS).map(|c| chain(seed, c)).fold(R::zero(), |sum, x| sum + x);
    seeds.iter().map(|&seed| sum(seed)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// 0.75ⁿ · start + 4 · (1 − 0.75ⁿ) · seed, summed over starts of 1 to 16 seeds.
    #[test]
    fn chains_follow_the_geometric_series() {
        for rounds in [0, 1, 7, 40] {
            let shrunk = 0.75f64.powi(4 * rounds as i32);
            let closed = 136.0 * shrunk + 64.0 * (1.0 - shrunk);
            let [sum] = fma(&[0.5], rounds)[..] else { panic!("one seed, one sum") };
            assert!((sum - 0.5 * closed).abs() < 1e-12, "{rounds}: {sum}");
        }
    }
}

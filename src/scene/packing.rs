//! Shared parts of the compact Gaussian formats: quantisation, and a spatially coherent (Morton)
//! order.

use crate::types::{Gaussians, SH_C0, sh_coefficients};
use crate::{Error, Result};
use std::path::Path;

/// Opacities of the bytes 0 and 255 are moved inwards by a quarter of a quantisation step, so that
/// the logit is finite.
const INSIDE: f32 = 0.25 / 255.0;

/// The opacity of a logit.
pub(super) fn opacity(logit: f32) -> f32 {
    1.0 / (1.0 + (-logit).exp())
}

/// The logit of an opacity of 8 bits.
pub(super) fn logit(byte: u8) -> f32 {
    logit_of(f32::from(byte) / 255.0)
}

/// The logit of an opacity that was quantised to 8 bits.
pub(super) fn logit_of(opacity: f32) -> f32 {
    let opacity = opacity.clamp(INSIDE, 1.0 - INSIDE);
    (opacity / (1.0 - opacity)).ln()
}

/// An infinite logit as that of the opacity 0 or 1 in 8 bits; others as they are.
pub(super) fn finite_logit(logit: f32) -> f32 {
    if logit.is_infinite() { logit_of(opacity(logit)) } else { logit }
}

/// Quantises a value in [0, 1] to `most` steps; values outside are clamped.
pub(super) fn steps(share: f32, most: u32) -> u32 {
    (share.clamp(0.0, 1.0) * most as f32).round() as u32
}

/// Quantises a value in [0, 1] to 8 bits.
pub(super) fn byte(share: f32) -> u8 {
    steps(share, 255) as u8
}

/// The colour of a coefficient of the constant harmonic.
pub(super) fn colour(harmonic: [f32; 3]) -> [f32; 3] {
    harmonic.map(|h| 0.5 + SH_C0 * h)
}

/// The coefficient of the constant harmonic for a colour.
pub(super) fn harmonic(colour: [f32; 3]) -> [f32; 3] {
    colour.map(|c| (c - 0.5) / SH_C0)
}

/// The normalised quaternion; one without a direction becomes the identity.
pub(super) fn unit(q: [f32; 4]) -> [f32; 4] {
    let length = q.iter().map(|v| f64::from(*v).powi(2)).sum::<f64>().sqrt();
    match length > 1e-10 && length.is_finite() {
        true => q.map(|v| (f64::from(v) / length) as f32),
        false => [1.0, 0.0, 0.0, 0.0],
    }
}

/// The index of a unit quaternion's largest component, and the quaternion with the sign that makes
/// this component positive. The other three components then determine the rotation.
pub(super) fn largest(q: [f32; 4]) -> (usize, [f32; 4]) {
    let mut largest = 0;
    for i in 1..4 {
        if q[i].abs() > q[largest].abs() {
            largest = i;
        }
    }
    (largest, if q[largest] < 0.0 { q.map(|v| -v) } else { q })
}

/// The component of a unit quaternion that follows from the other three.
pub(super) fn rest(parts: [f32; 4]) -> f32 {
    (1.0 - parts.iter().map(|v| v * v).sum::<f32>()).max(0.0).sqrt()
}

/// Point indices in Morton order: 10 bits per axis, interleaved.
pub(super) fn morton_order(positions: &[[f32; 3]]) -> Vec<u32> {
    let mut low = [f32::INFINITY; 3];
    let mut high = [f32::NEG_INFINITY; 3];
    for p in positions {
        for c in 0..3 {
            (low[c], high[c]) = (low[c].min(p[c]), high[c].max(p[c]));
        }
    }
    let spread = |mut v: u32| {
        v = (v | v << 16) & 0x0300_00ff;
        v = (v | v << 8) & 0x0300_f00f;
        v = (v | v << 4) & 0x030c_30c3;
        (v | v << 2) & 0x0924_9249
    };
    let key = |p: &[f32; 3]| {
        let axis = |c: usize| {
            let size = high[c] - low[c];
            spread(if size > 0.0 { steps((p[c] - low[c]) / size, 1023) } else { 0 })
        };
        axis(0) << 2 | axis(1) << 1 | axis(2)
    };
    let keys: Vec<u32> = positions.iter().map(key).collect();
    let mut order: Vec<u32> = (0..positions.len() as u32).collect();
    order.sort_by_key(|&i| (keys[i as usize], i));
    order
}

/// The Gaussians with these indices, in this order.
pub(super) fn picked(g: &Gaussians, order: &[u32]) -> Gaussians {
    fn rows<T: Copy>(of: &[T], order: &[u32], per: usize) -> Vec<T> {
        let row = |&i: &u32| of[i as usize * per..(i as usize + 1) * per].iter().copied();
        order.iter().flat_map(row).collect()
    }
    Gaussians {
        positions: rows(&g.positions, order, 1),
        log_scales: rows(&g.log_scales, order, 1),
        rotations: rows(&g.rotations, order, 1),
        opacity_logits: rows(&g.opacity_logits, order, 1),
        sh_degree: g.sh_degree,
        sh: rows(&g.sh, order, sh_coefficients(g.sh_degree)),
        motion_logits: match g.motion_logits.is_empty() {
            true => Vec::new(),
            false => rows(&g.motion_logits, order, 1),
        },
    }
}

/// Checks that a file of `packed` bytes can unpack to `unpacked` bytes of Gaussians, and that
/// memory suffices.
pub(super) fn check_room(path: &Path, unpacked: u64, packed: usize) -> Result<()> {
    crate::io::check_unpacked(path, unpacked, packed)?;
    crate::io::check_memory(unpacked.saturating_mul(8), &format!("reading {}", path.display()))
}

/// The error of a decompressor, with the file's path.
pub(super) fn unpacking(path: &Path, what: &str, error: &std::io::Error) -> Error {
    Error::format(
        path,
        format!("{what} cannot be unpacked: {error}; the file is damaged or cut off"),
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn neighbours_lie_together() {
        let grid = |i: usize| [(i % 8) as f32, (i / 8 % 8) as f32, (i / 64) as f32];
        let positions: Vec<[f32; 3]> = (0..512).map(grid).collect();
        let order = morton_order(&positions);
        let mut sorted = order.clone();
        sorted.sort_unstable();
        assert_eq!(sorted, (0..512).collect::<Vec<u32>>());
        // Each run of 64 fills a cube of side 4.
        for part in order.chunks_exact(64) {
            let corner = |p: [f32; 3]| p.map(|v| (v / 4.0) as u32);
            let first = corner(positions[part[0] as usize]);
            assert!(part.iter().all(|&i| corner(positions[i as usize]) == first));
        }
        assert_eq!(morton_order(&[[1.0; 3]; 3]), [0, 1, 2], "points in one place");
        assert!(morton_order(&[]).is_empty());
    }

    #[test]
    fn opacities_and_quaternions_come_back() {
        for byte in 0..=255u8 {
            assert_eq!(steps(opacity(logit(byte)), 255), u32::from(byte));
        }
        assert_eq!(finite_logit(f32::NEG_INFINITY), logit(0));
        assert_eq!(finite_logit(f32::INFINITY), logit(255));
        assert!(finite_logit(30.0) == 30.0 && finite_logit(f32::NAN).is_nan());
        assert_eq!(unit([0.0; 4]), [1.0, 0.0, 0.0, 0.0]);
        let (at, q) = largest(unit([0.1, 0.2, -3.0, 0.4]));
        assert_eq!(at, 2);
        let mut others = q;
        others[2] = 0.0;
        assert!(q[2] > 0.0 && (rest(others) - q[2]).abs() < 1e-6);
    }
}

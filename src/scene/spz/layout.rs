//! The attribute arrays of an SPZ file, and their conversion from and to Gaussians.

use super::{Version, further};
use crate::scene::axes::Axes;
use crate::scene::packing;
use crate::types::{Gaussians, sh_coefficients};

/// Scale of the constant harmonic's colour in 8 bits; it leaves a margin for colours outside [0,
/// 1].
const COLOUR: f32 = 0.15;
/// Largest magnitude of a 24-bit fixed-point coordinate.
const FARTHEST: f32 = 8_388_607.0;
/// Quantisation steps of a position per size of a small Gaussian.
const STEPS: f32 = 64.0;
/// Bits of the first band's harmonics and of the others, as in the reference library.
const BITS: [u32; 2] = [5, 4];
/// Largest 9-bit magnitude of a quaternion component that is not the largest one.
const PART: f32 = 511.0;

/// Bytes per Gaussian in each array.
pub(super) fn sizes(rotation: usize, sh_degree: u32) -> [usize; 6] {
    [9, 1, 3, 3, rotation, 3 * further(sh_degree)]
}

/// The arrays: positions, opacities, colours, scales, rotations, harmonics.
pub(super) struct Arrays(pub [Vec<u8>; 6]);

/// The number of fraction bits for positions, and the indices of the Gaussians that fit. The bits
/// resolve the smaller Gaussians of the scene, but are limited so that at most one position in a
/// thousand is out of range.
pub(super) fn fraction(g: &Gaussians) -> (u8, Vec<u32>) {
    let largest = |s: &[f32; 3]| s[0].max(s[1]).max(s[2]);
    let mut sizes: Vec<f32> = g.log_scales.iter().map(largest).collect();
    let tenth = sizes.len() / 10;
    let (_, size, _) = sizes.select_nth_unstable_by(tenth, f32::total_cmp);
    let wanted = (STEPS / size.exp()).log2().ceil().clamp(0.0, 23.0) as u8;
    let reach = |p: &[f32; 3]| p.iter().map(|v| v.abs()).fold(0.0, f32::max);
    let within = |fraction: u8| -> Vec<u32> {
        let most = FARTHEST / f32::from(fraction).exp2();
        (0..).zip(&g.positions).filter(|(_, p)| reach(p) <= most).map(|(i, _)| i).collect()
    };
    let mut fraction = wanted;
    loop {
        let fitting = within(fraction);
        if fraction == 0 || (g.len() - fitting.len()) * 1000 <= g.len() {
            return (fraction, fitting);
        }
        fraction -= 1;
    }
}

impl Arrays {
    /// The arrays of Gaussians whose positions are all in range.
    pub fn of(g: &Gaussians, fraction: u8, version: Version) -> Arrays {
        let (axes, bands) = (Axes::default(), sh_coefficients(g.sh_degree));
        let unit = f32::from(fraction).exp2();
        let mut arrays: [Vec<u8>; 6] = Default::default();
        let [positions, opacities, colours, scales, rotations, harmonics] = &mut arrays;
        for i in 0..g.len() {
            for v in axes.place(g.positions[i]) {
                let fixed = (v * unit).round().clamp(-FARTHEST, FARTHEST) as i32;
                positions.extend(&fixed.to_le_bytes()[..3]);
            }
            opacities.push(packing::byte(packing::opacity(g.opacity_logits[i])));
            let rows = &g.sh[i * bands..][..bands];
            colours.extend(rows[0].map(|h| packing::byte(COLOUR * h + 0.5)));
            scales.extend(
                g.log_scales[i].map(|s| ((s + 10.0) * 16.0).round().clamp(0.0, 255.0) as u8),
            );
            let q = axes.turn(packing::unit(g.rotations[i]));
            match version {
                Version::V2 => rotations.extend(vector(q)),
                Version::V3 | Version::V4 => rotations.extend(packed(q).to_le_bytes()),
            }
            for (k, row) in rows[1..].iter().enumerate() {
                let step = 1 << (8 - BITS[usize::from(k >= 3)]);
                harmonics.extend(row.map(|h| bucket(axes.harmonic(k) * h, step)));
            }
        }
        Arrays(arrays)
    }

    /// The Gaussians of the arrays, whose sizes must be correct.
    pub fn gaussians(&self, count: usize, sh_degree: u32, fraction: u8, axes: Axes) -> Gaussians {
        let [positions, opacities, colours, scales, rotations, harmonics] = &self.0;
        let mut out = Gaussians { sh_degree, ..Gaussians::default() };
        let unit = (-f32::from(fraction)).exp2();
        let fixed = |b: &[u8; 3]| (i32::from_le_bytes([0, b[0], b[1], b[2]]) >> 8) as f32 * unit;
        let places = positions.as_chunks::<3>().0.as_chunks::<3>().0;
        out.positions = places.iter().map(|p| axes.place(p.each_ref().map(fixed))).collect();
        out.opacity_logits = opacities.iter().map(|&b| packing::logit(b)).collect();
        let scale = |&b: &u8| f32::from(b) / 16.0 - 10.0;
        out.log_scales =
            scales.as_chunks::<3>().0.iter().map(|s| s.each_ref().map(scale)).collect();
        out.rotations = match rotations.len() == 4 * count {
            true => {
                let words = rotations.as_chunks::<4>().0.iter();
                words.map(|b| axes.turn(unpacked(u32::from_le_bytes(*b)))).collect()
            }
            false => {
                let part = |b: u8| f32::from(b) / 127.5 - 1.0;
                let rows = rotations.as_chunks::<3>().0.iter();
                let q = |b: &[u8; 3]| [0.0, part(b[0]), part(b[1]), part(b[2])];
                rows.map(q).map(|q| axes.turn([packing::rest(q), q[1], q[2], q[3]])).collect()
            }
        };
        let further = further(sh_degree);
        let colour = |&b: &u8| (f32::from(b) / 255.0 - 0.5) / COLOUR;
        let harmonic = |b: u8| (f32::from(b) - 128.0) / 128.0;
        let (colours, harmonics) = (colours.as_chunks::<3>().0, harmonics.as_chunks::<3>().0);
        for (i, first) in colours.iter().enumerate() {
            out.sh.push(first.each_ref().map(colour));
            let rows = harmonics[i * further..][..further].iter().enumerate();
            out.sh.extend(rows.map(|(k, row)| row.map(|b| axes.harmonic(k) * harmonic(b))));
        }
        out
    }
}

/// A harmonic quantised to 8 bits, at the centre of its bucket; 0 stays 0.
fn bucket(value: f32, step: i32) -> u8 {
    let whole = (value * 128.0).round().clamp(-1e6, 1e6) as i32 + 128;
    ((whole + step / 2).div_euclid(step) * step).clamp(0, 255) as u8
}

/// The components x, y, z of the quaternion whose w is positive, in 8 bits over [−1, 1].
fn vector([w, x, y, z]: [f32; 4]) -> [u8; 3] {
    let sign = if w < 0.0 { -1.0 } else { 1.0 };
    [x, y, z].map(|v| packing::byte(0.5 + 0.5 * sign * v))
}

/// Packs a quaternion from the highest bit on: the index of the largest component in the order x,
/// y, z, w (2 bits), then the three others with a sign and 9 bits each.
fn packed([w, x, y, z]: [f32; 4]) -> u32 {
    let (largest, q) = packing::largest([x, y, z, w]);
    (0..4).filter(|&c| c != largest).fold(largest as u32, |word, c| {
        let size = packing::steps(q[c].abs() / std::f32::consts::FRAC_1_SQRT_2, PART as u32);
        word << 10 | u32::from(q[c] < 0.0) << 9 | size
    })
}

/// The inverse of [`packed`].
fn unpacked(word: u32) -> [f32; 4] {
    let largest = (word >> 30) as usize;
    let mut parts = [0.0; 4];
    for (place, c) in (0..4).rev().filter(|&c| c != largest).enumerate() {
        let bits = word >> (10 * place);
        let size = (bits & 0x1ff) as f32 / PART * std::f32::consts::FRAC_1_SQRT_2;
        parts[c] = if bits & 0x200 == 0 { size } else { -size };
    }
    parts[largest] = packing::rest(parts);
    let [x, y, z, w] = parts;
    [w, x, y, z]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rotations_come_back() {
        for q in [
            [1.0, 0.0, 0.0, 0.0],
            [0.5, -0.5, 0.5, 0.5],
            [0.1, 0.7, -0.7, 0.1],
            [-0.9, 0.2, 0.3, -0.1],
        ] {
            let q = packing::unit(q);
            let back = unpacked(packed(q));
            let dot: f32 = q.iter().zip(&back).map(|(a, b)| a * b).sum();
            assert!(1.0 - dot.abs() < 1e-5, "{q:?} {back:?}");
        }
    }

    #[test]
    fn one_outlier_does_not_spoil_the_others() {
        let mut g = Gaussians {
            positions: vec![[1.0, 2.0, 3.0]; 2000],
            log_scales: vec![[-3.0; 3]; 2000],
            ..Gaussians::default()
        };
        g.positions[7] = [1e7, 0.0, 0.0];
        let (bits, within) = fraction(&g);
        assert_eq!(within.len(), 1999);
        assert!(!within.contains(&7) && bits >= 10, "{bits}");
        let (few, all) = fraction(&Gaussians {
            positions: vec![[1e5, 0.0, 0.0]; 10],
            log_scales: vec![[-3.0; 3]; 10],
            ..Gaussians::default()
        });
        assert_eq!((few, all.len()), (6, 10));
    }
}

//! Compressed PLY as PlayCanvas' tools write it: 16 bytes a Gaussian, relative to the bounds of a
//! chunk of 256.
//!
//! `packed_position` and `packed_scale` hold 11, 10 and 11 bits between the chunk's least and largest
//! values; `packed_rotation` the number of the largest component (2 bits) and the three others in
//! 10 bits each between ±1/√2; `packed_color` red, green, blue and opacity in 8 bits. An element `sh`
//! may follow: a byte per further coefficient, between ±4, channel-major.

use std::path::Path;

use crate::io::ply::{Element, Kind, Ply, Scalar};
use crate::types::{Gaussians, SH_C0, sh_coefficients};
use crate::{Error, Result};

/// Gaussians of a chunk.
const CHUNK: usize = 256;
/// Bounds that every chunk has: of positions, then of the scales' logarithms.
const BOUNDS: [&str; 12] = [
    "min_x",
    "min_y",
    "min_z",
    "max_x",
    "max_y",
    "max_z",
    "min_scale_x",
    "min_scale_y",
    "min_scale_z",
    "max_scale_x",
    "max_scale_y",
    "max_scale_z",
];
/// Bounds of colours, in newer files; else 0 and 1.
const COLOURS: [&str; 6] = ["min_r", "min_g", "min_b", "max_r", "max_g", "max_b"];
/// A byte of 0 or 255 stands for all that rounds to it: its opacity is taken a quarter of a step
/// inside, so that the logit is finite.
const INSIDE: f32 = 0.25 / 255.0;

/// Reads the Gaussians of a file whose vertices have a `packed_position`.
pub(super) fn gaussians(path: &Path, ply: &Ply<'_>) -> Result<Gaussians> {
    let bad = |what: String| Error::format(path, what);
    let element = |name: &str| {
        ply.element(name).ok_or_else(|| bad(format!("the compressed PLY has no element `{name}`")))
    };
    let columns = |element: &Element, names: &[&str]| {
        let column = |name: &&str| {
            let index = element.column(name).filter(|&i| is_scalar(element, i));
            index.ok_or_else(|| {
                bad(format!("the compressed PLY's `{}` has no number `{name}`", element.name))
            })
        };
        names.iter().map(column).collect::<Result<Vec<usize>>>()
    };
    let (chunk, vertex) = (element("chunk")?, element("vertex")?);
    let coloured = COLOURS.iter().all(|name| chunk.column(name).is_some());
    let names: Vec<&str> =
        BOUNDS.into_iter().chain(COLOURS.into_iter().filter(|_| coloured)).collect();
    let bounds = ply.rows("chunk", &columns(chunk, &names)?)?;
    let packed = ["packed_position", "packed_rotation", "packed_scale", "packed_color"];
    let packed = columns(vertex, &packed)?;
    if packed.iter().any(|&c| vertex.properties[c].kind != Kind::Scalar(Scalar::U32)) {
        return Err(bad("the compressed PLY's `packed_*` are of another type than uint".into()));
    }
    let words = ply.words("vertex", &packed)?;
    let count = words.len() / 4;
    let chunks = bounds.len() / names.len();
    if count.div_ceil(CHUNK) > chunks {
        return Err(bad(format!("has {count} vertices in {chunks} chunks of {CHUNK}")));
    }
    let mut out = Gaussians::default();
    for (i, word) in words.chunks_exact(4).enumerate() {
        let bounds = &bounds[i / CHUNK * names.len()..][..names.len()];
        let between = |share: [f32; 3], least: usize| {
            std::array::from_fn(|c| {
                let (low, high) = (bounds[least + c], bounds[least + 3 + c]);
                low + share[c] * (high - low)
            })
        };
        out.positions.push(between(three(word[0]), 0));
        out.log_scales.push(between(three(word[2]), 6));
        out.rotations.push(rotation(word[1]));
        let byte = |shift: u32| (word[3] >> shift & 0xff) as f32 / 255.0;
        let rgb = [byte(24), byte(16), byte(8)];
        let rgb: [f32; 3] = if coloured { between(rgb, 12) } else { rgb };
        out.sh.push(rgb.map(|c| (c - 0.5) / SH_C0));
        let opacity = byte(0).clamp(INSIDE, 1.0 - INSIDE);
        out.opacity_logits.push((opacity / (1.0 - opacity)).ln());
    }
    if let Some(sh) = ply.element("sh") {
        further_harmonics(path, ply, sh, &mut out)?;
    }
    Ok(out)
}

fn is_scalar(element: &Element, index: usize) -> bool {
    matches!(element.properties[index].kind, Kind::Scalar(_))
}

/// 11, 10 and 11 bits as shares of their range.
fn three(word: u32) -> [f32; 3] {
    [
        (word >> 21) as f32 / 2047.0,
        (word >> 11 & 0x3ff) as f32 / 1023.0,
        (word & 0x7ff) as f32 / 2047.0,
    ]
}

/// (w, x, y, z) of unit length; its largest component follows from the others.
fn rotation(word: u32) -> [f32; 4] {
    let largest = (word >> 30) as usize;
    let mut shifts = [20, 10, 0].into_iter();
    let mut squares = 0.0;
    let mut q: [f32; 4] = std::array::from_fn(|c| {
        if c == largest {
            return 0.0;
        }
        let bits = word >> shifts.next().unwrap_or(0) & 0x3ff;
        let value = (bits as f32 / 1023.0 - 0.5) * std::f32::consts::SQRT_2;
        squares += value * value;
        value
    });
    q[largest] = (1.0 - squares).max(0.0).sqrt();
    q
}

/// The coefficients above the constant, behind each Gaussian's own.
fn further_harmonics(path: &Path, ply: &Ply<'_>, sh: &Element, out: &mut Gaussians) -> Result<()> {
    let bad = |what: String| Error::format(path, what);
    let rest = sh.properties.iter().filter(|p| p.name.starts_with("f_rest_")).count();
    let degree = (0..=3).find(|&d| 3 * (sh_coefficients(d) - 1) == rest).ok_or_else(|| {
        bad(format!("has {rest} f_rest_* properties; 0, 9, 24 or 45 make spherical harmonics"))
    })?;
    let columns = (0..rest).map(|i| {
        let column = sh.column(&format!("f_rest_{i}")).filter(|&c| is_scalar(sh, c));
        column.ok_or_else(|| bad(format!("the compressed PLY's `sh` has no number `f_rest_{i}`")))
    });
    let columns = columns.collect::<Result<Vec<usize>>>()?;
    if columns.iter().any(|&c| sh.properties[c].kind != Kind::Scalar(Scalar::U8)) {
        return Err(bad("the compressed PLY's `f_rest_*` are of another type than uchar".into()));
    }
    let bytes = ply.words("sh", &columns)?;
    if bytes.len() != rest * out.len() {
        let rows = bytes.len() / rest.max(1);
        return Err(bad(format!("has {} vertices and {rows} rows of `sh`", out.len())));
    }
    let value = |byte: u32| match byte.min(255) {
        0 => -4.0,
        255 => 4.0,
        b => ((b as f32 + 0.5) / 256.0 - 0.5) * 8.0,
    };
    let bands = rest / 3;
    let constant = std::mem::take(&mut out.sh);
    for (i, first) in constant.into_iter().enumerate() {
        let row = &bytes[i * rest..(i + 1) * rest];
        out.sh.push(first);
        out.sh.extend((0..bands).map(|k| [0, 1, 2].map(|c| value(row[c * bands + k]))));
    }
    out.sh_degree = degree;
    Ok(())
}

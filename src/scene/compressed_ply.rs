//! Compressed PLY of the PlayCanvas tools: 16 bytes per Gaussian, quantised relative to the bounds
//! of a chunk of 256 Gaussians.
//!
//! `packed_position` and `packed_scale` hold three components in 11, 10 and 11 bits between the
//! chunk's minimum and maximum. `packed_rotation` holds the index of the largest component (2 bits)
//! and the three others in 10 bits each between ±1/√2. `packed_color` holds red, green, blue and
//! opacity in 8 bits each. An optional element `sh` holds one byte per further coefficient, between
//! ±4, channel-major.

use std::io::Write;
use std::path::Path;

use super::packing;
use crate::io::ply::{Element, Kind, Ply, Scalar};
use crate::types::{Gaussians, sh_coefficients};
use crate::{Error, Result};

/// Number of Gaussians in a chunk.
const CHUNK: usize = 256;
/// Names of the bounds of every chunk: of positions, then of log scales.
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
/// Names of the colour bounds, in newer files; 0 and 1 in files without them.
const COLOURS: [&str; 6] = ["min_r", "min_g", "min_b", "max_r", "max_g", "max_b"];
/// Names of the four words of a Gaussian.
const PACKED: [&str; 4] = ["packed_position", "packed_rotation", "packed_scale", "packed_color"];
/// Log scales are clamped to ± this: scales beyond it are invisible, and one such scale would make
/// the quantisation steps of its chunk too coarse.
const FARTHEST_LOG_SCALE: f32 = 20.0;

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
    let packed = columns(vertex, &PACKED)?;
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
        out.sh.push(packing::harmonic(rgb));
        out.opacity_logits.push(packing::logit(word[3] as u8));
    }
    if let Some(sh) = ply.element("sh") {
        further_harmonics(path, ply, sh, &mut out)?;
    }
    Ok(out)
}

fn is_scalar(element: &Element, index: usize) -> bool {
    matches!(element.properties[index].kind, Kind::Scalar(_))
}

/// Unpacks 11, 10 and 11 bits to values in [0, 1].
fn three(word: u32) -> [f32; 3] {
    [
        (word >> 21) as f32 / 2047.0,
        (word >> 11 & 0x3ff) as f32 / 1023.0,
        (word & 0x7ff) as f32 / 2047.0,
    ]
}

/// Unpacks a unit quaternion (w, x, y, z); its largest component follows from the others.
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

/// Writes Gaussians in Morton order, so that the bounds of a chunk are small. Motion logits are not
/// written.
pub(super) fn encode(gaussians: &Gaussians, sink: &mut dyn Write) -> std::io::Result<()> {
    let ordered = packing::picked(gaussians, &packing::morton_order(&gaussians.positions));
    let (g, n) = (&ordered, gaussians.len());
    let bands = sh_coefficients(g.sh_degree);
    writeln!(sink, "ply\nformat binary_little_endian 1.0")?;
    writeln!(sink, "comment splat4d\nelement chunk {}", n.div_ceil(CHUNK))?;
    for name in BOUNDS.iter().chain(&COLOURS) {
        writeln!(sink, "property float {name}")?;
    }
    writeln!(sink, "element vertex {n}")?;
    for name in PACKED {
        writeln!(sink, "property uint {name}")?;
    }
    if bands > 1 {
        writeln!(sink, "element sh {n}")?;
        for i in 0..3 * (bands - 1) {
            writeln!(sink, "property uchar f_rest_{i}")?;
        }
    }
    writeln!(sink, "end_header")?;
    let scales: Vec<[f32; 3]> = (g.log_scales.iter())
        .map(|s| s.map(|v| v.clamp(-FARTHEST_LOG_SCALE, FARTHEST_LOG_SCALE)))
        .collect();
    let colours: Vec<[f32; 3]> = g.sh.iter().step_by(bands).map(|&h| packing::colour(h)).collect();
    let arrays = [&g.positions, &scales, &colours];
    let bounds: Vec<[Range; 3]> = (0..n.div_ceil(CHUNK))
        .map(|chunk| arrays.map(|rows| Range::of(part(rows, chunk))))
        .collect();
    for bounds in &bounds {
        for value in bounds.iter().flat_map(|range| range.low.iter().chain(&range.high)) {
            sink.write_all(&value.to_le_bytes())?;
        }
    }
    for i in 0..n {
        let [position, scale, colour] = &bounds[i / CHUNK];
        let colour = colour.shares(colours[i]).map(packing::byte);
        let opacity = packing::byte(packing::opacity(g.opacity_logits[i]));
        let words = [
            packed_three(position.shares(g.positions[i])),
            packed_rotation(g.rotations[i]),
            packed_three(scale.shares(scales[i])),
            u32::from_be_bytes([colour[0], colour[1], colour[2], opacity]),
        ];
        for word in words {
            sink.write_all(&word.to_le_bytes())?;
        }
    }
    for rows in g.sh.chunks_exact(bands) {
        for channel in 0..3 {
            let byte =
                |row: &[f32; 3]| ((row[channel] / 8.0 + 0.5) * 256.0).clamp(0.0, 255.0) as u8;
            sink.write_all(&rows[1..].iter().map(byte).collect::<Vec<u8>>())?;
        }
    }
    Ok(())
}

/// The rows of a chunk.
fn part(rows: &[[f32; 3]], chunk: usize) -> &[[f32; 3]] {
    &rows[chunk * CHUNK..rows.len().min((chunk + 1) * CHUNK)]
}

/// The minimum and maximum of each component in a chunk.
struct Range {
    low: [f32; 3],
    high: [f32; 3],
}

impl Range {
    fn of(rows: &[[f32; 3]]) -> Range {
        let fold = |least: f32, with: fn(f32, f32) -> f32| {
            std::array::from_fn(|c| rows.iter().map(|row| row[c]).fold(least, with))
        };
        Range { low: fold(f32::INFINITY, f32::min), high: fold(f32::NEG_INFINITY, f32::max) }
    }

    /// Maps values to [0, 1] within the range.
    fn shares(&self, values: [f32; 3]) -> [f32; 3] {
        std::array::from_fn(|c| {
            let size = self.high[c] - self.low[c];
            if size > 0.0 { (values[c] - self.low[c]) / size } else { 0.0 }
        })
    }
}

/// Packs values in [0, 1] into 11, 10 and 11 bits.
fn packed_three(shares: [f32; 3]) -> u32 {
    let [x, y, z] = shares;
    packing::steps(x, 2047) << 21 | packing::steps(y, 1023) << 11 | packing::steps(z, 2047)
}

/// The inverse of [`rotation`].
fn packed_rotation(q: [f32; 4]) -> u32 {
    let (largest, q) = packing::largest(packing::unit(q));
    let others = (0..4).filter(|&c| c != largest);
    others.fold(largest as u32, |word, c| {
        word << 10 | packing::steps(q[c] / std::f32::consts::SQRT_2 + 0.5, 1023)
    })
}

/// Reads the spherical-harmonic coefficients above the constant into `out`.
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

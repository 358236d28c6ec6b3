//! The `.splat` format of antimatter15's viewer: 32 bytes per Gaussian, no header.
//!
//! Three f32 of the position, three f32 of the scales (standard deviations), red, green, blue and
//! opacity in 8 bits, and the quaternion (w, x, y, z) in 8 bits per component: 128 + 128 q. The
//! colour is that of the constant harmonic; there are no further bands. Values are little-endian.

use std::io::Write;
use std::path::Path;

use super::{packing, without_bad};
use crate::types::{Gaussians, sh_coefficients};
use crate::{Error, Result, io};

/// Bytes per Gaussian.
const SIZE: usize = 32;

/// Reads Gaussians; the second value counts those that `drop_bad` left out.
///
/// # Errors
/// The file's size is not a multiple of 32 bytes, or it holds values that are not finite or out of
/// range ([`Gaussians::check`]) and `drop_bad` is false.
pub fn read(path: impl AsRef<Path>, drop_bad: bool) -> Result<(Gaussians, usize)> {
    let path = path.as_ref();
    parse(path, &io::read(path)?, drop_bad)
}

/// [`read`] from bytes; `path` is used in error messages.
pub(super) fn parse(path: &Path, bytes: &[u8], drop_bad: bool) -> Result<(Gaussians, usize)> {
    let (rows, left) = bytes.as_chunks::<SIZE>();
    if !left.is_empty() {
        let what = format!("has {} bytes, which are no whole splats of {SIZE}", bytes.len());
        return Err(Error::format(path, what));
    }
    let mut out = Gaussians::default();
    for row in rows {
        let floats: [f32; 6] = std::array::from_fn(|i| {
            f32::from_le_bytes([row[4 * i], row[4 * i + 1], row[4 * i + 2], row[4 * i + 3]])
        });
        out.positions.push([floats[0], floats[1], floats[2]]);
        // A scale of 0 has underflowed.
        let log = |s: f32| if s == 0.0 { f32::MIN_POSITIVE.ln() } else { s.ln() };
        out.log_scales.push([log(floats[3]), log(floats[4]), log(floats[5])]);
        let share = |i: usize| f32::from(row[24 + i]) / 255.0;
        out.sh.push(packing::harmonic([share(0), share(1), share(2)]));
        out.opacity_logits.push(packing::logit(row[27]));
        let part = |i: usize| (f32::from(row[28 + i]) - 128.0) / 128.0;
        out.rotations.push(packing::unit([part(0), part(1), part(2), part(3)]));
    }
    let dropped = without_bad(path, &mut out, drop_bad)?;
    Ok((out, dropped))
}

/// Writes Gaussians with the constant harmonic only, atomically by rename.
///
/// # Errors
/// [`Error::Shape`] if arrays differ in length; [`Error::Io`].
pub fn write(path: impl AsRef<Path>, gaussians: &Gaussians) -> Result<()> {
    super::file::check_lengths(gaussians)?;
    io::write_atomically(path, |sink| encode(gaussians, sink))
}

/// Encodes the file. Large and opaque Gaussians come first, since viewers render while they load.
pub(super) fn encode(g: &Gaussians, sink: &mut dyn Write) -> std::io::Result<()> {
    let bands = sh_coefficients(g.sh_degree);
    let weight =
        |i: usize| g.log_scales[i].iter().sum::<f32>() + packing::opacity(g.opacity_logits[i]).ln();
    let weights: Vec<f32> = (0..g.len()).map(weight).collect();
    let mut order: Vec<usize> = (0..g.len()).collect();
    order.sort_by(|&a, &b| weights[b].total_cmp(&weights[a]).then(a.cmp(&b)));
    for i in order {
        for value in g.positions[i].into_iter().chain(g.log_scales[i].map(f32::exp)) {
            sink.write_all(&value.to_le_bytes())?;
        }
        let [red, green, blue] = packing::colour(g.sh[i * bands]).map(packing::byte);
        sink.write_all(&[red, green, blue, packing::byte(packing::opacity(g.opacity_logits[i]))])?;
        let (_, q) = packing::largest(packing::unit(g.rotations[i]));
        sink.write_all(&q.map(|v| (128.0 + 128.0 * v).round().clamp(0.0, 255.0) as u8))?;
    }
    Ok(())
}

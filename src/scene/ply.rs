//! Gaussians as 3DGS PLY, the layout that the original 3DGS code writes: `x y z`, `nx ny nz`,
//! `f_dc_0..2`, `f_rest_*` (channel-major: all of red, then green, then blue), `opacity` (logit),
//! `scale_0..2` (logarithms), `rot_0..3` (w, x, y, z); all of them floats.
//!
//! Compressed PLY, which SuperSplat writes, is read too (`compressed_ply`).
//!
//! Reading takes any order of properties, further properties, ASCII and both byte orders; normals
//! are not needed. Infinite logits, those of opacities of 0 and 1, are read as those of 0 and
//! 255 in 8 bits. The format cannot hold motion.

use std::io::Write;
use std::path::Path;

use super::{compressed_ply, packing, without_bad};
use crate::io::{self, ply::Kind, ply::Ply};
use crate::types::{Gaussians, sh_coefficients};
use crate::{Error, Result};

/// Reads Gaussians; the second value counts those that `drop_bad` left out.
///
/// # Errors
/// The file is not a 3DGS PLY, is truncated (the message names the vertex and the byte), or holds
/// values that are not finite or out of range ([`Gaussians::check`]) and `drop_bad` is false (the
/// message counts them).
pub fn read(path: impl AsRef<Path>, drop_bad: bool) -> Result<(Gaussians, usize)> {
    let path = path.as_ref();
    parse(path, &io::read(path)?, drop_bad)
}

/// [`read`] from bytes; `path` is used in error messages.
pub(super) fn parse(path: &Path, bytes: &[u8], drop_bad: bool) -> Result<(Gaussians, usize)> {
    let ply = Ply::parse(path, bytes)?;
    let bad = |what: String| Error::format(path, what);
    let vertex =
        ply.element("vertex").ok_or_else(|| bad("the PLY has no element `vertex`".into()))?;
    if vertex.column("packed_position").is_some() {
        let mut gaussians = compressed_ply::gaussians(path, &ply)?;
        let dropped = without_bad(path, &mut gaussians, drop_bad)?;
        return Ok((gaussians, dropped));
    }
    let has = |name: &str| vertex.column(name).is_some();
    if !has("f_dc_0") && has("red") {
        return Err(
            bad("is a point cloud, not 3D Gaussians (it has `red` but no `f_dc_0`)".into()),
        );
    }
    let column = |name: String| {
        let index = vertex
            .column(&name)
            .ok_or_else(|| bad(format!("is not a 3DGS PLY: the vertices have no `{name}`")))?;
        match vertex.properties[index].kind {
            Kind::Scalar(_) => Ok(index),
            Kind::List(..) => Err(bad(format!("is not a 3DGS PLY: `{name}` is a list"))),
        }
    };
    let rest = vertex.properties.iter().filter(|p| p.name.starts_with("f_rest_")).count();
    let sh_degree = (0..=3).find(|&d| 3 * (sh_coefficients(d) - 1) == rest).ok_or_else(|| {
        bad(format!("has {rest} f_rest_* properties; 0, 9, 24 or 45 make spherical harmonics"))
    })?;
    let fixed = ["x", "y", "z", "opacity"].map(String::from);
    let numbered = |stem: &'static str, n: usize| (0..n).map(move |i| format!("{stem}_{i}"));
    let names = fixed
        .into_iter()
        .chain(numbered("scale", 3))
        .chain(numbered("rot", 4))
        .chain(numbered("f_dc", 3))
        .chain(numbered("f_rest", rest));
    let columns = names.map(column).collect::<Result<Vec<usize>>>()?;
    let rows = ply.rows("vertex", &columns)?;
    let mut gaussians = Gaussians { sh_degree, ..Gaussians::default() };
    let bands = rest / 3;
    for row in rows.chunks_exact(columns.len()) {
        gaussians.positions.push([row[0], row[1], row[2]]);
        gaussians.opacity_logits.push(packing::finite_logit(row[3]));
        gaussians.log_scales.push([row[4], row[5], row[6]]);
        gaussians.rotations.push([row[7], row[8], row[9], row[10]]);
        gaussians.sh.push([row[11], row[12], row[13]]);
        let rest = &row[14..];
        gaussians.sh.extend((0..bands).map(|i| [rest[i], rest[bands + i], rest[2 * bands + i]]));
    }
    let dropped = without_bad(path, &mut gaussians, drop_bad)?;
    Ok((gaussians, dropped))
}

/// Writes Gaussians as binary little-endian PLY, atomically by rename. Motion logits are not
/// written.
pub fn write(path: impl AsRef<Path>, gaussians: &Gaussians) -> Result<()> {
    super::file::check_lengths(gaussians)?;
    io::write_atomically(path, |sink| encode(gaussians, sink))
}

/// Encodes the file.
pub(super) fn encode(gaussians: &Gaussians, sink: &mut dyn Write) -> std::io::Result<()> {
    let bands = sh_coefficients(gaussians.sh_degree);
    writeln!(sink, "ply\nformat binary_little_endian 1.0")?;
    writeln!(sink, "comment splat4d\nelement vertex {}", gaussians.len())?;
    let numbered = |stem: &'static str, n: usize| (0..n).map(move |i| format!("{stem}_{i}"));
    let names = ["x", "y", "z", "nx", "ny", "nz"].map(String::from).into_iter();
    let names = names
        .chain(numbered("f_dc", 3))
        .chain(numbered("f_rest", 3 * (bands - 1)))
        .chain(["opacity".to_string()])
        .chain(numbered("scale", 3))
        .chain(numbered("rot", 4));
    for name in names {
        writeln!(sink, "property float {name}")?;
    }
    writeln!(sink, "end_header")?;
    let mut put = |values: &[f32]| values.iter().try_for_each(|v| sink.write_all(&v.to_le_bytes()));
    for i in 0..gaussians.len() {
        let sh = &gaussians.sh[i * bands..(i + 1) * bands];
        put(&gaussians.positions[i])?;
        put(&[0.0; 3])?;
        put(&sh[0])?;
        for channel in 0..3 {
            for row in &sh[1..] {
                put(&row[channel..=channel])?;
            }
        }
        put(&[gaussians.opacity_logits[i]])?;
        put(&gaussians.log_scales[i])?;
        put(&gaussians.rotations[i])?;
    }
    Ok(())
}

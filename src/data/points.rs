//! Coloured points.

use std::io::Write;
use std::path::Path;

use glam::Vec3;

use crate::io::{self, ply::Kind, ply::Ply, ply::Scalar};
use crate::types::range::{self, CAMERA_REACH};
use crate::{Error, Result};

/// A coloured point in the world.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Point {
    /// Position in the world.
    pub position: [f32; 3],
    /// RGB in [0, 1].
    pub colour: [f32; 3],
}

/// Reads a point cloud from a PLY file: `x y z` and, where present, `red green blue` (grey otherwise).
/// Points that are not finite or outside [`range::CAMERA_REACH`] are left out; the second value is their
/// number.
///
/// # Errors
/// The file is not a PLY of points, is truncated, or has colours outside of [0, 1] (the message names the
/// first such vertex).
pub fn read_ply(path: &Path) -> Result<(Vec<Point>, usize)> {
    let bytes = io::read(path)?;
    let ply = Ply::parse(path, &bytes)?;
    let vertex = ply
        .element("vertex")
        .ok_or_else(|| Error::format(path, "the PLY has no element `vertex`"))?;
    let mut columns = Vec::new();
    for name in ["x", "y", "z"] {
        let column = vertex.column(name);
        columns.push(column.ok_or_else(|| {
            Error::format(path, format!("the PLY's vertices have no property `{name}`"))
        })?);
    }
    let colours: Vec<usize> =
        ["red", "green", "blue"].iter().filter_map(|name| vertex.column(name)).collect();
    let coloured = colours.len() == 3;
    let mut scale = 1.0;
    if coloured {
        scale = match vertex.properties[colours[0]].kind {
            Kind::Scalar(Scalar::U8) => 1.0 / 255.0,
            Kind::Scalar(Scalar::U16) => 1.0 / 65535.0,
            _ => 1.0,
        };
        columns.extend(colours);
    }
    let rows = ply.rows("vertex", &columns)?;
    let point = |row: &[f32]| Point {
        position: [row[0], row[1], row[2]],
        colour: match coloured {
            true => [row[3] * scale, row[4] * scale, row[5] * scale],
            false => [0.5; 3],
        },
    };
    let all = rows.chunks_exact(columns.len()).map(point).enumerate();
    let (mut points, mut left_out) = (Vec::new(), 0);
    for (i, point) in all {
        if !point.is_usable() {
            left_out += 1;
            continue;
        }
        range::colour(point.colour)
            .map_err(|what| Error::format(path, format!("vertex {i}: {what}")))?;
        points.push(point);
    }
    Ok((points, left_out))
}

/// Writes a point cloud as binary PLY, colours in 8 bits, by rename.
///
/// # Errors
/// [`Error::Io`].
pub fn write_ply(path: impl AsRef<Path>, points: &[Point]) -> Result<()> {
    io::write_atomically(path, |sink| {
        writeln!(sink, "ply")?;
        writeln!(sink, "format binary_little_endian 1.0")?;
        writeln!(sink, "element vertex {}", points.len())?;
        ["x", "y", "z"].iter().try_for_each(|name| writeln!(sink, "property float {name}"))?;
        let colours = ["red", "green", "blue"];
        colours.iter().try_for_each(|name| writeln!(sink, "property uchar {name}"))?;
        writeln!(sink, "end_header")?;
        points.iter().try_for_each(|point| {
            point.position.iter().try_for_each(|v| sink.write_all(&v.to_le_bytes()))?;
            sink.write_all(&point.colour.map(|c| (c.clamp(0.0, 1.0) * 255.0).round() as u8))
        })
    })
}

impl Point {
    /// Whether its values are finite and its position within [`range::CAMERA_REACH`].
    pub(super) fn is_usable(&self) -> bool {
        range::place(Vec3::from(self.position).as_dvec3()).is_ok()
            && self.colour.iter().all(|c| c.is_finite())
    }
}

/// The note about points that were left out.
pub(super) fn left_out_note(left_out: usize, kept: usize) -> Option<String> {
    let all = left_out + kept;
    (left_out > 0).then(|| {
        format!(
            "left out {left_out} of {all} points that are not finite or lie beyond {CAMERA_REACH:e}"
        )
    })
}

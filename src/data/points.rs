//! Coloured points.

use std::path::Path;

use crate::io::{self, ply::Kind, ply::Ply, ply::Scalar};
use crate::{Error, Result};

/// A coloured point in the world.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Point {
    /// In the world.
    pub position: [f32; 3],
    /// RGB in [0, 1].
    pub colour: [f32; 3],
}

/// Reads a point cloud from a PLY file: `x y z` and, where present, `red green blue` (grey
/// otherwise). Points that are not finite are left out.
pub fn read_ply(path: &Path) -> Result<Vec<Point>> {
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
    let finite = |p: &Point| p.position.iter().chain(&p.colour).all(|v| v.is_finite());
    Ok(rows.chunks_exact(columns.len()).map(point).filter(finite).collect())
}

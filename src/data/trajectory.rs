//! Trajectories: TUM's `timestamp tx ty tz qx qy qz qw`, and what goes by that name elsewhere.

use std::io::Write;
use std::path::Path;

use glam::{DMat3, DQuat, DVec3};

use crate::io;
use crate::types::{Pose, range};
use crate::{Error, Result};

/// A camera's pose at a time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TimedPose {
    /// The file's timestamp, in its own unit.
    pub time: f64,
    /// Camera to world.
    pub world_from_view: Pose,
}

/// The order of a quaternion's components in a file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum QuaternionOrder {
    /// (x, y, z, w), as TUM's.
    Xyzw,
    /// (w, x, y, z), as MonST3R writes under the same name.
    Wxyz,
}

/// Reads a trajectory of camera-to-world poses. A line holds 8 numbers (TUM), 7 (the same without
/// a timestamp; the line's index takes its place) or 12 (KITTI: the rows of a 3×4 matrix). Lines that
/// begin with `#` are comments.
///
/// With `order` `None` the order of quaternions is found out: a comment that names `qw` before `qx`
/// decides; else, where the first pose is the identity in one of the two readings, it is that one
/// (files written as (w, x, y, z) usually begin so); else TUM's (x, y, z, w).
pub fn read(path: impl AsRef<Path>, order: Option<QuaternionOrder>) -> Result<Vec<TimedPose>> {
    let path = path.as_ref();
    let text = io::read_text(path)?;
    let mut rows: Vec<(usize, Vec<f64>)> = Vec::new();
    let mut named = None;
    for (i, line) in text.lines().enumerate() {
        let line = line.trim();
        if line.is_empty() {
            continue;
        }
        if line.starts_with('#') {
            if let (Some(w), Some(x)) = (line.find("qw"), line.find("qx")) {
                named = Some(if w < x { QuaternionOrder::Wxyz } else { QuaternionOrder::Xyzw });
            }
            continue;
        }
        let separators = |c: char| c.is_ascii_whitespace() || c == ',';
        let words = line.split(separators).filter(|w| !w.is_empty());
        let numbers: Vec<f64> = words.map_while(|w| w.parse().ok()).collect();
        let count = line.split(separators).filter(|w| !w.is_empty()).count();
        if numbers.len() < count || !matches!(count, 7 | 8 | 12) {
            return Err(Error::format(
                path,
                format!("line {}: `timestamp tx ty tz qx qy qz qw` expected", i + 1),
            ));
        }
        rows.push((i + 1, numbers));
    }
    if rows.is_empty() {
        return Err(Error::format(path, "holds no poses"));
    }
    let order = order.or(named).unwrap_or_else(|| guess_order(&rows[0].1));
    rows.iter()
        .enumerate()
        .map(|(index, (line, numbers))| {
            let bad = |what: String| Error::format(path, format!("line {line}: {what}"));
            let (time, world_from_view) = match numbers[..] {
                [time, ref pose @ ..] if pose.len() == 7 => (time, quaternion_pose(pose, order)),
                ref pose if pose.len() == 7 => (index as f64, quaternion_pose(pose, order)),
                ref matrix => (index as f64, matrix_pose(matrix)),
            };
            let world_from_view = world_from_view.map_err(bad)?;
            range::timestamp(time).map_err(bad)?;
            world_from_view.check().map_err(bad)?;
            Ok(TimedPose { time, world_from_view })
        })
        .collect()
}

fn guess_order(first: &[f64]) -> QuaternionOrder {
    match first.len() {
        7 | 8 if (first[first.len() - 4].abs() - 1.0).abs() < 1e-9 => QuaternionOrder::Wxyz,
        _ => QuaternionOrder::Xyzw,
    }
}

/// The pose of tx ty tz and a quaternion.
fn quaternion_pose(row: &[f64], order: QuaternionOrder) -> std::result::Result<Pose, String> {
    let rotation = match order {
        QuaternionOrder::Xyzw => DQuat::from_xyzw(row[3], row[4], row[5], row[6]),
        QuaternionOrder::Wxyz => DQuat::from_xyzw(row[4], row[5], row[6], row[3]),
    };
    range::quaternion(rotation)?;
    Ok(Pose::new(rotation, DVec3::new(row[0], row[1], row[2])))
}

/// The pose of the 12 numbers of a 3×4 matrix, row by row.
fn matrix_pose(row: &[f64]) -> std::result::Result<Pose, String> {
    let column = |c: usize| DVec3::new(row[c], row[4 + c], row[8 + c]);
    let matrix = DMat3::from_cols(column(0), column(1), column(2));
    let (rotation, scale) =
        range::rotation_and_scale(matrix).map_err(|what| format!("the matrix {what}"))?;
    if (scale - 1.0).abs() > range::ROTATION_TOLERANCE {
        return Err(format!("the matrix is not a rigid transform: it scales by {scale:?}"));
    }
    Ok(Pose::new(rotation, column(3)))
}

/// Writes TUM's format (x, y, z, w), with as many digits as bring the same numbers back.
pub fn write(path: impl AsRef<Path>, poses: &[TimedPose]) -> Result<()> {
    io::write_atomically(path, |sink| {
        writeln!(sink, "# timestamp tx ty tz qx qy qz qw (camera to world)")?;
        for TimedPose { time, world_from_view } in poses {
            let (t, q) = (world_from_view.translation, world_from_view.rotation);
            writeln!(sink, "{time} {} {} {} {} {} {} {}", t.x, t.y, t.z, q.x, q.y, q.z, q.w)?;
        }
        Ok(())
    })
}

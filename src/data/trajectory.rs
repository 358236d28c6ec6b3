//! Trajectories: TUM's `timestamp tx ty tz qx qy qz qw`, and what goes by that name elsewhere.

use std::io::Write;
use std::path::Path;

use glam::{DMat4, DQuat, DVec3, DVec4};

use crate::io;
use crate::types::Pose;
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
        let finite = numbers.iter().all(|v: &f64| v.is_finite());
        if numbers.len() < count || !matches!(count, 7 | 8 | 12) || !finite {
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
            let bad = || Error::format(path, format!("line {line}: not a rigid transform"));
            let (time, world_from_view) = match numbers[..] {
                [time, ref pose @ ..] if pose.len() == 7 => (time, quaternion_pose(pose, order)),
                ref pose if pose.len() == 7 => (index as f64, quaternion_pose(pose, order)),
                ref matrix => (index as f64, matrix_pose(matrix)),
            };
            Ok(TimedPose { time, world_from_view: world_from_view.ok_or_else(bad)? })
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
fn quaternion_pose(row: &[f64], order: QuaternionOrder) -> Option<Pose> {
    let rotation = match order {
        QuaternionOrder::Xyzw => DQuat::from_xyzw(row[3], row[4], row[5], row[6]),
        QuaternionOrder::Wxyz => DQuat::from_xyzw(row[4], row[5], row[6], row[3]),
    };
    let unit = (rotation.length() - 1.0).abs() < 0.05;
    unit.then(|| Pose::new(rotation, DVec3::new(row[0], row[1], row[2])))
}

/// The pose of the 12 numbers of a 3×4 matrix, row by row.
fn matrix_pose(row: &[f64]) -> Option<Pose> {
    let line = |i: usize| DVec4::from_slice(&row[4 * i..4 * i + 4]);
    let matrix = DMat4::from_cols(line(0), line(1), line(2), DVec4::W).transpose();
    let unit = (matrix.determinant() - 1.0).abs() < 0.05;
    unit.then(|| Pose::from_matrix(matrix))
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

//! Trajectory files: TUM's `timestamp tx ty tz qx qy qz qw` and its variants, KITTI's pose files, EuRoC's
//! ground truth, Sintel's cameras.

use std::io::Write;
use std::path::Path;

use glam::{DAffine3, DQuat, DVec3};

use super::cam;
use crate::io;
use crate::types::{Pose, range};
use crate::{Error, Result};

/// Camera pose with a time stamp.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TimedPose {
    /// The file's time stamp, in the file's unit; for EuRoC in seconds.
    pub time: f64,
    /// Camera to world.
    pub world_from_view: Pose,
}

/// Order of a quaternion's components in a file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum QuaternionOrder {
    /// (x, y, z, w), as in TUM's format.
    Xyzw,
    /// (w, x, y, z), as MonST3R writes under the same name.
    Wxyz,
}

/// The supported formats, distinguished by a file's contents.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Format {
    /// Lines of 8 numbers: time stamp, translation, quaternion.
    Tum,
    /// Lines of 7 numbers: translation, quaternion.
    Poses,
    /// Lines of 12 numbers: the rows of a 3×4 matrix.
    Kitti,
    /// Comma-separated lines of at least 8 numbers: a time stamp in nanoseconds, a position, a quaternion
    /// (w, x, y, z), and further columns that are ignored.
    Euroc,
    /// Sintel's `.cam`: one file, or a folder of them.
    Cam,
}

/// A trajectory as stored.
#[derive(Clone, Debug)]
pub struct Trajectory {
    /// The file's format.
    pub format: Format,
    /// One per pose: the file's time stamp, in the file's unit, for EuRoC in seconds. Where the format has
    /// no time stamps, the index from 0.
    pub times: Vec<f64>,
    /// Camera to world, matrices as stored: rounding may leave them slightly off a rotation.
    pub world_from_view: Vec<DAffine3>,
    /// The order in which quaternions were read; `None` where the format has none.
    pub order: Option<QuaternionOrder>,
}

impl Trajectory {
    /// Whether the format has time stamps.
    pub fn is_timed(&self) -> bool {
        matches!(self.format, Format::Tum | Format::Euroc)
    }

    /// The poses, with their matrices projected to rotations.
    pub fn poses(&self) -> Vec<TimedPose> {
        let timed = |(&time, rigid): (&f64, &DAffine3)| {
            let rotation = DQuat::from_mat3(&rigid.matrix3);
            TimedPose { time, world_from_view: Pose::new(rotation, rigid.translation) }
        };
        self.times.iter().zip(&self.world_from_view).map(timed).collect()
    }
}

/// Reads a trajectory of camera-to-world poses, as [`open`] does.
pub fn read(path: impl AsRef<Path>, order: Option<QuaternionOrder>) -> Result<Vec<TimedPose>> {
    Ok(open(path, order)?.poses())
}

/// Reads a trajectory: a text file whose lines hold 8 numbers (TUM), 7 (without a time stamp), 12 (KITTI)
/// or EuRoC's columns, or Sintel's `.cam` (which stores world to camera), a file or a folder of them in the
/// natural order of their names. The format is determined from the contents. Lines that begin with `#` are
/// comments.
///
/// A comma-separated line is EuRoC's where a comment says `[ns]`, or where the first number is too large
/// for seconds.
///
/// With `order` `None` the order of the quaternion is determined: by a comment that names `qw` before `qx`;
/// for EuRoC it is (w, x, y, z); else, where the first pose is the identity in one of the two orders, by
/// that (files in the order (w, x, y, z) usually begin with it); else it is TUM's (x, y, z, w).
///
/// # Errors
/// [`Error::Io`]; [`Error::Format`] for a file that is not a trajectory, with the line.
pub fn open(path: impl AsRef<Path>, order: Option<QuaternionOrder>) -> Result<Trajectory> {
    let path = path.as_ref();
    if path.is_dir() {
        let files = cam::list(path)?;
        if files.is_empty() {
            return Err(Error::format(path, "holds no .cam files"));
        }
        return cams(files.iter().map(cam::read).collect::<Result<_>>()?);
    }
    if cam::is_cam(path)? {
        return cams(vec![cam::read(path)?]);
    }
    text(path, order)
}

fn cams(cams: Vec<cam::Cam>) -> Result<Trajectory> {
    Ok(Trajectory {
        format: Format::Cam,
        times: (0..cams.len()).map(|i| i as f64).collect(),
        // The transpose is used as the inverse, which leaves the matrix exactly as far off a rotation as it
        // was.
        world_from_view: cams
            .iter()
            .map(|cam| {
                let inverse = cam.view_from_world.matrix3.transpose();
                let translation = -(inverse * cam.view_from_world.translation);
                DAffine3 { matrix3: inverse, translation }
            })
            .collect(),
        order: None,
    })
}

/// A line's number and its values.
struct Row {
    line: usize,
    numbers: Vec<f64>,
}

fn text(path: &Path, order: Option<QuaternionOrder>) -> Result<Trajectory> {
    let text = io::read_text(path)?;
    let mut rows: Vec<Row> = Vec::new();
    let (mut named, mut nanoseconds, mut commas) = (None, false, false);
    for (i, line) in text.trim_start_matches('\u{feff}').lines().enumerate() {
        let line = line.trim();
        if line.is_empty() {
            continue;
        }
        if line.starts_with('#') {
            if let (Some(w), Some(x)) = (line.find("qw"), line.find("qx")) {
                named = Some(if w < x { QuaternionOrder::Wxyz } else { QuaternionOrder::Xyzw });
            }
            nanoseconds |= line.contains("[ns]");
            continue;
        }
        commas |= line.contains(',');
        let separators = |c: char| c.is_ascii_whitespace() || c == ',';
        let words = || line.split(separators).filter(|word| !word.is_empty());
        let numbers: Vec<f64> = words().map_while(|word| word.parse().ok()).collect();
        let (count, first) = (words().count(), rows.first().map_or(0, |row| row.numbers.len()));
        let bad = |what: String| Err(Error::format(path, format!("line {}: {what}", i + 1)));
        if numbers.len() < count || count < 7 {
            return bad("`timestamp tx ty tz qx qy qz qw` expected, or a 3×4 matrix".into());
        }
        if first > 0 && count != first {
            return bad(format!("holds {count} numbers, the lines before hold {first}"));
        }
        rows.push(Row { line: i + 1, numbers });
    }
    let Some(first) = rows.first() else { return Err(Error::format(path, "holds no poses")) };
    /// Values beyond this would be 30 million years after 1970 in seconds; in nanoseconds they are eleven
    /// days.
    const NANOSECONDS: f64 = 1e15;
    nanoseconds = commas && (nanoseconds || first.numbers[0].abs() >= NANOSECONDS);
    let format = match first.numbers.len() {
        8.. if nanoseconds => Format::Euroc,
        8 => Format::Tum,
        7 => Format::Poses,
        12 => Format::Kitti,
        count => {
            return Err(Error::format(
                path,
                format!(
                    "line {}: holds {count} numbers; 8 (TUM), 7 (without timestamps), 12 (KITTI) or \
                     EuRoC's, whose timestamps are nanoseconds, are expected",
                    first.line
                ),
            ));
        }
    };
    let order = order.or(named).unwrap_or_else(|| match format {
        Format::Euroc => QuaternionOrder::Wxyz,
        _ => guess_order(&first.numbers),
    });
    let (mut times, mut world_from_view) = (Vec::new(), Vec::new());
    for (index, Row { line, numbers }) in rows.iter().enumerate() {
        let bad = |what: String| Error::format(path, format!("line {line}: {what}"));
        let (time, pose) = match (format, &numbers[..]) {
            (Format::Tum, [time, pose @ ..]) => (*time, pose),
            (Format::Euroc, [time, pose @ ..]) => (*time / 1e9, pose),
            (_, pose) => (index as f64, pose),
        };
        let rigid = match <&[f64; 12]>::try_from(pose) {
            Ok(matrix) if format == Format::Kitti => cam::rigid(matrix),
            _ => quaternion_pose(pose, order),
        };
        let rigid = rigid.map_err(bad)?;
        range::timestamp(time).map_err(bad)?;
        range::place(rigid.translation).map_err(|what| bad(format!("translation {what}")))?;
        times.push(time);
        world_from_view.push(rigid);
    }
    let order = Some(order).filter(|_| format != Format::Kitti);
    Ok(Trajectory { format, times, world_from_view, order })
}

fn guess_order(first: &[f64]) -> QuaternionOrder {
    match first.len() {
        7 | 8 if (first[first.len() - 4].abs() - 1.0).abs() < 1e-9 => QuaternionOrder::Wxyz,
        _ => QuaternionOrder::Xyzw,
    }
}

/// The pose of tx ty tz and a quaternion.
fn quaternion_pose(row: &[f64], order: QuaternionOrder) -> std::result::Result<DAffine3, String> {
    let rotation = match order {
        QuaternionOrder::Xyzw => DQuat::from_xyzw(row[3], row[4], row[5], row[6]),
        QuaternionOrder::Wxyz => DQuat::from_xyzw(row[4], row[5], row[6], row[3]),
    };
    range::quaternion(rotation)?;
    let translation = DVec3::new(row[0], row[1], row[2]);
    Ok(DAffine3::from_rotation_translation(rotation.normalize(), translation))
}

/// Writes TUM's format (x, y, z, w) with enough digits to read back the same numbers.
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

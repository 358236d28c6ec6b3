//! Cameras in Sintel's `.cam` format: the float 202021.25, a 3×3 matrix of intrinsics and a 3×4 matrix of
//! extrinsics (world to camera), doubles in row-major order, all little-endian. A folder holds one file per
//! frame: `frame_0001.cam`, …

use std::io::Read;
use std::path::{Path, PathBuf};

use glam::{DAffine3, DMat3, DVec3};

use super::images;
use crate::io::{self, Bytes};
use crate::types::{Intrinsics, Pose, range};
use crate::{Error, Result};

/// Tag at the start of the file, the same as in `.flo`.
const TAG: f32 = 202_021.25;
/// File size in bytes: tag, intrinsics, extrinsics.
const LENGTH: usize = 4 + 8 * 9 + 8 * 12;

/// A camera as stored in its file.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Cam {
    /// Focal length along x and y, pixels.
    pub focal: [f64; 2],
    /// Principal point, where the first pixel's centre is 0.5 (the file counts it as 0).
    pub principal: [f64; 2],
    /// World to camera, the matrix as stored.
    pub view_from_world: DAffine3,
    /// The same transform as a pose.
    pub pose: Pose,
}

impl Cam {
    /// The intrinsics for an image of this size; the file does not contain a size.
    ///
    /// # Errors
    /// A message: the numbers are not valid for a pinhole camera of this size.
    pub fn intrinsics(&self, width: u32, height: u32) -> std::result::Result<Intrinsics, String> {
        let ([fx, fy], [cx, cy]) = (self.focal, self.principal);
        let k = Intrinsics { fx, fy, cx, cy, width, height };
        k.check().map(|()| k)
    }
}

/// Whether a file begins with the tag of a camera file.
pub fn is_cam(path: &Path) -> Result<bool> {
    let mut start = [0; 4];
    match io::open(path)?.read_exact(&mut start) {
        Ok(()) => Ok(f32::from_le_bytes(start) == TAG),
        Err(error) if error.kind() == std::io::ErrorKind::UnexpectedEof => Ok(false),
        Err(error) => Err(Error::io(path)(error)),
    }
}

/// Reads a camera.
///
/// # Errors
/// [`Error::Io`]; [`Error::Format`] for a file that is not a camera, or whose matrices are not those of a
/// pinhole camera.
pub fn read(path: impl AsRef<Path>) -> Result<Cam> {
    let path = path.as_ref();
    let bytes = io::read(path)?;
    let bad = |what: String| Error::format(path, what);
    let mut from = Bytes::new(path, &bytes);
    if from.f32("the tag")? != TAG {
        return Err(bad("is not a .cam file (its tag is another)".into()));
    }
    if bytes.len() != LENGTH {
        let length = bytes.len();
        return Err(bad(format!("is not a .cam file: {LENGTH} bytes are expected, not {length}")));
    }
    let mut k = [0.0; 9];
    for value in &mut k {
        *value = from.f64("the intrinsics")?;
    }
    let mut m = [0.0; 12];
    for value in &mut m {
        *value = from.f64("the extrinsics")?;
    }
    let [fx, skew, cx, a, fy, cy, b, c, one] = k;
    if [a, b, c] != [0.0; 3] || one != 1.0 || skew.abs() > 1e-6 * fx.abs() {
        return Err(bad(format!("its intrinsics {k:?} are not those of a pinhole without skew")));
    }
    let view_from_world = rigid(&m).map_err(|what| bad(format!("its extrinsics: {what}")))?;
    let (rotation, _) = range::rotation_and_scale(view_from_world.matrix3).map_err(bad)?;
    let pose = Pose::new(rotation, view_from_world.translation);
    pose.check().map_err(bad)?;
    // Sintel's pixel centres are at integers: 511.5 is the centre of 1024 pixels.
    let principal = [cx + 0.5, cy + 0.5];
    if !(fx > 0.0 && fy > 0.0 && principal.iter().all(|c| c.is_finite())) {
        return Err(bad(format!("its intrinsics {k:?} make no sense")));
    }
    Ok(Cam { focal: [fx, fy], principal, view_from_world, pose })
}

/// Converts the 12 numbers of a row-major 3×4 matrix to a rigid transform.
///
/// # Errors
/// A message: the matrix shears, mirrors or scales.
pub(super) fn rigid(rows: &[f64; 12]) -> std::result::Result<DAffine3, String> {
    let column = |c: usize| DVec3::new(rows[c], rows[4 + c], rows[8 + c]);
    let matrix = DMat3::from_cols(column(0), column(1), column(2));
    let (_, scale) =
        range::rotation_and_scale(matrix).map_err(|what| format!("the matrix {what}"))?;
    if (scale - 1.0).abs() > range::ROTATION_TOLERANCE {
        return Err(format!("the matrix is not a rigid transform: it scales by {scale:?}"));
    }
    Ok(DAffine3 { matrix3: matrix, translation: column(3) })
}

/// The camera files of a folder, in the natural order of their names; empty where there are none.
pub fn list(folder: &Path) -> Result<Vec<PathBuf>> {
    let mut found = Vec::new();
    for entry in std::fs::read_dir(folder).map_err(Error::io(folder))? {
        let path = entry.map_err(Error::io(folder))?.path();
        let hidden = path.file_name().is_some_and(|n| n.to_string_lossy().starts_with('.'));
        let named = path.extension().is_some_and(|e| e.eq_ignore_ascii_case("cam"));
        if named && !hidden && path.is_file() {
            found.push(path);
        }
    }
    found
        .sort_by(|a, b| images::natural(&a.to_string_lossy(), &b.to_string_lossy()).then(a.cmp(b)));
    Ok(found)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A file's bytes.
    fn bytes(k: [f64; 9], m: [f64; 12]) -> Vec<u8> {
        let numbers = k.iter().chain(&m).flat_map(|v| v.to_le_bytes());
        TAG.to_le_bytes().into_iter().chain(numbers).collect()
    }

    const K: [f64; 9] = [1120.0, 0.0, 511.5, 0.0, 1120.0, 217.5, 0.0, 0.0, 1.0];
    /// A quarter turn about z.
    const M: [f64; 12] = [0.0, -1.0, 0.0, 1.0, 1.0, 0.0, 0.0, 2.0, 0.0, 0.0, 1.0, 3.0];

    #[test]
    fn cameras_of_sintel() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        for name in ["frame_0010.cam", "frame_0002.cam", "frame_0001.CAM"] {
            std::fs::write(at(name), bytes(K, M)).unwrap();
        }
        std::fs::write(at("notes.txt"), "none").unwrap();
        let names = ["frame_0001.CAM", "frame_0002.cam", "frame_0010.cam"];
        assert_eq!(list(folder.path()).unwrap(), names.map(at));
        let cam = read(at("frame_0002.cam")).unwrap();
        assert!(is_cam(&at("frame_0002.cam")).unwrap() && !is_cam(&at("notes.txt")).unwrap());
        assert_eq!(cam.intrinsics(1024, 436).unwrap(), Intrinsics::centred(1120.0, 1024, 436));
        let point = cam.pose.apply(DVec3::X);
        assert!((point - DVec3::new(1.0, 3.0, 3.0)).length() < 1e-15, "{point}");
        assert!(cam.intrinsics(60_000, 436).is_err());
        let said = |bytes: Vec<u8>| {
            std::fs::write(at("bad.cam"), bytes).unwrap();
            read(at("bad.cam")).unwrap_err().to_string()
        };
        let with = |i: usize, value: f64| {
            let mut m = M;
            m[i] = value;
            bytes(K, m)
        };
        let skewed = [1.0, 5.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0];
        for (bytes, part) in [
            (b"PIEH".to_vec(), "172 bytes"),
            (b"PI".to_vec(), "the tag"),
            (vec![1; LENGTH], "its tag is another"),
            (bytes(skewed, M), "without skew"),
            (with(0, 3.0), "rigid"),
            (with(3, f64::NAN), "translation"),
        ] {
            let said = said(bytes);
            assert!(said.contains("bad.cam") && said.contains(part), "{said}");
        }
    }
}

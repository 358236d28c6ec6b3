//! NumPy arrays: a `.npy` file, or one array of an `.npz` archive.

use std::io::{Cursor, Read};
use std::path::Path;

use npyz::{NpyFile, Order};
use zip::ZipArchive;
use zip::result::ZipError;

use crate::error::excerpt;
use crate::io;
use crate::{Error, Result};

/// Maximum size of an array's header, bytes.
const MOST_HEADER: u32 = 1 << 16;

/// An array's values with its shape.
#[derive(Clone, Debug, PartialEq)]
pub struct Array {
    /// Lengths of the axes, the slowest first.
    pub shape: Vec<usize>,
    /// The values in row-major order.
    pub values: Vec<f64>,
}

/// Reads a `.npy` file of real numbers or booleans in row-major order.
///
/// # Errors
/// [`Error::Io`]; [`Error::Format`] for a file of another format.
pub fn read(path: &Path) -> Result<Array> {
    let bytes = io::read(path)?;
    parse(path, "its array", &bytes[..], bytes.len())
}

/// Reads the array of an `.npz` archive that holds exactly one.
///
/// # Errors
/// Those of [`read`]; an archive with no array or several.
pub fn read_only(path: &Path) -> Result<Array> {
    let bytes = io::read(path)?;
    let mut archive = open(path, &bytes)?;
    let names: Vec<String> = archive.file_names().flatten().map(|name| name.into_owned()).collect();
    let [name] = &names[..] else {
        let what = match &names[..] {
            [] => "holds no array".to_owned(),
            [first, ..] => format!(
                "holds {} arrays ({} …), one was expected",
                names.len(),
                excerpt(first.trim_end_matches(".npy"))
            ),
        };
        return Err(Error::format(path, what));
    };
    let name = name.strip_suffix(".npy").unwrap_or(name).to_owned();
    let found = entry(path, &mut archive, bytes.len(), &name)?;
    found.ok_or_else(|| Error::format(path, format!("its entry {} is no array", excerpt(&name))))
}

/// An `.npz` archive.
pub(super) type Archive<'a> = ZipArchive<Cursor<&'a Vec<u8>>>;

pub(super) fn open<'a>(path: &Path, bytes: &'a Vec<u8>) -> Result<Archive<'a>> {
    let damaged =
        |e: ZipError| Error::format(path, format!("is no .npz: {}", excerpt(&e.to_string())));
    ZipArchive::new(Cursor::new(bytes)).map_err(damaged)
}

/// Reads an array of an archive, given the archive's size in bytes; `None` where it is absent.
pub(super) fn entry(
    path: &Path,
    archive: &mut Archive,
    packed: usize,
    name: &str,
) -> Result<Option<Array>> {
    within(path, archive, name, |what, entry| parse(path, what, entry, packed))
}

/// Reads only the shape of an array of an archive; `None` where it is absent.
pub(super) fn shape(path: &Path, archive: &mut Archive, name: &str) -> Result<Option<Vec<usize>>> {
    within(path, archive, name, |what, entry| {
        let file = header(path, what, entry)?;
        Ok(file.shape().iter().map(|side| *side as usize).collect())
    })
}

/// Reads from an archive's array, and names the array in messages.
fn within<T>(
    path: &Path,
    archive: &mut Archive,
    name: &str,
    read: impl FnOnce(&str, &mut dyn Read) -> Result<T>,
) -> Result<Option<T>> {
    let what = format!("its array {}", excerpt(name));
    match archive.by_name(&format!("{name}.npy")) {
        Ok(mut entry) => read(&what, &mut entry).map(Some),
        Err(ZipError::FileNotFound) => Ok(None),
        Err(error) => Err(Error::format(path, format!("{what}: {}", excerpt(&error.to_string())))),
    }
}

/// Reads an array's header.
fn header<'a>(
    path: &Path,
    name: &str,
    mut from: impl Read + 'a,
) -> Result<NpyFile<impl Read + 'a>> {
    let wrong = |what: String| Error::format(path, format!("{name}: {what}"));
    let damaged = |error: std::io::Error| wrong(excerpt(&error.to_string()));
    // In formats newer than the first, the header's length has four bytes, and that much memory would be
    // allocated.
    let mut start = [0; 12];
    from.read_exact(&mut start).map_err(damaged)?;
    let [.., a, b, c, d] = start;
    if start[6] > 1 && u32::from_le_bytes([a, b, c, d]) > MOST_HEADER {
        return Err(wrong("has a header of a length that makes no sense".into()));
    }
    NpyFile::new(Cursor::new(start).chain(from)).map_err(damaged)
}

fn parse(path: &Path, name: &str, from: impl Read, packed: usize) -> Result<Array> {
    let wrong = |what: String| Error::format(path, format!("{name}: {what}"));
    let damaged = |error: std::io::Error| wrong(excerpt(&error.to_string()));
    let file = header(path, name, from)?;
    let count = file.shape().iter().try_fold(1u64, |all, side| all.checked_mul(*side));
    let count = count.unwrap_or(u64::MAX);
    io::check_unpacked(path, count.saturating_mul(8), packed)?;
    if file.order() != Order::C && file.shape().len() > 1 {
        return Err(wrong("is stored column by column; save it in C order".into()));
    }
    let shape: Vec<usize> = file.shape().iter().map(|side| *side as usize).collect();
    let of = |values: std::result::Result<Vec<f64>, std::io::Error>| values.map_err(damaged);
    macro_rules! of_type {
        ($file:expr, $($kind:ty => $convert:expr),+) => {{
            let file = $file;
            $(let file = match file.try_data::<$kind>() {
                Ok(values) => {
                    let convert: fn($kind) -> f64 = $convert;
                    let values = of(values.map(|v| v.map(convert)).collect())?;
                    return Ok(Array { shape, values });
                }
                Err(file) => file,
            };)+
            file
        }};
    }
    let other = of_type!(file, f32 => f64::from, f64 => |v| v, bool => |v| f64::from(u8::from(v)),
        u8 => f64::from, u16 => f64::from, i32 => f64::from, i64 => |v| v as f64);
    let kind = excerpt(&other.dtype().descr());
    Err(wrong(format!("holds values of type {kind}; real numbers or booleans were expected")))
}

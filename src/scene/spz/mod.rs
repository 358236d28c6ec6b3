//! The SPZ format of Niantic's `spz` library: about a tenth of the size of a PLY.
//!
//! Each attribute is stored as a separate array, in this order: positions (24-bit fixed point),
//! opacities, colours, logarithms of scales (in sixteenths from −10 on), rotations, and spherical
//! harmonics above the constant (128 + 128 h), all in bytes. Versions 2 and 3 put the arrays behind
//! a header of 16 bytes into one gzip stream; version 4 has a plain header of 32 bytes, records of
//! extensions, a table of sizes and a zstd stream for each array. The axes are right, up, back,
//! where a PLY's, and this crate's, are right, down, front.
//!
//! Versions 2, 3 and 4 are read and written. In version 4 the motion of a scene goes into an
//! extension ([`MOTION`]), which other readers skip; they show the Gaussians at the time for which
//! they were written. Adobe's extension for other axes is supported. The antialiasing flag is
//! ignored, since this crate's scenes have no such property.
//!
//! Source: github.com/nianticlabs/spz, its README and its extensions/README.md of July 2026.

mod layout;
mod motion;

use std::io::{Read, Write};
use std::path::Path;

use flate2::Compression;
use flate2::bufread::GzDecoder;
use flate2::write::GzEncoder;

use super::axes::Axes;
use super::{Opened, Scene, packing, without_bad};
use crate::io::{self, Bytes};
use crate::types::{Gaussians, sh_coefficients};
use crate::{Error, Result};
use layout::Arrays;

pub use motion::MOTION;

/// The first four bytes of version 4, and of what versions 1 to 3 unpack to.
const MAGIC: &[u8; 4] = b"NGSP";
/// The first two bytes of gzip.
const GZIP: [u8; 2] = [0x1f, 0x8b];
/// The header flag for extensions.
const EXTENDED: u8 = 2;
/// Type of Adobe's extension for axes.
const COORDINATES: u32 = 0xadbe_0003;
/// Size of version 4's header, bytes.
const HEADER: usize = 32;
/// Maximum number of bytes after the arrays of version 3, for extensions.
const MOST_BEHIND: u64 = 1 << 20;
/// Maximum number of Gaussians in a file, as in the reference library.
const MOST: u32 = i32::MAX as u32;
/// zstd compression level; the reference library uses 1 to 12, depending on its build.
const EFFORT: i32 = 12;

/// The version to write.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Version {
    /// One gzip stream, rotations in 3 bytes: what glTF's extension for SPZ holds.
    V2,
    /// One gzip stream, rotations in 4 bytes.
    V3,
    /// A plain header, extensions, and a zstd stream for each attribute.
    V4,
}

/// Whether the bytes begin like an SPZ file.
pub(super) fn is_spz(bytes: &[u8]) -> bool {
    bytes.starts_with(MAGIC) || bytes.starts_with(&GZIP)
}

/// Reads Gaussians and, if the file holds it, their motion.
///
/// # Errors
/// The file is not an SPZ, is truncated or damaged, is of another version or of a degree above 3,
/// or holds values out of range ([`Gaussians::check`]) and `drop_bad` is false.
pub fn read(path: impl AsRef<Path>, drop_bad: bool) -> Result<Opened> {
    let path = path.as_ref();
    parse(path, &io::read(path)?, drop_bad)
}

/// [`read`] from bytes; `path` is used in error messages.
pub(super) fn parse(path: &Path, bytes: &[u8], drop_bad: bool) -> Result<Opened> {
    let (mut gaussians, motion) = match bytes.starts_with(&GZIP) {
        true => (one_stream(path, bytes)?, None),
        false => streams(path, bytes)?,
    };
    match motion {
        None => {
            let dropped = without_bad(path, &mut gaussians, drop_bad)?;
            Ok(Opened { scene: Scene::of(gaussians), dropped })
        }
        Some(payload) => motion::restored(path, gaussians, payload, drop_bad),
    }
}

/// The fields that the headers of all versions have.
struct Header {
    version: u32,
    count: usize,
    sh_degree: u32,
    fraction: u8,
    flags: u8,
}

impl Header {
    fn read(path: &Path, bytes: &mut Bytes) -> Result<Header> {
        let bad = |what: String| Error::format(path, what);
        if bytes.array::<4>("the header")? != *MAGIC {
            return Err(bad("is no SPZ file: what it unpacks to does not begin with NGSP".into()));
        }
        let version = bytes.u32("the version")?;
        let count = bytes.u32("the number of points")?;
        let [sh_degree, fraction, flags] = bytes.array("the header")?;
        if count > MOST {
            return Err(bad(format!("is damaged: its header announces {count} points")));
        }
        if sh_degree > 3 {
            let what = "has spherical harmonics of degree";
            return Err(bad(format!("{what} {sh_degree}; up to 3 are read")));
        }
        if fraction > 30 {
            return Err(bad(format!("is damaged: {fraction} bits of fraction in 24")));
        }
        let (count, sh_degree) = (count as usize, u32::from(sh_degree));
        Ok(Header { version, count, sh_degree, fraction, flags })
    }

    /// Size of each array, bytes.
    fn sizes(&self) -> [usize; 6] {
        let rotation = if self.version == 2 { 3 } else { 4 };
        layout::sizes(rotation, self.sh_degree).map(|size| size * self.count)
    }
}

/// Reads versions 2 and 3: one gzip stream.
fn one_stream(path: &Path, bytes: &[u8]) -> Result<Gaussians> {
    let broken = |e: std::io::Error| packing::unpacking(path, "its gzip stream", &e);
    let mut unpacked = GzDecoder::new(bytes);
    let mut head = [0; 16];
    unpacked.read_exact(&mut head).map_err(broken)?;
    let header = Header::read(path, &mut Bytes::new(path, &head))?;
    if !(2..=3).contains(&header.version) {
        let what = format!("is SPZ of version {} in gzip; 2 and 3 are read", header.version);
        return Err(Error::format(path, what));
    }
    let sizes = header.sizes();
    let total: usize = sizes.iter().sum();
    packing::check_room(path, total as u64, bytes.len())?;
    let mut arrays = vec![0; total];
    unpacked.read_exact(&mut arrays).map_err(broken)?;
    // Read to the end, so that the gzip checksum is verified.
    let behind = std::io::copy(&mut unpacked.take(MOST_BEHIND + 1), &mut std::io::sink());
    if behind.map_err(broken)? > MOST_BEHIND {
        return Err(Error::format(path, "has more behind its arrays than its header announces"));
    }
    let mut rest = &arrays[..];
    let arrays = sizes.map(|size| rest.split_off(..size).unwrap_or_default().to_vec());
    Ok(Arrays(arrays).gaussians(header.count, header.sh_degree, header.fraction, Axes::default()))
}

/// Reads version 4: the Gaussians, and the payload of the motion extension.
fn streams<'a>(path: &'a Path, bytes: &'a [u8]) -> Result<(Gaussians, Option<&'a [u8]>)> {
    let bad = |what: String| Error::format(path, what);
    let mut at = Bytes::new(path, bytes);
    let header = Header::read(path, &mut at)?;
    if header.version != 4 {
        return Err(bad(format!("is SPZ of version {}; 2 to 4 are read", header.version)));
    }
    let [streams] = at.array("the number of streams")?;
    let table = at.u32("the place of the table")? as usize;
    at.take(12, "the header")?;
    if table < HEADER {
        return Err(bad(format!(
            "is damaged: its table of sizes lies at byte {table}, in the header"
        )));
    }
    let zone = at.take(table - HEADER, "the extensions")?;
    let sizes = header.sizes();
    // An empty array has no stream.
    let filled = sizes.iter().filter(|size| **size > 0).count();
    if usize::from(streams) != filled {
        return Err(bad(format!("has {streams} streams; its Gaussians need {filled}")));
    }
    packing::check_room(path, sizes.iter().map(|size| *size as u64).sum(), bytes.len())?;
    let mut toc = Bytes::new(path, at.take(16 * filled, "the table of sizes")?);
    let mut arrays: [Vec<u8>; 6] = Default::default();
    for (array, size) in arrays.iter_mut().zip(sizes).filter(|(_, size)| *size > 0) {
        let [packed, unpacked] = [toc.u64("a packed size")?, toc.u64("an unpacked size")?];
        if unpacked != size as u64 {
            return Err(bad(format!("has a stream of {unpacked} bytes, {size} were expected")));
        }
        let packed = at.take(usize::try_from(packed).unwrap_or(usize::MAX), "a stream")?;
        *array = zstd::bulk::decompress(packed, size)
            .map_err(|e| packing::unpacking(path, "one of its streams", &e))?;
        if array.len() != size {
            return Err(bad(format!("a stream unpacks to {} bytes of {size}", array.len())));
        }
    }
    if at.left() > 0 {
        return Err(bad(format!("has {} bytes behind its last stream", at.left())));
    }
    let (axes, motion) = match header.flags & EXTENDED {
        0 => (Axes::default(), None),
        _ => extensions(path, zone)?,
    };
    let arrays = Arrays(arrays);
    Ok((arrays.gaussians(header.count, header.sh_degree, header.fraction, axes), motion))
}

/// Reads the extensions that this crate supports and skips others.
fn extensions<'a>(path: &'a Path, zone: &'a [u8]) -> Result<(Axes, Option<&'a [u8]>)> {
    let (mut axes, mut motion) = (Axes::default(), None);
    let mut at = Bytes::new(path, zone);
    while at.left() > 0 {
        let kind = at.u32("an extension's type")?;
        let length = at.u32("an extension's length")? as usize;
        let payload = at.take(length, "an extension")?;
        match kind {
            COORDINATES => axes = Axes::named(path, Bytes::new(path, payload).u32("the axes")?)?,
            MOTION => motion = Some(payload),
            _ => {}
        }
    }
    Ok((axes, motion))
}

/// Writes Gaussians, atomically by rename, and returns their number. Gaussians out of range of the
/// 24-bit coordinates are left out, at most one in a thousand.
///
/// # Errors
/// [`Error::Shape`] if arrays differ in length; [`Error::Input`] without Gaussians; [`Error::Io`].
pub fn write(path: impl AsRef<Path>, gaussians: &Gaussians, version: Version) -> Result<usize> {
    super::file::check_lengths(gaussians)?;
    let (bytes, count) = encoded(gaussians, version, &[])?;
    io::write_atomically(path, |sink| sink.write_all(&bytes))?;
    Ok(count)
}

/// Writes a dynamic scene in version 4, atomically by rename, and returns the number of Gaussians.
/// `posed` holds the scene's Gaussians at one time, which other readers show; the motion goes into
/// an extension.
///
/// # Errors
/// As for [`write()`]; [`Error::Shape`] if `posed` has another number of Gaussians than the scene.
pub fn write_moving(path: impl AsRef<Path>, scene: &Scene, posed: &Gaussians) -> Result<usize> {
    let (gaussians, extension) = motion::split(scene, posed)?;
    let (bytes, count) = encoded(&gaussians, Version::V4, &extension)?;
    if count != gaussians.len() {
        return Err(Error::Input(format!(
            "{} Gaussians lie too far out for SPZ, and what moves is told by their order; export one \
             moment, or leave them out before",
            gaussians.len() - count
        )));
    }
    io::write_atomically(path, |sink| sink.write_all(&bytes))?;
    Ok(count)
}

/// The bytes of a file, and the number of Gaussians in it.
pub(super) fn encoded(
    gaussians: &Gaussians,
    version: Version,
    extension: &[u8],
) -> Result<(Vec<u8>, usize)> {
    if gaussians.is_empty() {
        return Err(Error::Input("SPZ does not hold a scene without Gaussians".into()));
    }
    let (fraction, within) = layout::fraction(gaussians);
    let kept = (within.len() < gaussians.len()).then(|| packing::picked(gaussians, &within));
    let gaussians = kept.as_ref().unwrap_or(gaussians);
    let arrays = Arrays::of(gaussians, fraction, version);
    let mut bytes = MAGIC.to_vec();
    let number: u32 = match version {
        Version::V2 => 2,
        Version::V3 => 3,
        Version::V4 => 4,
    };
    bytes.extend(number.to_le_bytes());
    bytes.extend((gaussians.len() as u32).to_le_bytes());
    let flags = if extension.is_empty() { 0 } else { EXTENDED };
    bytes.extend([gaussians.sh_degree as u8, fraction, flags]);
    let packed = |e: std::io::Error| Error::Failed(format!("compressing failed: {e}"));
    if version != Version::V4 {
        bytes.push(0);
        bytes.extend(arrays.0.concat());
        let mut gzip = GzEncoder::new(Vec::new(), Compression::best());
        gzip.write_all(&bytes).map_err(packed)?;
        return Ok((gzip.finish().map_err(packed)?, gaussians.len()));
    }
    let filled: Vec<&Vec<u8>> = arrays.0.iter().filter(|array| !array.is_empty()).collect();
    bytes.push(filled.len() as u8);
    bytes.extend(((HEADER + extension.len()) as u32).to_le_bytes());
    bytes.extend([0; 12]);
    bytes.extend(extension);
    let streams = filled.iter().map(|array| zstd::bulk::compress(array, EFFORT));
    let streams = streams.collect::<std::io::Result<Vec<Vec<u8>>>>().map_err(packed)?;
    for (stream, array) in streams.iter().zip(&filled) {
        bytes.extend((stream.len() as u64).to_le_bytes());
        bytes.extend((array.len() as u64).to_le_bytes());
    }
    bytes.extend(streams.concat());
    Ok((bytes, gaussians.len()))
}

/// Number of coefficients above the constant, per channel.
fn further(sh_degree: u32) -> usize {
    sh_coefficients(sh_degree) - 1
}

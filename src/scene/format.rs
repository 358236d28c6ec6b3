//! File formats of static Gaussians and their capabilities.

use std::io::Write;
use std::path::Path;

use super::{compressed_ply, glb, ply, splat, spz};
use crate::types::Gaussians;
use crate::{Result, io};

/// A file format of static Gaussians.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Format {
    /// 3DGS PLY: f32, lossless.
    Ply,
    /// Compressed PLY of PlayCanvas: 16 bytes per Gaussian, plus one byte per channel of each
    /// coefficient above the constant.
    CompressedPly,
    /// `.splat`: 32 bytes per Gaussian, only the constant spherical harmonic.
    Splat,
    /// SPZ.
    Spz(spz::Version),
    /// Binary glTF with `KHR_gaussian_splatting`: f32; written only.
    Glb,
    /// Binary glTF whose Gaussians are an SPZ of version 2, in the extension
    /// `KHR_gaussian_splatting_compression_spz_2`; written only.
    GlbSpz,
}

impl Format {
    /// The format of a file name; version 4 for SPZ, glTF without SPZ.
    pub fn of(path: &Path) -> Option<Format> {
        let name = path.file_name()?.to_str()?.to_ascii_lowercase();
        let ends = [
            (".compressed.ply", Format::CompressedPly),
            (".ply", Format::Ply),
            (".splat", Format::Splat),
            (".spz", Format::Spz(spz::Version::V4)),
            (".glb", Format::Glb),
        ];
        ends.into_iter().find(|(end, _)| name.ends_with(end)).map(|(_, format)| format)
    }

    /// The file name extension.
    pub fn extension(self) -> &'static str {
        match self {
            Format::Ply => ".ply",
            Format::CompressedPly => ".compressed.ply",
            Format::Splat => ".splat",
            Format::Spz(_) => ".spz",
            Format::Glb | Format::GlbSpz => ".glb",
        }
    }

    /// The highest degree of spherical harmonics that the format holds.
    pub fn most_sh_degree(self) -> u32 {
        if self == Format::Splat { 0 } else { 3 }
    }

    /// Writes Gaussians, atomically by rename. Motion, and harmonics above
    /// [`most_sh_degree`](Self::most_sh_degree), are left out. Returns the number of Gaussians
    /// written: SPZ, in glTF too, leaves out Gaussians beyond its coordinate range.
    ///
    /// # Errors
    /// [`Error::Shape`](crate::Error::Shape) if arrays differ in length;
    /// [`Error::Input`](crate::Error::Input) for SPZ or glTF without Gaussians, or glTF of more
    /// than 4 GiB;
    /// [`Error::Io`](crate::Error::Io).
    pub fn write(self, path: impl AsRef<Path>, gaussians: &Gaussians) -> Result<usize> {
        if let Format::Spz(_) | Format::GlbSpz = self {
            let (bytes, count) = self.encode(gaussians)?;
            io::write_atomically(path, |sink| sink.write_all(&bytes))?;
            return Ok(count);
        }
        self.check(gaussians)?;
        io::write_atomically(path, |sink| self.plain(gaussians, sink))?;
        Ok(gaussians.len())
    }

    /// The bytes that [`write`](Self::write) writes, and how many Gaussians they hold.
    ///
    /// # Errors
    /// As for [`write`](Self::write).
    pub fn encode(self, gaussians: &Gaussians) -> Result<(Vec<u8>, usize)> {
        self.check(gaussians)?;
        match self {
            Format::Spz(version) => return spz::encoded(gaussians, version, &[]),
            Format::GlbSpz => return glb::compressed(gaussians),
            _ => {}
        }
        let mut bytes = Vec::new();
        self.plain(gaussians, &mut bytes).map_err(crate::Error::io(""))?;
        Ok((bytes, gaussians.len()))
    }

    fn check(self, gaussians: &Gaussians) -> Result<()> {
        super::file::check_lengths(gaussians)?;
        if self == Format::Glb { glb::check(gaussians) } else { Ok(()) }
    }

    /// Writes a format that needs no further memory.
    fn plain(self, gaussians: &Gaussians, sink: &mut dyn Write) -> std::io::Result<()> {
        match self {
            Format::CompressedPly => compressed_ply::encode(gaussians, sink),
            Format::Splat => splat::encode(gaussians, sink),
            Format::Glb => glb::encode(gaussians, sink),
            Format::Ply | Format::Spz(_) | Format::GlbSpz => ply::encode(gaussians, sink),
        }
    }
}

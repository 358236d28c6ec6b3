//! A bounds-checked cursor over bytes.

use std::path::Path;

use crate::{Error, Result};

/// A reader of consecutive little-endian values. At the end of the bytes it returns an error that
/// names the file, the offset and the value.
pub struct Bytes<'a> {
    path: &'a Path,
    bytes: &'a [u8],
    at: usize,
}

impl<'a> Bytes<'a> {
    /// A cursor at the first byte; `path` is used in error messages.
    pub fn new(path: &'a Path, bytes: &'a [u8]) -> Bytes<'a> {
        Bytes { path, bytes, at: 0 }
    }

    /// Number of bytes not read yet.
    pub fn left(&self) -> usize {
        self.bytes.len() - self.at
    }

    /// The next `n` bytes; `what` names them in the error message.
    pub fn take(&mut self, n: usize, what: &str) -> Result<&'a [u8]> {
        if n > self.left() {
            return Err(Error::format(
                self.path,
                format!(
                    "truncated: {what} at byte {} needs {n} bytes, {} are left",
                    self.at,
                    self.left()
                ),
            ));
        }
        self.at += n;
        Ok(&self.bytes[self.at - n..self.at])
    }

    /// The next `N` bytes as an array.
    pub fn array<const N: usize>(&mut self, what: &str) -> Result<[u8; N]> {
        let mut array = [0; N];
        array.copy_from_slice(self.take(N, what)?);
        Ok(array)
    }

    /// Reads a `u32`.
    pub fn u32(&mut self, what: &str) -> Result<u32> {
        Ok(u32::from_le_bytes(self.array(what)?))
    }

    /// Reads an `i32`.
    pub fn i32(&mut self, what: &str) -> Result<i32> {
        Ok(i32::from_le_bytes(self.array(what)?))
    }

    /// Reads a `u64`.
    pub fn u64(&mut self, what: &str) -> Result<u64> {
        Ok(u64::from_le_bytes(self.array(what)?))
    }

    /// Reads an `f32`.
    pub fn f32(&mut self, what: &str) -> Result<f32> {
        Ok(f32::from_le_bytes(self.array(what)?))
    }

    /// Reads an `f64`.
    pub fn f64(&mut self, what: &str) -> Result<f64> {
        Ok(f64::from_le_bytes(self.array(what)?))
    }

    /// Reads a count of records of at least `size` bytes each. A count that exceeds the rest of the
    /// file is an error, so that nothing is allocated for it.
    pub fn count(&mut self, size: usize, what: &str) -> Result<usize> {
        let at = self.at;
        let count = self.u64(what)?;
        let most = (self.left() / size.max(1)) as u64;
        if count > most {
            return Err(Error::format(
                self.path,
                format!("truncated: byte {at} announces {count} {what}, at most {most} can follow"),
            ));
        }
        Ok(count as usize)
    }

    /// Reads a zero-terminated text.
    pub fn text(&mut self, what: &str) -> Result<String> {
        let rest = &self.bytes[self.at..];
        let length = rest.iter().position(|&b| b == 0).ok_or_else(|| {
            Error::format(self.path, format!("truncated: {what} at byte {} has no end", self.at))
        })?;
        let text = String::from_utf8(rest[..length].to_vec()).map_err(|_| {
            Error::format(self.path, format!("{what} at byte {} is not UTF-8", self.at))
        })?;
        self.at += length + 1;
        Ok(text)
    }
}

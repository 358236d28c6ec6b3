//! A cursor over bytes that cannot run past the end.

use std::path::Path;

use crate::{Error, Result};

/// Reads little-endian values one after another; running out of bytes is an error that names the
/// file, the offset and what was being read.
pub struct Bytes<'a> {
    path: &'a Path,
    bytes: &'a [u8],
    at: usize,
}

impl<'a> Bytes<'a> {
    /// Begins at the first byte; `path` is for the messages.
    pub fn new(path: &'a Path, bytes: &'a [u8]) -> Bytes<'a> {
        Bytes { path, bytes, at: 0 }
    }

    /// Bytes not read yet.
    pub fn left(&self) -> usize {
        self.bytes.len() - self.at
    }

    /// The next `n` bytes; `what` names them for the message.
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

    /// A `u32`.
    pub fn u32(&mut self, what: &str) -> Result<u32> {
        Ok(u32::from_le_bytes(self.array(what)?))
    }

    /// An `i32`.
    pub fn i32(&mut self, what: &str) -> Result<i32> {
        Ok(i32::from_le_bytes(self.array(what)?))
    }

    /// A `u64`.
    pub fn u64(&mut self, what: &str) -> Result<u64> {
        Ok(u64::from_le_bytes(self.array(what)?))
    }

    /// An `f32`.
    pub fn f32(&mut self, what: &str) -> Result<f32> {
        Ok(f32::from_le_bytes(self.array(what)?))
    }

    /// An `f64`.
    pub fn f64(&mut self, what: &str) -> Result<f64> {
        Ok(f64::from_le_bytes(self.array(what)?))
    }

    /// A count of records that take at least `size` bytes each: a count that the rest of the file
    /// cannot hold is an error here, before anything is allocated for it.
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

    /// A text that ends with a zero byte.
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

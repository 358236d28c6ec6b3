//! Writing of zip archives.

use std::io::Write;

use zip::write::{SimpleFileOptions, ZipWriter};

use super::Sink;

/// A writer of a zip archive, file by file. The output is deterministic.
pub struct Archive<'a, 'b>(ZipWriter<&'a mut Sink<'b>>);

impl<'a, 'b> Archive<'a, 'b> {
    /// Starts an archive.
    pub fn new(sink: &'a mut Sink<'b>) -> Archive<'a, 'b> {
        Archive(ZipWriter::new(sink))
    }

    /// Adds a file.
    ///
    /// # Errors
    /// A failed write.
    pub fn file(&mut self, name: &str, bytes: &[u8]) -> std::io::Result<()> {
        let options = SimpleFileOptions::default()
            .last_modified_time(zip::DateTime::default())
            .large_file(bytes.len() as u64 >= u64::from(u32::MAX));
        self.0.start_file(name, options)?;
        self.0.write_all(bytes)
    }

    /// Finishes the archive.
    ///
    /// # Errors
    /// A failed write.
    pub fn finish(self) -> std::io::Result<()> {
        self.0.finish().map(drop).map_err(std::io::Error::from)
    }
}

//! Zip archives, written.

use std::io::Write;

use zip::write::{SimpleFileOptions, ZipWriter};

use super::Sink;

/// Writes an archive, file after file. The same files give the same bytes.
pub struct Archive<'a, 'b>(ZipWriter<&'a mut Sink<'b>>);

impl<'a, 'b> Archive<'a, 'b> {
    /// Begins an archive.
    pub fn new(sink: &'a mut Sink<'b>) -> Archive<'a, 'b> {
        Archive(ZipWriter::new(sink))
    }

    /// Adds a file.
    ///
    /// # Errors
    /// The disk refuses.
    pub fn file(&mut self, name: &str, bytes: &[u8]) -> std::io::Result<()> {
        let options = SimpleFileOptions::default()
            .last_modified_time(zip::DateTime::default())
            .large_file(bytes.len() as u64 >= u64::from(u32::MAX));
        self.0.start_file(name, options)?;
        self.0.write_all(bytes)
    }

    /// Ends the archive.
    ///
    /// # Errors
    /// The disk refuses.
    pub fn finish(self) -> std::io::Result<()> {
        self.0.finish().map(drop).map_err(std::io::Error::from)
    }
}

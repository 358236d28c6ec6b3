//! The error type of the crate.
//!
//! A message states what was wrong, where, and how to fix it. A panic is a bug of the crate.

use std::path::{Path, PathBuf};

/// The result type of every fallible function of the crate.
pub type Result<T> = std::result::Result<T, Error>;

/// All errors of the crate.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// A Vulkan call failed.
    #[error("{call} failed: {meaning} ({code})")]
    Vulkan {
        /// The name of the call.
        call: &'static str,
        /// The `VkResult`, as a number.
        code: i32,
        /// The `VkResult`, in words.
        meaning: String,
    },
    /// The Vulkan loader or a driver is missing, or no device fits the request.
    #[error("{0}")]
    NoDevice(String),
    /// The device was lost.
    #[error("the device was lost; the last kernel begun was {last_kernel}")]
    DeviceLost {
        /// The last kernel of the oldest unfinished submission when the device was lost.
        last_kernel: String,
    },
    /// Device memory ran out.
    #[error(
        "out of device memory: {label} wants {bytes} bytes; use fewer Gaussians or smaller images"
    )]
    OutOfMemory {
        /// What the memory was for.
        label: String,
        /// How much was asked for.
        bytes: u64,
    },
    /// The requested work needs more device memory than is free.
    #[error(
        "{bytes} bytes of device memory are needed ({largest} alone takes {largest_bytes}), {free} are \
         free; use fewer Gaussians or smaller images"
    )]
    TooLarge {
        /// Bytes needed.
        bytes: u64,
        /// Free bytes on the device.
        free: u64,
        /// Label of the largest buffer.
        largest: String,
        /// Bytes of the largest buffer.
        largest_bytes: u64,
    },
    /// A buffer is larger than one binding of this device may be.
    #[error(
        "{label} needs {bytes} bytes in one binding, the device allows {limit}; use fewer Gaussians"
    )]
    RangeLimit {
        /// The buffer.
        label: String,
        /// Its size.
        bytes: u64,
        /// The device's `maxStorageBufferRange`.
        limit: u64,
    },
    /// The device lacks something that a kernel needs.
    #[error("{kernel} cannot run on this device: {missing}")]
    Unsupported {
        /// The kernel, or `the engine`.
        kernel: String,
        /// What is missing.
        missing: String,
    },
    /// An argument has the wrong shape.
    #[error("{op}: {arg} has {actual} elements, expected {expected}")]
    Shape {
        /// The kernel or op.
        op: &'static str,
        /// The argument.
        arg: &'static str,
        /// What was wanted.
        expected: String,
        /// What was given.
        actual: usize,
    },
    /// A file or folder could not be read or written.
    #[error("{}: {source}", shown(path))]
    Io {
        /// The file or folder.
        path: PathBuf,
        /// The system's error.
        source: std::io::Error,
    },
    /// The content of a file violates its format.
    #[error("{}: {what}", shown(path))]
    Format {
        /// The file.
        path: PathBuf,
        /// What is wrong, with the offset or the field.
        what: String,
    },
    /// The input is invalid; the message states what to do instead.
    #[error("{0}")]
    Input(String),
    /// The method did not find a result for this input.
    #[error("{0}")]
    Failed(String),
    /// The user interrupted the run; the last checkpoint stays usable.
    #[error("interrupted{}", .checkpoint.as_ref().map(|p| format!("; the run can be resumed from the checkpoint {}", shown(p))).unwrap_or_default())]
    Interrupted {
        /// The checkpoint to resume from, where one was written.
        checkpoint: Option<PathBuf>,
    },
}

impl Error {
    /// A closure for `map_err` that adds the path of the failed operation.
    pub fn io(path: impl AsRef<Path>) -> impl FnOnce(std::io::Error) -> Error {
        let path = path.as_ref().to_path_buf();
        move |source| Error::Io { path, source }
    }

    /// An [`Error::Format`] for this file.
    pub fn format(path: impl AsRef<Path>, what: impl Into<String>) -> Error {
        Error::Format { path: path.as_ref().to_path_buf(), what: what.into() }
    }
}

/// Text from a file, for quoting in a message: its first 80 characters on one line, and `…` if
/// there are more. Control characters are escaped, so that no file can write to the terminal.
pub fn excerpt(text: &str) -> String {
    printable(text.trim(), 80)
}

/// A path for a message: up to 4096 characters, with control characters escaped as in [`excerpt`],
/// since paths can come from other files.
fn shown(path: &Path) -> String {
    printable(&path.to_string_lossy(), 4096)
}

fn printable(text: &str, most: usize) -> String {
    let mut out = String::new();
    for (i, c) in text.chars().enumerate() {
        if i == most {
            out.push('…');
            break;
        }
        match is_harmless(c) {
            true => out.push(c),
            false => out.extend(c.escape_default()),
        }
    }
    out
}

/// Whether the character is neither a control character nor one that reverses or hides its
/// neighbours.
fn is_harmless(c: char) -> bool {
    !c.is_control()
        && !matches!(c, '\u{200b}'..='\u{200f}' | '\u{2028}'..='\u{202e}' | '\u{2066}'..='\u{2069}' | '\u{feff}')
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_quoted_is_short_and_printable() {
        assert_eq!(excerpt("  format text 1.0\r\n"), "format text 1.0");
        assert_eq!(excerpt("a\u{1b}[2J\tb\u{202e}c\u{85}é"), r"a\u{1b}[2J\tb\u{202e}c\u{85}é");
        let long = excerpt(&"é".repeat(1 << 20));
        assert_eq!((long.chars().count(), long.ends_with('…')), (81, true));
        let error = Error::format(format!("a\n{}", "b".repeat(9000)), "is odd").to_string();
        assert!(error.starts_with(r"a\nbbb") && error.len() < 4200 && error.ends_with(": is odd"));
    }
}

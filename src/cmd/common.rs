//! What all commands share: their common flags, what they answer, checks of where output goes.

use std::io::Write;
use std::path::Path;

use clap::Args;
use serde_json::Value;
use splat4d::gpu::{Device, DeviceKind, Footprint, Request, Selector};
use splat4d::{Error, Result};

/// The flags that every command takes.
#[derive(Args)]
pub struct Common {
    /// Print exactly one JSON object on stdout, everything else on stderr
    #[arg(long, global = true, help_heading = "Common options")]
    pub json: bool,
    /// The Vulkan device: its index, a part of its name, or a kind: best, gpu, integrated, software
    #[arg(
        long,
        global = true,
        help_heading = "Common options",
        value_name = "DEVICE",
        default_value = "best"
    )]
    pub device: String,
    /// Decides everything random; the same seed on the same device gives the same result
    #[arg(
        long,
        global = true,
        help_heading = "Common options",
        value_name = "NUMBER",
        default_value_t = 0
    )]
    pub seed: u64,
}

impl Common {
    /// Opens the device; a software driver that was not asked for is pointed out.
    pub fn open_device(&self) -> Result<Device> {
        let selector = Selector::from(self.device.as_str());
        let asked = selector != Selector::Best;
        let device = Device::open(&Request { selector, ..Request::default() })?;
        let info = device.info();
        if !asked && info.kind == DeviceKind::Software {
            say(&format!(
                "note: no GPU found, {} runs on the processor; it gives the same results slowly",
                info.name
            ));
        }
        Ok(device)
    }
}

/// What a command found out: for machines, and for people.
pub struct Answer {
    /// One object.
    pub json: Value,
    /// Whole lines.
    pub text: String,
}

/// A line on stderr. Nobody listening is no error.
pub fn say(line: &str) {
    let _ = writeln!(std::io::stderr(), "{line}");
}

/// Lines on stderr, each as a note.
pub fn notes(lines: &[String]) {
    lines.iter().for_each(|line| say(&format!("note: {line}")));
}

/// That a file can be written at `path`, before long work begins. Leaves nothing behind.
pub fn check_output_file(path: &Path) -> Result<()> {
    match std::fs::metadata(path) {
        Ok(found) if found.is_dir() => {
            Err(Error::format(path, "is a folder; name the file to write"))
        }
        // A pipe or a device is written in place.
        Ok(found) if !found.is_file() => {
            std::fs::File::options().write(true).open(path).map_err(Error::io(path)).map(drop)
        }
        _ => check_folder(path, path.parent().unwrap_or(Path::new("."))),
    }
}

/// That files can be written into a folder that may not exist yet. Leaves nothing behind.
pub fn check_output_folder(path: &Path) -> Result<()> {
    check_folder(path, path)
}

fn check_folder(output: &Path, folder: &Path) -> Result<()> {
    let mut folder = folder;
    loop {
        let here = if folder == Path::new("") { Path::new(".") } else { folder };
        match std::fs::metadata(here) {
            Ok(found) if found.is_dir() => {
                // Writing by rename makes a file beside the target, so that is what is tried.
                let tried = tempfile::tempfile_in(here);
                return tried.map(drop).map_err(|source| Error::Io {
                    path: output.to_path_buf(),
                    source: std::io::Error::new(
                        source.kind(),
                        format!("cannot write into {}: {}", here.display(), plain(&source)),
                    ),
                });
            }
            Ok(_) if here == output => {
                return Err(Error::format(output, "is a file; name a folder to write into"));
            }
            Ok(_) => {
                return Err(Error::format(output, format!("{} is a file", here.display())));
            }
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => match folder.parent() {
                Some(parent) => folder = parent,
                None => return Err(Error::io(output)(error)),
            },
            Err(error) => return Err(Error::io(output)(error)),
        }
    }
}

/// The system's message without the temporary file's name.
fn plain(error: &std::io::Error) -> String {
    let text = error.to_string();
    text.split(" at path ").next().unwrap_or(&text).to_string()
}

/// Says how much device memory some work will take, and gives it; an error where it does not fit, with
/// the most Gaussians that would, and what to turn.
pub fn foresee(
    device: &Device,
    what: &str,
    footprint: Result<Footprint>,
    most_gaussians: impl FnOnce() -> usize,
    turn: &str,
) -> Result<u64> {
    let name = &device.info().name;
    match footprint.and_then(|taken| taken.fits(device).map(|()| taken)) {
        Ok(taken) => {
            let free = bytes(device.free_memory());
            say(&format!("{what} takes {} of the {free} that {name} has free", bytes(taken.bytes)));
            Ok(taken.bytes)
        }
        Err(error @ (Error::RangeLimit { .. } | Error::TooLarge { .. })) => {
            let would = match most_gaussians() {
                0 => "not even one Gaussian would fit: make the pictures smaller".to_owned(),
                most => format!("{} Gaussians would fit: {turn}", thousands(most)),
            };
            Err(Error::Input(format!("{what} does not fit on {name}: {error}; {would}")))
        }
        Err(other) => Err(other),
    }
}

/// `1234567` as `1,234,567`.
pub fn thousands(number: usize) -> String {
    let digits = number.to_string();
    let mut text = String::new();
    for (i, digit) in digits.chars().enumerate() {
        if i > 0 && (digits.len() - i).is_multiple_of(3) {
            text.push(',');
        }
        text.push(digit);
    }
    text
}

/// Bytes in the largest unit that leaves a number above 1.
pub fn bytes(count: u64) -> String {
    let units = ["B", "KiB", "MiB", "GiB", "TiB"];
    let mut value = count as f64;
    let mut unit = 0;
    while value >= 1024.0 && unit + 1 < units.len() {
        value /= 1024.0;
        unit += 1;
    }
    if unit == 0 { format!("{count} B") } else { format!("{value:.1} {}", units[unit]) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_for_people() {
        assert_eq!(thousands(0), "0");
        assert_eq!(thousands(999), "999");
        assert_eq!(thousands(1_234_567), "1,234,567");
        assert_eq!(bytes(512), "512 B");
        assert_eq!(bytes(1536), "1.5 KiB");
        assert_eq!(bytes(3 << 30), "3.0 GiB");
    }

    #[test]
    fn outputs_are_tried_before_the_work() {
        let folder = tempfile::tempdir().unwrap();
        let inside = folder.path().join("a/b/scene.safetensors");
        check_output_file(&inside).unwrap();
        check_output_folder(&inside).unwrap();
        assert!(std::fs::read_dir(folder.path()).unwrap().next().is_none(), "nothing is left");
        let file = folder.path().join("file");
        std::fs::write(&file, "x").unwrap();
        check_output_file(&file).unwrap();
        let message = check_output_folder(&file).unwrap_err().to_string();
        assert!(message.contains("name a folder"), "{message}");
        assert!(check_output_file(&file.join("below")).is_err());
        let message = check_output_file(folder.path()).unwrap_err().to_string();
        assert!(message.contains("is a folder"), "{message}");
    }
}

//! What all commands share: their common flags, what they answer, words for people.

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

/// A machine's one object on stdout.
pub fn print_json(value: &Value) -> std::io::Result<()> {
    let mut stdout = std::io::stdout().lock();
    writeln!(stdout, "{value}")?;
    stdout.flush()
}

/// A line on stderr. Nobody listening is no error.
pub fn say(line: &str) {
    let _ = writeln!(std::io::stderr(), "{line}");
}

/// Lines on stderr, each as a note.
pub fn notes(lines: &[String]) {
    lines.iter().for_each(|line| say(&format!("note: {line}")));
}

/// A path as JSON holds it: as text, in which what is not Unicode is replaced.
pub fn path_text(path: &Path) -> Value {
    path.to_string_lossy().into()
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
}
